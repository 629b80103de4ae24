"""Data set folders and configuration files of strangers: damage them, then run ``info`` and ``bag``."""

from __future__ import annotations

import contextlib
import io
import os
import random
import re
import shutil
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.torture.worker import Outcome, Worker
from tests.support import bags, datasets

SLOW = 30.0  # seconds of processor time for one command, above which a case has failed
MEMORY = 2000.0  # MB for one command, above which a case has failed
SPARSE = (1 << 27, 1 << 31, 1 << 40)  # bytes of files that take no disk
NUMBERS = (
    *("nan", "inf", "-inf", "-1", "0", "1e308", "1e-308", "9" * 5000, "0x" + "f" * 5000, "4294967296"),
    *("9223372036854775808", "-9223372036854775809", "1e19", "²", "", "true", "null", "[]", "{}", "~", "'"),
)
NAMES = (
    "\x1b[2J",
    "a\nb",
    "²",
    "99999999999999999999",
    "9" * 200,
    "-1",
    "#?%&",
    "..",
    "ü",
    "\udcff",
    " ",
    "0",
)
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")


# --- sound folders -----------------------------------------------------------------------------


def plain(root: Path) -> Path:
    """Two LiDARs in different formats, a camera, and all files that may lie beside."""
    (root / "front").mkdir()
    (root / "rear").mkdir()
    for i in range(3):
        points = datasets.scan(i)
        np.save(root / f"front/{i:06d}.npy", points)
        points = points[:60]
        if i == 0:
            head = "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
            head += (
                f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n"
            )
            (root / f"rear/{i:06d}.pcd").write_bytes(head.encode() + points.tobytes())
        elif i == 1:
            head = (
                f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\n"
            )
            rows = "\n".join(" ".join(map(str, row)) for row in points[:, :3].tolist())
            (root / f"rear/{i:06d}.ply").write_text(f"{head}property float z\nend_header\n{rows}\n")
        else:
            head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
            head += (
                f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA ascii\n"
            )
            rows = "\n".join(" ".join(map(str, row)) for row in points[:, :3].tolist())
            (root / f"rear/{i:06d}.pcd").write_text(f"{head}{rows}\n")
        datasets.image(root / f"camera/{i:06d}.png", 50 * i)
    (root / "calibration.yaml").write_text(
        "rate: 10\nfields: [x, y, z, intensity]\nlidars:\n  front: {pose: [0, 0, 1.8, 0, 0, 0, 1]}\n"
        "  rear: {pose: [-1, 0, 1.8, 0, 0, 0, 1]}\ncameras:\n"
        "  camera:\n    K: [72, 0, 61, 0, 72, 17, 0, 0, 1]\n"
        "    size: [124, 38]\n    D: [0.1, 0, 0, 0]\n    pose: [0.2, 0, 1.5, -0.5, 0.5, -0.5, 0.5]\n"
    )
    files = [file for file in sorted(root.rglob("0*")) if file.is_file()]
    (root / "stamps.csv").write_text(
        "file,stamp\n" + "".join(f"{f.relative_to(root)},{1700000000 + int(f.stem)}.5\n" for f in files)
    )
    (root / "poses.txt").write_text("".join(f"{1700000000 + i} {i} 0 0 0 0 0 1\n" for i in range(4)))
    return root


def kitti_tracking(root: Path) -> Path:
    datasets.kitti_tracking(root)
    return root / "velodyne/0000"


FOLDERS: Mapping[str, Callable[[Path], Path]] = {
    "kitti-object": datasets.kitti_object,
    "kitti-raw": datasets.kitti_raw,
    "kitti-tracking": kitti_tracking,
    "kitti-odometry": lambda root: datasets.kitti_odometry(root, labels=False),
    "semantic-kitti": lambda root: datasets.kitti_odometry(root, labels=True),
    "nuscenes": datasets.nuscenes,
    "plain folder": plain,
}


# --- what is done to them ----------------------------------------------------------------------


def flipped(path: Path, rng: random.Random) -> None:
    """Change single bytes."""
    data = bytearray(path.read_bytes())
    for _ in range(rng.randrange(1, 9) if data else 0):
        data[rng.randrange(len(data))] = rng.choice((0, 10, 255, rng.randrange(256)))
    path.write_bytes(data)


