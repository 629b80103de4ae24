"""How long one has to wait for an answer: whole processes, from the command to its end, everything warm.

A question about one frame (``bevviz why``), ten frames of the synthetic drive into a recording (``bevviz
bag``), and the imports of ``bevviz info`` against those of the libraries that any reader of bags needs.
Beside the time on the clock stands the processor's, as other work on the machine holds up only the former.
Python must be allowed to write its compiled modules: without them each run compiles bevviz anew.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

from tqdm import tqdm

from benchmarks import bags
from benchmarks.measure import Times, children_time, machine, run

FRAMES = 40  # of the drive
IMPORTS = "import bevviz.cli, bevviz.pipeline.bag_info"
LIBRARIES = "import cv2, numpy, pydantic, rosbags.rosbag2"
ROWS = {  # command -> text, and the seconds that are wanted
    "why": ("`bevviz why`, one frame", "1 s"),
    "bag": ("`bevviz bag`, ten frames", "2 s"),
    "imports": ("imports of `bevviz info`", "0.3 s"),
    "libraries": (f"`{LIBRARIES}`", ""),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repetitions", type=int, default=9, metavar="N", help="of each run (default: 9)")
    parser.add_argument("--bag", type=Path, help="a drive that is there, instead")
    options = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    print(f"{machine()}, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bag = options.bag or bags.simulate(FRAMES, folder / "drive.mcap")
        print(*measured(bag, folder / "saved.rrd", options.repetitions), sep="\n")


def measured(bag: Path, saved: Path, repetitions: int) -> list[str]:
    """Rows of the table; the commands take turns."""
    what = (str(bag), "--model", "demo")
    commands = {
        "why": ("bevviz", "why", *what, "--at-frame", "20"),
        "bag": ("bevviz", "bag", *what, "--frames", ":10", "--save", str(saved)),
        "imports": ("python", "-c", IMPORTS),
        "libraries": ("python", "-c", LIBRARIES),
    }
    for command in commands.values():  # so that nothing is compiled meanwhile
        run(*command)
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
    for _ in tqdm(range(repetitions), unit="run", disable=None):
        for name, command in commands.items():
            before = children_time()
            seconds = run(*command).seconds
            found[name].append((seconds, children_time() - before))
    rows = ["| command | s | processor s | wanted |", "| --- | ---: | ---: | ---: |"]
    for name, (text, wanted) in ROWS.items():
        clock, processor = (Times(column) for column in zip(*found[name], strict=True))
        rows.append(f"| {text} | {clock} | {processor} | {wanted} |")
    return rows


if __name__ == "__main__":
    main()
