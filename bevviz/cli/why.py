"""Command ``bevviz why``: explain why an object was reported or missed."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from bevviz.cli.options import (
    Commands,
    add_at,
    add_bag,
    add_config,
    add_output,
    load_config,
    number,
    parse_real,
    positive,
)
from bevviz.cli.outputs import Outputs, add_json, print_result, say, warn
from bevviz.errors import UserError
from bevviz.support import progress
from bevviz.support.contexts import garbage_collection_off

if TYPE_CHECKING:
    from bevviz.model.frame import Scene
    from bevviz.model.results import FrameResult
    from bevviz.why import Answer, FrameExplainer, Selection

EXAMPLES = """examples:
  bevviz why drive.mcap --at 12.5 --model yolo11n.onnx                  whatever went wrong in that frame
  bevviz why drive.mcap --at 12.5 --model yolo11n.onnx --class person   every person, however weakly detected
  bevviz why drive.mcap --at-frame 125 --model yolo11n.onnx --box 320,180    what is at that pixel
  bevviz why drive.mcap --at 12.5 --point 8.2,-1.5,-0.8 --serve         what is there, shown in a browser"""

_metres = parse_real(lambda metres: 0 < metres < 1000, "is no length in metres")


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
    targets = why.add_argument_group("what to explain", "Nothing: what did not end as an object of its own.")
    target = targets.add_mutually_exclusive_group()
    target.add_argument("--class", dest="label", default="", metavar="NAME", help="all of that class")
    target.add_argument(
        "--box", type=_numbers(2, 4), default=(), metavar="U,V[,U1,V1]", help="at that pixel, or in that box"
    )
    target.add_argument(
        "--point",
        type=_numbers(3),
        default=(),
        metavar="X,Y,Z",
        help="there, in metres of the points' frame",
    )
    target.add_argument(
        "--cell",
        type=_numbers(2),
        default=(),
        metavar="ROW,COLUMN",
        help="what is in that cell of the bird's-eye view",
    )
    target.add_argument("--cluster", type=number, metavar="N", help="the cluster of that number")
    target.add_argument("--object", type=number, metavar="N", help="the object in that row")
    target.add_argument("--detection", type=number, metavar="N", help="the detection in that row")
    targets.add_argument(
        "--radius", type=_metres, default=0.5, metavar="M", help="around the point or cell (default: 0.5)"
    )
    targets.add_argument(
        "--camera", default="", metavar="NAME", help="of pixel or detection, if there are several"
    )
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


def _numbers(*counts: int) -> Callable[[str], tuple[float, ...]]:
    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) not in counts or not all(abs(v) < 1e6 for v in values):
            wanted = " or ".join(map(str, counts))
            raise argparse.ArgumentTypeError(f"'{text}' is not {wanted} numbers with commas between")
        return values

    return parse


@garbage_collection_off()
def _why(options: argparse.Namespace) -> int:
    from bevviz.bags.source import BagSource
    from bevviz.pipeline.session import Session
    from bevviz.pipeline.stage_loader import StageLoader
    from bevviz.support.text import printable
    from bevviz.why import FrameExplainer
    from bevviz.why.answer_text import plain_text

    config, selection = load_config(options), _selection(options)
    with BagSource(options.paths, config, at=options.at) as source:
        loader = StageLoader()
        session = Session(config, loader=loader)
        row = options.at_frame
        frame = next(iter(source), None) if row is None else source.frame(row)
        warn(source.warnings)
        if frame is None:
            option = f"--at {options.at}" if row is None else f"--at-frame {row}"
            raise UserError(f"{option}: the scan there cannot be read")
        outputs = Outputs.of(options)
        result = session.run(frame) if outputs else session.run_explained(frame)
        questioner = FrameExplainer(result, loader, session.stages.class_names)
        bar = partial(progress.bar, unit="object", desc="what would change it", leave=False)
        answers = questioner.explain(selection, options.limit, bar, everything=options.all)
        neighbours = _neighbours(questioner, selection, answers)
        headline = _headline(questioner, selection)
        text = printable(f"frame {frame.index}, preset {config.preset}: {headline}")
        if answers:
            text = f"{text}\n\n{plain_text(answers, options.limit, neighbours)}"
        print_result(options, "why", _tree(result, answers, neighbours, headline), lambda: text)
        if outputs:
            _show(result, answers, source.scene, outputs, options.limit)
    return 0


def _selection(options: argparse.Namespace) -> Selection:
    from bevviz.why import Selection

    return Selection(
        label=options.label,
        box=options.box,
        point=options.point,
        radius=options.radius,
        cell=tuple(map(int, options.cell)),
        cluster=options.cluster,
        detection=options.detection,
        object=options.object,
        camera=options.camera,
    )


def _neighbours(questioner: FrameExplainer, selection: Selection, answers: Sequence[Answer]) -> list[Answer]:
    """Return the answers about other objects at the selected place."""
    if not (selection.box or selection.point or selection.cell):
        return []
    answered = {answer.subject.key for answer in answers}
    return [answer for answer in questioner.candidates(selection) if answer.subject.key not in answered]


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
) -> dict[str, Any]:
    frame = result.frame
    head = {"frame": frame.index, "stamp": frame.stamp, "preset": result.config.preset, "summary": headline}
    verdicts = [{"name": a.subject.name, "verdict": a.verdict.text} for a in neighbours]
    return {**head, "answers": [a.as_dict() for a in answers], "beside": verdicts}


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
        log_answers(sinks.recording, result.frame, answers, limit, result.config.bev)
        if outputs.save is not None:
            say(f"saved in {outputs.save}")
        outputs.keep_serving(sinks)
