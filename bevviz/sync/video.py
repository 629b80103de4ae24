"""Pictures of a video, decoded from the last key frame on when a frame takes them."""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from statistics import median
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from bevviz.drivers.video import Continuity, VideoPacket
from bevviz.errors import first_line
from bevviz.messages.decoders import MessageError
from bevviz.model.frame import U8, Codec, Image, VideoClip
from bevviz.support.limits import MOST_PIXELS

if TYPE_CHECKING:
    import av
    from av.video.codeccontext import VideoCodecContext

Rewind = Callable[[str, int], Iterable[VideoPacket]]

SHOWN = ("h264", "h265", "av1", "vp8", "vp9")  # codecs that Rerun shows
HELD = 5_000_000_000  # nanoseconds after the receipt of a packet in which its image may be requested
MOST_BYTES = 64_000_000  # bytes of packets that are kept
MOST_REORDERED = 20  # decoded pictures that are kept until they are requested
UNNUMBERED = ("av1", "vp8", "vp9")  # codecs without a number by which a missing picture is noticed
STEPS = 9  # steps between packets that a longer step is compared with
_DECODERS = {"h265": "hevc", "av1": "libdav1d"}
LOW_DELAY = 0x80000  # AV_CODEC_FLAG_LOW_DELAY: return the picture of each packet at once


class Video:
    """Video of one topic, with bounded memory. Packets are added in order of receipt.

    A picture that depends on missing pictures is not returned; decoders would conceal the gap.

    Args:
        topic: topic of the packets.
        rewind: returns the packets from the last key frame before a time of receipt up to this time, from the
            recording; None: earlier packets cannot be read again.
    """

    def __init__(self, topic: str, rewind: Rewind | None = None) -> None:
        self.topic, self._rewind = topic, rewind
        self._packets: list[VideoPacket] = []
        self._size = 0  # bytes of the packets
        self._keyless = -1  # no key frame before this time of receipt
        self._headers: dict[bytes, None] = {}  # header packets of Theora
        self._decoder: _Decoder | None = None
        self._next = 0  # row of the next packet for the decoder
        self._last: Image | None = None
        self._last_place: tuple[int, int] | None = None
        self._stamp = 0  # stamp of the last packet
        self._steps: deque[int] = deque(maxlen=STEPS)  # nanoseconds between packets

    @property
    def awaits_key(self) -> bool:
        """Whether packets have come, but none from which pictures can be decoded."""
        return bool(self._packets) and self._next == 0 and not any(packet.is_key for packet in self._packets)

    def add(self, packet: VideoPacket) -> bool:
        """Add a packet.

        Returns:
            Whether packets may be missing before it, judged by its stamp, if the codec does not tell.
        """
        if packet.is_header:
            self._headers[packet.data] = None
            return False
        step = packet.stamp - self._stamp if self._stamp else 0
        usual = median(self._steps) if len(self._steps) == STEPS else math.inf
        self._stamp = packet.stamp
        self._steps.append(step)
        if packet.is_key:
            self._drop(before=packet.received - HELD)
        self._packets.append(packet)
        self._size += len(packet.data)
        if self._size > MOST_BYTES:
            self._drop(before=packet.received)
        if self._size > MOST_BYTES:  # a single group of pictures: drop the packets that the decoder has
            self._forget(self._next or len(self._packets))
        return packet.codec in UNNUMBERED and not packet.is_key and step > 1.5 * usual

    def image(self, place: tuple[int, int]) -> Image:
        """Return the picture of the packet at ``place``.

        Raises:
            MessageError: it cannot be decoded, or depends on lost packets.
        """
        if place != self._last_place or self._last is None:
            self._last = self._decode(place)
            self._last_place = place
        return self._last

    def _decode(self, place: tuple[int, int]) -> Image:
        row, key = self._find(place)
        decoder = self._decoder
        if decoder is None or not (key < self._next <= row or decoder.has(place)):
            decoder = self._decoder = _Decoder(self._packets[key].codec, tuple(self._headers))
            self._next = key
        for packet in self._packets[self._next : row + 1]:
            decoder.put(packet)
        self._next = max(self._next, row + 1)
        packet = self._packets[row]
        while decoder.waits_for(place):
            if self._next < len(self._packets):
                decoder.put(self._packets[self._next])
                self._next += 1
            else:
                decoder.finish()
                self._decoder = None
        picture = decoder.picture(place)
        if picture is None:
            why = decoder.failures.get(packet.place, "packets before it are lost or damaged")
            raise MessageError(
                f"{self.topic}: a picture of the {packet.codec.upper()} video cannot be decoded: {why}; "
                "the next key frame sets it right"
            )
        streamed = packet.codec in SHOWN and not decoder.reorders and key >= 0
        clip = self._clip(key, row) if streamed else None
        return Image(
            packet.stamp,
            packet.frame_id,
            picture,
            media_type=f"video/{packet.codec}",
            topic=self.topic,
            received=packet.received,
            clip=clip,
        )

    def _clip(self, key: int, row: int) -> VideoClip:
        before = [earlier for earlier in range(key) if self._packets[earlier].is_key]
        first = before[-1] if before else key
        packets = self._packets[first : row + 1]
        codec, places = cast("Codec", packets[0].codec), tuple(packet.place for packet in packets)
        return VideoClip(codec, places, tuple(packet.data for packet in packets), key - first)

    def _find(self, place: tuple[int, int]) -> tuple[int, int]:
        """Return the rows of the packet and of the key frame before it.

        Raises:
            MessageError: the packets are not available.
        """
        rows = self._rows_of(place)
        if rows is None and place[0] > self._keyless and self._rewind is not None:
            earlier = list(self._rewind(self.topic, place[0]))
            self._headers |= {packet.data: None for packet in earlier if packet.is_header}
            earlier = [packet for packet in earlier if not packet.is_header]
            self._packets = earlier + [p for p in self._packets if p.received > place[0]]
            self._size = sum(len(packet.data) for packet in self._packets)
            self._decoder = None
            rows = self._rows_of(place)
            if rows is None:
                self._keyless = place[0]
        if rows is None:
            raise MessageError(
                f"{self.topic}: the video begins between two key frames: what comes before the first one "
                "cannot be decoded"
            )
        return rows

    def _rows_of(self, place: tuple[int, int]) -> tuple[int, int] | None:
        rows = [row for row, packet in enumerate(self._packets) if packet.place == place]
        if not rows:
            return None
        # Packets before the first one may have been dropped after the decoder got them.
        within = 0 < self._next <= rows[-1] and self._decoder is not None
        keys = [row for row in range(rows[-1], -1, -1) if self._packets[row].is_key]
        return (rows[-1], keys[0]) if keys else ((rows[-1], -1) if within else None)

    def _drop(self, before: int) -> None:
        """Drop the groups of pictures that end before a time of receipt."""
        keys = [row for row, packet in enumerate(self._packets) if packet.is_key]
        ends = [row for row in keys if row and self._packets[row - 1].received <= before]
        self._forget(ends[-1] if ends else 0)

    def _forget(self, count: int) -> None:
        dropped, self._packets = self._packets[:count], self._packets[count:]
        self._size -= sum(len(packet.data) for packet in dropped)
        self._next -= count
        if self._next < 0:
            self._decoder, self._next = None, 0


