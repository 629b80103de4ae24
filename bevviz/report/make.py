"""Makes a report: cuts the window, runs it, and writes the recording, the page and the bag."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import rerun as rr
from tqdm import tqdm

from bevviz.bags.reader import megabytes
from bevviz.bags.recording import RawMessage
from bevviz.bags.source import MARGIN, BagSource
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.frame import Camera, Detections, Frame, FrameResult
from bevviz.logging import entities
from bevviz.logging.logger import versions
from bevviz.logging.recorder import Recorder
from bevviz.logging.sinks import open_recording
from bevviz.progress import Progress
from bevviz.report.digest import digest, pack
from bevviz.report.facts import Facts, commands, file_lines, window_text
from bevviz.report.origin import (
    About,
    Hardware,
    changes,
    file_hash,
    hardware,
    model_of,
    model_path,
    shareable,
)
from bevviz.report.page import page
from bevviz.report.redact import Redactor
from bevviz.report.story import Story
from bevviz.report.window import Cut, Window, choose_topics, cut, find_window, open_window
from bevviz.run import Observer, run
from bevviz.session import Session
from bevviz.stages.detector import Detector, read_names

Found = Mapping[tuple[str, int], Detections]  # by camera and stamp of the image


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What is asked for.

    ``before`` and ``after`` are in seconds; ``topics``: patterns of those that go into the bag beside the
    ones that the pipeline reads, None: all; ``redact``: hide people and vehicles; ``force``: overwrite.
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
    include_model: bool = False
    force: bool = False


@dataclass(slots=True)
class Made:
    """What came of it."""

    files: list[Path] = field(default_factory=list)
    frames: int = 0
    interrupted: bool = False
    warnings: list[str] = field(default_factory=list)


def make(order: Order) -> Made:
    """Write the report. Interrupted while it runs, it is a report of the frames until then.

    The pipeline runs on the bag that was cut out, not on the whole one: so does whoever runs it again. With
    ``redact`` that bag's images are no longer those that the network should see; its detections, made on
    the whole images, are kept in the recording instead, and stand in for the network in every later check.

    Raises:
        UserError: wrong input, a time outside the bag, files that exist, or that cannot be written.
    """
    made = Made()
    rrd, html, bag = (order.output.with_suffix(suffix) for suffix in (".rrd", ".html", ".mcap"))
    model = model_path(order.config) if order.include_model else None
    _check_targets(order, [rrd, html, bag], model)
    with ExitStack() as stack:
        whole = stack.enter_context(BagSource(order.paths, order.config, at=order.at))
        window = find_window(whole, whole.span[0], order.before, order.after)
        topics = choose_topics(whole.recording, whole.roles, order.topics)
        redactor = found = None
        if order.redact:
            redactor = Redactor(order.config.detector, whole.recording, whole.roles.lidars)
            found = _detect(order, window)
        detect = None if found is None else replay(found)
        session = Session(order.config, detect)
        part = _cut(whole, window, topics, bag, redactor)
        made.files.append(bag)
        made.warnings += [*whole.recording.warnings, *part.left_out, *(redactor.notes if redactor else ())]
        if model is not None:
            made.files.append(Path(shutil.copyfile(model, rrd.with_name(model.name))))

        public = shareable(order.config)
        again = stack.enter_context(open_window([bag], order.config, window.low, window.high))
        sinks = open_recording(whole.scene, public, save=rrd, blueprint="bug_report")
        recording = stack.enter_context(sinks).recording
        made.files.insert(0, rrd)
        story = Story(window.at, again.total, len(whole.scene.cameras))
        recorder = _ReportRecorder(recording, public, story, window.at, order.note)
        made.interrupted = run(again, session, [recorder, Progress("run")]).interrupted
        made.frames = len(story.moments)
        made.warnings += [w for w in again.warnings if w not in made.warnings]
        made.warnings = [_without_folders(w, [*order.paths, bag]) for w in made.warnings]
        machine = hardware(session.stages.provider)
        facts = _facts(order, public, window, part, made, machine, whole.scene.name)
        recording.send_property(
            "report", rr.AnyValues(about=_about(order, window, made, machine, bag).dump())
        )
        document = rr.TextDocument(facts.markdown(), media_type=rr.MediaType.MARKDOWN)
        recording.log(entities.REPORT, document, static=True)
    try:
        html.write_text(page(facts, story), encoding="utf-8")
    except OSError as error:
        raise UserError(f"{html}: cannot write the page: {error.strerror}") from None
    made.files.insert(1, html)
    return made


class _ReportRecorder(Recorder):
    """Logs each frame with its fingerprints and the note, and tells the story of the page."""

    def __init__(
        self, recording: rr.RecordingStream, config: Config, story: Story, at: int, note: str
    ) -> None:
        super().__init__(recording, config)
        self._story, self._at, self._note = story, at, note

    def see(self, result: FrameResult) -> None:
        noted = self._note and result.frame.received == self._at
        self.logger.log(result, notes=[("INFO", f"note: {self._note}")] if noted else ())
        lines, block = pack(digest(result))
        self.recording.log(entities.DIGEST, rr.AnyValues(stages=lines, arrays=block))
        self._story.add(result)


def replay(found: Found) -> Callable[[Camera], Detections | None]:
    """In place of the network: what it found when the report was made."""

    def detect(camera: Camera) -> Detections | None:
        return None if camera.image is None else found.get((camera.name, camera.image.stamp))

    return detect


def _check_targets(order: Order, targets: Sequence[Path], model: Path | None) -> None:
    output = order.output
    if output.suffix != ".rrd":
        raise UserError(f"-o {output}: expected a file name that ends in .rrd")
    if not output.parent.is_dir():
        raise UserError(f"-o {output}: there is no folder {output.parent}")
    if order.include_model and model is None:
        raise UserError("--include-model: there is no model: give --model FILE.onnx")
    copy = [] if model is None else [output.with_name(model.name)]
    given = {path.resolve() for path in order.paths} | ({model.resolve()} if model is not None else set())
    for target in [*targets, *copy]:
        if target.resolve() in given:
            raise UserError(f"-o {output}: {target} is what is read; give another name")
        if target.exists() and not order.force:
            raise UserError(f"{target} exists already; --force overwrites it")


class _Detections(Observer[Found]):
    """What the network finds in the images as they are, which nobody else is going to see."""

    def __init__(self, config: Config) -> None:
        self.found: dict[tuple[str, int], Detections] = {}
        self._detector = Detector(config.detector)

    def perceive(self, frame: Frame, network: Executor | None = None) -> Found:
        return {
            (camera.name, camera.image.stamp): self._detector(camera.image.bgr)
            for camera in frame.cameras
            if camera.image is not None and (camera.name, camera.image.stamp) not in self.found
        }

    def finish(self, found: Found) -> Found:
        return found

    def see(self, found: Found) -> None:
        self.found |= found


def _detect(order: Order, window: Window) -> Found:
    detections = _Detections(order.config)
    with open_window(order.paths, order.config, window.low, window.high) as source:
        if run(source, detections, [detections, Progress("detect")]).interrupted:
            raise KeyboardInterrupt
    return detections.found


def _cut(
    source: BagSource, window: Window, topics: Sequence[str], bag: Path, redactor: Redactor | None
) -> Cut:
    low, high = window.low - MARGIN, window.high + MARGIN
    times = [source.recording.times(name) for name in topics]
    total = sum(int(((t >= low) & (t < high)).sum()) for t in times)
    with tqdm(total=total, unit="message", desc="cut", disable=None) as bar:

        def edit(message: RawMessage, data: bytes | memoryview) -> bytes | memoryview | None:
            bar.update()
            return data if redactor is None else redactor(message, data)

        return cut(source.recording, window, topics, source.roles.tf_static, bag, edit)


def _about(order: Order, window: Window, made: Made, machine: Hardware, bag: Path) -> About:
    return About(
        low=window.low,
        high=window.high,
        at=window.at,
        bag_sha256=file_hash(bag),
        model=model_of(order.config),
        classes=_class_names(order.config),
        hardware=machine.lines(),
        redacted=order.redact,
        interrupted=made.interrupted,
        note=order.note,
        warnings=made.warnings,
    )


def _facts(
    order: Order, public: Config, window: Window, part: Cut, made: Made, machine: Hardware, name: str
) -> Facts:
    sizes = {
        path.name: f"{what}, {megabytes(path.stat().st_size)}"
        for path, what in (
            (order.output.with_suffix(".mcap"), "the raw messages of the window"),
            *((path, "the model") for path in made.files[2:]),
        )
    }
    sizes = {order.output.name: "everything that was seen, made and decided, for the Rerun viewer", **sizes}
    where = window_text(name, window)
    if made.interrupted:
        where += f"; interrupted after {made.frames} frames"
    if order.redact:
        where += "; people and vehicles that the detector finds are hidden in the images"
    title = f"{order.output.stem}: {order.note.splitlines()[0]}" if order.note else order.output.stem
    changed = changes(public)
    differs = f"with {len(changed)} parameter{'s' * (len(changed) > 1)} changed" if changed else "unchanged"
    return Facts(
        title=title,
        note=order.note,
        where=where,
        start=window.start,
        config=f"Preset {public.preset}, {differs}.",
        changes=changed,
        versions=versions(),
        hardware=machine.lines(),
        warnings=made.warnings,
        files=file_lines(sizes, part.counts, model_of(order.config)),
        commands=commands(order.output, window, public, order.redact),
    )


def _class_names(config: Config) -> list[str]:
    """Of the file that the configuration names, which does not come along."""
    names = config.detector.names
    return list(read_names(names)) if names and config.detector.model else []


def _without_folders(text: str, paths: Sequence[Path]) -> str:
    for path in paths:
        text = text.replace(str(path), path.name)
        if len(path.parent.parts) > 0 and str(path.parent) != path.root:
            text = text.replace(f"{path.parent}/", "").replace(str(path.parent), "the folder")
    return text
