"""What a network runs on: the best of what is installed and works, and a word where that is not the best."""

from __future__ import annotations

import contextlib
import ctypes
import io
from functools import lru_cache
from pathlib import Path

import onnxruntime as ort

from bevviz.errors import UserError
from bevviz.stages.detector.session import SUFFIX, NetworkSession
from bevviz.support import progress

# TensorRT compiles each network for minutes before its first frame: where it is asked for by name alone.
PREFERRED = ("CUDA", "MIGraphX", "ROCM", "OpenVINO", "CoreML", "CPU")
# Of onnxruntime-gpu; where what one of these needs is missing, onnxruntime says so in many lines.
SHARED = "libonnxruntime_providers_shared.so"
LIBRARIES = {"CUDA": "libonnxruntime_providers_cuda.so", "Tensorrt": "libonnxruntime_providers_tensorrt.so"}
HELP = {
    "CUDA": "pip install 'onnxruntime-gpu[cuda,cudnn]', and NVIDIA's driver",
    "Tensorrt": "TensorRT's libraries",
}


def open_session(path: Path, asked: str, options: ort.SessionOptions, where: str = "") -> NetworkSession:
    """Open the network of an ONNX file.

    Args:
        path: of the network.
        asked: execution provider, by its short or whole name; auto: the best that works. Where that is not
            the best that is installed, it is said why.
        options: of the session.
        where: the file is stated; empty: as the detector's.

    Raises:
        UserError: that provider is not installed or does not work; no network.
    """
    session, failed = _opened(path, asked, options, where or f"detector.model {path}")
    for name, reason in failed.items():
        tell(f"the network runs on {session.provider}: {name} is installed, but {reason}")
    return session


def network(path: Path, asked: str) -> str:
    """What the network of an ONNX file runs on here, in words; where it cannot be run, why."""
    try:
        session, failed = _opened(path, asked, ort.SessionOptions(), f"detector.model {path}")
    except UserError as error:
        return str(error)
    return "; ".join(
        [session.provider, *(f"{name} is installed, but {reason}" for name, reason in failed.items())]
    )


def _opened(
    path: Path, asked: str, options: ort.SessionOptions, where: str
) -> tuple[NetworkSession, dict[str, str]]:
    """Open the session, and say why each provider that would be better does not work."""
    if path.exists() and not path.is_file():  # onnxruntime would wait for a pipe
        raise UserError(f"{where}: it is no file")
    available = [name.removesuffix(SUFFIX) for name in ort.get_available_providers()]
    if asked.lower() != "auto":
        wanted = asked.lower().removesuffix(SUFFIX.lower())
        chosen = [name for name in available if name.lower() == wanted]
        if not chosen:
            raise UserError(f"detector.provider {asked}: not here; available: {', '.join(available)}")
        if reason := obstacle(chosen[0]):
            raise UserError(f"detector.provider {asked}: {reason}")
        session = NetworkSession(path, chosen, options, where, f"{where} on detector.provider {asked}")
        if session.provider != chosen[0]:
            raise UserError(
                f"detector.provider {asked}: could not be started, "
                f"onnxruntime fell back to {session.provider}"
            )
        return session, {}
    failed: dict[str, str] = {}
    for name in [name for name in PREFERRED if name in available]:
        if name == "CPU":
            session = NetworkSession(path, [name], options, where)
        elif reason := obstacle(name):
            failed[name] = reason
            continue
        else:
            try:
                session = NetworkSession(path, [name, "CPU"], options, where, name)
            except UserError as error:
                failed[name] = str(error).removeprefix(f"{name}: ")
                continue
        if session.provider != name:
            failed[name] = "onnxruntime does not start it"
        return session, failed
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
    progress.say(line)
