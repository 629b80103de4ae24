"""Fuzzed messages: each is decoded by itself, then a run goes over a drive that has them among sound ones."""

from __future__ import annotations

import contextlib
import io
import random
import struct
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from tqdm import tqdm

from benchmarks.torture.worker import Outcome, Worker
from tests.support import bags

BATCH = 40  # messages in a bag
TF, ODOMETRY = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"
DETECTION_2D, DETECTION_3D = "vision_msgs/msg/Detection2DArray", "vision_msgs/msg/Detection3DArray"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
TOPICS: Mapping[str, str] = {
    bags.CLOUD: "sensor_msgs/msg/PointCloud2",
    bags.IMAGE: "sensor_msgs/msg/Image",
    "/rear/image/compressed": COMPRESSED,
    bags.INFO: "sensor_msgs/msg/CameraInfo",
    "/tf": TF,
    "/tf_static": TF,
    "/odom": ODOMETRY,
    "/detections": DETECTION_2D,
    "/boxes": DETECTION_3D,
}
Row = tuple[str, int, bytes, str]
"""Topic, log time, serialised message, and the definition of its type."""


@dataclass
class Fuzzed:
    """Result of the fuzzed messages."""

    messages: int = 0
    refused: int = 0  # with one clear line
    tracebacks: int = 0
    runs: int = 0  # over a drive that has them
    broken: int = 0  # of those that ended in something else than a recording
    hangs: int = 0
    slowest: float = 0.0  # seconds to decode one
    memory: float = 0.0  # MB at most, for the messages of one bag
    examples: list[str] = field(default_factory=list)


# --- messages ----------------------------------------------------------------------------------


def sound(scans: int = 4) -> list[Row]:
    """Return a short drive with every kind of message that is decoded, in order of log time."""
    messages = bags.Messages()
    store = messages.store
    found = [
        (i.topic, i.received, i.type, i.message) for i in bags.small_items(messages, scans=scans, points=300)
    ]
    pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    for scan in range(scans):
        stamp = bags.START + scan * bags.PERIOD
        form = (".png", ".jpg")[scan % 2]
        encoded = cv2.imencode(form, pixels)[1].tobytes()
        found.append(
            ("/rear/image/compressed", stamp, COMPRESSED, messages.compressed(stamp, encoded, form[1:]))
        )
        found += [
            (topic, stamp, TOPICS[topic], _filled(store, TOPICS[topic], stamp))
            for topic in ("/detections", "/boxes")
        ]
    texts = {kind: store.generate_msgdef(kind, ros_version=2)[0] for kind in TOPICS.values()}
    rows = [(topic, at, bytes(store.serialize_cdr(m, kind)), texts[kind]) for topic, at, kind, m in found]
    return sorted(rows, key=lambda row: row[1])


def _filled(store: Any, kind: str, stamp: int) -> Any:
    """Make a message with two items in every list, and with plausible numbers in most fields."""
    values = {}
    for name, (node, detail) in store.fielddefs[kind][1]:
        values[name] = _value(store, node.name, detail, stamp)
    return store.types[kind](**values)


def _value(store: Any, node: str, detail: Any, stamp: int) -> Any:
    if node == "NAME":
        if detail == "builtin_interfaces/msg/Time":
            return store.types[detail](sec=stamp // 10**9, nanosec=stamp % 10**9)
        return _filled(store, detail, stamp)
    if node == "BASE":
        return "base_link" if detail[0] == "string" else True if detail[0] == "bool" else 1
    (inner, name), size = detail
    count = size if node == "ARRAY" else 2
    if inner.name == "BASE" and name[0] != "string":
        return np.ones(count, name[0])
    return [_value(store, inner.name, name, stamp) for _ in range(count)]


# --- what is done to them ----------------------------------------------------------------------


def flipped(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.randrange(1, 6)):
        data[rng.randrange(min(len(data), 400))] ^= 1 << rng.randrange(8)


def numbered(data: bytearray, rng: random.Random) -> None:
    """Set one of the first numbers to an extreme value."""
    at = rng.randrange(0, max(1, min(len(data) - 8, 400)), 4)
    numbers = (2**31 - 1, 2**31, 2**32 - 1, 10**6, 0, 0x7FC00000, 0x7F7FFFFF)
    data[at : at + 4] = struct.pack("<I", rng.choice(numbers))


def cut(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data)) :]


