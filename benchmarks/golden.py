"""Check that a change of the code changes no result.

``python -m benchmarks.golden WORK --write FOLDER`` asks the program about bags and drives in every way that a
user can, and writes the results to one file for each area: FOLDER/why.json and so on. ``--check FOLDER`` asks
again and names each result that differs, with both values where these can be read. A change on purpose is a
difference of such a file, to be read before it replaces the old one. ``--code TREE`` runs another checkout's
code. The bags stay in WORK, so that both runs read the same bytes.

A recording is hashed entity by entity: its values in order of time, however they are cut into chunks. Stage
times, memory, and what the clock of the machine decides are left out.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import urlsplit

import pyarrow as pa
import pyarrow.parquet as pq
from rerun.chunk import RrdReader
from websockets.sync.client import connect
from websockets.typing import Origin

HERE = Path(__file__).resolve().parents[1]
# The tree whose code runs. What is imported of it is imported later, in functions.
ROOT = Path(sys.argv[sys.argv.index("--code") + 1]).resolve() if "--code" in sys.argv else HERE
DATA = Path(os.environ.get("BEVVIZ_DATA") or HERE.parent / "shared/data")
FRAMES = 12  # of each drive: enough for tracks, anomalies and a pause between two images
CLICKS = 200
LIMIT = 600.0  # seconds that one command may take
VOLATILE = re.compile(
    r"(/b)?/health/(time|rate|stages|memory|process|latency)|^/(__properties|explain/log)|/ms$"
)
TRACKED = re.compile(r"track|trail|/world/fused|/clusters")  # depends on the clock in a live run
# Keys that depend on the machine, the clock or the place of a file.
UNSTABLE_KEYS = {
    *("milliseconds", "seconds", "ms", "times", "took", "run", "machine", "memory", "network", "created"),
    *(
        "file",
        "files",
        "path",
        "paths",
        "batch",
        "bag",
        "bags",
        "command",
        "commands",
        "version",
        "versions",
        "python",
    ),
}
READABLE = 160  # characters of a value that is stored as it is; a longer one is hashed
# Values that many drives are wrong with: what is explained must be more than the defaults' few misses.
MISTUNED = ("clustering.eps=0.9", "ground.distance_threshold=0.45", "detector.conf_threshold=0.4")

Results: TypeAlias = dict[str, Any]  # name of a result: its value, or the hash of a large one
Step: TypeAlias = Callable[[], Results]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path, help="folder for bags and recordings; kept")
    group = parser.add_mutually_exclusive_group(required=True)
    group.add_argument("--write", type=Path, metavar="FOLDER", help="store the results of this run")
    group.add_argument("--check", type=Path, metavar="FOLDER", help="compare this run with stored results")
    parser.add_argument("--only", default="", metavar="AREA", help="only this area, or steps with this text")
    parser.add_argument("--code", metavar="TREE", help="checkout whose code is run (default: this one)")
    options = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    options.work.mkdir(parents=True, exist_ok=True)
    os.environ["NO_COLOR"] = "1"
    # A store that outlived a run would answer for the code that is checked.
    with tempfile.TemporaryDirectory() as store:
        os.environ["BEVVIZ_STORE"] = store
        return _compare(options)


def _compare(options: argparse.Namespace) -> int:
    """Run the chosen steps; write their results, or name those that differ."""
    _drive("demo mcap", options.work.resolve())
    folder = options.write or options.check
    folder.mkdir(parents=True, exist_ok=True)
    different = equal = 0
    for area, steps in _areas(options.work.resolve()).items():
        chosen = {n: s for n, s in steps.items() if options.only in area or options.only in f"{area} {n}"}
        if not chosen:
            continue
        path, found = folder / f"{area}.json", {}
        for name, step in chosen.items():
            start = time.monotonic()
            found[name] = step()
            print(f"{time.monotonic() - start:6.1f} s  {area}: {name}", flush=True)
        if options.write:
            stored = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
            path.write_text(json.dumps(stored | found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
            continue
        expected = json.loads(path.read_text(encoding="utf-8"))
        for name, results in found.items():
            for key in sorted({*expected.get(name, {}), *results}):
                old, new = expected.get(name, {}).get(key), results.get(key)
                if old == new:
                    equal += 1
                else:
                    different += 1
                    print(f"          {area}: {name}: {key}: {old!r} -> {new!r}", flush=True)
    if options.check:
        print(f"{equal} results are equal, {different} differ")
    return 1 if different else 0


def _areas(work: Path) -> dict[str, dict[str, Step]]:
    """Return the steps of each area by name, in the order in which they run."""
    model = ("--model", str(DATA / "models/yolox_nano.onnx"))
    bags: dict[str, Step] = {}
    why: dict[str, Step] = {}
    for name in DRIVES:
        network = ("--model", "demo") if name.startswith("demo") else model
        several = name in ("demo mcap", "kitti object", "kitti drive")
        for preset in ("default", "reference") if several else ("default",):
            options = [*network, "--preset", preset, "--frames", f":{FRAMES}"]
            bags[f"bag {name} {preset}"] = partial(_of, name, work, partial(_recording, "bag"), options)
        bags[f"info {name}"] = partial(_of, name, work, partial(_json, "info"), ())
        why[name] = partial(_of, name, work, _why, [*network, "--at-frame", "3"])
    variants = {"default": (), "reference": ("--preset", "reference"), "mistuned": _settings(MISTUNED)}
    for variant, settings in variants.items():
        options = ["--model", "demo", *settings]
        why[f"street 0 {variant}"] = partial(_of, "demo mcap", work, partial(_why_frames, (5, 20)), options)
        for seed in (1, 2):
            why[f"street {seed} {variant}"] = partial(_why_street, seed, options, work)
        for name, numbers in (("kitti", range(0, 12, 3)), ("sus", range(4))):
            arguments = [str(DATA / name), *model, *settings]
            why[f"{name} {variant}"] = partial(_why_frames, numbers, arguments, work)
    demo = [str(work / "demo.mcap"), "--model", "demo", "--frames", f":{FRAMES}"]
    kitti = [str(DATA / "kitti"), *model]
    change = ["--set-b", "clustering.eps=0.8"]
    return {
        "bags": bags,
        "why": why,
        "commands": {
            "evaluate demo": lambda: _json("evaluate", demo, work),
            "evaluate kitti": lambda: _json("evaluate", kitti, work),
            "compare demo": lambda: _json("compare", [*demo, *change], work),
            "compare kitti": lambda: _json("compare", [*kitti, *change], work),
            "compare recording": lambda: _recording("compare", [*demo, *change], work),
            "evaluate recording": lambda: _recording("evaluate", demo, work),
            "sweep demo": lambda: _json("sweep", [*demo, "--set", "clustering.eps=0.4:0.6:0.1"], work),
            "calib demo": lambda: _json("calib", [str(work / "demo.mcap"), "--frames", f":{FRAMES}"], work),
            "keep demo": lambda: _recording("bag", [*demo, "--keep", "inspect"], work),
        },
        "findings": {"batch": lambda: _batch(work)},
        "report": {"demo": lambda: _report([str(work / "demo.mcap"), "--model", "demo"], work)},
        "entities": {
            "bag": lambda: _entities("bag", demo, work),
            "why": lambda: _entities("why", [*demo[:3], "--at-frame", "5"], work),
            "compare": lambda: _entities("compare", [*demo, *change], work),
            "evaluate": lambda: _entities("evaluate", demo, work),
        },
        "page": {"demo": lambda: _clicks([str(work / "demo.mcap")], work)},
        "live": {"demo": lambda: _live(work)},
    }


def _of(
    name: str, work: Path, step: Callable[[Sequence[str], Path], Results], options: Sequence[str]
) -> Results:
    """Run a step over a drive that is made when it is needed."""
    return step([*_drive(name, work), *options], work)


def _why_street(seed: int, options: Sequence[str], work: Path) -> Results:
    return _why_frames((2, 7), [str(_simulated(work, seed)), *options], work)


def _settings(values: Sequence[str]) -> tuple[str, ...]:
    return tuple(word for value in values for word in ("--set", value))


# --- drives ------------------------------------------------------------------------------------


CONTAINERS = {
    "demo sqlite": ("sqlite", "--dst-storage", "sqlite3"),
    "demo sqlite zstd": (
        *("sqlite_zstd", "--dst-storage", "sqlite3"),
        *("--compress", "zstd", "--compress-mode", "message"),
    ),
    "demo mcap zstd": (
        *("mcap_zstd", "--dst-storage", "mcap"),
        *("--compress", "zstd", "--compress-mode", "storage"),
    ),
    "demo ros1": ("demo.bag", "--dst-typestore", "ros1_noetic"),
}
MADE = ("kitti_raw", "kitti_tracking", "kitti_odometry")
DRIVES = (
    *("demo mcap", *CONTAINERS, "demo cut", "demo nuscenes"),
    *(f"made {name}" for name in MADE),
    *("kitti object", "kitti drive"),
)


def _drive(name: str, work: Path) -> list[str]:
    """Return the arguments that name a drive; make the drive if WORK lacks it."""
    if name.startswith("kitti "):
        return [str(DATA / ("kitti_drive" if name == "kitti drive" else "kitti"))]
    if name.startswith("made "):
        from tests.support import datasets

        kind = name.removeprefix("made ")
        root = work / kind
        if not root.exists():
            root.mkdir()
            getattr(datasets, kind)(root)
        place = root / "2011_09_26" if kind == "kitti_raw" else root
        return [str(place), *(("--sequence", "0000") if kind == "kitti_tracking" else ())]
    demo = work / "demo.mcap"
    if not demo.exists():
        _make(["demo", "--frames", "40", "--plant", "flat_car", "--weave", "-o", str(demo)], demo)
    if name in CONTAINERS:
        target, *options = CONTAINERS[name]
        return [str(_convert(demo, work / target, options))]
    if name == "demo cut":
        cut = work / "cut.mcap"
        if not cut.exists():
            cut.write_bytes(demo.read_bytes()[: demo.stat().st_size * 2 // 3])
        return [str(cut)]
    if name == "demo nuscenes":
        folder = work / "export"
        if not folder.exists():
            _make(["export", str(demo), "--model", "demo", "--format", "nuscenes", "-o", "export"], folder)
        return [str(folder)]
    return [str(demo)]


def _make(arguments: Sequence[str], target: Path) -> None:
    """Run a command that makes a drive, and end the check if it makes none."""
    printed = _run(arguments, target.parent)
    if not target.exists():
        sys.exit(f"{target} is missing and this code cannot make it: {printed[-500:]}")


def _simulated(work: Path, seed: int) -> Path:
    """Return a drive of another street; make it if it is not there."""
    path = work / f"street_{seed}.mcap"
    if not path.exists():
        options = ["--frames", "10", "--seed", str(seed), "--plant", "small_child"]
        _make(["demo", *options, "-o", str(path)], path)
    return path


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
    """Run a command of ``bevviz`` in this process and return what it prints on standard output."""
    from bevviz.cli import main as bevviz

    output, errors = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder), redirect_stdout(output), redirect_stderr(errors):
        try:
            status = bevviz([*arguments])
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 3
    # A gate that fails ends with 1 and prints its result all the same.
    if status not in (0, 1) or (status == 1 and not output.getvalue()):
        return f"status {status}: {errors.getvalue()[-2000:]}"
    return output.getvalue()


def _tree(command: str, arguments: Sequence[str], folder: Path) -> Any:
    """Return the JSON of a command, or its text where that is none."""
    text = _run([command, *arguments, "--json"], folder)
    try:
        return _stable(json.loads(text))
    except ValueError:
        return {"text": text}


def _json(command: str, arguments: Sequence[str], folder: Path) -> Results:
    """Return each value of a command's JSON by its path."""
    return dict(_flat(_tree(command, arguments, folder)))


