"""Where a report comes from: the machine, the model and the configuration. Nothing personal."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path

from bevviz.config import Config, load
from bevviz.stages.detector import DEMO_MODEL


@dataclass(frozen=True, slots=True)
class Model:
    name: str  # of the file, without its folder
    sha256: str


@dataclass(frozen=True, slots=True)
class Hardware:
    """What results and times may depend on. No name of a host or a user."""

    processor: str
    cores: int
    memory: str
    system: str
    network: str = ""  # what the detector's network runs on, "": there is none

    def lines(self) -> list[str]:
        return [f"{name}: {value}" for name, value in asdict(self).items() if value]


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """What a recording keeps of the report that it belongs to. Times are log times in nanoseconds."""

    low: int
    high: int
    at: int
    bag_sha256: str
    model: Model | None
    classes: Sequence[str]  # class names that were given in a file
    hardware: Sequence[str]
    redacted: bool
    interrupted: bool
    note: str
    warnings: Sequence[str]

    def dump(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def load(text: str) -> About:
        """Raises ValueError, TypeError or KeyError where ``text`` is not what ``dump`` makes."""
        values = json.loads(text)
        model = values.pop("model")
        return About(model=None if model is None else Model(**model), **values)


def hardware(network: str) -> Hardware:
    """This machine, and what the network runs on."""
    return Hardware(_processor(), os.cpu_count() or 0, _memory(), _system(), network)


def file_hash(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    content = sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            content.update(block)
    return content.hexdigest()


def model_path(config: Config) -> Path | None:
    """The detector's file; None: there is no detector."""
    name = config.detector.model
    return None if not name else DEMO_MODEL if name == "demo" else Path(name)


def model_of(config: Config) -> Model | None:
    path = model_path(config)
    return None if path is None else Model(path.name, file_hash(path))


def shareable(config: Config) -> Config:
    """The configuration without the folders of this machine."""
    detector, live = config.detector, config.live
    return config.model_copy(
        update={
            "detector": detector.model_copy(
                update={"model": Path(detector.model).name, "names": Path(detector.names).name}
            ),
            "live": live.model_copy(update={"flight_folder": ""}),
        }
    )


def changes(config: Config, base: Config | None = None) -> Mapping[str, tuple[object, object]]:
    """Dotted key -> value in ``base`` (None: in the preset) and value here, where they differ."""
    there = (base or load(preset=config.preset)).model_dump(mode="json")
    found = {}
    for section, values in config.model_dump(mode="json").items():
        for name, value in values.items() if isinstance(values, dict) else ():
            if value != there[section][name]:
                found[f"{section}.{name}"] = there[section][name], value
    return found


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return f"{line.partition(':')[2].strip()}, {platform.machine()}"
    return platform.processor() or platform.machine()


def _memory() -> str:
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return "unknown"
    return f"{size / 2**30:.0f} GiB"


def _system() -> str:
    with suppress(OSError):
        name = platform.freedesktop_os_release().get("PRETTY_NAME", "")
        return f"{name}, {platform.system()} {platform.release()}"
    return f"{platform.system()} {platform.release()}"
