"""Long bags: they are cut into windows, so that none holds up all workers while the others have ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing

from bevviz.batch.jobs import PARTIAL, Job
from bevviz.batch.work import Output, WithdrawnError, pictures
from bevviz.closing import Closing
from bevviz.engine.task import Engine, JobResult, JobResults, Task
from bevviz.errors import UserError
from bevviz.logging.recorder import OrderedRecorder
from bevviz.parallel.drive import LENGTH, InOrder, Windows, obstacle
from bevviz.parallel.work import Batched, WindowJob
from bevviz.run import few_collections
from bevviz.session import Session
from bevviz.stage_loader import StageLoader

LEAST = 2 * LENGTH  # frames of a bag that is cut


def run_jobs(
    jobs: Sequence[Job],
    long: Sequence[Job],
    engine: Engine,
    retries: int,
    on_frame: Callable[[], None],
    tick: Callable[[], None] = lambda: None,
) -> JobResults:
    """Run every job, long ones in windows, and yield how they ended, as they end.

    Half of the workers have windows as long as there are whole bags for the others: what of a window needs
    those before it is done here, which must not be left for the end, and windows are what levels the end.

    Args:
        jobs: the largest first.
        long: those of them that are to be cut, where they can be.
        engine: what runs them.
        retries: how often a bag or a window is run again that failed for no fault of its bag.
        on_frame: called for each frame of any of them.
        tick: called every now and then; what it raises ends all.
    """
    loader, bags, cut = StageLoader(), list[_LongBag](), dict[str, _LongBag]()  # by name of the window

    def parts() -> Iterator[Task]:
        for job in long:
            bag = stack.enter_context(_LongBag(job))
            try:
                opened = bag.open(engine.count, loader)
            except UserError:
                opened = False
            if not opened:  # also where it cannot be read: a worker says why
                bag.close()
                yield job
                continue
            bags.append(bag)
            for window in bag.jobs():
                cut[window.name] = bag
                yield window

    windows, whole = parts(), iter([job for job in jobs if job not in long])

    def tasks() -> Iterator[Task]:
        while True:
            out = sum(bag.on_their_way for bag in bags)
            first, second = (windows, whole) if out < max(1, engine.count // 2) else (whole, windows)
            task = next(first, None) or next(second, None)
            if task is None:
                return
            yield task

    def complete() -> Iterator[JobResult]:
        for bag in [bag for bag in bags if bag.over]:
            bags.remove(bag)
            yield bag.result()

    with (
        few_collections(),
        ExitStack() as stack,
        closing(engine.run(tasks(), retries, on_frame, tick)) as ends,
    ):
        for end in ends:
            if (owner := cut.pop(end.name, None)) is None:
                yield end
            else:
                owner.ended(end)
                yield from complete()
        yield from complete()


class _LongBag(Closing):
    """One bag that is cut, and what is made of it in order."""

    def __init__(self, job: Job) -> None:
        self._job, self._error = job, ""
        self._all_cut = False
        self._stack, self._recording = ExitStack(), ExitStack()
        self._output = self._stack.enter_context(Output(job))
        self._stack.enter_context(self._recording)

    def close(self) -> None:
        """What is not complete goes."""
        self._stack.close()

    def open(self, workers: int, loader: StageLoader) -> bool:
        """Whether it is to be cut.

        Raises:
            UserError: it cannot be read, or what is made of it not written.
        """
        job, config = self._job, self._job.config
        source = self._source = self._stack.enter_context(job.selection.source([job.bag], config))
        if source.total < LEAST:
            return False
        session = Session(config, loader=loader)
        if obstacle(source, session.stages):
            return False
        sinks = self._recording.enter_context(self._output.opened(source, in_parts=True))
        batched = Batched(job.name, pictures, judged=job.truth is not None)
        self._windows = self._recording.enter_context(
            Windows(source, config, job.recording_id, workers, job.folder / PARTIAL, batched)
        )
        self._jobs = self._recording.enter_context(closing(self._windows.jobs()))
        recorder = OrderedRecorder(sinks.recording, config, session.stages.provider)
        observers = self._output.observers(
            source, sinks, recorder, lambda: None, lambda result: self._in_order.extras
        )
        self._in_order = InOrder(self._windows, session, sinks, observers)
        self._in_order.begin(source)
        return True

    def jobs(self) -> Iterator[WindowJob]:
        """Its windows, until one of them fails."""
        yield from self._jobs
        self._all_cut = True

    @property
    def on_their_way(self) -> int:
        return self._windows.on_their_way

    def ended(self, end: JobResult) -> None:
        """One of its windows."""
        if self._error:
            return
        try:
            for window in self._windows.ended(end):
                self._in_order.see(window)
        except (UserError, WithdrawnError) as error:
            self._error = str(error)
            self._jobs.close()

    @property
    def over(self) -> bool:
        return bool(self._error) or (self._all_cut and not self._windows.on_their_way)

    def result(self) -> JobResult:
        """How it ended."""
        try:
            if self._error:
                raise UserError(self._error)
            self._in_order.end()
            self._recording.close()
            return self._output.complete(self._source)
        except UserError as error:
            return self._output.failed(error)
        finally:
            self.close()
