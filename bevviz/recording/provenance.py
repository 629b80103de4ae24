"""Dependencies of results besides data and configuration: versions, file contents, the machine.

A recording stores the versions. A report stores everything, so that its check can name differences. A batch
runs a bag again if a dependency other than the machine has changed.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from bevviz.config import METHOD_KEYS, Config, plugin_of, stage_files, with_stage_files
from bevviz.config.methods import CLASS_LISTS
from bevviz.config.plugins import TOPIC
from bevviz.support.files import absolute, file_hash
from bevviz.support.onnx_files import DEMO_MODEL, network_hash
from bevviz.support.version import __version__

PACKAGES = (  # packages that are not installed are skipped: some libraries have several packages
    *("rerun-sdk", "rosbags", "numpy"),
    "protobuf",  # decodes Foxglove messages
    *("velodyne-decoder", "dracopy", "pypcd4"),  # decode packets, compressed clouds and PCD files
    *("numba", "llvmlite"),  # compile every LiDAR stage
    "kiss-icp",  # estimates the motion
    *(
        "opencv-python-headless",
        "opencv-python",
        "pillow",
        "av",
    ),  # decode images and prepare them for the network
    *("onnxruntime", "onnxruntime-gpu"),
)


@dataclass(frozen=True, slots=True)
class Dependency:
    """A package or a file that results depend on. A file is identified by its content, under any name."""

    version: str = ""
    sha256: str = ""  # of the content, in hexadecimal
    file: str = field(default="", compare=False)  # name without the folder; of a function, module:name

    def __str__(self) -> str:
        content = f"SHA-256 {self.sha256}" if self.sha256 else ""
        file = f"{self.file} ({content})" if self.file and content else self.file or content
        return ", ".join(filter(None, (self.version, file)))


@dataclass(frozen=True, slots=True)
class Provenance:
    """Dependencies of a run, and the machine it ran on.

    ``dependencies`` decide the results: packages by name, files by the key that names them in the
    configuration (``detector.model``). The ``machine`` may round differently.
    """

    dependencies: Mapping[str, Dependency]
    machine: Mapping[str, str] = field(default_factory=dict)


def provenance(config: Config, network: str = "") -> Provenance:
    """Return the provenance of a run on this machine with the installed packages.

    Args:
        config: configuration of the run. The files that it names are read.
        network: device of the detector's network; empty: there is no network.
    """
    return Provenance(dependencies_of(config), machine(network))


def dependencies_of(config: Config) -> dict[str, Dependency]:
    """Return every package, and every file in the configuration whose content decides results.

    A user-defined stage contributes the file of its module and the version of its package.
    """
    dependencies = {name: Dependency(version=number) for name, number in versions().items()}
    for key, path in (("detector.model", model_path(config)), ("detector.names", names_path(config))):
        if path is not None:
            content = network_hash(path) if key == "detector.model" else file_hash(path)
            dependencies[key] = Dependency(sha256=content, file=path.name)
    for key, file in stage_files(config).items():
        dependencies[key] = Dependency(sha256=file_hash(Path(file)), file=Path(file).name)
    for section, key in METHOD_KEYS.items():
        plugin = plugin_of(config, section)
        if plugin is not None:
            content = file_hash(plugin.file) if plugin.file else ""
            name = f"{section}.{key}"
            name = plugin.name if name in dependencies else name  # The key stands for the stage's file.
            dependencies[name] = Dependency(plugin.version, content, plugin.name)
    return dependencies


def differences(then: Provenance, now: Provenance) -> Iterator[str]:
    """Yield one sentence for each difference."""
    for old, new in ((then.dependencies, now.dependencies), (then.machine, now.machine)):
        for name in dict.fromkeys([*old, *new]):
            if old.get(name) != new.get(name):
                yield f"{name} was {old.get(name, 'absent')}, is {new.get(name, 'absent')}"


@lru_cache(maxsize=1)
def versions() -> Mapping[str, str]:
    """Return the version of each package that results depend on, by name."""
    numbers = {"bevviz": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            numbers[name] = version(name)
    return numbers


# --- files -------------------------------------------------------------------------------------


def model_path(config: Config) -> Path | None:
    """Return the file of the detector; None: there is no detector, or it is a topic or a user's function."""
    name = config.detector.model
    if not name or name.startswith(TOPIC) or plugin_of(config, "detector") is not None:
        return None
    return DEMO_MODEL if name == "demo" else Path(name)


def with_absolute_files(config: Config) -> Config:
    """Return a configuration that names its files by absolute paths."""
    detector, model = config.detector, model_path(config)
    files = {"names": absolute(detector.names)}
    if model is not None and detector.model != "demo":
        files["model"] = str(model.resolve())
    return with_stage_files(config, absolute).model_copy(
        update={"detector": detector.model_copy(update=files)}
    )


def names_path(config: Config) -> Path | None:
    """Return the file with the detector's class names; None: there is no such file."""
    name = config.detector.names
    return Path(name) if name and name not in CLASS_LISTS and config.detector.model else None


# --- the machine -------------------------------------------------------------------------------


def machine(network: str = "") -> dict[str, str]:
    """Return the properties of the machine that results and times may depend on. No host or user names.

    Args:
        network: device of the detector's network; empty: there is no network.
    """
    fields = {
        "processor": _processor(),
        "cores": f"{os.cpu_count() or 0}",
        "memory": _memory(),
        "system": _system(),
        "network": network,
    }
    return {name: value for name, value in fields.items() if value}


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
