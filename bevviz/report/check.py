"""Run a report again and compare the results with the stored ones."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from bevviz.config import Config, Layer, changes, flat_yaml, load, stage_files
from bevviz.errors import UserError
from bevviz.model.protocols import Observer
from bevviz.model.results import FrameResult
from bevviz.pipeline.run import Progress, run
from bevviz.pipeline.session import Session
from bevviz.recording import entities
from bevviz.recording.provenance import differences, model_path, provenance
from bevviz.recording.rerun_cli import check_decodes, reader_errors_as_user_errors
from bevviz.report.bag_window import open_window
from bevviz.report.facts import ReportInfo
from bevviz.report.fingerprints import (
    ROUNDING,
    DigestDifference,
    StageDigest,
    compare,
    detections_of,
    digest,
    unpack,
)
from bevviz.report.make import replay
from bevviz.support.files import file_hash
from bevviz.support.onnx_files import DEMO_MODEL
from bevviz.support.scratch_folder import ScratchFolder

UNREADABLE = "cannot be read as a report"
_SEAL = re.compile(rb'id="seal">SHA-256 of the recording: ([0-9a-f]{64})<')


@dataclass(frozen=True, slots=True)
class StoredReport:
    """Content of a report's recording."""

    info: ReportInfo
    config: str  # YAML
    frames: dict[int, tuple[StageDigest, ...]]  # by frame number


@dataclass(slots=True)
class CheckResult:
    """Result of a check. ``changed``: inputs and versions that differ from those of the report."""

    frames: int = 0
    exact: int = 0  # frames that are equal in every bit
    rounding: float = 0.0  # largest relative difference in frames that are equal except for rounding
    differing: int = 0
    first: tuple[int, DigestDifference] | None = None  # frame number and difference
    changed: list[str] = field(default_factory=list)
    redacted: bool = False
    sound: bool = True  # whether the bag is, byte for byte, the one of the report
    sealed: bool = True  # whether a page beside the recording confirms its checksum

    @property
    def same(self) -> bool:
        """Whether the bag and every frame are the same."""
        return self.frames > 0 and not self.differing and self.sound

    def add(self, number: int, difference: DigestDifference | None) -> None:
        """Count one frame."""
        self.frames += 1
        if difference is None:
            self.exact += 1
        elif difference.amount <= ROUNDING:
            self.rounding = max(self.rounding, difference.amount)
        else:
            self.differing += 1
            self.first = self.first or (number, difference)

    def lines(self) -> Iterator[str]:
        """Yield the result as text."""
        if self.first is not None:
            number, difference = self.first
            yield (
                f"{self.differing} of {self.frames} frames differ, first frame {number} "
                f"in '{difference.stage}': {difference.text}"
            )
        elif not self.frames:
            yield "no frame, then or now: there is nothing to compare"
        elif self.exact == self.frames:
            yield f"{self.frames} frames: the same in every bit"
        else:
            yield (
                f"{self.frames} frames: the same; {self.exact} in every bit, the others to "
                f"{self.rounding:.1g} of their numbers (rounding, up to {ROUNDING:g})"
            )
        if self.frames and not self.differing:
            yield (
                "compared: what the stages make of each frame of the bag; not compared: how the recording "
                "and the page show it, their texts, times and tracks"
            )
            yield (
                "the recording is, byte for byte, the file that the page beside it tells of"
                if self.sealed
                else "the recording itself may have been changed: there is no page beside it that tells of it"
            )
        if self.redacted:
            yield "the images are redacted: detections are taken from the report, all else was computed again"
        yield from (f"not as it was: {text}" for text in self.changed)
        if self.differing and not self.changed:
            yield "bag, model, configuration, versions and machine are as they were"


def check(rrd: Path, *, model: Path | None = None, settings: Sequence[str] = ()) -> CheckResult:
    """Run the bag beside a report's recording with the stored configuration, and compare each frame.

    Args:
        rrd: the recording. The bag ``NAME.mcap`` lies beside it.
        model: model file of the detector, if it does not lie beside the recording.
        settings: ``key=value`` settings to change.

    Raises:
        UserError: the report, the bag or the model is missing, or cannot be read.
    """
    if not rrd.is_file():
        raise UserError(f"{rrd}: {'it is no file' if rrd.exists() else 'no such file'}")
    sealed = check_seal(rrd)
    if not sealed:
        check_decodes(rrd, UNREADABLE)
    stored = read(rrd)
    info, bag = stored.info, rrd.with_suffix(".mcap")
    if not bag.is_file():
        raise UserError(f"{bag}: the bag of the report is not there; it has the name of the recording")
    with closing(ScratchFolder()) as scratch:
        stored_config, current_config = _configs(rrd, stored, model, settings, scratch.new())
        result = CheckResult(redacted=info.redacted, sealed=sealed, sound=file_hash(bag) == info.bag_sha256)
        with reader_errors_as_user_errors(rrd, UNREADABLE):
            frames = stored.frames.values()
            detections = {key: value for stages in frames for key, value in detections_of(stages).items()}
        session = Session(current_config, replay(detections) if info.redacted else None)
        network = session.stages.provider
        result.changed = [
            *_changed_input(info, bag, stored_config, current_config),
            *_changed_provenance(info, current_config, network),
        ]
        comparer = _Comparer(stored, result)
        try:
            with session, open_window([bag], current_config, info.low, info.high) as source:
                if run(source, session, [comparer, Progress("check")], stop=comparer.complete).interrupted:
                    raise KeyboardInterrupt
        except UserError as error:
            raise error if result.sound else UserError(f"{error}; {_other(bag)}") from None
    for number in sorted(comparer.remaining):
        result.add(number, DigestDifference("cloud", "this run makes no such frame", inf))
    return result


