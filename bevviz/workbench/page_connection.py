"""The connection to one open page: its questions, the answers, and news of the run."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from bevviz.errors import UserError, first_line
from bevviz.support.loggers import logger

if TYPE_CHECKING:
    from bevviz.why import Answer
    from bevviz.why.pick import Pick
    from bevviz.workbench.session import Settings, WorkbenchSession

BESIDE = 6  # further answers that are listed
TOGETHER = 0.05  # seconds in which news are collected before they are sent

_log = logger(__name__)


class PageConnection:
    """Connection to one page.

    Args:
        workbench: the workbench session that the page asks.
        socket: an accepted socket.
        desk: executor with one thread that answers the questions of all pages in turn.
        run: id of this run of the server.
    """

    def __init__(
        self, workbench: WorkbenchSession, socket: WebSocket, desk: ThreadPoolExecutor, run: str
    ) -> None:
        self._workbench, self._socket, self._desk, self._run = workbench, socket, desk, run
        self._sending = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()
        self._newest = 0
        self._handlers = {
            "ask": self._ask,
            "try": self._try,
            "settle": self._settle,
            "shown": self._shown,
            "drive": self._drive,
            "cancel": self._cancel,
            "report": self._report,
            "note": self._note,
            "unnote": self._unnote,
        }

    async def stay(self) -> None:
        """Serve the page until it disconnects."""
        with news_event(self._workbench.listen) as news:
            await self._send(self._welcome())
            sender = asyncio.ensure_future(self._tell(news))
            try:
                while True:
                    self._take(await self._socket.receive_text())
            finally:
                sender.cancel()
                for task in self._tasks:
                    task.cancel()

    # --- messages to the page ------------------------------------------------------------------

    def _welcome(self) -> dict[str, Any]:
        from bevviz.workbench.controls import controls

        workbench = self._workbench
        self._opened = workbench.drive.config
        self._controls = controls(self._opened)
        return {
            "type": "welcome",
            "run": self._run,
            "bag": workbench.drive.scene.name,
            "scans": len(workbench.drive),
            "truth": workbench.truth_of is not None,
            "detector": bool(workbench.drive.config.detector.model),
            "controls": self._controls,
        }

    async def _tell(self, news: asyncio.Event) -> None:
        """Send news of the run whenever there are any."""
        sent_counts: dict[int, int] = {}
        opening_sent, notes_version, workbench = False, -1, self._workbench
        while True:
            news.clear()
            if not opening_sent and workbench.opening is not None:
                opening_sent = True
                await self._send({"type": "opening", "stamp": str(workbench.opening)})
            for message in workbench.entries.news(sent_counts):
                await self._send(message)
            if notes_version != workbench.notes_changed:
                notes_version = workbench.notes_changed
                await self._send(await asyncio.to_thread(_notes, workbench))
            await self._send(workbench.progress())
            await news.wait()
            await asyncio.sleep(TOGETHER)

    async def _send(self, message: dict[str, Any]) -> None:
        async with self._sending:
            await self._socket.send_text(json.dumps(message))

    # --- messages from the page ----------------------------------------------------------------

    def _take(self, text: str) -> None:
        """Handle a message of the page in a task of its own, so that the next message need not wait."""
        task = asyncio.ensure_future(self._handle(text))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _handle(self, text: str) -> None:
        number: Any = None
        try:
            message = json.loads(text)
            number = message.get("id")
            self._newest = max(self._newest, int(number))
            await self._handlers[message["type"]](int(number), message)
        except (WebSocketDisconnect, RuntimeError):
            return
        except UserError as error:
            await self._send({"type": "error", "id": number, "text": str(error)})
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            _log.debug("a message that cannot be used", exc_info=error)
            await self._send({"type": "error", "id": number, "text": "that message cannot be understood"})
        except Exception as error:
            _log.error("a question that failed", exc_info=error)
            description = f"error of bevviz itself: {type(error).__name__}: {first_line(error)}"
            await self._send({"type": "error", "id": number, "text": description})

    async def _at_desk(self, number: int, work: Callable[[], Any], *, idle: bool = False) -> Any:
        """Run ``work`` on the desk thread. Idle work is skipped once the page has sent a newer message."""

        def job() -> Any:
            if idle and number != self._newest:
                return None
            with self._workbench.quiet():
                return work()

        return await asyncio.get_running_loop().run_in_executor(self._desk, job)

    async def _ask(self, number: int, message: dict[str, Any]) -> None:
        from bevviz.why.pick import Pick

        workbench, settings = self._workbench, _settings(message)
        frame = await self._frame(message)

        def requested_pick() -> Pick | None:
            if "pick" in message:
                return Pick.parse(str(message["pick"]))
            position = tuple(float(v) for v in message.get("position") or () if v is not None)
            instance = message.get("instance")
            path = str(message["entity"])
            return workbench.picked(
                frame, settings, path, None if instance is None else int(instance), position
            )

        def work() -> dict[str, Any] | None:
            picked = requested_pick()
            if picked is None:
                return None
            answer, others = workbench.ask(frame, settings, picked)
            return {"pick": str(picked), **answer.as_dict(), "beside": list(_briefly(others))}

        answer = await self._at_desk(number, work)
        head = {"id": number, "frame": frame}
        if answer is None:
            await self._send({"type": "nothing", **head, "entity": str(message.get("entity", ""))})
            return
        await self._send({"type": "answer", **head, **answer})
        pick = Pick.parse(answer["pick"])
        hints = await self._at_desk(number, lambda: workbench.hints(frame, settings, pick), idle=True)
        if hints is not None:
            await self._send({"type": "hints", **head, "hints": hints.as_dict()["hints"]})

    async def _try(self, number: int, message: dict[str, Any]) -> None:
        from bevviz.why.pick import Pick
        from bevviz.workbench.controls import controls

        settings, frame = _settings(message), await self._frame(message)
        pick = Pick.parse(str(message["pick"])) if message.get("pick") else None
        effects = await self._at_desk(number, lambda: self._workbench.attempt(frame, settings, pick))
        await self._send({"type": "tried", "id": number, "frame": frame, **effects})
        new_controls = controls(self._workbench.configured(settings), self._opened)
        if new_controls != self._controls:  # a stage was replaced by a user's function, or is no longer
            self._controls = new_controls
            await self._send({"type": "controls", "controls": new_controls})

    async def _settle(self, number: int, message: dict[str, Any]) -> None:
        """Compute the result of the frame that the page has stopped at, before a question about it comes."""
        frame = await self._frame(message)
        await self._at_desk(number, lambda: self._workbench.look(frame, _settings(message)), idle=True)

    async def _drive(self, number: int, message: dict[str, Any]) -> None:
        """Run the drive with other values."""
        settings = _settings(message)
        await asyncio.to_thread(self._workbench.trials.begin, settings)

    async def _cancel(self, number: int, message: dict[str, Any]) -> None:
        runner = self._workbench.reports if message["what"] == "report" else self._workbench.trials
        await asyncio.to_thread(runner.end)

    async def _report(self, number: int, message: dict[str, Any]) -> None:
        frame, settings, text = await self._frame(message), _settings(message), str(message["text"])
        before, after = float(message["before"]), float(message["after"])
        await self._at_desk(
            number, lambda: self._workbench.reports.begin(frame, settings, before, after, text)
        )

    async def _note(self, number: int, message: dict[str, Any]) -> None:
        from bevviz.why.pick import Pick

        frame, text = await self._frame(message), str(message["text"])
        pick = Pick.parse(str(message["pick"])) if message.get("pick") else None
        await self._at_desk(number, lambda: self._workbench.note(frame, text, pick))
        await self._send({"type": "noted", "id": number, "file": self._workbench.notes.path.name})

    async def _unnote(self, number: int, message: dict[str, Any]) -> None:
        stamp, text = int(message["stamp"]), str(message["text"])
        await self._at_desk(number, lambda: self._workbench.remove_note(stamp, text))

    async def _shown(self, number: int, message: dict[str, Any]) -> None:
        """Let the run continue: the page has drawn its first frame."""
        self._workbench.go_on()

    async def _frame(self, message: dict[str, Any]) -> int:
        """Return the number of the frame that the page shows. The run may not have reached it yet."""
        return await asyncio.to_thread(self._workbench.number_at, round(float(message["time"])))


def _briefly(answers: Sequence[Answer]) -> Iterator[dict[str, Any]]:
    """Yield the other answers in brief, in the order of the questioner (nearest missed object first)."""
    from bevviz.why.pick_answers import pick_of

    for answer in answers[:BESIDE]:
        if (pick := pick_of(answer)) is not None:
            verdict = answer.verdict
            yield {
                "pick": str(pick),
                "name": answer.subject.name,
                "reported": verdict.reported,
                "reason": verdict.reason.value,
            }


def _notes(workbench: WorkbenchSession) -> dict[str, Any]:
    try:
        notes = list(workbench.notes)
    except UserError as error:
        return {"type": "notes", "notes": [], "error": str(error)}
    records = [{**asdict(note), "stamp": str(note.stamp), "received": str(note.received)} for note in notes]
    return {"type": "notes", "notes": records, "error": ""}


def _settings(message: dict[str, Any]) -> Settings:
    return tuple(str(setting) for setting in message.get("set") or ())


@contextlib.contextmanager
def news_event(listen: Callable[[Callable[[], None]], Callable[[], None]]) -> Iterator[asyncio.Event]:
    """Return an event that is set whenever there is news, from any thread."""
    news, loop = asyncio.Event(), asyncio.get_running_loop()

    def notify() -> None:
        with contextlib.suppress(RuntimeError):  # The server has ended.
            loop.call_soon_threadsafe(news.set)

    stop = listen(notify)
    try:
        yield news
    finally:
        stop()
