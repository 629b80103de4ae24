"""How fast bevviz is, against what the tutorial's users run today and against Rerun's own converter.

Both sides of each ratio process the same frames of the synthetic drive in this one run, in turns, and what
they make is compared. Prints the tables of benchmarks/RESULTS.md.
"""

from __future__ import annotations

import argparse
import tempfile
from datetime import UTC, datetime
from pathlib import Path

import cv2

from benchmarks import bags, runs, stages
from benchmarks.measure import default_model, machine
from bevviz.bags.source import BagSource
from bevviz.config import load

HEAD = (
    "| what | against | theirs | bevviz | ratio | wanted | the same |",
    "| --- | --- | ---: | ---: | ---: | ---: | --- |",
)
BEGIN, END = "<!-- make bench: begin -->", "<!-- make bench: end -->"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer frames and repetitions, a smaller bag")
    parser.add_argument("--size", type=float, default=1.0, help="GB of the bag of whole runs (default: 1)")
    parser.add_argument("--model", type=Path, default=default_model(), help="detector (default: yolox_nano)")
    parser.add_argument("--write", type=Path, help="page whose marked part is replaced, instead of printing")
    options = parser.parse_args()
    cv2.setNumThreads(2)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drive = bags.simulate(10 if options.quick else 40, folder / "drive.mcap")
        messages = bags.clouds(drive)
        with BagSource([drive], load()) as source:
            frames, scene = list(source), source.scene
        repetitions = 3 if options.quick else 15
        rows = stages.compare(messages, frames, scene, repetitions)
        table = stages.profile(messages, frames, scene)
        bag = bags.repeat(drive, folder / "repeated", int(1e9 * (0.2 if options.quick else options.size)))
        rows += runs.compare(bag, 1 if options.quick else 3)
        if options.write is None:  # the page goes without them
            rows += stages.growth(messages, frames, scene, repetitions)
        networks = runs.networks(drive, len(frames), options.model)

    page = "\n".join(
        [
            f"Measured on {datetime.now(UTC):%Y-%m-%d}: {machine()}. Medians, the best of the repetitions in "
            "brackets.",
            "",
            *(without_target(line) if options.write else line for line in HEAD),
            *(without_target(row) if options.write else row for row in rows),
            "",
            *table,
            "",
            *networks,
        ]
    )
    if options.write is None:
        print(page)
        return
    text = options.write.read_text()
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    options.write.write_text(f"{before}{BEGIN}\n\n{page}\n\n{END}{after}")


def without_target(row: str) -> str:
    """Drop the column ``wanted`` of a row of the table."""
    cells = row.split("|")
    return "|".join(cells[:6] + cells[7:])


if __name__ == "__main__":
    main()
