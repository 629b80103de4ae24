"""Load and run the networks of ONNX files within limits.

A broken or foreign file may need any time and any memory.
"""

from __future__ import annotations

import math
import os
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import onnxruntime as ort

from bevviz.errors import UserError, first_line
from bevviz.support.cleanup import ENDLESS_THREAD

# Seconds to load a network, and for each answer: ten times what the largest detectors take on a small board.
SECONDS = 120.0
# The same for providers that compile a network before its first answer, which takes minutes.
COMPILING_SECONDS = 1800.0
INTERPRETING = ("CPU", "CUDA")  # providers that do not compile networks
# Bytes that the networks of this process may take. The largest 3D detectors take 2 GB.
MAX_MEMORY = 8 * 2**30
# On a smaller machine the networks may take this share of its memory. The recording needs the other half.
MEMORY_SHARE = 0.5
# Numbers in all inputs of a network. 800 MB as float32; the largest known inputs of 3D detectors hold 1.3e8.
MAX_INPUT_NUMBERS = 200_000_000
# Numbers in all outputs of a network. 400 MB as float32; detectors for 4096 x 4096 pixels give 3e7.
MAX_OUTPUT_NUMBERS = 100_000_000
# Inputs and outputs of a network. Detectors have up to 4 inputs, and 6 outputs for each of 6 heads.
MAX_TENSORS = 100
MAX_NAME = 1000  # characters in the name of an input or output, which stands in error messages

CHECK_SECONDS = 0.05  # seconds between two checks of the memory; up to 100 MB are filled in this time
STOP_SECONDS = 1.0  # seconds that a network has to end after a stop request
SUFFIX = "ExecutionProvider"
# The first onnxruntime that reads no weights outside of a model's folder. pyproject.toml asks for it, but
# onnxruntime-gpu and other builds are installed in its place, and pip does not check their version.
FIRST_SAFE = (1, 24, 1)
LOG_FATAL = 4  # onnxruntime's severity "fatal", so that it does not print errors that we report ourselves
MAX_LISTED = 8  # inputs or outputs in an error message
MAX_LISTED_TEXT = 200  # characters of each text in an error message
MAX_REASON = (
    2000  # characters of onnxruntime's reason in an error message; a file may hold names of any length
)
AGAIN = "export it again, and test the file with onnxruntime alone"
# What to do, by onnxruntime's reason.
REMEDIES = (
    (re.compile(r"external data|External data"), "put the file with the weights beside it (FILE.onnx.data)"),
    (
        re.compile(r"opset|IR version|is not a registered|No Op registered"),
        "export it with an older opset (opset=17), or install a newer onnxruntime",
    ),
    (
        re.compile(r"[Pp]rotobuf|INVALID_PROTOBUF"),
        "it is damaged or no ONNX file: copy or export it again",
    ),
    (re.compile(r"[Ss]hape|[Dd]imension|broadcast"), "export it with a fixed input size (dynamic=False)"),
)
SIZE_HINT = "use a smaller network, or export it with a smaller input"

NUMBERS = re.compile(r"tensor\((u?int(8|16|32|64)|float|float16|double|bool)\)")
# Beginnings of onnxruntime's messages that do not help users: error codes, and positions in its source.
ERROR_CODE = re.compile(r"^\[ONNXRuntimeError\] : \d+ : \w+ : ")
SOURCE_POSITION = re.compile(r"\S*/onnxruntime/core/\S+:\d+ .*\) (?=\S)")
OUT_OF_MEMORY = re.compile(r"Failed to allocate memory|Available memory of|bad_alloc|bad allocation")

T = TypeVar("T")