def cut(path: Path, rng: random.Random) -> None:
    """Remove the end."""
    data = path.read_bytes()
    path.write_bytes(data[: rng.randrange(len(data))] if data else b"")


def noise(path: Path, rng: random.Random) -> None:
    """Replace the whole file by random bytes."""
    path.write_bytes(rng.randbytes(rng.randrange(1, 4000)))


def renumbered(path: Path, rng: random.Random) -> None:
    """Replace numbers of a text, or words of a binary file, by numbers that no sensor has."""
    data = path.read_bytes()
    try:
        text = data.decode()
    except UnicodeDecodeError:
        at = rng.randrange(0, max(1, len(data) - 8), 4)
        wrong = rng.choice((b"\0\0\xc0\x7f", b"\xff\xff\xff\xff", b"\xff\xff\x7f\x7f", b"\0\0\x80\x7f"))
        path.write_bytes(data[:at] + wrong * rng.choice((1, 1, 50)) + data[at + 4 :])
        return
    found = list(NUMBER.finditer(text))
    for match in sorted(rng.sample(found, min(len(found), rng.choice((1, 1, 3)))), key=lambda m: -m.start()):
        text = text[: match.start()] + rng.choice(NUMBERS) + text[match.end() :]
    path.write_bytes(text.encode("utf-8", "surrogateescape"))


def renamed_in_text(path: Path, rng: random.Random) -> None:
    """Replace a name in a text by one that leads elsewhere."""
    text = path.read_bytes().decode("utf-8", "replace")
    found = list(re.finditer(r"[A-Za-z_/][\w./-]*", text))
    if found:
        match = rng.choice(found)
        wrong = rng.choice(
            ("/etc/passwd", "../../../../etc/passwd", "/dev/zero", "\0", "x" * 5000, "&a [*a]")
        )
        path.write_text(text[: match.start()] + wrong + text[match.end() :])


def nested(path: Path, rng: random.Random) -> None:
    """Put thousands of brackets where a value was."""
    text = path.read_bytes().decode("utf-8", "replace")
    at = rng.randrange(len(text) + 1)
    path.write_text(text[:at] + rng.choice("[{(<") * rng.choice((2000, 200_000)) + text[at:])


def emptied(path: Path, rng: random.Random) -> None:
    path.write_bytes(b"")


def grown(path: Path, rng: random.Random) -> None:
    """Let a file claim far more bytes than there are on disk."""
    with path.open("r+b") as file:
        file.truncate(rng.choice(SPARSE))


def pipe(path: Path, rng: random.Random) -> None:
    path.unlink()
    os.mkfifo(path)


def sockets(path: Path, rng: random.Random) -> None:
    path.unlink()
    short = tempfile.mktemp()  # the name of a socket has 107 bytes at most
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(short)
    Path(short).replace(path)


def link(path: Path, rng: random.Random) -> None:
    """Replace a file by a link to nowhere, to a device, to itself or to a folder."""
    path.unlink()
    path.symlink_to(
        rng.choice(("/nowhere", "/dev/zero", "/dev/tty", "/dev/stdin", path.name, ".", "/proc/kmsg"))
    )


def folder_instead(path: Path, rng: random.Random) -> None:
    path.unlink()
    path.mkdir()


def removed(path: Path, rng: random.Random) -> None:
    path.unlink()


def renamed(path: Path, rng: random.Random) -> None:
    """Give a file, or the folder that it is in, a name that nobody expects."""
    place = path if rng.random() < 0.7 else path.parent
    name = rng.choice(NAMES) if rng.random() < 0.5 else f"{rng.choice(NAMES)}{place.suffix}"
    with contextlib.suppress(OSError):
        place.rename(place.with_name(name))


