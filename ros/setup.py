"""Package of a ROS 2 workspace: the launch file, its configuration, and the command ``ros2 bevviz``."""

from setuptools import setup

setup(
    name="bevviz-ros",  # not bevviz: this one may lie on the path before the program's own package
    version="0.0.0",
    packages=["bevviz_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/bevviz"]),
        ("share/bevviz", ["package.xml"]),
        ("share/bevviz/launch", ["launch/live.launch.py"]),
        ("share/bevviz/config", ["config/robot.yaml", "config/bevviz.service", "config/fastdds.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    entry_points={"ros2cli.command": ["bevviz = bevviz_ros.command:BevvizCommand"]},
)
