"""The commands as a user runs them: what they make, what they say, how they end."""

from __future__ import annotations

import io
import logging
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from bevviz.cli import main, outputs
from bevviz.cli.options import join_negative_numbers
from bevviz.model.results import FrameResult
from bevviz.recording.frame_logger import FrameLogger
from bevviz.support import progress
from bevviz.support.files import unfinished_files
from tests.support import bags
from tests.support.commands import Capture, environment, error_of
from tests.support.recordings import Recording
from tests.support.waiting import PATIENCE

pytestmark = pytest.mark.usefixtures("elsewhere")


def small_bag(change: Callable[[list[bags.Item], bags.Messages], None] | None = None, scans: int = 5) -> Path:
    """Write a bag into the working directory. ``change`` may modify its messages first."""
    messages = bags.Messages()
    items = bags.small_items(messages, scans=scans)
    if change is not None:
        change(items, messages)
    return bags.write(Path("drive"), items, messages)


def replaced(topic: str, make: Callable[[bags.Messages, int], Any]) -> Callable[..., None]:
    """Return a change of a bag that replaces the messages of one topic."""

    def change(items: list[bags.Item], messages: bags.Messages) -> None:
        for i, item in enumerate(items):
            if item.topic == topic:
                items[i] = item._replace(message=make(messages, item.received))

    return change


def without(*topics: str) -> Callable[..., None]:
    def change(items: list[bags.Item], messages: bags.Messages) -> None:
        items[:] = [item for item in items if item.topic not in topics]

    return change


# --- runs --------------------------------------------------------------------------------------


