"""Plant slices in a batch of synthetic drives, and count how many ``bevviz causes`` finds.

``python -m benchmarks.causes [--seed N] [--simulated N] [--drives N] [--null]`` simulates some drives with a
LiDAR of few beams and a camera of few pixels, and runs the pipeline on each twice: as it is, and with faults
planted. Each fault occurs under a condition of one to three attributes alone. The tables of the other drives
are drawn from the simulated ones, with other light, speed, hour, density and place. Development used seeds
below 100.

A slice counts as found if at least 90 % of its findings are under the conditions of one fault, which is most
of them, and if it names the attributes of that fault alone. A slice that no fault explains and that the same
batch without faults does not have counts as false.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from bevviz.config import load
from bevviz.extras.batch.causes import NAMES, SCALES, Bound, Causes, Findings, compare_causes, find_causes
from bevviz.extras.batch.findings import SCHEMA, FindingCollector
from bevviz.findings.frame_findings import find_findings
from bevviz.model.results import Detections
from bevviz.pipeline.session import Session
from bevviz.why import FrameExplainer
from tests.support import small_drives

FRAMES = 8  # of a simulated drive
DAY = 86400 * 10**9  # nanoseconds
BARE = 11  # points that an object without points keeps; one with fewer than ten need not be found
PLANTED = 20
HIT = 0.95  # share of the objects under the condition that a fault takes
PURE = 0.9
PRESENT = 0.75  # share of the objects under a condition that are found without faults; else it is masked
SHARE = (0.005, 0.02)  # of the objects that a condition holds for
Row = dict[str, Any]


@dataclass(frozen=True)
class Plant:
    """Fault that occurs under a condition alone."""

    bounds: tuple[Bound, ...]
    fault: str  # dropped, weak, misnamed, bare (no points), late (an image that is late)

    @property
    def kind(self) -> str:
        return "anomaly" if self.fault == "late" else "missed"

    @property
    def text(self) -> str:
        return f"{self.fault}: {', '.join(b.text for b in self.bounds)}"


# --- drives ------------------------------------------------------------------------------------


class SmallDrive:
    """Frames of a simulated drive with few beams and pixels, and detections that the simulator knows."""

    def __init__(self, number: int, rng: np.random.Generator) -> None:
        source = small_drives.source(number, FRAMES)
        self.name, self.bag = f"drive{number:04}", f"/data/robot{number % 5}/drive{number:04}.mcap"
        start, dim = int(rng.integers(5, 21)) * 3600 * 10**9, float(rng.uniform(0.3, 1.0))
        self.snapshots = list(small_drives.snapshots(source, FRAMES, dim, start))

    def findings(self, planted: dict[tuple[int, str], str]) -> list[Row]:
        """Run the pipeline. ``planted`` names the fault of an object, or of a frame (object "")."""
        config, now = load(), list[Detections]()
        session = Session(config, lambda _: now[-1])
        collector, rows = FindingCollector(), list[Row]()
        for snapshot in self.snapshots:
            index = snapshot.frame.index
            faults: dict[str, list[str]] = {}
            for (frame, number), fault in planted.items():
                if frame == index:
                    faults.setdefault(fault, []).append(number)
            bare = [int(number) for number in faults.get("bare", ())]
            snapshot = small_drives.without_points(snapshot, bare, BARE)
            found = small_drives.candidates(
                snapshot,
                dict.fromkeys(faults.get("weak", ()), 0.15),
                dict.fromkeys(faults.get("misnamed", ()), "bench"),
                set(faults.get("dropped", ())),
            )
            now.append(small_drives.detections(*found, config))
            frame_ = snapshot.frame
            if "late" in faults:
                frame_ = replace(frame_, cameras=tuple(replace(c, sync_error=0.4) for c in frame_.cameras))
            result = session.add_anomalies(session.perceive(frame_))
            explainer = FrameExplainer(result)
            place = {"bag": self.bag, "recording": self.name, "frame": index, "stamp": frame_.stamp}
            findings = collector.of_frame(explainer.traces, find_findings(explainer))
            rows += [{**place, **finding} for finding in findings]
        return rows


def drawn(rows: Sequence[Row], number: int, rng: np.random.Generator) -> list[Row]:
    """Return the table of another drive: that of a simulated one in other conditions."""
    mirrored, start = rng.random() < 0.5, int(rng.integers(5, 21)) * 3600 * 10**9
    light, density, pace = rng.uniform(0.4, 1.6), rng.uniform(0.6, 1.5), rng.uniform(0.4, 1.4)
    stretch, later, robot = (
        rng.uniform(0.93, 1.07),
        float(rng.choice([0, 5, 10, 20, 40])),
        int(rng.integers(5)),
    )
    other = []
    for row in rows:
        new = dict(row)
        new |= {"recording": f"drawn{number:04}", "bag": f"/data/robot{robot}/drawn{number:04}.mcap"}
        new["brightness"] = min(255.0, row["brightness"] * light)
        new["scan_points"] = row["scan_points"] * density
        new["speed_mps"] = row["speed_mps"] * pace
        new["time_s"] = row["time_s"] + later
        new["stamp"] = (
            row["stamp"] % (3600 * 10**9)
            + 1_750_000_000_000_000_000 // (86400 * 10**9) * (86400 * 10**9)
            + start
        )
        new["hour"] = new["stamp"] // 10**9 % 86400 / 3600
        if "range_m" in row:
            new["range_m"], new["points"] = row["range_m"] * stretch, max(10.0, row["points"] * density)
        if mirrored and "u" in row:
            new["u"], new["bearing_deg"] = 1 - row["u"], -row["bearing_deg"]
        other.append(new)
    return other


# --- faults ------------------------------------------------------------------------------------

OF_OBJECTS = ("range_m", "bearing_deg", "height_m", "gap_m", "points", "u", "v", "length_m")
RELATED = [
    {"bearing_deg", "u"},
    {"range_m", "points", "v"},
    {"height_m", "length_m", "class"},
    {"hour", "time_s"},
]
FAULTS = ("dropped", "weak", "misnamed", "bare")


def draw_plants(findings: Findings, number: int, rng: np.random.Generator) -> list[Plant]:
    """Draw faults whose conditions hold for a small part of the objects and overlap little."""
    plants: list[Plant] = []
    taken = np.zeros(len(findings), bool)
    while len(plants) < number:
        late = len(plants) % 10 == 9
        base = findings.is_word("outcome", "quiet" if late else "found")
        missed = findings.is_word("outcome", "anomaly" if late else "missed")
        numbers = ["brightness", "scan_points", "speed_mps", "hour"]
        pool = [*numbers, "folder"] if late else [*OF_OBJECTS, *numbers, "time_s", "folder", "class", "class"]
        names = set(rng.choice(pool, 2 if late else int(rng.integers(2, 4)), replace=True).tolist())
        if len(names) < 2 or any(len(names & related) > 1 for related in RELATED):
            continue
        bounds = tuple(_draw_bound(findings, name, base, rng) for name in sorted(names))
        holds = [bound.holds(findings) for bound in bounds]
        inside = base & np.logical_and.reduce(holds)
        share = inside.sum() / base.sum()
        objects = len(np.unique(findings.units[inside]))
        drives = len(np.unique(findings.words("recording")[1][inside]))
        if not SHARE[0] < share < SHARE[1] * (6 if late else 1) or drives < 8 or (objects < 25 and not late):
            continue
        if (inside & taken).sum() > 0.1 * inside.sum() or _is_needless(holds, base, inside):
            continue
        if inside.sum() < PRESENT * ((base | missed) & np.logical_and.reduce(holds)).sum():
            continue
        taken |= inside
        plants.append(Plant(bounds, "late" if late else str(rng.choice(FAULTS))))
    return plants


def _is_needless(holds: Sequence[Any], base: Any, inside: Any) -> bool:
    """Return whether a condition could be left out without much of a difference."""
    for i in range(len(holds)):
        others = np.logical_and.reduce([base, *holds[:i], *holds[i + 1 :]])
        if others.sum() < 1.5 * inside.sum():
            return True
    return False


def _draw_bound(findings: Findings, name: str, base: Any, rng: np.random.Generator) -> Bound:
    """Draw one side of a number at an edge of its bins, or a word."""
    if name in NAMES:
        words, codes = findings.words(name)
        return Bound(name, words[int(rng.choice(np.unique(codes[base & (codes >= 0)])))])
    number = findings.number(name)[base]
    quantile = np.nanquantile(number, rng.uniform(0.15, 0.85))
    edge = float(f"{SCALES[name].edges[np.abs(SCALES[name].edges - quantile).argmin()]:.6g}")
    return Bound(name, low=edge) if (number >= edge).mean() < 0.5 else Bound(name, high=edge)


def choose_victims(findings: Findings, plants: Sequence[Plant], rng: np.random.Generator) -> Any:
    """Return the (N,) number of the fault of each row, -1: none."""
    fault = np.full(len(findings), -1)
    for number, plant in enumerate(plants):
        base = findings.is_word("outcome", "quiet" if plant.kind == "anomaly" else "found")
        inside = base & np.logical_and.reduce([bound.holds(findings) for bound in plant.bounds])
        fault[inside & (fault < 0) & (rng.random(len(fault)) < HIT)] = number
    return fault


# --- the benchmark -----------------------------------------------------------------------------


def as_findings(rows: Sequence[Row]) -> Findings:
    return Findings(pa.Table.from_pylist(list(rows), schema=SCHEMA), Path("runs"))


def plant(
    drives: Sequence[SmallDrive], base: list[Row], plants: Sequence[Plant], rng: np.random.Generator
) -> tuple[list[Row], dict[tuple[str, int, str], int]]:
    """Return the findings with faults, and the fault of each (drive, frame, object)."""
    chosen = choose_victims(as_findings(base), plants, rng).tolist()
    victims = {
        (row["recording"], row["frame"], row.get("object", "") if row["outcome"] == "found" else ""): number
        for row, number in zip(base, chosen, strict=True)
        if number >= 0
    }
    rows: list[Row] = []
    reasons: dict[str, list[Row]] = {}
    for drive in drives:
        mine = {(f, o): plants[n].fault for (name, f, o), n in victims.items() if name == drive.name}
        for row in drive.findings(mine):
            fault = mine.get((row["frame"], row.get("object", "")))
            if row["outcome"] == "missed" and fault:
                reasons.setdefault(fault, []).append(row)
            rows.append(row)
    simulated = {drive.name for drive in drives}
    for row in base:
        if row["recording"] in simulated:
            continue
        number = victims.get((row["recording"], row["frame"], row.get("object", "")), -1)
        if row["outcome"] == "quiet" and number >= 0:
            row = {**row, "outcome": "anomaly", "reason": "sync", "object": "zed"}
        elif row["outcome"] == "found" and number >= 0 and (like := reasons.get(plants[number].fault)):
            example = like[int(rng.integers(len(like)))]
            row = {**row, "outcome": "missed", "reason": example["reason"], "text": example["text"]}
        rows.append(row)
    return rows, victims


def _victim(row: Row) -> str:
    """Return the object of a row as the faults name it: empty for a frame."""
    if row["outcome"] == "false":
        return "no object of the ground truth"
    return "" if row["outcome"] in ("anomaly", "quiet") else str(row.get("object", ""))


def _directions(names: set[str]) -> set[str]:
    """Return the attributes, with one name for a direction and its column in a camera that looks ahead."""
    return {"bearing_deg" if name == "u" else name for name in names}


def judge(
    causes: Causes,
    natural: Causes,
    plants: Sequence[Plant],
    victims: dict[tuple[str, int, str], int],
    rows: list[Row],
) -> tuple[int, int, int]:
    """Print what became of each fault. Return how many were found, found in part, and the false slices."""
    state = {(c.kind, c.reason, c.text): c.state for c in compare_causes(causes, natural)}
    numbers = np.array([victims.get((r["recording"], r["frame"], _victim(r)), -1) for r in rows])
    best: dict[int, tuple[float, float, bool, str]] = {}
    false = []
    for cause in causes.causes:
        of_cause = numbers[cause.rows]
        faults, counts = np.unique(of_cause[of_cause >= 0], return_counts=True)
        fault = int(faults[counts.argmax()]) if len(faults) else -1
        if not len(faults) or counts.max() < 0.5 * cause.count:
            # An object that is reported by a wrong name is missed, and false by that name.
            is_effect = cause.kind == "false" and cause.text.startswith("benches")
            if state.get((cause.kind, cause.reason, cause.text)) == "new" and not is_effect:
                false.append(cause.title)
            continue
        inside = np.logical_and.reduce([bound.holds(causes.findings) for bound in plants[fault].bounds])
        purity = float(inside[cause.rows].mean())
        names = {b.attribute for b in cause.conditions}
        right = _directions(names) == _directions({b.attribute for b in plants[fault].bounds})
        whole = counts.max() / max(int((numbers == fault).sum()), 1)
        if (right, purity) > (best[fault][2], best[fault][0]) if fault in best else True:
            best[fault] = purity, whole, right, cause.text
    for number, one in enumerate(plants):
        purity, whole, right, text = best.get(number, (0.0, 0.0, False, "-"))
        mark = "found" if purity >= PURE and right else "in part" if purity > 0 else "LOST"
        print(f"{mark:8} purity {purity:.2f} of {whole:.2f}  {one.text}\n{'':10}{text}")
    for text in false:
        print("false   ", text)
    found = sum(p >= PURE and right for p, _, right, _ in best.values())
    return found, len(best) - found, len(false)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--simulated", type=int, default=24)
    parser.add_argument("--drives", type=int, default=200)
    parser.add_argument("--repeat", type=int, default=1, help="draws of faults for the same drives")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    start = time.perf_counter()
    drives = [SmallDrive(1000 * options.seed + number, rng) for number in range(options.simulated)]
    print(f"{options.simulated} drives simulated in {time.perf_counter() - start:.0f} s", flush=True)
    measure(drives, options.drives, options.repeat, rng)


def measure(drives: Sequence[SmallDrive], number: int, repeat: int, rng: np.random.Generator) -> None:
    """Run the pipeline, draw the tables of the other drives, and plant faults several times."""
    by_drive = {drive.name: drive.findings({}) for drive in drives}
    base = [row for rows in by_drive.values() for row in rows]
    for other in range(number - len(drives)):
        base += drawn(by_drive[drives[int(rng.integers(len(drives)))].name], other, rng)
    start = time.perf_counter()
    natural = find_causes(as_findings(base))
    seconds = time.perf_counter() - start
    print(f"{len(base)} findings; without faults {len(natural.causes)} causes in {seconds:.0f} s", flush=True)
    totals = np.zeros(3, int)
    for _ in range(repeat):
        plants = draw_plants(as_findings(base), PLANTED, rng)
        rows, victims = plant(drives, base, plants, rng)
        start = time.perf_counter()
        causes = find_causes(as_findings(rows))
        print(f"\n{len(causes.causes)} causes in {time.perf_counter() - start:.0f} s", flush=True)
        result = judge(causes, natural, plants, victims, rows)
        print(
            f"{result[0]} of {len(plants)} found, {result[1]} in part; {result[2]} false slices", flush=True
        )
        totals += result
    print(f"\nin all: {totals[0]} of {PLANTED * repeat} found, {totals[1]} in part, {totals[2]} false")


if __name__ == "__main__":
    main()
