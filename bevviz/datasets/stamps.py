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

MAX_SENSORS = 16  # sensors in one folder
DATE = re.compile(  # 20121214T142255.814212, 2011-09-26_13-02-25-594, 20231114221321205
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_.T ]?(\d\d)[-_.:]?(\d\d)[-_.:]?(\d\d)"
    r"(?:[-_.](\d{1,9})|(\d{3}|\d{6}))?(?=\D*$)"
)
PADDED = re.compile(r"[A-Za-z]*0\d{3,}")
DECIMAL, WHOLE = re.compile(r"\d+(?:\.\d+)?"), re.compile(r"\d+")
DIGITS = {19: 1, 16: 1000, 13: 1_000_000, 10: SECOND}  # number of digits of a stamp: nanoseconds of its unit
UNITS = {1: "nanoseconds", 1000: "microseconds", 1_000_000: "milliseconds", SECOND: "seconds"}
MIN_STEP = 5_000_000  # nanoseconds between two frames; numbers with smaller steps count frames
MAX_FRAME = 10_000_000_000  # Frame numbers are smaller.
MAX_FRAME_STEP = 10_000  # Frame numbers have smaller steps.
DISTINCT_SHARE = 0.9  # share of distinct stamps among a sensor's files, in case some are duplicates
LEADING_SECONDS = re.compile(r"(?<![\d.])([1-9]\d{9})[-_]$")  # whole seconds before their decimals
MAX_STAMP = 1 << 63


@dataclass(frozen=True, slots=True)
class FileTimes:
    """Times in the names of a sensor's files.

    Attributes:
        frames: the values are frame numbers; else they are nanoseconds.
        values: value of each file that has one.
        note: interpretation to report to the user; empty: it is obvious.
    """

    frames: bool
    values: Mapping[Path, int]
    note: str = ""


def file_times(files: Sequence[Path]) -> FileTimes | None:
    """Return the times in the names of one sensor's files; None if the names have none."""
    dates = {file: date[1] for file in files if (date := _find_date(file))}
    if 2 * len(dates) > len(files) and not _have_frame_steps(dates.values()):
        return FileTimes(False, dates, "are taken for dates and times in UTC")
    times = _number_times(files, DECIMAL)
    if times and not times.frames and _have_frame_steps(times.values.values()):
        times = _number_times(files, WHOLE)
    return times if times and max(times.values.values()) < MAX_STAMP else None


def group_by_sensor(files: Sequence[Path]) -> dict[str, list[Path]]:
    """Group files by the words in which their names differ, without the time. One group means one sensor.

    Several groups are several sensors if each has about as many files. In addition, the words must not be
    mere numbers, such as dates or runs, or all groups must have the same times.
    """
    groups = dict[tuple[str, ...], list[Path]]()
    matches = {file: date[0] for file in files if (date := _find_date(file))}
    if len(matches) < len(files):
        matches = _find_numbers(files, DECIMAL)
    if len(matches) < len(files):
        return {"": list(files)}
    words = {file: _words(match) for file, match in matches.items()}
    counted = _counter_columns(words.values())
    for file, row in words.items():
        groups.setdefault(tuple(w for i, w in enumerate(row) if i not in counted), []).append(file)
    counts = [len(members) for members in groups.values()]
    if not 1 < len(groups) <= MAX_SENSORS or max(counts) > 2 * min(counts):
        return {"": list(files)}
    first, last = _shared_words(list(groups)), _shared_words([words[::-1] for words in groups])
    names = {words: words[first : max(first, len(words) - last)] for words in groups}
    numbers = {tuple(sorted(matches[file][0] for file in members)) for members in groups.values()}
    named = all(any(map(str.isalpha, "".join(words))) for words in names.values() if words)
    if not named and len(numbers) > 1:
        return {"": list(files)}
    return {"_".join(names[words]): members for words, members in groups.items()}


def stamps_in(texts: Sequence[str]) -> list[int]:
    """Convert stamps to nanoseconds. Digits or steps decide the unit of stamps without a point."""
    whole = [text for text in texts if "." not in text]
    numbers = list(map(int, whole))
    unit = (whole and _unit(whole, numbers)) or SECOND
    stamps = iter(_parse_decimals([text for text in texts if "." in text]))
    return [next(stamps) if "." in text else unit * int(text) for text in texts]


def _words(match: re.Match[str]) -> list[str]:
    """Return the words of a name without its time."""
    before = LEADING_SECONDS.sub("", match.string[: match.start()])
    return re.findall(r"[A-Za-z0-9]+", f"{before} {match.string[match.end() :]}")


def _counter_columns(rows: Iterable[Sequence[str]]) -> set[int]:
    """Return the columns of words that are counters, such as ``frame000104``.

    They are numbers with more values than sensors are possible, or padded ones that all differ.
    """
    columns = [(i, column, len(set(column))) for i, column in enumerate(zip(*rows, strict=False))]
    return {
        i
        for i, column, values in columns
        if (values > MAX_SENSORS and all(map(str.isdigit, column)))
        or (values == len(column) and all(map(PADDED.fullmatch, column)))
    }


def _shared_words(rows: Sequence[Sequence[str]]) -> int:
    """Count the leading words that all rows share."""
    return next(
        (i for i, row in enumerate(zip(*rows, strict=False)) if len(set(row)) > 1), min(map(len, rows))
    )


