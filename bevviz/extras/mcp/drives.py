"""Drives that an agent asks about: how they are opened and run, and which values an agent may change."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from bevviz.anomalies import FailureSummary
from bevviz.checks import InputChecks
from bevviz.config import (
    TUTORIAL_NAMES,
    Config,
    changed_config,
    parameter,
    parameters,
    unknown_key,
    untrusted_layers,
)
from bevviz.config.trust import MESSAGE
from bevviz.drive import Drive
from bevviz.errors import UserError
from bevviz.evaluate import truth_source
from bevviz.findings.finding_list import FindingList
from bevviz.findings.frame_findings import find_findings
from bevviz.model.protocols import Observer
from bevviz.model.results import FrameResult
from bevviz.pipeline.run import run
from bevviz.pipeline.session import Session
from bevviz.recording.source_lookup import find_source
from bevviz.workbench.labelled_source import LabelledSource
from bevviz.workbench.session import WorkbenchSession, recorded_session


@dataclass
class AskedDrive:
    """An open drive, and the words after ``bevviz COMMAND`` that open it in a terminal."""

    words: Sequence[str]
    paths: Sequence[Path]
    source: LabelledSource
    session: WorkbenchSession
    drive: Drive
    truth: tuple[str | None, Path | None] = (None, None)

    @classmethod
    def of(
        cls,
        words: Sequence[str],
        paths: Sequence[Path],
        config: Config,
        truth: tuple[str | None, Path | None] = (None, None),
    ) -> AskedDrive:
        """Open a drive.

        Args:
            words: see the class.
            paths: of the bag.
            config: configuration of the runs.
            truth: topic and label files of the ground truth, if the user has stated them.

        Raises:
            UserError: the bag or the model cannot be used.
        """
        source = LabelledSource(paths, config)
        if truth != (None, None):
            source.truth_of = truth_source(source, *truth)
        drive = Drive(source, config)
        session = recorded_session(drive, source, paths)
        return cls(words, paths, source, session, drive, truth)

    def command(self, command: str, *words: object) -> str:
        """Return the command line that gives the same in a terminal."""
        return shlex.join(["bevviz", command, *self.words, *map(str, words)])

    def run(self, settings: Sequence[str], observers: Sequence[Observer[FrameResult]]) -> None:
        """Run the drive with some values changed."""
        config = agent_config(self.drive.config, settings)
        with Session(config, loader=self.drive.session.loader) as session:
            run(self.drive.frames, session, observers)

    @cached_property
    def findings(self) -> RunFindings:
        """Findings of a run of the whole drive."""
        found = RunFindings(self)
        self.run((), [found])
        return found


class RunFindings(Observer[FrameResult]):
    """Findings, failures and warnings of a run."""

    def __init__(self, asked: AskedDrive) -> None:
        self._asked = asked
        self.list, self.failures, self.frames = FindingList(), FailureSummary(), 0
        self.checks = InputChecks(asked.drive.frames, asked.drive.config)

    def observe(self, result: FrameResult) -> None:
        """List the findings of a frame."""
        self.list.add(find_findings(self._asked.session.source.explainer(result)))
        self.failures.observe(result)
        self.checks.observe(result)
        self.frames += 1


def agent_config(config: Config, settings: Sequence[str]) -> Config:
    """Return the configuration with an agent's values, which are numbers, booleans and declared choices.

    Raises:
        UserError: an unknown key, a wrong value, or a parameter that only the user may state. Nothing is
            looked up before: not even whether a file exists.
    """
    for layer in untrusted_layers(settings, trust=MESSAGE):
        for stated, value in layer.values.items():
            key = TUTORIAL_NAMES.get(stated, stated)
            declared = parameter(key, config)
            if declared is None:
                raise UserError(f"{layer.where}: {unknown_key(key, [*parameters(config)])}")
            if not declared.is_number_or_choice(value):
                raise UserError(
                    f"{key}: an agent states numbers, booleans and built-in choices; names, files, topics "
                    f"and functions are stated by the user: bevviz mcp --set {key}=..."
                )
    return changed_config(config, settings)


def batch_drives(results: Sequence[tuple[Path, object]]) -> dict[str, Callable[[], AskedDrive]]:
    """Return what opens each drive of a batch, as its recording was configured."""

    def opener(recording: Path) -> Callable[[], AskedDrive]:
        def open_it() -> AskedDrive:
            found = find_source(recording, [], ())
            return AskedDrive.of([str(recording)], found.paths, found.load())

        return open_it

    return {table.stem: opener(table.with_suffix(".rrd")) for table, _ in results}
