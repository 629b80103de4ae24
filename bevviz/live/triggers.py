"""When the flight recorder saves by itself."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator

from bevviz.config import LiveConfig
from bevviz.frame import Decision, DetectionState, FrameResult


class Triggers:
    """Looks at every result for what ``live.trigger_...`` asks for.

    ``check`` gives the reason to save, once in ``live.trigger_pause``.
    """

    def __init__(self, config: LiveConfig) -> None:
        self.config = config
        self._fired = -math.inf
        self._alone: Counter[tuple[str, str]] = Counter()  # (camera, class) -> frames without a cluster
        self._known: set[str] = set()  # sensors whose transforms were there

    def check(self, result: FrameResult) -> str | None:
        reasons = list(self._reasons(result))  # all of them: each has a memory
        now = time.monotonic()
        if not reasons or now - self._fired < self.config.trigger_pause:
            return None
        self._fired = now
        return "; ".join(reasons)

    def _reasons(self, result: FrameResult) -> Iterator[str]:
        yield from self._without_cluster(result)
        yield from self._lost_transforms(result)
        if (limit := self.config.trigger_stage_time) is not None:
            for stage, seconds in result.timings.items():
                if seconds > limit:
                    yield f"{stage} took {1e3 * seconds:.0f} ms"
        if (limit := self.config.trigger_sync_error) is not None:
            for camera in result.frame.cameras:
                if abs(camera.sync_error) > limit:
                    yield f"{camera.name} is {1e3 * camera.sync_error:+.0f} ms off the cloud"

    def _without_cluster(self, result: FrameResult) -> Iterator[str]:
        limit = self.config.trigger_no_cluster
        alone = set()
        for camera in result.cameras:
            found, fusion = camera.detections, camera.fusion
            if found is None or fusion is None:
                continue
            rows = (found.state == DetectionState.KEPT) & (fusion.detection_decision == Decision.NO_CLUSTER)
            alone |= {(camera.camera.name, found.names[d]) for d in rows.nonzero()[0].tolist()}
        self._alone = Counter({key: self._alone[key] + 1 for key in alone})
        for (camera_name, class_name), frames in self._alone.items():
            if frames == limit:
                yield f"{class_name} in {camera_name} without a cluster for {frames} frames"

    def _lost_transforms(self, result: FrameResult) -> Iterator[str]:
        frame = result.frame
        placed = {c.name for c in frame.cameras if c.camera_from_points is not None}
        if frame.world_from_points is not None:
            placed.add(frame.lidar)
        lost = self._known - placed
        self._known = placed
        if lost and self.config.trigger_tf_lost:
            yield f"transform of {', '.join(sorted(lost))} lost"
