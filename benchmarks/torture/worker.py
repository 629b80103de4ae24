"""bevviz in a process of its own, so that a hang can be ended and memory belongs to one bag."""

from __future__ import annotations

import faulthandler
import multiprocessing
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any, Self

LIMIT = 60.0  # seconds for a bag or a message


@dataclass
class Outcome:
    """Result of reading one bag or one message."""

    found: list[tuple[str, int, bytes]] = field(default_factory=list)
    said: list[str] = field(default_factory=list)  # warnings, or the one line of an error
    uneven: bool = False  # counts or times are not those of the messages that were given
    traceback: str = ""
    hung: bool = False
    memory: float = 0.0  # MB more than before, at most


def read_bag(path: Path) -> Outcome:
    """Everything that commands do with a bag before a frame goes through the pipeline."""
    from backports import zstd

    from bevviz.bags.bag import Recording
    from bevviz.config import Config
    from bevviz.errors import UserError
    from bevviz.pipeline.bag_info import describe_bag, render_bag_info

    outcome = Outcome()
    try:
        with Recording([path]) as recording:
            names = [topic.name for topic in recording.topics]
            given: dict[str, list[int]] = {name: [] for name in names}
            in_order, packed = [], 0
            for message in recording.messages(names):
                given[message.topic].append(message.received)
                in_order.append(message.received)
                try:
                    outcome.found.append((message.topic, message.received, bytes(message.content())))
                except zstd.ZstdError:
                    packed += 1  # a run says so, topic by topic
            times = {name: recording.times(name).tolist() for name in names}
            outcome.said = [*recording.warnings, *[f"{packed} messages cannot be unpacked"] * bool(packed)]
            lost = recording.message_count != len(in_order) and not outcome.said
            outcome.uneven = in_order != sorted(in_order) or given != times or lost
        render_bag_info(describe_bag([path], Config()))
    except UserError as error:
        outcome.said.append(f"{error} (0 messages)" if not outcome.found else str(error))
    except Exception:
        outcome.traceback = traceback.format_exc()
    return outcome


class Worker:
    """Context manager: one process, replaced when it hangs or dies."""

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def read(self, path: Path) -> Outcome:
        return self.do(read_bag, path)

    def do(self, task: Callable[[Any], Outcome], argument: object) -> Outcome:
        """Run a function in the process. The outcome tells a hang beyond ``LIMIT`` and a dead process."""
        self._pipe.send((task, argument))
        try:
            if self._pipe.poll(LIMIT):
                outcome: Outcome = self._pipe.recv()
                return outcome
            outcome = Outcome(hung=True)
        except EOFError:
            outcome = Outcome(traceback=f"the process ended ({self._process.exitcode})")
        self.restart()
        return outcome

    def restart(self) -> None:
        """Replace the process, whatever it still does."""
        self._end()
        self._start()

    def _start(self) -> None:
        context: Any = multiprocessing.get_context("spawn")
        self._pipe: Connection
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def _end(self) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _serve(pipe: Connection) -> None:
    while True:
        try:
            task, argument = pipe.recv()
        except (EOFError, KeyboardInterrupt):
            return
        before = _reset_peak()
        faulthandler.dump_traceback_later(0.9 * LIMIT)  # what hangs says where
        outcome = task(argument)
        faulthandler.cancel_dump_traceback_later()
        outcome.memory = max(0.0, _peak() - before)
        pipe.send(outcome)


def _reset_peak() -> float:
    """Forget the most memory there was so far; returns what there is now, in MB."""
    Path("/proc/self/clear_refs").write_text("5")
    return _peak()


def _peak() -> float:
    status = Path("/proc/self/status").read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM:")) / 1e3
