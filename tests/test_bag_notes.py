"""Notes beside a bag."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bevviz.errors import UserError
from bevviz.pipeline.notes import Note, Notes

LATE, EARLY = Note(200, 210, "later"), Note(100, 110, "Größe: 3 m", "car at 3 m", "truth//1")


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return tmp_path / "drive.mcap"


def test_notes_are_kept_in_order_and_found_by_time(bag: Path) -> None:
    notes = Notes([bag, bag.with_name("second.mcap")])
    for note in (LATE, EARLY):
        notes.add(note)
    assert [str(note) for note in Notes([bag])] == ["car at 3 m: Größe: 3 m", "later"]
    assert notes.between(110, 210) == [EARLY]
    assert [path.name for path in bag.parent.iterdir()] == ["drive.mcap.notes.json"]
    notes.remove(EARLY)
    assert list(notes) == [LATE]
    notes.remove(LATE)
    assert not list(bag.parent.iterdir())


@pytest.mark.long
@given(text=st.text(min_size=1, max_size=50).filter(str.strip))
def test_any_text_of_a_note_is_read_back(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    notes = Notes([tmp_path_factory.mktemp("notes") / "drive.mcap"])
    notes.add(Note(1, 2, text))
    assert [note.text for note in notes] == [text]


WRONG_TYPE = '{"notes": [{"stamp": "now", "received": 0, "text": "a child"}]}'


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"notes": [{"stamp": 1}]}', '{"notes": 3}', WRONG_TYPE, "[" * 100_000]
)
def test_a_file_without_notes_is_left_unchanged(bag: Path, content: str) -> None:
    notes = Notes([bag])
    notes.path.write_text(content)
    with pytest.raises(UserError, match="holds no notes"):
        list(notes)
    with pytest.raises(UserError, match="move it away"):
        notes.add(LATE)
    assert notes.path.read_text() == content


def test_an_unwritable_notes_file_is_reported(bag: Path) -> None:
    notes = Notes([bag.parent / "missing" / "drive.mcap"])
    with pytest.raises(UserError, match="cannot write the notes: No such file or directory"):
        notes.add(LATE)


def test_notes_of_a_read_only_folder_are_in_the_users_data(
    bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(data := bag.parent / "data"))
    monkeypatch.setattr("os.access", lambda path, mode: path != bag.parent)
    notes = Notes([bag])
    notes.add(LATE)
    assert notes.path.parent == data / "bevviz" / "notes" and list(Notes([bag])) == [LATE]
    other = Notes([bag.parent / "other" / "drive.mcap"])
    assert not list(other) and other.path != notes.path, "another bag of that name has its own"


@pytest.mark.parametrize("text", ["", "  \n", "x" * 3000])
def test_empty_and_overlong_notes_are_refused(bag: Path, text: str) -> None:
    with pytest.raises(UserError, match="characters"):
        Notes([bag]).add(Note(1, 2, text))
    assert not list(bag.parent.iterdir())


def test_notes_are_plain_json(bag: Path) -> None:
    Notes([bag]).add(EARLY)
    (note,) = json.loads(Notes([bag]).path.read_text())["notes"]
    assert note == {
        "stamp": 100, "received": 110, "text": "Größe: 3 m", "about": "car at 3 m", "pick": "truth//1",
        "end": 0, "label": "", "box": [], "points_frame": "",
    }  # fmt: skip
