"""Jobs of a batch: their bags and names, their folder, and whether a result is complete and intact."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

from bevviz.bags.bag import METADATA
from bevviz.bags.remote import address_of, name_of
from bevviz.bags.source import FrameSelection
from bevviz.config import Config
from bevviz.datasets import find_loader
from bevviz.errors import UserError
from bevviz.extras.batch.table import RESERVED, RunInfo, find_damage, read_info
from bevviz.recording.provenance import dependencies_of, with_absolute_files
from bevviz.support import cleanup, progress
from bevviz.support.files import absolute, bag_files, file_hash, is_path, sampled_files
from bevviz.support.text import path_text

T = TypeVar("T")

PARTIAL = ".bevviz-partial"  # folder of unfinished results


@dataclass(frozen=True)
class Job:
    """One bag, with everything a worker needs, also on another machine that shares the file system."""

    name: str
    bag: Path  # absolute path
    folder: Path  # absolute path of the folder for results
    config: Config
    selection: FrameSelection
    blueprint: str
    truth: str | None = None  # topic of the ground truth; "": the bag's own; None: the bag's own, if any

    @property
    def recording(self) -> Path:
        """Path of the complete recording."""
        return self.folder / f"{self.name}.rrd"

    @property
    def table(self) -> Path:
        """Path of the table of frames. It is written last: if it exists, the recording is complete."""
        return self.folder / f"{self.name}.parquet"

    @property
    def size(self) -> int:
        """Size of the bag in bytes."""
        return sum(file.stat().st_size for file in _files(self.bag))

    @cached_property
    def key(self) -> str:
        """Hash of bag, selection, configuration, model, layout and versions."""
        files = {"detector": {"model", "names"}}  # Their content counts, see below.
        content: dict[str, Any] = {
            "bag": [
                [path_text(file.name), file.stat().st_size, file.stat().st_mtime_ns]
                for file in _files(self.bag)
            ],
            "selection": asdict(self.selection),
            "config": self.config.model_dump(mode="json", exclude={"live": True, "store": True, **files}),
            "blueprint": file_hash(Path(self.blueprint)) if is_path(self.blueprint) else self.blueprint,
            "dependencies": {name: [d.version, d.sha256] for name, d in dependencies_of(self.config).items()},
        }
        if self.truth is not None:
            content["truth"] = self.truth
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @property
    def identity(self) -> str:
        """Name that is unique everywhere. Two jobs share it only if they make the same result."""
        return f"{self.folder}-{self.name}-{self.key}"

    @property
    def recording_id(self) -> str:
        """Recording ID with the job's name and key. A viewer merges recordings with the same ID."""
        return f"{self.name}-{self.key[:8]}"

    def complete(self) -> RunInfo | None:
        """Return the description of the result. None: it is missing or out of date."""
        info = read_info(self.table)
        if info is None or info.key != self.key or not self.recording.is_file():
            return None
        return info


@dataclass(frozen=True, slots=True)
class JobResult:
    """Outcome of a job. ``error`` is empty if its results are complete."""

    name: str
    frames: int = 0
    seconds: float = 0.0
    error: str = ""


JobResults: TypeAlias = Generator[JobResult, None, None]


def make_jobs(
    paths: Sequence[Path],
    folder: Path,
    config: Config,
    selection: FrameSelection,
    blueprint: str,
    truth: str | None = None,
) -> list[Job]:
    """Return a job for each bag that the paths name. The arguments are those of ``Job``.

    Raises:
        UserError: a path does not exist, or there is no bag.
    """
    bags = find_bags(paths)
    config = with_absolute_files(config)
    folder = folder.resolve()
    blueprint = absolute(blueprint)
    owners = {info.bag: table.stem for table, info in tables(folder)}
    names = name_bags(bags, owners)
    return [Job(names[bag], bag, folder, config, selection, blueprint, truth) for bag in bags]


def tables(folder: Path) -> Iterator[tuple[Path, RunInfo]]:
    """Yield table and description of every result in a folder, sorted by name."""
    for path in sorted(folder.glob("*.parquet")):
        if (info := read_info(path)) is not None:
            yield path, info


# --- bags --------------------------------------------------------------------------------------


def find_bags(paths: Sequence[Path]) -> list[Path]:
    """Find bag files and folders: the paths themselves, matches of patterns, and bags in folders.

    A folder with a metadata.yaml is one bag. In any other folder each bag file is a bag of its own.

    Raises:
        UserError: a path does not exist, or a folder has no bags.
    """
    unique_bags: dict[Path, None] = {}
    for path in paths:
        if address_of(path):
            raise UserError(f"{name_of(path)}: a batch reads no bags at addresses: download it")
        matches = (
            [path] if path.exists() else sorted(Path(path.anchor).glob(str(path.relative_to(path.anchor))))
        )
        if not matches:
            raise UserError(f"{path}: no such file or folder")
        for match in matches:
            bags = [bag.resolve() for bag in _bags(match)]
            if not bags and match == path:
                raise UserError(f"{path}: no bag in this folder (no .mcap, .db3 or .bag file)")
            unique_bags.update(dict.fromkeys(bags))
    if not unique_bags:
        raise UserError("no bag among " + ", ".join(map(str, paths)))
    return list(unique_bags)