def bomb(path: Path, rng: random.Random) -> None:
    """Replace a scan or an image by one whose header claims far more than the file has; others are nested."""
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 {count}\n"
    head += "WIDTH {n}\nHEIGHT 1\nPOINTS {n}\n"
    n = rng.choice((10**12, -1, 99_999_999, 2**63, 0))
    match path.suffix:
        case ".pcd":
            kind = rng.choice(("binary", "ascii", "binary_compressed"))
            text = head.format(n=n, count=rng.choice((1, 1, 10**9, -1)))
            body = rng.choice((b"\xff\xff\xff\x7f", b"\x10\0\0\0")) * 2 + bytes(64)
            path.write_bytes(f"{text}DATA {kind}\n".encode() + body)
        case ".ply":
            kind = rng.choice(("ascii", "binary_little_endian"))
            text = f"ply\nformat {kind} 1.0\nelement face {rng.choice((0, 10**15))}\nproperty float q\n"
            text += f"element vertex {n}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
            path.write_bytes(text.encode() + bytes(64))
        case ".npy":
            text = str({"descr": "<f4", "fortran_order": False, "shape": (abs(n), 4)}).ljust(117) + "\n"
            path.write_bytes(
                b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + bytes(64)
            )
        case ".png" | ".jpg":
            from benchmarks.torture.fuzz import png

            path.write_bytes(png(rng.choice((9_000, 60_000, 2**31 - 1))))
        case _:
            nested(path, rng)


Change = Callable[[Path, random.Random], None]
CHANGES: Sequence[Change] = (
    *(flipped, cut, noise, renumbered, renumbered, renumbered, renamed_in_text, nested, emptied, grown),
    *(pipe, sockets, link, folder_instead, removed, renamed, bomb),
)


def damage(root: Path, rng: random.Random) -> str:
    """Damage one file of a folder, two or three in some cases. Texts are chosen as often as sensor data.

    Returns:
        What was done to which file.
    """
    done = []
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        files = sorted(file for file in root.rglob("*") if file.is_file() and not file.is_symlink())
        files = [file for file in files if file.stat().st_size < min(SPARSE)]
        texts = [
            f for f in files if f.suffix in (".txt", ".csv", ".yaml", ".json", ".xml", ".toml", ".label")
        ]
        chosen = texts if texts and rng.random() < 0.6 else files
        if not chosen:
            break
        file, change = rng.choice(chosen), rng.choice(CHANGES)
        done.append(f"{change.__name__} {file.relative_to(root)}")
        change(file, rng)
    return ", ".join(done)


# --- project files -----------------------------------------------------------------------------

PROJECT = """model = ""
config = "robot.yaml"
preset = "default"
voxel_size = "3 cm"
[source]
lidar_topics = ["/points"]
[clustering]
eps = "60 cm"
min_points = 20
[bev]
range_x = 12.5
"""
ROBOT = """clustering: {eps: 0.9, min_points: 7}
voxel:
  size: 0.05
detector:
  names: names.txt
bev: {range_x: 20, resolution: 5 cm}
fusion:
  match_radius: 120
"""
VALUES = (
    *(
        "9" * 5000,
        "0x" + "f" * 5000,
        "nan",
        "inf",
        "-1",
        "1e999",
        "[" * 3000,
        "{a={a=1}}",
        "'" * 3,
        "2001-99-99",
    ),
    *('"/dev/zero"', '"/dev/stdin"', '"pipe"', '"."', '"../../../etc/passwd"', '"\\u0000"', "true", "[[[]]]"),
    *(
        "&a [*a, *a]",
        "!!python/object:os.system x",
        "*b",
        "? x",
        "{? {a: b}: c}",
        "<<: *a",
        "!!binary =",
        "1:2:3",
    ),
)
BOMBS = (
    "a." * 100_000 + "a = 1\n",
    "[" + "a." * 100_000 + "a]\n",
    "x = " + "[" * 100_000 + "\n",
    'config = "/dev/zero"\n',
    'config = ["pipe", "robot.yaml"]\n',
    'config = "bevviz.toml"\n',
    'model = "/dev/zero"\n',
    'model = "pipe"\n',
    "x" * 2_000_000,
    "#" * 900_000,
    "".join(f"k{i} = {i}\n" for i in range(40_000)),
    "".join(f"[clustering.k{i}]\n" for i in range(20_000)),
    datasets.LAUGHS,
    datasets.LAUGHS + "voxel: {size: *a11}\n",
    datasets.LAUGHS + "source: {lidar_topics: *a11}\n",
    "\n".join(" " * i + "a:" for i in range(1400)),
    "? " * 100_000,
    "- " * 100_000,
    "voxel: {size: 1" + "_" * 100_000 + "}\n",
    "voxel: {size: 0b" + "1" * 100_000 + "}\n",
    "'" * 100_000,
    "&a " * 50_000,
)