def test_demo_shows_a_missed_pedestrian(tmp_path: Path) -> None:
    """The terminal says why it is missed, and the page opens on it; a second call opens the same drive."""
    command = [sys.executable, "-m", "bevviz", "demo"]
    for call in ("first", "second"):
        with subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(),
            cwd=tmp_path,
        ) as process:
            assert process.stdout is not None and process.stderr is not None
            try:
                sentence = process.stdout.readline()
                said = list(takewhile(lambda line: "open until Ctrl-C" not in line, process.stderr))
            finally:
                process.send_signal(signal.SIGINT)
                process.communicate(timeout=PATIENCE)
        assert sentence.startswith(
            "0.5 s into demo.mcap: The person at 7.3 m was not reported because it was"
        )
        assert "taken for ground" in sentence and "change ground.distance_threshold=0.2" in sentence
        (address,) = [line for line in said if "workbench at" in line]
        assert "#bag=demo.mcap&at=1750000000500000000&pick=truth" in address
        assert any(f"ssh -N -L {port_of(address)}:localhost:{port_of(address)}" in line for line in said)
        assert any("is there already" in line for line in said) == (call == "second")
    done = subprocess.run(
        [*command, "--seed", "1"],
        capture_output=True,
        text=True,
        env=environment(),
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 2 and "demo.mcap exists already" in done.stderr


def port_of(address: str) -> str:
    found = re.search(r":(\d+)/", address)
    assert found is not None
    return found[1]


@pytest.mark.long
def test_demo_is_saved_where_asked(tmp_path: Path) -> None:
    assert main(["demo", "--save", "demo.rrd"]) == 0
    recording = Recording(tmp_path / "demo.rrd")
    assert len(recording.rows["/bev"]) == 16
    assert "/world/fused" in recording.at


def test_demo_writes_a_bag_that_runs(tmp_path: Path, capsys: Capture) -> None:
    assert main(["demo", "-o", "drive.mcap"]) == 0
    assert main(["bag", "drive.mcap", "--model", "demo", "--frames", ":3", "--save", "out.rrd"]) == 0
    assert "3 frames in out.rrd" in capsys.readouterr().err
    assert main(["demo", "-o", "drive.mcap"]) == main(["demo", "-o", "drive.bag"]) == 2
    assert "drive.mcap exists already" in capsys.readouterr().err
    assert len(Recording(tmp_path / "out.rrd").rows["/bev"]) == 3


def test_frames_can_be_selected(tmp_path: Path, capsys: Capture) -> None:
    small_bag(scans=20)
    assert main(["bag", "drive", "--frames", "4:12", "--every", "3", "--save", "out.rrd"]) == 0
    assert sorted(row["frame"] for row in Recording(tmp_path / "out.rrd").rows["/bev"]) == [4, 7, 10]


def test_info_names_sensors_and_what_is_missing(capsys: Capture) -> None:
    small_bag()
    assert main(["info", "drive"]) == 0
    said = capsys.readouterr().out
    assert bags.CLOUD in said
    assert "--model" in said


def test_several_numbers_may_begin_below_zero() -> None:
    """Check that -5,1,0 is a value. argparse itself accepts only single negative numbers."""
    assert join_negative_numbers(["why", "--point", "-5,1,0", "--at", "-3"]) == [
        "why",
        "--point=-5,1,0",
        "--at",
        "-3",
    ]
    assert join_negative_numbers(["--point", "-.5,-1e-3,0"]) == ["--point=-.5,-1e-3,0"]
    kept = ["--point=1,2", "-5,1", "-v", "--set", "-x=1,2", "bag", "-1,2"]
    assert join_negative_numbers(kept) == kept


def test_config_is_read_back(capsys: Capture, tmp_path: Path) -> None:
    assert main(["config", "--preset", "reference", "--set", "voxel_size=3 cm"]) == 0
    Path("c.yaml").write_text(capsys.readouterr().out)
    assert main(["config", "--config", "c.yaml"]) == 0
    assert "size: 0.03" in capsys.readouterr().out


def test_every_command_has_help(capsys: Capture) -> None:
    for command in ((), ("bag",), ("info",), ("report",), ("demo",), ("config",)):
        with pytest.raises(SystemExit) as ended:
            main([*command, "--help"])
        assert ended.value.code == 0


def test_the_help_imports_no_library() -> None:
    """Shell completion makes the parsers of all commands, too."""
    code = (
        "import sys; before = {*sys.modules}; from bevviz.cli import main, make_parser; make_parser()\n"
        "try: main(['--help'])\n"
        "finally:\n"
        " imported = {name.partition('.')[0] for name in {*sys.modules} - before}\n"
        " print(sorted(imported - sys.stdlib_module_names), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "examples:" in done.stdout
    assert done.stderr == "['bevviz']\n"


# --- wrong input: one clear line, exit status 2 --------------------------------------------------


def test_a_missing_file(capsys: Capture) -> None:
    assert "absent.mcap" in error_of(capsys, "bag", "absent.mcap")


def test_a_directory_without_a_bag_is_one_line(capsys: Capture) -> None:
    Path("folder").mkdir()
    Path("folder/notes.txt").write_text("no bag")
    assert "folder" in error_of(capsys, "bag", "folder")


def test_an_empty_file(capsys: Capture) -> None:
    Path("empty.mcap").touch()
    assert "empty.mcap" in error_of(capsys, "bag", "empty.mcap")


def test_a_bag_without_messages_is_one_line(capsys: Capture) -> None:
    bags.write(Path("empty"), [])
    assert "empty" in error_of(capsys, "bag", "empty")


def test_a_lidar_topic_without_messages(capsys: Capture) -> None:
    items = [item for item in bags.small_items() if item.topic != bags.CLOUD]
    bags.write(Path("drive"), items, topics=[(bags.CLOUD, "sensor_msgs/msg/PointCloud2")])
    said = error_of(capsys, "bag", "drive")
    assert bags.CLOUD in said
    assert "nor has any other" in said


def test_a_bag_without_a_lidar_is_one_line(capsys: Capture) -> None:
    small_bag(without(bags.CLOUD, bags.IMAGE))
    assert "none of 3 topics is a sensor_msgs/PointCloud2" in error_of(capsys, "bag", "drive")
    shutil.rmtree("drive")
    small_bag(without(bags.CLOUD))
    assert main(["bag", "drive", "--save", "out.rrd"]) == 0
    assert "no LiDAR" in capsys.readouterr().err


def told_of_the_model(capsys: Capture) -> str:
    """Return the line about a model that gets no images. It is printed once."""
    assert main(["bag", "drive", "--model", "demo", "--save", "out.rrd"]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "detector.model" in line]
    return line


def test_undecodable_video_explains_missing_detections(capsys: Capture) -> None:
    kind = "foxglove_msgs/msg/CompressedVideo"
    fields = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"

    def change(items: list[bags.Item], messages: bags.Messages) -> None:
        messages.store.register(get_types_from_msg(fields, kind))
        for i, item in enumerate(items):
            if item.topic == bags.IMAGE:
                time, data = item.message.header.stamp, np.zeros(4, np.uint8)
                video = messages.make(kind, timestamp=time, frame_id="camera", data=data, format="h264")
                items[i] = bags.Item("/camera/video", kind, item.received, video)

    small_bag(change)
    line = told_of_the_model(capsys)
    assert "detector.model demo has seen nothing in 5 frames: no image at the time of any scan" in line


def test_video_in_images_explains_missing_detections(capsys: Capture) -> None:
    def change(items: list[bags.Item], messages: bags.Messages) -> None:
        for i, item in enumerate(items):
            if item.topic == bags.IMAGE:
                video = messages.compressed(item.received, b"\0\0\0\1\x67abc", "h264")
                items[i] = item._replace(type="sensor_msgs/msg/CompressedImage", message=video)

    small_bag(change)
    line = told_of_the_model(capsys)
    assert (
        f"detector.model demo has seen nothing in 5 frames: {bags.IMAGE}: a picture of the H264 video" in line
    )


def test_late_images_explain_missing_detections(capsys: Capture) -> None:
    def change(items: list[bags.Item], messages: bags.Messages) -> None:
        items[:] = [i for i in items if i.topic != bags.IMAGE or i.received == bags.START]
        items[:] = [i for i in items if i.topic != bags.CLOUD or i.received > bags.START + 3 * bags.PERIOD]

    small_bag(change)
    assert "has seen nothing in 2 frames: no image at the time of any scan" in told_of_the_model(capsys)


def test_no_warning_if_the_model_detects_something(capsys: Capture) -> None:
    small_bag()
    assert main(["bag", "drive", "--model", "demo", "--save", "out.rrd"]) == 0
    assert "detector.model" not in capsys.readouterr().err


def test_an_unknown_topic_is_one_line(capsys: Capture) -> None:
    small_bag()
    said = error_of(capsys, "bag", "drive", "--set", "source.lidar_topics=[/velodyne_point]")
    assert bags.CLOUD in said


@pytest.mark.parametrize("name", ["absent.onnx", "text.onnx"])
def test_a_file_that_is_no_model_is_one_line(capsys: Capture, name: str) -> None:
    small_bag()
    Path("text.onnx").write_text("not a network")
    assert name in error_of(capsys, "bag", "drive", "--model", name)


def test_a_time_outside_the_bag_is_one_line(capsys: Capture) -> None:
    small_bag()
    assert "1000" in error_of(capsys, "bag", "drive", "--start", "1000")
    assert "soon" in error_of(capsys, "bag", "drive", "--start", "soon")


def test_an_unknown_blueprint_is_one_line(capsys: Capture) -> None:
    small_bag()
    said = error_of(capsys, "bag", "drive", "--save", "o.rrd", "--blueprint", "debugg")
    assert "did you mean 'debug'?" in said


def test_an_unwritable_output_is_one_line(capsys: Capture) -> None:
    small_bag()
    assert "absent/o.rrd" in error_of(capsys, "bag", "drive", "--save", "absent/o.rrd")


def test_a_recording_never_overwrites_a_bag(capsys: Capture) -> None:
    small_bag()
    before = {path: path.read_bytes() for path in Path("drive").iterdir()}
    for path in before:
        assert "is what is read" in error_of(capsys, "bag", "drive", "--save", path)
    Path("other.mcap").write_text("another bag")
    assert "ends in .rrd" in error_of(capsys, "bag", "drive", "--save", "other.mcap")
    assert {path: path.read_bytes() for path in Path("drive").iterdir()} == before


@pytest.mark.parametrize("frames", ["5", "a:b", "1-3"])
def test_an_invalid_frame_range_is_one_line(capsys: Capture, frames: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["bag", "drive", "--frames", frames])
    assert ended.value.code == 2
    assert "is not A:B" in capsys.readouterr().err


# --- bad data: every frame is made, and says what it lacks ---------------------------------------


def test_clouds_without_points_are_processed(tmp_path: Path) -> None:
    none = np.zeros((0, 4), np.float32)
    small_bag(replaced(bags.CLOUD, lambda m, t: m.cloud(t, none)))
    assert main(["bag", "drive", "--save", "out.rrd"]) == 0
    recording = Recording(tmp_path / "out.rrd")
    assert len(recording.rows["/explain"]) == 5
    assert "no finite point" in recording.text("/explain")[0]


def test_clouds_of_nan_are_processed(tmp_path: Path) -> None:
    nan = np.full((50, 4), np.nan, np.float32)
    small_bag(replaced(bags.CLOUD, lambda m, t: m.cloud(t, nan)))
    assert main(["bag", "drive", "--save", "out.rrd"]) == 0
    texts = Recording(tmp_path / "out.rrd").text("/explain")
    assert len(texts) == 5
    assert "no finite point" in texts[0]


def test_an_unknown_image_encoding_is_reported(tmp_path: Path, capsys: Capture) -> None:
    def strange(messages: bags.Messages, stamp: int) -> Any:
        image = messages.image(stamp, np.zeros((48, 64, 3), np.uint8))
        image.encoding = "rgb565"
        return image

    small_bag(replaced(bags.IMAGE, strange))
    assert main(["bag", "drive", "--save", "out.rrd"]) == 0
    texts = Recording(tmp_path / "out.rrd").text("/explain")
    assert len(texts) == 5
    assert "rgb565" in texts[0]
    assert bags.IMAGE in texts[0]


def test_a_missing_camera_info_is_reported(tmp_path: Path) -> None:
    small_bag(without(bags.INFO))
    assert main(["bag", "drive", "--model", "demo", "--save", "out.rrd"]) == 0
    texts = Recording(tmp_path / "out.rrd").text("/explain")
    assert len(texts) == 5
    assert "no CameraInfo topic for camera 'camera': nothing can be projected into it; record one" in texts[0]


def test_missing_transforms_are_reported(tmp_path: Path) -> None:
    small_bag(without("/tf", "/tf_static"))
    assert main(["bag", "drive", "--model", "demo", "--save", "out.rrd"]) == 0
    texts = Recording(tmp_path / "out.rrd").text("/explain")
    assert len(texts) == 5
    assert "source.extrinsics" in texts[0]


def test_a_cut_bag_is_processed_to_the_cut(tmp_path: Path, capsys: Capture) -> None:
    small_bag(scans=40)
    (whole,) = Path("drive").glob("*.mcap")
    data = whole.read_bytes()
    Path("cut.mcap").write_bytes(data[: len(data) // 2])
    assert main(["bag", "cut.mcap", "--save", "out.rrd"]) == 0
    said = capsys.readouterr().err
    assert "warning: cut.mcap" in said
    frames = len(Recording(tmp_path / "out.rrd").rows["/bev"])
    assert 10 < frames < 30


@pytest.mark.long
def test_an_interrupted_run_leaves_a_readable_recording(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "bevviz.cli", "demo", "--frames", "500", "--save", "out.rrd"]
    saved = tmp_path / "out.rrd"
    deadline = time.monotonic() + 120
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment()) as run:
        try:
            while run.poll() is None and time.monotonic() < deadline:
                if sum(path.stat().st_size for path in unfinished_files(saved)) > 4_000_000:
                    break
                time.sleep(0.1)
            run.send_signal(signal.SIGINT)
            _, said = run.communicate(timeout=PATIENCE)
        finally:
            run.kill()
    assert run.returncode == 130
    assert "interrupted after" in said
    assert "Traceback" not in said
    assert 0 < len(Recording(saved).rows["/bev"]) < 500


def test_an_interrupt_swallowed_by_a_library_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    log = FrameLogger.log

    def deaf(self: FrameLogger, result: FrameResult) -> None:
        if result.frame.index == 3:
            with suppress(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGTERM)
        log(self, result)

    monkeypatch.setattr(FrameLogger, "log", deaf)
    small_bag(scans=40)
    assert main(["bag", "drive", "--save", "out.rrd"]) == 130
    assert "interrupted after 4 frames" in capsys.readouterr().err
    assert len(Recording(tmp_path / "out.rrd").rows["/bev"]) == 4


# --- what nobody foresaw -----------------------------------------------------------------------


def test_a_failing_stage_prints_one_line_unless_debugging(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("broken.py").write_text("def cluster(points):\n    return 1 // 0\n")
    bags.write(tmp_path / "drive", bags.small_items(scans=3))
    run = ["bag", str(tmp_path / "drive"), "--set", "clustering.method=broken:cluster", "--save", "x.rrd"]
    assert main(run) == 0
    said = capsys.readouterr().err
    failed = [line for line in said.splitlines() if "clustering failed in 3 of 3 frames" in line]
    error = "broken:cluster raised ZeroDivisionError: integer division or modulo by zero (broken.py, line 2)"
    assert len(failed) == 1 and failed[0].endswith(f"first: {error}")
    assert "Traceback" not in said
    try:
        assert main([*run, "--verbose"]) == 0
    finally:
        logging.getLogger("bevviz").handlers[:] = logging.getLogger("bevviz").handlers[:1]
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert 'broken.py", line 2, in cluster' in said


def test_an_internal_error_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: FrameLogger, result: object) -> None:
        raise RuntimeError("planted")

    bags.write(tmp_path / "drive", bags.small_items(scans=2))
    monkeypatch.setattr(FrameLogger, "log", broken)
    assert main(["bag", str(tmp_path / "drive"), "--save", "x.rrd"]) == 3
    said = capsys.readouterr().err.splitlines()
    assert said[-1] == (
        "bevviz: error of bevviz itself: RuntimeError: planted; --verbose shows where, please report it"
    )


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("preset", ["default", "reference"])
def test_points_beyond_any_sensor_cause_no_warning(preset: str, tmp_path: Path) -> None:
    near = np.random.default_rng(0).normal(0, 10, (200, 4))
    far = [[sign * 1e30 if i == axis else 5.0 for i in range(4)] for axis in range(4) for sign in (1, -1)]
    far += [[3e38, 3e38, 3e38, 3e38], [9e7, 5, 1, 1]]
    points = np.array([*near, *far], np.float32)

    def change(items: list[bags.Item], messages: bags.Messages) -> None:
        replaced(bags.CLOUD, lambda m, t: m.cloud(t, points))(items, messages)
        for i, item in enumerate(items):
            if item.topic == bags.INFO:
                item.message.d = np.array([0.1, 0.05, 0.0, 0.0, 0.02])
            elif item.topic == bags.IMAGE:  # not rectified
                items[i] = item._replace(topic="/camera/image_raw")

    small_bag(change)
    assert main(["bag", "drive", "--save", "out.rrd", "--preset", preset]) == 0
    recording = Recording(tmp_path / "out.rrd")
    assert recording.column("/health/count/invalid_points", "Scalars:scalars") == [[7.0]] * 5
    assert recording.column("/health/count/failures", "Scalars:scalars") == [[0.0]] * 5


def test_a_message_does_not_share_a_line_with_the_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with progress.bar(total=3, file=terminal, ncols=60) as bar:
        bar.update()
        outputs.say("the clouds are back")
    before, _, _ = terminal.getvalue().partition("bevviz: the clouds are back\n")
    assert "1/3" in before or "0/3" in before
    assert before.endswith("\r") and not before.rpartition("\r")[0].rpartition("\r")[2].strip()


def test_a_taken_port_of_the_page_is_told_before_the_robot(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert f"--workbench {port}: the port is in use" in error_of(capsys, "live", "--workbench", port)
