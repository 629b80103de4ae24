"""State of bevviz for the robot's monitor: diagnostic_msgs/DiagnosticArray on /diagnostics."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bevviz.live.typesupport import message_type
from bevviz.messages.definitions import typestore
from bevviz.messages.surroundings import LEVELS
from bevviz.model.results import FrameResult

TOPIC = "/diagnostics"
TYPE = "diagnostic_msgs/msg/DiagnosticArray"
PERIOD = 1.0  # seconds, the usual period of diagnostic_updater
OK, WARN, ERROR = range(3)


class Diagnostics:
    """Publisher of the state of the run, each second, with or without frames.

    ``NAME: pipeline`` has latencies, drops and failed stages. ``NAME: anomalies`` has the anomalies of the
    newest frame. ``NAME: sources`` has the warnings of the source.

    Args:
        node: an rclpy node, whose remaps apply.

    Raises:
        UserError: the message type is unknown.
    """

    def __init__(self, node: Any) -> None:
        self._node, self._name = node, node.get_name()
        self._publisher = node.create_publisher(message_type(TYPE), TOPIC, 10)
        self._result: FrameResult | None = None
        self._at = 0.0

    def every_second(self, publish: Callable[[], None]) -> None:
        """Make a timer of the node call ``publish``. That function calls the method ``publish``."""
        from rclpy.clock import Clock
        from rclpy.clock_type import ClockType

        # A steady clock. The node's clock stands still while a simulation is paused.
        self._node.create_timer(PERIOD, publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def observe(self, result: FrameResult) -> None:
        """Store the newest result. Any thread may call it."""
        self._result, self._at = result, time.monotonic()

    def publish(self, numbers: Mapping[str, float], warnings: Sequence[str]) -> None:
        """Publish the current state.

        Args:
            numbers: numbers of the run, by name.
            warnings: warnings of the source, one sentence each.
        """
        more = f" (and {len(warnings) - 1} more)" if warnings[1:] else ""
        text = f"{warnings[0]}{more}" if warnings else ""
        listed = {str(number): text for number, text in enumerate(warnings, 1)}
        sources = self._status("sources", WARN if warnings else OK, text, listed)
        statuses = [self._pipeline(numbers), self._anomalies(), sources]
        now = time.time_ns()
        types = typestore().types
        stamp = types["builtin_interfaces/msg/Time"](sec=now // 10**9, nanosec=now % 10**9)
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
        message = types[TYPE](header=header, status=statuses)
        self._publisher.publish(bytes(typestore().serialize_cdr(message, TYPE)))

    def _pipeline(self, numbers: Mapping[str, float]) -> Any:
        """Return the status of the pipeline."""
        result = self._result
        values = {name: f"{value:.1f}".removesuffix(".0") for name, value in numbers.items()}
        if result is None:
            return self._status("pipeline", WARN, "no frame yet", values)
        age = time.monotonic() - self._at
        if age > 2 * PERIOD:
            return self._status("pipeline", ERROR, f"no frame for {age:.0f} s", values)
        if result.failures:
            failure = result.failures[0]
            return self._status("pipeline", ERROR, f"{failure.stage} fails: {failure.reason}", values)
        problems = [*result.frame.problems, *(p for c in result.cameras for p in c.camera.problems)]
        return self._status("pipeline", WARN if problems else OK, problems[0] if problems else "", values)

    def _anomalies(self) -> Any:
        """Return the status of the anomalies."""
        anomalies = self._result.anomalies if self._result is not None else ()
        text = anomalies[0].text if anomalies else ""
        level = ERROR if any(a.severity == "ERROR" for a in anomalies) else WARN if anomalies else OK
        return self._status("anomalies", level, text, {f"{a.kind} {a.subject}": a.text for a in anomalies})

    def _status(self, part: str, level: int, text: str, values: Mapping[str, str]) -> Any:
        """Return a DiagnosticStatus."""
        types = typestore().types
        pairs = [types["diagnostic_msgs/msg/KeyValue"](key=k, value=v) for k, v in values.items()]
        return types["diagnostic_msgs/msg/DiagnosticStatus"](
            level=level,
            name=f"{self._name}: {part}",
            message=text or LEVELS[level],
            hardware_id="",
            values=pairs,
        )
