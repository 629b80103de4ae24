"""Drives in Python: the session that the commands use, too."""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from bevviz.checks import InputChecks
from bevviz.config import Config, ParameterChange, Preset, changed_config, load
from bevviz.config.trust import USER
from bevviz.errors import UserError
from bevviz.model.frame import F64, Frame, Scene
from bevviz.model.protocols import FrameSource, Observer
from bevviz.model.results import FrameResult
from bevviz.model.tables import Columns, Tabular
from bevviz.pipeline.run import RunEnd, iterate_results, run
from bevviz.pipeline.session import Session
from bevviz.stages.odometry import Odometry, place
from bevviz.support.contexts import Closable
from bevviz.support.extensions import find
from bevviz.support.python_words import errors_about_arguments, python_words

if TYPE_CHECKING:
    from rerun.blueprint import Blueprint

    from bevviz.evaluate.evaluation import Evaluation
    from bevviz.notebook import NotebookViewer, Selected
    from bevviz.why import Answer, FrameExplainer

Settings = Mapping[str, Any] | Sequence[str]
MAX_RESULTS = 8  # number of single frames whose results are kept for further questions


class Drive(Closable, Tabular):
    """Open drive: its frames, in order or one by one, and the results of the stages.

    Use it as a context manager, or call ``close``.

    Args:
        frames: source of the frames.
        config: configuration of the runs.
        notes: warnings about the source, one sentence each.

    Attributes:
        frames: the source.
        session: session for single frames. A run over the whole drive has a session of its own.
        checks: findings about the input, from the single frames or the last run.

    Raises:
        UserError: the detector's model or a user-defined function cannot be used.
    """

    def __init__(self, frames: FrameSource, config: Config, notes: Sequence[str] = ()) -> None:
        self.frames, self.session = frames, Session(config)
        self.checks = InputChecks(frames, config)
        self._notes = list(notes)
        self._results: OrderedDict[tuple[int, int], FrameResult] = OrderedDict()
        self._poses: dict[int, F64] = {}  # estimated by runs over the drive, by stamp
        self._questioner: FrameExplainer | None = None
        self._viewer: NotebookViewer | None = None

    def close(self) -> None:
        """Close the source and the session."""
        self.frames.close()
        self.session.close()

    def __repr__(self) -> str:
        seconds = f"{self.times[-1]:.1f} s" if len(self) else "empty"
        noun = "scans" if self.scene.lidar else "images"
        return f"<Drive {self.scene.name}: {len(self)} {noun}, {seconds}, preset {self.config.preset}>"

    # --- properties ----------------------------------------------------------------------------

    @property
    def config(self) -> Config:
        """Current configuration."""
        return self.session.config

    @property
    def scene(self) -> Scene:
        """Names of the drive, its LiDARs and cameras."""
        return self.frames.scene

    @property
    def warnings(self) -> list[str]:
        """Losses and irregularities so far, one sentence each."""
        return [*map(python_words, self._notes), *map(python_words, self.checks.warnings)]

    @property
    def times(self) -> F64:
        """(N,) seconds from the first scan to each scan, by log time."""
        scans = self.frames.scans
        return np.asarray((scans - scans[0]) * 1e-9, np.float64) if len(scans) else np.zeros(0)

    def __len__(self) -> int:
        """Return the number of scans in the recording."""
        return len(self.frames.scans)

    @overload
    def __getitem__(self, frame: int) -> FrameResult: ...

    @overload
    def __getitem__(self, frame: slice) -> list[FrameResult]: ...

    def __getitem__(self, frame: int | slice) -> FrameResult | list[FrameResult]:
        """Return the results of one scan by its number, or those of a slice, see ``at``.

        Raises:
            IndexError: there is no such scan.
            UserError: a scan cannot be read.
        """
        if isinstance(frame, slice):
            return [self.at(frame=number) for number in range(*frame.indices(len(self)))]
        if not -len(self) <= frame < len(self):
            raise IndexError(f"frame {frame}: the drive has {len(self)}")
        return self.at(frame=frame)

    # --- one frame -----------------------------------------------------------------------------

    @overload
    def at(self, time: str | float) -> FrameResult: ...

    @overload
    def at(self, *, frame: int) -> FrameResult: ...

    @errors_about_arguments()
    def at(self, time: str | float | None = None, *, frame: int | None = None) -> FrameResult:
        """Return the results of one scan, without tracks and anomalies, which need the frames before it.

        Args:
            time: selects the nearest scan: seconds from the start (12.5), since 1970, or ISO 8601.
            frame: or the number of the scan, counted from 0; -1 is the last.

        Raises:
            UserError: the time is outside the recording, there is no such scan, or it cannot be read.
        """
        number = self._number(time, frame)
        key = number, id(self.config)
        if key not in self._results:
            self._results[key] = self.session.run_single(self.raw(number))
            self.checks.observe(self._results[key])
            while len(self._results) > MAX_RESULTS:
                self._results.popitem(last=False)
        self._results.move_to_end(key)
        return self._results[key]

    @errors_about_arguments()
    def raw(self, frame: int) -> Frame:
        """Return a scan with all messages of its time, before any stage, where the last run placed it.

        Raises:
            UserError: there is no such scan, or it cannot be read.
        """
        raw_frame = self.frames.frame(frame)
        if raw_frame is None:
            raise UserError(f"frame {frame}: the scan there cannot be read: {'; '.join(self.warnings)}")
        pose = self._poses.get(raw_frame.stamp)
        return raw_frame if pose is None else place(raw_frame, pose)

    @errors_about_arguments()
    def why(
        self,
        time: str | float | None = None,
        *,
        frame: int | None = None,
        cls: str = "",
        box: Sequence[float] = (),
        point: Sequence[float] = (),
        radius: float = 0.5,
        cell: Sequence[int] = (),
        cluster: int | None = None,
        detection: int | None = None,
        camera: str = "",
        hints: int = 5,
        everything: bool = False,
    ) -> list[Answer]:
        """Explain why objects of a frame were reported or missed, as ``bevviz why`` does.

        Without a time and a frame, the notebook's viewer selects the frame. Without a selection as well, the
        last click in it selects the object, too.

        Args:
            time: as in ``at``.
            frame: as in ``at``.
            cls: all objects of this class. With no selection at all: everything that went wrong.
            box: the object at the pixel u, v, or in the image box u0, v0, u1, v1.
            point: the object at x, y, z, in metres of the points' frame.
            radius: metres around that point or cell.
            cell: row and column of a cell of the bird's-eye view.
            cluster: row of a cluster in the frame's result.
            detection: row of a detection in the frame's result.
            camera: of the pixel or detection, if there are several cameras.
            hints: number of answers for which parameter changes are tried.
            everything: also explain correct results, and errors that no parameter could prevent.

        Returns:
            The answers, worst first.

        Raises:
            UserError: as ``at``. Or there is no such class, camera, pixel, cell, cluster or detection.
        """
        from bevviz.why import Selection

        selection = Selection(
            label=cls,
            box=tuple(box),
            point=tuple(point),
            radius=radius,
            cell=tuple(cell),
            cluster=cluster,
            detection=detection,
            camera=camera,
        )
        viewer = self._viewer
        if time is None and frame is None and viewer is not None:
            frame = viewer.frame
            if not (selection.one or selection.label) and (clicked := self.selected) is not None:
                frame, selection = clicked.frame, clicked.selection(self.config == viewer.config)
        questioner = self.questioner(time, frame=frame)
        answers = questioner.explain(selection, hints, everything=everything)
        if viewer is not None:
            viewer.mark(questioner.traces.result, answers)
        return answers

    @property
    def selected(self) -> Selected | None:
        """Last click in the notebook's viewer, see ``show``. None: nothing was clicked."""
        viewer = self._viewer
        if viewer is None or viewer.clicked is None:
            return None
        if viewer.config == self.config:
            return viewer.selected(self.at(frame=viewer.clicked))
        session = Session(viewer.config, loader=self.session.loader)
        return viewer.selected(session.run_single(self.raw(viewer.clicked)))

    @errors_about_arguments()
    def questioner(self, time: str | float | None = None, *, frame: int | None = None) -> FrameExplainer:
        """Return an object that answers questions about one scan. It computes shared results once.

        Args:
            time: as in ``at``.
            frame: as in ``at``.

        Raises:
            UserError: as ``at``.

        Example:
            >>> questioner = drive.questioner(12.5)
            >>> for answer in questioner.missed():
            ...     print(questioner.with_hints(answer).verdict.text)
        """
        from bevviz.why import FrameExplainer
        from bevviz.why.neighbours import frames_beside

        result = self.at(frame=self._number(time, frame))
        if self._questioner is None or self._questioner.traces.result is not result:
            names = self.session.stages.class_names
            beside = frames_beside(self.frames, result.frame.index)
            self._questioner = FrameExplainer(result, self.session.loader, names, neighbours=beside)
        return self._questioner

    @errors_about_arguments()
    def configure(self, *settings: str, **more: Any) -> dict[str, ParameterChange]:
        """Change parameters from now on.

        Args:
            settings: ``"clustering.eps=0.6"``, as after ``--set``.
            more: the same as ``clustering={"eps": 0.6}``.

        Returns:
            The changed parameters.

        Raises:
            UserError: an unknown key or a wrong value. No parameter is changed then.
        """
        return self.session.configure(changed_config(self.config, [*settings, *_settings(more)], USER))

    def _number(self, time: str | float | None, frame: int | None) -> int:
        if (time is None) == (frame is None):
            raise UserError("which scan? Give a time, or frame=NUMBER; or show() it in a notebook, and click")
        if time is not None:
            return self.frames.number_at(time)
        assert frame is not None
        return frame + len(self) if frame < 0 else frame

    # --- the whole drive -----------------------------------------------------------------------

    def __iter__(self) -> Iterator[FrameResult]:
        """Yield the result of every frame in order, with tracks and anomalies. Results are computed ahead."""
        with self.new_session() as session:
            for result in iterate_results(self.frames, session):
                self.checks.observe(result)
                yield result

    def new_session(self) -> Session:
        """Return a session for a run over the whole drive. It has its own tracks and shares the networks.

        Where it estimates the robot's motion, single frames are placed by that from then on.
        """
        self._results.clear()
        self._poses.clear()
        self.checks = InputChecks(self.frames, self.config)
        return Session(self.config, loader=self.session.loader, odometry=Odometry(self._poses))

    def run(self, observers: Sequence[Observer[FrameResult]]) -> RunEnd:
        """Run every frame in order and pass the results to the observers, see ``bevviz.pipeline.run.run``."""
        with self.new_session() as session:
            return run(self.frames, session, [*observers, self.checks])

    @errors_about_arguments()
    def evaluate(
        self, *, truth: str | None = None, kitti_labels: str | PathLike[str] | None = None
    ) -> Evaluation:
        """Run the whole drive and compare every frame with the ground truth.

        Args:
            truth: Detection3DArray topic of the ground truth; default: the one called ground truth.
            kitti_labels: or a folder of KITTI's labels, one file for each scan.

        Raises:
            UserError: there is no ground truth.

        Example:
            >>> drive.evaluate().metrics["recall.person@0-10"]
        """
        from bevviz.evaluate.evaluation import Evaluation
        from bevviz.evaluate.ground_truth import truth_in
        from bevviz.why import RunExplainer

        truths = truth_in(self.frames, truth, _path(kitti_labels))
        evaluation = Evaluation(truths, RunExplainer().false_causes)
        self.run([evaluation])
        return evaluation

    @errors_about_arguments()
    def save(self, path: str | PathLike[str], blueprint: str | Blueprint = "debug") -> Path:
        """Run the whole drive into a Rerun recording.

        Args:
            path: .rrd file to write.
            blueprint: layout.

        Raises:
            UserError: the file cannot be written, or there is no such blueprint.
        """
        from bevviz.findings.marks import MarkRecorder
        from bevviz.pipeline.run import Progress
        from bevviz.recording.recorder import DiskWatch, Recorder
        from bevviz.recording.sinks import open_recording

        target = Path(path)
        with open_recording(self.scene, self.config, save=target, blueprint=blueprint) as sinks:
            recorder = Recorder(sinks.recording, self.config, self.session.stages.provider)
            end = self.run([recorder, MarkRecorder(sinks.recording), DiskWatch(sinks), Progress()])
            if end.interrupted:
                raise KeyboardInterrupt
        return target

    @errors_about_arguments()
    def show(self, blueprint: str | Blueprint | None = None) -> None:
        """Run the whole drive into a viewer: in a notebook into the cell, else into a window.

        ``selected`` returns the last click in a notebook's viewer. ``why()`` explains it and marks it there.

        Args:
            blueprint: layout; None: ``workbench`` in a notebook, else ``debug``.

        Raises:
            UserError: no viewer can be shown.
        """
        from bevviz.findings.marks import MarkRecorder
        from bevviz.notebook import NotebookViewer, in_notebook
        from bevviz.recording.recorder import Recorder
        from bevviz.recording.sinks import open_recording

        if in_notebook():
            self._viewer = NotebookViewer(self.scene, self.config, blueprint or "workbench")
            self.run([self._viewer])
            return
        with open_recording(self.scene, self.config, spawn=True, blueprint=blueprint or "debug") as sinks:
            recorder = Recorder(sinks.recording, self.config, self.session.stages.provider)
            self.run([recorder, MarkRecorder(sinks.recording)])

    def _columns(self) -> Columns:
        """Run the whole drive and return a row for each frame: counts, times and problems."""
        from bevviz.findings.frame_findings import findings_of
        from bevviz.findings.frame_row import row
        from bevviz.why.frame_index import FrameIndex

        return [
            row(result, findings_of(FrameIndex(result)), evaluated=result.frame.truth is not None)
            for result in self
        ]


