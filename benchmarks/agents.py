"""Agents without a language model: a client with fixed rules finds the causes of planted incidents.

The client talks to ``bevviz mcp`` over standard input and output. Its rules know no plant: they see the
answers of the server and, of some incidents, the complaint of a user (a class, a frame and a distance).

    python -m benchmarks.agents
"""

from __future__ import annotations

import argparse
import asyncio
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcp.shared.memory import create_connected_server_and_client_session

from bevviz.config import load
from bevviz.extras.demo.bag import BagWriter
from bevviz.extras.demo.drive import (
    CAMERA_INFO_TOPIC,
    IMAGE_TOPIC,
    ODOMETRY_TOPIC,
    PERIOD,
    START,
    SyntheticSource,
)
from bevviz.extras.demo.faults import FAULTS
from bevviz.extras.mcp.drives import AskedDrive
from bevviz.extras.mcp.server import make_server
from bevviz.extras.mcp.tools import AgentTools
from bevviz.model import geometry
from bevviz.model.frame import Frame
from tests.support.mcp_client import Client, connected

CALLS, BYTES, WANTED = 8, 12_000, 45
FRAMES = 12  # of a drive
BEGIN = 6  # frame from which a sensor is faulty
SEEDS = (1, 2)


# --- client ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Complaint:
    """What a user noticed: an object of a class at a distance was not reported in a frame."""

    frame: int
    label: str
    distance: float


HOPELESS = ("hidden", "no points", "out of view")
NO_PARAMETER = (*HOPELESS, "not detected", "detector not run")
NEAR = 20.0  # metres
ASKED = 3  # findings: three calls are left for comparisons and the calibration


async def conclude(client: Client, complaint: Complaint | None) -> str:
    """Find the cause by fixed rules: the recording, the sensors, then hints that hold in the whole drive."""
    overview = await client.ask("overview")
    if overview.get("warnings"):  # A fault of a sensor or clock can be the reason of what is missing.
        return f"sensor: {overview['warnings'][0]}"
    if overview.get("missing"):
        return f"missing: {overview['missing'][0]}"
    if complaint is not None:
        return await explain_complaint(client, complaint)
    found = await client.ask("findings")
    rows = found.get("findings", [])
    faults = [row for row in rows if row["kind"] == "anomaly" and row["name"] in ("sensor", "sync", "tf")]
    if faults:
        return f"sensor: {faults[0]['cause']}"
    for text in (*found.get("failures", ()), *found.get("warnings", ())):
        return f"sensor: {text}"
    return await confirmed(client, await best_settings(client, typical(rows)))


async def explain_complaint(client: Client, complaint: Complaint) -> str:
    """Ask about the object of a complaint."""
    answer = await client.ask("why", frame=complaint.frame, label=complaint.label)
    near = [
        one
        for one in (*answer.get("answers", ()), *answer.get("out_of_sight", ()))
        if one["distance"] is not None and abs(one["distance"] - complaint.distance) < 1
    ]
    if not near:
        return "nothing"
    one = min(near, key=lambda entry: abs(entry["distance"] - complaint.distance))
    if one["reason"] in HOPELESS or not one.get("hints"):
        return f"reason: {one['reason']}"
    return f"reason: {one['reason']}; parameter {key_of(one['hints'][0])}"


