"""The connection to one open page: its questions, the answers, and news of the run."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from bevviz.errors import UserError, first_line
from bevviz.evaluate.metrics import METRICS
from bevviz.findings.finding_list import DIFFERENCES
from bevviz.model.reasons import FACTS
from bevviz.support.colors import class_color
from bevviz.support.json_form import json_tree
from bevviz.support.loggers import logger

if TYPE_CHECKING:
    from bevviz.model.results import FrameResult
    from bevviz.why import Answer, Selection
    from bevviz.why.identity import Identity
    from bevviz.why.robot_questions import RobotSteps
    from bevviz.workbench import page_types as types
    from bevviz.workbench.buffers import News
    from bevviz.workbench.growing_drive import Settings
    from bevviz.workbench.session import WorkbenchSession

LEGEND = ("person", "cyclist", "car", "truck", "bus")  # classes in the legend of the page
TOGETHER = 0.05  # seconds in which news are collected before they are sent

_log = logger(__name__)


class PageConnection:
    """Connection to one page.

    Args:
        workbench: the workbench session that the page asks.
        socket: an accepted socket.
        questions: executor with one thread that answers the questions of all pages in turn.
        run: id of this run of the server.
    """

    def __init__(
        self, workbench: WorkbenchSession, socket: WebSocket, questions: ThreadPoolExecutor, run: str
    ) -> None:
        self._workbench, self._source = workbench, workbench.source
        self._socket, self._questions, self._run = socket, questions, run
        self._sending = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()
        self._newest = 0  # of all messages
        self._asked = 0  # of the questions
        self._rows: list[types.Row] = []  # those that need a remark
        self._remarking = False
        self._overlay = self._source.open_overlay()
        self._tries = ThreadPoolExecutor(1, "tries")  # A slow try keeps no other question waiting.
        self._trying = 0  # number of the try in progress
        self._handlers: Mapping[str, Callable[[Any], Coroutine[Any, Any, None]]] = {
            "ask": self._ask,
            "try": self._try,
            "settle": self._settle,
            "remarks": self._remark_rows,
            "shown": self._shown,
            "drive": self._drive,
            "fix": self._fix,
            "cancel": self._cancel,
            "report": self._report,
            "note": self._note,
            "unnote": self._unnote,
            "handle": self._handle_finding,
            "draw": self._draw_label,
        }

    async def stay(self) -> None:
        """Serve the page until it disconnects."""
        with news_event(self._source.news) as news:
            await self._send(self._welcome())
            sender = asyncio.ensure_future(self._tell(news))
            try:
                while True:
                    message = await self._socket.receive()
                    if message["type"] == "websocket.disconnect":
                        break
                    self._take(message.get("text") or "")
            finally:
                tasks = (sender, *self._tasks)
                for task in tasks:
                    task.cancel()
                self._stop_try()
                self._tries.shutdown(wait=False)
                await asyncio.gather(*tasks, return_exceptions=True)
                if self._overlay is not None:
                    self._source.close_overlay(self._overlay)

    # --- messages to the page ------------------------------------------------------------------

    def _welcome(self) -> types.Welcome:
        from bevviz.workbench.page_messages import controls, opened_values

        source = self._source
        self._opened = source.pipeline.config
        self._controls = controls(self._opened)
        return {
            "type": "welcome",
            "run": self._run,
            "overlay": "" if self._overlay is None else self._overlay.lane,
            "bag": source.title,
            "truth": source.has_truth,
            "single": source.single_frames,
            "detector": bool(self._opened.detector.model),
            "opened": opened_values(self._opened),
            "classes": {name: f"rgb{class_color(name)}" for name in LEGEND},
            "controls": self._controls,
            "meanings": {
                **{str(kind): facts.meaning for kind, facts in FACTS.items()},
                **DIFFERENCES,
                "F1": METRICS["f1"],
            },
        }

    async def _tell(self, news: asyncio.Event) -> None:
        """Send news of the run whenever there are any."""
        sent_counts: dict[int, int] = {}
        sent_numbers: set[int] = set()  # of frames
        opening_sent, notes_version, workbench, source = False, -1, self._workbench, self._source
        while True:
            news.clear()
            if not opening_sent and source.opening is not None:
                opening_sent = True
                await self._send(
                    {
                        "type": "opening",
                        "stamp": str(source.opening),
                        "first": str(source.first),
                        "demand": source.on_demand,
                    }
                )
            times = source.unsent_frames(sent_numbers)
            if times:
                frames: list[types.FrameTime] = [{"stamp": str(at), "frame": number} for at, number in times]
                await self._send({"type": "frames", "frames": frames})
            entries, gone = source.findings.news(sent_counts)
            if entries or gone:
                await self._send({"type": "entries", "entries": entries, "gone": gone})
            if notes_version != workbench.notes_version:
                notes_version = workbench.notes_version
                await self._send(await asyncio.to_thread(self._notes))
            await self._send(workbench.progress())
            await news.wait()
            await asyncio.sleep(TOGETHER)

    async def _send(self, message: types.ToPage | Mapping[str, Any]) -> None:
        async with self._sending:
            await self._socket.send_text(json.dumps(message, default=json_tree))

    def _notes(self) -> types.Notes:
        try:
            file, error = self._workbench.tools.notes, ""
            notes, findings = list(file), file.handled()
        except UserError as problem:
            notes, findings, error = [], [], str(problem)
        return {
            "type": "notes",
            "notes": notes,
            "findings": findings,
            "error": error,
        }

    # --- messages from the page ----------------------------------------------------------------

    def _take(self, text: str) -> None:
        """Handle a message of the page in a task of its own, so that the next message need not wait."""
        task = asyncio.ensure_future(self._handle(text))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _handle(self, text: str) -> None:
        from bevviz.workbench.page_types import FROM_PAGE

        number: Any = None
        try:
            tree = json.loads(text)
            number = tree.get("id")
            message = FROM_PAGE.validate_python(tree)
            if message["type"] != "remarks":  # It makes no question idle.
                self._newest = max(self._newest, message["id"])
            if command := self._source.commands.get(message["type"]):
                await self._send(await asyncio.to_thread(command, message))
            else:
                await self._handlers[message["type"]](message)
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

    async def _in_turn(
        self, number: int, work: Callable[[], Any], settings: Settings = (), *, idle: bool = False
    ) -> Any:
        """Run work about a frame on the thread of all pages, or with other values on that of this page.

        Idle work is skipped once the page has sent a newer message.
        """
        own_thread = bool(settings) and self._overlay is not None

        def job() -> Any:
            if idle and number not in (self._asked, self._newest):
                return None
            with self._source.quiet():
                return work()

        return await asyncio.get_running_loop().run_in_executor(
            self._tries if own_thread else self._questions, job
        )

    async def _ask(self, message: types.Ask) -> None:
        """Answer a question and mark the object. Then send hints, unless a newer question came."""
        from bevviz.why.changes import other_methods
        from bevviz.why.log import cameras_of
        from bevviz.workbench.page_messages import answer_tree, other_answers, row_remark

        number = self._asked = message["id"]
        workbench, frame = self._workbench, await self._frame(message)
        settings = self._source.asked_settings(message.get("set", ()), again="pick" in message)
        head: types.Reply = {"id": number, "frame": frame, "set": message.get("set", ())}
        origin = None if _identity(message) else message.get("origin")  # A row is of its own frame.
        asked_in = frame if origin is None else await self._frame(origin)

        def work() -> tuple[Selection, FrameResult, Answer, dict[str, Any]] | types.Nothing | types.Absent:
            identity, found = _identity(message), ""
            selection = None if identity else self._selected(message, frame, settings)
            if identity is None and selection is None:
                return {"type": "nothing", **head, "entity": message.get("entity", "")}
            if selection is not None and origin is not None:
                asked_settings = self._source.asked_settings(origin["set"], again=True)
                if (asked_in, asked_settings) != (frame, settings):
                    answer = workbench.ask(asked_in, asked_settings, selection)[0]
                    identity = workbench.identity(asked_in, asked_settings, selection, answer, None)
            if identity is not None:
                selection, found = workbench.follow(identity, frame, settings)
            if selection is None:
                assert identity is not None
                values = " with these values" if settings and frame == identity.frame else ""
                name = identity.name[:1].upper() + identity.name[1:]
                text = f"{name} of frame {identity.frame} is not in frame {frame}{values}: {found}."
                return {"type": "absent", **head, "text": text, "pick": str(identity)}
            answer, *others = workbench.ask(frame, settings, selection)
            identity = workbench.identity(frame, settings, selection, answer, identity)
            followed = {"pick": str(identity), "place": bool(identity.place), "found": found}
            result = self._source.look(frame, settings)
            more = {
                "labelled": answer.label >= 0,
                "beside": [*other_answers(others)],
                "cameras": cameras_of(result.frame, answer),
            }
            tree = {"type": "answer", **head, **answer_tree(answer), **followed, **more}
            return selection, result, answer, tree

        answered = await self._in_turn(number, work, settings)
        if isinstance(answered, dict):
            await self._send(answered)
            return
        selection, result, answer, tree = answered
        await self._send(tree)

        async def follow_up() -> None:
            await self._in_turn(number, lambda: self._source.mark(result, answer, self._overlay))
            hints = await self._in_turn(
                number, lambda: workbench.hints(frame, settings, selection), settings, idle=True
            )
            if hints is not None:
                row, changes = str(answer.selection or selection), answer_tree(hints)["hints"]
                methods = other_methods(hints.lost_in, result.config)
                remark = {"methods": methods, **row_remark(hints)}
                await self._send({"type": "hints", **head, "row_pick": row, "hints": changes, **remark})

        async def follow_robot() -> None:
            robot = await asyncio.to_thread(self._followed, number, result, answer)
            if robot is not None:
                await self._send({"type": "robot", **head, **robot})

        await asyncio.gather(follow_up(), follow_robot())

    def _followed(self, number: int, result: FrameResult, answer: Answer) -> RobotSteps | None:
        """Return what the robot's own nodes did with an object. None: nothing is to be shown."""
        from bevviz.why.log import focus_point

        if number != self._asked:
            return None
        place, frame = focus_point(result.frame, answer), result.frame.index
        try:
            with self._source.quiet():
                followed = self._source.follow_robot(frame, place)
        except UserError as error:
            return {"text": f"what the robot's nodes did cannot be told: {error}", "steps": [], "notes": []}
        if followed is None or (answer.empty and not followed.is_known):
            return None
        return followed.page_form()

    def _selected(self, message: types.Ask, frame: int, settings: Settings) -> Selection | None:
        """Return the selection of a question: named by its text, or by a click in the viewer."""
        from bevviz.why.selection import Selection

        if "pick" in message:
            return Selection.parse(message["pick"])
        position: Sequence[float] = [one for one in message.get("position") or () if one is not None]
        if self._overlay is not None and position:
            position = self._overlay.position(round(message["time"]), message.get("view", ""), position)
        return self._source.select(frame, settings, message["entity"], message.get("instance"), position)

    async def _try(self, message: types.Try) -> None:
        from bevviz.workbench.page_messages import controls

        self._stop_try()
        overlay, workbench, settings = self._overlay, self._workbench, message.get("set", ())
        attempt = None if overlay is None else overlay.attempt()
        number = self._trying = message["id"]
        try:
            frame, identity = await self._frame(message), _identity(message)
            effects = await self._in_turn(
                number, lambda: workbench.try_values(frame, settings, identity, attempt), settings
            )
        finally:
            if self._trying == number:
                self._trying = 0
        head: types.Reply = {"id": number, "frame": frame, "set": settings}
        await self._send({"type": "tried", **head, **effects})
        new_controls = controls(self._source.configured(settings), self._opened)
        if new_controls != self._controls:  # a stage was replaced by a user's function, or is no longer
            self._controls = new_controls
            await self._send({"type": "controls", "controls": new_controls})

    def _stop_try(self) -> None:
        """Stop the try in progress, and give the next one a new thread.

        The old thread ends after the current step and the questions that wait behind the try.
        """
        if self._trying and self._overlay is not None:
            self._trying = 0
            self._overlay.stop()
            self._tries.shutdown(wait=False)
            self._tries = ThreadPoolExecutor(1, "tries")

    async def _settle(self, message: types.Settle) -> None:
        """Compute the result of the frame that the page has stopped at, before a question about it comes."""
        frame, settings = await self._frame(message), message.get("set", ())
        await self._in_turn(message["id"], lambda: self._source.look(frame, settings), settings, idle=True)

    async def _remark_rows(self, message: types.Remarks) -> None:
        """Send the remarks on the first rows of the page's list, one by one, behind all questions."""
        self._rows = message["rows"]
        if self._remarking:
            return
        self._remarking = True
        try:
            while self._rows:
                row = self._rows.pop(0)
                remark = await asyncio.to_thread(self._remark, row)
                await self._send({"type": "remark", **row, **remark})
        finally:
            self._remarking = False

    def _remark(self, row: types.Row) -> types.RowRemark:
        """Return the remark on a row. The next one waits as long as this one took."""
        from bevviz.workbench.page_messages import row_remark

        self._source.wait_for_quiet()
        start = time.monotonic()
        try:
            remark = row_remark(self._source.remark(row["frame"], row["pick"]))
        except UserError:  # The list has changed meanwhile.
            remark = {"remark": "", "chip": "", "text": ""}
        time.sleep(min(time.monotonic() - start, 1.0))
        return remark

    async def _drive(self, message: types.RunDrive) -> None:
        """Run the drive with other values."""
        await asyncio.to_thread(self._workbench.tools.trials.begin, message["set"], message.get("span"))

    async def _fix(self, message: types.FindFix) -> None:
        """Search values that repair the drive."""
        self._workbench.tools.fix.begin()

    async def _cancel(self, message: types.Cancel) -> None:
        if message["what"] == "try":
            self._stop_try()
            return
        workbench = self._workbench
        if message["what"] == "report":
            workbench.reports.cancel()
        else:
            tools = workbench.tools
            (tools.fix if message["what"] == "fix" else tools.trials).cancel()

    async def _report(self, message: types.MakeReport) -> None:
        workbench, settings = self._workbench, message.get("set", ())
        range_ = message["before"], message["after"]
        asked = await self._frame(message), settings, *range_, message["text"], _identity(message)
        await self._in_turn(message["id"], lambda: workbench.begin_report(*asked), settings)

    async def _note(self, message: types.AddNote) -> None:
        number, text, span = message["id"], message["text"], message.get("span")
        frame, identity = await self._frame(message), _identity(message)
        about = await self._in_turn(
            number, lambda: self._workbench.note(frame, text, identity, self._overlay, span)
        )
        said = f"Noted about {about}{'' if span else f' in frame {frame}'}."
        await self._send({"type": "noted", "id": number, "text": said})

    async def _unnote(self, message: types.RemoveNote) -> None:
        stamp, text = int(message["stamp"]), message["text"]
        await self._in_turn(message["id"], lambda: self._workbench.remove_note(stamp, text))

    async def _draw_label(self, message: types.DrawLabel) -> None:
        """Draw a label of an object, and keep it if the page says so."""
        from bevviz.workbench.page_messages import label_box, label_of_page

        workbench, source, number = self._workbench, self._source, message["id"]
        frame, identity = await self._frame(message), _identity(message)
        if identity is None:
            raise UserError("ask about an object or a place first")
        drawn = label_of_page(message["box"]) if "box" in message else None

        def work() -> types.Label:
            label = workbench.draw_label(frame, identity, drawn, self._overlay)
            kept = workbench.keep_label(frame, label) if message.get("keep") else ""
            return {
                "type": "label",
                "id": number,
                "frame": frame,
                "set": (),
                "box": label_box(label.label, label.box),
                "points": label.points,
                "pick": label.pick,
                "classes": source.pipeline.stages.class_names,
                "kept": kept,
            }

        await self._send(await self._in_turn(number, work))

    async def _handle_finding(self, message: types.Handle) -> None:
        """Keep that a finding is done or ignored."""
        await self._in_turn(message["id"], lambda: self._workbench.handle(message["finding"]))

    async def _shown(self, message: types.Shown) -> None:
        """Let the run continue: the page has drawn its first frame."""
        self._source.go_on()

    async def _frame(self, message: types.AboutFrame | types.Origin) -> int:
        """Return the number of the frame that the page shows. The run may not have reached it yet."""
        return await asyncio.to_thread(self._source.number_at, round(message["time"]))


def _identity(message: types.AboutFrame) -> Identity | None:
    """Return the identity that a message names, if it names one."""
    from bevviz.why.identity import Identity

    pick = message.get("pick", "")
    return Identity.parse(pick) if pick.startswith("{") else None


@contextlib.contextmanager
def news_event(news: News) -> Iterator[asyncio.Event]:
    """Return an event that is set whenever there is news, from any thread."""
    event, loop = asyncio.Event(), asyncio.get_running_loop()

    def notify() -> None:
        with contextlib.suppress(RuntimeError):  # The server has ended.
            loop.call_soon_threadsafe(event.set)

    stop = news.listen(notify)
    try:
        yield event
    finally:
        stop()
