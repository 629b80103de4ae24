"""What a network runs on, where a better provider is installed that does not work."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import onnxruntime as ort
import pytest

from bevviz.config import load
from bevviz.errors import UserError
from bevviz.pipeline.bag_info import network_provider
from bevviz.stages.detector import providers
from bevviz.support import progress
from bevviz.support.onnx_files import DEMO_MODEL


@pytest.fixture
def gpu_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """As onnxruntime-gpu is installed: it lists CUDA, whether or not that loads."""
    folder = tmp_path / "onnxruntime"
    (folder / "capi").mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "capi" / providers.LIBRARIES["CUDA"]).write_bytes(b"no library")
    monkeypatch.setattr(ort, "__file__", str(folder / "__init__.py"))
    names = ["TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(ort, "get_available_providers", lambda: names)
    providers.why_unavailable.cache_clear()
    providers.say_once.cache_clear()
    return folder


def libraries(monkeypatch: pytest.MonkeyPatch, error: str) -> None:
    """Replace the loading of libraries: it fails with this error of the dynamic linker, if there is one."""

    def load_library(*_: object) -> None:
        if error:
            raise OSError(error)

    monkeypatch.setattr(ctypes, "CDLL", load_library)


MISSING = "libcublasLt.so.13: cannot open shared object file: No such file or directory"


def test_a_missing_library_is_told_once_and_the_cpu_is_used(
    gpu_package: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    libraries(monkeypatch, MISSING)
    said: list[str] = []
    monkeypatch.setattr(progress, "_say", said.append)
    for _ in range(2):
        assert providers.open_session(DEMO_MODEL, "auto", ort.SessionOptions()).provider == "CPU"
    assert said == [
        "the network runs on CPU: CUDA is installed, but libcublasLt.so.13 is missing "
        "(pip install 'onnxruntime-gpu[cuda,cudnn]', and NVIDIA's driver)"
    ]
    assert "CPU; CUDA is installed, but libcublasLt.so.13 is missing" in network_provider(
        load(settings=["detector.model=demo"])
    )
    assert capfd.readouterr().out == "", "nothing of onnxruntime's own"
    with pytest.raises(UserError, match=r"detector.provider CUDA: libcublasLt.so.13 is missing"):
        providers.open_session(DEMO_MODEL, "CUDA", ort.SessionOptions())


def test_a_gpu_that_does_not_start_is_replaced_by_the_cpu(
    gpu_package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All libraries are there, the driver is not."""
    libraries(monkeypatch, "")
    said: list[str] = []
    monkeypatch.setattr(progress, "_say", said.append)
    real = ort.InferenceSession

    def session(path: Path, options: Any, chosen: list[str], **more: Any) -> Any:
        if chosen[0].startswith("CUDA"):
            raise RuntimeError("CUDA failure 35: CUDA driver version is insufficient\nat cuda_call.cc")
        return real(path, options, chosen, **more)

    monkeypatch.setattr(ort, "InferenceSession", session)
    assert providers.open_session(DEMO_MODEL, "auto", ort.SessionOptions()).provider == "CPU"
    (line,) = said
    assert "CUDA failure 35" in line
    assert "cuda_call" not in line
    with pytest.raises(UserError, match="CUDA failure 35"):
        providers.open_session(DEMO_MODEL, "cuda", ort.SessionOptions())


def test_without_a_detector_nothing_is_said() -> None:
    assert network_provider(load()) == ""
    assert network_provider(load(settings=["detector.model=nowhere.onnx"]))
