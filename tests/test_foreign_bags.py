"""Bags as others write them: definitions in IDL."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

import bevviz
from bevviz.ros.encode import encode_points

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
