"""Command ``bevviz why``: explain why an object was reported or missed."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from bevviz.cli.options import (
    Commands,
    add_at,
    add_bag,
    add_config,
    add_output,
    add_subject,
    load_config,
    positive,
    selected_subject,
)
from bevviz.cli.outputs import Outputs, add_json, print_result, say, warn
from bevviz.errors import UserError
from bevviz.support import progress
from bevviz.support.contexts import garbage_collection_off
from bevviz.support.extensions import load_all

if TYPE_CHECKING:
    from bevviz.cli.parser import Parser
    from bevviz.model.frame import Scene
    from bevviz.model.json_forms import WhyForm
    from bevviz.model.results import FrameResult
    from bevviz.why import Answer, FrameExplainer, Selection
    from bevviz.why.robot_questions import Question

EXAMPLES = """examples:
  bevviz why drive.mcap --at 12.5 --model yolo11n.onnx                  whatever went wrong in that frame
  bevviz why drive.mcap --at 12.5 --model yolo11n.onnx --class person   every person, however weakly detected
  bevviz why drive.mcap --at-frame 125 --model yolo11n.onnx --box 320,180    what is at that pixel
  bevviz why drive.mcap --at 12.5 --point 8.2,-1.5,-0.8 --serve         what is there, shown in a browser"""


def add(commands: Commands) -> None:
    """Add the command ``why``."""
    why = commands.add_parser(
        "why",
        help="why an object was reported, or was not",
        description="Follow an object through the stages of one frame: where it was lost, by which number, "
        "and which change of the configuration would keep it, which is tried before it is said.",
        epilog=EXAMPLES,
    )
    group = add_bag(why)
    add_at(group, "the scan nearest to this time", required=True)
    targets = add_subject(why, "Nothing: what did not end as an object of its own.")
    targets.add_argument(
        "--limit", type=positive, default=5, metavar="N", help="the N worst with their chain (default: 5)"
    )
    targets.add_argument(
        "--all", action="store_true", help="also what went well, and what nothing could be done about"
    )
    add_json(why)
    add_config(why)
    add_output(why, blueprint="explain").description = "None, unless one is given."
    why.set_defaults(run=_why)
    why.add_later(lambda: _add_questions(why, targets))


def _add_questions(why: Parser, group: argparse._ArgumentGroup) -> None:
    """Add the options of the questions that are registered."""
    questions = [*load_all("questions", lambda text: warn([text]))]
    for question in questions:
        question.add_options(group)
    why.set_defaults(questions=questions)


@garbage_collection_off()
def _why(options: argparse.Namespace) -> int:
    from bevviz.bags.source import BagSource
    from bevviz.pipeline.session import Session
    from bevviz.pipeline.stage_loader import StageLoader
    from bevviz.support.text import printable
    from bevviz.why import FrameExplainer
    from bevviz.why.answer_text import plain_text

    config, selection = load_config(options), selected_subject(options)
    with BagSource(options.paths, config, at=options.at) as source:
        loader = StageLoader()
        session = Session(config, loader=loader)
        row = options.at_frame
        frame = next(iter(source), None) if row is None else source.frame(row)
        warn(source.warnings)
        if frame is None:
            option = f"--at {options.at}" if row is None else f"--at-frame {row}"
            raise UserError(f"{option}: the scan there cannot be read")
        questions: list[Question] = options.questions
        answered = (question.answer(options, source, frame, selection) for question in questions)
        if (further := next(filter(None, answered), None)) is not None:
            tree, lines = further
            print_result(options, "why", tree, lambda: "\n".join(map(printable, lines)))
            return 0
        outputs = Outputs.of(options)
        result = session.run(frame) if outputs else session.run_explained(frame)
        questioner = FrameExplainer(result, loader, session.stages.class_names)
        bar = partial(progress.bar, unit="object", desc="what would change it", leave=False)
        answers = questioner.explain(selection, options.limit, bar, everything=options.all)
        neighbours = _neighbours(questioner, selection, answers)
        unseen = _unseen(questioner, selection, answers)
        headline = _headline(questioner, selection)
        text = printable(f"frame {frame.index}, preset {config.preset}: {headline}")
        if answers:
            text = f"{text}\n\n{plain_text(answers, options.limit, neighbours, unseen)}"
        print_result(options, "why", _tree(result, answers, neighbours, headline), lambda: text)
        if outputs:
            _show(result, answers, source.scene, outputs, options.limit)
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
    from bevviz.why.reason_values import not_run

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


def _tree(
    result: FrameResult, answers: Sequence[Answer], neighbours: Sequence[Answer], headline: str
) -> WhyForm:
    return {
        "frame": result.frame.index,
        "stamp": result.frame.stamp,
        "preset": result.config.preset,
        "summary": headline,
        "answers": [a.as_dict() for a in answers],
        "beside": [{"name": a.subject.name, "verdict": a.verdict.text} for a in neighbours],
    }


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
