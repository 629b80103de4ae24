"""Command ``bevviz evaluate``: compare the results with the ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from bevviz.cli.command import Group, command
from bevviz.cli.options import (
    ConfigOptions,
    DriveOptions,
    Keep,
    LimitOptions,
    RangeOptions,
    TruthOptions,
    keep_option,
    load_config,
    open_bag,
)
from bevviz.cli.outputs import STDOUT, Outputs, json_option, layout_option, print_hints, say, warn, write_json
from bevviz.cli.run import run_logged, run_with_progress, table_status
from bevviz.errors import UserError

if TYPE_CHECKING:
    from rerun import RecordingStream

    from bevviz.bags.source import BagSource
    from bevviz.config import Config
    from bevviz.evaluate.evaluation import Evaluation
    from bevviz.evaluate.metrics import Limit
    from bevviz.model.protocols import Observer
    from bevviz.model.results import FrameResult
    from bevviz.pipeline.session import Session
    from bevviz.why import RunExplainer


DESCRIPTION = """Hold the results to what is really there: precision and recall by class and range, average
precision as KITTI defines it, tracks (HOTA, MOTA, IDF1), image boxes, ground. PATH is a bag, or a
labelled data set (docs/inputs.md). With --min and --max it is a
gate: the exit status is 1 where a limit is not kept."""

EPILOG = """examples:
  bevviz evaluate drive.mcap --model yolo11n.onnx
  bevviz evaluate training --model yolox_nano.onnx --frames :100 --save training.rrd
  bevviz evaluate drive.mcap --model yolo11n.onnx --min recall.person=0.8 --max false=2 --junit ci.xml"""


@dataclass(frozen=True, kw_only=True)
class EvaluateOutputs(Outputs):
    """Outputs of ``evaluate``."""

    group: ClassVar = Group("output", "None, but the table. Several can be given at once.")

    blueprint: str = layout_option("evaluate")
    keep: Keep = keep_option()
    json: Path | None = json_option()


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Options of ``evaluate``."""

    drive: DriveOptions
    frames: RangeOptions
    truth: TruthOptions
    limits: LimitOptions
    config: ConfigOptions
    output: EvaluateOutputs


@command(
    "evaluate",
    description=DESCRIPTION,
    epilog=EPILOG,
    forms=("bevviz.evaluate.evaluation:EvaluationResult",),
)
def _evaluate(options: EvaluateOptions) -> int:
    from bevviz.evaluate.evaluation import Evaluation
    from bevviz.evaluate.ground_truth import truth_in
    from bevviz.evaluate.metrics import parse_limits
    from bevviz.pipeline.session import Session
    from bevviz.why import RunExplainer

    truth, limits = options.truth, parse_limits(options.limits.min, options.limits.max)
    config = load_config(options)
    with open_bag(options.drive, options.frames, config) as frames:
        lookup = truth_in(frames, truth.truth, truth.kitti_labels)
        if not any(limit.metric.startswith(("ground", "object_points")) for limit in limits):
            _check_detector(config)
        with Session(config, draws=bool(options.output)) as session:
            explainer = RunExplainer(session.loader, session.stages.class_names)
            evaluation = Evaluation(lookup, explainer.false_causes)
            status = _run(frames, session, evaluation, explainer, options)
        if not evaluation.judged:
            raise UserError(
                f"{options.drive.paths[0]}: there is truth for none of the {evaluation.without} frames"
            )
        return _report(evaluation, limits, options) or status


def _check_detector(config: Config) -> None:
    """Raise an error if no object can have a class."""
    from bevviz.findings.frame_findings import has_detector

    if not has_detector(config):
        raise UserError(
            "without a detector no object has a class, and all would be missed: give --model FILE.onnx, "
            "or another objects.method; --min ground_iou=0.9 needs none"
        )


def _run(
    frames: BagSource,
    session: Session,
    evaluation: Evaluation,
    explainer: RunExplainer,
    options: EvaluateOptions,
) -> int:
    """Run the pipeline with an evaluation and return the exit status.

    The table is printed before a recording is served.
    """
    from bevviz.anomalies import FailureSummary
    from bevviz.checks import InputChecks
    from bevviz.findings.run_table import list_keeper

    config, failures, outputs = session.config, FailureSummary(), options.output
    # The workbench takes stated labels for the frames' own. This run has them apart.
    truth = options.truth
    keeper = None if truth.truth or truth.kitti_labels else list_keeper(frames, session, explainer)
    checks = InputChecks(frames, config)
    judges: list[Observer[FrameResult]] = [evaluation, failures, checks]
    if keeper is not None:
        judges.append(keeper)
    if not outputs:
        print_hints(frames.scene, config)
        end = run_with_progress(frames, session, judges)
        warn([*checks.warnings, *failures.warnings])
        return table_status(end)
    from bevviz.evaluate.log import EvaluationRecorder
    from bevviz.findings.marks import MarkRecorder
    from bevviz.recording.recorder import Recorder

    def observers(recording: RecordingStream) -> list[Observer[FrameResult]]:
        print_hints(frames.scene, config)
        recorder = Recorder(recording, config, session.stages.provider)
        marks = MarkRecorder(recording, explainer)
        return [recorder, *judges, EvaluationRecorder(recording, evaluation), marks]

    def finish() -> None:
        warn([*checks.warnings_beside(frames.warnings), *failures.warnings])
        if options.output.json != STDOUT:
            print(evaluation.table(), flush=True)

    return run_logged(frames, session, config, outputs, observers, finish)


def _report(evaluation: Evaluation, limits: list[Limit], options: EvaluateOptions) -> int:
    """Print and write the results. Return the exit status of the gate: 1 if a limit is not kept, else 0."""
    from bevviz.bags.remote import beside
    from bevviz.evaluate.metrics import check, write_junit

    if not options.output and options.output.json != STDOUT:
        print(evaluation.table())
    elif options.output.json == STDOUT:
        warn(evaluation.warnings)
    results = check(limits, evaluation.metrics)
    write_json(options.output.json, "evaluate", evaluation.result(results))
    if options.limits.junit is not None:
        write_junit(options.limits.junit, {beside(options.drive.paths[0]).stem: results})
    for result in results:
        if result.reason:
            say(f"not kept: {result.reason}", always=True)
    if results and not any(result.reason for result in results):
        say(f"all {len(results)} limits are kept" if len(results) > 1 else f"kept: {results[0].limit}")
    return int(any(result.reason for result in results))
