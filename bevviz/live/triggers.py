"""Triggers that save the flight recorder automatically."""

from __future__ import annotations

import math
import time

from bevviz.anomalies import Onsets
from bevviz.config import LiveConfig
from bevviz.model.results import FrameResult


class Triggers:
    """Trigger on anomalies of the kinds in ``live.triggers``.

    ``check`` returns a reason to save at most once in ``live.trigger_pause``.
    """

    def __init__(self, config: LiveConfig) -> None:
        self.config = config
        self._onsets = Onsets()
        self._fired = -math.inf

    def check(self, result: FrameResult) -> str | None:
        """Return the reason to save, or None."""
        # Called for every result, so that old anomalies do not count as new.
        onsets = self._onsets.of(result.anomalies)
        reasons = [anomaly.text for anomaly in onsets if anomaly.kind in self.config.triggers]
        now = time.monotonic()
        if not reasons or now - self._fired < self.config.trigger_pause:
            return None
        self._fired = now
        return "; ".join(reasons)