def typical(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return missed objects of the most frequent causes that a parameter may have, one of each in turn.

    Near objects come first, since any detector misses far ones.
    """
    missed = [row for row in rows if row["kind"] == "missed" and row["cause"] not in NO_PARAMETER]
    near = [row for row in missed if row["distance_m"] is not None and row["distance_m"] < NEAR]
    frames: Counter[str] = Counter()
    for row in near or missed:
        frames[row["cause"]] += row["frames"]
    nearest = sorted(near or missed, key=lambda row: (row["distance_m"] is None, row["distance_m"]))
    rounds: Counter[str] = Counter()
    turns = []
    for row in nearest:
        turns.append((rounds[row["cause"]], -frames[row["cause"]]))
        rounds[row["cause"]] += 1
    return [nearest[i] for i in sorted(range(len(turns)), key=turns.__getitem__)]


def key_of(hint: Mapping[str, Any]) -> str:
    """Return the parameter that a hint changes first."""
    return str(hint["settings"][0].partition("=")[0])


async def best_settings(client: Client, rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the hints of some findings: of one parameter first, those that fix most in their frame first."""
    gains: dict[tuple[str, ...], int] = {}
    for row in rows[:ASKED]:
        answer = await client.ask("why", frame=row["frame"], about=row["about"])
        for one in answer.get("answers", ())[:1]:
            for hint in one["hints"][:2]:
                gain = len(hint.get("fixed", ())) - len(hint.get("false", ())) - len(hint.get("right", ()))
                settings = tuple(hint["settings"])
                gains[settings] = max(gain, gains.get(settings, gain))
    return [
        list(settings) for settings, _ in sorted(gains.items(), key=lambda item: (len(item[0]), -item[1]))
    ]


async def confirmed(client: Client, settings: Sequence[list[str]]) -> str:
    """Compare the two best hints over the whole drive, and look at the calibration if none is clear."""
    best, most = "", 0
    for one in settings[:2]:
        tree = await client.ask("compare", settings_b=one)
        truth = tree.get("truth") or {}
        fixed = sum(c.get("fixed", 0) - c.get("broke", 0) for c in truth.get("classes", {}).values())
        wrong = truth.get("wrong", {"A": 0, "B": 0})
        if (gain := fixed - (wrong["B"] - wrong["A"])) > most:
            best, most = one[0].partition("=")[0], gain
        if most >= FRAMES:
            break
    if most < FRAMES or best.startswith("fusion."):
        calibration = await client.ask("calibration")
        for camera in calibration.get("cameras", ()):
            for name, axis in camera["axes"].items():
                if axis["finding"] == "off":
                    return f"calibration: {camera['camera']} {name}"
    return f"parameter {best}" if best else "nothing"


# --- incidents ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Incident:
    """A drive with something wrong.

    Attributes:
        name: of the plant.
        cause: pattern of the right conclusion.
        make: writes the bag.
        options: options of the server.
        complaint: what the user noticed. None: nothing in particular.
    """

    name: str
    cause: str
    make: Callable[[Path], None]
    options: tuple[str, ...] = ()
    complaint: Complaint | None = None


Edit = Callable[[list[Frame]], list[Frame]]
DECOYS = (
    "tracking.max_coast=0.8",
    "clustering.min_cluster_points=9",
    "fusion.max_depth=110",
    "bev.range_x=40",
)

UNSPLIT = "fusion.split=false"  # Fusion that splits clusters repairs what a clustering gets wrong.
PARAMETERS = {
    "detector.conf_threshold": ("0.9",),
    "detector.iou_threshold": ("0.01",),
    "clustering.eps": ("3", "0.12"),
    "clustering.min_points": ("80",),
    "clustering.min_cluster_points": ("400",),
    "clustering.max_cluster_points": ("60",),
    "fusion.min_points": ("300",),
    "fusion.min_iou": ("0.9",),
    "fusion.max_depth": ("8",),
    "fusion.min_rating": ("0.9",),
    "ground.distance_threshold": ("1.5",),
}


@cache
def rendered(
    seed: int, plant: str = "", weave: bool = False
) -> tuple[SyntheticSource, tuple[int, ...], list[Frame]]:
    """Return a source, and some of its frames around the time at which a plant is seen."""
    time_seen = FAULTS[plant].time if plant else FRAMES * PERIOD * 1e-9
    last = round(time_seen * 1e9 / PERIOD) + 2
    source = SyntheticSource(last + 1, seed, plant=[plant] if plant else [], weave=weave)
    numbers = tuple(range(max(0, last - FRAMES + 1), last + 1))
    return source, numbers, [source.snapshot(number).frame for number in numbers]


class _Writer(BagWriter):
    """Writer that leaves messages out."""

    def __init__(self, source: SyntheticSource, path: Path, keep: Callable[[str, int], bool]) -> None:
        super().__init__(source, path)
        self._keep = keep

    def _put(self, topic: str, received: int, message: Any) -> None:
        if self._keep(topic, received):
            super()._put(topic, received, message)


def writer(
    seed: int,
    edit: Edit = list,
    keep: Callable[[str, int], bool] = lambda topic, received: True,
    plant: str = "",
    camera_error: Any = None,
    weave: bool = False,
) -> Callable[[Path], None]:
    """Return a function that writes a changed drive."""

    def write(path: Path) -> None:
        source, _, frames = rendered(seed, plant, weave)
        if camera_error is not None:
            source = SyntheticSource(source.total, seed, weave=weave, camera_error=camera_error)
        with _Writer(source, path, keep) as bag:
            for frame in edit(frames):
                bag.write(frame)

    return write


def with_images(change: Callable[[list[Frame], int], Any]) -> Edit:
    """Change the pixels of the images from ``BEGIN`` on."""

    def edit(frames: list[Frame]) -> list[Frame]:
        edited = frames[:BEGIN]
        for i in range(BEGIN, len(frames)):
            camera = frames[i].cameras[0]
            assert camera.image is not None
            camera = replace(camera, image=replace(camera.image, bgr=change(frames, i)))
            edited.append(replace(frames[i], cameras=(camera,)))
        return edited

    return edit


def pixels(frames: Sequence[Frame], i: int) -> Any:
    image = frames[i].cameras[0].image
    assert image is not None
    return image.bgr


def with_scans(change: Callable[[list[Frame], int], Any]) -> Edit:
    """Change the clouds from ``BEGIN`` on. ``change`` returns points and their rows in the cloud."""

    def edit(frames: list[Frame]) -> list[Frame]:
        edited = frames[:BEGIN]
        for i in range(BEGIN, len(frames)):
            cloud, (xyz, rows, origin) = frames[i].clouds[0], change(frames, i)
            fields = {name: values[rows] for name, values in frames[origin].clouds[0].fields.items()}
            edited.append(replace(frames[i], clouds=(replace(cloud, xyz=xyz, fields=fields),)))
        return edited

    return edit


def blocked(frames: list[Frame], i: int) -> Any:
    xyz = frames[i].clouds[0].xyz
    azimuth = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))
    rows = np.flatnonzero((azimuth < -48) | (azimuth > -13))
    return xyz[rows], rows, i