class NetworkSession:
    """A loaded network that runs within limits.

    Args:
        path: ONNX file.
        providers: names of onnxruntime's execution providers, without their suffix.
        options: of the session.
        where: how errors name the file.
        loading: how errors name the file, or the provider, when it cannot be loaded; empty: as ``where``.

    Attributes:
        inputs: the network's inputs, as onnxruntime describes them.
        outputs: names of the network's outputs.
        metadata: texts that the exporter wrote into the file, by name.
        provider: the execution provider in use.

    Raises:
        UserError: onnxruntime cannot load the file, or the network exceeds a limit.
    """

    def __init__(
        self, path: Path, providers: Sequence[str], options: ort.SessionOptions, where: str, loading: str = ""
    ) -> None:
        self.where = where
        self._seconds = SECONDS if set(providers) <= set(INTERPRETING) else COMPILING_SECONDS
        self._session = _load(path, providers, options, loading or where, self._seconds)
        self.provider = str(self._session.get_providers()[0]).removesuffix(SUFFIX)
        self.metadata: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map
        self.inputs: list[Any] = self._session.get_inputs()
        self.outputs: list[str] = [output.name for output in self._session.get_outputs()]
        self._has_answered = False
        self._check_tensors()

    def run(self, feed: Mapping[str, Any], wanted: Sequence[str] | None = None) -> dict[str, Any]:
        """Run the network.

        Args:
            feed: arrays by the name of the input.
            wanted: names of outputs; None: all.

        Returns:
            The outputs by name, in the order of ``wanted``.

        Raises:
            UserError: the network fails, takes too long, or answers more than the limits allow.
        """
        names = self.outputs if wanted is None else list(wanted)
        shapes = ", ".join(str(list(np.shape(value))) for value in feed.values())
        options = ort.RunOptions()
        options.log_severity_level = LOG_FATAL

        def answer() -> list[Any]:
            outputs: list[Any] = self._session.run(names, dict(feed), options)
            return outputs

        def end() -> None:
            options.terminate = True

        try:
            if self._has_answered:
                arrays = _run_in_time(answer, end, self._seconds)
            else:
                arrays = _watch(answer, end, self._seconds)
        except _LimitError as error:
            raise UserError(f"{self.where}: {error} on an input of {shapes}; {SIZE_HINT}") from None
        except Exception as error:  # onnxruntime's errors have no common base class
            if options.terminate:
                raise UserError(
                    f"{self.where}: {_overdue('answer', self._seconds)} on an input of {shapes}; {SIZE_HINT}"
                ) from None
            raise UserError(f"{self.where}: {_reason(error, f'fails on an input of {shapes}')}") from None
        self._has_answered = True
        self._check_answer(names, arrays)
        return dict(zip(names, arrays, strict=True))

    def check_input(self, name: str, shape: Sequence[Any]) -> None:
        """Check the size of an input. Open axes are not checked.

        Raises:
            UserError: an axis has no elements, or all together have too many.
        """
        known = [n for n in shape if isinstance(n, int)]
        if any(n < 1 for n in known):
            raise UserError(f"{self.where}: its input {clip(name)} is {clip(shape)}, which holds nothing")
        if math.prod(known) > MAX_INPUT_NUMBERS:
            raise UserError(
                f"{self.where}: its input {clip(name)} is {clip(shape)}, more than {MAX_INPUT_NUMBERS:,} "
                "numbers; export it with a smaller input"
            )

    def _check_tensors(self) -> None:
        """Check number, names and types of the inputs and outputs."""
        outputs = self._session.get_outputs()
        for kind, nodes in (("input", self.inputs), ("output", outputs)):
            if not nodes:
                raise UserError(f"{self.where}: has no {kind}; export it again")
            if len(nodes) > MAX_TENSORS:
                raise UserError(
                    f"{self.where}: has {len(nodes):,} {kind}s, and no more than {MAX_TENSORS} are read"
                )
            for node in nodes:
                if len(node.name) > MAX_NAME:
                    raise UserError(
                        f"{self.where}: its {kind} {clip(node.name)} has a name of {len(node.name):,} "
                        f"characters, and no more than {MAX_NAME} are read; export it with another name"
                    )
                if not NUMBERS.fullmatch(node.type):
                    raise UserError(
                        f"{self.where}: its {kind} {clip(node.name)} is a {clip(node.type)}, no tensor of "
                        "numbers; export the network without it"
                    )
        for node in self.inputs:
            self.check_input(node.name, node.shape)

    def _check_answer(self, names: Sequence[str], arrays: Sequence[Any]) -> None:
        """Check the size of the outputs."""
        if sum(array.size for array in arrays) > MAX_OUTPUT_NUMBERS:
            shapes = list_tensors((name, np.shape(array)) for name, array in zip(names, arrays, strict=True))
            raise UserError(
                f"{self.where}: answers more than {MAX_OUTPUT_NUMBERS:,} numbers: {shapes}; {SIZE_HINT}"
            )


