"""Text of others where it is shown: what a Markdown reader that is not ours makes of it, and a terminal."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from markdown_it.token import Token

from bevviz.cli import main
from bevviz.errors import UserError, printable
from bevviz.support import table
from bevviz.support.text import fenced, markdown
from tests.support import bags
from tests.support.recordings import Recording

READER = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
ANYTHING = st.one_of(
    st.text(),
    st.text("\\`*_[]()<>~|&$#+-=:.!;1a \n\t\x1b", max_size=30),
    st.lists(st.sampled_from(["**", "__", "](x)", "<b>", "&lt;", "```", "~~", "1.", "- ", "a", " "])).map(
        "".join
    ),
)


def words(tokens: list[Token]) -> list[str]:
    """Return the text of each paragraph, cell or heading. Fail if one contains more than plain text."""
    found = []
    for token in tokens:
        if token.type == "inline":
            assert {child.type for child in token.children or []} <= {"text", "text_special"}, token.children
            found.append("".join(child.content for child in token.children or []))
    return found


def shown(text: str) -> str:
    return printable(" ".join(text.split()))


@given(ANYTHING)
@example("tracks_of_ _x_ __init__ a_b")
@example("1. one")
@example("# no heading")
@example("no end of one #")
@example("~~struck~~")
@example("[link](javascript:x) ![i](j) <script>alert(1)</script> &lt; `code` a  \nb")
def test_markdown_shows_any_text_as_it_is(text: str) -> None:
    line = markdown(text)
    assert "\n" not in line and line.isprintable()
    if not shown(text):
        return
    for page, kinds in (
        (f"- {line}\n", ["bullet_list_open", "list_item_open", "paragraph_open"]),
        (f"### {line}\n", ["heading_open"]),
        (f"> {line}\n", ["blockquote_open", "paragraph_open"]),
        (f"{line}\n", ["paragraph_open"]),
    ):
        tokens = READER.parse(page)
        assert [t.type for t in tokens if t.type.endswith("_open")] == kinds, page
        assert words(tokens) == [shown(text)]


@given(st.lists(st.tuples(ANYTHING, ANYTHING), min_size=1, max_size=4))
def test_any_text_stays_in_its_table_cell(cells: list[tuple[str, str]]) -> None:
    rows = [("what", "how many"), *cells]
    tokens = READER.parse(table.markdown(rows))
    assert tokens[0].type == "table_open" and tokens[-1].type == "table_close"
    assert words(tokens) == [shown(cell) for row in rows for cell in row]


@given(ANYTHING)
def test_a_block_of_code_ends_where_it_should(text: str) -> None:
    text = text.replace("\r", "").replace("\x00", "")  # which Markdown changes everywhere
    (block,) = READER.parse(f"{fenced(text, 'yaml')}\n")
    assert block.type == "fence" and block.info == "yaml"
    assert block.content == text.removesuffix("\n") + "\n"


@pytest.mark.parametrize(
    "text",
    [
        "person 0.90: 14 points of cluster 0 in its frustum at 7.8 m, IoU 0.61, matched",
        "cluster 3: 12 points at 9.1 m: set aside, clustering.min_cluster_points is 20",
        "car 0.31: suppressed by car 0.62, IoU 0.55 > detector.iou_threshold 0.45",
        "person #12 1.4 m/s",
    ],
)
def test_our_own_sentences_stay_as_they_are(text: str) -> None:
    assert markdown(text) == printable(text) == text


@given(ANYTHING)
def test_control_characters_do_not_reach_the_terminal(text: str) -> None:
    safe = printable(text)
    assert not re.search(r"[\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]", safe)
    assert printable(safe) == safe
    assert (safe == text) == text.isprintable()
    error = str(UserError(f"{text}: no such topic"))
    assert error.isprintable()
    (head, row) = table.lines([("topic", "type"), (text, "x")])
    assert head.isprintable() and row.isprintable()


def test_columns_are_aligned_for_any_text() -> None:
    rows = [("what", "n", "text"), ("a", "10", "x"), ("bcd", "5", "yz")]
    assert list(table.lines(rows)) == ["what   n  text", "a     10     x", "bcd    5    yz"]
    assert list(table.lines(rows, "lrl")) == ["what   n  text", "a     10  x", "bcd    5  yz"]
    assert table.markdown(rows[:2], "lrl") == "| what | n | text |\n| --- | ---: | --- |\n| a | 10 | x |"


# --- a hostile bag -----------------------------------------------------------------------------

EVIL = "\x1b]0;owned\x07<b>*_x`|[y](z)\u202e"


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a drive whose topics and frames contain terminal escapes and markup."""
    items = []
    for item in bags.small_items(scans=6):
        if hasattr(item.message, "header"):
            item.message.header.frame_id += EVIL
        for edge in getattr(item.message, "transforms", ()):
            edge.header.frame_id += EVIL
            edge.child_frame_id += EVIL
        topic = item.topic if item.topic.startswith("/tf") else f"/{EVIL}{item.topic}"
        items.append(item._replace(topic=topic))
    return bags.write(tmp_path_factory.mktemp("hostile") / "drive", items)


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "status"),
    [
        ("info {bag}", 0),
        ("bag {bag} --save run.rrd", 0),
        ("bag {bag} --save run.rrd --set source.lidar_topics=[/absent]", 2),
        ("why {bag} --at 0.3 --class car --model demo --save why.rrd", 0),
        ("compare {bag} --model demo --save compare.rrd", 0),
        ("compare {bag} --robot", 2),
        ("sweep {bag} --model demo --set clustering.eps=0.4,0.5 --save sweep.rrd", 0),
        ("report {bag} --at 0.3 --before 0.2 --after 0.2", 0),
        ("batch {bag} -o runs --jobs 1", 0),
        ("calib {bag}", 0),
    ],
)
def test_names_in_a_hostile_bag_are_shown_as_text(
    command: str,
    status: int,
    hostile: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    assert main(command.format(bag=hostile).split()) == status
    for text in capfd.readouterr():
        assert all(line.isprintable() for line in text.split("\n")), ascii(text)
    for path in tmp_path.glob("*.rrd"):
        pages = pages_of(Recording(path))
        assert pages
        assert any("owned" in page for page in pages) or path.stem == "sweep"
        for page in pages:
            tokens = READER.parse(page)
            kinds = {child.type for token in tokens for child in token.children or []}
            assert not kinds & {"html_inline", "link_open", "image", "code_inline"}, page
            assert "html_block" not in {token.type for token in tokens}


def pages_of(found: Recording) -> list[str]:
    """Every page of Markdown in a recording."""
    pages = [text for entity in found.at for text in found.text(entity)]
    pages += [
        values["TextDocument:text"][0] for values in found.static.values() if "TextDocument:text" in values
    ]
    return pages
