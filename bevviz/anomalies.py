"""What is worth a look in a drive: flickers, jumps, what one sensor alone sees, clocks, transforms.

Plain rules over the results of consecutive frames; their limits are the section ``anomalies``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from bevviz.config import AnomaliesConfig
from bevviz.frame import F32, Anomaly, AnomalyKind, Decision, FrameResult, Tracks
from bevviz.geometry import iou
from bevviz.run import Observer
from bevviz.stages.fusion import in_view

KINDS: tuple[AnomalyKind, ...] = get_args(AnomalyKind)
UNMATCHED = (Decision.NO_CLUSTER, Decision.TOO_FEW_POINTS, Decision.LOW_OVERLAP, Decision.MISFIT)
SAME_BOX = 0.3  # IoU of the image boxes of one object in consecutive frames
MOVING = 1.0  # m/s that makes an object of a cluster that was never named
SETTLED = 1.0  # seconds that such a cluster must have been tracked for: its speed is sure by then
OBJECT_SIZES = ((0.3, 0.3, 0.8), (7.0, 3.0, 3.5))  # metres, least and greatest, the longer side first


@dataclass(slots=True)
class _Seen:
    """What is remembered of a track."""

    name: str = ""  # the last that it was given
    gap: int | None = None  # frames in view without one since then; None: it was out of view meanwhile
    clustered: bool = True  # it had a cluster in all of them
    unnamed: int = 0  # frames in a row that it was in view with a cluster and without a name
    steady: int = 0  # frames in a row with a name, before the gap
    length: float = 0.0  # metres, longer side of its smoothed box


class AnomalyDetector:
    """Looks at the results of consecutive frames. What lasts is one anomaly, with the stamp it began at."""

    def __init__(self) -> None:
        self._active: dict[tuple[str, str], tuple[Anomaly, int]] = {}  # with the stamp it was last true at
        self._seen: dict[int, _Seen] = {}  # by id of the track
        self._alone: dict[str, list[tuple[F32, str, int]]] = {}  # camera -> box, class, frames
        self._placed: set[str] = set()  # sensors whose transforms were there
        self._imaged: set[str] = set()  # cameras that had an image
        self._stamp = 0

    def update(self, result: FrameResult, config: AnomaliesConfig) -> tuple[Anomaly, ...]:
        """Those of this frame, and those that ended within ``anomalies.hold``, in the order they began in."""
        stamp = result.frame.stamp
        if stamp < self._stamp:
            self._active.clear()
            self._alone.clear()
        self._stamp = stamp
        for anomaly in self._found(result, config):
            key = anomaly.kind, anomaly.subject
            since = self._active[key][0].since if key in self._active else stamp
            self._active[key] = replace(anomaly, since=since), stamp
        self._active = {
            key: (anomaly, last)
            for key, (anomaly, last) in self._active.items()
            if stamp - last <= config.hold * 1e9
        }
        return tuple(anomaly for anomaly, _ in self._active.values())

    def _found(self, result: FrameResult, config: AnomaliesConfig) -> Iterator[Anomaly]:
        if result.tracks is not None:
            yield from self._tracks(result, result.tracks, config)
        yield from self._detections(result, config)
        yield from self._clocks(result, config)
        yield from self._transforms(result, config)
        yield from _stages(result, config)

    # --- objects -------------------------------------------------------------------------------

    def _tracks(self, result: FrameResult, tracks: Tracks, config: AnomaliesConfig) -> Iterator[Anomaly]:
        count = 0 if result.clusters is None else len(result.clusters)
        looked_at = np.append(in_view(result.cameras, count), False)[tracks.cluster]
        before, self._seen = self._seen, {}
        for row, number in enumerate(tracks.id.tolist()):
            seen = self._seen[number] = before.get(number, _Seen())
            in_image, clustered = bool(looked_at[row]), tracks.cluster[row] >= 0
            named = tracks.object[row] >= 0
            seen.unnamed = seen.unnamed + 1 if in_image and not named else 0
            if tracks.confirmed[row]:
                yield from self._flicker(result, tracks, row, seen, config)
                yield from self._jump(result, tracks, row, seen, config)
            if named:
                seen.steady = 1 if seen.gap or seen.gap is None else seen.steady + 1
                seen.gap, seen.clustered = 0, True
            elif clustered and not in_image:
                seen.gap = None
            elif seen.gap is not None:
                seen.gap += 1
                seen.clustered &= bool(clustered)
            seen.length = float(tracks.boxes.size[row, :2].max())
            if seen.unnamed >= config.alone_frames and (tracks.confirmed[row] or _moves(tracks, row)):
                size = " x ".join(f"{side:.1f}" for side in tracks.boxes.size[row].tolist())
                yield Anomaly(
                    "one_sensor",
                    label(tracks, row),
                    f"{label(tracks, row)}: a cluster in view, {size} m, {tracks.speed[row]:.1f} m/s, "
                    f"without a detection for {_frames(seen.unnamed)}",
                )

    def _flicker(
        self, result: FrameResult, tracks: Tracks, row: int, seen: _Seen, config: AnomaliesConfig
    ) -> Iterator[Anomaly]:
        j = int(tracks.object[row])
        if j < 0 or result.objects is None:
            return
        name, score = result.objects.names[j], result.objects.score[j]
        who = label(tracks, row)
        if seen.name and name != seen.name:
            yield Anomaly("flicker", who, f"{who}: called {name} {score:.2f}, before {seen.name}")
        elif seen.gap and seen.gap <= config.flicker_frames <= seen.steady:
            why = "no detection of it" if seen.clustered else "no cluster of it"
            yield Anomaly("flicker", who, f"{who}: gone for {_frames(seen.gap)} ({why}), and back")
        seen.name = name

    def _jump(
        self, result: FrameResult, tracks: Tracks, row: int, seen: _Seen, config: AnomaliesConfig
    ) -> Iterator[Anomaly]:
        k = int(tracks.cluster[row])
        if k < 0 or result.clusters is None or not np.isfinite(tracks.innovation[row]):
            return
        who = label(tracks, row)
        if tracks.innovation[row] > config.jump:
            text = f"{who}: {tracks.innovation[row]:.1f} m from where it was expected"
            yield Anomaly("jump", who, text)
            return
        length = float(result.clusters.obb.size[k, :2].max())
        if abs(length - seen.length) > config.jump:
            text = f"{who}: its box is {length:.1f} m long, and was {seen.length:.1f} m"
            yield Anomaly("jump", who, text)

    def _detections(self, result: FrameResult, config: AnomaliesConfig) -> Iterator[Anomaly]:
        """What a camera alone sees, followed from frame to frame by the overlap of its boxes."""
        texts = {(e.camera, e.row): e.text for e in result.explanations if e.subject == "detection"}
        for camera in result.cameras:
            name, found, fusion = camera.camera.name, camera.detections, camera.fusion
            before, self._alone[name] = self._alone.get(name, []), []
            if found is None or fusion is None:
                continue
            unmatched = np.flatnonzero(np.isin(fusion.detection_decision, UNMATCHED) & found.kept)
            boxes = found.xyxy[unmatched]
            others = np.array([box for box, _, _ in before], np.float32).reshape(-1, 4)
            same = iou(boxes, others) >= SAME_BOX
            for d, box, near in zip(unmatched.tolist(), boxes, same, strict=True):
                what = found.names[d]
                earlier = [before[i][2] for i in np.flatnonzero(near).tolist() if before[i][1] == what]
                frames = 1 + max(earlier, default=0)
                self._alone[name].append((box, what, frames))
                if frames >= config.alone_frames:
                    text = texts.get((name, d), f"{what} {found.score[d]:.2f}")
                    subject = f"{what} in {name}"
                    yield Anomaly("one_sensor", subject, f"{name}: {text}, for {_frames(frames)}")

    # --- sensors and stages --------------------------------------------------------------------

    def _clocks(self, result: FrameResult, config: AnomaliesConfig) -> Iterator[Anomaly]:
        for camera in result.frame.cameras:
            if abs(camera.sync_error) > config.sync_error:
                text = f"{camera.name} is {1e3 * camera.sync_error:+.0f} ms off the cloud"
                yield Anomaly("sync", camera.name, text)
            elif camera.image is None and camera.name in self._imaged:
                yield Anomaly("sync", camera.name, f"{camera.name} has no image at the time of the cloud")
        self._imaged |= {camera.name for camera in result.frame.cameras if camera.image is not None}

    def _transforms(self, result: FrameResult, config: AnomaliesConfig) -> Iterator[Anomaly]:
        frame = result.frame
        ages = {frame.lidar: frame.tf_age} | {camera.name: camera.tf_age for camera in frame.cameras}
        for sensor, age in ages.items():
            if age > config.tf_age:
                yield Anomaly("tf", sensor, f"the transform of {sensor} is {1e3 * age:.0f} ms old")
        placed = {c.name for c in frame.cameras if c.camera_from_points is not None}
        if frame.world_from_points is not None:
            placed.add(frame.lidar)
        for sensor in sorted(self._placed - placed):
            yield Anomaly("tf", sensor, f"the transform of {sensor} is lost", "ERROR")
        self._placed |= placed


def _stages(result: FrameResult, config: AnomaliesConfig) -> Iterator[Anomaly]:
    for failure in result.failures:
        yield Anomaly("stage", failure.stage, f"{failure.stage}: {failure.reason}", "ERROR")
    failed = {failure.stage for failure in result.failures}
    for stage, seconds in result.timings.items():
        if config.stage_time is not None and seconds > config.stage_time and stage not in failed:
            yield Anomaly("stage", stage, f"{stage} took {1e3 * seconds:.0f} ms")


class Onsets:
    """Tells what is new in the anomalies of each frame, even where frames are left out."""

    def __init__(self) -> None:
        self._known: set[tuple[str, str, int]] = set()

    def of(self, anomalies: Sequence[Anomaly]) -> list[Anomaly]:
        known, self._known = self._known, {(a.kind, a.subject, a.since) for a in anomalies}
        return [a for a in anomalies if (a.kind, a.subject, a.since) not in known]


class AnomalySummary(Observer[FrameResult]):
    """How many anomalies of each kind a drive had, and when the first began."""

    def __init__(self) -> None:
        self._onsets = Onsets()
        self._start: int | None = None
        self._count: Counter[str] = Counter()
        self._first: dict[str, int] = {}

    def see(self, result: FrameResult) -> None:
        self._start = result.frame.stamp if self._start is None else self._start
        for anomaly in self._onsets.of(result.anomalies):
            self._count[anomaly.kind] += 1
            self._first.setdefault(anomaly.kind, anomaly.since - self._start)

    def __str__(self) -> str:
        """One line, most frequent first; times in seconds from the first frame."""
        kinds = [
            f"{count} {kind.replace('_', ' ')} (first at {self._first[kind] * 1e-9:.1f} s)"
            for kind, count in self._count.most_common()
        ]
        return ", ".join(kinds) or "none"


class FailureSummary(Observer[FrameResult]):
    """Which stages failed, how often, and the reason that each gave first."""

    def __init__(self) -> None:
        self._frames = 0
        self._count: Counter[str] = Counter()
        self._first: dict[str, str] = {}

    def see(self, result: FrameResult) -> None:
        self._frames += 1
        for failure in result.failures:
            self._count[failure.stage] += 1
            self._first.setdefault(failure.stage, failure.reason)

    @property
    def warnings(self) -> list[str]:
        """One sentence for each stage."""
        return [
            f"{stage} failed in {count} of {self._frames} frames, first: {self._first[stage]}"
            for stage, count in self._count.items()
        ]


def label(tracks: Tracks, row: int) -> str:
    """``person #12``."""
    return f"{tracks.names[row] or 'object'} #{tracks.id[row]}"


def _moves(tracks: Tracks, row: int) -> bool:
    """An object by its size and by the way that it has gone, whatever its name."""
    least, greatest = OBJECT_SIZES
    length, width = sorted(tracks.boxes.size[row, :2].tolist(), reverse=True)
    size = (length, width, float(tracks.boxes.size[row, 2]))
    return bool(
        tracks.age[row] >= SETTLED
        and tracks.speed[row] >= MOVING
        and all(low <= side <= high for low, side, high in zip(least, size, greatest, strict=True))
    )


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"
