"""How well objects are placed on labelled KITTI frames: with the labels' own 2D boxes, and with a detector.

The judging shares no code with what it judges: labels are read here, and boxes are compared by shapely.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from bevviz.config import load
from tests.support.kitti_accuracy import FOUND, MIN_HITS, RANGE, Case, Label, Tally, measure

DATA = Path(os.environ.get("BEVVIZ_DATA") or Path(__file__).resolve().parents[2] / "shared/data")


def cases(data: Path, settings: Sequence[str] = ()) -> dict[str, Case]:
    """Both presets, with what can be had of detections."""
    model = f"detector.model={data / 'models/yolox_nano.onnx'}"
    reference = load(settings=[model], preset="reference")
    return {
        "`reference`, labels' boxes": Case(reference),
        "`default`, labels' boxes, clusters as they are": Case(load(settings=["fusion.split=false"])),
        "`default`, labels' boxes": Case(load(settings=settings)),
        "`default`, labels' boxes, edges 5 % off": Case(load(settings=settings), off=0.05),
        "`reference`, YOLOX-nano": Case(reference, by_labels=False),
        "`default`, YOLOX-nano, clusters as they are": Case(
            load(settings=[model, "fusion.split=false"]), by_labels=False
        ),
        "`default`, YOLOX-nano": Case(load(settings=[model, *settings]), by_labels=False),
    }


def table(tallies: Mapping[str, Tally], columns: Sequence[str] = ()) -> str:
    """Format the figures of each case as a Markdown table. Without ``columns`` it has all of them."""
    figures = {case: tally.figures() for case, tally in tallies.items()}
    heads = columns or list(next(iter(figures.values())))
    lines = ["| case | " + " | ".join(heads) + " |", "| --- |" + " ---: |" * len(heads)]
    lines += [f"| {case} | " + " | ".join(f[head] for head in heads) + " |" for case, f in figures.items()]
    return "\n".join(lines)


RINGS = ((0, 15), (15, 25), (25, RANGE))  # metres


VISIBILITIES: dict[str, Callable[[Label], bool]] = {
    "seen whole": lambda label: label.occluded == 0 and label.truncated <= 0.15,
    "partly hidden, or cut off by the image": lambda label: (
        label.occluded == 1 or (label.occluded == 0 and label.truncated > 0.15)
    ),
    "largely hidden": lambda label: label.occluded >= 2,
}


def by_visibility(tallies: Mapping[str, Tally]) -> str:
    """Format a table of the objects found, by how visible the labels say that they are."""
    heads = [f"{name}: found, IoU 0.5" for name in VISIBILITIES]
    lines = ["| case | " + " | ".join(heads) + " |", "| --- |" + " ---: |" * len(heads)]
    for case, tally in tallies.items():
        cells = []
        for holds in VISIBILITIES.values():
            there = [v for v in tally.objects if holds(v.label)]
            found, good = sum(v.distance <= FOUND for v in there), sum(v.iou >= 0.5 for v in there)
            cells.append(f"{found}, {good} of {len(there)}")
        lines.append(f"| {case} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def by_distance(tallies: Mapping[str, Tally]) -> str:
    """Objects found, and of those that have an IoU of 0.5."""
    heads = [f"{low:.0f} to {high:.0f} m: found, IoU 0.5" for low, high in RINGS]
    lines = ["| case | " + " | ".join(heads) + " |", "| --- |" + " ---: |" * len(heads)]
    for case, tally in tallies.items():
        cells = []
        for low, high in RINGS:
            there = [v for v in tally.objects if low <= np.hypot(*v.label.center[:2]) < high]
            found, good = sum(v.distance <= FOUND for v in there), sum(v.iou >= 0.5 for v in there)
            cells.append(f"{found}, {good} of {len(there)}")
        lines.append(f"| {case} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


SHOWN = ("`default`, labels' boxes", "`default`, YOLOX-nano", "`reference`, YOLOX-nano")  # on the page
COLUMNS = ("found within 2 m", "error, median m", "cars 0.7", "people 0.5", "wrong")  # on the page


def section(data: Path) -> str:
    """Measure every case and format its section of benchmarks/RESULTS.md."""
    shown: dict[str, Tally] = {}
    for frames, folder in (("0-11", "kitti"), ("12-23", "kitti_more")):
        tallies = measure(data / folder, cases(data))
        shown |= {f"{frames}, {case}": tallies[case] for case in SHOWN}
    return f"""## Objects on real frames

Labelled frames of the KITTI object benchmark (Geiger et al. 2012), by `python -m benchmarks.kitti`, which
also prints tables by distance and visibility. An object within {RANGE:.0f} m with {MIN_HITS} LiDAR points or
more is found if a box of its class has its centre within {FOUND:.0f} m. A box is wrong if no labelled object
is within {FOUND:.0f} m. Cars need an IoU of 0.7 from above, people 0.5. Brackets hold 95 % intervals. Methods
were chosen on frames 000000 to 000011, two rules (boxes of people, edges of weak detections) on all.

{table(shown, COLUMNS)}
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder with kitti/ and models/")
    parser.add_argument("--frame", action="append", metavar="NUMBER", help="only this one, as 000008")
    parser.add_argument("--objects", action="store_true", help="list every object")
    parser.add_argument("--set", action="append", default=[], help="key=value for the default preset")
    options = parser.parse_args(arguments)
    tallies = measure(options.data / "kitti", cases(options.data, options.set), options.frame)
    print(table(tallies), by_distance(tallies), by_visibility(tallies), sep="\n\n")
    if options.objects:
        for case, tally in tallies.items():
            print(f"\n{case}")
            for v in tally.objects:
                away = np.hypot(*v.label.center[:2])
                print(
                    f"  {v.frame} {v.label.kind:10} at {away:4.1f} m, {v.label.hits:5} hits: "
                    f"{v.distance:5.2f} m, IoU {v.iou:.2f}"
                )
            for b in tally.boxes:
                if b.nearest > FOUND:
                    print(
                        f"  {b.frame} {b.name} of {b.size[:2].round(1)} is {b.nearest:.1f} m from anything"
                        + (", unlabelled ground" if b.ignored else "")
                    )


if __name__ == "__main__":
    main()