def grown(data: bytearray, rng: random.Random) -> None:
    at = rng.randrange(len(data))
    data[at:at] = rng.randbytes(rng.randrange(1, 64))


def noise(data: bytearray, rng: random.Random) -> None:
    at = rng.randrange(len(data))
    data[at:] = rng.randbytes(len(data) - at)


CHANGES: Sequence[Callable[[bytearray, random.Random], None]] = (
    flipped,
    numbered,
    numbered,
    cut,
    grown,
    noise,
)


def renamed(text: str, rng: random.Random) -> str:
    """Change a name or a type in a message definition."""
    words = ["data", "height", "width", "fields", "header", "stamp", "transforms", "point_step", "encoding"]
    words += ["uint32", "uint8", "float64", "string", "detections", "k", "pose", "results", "frame_id"]
    word = rng.choice([w for w in words if w in text] or words)
    return text.replace(word, rng.choice(["other", "uint8", "string", "float64", "\0", "Ünicode"]))


def png(side: int) -> bytes:
    """Make a square PNG of one bit per pixel: a small file of a large image. The largest have no pixels."""
    rows = (b"\0" + bytes(side // 8)) * (side if side <= 32_000 else 1)

    def part(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    head = part(b"IHDR", struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + part(b"IDAT", zlib.compress(rows, 9)) + part(b"IEND", b"")


def bombs() -> list[Row]:
    """Small messages that ask for a lot: of memory, or of time."""
    messages = bags.Messages()
    store, stamp = messages.store, bags.START
    small = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    at = small.index(b"\xff\xc0") + 5
    jpeg = small[:at] + struct.pack(">HH", 65_000, 65_000) + small[at + 4 :]
    found = [
        (topic, messages.compressed(stamp, data)) for topic, data in [("png", png(32_000)), ("jpeg", jpeg)]
    ]
    rows = [("/rear/image/compressed", COMPRESSED, message) for _, message in found]
    cloud = "sensor_msgs/msg/PointCloud2"
    for changes in ({"count": 10**6}, {"count": 2**32 - 1}):
        message = messages.cloud(stamp, np.zeros((10, 4), np.float32))
        message.fields[3].count, message.fields[3].datatype = changes["count"], 2
        message.point_step = 2**31 - 1
        rows.append((bags.CLOUD, cloud, message))
    for values in ({"point_step": 2**31}, {"height": 2**32 - 1, "width": 2**32 - 1}, {"height": 2**31}):
        message = messages.cloud(stamp, np.zeros((10, 4), np.float32))
        for name, value in values.items():
            setattr(message, name, value)
        rows.append((bags.CLOUD, cloud, message))
    image = messages.image(stamp, np.zeros((4, 4, 3), np.uint8))
    image.height = image.width = image.step = 2**32 - 1
    rows.append((bags.IMAGE, TOPICS[bags.IMAGE], image))
    return [
        (topic, stamp, bytes(store.serialize_cdr(m, kind)), store.generate_msgdef(kind, ros_version=2)[0])
        for topic, kind, m in rows
    ]


def fuzzed(rows: Sequence[Row], rng: random.Random) -> Row:
    topic, time_, data, text = rng.choice(rows)
    if rng.random() < 0.15:
        return topic, time_, data, renamed(text, rng)
    changed = bytearray(data)
    rng.choice(CHANGES)(changed, rng)
    return topic, time_, bytes(changed), text


# --- the trial ---------------------------------------------------------------------------------


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows as a bag. A changed definition has its own channel."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2")
        channels: dict[tuple[str, str], int] = {}
        for topic, time_, data, text in sorted(rows, key=lambda row: row[1]):
            if (topic, text) not in channels:
                schema = writer.register_schema(TOPICS[topic], "ros2msg", text.encode())
                channels[topic, text] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic, text], time_, data, time_)
        writer.finish()  # type: ignore[no-untyped-call]


def read_messages(path: Path) -> Outcome:
    """Decode every message of a bag by itself. ``said``: the slowest one's seconds, and the lines."""
    from bevviz.bags.bag import Recording
    from bevviz.messages import camera_info, clouds, detections, images, transforms
    from bevviz.messages.decoders import MessageError
    from bevviz.messages.guard import guard

    of_type: dict[str, Callable[[Any, str], object]] = {
        "PointCloud2": lambda m, topic: clouds.decode_cloud(m, topic, 0),
        "Image": lambda m, topic: images.decode_image(m, topic, 0),
        "CompressedImage": lambda m, topic: images.decode_compressed_image(m, topic, 0),
        "CameraInfo": lambda m, topic: camera_info.decode_camera_info(m, False, topic),
        "TFMessage": lambda m, topic: transforms.decode_transforms(m, topic),
        "Odometry": lambda m, topic: transforms.decode_odometry(m, topic),
        "Detection2DArray": lambda m, topic: detections.decode_detections_2d(m, topic, 0),
        "Detection3DArray": lambda m, topic: detections.decode_detections_3d(m, topic, 0),
    }
    outcome, slowest = Outcome(), 0.0
    with Recording([path]) as recording:
        for message in recording.messages([topic.name for topic in recording.topics]):
            start = time.perf_counter()
            try:
                with contextlib.suppress(MessageError):
                    message.header()
                decoded = recording.decode(message)
                decode = of_type[message.connection.msgtype.rpartition("/")[2]]
                guard(message, decode, decoded, message.topic)
            except MessageError as error:
                outcome.said.append(str(error))
            except Exception:
                outcome.traceback += traceback.format_exc()
            slowest = max(slowest, time.perf_counter() - start)
    outcome.said.insert(0, f"{slowest:.3f}")
    return outcome


def run_over(path: Path) -> Outcome:
    """Run bevviz over a bag. ``said`` of the outcome has the exit status."""
    from bevviz.cli import main

    outcome = Outcome()
    noise_ = io.StringIO()
    try:
        with contextlib.redirect_stdout(noise_), contextlib.redirect_stderr(noise_):
            status = main(["bag", str(path), "--save", str(path.with_suffix(".rrd"))])
        outcome.said = [str(status), *noise_.getvalue().splitlines()[-3:]]
    except Exception:
        outcome.traceback = traceback.format_exc()
    return outcome


def run(seed: int, messages: int) -> Iterator[Fuzzed]:
    """Fuzz ``messages`` messages; yields once, at the end."""
    rng, rows, total = random.Random(f"{seed} fuzz"), sound(), Fuzzed()
    with tempfile.TemporaryDirectory(prefix="bevviz-torture-") as folder, Worker() as worker:
        bar = tqdm(total=messages, unit="message", desc="fuzz", disable=None)
        write(Path(folder) / "sound.mcap", rows)
        worker.do(read_messages, Path(folder) / "sound.mcap")  # so that what is loaded once counts for nobody
        with bar:
            while total.messages < messages:
                batch = [fuzzed(rows, rng) for _ in range(min(BATCH, messages - total.messages))]
                if not total.messages:
                    batch += bombs()
                _try(worker, Path(folder), rows, batch, total)
                bar.update(len(batch))
    yield total


def _try(worker: Worker, folder: Path, rows: Sequence[Row], batch: Sequence[Row], total: Fuzzed) -> None:
    alone, among = folder / "alone.mcap", folder / "among.mcap"
    write(alone, batch)
    outcome = worker.do(read_messages, alone)
    total.messages += len(batch)
    total.refused += max(0, len(outcome.said) - 1)
    total.tracebacks += outcome.traceback.count("Traceback (most recent call last)")
    total.memory = max(total.memory, outcome.memory)
    total.slowest = max([total.slowest, *map(float, outcome.said[:1])])
    write(among, [*rows, *((t, at + 1, data, text) for t, at, data, text in batch)])
    ran = worker.do(run_over, among)
    total.runs += 1
    total.broken += int(ran.said[:1] != ["0"])
    for one in (outcome, ran):
        total.hangs += int(one.hung)
        if one.traceback or one.hung:
            total.examples.append(one.traceback or "a hang")
    if ran.said[:1] not in (["0"], []):
        total.examples.append(" ".join(ran.said))


HEAD = (
    "| messages | refused in one line | tracebacks | runs over a drive with them | that failed | hangs "
    "| slowest, s | memory, MB |\n| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
)


def row(total: Fuzzed) -> str:
    return (
        f"| {total.messages} | {total.refused} | {total.tracebacks} | {total.runs} | {total.broken} "
        f"| {total.hangs} | {total.slowest:.2f} | {total.memory:.0f} |"
    )
