"""Command ``bevviz batch``: run the pipeline over many bags."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from bevviz.cli.command import Group, command, flag, option
from bevviz.cli.interrupts import interruptible, wait_for_interrupt
from bevviz.cli.options import (
    TIMES,
    WHAT_TO_RUN,
    ConfigOptions,
    Keep,
    LimitOptions,
    RangeOptions,
    keep_option,
    load_config,
    model_option,
)
from bevviz.cli.outputs import bind_option, print_hints, say, warn
from bevviz.cli.values import port, positive
from bevviz.errors import UserError
from bevviz.support import progress

if TYPE_CHECKING:
    from pyarrow import Table

    from bevviz.evaluate.metrics import Limit
    from bevviz.extras.batch.dask_jobs import Cluster
    from bevviz.extras.batch.jobs import Job, JobResults
    from bevviz.extras.batch.processes import Processes
    from bevviz.extras.batch.summary import BagTotals
    from bevviz.extras.batch.table import RunInfo


@dataclass(frozen=True, kw_only=True)
class BatchRange(RangeOptions):
    """Options that select the frames that are run."""

    force: bool = flag("also what is complete and up to date")


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Options for the detector."""

    group: ClassVar = WHAT_TO_RUN

    model: str | None = model_option()


@dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """Options for the processes that run the bags."""

    group: ClassVar = Group("where")

    jobs: int | None = option("N", "processes (default: half the cores)", parse=positive)
    dask: str | None = option("ADDRESS", "on a Dask cluster, e.g. tcp://host:8786")
    retries: int = option("N", "again, where a process dies (default: 2)", default=2)


@dataclass(frozen=True, kw_only=True)
class BatchResults:
    """Options for the results."""

    group: ClassVar = Group("results")

    keep: Keep = keep_option()
    blueprint: str = option("NAME|FILE", "layout (default: debug)", file="read", default="debug")
    top: int = option("N", "worst frames shown (default: 30)", parse=positive, default=30)
    catalog: str | None = option("URL", "register with this Rerun catalog server")
    serve_catalog: int | None = option(
        "PORT", "start one here (default: 51234), and a web viewer; until Ctrl-C", parse=port, const=51234
    )
    bind: str = bind_option("--serve-catalog")
    catalog_name: str | None = option("NAME", "of the data set in the catalog (default: name of DIR)")


@dataclass(frozen=True, kw_only=True)
class BatchTruth:
    """Options for the ground truth."""

    group: ClassVar = Group("ground truth")

    truth: str | None = option(
        "TOPIC",
        "evaluate each bag: refuse one without .../ground_truth, or use this Detection3DArray "
        "(default: evaluate those with .../ground_truth)",
        const="",
    )


@dataclass(frozen=True, kw_only=True)
class BatchOptions:
    """Options of ``batch``."""

    paths: tuple[Path, ...] = option(
        "BAG",
        "bag file or folder, a pattern, or a folder that has bags in it; none: what -o has already",
        positional=True,
        nargs="*",
        file="read",
        default=(),
    )
    output: Path = option("DIR", "where results go", names=("-o", "--output"), file="written", required=True)
    detector: ModelOptions
    frames: BatchRange
    workers: WorkerOptions
    results: BatchResults
    truth: BatchTruth
    limits: LimitOptions
    config: ConfigOptions


@command(
    "batch",
    help="run the pipeline over many bags",
    description="Run the pipeline over many bags, each by itself, and sum up. Run again, it goes on.",
    epilog=TIMES,
)
def _batch(options: BatchOptions) -> int:
    from bevviz.evaluate.metrics import parse_limits
    from bevviz.extras.batch.jobs import lock_folder

    limits = parse_limits(options.limits.min, options.limits.max)
    if options.results.catalog and options.results.serve_catalog:
        raise UserError("--catalog and --serve-catalog: give one of them")
    failed: list[tuple[str, str]] = []
    with lock_folder(options.output):
        if options.paths:
            jobs = _jobs(options)
            interrupted = _run(jobs, options.workers, options.frames.force, failed)
            complete = [(job.table, info) for job in jobs if (info := job.complete())]
        else:
            interrupted = False
            complete = complete_bags(options.output)
        return _sum_up(complete, failed, limits, options, interrupted)


def complete_bags(folder: Path) -> list[tuple[Path, RunInfo]]:
    """Return the table of each complete bag of a batch, with its description. Warn of damaged ones."""
    from bevviz.extras.batch.jobs import intact_results

    return intact_results(folder.resolve(), _warn)


def sum_up(complete: Sequence[tuple[Path, RunInfo]]) -> tuple[Table, list[BagTotals]]:
    """Return the frames of all bags, the worst first, and the totals of each bag."""
    from bevviz.extras.batch.summary import collect

    return collect(complete, None)


