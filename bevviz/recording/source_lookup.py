"""Find the bag that a recording (.rrd) was made from, and the settings of the run."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Self

import rerun as rr

from bevviz.config import (
    METHOD_KEYS,
    Config,
    Layer,
    Preset,
    flat_yaml,
    load,
    same_stage,
    stage_files,
    untrusted_layers,
    values,
)
from bevviz.errors import UserError, first_line
from bevviz.model.frame import Scene
from bevviz.recording import entities
from bevviz.recording.provenance import model_path, names_path
from bevviz.recording.rerun_cli import check_decodes
from bevviz.support.files import bag_files, open_regular, sampled_files
from bevviz.support.text import path_text

FRAME_SECTIONS = ("source.", "sync.")  # sections that decide what a frame is made of
HASHED_BYTES = 1 << 16  # bytes that are hashed at the beginning, the middle and the end of a file
PROPERTY_CHUNKS = 500  # chunks within which one property follows another
MAGIC = b"RRF"  # followed by a digit, the generation of the format
CHECKED_BYTES = 1 << 24  # bytes that are checked before properties are read; they need fewer


class NoBagError(UserError):
    """Error for a recording without a bag: of another program, of the synthetic drive, or of a comparison."""


@dataclass(frozen=True, slots=True)
class FileReference:
    """Reference to a bag or another file: paths where it may be, and a fingerprint of its content.

    Attributes:
        name: file name without the folder.
        size: bytes; of a folder, the sum over the bag's files in it.
        fingerprint: SHA-256 from ``fingerprint``.
        beside: path relative to the recording's folder; empty: the recording was no file.
        path: absolute path; empty: it is private.
    """

    name: str
    size: int
    fingerprint: str
    beside: str = ""
    path: str = ""

    @classmethod
    def of(cls, path: Path, recording: Path | None, *, folders: bool) -> Self:
        """Return the reference to a file or to a bag's folder.

        Args:
            path: file or folder.
            recording: recording that stores the reference; None: it is no file.
            folders: whether the recording may name folders of this machine.
        """
        size, digest = fingerprint(path)
        absolute = Path(os.path.normpath(path.absolute()))  # does not resolve a link
        beside = ""
        if recording is not None:
            beside = os.path.relpath(absolute, recording.absolute().parent) if folders else absolute.name
        return cls(
            path_text(absolute.name), size, digest, path_text(beside), path_text(absolute) if folders else ""
        )

    def candidates(self, recording: Path) -> list[Path]:
        """Return paths where the file may be, the likeliest first."""
        folder = recording.absolute().parent
        paths = [folder / (self.beside or self.name), folder / self.name]
        paths += [Path(self.path)] if self.path else []
        return list(dict.fromkeys(Path(os.path.normpath(path)) for path in paths))

    def is_same(self, path: Path) -> bool:
        """Return whether a file has the size and the fingerprint."""
        try:
            return fingerprint(path) == (self.size, self.fingerprint)
        except OSError:
            return False

    def locate(self, recording: Path) -> tuple[Path | None, str]:
        """Return the file's present path and an empty text, or None and the reason why it is not found."""
        candidates = self.candidates(recording)
        for path in candidates:
            if self.is_same(path):
                return path, ""
        changed = [path for path in candidates if path.exists()]
        absent = [str(path) for path in candidates if path not in changed]
        reasons = [f"what is at {path} is another one (size or content)" for path in changed]
        reasons += [f"there is none at {' or '.join(absent)}"] if absent else []
        return None, "; ".join(reasons)


