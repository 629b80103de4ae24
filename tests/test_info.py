"""What ``bevviz info`` says of a bag."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.checks import InputChecks
from bevviz.cli import main
from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.pipeline.bag_info import WIDTH, BagInfo, describe_bag, render_bag_contents, render_bag_info
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.support.onnx_files import DEMO_MODEL
from tests.support import bags
from tests.support.small_bags import frozen_after


def write(path: Path, *without: str, form: str = "mcap") -> Path:
    messages = bags.Messages(form == "ros1")
    items = [i for i in bags.small_items(messages) if i.topic not in without]
    return bags.write(path, items, messages, form=form)


@pytest.mark.parametrize(("form", "name"), [("mcap", "MCAP"), ("sqlite3", "sqlite3"), ("ros1", "ROS 1 bag")])
def test_a_whole_bag_is_described(tmp_path: Path, form: str, name: str) -> None:
    path = write(tmp_path / "drive.bag", form=form)
    info = describe_bag([path], load(settings=["detector.model=demo"]))
    assert info.formats == (name,)
    assert info.messages == 121
    assert info.duration == pytest.approx(2.91)
    files = [path] if path.is_file() else [f for f in path.iterdir() if f.name != "metadata.yaml"]
    assert info.size == sum(f.stat().st_size for f in files)
    assert [t.name for t in info.topics] == [bags.INFO, bags.IMAGE, "/tf", "/tf_static", bags.CLOUD]
    cloud = info.topics[-1]
    assert (cloud.type, cloud.count, cloud.frame_id) == ("sensor_msgs/msg/PointCloud2", 30, "velodyne")
    assert cloud.rate == pytest.approx(10)
    assert cloud.pause == pytest.approx(0.1)
    assert cloud.role.startswith("LiDAR")
    assert info.topics[3].rate is None
    assert info.lidars == ("velodyne",)
    (camera,) = info.cameras
    assert camera.name == "camera"
    assert info.transforms == {"base_link": "odom", "velodyne": "base_link", "camera_optical": "velodyne"}
    assert info.world_frame == "odom"
    assert info.missing == info.warnings == ()
    text = render_bag_info(info)
    assert "2.91 s from 2023-11-14T22:13:20.000Z, 121 messages" in text
    assert (
        "camera: 64 x 48 uncompressed, fx 60.0 fy 60.0 cx 32.0 cy 24.0, no distortion, placed by TF" in text
    )
    assert "  odom\n    base_link\n      velodyne\n        camera_optical\n" in text
    assert "missing for a full run\n  nothing" in text


def test_gaps_are_found_in_the_index(tmp_path: Path) -> None:
    items = [
        i
        for i in bags.small_items()
        if i.topic != bags.CLOUD or not 1.0 <= (i.received - bags.START) / 1e9 < 1.5
    ]
    for form in ("mcap", "sqlite3"):
        info = describe_bag([bags.write(tmp_path / form, items, form=form)], Config())
        (cloud,) = (t for t in info.topics if t.name == bags.CLOUD)
        assert cloud.count == 25
        assert cloud.pause == pytest.approx(0.6)
        assert cloud.pause_at == pytest.approx(0.91)
        assert "0.60 s at 0.9 s" in render_bag_info(info)


def test_missing_inputs_name_their_options(tmp_path: Path) -> None:
    path = write(tmp_path / "drive", "/tf_static", "/tf", bags.INFO)
    text = render_bag_info(describe_bag([path], Config()))
    assert "camera 'camera' has no CameraInfo, and no topic of that kind is free: record it" in text
    assert "--set source.extrinsics='{velodyne camera_optical: [x, y, z, qx, qy, qz, qw]}'" in text
    assert "--set source.fixed_frame=name" in text
    assert "--model FILE.onnx" in text
    assert all(len(line) <= WIDTH for line in text.splitlines())


def test_the_option_that_is_offered_is_accepted(tmp_path: Path) -> None:
    path = write(tmp_path / "drive", "/tf_static")
    config = load(settings=["source.extrinsics={velodyne camera_optical: [0, 0, 0, -0.5, 0.5, -0.5, 0.5]}"])
    (camera,) = describe_bag([path], config).cameras
    assert camera.camera_from_points is not None
    assert "not placed" not in render_bag_info(describe_bag([path], config))


def test_the_camera_info_that_is_offered_is_there_and_accepted(tmp_path: Path) -> None:
    def moved(item: bags.Item) -> bags.Item:
        if item.topic != bags.INFO:
            return item
        header = replace(item.message.header, frame_id="lens")
        return item._replace(topic="/calibration/lens", message=replace(item.message, header=header))

    path = bags.write(tmp_path / "drive", map(moved, bags.small_items()))
    offered = "source.camera_info_topics='{/camera/image_rect_color: /calibration/lens}'"
    assert f"--set {offered}" in render_bag_info(describe_bag([path], Config()))
    config = load(settings=[offered.replace("'", "")])
    assert describe_bag([path], config).missing == ("no detector: --model FILE.onnx",)


def test_an_uncalibrated_camera_needs_no_other_topic(tmp_path: Path) -> None:
    """What lacks is said, and nothing that would not help: 'bag' has the same words."""

    def zero(item: bags.Item) -> bags.Item:
        k, p = np.zeros(9), np.zeros(12)
        return item if item.topic != bags.INFO else item._replace(message=replace(item.message, k=k, p=p))

    path = bags.write(tmp_path / "drive", map(zero, bags.small_items(scans=4)))
    said = f"{bags.INFO}: the camera is uncalibrated (K is zero or not finite); calibrate it"
    info = describe_bag([path], Config())
    assert info.missing == (f"camera 'camera': {said}", "no detector: --model FILE.onnx")
    with BagSource([path], Config()) as source:
        frames = list(source)
        assert [f.cameras[0].problems for f in frames] == [(said,)] * 4
        assert not [text for text in source.warnings if "record" in text]


def test_without_frame_ids_no_extrinsics_are_asked_for(tmp_path: Path) -> None:
    """They have two names, one of which would be empty."""

    def nameless(topic: str, *others: str) -> str:
        items = []
        for item in bags.small_items(scans=3):
            if item.topic in (topic, *others):
                header = replace(item.message.header, frame_id="")
                item = item._replace(message=replace(item.message, header=header))
            items.append(item)
        return " ".join(
            describe_bag([bags.write(tmp_path / f"{topic[1:7]}{len(others)}", items)], Config()).missing
        )

    for topic, what in ((bags.CLOUD, "the points state"), (bags.IMAGE, "its images state")):
        missing = nameless(topic, *([bags.INFO] if topic == bags.IMAGE else []))
        named = f"--set source.frames='{{{topic}: name}}'"
        assert f"camera 'camera' is not placed: {what} no frame_id, name it: {named}" in missing
        assert "source.extrinsics" not in missing and "source.fixed_frame" not in missing
    assert "not placed" not in nameless(bags.IMAGE), "the CameraInfo states the frame"


def test_a_bag_without_a_lidar_is_described_all_the_same(tmp_path: Path) -> None:
    info = describe_bag([write(tmp_path / "drive", bags.CLOUD)], Config())
    assert [t.name for t in info.topics] == [bags.INFO, bags.IMAGE, "/tf", "/tf_static"]
    assert info.missing[0].startswith("no LiDAR: none of 4 topics is a sensor_msgs/PointCloud2; there")
    assert "no LiDAR" in render_bag_info(info)


def test_a_cut_bag_is_described_with_the_loss(tmp_path: Path) -> None:
    (path,) = write(tmp_path / "drive").glob("*.mcap")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    text = render_bag_info(describe_bag([path], Config()))
    assert "warnings\n" in text
    assert "the file ends early (no footer): what is there was rescued" in text
    assert re.search(r"read \d+ messages, \d+ of them from the incomplete last", " ".join(text.split()))


def test_a_frozen_camera_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(frozen_after(2.0, tmp_path / "drive"))
    assert main(["info", path]) == 0
    assert "warnings\n  camera camera: frozen image since 2.0 s\n" in capsys.readouterr().out
    assert main(["info", path, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == ["camera camera: frozen image since 2.0 s"]


def test_the_whole_drive_is_checked_on_request(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(frozen_after(11.0, tmp_path / "drive"))
    assert main(["info", path]) == 0
    assert "warnings" not in capsys.readouterr().out
    assert main(["info", path, "--sensors"]) == 0
    assert "warnings\n  camera camera: frozen image since 11.0 s\n" in capsys.readouterr().out
    assert main(["info", "--live", "--sensors"]) != 0


def test_the_contents_come_before_the_sensors_are_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long drive is described at once."""
    checked: list[int] = []
    monkeypatch.setattr(
        InputChecks, "observe_frame", lambda checks, frame, follows: checked.append(frame.index)
    )
    told: list[BagInfo] = []

    def tell(info: BagInfo) -> None:
        assert not checked
        told.append(info)

    info = describe_bag([frozen_after(2.0, tmp_path / "drive")], Config(), on_contents=tell)
    assert len(checked) > 5 and checked == list(range(len(checked)))
    assert render_bag_info(info).startswith(render_bag_contents(told[0]))


