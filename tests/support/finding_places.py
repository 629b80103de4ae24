"""Counts of what went wrong in a drive, by frame and kind, from each place that counts it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import pyarrow.parquet as pq

import bevviz
from bevviz.cli import main
from bevviz.config import load
from bevviz.evaluate.evaluation import EvaluationResult
from bevviz.extras.mcp.drives import AskedDrive
from bevviz.extras.mcp.tools import AgentTools
from bevviz.why import Selection
from bevviz.why.answer_text import summary_line
from tests.support.recordings import Recording

Counts: TypeAlias = Counter[tuple[int, str]]  # (frame, kind) -> number

JUDGED = ("missed", "false")
STATES = {  # state of a mark -> kinds that have it, number of lines of a mark
    "missed": (("missed",), 12 * 4),
    "false": (("false", "doubtful"), 14),
    "unexplained": (("unmatched",), 8 * 8),
    "unnamed": (("unnamed",), 12 * 8),
}


class FindingPlaces:
    """Places that count the findings of one drive.

    Args:
        drive: the drive, with or without ground truth.
        model: detector.
        folder: folder for the results of a batch.
        settings: parameters, as after ``--set``.
    """

    def __init__(self, drive: Path, model: str, folder: Path, settings: Sequence[str] = ()) -> None:
        self._drive, self._model, self._folder, self._settings = drive, model, folder, list(settings)
        words = [word for setting in settings for word in ("--set", setting)]
        assert main(["batch", str(drive), "-o", str(folder), "--model", model, "--jobs", "1", *words]) == 0
        [self._recording] = folder.glob("*.rrd")
        self._summary = pq.read_table(folder / "summary.parquet").drop_columns("stamp").to_pylist()
        self.has_truth = any(row["missed"] is not None for row in self._summary)

    def disagreements(self) -> dict[str, tuple[Counts, Counts]]:
        """Return what each place and the list do not have in common, by place. Empty: all agree."""
        listed = self.listed()
        places = {
            "marks of batch": (self.marks(self._recording), _by_state(listed)),
            "marks of bag": (self.marks(self._saved()), _by_state(listed)),
            "findings.parquet": (self.findings_table(), listed),
            "worst frames": (self.worst_frames(), _of(listed, (*JUDGED, "unmatched"))),
            "agent": (self.agent(), _without_frames(listed)),
            "why": (self.why(), _as_why(listed)),
        }
        if self.has_truth:
            places["evaluate"] = self.evaluate(), _of(listed, JUDGED)
        return {name: (a - b, b - a) for name, (a, b) in places.items() if +a != +b}

    def listed(self) -> Counts:
        """Return the findings in the list of the whole run."""
        with self._asked() as asked:
            groups = asked.findings.list.content()
        return Counter((one.frame, kind) for kind, _, frames in groups for one in frames if kind != "anomaly")

    def _saved(self) -> Path:
        """Record the drive as ``bag`` does. Return the recording."""
        path = self._folder / "saved" / "drive.rrd"
        path.parent.mkdir(exist_ok=True)
        with bevviz.open(self._drive, model=self._model, set=self._settings) as drive:
            drive.save(path)
        return path

    def marks(self, path: Path) -> Counts:
        """Return the marks in a recording, by state."""
        recording = Recording(path)
        counts: Counts = Counter()
        for state, (_, lines) in STATES.items():
            for frame, sentences in recording.at[f"/world/{state}"]["says"].items():
                assert len(sentences) % lines == 0
                counts[frame, state] += len(sentences) // lines
        return counts

    def findings_table(self) -> Counts:
        """Return the findings in ``findings.parquet``."""
        table = pq.read_table(self._folder / "findings.parquet", columns=["frame", "kind"]).to_pylist()
        return Counter((row["frame"], row["kind"]) for row in table if row["kind"] not in (None, "anomaly"))

    def worst_frames(self) -> Counts:
        """Return the findings that the summary of the batch counts."""
        counts: Counts = Counter()
        for row in self._summary:
            numbers = {"missed": row["missed"], "false": row["false"], "unmatched": len(row["unmatched"])}
            counts.update({(row["frame"], kind): number or 0 for kind, number in numbers.items()})
            remarks = Counter(text.partition(" ")[0] for text in row["remarks"])
            assert all(remarks[kind] == (number or 0) for kind, number in numbers.items()), row["remarks"]
        return counts

    def evaluate(self) -> Counts:
        """Return the missed and false objects that ``evaluate`` counts."""
        with bevviz.open(self._drive, model=self._model, set=self._settings) as drive:
            result: EvaluationResult = drive.evaluate().result()
        counts: Counts = Counter()
        for frame in result.worst:
            counts[frame.frame, "missed"] += len(frame.missed)
            counts[frame.frame, "false"] += len(frame.false)
        return counts

    def why(self) -> Counts:
        """Return what ``why`` counts in each frame."""
        counts: Counts = Counter()
        with bevviz.open(self._drive, model=self._model, set=self._settings) as drive:
            for number in range(len(drive)):
                explainer = drive.questioner(frame=number)
                answers = explainer.ask(Selection())
                missed, false = len(explainer.missed()), sum(answer.false for answer in answers)
                if answers:
                    assert f" {missed} missed within 40 m" in summary_line(answers)
                counts.update({(number, "missed"): missed, (number, "false"): false})
        return counts

    def agent(self) -> Counts:
        """Return the findings that an agent is told of, of all frames together."""
        with self._asked() as asked:
            answer: dict[str, Any] = json.loads(AgentTools({"drive": lambda: asked}).findings(limit=1))
        counts: Counts = Counter()
        for cause, number in answer["frames_by_cause"].items():
            kind = cause.partition(":")[0]
            if kind != "anomaly":
                counts[0, kind] += number
        return counts

    @contextmanager
    def _asked(self) -> Iterator[AskedDrive]:
        """Open the drive as an agent's tools do."""
        config = load(settings=[f"detector.model={self._model}", *self._settings])
        asked = AskedDrive.of([str(self._drive)], [self._drive], config)
        yield asked
        asked.session.close()


def _of(counts: Counts, kinds: Sequence[str]) -> Counts:
    return Counter({key: number for key, number in counts.items() if key[1] in kinds})


def _by_state(counts: Counts) -> Counts:
    """Return the counts by the state of the marks."""
    states = {kind: state for state, (kinds, _) in STATES.items() for kind in kinds}
    return _renamed((frame, states[kind], number) for (frame, kind), number in counts.items())


def _as_why(counts: Counts) -> Counts:
    """Return the counts in the words of ``why``: what was not reported, and what should not have been."""
    words = {"missed": "missed", "unmatched": "missed", "false": "false", "doubtful": "false"}
    return _renamed((frame, words[kind], number) for (frame, kind), number in counts.items() if kind in words)


def _without_frames(counts: Counts) -> Counts:
    return _renamed((0, kind, number) for (_, kind), number in counts.items())


def _renamed(rows: Iterator[tuple[int, str, int]]) -> Counts:
    renamed: Counts = Counter()
    for frame, kind, number in rows:
        renamed[frame, kind] += number
    return renamed
