"""Command ``bevviz why``: explain why an object was reported or missed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from bevviz.cli.command import Group, command, extensions, flag, option
from bevviz.cli.options import ConfigOptions, DriveOptions, FrameOptions, SubjectOptions, load_config
from bevviz.cli.outputs import Outputs, json_option, layout_option, print_result, say, warn
from bevviz.cli.values import positive
from bevviz.errors import UserError, printable
from bevviz.support import progress
from bevviz.support.contexts import garbage_collection_off

if TYPE_CHECKING:
    from bevviz.model.frame import Scene
    from bevviz.model.results import FrameResult
    from bevviz.why import Answer, FrameExplainer, Selection
    from bevviz.why.answer_results import FrameAnswers

EXAMPLES = """examples:
  bevviz why drive.mcap --at 12.5 --model yolo11n.onnx                  whatever went wrong in that frame
  bevviz why drive.mcap --at 12.5 --model yolo11n.onnx --class person   every person, however weakly detected
  bevviz why drive.mcap --at-frame 125 --model yolo11n.onnx --box 320,180    what is at that pixel
  bevviz why drive.mcap --at 12.5 --point 8.2,-1.5,-0.8 --serve         what is there, shown in a browser"""


@dataclass(frozen=True, kw_only=True)
class WhySubject(SubjectOptions):
    """Options that select the explained objects."""

    group: ClassVar = Group("what to explain", "Nothing: what did not end as an object of its own.")

    limit: int = option("N", "the N worst with their chain (default: 5)", parse=positive, default=5)
    all: bool = flag("also what went well, and what nothing could be done about")


@dataclass(frozen=True, kw_only=True)
class WhyOutputs(Outputs):
    """Outputs of ``why``."""

    group: ClassVar = Group("output", "None, unless one is given.")

    blueprint: str = layout_option("explain")


@dataclass(frozen=True, kw_only=True)
class WhyOptions:
    """Options of ``why``."""

    drive: DriveOptions
    frame: FrameOptions
    subject: WhySubject
    json: Path | None = json_option()
    config: ConfigOptions
    output: WhyOutputs


@command(
    "why",
    description="Follow an object through the stages of one frame: where it was lost, by which number, "
    "and which change of the configuration would keep it, which is tried before it is said.",
    epilog=EXAMPLES,
    extended_by="questions",
    forms=("bevviz.why.answer_results:FrameAnswers",),
)
@garbage_collection_off()
def _why(options: WhyOptions) -> int:
    from bevviz.bags.source import BagSource
    from bevviz.checks import InputChecks
    from bevviz.pipeline.notes import Notes
    from bevviz.pipeline.session import Session
    from bevviz.pipeline.stage_loader import StageLoader
    from bevviz.why import FrameExplainer
    from bevviz.why.answer_text import plain_text
    from bevviz.why.kept_labels import kept_truth
    from bevviz.why.neighbours import frames_beside

    config, subject, at = load_config(options), options.subject, options.frame.at
    selection = subject.selection()
    with BagSource(options.drive.paths, config, at=at) as source:
        loader = StageLoader()
        session = Session(config, loader=loader)
        row = options.frame.at_frame
        frame = next(iter(source), None) if row is None else source.frame(row)
        checks = InputChecks(source, config)
        warn(early := checks.warnings)
        if frame is None:
            option = f"--at {at}" if row is None else f"--at-frame {row}"
            raise UserError(f"{option}: the scan there cannot be read")
        answered = (
            question.answer(asked, source, frame, selection, subject.limit, subject.all)
            for question, asked in extensions(options)
        )
        if (further := next(filter(None, answered), None)) is not None:
            frame_answers, lines = further
            print_result(options.json, "why", frame_answers, lambda: "\n".join(map(printable, lines)))
            return 0
        outputs = options.output
        result = session.run(frame) if outputs else session.run_explained(frame)
        checks.observe(result)
        warn(checks.warnings_beside(early))
        beside = frames_beside(source, frame.index)
        names = session.stages.class_names
        labels = kept_truth(Notes(options.drive.paths), frame, names)
        questioner = FrameExplainer(result, loader, names, neighbours=beside, labels=labels)
        bar = partial(progress.bar, unit="object", desc="what would change it", leave=False)
        answers = questioner.explain(selection, subject.limit, bar, everything=subject.all)
        neighbours = _neighbours(questioner, selection, answers)
        unseen = _unseen(questioner, selection, answers)
        headline = _headline(questioner, selection)
        text = printable(f"frame {frame.index}, preset {config.preset}: {headline}")
        if answers:
            text = f"{text}\n\n{plain_text(answers, subject.limit, neighbours, unseen)}"
        print_result(options.json, "why", _frame_answers(result, answers, neighbours, headline), lambda: text)
        if outputs:
            _show(result, answers, source.scene, outputs, subject.limit)
    return 0


def _neighbours(questioner: FrameExplainer, selection: Selection, answers: Sequence[Answer]) -> list[Answer]:
    """Return the answers about other objects at the selected place."""
    if not (selection.box or selection.point or selection.cell):
        return []
    answered = {answer.subject.key for answer in answers}
    return [answer for answer in questioner.candidates(selection) if answer.subject.key not in answered]


def _unseen(questioner: FrameExplainer, selection: Selection, answers: Sequence[Answer]) -> list[Answer]:
    """Return the objects of a class that no sensor sees and that ``answers`` leave out, the nearest first.

    Raises:
        UserError: the detector does not know the class, and nothing in the frame is labelled so.
    """
    if not selection.label:
        return []
    known = questioner.traces.classes
    answered = {answer.subject.key for answer in answers}
    unseen = [
        answer
        for answer in questioner.ask(selection)
        if answer.subject.kind == "truth" and answer.folded and answer.subject.key not in answered
    ]
    truth, wanted = questioner.traces.result.frame.truth, selection.label.lower()
    names = {*known, *(answer.subject.label for answer in answers), *(truth.labels if truth else ())}
    if known and wanted not in map(str.lower, names):
        raise UserError(f"--class {selection.label}: the model has no such class; it has {', '.join(known)}")
    return sorted(unseen, key=lambda answer: answer.distance)


def _headline(questioner: FrameExplainer, selection: Selection) -> str:
    """Return one line about the selected objects, or the reason why there are none."""
    from bevviz.why.answer_text import summary_line
    from bevviz.why.reason_text import not_run

    answers = questioner.ask(selection)
    if selection.one:
        return answers[0].subject.name
    if answers:
        return summary_line(answers)
    reasons = "; ".join(not_run(questioner.traces.result, selection.camera))
    problem = f"no {selection.label} is known" if selection.label else "no object is known"
    if reasons:
        return f"{problem}, as the detector never ran ({reasons}); ask for a place with --point x,y,z"
    if selection.label:
        return f"{problem}: the detector has no candidate, however weak"
    return f"{problem}: there is no detection, however weak"


def _frame_answers(
    result: FrameResult, answers: Sequence[Answer], neighbours: Sequence[Answer], headline: str
) -> FrameAnswers:
    from bevviz.why.answer_results import AnswerResult, FrameAnswers, OtherAnswer

    return FrameAnswers(
        frame=result.frame.index,
        stamp=result.frame.stamp,
        preset=result.config.preset,
        summary=headline,
        answers=[*map(AnswerResult.of, answers)],
        beside=[OtherAnswer(a.subject.name, a.verdict.text) for a in neighbours],
    )


def _show(result: FrameResult, answers: Sequence[Answer], scene: Scene, outputs: Outputs, limit: int) -> None:
    from bevviz.recording.frame_logger import FrameLogger
    from bevviz.why.log import focus_point, log_answers

    if answers and (position := focus_point(result.frame, answers[0])) is not None:
        x, y, z = position.tolist()
        scene = replace(scene, focus=(x, y, z))
    with outputs.opened(scene, result.config) as sinks:
        logger = FrameLogger(sinks.recording, result.config, scene)
        logger.log_static()
        logger.log(result)
        log_answers(logger, result.frame, answers, limit, result.config.bev)
        if outputs.save is not None:
            say(f"saved in {outputs.save}")
        outputs.keep_serving(sinks)
