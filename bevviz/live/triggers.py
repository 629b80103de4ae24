"""When the flight recorder saves by itself."""

from __future__ import annotations

import math
import time

from bevviz.anomalies import Onsets
from bevviz.config import LiveConfig
from bevviz.model.results import FrameResult


class Triggers:
    """Looks at every result for an anomaly of the kinds in ``live.triggers`` that begins.

    ``check`` gives the reason to save, once in ``live.trigger_pause``.
    """

    def __init__(self, config: LiveConfig) -> None:
        self.config = config
        self._onsets = Onsets()
        self._fired = -math.inf

    def check(self, result: FrameResult) -> str | None:
        onsets = self._onsets.of(result.anomalies)  # whether or not one is reported
        reasons = [anomaly.text for anomaly in onsets if anomaly.kind in self.config.triggers]
        now = time.monotonic()
        if not reasons or now - self._fired < self.config.trigger_pause:
            return None
        self._fired = now
        return "; ".join(reasons)
