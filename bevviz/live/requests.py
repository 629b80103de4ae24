"""Requests to a running bevviz: through its socket (``bevviz snap``), by ROS parameters and a ROS service."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from bevviz.errors import UserError
from bevviz.support.contexts import Closable
from bevviz.support.files import check_owned

if TYPE_CHECKING:  # the client of the socket starts without the configuration
    from bevviz.config import Config, Parameter

ANSWER = 5.0  # seconds that a healthy process needs at most to acknowledge a request
PATIENCE = 120.0  # seconds that saving may take
LONGEST = 1 << 16  # bytes, longest request or answer
_CREDENTIALS = struct.Struct("3i")  # SO_PEERCRED of a socket: process, user, group
NO_LIMIT = 0  # a ROS parameter cannot be empty


class Control(Closable):
    """Server that answers requests to save until it is closed.

    A request is a line of JSON, ``{"path": "FILE.rrd"}``. The first line of the answer comes at once. The
    second, ``{"saved": ...}`` or ``{"error": ...}``, comes when the saving is done.

    Args:
        save: writes the recording to a path, or to a path of its own choice, and returns the path.
        warn: called with one sentence if no socket can be opened. ``snap`` does not find the process then.
    """

    def __init__(self, save: Callable[[Path | None], Path], warn: Callable[[str], None]) -> None:
        self.save = save  # public, because it may be replaced later
        self._path: Path | None = None
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)
        self._answers: list[threading.Thread] = []  # each answers one request
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        reasons: list[str] = []
        for folder in folders():
            try:
                self._listen(folder)
            except (OSError, UserError) as error:
                reasons.append(str(error))
            else:
                break
        if self._path is None:
            warn(f"'bevviz snap' cannot reach this run, SIGUSR1 can: {'; '.join(reasons)}")
            return
        self._thread.start()

    def close(self) -> None:
        """Remove the socket and wait for a save in progress."""
        if self._path is None:
            self._socket.close()
            return
        self._path.unlink(missing_ok=True)
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes the thread
        self._socket.close()
        self._thread.join(PATIENCE)
        for thread in self._answers:
            thread.join(PATIENCE)  # a save may be in progress

    def _listen(self, folder: Path) -> None:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        check_owned(folder)
        path = folder / f"{os.getpid()}.sock"
        path.unlink(missing_ok=True)
        self._socket.bind(str(path))
        self._socket.listen()
        self._path = path

    def _serve(self) -> None:
        """Answer each request in a thread of its own until the socket is closed: a save takes time."""
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            answer = threading.Thread(target=self._converse, args=(connection,), name="answer", daemon=True)
            self._answers = [thread for thread in self._answers if thread.is_alive()] + [answer]
            answer.start()

    def _converse(self, connection: socket.socket) -> None:
        """Read one request and answer it."""
        with connection, suppress(OSError), connection.makefile("rb") as lines:
            connection.settimeout(ANSWER)
            request = _line(lines)
            if request is None:  # the client only tested whether a process listens
                return
            connection.sendall(b'{"heard": true}\n')
            connection.settimeout(PATIENCE)
            connection.sendall(json.dumps(self._answer(request)).encode() + b"\n")

    def _answer(self, request: bytes) -> dict[str, str]:
        try:
            content = json.loads(request)
            path = content.get("path") if isinstance(content, dict) else 0
        except ValueError:
            path = 0
        if not isinstance(path, str | None):
            return {"error": "the request was not understood"}
        try:
            saved = self.save(Path(path) if path else None)
            return {"saved": str(saved.absolute())}
        except UserError as error:
            return {"error": str(error)}
        except Exception as error:  # an error must not end the thread that answers the next request
            return {"error": f"{type(error).__name__}: {error}"}


@contextmanager
def answer_sigusr1(answer: Callable[[], None]) -> Iterator[None]:
    """Call a function at each SIGUSR1. The default action would end the process."""
    before = signal.signal(signal.SIGUSR1, lambda number, stack: answer())
    try:
        yield
    finally:
        signal.signal(signal.SIGUSR1, before)


def snap(path: Path | None = None, pid: int | None = None) -> Path:
    """Make the running process save its flight recorder.

    Args:
        path: .rrd file. None: the process names it by the time, in its own folder.
        pid: process to ask, if several run.

    Raises:
        UserError: no process runs, several run, the process does not answer, or it cannot save.
    """
    running = _running()
    if pid is not None and pid not in running:
        raise UserError(f"no 'bevviz live' of yours with process id {pid} runs on this machine")
    if not running:
        raise UserError("no 'bevviz live' of yours runs on this machine")
    if pid is None and len(running) > 1:
        raise UserError(f"several run; choose one with --pid: {', '.join(map(str, sorted(running)))}")
    process, connection = next((p, c) for p, c in running.items() if pid in (None, p))
    with connection, connection.makefile("rb") as lines:
        try:
            connection.settimeout(ANSWER)
            request = {"path": str(path.absolute())} if path is not None else {}
            connection.sendall(json.dumps(request).encode() + b"\n")
            heard = _line(lines)
        except OSError:
            heard = None
        if heard is None:
            raise UserError(f"process {process} does not answer: it is stopped, or hangs")
        try:
            connection.settimeout(PATIENCE)
            answer = json.loads(_line(lines) or b"{}")
        except (OSError, ValueError):
            answer = {}
    if not isinstance(answer, dict) or "saved" not in answer:
        error = answer.get("error") if isinstance(answer, dict) else None
        raise UserError(str(error or f"process {process} ended before it had saved"))
    return Path(str(answer["saved"]))


def folders() -> Iterator[Path]:
    """Yield the folders that may hold the sockets, the best one first."""
    if runtime_folder := os.environ.get("XDG_RUNTIME_DIR"):
        yield Path(runtime_folder, "bevviz")
    user_folder = Path(f"/run/user/{os.getuid()}")
    if user_folder.is_dir():
        yield user_folder / "bevviz"
    yield Path(tempfile.gettempdir(), f"bevviz-{os.getuid()}")


def _running() -> dict[int, socket.socket]:
    """Return a connection to each listening process of this user. Remove the sockets of ended processes."""
    connections: dict[int, socket.socket] = {}
    for folder in dict.fromkeys(folders()):
        try:
            check_owned(folder)
            paths = sorted(folder.glob("*.sock"))
        except (OSError, UserError):
            continue  # the folder is not safely this user's
        for path in paths:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            connection.settimeout(ANSWER)
            try:
                connection.connect(str(path))
                peer = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
                process, user, _ = _CREDENTIALS.unpack(peer)
            except ConnectionRefusedError:
                path.unlink(missing_ok=True)
                continue
            except OSError:
                continue
            if user == os.getuid():
                connections[process] = connection
    return connections


def _line(lines: BinaryIO) -> bytes | None:
    """Read the next line. Return None if the other side has closed or the line is too long."""
    line = lines.readline(LONGEST)
    return line if line.endswith(b"\n") else None


# --- ROS ---------------------------------------------------------------------------------------


class RosRequests:
    """ROS parameters for every key of the configuration, and the service ``~/save_recording``.

    Each key is a parameter (``clustering.eps``). The tutorial's names (``range_x``, ``voxel_size`` ...) exist
    too. Values given with ``--ros-args -p`` are applied before the constructor returns. ``config``,
    ``change`` and ``save`` may be replaced later.

    Args:
        node: an rclpy node that another thread spins.
        config: initial values of the parameters.
        change: applies settings ``key=value``, or raises a UserError with the reason.
        save: writes the recording of the last seconds and returns its path, or raises a UserError.

    Raises:
        UserError: a value given with ``-p`` is refused.
    """

    def __init__(
        self,
        node: Any,
        config: Config,
        change: Callable[[list[str]], None],
        save: Callable[[], Path] | None = None,
    ) -> None:
        from bevviz.config import TUTORIAL_NAMES, parameters

        self._node = node
        self.config = config
        self.change = change
        self.save = save
        about = parameters(config)
        self._keys = {**{key: key for key in about}, **TUTORIAL_NAMES}  # parameter name -> key
        declared = [
            node.declare_parameter(name, value, _descriptor(about[self._keys[name]].text))
            for name, value in self._parameters(config).items()
        ]
        if settings := self._settings(declared):
            change(settings)
        # Ranges come after the first change, so that a wrong value given with ``-p`` gets our sentence.
        for name, key in self._keys.items():
            if (descriptor := _descriptor_with_range(about[key], config)) is not None:
                node.set_descriptor(name, descriptor)
        node.add_on_set_parameters_callback(self._set)
        if save is not None:
            from std_srvs.srv import Trigger

            node.create_service(Trigger, "~/save_recording", self._trigger)

    def show(self, config: Config) -> None:
        """Set the parameters to a configuration that was changed elsewhere."""
        from rclpy.parameter import Parameter

        self.config = config
        parameters = self._parameters(config).items()
        self._node.set_parameters(
            [Parameter(n, value=v) for n, v in parameters if self._node.get_parameter(n).value != v]
        )

    def _parameters(self, config: Config) -> dict[str, Any]:
        """Return a configuration as ROS parameters. Lists become YAML, and None an empty text."""
        from bevviz.config import values

        current, parameters = values(config), dict[str, Any]()
        for name, key in self._keys.items():
            value = current[key]
            if value is None:
                value = NO_LIMIT if name == "max_cluster_size" else ""
            parameters[name] = value if isinstance(value, bool | int | float | str) else _yaml(value)
        return parameters

    def _settings(self, parameters: Sequence[Any]) -> list[str]:
        """Return the parameters that differ from the configuration, as settings ``key=value``."""
        from bevviz.config import values

        current, unchanged = values(self.config), self._parameters(self.config)
        ordered = []
        for parameter in parameters:
            name, value = parameter.name, parameter.value
            key = self._keys.get(name)
            if key is None or value == unchanged[name]:
                continue
            empty = value == NO_LIMIT if name == "max_cluster_size" else value in ("", None)
            none = empty and not isinstance(current[key], str)
            ordered.append(f"{key}={'null' if none else _text(value)}")
        return ordered

    def _set(self, parameters: Sequence[Any]) -> Any:
        """Apply changed parameters. Return whether they were accepted."""
        from rcl_interfaces.msg import SetParametersResult

        try:
            if settings := self._settings(parameters):
                self.change(settings)
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _trigger(self, request: Any, response: Any) -> Any:
        assert self.save is not None
        try:
            response.success, response.message = True, str(self.save())
        except UserError as error:
            response.success, response.message = False, str(error)
        return response


def _text(value: Any) -> str:
    return _yaml(value) if isinstance(value, bool | list | tuple) or hasattr(value, "tolist") else str(value)


def _yaml(value: Any) -> str:
    """Return a value as YAML on one line. JSON is YAML."""
    return json.dumps(value, default=lambda other: other.tolist() if hasattr(other, "tolist") else str(other))


def _descriptor(about: str) -> Any:
    from rcl_interfaces.msg import ParameterDescriptor

    # The configuration checks the type. `ros2 param set` takes 20 for an integer where 20.0 is meant.
    return ParameterDescriptor(description=about, dynamic_typing=True)


def _descriptor_with_range(parameter: Parameter, config: Config) -> Any:
    """Return the descriptor of a number with a range, for the sliders of rqt. None: the key has no range."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange

    from bevviz.config import values

    value, low, high = values(config)[parameter.key], parameter.low, parameter.high
    if isinstance(value, bool) or parameter.optional or low is None or high is None:
        return None
    descriptor = _descriptor(parameter.text)
    if isinstance(value, int):
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
    elif isinstance(value, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
        ]
    return descriptor
