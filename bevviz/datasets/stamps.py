"""Sensors and times that file names state."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from statistics import median

from bevviz.datasets.dataset import SECOND

MOST_SENSORS = 16  # sensors in one folder
DATE = re.compile(  # 20121214T142255.814212, 2011-09-26_13-02-25-594, 20231114221321205
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_.T ]?(\d\d)[-_.:]?(\d\d)[-_.:]?(\d\d)"
    r"(?:[-_.](\d{1,9})|(\d{3}|\d{6}))?(?=\D*$)"
)
DECIMAL, WHOLE = re.compile(r"\d+(?:\.\d+)?"), re.compile(r"\d+")
DIGITS = {19: 1, 16: 1000, 13: 1_000_000, 10: SECOND}  # number of digits of a stamp: nanoseconds of its unit
UNITS = {1: "nanoseconds", 1000: "microseconds", 1_000_000: "milliseconds", SECOND: "seconds"}
FASTEST = 5_000_000  # nanoseconds between two frames; numbers with smaller steps count frames
FRAMES = 10_000_000_000  # Frame numbers are smaller.
STRIDE = 10_000  # Frame numbers have smaller steps.
ALL = 0.9  # share of distinct stamps among a sensor's files, in case some are duplicates
SECONDS = re.compile(r"(?<![\d.])([1-9]\d{9})[-_]$")  # whole seconds before their decimals
MOST = 1 << 63


@dataclass(frozen=True, slots=True)
class Told:
    """Times in the names of a sensor's files.

    Attributes:
        frames: the values are frame numbers; else they are nanoseconds.
        values: value of each file that has one.
        said: interpretation to report to the user; empty: it is obvious.
    """

    frames: bool
    values: Mapping[Path, int]
    said: str = ""


def told_by(files: Sequence[Path]) -> Told | None:
    """Return the times in the names of one sensor's files; None if the names have none."""
    dates = {file: date[1] for file in files if (date := _dated(file))}
    if 2 * len(dates) > len(files) and not _counts(dates.values()):
        return Told(False, dates, "are taken for dates and times in UTC")
    found = _by_number(files, DECIMAL)
    if found and not found.frames and _counts(found.values.values()):
        found = _by_number(files, WHOLE)
    return found if found and max(found.values.values()) < MOST else None


def sensors_of(files: Sequence[Path]) -> dict[str, list[Path]]:
    """Group files by the words in which their names differ, without the time. One group means one sensor.

    Several groups are several sensors if each has about as many files. In addition, the words must not be
    mere numbers, such as dates or runs, or all groups must have the same times.
    """
    groups = dict[tuple[str, ...], list[Path]]()
    told = {file: date[0] for file in files if (date := _dated(file))}
    if len(told) < len(files):
        told = _telling(files, DECIMAL)
    if len(told) < len(files):
        return {"": list(files)}
    words = {file: _words(match) for file, match in told.items()}
    counted = _counting(words.values())
    for file, row in words.items():
        groups.setdefault(tuple(w for i, w in enumerate(row) if i not in counted), []).append(file)
    counts = [len(found) for found in groups.values()]
    if not 1 < len(groups) <= MOST_SENSORS or max(counts) > 2 * min(counts):
        return {"": list(files)}
    first, last = _alike(list(groups)), _alike([words[::-1] for words in groups])
    names = {words: words[first : max(first, len(words) - last)] for words in groups}
    numbers = {tuple(sorted(told[file][0] for file in found)) for found in groups.values()}
    named = all(any(map(str.isalpha, "".join(words))) for words in names.values() if words)
    if not named and len(numbers) > 1:
        return {"": list(files)}
    return {"_".join(names[words]): found for words, found in groups.items()}


def stamps_in(texts: Sequence[str]) -> list[int]:
    """Convert stamps to nanoseconds. Digits or steps decide the unit of stamps without a point."""
    whole = [text for text in texts if "." not in text]
    numbers = list(map(int, whole))
    unit = (whole and _unit(whole, numbers)) or SECOND
    stamps = iter(_decimals([text for text in texts if "." in text]))
    return [next(stamps) if "." in text else unit * int(text) for text in texts]


def _words(told: re.Match[str]) -> list[str]:
    """Return the words of a name without its time."""
    before = SECONDS.sub("", told.string[: told.start()])
    return re.findall(r"[A-Za-z0-9]+", f"{before} {told.string[told.end() :]}")


def _counting(rows: Iterable[Sequence[str]]) -> set[int]:
    """Return the columns of words that are counters: numbers with more values than sensors are possible."""
    columns = zip(*rows, strict=False)
    return {
        i
        for i, column in enumerate(columns)
        if len(set(column)) > MOST_SENSORS and all(map(str.isdigit, column))
    }


def _alike(rows: Sequence[Sequence[str]]) -> int:
    """Count the leading words that all rows share."""
    return next(
        (i for i, row in enumerate(zip(*rows, strict=False)) if len(set(row)) > 1), min(map(len, rows))
    )


def _dated(file: Path) -> tuple[re.Match[str], int] | None:
    """Return the date and time at the end of a name and its nanoseconds in UTC; None if there is none."""
    if not (found := DATE.search(file.stem)):
        return None
    *whole, apart, joined = found.groups()
    try:
        at = datetime(*map(int, whole), tzinfo=UTC)  # type: ignore[misc, arg-type]
    except ValueError:
        return None
    return found, int(at.timestamp()) * SECOND + _nanoseconds(apart or joined or "")


