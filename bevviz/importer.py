"""``rerun-importer-bevviz``: Rerun's viewer runs it on the files that it opens, and shows what it writes.

Arguments and exit code are those of the external importers (rerun.io/docs/concepts/logging-and-ingestion): a
recording on standard output, or ``NOT_OURS``. Rerun asks every importer about every file, so that one that is
none of ours is answered before anything is imported.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

NOT_OURS = 66
BAGS = (".db3", ".bag")


def main() -> None:
    """The executable."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="rerun-importer-bevviz",
        description="Rerun's viewer runs this on what it opens: 'rerun drive.db3', or a bag dropped on it. "
        "Model and parameters are those of the bevviz.toml in the file's folder or above. An MCAP file Rerun "
        "reads itself, and asks nobody.",
    )
    parser.add_argument("path", type=Path, metavar="PATH", help="bag that the viewer opens")
    parser.add_argument("--application-id", default="", metavar="ID", help="that the viewer proposes")
    parser.add_argument("--recording-id", default=None, metavar="ID", help="that the viewer proposes")
    options, _ = parser.parse_known_args(arguments)
    path = options.path.absolute()
    if not _is_ours(path):
        return NOT_OURS
    from bevviz.errors import UserError

    try:
        _import(path, options.application_id, options.recording_id)
    except UserError as error:
        print(f"bevviz: error: {error}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, BrokenPipeError):  # the viewer has gone
        return 1
    return 0


def _import(path: Path, application_id: str, recording_id: str | None) -> None:
    import rerun as rr

    from bevviz.bags.source import BagSource
    from bevviz.cli.outputs import hint, warn
    from bevviz.config import load
    from bevviz.drive import Drive
    from bevviz.logging import blueprints
    from bevviz.logging.recorder import Recorder
    from bevviz.project import layers
    from bevviz.recorded import Origin

    config = load(layers=layers(path.parent))
    with BagSource([path], config) as source:
        drive = Drive(source, config)
        hint(drive.scene, config)
        recording = rr.RecordingStream(application_id or "bevviz", recording_id=recording_id)
        recording.set_log_time_enabled(False)
        recording.stdout(default_blueprint=blueprints.load("debug", drive.scene, config))
        origin = Origin.of(drive.scene, config, None)
        if origin is not None:
            origin.log(recording)
        drive.run([Recorder(recording, config)])
        recording.flush()
        recording.disconnect()
        warn(drive.warnings)


def _is_ours(path: Path) -> bool:
    return path.suffix in BAGS or (path / "metadata.yaml").is_file()
