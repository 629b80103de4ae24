"""Redaction: what is hidden in every file of a report, what stays, and that the check still holds."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bevviz.bags.bag import Recording as Bag
from bevviz.cli import main
from bevviz.config import DetectorConfig
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.messages.decoders import MessageError
from bevviz.messages.images import decode_compressed_image, decode_image
from bevviz.model.frame import F32, U8
from bevviz.report.pictures import shrink
from bevviz.report.redact import CELLS, ImageFinder, Redactor, _encoded, grow_boxes, hide_boxes
from bevviz.report.summary import STRIP_WIDTH
from tests.support import bags, videos
from tests.support.commands import Capture, error_of
from tests.support.recordings import Recording, verify

PNG, RAW, JPEG = "/camera/image_rect_color/compressed", "/annotated", "/other/compressed"
PERSON = np.array([712, 143, 811, 308])  # the pedestrian of KITTI 000000


def unfold(bag: Path) -> dict[str, list[U8]]:
    """Return the images of a bag by topic."""
    found: dict[str, list[U8]] = {}
    with Bag([bag]) as recording:
        for m in recording.messages([PNG, RAW, JPEG]):
            decode = decode_image if m.topic == RAW else decode_compressed_image
            found.setdefault(m.topic, []).append(decode(recording.decode(m), m.topic, m.received).bgr)
    return found


@pytest.fixture(scope="module")
def drive(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One KITTI frame, its picture on three topics, and what cannot be looked into."""
    messages, stamp = bags.Messages(), bags.START
    items = bags.kitti_items(shared, messages, ["000000"], step=4)
    png = bags.kitti(shared, "000000").png
    bgr: Any = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    jpeg = cv2.imencode(".jpg", bgr)[1].tobytes()
    image = "sensor_msgs/msg/Image"
    colored = messages.cloud(stamp, np.zeros((3, 4), np.float32))
    colored.fields[3].name = "rgb"
    depth = messages.image(stamp, bgr[:4, :4])
    depth.encoding = "32FC1"
    return bags.write(
        tmp_path_factory.mktemp("redact") / "drive",
        [
            *items,
            bags.Item(RAW, image, stamp, messages.image(stamp, bgr)),
            bags.Item(
                JPEG, "sensor_msgs/msg/CompressedImage", stamp, messages.compressed(stamp, jpeg, "jpeg")
            ),
            bags.Item("/depth", image, stamp, depth),
            bags.Item("/video", "stereo_msgs/msg/DisparityImage", stamp, b"\0" * 64),
            bags.Item("/depth/points", "sensor_msgs/msg/PointCloud2", stamp, colored),
        ],
        messages,
    )


@pytest.fixture(scope="module")
def report(drive: Path, shared: Path) -> Path:
    out = drive.parent / "bug.rrd"
    call = ["report", drive, "--at", "0", "-o", out, "--model", shared / "models" / "yolox_nano.onnx"]
    assert main([*map(str, call), "--redact", "--set", f"source.camera_topics=[{PNG}]"]) == 0
    return out


def is_hidden(bgr: U8, noise: int = 3) -> bool:
    """Whether the middle of the pedestrian is a few flat cells, but for what a codec makes of them."""
    x0, y0, x1, y1 = PERSON
    inner = bgr[y0 + 10 : y1 - 10, x0 + 10 : x1 - 10]
    rows = np.abs(np.diff(inner.astype(int), axis=0)).max(axis=(1, 2)) > noise
    return int(np.count_nonzero(rows)) <= CELLS


