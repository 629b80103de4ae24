"""Make a report: cut the window, run it, and write the recording, the page and the bag."""

from __future__ import annotations

import errno
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from bevviz.bags.message import RawMessage
from bevviz.bags.reader import megabytes
from bevviz.bags.source import MARGIN, SECOND, BagSource
from bevviz.config import Config, changes, load
from bevviz.errors import UserError
from bevviz.model.frame import Camera, Frame, Scene
from bevviz.model.protocols import Observer
from bevviz.model.results import Detections, FrameResult
from bevviz.pipeline.notes import Note
from bevviz.pipeline.run import Progress, run
from bevviz.pipeline.session import Session
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.recording import blueprints, entities, views
from bevviz.recording.primitives import document
from bevviz.recording.provenance import Provenance, model_path, names_path, provenance, versions
from bevviz.recording.recorder import DiskWatch, Recorder
from bevviz.recording.sinks import open_recording
from bevviz.recording.source_lookup import Origin
from bevviz.report.bag_window import (
    MILLISECOND,
    CutContent,
    Edited,
    MadeMessage,
    ReportWindow,
    check_patterns,
    choose_topics,
    cut_bag,
    find_window,
    open_window,
    unchanged,
)
from bevviz.report.facts import (
    Facts,
    ReportInfo,
    commands,
    file_lines,
    shareable,
    traceback_texts,
    window_text,
)
from bevviz.report.fingerprints import digest, pack
from bevviz.report.page import page
from bevviz.report.redact import Redactor
from bevviz.report.report_subject import LISTED, TriedValues, cause_of, explain_subject
from bevviz.report.result_topics import result_messages, without_result_files
from bevviz.report.summary import WindowSummary
from bevviz.stages.detector import Detector
from bevviz.support import cleanup, progress
from bevviz.support.files import file_hash, save_text
from bevviz.support.onnx_files import with_weights
from bevviz.support.unfinished_folder import UnfinishedFolder
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.log import clear_answers, log_answers
from bevviz.why.neighbours import frames_beside

DetectionsByImage = Mapping[tuple[str, int], Detections]  # by camera name and image stamp


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportRequest:
    """Request for a report.

    Attributes:
        paths: paths of the bag.
        config: configuration of the run.
        at: time of the frame that the report is about.
        before: seconds before it.
        after: seconds after it.
        output: path of the recording.
        note: what went wrong, in the user's words.
        topics: patterns of topics for the bag, beside those that the pipeline reads. None: all topics.
        redact: hide people and vehicles.
        unredacted: patterns of topics that are kept even if their content is unknown.
        include_model: copy the model file.
        force: overwrite files.
        selection: the object that the report is about. An empty selection means the worst of the frame.
        answers: answers about the frame, its subject first. Empty: the report asks for itself.
        result: result of the frame that the answers are about. None: the frame is run.
        asked: answers about other frames.
        tried: values that the user tried.
        notes: notes of the whole drive.
    """

    paths: Sequence[Path]
    config: Config
    at: str
    before: float = 5.0
    after: float = 5.0
    output: Path = Path("bug.rrd")
    note: str = ""
    topics: Sequence[str] | None = None
    redact: bool = False
    unredacted: Sequence[str] = ()
    include_model: bool = False
    force: bool = False
    selection: Selection = field(default_factory=Selection)
    answers: Sequence[Answer] = ()
    result: FrameResult | None = None
    asked: Sequence[Answer] = ()
    tried: TriedValues | None = None
    notes: Sequence[Note] = ()


@dataclass(slots=True)
class WrittenReport:
    """Outcome of ``make``."""

    files: list[Path] = field(default_factory=list)
    frames: int = 0
    interrupted: bool = False
    warnings: list[str] = field(default_factory=list)


