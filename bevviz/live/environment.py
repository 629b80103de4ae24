"""Check of the rclpy installation: whether it works, why not, and what to do about it."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from types import ModuleType

import numpy as np

from bevviz.errors import UserError

WHEELS = "pip install 'bevviz[ros]' (Python 3.11 or 3.12, Linux) brings one that needs no ROS installation"
UNSOURCED = (
    "start bevviz in a shell without `source /opt/ros/.../setup.bash`, in an environment with "
    "pip install 'bevviz[ros]' or in RoboStack: it meets the robot's nodes over DDS all the same"
)

MEETING = (
    "Fast DDS and Cyclone DDS meet on the wire, a robot on rmw_zenoh_cpp is met by none of them: bevviz must "
    "run in an environment that has that middleware"
)

# The wheels set it after they have restarted the interpreter with their library path. A child process of
# another environment inherits the variable, but needs another path.
BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


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
