"""Check that a change of the code changes no result.

``python -m benchmarks.golden FOLDER --write golden.json`` runs the commands over a bag of each container and
a drive of each data set format, and writes a hash of every result. ``--check golden.json`` runs the commands
again and names the results that differ. The bags stay in FOLDER, so that both runs read the same bytes.

A recording is hashed entity by entity: its values in order of time, however they are cut into chunks. Stage
times, memory, and what the clock of the machine decides are left out.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pyarrow as pa
from rerun.chunk import RrdReader
from websockets.sync.client import connect
from websockets.typing import Origin

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("BEVVIZ_DATA") or ROOT.parent / "shared/data")
FRAMES = 12  # of each drive: enough for tracks, anomalies and a pause between two images
LIMIT = 600.0  # seconds that one command may take
VOLATILE = re.compile(
    r"(/b)?/health/(time|rate|stages|memory|process|latency)|^/(__properties|explain/log)|/ms$"
)
TRACKED = re.compile(r"track|trail|/world/fused|/clusters")  # depends on the clock in a live run
UNSTABLE_KEYS = {"milliseconds", "seconds", "ms", "times", "took", "run", "machine", "memory", "network"}

Hashes = dict[str, str]  # name of a result: hash of its content


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="for bags and recordings; kept")
    group = parser.add_mutually_exclusive_group(required=True)
    group.add_argument("--write", type=Path, metavar="FILE.json", help="store the hashes of this run")
    group.add_argument("--check", type=Path, metavar="FILE.json", help="compare this run with stored hashes")
    parser.add_argument("--only", default="", metavar="TEXT", help="only the steps whose name contains TEXT")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    steps = {name: step for name, step in _steps(options.folder.resolve()).items() if options.only in name}
    expected: Hashes = json.loads(options.check.read_text(encoding="utf-8")) if options.check else {}
    hashes: Hashes = {}
    for name, step in steps.items():
        start = time.monotonic()
        found = {f"{name}: {part}": value for part, value in step().items()}
        hashes |= found
        print(f"{time.monotonic() - start:6.1f} s  {name}", flush=True)
        if options.check:
            stored = {key: value for key, value in expected.items() if key.startswith(f"{name}: ")}
            for key in sorted({*stored, *found}):
                if stored.get(key) != found.get(key):
                    state = "is gone" if key not in found else "is new" if key not in stored else "differs"
                    print(f"          {key} {state}", flush=True)
    if options.write:
        options.write.write_text(json.dumps(hashes, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        print(f"{options.write}: {len(hashes)} hashes")
        return 0
    expected = {key: value for key, value in expected.items() if key.split(": ")[0] in steps}
    equal = sum(expected[key] == hashes.get(key) for key in expected)
    print(f"{equal} of {len(expected)} results are equal, {len(hashes.keys() - expected.keys())} are new")
    return 0 if equal == len(expected) == len(hashes) else 1


def _steps(folder: Path) -> dict[str, Callable[[], Hashes]]:
    """Return the steps by name, in the order in which they run."""
    model = str(DATA / "models/yolox_nano.onnx")
    drives = _drives(folder)
    steps: dict[str, Callable[[], Hashes]] = {}
    for name, drive in drives.items():
        network = ["--model", "demo" if name.startswith("demo") else model]
        for preset in ("default", "reference"):
            arguments = [*drive, *network, "--preset", preset, "--frames", f":{FRAMES}"]
            if name in ("demo mcap", "kitti object", "kitti drive") or preset == "default":
                steps[f"bag {name} {preset}"] = lambda a=arguments: _recording("bag", a, folder)  # type: ignore[misc]
        at = [*drive, *network, "--at-frame", "3", "--all"]
        steps[f"why {name}"] = lambda a=at: _json("why", a, folder)  # type: ignore[misc]
        steps[f"info {name}"] = lambda a=drive: _json("info", a, folder)  # type: ignore[misc]
    demo = [*drives["demo mcap"], "--model", "demo", "--frames", f":{FRAMES}"]
    kitti = [*drives["kitti object"], "--model", model]
    change = ["--set-b", "clustering.eps=0.8"]
    steps["evaluate demo"] = lambda: _json("evaluate", demo, folder)
    steps["evaluate kitti"] = lambda: _json("evaluate", kitti, folder)
    steps["compare demo"] = lambda: _json("compare", [*demo, *change], folder)
    steps["compare kitti"] = lambda: _json("compare", [*kitti, *change], folder)
    steps["compare recording"] = lambda: _recording("compare", [*demo, *change], folder)
    steps["sweep demo"] = lambda: _json("sweep", [*demo, "--set", "clustering.eps=0.4:0.6:0.1"], folder)
    steps["calib demo"] = lambda: _json("calib", [*drives["demo mcap"], "--frames", f":{FRAMES}"], folder)
    steps["keep demo"] = lambda: _recording("bag", [*demo, "--keep", "inspect"], folder)
    steps["workbench demo"] = lambda: _workbench(drives["demo mcap"], folder)
    steps["live demo"] = lambda: _live(folder)
    return steps


# --- drives ------------------------------------------------------------------------------------


def _drives(folder: Path) -> dict[str, list[str]]:
    """Return the arguments that name each drive; make the drives that FOLDER lacks."""
    from tests.support import datasets

    demo = folder / "demo.mcap"
    if not demo.exists():
        _run(["demo", "--frames", "40", "--plant", "flat_car", "--weave", "-o", str(demo)], folder)
    drives = {"demo mcap": [str(demo)]}
    for name, options in {
        "sqlite": ["--dst-storage", "sqlite3"],
        "sqlite zstd": ["--dst-storage", "sqlite3", "--compress", "zstd", "--compress-mode", "message"],
        "mcap zstd": ["--dst-storage", "mcap", "--compress", "zstd", "--compress-mode", "storage"],
    }.items():
        drives[f"demo {name}"] = [str(_convert(demo, folder / name.replace(" ", "_"), options))]
    drives["demo ros1"] = [str(_convert(demo, folder / "demo.bag", ["--dst-typestore", "ros1_noetic"]))]
    cut = folder / "cut.mcap"
    if not cut.exists():
        cut.write_bytes(demo.read_bytes()[: demo.stat().st_size * 2 // 3])
    drives["demo cut"] = [str(cut)]
    if not (folder / "export").exists():
        _run(["export", str(demo), "--model", "demo", "--format", "nuscenes", "-o", "export"], folder)
    drives["demo nuscenes"] = [str(folder / "export")]
    for name, options in {
        "kitti_raw": [],
        "kitti_tracking": ["--sequence", "0000"],
        "kitti_odometry": [],
    }.items():
        root = folder / name
        if not root.exists():
            root.mkdir()
            getattr(datasets, name)(root)
        place = root / "2011_09_26" if name == "kitti_raw" else root
        drives[f"made {name}"] = [str(place), *options]
    drives["kitti object"] = [str(DATA / "kitti")]
    drives["kitti drive"] = [str(DATA / "kitti_drive")]
    return drives


def _convert(bag: Path, target: Path, options: Sequence[str]) -> Path:
    """Convert a bag by the command line of rosbags."""
    if not target.exists():
        command = [
            str(Path(sys.executable).with_name("rosbags-convert")),
            "--src",
            str(bag),
            "--dst",
            str(target),
        ]
        subprocess.run([*command, *options], check=True)
    return target


# --- commands ----------------------------------------------------------------------------------


def _run(arguments: Sequence[str], folder: Path) -> str:
    """Run ``bevviz`` and return what it prints on standard output."""
    command = [sys.executable, "-m", "bevviz", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_COLOR": "1"}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False
    )
    # A gate that fails ends with 1 and prints its result all the same.
    if done.returncode not in (0, 1) or (done.returncode == 1 and not done.stdout):
        return f"status {done.returncode}: {done.stderr[-2000:]}"
    return done.stdout


def _json(command: str, arguments: Sequence[str], folder: Path) -> Hashes:
    text = _run([command, *arguments, "--json"], folder)
    try:
        tree = json.loads(text)
    except ValueError:
        return {"text": _hash(text.encode())}
    return {key: _hash(json.dumps(value, sort_keys=True).encode()) for key, value in _stable(tree).items()}


def _stable(tree: Any) -> Any:
    """Return a JSON tree without the keys that depend on the machine."""
    if isinstance(tree, dict):
        return {
            key: _stable(value)
            for key, value in tree.items()
            if key not in UNSTABLE_KEYS and not key.endswith(" ms")
        }
    return [_stable(value) for value in tree] if isinstance(tree, list) else tree


def _recording(command: str, arguments: Sequence[str], folder: Path) -> Hashes:
    path = folder / "result.rrd"
    path.unlink(missing_ok=True)
    said = _run([command, *arguments, "--save", str(path)], folder)
    return digest(path) if path.exists() else {"no recording": _hash(said.encode())}


# --- recordings --------------------------------------------------------------------------------


def digest(recording: Path, timelines: Sequence[str] = ("frame", "stamp")) -> Hashes:
    """Return a hash for each entity of a recording, over its values in order of the timelines."""
    rows: dict[str, list[tuple[Any, ...]]] = defaultdict(list)
    for chunk in RrdReader(recording).stream():
        entity = chunk.entity_path
        if VOLATILE.search(entity):
            continue
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name not in chunk.timeline_names]
        clocks = [batch.column(name).cast(pa.int64()) for name in timelines if name in chunk.timeline_names]
        for name in names:
            if name.startswith("rerun.controls"):
                continue
            column = batch.column(name)
            for row in range(batch.num_rows):
                if column[row].is_valid:
                    when = tuple(clock[row].as_py() for clock in clocks)
                    rows[entity].append((name, when, array_hash(column.slice(row, 1))))
    return {entity: _hash(repr(sorted(values)).encode()) for entity, values in sorted(rows.items())}


def array_hash(array: Any) -> str:
    """Return a hash of an Arrow array's values, whatever buffers they lie in."""
    state = hashlib.sha256()
    _update(state, array)
    return state.hexdigest()[:16]