def project(root: Path, rng: random.Random) -> str:
    """Write a damaged ``bevviz.toml`` and a damaged configuration into a folder with a drive."""
    (root / "bevviz.toml").write_text(PROJECT)
    (root / "robot.yaml").write_text(ROBOT)
    (root / "names.txt").write_text("car\nperson\n")
    if not (root / "pipe").exists():
        os.mkfifo(root / "pipe")
    file = root / rng.choice(("bevviz.toml", "robot.yaml", "robot.yaml", "bevviz.toml", "names.txt"))
    kind = rng.randrange(4)
    if kind == 0:
        content = rng.choice(BOMBS)
        file.write_text(content)
        return f"{content[:40]!r} in {file.name}"
    if kind == 1:
        lines = file.read_text().splitlines()
        at = rng.randrange(len(lines))
        key, separator, _ = re.split(r"([=:])", f"{lines[at]}=", maxsplit=1)
        value = rng.choice(VALUES)
        lines[at] = f"{key}{separator} {value}"
        file.write_text("\n".join(lines) + "\n")
        return f"{key}{separator} {value[:40]} in {file.name}"
    change = rng.choice([change for change in CHANGES if change not in (bomb, renamed)])
    change(file, rng)
    return f"{change.__name__} {file.name}"


# --- the trial ---------------------------------------------------------------------------------


