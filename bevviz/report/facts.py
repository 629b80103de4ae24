"""Description of a report beside the results: text for its page, and data in its recording."""

from __future__ import annotations

import json
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter

from bevviz.bags.source import SECOND, iso
from bevviz.config import Config, ParameterChange, changes, load, with_stage_files
from bevviz.recording.provenance import Dependency, Provenance, model_path
from bevviz.report.bag_window import ReportWindow
from bevviz.support.text import fenced, markdown
from bevviz.support.version import install_command
from bevviz.why import Answer
from bevviz.why.steps import Step

TRACEBACKS = 5  # tracebacks that are listed
_FOLDERS = re.compile(r'(?<=File ").*?([^/\\"]+[/\\][^/\\"]+)(?=")')


@dataclass(frozen=True, slots=True)
class TriedText:
    """Values that were tried, what the subject is then, and the objects that get better and worse.

    ``fixes`` and ``breaks`` are empty where they were not counted.
    """

    settings: str
    result: str
    fixes: str = ""
    breaks: str = ""


@dataclass(frozen=True, slots=True)
class Cause:
    """The first lines of a report: the object that it is about, where it is, and why.

    Attributes:
        what: what became of the object.
        where: its place, and the frame.
        why: the reason in a sentence.
        chain: decision of each stage.
        tried: values that were tried.
        remark: one sentence where no values helped, or none could be tried.
    """

    what: str
    where: str
    why: str
    chain: Sequence[Step]
    tried: Sequence[TriedText]
    remark: str = ""

    def markdown(self) -> list[str]:
        """Return the lines of the same in Markdown."""
        lines = [f"## {markdown(self.what)}", "", f"**{markdown(self.why)}**", "", markdown(self.where)]
        lines += ["", "## What was tried", ""]
        for tried in self.tried:
            effects = f"; fixes {tried.fixes}; breaks {tried.breaks}" if tried.fixes else ""
            lines.append(f"- `{tried.settings}`: {markdown(tried.result + effects)}")
        lines += [markdown(self.remark)] if self.remark else []
        lines += ["", "## What became of it at each stage", ""]
        return [*lines, *_chain(self.chain)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """Text of a page beside the results. It is escaped where it is written."""

    title: str
    note: str
    notes: Mapping[str, str]  # notes of the drive within the window, by time
    cause: Cause | None  # None: there is no frame, or nothing in it went wrong
    asked: Sequence[Answer]  # further answers
    where: str  # the bag, its window and the frame
    start: int  # log time of the recording's start, from which seconds are counted
    config: str  # one sentence about preset and changes
    changes: Mapping[str, ParameterChange]  # by key, before: value of the preset
    versions: Sequence[str]
    hardware: Sequence[str]
    warnings: Sequence[str]
    tracebacks: Mapping[str, str]  # unexpected errors in stages, by heading
    files: Sequence[str]  # files beside the page
    commands: Sequence[str]

    def markdown(self) -> str:
        """Return the text for the recording, without what the recording holds already."""
        lines = [f"# {markdown(self.title)}", "", markdown(self.where), ""]
        lines += [f"> {markdown(line)}" for line in self.note.splitlines()]
        lines += [f"- {markdown(when)}: {markdown(text)}" for when, text in self.notes.items()]
        lines += ["", *self.cause.markdown()] if self.cause is not None else []
        lines += ["", "## Also missed, or asked about"] if self.asked else []
        for answer in self.asked:
            lines += ["", f"**{markdown(answer.text)}**", "", *_chain(answer.steps)]
        for title, items in (("Files", self.files), ("Warnings", self.warnings), ("Hardware", self.hardware)):
            lines += ["", f"## {title}", "", *(f"- {markdown(item)}" for item in items)] if items else []
        for title, traceback in self.tracebacks.items():
            lines += ["", f"## {markdown(title)}", "", fenced(traceback)]
        commands = fenced("\n".join(self.commands))
        return "\n".join([*lines, "", "## How to run it again", "", commands])


def _chain(steps: Sequence[Step]) -> list[str]:
    """Return the decision of each stage as a list in Markdown."""
    return [f"- *{step.stage}*: {markdown(step.text)}" for step in steps]


def window_text(name: str, window: ReportWindow) -> str:
    """Return the sentence about the window of a bag, in seconds and in UTC."""
    first, last, at = ((t - window.start) / SECOND for t in (window.low, window.high, window.at))
    return f"{name}, {first:.1f} to {last:.1f} s of it, at {at:.3f} s ({iso(window.at)})"


def commands(
    rrd: Path, window: ReportWindow, config: Config, redacted: bool, tried: Sequence[str] = ()
) -> list[str]:
    """Return the commands that show, check and repeat the report, to be typed in the folder of its files.

    Args:
        rrd: the recording. The bag lies beside it.
        window: the scans.
        config: the configuration without folders of this machine.
        redacted: whether the images of the bag are redacted.
        tried: settings to compare the run with.
    """
    run = [rrd.with_suffix(".mcap").name]
    run += ["--start", iso(window.low), "--end", iso(window.high)]
    run += ["--preset", config.preset] if config.preset != "default" else []
    for key, change in changes(load(preset=config.preset), config).items():
        run += ["--model", config.detector.model] if key == "detector.model" else []
        run += ["--set", f"{key}={json.dumps(change.after)}"] if key != "detector.model" else []
    note = ["# its images are redacted: here the network sees less than it did"] if redacted else []
    other = [part for setting in tried for part in ("--set-b", setting)]
    return [
        install_command(),
        shlex.join(["rerun", rrd.name]),
        shlex.join(["bevviz", "report", "--check", rrd.name]),
        *note,
        shlex.join(["bevviz", "bag", *run]),
        *([shlex.join(["bevviz", "compare", *run, *other])] if tried else []),
    ]


def traceback_texts(tracebacks: Counter[tuple[str, str]]) -> dict[str, str]:
    """Return the most common tracebacks by heading, without folders of this machine."""
    return {
        f"Traceback of stage '{stage}' ({times} frame{'s' * (times > 1)})": _FOLDERS.sub(r"\1", text)
        for (stage, text), times in reversed(tracebacks.most_common(TRACEBACKS))
    }


def file_lines(sizes: Mapping[str, str], counts: Mapping[str, int], model: Dependency | None) -> list[str]:
    """Return one line per file of a report, and one about its model."""
    lines = [f"{name}: {size}" for name, size in sizes.items()]
    if counts:
        topics = ", ".join(f"{topic} ({n})" for topic, n in sorted(counts.items()))
        lines.append(f"messages in the bag, by topic: {topics}")
    if model is not None:
        lines.append(f"model: {model.file}, SHA-256 {model.sha256}")
    return lines


# --- in the recording --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportInfo:
    """Description of a report: bag, window, provenance and options. It holds no personal data.

    Times are log times in nanoseconds.
    """

    low: int
    high: int
    at: int
    bag_sha256: str
    provenance: Provenance
    names: str  # content of the file with class names, which is not part of the report
    redacted: bool
    interrupted: bool
    note: str
    warnings: Sequence[str]

    def dump(self) -> str:
        """Return the description as JSON."""
        return json.dumps(asdict(self))

    @staticmethod
    def load(text: str) -> ReportInfo:
        """Read a description from JSON.

        Raises:
            ValueError: ``text`` is not from ``dump``.
        """
        return _INFO.validate_json(text, strict=True)


_INFO = TypeAdapter(ReportInfo)


def shareable(config: Config) -> Config:
    """Return the configuration without folders of this machine."""
    detector, live, model = config.detector, config.live, model_path(config)
    calibrations = {topic: Path(file).name for topic, file in config.source.lidar_calibration.items()}
    results = {name: Path(file).name for name, file in config.source.results.items()}
    files = {"lidar_calibration": calibrations, "results": results}
    name = detector.model if model is None or detector.model == "demo" else model.name
    return with_stage_files(config, lambda file: Path(file).name).model_copy(
        update={
            "detector": detector.model_copy(update={"model": name, "names": Path(detector.names).name}),
            "source": config.source.model_copy(update=files),
            "live": live.model_copy(update={"flight_folder": ""}),
        }
    )