class _Comparer(Observer[FrameResult]):
    """Observer that compares each frame with the stored one."""

    def __init__(self, stored: StoredReport, result: CheckResult) -> None:
        self.remaining = dict(stored.frames)
        # An interrupted report has no results for the rest of its bag: the run ends early.
        self.complete = Event()
        self._interrupted, self._result = stored.info.interrupted, result

    def observe(self, result: FrameResult) -> None:
        number = result.frame.index
        self._result.add(number, compare(self.remaining.pop(number, ()), digest(result)))
        if self._interrupted and not self.remaining:
            self.complete.set()


def check_seal(rrd: Path) -> bool:
    """Return whether a page beside the recording states its checksum.

    Raises:
        UserError: the checksum differs. A damaged file could be misread, or crash its reader.
    """
    page = rrd.with_suffix(".html")
    try:
        checksums = _SEAL.findall(page.read_bytes()) if page.is_file() else []
    except OSError:
        checksums = []
    if checksums and checksums[-1].decode() != file_hash(rrd):
        raise UserError(
            f"{rrd}: changed or damaged: it is not the file that {page.name}, its page, tells of "
            "(SHA-256); without that page beside it, it is compared even so"
        )
    return bool(checksums)


def read(rrd: Path) -> StoredReport:
    """Read the report in a recording.

    Raises:
        UserError: it is no recording, or not that of a report.
    """
    info = config = None
    frames: dict[int, tuple[StageDigest, ...]] = {}
    with reader_errors_as_user_errors(rrd, UNREADABLE):
        for chunk in RrdReader(rrd).stream():
            if chunk.entity_path == "/__properties/report":
                info = _column(chunk, "about")[-1][0]
            elif chunk.entity_path == f"/__properties/{entities.PROPERTY}":
                config = _column(chunk, "config")[-1][0]
            elif chunk.entity_path == entities.DIGEST:
                numbers = _column(chunk, entities.FRAME)
                rows = zip(numbers, _column(chunk, "stages"), _column(chunk, "arrays"), strict=True)
                frames |= {n: unpack(lines, np.array(block, np.uint8)) for n, lines, block in rows}
    if info is None or config is None:
        raise UserError(f"{rrd}: a recording, but not one of 'bevviz report' (or one that was not finished)")
    try:
        return StoredReport(ReportInfo.load(info), config, frames)
    except ValueError:
        raise UserError(
            f"{rrd}: a report of another version of bevviz: check it with that version; /config names it"
        ) from None


def _column(chunk: Any, name: str) -> list[Any]:
    """Return a column of a chunk as a list."""
    values: list[Any] = chunk.to_record_batch().column(name).to_pylist()
    return values


def _configs(
    rrd: Path, stored: StoredReport, model: Path | None, settings: Sequence[str], folder: Path
) -> tuple[Config, Config]:
    """Return the configuration as it is stored, and with the paths of this machine."""
    info, names = stored.info, folder / "names.txt"
    names.write_bytes(info.names.encode())
    recorded = Layer(str(rrd), flat_yaml(stored.config, str(rrd)))
    # The user's own functions run only if the user names them again.
    repeated_settings = [text for text in settings if _is_in(recorded, text)]
    stored_config = load(settings=repeated_settings, layers=[recorded])
    model_file = model_path(stored_config)
    local_settings = [f"detector.names={names}"] if info.names else []
    if model is not None:
        local_settings.append(f"detector.model={model}")
    elif model_file is not None and model_file != DEMO_MODEL and not info.redacted:
        path = rrd.with_name(model_file.name)
        if not path.exists():
            used = info.provenance.dependencies.get("detector.model", stored_config.detector.model)
            raise UserError(f"{rrd}: it was made with {used}, which is not beside it: give --model FILE")
        local_settings.append(f"detector.model={path}")
    for key, name in stage_files(stored_config).items():
        if any(text.partition("=")[0] in (key, key.replace(".params", "")) for text in settings):
            continue
        path = rrd.with_name(name)
        if not path.exists():
            raise UserError(f"{rrd}: it was made with {name}, which is not beside it: add --set {key}=FILE")
        local_settings.append(f"{key}={path}")
    return stored_config, load(settings=[*local_settings, *settings], layers=[recorded])


def _is_in(layer: Layer, setting: str) -> bool:
    """Return whether a layer already contains this ``key=value``."""
    key, _, value = setting.partition("=")
    return str(layer.values.get(key)) == value


def _other(bag: Path) -> str:
    """Return the sentence for a bag whose checksum differs."""
    return f"{bag.name} is not the file that the report was made with (SHA-256)"


def _changed_input(
    info: ReportInfo, bag: Path, stored_config: Config, current_config: Config
) -> Iterator[str]:
    """Yield the changes of the bag and of the configuration. Files that it names count as dependencies."""
    if file_hash(bag) != info.bag_sha256:
        yield _other(bag)
    for key, change in changes(stored_config, current_config).items():
        if key not in ("detector.model", "detector.names", *stage_files(stored_config)):
            yield f"{key} was {change.before}, is {change.after}"


def _changed_provenance(info: ReportInfo, current_config: Config, network: str) -> Iterator[str]:
    """Yield the changes of versions, machine and dependencies."""
    stored = info.provenance
    if info.redacted:  # The network is not run. The report holds its detections.
        dependencies = {
            name: dependency
            for name, dependency in stored.dependencies.items()
            if not name.startswith("detector.")
        }
        stored = replace(stored, dependencies=dependencies)
        current_config = current_config.model_copy(
            update={"detector": current_config.detector.model_copy(update={"model": ""})}
        )
    return differences(stored, provenance(current_config, network))
