"""Debugger for LiDAR-camera perception: shows frame by frame, in Rerun, what each stage computed and decided.

>>> import bevviz
>>> drive = bevviz.open("drive.mcap", model="yolo11n.onnx")
>>> drive.at(12.5).objects.to_pandas()
"""

import os

# Do not import ``typing`` or ``__future__`` here: Python prints a traceback for an interrupt during them.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from bevviz.config import Config
    from bevviz.drive import Drive, simulate
    from bevviz.drive import open_drive as open  # bevviz.open
    from bevviz.errors import UserError
    from bevviz.model.frame import Frame
    from bevviz.model.results import FrameResult
    from bevviz.support.version import __version__

__all__ = ["Config", "Drive", "Frame", "FrameResult", "UserError", "__version__", "open", "simulate"]

# onnxruntime stores an ID of this machine at its import, unless telemetry is disabled before.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

_HOMES = {
    "Config": ("bevviz.config", "Config"),
    "Drive": ("bevviz.drive", "Drive"),
    "Frame": ("bevviz.model.frame", "Frame"),
    "FrameResult": ("bevviz.model.results", "FrameResult"),
    "UserError": ("bevviz.errors", "UserError"),
    "__version__": ("bevviz.support.version", "__version__"),
    "open": ("bevviz.drive", "open_drive"),
    "simulate": ("bevviz.drive", "simulate"),
}


def __getattr__(name: str) -> "Any":
    """Import a public name when it is used, so that ``bevviz --help`` is instant."""
    if name not in _HOMES:
        raise AttributeError(f"module 'bevviz' has no attribute '{name}'")
    from importlib import import_module

    module, attribute = _HOMES[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    """Return the public names, also those that are not imported yet."""
    return [*__all__, "__doc__", "__file__", "__path__"]
