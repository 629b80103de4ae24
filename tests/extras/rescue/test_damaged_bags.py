"""Damaged bags: what is there is read, nothing false is given, and every loss is said with a number."""

from __future__ import annotations

import bz2
import os
import re
import sqlite3
import struct
import tracemalloc
from collections import Counter
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard

from bevviz.bags import chunks, mcap
from bevviz.bags.bag import Recording
from bevviz.bags.compression import unpack
from bevviz.bags.reader import DamageError, FileBytes
from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.extras.rescue.sqlite import checksum_of
from bevviz.pipeline.bag_info import describe_bag, render_bag_info
from bevviz.support.limits import MIN_CHUNK
from tests.support.bag_formats import FORMATS
from tests.support.commands import error_of
from tests.support.damaged_bags import Found, change, missing, read, records, whole
from tests.support.foreign_readers import judges, taken

# --- sound -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FORMATS)
def test_a_sound_bag_is_read_without_a_rescue(tmp_path: Path, name: str) -> None:
    found, said = read(FORMATS[name](tmp_path))
    assert not missing(found, name)
    how = {"mcap, flat": "it is read from end to end", "sqlite3, with a log": "rescued"}  # no index, no end
    if name in how:
        assert [how[name] in text for text in said].count(True) == 1
    else:
        assert not said


def test_a_programming_error_is_not_reported_as_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = FORMATS["mcap"](tmp_path)

    def broken(*_: object) -> None:
        raise TypeError("a slip of ours")

    monkeypatch.setattr(mcap.Channels, "connections", broken)
    with pytest.raises(TypeError, match="a slip of ours"):
        read(path)
    monkeypatch.undo()
    monkeypatch.setattr(chunks.ChunkReader, "times", broken)
    with pytest.raises(TypeError, match="a slip of ours"):
        read(path)


# --- an index that is not to be believed -------------------------------------------------------


