"""Walk over the page of the workbench at random, and hold every sentence against the drive.

python -m benchmarks.page_walk --steps 500 --seeds 1 2 3
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from bevviz.cli import main as bevviz
from tests.support.page_walk import Oracle, Walk
from tests.support.workbench_pages import chromium, serving


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=500, help="of each walk (default: 500)")
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[1, 2, 3], help="one walk each (default: 1 2 3)"
    )
    parser.add_argument("--frames", type=int, default=12, help="of the demo drive (default: 12)")
    parser.add_argument(
        "--screenshots",
        type=Path,
        help="folder for a picture of each page that is wrong, and of the last step",
    )
    options = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "demo.mcap"
        bevviz(["demo", "--frames", str(options.frames), "-o", str(bag)])
        oracle = Oracle(bag)
        for seed in options.seeds:
            with serving("open", str(bag)) as (address, _), chromium() as browser:
                walk = Walk(browser, address, oracle, seed, options.screenshots)
                try:
                    walk.go(options.steps)
                except Exception as error:  # The next seed is walked nevertheless.
                    print(f"seed {seed} has ended early: {error!r}")
                for pane in walk.panes if not walk.wrong else []:
                    walk.save_picture(pane, options.steps)
            (bag.parent / "demo.mcap.notes.json").unlink(missing_ok=True)
            print(f"seed {seed}: {walk.taken} steps, {len(walk.wrong)} wrong sentences")
            failed += len(walk.wrong)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