def _telling(files: Sequence[Path], pattern: re.Pattern[str]) -> dict[Path, re.Match[str]]:
    """Return the number in each name that is its frame or stamp. A file without a number is left out.

    The number with the most distinct values counts: v2, cam0 and hdl64 vary less. Among equals a stamp comes
    before others, then the last number. A few files may all be of one frame, so leading zeros
    count as well.
    """
    rows = {file: list(pattern.finditer(file.stem)) for file in files}
    usual = Counter(len(row) for row in rows.values() if row).most_common(1)
    if not usual:
        return {}
    columns = list(zip(*(row for row in rows.values() if len(row) == usual[0][0]), strict=True))
    texts = [[match[0] for match in column] for column in columns]
    values = [len(set(column)) for column in texts]
    few = len(texts[0]) <= MOST_SENSORS

    def score(i: int) -> tuple[bool, float, bool, int]:
        differs = values[i] / max(values)
        stamps = _are_stamps(texts[i]) and (values[i] > 1 or differs == 1)
        padded = few and (stamps or any(len(text) > 1 and text[0] == "0" for text in texts[i]))
        return padded and values[i] > 1, 1.0 if padded or differs > ALL else differs, stamps, i

    chosen = max(range(len(columns)), key=score)
    return {file: row[chosen] if chosen < len(row) else row[-1] for file, row in rows.items() if row}


def _by_number(files: Sequence[Path], pattern: re.Pattern[str]) -> Told | None:
    told = _telling(files, pattern)
    if 2 * len(told) <= len(files):
        return None
    texts = [match[0] for match in told.values()]
    if parts := _seconds_before(told):
        values = _fractions(*parts)
        if not _counts(values):
            return Told(False, dict(zip(told, values, strict=True)), "are taken for seconds and their parts")
    if any("." in text for text in texts):
        return Told(False, dict(zip(told, stamps_in(texts), strict=True)))
    numbers = [int(text) for text in texts]
    if unit := _unit(texts, numbers):
        plain = _are_stamps(texts)
        said = "" if plain else f"are taken for stamps in {UNITS[unit]}, as the steps between them tell"
        return Told(False, {file: unit * n for file, n in zip(told, numbers, strict=True)}, said)
    return Told(True, dict(zip(told, numbers, strict=True)))


def _seconds_before(told: Mapping[Path, re.Match[str]]) -> tuple[list[int], list[str]] | None:
    """Return seconds and decimals if each number follows one of seconds: 1700000001_205187200."""
    rows = list[tuple[int, str]]()
    for file, match in told.items():
        before = SECONDS.search(file.stem[: match.start()])
        if not before or len(match[0]) > 9 or "." in match[0]:
            return None
        rows.append((int(before[1]), match[0]))
    return [second for second, _ in rows], [part for _, part in rows]


def _fractions(seconds: Sequence[int], parts: Sequence[str]) -> list[int]:
    """Add whole seconds and milli-, micro- or nanoseconds. The longest part decides the unit."""
    unit = 10 ** (9 - 3 * -(-max(map(len, parts)) // 3))
    return [second * SECOND + int(part) * unit for second, part in zip(seconds, parts, strict=True)]


def _decimals(texts: Sequence[str]) -> list[int]:
    """Convert seconds with a point to nanoseconds. The part after the point may lack its leading zeros.

    If lengths differ, the interpretation with the more even steps counts.
    """
    split = [text.partition(".") for text in texts]
    seconds, parts = [int(whole) for whole, _, _ in split], [part for _, _, part in split]
    stamps = [s * SECOND + _nanoseconds(part) for s, part in zip(seconds, parts, strict=True)]
    lengths = set(map(len, parts))
    if max(lengths, default=0) != 9 or len(lengths) == 1 or not all(part.isdigit() for part in parts):
        return stamps
    return min(stamps, _fractions(seconds, parts), key=_unevenness)


def _nanoseconds(decimals: str) -> int:
    return int(decimals[:9].ljust(9, "0"))


def _unit(texts: Sequence[str], numbers: Sequence[int]) -> int | None:
    """Return the unit of integer stamps in nanoseconds; None if they count frames or seconds."""
    if _are_stamps(texts):
        return DIGITS[len(texts[0])]
    padded = any(len(text) > 1 and text.startswith("0") for text in texts)
    steps = _steps(numbers)
    step = median(steps) if steps else 0
    if max(numbers) < FRAMES and (padded or len(steps) < 2 or step < STRIDE):
        return None
    if not step:
        return DIGITS[min((digits for digits in DIGITS if digits >= len(str(max(numbers)))), default=19)]
    return next((unit for unit in (1, 1000) if step * unit >= FASTEST), 1_000_000)


def _are_stamps(texts: Sequence[str]) -> bool:
    """Tell whether numbers look like stamps. Frame numbers of that length have leading zeros."""
    if any("." in text for text in texts):
        return True
    return len(set(map(len, texts))) == 1 and len(texts[0]) in DIGITS and texts[0][0] != "0"


def _steps(values: Iterable[int]) -> list[int]:
    return [b - a for a, b in pairwise(sorted(set(values)))]


def _counts(stamps: Iterable[int]) -> bool:
    """Tell whether supposed nanoseconds count frames, because no sensor is that fast."""
    steps = _steps(stamps)
    return bool(steps) and median(steps) < FASTEST


def _unevenness(stamps: Sequence[int]) -> float:
    steps = _steps(stamps)
    middle = median(steps) if steps else 0
    return sum(abs(step - middle) for step in steps)