@pytest.mark.parametrize("name", ["mcap", "mcap, no checksums", "mcap, one chunk"])
def test_an_mcap_cut_behind_its_last_chunk_has_all_messages(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    last = records(data, mcap.CHUNK)[-1]
    end = last + 9 + struct.unpack_from("<Q", data, last + 1)[0]
    for cut in range(end, len(data), max(1, (len(data) - end) // 12)):
        path.write_bytes(data[:cut])
        found, said = read(path)
        assert not missing(found, name)
        assert any("read 161 messages" in text for text in said)


def test_a_cut_ros1_bag_yields_all_messages_before_the_cut(tmp_path: Path) -> None:
    path = FORMATS["ros1"](tmp_path)
    data, written = path.read_bytes(), whole("ros1")
    ends, at = [], 0
    for _, _, content in written:
        at = data.index(content, at) + len(content)
        ends.append(at)
    for cut in range(30_000, len(data), len(data) // 25):
        path.write_bytes(data[:cut])
        found, said = read(path)
        assert found == written[: sum(end <= cut for end in ends)]
        assert any(f"read {len(found)} messages" in text for text in said)


@pytest.mark.parametrize("name", ["mcap", "mcap, zstd", "mcap, one chunk"])
@pytest.mark.parametrize("kind", [mcap.CHUNK_INDEX, mcap.STATISTICS, mcap.MESSAGE_INDEX, mcap.CHANNEL])
def test_a_changed_opcode_in_the_index_loses_nothing(tmp_path: Path, name: str, kind: int) -> None:
    path = FORMATS[name](tmp_path)
    change(path, records(path.read_bytes(), kind)[-1], b"\x4d")
    found, said = read(path)
    assert not missing(found, name)
    # A damaged message index does not keep a chunk from being read, nor is it asked for before.
    told = [text for text in said if "rescued" in text or "read from end to end" in text]
    assert kind == mcap.MESSAGE_INDEX or len(told) == 1


def test_an_index_that_contradicts_the_statistics_is_ignored(tmp_path: Path) -> None:
    path = FORMATS["mcap, one chunk"](tmp_path)
    at = records(path.read_bytes(), mcap.STATISTICS)[0]
    change(path, at + 9, struct.pack("<Q", 200))
    with pytest.raises(DamageError, match=r"of 1 chunks with 161 messages, disagrees .* of 1 with 200"):
        mcap.read_index(path)
    found, said = read(path)
    assert not missing(found, "mcap")
    assert any("count 200 messages: 39 are lost" in text for text in said)


# --- broken records ----------------------------------------------------------------------------


@pytest.mark.parametrize("length", [0, 5, 300, 1 << 33, 2**63 - 1, 2**64 - 1])
@pytest.mark.parametrize("name", ["mcap, flat", "mcap, no checksums", "mcap, one chunk"])
def test_reading_resumes_after_a_broken_message(tmp_path: Path, name: str, length: int) -> None:
    path = FORMATS[name](tmp_path)
    at = records(path.read_bytes(), mcap.MESSAGE)[70]
    change(path, at + 1, struct.pack("<Q", length))
    found, said = read(path)
    assert missing(found, name) == 1
    assert any(re.search(r"1 (are|messages) lost|: 1 are lost", text) for text in said)


@pytest.mark.parametrize("name", ["mcap", "mcap, lz4", "mcap, zstd"])
@pytest.mark.parametrize("wrong", [b"\x00", b"\x05", b"\xff"])
def test_a_chunk_is_recognized_by_its_content(tmp_path: Path, name: str, wrong: bytes) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    change(path, records(data, mcap.CHUNK)[3], wrong)
    path.write_bytes(path.read_bytes()[:-40])  # without its index, that is
    assert not missing(read(path)[0], name)


def rightness(found: Found, name: str) -> tuple[int, int]:
    """How many messages are as they were written, and how many are not."""
    right = (Counter(found) & Counter(whole(name))).total()
    return right, len(found) - right


@pytest.mark.parametrize("name", ["mcap", "mcap, lz4", "mcap, zstd"])
@pytest.mark.parametrize("end", [None, -40])  # with its index and without it
def test_a_wrong_checksum_alone_drops_no_message(tmp_path: Path, name: str, end: int | None) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()[:end]
    path.write_bytes(data)
    change(path, records(data, mcap.CHUNK)[3] + 9 + 24, b"\x55\xaa\x55\xaa")  # the checksum itself
    found, said = read(path)
    assert rightness(found, name) == (161, 0)
    why = "1 damaged chunk(s), the content of a chunk does not fit its checksum: 0 messages lost"
    assert any(re.search(re.escape(why) + r", \d+ that were kept may be wrong", text) for text in said)


@pytest.mark.parametrize("name", ["mcap", "mcap, lz4", "mcap, zstd"])
def test_messages_lost_in_a_damaged_chunk_are_counted(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    change(path, records(data, mcap.CHUNK)[3] + 2000, b"\x55\xaa\x55" * 100)
    found, said = read(path)
    right, wrong = rightness(found, name)
    lost = 161 - right - wrong
    assert right > 140 and wrong < 5 and (lost or wrong)
    assert any("1 damaged chunk(s), " in s and f": {lost} messages lost" in s for s in said)


@pytest.mark.parametrize("name", ["mcap, one zstd chunk", "mcap, one lz4 chunk", "ros1, one lz4 chunk"])
@pytest.mark.parametrize("end", [None, 0.9])  # a whole file, and one that ends within the chunk
def test_messages_before_the_damage_in_a_chunk_are_kept(tmp_path: Path, name: str, end: float | None) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: None if end is None else int(end * len(data))])
    change(path, len(data) * 2 // 3, b"\xff\0" * 3000)
    found, said = read(path)
    right, wrong = rightness(found, name)
    # The other readers unpack the chunk with libraries of their own, a few bytes at a time.
    others = [Counter(taken(judge, path)) for judge in judges(name).values()]
    best = max((other & Counter(whole(name))).total() for other in others)
    assert right >= best > 60
    assert wrong < 5
    if end is None:  # what is wrong in a block that is stored as it is, only the whole chunk tells
        told = f"1 damaged chunk\\(s\\), .*: {161 - len(found)} messages lost, {len(found)} that were kept"
        assert any(re.search(told, text) for text in said)


@pytest.mark.parametrize("size", [0, 1, 10**12, 2**64 - 1])
def test_the_size_that_a_chunk_claims_costs_nothing(tmp_path: Path, size: int) -> None:
    path = FORMATS["mcap, one zstd chunk"](tmp_path)
    data = path.read_bytes()[:-40]
    path.write_bytes(data)
    change(path, records(data, mcap.CHUNK)[0] + 9 + 16, struct.pack("<Q", size))
    tracemalloc.start()
    found, _ = read(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert rightness(found, "mcap") == (161, 0)
    assert most < 50e6


@pytest.mark.parametrize("compression", ["zstd", "lz4", "bz2"])
def test_a_chunk_is_unpacked_to_a_limit(compression: str) -> None:
    bomb = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress}[compression]
    data, damage = unpack(compression, bomb(bytes(MIN_CHUNK + (1 << 20))), 1000)
    assert len(data) == MIN_CHUNK
    assert damage == "a chunk ends early"


@pytest.mark.parametrize("name", ["mcap", "mcap, zstd", "ros1", "ros1, bz2", "sqlite3"])
def test_missing_bytes_lose_only_their_messages(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[:200_000] + (bytes(300) if name == "sqlite3" else b"") + data[200_300:])
    found, said = read(path)
    assert missing(found, name) < 30 if name != "sqlite3" else len(found) > 155
    assert name == "sqlite3" or any(re.search(r"\d+ (are|messages) lost|\d broken place", s) for s in said)


def test_no_message_is_yielded_twice_after_damage(tmp_path: Path) -> None:
    path = FORMATS["mcap"](tmp_path)
    change(path, records(path.read_bytes(), mcap.CHUNK)[4] + 5000, b"\0\0\0\0\0\0\0\1")
    with Recording([path]) as recording:
        names = [topic.name for topic in recording.topics]
        messages = recording.messages(names)
        first = [next(messages) for _ in range(20)]
        assert not recording.warnings
        rest = list(messages)
        found = [(m.topic, m.received, bytes(m.data)) for m in [*first, *rest]]
        assert any("does not fit its checksum" in text for text in recording.warnings)
        again = [(m.topic, m.received, bytes(m.data)) for m in recording.messages(names)]
    assert rightness(found, "mcap") in [(160, 0), (160, 1)]
    assert again == found


@pytest.mark.parametrize("name", ["mcap", "mcap, zstd", "mcap, flat", "sqlite3", "ros1", "ros1, lz4"])
def test_a_file_cut_during_reading_is_reported(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    size = path.stat().st_size
    with Recording([path]) as recording:
        names = [topic.name for topic in recording.topics]
        messages = recording.messages(names)
        found = [next(messages) for _ in range(10)]
        os.truncate(path, size // 2)
        found += messages
        said = recording.warnings
    given = [(m.topic, m.received, bytes(m.data)) for m in found]
    assert 30 < missing(given, name) < 110
    assert any(re.search(r"\d+ messages lost|read \d+ messages", text) for text in said)


# --- numbers beyond all measure ----------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", ["mcap", "mcap, flat", "mcap, no checksums", "ros1", "sqlite3"])
def test_no_number_in_a_file_leads_to_a_traceback(tmp_path: Path, name: str) -> None:
    """The places take turns with two numbers, one of which is negative where it is read as signed."""
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    places = range(4096, len(data), 30_011) if "mcap" not in name else []
    for kind in (mcap.MESSAGE, mcap.CHUNK, mcap.CHUNK_INDEX, mcap.STATISTICS, mcap.FOOTER, mcap.SCHEMA):
        if "mcap" in name:
            places = [*places, *(at + 9 + step for at in records(data, kind)[:1] for step in range(0, 32, 8))]
    first = name != "mcap"  # the formats of MCAP share their records, which so get both numbers
    for number, at in enumerate(places, start=first):
        path.write_bytes(data)
        change(path, at, struct.pack("<Q", 2**62 if number % 2 else 2**64 - 1))
        try:
            read(path)
            render_bag_info(describe_bag([path], Config()))
        except UserError as error:
            assert "\n" not in str(error)


def test_a_time_that_no_date_has_is_a_broken_message(tmp_path: Path) -> None:
    path = FORMATS["mcap, flat"](tmp_path)
    at = records(path.read_bytes(), mcap.MESSAGE)[5]
    change(path, at + 9 + 6, struct.pack("<Q", 2**63 + 7))
    found, said = read(path)
    assert missing(found, "mcap, flat") == 1
    assert any("count 161 messages: 1 are lost" in text for text in said)


@pytest.mark.parametrize("name", ["mcap, flat", "ros1"])
def test_a_definition_that_is_no_utf8_is_reported(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    path.write_bytes(data.replace(b"uint32 height", b"uint32 \xff\xfe\xfdght"))
    with BagSource([path], Config()) as source:
        list(source)
        said = source.warnings
    assert len(read(path)[0]) == 161
    assert any("definition" in text or "could not be used" in text for text in said)


# --- ROS 1 -------------------------------------------------------------------------------------


def test_messages_of_an_unknown_connection_are_counted(tmp_path: Path) -> None:
    path = FORMATS["ros1"](tmp_path)
    data = path.read_bytes()
    for match in re.finditer(rb"conn=(....)", data, re.DOTALL):
        if match[1] == b"\x03\0\0\0":
            change(path, match.start(1), b"\x77\0\0\0")
    found, said = read(path)
    assert missing(found, "ros1") <= 41
    assert any("that nothing describes: lost" in text for text in said) or not missing(found, "ros1")


@pytest.mark.parametrize("name", ["ros1", "ros1, bz2", "ros1, lz4"])
def test_changed_opcodes_of_ros1_records_lose_nothing(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    data = path.read_bytes()
    places = [match.end() for match in re.finditer(b"op=", data)]
    for at in places[1 :: len(places) // 10]:
        path.write_bytes(data)
        change(path, at, b"\x09")
        assert not missing(read(path)[0], name)


# --- sqlite3 -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [10, 11])
def test_columns_of_wrong_types_lose_one_message_at_most(tmp_path: Path, kind: int) -> None:
    path = FORMATS["sqlite3"](tmp_path)
    data = path.read_bytes()
    matches = list(re.finditer(rb"\x00[\x01\x08\x09]\x06", data))  # id, topic, time, and then the data
    assert len(matches) > 20
    change(path, matches[10].start() + 1, bytes([kind]))
    found, said = read(path)
    assert missing(found, "sqlite3") <= 1
    assert any("rescued" in text for text in said)


def test_the_log_beside_a_database_is_read(tmp_path: Path) -> None:
    path = FORMATS["sqlite3, with a log"](tmp_path)
    log = path.with_name("bag.db3-wal")
    assert log.stat().st_size > 100_000
    before = path.read_bytes(), log.read_bytes(), sorted(tmp_path.rglob("*"))
    found, said = read(path)
    assert not missing(found, "sqlite3")
    assert any("messages lie in bag.db3-wal" in text for text in said)
    assert (path.read_bytes(), log.read_bytes(), sorted(tmp_path.rglob("*"))) == before
    log.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    rows = sqlite3.connect(path).execute("SELECT count(*) FROM messages").fetchall()
    found, _ = read_copy(path, before[0], log)
    assert len(found) == rows[0][0] > 120


def read_copy(path: Path, data: bytes, log: Path) -> tuple[Found, list[str]]:
    """Read again as it was before sqlite3 had looked at it."""
    folder = path.parent / "copy"
    folder.mkdir()
    (folder / "bag.db3").write_bytes(data)
    (folder / "bag.db3-wal").write_bytes(log.read_bytes())
    return read(folder / "bag.db3")


def test_the_checksum_of_a_log_is_that_of_its_definition() -> None:
    data, before = os.urandom(8 + 512), (123_456_789, 4_000_000_000)
    for order in "<>":
        s0, s1 = before
        for x0, x1 in struct.iter_unpack(f"{order}II", data):
            s0 = (s0 + x0 + s1) % 2**32
            s1 = (s1 + x1 + s0) % 2**32
        assert checksum_of(data, order, before) == (s0, s1)


def test_a_database_whose_index_disagrees_with_its_messages(tmp_path: Path) -> None:
    path = FORMATS["sqlite3"](tmp_path)
    with sqlite3.connect(path) as connection:
        (root,) = connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'timestamp_idx'"
        ).fetchone()
        (size,) = connection.execute("PRAGMA page_size").fetchone()
    connection.close()
    data = path.read_bytes()
    at = data.index(struct.pack(">q", whole("sqlite3")[9][1]), (root - 1) * size, root * size)
    change(path, at + 4, b"\0\0\0")
    found, said = read(path)
    assert not missing(found, "sqlite3")
    assert any("its index of times disagrees" in text for text in said)


# --- packed files ------------------------------------------------------------------------------


def test_a_cut_zstd_file_keeps_every_whole_block(tmp_path: Path) -> None:
    path = FORMATS["mcap.zstd"](tmp_path)
    data = path.read_bytes()
    for share in (0.3, 0.61, 0.97):
        path.write_bytes(data[: int(share * len(data))])
        reference = zstandard.ZstdDecompressor().decompressobj().decompress(path.read_bytes())
        found, said = read(path)
        written = whole("mcap")
        there = sum(reference.find(content) >= 0 for _, _, content in written)
        assert found == written[:there]
        assert any("its end is missing" in text and "could be unpacked" in text for text in said)


def test_unpacking_resumes_after_a_damaged_frame(tmp_path: Path) -> None:
    path = FORMATS["mcap.zstd, several frames"](tmp_path)
    data = path.read_bytes()
    second = data.index(b"\x28\xb5\x2f\xfd", 4)
    change(path, second + 4, b"\xff" * 12)
    found, said = read(path)
    assert len(found) > 60 and missing(found, "mcap") < 100
    assert {time for _, time, _ in found} >= {time for _, time, _ in whole("mcap")[-20:]}
    assert any("1 damaged place(s)" in text for text in said)


# --- what else stands in the way ---------------------------------------------------------------


@pytest.mark.parametrize("name", ["mcap", "ros1"])
def test_damaged_first_bytes_are_survived(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    change(path, 0, b"\0\0\0\0")
    found, said = read(path)
    assert not missing(found, name)
    assert any("rescued" in text for text in said)


def test_a_database_whose_rows_are_all_in_its_log_is_read(tmp_path: Path) -> None:
    path = tmp_path / "bag.db3"
    with sqlite3.connect(FORMATS["sqlite3"](tmp_path)) as source, sqlite3.connect(path) as target:
        target.execute("PRAGMA journal_mode=WAL")
        target.execute("PRAGMA wal_autocheckpoint=0")
        target.execute("CREATE TABLE first (id)")
        script = "\n".join(source.iterdump())
        target.executescript(script)
        log = path.with_name("bag.db3-wal").read_bytes()
    source.close()
    target.close()
    path.write_bytes(b"")
    path.with_name("bag.db3-wal").write_bytes(log)
    assert not missing(read(path)[0], "sqlite3")


@pytest.mark.parametrize("name", ["drive #1?.db3", "100%.db3", "drive", "drive.mcap"])
def test_odd_file_names_are_opened(tmp_path: Path, name: str) -> None:
    path = FORMATS["sqlite3"](tmp_path)
    found, said = read(path.rename(tmp_path / name))
    assert not missing(found, "sqlite3")
    assert not said


# --- a summary that describes topics in another way than the data --------------------------------

UNSEALED = ["mcap, no checksums", "mcap, zstd, no checksums"]


def in_summary(path: Path, old: bytes, new: bytes) -> None:
    """Replace bytes of the same length at their last occurrence in the summary of an MCAP file."""
    data = path.read_bytes()
    (start,) = struct.unpack_from("<Q", data, len(data) - 28)
    at = data.rindex(old)
    assert at > start and len(old) == len(new)
    change(path, at, new)


@pytest.mark.parametrize("name", UNSEALED)
def test_topics_are_read_if_the_summary_is_damaged(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    in_summary(path, b"/velodyne_points", b"/velodyne_pojnts")
    found, said = read(path)
    assert not missing(found, name)
    assert said == [
        "bag.mcap: its index describes /velodyne_pojnts in another way than its data: "
        "what is there was rescued",
        "bag.mcap: read 161 messages; 'bevviz recover' writes a sound copy",
    ]


@pytest.mark.parametrize("name", UNSEALED)
def test_types_are_read_if_the_summary_is_damaged(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path)
    in_summary(path, b"sensor_msgs/msg/PointCloud2", b"sensor_msgs/msg/PointCloud3")
    with Recording([path]) as recording:
        kinds = {topic.name: topic.type for topic in recording.topics}
        assert kinds["/velodyne_points"] == "sensor_msgs/msg/PointCloud2"
        assert "describes /velodyne_points in another way" in recording.warnings[0]


def test_only_chunks_with_a_first_message_are_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = FORMATS["mcap, zstd, no checksums"](tmp_path)
    chunks_read = Counter[int]()

    def counted(chunk: chunks.Chunk, file: FileBytes) -> tuple[bytes, str]:
        chunks_read[chunk.data] += 1
        return unpacked(chunk, file)

    unpacked = chunks.Chunk.unpack
    monkeypatch.setattr(chunks.Chunk, "unpack", counted)
    index = mcap.read_index(path)
    assert len(index.chunks) > 5 and chunks_read == {index.chunks[0].data: 1}


# --- a sound copy ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mcap, zstd", "sqlite3", "ros1"])
def test_recover_writes_a_sound_copy(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    path, fixed = FORMATS[name](tmp_path), tmp_path / "fixed.mcap"
    assert "is not damaged" in error_of(capsys, "recover", path, "--output", fixed)
    assert not fixed.exists()
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    left, _ = read(path)
    assert 60 < len(left) < 161
    assert main(["recover", str(path), "--output", str(fixed)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert re.search(rf"fixed\.mcap: {len(left)} messages of \d topics read, \d+ known to be lost$", said[-1])
    found, warnings = read(fixed)
    assert Counter(found) == Counter(left)
    assert not warnings
    assert "already there" in error_of(capsys, "recover", path, "--output", fixed)
    path.write_bytes(data[:10])
    other = tmp_path / "other.mcap"
    assert re.search(
        "no messages|nothing of it is left|not a bag", error_of(capsys, "recover", path, "-o", other)
    )
    assert not other.exists()