def test_people_are_hidden_in_images_of_the_bag(drive: Path, report: Path) -> None:
    before, after = unfold(drive), unfold(report.with_suffix(".mcap"))
    assert after.keys() == before.keys() == {PNG, RAW, JPEG}
    assert not is_hidden(before[RAW][0])
    for topic in (PNG, RAW):
        assert is_hidden(after[topic][0])
    np.testing.assert_array_equal(after[PNG][0], after[RAW][0])  # both without loss
    # JPEG is encoded anew: hidden all the same, next to unchanged elsewhere.
    changed = np.abs(after[JPEG][0].astype(int) - before[JPEG][0]).max(axis=2)
    outside = (after[RAW][0] == before[RAW][0]).all(axis=2)
    assert np.percentile(changed[cv2.erode(outside.astype(np.uint8), np.ones((17, 17))) > 0], 99) <= 12
    assert 0.05 < 1 - outside.mean() < 0.5


def test_everything_else_of_the_bag_is_untouched(drive: Path, report: Path, capsys: Capture) -> None:
    with Bag([drive]) as old, Bag([report.with_suffix(".mcap")]) as new:
        there = {t.name for t in old.topics}
        here = {t.name for t in new.topics}
        assert there - here == {"/depth", "/video", "/depth/points"}
        topics = sorted(here - {PNG, RAW, JPEG})
        contents = [[(m.topic, bytes(m.content())) for m in b.messages(topics)] for b in (old, new)]
    assert contents[0] == contents[1]
    about = json.loads(Recording(report).static["/__properties/report"]["about"][0])
    told = " ".join(about["warnings"])
    for reason in (
        "/depth left out: image encoding '32FC1'",
        "/video left out",
        "colours of a picture",
    ):
        assert reason in told


def test_people_are_hidden_in_recording_and_page(drive: Path, report: Path) -> None:
    verify(report)
    redacted, whole = unfold(report.with_suffix(".mcap"))[PNG][0], unfold(drive)[PNG][0]
    blobs = Recording(report).column("/world/camera/image", "EncodedImage:blob")
    assert len(blobs) == 1
    logged: Any = cv2.imdecode(np.array(blobs[0][0], np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(logged, redacted)

    text = report.with_suffix(".html").read_text()
    pictures: list[Any] = [
        cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        for data in re.findall(r"base64,([^\"]+)", text)
    ]
    ratio = whole.shape[1] / whole.shape[0]
    shown = [p for p in pictures if abs(p.shape[1] / p.shape[0] - ratio) < 0.1]
    assert len(shown) == 2  # the scene and the strip
    x0, y0, x1, y1 = np.round(PERSON * STRIP_WIDTH / whole.shape[1]).astype(int)
    inner = np.s_[y0 + 4 : y1 - 4, x0 + 4 : x1 - 4]
    for picture in shown:
        small = shrink(picture, STRIP_WIDTH)[0][inner].astype(int)
        to_redacted = np.abs(small - shrink(redacted, STRIP_WIDTH)[0][inner]).mean()
        to_whole = np.abs(small - shrink(whole, STRIP_WIDTH)[0][inner]).mean()
        assert to_redacted < 0.6 * to_whole


def test_detections_are_those_of_the_whole_images(report: Path, capsys: Capture) -> None:
    labels = Recording(report).column("/world/camera/image/detections", "Boxes2D:labels")
    assert labels[0][0].startswith("person 0.8")
    assert main(["report", "--check", str(report)]) == 0
    said = capsys.readouterr().out
    assert "1 frames: the same in every bit" in said
    assert "detections are taken from the report" in said


def test_a_check_still_sees_a_change(report: Path, capsys: Capture) -> None:
    assert main(["report", "--check", str(report), "--set", "fusion.min_iou=0.99"]) == 1
    assert "in 'fusion camera'" in capsys.readouterr().out


def test_redaction_needs_a_detector_of_people(drive: Path, tmp_path: Path, capsys: Capture) -> None:
    output = str(tmp_path / "bug.rrd")
    call = ["report", str(drive), "--at", "0", "-o", output, "--redact"]
    assert "--redact needs a detector" in error_of(capsys, *call)
    names = tmp_path / "names.txt"
    names.write_text("cat\ncar\ndog\n")
    call += ["--model", "demo", "--set", f"detector.names={names}"]
    assert "finds no people, but cat, car, dog" in error_of(capsys, *call)
    assert [p.name for p in tmp_path.iterdir()] == ["names.txt"]


def test_class_filters_do_not_limit_redaction(drive: Path, shared: Path) -> None:
    """Neither a high threshold nor a choice of classes keeps anybody visible."""
    config = DetectorConfig(
        model=str(shared / "models" / "yolox_nano.onnx"),
        classes=("dog",),
        conf_threshold=0.99,
        explain_threshold=0.99,
        max_candidates=1,
    )
    with Bag([drive]) as recording:
        redactor = Redactor(config, recording)
    boxes = redactor.find(unfold(drive)[PNG][0])
    assert np.abs(boxes - PERSON).max(axis=1).min() < 15
    assert len(boxes) > 5


@pytest.mark.parametrize("limit", [1, 100])
@pytest.mark.parametrize("overlap", [0.01, 0.99])
def test_every_candidate_is_redacted_whatever_is_configured(
    limit: int, overlap: float, tmp_path: Path
) -> None:
    """126 people on top of each other, each a little weaker: all but a few are suppressed."""
    pytest.importorskip("onnx", reason="the test networks are built with onnx")
    from tests.support.onnx_networks import CELLS as PEOPLE
    from tests.support.onnx_networks import H, W, constant, head

    rng = np.random.default_rng(0)
    corner = rng.uniform(0, 8, (PEOPLE, 2))
    boxes = np.hstack([corner, corner + np.array([30, 40])])
    scores = np.linspace(0.9, 0.02, PEOPLE)
    names = {"names": "['person', 'car', 'dog']"}
    output = head("YOLOv8", boxes, scores, np.zeros(PEOPLE, int))
    config = DetectorConfig(
        model=constant(tmp_path / "crowd.onnx", output, metadata=names),
        threads=1,
        max_candidates=limit,
        iou_threshold=overlap,
    )
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=1))
    with Bag([bag]) as recording:
        found = Redactor(config, recording).find(np.zeros((H, W, 3), np.uint8))
    assert len(found) == PEOPLE


