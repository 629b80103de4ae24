"""What a source remembers between two frames, so that another process goes on from there."""

from __future__ import annotations

import io
import pickle
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from bevviz.bags.message import RawMessage
from bevviz.bags.recording import Recording
from bevviz.ros.messages import MessageError
from bevviz.sync.damage import Damage
from bevviz.sync.feed import Loader
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
    damage: Damage
    problems: Counter[str]
    oddities: dict[str, str]

    @staticmethod
    def of(sync: Synchronizer) -> Losses:
        r = sync.report
        decoded = r.images, r.without_image, r.undecodable, r.first_undecodable, r.damage
        return Losses(*decoded, r.problems, r.oddities)

    @staticmethod
    def forget(sync: Synchronizer) -> None:
        """Count anew."""
        r = sync.report
        r.images = 0
        r.without_image, r.undecodable, r.problems = Counter(), Counter(), Counter()
        r.first_undecodable, r.damage = {}, Damage()

    def add_to(self, sync: Synchronizer) -> None:
        """Those of a window, to the report of who skimmed it."""
        r = sync.report
        r.images += self.images
        r.without_image += self.without_image
        r.undecodable += self.undecodable
        r.problems += self.problems
        r.damage.extend(self.damage)
        for mine, others in ((r.first_undecodable, self.first_undecodable), (r.oddities, self.oddities)):
            for key, text in others.items():
                mine.setdefault(key, text)


def dumps(state: ReadingState) -> bytes:
    """As bytes. Messages that wait to be decoded, and video, are told by where they are in the recording."""
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
class _Placed:
    """As ``Loader``, of a message that is looked up when it is needed."""

    place: _Place
    read: Callable[[Any, str, int], Any]
    recording: Recording

    def __call__(self) -> Any:
        place = self.place
        for message in self.recording.messages([place.topic], place.received, place.received + 1):
            if _Place.of(message) == place:
                return self.read(self.recording.decode(message), place.topic, place.received)
        raise MessageError(f"{place.topic}: a message is gone from the recording")


class _Pickler(pickle.Pickler):
    def persistent_id(self, obj: object) -> tuple[object, ...] | None:
        if isinstance(obj, Loader):
            return "message", _Place.of(obj.message), obj.read
        if isinstance(obj, _Placed):
            return "message", obj.place, obj.read
        if isinstance(obj, Video):
            return "video", obj.topic
        return None


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, recording: Recording) -> None:
        super().__init__(file)
        self._recording = recording
        self._videos: dict[str, Video] = {}

    def persistent_load(self, pid: Any) -> _Placed | Video:
        if pid[0] == "video":
            return self._videos.setdefault(pid[1], Video(pid[1], self._recording.packets))
        _, place, read = pid
        return _Placed(place, read, self._recording)
