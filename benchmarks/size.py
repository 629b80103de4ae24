"""How large recordings are that keep everything, what an inspection needs, or what a report needs.

Runs `bevviz bag --keep` on the synthetic drive, and on a real one where its path is given; counts what each
recording has of what must not be missing. Prints a section of benchmarks/RESULTS.md.
"""

from __future__ import annotations

import argparse
import tempfile
from datetime import UTC, datetime
from pathlib import Path

from rerun.chunk import RrdReader
from tqdm import tqdm

from benchmarks import bags
from benchmarks.measure import machine, run
from benchmarks.pages import write_section
from bevviz.recording import entities

KEEPS = ("everything", "inspect", "report")
DECIDED = (entities.EXPLAIN, entities.FUSED, entities.TRACKS, entities.ANOMALY_LOG)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=100, help="of the synthetic drive (default: 100)")
    parser.add_argument(
        "--drive", type=Path, action="append", default=[], help="a bag or a data set's folder"
    )
    parser.add_argument("--model", default="demo", help="detector of the further drives (default: demo)")
    parser.add_argument("--write", type=Path, help="page whose section is replaced, instead of printing")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        synthetic = bags.simulate(options.frames, folder / "synthetic.mcap")
        drives = [(synthetic, "demo"), *((drive, options.model) for drive in options.drive)]
        rows = [row for drive, model in drives for row in sizes(drive, model, folder)]
    section = "\n".join(
        [
            "## Size of a recording, by what it keeps",
            "",
            f"`python -m benchmarks.size`, {datetime.now(UTC):%Y-%m-%d}: {machine()}.",
            "",
            "| drive | keep | MB | of everything | MB a frame | raw clouds |",
            "| --- | --- | ---: | ---: | ---: | ---: |",
            *rows,
        ]
    )
    if options.write:
        write_section(options.write, section)
    else:
        print(section)


def sizes(drive: Path, model: str, folder: Path) -> list[str]:
    """Return a row of the table for each kind of recording."""
    found, whole, decided = [], 0, -1
    for keep in tqdm(KEEPS, unit="run", desc=drive.name, disable=None):
        saved = folder / "saved.rrd"
        run("bevviz", "bag", str(drive), "--model", model, "--keep", keep, "--save", str(saved))
        size, (frames, raw, rows) = saved.stat().st_size, counted(saved)
        whole, decided = whole or size, rows if decided < 0 else decided
        if rows != decided:
            raise SystemExit(f"{drive.name}, {keep}: {rows} decisions, of {decided}")
        found.append(
            f"| {drive.stem}, {frames} scans | `{keep}` | {size / 1e6:.1f} | {size / whole:.3f} "
            f"| {size / frames / 1e6:.2f} | {raw} |"
        )
    return found


def counted(recording: Path) -> tuple[int, int, int]:
    """Frames, raw clouds, and rows of what was decided."""
    frames: set[int] = set()
    raw = rows = 0
    for chunk in RrdReader(recording).stream():
        if chunk.is_static or chunk.entity_path.startswith("/__"):
            continue
        batch, path = chunk.to_record_batch(), chunk.entity_path
        frames.update(batch.column(entities.FRAME).to_pylist())
        rows += batch.num_rows if path.startswith(DECIDED) else 0
        sensor = path.removeprefix(f"{entities.WORLD}/").split("/")[0]
        if path == entities.POINTS.path(sensor) and "Points3D:positions" in batch.schema.names:
            raw += batch.num_rows - batch.column("Points3D:positions").null_count
    return len(frames), raw, rows


if __name__ == "__main__":
    main()