def _why(arguments: Sequence[str], folder: Path) -> Results:
    """Return the verdict, chain and hints of every object of a frame."""
    tree = _tree("why", [*arguments, "--all"], folder)
    results = {"summary": tree.get("summary", tree.get("text"))}
    known: Counter[str] = Counter()
    for answer in tree.get("answers", []):
        known[answer["name"]] += 1
        name = f"{answer['name']} #{known[answer['name']]}"
        results[name] = f"{answer['reason']}: {answer['verdict']}"
        results[f"{name} chain"] = [f"{step['stage']}: {step['text']}" for step in answer["chain"]]
        results[f"{name} hints"] = [hint.get("set", hint.get("settings")) for hint in answer["hints"]]
    return results


def _why_frames(numbers: Sequence[int], arguments: Sequence[str], folder: Path) -> Results:
    results: Results = {}
    for number in numbers:
        found = _why([*arguments, "--at-frame", str(number)], folder)
        results |= {f"frame {number}: {key}": value for key, value in found.items()}
    return results


def _batch(work: Path) -> Results:
    """Return the tables of a batch over three drives, and the causes that it finds."""
    bags, runs = work / "batch", work / "runs"
    bags.mkdir(exist_ok=True)
    for path in (work / "demo.mcap", work / "street_1.mcap", work / "street_2.mcap"):
        if not (bags / path.name).exists():
            (bags / path.name).symlink_to(path)
    _run(["batch", str(bags), "-o", str(runs), "--model", "demo", "--jobs", "1", "--force"], work)
    results: Results = {}
    for name in ("summary.parquet", "findings.parquet"):
        table = pq.read_table(runs / name)
        for column in table.column_names:
            if not re.search(r"ms$|seconds|time|memory|path|file|run", column):
                results[f"{name} {column}"] = _brief(table.column(column).to_pylist())
    return results | {f"causes {k}": v for k, v in _json("causes", [str(runs)], work).items()}