def _find_date(file: Path) -> tuple[re.Match[str], int] | None:
    """Return the date and time at the end of a name and its nanoseconds in UTC; None if there is none."""
    if not (match := DATE.search(file.stem)):
        return None
    *whole, separate, joined = match.groups()
    try:
        at = datetime(*map(int, whole), tzinfo=UTC)  # type: ignore[misc, arg-type]
    except ValueError:
        return None
    return match, int(at.timestamp()) * SECOND + _nanoseconds(separate or joined or "")


def _find_numbers(files: Sequence[Path], pattern: re.Pattern[str]) -> dict[Path, re.Match[str]]:
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
    few = len(texts[0]) <= MAX_SENSORS

    def score(i: int) -> tuple[bool, float, bool, int]:
        differs = values[i] / max(values)
        stamps = _are_stamps(texts[i]) and (values[i] > 1 or differs == 1)
        padded = few and (stamps or any(len(text) > 1 and text[0] == "0" for text in texts[i]))
        return padded and values[i] > 1, 1.0 if padded or differs > DISTINCT_SHARE else differs, stamps, i

    chosen = max(range(len(columns)), key=score)
    return {file: row[chosen] if chosen < len(row) else row[-1] for file, row in rows.items() if row}


def _number_times(files: Sequence[Path], pattern: re.Pattern[str]) -> FileTimes | None:
    matches = _find_numbers(files, pattern)
    if 2 * len(matches) <= len(files):
        return None
    texts = [match[0] for match in matches.values()]
    if parts := _seconds_before(matches):
        values = _join_fractions(*parts)
        if not _have_frame_steps(values):
            return FileTimes(
                False, dict(zip(matches, values, strict=True)), "are taken for seconds and their parts"
            )
    if any("." in text for text in texts):
        return FileTimes(False, dict(zip(matches, stamps_in(texts), strict=True)))
    numbers = [int(text) for text in texts]
    if unit := _unit(texts, numbers):
        plain = _are_stamps(texts)
        note = "" if plain else f"are taken for stamps in {UNITS[unit]}, as the steps between them tell"
        return FileTimes(False, {file: unit * n for file, n in zip(matches, numbers, strict=True)}, note)
    return FileTimes(True, dict(zip(matches, numbers, strict=True)))


def _seconds_before(matches: Mapping[Path, re.Match[str]]) -> tuple[list[int], list[str]] | None:
    """Return seconds and decimals if each number follows one of seconds: 1700000001_205187200."""
    rows = list[tuple[int, str]]()
    for file, match in matches.items():
        before = LEADING_SECONDS.search(file.stem[: match.start()])
        if not before or len(match[0]) > 9 or "." in match[0]:
            return None
        rows.append((int(before[1]), match[0]))
    return [second for second, _ in rows], [part for _, part in rows]


def _join_fractions(seconds: Sequence[int], parts: Sequence[str]) -> list[int]:
    """Add whole seconds and milli-, micro- or nanoseconds. The longest part decides the unit."""
    unit = 10 ** (9 - 3 * -(-max(map(len, parts)) // 3))
    return [second * SECOND + int(part) * unit for second, part in zip(seconds, parts, strict=True)]


def _parse_decimals(texts: Sequence[str]) -> list[int]:
    """Convert seconds with a point to nanoseconds. The part after the point may lack its leading zeros.

    If lengths differ, the interpretation with the more even steps counts.
    """
    split = [text.partition(".") for text in texts]
    seconds, parts = [int(whole) for whole, _, _ in split], [part for _, _, part in split]
    stamps = [s * SECOND + _nanoseconds(part) for s, part in zip(seconds, parts, strict=True)]
    lengths = set(map(len, parts))
    if max(lengths, default=0) != 9 or len(lengths) == 1 or not all(part.isdigit() for part in parts):
        return stamps
    return min(stamps, _join_fractions(seconds, parts), key=_unevenness)


def _nanoseconds(decimals: str) -> int:
    return int(decimals[:9].ljust(9, "0"))


def _unit(texts: Sequence[str], numbers: Sequence[int]) -> int | None:
    """Return the unit of integer stamps in nanoseconds; None if they count frames or seconds."""
    if _are_stamps(texts):
        return DIGITS[len(texts[0])]
    padded = any(len(text) > 1 and text.startswith("0") for text in texts)
    steps = _steps(numbers)
    step = median(steps) if steps else 0
    if max(numbers) < MAX_FRAME and (padded or len(steps) < 2 or step < MAX_FRAME_STEP):
        return None
    if not step:
        return DIGITS[min((digits for digits in DIGITS if digits >= len(str(max(numbers)))), default=19)]
    return next((unit for unit in (1, 1000) if step * unit >= MIN_STEP), 1_000_000)


def _are_stamps(texts: Sequence[str]) -> bool:
    """Tell whether numbers look like stamps. Frame numbers of that length have leading zeros."""
    if any("." in text for text in texts):
        return True
    return len(set(map(len, texts))) == 1 and len(texts[0]) in DIGITS and texts[0][0] != "0"


def _steps(values: Iterable[int]) -> list[int]:
    return [b - a for a, b in pairwise(sorted(set(values)))]


def _have_frame_steps(stamps: Iterable[int]) -> bool:
    """Tell whether supposed nanoseconds count frames, because no sensor is that fast."""
    steps = _steps(stamps)
    return bool(steps) and median(steps) < MIN_STEP


def _unevenness(stamps: Sequence[int]) -> float:
    steps = _steps(stamps)
    middle = median(steps) if steps else 0
    return sum(abs(step - middle) for step in steps)
