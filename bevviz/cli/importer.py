"""Executable ``rerun-importer-bevviz``: Rerun's viewer runs it on each file it opens and shows its output.

Arguments and exit code follow the protocol of external importers
(rerun.io/docs/concepts/logging-and-ingestion): write a recording to standard output, or end with
``NOT_OURS``. Rerun asks every importer about every file. A foreign file is therefore rejected before the
slow imports.
"""

from __future__ import annotations

import argparse
import os
import select
import sys
import threading
from dataclasses import replace
from pathlib import Path

from bevviz.support import cleanup

NOT_OURS = 66
BAGS = (".db3", ".bag")
METADATA = "metadata.yaml"  # This file marks a folder that is one bag.


def main() -> None:
    """Run the importer and end the process with its exit code."""
    threading.Thread(target=_end_with_viewer, daemon=True).start()
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Import the file and return the exit code."""
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
    # Rerun takes the application ID from the folder if it asks about a folder, else from the file.
    with_folder = options.application_id in ("", path.parent.name) and options.application_id != path.stem
    if not _is_ours(path, with_folder):
        return NOT_OURS
    if _comes_with_another(path, with_folder):
        return 0
    from bevviz.errors import UserError

    proposed_ids = (options.application_id, options.recording_id)
    try:
        # Each bag of a folder needs its own recording. In the proposed one they would be mixed.
        _import(path, *((path.stem, None) if with_folder and path.is_file() else proposed_ids))
    except UserError as error:
        print(f"bevviz: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 1
    return 0


def _end_with_viewer() -> None:
    """End the process when the viewer closes standard output. The SDK would go on, or wait for ever."""
    pipe = select.poll()
    pipe.register(sys.stdout, 0)  # poll() always reports errors and hang-ups.
    pipe.poll()
    cleanup.remove_all()
    os._exit(1)


def _import(path: Path, application_id: str, recording_id: str | None) -> None:
    import rerun as rr

    from bevviz.bags.source import BagSource
    from bevviz.cli.outputs import print_hints, warn
    from bevviz.config import load
    from bevviz.config.project import read_project_layers
    from bevviz.config.trust import Trust
    from bevviz.drive import Drive
    from bevviz.findings.marks import MarkRecorder
    from bevviz.recording import blueprints
    from bevviz.recording.recorder import Recorder
    from bevviz.recording.source_lookup import Origin

    # The viewer may open files of unknown origin. Never run the functions they name, even if trusted.
    no_trust = Trust(advice="Rerun's viewer runs none; 'bevviz' does, on the command line")
    project_layers = read_project_layers(path if path.is_dir() else path.parent)
    config = load(layers=[replace(layer, trust=no_trust) for layer in project_layers])
    with BagSource([path], config) as source:
        drive = Drive(source, config)
        print_hints(drive.scene, config)
        application_id = application_id or blueprints.application_id("debug", drive.scene, config)
        recording = rr.RecordingStream(application_id, recording_id=recording_id)
        recording.set_log_time_enabled(False)
        recording.stdout(default_blueprint=blueprints.load("debug", drive.scene, config))
        origin = Origin.of(drive.scene, config, None)
        if origin is not None:
            origin.log(recording)
        drive.run([Recorder(recording, config), MarkRecorder(recording)])
        recording.flush()
        recording.disconnect()
        warn(drive.warnings)


def _is_ours(path: Path, with_folder: bool) -> bool:
    return path.suffix in BAGS or (path / METADATA).is_file() or (with_folder and path.name == METADATA)


def _comes_with_another(path: Path, with_folder: bool) -> bool:
    """Return whether Rerun also asks about another path of the same bag.

    Rerun asks about a folder, and about every file in it.
    """
    if path.is_dir():
        return len(_files(path)) == 1
    of_folder = path.name == METADATA or ((path.parent / METADATA).is_file() and len(_files(path.parent)) > 1)
    return with_folder and of_folder


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix in BAGS]
