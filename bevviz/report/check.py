"""Runs a report again and compares the results with those that it holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rerun.chunk import RrdReader
from tqdm import tqdm

from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.logging import entities
from bevviz.pipeline import Pipeline
from bevviz.prefetch import prefetch
from bevviz.provenance import versions
from bevviz.report.digest import ROUNDING, Difference, Stage, compare, detections_of, digest, unpack
from bevviz.report.make import replay
from bevviz.report.origin import About, changes, file_hash, hardware, model_of
from bevviz.report.window import open_window


@dataclass(frozen=True, slots=True)
class Kept:
    """A report as its recording holds it."""

    about: About
    config: str  # YAML
    versions: Sequence[str]
    frames: dict[int, tuple[Stage, ...]]  # by number


@dataclass(slots=True)
class Verdict:
    """How a second run compares. ``changed``: what it was made with that is not as it was then."""

    frames: int = 0
    exact: int = 0  # frames that are the same in every bit
    rounding: float = 0.0  # largest relative difference of a number in those that are the same but for it
    differing: int = 0
    first: tuple[int, Difference] | None = None  # frame and what differs
    changed: list[str] = field(default_factory=list)
    redacted: bool = False

    @property
    def same(self) -> bool:
        return self.frames > 0 and not self.differing

    def lines(self) -> list[str]:
        """For people."""
        if self.first is not None:
            number, difference = self.first
            said = [
                f"{self.differing} of {self.frames} frames differ, first frame {number} "
                f"in '{difference.stage}': {difference.text}"
            ]
        elif self.exact == self.frames:
            said = [f"{self.frames} frames: the same in every bit"]
        else:
            said = [
                f"{self.frames} frames: the same; {self.exact} in every bit, the others to "
                f"{self.rounding:.1g} of their numbers (rounding, up to {ROUNDING:g})"
            ]
        if self.redacted:
            said.append(
                "the images are redacted: detections are taken from the report, all else was computed again"
            )
        return said + [f"not as it was: {text}" for text in self.changed]


def check(rrd: Path, *, model: Path | None = None, settings: Sequence[str] = ()) -> Verdict:
    """Run the bag beside a report's recording as the recording says, and compare each frame.

    Args:
        rrd: the recording; ``NAME.mcap`` lies beside it.
        model: the detector's file, where it does not lie beside it.
        settings: ``key=value`` to be changed.

    Raises:
        UserError: no report, no bag, or no model.
    """
    kept = read(rrd)
    about, bag = kept.about, rrd.with_suffix(".mcap")
    if not bag.exists():
        raise UserError(f"{bag}: the bag of the report is not there; it has the name of the recording")
    with TemporaryDirectory(prefix="bevviz-") as folder:
        stored, config = _config(rrd, kept, model, settings, Path(folder))
        verdict = Verdict(redacted=about.redacted)
        detections = {
            key: value for stages in kept.frames.values() for key, value in detections_of(stages).items()
        }
        with (
            open_window([bag], config, about.low, about.high) as source,
            Pipeline(config, replay(detections) if about.redacted else None) as pipeline,
        ):
            verdict.changed = _changed(kept, bag, stored, pipeline)
            left = dict(kept.frames)
            for frame in tqdm(
                prefetch(source, 2), total=source.total, unit="frame", desc="check", disable=None
            ):
                if about.interrupted and not left:
                    break
                then = left.pop(frame.index, ())
                _count(verdict, frame.index, compare(then, digest(pipeline.run(frame))))
    for number in sorted(left):
        _count(verdict, number, Difference("cloud", "this run makes no such frame", float("inf")))
    return verdict


def read(rrd: Path) -> Kept:
    """The report in a recording.

    Raises:
        UserError: no recording, or none of a report.
    """
    about = config = made_with = None
    frames: dict[int, tuple[Stage, ...]] = {}
    if not rrd.is_file():
        raise UserError(f"{rrd}: no such file")
    try:
        for chunk in RrdReader(rrd).stream():
            if chunk.entity_path == "/__properties/report":
                about = About.load(_column(chunk, "about")[-1][0])
            elif chunk.entity_path == "/__properties/bevviz":
                config, made_with = _column(chunk, "config")[-1][0], _column(chunk, "versions")[-1]
            elif chunk.entity_path == entities.DIGEST:
                numbers = _column(chunk, entities.FRAME)
                rows = zip(numbers, _column(chunk, "stages"), _column(chunk, "arrays"), strict=True)
                frames |= {n: unpack(lines, np.array(block, np.uint8)) for n, lines, block in rows}
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise UserError(f"{rrd}: cannot be read as a report: {str(error).splitlines()[0]}") from None
    if about is None or config is None or made_with is None:
        raise UserError(f"{rrd}: a recording, but not one of 'bevviz report' (or one that was not finished)")
    return Kept(about, config, made_with, frames)


def _column(chunk: Any, name: str) -> list[Any]:
    found: list[Any] = chunk.to_record_batch().column(name).to_pylist()
    return found


def _config(
    rrd: Path, kept: Kept, model: Path | None, settings: Sequence[str], folder: Path
) -> tuple[Config, Config]:
    """The configuration as it is kept, and as it is to be run on this machine."""
    file, names = folder / "config.yaml", folder / "names.txt"
    file.write_text(kept.config)
    names.write_text("\n".join(kept.about.classes))
    stored = load(file)
    here = [f"detector.names={names}"] if kept.about.classes else []
    if model is not None:
        here.append(f"detector.model={model}")
    elif stored.detector.model not in ("", "demo") and not kept.about.redacted:
        beside = rrd.with_name(stored.detector.model)
        if not beside.exists():
            was = f"{stored.detector.model}" + (
                f" (SHA-256 {kept.about.model.sha256})" if kept.about.model else ""
            )
            raise UserError(f"{rrd}: it was made with {was}, which is not beside it: give --model FILE")
        here.append(f"detector.model={beside}")
    return stored, load(file, [*here, *settings])


def _changed(kept: Kept, bag: Path, stored: Config, pipeline: Pipeline) -> list[str]:
    about, config = kept.about, pipeline.config
    found = []
    if file_hash(bag) != about.bag_sha256:
        found.append(f"{bag.name} is not the file that the report was made with (SHA-256)")
    local = ("detector.model", "detector.names")
    for key, (then, now) in changes(config, stored).items():
        if key not in local:
            found.append(f"{key} was {then}, is {now}")
    if not about.redacted:
        model = model_of(config)
        if model is not None and about.model is not None and model.sha256 != about.model.sha256:
            found.append(f"model was {about.model.name} (SHA-256 {about.model.sha256}), is {model.sha256}")
    here = dict(line.rsplit(" ", 1) for line in [f"{name} {number}" for name, number in versions().items()])
    for line in kept.versions:
        name, number = line.rsplit(" ", 1)
        if here.get(name) != number:
            found.append(f"{name} was {number}, is {here.get(name, 'absent')}")
    machine = dict(line.split(": ", 1) for line in hardware(pipeline).lines())
    for line in about.hardware:
        name, value = line.split(": ", 1)
        if machine.get(name) != value:
            found.append(f"{name} was {value}, is {machine.get(name)}")
    return found


def _count(verdict: Verdict, number: int, difference: Difference | None) -> None:
    verdict.frames += 1
    if difference is None:
        verdict.exact += 1
    elif difference.amount <= ROUNDING:
        verdict.rounding = max(verdict.rounding, difference.amount)
    else:
        verdict.differing += 1
        verdict.first = verdict.first or (number, difference)
