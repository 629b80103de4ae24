"""The pages of a sqlite3 file and of the log beside it (https://www.sqlite.org/fileformat2.html)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevviz.bags.reader import Bytes

MAGIC = b"SQLite format 3\0"
LEAF = 0x0D  # first byte of a page with table rows
PAGE_SIZES = [1 << bits for bits in range(9, 17)]
LOG_MAGIC = (0x377F0682, 0x377F0683)
LOG_HEAD, FRAME_HEAD = struct.Struct(">8I"), struct.Struct(">6I")


class Pages:
    """The pages of a file, those of the log beside it before its own. Numbers count from 1."""

    def __init__(self, path: Path) -> None:
        self._file = Bytes(path)
        log = log_of(path)
        self._log = Bytes(log) if log.exists() else None
        self.in_log: dict[int, int] = {}  # page -> offset of its newest version
        self.log_frames = 0  # that are not sound
        head = self._file.read(0, 100)
        self.size = page_size_of(head) or 0
        if self._log is not None:
            self._read_log(self._log)
            if 1 in self.in_log:
                head = self.read(1)[:100]
        self.reserved = head[20] if len(head) > 20 and self.size else 0
        self.missing = max(0, int.from_bytes(head[28:32], "big") * self.size - self._file.size)

    @property
    def usable(self) -> int:
        return self.size - self.reserved

    @property
    def count(self) -> int:
        own = -(-self._file.size // self.size)
        return max([own, *self.in_log])

    @property
    def length(self) -> int:
        """Bytes."""
        return self.count * self.size

    def read(self, number: int) -> bytes:
        """A page; shorter where the file is cut, empty where there is none."""
        if (offset := self.in_log.get(number)) is not None and self._log is not None:
            return self._log.read(offset, self.size)
        return self._file.read((number - 1) * self.size, self.size) if number > 0 else b""

    def has(self, number: int, size: int) -> bool:
        """Whether the first ``size`` bytes of a page are there."""
        return number > 0 and (number in self.in_log or (number - 1) * self.size + size <= self._file.size)

    def first(self, number: int) -> int:
        """The number that a page begins with: of the next overflow page."""
        if (offset := self.in_log.get(number)) is not None and self._log is not None:
            return int.from_bytes(self._log.read(offset, 4), "big")
        return int.from_bytes(self._file.read((number - 1) * self.size, 4), "big")

    def leaves(self) -> Iterator[int]:
        """Numbers of the pages with table rows."""
        step = max(1, (1 << 22) // self.size)
        for first in range(1, self.count + 1, step):
            block = self._file.read((first - 1) * self.size, step * self.size)
            kinds = bytearray(block[:: self.size].ljust(min(step, self.count + 1 - first), b"\0"))
            if first == 1 and len(block) > 100:
                kinds[0] = block[100]
            for number in range(first, first + len(kinds)):
                if number in self.in_log:
                    page = self.read(number)
                    kinds[number - first] = page[100 if number == 1 else 0]
            yield from (first + int(i) for i in np.flatnonzero(np.frombuffer(kinds, np.uint8) == LEAF))

    def close(self) -> None:
        self._file.close()
        if self._log is not None:
            self._log.close()

    def _read_log(self, log: Bytes) -> None:
        """Find the newest version of each page among what was committed, by frames whose checksums fit."""
        head = log.read(0, LOG_HEAD.size)
        if len(head) < LOG_HEAD.size:
            return
        magic, _, page_size, _, salt, salt2, *checksum = LOG_HEAD.unpack(head)
        if magic not in LOG_MAGIC or page_size not in PAGE_SIZES:
            return
        self.size = self.size or page_size
        if page_size != self.size:
            return
        order = ">" if magic & 1 else "<"
        before, pages = (checksum[0], checksum[1]), dict[int, int]()
        offset = LOG_HEAD.size
        while offset + FRAME_HEAD.size + page_size <= log.size:
            frame = log.read(offset, FRAME_HEAD.size)
            number, committed, *salts = FRAME_HEAD.unpack(frame)[:4]
            after = struct.unpack(">2I", frame[16:])
            if salts != [salt, salt2]:
                offset += FRAME_HEAD.size + page_size  # of an older round of the log
                continue
            data = frame[:8] + log.read(offset + FRAME_HEAD.size, page_size)
            if checksum_of(data, order, before) == after and number:
                pages[number] = offset + FRAME_HEAD.size
            else:
                self.log_frames += 1
                pages.pop(number, None)
            before = after
            offset += FRAME_HEAD.size + page_size
            if committed:
                self.in_log.update(pages)
                pages.clear()


def page_size_of(head: bytes) -> int | None:
    """None: it is not the head of a file."""
    size = int.from_bytes(head[16:18], "big")
    size = 65536 if size == 1 else size
    return size if head[: len(MAGIC)] == MAGIC and size in PAGE_SIZES else None


def log_of(path: Path) -> Path:
    return path.with_name(path.name + "-wal")


@cache
def _weights(size: int) -> NDArray[np.uint32]:
    """(size / 4 + 2, 2) what each number of a frame, and the two of the checksum before, add to its checksum.

    The checksum takes two numbers at a time: s0 += x0 + s1; s1 += x1 + s0. So it is a sum of multiples.
    """
    steps = size // 8
    weights = np.zeros((size // 4 + 2, 2), np.uint32)
    # What a change of s0 and of s1 before the last n steps does in the end, n = 0, 1, ...
    a, b, c, d = 1, 0, 0, 1  # s0 -> (a, b), s1 -> (c, d)
    for step in range(steps - 1, -1, -1):
        # x0 goes into s0, and through it into s1; x1 goes into s1 alone.
        weights[2 * step + 2] = (a + c) & 0xFFFFFFFF, (b + d) & 0xFFFFFFFF
        weights[2 * step + 3] = c, d
        # One more step before: s0' = s0 + s1, s1' = s1 + s0' = s0 + 2 s1.
        a, b, c, d = (x & 0xFFFFFFFF for x in (a + c, b + d, a + 2 * c, b + 2 * d))
    weights[0], weights[1] = (a, b), (c, d)
    return weights


def checksum_of(data: bytes, order: str, before: tuple[int, int]) -> tuple[int, int]:
    """The checksum of a frame of the log, which goes on from that of the frame before."""
    numbers = np.concatenate(
        [np.array(before, np.uint32), np.frombuffer(data, order + "u4").astype(np.uint32)]
    )
    with np.errstate(over="ignore"):
        sums = (numbers[:, None] * _weights(len(data))).sum(axis=0, dtype=np.uint32)
    return int(sums[0]), int(sums[1])