def test_boxes_outside_the_image_hide_nobody_in_it(tmp_path: Path) -> None:
    """A stronger box that nobody sees would suppress one that somebody does."""
    pytest.importorskip("onnx", reason="the test networks are built with onnx")
    from tests.support.onnx_networks import H, W, constant, head

    boxes = np.array([[-50.0, 0, -1, 40], [-45, 0, 6, 40]])
    output = head("YOLOv8", boxes, np.array([0.9, 0.8]), np.array([0, 0]))
    names = {"names": "['person', 'car', 'dog']"}
    config = DetectorConfig(model=constant(tmp_path / "edge.onnx", output, metadata=names), threads=1)
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=1))
    with Bag([bag]) as recording:
        found = Redactor(config, recording).find(np.zeros((H, W, 3), np.uint8))
    np.testing.assert_allclose(found, [[-0.5, -0.5, 5.5, 39.5]], atol=1e-4)


@pytest.mark.parametrize("form", [".jpg", ".png", ".webp"])
def test_redacted_images_keep_their_encoding(form: str) -> None:
    magic = cv2.imencode(form, np.zeros((8, 8, 3), np.uint8))[1].tobytes()[:8]
    grey = np.full((16, 16, 3), 77, np.uint8)
    data = _encoded(grey, magic)
    assert data[:4].tobytes() == magic[:4]
    np.testing.assert_allclose(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), int), 77, atol=1)


# --- pictures inside other messages --------------------------------------------------------------

