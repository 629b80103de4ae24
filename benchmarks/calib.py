"""Measure ``bevviz calib`` on planted errors: how near it gets, how often it is wrong.

On the synthetic drive, and on real frames of KITTI where they are beside the checkout (../shared/data).

python -m benchmarks.calib --write benchmarks/RESULTS.md
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bevviz.extras.calib.result import AXES, SCALES, TIME, Axis, AxisFinding, Calibration
from bevviz.model.frame import F64
from tests.support.miscalibrated_drives import EVERY, Drive, Kitti

BEGIN, END = "<!-- benchmarks.calib: begin -->", "<!-- benchmarks.calib: end -->"
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
SIZES = {"deg": (0.5, 1.0, 2.0), "cm": (5.0, 10.0, 20.0), "ms": (20.0, 40.0, 80.0)}
CHOSEN = range(6)  # frames of KITTI on which the thresholds of bevviz.extras.calib were chosen


@dataclass(frozen=True, slots=True)
class Case:
    """What was planted and what was found."""

    asked: int  # axes, from the first: time is not asked of frames whose motion nothing tells
    planted: F64  # (7,) in units of the axes
    result: Calibration
    seconds: float  # of processor time

    def error(self, row: int) -> float:
        return self.result.axes[row].offset - float(self.planted[row])

    def held(self, row: int) -> bool:
        return abs(self.error(row)) <= self.result.axes[row].interval

    def wrong(self, row: int) -> bool:
        """Whether a finding relies on an interval that does not hold the truth."""
        relied = self.result.axes[row].finding in (AxisFinding.OFF, AxisFinding.FINE)
        return relied and not self.held(row)


# --- what is planted ---------------------------------------------------------------------------


def alone(axes: Sequence[Axis]) -> Iterator[F64]:
    """Nothing, then every size of every axis, both signs; in units of the axes."""
    yield np.zeros(len(AXES))
    for axis in axes:
        for size in SIZES[axis.unit]:
            for sign in (1, -1):
                planted = np.zeros(len(AXES))
                planted[AXES.index(axis)] = sign * size
                yield planted


def together(axes: Sequence[Axis], count: int, rng: np.random.Generator) -> Iterator[F64]:
    """All axes at once, each with one of the sizes, either sign, or none."""
    for _ in range(count):
        planted = np.zeros(len(AXES))
        for axis in axes:
            sizes = SIZES[axis.unit]
            planted[AXES.index(axis)] = rng.choice([0.0, *sizes, *(-size for size in sizes)])
        yield planted


def judge(
    name: str, asked: int, errors: Iterable[F64], calibrated: Callable[[F64], Calibration]
) -> list[Case]:
    cases = []
    for planted in tqdm(list(errors), unit="case", desc=name, disable=None):
        start = time.process_time()
        result = calibrated(planted / SCALES)
        cases.append(Case(asked, planted, result, time.process_time() - start))
        for row, axis in enumerate(AXES):
            if cases[-1].wrong(row):
                found = result.axes[row].measured
                tqdm.write(f"{name}: {axis.name} {found}, but {planted[row]:+g}; planted {planted}")
    return cases


# --- tables ------------------------------------------------------------------------------------


def summary(groups: dict[str, list[Case]]) -> Iterator[str]:
    yield "| frames | cases | wrong in | large errors called off | cannot tell | s |"
    yield "| --- | ---: | ---: | ---: | ---: | ---: |"
    for name, cases in groups.items():
        axes = [(case, row) for case in cases for row in range(case.asked)]
        wrong = sum(any(case.wrong(row) for row in range(len(AXES))) for case in cases)
        large = [(c, row) for c, row in axes if abs(c.planted[row]) >= SIZES[AXES[row].unit][1]]
        off = sum(_finding(c, row) is AxisFinding.OFF for c, row in large)
        said = Counter(_finding(c, row) for c, row in axes)
        seconds = np.median([case.seconds for case in cases])
        yield (
            f"| {name} | {len(cases)} | {wrong} | {off} of {len(large)} "
            f"| {said[AxisFinding.UNKNOWN]} of {len(axes)} | {seconds:.0f} |"
        )


def by_size(cases: list[Case]) -> Iterator[str]:
    """One axis at a time: both signs of a size are one row."""
    yield "| planted | largest error | interval | held | said |"
    yield "| --- | ---: | ---: | ---: | --- |"
    for row, axis in enumerate(AXES):
        sizes = sorted({abs(float(case.planted[row])) for case in cases} - {0.0})
        for size in sizes:
            same = [case for case in cases if abs(case.planted[row]) == size]
            yield f"| {axis.name} +-{size:g} {axis.unit} | {_columns(same, row)} |"
        if sizes:
            nothing = [case for case in cases if case.planted[row] == 0]
            yield f"| {axis.name}, others planted | {_columns(nothing, row)} |"


def by_axis(cases: list[Case]) -> Iterator[str]:
    yield "| axis | largest error | interval | held | said |"
    yield "| --- | ---: | ---: | ---: | --- |"
    for row, axis in enumerate(AXES):
        if row < cases[0].asked:
            yield f"| {axis.name} | {_columns(cases, row)} |"


def _columns(cases: list[Case], row: int) -> str:
    """Format the table columns of one axis: largest error, median interval, intervals that hold, findings."""
    axis = AXES[row]
    known = [case for case in cases if case.result.axes[row].interval < 2 * axis.prior]
    error = max((abs(case.error(row)) for case in known), default=float("nan"))
    interval = float(np.median([case.result.axes[row].interval for case in known])) if known else float("nan")
    held = sum(case.held(row) for case in cases)
    said = Counter(str(_finding(case, row)) for case in cases)
    told = ", ".join(f"{what} {said[what]}" for what in AxisFinding if said[what])
    n = axis.decimals
    return f"{error:.{n}f} {axis.unit} | {interval:.{n}f} {axis.unit} | {held} of {len(cases)} | {told}"


def sentences(cases: list[Case]) -> Iterator[str]:
    """Yield the reasons given where the calibration cannot be determined, with their counts."""
    said = Counter(
        f"{axis.finding}: {axis.reason}"
        for case in cases
        for axis in case.result.axes[: case.asked]
        if axis.reason
    )
    for what, count in said.most_common(8):
        yield f"- {count} times: {what}"


def _finding(case: Case, row: int) -> AxisFinding:
    return case.result.axes[row].finding


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=12, help="errors on all axes at once (default: 12)")
    parser.add_argument("--only", help="groups whose name contains this")
    parser.add_argument("--write", type=Path, help="page whose marked part is replaced, instead of printing")
    options = parser.parse_args()
    groups = {
        name: cases
        for name, make in _groups(options.draws).items()
        if options.only is None or options.only in name
        if (cases := make(name))
    }
    page = "\n".join(summary(groups))
    if options.write:
        page = "\n".join(line for line in page.splitlines() if "of those six |" not in line)
        before, _, rest = options.write.read_text().partition(BEGIN)
        _, _, after = rest.partition(END)
        options.write.write_text(f"{before}{BEGIN}\n\n{page}\n\n{END}{after}")
        return
    lines = [page]
    for name, cases in groups.items():
        single = [case for case in cases if np.count_nonzero(case.planted) <= 1]
        several = [case for case in cases if np.count_nonzero(case.planted) > 1]
        lines += ["", f"### {name[0].upper()}{name[1:]}"]
        if any(case.planted.any() for case in single):
            lines += ["", "One axis at a time:", "", *by_size(single)]
        if several:
            lines += ["", "All axes at once, at random:", "", *by_axis(several)]
        lines += ["", *sentences(cases)]
    print("\n".join(lines))


def _groups(draws: int) -> dict[str, Callable[[str], list[Case]]]:
    found: dict[str, Callable[[str], list[Case]]] = {}

    def real(folder: Path, numbers: Sequence[int]) -> Callable[[str], list[Case]]:
        def run(name: str) -> list[Case]:
            kitti = Kitti(folder, numbers)
            errors = [*alone(AXES[:TIME]), *together(AXES[:TIME], draws, np.random.default_rng(0))]
            return judge(name, TIME, errors, kitti.calibrate)

        return run

    def few(folder: Path, numbers: Sequence[int], count: int) -> Callable[[str], list[Case]]:
        def run(name: str) -> list[Case]:
            kitti, rng = Kitti(folder, numbers), np.random.default_rng(0)

            def some(offsets: F64) -> Calibration:
                return kitti.calibrate(offsets, sorted(rng.choice(len(numbers), count, replace=False)))

            errors = [np.zeros(len(AXES))] * (draws // 4) + [*together(AXES[:TIME], draws, rng)]
            return judge(name, TIME, errors, some)

        return run

    def made(weave: bool) -> Callable[[str], list[Case]]:
        def run(name: str) -> list[Case]:
            drive = Drive(90, 2, weave, every=2 * EVERY)
            errors = [*alone(AXES[TIME:]), *together(AXES, draws, np.random.default_rng(0))]
            return judge(name, len(AXES), errors, drive.calibrate)

        return run

    frames, street = SHARED / "kitti", SHARED / "kitti_drive"
    held_out = [number for number in range(12) if number not in CHOSEN]
    if frames.exists() and street.exists():
        found["KITTI, twelve frames (000000 to 000011)"] = real(frames, range(12))
        found["KITTI, the six frames on which nothing was chosen (000006 to 000011)"] = real(frames, held_out)
        found["KITTI, a queue of cars (every other of 25 frames of a drive, 2.4 s)"] = real(
            street, range(0, 25, 2)
        )
        for count, word in ((3, "three"), (2, "two"), (1, "one")):
            found[f"KITTI, {word} of those six"] = few(frames, held_out, count)
    found["synthetic drive that weaves, 15 frames (seed 2)"] = made(weave=True)
    found["synthetic drive at a steady speed, 15 frames (seed 2)"] = made(weave=False)
    return found


if __name__ == "__main__":
    main()
