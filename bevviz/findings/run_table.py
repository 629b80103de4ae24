"""Findings of whole runs in the store of results: a drive that was run before shows its list at once."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from bevviz.bags.remote import address_of
from bevviz.bags.source import BagSource
from bevviz.config import Config, values
from bevviz.findings.finding_list import FindingList, StoredGroup
from bevviz.findings.frame_findings import Finding, find_findings
from bevviz.model.frame import Frame
from bevviz.model.protocols import Observer
from bevviz.model.results import FrameResult
from bevviz.pipeline.result_store import ResultStore, code_hash, open_store, store_key
from bevviz.pipeline.session import Session
from bevviz.recording.provenance import model_path, versions
from bevviz.support.files import file_hash
from bevviz.support.onnx_files import with_weights
from bevviz.why import RunExplainer


@dataclass(frozen=True, slots=True)
class StoredRun:
    """List of a complete run.

    Attributes:
        groups: the findings.
        frames: stamp and number of each frame.
    """

    groups: list[StoredGroup]
    frames: list[tuple[int, int]]

    @property
    def explained(self) -> bool:
        """Whether missed objects have a reason."""
        return all(frame.text for group in self.groups if group.what == "missed" for frame in group.frames)


UNRELATED = {"live", "logging", "store"}  # sections that change no finding

_RUN = TypeAdapter(StoredRun)


class RunTable:
    """Place of the list of one drive with one configuration in the store.

    Args:
        store: the store of results.
        key: key of the drive, the configuration and the code.
    """

    def __init__(self, store: ResultStore, key: bytes) -> None:
        self._store, self._key = store, key

    def load(self) -> StoredRun | None:
        """Return the list of an earlier run. None: there is none, or it is damaged."""
        content = self._store.get(self._key)
        if content is None:
            return None
        try:
            return _RUN.validate_json(zlib.decompress(content))
        except (zlib.error, ValidationError):
            return None

    def save(self, run: StoredRun) -> None:
        """Keep the list of a complete run."""
        self._store.put(self._key, zlib.compress(json.dumps(asdict(run)).encode(), 1))


class ListKeeper(Observer[FrameResult]):
    """Observer that keeps the list of a run over a whole drive for the workbench.

    The reasons of missed objects would take most of the time of a run. The workbench finds them.

    Args:
        table: place of the list.
        explainer: explainer of the run.
        scans: number of scans of the drive. The list of a run over fewer is not kept.
    """

    def __init__(self, table: RunTable, explainer: RunExplainer, scans: int) -> None:
        self._table, self._explainer, self._scans = table, explainer, scans
        self._list = FindingList()
        self._frames: list[tuple[int, int]] = []

    def observe(self, result: FrameResult) -> None:
        """List the findings of a frame."""
        self.add(result.frame, find_findings(self._explainer.of(result), restore=False))

    def add(self, frame: Frame, findings: Iterable[Finding]) -> None:
        """List the findings of a frame."""
        self._list.add(findings)
        self._frames.append((frame.stamp, frame.index))

    def end(self) -> None:
        """Keep the list."""
        if len(self._frames) == self._scans:
            self._table.save(StoredRun(self._list.content(), sorted(self._frames)))


def list_keeper(
    source: BagSource, session: Session, explainer: RunExplainer, config: Config | None = None
) -> ListKeeper | None:
    """Return an observer that keeps the list of a run. None: the run leaves scans out, or no list is kept.

    Args:
        source: frames of the run.
        session: session of the run.
        explainer: explainer of the run.
        config: configuration as the user gave it. None: that of the session.
    """
    if len(source.numbers) != len(source.scans):
        return None
    files = [file.path for file in source.recording.files]
    config = config or session.config
    table = run_table(files, config, session.stages.provider, (None, None)) if files else None
    return None if table is None else ListKeeper(table, explainer, len(source.scans))


def run_table(
    paths: Iterable[Path], config: Config, provider: str, labels: Iterable[str | Path | None]
) -> RunTable | None:
    """Return the place of the list of a drive.

    None: there is no store, the drive is not on this machine and may have changed, or functions of the user
    run, whose results may depend on anything.

    Args:
        paths: files and folders that the drive is read from.
        config: configuration of the run.
        provider: provider of the networks.
        labels: topic, and file or folder, of the ground truth that the user states.
    """
    store = open_store(config.store.size)
    paths = list(paths)
    if store is None or config.functions or any(map(address_of, paths)):
        return None
    model = model_path(config)
    files = [Path(text) for text in _strings(list(values(config).values()))]
    files = [path for path in files if path.is_file()]
    for path in [path for path in (model, *files) if path is not None and path.suffix == ".onnx"]:
        files += with_weights(path)
    facts = [
        config.model_dump_json(exclude=UNRELATED),
        provider,
        str(sorted(versions().items())),
        code_hash(""),
    ]
    facts += [file_hash(path) for path in files]
    for stated in [*paths, *labels]:
        facts.append(str(stated))
        if isinstance(stated, Path):
            facts += map(_state_of, _files(stated.resolve()))
    return RunTable(store, store_key("run", *facts))


def _strings(value: object) -> Iterator[str]:
    """Yield the texts in the values of parameters, which may be names of files."""
    if isinstance(value, str) and value:
        yield value
    elif isinstance(value, Mapping):
        yield from _strings(list(value.values()))
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for inner in value:
            yield from _strings(inner)


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]


def _state_of(file: Path) -> str:
    """Return path, size and time of a file. A file that changed has another one."""
    state = file.stat()
    return f"{file} {state.st_size} {state.st_mtime_ns}"