def make(
    request: ReportRequest,
    observers: Sequence[Observer[FrameResult]] = (),
    stop: threading.Event | None = None,
) -> WrittenReport:
    """Write the report. If the run is interrupted, the report has the frames until then.

    The pipeline runs on the bag that was cut out, so that a later run of it gives the same results. With
    ``redact`` the images of that bag are changed, and the network would see less in them. So the network runs
    on the original images, its detections are stored in the recording, and every check uses these.

    The files are written into an unfinished folder and get their names when all of them are complete.

    Args:
        request: the request.
        observers: further observers of the run.
        stop: ends the run when it is set, as an interrupt does.

    Raises:
        UserError: the input is wrong, the time is outside the bag, or a file exists or cannot be written.
    """
    written = WrittenReport()
    rrd, html, bag = (request.output.with_suffix(suffix) for suffix in (".rrd", ".html", ".mcap"))
    model = model_path(request.config) if request.include_model else None
    _check_targets(request, [rrd, html, bag], model)
    with ExitStack() as stack:
        whole_bag = stack.enter_context(BagSource(request.paths, request.config, at=request.at))
        window = find_window(whole_bag, whole_bag.span[0], request.before, request.after)
        topics = choose_topics(whole_bag.recording, whole_bag.roles, request.topics)
        redactor = detections = None
        if request.redact:
            check_patterns(whole_bag.recording, request.unredacted, "--unredacted")
            redactor = Redactor(
                request.config.detector, whole_bag.recording, whole_bag.roles.lidars, request.unredacted
            )
        # Delete an older report first. If this run fails, nobody may take the old files, perhaps
        # unredacted, for the new ones.
        unfinished = stack.enter_context(_unfinished_report([rrd, html, bag]))
        rrd, html, bag = (unfinished / target.name for target in (rrd, html, bag))
        if request.redact:
            detections = _detect(request, window)
        detect = None if detections is None else replay(detections)
        loader = StageLoader(store=not request.redact)  # Nothing of a redacted report is kept.
        asked = _ask(request, whole_bag, loader)
        answers = () if asked is None else asked.answers
        made: list[MadeMessage] = []
        if whole_bag.results:
            low = max(window.low - MARGIN, whole_bag.recording.start)  # The bag has the scans beside it, too.
            high = min(window.high + MARGIN, whole_bag.recording.end + MILLISECOND)
            with open_window(request.paths, request.config, low, high) as source_of_results:
                made = list(result_messages(source_of_results))
            request = replace(request, config=without_result_files(request.config))
        session = stack.enter_context(Session(request.config, detect, loader=loader))
        content = _cut(whole_bag, window, topics, bag, redactor, made)
        written.files.append(bag)
        written.warnings += [
            *whole_bag.recording.warnings,
            *content.left_out,
            *(redactor.notes if redactor else ()),
        ]
        if model is not None:
            written.files += [shutil.copyfile(path, unfinished / path.name) for path in _network_files(model)]
        notes = [note for note in request.notes if window.low <= note.received < window.high]
        public = shareable(request.config)
        source = stack.enter_context(open_window([bag], request.config, window.low, window.high))
        origin = Origin.of(source.scene, request.config, rrd, folders=False, redacted=request.redact)
        focus = None if not answers else answers[0].center
        scene = replace(
            whole_bag.scene, bag=(), focus=focus
        )  # The recording must not contain the bag's path.
        recorded = stack.enter_context(ExitStack())
        sinks = recorded.enter_context(
            open_recording(
                scene, public, save=rrd, keep=False, blueprint=_layout(scene, public), origin=origin
            )
        )
        recording = sinks.recording
        written.files.insert(0, rrd)
        summary = WindowSummary(
            window.at,
            None if request.result is None else request.result.frame.stamp,
            source.total,
            len(whole_bag.scene.cameras),
        )
        recorder = _ReportRecorder(
            recording, public, summary, request.note, notes, answers, session.stages.provider
        )
        watchers = [recorder, DiskWatch(sinks), Progress("run"), *observers]
        outcome = run(source, session, watchers, stop=stop)
        written.interrupted = outcome.interrupted or (stop is not None and stop.is_set())
        written.frames = len(summary.frames)
        written.warnings += [warning for warning in source.warnings if warning not in written.warnings]
        written.warnings = [_without_folders(warning, [*request.paths, bag]) for warning in written.warnings]
        made_with = provenance(request.config, session.stages.provider)
        facts = _facts(
            request, public, window, content, written, made_with, summary, whole_bag.scene.name, notes, asked
        )
        info = _info(request, window, written, made_with, bag)
        recording.send_property("report", rr.AnyValues(about=info.dump()))
        recording.log(entities.REPORT, document(facts.markdown()), static=True)
        recorded.close()
        save_text(html, page(facts, summary, file_hash(rrd), answers[:1]), "-o")
        written.files.insert(1, html)
        folder = request.output.parent
        # The page that people open comes last.
        for path in sorted(written.files, key=lambda path: path == html):
            path.replace(folder / path.name)
        written.files = [folder / path.name for path in written.files]
    return written


@contextmanager
def _unfinished_report(targets: Sequence[Path]) -> Iterator[Path]:
    """Delete an older report. Yield a folder for the files of the new one, which is deleted at the end.

    Raises:
        UserError: the files cannot be written, or another process writes a report of the same name.
    """
    try:
        unfinished = UnfinishedFolder(targets[0].with_suffix(""))
    except OSError as error:
        raise UserError(f"{targets[0]}: cannot write the report: {error.strerror}") from None
    cleanup.register(unfinished, unfinished.discard)
    try:
        for target in targets:
            target.unlink(missing_ok=True)
        yield unfinished.path
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EISDIR, errno.EPERM, errno.EACCES):
            raise
        raise UserError(f"{targets[0]}: cannot write the report: {error.strerror}") from None
    finally:
        cleanup.unregister(unfinished)
        unfinished.discard()


