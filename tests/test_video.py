"""Video in bags, encoded by FFmpeg's libraries and written by the ``mcap`` library."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import load
from bevviz.drivers.video import Continuity, is_key
from bevviz.model.frame import Frame, Image
from bevviz.report.bag_window import choose_topics, cut_bag, find_window, open_window
from bevviz.sync import video
from tests.support import bags, videos
from tests.support.onnx_networks import FLOAT, answer
from tests.support.recordings import Recording, verify
from tests.support.videos import encode, number_of, numbered

FOXGLOVE, FFMPEG = "foxglove_msgs/msg/CompressedVideo", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
IMAGE = "sensor_msgs/msg/CompressedImage"


def drive(
    path: Path,
    packets: Sequence[bytes],
    *,
    lost: Sequence[int] = (),
    scans: int = 30,
    period: int = bags.PERIOD,
    **how: Any,
) -> Path:
    made = videos.messages()
    small = [item for item in bags.small_items(made, scans) if item.topic != bags.IMAGE]
    found = videos.items(made, packets, period=period, **how)
    kept = [item for row, item in enumerate(found) if row not in lost]
    return videos.write_mcap(path, [*small, *kept], made)


def image(frame: Frame | None) -> Image | None:
    assert frame is not None
    return frame.cameras[0].image


def numbers(frames: Sequence[Frame]) -> list[int | None]:
    found = map(image, frames)
    return [None if picture is None else number_of(picture.bgr) for picture in found]


@pytest.mark.long
@pytest.mark.parametrize(
    ("codec", "kind"),
    [
        ("h264", FOXGLOVE),
        ("h265", FFMPEG),
        ("h264", IMAGE),
        ("h265", IMAGE),
        ("av1", FOXGLOVE),
        ("vp9", FOXGLOVE),
    ],
)
def test_each_scan_gets_the_video_picture_of_its_stamp(codec: str, kind: str, tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", encode(numbered(30), codec), kind=kind, codec=codec)
    with BagSource([path], load()) as source:
        assert source.roles.cameras[0].kind == "CompressedVideo"
        assert source.roles.cameras[0].info_topic == bags.INFO
        assert numbers(list(source)) == list(range(30))
        for number in (17, 29, 3, 4):
            assert numbers([source.frame(number) or pytest.fail()]) == [number]
        assert not any("decoded" in warning for warning in source.warnings)


def test_pictures_with_b_frames_match_their_packets(tmp_path: Path) -> None:
    packets = encode(numbered(20), b_frames=2)
    path = drive(tmp_path / "drive.mcap", packets, scans=20)
    with BagSource([path], load()) as source:
        frames = list(source)
        found = numbers(frames)
        assert sorted(n for n in found if n is not None) == list(range(20))
        assert found != list(range(20))  # packets come in the order of decoding
        assert all(picture is not None and picture.clip is None for picture in map(image, frames))
        assert numbers([source.frame(7) or pytest.fail()]) == [found[7]]


def test_a_key_frame_far_back_is_found_and_memory_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = drive(tmp_path / "drive.mcap", encode(numbered(60), group=60), scans=60)
    with BagSource([path], load()) as source:
        assert numbers([source.frame(57) or pytest.fail()]) == [57 % 31]
        monkeypatch.setattr(video, "MOST_BYTES", 2000)
        expected = [n % 31 for n in range(60)]
        assert numbers(list(source)) == expected
        with BagSource([path], load(), every=25) as sparse:
            assert numbers(list(sparse)) == [expected[n] for n in (0, 25, 50)]


def test_packets_before_the_first_key_frame_are_reported_once(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", encode(numbered(30)), lost=range(4))
    with BagSource([path], load()) as source:
        assert numbers(list(source)) == [*[None] * 10, *range(10, 30)]
        told = [warning for warning in source.warnings if "between two key frames" in warning]
        assert len(told) == 1
        assert "7 times" in told[0]  # the first three have no packet near


@pytest.mark.parametrize("codec", ["h264", "h265"])
def test_lost_packets_drop_only_the_pictures_that_need_them(codec: str, tmp_path: Path) -> None:
    packets = encode(numbered(30), codec)
    path = drive(tmp_path / "drive.mcap", packets, lost=(13, 14), codec=codec)
    with BagSource([path], load()) as source:
        assert numbers(list(source)) == [*range(13), 12, *[None] * 6, *range(20, 30)]
        told = [warning for warning in source.warnings if "cannot be decoded" in warning]
        assert len(told) == 1
        assert "lost" in told[0]


def test_a_stream_without_key_frames_begins_at_a_recovery_point() -> None:
    """As encoders with intra-refresh write it, among other messages in one unit."""
    said, slice_p = b"\0\0\1\x67\x42\0\x1e\0\0\1\x68\xce", b"\0\0\1\x41\x9a"
    long = bytes([5, 255, 3]) + bytes(258)
    for sei, key in (([6, 1, 0xC4], True), ([0, 2, 6, 1, 6, 1, 0xC4], True), ([0, 2, 6, 1, 0x80], False)):
        assert is_key("h264", said + b"\0\0\1\x06" + bytes(sei) + slice_p) is key
    assert is_key("h264", said + b"\0\0\1\x06" + long[:60] + slice_p) is False
    assert is_key("h264", said) and not is_key("h264", said + slice_p)


@pytest.mark.parametrize("codec", ["h264", "h265"])
def test_parameter_sets_before_each_picture_are_no_key_frames(codec: str, tmp_path: Path) -> None:
    """Some encoders repeat their parameter sets: each picture was decoded alone, and all but a few failed."""
    packets = encode(numbered(30), codec)
    kinds = (7, 8) if codec == "h264" else (32, 33, 34)
    said = b"".join(
        b"\0\0\0\1" + unit
        for unit in filter(None, re.split(b"\0\0\0?\1", packets[0]))
        if (unit[0] & 31 if codec == "h264" else unit[0] >> 1) in kinds
    )
    packets = [packet if row % 10 == 0 else said + packet for row, packet in enumerate(packets)]
    assert [row for row, packet in enumerate(packets) if is_key(codec, packet)] == [0, 10, 20]
    path = drive(tmp_path / "drive.mcap", packets, lost=(13, 14), codec=codec)
    with BagSource([path], load()) as source:
        assert numbers(list(source)) == [*range(13), 12, *[None] * 6, *range(20, 30)]
        assert number_of(image(source.frame(27)).bgr) == 27  # type: ignore[union-attr]


def test_a_gap_is_reported_where_packets_have_no_numbers(tmp_path: Path) -> None:
    packets = encode(numbered(30), "vp9")
    for lost in ((), (20,), (13, 14)):
        path = drive(tmp_path / f"{len(lost)}.mcap", packets, lost=lost, codec="vp9")
        with BagSource([path], load()) as source:
            assert len(list(source)) == 30
            told = [warning for warning in source.warnings if "VP9" in warning]
            assert [text.partition(" between")[0] for text in told] == [f"{videos.VIDEO}: 1 gap"] * bool(lost)


def test_damaged_packets_and_other_codecs_are_one_line(tmp_path: Path) -> None:
    packets = encode(numbered(30))
    packets[12] = packets[12][:9] + b"\xff" * 40
    path = drive(tmp_path / "drive.mcap", packets)
    with BagSource([path], load()) as source:
        assert numbers(list(source))[:12] == list(range(12))
        assert numbers(list(source))[20:] == list(range(20, 30))
    path = drive(tmp_path / "other.mcap", packets, codec="mjpeg2000")
    with BagSource([path], load()) as source:
        assert numbers(list(source)) == [None] * 30
        assert any("codec 'mjpeg2000' is not supported" in warning for warning in source.warnings)


def test_h264_states_how_many_pictures_are_missing() -> None:
    packets = encode(numbered(30), group=30)
    follows = Continuity()
    assert [follows.missing(packet) for packet in packets] == [0] * 30
    follows = Continuity()
    assert [follows.missing(packet) for packet in packets[:5] + packets[8:]] == [0] * 5 + [3] + [0] * 21


@pytest.mark.parametrize("codec", ["h264", "h265", "av1", "vp9"])
def test_key_frames_are_those_of_the_encoder(codec: str) -> None:
    packets = encode(numbered(30), codec)
    assert [row for row, packet in enumerate(packets) if is_key(codec, packet)] == [0, 10, 20]


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg with an encoder of Theora")
def test_theora_is_decoded(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number, bgr in enumerate(numbered(30)):
        cv2.imwrite(str(folder / f"{number:02}.png"), bgr)
    file = tmp_path / "video.ogv"
    command = f"ffmpeg -loglevel error -framerate 10 -i {folder}/%02d.png -c:v libtheora -q:v 10 -g 8 {file}"
    if subprocess.run(command.split(), check=False).returncode:
        pytest.skip("this ffmpeg has no encoder of Theora")
    with av.open(str(file)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
        said = container.streams.video[0].codec_context.extradata or b""
    headers, at = [], 0
    while at < len(said):
        size = int.from_bytes(said[at : at + 2])
        headers.append(said[at + 2 : at + 2 + size])
        at += 2 + size
    assert len(headers) == 3
    made = videos.messages()
    kind = "theora_image_transport/msg/Packet"
    found = [item for item in bags.small_items(made) if item.topic != bags.IMAGE]
    before = videos.items(made, headers, kind=kind, period=1000)
    found += [item._replace(received=item.received - 10**6) for item in before]
    path = videos.write_mcap(tmp_path / "drive.mcap", found + videos.items(made, packets, kind=kind), made)
    with BagSource([path], load()) as source:
        assert numbers(list(source))[:20] == list(range(20))
        assert numbers([source.frame(17) or pytest.fail()]) == [17]
    kept = [item for row, item in enumerate(videos.items(made, packets, kind=kind)) if row != 10]
    path = videos.write_mcap(tmp_path / "lost.mcap", found + kept, made)
    with BagSource([path], load()) as source:
        assert numbers(list(source))[:20] == [*range(10), 9, *[None] * 5, *range(16, 20)]


def test_a_recording_has_every_packet_untouched(tmp_path: Path) -> None:
    packets = encode(numbered(60), group=20)
    path = drive(tmp_path / "drive.mcap", packets, period=bags.PERIOD // 2)
    saved = tmp_path / "drive.rrd"
    assert main(["bag", str(path), "--save", str(saved), "--quiet"]) == 0
    verify(saved)
    found = samples(saved)
    assert [data for _, _, data in found] == packets[:59]  # the last one is after the last scan
    assert len({stamp for stamp, _, _ in found}) == 59
    there = bags.START + 3 * bags.PERIOD
    assert [stamp for stamp, frame, _ in found if frame == 3] == [there - bags.PERIOD // 2, there]


def samples(path: Path) -> list[tuple[int, int, bytes]]:
    """Stamp, frame and packet of all video in a recording."""
    rows = Recording(path).rows["/world/camera/image"]
    kept = [row for row in rows if row.get("VideoStream:sample")]
    return sorted((row["stamp"], row["frame"], bytes(row["VideoStream:sample"][0])) for row in kept)


def test_video_can_be_saved_as_images(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", encode(numbered(30)))
    saved = tmp_path / "drive.rrd"
    assert main(["bag", str(path), "--save", str(saved), "--set", "logging.video=images", "--quiet"]) == 0
    recording = Recording(saved)
    assert "VideoStream:codec" not in {name for found in recording.static.values() for name in found}
    assert len(recording.column("/world/camera/image", "EncodedImage:blob")) == 30


def test_a_cut_out_part_has_the_video_that_it_needs(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", encode(numbered(60), group=60), scans=60)
    target = tmp_path / "cut.mcap"
    with BagSource([path], load()) as source:
        window = find_window(source, int(source.scans[50]), 0.1, 0.1)
        topics = choose_topics(source.recording, source.roles, None)
        cut_bag(source.recording, window, topics, source.roles.tf_static, target)
    with open_window([target], load(), window.low, window.high) as source:
        assert numbers(list(source)) == [n % 31 for n in (49, 50, 51)]


def alone(path: Path) -> Path:
    made = videos.messages()
    found = videos.items(made, encode(numbered(12)))
    found += [item for item in bags.small_items(made, 12) if item.topic not in (bags.IMAGE, bags.CLOUD)]
    return videos.write_mcap(path, found, made)


def test_cameras_alone_make_frames_with_explained_detections(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = np.array([[[8, 8, 40, 40, 0.9, 2], [4, 4, 20, 30, 0.1, 0]]], np.float32)
    model = answer(tmp_path / "model.onnx", {"output0": rows}, [("images", (1, 3, 64, 64), FLOAT)])
    path, saved = alone(tmp_path / "alone.mcap"), tmp_path / "alone.rrd"
    assert main(["bag", str(path), "--model", model, "--save", str(saved), "--quiet"]) == 0
    verify(saved)
    recording = Recording(saved)
    assert sorted(recording.at["/world/camera/image/detections"]["Boxes2D:labels"]) == list(range(12))
    assert not [entity for entity in recording.at if entity.startswith(("/bev", "/world/fused"))]
    told = capsys.readouterr().err
    assert told.count("no LiDAR") == 1
    assert "the frames are /camera/image_rect_color/foxglove's" in told
    assert main(["why", str(path), "--model", model, "--at", "0.52", "--all"]) == 0
    told = capsys.readouterr().out
    assert "was reported: class_2 0.90 was kept" in told
    assert "without a LiDAR nothing tells where it is" in told
    assert "below detector.conf_threshold" in told
    assert main(["info", str(path)]) == 0
    assert "no LiDAR: none of" in capsys.readouterr().out
