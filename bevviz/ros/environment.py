"""Is there an rclpy that works here? If not, why, and what to do."""

from __future__ import annotations

import importlib
import os
from types import ModuleType

import numpy as np

from bevviz.errors import UserError

WHEELS = "pip install 'bevviz[ros]' (Python 3.11 or 3.12, Linux) brings one that needs no ROS installation"
UNSOURCED = (
    "start bevviz in a shell without `source /opt/ros/.../setup.bash`, in an environment with "
    "pip install 'bevviz[ros]' or in RoboStack: it meets the robot's nodes over DDS all the same"
)

# Set by the wheels when they have restarted the interpreter with their library path; a child process of
# another environment inherits it, but needs another path.
BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


def load_rclpy() -> ModuleType:
    """Import rclpy, with the message packages that a node needs.

    Raises:
        UserError: none is installed, or the one that is found does not work with this Python and numpy.
    """
    sourced = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)[0]
    if int(np.__version__.partition(".")[0]) < 2:
        whose = f"the sourced ROS in {sourced}" if sourced else "this environment"
        raise UserError(f"numpy {np.__version__} of {whose} is too old for the viewer's SDK; {UNSOURCED}")
    try:
        rclpy = importlib.import_module("rclpy")
        for name in ("rclpy.executors", "rcl_interfaces.msg", "sensor_msgs.msg"):
            importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name == "rclpy":
            raise UserError(f"a live robot needs rclpy, which is not installed; {WHEELS}") from None
        raise UserError(_explain(error, sourced)) from None
    except (ImportError, AttributeError) as error:  # numpy's own words for an extension of another ABI
        raise UserError(_explain(error, sourced)) from None
    return rclpy


def _explain(error: Exception, sourced: str) -> str:
    reason = " ".join(str(error).split())
    if "shared object" in reason and BOOTSTRAPPED in os.environ:
        return f"the wheels do not find their libraries ({reason}): start bevviz in a new shell"
    if sourced:
        return (
            f"the sourced ROS in {sourced} does not work with this Python and numpy ({reason}); {UNSOURCED}"
        )
    return f"the installed rclpy does not work ({reason}); {WHEELS}"