def _jobs(options: BatchOptions) -> list[Job]:
    from bevviz.bags.source import FrameSelection
    from bevviz.extras.batch.jobs import make_jobs
    from bevviz.model.frame import Scene
    from bevviz.recording import blueprints
    from bevviz.stages.detector import Detector

    config, frames, layout = load_config(options), options.frames, options.results.blueprint
    selection = FrameSelection(frames.start, frames.end, frames.every, frames.frames)
    jobs = make_jobs(options.paths, options.output, config, selection, layout, options.truth.truth)
    # Report once here an error that every bag would hit.
    blueprints.load(layout, Scene("", "lidar"))
    if config.detector.model:
        Detector(config.detector)
    print_hints(Scene("", "lidar", cameras=("any",)), config)
    return jobs


def _run(jobs: list[Job], workers: WorkerOptions, force: bool, failed: list[tuple[str, str]]) -> bool:
    """Run the unfinished jobs. Return whether the user interrupted them.

    Args:
        jobs: all jobs of the batch.
        workers: the processes that run them.
        force: whether to run the finished ones, too.
        failed: filled with the name and the error of each failed bag.
    """
    from bevviz.extras.batch.jobs import unfinished_jobs

    todo = unfinished_jobs(jobs, force, _warn)
    if len(todo) < len(jobs):
        say(f"{len(jobs) - len(todo)} of {len(jobs)} bags are complete and up to date")
    frames = 0
    try:
        with (
            interruptible() as ended,
            progress.bar(total=len(jobs), initial=len(jobs) - len(todo), unit="bag") as bar,
        ):

            def on_frame() -> None:
                nonlocal frames
                frames += 1
                bar.set_postfix_str(f"{frames} frames", False)
                bar.update(0)
                tick()

            def tick() -> None:
                if ended.is_set():
                    raise KeyboardInterrupt

            with closing(_execute(todo, workers, on_frame, tick)) as outcomes:
                for outcome in outcomes:
                    bar.update()
                    if outcome.error:
                        failed.append((outcome.name, outcome.error))
                        bar.write(f"bevviz: {outcome.name}: {outcome.error}", file=sys.stderr)
    except KeyboardInterrupt:
        return True
    return False


def _warn(text: str) -> None:
    warn([text])


def _execute(
    todo: list[Job], workers: WorkerOptions, on_frame: Callable[[], None], tick: Callable[[], None]
) -> JobResults:
    if not todo:
        return
    with ExitStack() as stack:
        engine: Cluster | Processes
        if workers.dask:
            from bevviz.extras.batch.dask_jobs import Cluster

            engine = stack.enter_context(Cluster(workers.dask))
        else:
            from bevviz.extras.batch.processes import Processes

            count = workers.jobs or max(1, (os.cpu_count() or 1) // 2)
            engine = stack.enter_context(Processes(min(count, len(todo))))
        yield from stack.enter_context(closing(engine.run(todo, workers.retries, on_frame, tick)))


def _sum_up(
    complete: list[tuple[Path, RunInfo]],
    failed: list[tuple[str, str]],
    limits: list[Limit],
    options: BatchOptions,
    interrupted: bool,
) -> int:
    """Write the summary of the complete bags, register them in a catalog, and return the exit status."""
    from bevviz.extras.batch.summary import write_summary

    folder, results = options.output, options.results
    recordings = [(table.with_suffix(".rrd"), info) for table, info in complete]
    with ExitStack() as stack:
        link, url, viewer = None, results.catalog, ""
        if interrupted:
            url = None
        elif results.serve_catalog:
            from bevviz.extras.batch.catalog import serve_catalog

            url, viewer = stack.enter_context(serve_catalog(results.serve_catalog, results.bind))
        if url:
            from bevviz.extras.batch.catalog import register

            dataset = results.catalog_name or folder.resolve().name
            link = register(url, dataset, recordings, results.blueprint)
            say(f"{len(complete)} recordings in dataset '{dataset}' at {url}")
        page = write_summary(folder, complete, failed, results.top, link, viewer)
        if interrupted:
            say(f"interrupted; {len(complete)} bags are complete, the same command goes on. Summary: {page}")
            return 130
        limits_kept = _gate(complete, failed, limits, options.limits.junit)
        frames = sum(info.frames for _, info in complete)
        done = f"{len(complete)} bag{'s' * (len(complete) != 1)} complete, {len(failed)} failed"
        say(f"{done}, {frames} frames. Summary: {page}")
        if viewer:
            say(f"catalog at {url}, viewer at {viewer}; serving until Ctrl-C", always=True)
            wait_for_interrupt()
    return 1 if failed or not complete or not limits_kept else 0


def _gate(
    complete: list[tuple[Path, RunInfo]],
    failed: list[tuple[str, str]],
    limits: list[Limit],
    junit: Path | None,
) -> bool:
    """Return whether every bag is within every limit."""
    from bevviz.evaluate.metrics import LimitResult, check, write_junit

    suites: dict[str, list[LimitResult] | str] = dict(failed)
    for table, info in complete:
        metrics = {name: value for name, value in (info.metrics or {}).items() if value is not None}
        suites[table.stem] = check(limits, metrics)
    violations = [
        (name, result.reason)
        for name, outcome in suites.items()
        if not isinstance(outcome, str)
        for result in outcome
        if result.reason
    ]
    for name, reason in violations:
        say(f"{name}: not kept: {reason}", always=True)
    if junit is not None:
        write_junit(junit, suites)
    return not violations