OLD_VISION = {
    "vision_msgs/msg/ObjectHypothesisWithPose": "string id\nfloat64 score\n"
    "geometry_msgs/PoseWithCovariance pose",
    "vision_msgs/msg/BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "vision_msgs/msg/Detection2D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\n"
    "BoundingBox2D bbox\nsensor_msgs/Image source_img",
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nDetection2D[] detections",
    "robot_msgs/msg/Snapshot": "std_msgs/Header header\nsensor_msgs/CompressedImage picture\nstring note",
    "robot_msgs/msg/State": "float64 speed",
}
SECRET = np.random.default_rng(7).integers(0, 256, 48, np.uint8).tobytes()  # within every picture
FRAMES = 3


def crowded_items(messages: bags.Messages) -> list[bags.Item]:
    """Return the synthetic drive together with other messages of a robot."""
    store = messages.store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for name, text in OLD_VISION.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    found: list[bags.Item] = []
    items = bags.small_items(messages, scans=FRAMES)
    drive = {bags.START + i * bags.PERIOD: f for i, f in enumerate(SyntheticSource(frames=FRAMES))}
    secret = np.frombuffer(SECRET, np.uint8).reshape(4, 4, 3)
    for item in items:
        if item.topic == bags.IMAGE:
            camera = drive[item.received].cameras[0]
            assert camera.image is not None
            item = item._replace(message=messages.image(item.received, camera.image.bgr))
        found.append(item)
    for stamp in drive:
        crop = messages.image(stamp, secret)
        box = messages.make(
            "vision_msgs/msg/BoundingBox2D",
            center=messages.make("geometry_msgs/msg/Pose2D", x=1.0, y=2.0, theta=0.0),
            size_x=3.0,
            size_y=4.0,
        )
        about = messages.header(stamp, "camera")
        one = messages.make(
            "vision_msgs/msg/Detection2D", header=about, results=[], bbox=box, source_img=crop
        )
        both = messages.make("vision_msgs/msg/Detection2DArray", header=about, detections=[one, one])
        picture = messages.compressed(stamp, SECRET)
        snapshot = messages.make("robot_msgs/msg/Snapshot", header=about, picture=picture, note="a note")
        layout = messages.make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        array = "std_msgs/msg/UInt8MultiArray"
        large = messages.make(array, layout=layout, data=np.frombuffer(SECRET * 20, np.uint8))
        small = messages.make(array, layout=layout, data=np.zeros(3, np.uint8))
        state = messages.make("robot_msgs/msg/State", speed=2.0)
        found += [
            bags.Item("/crops", "vision_msgs/msg/Detection2DArray", stamp, both),
            bags.Item("/snapshot", "robot_msgs/msg/Snapshot", stamp, snapshot),
            bags.Item("/bytes", array, stamp, large),
            bags.Item("/key", array, stamp, small),
            bags.Item("/state", "robot_msgs/msg/State", stamp, state),
        ]
    return found


@pytest.fixture(scope="module")
def crowded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    messages = bags.Messages()
    items = crowded_items(messages)
    return bags.write(tmp_path_factory.mktemp("crowded") / "drive", items, messages)


def redacted_report(bag: Path, output: Path, *more: str) -> Path:
    call = ["report", str(bag), "--at", "0", "-o", str(output), "--redact", "--model", "demo", *more]
    assert main(call) == 0
    return output