@contextmanager
def reading_answer(where: str) -> Iterator[None]:
    """Convert errors while reading a network's answer, which may have any shape and any numbers.

    Raises:
        UserError: the answer cannot be read. The text of a ValueError is used as it is.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except ValueError as error:
        raise UserError(f"{where}: {first_line(error)}") from None
    except (IndexError, KeyError, OverflowError) as error:
        raise UserError(
            f"{where}: its outputs have shapes that cannot be read ({first_line(error)}); "
            "export it with fixed shapes"
        ) from None


def list_tensors(tensors: Iterable[tuple[str, Any]]) -> str:
    """List names and shapes of inputs or outputs for an error message, with a limited length.

    >>> listed([("images", [1, 3, 640, 640]), ("scale", (1, 2))])
    'images [1, 3, 640, 640], scale [1, 2]'
    """
    texts = [f"{clip(name)} {clip(list(shape))}" for name, shape in tensors]
    more = len(texts) - MAX_LISTED
    return ", ".join([*texts[:MAX_LISTED], *([f"and {more} more"] if more > 0 else [])])


def clip(value: object, most: int = MAX_LISTED_TEXT) -> str:
    """Return the value as a text for an error message. A file may hold names of any length."""
    text = str(value)
    return text if len(text) <= most else f"{text[:most]}..."


class _LimitError(Exception):
    """Error of a network that takes more than a limit allows."""


def _load(
    path: Path, providers: Sequence[str], options: ort.SessionOptions, where: str, seconds: float
) -> Any:
    """Load a network within the limits."""
    if tuple(map(int, re.findall(r"\d+", ort.__version__)[:3])) < FIRST_SAFE:
        raise UserError(
            f"{where}: onnxruntime {ort.__version__} lets a model read files outside of its folder: install "
            f"{'.'.join(map(str, FIRST_SAFE))} or newer"
        )
    _share_limited_memory()
    options.log_severity_level = LOG_FATAL
    options.add_session_config_entry("session.use_env_allocators", "1")
    # Without this setting a name that ends with .ort has the file read in another format.
    options.add_session_config_entry("session.load_model_format", "ONNX")

    def load() -> Any:
        # onnxruntime's own fallback is disabled because it prints to standard output.
        names = [f"{name}{SUFFIX}" for name in providers]
        return ort.InferenceSession(path, options, names, enable_fallback=0)

    def end() -> None:
        options.set_load_cancellation_flag(True)

    try:
        return _watch(load, end, seconds, "load")
    except _LimitError as error:
        raise UserError(f"{where}: {error}; {SIZE_HINT}") from None
    except Exception as error:  # onnxruntime's errors have no common base class
        raise UserError(f"{where}: {_reason(error, 'onnxruntime cannot load it')}") from None


@lru_cache
def _share_limited_memory() -> None:
    """Limit the memory for tensors. All networks of this process share it."""
    cpu = ort.OrtMemoryInfo("Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT)
    ort.create_and_register_allocator(cpu, ort.OrtArenaCfg({"max_mem": memory_limit()}))


@lru_cache
def memory_limit() -> int:
    """Return how many bytes the networks of this process may take."""
    try:
        whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return MAX_MEMORY
    return min(MAX_MEMORY, int(MEMORY_SHARE * whole))


def _resident() -> int:
    """Return the resident bytes of this process; 0 if the system does not report them."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def _watch(work: Callable[[], T], end: Callable[[], None], seconds: float, verb: str = "answer") -> T:
    """Run work of unknown time and memory in a thread. Abandon the thread when a limit is exceeded.

    ``end`` asks the work to stop. A network stops only between two of its operations.

    Raises:
        _LimitError: the work exceeds a limit.
    """
    result: Future[T] = Future()

    def thread() -> None:
        try:
            result.set_result(work())
        except BaseException as error:
            result.set_exception(error)

    # The thread must not keep the process alive: one operation may take hours.
    threading.Thread(target=thread, daemon=True, name=ENDLESS_THREAD).start()
    start, before, reason = time.monotonic(), _resident(), ""
    try:
        while not (reason or wait([result], CHECK_SECONDS).done):
            if time.monotonic() - start > seconds:
                reason = _overdue(verb, seconds)
            elif _resident() - before > memory_limit():
                reason = _too_large()
    finally:
        if not result.done():
            end()
    if not reason:
        return result.result()
    wait([result], STOP_SECONDS)
    raise _LimitError(reason)


def _run_in_time(work: Callable[[], T], end: Callable[[], None], seconds: float) -> T:
    """Run the work in this thread, and ask it to stop after so many seconds."""
    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    try:
        return work()
    finally:
        timer.cancel()


def _overdue(verb: str, seconds: float) -> str:
    """Return the message for work that took too long."""
    return f"does not {verb} within {seconds:g} s"


def _too_large() -> str:
    """Return the message for work that took too much memory."""
    return f"needs more than {memory_limit() / 2**30:.1f} GiB of memory"


def _reason(error: Exception, otherwise: str) -> str:
    """Return why onnxruntime failed, and how to fix it if that is known."""
    text = first_line(error)
    if isinstance(error, MemoryError) or OUT_OF_MEMORY.search(text):
        return f"{_too_large()}; {SIZE_HINT}"
    text = SOURCE_POSITION.sub("", ERROR_CODE.sub("", text))
    remedy = next((remedy for pattern, remedy in REMEDIES if pattern.search(text)), AGAIN)
    return f"{otherwise}: {clip(text, MAX_REASON)}; {remedy}"