def frozen_scan(frames: list[Frame], i: int) -> Any:
    xyz = frames[BEGIN - 1].clouds[0].xyz
    return xyz, np.arange(len(xyz)), BEGIN - 1


def turned_scan(frames: list[Frame], i: int) -> Any:
    xyz, turn = frames[i].clouds[0].xyz, turned(2, 6.0)
    return geometry.apply(turn, xyz).astype(np.float32), np.arange(len(xyz)), i


def turned(axis: int, degrees: float) -> Any:
    """Return the (4, 4) rotation about x, y or z."""
    quaternion = np.zeros(4)
    quaternion[axis], quaternion[3] = np.sin(np.radians(degrees) / 2), np.cos(np.radians(degrees) / 2)
    return geometry.transform(np.zeros(3), quaternion)


def late_images(seconds: float) -> Edit:
    """State the stamps of all images late."""

    def edit(frames: list[Frame]) -> list[Frame]:
        edited = []
        for frame in frames:
            camera = frame.cameras[0]
            assert camera.image is not None
            image = replace(camera.image, stamp=camera.image.stamp + round(seconds * 1e9))
            edited.append(replace(frame, cameras=(replace(camera, image=image),)))
        return edited

    return edit


def incidents(seeds: Sequence[int] = SEEDS) -> Iterator[Incident]:
    """Yield all incidents."""
    for seed in seeds:
        for key, wrong_values in PARAMETERS.items():
            for value in wrong_values:
                decoys = [decoy for decoy in DECOYS if not decoy.startswith(f"{key}=")]
                if key in ("clustering.eps", "clustering.min_points"):
                    decoys.append(UNSPLIT)
                options = tuple(word for s in (*decoys, f"{key}={value}") for word in ("--set", s))
                causes = [key, "fusion.split"] if UNSPLIT in decoys else [key]  # Either one repairs it.
                pattern = "|".join(map(re.escape, causes))
                yield Incident(f"{key}={value}", rf"parameter ({pattern})$", writer(seed), options)
        yield from sensor_incidents(seed)
        yield from scene_incidents(seed)


