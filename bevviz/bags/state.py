"""What a source remembers between two frames, so that another process goes on from there."""

from __future__ import annotations

import io
import pickle
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from bevviz.bags.recording import RawMessage, Recording
from bevviz.frame import Image
from bevviz.ros.messages import MessageError, decode_compressed_image, decode_image
from bevviz.sync.damage import Damage
from bevviz.sync.feed import ImageLoader
from bevviz.sync.synchronizer import Synchronizer
from bevviz.sync.video import Video

HEAD = 128  # bytes of a message that tell it from others of the same time: stamp and frame are in them


@dataclass(slots=True)
class ReadingState:
    """Between two messages of a recording, or between two frames that one of them completed.

    Attributes:
        sync: what waits and what holds.
        stop: log time that nothing is read after.
        number: of the last scan met, from the first that is read; -1: none.
        numbers: time of receipt -> numbers of the scans that are not yet delivered.
        reached: log time of the last message read, and how many of that time were.
        damage: messages that could not be used.
    """

    sync: Synchronizer
    stop: int
    number: int = -1
    numbers: dict[int, list[int]] = field(default_factory=dict)
    reached: tuple[int, int] | None = None
    damage: Damage = field(default_factory=Damage)


@dataclass(frozen=True, slots=True)
class Losses:
    """What the synchroniser's report counts when it makes frames, and not where it skims them."""

    images: int
    without_image: Counter[str]
    undecodable: Counter[str]
    first_undecodable: dict[str, str]
    problems: Counter[str]
    oddities: dict[str, str]

    @staticmethod
    def of(sync: Synchronizer) -> Losses:
        r = sync.report
        return Losses(r.images, r.without_image, r.undecodable, r.first_undecodable, r.problems, r.oddities)

    @staticmethod
    def forget(sync: Synchronizer) -> None:
        """Count anew."""
        r = sync.report
        r.images = 0
        r.without_image, r.undecodable, r.problems = Counter(), Counter(), Counter()
        r.first_undecodable = {}

    def add_to(self, sync: Synchronizer) -> None:
        """Those of a window, to the report of who skimmed it."""
        r = sync.report
        r.images += self.images
        r.without_image += self.without_image
        r.undecodable += self.undecodable
        r.problems += self.problems
        for mine, others in ((r.first_undecodable, self.first_undecodable), (r.oddities, self.oddities)):
            for key, text in others.items():
                mine.setdefault(key, text)


def dumps(state: ReadingState) -> bytes:
    """As bytes. Images that wait are told by where they are in the recording, and so is video."""
    file = io.BytesIO()
    _Pickler(file, pickle.HIGHEST_PROTOCOL).dump(state)
    return file.getvalue()


def loads(content: bytes, recording: Recording) -> ReadingState:
    """``recording`` is the same one, opened by whoever goes on."""
    state = _Unpickler(io.BytesIO(content), recording).load()
    assert isinstance(state, ReadingState)
    return state


@dataclass(frozen=True, slots=True)
class _Place:
    """Of a message in a recording."""

    topic: str
    received: int
    size: int
    head: bytes

    @staticmethod
    def of(message: RawMessage) -> _Place:
        return _Place(message.topic, message.received, len(message.data), bytes(message.data[:HEAD]))


@dataclass(frozen=True, slots=True)
class _PlacedImage:
    """As ``ImageLoader``, of a message that is looked up when the image is needed."""

    place: _Place
    compressed: bool
    recording: Recording

    def __call__(self) -> Image:
        place = self.place
        for message in self.recording.messages([place.topic], place.received, place.received + 1):
            if _Place.of(message) == place:
                decode_pixels = decode_compressed_image if self.compressed else decode_image
                return decode_pixels(self.recording.decode(message), place.topic, place.received)
        raise MessageError(f"{place.topic}: an image is gone from the recording")


class _Pickler(pickle.Pickler):
    def persistent_id(self, obj: object) -> tuple[object, ...] | None:
        if isinstance(obj, ImageLoader):
            return "image", _Place.of(obj.message), obj.compressed
        if isinstance(obj, _PlacedImage):
            return "image", obj.place, obj.compressed
        if isinstance(obj, Video):
            return "video", obj.topic
        return None


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, recording: Recording) -> None:
        super().__init__(file)
        self._recording = recording
        self._videos: dict[str, Video] = {}

    def persistent_load(self, pid: Any) -> _PlacedImage | Video:
        if pid[0] == "video":
            return self._videos.setdefault(pid[1], Video(pid[1], self._recording.packets))
        _, place, compressed = pid
        return _PlacedImage(place, compressed, self._recording)
