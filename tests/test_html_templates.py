"""Pages: what is filled in is text, and nothing that a template names may be missing."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jinja2 import UndefinedError

from bevviz.extras.batch.causes import Causes, Findings, find_causes
from bevviz.extras.batch.findings import SCHEMA
from bevviz.extras.batch.summary import BagTotals, page
from bevviz.extras.batch.table import RunInfo
from bevviz.model.frame import Scene
from bevviz.report.pictures import plot
from bevviz.support.html import render, template_environment
from tests.support.html_pages import Page

EVIL = "</style></script><script>alert('x')</script>\"'><img src=x onerror=alert(1)> &amp; {{ 7 * 7 }}"


COUNTED: dict[str, object] = {
    "failures": 0,
    "problems": 1,
    "missed": None,
    "false": None,
    "anomalies": 0,
    "unmatched": [],
    "picture": b"\xff\xd8",
    "above": None,
}


def totals(name: str) -> BagTotals:
    counts = dict.fromkeys(("failures", "problems", "clusters", "detections", "matched", "no_cluster"), 1)
    info = RunInfo("key", name, "id", 1, 0.5, Scene(name, "lidar"), (name,))
    return BagTotals(name, info, 0, 0.5, counts, 10.0, 20.0, Counter(lacking=1), 3.5)


def batch(text: str) -> str:
    row = {
        "badness": 3.5,
        "recording": text,
        "frame": 7,
        "stamp": 10**18,
        "sync_error_ms": 1.0,
        "tf_age_ms": None,
        "remarks": [text] * 9,
        "link": None,
        **COUNTED,
    }
    return page(text, [totals(text)], [row], [(text, text)], "", causes(text))


def causes(text: str) -> Causes:
    words = dict.fromkeys(("bag", "recording", "reason", "text", "class", "object"), text)
    found = {**words, "outcome": "missed", "frame": 0, "stamp": 0}
    return find_causes(Findings(pa.Table.from_pylist([found], schema=SCHEMA), Path()))


@pytest.mark.long
@given(st.one_of(st.text(max_size=40), st.just(EVIL)))
def test_no_name_becomes_markup(name: str) -> None:
    shown, plain = Page(batch(name)), Page(batch("plain"))
    assert [tag for tag, _ in shown.tags] == [tag for tag, _ in plain.tags]
    assert [list(attrs) for _, attrs in shown.tags] == [list(attrs) for _, attrs in plain.tags]
    if name == EVIL:
        assert shown.text.count(EVIL) >= 9
        assert next(attrs["title"] for tag, attrs in shown.tags if tag == "span" and attrs) == EVIL


def test_only_addresses_of_recordings_are_linked() -> None:
    row = {"badness": 1, "recording": "a", "frame": 0, "stamp": 0, "remarks": [], **COUNTED}
    row |= {"sync_error_ms": None, "tf_age_ms": None, "link": "javascript:alert(1)"}
    with pytest.raises(ValueError, match="no address of a recording"):
        page("x", [], [row], [], "", causes("x"))


def test_a_missing_value_of_a_template_is_an_error() -> None:
    with pytest.raises(UndefinedError, match="bags"):
        render("batch.html", title="x")


def test_a_page_loads_nothing() -> None:
    (policy,) = (a["content"] for tag, a in Page(batch("x")).tags if "http-equiv" in a)
    assert (
        policy == "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
    )


def test_a_plot_draws_its_values() -> None:
    drawn = plot("a < b", {"<x>": [(0.0, 1.0), (1.0, 3.0)], "one": [(0.5, -2.0)]}, 0.5)
    assert drawn is not None
    inside = [(x, y) for line in drawn.lines for x, y in line.points]
    assert all(drawn.left <= x <= drawn.right and drawn.top <= y <= drawn.bottom for x, y in inside)
    template = template_environment().from_string('{% from "macros.html" import plot %}{{ plot(drawn) }}')
    found = Page(template.render(drawn=drawn))
    tags = [tag for tag, _ in found.tags]
    assert tags.count("polyline") == 2 and tags.count("circle") == 1
    assert all(text in found.text for text in ("a < b", "<x>", "one"))
    assert plot("none", {"empty": []}, 0) is None