@dataclass(frozen=True, slots=True)
class _Asked:
    """Answers that the report opens on, about its frame in the whole drive."""

    result: FrameResult
    answers: Sequence[Answer]


def _ask(request: ReportRequest, source: BagSource, loader: StageLoader) -> _Asked | None:
    """Return the answers about the frame of a report. None: the scan cannot be read."""
    session = Session(request.config, loader=loader)
    result = request.result
    if result is None:
        frame = next(iter(source), None)
        if frame is None:  # The run names what is wrong with the scan.
            return None
        result = session.run_explained(frame)
    beside = frames_beside(source, result.frame.index)
    explainer = FrameExplainer(result, loader, session.stages.class_names, neighbours=beside)
    return _Asked(result, explain_subject(explainer, request.selection, request.answers))


def _layout(scene: Scene, config: Config) -> rrb.Blueprint:
    """Return the layout of a report. It opens on the last frame of the timeline ``report``, its own frame."""
    layout = blueprints.load("bug_report", scene, config)
    layout.time_panel = views.time_panel(play=rrb.components.PlayState.Following, timeline=entities.REPORTED)
    return layout


class _ReportRecorder(Recorder):
    """Recorder that also logs fingerprints, the note and the subject, and collects the summary for the page.

    The timeline ``report`` ends with the frame that the report is about, so that a viewer opens on it.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        config: Config,
        summary: WindowSummary,
        note: str,
        notes: Sequence[Note],
        answers: Sequence[Answer],
        network: str,
    ) -> None:
        super().__init__(recording, config, network)
        self._summary, self._note, self._notes = summary, note, notes
        self._answers = answers

    def observe(self, result: FrameResult) -> None:
        frame = result.frame
        lines = [f"note: {note}" for note in self._notes if note.received == frame.received]
        states: dict[str, str] = {}
        is_reported = self._summary.is_about(frame)
        if is_reported:
            lines += [answer.text for answer in self._answers[:1]]
            if self._note:
                lines.insert(0, f"note: {self._note}")
            subject = self._answers[0] if self._answers else None
            if subject is not None:
                states[entities.STATE.path("report")] = (
                    f"{subject.subject.name}: {subject.verdict.kind.value}"
                )

        def mark() -> None:
            """Mark the subject in its frame alone."""
            if is_reported:
                log_answers(self.logger, frame, self._answers, 1, result.config.bev)
            else:
                clear_answers(self.logger)

        self.logger.sequences = {entities.REPORTED: frame.index} if frame.received <= self._summary.at else {}
        self.logger.log(result, notes=[("INFO", line) for line in lines], states=states, log_more=mark)
        lines, block = pack(digest(result))
        self.recording.log(entities.DIGEST, rr.AnyValues(stages=lines, arrays=block))
        self._summary.add(result)


def replay(detections: DetectionsByImage) -> Callable[[Camera], Detections | None]:
    """Return a stand-in for the network that returns the stored detections."""

    def detect(camera: Camera) -> Detections | None:
        return None if camera.image is None else detections.get((camera.name, camera.image.stamp))

    return detect


def _network_files(model: Path) -> list[Path]:
    """Return the detector's file, and the files in its folder that hold its weights."""
    weights = with_weights(model)[1:]
    return [model, *(path for path in weights if path.parent == model.parent and not path.is_symlink())]


def _check_targets(request: ReportRequest, targets: Sequence[Path], model: Path | None) -> None:
    """Check that the output files may be written.

    Raises:
        UserError: the name is wrong, a file is an input, or a file exists already.
    """
    output = request.output
    if output.suffix != ".rrd":
        raise UserError(f"-o {output}: expected a file name that ends in .rrd")
    if not output.parent.is_dir():
        raise UserError(f"-o {output}: there is no folder {output.parent}")
    if request.include_model and model is None:
        raise UserError("--include-model: there is no model: give --model FILE.onnx")
    network = [] if model is None else _network_files(model)
    copies = [output.with_name(path.name) for path in network]
    inputs = {path.resolve() for path in [*request.paths, *network]}
    for target in [*targets, *copies]:
        if target.resolve() in inputs:
            raise UserError(f"-o {output}: {target} is what is read; give another name")
        if target.exists() and not request.force:
            raise UserError(f"{target} exists already; --force overwrites it")


class _Detections(Observer[DetectionsByImage]):
    """Run of the network alone, on the original images."""

    def __init__(self, config: Config) -> None:
        self.detections: dict[tuple[str, int], Detections] = {}
        self._detector = Detector(config.detector)

    def perceive(self, frame: Frame, network: Executor | None = None) -> DetectionsByImage:
        return {
            (camera.name, camera.image.stamp): self._detector(camera.image.bgr)
            for camera in frame.cameras
            if camera.image is not None and (camera.name, camera.image.stamp) not in self.detections
        }

    def finish(self, detections: DetectionsByImage) -> DetectionsByImage:
        return detections

    def observe(self, detections: DetectionsByImage) -> None:
        self.detections |= detections


