"""Damaged bags without the extra ``rescue``: they are read up to the damage, and every loss is said."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bevviz.bags import mcap
from bevviz.cli import main
from tests.support.bag_formats import FORMATS
from tests.support.damaged_bags import change, missing, read, records, whole

HINT = "pip install 'bevviz[rescue]'"


@pytest.fixture(autouse=True)
def _without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bevviz.bags.file_types.registered", lambda kind: {})


@pytest.mark.parametrize("name", [name for name in FORMATS if "zstd," not in name and "log" not in name])
@pytest.mark.parametrize("share", [0.4, 0.8])
def test_a_cut_bag_is_read_up_to_the_cut(tmp_path: Path, name: str, share: float) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    found, said = read(path)
    assert found == whole(name)[: len(found)]
    assert len(found) > (share - 0.25) * 161
    assert any(f"read {len(found)} messages" in text for text in said)
    assert any(HINT in text for text in said)


@pytest.mark.parametrize("name", ["mcap", "mcap, flat", "ros1"])
def test_a_bag_without_its_index_loses_nothing(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(whole(name)[-1][2]) + len(whole(name)[-1][2])])
    found, said = read(path)
    assert not missing(found, name)
    assert any("read 161 messages" in text for text in said)


@pytest.mark.parametrize("name", ["mcap", "mcap, lz4", "mcap, zstd"])
def test_a_damaged_chunk_loses_what_follows_in_it(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    change(path, records(path.read_bytes(), mcap.CHUNK)[3] + 2000, b"\x55\xaa\x55" * 100)
    found, said = read(path)
    wrong = [message for message in found if message not in whole(name)]
    assert len(found) > 140 and len(wrong) < 5
    assert any("1 damaged chunk(s), " in text and "what follows in them is lost" in text for text in said)
    assert any(f"count 161 messages: {161 - len(found)} are lost" in text for text in said) or wrong
    assert any(HINT in text for text in said)


@pytest.mark.parametrize("name", ["mcap", "mcap, flat", "ros1"])
def test_reading_ends_at_a_broken_record(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    _, _, content = whole(name)[100]
    change(path, data.rindex(content), b"\0\0" + b"\xff" * len(content))
    change(path, len(data) - 40, b"\0" * 40)
    found, said = read(path)
    assert 60 < len(found) < 161
    assert any(HINT in text for text in said)


def test_a_complete_bag_without_an_index_is_read_to_its_end(tmp_path: Path) -> None:
    found, said = read(FORMATS["mcap, flat"](tmp_path))
    assert not missing(found, "mcap, flat")
    assert not any(HINT in text or "lost" in text or "broken" in text for text in said)


def test_a_message_on_the_cut_page_of_a_database_is_not_given(tmp_path: Path) -> None:
    path = FORMATS["sqlite3"](tmp_path)
    data = path.read_bytes()
    for size in range(len(data) // 2, len(data) // 2 + 4096 * 3, 1500):
        path.write_bytes(data[:size])
        found, said = read(path)
        assert found == whole("sqlite3")[: len(found)] and len(found) > 50
        assert any(HINT in text for text in said)


def test_a_log_beside_a_database_is_named(tmp_path: Path) -> None:
    found, said = read(FORMATS["sqlite3, with a log"](tmp_path))
    assert found == whole("sqlite3")[: len(found)]
    assert any("messages lie in bag.db3-wal" in text for text in said)
    assert any(HINT in text for text in said)


def test_recover_writes_what_precedes_the_damage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, fixed = FORMATS["mcap, zstd"](tmp_path), tmp_path / "fixed.mcap"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    left, _ = read(path)
    assert main(["recover", str(path), "--output", str(fixed)]) == 0
    said = capsys.readouterr().err
    assert HINT in said and re.search(rf"{len(left)} messages of \d topics read", said)
    found, warnings = read(fixed)
    assert found == left and not warnings