class _Decoder:
    """Decoder of consecutive packets, from a key frame on."""

    def __init__(self, codec: str, headers: tuple[bytes, ...]) -> None:
        import av  # the import takes 0.1 s

        av.logging.set_level(None)
        self._context = cast("VideoCodecContext", av.CodecContext.create(_DECODERS.get(codec, codec), "r"))
        self._context.thread_count = 1
        self._context.flags |= LOW_DELAY
        self._context.options = {"max_pixels": str(MOST_PIXELS)}
        if codec == "theora":
            self._context.extradata = b"".join(len(h).to_bytes(2) + h for h in headers)
        self._continuity = Continuity() if codec == "h264" else None
        self._number: int | None = None  # number of the previous packet
        self._places: list[tuple[int, int]] = []
        self._broken = ""  # why pictures are incomplete until the next key frame
        self._finished = False
        self._pictures: OrderedDict[tuple[int, int], av.VideoFrame] = OrderedDict()
        self.failures: dict[tuple[int, int], str] = {}

    @property
    def reorders(self) -> bool:
        """Whether a picture may depend on later packets."""
        return bool(self._context.has_b_frames)

    def put(self, packet: VideoPacket) -> None:
        """Decode a packet."""
        import av

        lost = self._missing(packet)
        if packet.is_key:
            self._broken = ""
            self.failures.clear()
        elif lost:
            self._broken = f"{lost} packet(s) before it are lost"
        av_packet = av.Packet(packet.data)
        av_packet.pts = len(self._places)
        self._places.append(packet.place)
        self._take(av_packet)

    def _missing(self, packet: VideoPacket) -> int:
        """Return the number of packets that are missing before a packet."""
        if self._continuity is not None:
            return self._continuity.missing(packet.data)
        last, self._number = self._number, packet.number
        return 0 if last is None or packet.number is None else max(0, packet.number - last - 1)

    def finish(self) -> None:
        """Decode the pictures that wait for later packets."""
        self._finished = True
        self._take(None)

    def _take(self, packet: av.Packet[Any] | None) -> None:
        import av

        try:
            pictures = self._context.decode(packet)
        except av.FFmpegError as error:
            self.failures[self._places[-1]] = self._broken or first_line(error.strerror or error)
            return
        for picture in pictures:
            place = self._places[picture.pts or 0]
            if self._broken:
                self.failures[place] = self._broken
            else:
                self._pictures[place] = picture
        while len(self._pictures) > MOST_REORDERED:
            self._pictures.popitem(last=False)

    def has(self, place: tuple[int, int]) -> bool:
        """Return whether a picture is decoded and still kept."""
        return place in self._pictures

    def waits_for(self, place: tuple[int, int]) -> bool:
        """Return whether the next packet may complete the picture."""
        is_known = place in self._pictures or place in self.failures
        return self.reorders and not is_known and not self._finished

    def picture(self, place: tuple[int, int]) -> U8 | None:
        """Return the (H, W, 3) BGR picture; None if it was not decoded."""
        picture = self._pictures.get(place)
        return None if picture is None else np.ascontiguousarray(picture.to_ndarray(format="bgr24"))