def sensor_incidents(seed: int) -> Iterator[Incident]:
    """Yield faults of sensors, clocks and transforms."""
    from_begin = START + BEGIN * PERIOD
    black = with_images(lambda frames, i: np.zeros_like(pixels(frames, i)))
    frozen = with_images(lambda frames, i: pixels(frames, BEGIN - 1))
    covered = with_images(lambda frames, i: np.full_like(pixels(frames, i), 110))
    yield Incident("black image", "sensor: .*zed.*black", writer(seed, black))
    yield Incident("frozen image", "sensor: .*zed.*frozen image", writer(seed, frozen))
    yield Incident("covered camera", "sensor: .*zed.*blank", writer(seed, covered))
    yield Incident("blocked sector", "sensor: .*rslidar.*blocked", writer(seed, with_scans(blocked)))
    yield Incident("frozen scan", "sensor: .*rslidar.*frozen", writer(seed, with_scans(frozen_scan)))
    no_images = writer(seed, keep=lambda topic, t: topic != IMAGE_TOPIC or t < from_begin)
    yield Incident("camera stops", "(sensor|missing): .*no image of camera 'zed'", no_images)
    no_static = writer(seed, keep=lambda topic, t: topic != "/tf_static")
    yield Incident("no static transforms", "missing: .*no transform", no_static)
    no_pose = writer(seed, keep=lambda topic, t: topic not in ("/tf", ODOMETRY_TOPIC))
    yield Incident("no pose", "missing: .*no fixed frame", no_pose)
    no_info = writer(seed, keep=lambda topic, t: topic != CAMERA_INFO_TOPIC)
    yield Incident("no camera info", "missing: .*no CameraInfo", no_info)
    yield Incident("clock of the camera", "sensor: .*its clock is", writer(seed, late_images(5.0)))


def scene_incidents(seed: int) -> Iterator[Incident]:
    """Yield scenes and wrong calibrations."""
    first = max(0, round(FAULTS["hidden_person"].time * 10) + 2 - FRAMES + 1)
    at = round(FAULTS["hidden_person"].time * 10) - first
    hidden = Complaint(at, "person", 17.1)
    yield Incident("hidden person", "reason: hidden", writer(seed, plant="hidden_person"), (), hidden)
    for axis, name, degrees in ((0, "rx", -2.0), (1, "ry", 2.0)):
        error = writer(seed, camera_error=turned(axis, degrees))
        yield Incident(f"camera turned about {name}", f"calibration: zed {name}", error)


@asynccontextmanager
async def in_process(path: str, *words: str) -> AsyncIterator[Client]:
    """Connect a client to a server of this process, for the words of the command line."""
    settings = ["detector.model=demo", *(word for word in words if "=" in word)]
    asked = AskedDrive.of([path, *words], [Path(path)], load(None, settings))
    server = make_server(AgentTools({"drive": lambda: asked}), writes=False)
    async with create_connected_server_and_client_session(server) as session:
        yield Client(session)
    asked.session.close()


Connect = Callable[..., AbstractAsyncContextManager[Client]]


# --- run ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What the client said about an incident."""

    incident: Incident
    conclusion: str
    calls: int
    largest: int
    seconds: float
    errors: tuple[str, ...]

    @property
    def right(self) -> bool:
        """Whether the conclusion names the planted cause, within the limits."""
        within = self.calls <= CALLS and self.largest <= BYTES
        return within and re.match(self.incident.cause, self.conclusion) is not None


async def investigate(incident: Incident, folder: Path, connect: Connect) -> Outcome:
    """Write the drive of an incident, and let the client find its cause."""
    path = folder / "drive.mcap"
    path.unlink(missing_ok=True)
    incident.make(path)
    start = time.perf_counter()
    async with connect(str(path), "--model", "demo", *incident.options) as client:
        conclusion = await conclude(client, incident.complaint)
        seconds = time.perf_counter() - start
        return Outcome(incident, conclusion, client.calls, client.largest, seconds, tuple(client.errors))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="incidents whose name has this text")
    parser.add_argument("--seeds", type=int, nargs="*", default=SEEDS, help="seeds of the drives")
    parser.add_argument("--in-process", action="store_true", help="servers in this process, which is faster")
    options = parser.parse_args()
    connect: Connect = in_process if options.in_process else connected
    outcomes = []
    chosen = [incident for incident in incidents(options.seeds) if re.search(options.only, incident.name)]
    with tempfile.TemporaryDirectory() as folder:
        for incident in chosen:
            outcome = asyncio.run(investigate(incident, Path(folder), connect))
            outcomes.append(outcome)
            mark = "right" if outcome.right else "WRONG"
            print(
                f"{mark}  {incident.name}: {outcome.conclusion[:120]} ({outcome.calls} calls, "
                f"{outcome.largest} bytes, {outcome.seconds:.0f} s) {' '.join(outcome.errors)[:200]}",
                flush=True,
            )
    right = sum(outcome.right for outcome in outcomes)
    print(f"{right} of {len(outcomes)} right")
    return 0 if right * 50 >= WANTED * len(outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