def _report(arguments: Sequence[str], work: Path) -> Results:
    """Return the text of a report's page, without what names the machine, and the digest of its recording."""
    path = work / "report.rrd"
    _run(
        [
            "report",
            *arguments,
            "--at",
            "1.0",
            "--before",
            "0.5",
            "--after",
            "0.5",
            "--force",
            "-o",
            str(path),
        ],
        work,
    )
    if not path.exists():
        return {"report": "none"}
    page = path.with_suffix(".html").read_text(encoding="utf-8")
    text = re.sub(r"<(style|script)\b.*?</\1>|<[^>]+>|data:[^\"]+", " ", page, flags=re.DOTALL)
    unstable = re.compile(r"bevviz [\d.]|/|\d ms|GB|MB|Python|Linux|sha|[0-9a-f]{12}|cores?\b|checkout")
    sentences = (line.strip() for line in text.splitlines() if len(line.split()) > 3)
    results: Results = dict(Counter(line for line in sentences if not unstable.search(line)))
    return results | {f"recording {key}": value for key, value in digest(path).items()}


def _flat(tree: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of a JSON tree by their path; long lists are hashed."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from _flat(value, f"{name}.{key}" if name else str(key))
    elif isinstance(tree, list) and any(isinstance(value, dict | list) for value in tree) and len(tree) <= 60:
        for number, value in enumerate(tree):
            yield from _flat(value, f"{name}[{number}]")
    else:
        yield name, _brief(tree)


def _brief(value: Any) -> Any:
    """Return a value that can be read, or the hash of a long one."""
    text = json.dumps(value, sort_keys=True, default=str)
    return value if len(text) <= READABLE and not isinstance(value, bytes) else _hash(text.encode())


def _stable(tree: Any) -> Any:
    """Return a JSON tree without the keys that depend on the machine."""
    if isinstance(tree, dict):
        return {
            key: _stable(value)
            for key, value in tree.items()
            if key not in UNSTABLE_KEYS and not key.endswith(" ms")
        }
    return [_stable(value) for value in tree] if isinstance(tree, list) else tree


def _recording(command: str, arguments: Sequence[str], folder: Path) -> Results:
    path = folder / "result.rrd"
    path.unlink(missing_ok=True)
    said = _run([command, *arguments, "--save", str(path)], folder)
    return digest(path) if path.exists() else {"no recording": said}


def _entities(command: str, arguments: Sequence[str], folder: Path) -> Results:
    """Return the components and their Arrow types of each entity of a recording."""
    path = folder / "result.rrd"
    path.unlink(missing_ok=True)
    _run([command, *arguments, "--save", str(path)], folder)
    kinds: dict[str, set[str]] = defaultdict(set)
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for field in batch.schema:
            if field.name not in chunk.timeline_names and not field.name.startswith("rerun.controls"):
                kinds[chunk.entity_path].add(f"{field.name}: {field.type}")
    return {entity: sorted(names) for entity, names in sorted(kinds.items())}


# --- recordings --------------------------------------------------------------------------------


def digest(recording: Path, timelines: Sequence[str] = ("frame", "stamp")) -> Results:
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


def _clicks(drive: Sequence[str], folder: Path) -> Results:
    """Ask the page's questions over its socket: the list, and clicks on rows and places of all frames."""
    results: Results = {}
    with _serving(drive, folder) as address:
        parts = urlsplit(address)
        url, origin = f"ws://{parts.netloc}/talk?&{parts.query}", Origin(f"http://{parts.netloc}")
        with connect(url, origin=origin, max_size=None) as talk:
            talk.send(json.dumps({"id": 0, "type": "shown"}))
            entries: dict[int, Any] = {}
            stamps: set[int] = set()
            over = False
            while not over:
                message = json.loads(talk.recv(timeout=LIMIT))
                if message["type"] == "entries":
                    for entry in message["entries"]:
                        known = entries.setdefault(entry["number"], {**entry, "sights": []})
                        known["sights"] += entry["sights"]
                if message["type"] == "frames":
                    stamps |= {int(frame["stamp"]) for frame in message["frames"]}
                over = message["type"] == "progress" and message["over"]
            rows = [
                f"{entry['what']} {_brief(_stable({k: v for k, v in entry.items() if k != 'sights'}))}"
                for entry in entries.values()
            ]
            results["list"] = sorted(rows)
            asked = [
                (int(sight["stamp"]), sight["pick"])
                for entry in entries.values()
                for sight in entry["sights"]
                if sight["pick"]
            ]
            picks = sorted(set(asked))[: CLICKS // 2]
            places = [f"pixel/zed/{60 + 53 * n % 540},{120 + 29 * n % 160}" for n in range(CLICKS)]
            places += [f"point//{4 + 3 * n % 25},{n % 13 - 6},-1" for n in range(CLICKS)]
            places += [f"cell//{37 * n % 400},{53 * n % 400}" for n in range(CLICKS)]
            ordered = sorted(stamps)
            while len(picks) < CLICKS:
                number = len(picks)
                picks.append((ordered[number % len(ordered)], places[number % 3 * CLICKS + number // 3]))
            for number, (stamp, pick) in enumerate(picks, 1):
                kind = "try" if number % 20 == 0 else "ask"
                settings = ["clustering.eps=0.8"] if kind == "try" else []
                talk.send(
                    json.dumps({"id": number, "type": kind, "time": stamp, "pick": pick, "set": settings})
                )
                wanted = ("tried",) if kind == "try" else ("answer", "nothing", "absent")
                message = json.loads(talk.recv(timeout=LIMIT))
                while message["type"] not in (*wanted, "error") or message.get("id") != number:
                    message = json.loads(talk.recv(timeout=LIMIT))
                said = message.get("verdict", message.get("text", message["type"]))
                results[f"{kind} {(stamp - ordered[0]) / 1e9:.1f} s {pick}"] = f"{said} {_hash_of(message)}"
    return results


def _hash_of(message: Any) -> str:
    """Return the hash of a message of the page without its number."""
    return _hash(json.dumps(_stable({**message, "id": 0}), sort_keys=True).encode())


def _live(folder: Path) -> Results:
    """Run the live path over replayed frames, slowly enough that none is dropped."""
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.extras.demo.drive import SyntheticSource
    from bevviz.live.run_outputs import Outputs
    from bevviz.live.runtime import Live
    from bevviz.live.status import Notes
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
