"""bevviz among a robot's nodes: ``ros2 launch bevviz live.launch.py model:=/opt/models/yolo11n.onnx``.

bevviz runs in an environment of its own (numpy 2), so it is a process here and no Node. It restarts when it
has ended, and it ends no other node. It publishes on ``/diagnostics`` only: ``options:=--publish`` sends its
results, too.
"""

import os
import shlex
import shutil
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration

PROGRAM = os.environ.get("BEVVIZ_PROGRAM") or shutil.which("bevviz") or "/opt/bevviz/bin/bevviz"
ARGUMENTS = {
    "program": (PROGRAM, "program of the environment that bevviz is installed in"),
    "config": (str(Path(__file__).parents[1] / "config" / "robot.yaml"), "file as 'bevviz config' prints it"),
    "model": ("", "detector, an .onnx file; empty: none"),
    "folder": (".", "existing folder for the last seconds before a fault"),
    "namespace": ("/", "namespace of the robot"),
    "options": ("", "more options of 'bevviz live', e.g. '--publish --save drive.mcap'"),
}


def start(context):
    """Return the process, given the values of the arguments."""
    value = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    command = [value["program"], "live", "--config", value["config"], "--diagnostics", "--nice", "10"]
    command += ["--set", f"detector.model={value['model']}"]
    command += ["--set", f"live.flight_folder={value['folder']}"]
    command += ["--set", "live.triggers=[one_sensor, tf, stage]"]
    command += shlex.split(value["options"])
    command += ["--ros-args", "-r", f"__ns:={value['namespace']}"]
    return [ExecuteProcess(cmd=command, name="bevviz", output="screen", respawn=True, respawn_delay=5.0)]


def generate_launch_description() -> LaunchDescription:
    """Return the process and its arguments."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=about)
                for name, (default, about) in ARGUMENTS.items()
            ),
            # Paths of the sourced ROS are not those of bevviz's own environment.
            SetEnvironmentVariable("PYTHONPATH", ""),
            SetEnvironmentVariable("LD_LIBRARY_PATH", ""),
            OpaqueFunction(function=start),
        ]
    )
