"""Fuzzed messages of every kind that is read beside plain clouds and images, one drive after the other.

Each kind has a short sound drive. A case is one message of it that is changed; all cases of a drive are read
the public way, from the bag to its frames. A case is known by its kind, its number and the seed.
"""

from __future__ import annotations

import json
import random
import struct
import tempfile
import time
import traceback
import zlib
from base64 import b64decode
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from backports import zstd
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import get_types_from_msg
from tqdm import tqdm

from benchmarks.torture import fuzz
from benchmarks.torture.worker import Outcome, Worker
from bevviz.drivers.compressed_clouds import COMPRESSED
from tests.support import bags, videos

SCANS = 52  # of a drive
BATCH = 50  # messages of a drive that are changed; the first ones stay sound
SLOW = 20.0  # seconds for a drive
MEMORY = 700.0  # MB for a drive
TOPIC = "/fuzzed"
CHANGED_DEFINITIONS = 0.1  # share of the cases
CLOUD, IMAGE = bags.CLOUD, bags.IMAGE


@dataclass(frozen=True, slots=True)
class Row:
    """One message in a bag."""

    topic: str
    type: str
    time: int  # nanoseconds
    data: bytes
    definition: bytes
    form: str = "ros2msg"  # of the definition
    encoding: str = "cdr"


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of messages.

    Attributes:
        rows: makes a sound drive.
        topic: the topic whose messages are changed.
        settings: of the configuration.
        needed: nothing can be read without these messages, so that one clear line may end the reading.
    """

    rows: Callable[[], list[Row]]
    topic: str = TOPIC
    settings: tuple[str, ...] = ()
    needed: bool = False


@dataclass
class Tally:
    """Results of one kind, or of all kinds."""

    cases: int = 0
    tracebacks: int = 0  # drives with one
    ended: int = 0  # drives whose reading ended early, with one line
    hangs: int = 0
    slow: int = 0  # drives that took more than ``SLOW``
    large: int = 0  # drives that took more than ``MEMORY``
    slowest: float = 0.0  # seconds for a drive
    memory: float = 0.0  # MB for a drive, at most
    examples: list[str] = field(default_factory=list)

    def __iadd__(self, other: Tally) -> Tally:
        for name in ("cases", "tracebacks", "ended", "hangs", "slow", "large"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.slowest, self.memory = max(self.slowest, other.slowest), max(self.memory, other.memory)
        self.examples += other.examples
        return self

    @property
    def well(self) -> bool:
        return not (self.tracebacks or self.ended or self.hangs or self.slow or self.large)


# --- sound drives ------------------------------------------------------------------------------


@cache
def _messages() -> bags.Messages:
    """Return a message factory that knows all types."""
    from tests.support import object_messages

    made = bags.Messages()
    for name, text in videos.DEFINITIONS.items():
        made.store.register(get_types_from_msg(text, name))
    for package, texts in (
        ("autoware_perception_msgs", object_messages.AUTOWARE),
        ("radar_msgs", object_messages.RADAR),
        ("my_msgs", object_messages.PRIVATE),
    ):
        types: dict[str, Any] = {}
        for name, text in texts.items():
            types |= get_types_from_msg(text, f"{package}/msg/{name}")
        made.store.register(types)
    return made


def _rows(items: Sequence[bags.Item]) -> list[Row]:
    store = _messages().store
    texts = {kind: store.generate_msgdef(kind, ros_version=2)[0].encode() for kind in {i.type for i in items}}
    rows = [
        Row(i.topic, i.type, i.received, bytes(store.serialize_cdr(i.message, i.type)), texts[i.type])
        for i in items
    ]
    return sorted(rows, key=lambda row: row.time)


@cache
def _base() -> tuple[bags.Item, ...]:
    return tuple(bags.small_items(_messages(), SCANS, 40))


def _drive(kind: str, make: Callable[[int], Any], *, without: str = "", topic: str = TOPIC) -> list[Row]:
    """Return a drive with one message of a kind per scan. These messages replace the topic ``without``."""
    stamps = [bags.START + scan * bags.PERIOD for scan in range(SCANS)]
    items = [item for item in _base() if item.topic != without]
    return _rows([*items, *(bags.Item(topic, kind, stamp, make(stamp)) for stamp in stamps)])


def _livox() -> list[Row]:
    from tests.support.livox_messages import scan

    package = "livox_ros_driver2"
    return _drive(
        f"{package}/msg/CustomMsg", partial(scan, _messages(), package, frame=bags.LIDAR_FRAME), without=CLOUD
    )


def _pandar(model: str) -> list[Row]:
    from tests.support.lidar_packets import MODELS_BY_NAME, SCAN, packet, scan

    packets = [packet(MODELS_BY_NAME[model], number) for number in range(3)]
    return _drive(
        SCAN, lambda stamp: scan(_messages(), stamp, packets, frame=bags.LIDAR_FRAME), without=CLOUD
    )


def _velodyne() -> list[Row]:
    from tests.support.lidar_packets import VELODYNE, scan

    blocks = b""
    for block in range(12):
        blocks += struct.pack("<HH", 0xEEFF, 9000 + 40 * block)
        blocks += b"".join(struct.pack("<HB", 2500, channel % 16) for channel in range(32))
    packets = [blocks + struct.pack("<IBB", 1_000_000 + 1327 * n, 0x37, 0x22) for n in range(3)]
    return _drive(
        VELODYNE,
        lambda stamp: scan(_messages(), stamp, packets, VELODYNE, bags.LIDAR_FRAME),
        without=CLOUD,
    )


def _ouster() -> list[Row]:
    from tests.support import ouster_packets

    made, profile = _messages(), "RNG15_RFL8_NIR8"
    text = made.make("std_msgs/msg/String", data=ouster_packets.metadata(profile))
    items = [item for item in _base() if item.topic != CLOUD]
    items.append(bags.Item(ouster_packets.METADATA, "std_msgs/msg/String", bags.START - 1, text))
    for number in range(SCANS * ouster_packets.PACKETS):
        scan, part = divmod(number, ouster_packets.PACKETS)
        at = bags.START + scan * bags.PERIOD
        data = ouster_packets.packet(profile, scan + 65534 & 0xFFFF, part, at)
        message = made.make(ouster_packets.KIND, buf=np.frombuffer(data, np.uint8))
        items.append(
            bags.Item(ouster_packets.LIDAR, ouster_packets.KIND, at + (part + 1) * 16_000_000, message)
        )
    return _rows(items)


def _compressed_cloud(form: str) -> list[Row]:
    from tests.support import compressed_clouds as samples

    made = _messages()

    def make(stamp: int) -> Any:
        cloud = made.cloud(stamp, np.random.default_rng(0).normal(0, 9, (400, 4)).astype(np.float32))
        if form == "draco":
            message = samples.draco(b64decode(samples.DRACO[0]))
        else:
            message = samples.compressed(made, cloud, form, samples.packed(form, cloud.data.tobytes()))
        return replace(message, header=cloud.header)

    return _drive(COMPRESSED, make, without=CLOUD)


def _video(kind: str, codec: str = "h264") -> list[Row]:
    made = _messages()
    packets = videos.encode(videos.numbered(SCANS), codec)
    video = videos.items(made, packets, kind=kind, codec=codec)
    return _rows([*(item for item in _base() if item.topic != IMAGE), *video])


def _objects(kind: str) -> list[Row]:
    from tests.support.object_messages import autoware

    package = "autoware_perception_msgs"
    outline = [(-2, -1), (2, -1), (2, 1)] if kind == "Detected" else ()
    return _drive(
        f"{package}/msg/{kind}Objects",
        lambda stamp: _stamped(autoware(_messages(), package, kind, outline), stamp),
    )


def _radar() -> list[Row]:
    from tests.support.object_messages import radar

    return _drive("radar_msgs/msg/RadarTracks", lambda stamp: _stamped(radar(_messages()), stamp))


def _private() -> list[Row]:
    from tests.support.object_messages import private

    return _drive("my_msgs/msg/Things", lambda stamp: _stamped(private(_messages()), stamp))


def _stamped(message: Any, stamp: int) -> Any:
    return replace(message, header=_messages().header(stamp, bags.LIDAR_FRAME))


def _markers() -> list[Row]:
    from tests.support.object_messages import pose

    made = _messages()

    def make(stamp: int) -> Any:
        kinds = (1, 2, 3, 4, 5, 6, 8, 9, 0)
        found = [
            made.marker(bags.LIDAR_FRAME, pose(made), (4, 2, 1), ns="cars", number=n, kind=kind, text="van")
            for n, kind in enumerate(kinds)
        ]
        for one in found:
            one.header = made.header(stamp, bags.LIDAR_FRAME)
            one.points = [made.make("geometry_msgs/msg/Point", x=1.0, y=float(i), z=0.0) for i in range(2)]
        return made.make("visualization_msgs/msg/MarkerArray", markers=found)

    return _drive("visualization_msgs/msg/MarkerArray", make)


def _filled(kind: str, topic: str = TOPIC, **values: Any) -> list[Row]:
    """Return a drive with messages that have two items in every list, except for the given fields."""

    def make(stamp: int) -> Any:
        message = fuzz._filled(_messages().store, kind, stamp)
        return replace(message, **values)

    return _drive(kind, make, topic=topic)


def _grid() -> list[Row]:
    made = _messages()

    def make(stamp: int) -> Any:
        message = fuzz._filled(made.store, "nav_msgs/msg/OccupancyGrid", stamp)
        info = replace(message.info, width=20, height=10, resolution=0.5)
        return replace(message, info=info, data=np.arange(200).astype(np.int8))

    return _drive("nav_msgs/msg/OccupancyGrid", make)


def _height_map() -> list[Row]:
    made = _messages()
    values = np.arange(12, dtype=np.float32)

    def make(stamp: int) -> Any:
        dims = [
            made.make("std_msgs/msg/MultiArrayDimension", label=label, size=size, stride=stride)
            for label, size, stride in (("column_index", 3, 12), ("row_index", 4, 4))
        ]
        layout = made.make("std_msgs/msg/MultiArrayLayout", dim=dims, data_offset=0)
        layer = made.make("std_msgs/msg/Float32MultiArray", layout=layout, data=values)
        message = fuzz._filled(made.store, "grid_map_msgs/msg/GridMap", stamp)
        info = replace(message.info, resolution=0.5, length_x=2.0, length_y=1.5)
        about = {"outer_start_index": 0, "inner_start_index": 0}
        return replace(message, info=info, layers=["elevation"], basic_layers=[], data=[layer], **about)

    return _drive("grid_map_msgs/msg/GridMap", make)


def _text(topic: str, text: str) -> list[Row]:
    made = _messages()
    return _drive("std_msgs/msg/String", lambda _: made.make("std_msgs/msg/String", data=text), topic=topic)


ROBOT = """<robot name="r"><link name="base_link"><visual><origin xyz="0 0 1" rpy="0 0 1"/><geometry>
<box size="1 2 3"/></geometry></visual></link><link name="wheel"><visual><geometry><cylinder radius="1"
length="2"/></geometry></visual></link><joint name="j" type="fixed"><parent link="base_link"/><child
link="wheel"/></joint></robot>"""


def _foxglove(image: str, encoding: str) -> list[Row]:
    """Return the drive of Foxglove's own SDK, prolonged, in protobuf or JSON."""
    from google.protobuf.json_format import MessageToDict, ParseDict

    from bevviz.messages.foxglove import parse
    from tests.support import foxglove_bags

    with tempfile.TemporaryDirectory(prefix="bevviz-torture-") as folder:
        path = foxglove_bags.write(Path(folder) / "drive.mcap", image=image)
        with path.open("rb") as file:
            found = [(s, c.topic, m.log_time, m.data) for s, c, m in make_reader(file).iter_messages() if s]
    rows = []
    period = foxglove_bags.SCANS * bags.PERIOD
    for schema, name, at, data in found:
        text = schema.data.decode("latin-1")
        fields = MessageToDict(
            parse(data, schema.name, "protobuf", text),
            preserving_proto_field_name=True,
            use_integers_for_enums=True,
        )
        for turn in range(-(-SCANS // foxglove_bags.SCANS)):
            moment = at + turn * period
            stamped = _at(fields, moment)
            if encoding == "json":
                content = json.dumps(foxglove_bags._times(stamped)).encode()
                rows.append(
                    Row(name, schema.name, moment, content, b'{"type": "object"}', "jsonschema", "json")
                )
            else:
                message = ParseDict(stamped, parse(b"", schema.name, "protobuf", text))
                content = message.SerializeToString()
                rows.append(Row(name, schema.name, moment, content, schema.data, "protobuf", "protobuf"))
    return sorted(rows, key=lambda row: row.time)


def _at(value: Any, moment: int) -> Any:
    """Return the fields of a message with every time in them replaced."""
    if isinstance(value, dict):
        told = f"{np.datetime64(moment, 'ns')}Z"
        return {key: told if key == "timestamp" else _at(item, moment) for key, item in value.items()}
    return [_at(item, moment) for item in value] if isinstance(value, list) else value


def _foxglove_kinds() -> Iterator[tuple[str, Kind]]:
    topics = {  # and the form of the drive's images
        "PointCloud": ("/LIDAR_TOP", "png"),
        "CompressedImage": ("/CAM_FRONT/image_rect_compressed", "png"),
        "RawImage": ("/CAM_FRONT/image_raw", "raw"),
        "CompressedVideo": ("/CAM_FRONT/video", "video"),
        "CameraCalibration": ("/CAM_FRONT/camera_info", "png"),
        "FrameTransforms": ("/tf", "png"),
        "FrameTransform": ("/tf_single", "png"),
        "SceneUpdate": ("/markers/annotations", "png"),
    }
    for encoding in ("protobuf", "json"):
        for name, (topic, image) in topics.items():
            yield f"foxglove.{name}, {encoding}", Kind(partial(_foxglove, image, encoding), topic)


VIDEO = {
    "CompressedVideo": "foxglove_msgs/msg/CompressedVideo",
    "FFMPEGPacket": "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
    "CompressedImage": fuzz.COMPRESSED,
}
KINDS: Mapping[str, Kind] = {
    "Livox CustomMsg": Kind(_livox),
    "PandarScan, Pandar64": Kind(partial(_pandar, "Pandar64")),
    "PandarScan, PandarQT128": Kind(partial(_pandar, "PandarQT128")),
    "PandarScan, PandarXT32": Kind(partial(_pandar, "PandarXT32")),
    "VelodyneScan": Kind(_velodyne),
    "Ouster PacketMsg": Kind(_ouster, "/ouster/lidar_packets"),
    "Ouster metadata": Kind(_ouster, "/ouster/metadata", needed=True),
    **{
        f"CompressedPointCloud2, {form}": Kind(partial(_compressed_cloud, form))
        for form in ("zstd", "zlib", "draco")
    },
    **{f"{name}, h264": Kind(partial(_video, kind), videos.VIDEO) for name, kind in VIDEO.items()},
    "CompressedVideo, h265": Kind(partial(_video, VIDEO["CompressedVideo"], "h265"), videos.VIDEO),
    **{f"{kind}Objects": Kind(partial(_objects, kind)) for kind in ("Detected", "Tracked", "Predicted")},
    "RadarTracks": Kind(_radar),
    "MarkerArray": Kind(_markers),
    "MarkerArray as boxes": Kind(_markers, settings=(f"source.boxes={{topic: {TOPIC}}}",)),
    "private boxes": Kind(
        _private,
        settings=(
            f"source.boxes={{topic: {TOPIC}, center: pose.position, size: dimensions, label: class_name, "
            "yaw: heading, score: confidence, id: number}",
        ),
    ),
    "OccupancyGrid": Kind(_grid),
    "GridMap": Kind(_height_map),
    "LaserScan": Kind(
        partial(
            _filled,
            "sensor_msgs/msg/LaserScan",
            range_min=0.1,
            range_max=50.0,
            ranges=np.linspace(0, 60, 100, dtype=np.float32),
            intensities=np.zeros(100, np.float32),
        )
    ),
    "Path": Kind(partial(_filled, "nav_msgs/msg/Path")),
    "PoseStamped": Kind(partial(_filled, "geometry_msgs/msg/PoseStamped")),
    "NavSatFix": Kind(partial(_filled, "sensor_msgs/msg/NavSatFix")),
    "Imu": Kind(partial(_filled, "sensor_msgs/msg/Imu")),
    "Odometry": Kind(partial(_filled, "nav_msgs/msg/Odometry", child_frame_id="robot")),
    "DiagnosticArray": Kind(partial(_filled, "diagnostic_msgs/msg/DiagnosticArray")),
    "robot description": Kind(partial(_text, "/robot_description", ROBOT), "/robot_description"),
    "mark": Kind(partial(_text, "/bevviz/mark", "look at the van"), "/bevviz/mark"),
    **dict(_foxglove_kinds()),
}


# --- what is done to a message -----------------------------------------------------------------


def _flipped(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.randrange(1, 9)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _numbered(data: bytearray, rng: random.Random) -> None:
    """Set a number anywhere in the message to an extreme value."""
    at = rng.randrange(0, max(1, len(data) - 8), 4)
    numbers = (2**31 - 1, 2**31, 2**32 - 1, 10**6, 65535, 0, 0x7FC00000, 0xFF800000)
    data[at : at + 4] = struct.pack("<I", rng.choice(numbers))


def _doubled(data: bytearray, rng: random.Random) -> None:
    """Set a number of eight bytes to NaN or to an extreme value."""
    at = rng.randrange(0, max(1, len(data) - 8), 4)
    numbers = (float("nan"), float("inf"), -float("inf"), 1e308, -1e300, 5e-324, 0.0)
    data[at : at + 8] = struct.pack("<d", rng.choice(numbers))


def _spliced(data: bytearray, rng: random.Random) -> None:
    """Copy a stretch of the message over another stretch."""
    size = rng.randrange(1, max(2, len(data) // 2))
    source, target = (rng.randrange(max(1, len(data) - size)) for _ in range(2))
    data[target : target + size] = data[source : source + size]


def _repeated(data: bytearray, rng: random.Random) -> None:
    at = rng.randrange(len(data))
    data[at:at] = data[at : at + rng.randrange(1, 64)] * rng.choice([1, 2, 50, 1000])


CHANGES = (*fuzz.CHANGES, _flipped, _numbered, _doubled, _spliced, _repeated)
ODD: Sequence[Any] = (
    *(None, True, "", "text", "\0", "9" * 400, -1, 2**31, 2**63, 2**70, 1e308, -0.5, [], {}),
    *([None], [1, "a"], [[[[]]]], {"x": 1}, float("nan"), float("inf")),
)


def _reworded(text: bytes, rng: random.Random) -> bytes:
    """Change or remove one to three values of a JSON message."""
    tree = json.loads(text)
    for _ in range(rng.randrange(1, 4)):
        places = list(_places(tree))
        if not places:
            break
        holder, key = rng.choice(places)
        what = rng.randrange(6)
        if what == 0:
            del holder[key]
        elif what == 1 and isinstance(holder, list):
            holder.extend(holder * 3)
        else:
            holder[key] = deepcopy(rng.choice(ODD))
    return json.dumps(tree).encode()


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every container in a tree with each of its keys."""
    keys = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in keys:
        yield value, key
        yield from _places(value[key])


def changed(row: Row, rng: random.Random) -> Row:
    """Return the row with a damaged message or a damaged definition."""
    if row.form != "jsonschema" and rng.random() < CHANGED_DEFINITIONS:
        if row.form == "ros2msg":
            return replace(row, definition=fuzz.renamed(row.definition.decode(), rng).encode())
        definition = bytearray(row.definition)
        rng.choice(CHANGES)(definition, rng)
        return replace(row, definition=bytes(definition))
    if row.encoding == "json" and rng.random() < 0.8:
        return replace(row, data=_reworded(row.data, rng))
    data = bytearray(row.data)
    rng.choice(CHANGES)(data, rng)
    return replace(row, data=bytes(data))


def case(name: str, rows: Sequence[Row], number: int, seed: int) -> tuple[int, Row]:
    """Return the index of a case in its drive, and the changed row."""
    victims = [place for place, row in enumerate(rows) if row.topic == KINDS[name].topic]
    victims = victims[2:] or victims
    place = victims[number % min(len(victims), BATCH)]
    return place, changed(rows[place], random.Random(f"{seed} {name} {number}"))


def bombs(name: str, rows: Sequence[Row]) -> list[tuple[int, Row]]:
    """Small messages of a kind that ask for a lot: of memory, or of time."""
    if not name.startswith("CompressedPointCloud2, z"):
        return []
    zeros = bytes(1 << 24)
    if name.endswith("zstd"):
        stream = zstd.ZstdCompressor()
        packed = b"".join(stream.compress(zeros) for _ in range(160)) + stream.flush()
    else:
        packer = zlib.compressobj()
        packed = b"".join(packer.compress(zeros) for _ in range(160)) + packer.flush()
    victims = [place for place, row in enumerate(rows) if row.topic == TOPIC]
    store, kind = _messages().store, COMPRESSED
    message: Any = store.deserialize_cdr(rows[victims[-1]].data, kind)
    message = replace(message, compressed_data=np.frombuffer(packed, np.uint8))
    data = bytes(store.serialize_cdr(message, kind))
    return [(victims[-1], replace(rows[victims[-1]], data=data))]


# --- the trial ---------------------------------------------------------------------------------


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write a bag; a definition that is another one has a channel of its own."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2")
        channels: dict[tuple[str, bytes], int] = {}
        for row in rows:
            key = row.topic, row.definition
            if key not in channels:
                schema = writer.register_schema(row.type, row.form, row.definition)
                channels[key] = writer.register_channel(row.topic, row.encoding, schema)
            writer.add_message(channels[key], row.time, row.data, row.time)
        writer.finish()  # type: ignore[no-untyped-call]


def read_frames(argument: tuple[Path, Sequence[str]]) -> Outcome:
    """Read a bag as commands do: its description and its frames.

    ``said`` has the seconds, the number of frames, what ended the reading, and the warnings.
    """
    from bevviz.bags.source import BagSource
    from bevviz.config import load
    from bevviz.errors import UserError
    from bevviz.pipeline.bag_info import describe_bag, render_bag_info

    path, settings = argument
    outcome, frames, ended = Outcome(), 0, ""
    warnings: Sequence[str] = ()
    start = time.perf_counter()
    try:
        config = load(settings=settings)
        render_bag_info(describe_bag([path], config))
        with BagSource([path], config) as source:
            for _ in source:
                frames += 1
            warnings = source.warnings
    except UserError as error:
        ended = str(error)
    except Exception:
        outcome.traceback = traceback.format_exc()
    outcome.said = [f"{time.perf_counter() - start:.3f}", str(frames), ended, *warnings]
    return outcome


def fault(outcome: Outcome) -> str:
    """Return what is wrong with the reading of a drive; empty if nothing is."""
    if outcome.hung:
        return "hangs"
    if outcome.traceback:
        return "tracebacks"
    if float(outcome.said[0]) > SLOW:
        return "slow"
    if outcome.memory > MEMORY:
        return "large"
    return "ended" if outcome.said[2] else ""


class Trial:
    """The cases of one kind.

    Args:
        name: of the kind.
        worker: reads the drives.
        folder: for the bags.
    """

    def __init__(self, name: str, worker: Worker, folder: Path) -> None:
        self._name, self._worker, self._path = name, worker, folder / "drive.mcap"
        self.rows = KINDS[name].rows()
        sound = self.read({})  # what is loaded and compiled once counts for no case
        refused = [text for text in sound.said[3:] if "could not be used" in text]
        if fault(sound) not in ("", "slow", "large") or sound.said[1] == "0" or refused:
            raise RuntimeError(f"{name}: the sound drive: {sound.traceback or sound.said}")

    def read(self, cases: Mapping[int, Row]) -> Outcome:
        """Read the drive with these rows in the places of its own."""
        write(self._path, [cases.get(place, row) for place, row in enumerate(self.rows)])
        return self._worker.do(read_frames, (self._path, KINDS[self._name].settings))

    def judge(self, cases: Mapping[int, Row], numbers: Mapping[int, int], tally: Tally) -> None:
        """Count what comes of a drive with these cases; ``numbers`` has the case of each place."""
        outcome = self.read(cases)
        tally.cases += len(cases)
        tally.memory = max(tally.memory, outcome.memory)
        if not outcome.hung and outcome.said:
            tally.slowest = max(tally.slowest, float(outcome.said[0]))
        kind = fault(outcome)
        if kind and not (kind == "ended" and KINDS[self._name].needed):
            setattr(tally, kind, getattr(tally, kind) + 1)
            guilty = self._guilty(cases, kind)
            which = ", ".join(str(numbers.get(place, "a bomb")) for place in guilty)
            last = (outcome.traceback.strip().splitlines() or outcome.said[2:3])[-1:]
            where = [line.strip() for line in outcome.traceback.splitlines() if "/bevviz/" in line][-1:]
            told = f"{outcome.said[0]} s, {outcome.memory:.0f} MB" if kind in ("slow", "large") else ""
            tally.examples.append("; ".join([f"{self._name}, case {which}: {kind}", told, *last, *where]))

    def _guilty(self, cases: Mapping[int, Row], kind: str) -> list[int]:
        """Return the index of one case that has the fault alone, or of several that have it together."""
        places = list(cases)
        while len(places) > 1:
            halves = places[: len(places) // 2], places[len(places) // 2 :]
            fitting = (h for h in halves if fault(self.read({place: cases[place] for place in h})) == kind)
            half = next(fitting, None)
            if half is None:
                break
            places = half
        return places


def run(seed: int, each: int, names: Sequence[str] = tuple(KINDS)) -> Iterator[tuple[str, Tally]]:
    """Change ``each`` messages of every kind; yields a tally for each kind."""
    bar = tqdm(total=each * len(names), unit="message", desc="messages", disable=None)
    with tempfile.TemporaryDirectory(prefix="bevviz-torture-") as folder, Worker() as worker, bar:
        for name in names:
            trial, tally = Trial(name, worker, Path(folder)), Tally()
            number = 0
            while number < each:
                cases, numbers = dict[int, Row](), dict[int, int]()
                while number < each:
                    place, row = case(name, trial.rows, number, seed)
                    if place in cases:
                        break
                    cases[place], numbers[place] = row, number
                    number += 1
                trial.judge(cases, numbers, tally)
                bar.update(len(cases))
            for place, row in bombs(name, trial.rows):
                trial.judge({place: row}, {}, tally)
            yield name, tally


HEAD = (
    "| kind | messages | tracebacks | ended | hangs | slow | large | slowest drive, s | memory, MB |\n"
    "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
)


def row(name: str, tally: Tally) -> str:
    return (
        f"| {name} | {tally.cases} | {tally.tracebacks} | {tally.ended} | {tally.hangs} | {tally.slow} "
        f"| {tally.large} | {tally.slowest:.2f} | {tally.memory:.0f} |"
    )