def _update(state: Any, array: Any) -> None:
    kind = array.type
    state.update(f"{kind} {len(array)} {array.null_count}".encode())
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        if not pa.types.is_fixed_size_list(kind):
            state.update(repr(array.value_lengths().to_pylist()).encode())
        _update(state, array.flatten())
    elif pa.types.is_struct(kind):
        for field in array.flatten():
            _update(state, field)
    elif pa.types.is_primitive(kind) and not array.null_count and not pa.types.is_boolean(kind):
        state.update(array.to_numpy(zero_copy_only=False).tobytes())
    else:
        state.update(repr(array.to_pylist()).encode())


# --- the workbench and the live path -----------------------------------------------------------


@contextmanager
def _serving(arguments: Sequence[str], folder: Path) -> Iterator[str]:
    """Start ``bevviz open`` and return the address that it prints."""
    command = [sys.executable, "-m", "bevviz", "open", *arguments, "--model", "demo", "--no-browser"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=folder, env=environment) as server:
        assert server.stderr is not None
        for line in server.stderr:
            if found := re.search(r"workbench at (\S+)", line):
                yield found[1]
                break
        server.terminate()
        server.communicate(timeout=60)


def _workbench(drive: Sequence[str], folder: Path) -> Hashes:
    """Ask the page's questions over its socket: the list, three answers and two tried values."""
    hashes: Hashes = {}
    with _serving(drive, folder) as address:
        parts = urlsplit(address)
        url, origin = f"ws://{parts.netloc}/talk?&{parts.query}", Origin(f"http://{parts.netloc}")
        with connect(url, origin=origin, max_size=None) as talk:
            talk.send(json.dumps({"id": 0, "type": "shown"}))
            entries: list[Any] = []
            over = False
            while not over:
                message = json.loads(talk.recv(timeout=LIMIT))
                if message["type"] == "entries":
                    entries = message["entries"]
                over = message["type"] == "progress" and message["over"]
            hashes["entries"] = _hash(json.dumps(_stable(entries), sort_keys=True).encode())
            sights = [sight for entry in entries for sight in entry["sights"] if sight[3]][:3]
            for number, sight in enumerate(sights, 1):
                for kind, settings in (("ask", []), ("try", ["clustering.eps=0.8"])):
                    asked = {"time": int(sight[1]), "pick": sight[3], "set": settings}
                    talk.send(json.dumps({"id": number, "type": kind, **asked}))
                    wanted = {"ask": "answer", "try": "tried"}[kind]
                    message = json.loads(talk.recv(timeout=LIMIT))
                    while message["type"] not in (wanted, "error"):
                        message = json.loads(talk.recv(timeout=LIMIT))
                    text = json.dumps(_stable(message), sort_keys=True)
                    hashes[f"{kind} {sight[3]} {number}"] = _hash(text.encode())
    return hashes


def _live(folder: Path) -> Hashes:
    """Run the live path over replayed frames, slowly enough that none is dropped."""
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.live.runtime import Live, Outputs
    from bevviz.live.status import Notes
    from bevviz.synthetic import SyntheticSource
    from tests.support.replay import Replay

    path = folder / f"live_{time.time_ns()}.rrd"
    drive = SyntheticSource(frames=FRAMES)
    source = Replay(list(drive), drive.scene, rate=1.0, total=FRAMES)
    settings = ReloadableConfig(settings=["detector.model=demo"])
    Live(source, settings, Outputs(save=path), Notes(lambda line: None)).run()
    return {key: value for key, value in digest(path, ("frame",)).items() if not TRACKED.search(key)}


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


if __name__ == "__main__":
    sys.exit(main())
