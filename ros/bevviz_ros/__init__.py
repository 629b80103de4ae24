"""bevviz in a ROS 2 workspace. The program itself runs in an environment of its own."""

import os
import shutil

DEFAULT = "/opt/bevviz/bin/bevviz"


def program() -> str:
    """Return the program: ``BEVVIZ_PROGRAM``, else the one on the path, else that of /opt/bevviz."""
    return os.environ.get("BEVVIZ_PROGRAM") or shutil.which("bevviz") or DEFAULT


def environment() -> dict[str, str]:
    """Return the environment of the program: paths of the sourced ROS are not those of its Python."""
    return {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "LD_LIBRARY_PATH")}
