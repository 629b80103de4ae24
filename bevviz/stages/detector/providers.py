"""What a network runs on: the best of what is installed and works, and a word where that is not the best."""

from __future__ import annotations

import contextlib
import ctypes
import io
from functools import lru_cache
from pathlib import Path
from typing import Any

import onnxruntime as ort

from bevviz import announce
from bevviz.errors import UserError, first_line

# TensorRT compiles each network for minutes before its first frame: where it is asked for by name alone.
PREFERRED = ("CUDA", "MIGraphX", "ROCM", "OpenVINO", "CoreML", "CPU")
SUFFIX = "ExecutionProvider"
# Of onnxruntime-gpu; where what one of these needs is missing, onnxruntime says so in many lines.
SHARED = "libonnxruntime_providers_shared.so"
LIBRARIES = {"CUDA": "libonnxruntime_providers_cuda.so", "Tensorrt": "libonnxruntime_providers_tensorrt.so"}
HELP = {
    "CUDA": "pip install 'onnxruntime-gpu[cuda,cudnn]', and NVIDIA's driver",
    "Tensorrt": "TensorRT's libraries",
}


def open_session(path: Path, asked: str, options: ort.SessionOptions, where: str = "") -> tuple[Any, str]:
    """The session of an ONNX file, and the short name of the execution provider that it runs on.

    Args:
        path: of the network.
        asked: execution provider, by its short or whole name; auto: the best that works. Where that is not
            the best that is installed, it is said why.
        options: of the session.
        where: the file is stated; empty: as the detector's.

    Raises:
        UserError: that provider is not installed or does not work; no network.
    """
    session, used, failed = _opened(path, asked, options, where or f"detector.model {path}")
    for name, reason in failed.items():
        tell(f"the network runs on {used}: {name} is installed, but {reason}")
    return session, used


def network(path: Path, asked: str) -> str:
    """What the network of an ONNX file runs on here, in words; where it cannot be run, why."""
    try:
        _, used, failed = _opened(path, asked, ort.SessionOptions(), f"detector.model {path}")
    except UserError as error:
        return str(error)
    return "; ".join([used, *(f"{name} is installed, but {reason}" for name, reason in failed.items())])


def _opened(
    path: Path, asked: str, options: ort.SessionOptions, where: str
) -> tuple[Any, str, dict[str, str]]:
    """The session, what it runs on, and why each provider that would be better does not work."""
    available = [name.removesuffix(SUFFIX) for name in ort.get_available_providers()]
    if asked.lower() != "auto":
        wanted = asked.lower().removesuffix(SUFFIX.lower())
        chosen = [name for name in available if name.lower() == wanted]
        if not chosen:
            raise UserError(f"detector.provider {asked}: not here; available: {', '.join(available)}")
        if reason := obstacle(chosen[0]):
            raise UserError(f"detector.provider {asked}: {reason}")
        session = _started(path, chosen, options, f"detector.provider {asked}")
        used = session.get_providers()[0].removesuffix(SUFFIX)
        if used != chosen[0]:
            raise UserError(
                f"detector.provider {asked}: could not be started, onnxruntime fell back to {used}"
            )
        return session, used, {}
    failed: dict[str, str] = {}
    for name in [name for name in PREFERRED if name in available]:
        if name == "CPU":
            session = _started(path, [name], options, where)
        elif reason := obstacle(name):
            failed[name] = reason
            continue
        else:
            try:
                session = _started(path, [name, "CPU"], options, name)
            except UserError as error:
                failed[name] = str(error).removeprefix(f"{name}: ")
                continue
        used = str(session.get_providers()[0]).removesuffix(SUFFIX)
        if used != name:
            failed[name] = "onnxruntime does not start it"
        return session, used, failed
    raise UserError(f"{where}: onnxruntime has none of {', '.join(PREFERRED)}")


@lru_cache
def obstacle(name: str) -> str:
    """Why an execution provider that is installed cannot be loaded; empty: as far as is known, it can."""
    folder = Path(ort.__file__).parent / "capi"
    if not (folder / LIBRARIES.get(name, "")).is_file():
        return ""
    if hasattr(ort, "preload_dlls"):  # those that came as packages; it prints what it does not find
        with contextlib.redirect_stdout(io.StringIO()):
            ort.preload_dlls()
    try:
        ctypes.CDLL(str(folder / SHARED), ctypes.RTLD_GLOBAL)
        ctypes.CDLL(str(folder / LIBRARIES[name]))
    except OSError as error:
        missing, _, rest = str(error).partition(": ")
        if "cannot open shared object" in rest:
            return f"{missing} is missing ({HELP[name]})"
    return ""


@lru_cache
def tell(line: str) -> None:
    """Once."""
    announce.say(line)


def _started(path: Path, names: list[str], options: ort.SessionOptions, what: str) -> Any:
    try:
        # Without onnxruntime's own way to go on, which prints to standard output.
        return ort.InferenceSession(path, options, [f"{name}{SUFFIX}" for name in names], enable_fallback=0)
    except Exception as error:  # onnxruntime's errors have no common base class
        raise UserError(f"{what}: onnxruntime cannot load it: {first_line(error)}") from None
