"""The registry of decoders: bags and live graphs read the same, and packages add their own."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from bevviz.drivers.compressed_clouds import COMPRESSED
from bevviz.errors import UserError
from bevviz.live.live_message import LiveMessage
from bevviz.messages.decoders import BUILT_IN, declared_decoder, decoders, find_decoder
from bevviz.messages.topics import Topic
from bevviz.support.extensions import registered
from tests.support import bags, compressed_clouds, livox_messages, videos
from tests.support.decoded_messages import assert_same, both

ROOT = Path(__file__).parents[1]
# The decoder and the entry point that the documentation shows.
EXAMPLE = re.search(
    r"### Messages of another driver.*?```python\n(.*?)```.*?```toml\n(.*?)```",
    (ROOT / "docs" / "inputs.md").read_text(),
    re.DOTALL,
)


def test_bags_and_live_decode_livox_alike(tmp_path: Path) -> None:
    package = "livox_ros_driver2"
    made = livox_messages.messages(False, package)
    content = livox_messages.scan(made, package, bags.START)
    in_bag, live = both(tmp_path / "bag", bags.Item("/l", f"{package}/msg/CustomMsg", 1, content), made)
    assert len(in_bag.xyz) + in_bag.dropped == 50
    assert_same(in_bag, live)


@pytest.mark.parametrize("form", ["zstd", "zlib"])
def test_bags_and_live_decode_compressed_clouds_alike(tmp_path: Path, form: str) -> None:
    made = compressed_clouds.messages()
    cloud = made.cloud(bags.START, compressed_clouds.points(0))
    data = compressed_clouds.packed(form, bytes(cloud.data))
    content = compressed_clouds.compressed(made, cloud, form, data)
    in_bag, live = both(tmp_path / "bag", bags.Item("/c", COMPRESSED, 1, content), made)
    assert len(in_bag.xyz) + in_bag.dropped == 500
    assert_same(in_bag, live)


@pytest.mark.parametrize("kind", list(videos.DEFINITIONS))
def test_bags_and_live_decode_video_alike(tmp_path: Path, kind: str) -> None:
    made = videos.messages()
    item = bags.Item("/v", kind, 1, videos.message(made, kind, bags.START, b"\0\0\0\1\x67"))
    in_bag, live = both(tmp_path / "bag", item, made)
    assert bytes(in_bag.data) == b"\0\0\0\1\x67"
    assert_same(in_bag, live)
    assert Topic("/v", kind).kind == "CompressedVideo"


def test_a_foxglove_cloud_is_a_point_cloud_in_live_as_in_bags(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, kind = bags.Messages(), "foxglove_msgs/msg/PointCloud"
    field = "foxglove_msgs/msg/PackedElementField"
    made.store.register(
        get_types_from_msg("string name\nuint32 offset\nuint8 type\n", field)
        | get_types_from_msg(
            "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\n"
            "uint32 point_stride\nPackedElementField[] fields\nuint8[] data\n",
            kind,
        )
    )
    header = made.header(bags.START, "lidar")
    point = made.make("geometry_msgs/msg/Point", x=1.0, y=0.0, z=0.0)
    turn = made.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    content = made.make(
        kind,
        timestamp=header.stamp,
        frame_id="lidar",
        pose=made.make("geometry_msgs/msg/Pose", position=point, orientation=turn),
        point_stride=12,
        fields=[made.make(field, name=name, offset=4 * i, type=7) for i, name in enumerate("xyz")],
        data=np.ones((5, 3), np.float32).view(np.uint8).reshape(-1),
    )
    monkeypatch.setattr("bevviz.live.live_message.store_of", lambda name: made.store)
    in_bag, live = both(tmp_path / "bag", bags.Item("/f", kind, 1, content), made)
    np.testing.assert_array_equal(in_bag.xyz, [[2, 1, 1]] * 5)  # moved by 1 m along x
    assert_same(in_bag, live)


def forget() -> None:
    """Forget the decoders that are loaded."""
    registered.cache_clear()
    decoders.cache_clear()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Install the package with a decoder that the documentation shows."""
    assert EXAMPLE is not None
    code, project = EXAMPLE.groups()
    ((name, target),) = tomllib.loads(project)["project"]["entry-points"]["bevviz.decoders"].items()
    metadata = tmp_path / "my_lidar-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: my_lidar\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[bevviz.decoders]\n{name} = {target}\n")
    (tmp_path / "my_lidar_decoder.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    forget()
    yield tmp_path
    monkeypatch.undo()
    forget()


def test_a_decoder_of_a_package_reads_its_messages(package: Path) -> None:
    kind = "my_lidar_msgs/msg/Sweep"
    decoder = find_decoder("my_lidar_msgs/Sweep")
    assert decoder is not None and decoder.kind == Topic("/sweep", kind).kind == "PointCloud2"
    data = bytes([0, 1, 0, 0]) + np.arange(1, 7, dtype="<f4").tobytes()
    cloud = LiveMessage("/sweep", kind, 0, data).decode()
    np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3], [4, 5, 6]])
    assert (cloud.stamp, cloud.frame_id) == (7, "my_lidar")
    assert list(decoders())[-1] == kind  # ours come first


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("import nothing_of_this_name", "cannot be loaded: ModuleNotFoundError: No module named"),
        ("DECODER = 5", "is a int, not a bevviz.messages.decoders.Decoder"),
    ],
)
def test_a_broken_decoder_of_a_package_is_one_line(package: Path, source: str, said: str) -> None:
    (package / "broken_decoder.py").write_text(source)
    points = package / "my_lidar-1.0.dist-info" / "entry_points.txt"
    points.write_text("[bevviz.decoders]\nmine = broken_decoder:DECODER\n")
    sys.modules.pop("broken_decoder", None)
    with pytest.raises(UserError, match=rf"^the decoder 'mine' \(broken_decoder:DECODER\) .*{said}"):
        find_decoder("my_lidar_msgs/msg/Sweep")


def test_every_decoder_of_bevviz_is_in_the_registry() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    listed = {*BUILT_IN, *project["entry-points"]["bevviz.decoders"].values()}
    written = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "bevviz").rglob("*.py")
        if any(line.startswith(("DECODER = ", "DECODERS = ")) for line in path.read_text().splitlines())
    }
    assert {name.partition(":")[0] for name in listed} == written
    assert declared_decoder("ouster_ros/PacketMsg") is declared_decoder("ouster_sensor_msgs/msg/PacketMsg")
    assert find_decoder("sensor_msgs/msg/PointCloud2") is None


def test_no_module_of_messages_imports_a_driver() -> None:
    for path in (ROOT / "bevviz" / "messages").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [name.name for name in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.startswith("bevviz.drivers") for name in names), path
