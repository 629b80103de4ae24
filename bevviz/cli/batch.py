"""Command ``bevviz batch``: run the pipeline over many bags."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.cli.interrupts import interruptible, wait_for_interrupt
from bevviz.cli.options import (
    TIMES,
    Commands,
    add_bind,
    add_config,
    add_keep,
    add_limits,
    add_selection,
    load_config,
    port,
    positive,
)
from bevviz.cli.outputs import print_hints, say, warn
from bevviz.errors import UserError
from bevviz.support import progress

if TYPE_CHECKING:
    from bevviz.evaluate.metrics import Limit
    from bevviz.fleet.dask_jobs import Cluster
    from bevviz.fleet.jobs import Job, JobResults
    from bevviz.fleet.processes import Processes
    from bevviz.fleet.table import RunInfo


def add(commands: Commands) -> None:
    """Add the command ``batch``."""
    batch = commands.add_parser(
        "batch",
        help="run the pipeline over many bags",
        description="Run the pipeline over many bags, each by itself, and sum up. Run again, it goes on.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=TIMES,
    )
    batch.add_argument(
        "paths",
        nargs="*",
        type=Path,
        metavar="BAG",
        help="bag file or folder, a pattern, or a folder that has bags in it; none: what -o has already",
    )
    batch.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="where results go")
    group = batch.add_argument_group("what to run")
    group.add_argument("--model", metavar="FILE.onnx", help="detector: YOLOv5, v8, v10, 11, 26 or YOLOX")
    add_selection(group)
    group.add_argument("--force", action="store_true", help="also what is complete and up to date")
    where = batch.add_argument_group("where")
    where.add_argument("--jobs", type=positive, metavar="N", help="processes (default: half the cores)")
    where.add_argument("--dask", metavar="ADDRESS", help="on a Dask cluster, e.g. tcp://host:8786")
    where.add_argument(
        "--retries", type=int, default=2, metavar="N", help="again, where a process dies (default: 2)"
    )
    results = batch.add_argument_group("results")
    add_keep(results)
    results.add_argument("--blueprint", default="debug", metavar="NAME|FILE", help="layout (default: debug)")
    results.add_argument(
        "--top", type=positive, default=30, metavar="N", help="worst frames shown (default: 30)"
    )
    results.add_argument("--catalog", metavar="URL", help="register with this Rerun catalog server")
    results.add_argument(
        "--serve-catalog",
        nargs="?",
        type=port,
        const=51234,
        metavar="PORT",
        help="start one here (default: 51234), and a web viewer; until Ctrl-C",
    )
    add_bind(results, "--serve-catalog")
    results.add_argument(
        "--catalog-name", metavar="NAME", help="of the data set in the catalog (default: name of DIR)"
    )
    truth = batch.add_argument_group("ground truth")
    truth.add_argument(
        "--truth",
        nargs="?",
        const="",
        metavar="TOPIC",
        help="evaluate: against the bag's own .../ground_truth, or this Detection3DArray",
    )
    add_limits(batch)
    add_config(batch)
    batch.set_defaults(run=_batch)


def _batch(options: argparse.Namespace) -> int:
    from bevviz.fleet.jobs import intact_results, lock_folder

    limits = _limits(options)
    if options.catalog and options.serve_catalog:
        raise UserError("--catalog and --serve-catalog: give one of them")
    failed: list[tuple[str, str]] = []
    with lock_folder(options.output):
        if options.paths:
            jobs = _jobs(options)
            interrupted = _run(jobs, options, failed)
            complete = [(job.table, info) for job in jobs if (info := job.complete())]
        else:
            interrupted = False
            complete = intact_results(options.output.resolve(), _warn)
        return _sum_up(complete, failed, limits, options, interrupted)


def _limits(options: argparse.Namespace) -> list[Limit]:
    from bevviz.evaluate.metrics import parse_limits

    limits = parse_limits(options.min, options.max)
    if (limits or options.junit) and options.paths and options.truth is None:
        raise UserError("--min, --max and --junit: held to what? Give --truth, or --truth TOPIC")
    return limits


def _jobs(options: argparse.Namespace) -> list[Job]:
    from bevviz.bags.source import FrameSelection
    from bevviz.fleet.jobs import make_jobs
    from bevviz.model.frame import Scene
    from bevviz.recording import blueprints
    from bevviz.stages.detector import Detector

    config = load_config(options)
    selection = FrameSelection(options.start, options.end, options.every, options.frames)
    jobs = make_jobs(options.paths, options.output, config, selection, options.blueprint, options.truth)
    # Report once here an error that every bag would hit.
    blueprints.load(options.blueprint, Scene("", "lidar"))
    if config.detector.model:
        Detector(config.detector)
    print_hints(Scene("", "lidar", cameras=("any",)), config)
    return jobs


def _run(jobs: list[Job], options: argparse.Namespace, failed: list[tuple[str, str]]) -> bool:
    """Run the unfinished jobs. Return whether the user interrupted them.

    Args:
        jobs: all jobs of the batch.
        options: of the command.
        failed: filled with the name and the error of each failed bag.
    """
    from bevviz.fleet.jobs import unfinished_jobs

    todo = unfinished_jobs(jobs, options.force, _warn)
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

            with closing(_execute(todo, options, on_frame, tick)) as outcomes:
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
    todo: list[Job], options: argparse.Namespace, on_frame: Callable[[], None], tick: Callable[[], None]
) -> JobResults:
    if not todo:
        return
    with ExitStack() as stack:
        engine: Cluster | Processes
        if options.dask:
            from bevviz.fleet.dask_jobs import Cluster

            engine = stack.enter_context(Cluster(options.dask))
        else:
            from bevviz.fleet.processes import Processes

            workers = options.jobs or max(1, (os.cpu_count() or 1) // 2)
            engine = stack.enter_context(Processes(min(workers, len(todo))))
        yield from stack.enter_context(closing(engine.run(todo, options.retries, on_frame, tick)))


def _sum_up(
    complete: list[tuple[Path, RunInfo]],
    failed: list[tuple[str, str]],
    limits: list[Limit],
    options: argparse.Namespace,
    interrupted: bool,
) -> int:
    """Write the summary of the complete bags, register them in a catalog, and return the exit status."""
    from bevviz.fleet.summary import write_summary

    folder: Path = options.output
    recordings = [(table.with_suffix(".rrd"), info) for table, info in complete]
    with ExitStack() as stack:
        link, url, viewer = None, options.catalog, ""
        if interrupted:
            url = None
        elif options.serve_catalog:
            from bevviz.fleet.catalog import serve_catalog

            url, viewer = stack.enter_context(serve_catalog(options.serve_catalog, options.bind))
        if url:
            from bevviz.fleet.catalog import register

            dataset = options.catalog_name or folder.resolve().name
            link = register(url, dataset, recordings, options.blueprint)
            say(f"{len(complete)} recordings in dataset '{dataset}' at {url}")
        page = write_summary(folder, complete, failed, options.top, link, viewer)
        if interrupted:
            say(f"interrupted; {len(complete)} bags are complete, the same command goes on. Summary: {page}")
            return 130
        limits_kept = _gate(complete, failed, limits, options.junit)
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
