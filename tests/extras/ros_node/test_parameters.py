"""Parameters and the service of the node, as another node uses them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.config import load, parameters
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.extras.ros_node.parameters import RosRequests
from bevviz.live.node import Node
from tests.support.ros_graphs import own_graph


@pytest.fixture(autouse=True)
def domain() -> Iterator[None]:
    with own_graph():
        yield


def test_parameters_set_the_configuration() -> None:
    from rclpy.parameter import Parameter
    from std_srvs.srv import Trigger

    ordered: list[str] = []

    class OrderedConfig(ReloadableConfig):
        def take(self, more: Sequence[str] = (), without: Sequence[str] = ()) -> None:
            super().take(more, without)
            ordered.extend(more)

    settings = OrderedConfig(preset="reference")

    def show(*more: str) -> None:
        """Put another configuration in force, as a page does."""
        settings.config = load(settings=more, preset="reference")
        orders.show(settings.config)

    full = False

    def save() -> Path:
        if full:
            raise UserError("no space left in /tmp")
        return Path("/tmp/robot.rrd")

    with Node() as session:
        node = session.node
        orders = RosRequests(node, settings, save)

        def set_to(name: str, value: Any) -> Any:
            return node.set_parameters([Parameter(name, value=value)])[0]

        assert node.get_parameter("range_x").value == 10.0
        assert set_to("range_x", 25).successful  # an integer, as `ros2 param set` makes of it
        assert set_to("max_cluster_size", 500).successful
        assert settings.config.clustering.max_cluster_points == 500
        orders.show(settings.config)
        assert set_to("max_cluster_size", 0).successful
        assert settings.config.clustering.max_cluster_points is None
        assert ordered == [
            "bev.range_x=25",
            "clustering.max_cluster_points=500",
            "clustering.max_cluster_points=null",
        ]
        refused = set_to("voxel_size", -1.0)
        assert not refused.successful and "voxel_size out of range" in refused.reason
        (allowed,) = node.describe_parameter("clustering.eps").floating_point_range
        assert 0 == allowed.from_value < allowed.to_value < 1000
        assert node.get_parameter("voxel_size").value == 0.05

        show("voxel_size=0.2")
        assert node.get_parameter("voxel_size").value == 0.2
        assert len(ordered) == 3, "what is shown is no order"

        del ordered[:]
        values = {
            "clustering.eps": "60 cm",
            "live.max_rate": 5,
            "live.triggers": ["tf", "stage"],
            "source.lidar_topics": "[/points]",
            "sync.motion_compensation": True,
        }
        assert all(set_to(name, value).successful for name, value in values.items())
        assert ordered == [
            "clustering.eps=60 cm",
            "live.max_rate=5",
            'live.triggers=["tf", "stage"]',
            "source.lidar_topics=[/points]",
            "sync.motion_compensation=true",
        ]
        show("live.max_rate=5")
        assert set_to("live.max_rate", "").successful and ordered[-1] == "live.max_rate=null"
        assert not set_to("live.triggers", ["typhoon"]).successful
        assert {name for name in parameters() if not node.has_parameter(name)} == set()

        answer = orders._trigger(Trigger.Request(), Trigger.Response())
        assert (answer.success, answer.message) == (True, "/tmp/robot.rrd")
        full = True
        answer = orders._trigger(Trigger.Request(), Trigger.Response())
        assert (answer.success, answer.message) == (False, "no space left in /tmp")


def test_parameters_of_the_command_line() -> None:
    settings = ReloadableConfig()
    arguments = ["-p", "range_y:=12.5", "-r", "__node:=eye", "-r", "__ns:=/robot1"]
    with Node(arguments) as session:
        RosRequests(session.node, settings)
        assert session.node.get_fully_qualified_name() == "/robot1/eye"
        assert session.resolve("points") == "/robot1/points"
    assert settings.config.bev.range_y == 12.5