def _detect(request: ReportRequest, window: ReportWindow) -> DetectionsByImage:
    """Return the detections in the original images of a window."""
    observer = _Detections(request.config)
    with open_window(request.paths, request.config, window.low, window.high) as source:
        if run(source, observer, [observer, Progress("detect")]).interrupted:
            raise KeyboardInterrupt
    return observer.detections


def _cut(
    source: BagSource,
    window: ReportWindow,
    topics: Sequence[str],
    bag: Path,
    redactor: Redactor | None,
    made: Sequence[MadeMessage],
) -> CutContent:
    """Cut the window out of the bag, with a progress bar."""
    low, high = window.low - MARGIN, window.high + MARGIN
    times = [source.recording.times(name) for name in topics]
    total = sum(int(((t >= low) & (t < high)).sum()) for t in times)
    with progress.bar(total=total, unit="message", desc="cut") as bar:

        def edit(message: RawMessage, data: bytes | memoryview) -> Edited:
            bar.update()
            return unchanged(message, data) if redactor is None else redactor(message, data)

        static = source.roles.tf_static
        return cut_bag(source.recording, window, topics, static, bag, edit, made=made)


def _info(
    request: ReportRequest, window: ReportWindow, written: WrittenReport, made_with: Provenance, bag: Path
) -> ReportInfo:
    """Return the machine-readable description of the report."""
    return ReportInfo(
        low=window.low,
        high=window.high,
        at=window.at,
        bag_sha256=file_hash(bag),
        provenance=made_with,
        names=_class_names(request.config),
        redacted=request.redact,
        interrupted=written.interrupted,
        note=request.note,
        warnings=written.warnings,
    )


def _facts(
    request: ReportRequest,
    public: Config,
    window: ReportWindow,
    content: CutContent,
    written: WrittenReport,
    made_with: Provenance,
    summary: WindowSummary,
    name: str,
    notes: Sequence[Note],
    frame: _Asked | None,
) -> Facts:
    """Return the text of the report."""
    answers = () if frame is None else frame.answers
    sizes = {
        path.name: f"{description}, {megabytes(path.stat().st_size)}"
        for path, description in zip(
            written.files[1:], ("the raw messages of the window", "the model"), strict=False
        )
    }
    sizes = {request.output.name: "everything that was seen, made and decided, for the Rerun viewer", **sizes}
    where = window_text(name, window)
    if written.interrupted:
        where += f"; interrupted after {written.frames} frames"
    if request.redact:
        where += "; people and vehicles that the detector finds are hidden in the images"
    stem = request.output.stem
    changed = changes(load(preset=public.preset), public)
    differs = f"with {len(changed)} parameter{'s' * (len(changed) > 1)} changed" if changed else "unchanged"
    headline = request.note.splitlines()[0] if request.note else answers[0].subject.name if answers else ""
    return Facts(
        title=f"{stem}: {headline}" if headline else stem,
        note=request.note,
        notes={f"{(note.received - window.start) / SECOND:.3f} s": str(note) for note in notes},
        cause=None
        if frame is None or not answers
        else cause_of(frame.result, (window.at - window.start) / SECOND, answers[0], request.tried),
        asked=[*answers[1 : 1 + LISTED], *request.asked],
        where=where,
        start=window.start,
        config=f"Preset {public.preset}, {differs}.",
        changes=changed,
        versions=[f"{name} {version}" for name, version in versions().items()],
        hardware=[f"{name}: {value}" for name, value in made_with.machine.items()],
        warnings=written.warnings,
        tracebacks=traceback_texts(summary.tracebacks),
        files=file_lines(sizes, content.counts, made_with.dependencies.get("detector.model")),
        commands=commands(request.output, window, public, request.redact, _helpful(request, answers)),
    )


def _helpful(request: ReportRequest, answers: Sequence[Answer]) -> Sequence[str]:
    """Return the settings to compare with: those that the user tried, else the best hint's."""
    if request.tried is not None:
        return request.tried.settings
    return answers[0].hints[0].settings if answers and answers[0].hints else ()


def _class_names(config: Config) -> str:
    """Return the content of the file with class names. The file itself is not part of the report."""
    path = names_path(config)
    return "" if path is None else path.read_bytes().decode()


def _without_folders(text: str, paths: Sequence[Path]) -> str:
    """Remove the folders of these paths from a text."""
    for path in paths:
        text = text.replace(str(path), path.name)
        if len(path.parent.parts) > 0 and str(path.parent) != path.root:
            text = text.replace(f"{path.parent}/", "").replace(str(path.parent), "the folder")
    return text
