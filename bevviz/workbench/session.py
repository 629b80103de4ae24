"""The workbench session of a page: questions about frames and their answers, tried values, notes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.bags.source import iso
from bevviz.config import changed_config
from bevviz.drive import Drive
from bevviz.errors import UserError
from bevviz.evaluate import Truth
from bevviz.findings.run_table import run_table
from bevviz.model.frame import Boxes3D, Frame
from bevviz.model.protocols import FrameSource
from bevviz.pipeline.notes import HandledFinding, Note, Notes
from bevviz.report.report_subject import TriedValues
from bevviz.support.contexts import Closable
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.frame_index import FrameIndex
from bevviz.why.identity import Identity, find, identify
from bevviz.why.kept_labels import box_of, is_label_in, kept_truth, proposed_label
from bevviz.why.resolve import select_subjects
from bevviz.why.subject import points_in_box
from bevviz.workbench.fix_search import FixSearch
from bevviz.workbench.growing_drive import GrowingDrive, Settings, Span
from bevviz.workbench.page_overlay import Attempt, PageOverlay
from bevviz.workbench.recorded_drive import RecordedDrive
from bevviz.workbench.reports import LONGEST, ReportedBag, ReportJob, ReportMaker, folder_beside
from bevviz.workbench.trials import TrialRunner, TriedEffects, frame_effects, trial_effects

if TYPE_CHECKING:
    from bevviz.workbench.page_types import Progress

ASKED = 8  # answers that are kept for reports


@dataclass(frozen=True, slots=True)
class DriveTools:
    """Trials, search of a fix, and notes of a recorded drive.

    Attributes:
        trials: runs over the drive with other values.
        fix: search of values that repair it.
        notes: notes of the user, saved beside the bag.
    """

    trials: TrialRunner
    fix: FixSearch
    notes: Notes


@dataclass(frozen=True, slots=True)
class DrawnLabel:
    """A label that the user draws.

    Attributes:
        label: its class.
        box: its box in the frame of the points.
        points: number of raw points in the box.
        answer: answer about the object that it is drawn for.
        pick: identity of that object as text.
    """

    label: str
    box: Boxes3D
    points: int
    answer: Answer
    pick: str


class WorkbenchSession(Closable):
    """Workbench session of a drive or a robot. Several threads may ask, each about results of its own.

    Args:
        source: source of the frames.
        reports: maker of reports. None: the frames are not made of messages.
        tools: tools of a recorded drive. None: the source is a robot.

    Attributes:
        notes_version: number that changes with the notes. -1: there are none.
    """

    def __init__(
        self, source: GrowingDrive, reports: ReportMaker | None = None, tools: DriveTools | None = None
    ) -> None:
        self.source, self._reports, self._tools = source, reports, tools
        self.notes_version = -1 if tools is None else 0
        source.kept_labels = self._kept_labels
        self._local = threading.local()  # The explainer of each thread that asks.
        self._lock = threading.Lock()  # guards _answers
        self._answers: OrderedDict[tuple[int, Settings, str], tuple[int, Answer]] = OrderedDict()

    @property
    def tools(self) -> DriveTools:
        """Trials, search of a fix, and notes.

        Raises:
            UserError: the source is a robot.
        """
        if self._tools is None:
            raise UserError(
                "that is for a drive that is over: save what was seen, and open the recording's bag"
            )
        return self._tools

    @property
    def reports(self) -> ReportMaker:
        """Bug reports.

        Raises:
            UserError: the frames are not made of messages.
        """
        if self._reports is None:
            raise UserError("there are no messages that a report could be cut from")
        return self._reports

    def notes(self) -> list[Note]:
        """Return the notes. A robot has none."""
        return [] if self._tools is None else list(self._tools.notes)

    def start(self) -> None:
        """Start to make frames."""
        self.source.start()

    def close(self) -> None:
        """Stop the trials, the reports and the run, and release the files."""
        if self._tools is not None:
            self._tools.fix.cancel()
            self._tools.trials.end()
        if self._reports is not None:
            self._reports.end()
        self.source.close()

    def progress(self) -> Progress:
        """Return the progress message for the page."""
        fixes = [] if self._tools is None else self._tools.fix.jobs
        return {
            "type": "progress",
            **self.source.progress(),
            "reports": [] if self._reports is None else self._reports.jobs,
            "trials": [] if self._tools is None else self._tools.trials.jobs,
            "fix": fixes[-1] if fixes else None,
        }

    # --- questions -----------------------------------------------------------------------------

    def ask(self, number: int, settings: Settings, selection: Selection) -> list[Answer]:
        """Explain an object: why was it reported or not?

        Returns:
            The answer, then the answers about other subjects at the same place.

        Raises:
            UserError: there is no such object in the frame.
        """
        explainer, answers, candidates = self._answers_about(number, settings, selection)
        if not answers:
            raise UserError(f"there is nothing to say about {selection}")
        answer = answers[0]
        if not candidates and (nearby := answer.surroundings) is not None:
            candidates = explainer.candidates(nearby)
        self._keep(number, settings, selection, answer)
        return [answer, *(other for other in candidates if other.subject.key != answer.subject.key)]

    def identity(
        self, number: int, settings: Settings, selection: Selection, answer: Answer, known: Identity | None
    ) -> Identity:
        """Return the identity of an answer's subject.

        Args:
            number: number of the frame.
            settings: settings of the answer.
            selection: the selection that was asked about.
            answer: the answer.
            known: identity by which the subject was found. It gets the new place.
        """
        source = self.source
        result, opened, tracks = source.look(number, settings), source.look(number), source.tracks(number)
        identity = identify(answer.subject, selection, result, tracks if result is opened else None)
        if result is not opened and identity.kind != "truth" and not identity.place:
            same, _ = find(identity, opened, opened, None)
            if same is not None and not same.is_place:
                (subject,) = select_subjects(FrameIndex(opened), same)
                identity = replace(identity, track=identify(subject, same, opened, tracks).track)
        if known is None or identity.place:
            return known or identity
        track = identity.track if identity.track >= 0 else known.track
        return replace(known, frame=number, at=identity.at or known.at, box=identity.box, track=track)

    def follow(
        self, identity: Identity, number: int, settings: Settings = ()
    ) -> tuple[Selection | None, str]:
        """Find the object of an identity in a frame, see ``bevviz.why.identity.find``."""
        source = self.source
        return find(identity, source.look(number, settings), source.look(number), source.tracks(number))

    def hints(self, number: int, settings: Settings, selection: Selection) -> Answer:
        """Answer with hints: parameter changes that would change the verdict. This takes longer than ``ask``.

        Raises:
            UserError: as ``ask``.
        """
        explainer, answers, _ = self._answers_about(number, settings, selection)
        answer = explainer.with_hints(answers[0])
        self._keep(number, settings, selection, answer)
        return answer

    def _answers_about(
        self, number: int, settings: Settings, selection: Selection
    ) -> tuple[FrameExplainer, list[Answer], list[Answer]]:
        """Return the explainer of the frame, the answers, and those of them that a place selects."""
        result = self.source.look(number, settings)
        known, labels = getattr(self._local, "explainer", None), self.labels(result.frame)
        if known is None or known[0] is not result or known[1] != labels:
            known = self._local.explainer = result, labels, self.source.explainer(result)
        explainer: FrameExplainer = known[2]
        candidates = explainer.candidates(selection) if selection.is_place else []
        return explainer, candidates or explainer.ask(selection), candidates

    def _keep(self, number: int, settings: Settings, selection: Selection, answer: Answer) -> None:
        """Keep an answer for reports. One with hints replaces one without."""
        key, received = (number, settings, str(selection)), self.source.look(number).frame.received
        with self._lock:
            if answer.hints or key not in self._answers:
                self._answers[key] = received, answer
            self._answers.move_to_end(key)
            while len(self._answers) > ASKED:
                self._answers.popitem(last=False)

    def begin_report(
        self,
        number: int,
        settings: Settings,
        before: float,
        after: float,
        note: str,
        identity: Identity | None = None,
    ) -> ReportJob:
        """Start to make a report.

        Args:
            number: number of the frame that it is about.
            settings: values that are tried. The report is of the drive as opened, and says what they change.
            before: seconds before the frame.
            after: seconds after the frame.
            note: what went wrong, in the user's words.
            identity: the object that the page shows. None: the report is about the worst of the frame.

        Raises:
            UserError: a report is in progress, there is no such frame, the object is not in it, the range is
                too long, or a value is wrong.
        """
        from bevviz.report.make import ReportRequest

        reports = self.reports
        reports.check_idle("a report is being made")
        if not (0 <= before <= LONGEST and 0 <= after <= LONGEST):
            raise UserError(f"a report is of up to {LONGEST:g} seconds before and after")
        bag, received = reports.bag_of(number), self.source.look(number, settings).frame.received
        low, high = received - round(before * 1e9), received + round(after * 1e9)
        about = None if identity is None else self._about(number, identity)
        changed_config(bag.config, settings)  # Wrong values are told before the report is begun.
        request = ReportRequest(
            paths=bag.paths,
            config=bag.config,
            at=iso(received),
            before=before,
            after=after,
            output=reports.output(bag, received),
            note=note.strip(),
            answers=[] if about is None else [about],
            result=self.source.look(number),
            asked=[answer for frame, answer in self._asked_within(low, high) if frame != number],
            tried=self.tried_on(number, settings, about) if settings else None,
            notes=self.notes(),
        )
        return reports.begin(request, settings)

    def _about(self, number: int, identity: Identity) -> Answer:
        """Return the answer about an object in a frame of the drive as opened, with hints if it has them.

        Raises:
            UserError: the object is not in the frame.
        """
        selection, reason = self.follow(identity, number)
        if selection is None:
            raise UserError(
                f"{identity.name} is not in frame {number} of the drive as opened: {reason}; "
                "a report is about the drive as opened: ask about an object of the frame first"
            )
        answer = self.ask(number, (), selection)[0]
        with self._lock:
            kept = list(self._answers.items())
        same = (
            other
            for (frame, settings, _), (_, other) in reversed(kept)
            if (frame, settings, other.subject.key) == (number, (), answer.subject.key) and other.hints
        )
        return next(same, answer)

    def _asked_within(self, low: int, high: int) -> list[tuple[int, Answer]]:
        """Return the answers about the drive as opened in a range of log times, newest first.

        Each comes with the number of its frame. Of several answers about one object of a frame, the newest
        is returned.
        """
        answers: dict[tuple[object, ...], tuple[int, Answer]] = {}
        with self._lock:
            kept = list(self._answers.items())
        for (number, settings, _), (received, answer) in reversed(kept):
            if not settings and low <= received <= high:
                answers.setdefault((number, *answer.subject.key), (number, answer))
        return list(answers.values())

    def tried_on(self, number: int, settings: Settings, answer: Answer | None) -> TriedValues:
        """Return what other values do to the object of an answer, to its frame, and to the drive."""
        before, after = self.source.look(number), self.source.look(number, settings)
        row = -1
        answer_then = None
        if answer is not None and answer.selection is not None:
            identity = self.identity(number, (), answer.selection, answer, None)
            selection, _ = self.follow(identity, number, settings)
            row = answer.subject.row if answer.subject.kind == "truth" else -1
            answer_then = None if selection is None else self.ask(number, settings, selection)[0]
        texts = [trial.text for trial in self.tools.trials.jobs if trial.settings == settings]
        drive = texts[-1] if texts else ""
        effects = frame_effects(before, after, self.source.truth(after.frame), row)
        return TriedValues(settings, answer_then, effects, drive)

    def try_values(
        self,
        number: int,
        settings: Settings,
        identity: Identity | None = None,
        attempt: Attempt | None = None,
    ) -> TriedEffects:
        """Show a frame with other values, and return their effects.

        Args:
            number: number of the frame.
            settings: the other values.
            identity: the object that the values are tried for. Its effect comes first.
            attempt: attempt of the page that shows the frame.

        Raises:
            UserError: a parameter is unknown, a value is wrong, or the attempt was stopped.
        """
        before, after = self.source.try_values(number, settings, attempt)
        selection = None if identity is None else self.follow(identity, number)[0]
        asked_row = None if selection is None else selection.truth
        return trial_effects(
            before, after, self.source.truth(after.frame), -1 if asked_row is None else asked_row
        )

    # --- notes ---------------------------------------------------------------------------------

    def note(
        self,
        number: int,
        text: str,
        identity: Identity | None,
        overlay: PageOverlay | None = None,
        span: Span | None = None,
    ) -> str:
        """Save a note about a span, an object, or the frame if the object is not in it. Return its subject.

        Raises:
            UserError: the note cannot be written.
        """
        result, name, pick = self.source.look(number), "", ""
        selection = None if identity is None else self.follow(identity, number)[0]
        if selection is not None:
            answer = self.ask(number, (), selection)[0]
            self.source.mark(result, answer, overlay)
            name = answer.subject.name
            pick = str(self.identity(number, (), selection, answer, identity))
        stamp, received, end = result.frame.stamp, result.frame.received, 0
        if span is not None:
            first = self.source.look(self.source.number_at(int(span["first"]))).frame
            end = int(span["last"])
            stamp, received = first.stamp, first.received
            name = name or f"the span of {(end - stamp) / 1e9:.2f} s"
        self.tools.notes.add(Note(stamp, received, text.strip(), name.removeprefix("the "), pick, end))
        self._tell_notes()
        return name or "the frame"

    def remove_note(self, stamp: int, text: str) -> None:
        """Remove a note.

        Raises:
            UserError: the file cannot be written.
        """
        notes = [note for note in self.tools.notes if (note.stamp, note.text) == (stamp, text)]
        for note in notes:
            self.tools.notes.remove(note)
        if any(note.label for note in notes):
            self._forget_answers()
        self._tell_notes()

    # --- labels --------------------------------------------------------------------------------

    def draw_label(
        self,
        number: int,
        identity: Identity,
        drawn: tuple[str, Boxes3D] | None = None,
        overlay: PageOverlay | None = None,
    ) -> DrawnLabel:
        """Show a label of an object in every view of a page, and return it.

        Args:
            number: number of the frame.
            identity: the object.
            drawn: class and box. None: those that are kept, or that the object seems to have.
            overlay: overlay of the page.

        Raises:
            UserError: the object is not in the frame.
        """
        selection, reason = self.follow(identity, number)
        if selection is None:
            raise UserError(f"{identity.name} is not in frame {number}: {reason}")
        explainer, answers, _ = self._answers_about(number, (), selection)
        answer, traces = answers[0], explainer.traces
        if drawn is None and (note := self._note_of(answer, traces.result.frame)) is not None:
            drawn = note.label, box_of(note.box)
        label, box = drawn or proposed_label(answer.subject, traces)
        subject = replace(answer.subject, name=f"your label: {label}", box=box, xyxy=None)
        self.source.mark(traces.result, replace(answer, subject=subject), overlay)
        points = int(points_in_box(box, traces.result.frame.points).sum())
        about = self.identity(number, (), selection, answer, identity)
        if answer.subject.kind != "detection":  # An image box finds its label, wherever that is drawn.
            x, y, z = (round(value, 2) for value in box.center[0].tolist())
            place = Selection(point=(x, y, z))
            about = Identity(kind="point", label=f"the place of the {label}", frame=number, place=str(place))
        return DrawnLabel(label, box, points, answer, str(about))

    def keep_label(self, number: int, drawn: DrawnLabel) -> str:
        """Keep a label beside the bag, in place of an earlier one of the same object. Return what was done.

        Raises:
            UserError: the file cannot be written.
        """
        frame, notes = self.source.look(number).frame, self.tools.notes
        if (earlier := self._note_of(drawn.answer, frame)) is not None:
            notes.remove(earlier)
        center, size = drawn.box.center[0].tolist(), drawn.box.size[0].tolist()
        box = tuple(round(value, 3) for value in (*center, *size, float(drawn.box.yaw[0])))
        text = f"kept as truth: {' x '.join(f'{value:.2f}' for value in size)} m"
        about = f"{drawn.label} at {float(drawn.box.distance[0]):.1f} m"
        times = frame.stamp, frame.received
        notes.add(Note(*times, text, about, drawn.pick, 0, drawn.label, box, frame.points_frame))
        self._forget_answers()
        self._tell_notes()
        return f"Kept in {notes.path}: the {about}. The note in the list removes it."

    def labels(self, frame: Frame) -> tuple[Note, ...]:
        """Return the notes with the labels of a frame that the user keeps."""
        with suppress(UserError):
            return tuple(note for note in self.notes() if is_label_in(note, frame))
        return ()

    def _note_of(self, answer: Answer, frame: Frame) -> Note | None:
        """Return the note with the label that an answer is about. None: there is no label."""
        labels = self.labels(frame)
        return labels[answer.label] if 0 <= answer.label < len(labels) else None

    def _kept_labels(self, frame: Frame) -> Truth | None:
        """Return the labels of a frame that the user keeps. None: there are none."""
        return kept_truth(self.labels(frame), frame, self.source.pipeline.stages.class_names)

    def _forget_answers(self) -> None:
        """Forget the answers that were made with other labels."""
        self.source.forget_remarks()
        with self._lock:
            self._answers.clear()

    def handle(self, finding: HandledFinding) -> None:
        """Keep that a finding is done or ignored.

        Raises:
            UserError: the state is unknown, or the file cannot be written.
        """
        self.tools.notes.handle(finding)
        self._tell_notes()

    def _tell_notes(self) -> None:
        self.notes_version += 1
        self.source.news.tell()


def recorded_session(
    drive: Drive,
    again: FrameSource,
    paths: Sequence[Path],
    first: int = 0,
    labels: tuple[str | None, Path | None] = (None, None),
    opened: Callable[[FrameExplainer], None] = lambda explainer: None,
) -> WorkbenchSession:
    """Return the workbench session of a recorded drive.

    Args:
        drive: the drive that questions are about.
        again: the same frames a second time. The run reads them while questions read those of ``drive``.
        paths: paths of the bag.
        first: number of the scan that is shown first.
        labels: stated topic and files of the ground truth.
        opened: called once a page shows the first frame, before the run.
    """
    recording = getattr(drive.frames, "recording", None)
    files = [] if recording is None else [file.path for file in recording.files]
    table = run_table(files, drive.config, drive.session.stages.provider, labels) if files else None
    source = RecordedDrive(drive, again, first, table, opened)

    def bag_of(number: int) -> ReportedBag:
        return ReportedBag(paths, drive.config, int(drive.frames.scans[0]))

    reports = ReportMaker(source.news.tell, bag_of, folder_beside(paths))
    fix = FixSearch(source, paths, *labels)
    return WorkbenchSession(source, reports, DriveTools(TrialRunner(source), fix, Notes(paths)))