def contents(bag: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with Bag([bag]) as recording:
        for message in recording.messages([topic.name for topic in recording.topics]):
            found.setdefault(message.topic, []).append(bytes(message.content()))
    return found


@pytest.mark.long
def test_pictures_inside_other_messages_are_redacted(crowded: Path, tmp_path: Path) -> None:
    report = redacted_report(crowded, tmp_path / "bug.rrd")
    before, after = contents(crowded), contents(report.with_suffix(".mcap"))
    assert all(any(SECRET in m for m in before[topic]) for topic in ("/crops", "/snapshot", "/bytes"))
    assert not any(SECRET in m for messages in after.values() for m in messages)
    assert before.keys() - after.keys() == {"/snapshot", "/bytes", "/state"}
    for topic in after.keys() - {"/crops", bags.IMAGE}:
        assert after[topic] == before[topic]
    with Bag([report.with_suffix(".mcap")]) as recording:
        message = recording.first("/crops")
        assert message is not None
        detections = recording.decode(message).detections  # the message itself stays
    assert [(d.bbox.size_x, len(d.source_img.data)) for d in detections] == [(3.0, 0), (3.0, 0)]
    told = " ".join(json.loads(Recording(report).static["/__properties/report"]["about"][0])["warnings"])
    for words in (
        f"{FRAMES} message(s) of /crops without the pictures in it (detections.source_img of",
        "/snapshot left out: bevviz does not know what a robot_msgs/msg/Snapshot shows",
        "/state left out",
        "/bytes left out: nobody can tell what the 960 values of 'data' show",
    ):
        assert words in told
    assert "/snapshot left out" in report.with_suffix(".html").read_text()


@pytest.mark.long
def test_an_image_of_the_synthetic_drive_is_hidden(crowded: Path, tmp_path: Path) -> None:
    report = redacted_report(crowded, tmp_path / "bug.rrd")
    with Bag([crowded]) as old, Bag([report.with_suffix(".mcap")]) as new:
        images = []
        for bag in (old, new):
            first = bag.first(bags.IMAGE)
            assert first is not None
            images.append(decode_image(bag.decode(first), first.topic, 0).bgr)
        redactor = Redactor(DetectorConfig(model="demo"), old)
    changed = (images[0] != images[1]).any(axis=2)
    places = grow_boxes(redactor.find(images[0]), images[0].shape[1], images[0].shape[0])
    assert places and changed.any()
    for left, top, right, bottom in places:
        changed[top:bottom, left:right] = False
    assert not changed.any()


@pytest.mark.long
def test_topics_kept_on_request_are_named(crowded: Path, tmp_path: Path, capsys: Capture) -> None:
    report = redacted_report(crowded, tmp_path / "bug.rrd", "--unredacted", "/s*", "/bytes")
    capsys.readouterr()
    before, after = contents(crowded), contents(report.with_suffix(".mcap"))
    assert after["/state"] == before["/state"] and after["/bytes"] == before["/bytes"]
    assert not any(SECRET in m for m in after["/snapshot"] + after["/crops"])  # pictures all the same
    assert all(b"a note" in m for m in after["/snapshot"])
    call = ["report", str(crowded), "--at", "0", "-o", str(tmp_path / "other.rrd"), "--model", "demo"]
    assert "--unredacted /absent: no topic fits" in error_of(
        capsys, *call, "--redact", "--unredacted", "/absent"
    )
    assert "--unredacted: everything is" in error_of(capsys, *call, "--unredacted", "/bytes")


@pytest.mark.parametrize(
    ("text", "reason"),
    [("sensor_msgs/Absent part", "nobody knows what a"), ("Loop[] again", "nobody knows what a")],
)
def test_broken_definitions_end_redaction(text: str, reason: str) -> None:
    types = get_types_from_msg(text, "robot_msgs/msg/Loop")
    with pytest.raises(MessageError, match=reason):
        ImageFinder("robot_msgs/msg/Loop", types)


def test_no_older_report_is_left_when_redaction_ends_early(
    crowded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed at any time, nobody may take the older, unredacted page for the new one."""
    output = tmp_path / "bug.rrd"
    call = ["report", str(crowded), "--at", "0", "-o", str(output), "--model", "demo"]
    assert main(call) == 0
    assert len(list(tmp_path.iterdir())) == 3

    def killed(*_: object) -> None:
        raise SystemExit(9)

    monkeypatch.setattr("bevviz.report.make._detect", killed)
    with pytest.raises(SystemExit):
        main([*call, "--redact", "--force"])
    assert list(tmp_path.iterdir()) == []


# --- hiding ------------------------------------------------------------------------------------

SIDE = st.floats(-20, 140, width=32)


@given(
    st.integers(0, 1000),
    SIDE,
    SIDE,
    st.floats(0.5, 100, width=32),
    st.floats(0.5, 100, width=32),
)
def test_redaction_flattens_the_box_and_nothing_else(
    seed: int, x: float, y: float, width: float, height: float
) -> None:
    image: U8 = np.random.default_rng(seed).integers(0, 256, (90, 120, 3), np.uint8)
    box: F32 = np.array([[x, y, x + width, y + height]], np.float32)
    hidden = hide_boxes(image, box)
    places = grow_boxes(box, 120, 90)
    if not places:
        np.testing.assert_array_equal(hidden, image)
        assert x + width < 0 or y + height < 0 or x > 119 or y > 89
        return
    left, top, right, bottom = places[0]
    outside = np.ones((90, 120), bool)
    outside[top:bottom, left:right] = False
    np.testing.assert_array_equal(hidden[outside], image[outside])
    part = hidden[top:bottom, left:right].reshape(-1, 3)
    assert len(np.unique(part, axis=0)) <= CELLS * CELLS
    x0, y0, x1, y1 = np.clip(box[0], 0, [119, 89, 119, 89])
    assert left <= x0 and top <= y0 and right >= x1 and bottom >= y1


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "codec", "b_frames"),
    [
        ("foxglove_msgs/msg/CompressedVideo", "h264", 0),
        ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "h265", 0),
        ("sensor_msgs/msg/CompressedImage", "h264", 2),
    ],
)
def test_each_picture_of_a_video_is_an_image_without_people(
    kind: str, codec: str, b_frames: int, shared: Path, tmp_path: Path, capsys: Capture
) -> None:
    bgr: Any = cv2.imdecode(np.frombuffer(bags.kitti(shared, "000000").png, np.uint8), cv2.IMREAD_COLOR)
    pictures = [np.ascontiguousarray(bgr[: bgr.shape[0] // 2 * 2, : bgr.shape[1] // 2 * 2])] * 6
    packets = videos.encode(pictures, codec, group=4, b_frames=b_frames)
    made = videos.messages()
    others = [
        item
        for item in bags.kitti_items(shared, made, ["000000"], scans=6, step=4)
        if item.topic != f"{bags.IMAGE}/compressed"
    ]
    drive = videos.write_mcap(
        tmp_path / "drive.mcap", [*others, *videos.items(made, packets, kind=kind, codec=codec)], made
    )
    out = tmp_path / "bug.rrd"
    call = ["report", drive, "--at", "0.5", "--before", "0.2", "--after", "0", "-o", out, "--redact"]
    assert main([*map(str, call), "--model", str(shared / "models" / "yolox_nano.onnx")]) == 0
    assert "left out" not in capsys.readouterr().err

    with Bag([out.with_suffix(".mcap")]) as recording:
        (topic,) = (t for t in recording.topics if t.name == videos.VIDEO)
        assert (topic.type, topic.kind) == ("sensor_msgs/msg/CompressedImage", "CompressedImage")
        images = [
            decode_compressed_image(recording.decode(m), m.topic, m.received)
            for m in recording.messages([videos.VIDEO])
        ]
    assert sorted(image.stamp for image in images) == [bags.START + n * bags.PERIOD for n in range(6)]
    for image in images:
        assert is_hidden(image.bgr, noise=10)
        assert not is_hidden(pictures[0], noise=10)
        assert np.abs(image.bgr[:200, 150:450].astype(int) - pictures[0][:200, 150:450]).mean() < 12
    # No packet is in any of the files, whole or in part.
    for made_file in (out, out.with_suffix(".mcap"), out.with_suffix(".html")):
        found = made_file.read_bytes()
        assert not any(packet[100:140] in found for packet in packets if len(packet) > 140)
    assert main(["report", "--check", str(out)]) == 0
    assert "3 frames: the same" in capsys.readouterr().out
