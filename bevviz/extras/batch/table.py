"""File of the table of a recording's frames, with the description of the run."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import TypeAdapter

from bevviz.extras.batch.findings import FINDING, FINDINGS
from bevviz.findings.frame_row import COUNTS, STAGES
from bevviz.model.frame import Scene
from bevviz.support.files import file_hash

NAME = "summary"  # of the table and the page of all bags
RESERVED = {NAME, FINDINGS}  # names of tables that are of all bags

SCHEMA = pa.schema(
    [
        ("bag", pa.string()),
        ("recording", pa.string()),
        ("frame", pa.int64()),
        ("stamp", pa.timestamp("ns", "UTC")),
        *((name, pa.int32()) for name in COUNTS),
        ("sync_error_ms", pa.float64()),
        ("tf_age_ms", pa.float64()),
        *((f"time_ms_{stage}", pa.float64()) for stage in STAGES),
        ("unmatched", pa.list_(pa.string())),
        ("remarks", pa.list_(pa.string())),
        ("badness", pa.float64()),
        ("missed", pa.int64()),
        ("false", pa.int64()),
        ("false_causes", pa.list_(pa.string())),
        (FINDINGS, pa.list_(FINDING)),
        # JPEGs, only for the worst frames: the first camera with its detections, and the bird's-eye view.
        ("picture", pa.binary()),
        ("above", pa.binary()),
    ]
)


SEVERITIES = {  # of a frame, the gravest first -> description
    "failed": "a stage failed",
    "lacking": "an input is missing",
    "wrong": "an object is missed or false",
    "strange": "an anomaly",
    "unmatched": "a detection has no match",
    "well": "nothing is wrong",
    "unjudged": "not judged: there is no ground truth, and nothing stands out",
}


def severity(row: Mapping[str, Any]) -> str:
    """Return the gravest problem of a frame, or how good it is: a key of ``SEVERITIES``."""
    numbers = {
        "failed": row["failures"],
        "lacking": row["problems"],
        "wrong": (row["missed"] or 0) + (row["false"] or 0),
        "strange": row["anomalies"],
        "unmatched": len(row["unmatched"]),
    }
    good = "unjudged" if row["missed"] is None else "well"
    return next((kind for kind, number in numbers.items() if number), good)


@dataclass(frozen=True, slots=True)
class RunInfo:
    """Description of a run. Its table contains it."""

    key: str
    bag: str
    recording_id: str
    frames: int
    seconds: float  # run time
    scene: Scene
    warnings: tuple[str, ...] = ()
    metrics: dict[str, float | None] | None = None  # None: not evaluated
    recording_size: int = 0  # bytes
    # Hash of every byte: samples would miss damage between them. A core hashes about 1 GB/s, far faster than
    # a recording is made. Rerun writes the file, so it is read once more when it is complete.
    recording_sha256: str = ""


_INFO = TypeAdapter(RunInfo)
_ABOUT, _CHECKSUM = b"bevviz", b"bevviz_sha256"  # metadata of a table: the RunInfo as JSON, and its checksum
# Errors that reading a damaged table raises.
_UNREADABLE = (OSError, LookupError, ValueError, MemoryError, pa.ArrowException)


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], info: RunInfo) -> None:
    """Write a table with checksums of its pages and of ``info``. ``find_damage`` verifies them."""
    table = pa.Table.from_pylist([dict(r) for r in rows], schema=SCHEMA)
    about = _INFO.dump_json(info)
    metadata = {_ABOUT: about, _CHECKSUM: hashlib.sha256(about).hexdigest()}
    # Statistics of a page lie outside its checksum. A table of one bag needs none.
    pq.write_table(
        table.replace_schema_metadata(metadata), path, write_page_checksum=True, write_statistics=False
    )


def read_info(path: Path) -> RunInfo | None:
    """Return the description in a table. None: the table is missing, broken or foreign."""
    try:
        metadata = pq.read_schema(path).metadata or {}
        return _INFO.validate_json(metadata[_ABOUT])
    except _UNREADABLE:
        return None


def find_damage(table: Path, recording: Path) -> str:
    """Return a text about the damage in the result of a bag. Empty: there is none.

    Args:
        table: of the frames; the file exists.
        recording: made by the same run.
    """
    info = read_info(table)
    if info is None or not _is_whole(table):
        return f"{table.name} is damaged"
    try:
        size = recording.stat().st_size
        if size != info.recording_size:
            return f"{recording.name} has {size} bytes instead of {info.recording_size}"
        if file_hash(recording) != info.recording_sha256:
            return f"{recording.name} was changed or damaged (SHA-256)"
    except FileNotFoundError:
        return f"{recording.name} is missing"
    except OSError as error:
        return f"{recording.name} cannot be read ({error.strerror})"
    return ""


def _is_whole(table: Path) -> bool:
    """Return whether a table can be read to its end and matches its checksums."""
    try:
        with pq.ParquetFile(table, page_checksum_verification=True) as file:
            file.read()
            metadata = file.schema_arrow.metadata
            checksum = hashlib.sha256(metadata[_ABOUT]).hexdigest()
            # Column names have no checksum. A damaged name would look like a missing column.
            return bool(file.schema_arrow.equals(SCHEMA)) and metadata[_CHECKSUM] == checksum.encode()
    except _UNREADABLE:
        return False
