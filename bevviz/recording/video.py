"""Encode camera images as an H.264 stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import av
import numpy as np
from av.video.frame import PictureType
from av.video.reformatter import ColorRange, Colorspace

from bevviz.model.frame import U8

GOP = 1_000_000_000  # nanoseconds between key frames, at most
QUALITY = "20"  # constant rate factor of x264, with hardly visible loss
BT709 = 1  # entry in H.264's tables of matrices, primaries and transfer functions


@dataclass(frozen=True, slots=True)
class Sample:
    """One encoded image in Annex B format. A key frame can be decoded without earlier images."""

    data: bytes
    key: bool


class VideoEncoder:
    """Encoder of images to H.264. There are no B-frames, so each image is complete at once.

    H.264 needs an even number of rows and columns. An odd last row or column is repeated.
    """

    def __init__(self) -> None:
        self._context: av.VideoCodecContext | None = None
        self._size: tuple[int, int] = (0, 0)
        self._key_stamp = 0  # stamp of the last key frame
        self._count = 0
        self._forces_key = True

    def restart(self) -> None:
        """Make the next image a key frame."""
        self._forces_key = True

    def __call__(self, bgr: U8, stamp: int) -> Sample:
        """Encode the next image.

        Args:
            bgr: (H, W, 3) image.
            stamp: nanoseconds.
        """
        if self._context is None or bgr.shape[:2] != self._size:
            self._size, self._count = (bgr.shape[0], bgr.shape[1]), 0
            self._context, self._forces_key = _open_encoder(bgr), True
        key = self._forces_key or not 0 <= stamp - self._key_stamp < GOP
        if key:
            self._key_stamp, self._forces_key = stamp, False
        frame = av.VideoFrame.from_ndarray(_pad_to_even(bgr), format="bgr24").reformat(
            format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
        )
        frame.pts = self._count
        frame.pict_type = PictureType.I if key else PictureType.NONE
        self._count += 1
        return Sample(b"".join(bytes(packet) for packet in self._context.encode(frame)), key)


def decode(samples: Sequence[bytes]) -> list[U8]:
    """Decode samples to (H, W, 3) BGR images. The first sample is a key frame."""
    context = av.CodecContext.create("h264", "r")
    assert isinstance(context, av.VideoCodecContext)
    packets = [av.Packet(sample) for sample in samples]
    frames = [frame for packet in [*packets, None] for frame in context.decode(packet)]
    return [np.asarray(frame.to_ndarray(format="bgr24"), np.uint8) for frame in frames]


def _open_encoder(bgr: U8) -> av.VideoCodecContext:
    height, width = (side + side % 2 for side in bgr.shape[:2])
    context = av.CodecContext.create("libx264", "w")
    assert isinstance(context, av.VideoCodecContext)
    context.width, context.height, context.pix_fmt = width, height, "yuv420p"
    context.time_base = Fraction(1, 10)
    context.gop_size, context.max_b_frames = 1 << 16, 0  # key frames are requested by time
    context.thread_count = 1  # the other cores are busy
    context.colorspace = context.color_primaries = context.color_trc = BT709
    context.color_range = ColorRange.MPEG
    context.options = {"preset": "superfast", "tune": "zerolatency", "crf": QUALITY, "forced-idr": "1"}
    return context


def _pad_to_even(bgr: U8) -> U8:
    height, width = bgr.shape[:2]
    if height % 2 or width % 2:
        return np.pad(bgr, ((0, height % 2), (0, width % 2), (0, 0)), "edge")
    return np.ascontiguousarray(bgr)
