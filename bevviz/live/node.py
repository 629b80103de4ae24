"""ROS nodes of bevviz, the threads that spin them, and the check of the rclpy installation."""

from __future__ import annotations

import importlib
import os
import sys
import threading
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from bevviz.errors import UserError
from bevviz.support.contexts import Closable

WHEELS = "pip install 'bevviz[ros]' (Python 3.11 or 3.12, Linux) brings one that needs no ROS installation"
UNSOURCED = (
    "start bevviz in a shell without `source /opt/ros/.../setup.bash`, in an environment with "
    "pip install 'bevviz[ros]' or in RoboStack: it meets the robot's nodes over DDS all the same"
)

MEETING = (
    "Fast DDS and Cyclone DDS meet on the wire, a robot on rmw_zenoh_cpp is met by none of them: bevviz must "
    "run in an environment that has that middleware"
)

INPUT = "_input"  # end of the name of the node that receives
LAST_DOMAIN = 232  # the ports of higher ones would lie beyond 65535

# The wheels set it after they have restarted the interpreter with their library path. A child process of
# another environment inherits the variable, but needs another path.
BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


class Node(Closable):
    """One context with two nodes. Each is spun by its own thread from ``start`` to ``close``.

    ``node`` is the node that users see. It has the name, the parameters and the services, and it publishes.
    ``input`` receives, so that a slow service call delays no message. It subscribes by the names on the
    graph. Remaps apply to names that the user states, through ``resolve``.

    Args:
        arguments: arguments after ``--ros-args`` on the command line: remaps, namespace, parameters.
        on_end: called when a thread ends, for any reason.
        name: name of the node, unless remapped.

    Raises:
        UserError: rclpy does not work, or refuses the arguments.
    """

    def __init__(
        self, arguments: Sequence[str] = (), on_end: Callable[[], None] = lambda: None, name: str = "bevviz"
    ) -> None:
        rclpy = load_rclpy()
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        _check_domain()
        _check_remaps(arguments)
        self.error: BaseException | None = None  # the exception that ended a thread
        self._on_end = on_end
        self._context: Any = rclpy.Context()
        ros_args = ["--ros-args", *arguments] if arguments else []
        try:
            # The command handles signals itself, so that it ends with a readable recording.
            rclpy.init(args=ros_args, context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            self.node: Any = rclpy.create_node(name, context=self._context)
            self.input: Any = rclpy.create_node(
                f"{self.node.get_name()}{INPUT}",
                namespace=self.node.get_namespace(),
                context=self._context,
                use_global_arguments=False,
                start_parameter_services=False,
                enable_rosout=False,
            )
        except Exception as error:  # rclpy has no common base class for errors in the arguments
            self._context.try_shutdown()
            raise UserError(f"ROS does not start: {' '.join(str(error).split())}") from None
        self._executors = [SingleThreadedExecutor(context=self._context) for _ in range(2)]
        for executor, node in zip(self._executors, (self.node, self.input), strict=True):
            executor.add_node(node)
        self._threads = [
            threading.Thread(target=self._spin, args=(executor,), name="ros", daemon=True)
            for executor in self._executors
        ]

    @property
    def domain(self) -> int:
        """ROS domain id."""
        return int(self._context.get_domain_id())

    @property
    def middleware(self) -> str:
        """Name of the middleware, such as ``rmw_fastrtps_cpp``."""
        from rclpy.utilities import get_rmw_implementation_identifier

        return str(get_rmw_implementation_identifier())

    @property
    def namespace(self) -> str:
        """Namespace of the node."""
        return str(self.node.get_namespace())

    def resolve(self, topic: str) -> str:
        """Return the name on the graph of a topic that the user states: with namespace, remapped."""
        return str(self.node.resolve_topic_name(topic))

    @property
    def is_alone(self) -> bool:
        """Whether no other discovered node has the same name."""
        me = (self.node.get_name(), self.node.get_namespace())
        return list(self.input.get_node_names_and_namespaces()).count(me) <= 1

    def start(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def _spin(self, executor: Any) -> None:
        """Spin an executor until it is shut down. Keep the exception that ended it."""
        from rclpy.executors import ExternalShutdownException, ShutdownException

        try:
            executor.spin()
        except (ExternalShutdownException, ShutdownException):
            pass
        except BaseException as error:
            self.error = error
        finally:
            self._on_end()

    def close(self) -> None:
        """Stop the threads and leave the graph."""
        for executor in self._executors:
            executor.shutdown(timeout_sec=0)
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=5)
        self.input.destroy_node()
        self.node.destroy_node()
        self._context.try_shutdown()


def is_cut_off() -> bool:
    """Return whether a port of Fast DDS's shared memory that this process uses was deleted.

    While a killed process is still known, which takes 20 s, the robot's nodes make and delete its port again
    and again. A process that takes over the port meanwhile may read a deleted file for ever (Fast DDS 2.14).
    """
    lines = Path("/proc/self/maps").read_text().splitlines()
    return any("/fastrtps_port" in line and line.endswith("(deleted)") for line in lines)


def add_timer(node: Any, period: float, callback: Callable[[], None]) -> None:
    """Call a function regularly in the thread that spins an rclpy node."""
    from rclpy.clock import Clock
    from rclpy.clock_type import ClockType

    # A steady clock. The node's clock stands still while a simulation is paused.
    node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def load_rclpy() -> ModuleType:
    """Import rclpy and the message packages that a node needs.

    Raises:
        UserError: rclpy is not installed, or does not work with this Python and numpy.
    """
    sourced = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)[0]
    if int(np.__version__.partition(".")[0]) < 2:
        installation = f"the sourced ROS in {sourced}" if sourced else "this environment"
        raise UserError(
            f"numpy {np.__version__} of {installation} is too old for the viewer's SDK; {UNSOURCED}"
        )
    _check_middleware()
    try:
        rclpy = importlib.import_module("rclpy")
        for name in ("rclpy.executors", "rcl_interfaces.msg", "sensor_msgs.msg"):
            importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name == "rclpy":
            raise UserError(f"a live robot needs rclpy, which is not installed; {WHEELS}") from None
        raise UserError(_explain(error, sourced)) from None
    except (ImportError, AttributeError) as error:  # numpy raises these for an extension of another ABI
        raise UserError(_explain(error, sourced)) from None
    return rclpy


