"""What a report states beside its results: where it comes from, what lies beside it, how to run it again."""

from __future__ import annotations

import json
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bevviz.bags.source import SECOND, iso
from bevviz.config import Config, ParameterChange, changes, load
from bevviz.recording.provenance import Dependency
from bevviz.report.bag_window import Window
from bevviz.support.text import fenced, markdown
from bevviz.support.version import __version__

TRACEBACKS = 5  # that are told
_FOLDERS = re.compile(r'(?<=File ").*?([^/\\"]+[/\\][^/\\"]+)(?=")')


@dataclass(frozen=True, slots=True)
class Asked:
    """What was asked about, and why it is as it is: the verdict, and stage by stage."""

    verdict: str
    reported: bool
    chain: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What a page states beside the results. All of it is text, and escaped where it is written."""

    title: str
    note: str
    notes: Mapping[str, str]  # of the drive, in the window, by their time
    asked: Sequence[Asked]
    where: str  # the bag, its window, and the place in it
    start: int  # log time of the recording's start: seconds count from here
    config: str  # preset in a sentence
    changes: Mapping[str, ParameterChange]  # by key; before: as the preset has it
    versions: Sequence[str]
    hardware: Sequence[str]
    warnings: Sequence[str]
    tracebacks: Mapping[str, str]  # of errors in stages that nobody foresaw, by a heading
    files: Sequence[str]  # what lies beside the page
    commands: Sequence[str]

    def markdown(self) -> str:
        """The same for the recording, without what it holds already."""
        lines = [f"# {markdown(self.title)}", "", markdown(self.where), ""]
        lines += [f"> {markdown(line)}" for line in self.note.splitlines()]
        lines += [f"- {markdown(when)}: {markdown(text)}" for when, text in self.notes.items()]
        for one in self.asked:
            lines += ["", f"**{markdown(one.verdict)}**", ""]
            lines += [f"- *{stage}*: {markdown(text)}" for stage, text in one.chain]
        for title, items in (("Files", self.files), ("Warnings", self.warnings), ("Hardware", self.hardware)):
            lines += ["", f"## {title}", "", *(f"- {markdown(item)}" for item in items)] if items else []
        for title, traceback in self.tracebacks.items():
            lines += ["", f"## {markdown(title)}", "", fenced(traceback)]
        commands = fenced("\n".join(self.commands))
        return "\n".join([*lines, "", "## How to run it again", "", commands])


def window_text(name: str, window: Window) -> str:
    """Where in a bag, in both kinds of time."""
    first, last, at = ((t - window.start) / SECOND for t in (window.low, window.high, window.at))
    return f"{name}, {first:.1f} to {last:.1f} s of it, at {at:.3f} s ({iso(window.at)})"


def commands(rrd: Path, window: Window, config: Config, redacted: bool) -> list[str]:
    """What to type where the files are, to see, to prove and to run it again.

    Args:
        rrd: the recording; the bag lies beside it.
        window: the scans.
        config: without the folders of this machine.
        redacted: whether the bag's images are.
    """
    run = ["bevviz", "bag", rrd.with_suffix(".mcap").name]
    run += ["--start", iso(window.low), "--end", iso(window.high)]
    run += ["--preset", config.preset] if config.preset != "default" else []
    for key, change in changes(load(preset=config.preset), config).items():
        run += ["--model", config.detector.model] if key == "detector.model" else []
        run += ["--set", f"{key}={json.dumps(change.after)}"] if key != "detector.model" else []
    note = ["# its images are redacted: here the network sees less than it did"] if redacted else []
    return [
        f"pip install bevviz=={__version__}",
        shlex.join(["rerun", rrd.name]),
        shlex.join(["bevviz", "report", "--check", rrd.name]),
        *note,
        shlex.join(run),
    ]


def traceback_texts(tracebacks: Counter[tuple[str, str]]) -> dict[str, str]:
    """The most common ones by a heading, without the folders of this machine."""
    return {
        f"Traceback of stage '{stage}' ({times} frame{'s' * (times > 1)})": _FOLDERS.sub(r"\1", text)
        for (stage, text), times in reversed(tracebacks.most_common(TRACEBACKS))
    }


def file_lines(sizes: Mapping[str, str], counts: Mapping[str, int], model: Dependency | None) -> list[str]:
    """The files of a report, and the model that it needs."""
    lines = [f"{name}: {size}" for name, size in sizes.items()]
    if counts:
        topics = ", ".join(f"{topic} ({n})" for topic, n in sorted(counts.items()))
        lines.append(f"messages in the bag, by topic: {topics}")
    if model is not None:
        lines.append(f"model: {model.file}, SHA-256 {model.sha256}")
    return lines
