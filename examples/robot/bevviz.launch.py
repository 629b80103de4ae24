"""bevviz among a robot's nodes: ``ros2 launch ./bevviz.launch.py model:=/opt/models/yolo11n.onnx``.

It runs in an environment of its own (numpy 2), so it is a process here and no Node. It comes back when it has
ended, and it shuts nothing down.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "program": ("/opt/bevviz/bin/bevviz", "of the environment that bevviz is installed in"),
    "config": ("/etc/bevviz/robot.yaml", "configuration, as 'bevviz config' prints it"),
    "model": ("", "detector, an .onnx file; empty: none"),
    "folder": ("/var/lib/bevviz", "where the last seconds are saved"),
    "namespace": ("/", "of the robot"),
}


def generate_launch_description() -> LaunchDescription:
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