def _check_middleware() -> None:
    """Check that the library of the selected middleware exists.

    Without the library rclpy ends the process, without an exception.

    Raises:
        UserError: RMW_IMPLEMENTATION names a middleware that is not installed.
    """
    selected = os.environ.get("RMW_IMPLEMENTATION", "")
    if not selected:
        return
    installed = middlewares()
    if installed and selected not in installed:
        raise UserError(
            f"RMW_IMPLEMENTATION={selected} is not installed for this Python, there is "
            f"{', '.join(sorted(installed))}: unset RMW_IMPLEMENTATION where the robot speaks DDS; {MEETING}"
        )


def _check_domain() -> None:
    """Check ROS_DOMAIN_ID. The middleware prints lines of its own about a wrong one.

    Raises:
        UserError: it is not a number that the ports of DDS allow.
    """
    domain = os.environ.get("ROS_DOMAIN_ID", "")
    if domain and not (domain.isdecimal() and int(domain) <= LAST_DOMAIN):
        raise UserError(f"ROS_DOMAIN_ID={domain}: a domain is a number from 0 to {LAST_DOMAIN}")


def _check_remaps(arguments: Sequence[str]) -> None:
    """Check the remaps. The middleware's messages about a wrong one name no argument.

    Raises:
        UserError: a remap has no ``:=``, or a namespace has no slash.
    """
    for option, remap in pairwise(arguments):
        if option not in ("-r", "--remap"):
            continue
        name, separator, value = remap.partition(":=")
        if not separator:
            raise UserError(f"--ros-args {option} {remap}: expected FROM:=TO")
        if name.rpartition(":")[2] in ("__ns", "__namespace") and not value.startswith("/"):
            raise UserError(f"--ros-args {option} {remap}: a namespace begins with a slash: {name}:=/{value}")


def middlewares() -> set[str]:
    """Return the installed middlewares, by their names for RMW_IMPLEMENTATION."""
    folders = [Path(sys.prefix, "lib"), *(Path(p, "lib") for p in _paths("AMENT_PREFIX_PATH"))]
    folders += map(Path, _paths("LD_LIBRARY_PATH"))
    names = {path.name[3:-3] for folder in folders for path in folder.glob("librmw_*_cpp.so")}
    return {
        name for name in names if not name.endswith(("_shared_cpp", "_typesupport_cpp")) and "__" not in name
    }


def _paths(variable: str) -> list[str]:
    """Return the paths in an environment variable."""
    return [path for path in os.environ.get(variable, "").split(os.pathsep) if path]


def _explain(error: Exception, sourced: str) -> str:
    """Return the sentence that explains an import error."""
    reason = " ".join(str(error).split())
    if "shared object" in reason and BOOTSTRAPPED in os.environ:
        return f"the wheels do not find their libraries ({reason}): start bevviz in a new shell"
    if sourced:
        return (
            f"the sourced ROS in {sourced} does not work with this Python and numpy ({reason}); {UNSOURCED}"
        )
    return f"the installed rclpy does not work ({reason}); {WHEELS}"