def fingerprint(path: Path) -> tuple[int, str]:
    """Return the size and a quick SHA-256 (hexadecimal) of a file, or of the bag's files in a folder.

    The hash covers the size, the beginning, the middle and the end of each file. This distinguishes
    recordings, and is fast even for 100 GB. For a data set, it covers the number of files and a few files of
    each folder.

    Raises:
        OSError: the file does not exist or cannot be read.
    """
    total, digest = 0, hashlib.sha256()
    files = bag_files(path) if path.is_dir() else [path]
    if not files:
        count, files = sampled_files(path)
        digest.update(count.to_bytes(8, "little"))
    for file in files:
        with open_regular(file) as content:
            size = os.fstat(content.fileno()).st_size
            digest.update(size.to_bytes(8, "little"))
            for start in sorted({0, max(size // 2 - HASHED_BYTES // 2, 0), max(size - HASHED_BYTES, 0)}):
                content.seek(start)
                digest.update(content.read(HASHED_BYTES) or b"")  # None: a special file that would block
        total += size
    return total, digest.hexdigest()


@dataclass(frozen=True, slots=True)
class Origin:
    """Source of a recording, as the recording stores it.

    Attributes:
        bag: files and folders; several make up one drive.
        files: files in the configuration, by the key that names them.
        topics: ``key=value`` settings that give topics the same roles again.
        redacted: the bag's images are not the images that the network saw.
    """

    bag: Sequence[FileReference]
    files: Mapping[str, FileReference] = field(default_factory=dict)
    topics: Sequence[str] = ()
    redacted: bool = False

    @classmethod
    def of(
        cls,
        scene: Scene,
        config: Config,
        recording: Path | None,
        *,
        folders: bool = True,
        redacted: bool = False,
    ) -> Self | None:
        """Return the source of a new recording. None: it is not made from a bag, or the bag is gone.

        Args:
            scene: scene of the source.
            config: configuration of the run.
            recording: file of the new recording; None: it goes to no file.
            folders: whether the recording may name folders of this machine.
            redacted: see the attribute.
        """
        named_files = {"detector.model": model_path(config), "detector.names": names_path(config)}
        if config.detector.model == "demo":
            named_files = {}
        named_files |= {key: Path(file) for key, file in stage_files(config).items()}
        try:
            bag = [FileReference.of(path, recording, folders=folders) for path in scene.bag]
            files = {
                key: FileReference.of(path, recording, folders=folders)
                for key, path in named_files.items()
                if path is not None
            }
        except OSError:
            return None
        return cls(bag, files, scene.topics, redacted) if bag else None

    def log(self, recording: rr.RecordingStream) -> None:
        """Log the source as a property of the recording."""
        recording.send_property(entities.BAG, rr.AnyValues(about=json.dumps(asdict(self))))

    @classmethod
    def load(cls, text: str) -> Self:
        """Parse the text that ``log`` has written.

        Raises:
            ValueError, TypeError, KeyError: the text has another form.
        """
        tree = json.loads(text)
        return cls(
            [FileReference(**reference) for reference in tree["bag"]],
            {str(key): FileReference(**reference) for key, reference in tree["files"].items()},
            [str(setting) for setting in tree["topics"]],
            bool(tree["redacted"]),
        )


@dataclass(frozen=True, slots=True)
class RecordingSource:
    """Bag and settings that a recording was made from.

    Attributes:
        recording: .rrd file.
        paths: paths of the bag.
        settings: ``key=value`` settings: the topics of the run, and the present paths of its files.
        warnings: one sentence each.
        yaml: configuration of the run, as ``dump`` wrote it.
    """

    recording: Path
    paths: tuple[Path, ...]
    settings: tuple[str, ...]
    warnings: tuple[str, ...]
    yaml: str

    def load(
        self,
        file: Path | Sequence[Path] | None = None,
        settings: Sequence[str] = (),
        preset: Preset | None = None,
    ) -> Config:
        """Load the recording's configuration with changes.

        A file or a preset replaces the recording's configuration. Values that it leaves at the preset's
        default come from the recording if they decide how frames are made, or name the detector. The other
        stages do not, because a method needs its parameters.

        Functions in the recording's configuration run only if ``settings`` or a trusted file names them too.

        Raises:
            UserError: see ``bevviz.config.load``.
        """
        if file or preset is not None:
            stated = load(file, settings, preset)
            return load(file, [self.missing(stated), *settings], preset)
        base = Layer(str(self.recording), flat_yaml(self.yaml, str(self.recording)))
        return load(settings=[*self._received(), *settings], base=base)

    def missing(self, config: Config) -> Layer:
        """Return the recording's frame and detector values that a configuration leaves at their default."""
        stated, defaults = values(config), values(load(preset=config.preset))
        recording_values = flat_yaml(self.yaml, str(self.recording))
        recorded = {key: value for key, value in recording_values.items() if key.startswith(FRAME_SECTIONS)}
        if recording_values.get("detector.model"):
            recorded["detector.model"] = recording_values["detector.model"]
        for layer in self._received():
            recorded |= layer.values
        method_keys = {f"{section}.{key}" for section, key in METHOD_KEYS.items() if section != "detector"}
        open_keys = [
            key
            for key in recorded
            if key in defaults and key not in method_keys and stated[key] == defaults[key]
        ]
        return Layer(str(self.recording), {key: recorded[key] for key in open_keys})

    def _received(self) -> list[Layer]:
        return untrusted_layers(self.settings, str(self.recording))


def find_source(recording: Path, bag: Sequence[Path] = (), settings: Sequence[str] = ()) -> RecordingSource:
    """Find the bag and the settings that a recording was made from.

    Args:
        recording: .rrd file.
        bag: paths of the bag, if it is neither next to the recording nor at its old path.
        settings: settings that the caller will apply. They may name the detector's file.

    Raises:
        NoBagError: the recording has no bag or does not name it.
        UserError: it is no recording, or the bag or the detector's file is not found or has changed.
    """
    yaml, origin = read_origin(recording)
    warnings: list[str] = []
    if origin is None and not bag:
        beside = recording.with_suffix(".mcap")  # 'bevviz live' saves both
        if not beside.is_file():
            raise NoBagError(
                f"{recording}: it does not say which bag it was made from, and {beside.name} is not beside "
                "it: give --bag PATH"
            )
        bag = [beside]
    configuration = flat_yaml(yaml, str(recording))
    if bag:
        paths = list(bag)
        marks = (
            {(reference.size, reference.fingerprint) for reference in origin.bag}
            if origin is not None
            else set()
        )
        if origin is not None and {_fingerprint_of_option(path) for path in bag} != marks:
            names = ", ".join(reference.name for reference in origin.bag)
            warnings.append(f"--bag is not what {recording.name} was made from, {names} (size or content)")
    else:
        assert origin is not None
        paths = [_locate(reference, recording) for reference in origin.bag]
    if origin is not None and origin.redacted:
        warnings.append(
            f"the images in {paths[0].name} are redacted: what the detector finds in them is not what "
            f"{recording.name} holds"
        )
    topics, file_settings = list(origin.topics) if origin is not None else [], list[str]()
    new_settings = {key: value for key, _, value in (setting.partition("=") for setting in settings)}
    replaced = tuple(
        section
        for section, key in METHOD_KEYS.items()
        if (method := new_settings.get(f"{section}.{key}")) is not None
        and not same_stage(section, method, str(configuration.get(f"{section}.{key}")))
    )
    for key, reference in origin.files.items() if origin is not None else ():
        section, _, name = key.partition(".")
        if key in new_settings or (name.startswith("params.") and section in replaced):
            continue
        path, reason = reference.locate(recording)
        if path is None:
            option = "--model FILE" if key == "detector.model" else f"--set {key}=FILE"
            raise UserError(f"{recording}: it was made with {key} {reference.name}; {reason}: give {option}")
        file_settings.append(f"{key}={json.dumps(str(path))}")
    recorded_settings = [
        *(topic for topic in topics if not configuration.get(topic.partition("=")[0])),
        *file_settings,
    ]
    return RecordingSource(recording, tuple(paths), tuple(recorded_settings), tuple(warnings), yaml)


def _locate(reference: FileReference, recording: Path) -> Path:
    path, reason = reference.locate(recording)
    if path is None:
        raise UserError(
            f"{recording}: it was made from the bag {reference.name}; {reason}: move it beside the "
            "recording, or give --bag PATH"
        )
    return path


def _fingerprint_of_option(path: Path) -> tuple[int, str]:
    try:
        return fingerprint(path)
    except OSError as error:
        raise UserError(f"--bag {path}: cannot be read: {error.strerror}") from None


def read_origin(recording: Path) -> tuple[str, Origin | None]:
    """Return the configuration (YAML) in a recording, and its source. None: the recording does not name it.

    Raises:
        UserError: the file is no recording, or not one of bevviz.
    """
    if not recording.is_file():
        raise UserError(f"{recording}: no such file")
    with recording.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise UserError(f"{recording}: no recording: it does not begin as one of Rerun's")
    check_decodes(recording, first=CHECKED_BYTES)
    yaml: str | None = None
    origin: Origin | None = None
    try:
        for path, chunk in _properties(recording):
            # A property may be spread over several chunks.
            if path == entities.PROPERTY and (column := _column(chunk, "config")):
                yaml = str(column[-1][0])
            elif path == entities.BAG and (column := _column(chunk, "about")):
                origin = Origin.load(column[-1][0])
            if yaml is not None and origin is not None:
                break
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise UserError(f"{recording}: cannot be read as a recording: {first_line(error)}") from None
    if yaml is None:
        raise NoBagError(f"{recording}: no recording of bevviz: it does not say how it was made")
    return yaml, origin


def _properties(recording: Path) -> Iterator[tuple[str, Any]]:
    """Yield name and chunk of each property. They are near the beginning, so little of the file is read."""
    from rerun.chunk import RrdReader

    chunks = iter(RrdReader(recording).stream())
    for chunk in chunks:
        head, _, name = chunk.entity_path.rpartition("/")
        if head != "/__properties":
            continue
        yield name, chunk
        if name == entities.PROPERTY:
            break
    for chunk in islice(chunks, PROPERTY_CHUNKS):
        head, _, name = chunk.entity_path.rpartition("/")
        if head == "/__properties":
            yield name, chunk


def _column(chunk: Any, name: str) -> list[Any]:
    """Return the values of a column; empty: the chunk has no such column."""
    batch = chunk.to_record_batch()
    return list(batch.column(name).to_pylist()) if name in batch.schema.names else []