def _bags(path: Path) -> Iterator[Path]:
    if path.name == METADATA:
        path = path.parent
    if not path.is_dir() or (path / METADATA).is_file():
        yield path
        return
    bags, loader = bag_files(path), find_loader(path)
    if not bags and loader is not None and not (loader.any_folder and _has_bags_inside(path)):
        yield from loader.drives(path)
        return
    yield from bags
    for inner in sorted(path.iterdir()):
        if inner.is_dir() and not inner.name.startswith("."):
            yield from _bags(inner)


def _has_bags_inside(path: Path) -> bool:
    """Return whether a subfolder is a bag or has bags, so that clouds beside it are no drive."""
    inner = [folder for folder in path.iterdir() if folder.is_dir()]
    return any((folder / METADATA).is_file() or bag_files(folder) for folder in inner)


def name_bags(bags: Sequence[Path], owners: Mapping[str, str]) -> dict[Path, str]:
    """Return a name for each bag that stays the same from run to run.

    A bag that already has a result keeps its name. For equally named bags, the names also contain as many
    folders as are needed to tell them apart.

    Args:
        bags: absolute paths without duplicates.
        owners: bag -> name of its existing results.
    """
    names = {bag: owners[path_text(bag)] for bag in bags if path_text(bag) in owners}
    taken = {*RESERVED, *owners.values()}
    unnamed = [bag for bag in bags if bag not in names]
    deepest = max((len(bag.parts) for bag in unnamed), default=0)
    for depth in range(1, deepest + 1):
        candidates = {bag: _name(bag, depth) for bag in unnamed}
        counts = Counter(candidates.values())
        names |= {bag: n for bag, n in candidates.items() if counts[n] == 1 and n not in taken}
        unnamed = [bag for bag in unnamed if bag not in names]
        taken |= set(names.values())
    for bag in unnamed:  # They differ only in characters that a file name should not have.
        names[bag] = f"{_name(bag, 1)}-{hashlib.sha256(os.fsencode(bag)).hexdigest()[:8]}"
    return names


def _name(bag: Path, depth: int) -> str:
    stem = bag.name if bag.is_dir() else re.sub(r"(\.(mcap|db3|bag|active|zstd|zst))+$", "", bag.name)
    parts = [*bag.parts[-depth:-1], stem]
    return re.sub(r"[^\w.-]+", "_", "-".join(parts), flags=re.ASCII).strip("._") or "bag"


# --- results ----------------------------------------------------------------------------------


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock the folder for one batch. Delete the unfinished files of an interrupted batch before and after.

    Raises:
        UserError: the folder cannot be made, or another batch works in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise UserError(f"-o {folder}: {error.strerror}") from None
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(f"-o {folder}: another batch is running in it") from None
        except OSError:
            pass  # Some network file systems cannot lock folders.
        remove = partial(shutil.rmtree, folder / PARTIAL, ignore_errors=True)
        remove()
        cleanup.register(folder, remove)
        try:
            yield
        finally:
            remove()
            cleanup.unregister(folder)
    finally:
        os.close(handle)


def unfinished_jobs(
    jobs: Sequence[Job], force: bool, warn: Callable[[str], None] = lambda _: None
) -> list[Job]:
    """Return the jobs without a complete, up-to-date result. The largest bags come first.

    The order keeps a worker from running a large bag alone at the end. The table of a damaged result is
    deleted, so that the result counts as missing.

    Args:
        jobs: all jobs of the batch.
        force: return all jobs.
        warn: gets one line for each damaged result.
    """
    for job in jobs:
        if force:
            job.table.unlink(missing_ok=True)
    _delete_damaged([job for job in jobs if job.table.exists()], warn)
    return sorted((job for job in jobs if not job.complete()), key=lambda job: -job.size)


def intact_results(folder: Path, warn: Callable[[str], None]) -> list[tuple[Path, RunInfo]]:
    """Return table and description of each result in a folder. Leave out damaged ones and warn of them."""
    results: list[tuple[Path, RunInfo]] = []
    for table in _with_bar([path for path in sorted(folder.glob("*.parquet")) if path.stem not in RESERVED]):
        info = read_info(table)
        if damage := find_damage(table, table.with_suffix(".rrd")):
            warn(f"{table.stem}: {damage}; it is left out until its bag is run again")
        elif info is not None:
            results.append((table, info))
    return results


def _delete_damaged(jobs: Sequence[Job], warn: Callable[[str], None]) -> None:
    """Delete the tables of damaged results.

    Args:
        jobs: that have a table.
        warn: gets a line for each damaged result.
    """
    for job in _with_bar(jobs):
        info = read_info(job.table)
        if info is not None and info.key != job.key:
            continue  # It is out of date anyway.
        if damage := find_damage(job.table, job.recording):
            warn(f"{job.name}: {damage}; its bag is run again")
            job.table.unlink()


def _with_bar(results: Iterable[T]) -> Iterable[T]:
    """Show a bar, as recordings are read from end to end."""
    return cast(Iterable[T], progress.bar(results, desc="check", unit="bag", delay=1, leave=False))


# --- content -----------------------------------------------------------------------------------


def _files(bag: Path) -> list[Path]:
    if not bag.is_dir():
        return [bag]
    metadata = bag / METADATA
    if not bag_files(bag):
        return sampled_files(bag)[1]
    return [*bag_files(bag), *([metadata] if metadata.is_file() else [])]
