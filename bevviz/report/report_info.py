"""Description of a report within its recording. It holds no personal data."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter

from bevviz.config import Config, with_object_files
from bevviz.recording.provenance import Provenance, model_path


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportInfo:
    """Description of a report: bag, window, provenance and options. Times are log times in nanoseconds."""

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
    name = detector.model if model is None or detector.model == "demo" else model.name
    return with_object_files(config, lambda file: Path(file).name).model_copy(
        update={
            "detector": detector.model_copy(update={"model": name, "names": Path(detector.names).name}),
            "source": config.source.model_copy(update={"lidar_calibration": calibrations}),
            "live": live.model_copy(update={"flight_folder": ""}),
        }
    )
