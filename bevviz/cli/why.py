"""``bevviz why``."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

from bevviz.cli.interrupts import terminable
from bevviz.cli.options import Commands, add_bag, add_config, add_output, load_config, positive
from bevviz.cli.outputs import Outputs, say, warn
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.frame import FrameResult, Scene
    from bevviz.why import Answer

EXAMPLES = """examples:
  bevviz why drive.mcap --at 12.5 --model yolo11n.onnx                  whatever went wrong in that frame
  bevviz why drive.mcap --at 12.5 --model yolo11n.onnx --class person   every person, however weakly detected
  bevviz why drive.mcap --at 12.5 --model yolo11n.onnx --box 320,180    what is at that pixel
  bevviz why drive.mcap --at 12.5 --point=8.2,-1.5,-0.8 --serve         what is there, shown in a browser"""


def add(commands: Commands) -> None:
    why = commands.add_parser(
        "why",
        help="why an object was reported, or was not",
        description="Follow an object through the stages of one frame: where it was lost, by which number, "
        "and which change of the configuration would keep it, which is tried before it is said.",
        epilog=EXAMPLES,
    )
    group = add_bag(why)
    group.add_argument("--at", required=True, metavar="TIME", help="the scan nearest to this time")
    what = why.add_argument_group("what to explain", "Nothing: whatever did not end as an object of its own.")
    one = what.add_mutually_exclusive_group()
    one.add_argument("--class", dest="label", default="", metavar="NAME", help="all of that class")
    one.add_argument(
        "--box", type=_numbers(2, 4), default=(), metavar="U,V[,U1,V1]", help="at that pixel, or in that box"
    )
    one.add_argument(
        "--point",
        type=_numbers(3),
        default=(),
        metavar="X,Y,Z",
        help="there, in metres of the points' frame (--point=-1,2,0 where it begins with a minus)",
    )
    what.add_argument(
        "--radius", type=_metres, default=0.5, metavar="M", help="around that point (default: 0.5)"
    )
    what.add_argument("--camera", default="", metavar="NAME", help="of the pixel, where there are several")
    what.add_argument(
        "--limit", type=positive, default=5, metavar="N", help="the N worst with their chain (default: 5)"
    )
    why.add_argument("--json", action="store_true", help="for machines")
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


def _metres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1000:
        raise argparse.ArgumentTypeError(f"'{text}' is no length in metres")
    return value


def _why(options: argparse.Namespace) -> int:
    from bevviz.bags.source import BagSource
    from bevviz.perceive import StageLoader
    from bevviz.session import Session
    from bevviz.why import Selection, why
    from bevviz.why.text import plain

    config = load_config(options)
    selection = Selection(options.label, options.box, options.point, options.radius, options.camera)
    with terminable(), BagSource(options.paths, config, at=options.at) as source:
        loader = StageLoader()
        session = Session(config, loader=loader)
        frame = next(iter(source), None)
        warn(source.warnings)
        if frame is None:
            raise UserError(f"--at {options.at}: the scan there cannot be read")
        result = session.run(frame)
        answers = why(result, selection, session.stages.class_names, options.limit, _progress, loader)
        if options.json:
            _print_json(result, answers)
        else:
            print(f"frame {frame.index}, preset {config.preset}\n")
            print(plain(answers, options.limit) or _nothing(options.label))
        if outputs := Outputs.of(options):
            _show(result, answers, source.scene, outputs, options.limit)
    return 0


def _nothing(label: str) -> str:
    if label:
        return f"There is no {label} in this frame: the detector has no candidate, however weak."
    return "Everything that was detected or stated in this frame ended as an object of its own."


def _progress(answers: Sequence[Answer]) -> Iterable[Answer]:
    from tqdm import tqdm

    yield from tqdm(answers, unit="object", desc="what would change it", leave=False, disable=None)


def _print_json(result: FrameResult, answers: Sequence[Answer]) -> None:
    import json

    frame = result.frame
    head = {"frame": frame.index, "stamp": frame.stamp, "preset": result.config.preset}
    print(json.dumps({**head, "answers": [answer.as_dict() for answer in answers]}, indent=2))


def _show(result: FrameResult, answers: Sequence[Answer], scene: Scene, outputs: Outputs, limit: int) -> None:
    from bevviz.logging.logger import Logger
    from bevviz.why.log import log_answers

    with outputs.opened(scene, result.config) as sinks:
        logger = Logger(sinks.recording, result.config, scene)
        logger.log_static()
        logger.log(result)
        log_answers(sinks.recording, result.frame, answers, limit)
        if outputs.save is not None:
            say(f"saved in {outputs.save}")
        outputs.keep_serving(sinks)
