"""Damaged bags: what bevviz gets out of them, beside the best of the readers that are not its own."""

from __future__ import annotations

import random
import re
import shutil
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tqdm import tqdm

from benchmarks.torture.worker import Outcome, Worker
from tests.support.bag_formats import FORMATS, items
from tests.support.foreign_readers import Found, judges, taken

Damage = Callable[[bytearray, random.Random], object]


def cut(data: bytearray, rng: random.Random) -> None:
    """Cut off the end, as a full disk or a pulled plug does."""
    del data[rng.randrange(len(data)) :]


def cut_late(data: bytearray, rng: random.Random) -> None:
    """Cut off the end somewhere in the index."""
    del data[len(data) - rng.randrange(1, max(2, len(data) // 20)) :]


def hole(data: bytearray, rng: random.Random) -> None:
    """Bytes are missing in the middle."""
    at = rng.randrange(len(data))
    del data[at : at + rng.randrange(1, 5000)]


def zeros(data: bytearray, rng: random.Random) -> None:
    """Fill a sector with zeros, as if it was never written."""
    at = rng.randrange(len(data)) // 512 * 512
    size = min(rng.choice([512, 4096]), len(data) - at)
    data[at : at + size] = bytes(size)


def flips(data: bytearray, rng: random.Random) -> None:
    """Single bits are wrong."""
    for _ in range(rng.randrange(1, 9)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def noise(data: bytearray, rng: random.Random) -> None:
    """Overwrite a stretch with random bytes."""
    at = rng.randrange(len(data))
    size = min(rng.randrange(1, 200), len(data) - at)
    data[at : at + size] = rng.randbytes(size)


def inserted(data: bytearray, rng: random.Random) -> None:
    """There is more than there should be."""
    at = rng.randrange(len(data))
    data[at:at] = rng.randbytes(rng.randrange(1, 200))


def opcode(data: bytearray, rng: random.Random) -> None:
    """Change the kind of a record."""
    data[rng.choice(_heads(data))] = rng.randrange(256)


def length(data: bytearray, rng: random.Random) -> None:
    """Change the length of a record: a little, or to more than all memory."""
    at = rng.choice(_heads(data)) + 1
    if data[:6] == b"\x89MCAP0":
        size = struct.unpack_from("<Q", data, at)[0] if at + 8 <= len(data) else 0
        wrong = rng.choice(
            [0, 1, size + rng.randrange(1, 300), max(0, size - 7), 1 << 40, (1 << 63) + 5, 2**64 - 1]
        )
        data[at : at + 8] = struct.pack("<Q", wrong & (2**64 - 1))
    else:
        data[at : at + 4] = struct.pack("<I", rng.choice([0, 1, rng.randrange(1 << 16), 1 << 31, 2**32 - 1]))


def numbers(data: bytearray, rng: random.Random) -> None:
    """Set one of the first numbers of a record (a time, a size, an offset) to an extreme value."""
    at = rng.choice(_heads(data)) + rng.randrange(1, 60)
    data[at : at + 8] = struct.pack("<Q", rng.choice([2**63, 2**64 - 1, 2**62, 2**31, 2**32 - 1, 0]))


def _heads(data: bytearray) -> Sequence[int]:
    """Offsets that a record begins at, as far as it can be told, or a page or a row of sqlite3."""
    if data[:6] == b"\x89MCAP0":
        found, at = [], 8
        while at + 9 < len(data):
            opcode_, size = struct.unpack_from("<BQ", data, at)
            found.append(at)
            if opcode_ == 6:  # what lies in an uncompressed chunk counts, too
                (name,) = struct.unpack_from("<I", data, at + 9 + 28)
                inner = at + 9 + 40 + name
                while not name and inner + 9 < at + 9 + size:
                    found.append(inner)
                    inner += 9 + struct.unpack_from("<Q", data, inner + 1)[0]
            at += 9 + size
        return found
    if data[:7] == b"#ROSBAG":
        return [match.start() + 3 for match in re.finditer(b"op=", data)]
    if data[:6] == b"SQLite":
        pages = [at for at in range(0, len(data), 4096) if data[at] in (2, 5, 10, 13)] or [0]
        cells = [
            page + int.from_bytes(data[page + 8 + 2 * i : page + 10 + 2 * i], "big")
            for page in pages
            for i in range(min(int.from_bytes(data[page + 3 : page + 5], "big"), 50))
        ]
        columns = [at + i for at in cells for i in range(9)]
        return [at for at in (*pages, *columns) if at < len(data)]
    return range(len(data))


DAMAGES: Mapping[str, Damage] = {
    "cut": cut,
    "cut late": cut_late,
    "hole": hole,
    "zeros": zeros,
    "flips": flips,
    "noise": noise,
    "inserted": inserted,
    "opcode": opcode,
    "length": length,
    "numbers": numbers,
}


@dataclass
class Tally:
    """Result of the bags of one format, or of all."""

    bags: int = 0
    messages: int = 0  # that were in them when they were sound
    best: int = 0  # right ones of the best other reader, bag by bag
    ours: int = 0  # right ones
    wrong: int = 0  # payloads that were never written, of ours
    their_wrong: int = 0  # the same of the best other reader
    tracebacks: int = 0
    hangs: int = 0
    silent: int = 0  # bags of which messages are missing without a number in a warning
    uneven: int = 0  # bags whose counts or times are not those of the messages
    memory: float = 0.0  # MB at most, in one bag
    by_judge: Counter[str] = field(default_factory=Counter)  # right ones of each other reader
    examples: list[str] = field(default_factory=list)  # of what went wrong

    def __iadd__(self, other: Tally) -> Tally:
        for name in ("bags", "messages", "best", "ours", "wrong", "their_wrong"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("tracebacks", "hangs", "silent", "uneven"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.memory = max(self.memory, other.memory)
        self.by_judge += other.by_judge
        self.examples += other.examples
        return self

    @property
    def share(self) -> float:
        return self.ours / self.best if self.best else 1.0


def damaged(name: str, sound: Path, number: int, seed: int, folder: Path) -> tuple[str, Path]:
    """Write the damaged bag of this number. Return what was done to it and its path."""
    rng = random.Random(f"{seed} {name} {number}")
    what = list(DAMAGES)[number % len(DAMAGES)]
    path = folder / sound.name
    log = sound.with_name(f"{sound.name}-wal")
    victims = [sound, log] if log.exists() else [sound]
    victim = rng.choice(victims)
    for file in victims:
        data = bytearray(file.read_bytes())
        if file is victim:
            DAMAGES[what](data, rng)
        path.with_name(file.name).write_bytes(data)
    return what, path


def judged(path: Path, name: str, whole: Counter[Found], outcome: Outcome) -> Tally:
    """One bag: what was found in it, held against what others find and against what was written."""
    tally = Tally(bags=1, messages=whole.total(), memory=outcome.memory)
    found = Counter(outcome.found)
    right = (found & whole).total()
    tally.ours, tally.wrong = right, found.total() - right
    for judge, read in judges(name).items():
        theirs = Counter(taken(read, path))
        tally.by_judge[judge] = (theirs & whole).total()
        if tally.by_judge[judge] > tally.best:
            tally.best = tally.by_judge[judge]
            tally.their_wrong = theirs.total() - tally.best
    tally.hangs, tally.tracebacks = int(outcome.hung), int(bool(outcome.traceback))
    missing = found.total() < whole.total()
    tally.silent = int(missing and not any(re.search(r"\d", text) for text in outcome.said))
    tally.uneven = int(outcome.uneven)
    return tally


def run(seed: int, bags: int, names: Sequence[str] = tuple(FORMATS)) -> Iterator[tuple[str, Tally]]:
    """Damage ``bags`` bags, by turns of each format; yields a tally for each format."""
    with tempfile.TemporaryDirectory(prefix="bevviz-torture-") as folder, Worker() as worker:
        each = -(-bags // len(names))
        bar = tqdm(total=each * len(names), unit="bag", desc="damage", disable=None)
        with bar:
            for position, name in enumerate(names):
                base = Path(folder) / str(position)
                base.mkdir()
                sound = FORMATS[name](base)
                whole = Counter((t, time, data) for t, _, time, data in items(name.startswith("ros1")))
                total = Tally()
                for number in range(each):
                    trial = base / "trial"
                    trial.mkdir()
                    what, path = damaged(name, sound, number, seed, trial)
                    tally = judged(path, name, whole, outcome := worker.read(path))
                    if tally.tracebacks or tally.hangs or tally.silent or tally.uneven or tally.share < 0.99:
                        tally.examples.append(f"{name}, {number}, {what}: {_told(tally, outcome)}")
                    total += tally
                    shutil.rmtree(trial)
                    bar.update()
                yield name, total


def _told(tally: Tally, outcome: Outcome) -> str:
    what = f"{tally.ours} of {tally.best}"
    what += ", a hang" * tally.hangs + ", unsaid" * tally.silent + ", uneven" * tally.uneven
    error = outcome.traceback.strip().splitlines()[-1:]
    return "; ".join([what, *error, *outcome.said])


HEAD = (
    "| format | bags | messages | best other | bevviz | share | wrong | tracebacks | hangs | unsaid | uneven "
    "| memory, MB |\n| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
)


def row(name: str, tally: Tally) -> str:
    wrong = f"{tally.wrong} ({tally.their_wrong})"
    return (
        f"| {name} | {tally.bags} | {tally.messages} | {tally.best} | {tally.ours} | {tally.share:.2%} "
        f"| {wrong} | {tally.tracebacks} | {tally.hangs} | {tally.silent} | {tally.uneven} "
        f"| {tally.memory:.0f} |"
    )
