"""Transform tree over time, from /tf and /tf_static.

It follows the semantics of tf2 (Foote 2013, "tf: The transform library"): one parent for each frame, a
bounded history for each edge, interpolation between samples. tf2 refuses a stamp just past the newest sample.
Here the nearest sample holds for a tolerance, and its age is returned.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from bevviz.errors import UserError
from bevviz.messages.transforms import StampedTransform
from bevviz.model import geometry
from bevviz.model.frame import F64
from bevviz.support.limits import MAX_FRAMES

SAME_ANGLE, SAME_PLACE = 0.05, 0.001  # degrees and metres; static transforms nearer to each other are equal


class TransformError(UserError):
    """Error for two frames without a transform at a stamp."""


class Origin(IntEnum):
    """Source of a transform. If two sources state the parent of a frame, the higher one counts."""

    ODOMETRY = 0
    TF = 1
    CONFIG = 2


@dataclass(frozen=True, slots=True)
class TransformResult:
    """Transform between two frames.

    Attributes:
        matrix: (4, 4) target_from_source.
        age: seconds from the stamp to the nearest sample, the largest over the chain; 0 for static
            transforms.
    """

    matrix: F64
    age: float


@dataclass(slots=True)
class _Edge:
    """Parent of a frame over time. ``stamps`` is sorted. A static edge has one pose and no stamp.

    Attributes:
        parent: parent frame.
        origin: source of the edge.
        static: whether the pose holds at any time.
        stamps: nanoseconds.
        poses: (4, 4) parent_from_child.
        held: whether a pose holds until the next one.
        moved: whether the pose of a held edge has changed.
        topic: topic of the pose of a static edge.
    """

    parent: str
    origin: Origin
    static: bool
    stamps: list[int] = field(default_factory=list)
    poses: list[F64] = field(default_factory=list)
    held: bool = False
    moved: bool = False
    topic: str = ""

    @property
    def rests(self) -> bool:
        """Whether no further sample is expected."""
        return self.static or (self.held and len(self.stamps) == 1)

    def put(self, stamp: int, pose: F64) -> None:
        """Insert a sample."""
        if self.held and self.poses and not np.array_equal(pose, self.poses[-1]):
            self.moved = True
        if self.static:
            self.poses = [pose]
            return
        i = bisect_left(self.stamps, stamp)
        if i < len(self.stamps) and self.stamps[i] == stamp:
            self.poses[i] = pose
        else:
            self.stamps.insert(i, stamp)
            self.poses.insert(i, pose)

    def keep(self, first: int, last: int) -> None:
        """Drop the samples outside [first, last]."""
        low, high = bisect_left(self.stamps, first), bisect_left(self.stamps, last + 1)
        self.stamps, self.poses = self.stamps[low:high], self.poses[low:high]

    def at(self, stamp: int) -> tuple[F64, float, int]:
        """Return the pose, the seconds to the nearest sample, and the nanoseconds beyond the history.

        Nanoseconds before the history are negative.
        """
        if self.static or (self.held and not self.moved):
            return self.poses[0], 0.0, 0
        i = bisect_left(self.stamps, stamp)
        if i == len(self.stamps):
            past = stamp - self.stamps[-1]
            return self.poses[-1], past * 1e-9, past
        after = self.stamps[i] - stamp
        if after == 0:
            return self.poses[i], 0.0, 0
        if i == 0:
            return self.poses[0], after * 1e-9, -after
        before = stamp - self.stamps[i - 1]
        pose = geometry.interpolate(self.poses[i - 1], self.poses[i], before / (before + after))
        return pose, min(before, after) * 1e-9, 0


class TransformBuffer:
    """Transforms between frames, with ``duration`` seconds of history for each moving edge.

    The frames may form several trees. The leading slash of ROS 1's frame names is removed. Samples may come
    in any order.
    """

    def __init__(self, duration: float = 30.0) -> None:
        self._duration = round(duration * 1e9)
        self._edges: dict[str, _Edge] = {}
        self._problems: Counter[str] = Counter()
        self._conflicts: dict[str, str] = {}  # a sentence by child

    def add(
        self,
        t: StampedTransform,
        static: bool = False,
        origin: Origin = Origin.TF,
        held: bool = False,
        topic: str = "",
    ) -> None:
        """Insert a sample. An unusable one is left out and listed in ``problems``.

        Args:
            t: the sample.
            static: whether it holds at any time.
            origin: source of the sample.
            held: whether it holds at any time as long as no other sample differs from it.
            topic: topic of the sample, for warnings.
        """
        parent, child = _name(t.parent), _name(t.child)
        about = f"'{parent}' -> '{child}'"
        if not parent or not child:
            self._problems[f"the transform {about} has an empty frame name: ignored"] += 1
            return
        if not _is_rigid(t.parent_from_child):
            self._problems[f"the transform {about} is not a finite rotation and translation: ignored"] += 1
            return
        edge = self._edges.get(child)
        if edge is None and len(self._edges) >= MAX_FRAMES:
            self._problems[f"there are more than {MAX_FRAMES:,} frames: the others are ignored"] += 1
            return
        if edge is not None and origin < edge.origin:
            if edge.origin is Origin.CONFIG:
                self._problems[f"{about} is ignored: source.extrinsics states the parent of '{child}'"] += 1
            return
        if edge is None or edge.parent != parent or edge.origin != origin:
            if edge is not None and edge.parent != parent and edge.origin == origin:
                both = " and ".join(sorted((f"'{edge.parent}'", f"'{parent}'")))
                self._problems[f"frame '{child}' has two parents, {both}: the newer one holds"] += 1
                if not (edge.static or static) and t.stamp < edge.stamps[-1]:
                    return
            if not self._break_cycle(parent, child, origin):
                if origin is not Origin.ODOMETRY:  # odometry only fills gaps
                    self._problems[f"{about} is refused: '{child}' is above '{parent}' already"] += 1
                return
            edge = self._edges[child] = _Edge(parent, origin, static, held=held)
        elif static and not edge.static:
            self._compare(edge, child, t.parent_from_child, topic)
            edge = self._edges[child] = _Edge(parent, origin, True)
        elif edge.static:
            self._compare(edge, child, t.parent_from_child, topic)
        elif edge.stamps and t.stamp < edge.stamps[-1] - self._duration:
            self._problems[f"the clock of {about} jumped back: its history was cleared"] += 1
            edge.keep(0, -1)
        edge.put(t.stamp, t.parent_from_child)
        edge.topic = topic
        # Prune in chunks, which spreads the cost over many insertions.
        if edge.stamps and edge.stamps[0] < edge.stamps[-1] - self._duration * 5 // 4:
            edge.keep(edge.stamps[-1] - self._duration, edge.stamps[-1])

    def refuse(self, reason: str) -> None:
        """Count a transform that cannot be decoded in ``problems``."""
        self._problems[f"{reason}: ignored"] += 1

    def _compare(self, edge: _Edge, child: str, pose: F64, topic: str) -> None:
        """Note that a static edge is stated again with another pose."""
        former = edge.poses[-1] if edge.poses else pose
        if child in self._conflicts or former is pose or np.array_equal(former, pose):
            return
        apart = geometry.inverse(former) @ pose
        angle = math.degrees(math.acos(max(-1.0, min(1.0, (float(np.trace(apart[:3, :3])) - 1) / 2))))
        distance = float(np.linalg.norm(former[:3, 3] - pose[:3, 3]))
        if angle < SAME_ANGLE and distance < SAME_PLACE:
            return
        numbers = [*former[:3, 3], *geometry.quaternion(former)]
        stated = ", ".join(f"{number:.6g}" for number in numbers)
        topics = f"twice on {topic}" if topic == edge.topic else f"on {edge.topic} and on {topic}"
        self._conflicts[child] = (
            f"the fixed transform '{edge.parent}' -> '{child}' is stated {topics}, {angle:.1f} degrees and "
            f"{distance:.3f} m apart: the newer one is used; the other one is taken with "
            f"--set source.extrinsics='{{{edge.parent} {child}: [{stated}]}}'"
        )

    def _break_cycle(self, parent: str, child: str, origin: Origin) -> bool:
        """Return whether ``child`` may be below ``parent``. If needed, cut an edge of lower origin."""
        path = self.ancestors(parent)
        if child not in path:
            return True
        between = path[: path.index(child)]
        weakest = min(between, key=lambda frame: self._edges[frame].origin, default=None)
        if weakest is None or self._edges[weakest].origin >= origin:
            return False
        del self._edges[weakest]
        return True

    def forget_after(self, stamp: int) -> None:
        """Drop the samples newer than ``stamp``, which are from before a clock reset."""
        for child, edge in list(self._edges.items()):
            if not edge.static:
                edge.keep(0, stamp)
                if not edge.stamps:
                    del self._edges[child]

    def lookup(self, target: str, source: str, stamp: int, tolerance: float) -> TransformResult:
        """Return target_from_source at ``stamp``, interpolated along the chain through the common ancestor.

        Raises:
            TransformError: the frames are not connected, or a moving edge has no sample within ``tolerance``
                seconds of a stamp outside its history.
        """
        up, down = self._chains(target, source)
        to_common, age = self._climb(up, target, source, stamp, tolerance)
        to_target, other_age = self._climb(down, target, source, stamp, tolerance)
        return TransformResult(geometry.inverse(to_target) @ to_common, max(age, other_age))

    def lookup_moving(
        self, target: str, target_stamp: int, source: str, source_stamp: int, fixed: str, tolerance: float
    ) -> TransformResult:
        """Return target at ``target_stamp`` from source at ``source_stamp``.

        Objects at rest in ``fixed`` stay in place.

        Raises:
            TransformError: see ``lookup``.
        """
        fixed_from_source = self.lookup(fixed, source, source_stamp, tolerance)
        fixed_from_target = self.lookup(fixed, target, target_stamp, tolerance)
        matrix = geometry.inverse(fixed_from_target.matrix) @ fixed_from_source.matrix
        return TransformResult(matrix, max(fixed_from_source.age, fixed_from_target.age))

    def latest(self, target: str, source: str) -> int | None:
        """Return the newest stamp that all edges of the chain reach; None if the chain is static.

        Raises:
            TransformError: the frames are not connected.
        """
        up, down = self._chains(target, source)
        ends = [self._edges[frame].stamps[-1] for frame in (*up, *down) if not self._edges[frame].rests]
        return min(ends, default=None)

    def knows(self, target: str, source: str) -> bool:
        """Return whether two frames are connected at any stamp."""
        return self.root(target) == self.root(source)

    def frames(self) -> set[str]:
        """Return all frames."""
        return {*self._edges, *(edge.parent for edge in self._edges.values())}

    def needs_odometry(self, frame: str) -> bool:
        """Return whether only odometry states the parent of a frame."""
        edge = self._edges.get(_name(frame))
        return edge is None or edge.origin is Origin.ODOMETRY

    def ancestors(self, frame: str) -> tuple[str, ...]:
        """Return the frame, its parent, and so on up to the root."""
        path = [_name(frame)]
        while (edge := self._edges.get(path[-1])) is not None:
            path.append(edge.parent)
        return tuple(path)

    def root(self, frame: str) -> str:
        """Return the root of a frame's tree."""
        return self.ancestors(frame)[-1]

    def tree(self) -> Mapping[str, str]:
        """Return the parent of each frame."""
        return {child: edge.parent for child, edge in self._edges.items()}

    @property
    def conflicts(self) -> tuple[str, ...]:
        """A sentence for each static transform that is stated with different poses."""
        return tuple(self._conflicts.values())

    @property
    def problems(self) -> tuple[str, ...]:
        """A sentence with a count for each problem of the transforms."""
        return tuple(f"{text} ({n} time{'s' * (n > 1)})" for text, n in self._problems.items())

    def _chains(self, target: str, source: str) -> tuple[Sequence[str], Sequence[str]]:
        """Return the frames below the common ancestor: from source upwards, and from target upwards."""
        up, down = self.ancestors(source), self.ancestors(target)
        if not up[0] or not down[0]:
            raise TransformError(f"no transform from '{up[0]}' to '{down[0]}': a message states no frame_id")
        if up[-1] == down[-1]:
            common = next(frame for frame in up if frame in down)
            return up[: up.index(common)], down[: down.index(common)]
        known = self.frames()
        lacking = [frame for frame in (up[0], down[0]) if frame not in known]
        if lacking:
            reason = f"frame '{lacking[0]}' is unknown"
        else:
            reason = f"they are in two unconnected trees (roots '{up[-1]}' and '{down[-1]}')"
        raise TransformError(f"no transform from '{up[0]}' to '{down[0]}': {reason}")

    def _climb(
        self, frames: Sequence[str], target: str, source: str, stamp: int, tolerance: float
    ) -> tuple[F64, float]:
        matrix, worst = np.eye(4), 0.0
        for frame in frames:
            edge = self._edges[frame]
            pose, age, past = edge.at(stamp)
            if abs(past) > tolerance * 1e9:
                ends = "ends {:.2f} s before" if past > 0 else "begins {:.2f} s after"
                once = " (it was sent once, as if it were static: sync.tf_tolerance holds it for longer)"
                raise TransformError(
                    f"no transform from '{_name(source)}' to '{_name(target)}': '{edge.parent}' -> '{frame}' "
                    f"{ends.format(age)} the asked stamp{once if len(edge.stamps) == 1 else ''}"
                )
            matrix, worst = pose @ matrix, max(worst, age)
        return matrix, worst


def _name(frame: str) -> str:
    return frame.lstrip("/")


def _is_rigid(matrix: F64) -> bool:
    # Without NumPy: for so few numbers its calls take ten times as long.
    a, b, c = rows = matrix[:3].tolist()
    if not all(math.isfinite(value) for row in rows for value in row):
        return False
    products = (_dot(a, a) - 1, _dot(b, b) - 1, _dot(c, c) - 1, _dot(a, b), _dot(a, c), _dot(b, c))
    return max(map(abs, products)) < 1e-4


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