def test_unrelated_single_frames_are_not_compared(shared: Path) -> None:
    assert not any("since" in line for line in describe_bag([shared / "kitti"], Config()).warnings)


def test_a_real_drive_has_no_fault(shared: Path) -> None:
    info = describe_bag([shared / "kitti_drive"], Config(), all_frames=True)
    assert not any("since" in line for line in info.warnings)


def test_a_file_that_is_no_bag_is_reported(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file or folder"):
        describe_bag([tmp_path / "nowhere"], Config())
    with pytest.raises(UserError, match=r"source\.lidar_topics: there is no topic /x"):
        describe_bag([write(tmp_path / "drive")], load(settings=["source.lidar_topics=[/x]"]))


def test_a_kitti_bag_is_described(shared: Path, tmp_path: Path) -> None:
    info = describe_bag([bags.write(tmp_path / "kitti", bags.kitti_items(shared))], Config())
    text = render_bag_info(info)
    assert "camera: 1242 x 375 image/png, fx 721.5" in text
    assert "velodyne\n    camera_optical" in text
    assert "fixed frame of 'velodyne': none" in text


def test_unusable_networks_are_listed_as_missing(tmp_path: Path) -> None:
    """The detector's and the objects' alike: not there, no network, another kind of network."""
    path, text = write(tmp_path / "drive"), tmp_path / "text.onnx"
    text.write_text("hello")
    params = ["objects.point_range=[0, -8, -3, 24, 8, 1]", "objects.voxel_size=[1, 1, 4]"]
    params += ["objects.features=[x, y, z, intensity]", "objects.classes=[Car]"]
    for file, reason in ((tmp_path / "none.onnx", "o such file"), (text, "onnxruntime cannot load it")):
        info = describe_bag(
            [path], load(settings=[f"objects.method={file}", *params, f"detector.model={file}"])
        )
        detector, objects = info.missing
        assert detector.startswith(f"detector.model {file}: ") and objects.startswith(
            f"objects.method {file}: "
        )
        assert reason in objects and info.object_network == objects
        with pytest.raises(UserError, match=re.escape(objects)):  # as a run says before its first frame
            StageLoader().load(load(settings=[f"objects.method={file}", *params]))
    info = describe_bag(
        [path], load(settings=[f"objects.method={DEMO_MODEL}", *params, "detector.model=demo"])
    )
    [foreign] = info.missing
    assert "a network on pillars takes pillars [N, points, features]" in foreign
    assert "3D detector runs on" in render_bag_info(info)


def test_a_3d_detector_lacks_its_file_before_its_parameters(tmp_path: Path) -> None:
    file = tmp_path / "net.onnx"
    with pytest.raises(UserError, match=r"^--set objects\.method=.*net\.onnx: no such file$"):
        load(settings=[f"objects.method={file}"])
    file.touch()
    with pytest.raises(UserError, match=r"net\.onnx: it needs objects\.params\.point_range, in a YAML"):
        load(settings=[f"objects.method={file}"])


@pytest.mark.parametrize(("without", "noun"), [("", "scan"), (bags.CLOUD, "image")])
def test_lost_stamps_are_missing_and_named_by_receipt(tmp_path: Path, without: str, noun: str) -> None:
    def stopped(item: bags.Item) -> bags.Item:
        if item.topic.startswith("/tf"):
            return item
        stamp = bags.Messages().header(bags.START, "").stamp
        return item._replace(message=replace(item.message, header=replace(item.message.header, stamp=stamp)))

    items = [stopped(item) for item in bags.small_items(scans=6) if item.topic != without]
    path = bags.write(tmp_path / "drive", items)
    lost = f"a run drops 5 of the first 6 {noun}s, whose stamps repeat or go back: --set sync.by=received"
    assert lost in describe_bag([path], Config()).missing
    with BagSource([path], Config()) as source:
        assert len(list(source)) == 1
        noun = "cloud" if noun == "scan" else noun
        dropped = f"5 {noun}s had the stamp of another one and were dropped; --set sync.by=received goes by"
        assert any(text.startswith(dropped) for text in source.warnings)
    by_receipt = load(settings=["sync.by=received"])
    assert not any("drops" in text for text in describe_bag([path], by_receipt).missing)
    with BagSource([path], by_receipt) as source:
        assert len(list(source)) == 6
