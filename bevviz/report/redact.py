"""Hide people and vehicles in images, and find the images in messages of any type."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cache
from typing import Any, TypeAlias

import cv2
import numpy as np
from rosbags.interfaces import ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_typestore

from bevviz.bags.bag import Recording
from bevviz.bags.message import RawMessage
from bevviz.bags.reader import normalized
from bevviz.config import DetectorConfig
from bevviz.config.plugins import TOPIC
from bevviz.drivers.video import decode_packet
from bevviz.errors import UserError
from bevviz.messages.decoders import MessageError
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import encode_compressed_image
from bevviz.messages.foxglove import foxglove_type
from bevviz.messages.guard import guard
from bevviz.messages.images import decode_compressed_image, decode_image
from bevviz.model.frame import F32, U8
from bevviz.report.bag_window import Edited
from bevviz.stages.detector import MAX_CANDIDATES, Detector
from bevviz.sync.video import Video

SCORE = 0.01  # Candidates from this score on are hidden: too much is better than too little.
CELLS = 8  # cells along the longer side of a box, so that a face or a plate has one or two
SMALLEST = 8  # pixels, minimum edge of a cell
MARGIN = 0.15  # of the box's width or height, added on each side
QUALITY = 95  # of encoded JPEGs

PLAIN_FOXGLOVE = {"CameraCalibration", "FrameTransform", "FrameTransforms"}  # types without images
PEOPLE = re.compile(r"person|people|pedestrian|rider|cyclist|human|man\b|child|face|head")
VEHICLES = re.compile(
    r"car\b|van\b|truck|bus\b|tram|train|motor|bike|bicycle|cycle|trailer|caravan|vehicle|taxi|scooter|plate"
)

Definitions: TypeAlias = Mapping[str, Any]  # message type -> (constants, fields), as rosbags returns them

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CLOUD, OLD_CLOUD = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/PointCloud"
PLAIN = {"nav_msgs/msg/OccupancyGrid"}  # Its bytes are occupancy values, no pixels.
# Types with encoded images that this module cannot decode.
PICTURES = re.compile(r"image|video|ffmpeg|theora|h26[45]|jpeg|png|disparity", re.IGNORECASE)
COLOUR_FIELDS = {"rgb", "rgba", "r", "red", "color"}  # fields of a cloud that shows an image
PIXELS = {"uint8", "int8", "byte", "octet", "char", "uint16", "int16"}
SMALL = 256  # Arrays of up to this many values hold no image, but for example a key or a name.


class Redactor:
    """Editor that hides people and vehicles in the image messages of a recording.

    A box is hidden with ``MARGIN`` around it. It is divided into at most ``CELLS`` x ``CELLS`` cells. Each
    cell gets its mean colour. The whole box of a vehicle is hidden, because a plate may be anywhere in it.
    Objects that the detector misses stay visible.

    Args:
        config: the detector. Its thresholds, limits and classes are not used.
        recording: recording of the messages.
        lidars: topics whose clouds are kept even if their points have colours.
        unredacted: patterns of topics that are written even if their content is unknown.

    Raises:
        UserError: there is no model, or it detects no people or no vehicles.
    """

    def __init__(
        self,
        config: DetectorConfig,
        recording: Recording,
        lidars: Collection[str] = (),
        unredacted: Sequence[str] = (),
    ) -> None:
        if not config.model or config.model.startswith(TOPIC):
            raise UserError(
                "--redact needs a detector that finds people and vehicles: give --model FILE.onnx"
            )
        settings = {
            "classes": (),
            "conf_threshold": SCORE,
            "explain_threshold": SCORE,
            # No suppression: a box that reaches outside the image could suppress another.
            "iou_threshold": 1.0,
            "max_candidates": MAX_CANDIDATES,
        }
        self._detector = Detector(config.model_copy(update=settings))
        names = [name.lower() for name in self._detector.names]
        for kind, pattern in (("people", PEOPLE), ("vehicles, which plates are on", VEHICLES)):
            if not any(pattern.search(name) for name in names):
                raise UserError(
                    f"--redact: {config.model} finds no {kind}, but {', '.join(names) or 'unnamed'}"
                )
        self._recording, self._lidars, self._unredacted = recording, lidars, unredacted
        self._videos = {
            topic.name: Video(topic.name, recording.packets)
            for topic in recording.topics
            if topic.kind == "CompressedVideo"
        }
        self._contents: dict[tuple[str, MessageDefinition], ImageFinder] = {}
        self._left_out: Counter[str] = Counter()
        self.images = 0
        self.hidden = 0  # hidden boxes

    @property
    def notes(self) -> list[str]:
        """Messages that are missing in the report, one sentence each."""
        return [f"{n} message(s) of {why}" for why, n in self._left_out.items()]

    def __call__(self, message: RawMessage, data: bytes | memoryview) -> Edited:
        """Return the message to write. None: its content is unknown.

        A message without people and vehicles is unchanged. Each image of a video becomes a CompressedImage
        of its own.
        """
        keep_unknown = any(fnmatchcase(message.topic, pattern) for pattern in self._unredacted)
        try:
            if message.topic in self._videos:
                return self._edited_video(message, self._videos[message.topic])
            return message.connection, self._edited_message(message, data, keep_unknown)
        except MessageError as error:
            reason = str(error).removeprefix(f"{message.topic}: ")
            action = "as it was recorded, as --unredacted says" if keep_unknown else "left out"
            self._left_out[f"{message.topic} {action}: {reason}"] += 1
            return (message.connection, data) if keep_unknown else None

    def _edited_message(
        self, message: RawMessage, data: bytes | memoryview, keep_unknown: bool
    ) -> bytes | memoryview:
        """Return the bytes to write for a message that is no video packet."""
        msgtype = normalized(message.connection.msgtype)
        if msgtype in (IMAGE, COMPRESSED):
            return self._edited_image(message, data, msgtype == COMPRESSED)
        if message.topic in self._lidars or foxglove_type(msgtype) in PLAIN_FOXGLOVE:
            return data
        if PICTURES.search(msgtype):
            raise MessageError(f"a {msgtype} cannot be looked into")
        if not is_known(msgtype) and not keep_unknown:
            raise MessageError(f"bevviz does not know what a {msgtype} shows (--unredacted keeps it)")
        key = msgtype, message.connection.msgdef
        contents = self._contents.get(key)
        if contents is None:
            definitions = self._recording.types.fields(message.connection)
            contents = self._contents[key] = ImageFinder(msgtype, definitions)
        if not contents.may_show:
            return data
        content = self._recording.deserialize(message)
        if msgtype in (CLOUD, OLD_CLOUD):
            if guard(message, is_coloured, content):
                raise MessageError("its points have the colours of a picture")
            return data
        stripped, pictures = contents.without_pictures(content, lenient=keep_unknown)
        if not pictures:
            return data
        for path in pictures:
            self._left_out[f"{message.topic} without the pictures in it ({path} of {msgtype})"] += 1
        return self._recording.encode(message, stripped)

    def _edited_image(
        self, message: RawMessage, data: bytes | memoryview, compressed: bool
    ) -> bytes | memoryview:
        """Return the bytes of an image message with hidden boxes."""
        decode = decode_compressed_image if compressed else decode_image
        content = self._recording.decode(message)
        bgr = guard(message, decode, content, message.topic, message.received).bgr
        self.images += 1
        boxes = self.find(bgr)
        if not len(boxes):
            return data
        self.hidden += len(boxes)
        hidden = hide_boxes(bgr, boxes)
        values: dict[str, Any]
        if compressed:
            values = {"data": _encoded(hidden, bytes(content.data[:8]))}
        else:
            height, width = hidden.shape[:2]
            values = {
                "encoding": "bgr8",
                "is_bigendian": 0,
                "step": 3 * width,
                "data": hidden.reshape(-1),
                "height": height,
            }
        return self._recording.encode(message, replace(content, **values))

    def _edited_video(self, message: RawMessage, video: Video) -> Edited:
        """Return an image of a video as a CompressedImage with hidden boxes. None for a header."""
        content = self._recording.decode(message)
        packet = guard(message, decode_packet, content, message.topic, message.received)
        video.add(packet)
        if packet.is_header:
            return None
        bgr = video.image(packet.place).bgr
        boxes = self.find(bgr)
        self.images += 1
        self.hidden += len(boxes)
        data = _encoded(hide_boxes(bgr, boxes), b"").tobytes()
        image = encode_compressed_image(packet.stamp, packet.frame_id, data, "jpeg")
        profiles = getattr(message.connection.ext, "offered_qos_profiles", [])
        connection = message.connection._replace(
            msgtype=COMPRESSED,
            msgdef=MessageDefinition(
                MessageDefinitionFormat.MSG, typestore().generate_msgdef(COMPRESSED, ros_version=2)[0]
            ),
            digest="",
            ext=ConnectionExtRosbag2("cdr", profiles),
        )
        return connection, typestore().serialize_cdr(image, COMPRESSED)

    def find(self, bgr: U8) -> F32:
        """Return (B, 4) boxes of people and vehicles in an (H, W, 3) image, the largest last."""
        detections = self._detector(bgr)
        rows = [
            i
            for i, n in enumerate(detections.names)
            if PEOPLE.search(n.lower()) or VEHICLES.search(n.lower())
        ]
        boxes = detections.xyxy[rows]
        sizes = boxes[:, 2:] - boxes[:, :2]
        return boxes[np.argsort(sizes.prod(axis=1), kind="stable")]


def hide_boxes(bgr: U8, boxes: F32) -> U8:
    """Return a copy of an (H, W, 3) image. Flat cells hide the (B, 4) boxes and their margins."""
    hidden = bgr.copy()
    height, width = bgr.shape[:2]
    for x0, y0, x1, y1 in grow_boxes(boxes, width, height):
        region = hidden[y0:y1, x0:x1]
        edge = max(SMALLEST, -(-max(region.shape[:2]) // CELLS))
        cells = [max(1, side // edge) for side in region.shape[1::-1]]
        means = cv2.resize(region, cells, interpolation=cv2.INTER_AREA)
        region[:] = cv2.resize(means, region.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return hidden


def grow_boxes(boxes: F32, width: int, height: int) -> Sequence[tuple[int, int, int, int]]:
    """Return the boxes with their margin in whole pixels: first column and row, and those after the last.

    A box outside the image is left out.
    """
    pixels = []
    for x0, y0, x1, y1 in boxes.tolist():
        dx, dy = MARGIN * (x1 - x0) + 2, MARGIN * (y1 - y0) + 2
        left, top = max(0, int(np.floor(x0 - dx + 0.5))), max(0, int(np.floor(y0 - dy + 0.5)))
        right, bottom = min(width, int(np.ceil(x1 + dx + 0.5))), min(height, int(np.ceil(y1 + dy + 0.5)))
        if left < right and top < bottom:
            pixels.append((left, top, right, bottom))
    return pixels


def _encoded(bgr: U8, magic: bytes) -> U8:
    """Encode an image in the format of the magic bytes: PNG without loss, JPEG and WebP with little loss."""
    form, options = ".jpg", [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    if magic.startswith(b"\x89PNG"):
        form, options = ".png", []
    elif magic.startswith(b"RIFF"):
        form, options = ".webp", [cv2.IMWRITE_WEBP_QUALITY, QUALITY]
    _, data = cv2.imencode(form, bgr, options)
    encoded: U8 = data.reshape(-1)
    return encoded


# --- fields that may hold an image, by the message definition ----------------------------------


@cache
def known_types() -> frozenset[str]:
    """Return the message types of ROS, whose fields are all documented."""
    stores = (get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC))
    return frozenset(name for store in stores for name in store.fielddefs)


def is_known(msgtype: str) -> bool:
    """Return whether the meaning of its fields is known. This includes every version of vision_msgs."""
    return msgtype in known_types() or msgtype.startswith(("vision_msgs/", "tf2_msgs/"))


def is_coloured(cloud: Any) -> bool:
    """Return whether a PointCloud2 or PointCloud has the colours of an image."""
    columns = cloud.fields if hasattr(cloud, "fields") else cloud.channels
    return not COLOUR_FIELDS.isdisjoint(column.name.lower() for column in columns)


class ImageFinder:
    """Search for images in the messages of one type.

    Args:
        msgtype: the normalised type.
        definitions: definitions of this type and of all types in it.

    Raises:
        MessageError: a type in it is not defined.
    """

    def __init__(self, msgtype: str, definitions: Definitions) -> None:
        self._msgtype, self._definitions = msgtype, definitions
        self._inside: dict[str, bool] = {}
        self.may_show = self._look(msgtype)

    def without_pictures(self, message: Any, lenient: bool = False) -> tuple[Any, Counter[str]]:
        """Return the message with every image and coloured cloud emptied, and the paths of these fields.

        Args:
            message: the decoded message.
            lenient: keep bytes of unknown meaning.

        Raises:
            MessageError: the message has bytes of unknown meaning.
        """
        emptied: Counter[str] = Counter()
        return self._strip(message, self._msgtype, "", emptied, lenient), emptied

    def _look(self, msgtype: str, within: tuple[str, ...] = ()) -> bool:
        """Return whether a type may hold images. Every type within it is looked up."""
        if msgtype in self._inside:
            return self._inside[msgtype]
        if msgtype not in self._definitions or msgtype in within:
            raise MessageError(f"nobody knows what a {msgtype} is made of")
        inside = msgtype in _EMPTIED
        for _, kind in self._definitions[msgtype][1]:
            inside |= self._is_opaque(msgtype, kind)
            if inner_type := _inner_type(kind):
                inside |= self._look(inner_type, (*within, msgtype))
        self._inside[msgtype] = inside
        return inside

    def _is_opaque(self, msgtype: str, kind: Any) -> bool:
        """Return whether a field is an array of bytes or numbers that may be pixels."""
        node, about = kind
        if node not in (Nodetype.ARRAY, Nodetype.SEQUENCE) or msgtype in PLAIN:
            return False
        (element, basic), length = about
        if element != Nodetype.BASE or 0 < length <= SMALL:
            return False
        return basic[0] in PIXELS or msgtype.endswith("MultiArray")

    def _strip(self, message: Any, msgtype: str, path: str, emptied: Counter[str], lenient: bool) -> Any:
        """Return a message with its images emptied. ``emptied`` counts the emptied fields by path."""
        if not self._inside[msgtype]:
            return message
        if msgtype in _EMPTIED:
            if _EMPTIED[msgtype][0](message):
                emptied[path] += 1
                return replace(message, **_EMPTIED[msgtype][1])
            return message
        changed = {}
        for name, kind in self._definitions[msgtype][1]:
            value, inner = getattr(message, name), f"{path}.{name}".lstrip(".")
            if self._is_opaque(msgtype, kind):
                if len(value) > SMALL and not lenient:
                    raise MessageError(f"nobody can tell what the {len(value)} values of '{inner}' show")
            elif (inner_type := _inner_type(kind)) and self._inside[inner_type]:
                if kind[0] == Nodetype.NAME:
                    changed[name] = self._strip(value, inner_type, inner, emptied, lenient)
                else:
                    changed[name] = [
                        self._strip(element, inner_type, inner, emptied, lenient) for element in value
                    ]
        return replace(message, **changed)


def _inner_type(kind: Any) -> str:
    """Return the message type of a field, or an empty text for a basic type."""
    node, about = kind
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        node, about = about[0]
    return str(about) if node == Nodetype.NAME else ""


_NOTHING = np.zeros(0, np.uint8)
_EMPTIED: Mapping[str, tuple[Callable[[Any], bool], Mapping[str, Any]]] = {
    IMAGE: (lambda image: len(image.data) > 0, {"height": 0, "width": 0, "step": 0, "data": _NOTHING}),
    COMPRESSED: (lambda image: len(image.data) > 0, {"data": _NOTHING}),
    CLOUD: (
        lambda cloud: len(cloud.data) > 0 and is_coloured(cloud),
        {"height": 0, "width": 0, "row_step": 0, "data": _NOTHING},
    ),
    OLD_CLOUD: (is_coloured, {"points": [], "channels": []}),
}