@errors_about_arguments()
def open_drive(
    path: str | PathLike[str] | Sequence[str | PathLike[str]],
    *,
    model: str | PathLike[str] = "",
    set: Settings = (),  # named as the command's option
    config: str | PathLike[str] | None = None,
    preset: Preset | None = None,
    start: str | float | None = None,
    end: str | float | None = None,
    every: int = 1,
    frames: tuple[int | None, int | None] | None = None,
    bag: str | PathLike[str] | None = None,
) -> Drive:
    """Open a recorded drive.

    Args:
        path: bag file or folder (MCAP, sqlite3, ROS 1); several are one drive. Or the folder of a data set,
            see docs/inputs.md. Or a recording (.rrd), which stands for its bag and its configuration.
        model: detector, as ``detector.model``.
        set: parameters: ``{"clustering.eps": 0.6}``, or ``["clustering.eps=60 cm"]`` as after ``--set``.
        config: YAML file, as ``bevviz config`` prints it.
        preset: ``default``, or ``reference``: as the ROS 2 tutorial pipeline.
        start: first time of a run over the whole drive. Single frames ignore this and the next three.
        end: last time of such a run.
        every: number N to run each N-th scan only.
        frames: numbers A, B to run scans A to B - 1.
        bag: bag of a recording, if it is not found automatically.

    Raises:
        UserError: there is no bag, or it is empty. Or a parameter is unknown, or a model cannot be used.

    Example:
        >>> import bevviz
        >>> drive = bevviz.open("drive.mcap", model="yolo11n.onnx", set={"clustering.eps": 0.6})
        >>> result = drive.at(12.5)
        >>> result.objects.to_pandas()
        >>> for answer in drive.why(12.5, cls="person"):
        ...     print(answer.verdict.text)
    """
    from bevviz.bags.source import BagSource

    paths = [Path(p) for p in ([path] if isinstance(path, str | PathLike) else path)]
    settings, notes = _all_settings(model, set), tuple[str, ...]()
    if len(paths) == 1 and paths[0].suffix == ".rrd":
        from bevviz.recording.source_lookup import find_source

        recorded = find_source(paths[0], [] if bag is None else [Path(bag)], settings)
        paths, notes = list(recorded.paths), recorded.warnings
        loaded = recorded.load(_path(config), settings, preset)
    elif bag is not None:
        raise UserError(f"bag={bag}: is where the bag of a recording lies, and {paths[0]} is none")
    else:
        loaded = load(_path(config), settings, preset)
    times = {"start": None if start is None else str(start), "end": None if end is None else str(end)}
    source = BagSource(paths, loaded, every=every, frames=frames, **times)
    try:
        return Drive(source, loaded, notes)
    except BaseException:
        source.close()
        raise


