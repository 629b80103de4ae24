"""State of a run on the robot's /diagnostics."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bevviz.extras.ros_node.topics import open_publisher
from bevviz.live.node import add_timer
from bevviz.live.problems import Problem
from bevviz.live.publish import Receiver
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import make_header, make_message
from bevviz.messages.surroundings import LEVELS
from bevviz.model.results import FrameResult

DIAGNOSTICS = "/diagnostics"
TYPE = "diagnostic_msgs/msg/DiagnosticArray"
PERIOD = 1.0  # seconds, the usual period of diagnostic_updater
OK, WARN, ERROR = range(3)


class Diagnostics(Receiver):
    """Publisher of the state of the run, each second, with or without frames.

    ``NAME: pipeline`` has latencies, drops and failed stages. ``NAME: anomalies`` has the anomalies of the
    newest frame. ``NAME: sources`` has the current problems, with the seconds that they have lasted.

    Args:
        node: an rclpy node, whose remaps apply.

    Raises:
        UserError: the message type is unknown, or another node publishes the topic with another type.
    """

    def __init__(self, node: Any) -> None:
        self._node, self._name = node, node.get_name()
        self._publisher = open_publisher(node, TYPE, DIAGNOSTICS, shared=True)
        self._result: FrameResult | None = None
        self._at = 0.0

    def every_second(self, publish: Callable[[], None]) -> None:
        """Make a timer of the node call ``publish``. That function calls the method ``publish``."""
        add_timer(self._node, PERIOD, publish)

    def observe(self, result: FrameResult) -> None:
        """Store the newest result. Any thread may call it."""
        self._result, self._at = result, time.monotonic()

    def publish(self, numbers: Mapping[str, float], problems: Sequence[Problem]) -> None:
        """Publish the current state.

        Args:
            numbers: numbers of the run, by name.
            problems: the current problems.
        """
        more = f" (and {len(problems) - 1} more)" if problems[1:] else ""
        text = f"{problems[0]}{more}" if problems else ""
        listed = {
            f"{problem.finding.kind} {problem.finding.subject}": (
                f"{problem} (for {time.time() - problem.since:.0f} s)"
            )
            for problem in problems
        }
        sources = self._status("sources", WARN if problems else OK, text, listed)
        statuses = [self._pipeline(numbers), self._anomalies(), sources]
        now = time.time_ns()
        message = make_message(TYPE, header=make_header(now, ""), status=statuses)
        self._publisher.publish(bytes(typestore().serialize_cdr(message, TYPE)))

    def _pipeline(self, numbers: Mapping[str, float]) -> Any:
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
        anomalies = self._result.anomalies if self._result is not None else ()
        text = anomalies[0].text if anomalies else ""
        level = ERROR if any(a.severity == "ERROR" for a in anomalies) else WARN if anomalies else OK
        return self._status("anomalies", level, text, {f"{a.kind} {a.subject}": a.text for a in anomalies})

    def _status(self, part: str, level: int, text: str, values: Mapping[str, str]) -> Any:
        pairs = [make_message("diagnostic_msgs/msg/KeyValue", key=k, value=v) for k, v in values.items()]
        return make_message(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=f"{self._name}: {part}",
            message=text or LEVELS[level],
            values=pairs,
        )
