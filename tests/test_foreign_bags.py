"""Bags as others write them: definitions in IDL, no index."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer
from rosbags.typesys import Stores, get_typestore

import bevviz
from bevviz.ros.encode import encode_points
from tests import bags

LINE = "=" * 80 + "\n"
IDL = {  # as rosidl generates it from .msg files, and rosbag2 stores it
    "sensor_msgs/msg/PointCloud2": """// generated from rosidl_adapter/resource/msg.idl.em
#include "sensor_msgs/msg/PointField.idl"
#include "std_msgs/msg/Header.idl"

module sensor_msgs {
  module msg {
    @verbatim (language="comment", text=
      "A collection of N-dimensional points.")
    struct PointCloud2 {
      std_msgs::msg::Header header;
      uint32 height;
      uint32 width;
      sequence<sensor_msgs::msg::PointField> fields;
      boolean is_bigendian;
      uint32 point_step;
      uint32 row_step;
      sequence<uint8> data;
      boolean is_dense;
    };
  };
};
""",
    "sensor_msgs/msg/PointField": """module sensor_msgs {
  module msg {
    module PointField_Constants {
      const uint8 FLOAT32 = 7;
    };
    struct PointField {
      string name;
      uint32 offset;
      uint8 datatype;
      uint32 count;
    };
  };
};
""",
    "std_msgs/msg/Header": """#include "builtin_interfaces/msg/Time.idl"
module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
""",
    "builtin_interfaces/msg/Time": """module builtin_interfaces { module msg {
  struct Time { int32 sec; uint32 nanosec; };
}; };
""",
}


@pytest.mark.parametrize("encoding", ["ros2idl", "omgidl"])
def test_definitions_in_idl_are_taken(encoding: str, tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).normal(0, 10, (200, 3)).astype(np.float32)
    points = xyz.view([(name, "<f4") for name in "xyz"]).reshape(-1)
    stamp = 1_700_000_000_000_000_000
    data = get_typestore(Stores.ROS2_JAZZY).serialize_cdr(
        encode_points(stamp, "lidar", points), "sensor_msgs/msg/PointCloud2"
    )
    text = "".join(f"{LINE}IDL: {name}\n{body}" for name, body in IDL.items())
    with (tmp_path / "drive.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("sensor_msgs/msg/PointCloud2", encoding, text.encode())
        channel = writer.register_channel("/points", "cdr", schema)
        writer.add_message(channel, stamp, bytes(data), stamp)
        writer.finish()  # type: ignore[no-untyped-call]
    with bevviz.open(tmp_path / "drive.mcap") as drive:
        (frame,) = drive.frames
        np.testing.assert_array_equal(frame.points, xyz)
        assert not [warning for warning in drive.warnings if "not usable" in warning]


BARE = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}


@pytest.mark.parametrize(
    ("left_out", "said"),
    [
        (BARE, "it has no index"),  # as rosbag2's preset ``fastwrite``
        ({"use_statistics": False}, "it has no statistics"),
        ({}, "it has no index of chunks"),
    ],
)
def test_without_an_index_it_is_read_from_end_to_end(
    left_out: dict[str, Any], said: str, tmp_path: Path
) -> None:
    bag = bags.write(tmp_path / "sound", bags.small_items(scans=3))
    (sound,) = bag.glob("*.mcap")
    with sound.open("rb") as source, (tmp_path / "fast.mcap").open("wb") as file:
        writer = Writer(file, use_chunking=False, **left_out)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if schema is not None and channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]
    with bevviz.open(tmp_path / "fast.mcap") as drive, bevviz.open(sound) as same:
        for frame, other in zip(drive.frames, same.frames, strict=True):
            np.testing.assert_array_equal(frame.points, other.points)
        told = [warning for warning in drive.warnings if warning not in same.warnings]
        assert f": {said}" in told[0] and told[0].endswith(": it is read from end to end")
        assert not [warning for warning in told if "rescued" in warning or "lost" in warning]