@errors_about_arguments()
def simulate(
    frames: int = 100,
    seed: int = 0,
    *,
    plant: Sequence[str] = (),
    model: str | PathLike[str] = "demo",
    set: Settings = (),
    config: str | PathLike[str] | None = None,
    preset: Preset | None = None,
) -> Drive:
    """Return the synthetic drive of ``bevviz demo``, with ground truth and its own detector.

    Args:
        frames: scans, at 10 Hz.
        seed: selects the street.
        plant: faults to plant, see ``bevviz demo --help``.
        model: as in ``bevviz.open``.
        set: as in ``bevviz.open``.
        config: as in ``bevviz.open``.
        preset: as in ``bevviz.open``.

    Raises:
        UserError: no such fault, an unknown parameter, or a model that cannot be used.
    """
    simulator: Callable[..., FrameSource] = find("simulators", "demo")
    return Drive(simulator(frames, seed, plant=plant), load(_path(config), _all_settings(model, set), preset))


def _all_settings(model: str | PathLike[str], settings: Settings) -> list[str]:
    """Return the settings as ``key=value``."""
    tree_settings = _settings(settings) if isinstance(settings, Mapping) else list(settings)
    return [*([f"detector.model={model}"] if model else []), *tree_settings]


def _path(path: str | PathLike[str] | None) -> Path | None:
    return None if path is None else Path(path)


def _settings(tree: Mapping[str, Any]) -> list[str]:
    """Return dotted keys, or keys in sections, as ``key=value`` for ``--set``."""
    flat: list[str] = []
    for key, value in tree.items():
        if isinstance(value, Mapping) and "." not in key:
            flat += _settings({f"{key}.{name}": inner for name, inner in value.items()})
        else:
            flat.append(f"{key}={value if isinstance(value, str) else json.dumps(value)}")
    return flat
