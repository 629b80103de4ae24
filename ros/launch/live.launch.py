"""bevviz among a robot's nodes: ``ros2 launch bevviz live.launch.py model:=/opt/models/yolo11n.onnx``.

bevviz runs in an environment of its own (numpy 2), so it is a process here and no Node. It restarts when it
has ended, and it ends no other node.
"""

import os
import shutil
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration

PROGRAM = os.environ.get("BEVVIZ_PROGRAM") or shutil.which("bevviz") or "/opt/bevviz/bin/bevviz"
ARGUMENTS = {
    "program": (PROGRAM, "program of the environment that bevviz is installed in"),
    "config": (str(Path(__file__).parents[1] / "config" / "robot.yaml"), "file as 'bevviz config' prints it"),
    "model": ("", "detector, an .onnx file; empty: none"),
    "folder": (".", "existing folder for the last seconds before a fault"),
    "namespace": ("/", "namespace of the robot"),
}


def generate_launch_description() -> LaunchDescription:
    """Return the process and its arguments."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    command = [
        value["program"],
        "live",
        "--config",
        value["config"],
        "--diagnostics",
        "--publish",
        "--nice",
        "10",
    ]
    command += ["--set", ["detector.model=", value["model"]]]
    command += ["--set", ["live.flight_folder=", value["folder"]]]
    command += ["--set", "live.triggers=[one_sensor, tf, stage]"]
    command += ["--ros-args", "-r", ["__ns:=", value["namespace"]]]
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=about)
                for name, (default, about) in ARGUMENTS.items()
            ),
            # Paths of the sourced ROS are not those of bevviz's own environment.
            SetEnvironmentVariable("PYTHONPATH", ""),
            SetEnvironmentVariable("LD_LIBRARY_PATH", ""),
            ExecuteProcess(cmd=command, name="bevviz", output="screen", respawn=True, respawn_delay=5.0),
        ]
    )
