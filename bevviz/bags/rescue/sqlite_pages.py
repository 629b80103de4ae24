"""Pages of a sqlite3 file and of its write-ahead log (https://www.sqlite.org/fileformat2.html)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevviz.bags.reader import FileBytes
from bevviz.bags.sqlite import LOG_HEAD, PAGE_SIZES, log_path, page_size_of

LEAF = 0x0D  # first byte of a page with table rows
LOG_MAGIC = (0x377F0682, 0x377F0683)
FRAME_HEAD = struct.Struct(">6I")


class Pages:
    """Pages of a file, numbered from 1. A page in the log replaces that of the file."""

    def __init__(self, path: Path) -> None:
        self._file = FileBytes(path)
        log = log_path(path)
        self._log = FileBytes(log) if log.exists() else None
        self.in_log: dict[int, int] = {}  # offset of the newest version by page number
        self.log_frames = 0  # number of log frames with a wrong checksum
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
        """Usable bytes of a page."""
        return self.size - self.reserved

    @property
    def count(self) -> int:
        """Number of pages of the file and the log."""
        file_pages = -(-self._file.size // self.size)
        return max([file_pages, *self.in_log])

    @property
    def length(self) -> int:
        """Size of all pages in bytes."""
        return self.count * self.size

    def read(self, number: int) -> bytes:
        """Read a page. It is shorter at the cut of a file, and empty if it does not exist."""
        if (offset := self.in_log.get(number)) is not None and self._log is not None:
            return self._log.read(offset, self.size)
        return self._file.read((number - 1) * self.size, self.size) if number > 0 else b""

    def has(self, number: int, size: int) -> bool:
        """Tell whether the first ``size`` bytes of a page exist."""
        return number > 0 and (number in self.in_log or (number - 1) * self.size + size <= self._file.size)

    def next_overflow(self, number: int) -> int:
        """Read the number at the start of an overflow page: the next overflow page."""
        if (offset := self.in_log.get(number)) is not None and self._log is not None:
            return int.from_bytes(self._log.read(offset, 4), "big")
        return int.from_bytes(self._file.read((number - 1) * self.size, 4), "big")

    def leaves(self) -> Iterator[int]:
        """Yield the numbers of the pages with table rows."""
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
        """Close the files."""
        self._file.close()
        if self._log is not None:
            self._log.close()

    def _read_log(self, log: FileBytes) -> None:
        """Find the newest committed version of each page in the log, without frames of a wrong checksum."""
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
                offset += FRAME_HEAD.size + page_size  # a frame of an older round of the log
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


@cache
def _weights(size: int) -> NDArray[np.uint32]:
    """Return a (size / 4 + 2, 2) array: the factors of each 32-bit word in the two sums of a checksum.

    The first two words are the previous checksum, the others those of the frame. The checksum takes two words
    at a time: s0 += x0 + s1; s1 += x1 + s0. So both sums are linear in the words.
    """
    steps = size // 8
    weights = np.zeros((size // 4 + 2, 2), np.uint32)
    # Effect of a change of s0 and of s1 before the last n steps on the result, n = 0, 1, ...
    a, b, c, d = 1, 0, 0, 1  # s0 -> (a, b), s1 -> (c, d)
    for step in range(steps - 1, -1, -1):
        # x0 goes into s0 and through it into s1; x1 goes into s1 alone.
        weights[2 * step + 2] = (a + c) & 0xFFFFFFFF, (b + d) & 0xFFFFFFFF
        weights[2 * step + 3] = c, d
        # One more step before: s0' = s0 + s1, s1' = s1 + s0' = s0 + 2 s1.
        a, b, c, d = (x & 0xFFFFFFFF for x in (a + c, b + d, a + 2 * c, b + 2 * d))
    weights[0], weights[1] = (a, b), (c, d)
    return weights


def checksum_of(data: bytes, order: str, before: tuple[int, int]) -> tuple[int, int]:
    """Return the checksum of a log frame. It continues that of the previous frame."""
    numbers = np.concatenate(
        [np.array(before, np.uint32), np.frombuffer(data, order + "u4").astype(np.uint32)]
    )
    with np.errstate(over="ignore"):
        sums = (numbers[:, None] * _weights(len(data))).sum(axis=0, dtype=np.uint32)
    return int(sums[0]), int(sums[1])
