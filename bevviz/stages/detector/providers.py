"""Choose the execution provider of a network: the best one that is installed and works."""

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

# TensorRT compiles each network for minutes before its first frame. So it is used only on request.
PROVIDERS = ("CUDA", "MIGraphX", "ROCM", "OpenVINO", "CoreML", "CPU")
# Libraries of onnxruntime-gpu. onnxruntime prints many lines if one of their dependencies is missing.
SHARED_LIBRARY = "libonnxruntime_providers_shared.so"
LIBRARIES = {"CUDA": "libonnxruntime_providers_cuda.so", "Tensorrt": "libonnxruntime_providers_tensorrt.so"}
INSTALL_HELP = {
    "CUDA": "pip install 'onnxruntime-gpu[cuda,cudnn]', and NVIDIA's driver",
    "Tensorrt": "TensorRT's libraries",
}


def open_session(path: Path, asked: str, options: ort.SessionOptions, where: str = "") -> NetworkSession:
    """Open the network of an ONNX file.

    With ``auto``, print why better installed providers are not used.

    Args:
        path: file of the network.
        asked: execution provider by its short or whole name, or ``auto`` for the best that works.
        options: of the session.
        where: how errors name the file; empty: as ``detector.model``.

    Raises:
        UserError: the provider is not installed or does not work, or the file is no network.
    """
    session, failed = _open_with_reasons(path, asked, options, where or f"detector.model {path}")
    for name, reason in failed.items():
        say_once(f"the network runs on {session.provider}: {name} is installed, but {reason}")
    return session


def network(path: Path, asked: str) -> str:
    """Describe the provider that would run a network here, or why the network cannot run."""
    try:
        session, failed = _open_with_reasons(path, asked, ort.SessionOptions(), f"detector.model {path}")
    except UserError as error:
        return str(error)
    return "; ".join(
        [session.provider, *(f"{name} is installed, but {reason}" for name, reason in failed.items())]
    )


def _open_with_reasons(
    path: Path, asked: str, options: ort.SessionOptions, where: str
) -> tuple[NetworkSession, dict[str, str]]:
    """Open the session. Also return why each better provider does not work."""
    if path.exists() and not path.is_file():  # onnxruntime would wait for a pipe
        raise UserError(f"{where}: it is no file")
    available = [name.removesuffix(SUFFIX) for name in ort.get_available_providers()]
    if asked.lower() != "auto":
        wanted = asked.lower().removesuffix(SUFFIX.lower())
        chosen = [name for name in available if name.lower() == wanted]
        if not chosen:
            raise UserError(f"detector.provider {asked}: not here; available: {', '.join(available)}")
        if reason := why_unavailable(chosen[0]):
            raise UserError(f"detector.provider {asked}: {reason}")
        session = NetworkSession(path, chosen, options, where, f"{where} on detector.provider {asked}")
        if session.provider != chosen[0]:
            raise UserError(
                f"detector.provider {asked}: could not be started, "
                f"onnxruntime fell back to {session.provider}"
            )
        return session, {}
    failed: dict[str, str] = {}
    for name in [name for name in PROVIDERS if name in available]:
        if name == "CPU":
            session = NetworkSession(path, [name], options, where)
        elif reason := why_unavailable(name):
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
    raise UserError(f"{where}: onnxruntime has none of {', '.join(PROVIDERS)}")


@lru_cache
def why_unavailable(name: str) -> str:
    """Return why an installed execution provider cannot be loaded, empty if no reason is known."""
    folder = Path(ort.__file__).parent / "capi"
    if not (folder / LIBRARIES.get(name, "")).is_file():
        return ""
    if hasattr(ort, "preload_dlls"):  # of installed packages; prints missing ones
        with contextlib.redirect_stdout(io.StringIO()):
            ort.preload_dlls()
    try:
        ctypes.CDLL(str(folder / SHARED_LIBRARY), ctypes.RTLD_GLOBAL)
        ctypes.CDLL(str(folder / LIBRARIES[name]))
    except OSError as error:
        missing, _, rest = str(error).partition(": ")
        if "cannot open shared object" in rest:
            return f"{missing} is missing ({INSTALL_HELP[name]})"
    return ""


@lru_cache
def say_once(line: str) -> None:
    """Print a line, once for each text."""
    progress.say(line)