@dataclass
class Tally:
    """Result of the folders of one kind."""

    cases: int = 0
    read: int = 0  # commands that ended with status 0, or with 1 and the line that there are no frames
    refused: int = 0  # commands that ended with one clear line
    failed: int = 0  # commands that ended otherwise: a traceback, status 3, several lines
    warned: int = 0  # commands in which NumPy warns of a number beyond all measure
    hangs: int = 0  # commands that took longer than ``SLOW``, or did not end
    large: int = 0  # cases that took more than ``MEMORY``
    slowest: float = 0.0  # seconds
    memory: float = 0.0  # MB
    examples: list[str] = field(default_factory=list)

    def __iadd__(self, other: Tally) -> Tally:
        for name in ("cases", "read", "refused", "failed", "warned", "hangs", "large"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.slowest, self.memory = max(self.slowest, other.slowest), max(self.memory, other.memory)
        self.examples += other.examples
        return self

    @property
    def well(self) -> bool:
        return not (self.failed or self.hangs or self.large)


def run_commands(case: tuple[Path, Sequence[Sequence[str]]]) -> Outcome:
    """Run commands in a folder. ``said`` has for each its status, its seconds and its last lines."""
    from bevviz.cli import main

    folder, commands = case
    outcome, before = Outcome(), Path.cwd()
    os.chdir(folder)
    try:
        for command in commands:
            out, err = io.StringIO(), io.StringIO()
            start = time.process_time()  # a busy machine is no fault of the command
            try:
                with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                    try:
                        status: object = main(list(command))
                    except SystemExit as ended:
                        status = ended.code
            except Exception:
                outcome.traceback += traceback.format_exc()
                status = "a traceback"
            took = time.process_time() - start
            warned = int("RuntimeWarning:" in err.getvalue())
            outcome.said.append(f"{status}\t{took:.1f}\t{warned}\t{_wrong(status, err.getvalue())}")
    finally:
        os.chdir(before)
    return outcome


def _wrong(status: object, errors: str) -> str:
    """Say what is wrong with how a command ended; "": nothing."""
    lines = [line for line in errors.splitlines() if line.strip()]
    told = [line for line in lines if line.startswith("bevviz: error")]
    if status == 1 and any("0 frames" in line for line in lines):
        return ""  # as documented: nothing was made, and that is said
    if status not in (0, 2):
        return f"status {status}: {' '.join(lines)[-400:]}"
    if status == 2 and len(told) != 1:
        return f"{len(told)} lines of an error: {' '.join(lines)[-400:]}"
    if any(re.match(r"Traceback|  File ", line) for line in errors.splitlines()):
        return f"a traceback: {' '.join(lines)[-400:]}"
    return ""


def run(seed: int, cases: int, names: Sequence[str] = (*FOLDERS, "project")) -> Iterator[tuple[str, Tally]]:
    """Damage ``cases`` folders, by turns of each kind, and as many project files; yields a tally for each."""
    each = -(-cases // len(FOLDERS))
    with tempfile.TemporaryDirectory(prefix="bevviz-torture-") as folder, Worker() as worker:
        for position, name in enumerate(names):
            base = Path(folder) / str(position)
            base.mkdir()
            total, count = Tally(), cases if name == "project" else each
            for number in tqdm(range(count), unit="case", desc=name, disable=None):
                rng = random.Random(f"{seed} {name} {number}")
                trial = base / "trial"
                trial.mkdir()
                what, commands = _prepared(name, trial, rng)
                tally = judged(f"{name}, {number}, {what}", worker, trial, commands)
                for example in tally.examples:
                    tqdm.write(example, file=sys.stderr)
                total += tally
                shutil.rmtree(trial)
            yield name, total


def _prepared(name: str, trial: Path, rng: random.Random) -> tuple[str, list[list[str]]]:
    """Make the case that belongs to a number: what was done to it, and the commands that read it."""
    if name == "project":
        bags.write(trial / "drive", bags.small_items(scans=2, points=60))
        what = project(trial, rng)
        given = ["--config", "robot.yaml"] if rng.random() < 0.5 else []
        return what, [
            ["info", "drive", *given],
            ["bag", "drive", *given, "--save", "out.rrd"],
            ["config", *given],
        ]
    (trial / "set").mkdir()
    path = FOLDERS[name](trial / "set")
    what = damage(trial / "set", rng)
    given = [str(path.relative_to(trial))]
    given += ["--set", "source.sequence=scene-0061"] if name == "nuscenes" and rng.random() < 0.5 else []
    given += ["--set", "source.dataset=folder"] if rng.random() < 0.1 else []
    return what, [["info", *given], ["bag", *given, "--save", "out.rrd"]]


def judged(what: str, worker: Worker, folder: Path, commands: Sequence[Sequence[str]]) -> Tally:
    """Run the commands of one case, and judge how they ended."""
    outcome = worker.do(run_commands, (folder, commands))
    tally = Tally(cases=1, memory=outcome.memory)
    if outcome.hung or (outcome.traceback and not outcome.said):
        tally.hangs, tally.failed = int(outcome.hung), int(not outcome.hung)
        tally.examples.append(f"{what}: {'a hang' if outcome.hung else outcome.traceback}")
        return tally
    if outcome.memory > MEMORY:
        tally.large = 1
        tally.examples.append(f"{what}: {outcome.memory:.0f} MB")
    for command, said in zip(commands, outcome.said, strict=True):
        status, took, warned, wrong = said.split("\t", 3)
        tally.warned += int(warned)
        tally.slowest = max(tally.slowest, float(took))
        if float(took) > SLOW:
            tally.hangs += 1
            wrong = f"{took} s"
        elif wrong:
            tally.failed += 1
        else:
            tally.read += int(status in ("0", "1"))
            tally.refused += int(status == "2")
        if wrong:
            last = outcome.traceback.strip().splitlines()[-1:]
            tally.examples.append(f"{what}: {command[0]}: {' '.join([wrong, *last])}")
    return tally


HEAD = (
    "| kind | cases | read | refused in one line | failed | warnings of NumPy | hangs | slowest, s "
    "| memory, MB |\n| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
)


def row(name: str, tally: Tally) -> str:
    return (
        f"| {name} | {tally.cases} | {tally.read} | {tally.refused} | {tally.failed} "
        f"| {tally.warned} | {tally.hangs} | {tally.slowest:.1f} | {tally.memory:.0f} |"
    )
