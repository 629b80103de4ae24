"""Images of ROS messages as arrays."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from io import BytesIO
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from bevviz.messages.decoders import MessageError, frame_name, stamp_ns
from bevviz.messages.topics import VIDEO
from bevviz.model.frame import U8, Image
from bevviz.support.limits import MOST_PIXELS


class _Encoding(NamedTuple):
    to_bgr: int | None  # conversion code of OpenCV; None: it is BGR already
    channels: int = 1
    scalar: str = "u1"
    rows: float = 1.0  # rows of data per row of pixels


_ENCODINGS: Mapping[str, _Encoding] = {
    "bgr8": _Encoding(None, 3),
    "rgb8": _Encoding(cv2.COLOR_RGB2BGR, 3),
    "bgra8": _Encoding(cv2.COLOR_BGRA2BGR, 4),
    "rgba8": _Encoding(cv2.COLOR_RGBA2BGR, 4),
    "mono8": _Encoding(cv2.COLOR_GRAY2BGR),
    "mono16": _Encoding(cv2.COLOR_GRAY2BGR, scalar="u2"),
    "8UC1": _Encoding(cv2.COLOR_GRAY2BGR),
    "8UC3": _Encoding(None, 3),
    "8UC4": _Encoding(cv2.COLOR_BGRA2BGR, 4),
    "16UC1": _Encoding(cv2.COLOR_GRAY2BGR, scalar="u2"),
    "bayer_rggb8": _Encoding(cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": _Encoding(cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": _Encoding(cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": _Encoding(cv2.COLOR_BayerGRBG2BGR),
    "bayer_rggb16": _Encoding(cv2.COLOR_BayerRGGB2BGR, scalar="u2"),
    "bayer_bggr16": _Encoding(cv2.COLOR_BayerBGGR2BGR, scalar="u2"),
    "bayer_gbrg16": _Encoding(cv2.COLOR_BayerGBRG2BGR, scalar="u2"),
    "bayer_grbg16": _Encoding(cv2.COLOR_BayerGRBG2BGR, scalar="u2"),
    "yuv422": _Encoding(cv2.COLOR_YUV2BGR_UYVY, 2),
    "uyvy": _Encoding(cv2.COLOR_YUV2BGR_UYVY, 2),
    "yuv422_yuy2": _Encoding(cv2.COLOR_YUV2BGR_YUY2, 2),
    "yuyv": _Encoding(cv2.COLOR_YUV2BGR_YUY2, 2),
    "nv12": _Encoding(cv2.COLOR_YUV2BGR_NV12, rows=1.5),
    "nv21": _Encoding(cv2.COLOR_YUV2BGR_NV21, rows=1.5),
}


def decode_image(msg: Any, topic: str, received: int) -> Image:
    """Decode a sensor_msgs/Image to BGR. bgr8 without row padding is a view of the message's data.

    Images of 16 bits are reduced to 8 bits, see ``to_8_bits``.

    Raises:
        MessageError: the encoding is not supported, the image has no pixels, or it has fewer data than its
            size needs.
    """
    encoding = _ENCODINGS.get(msg.encoding)
    if encoding is None:
        raise MessageError(
            f"{topic}: image encoding '{msg.encoding}' is not supported; "
            f"supported are {', '.join(_ENCODINGS)}"
        )
    width, height = int(msg.width), int(msg.height)
    if not width or not height:
        raise MessageError(f"{topic}: the image is {width} x {height} and has no pixels")
    data = np.frombuffer(msg.data, np.uint8)
    scalar = np.dtype((">" if msg.is_bigendian else "<") + encoding.scalar)
    rows, pixel_bytes = int(height * encoding.rows), encoding.channels * scalar.itemsize
    step = int(msg.step) or width * pixel_bytes
    if data.size == rows * width * pixel_bytes:  # Rows without padding: the stated step is wrong.
        step = width * pixel_bytes
    needed = (rows - 1) * step + width * pixel_bytes
    if step < width * pixel_bytes or data.size < needed:
        raise MessageError(
            f"{topic}: a {width} x {height} {msg.encoding} image needs {rows} rows of "
            f"{width * pixel_bytes} bytes, but step is {step} and there are {data.size} bytes of data"
        )
    pixels = np.ndarray(
        (rows, width, encoding.channels), scalar, data, strides=(step, pixel_bytes, scalar.itemsize)
    )
    if scalar.itemsize == 2:
        pixels = to_8_bits(np.asarray(pixels, np.uint16))
    try:
        bgr = pixels if encoding.to_bgr is None else cv2.cvtColor(pixels, encoding.to_bgr)
    except cv2.error as error:
        raise MessageError(
            f"{topic}: a {width} x {height} image cannot be {msg.encoding} (OpenCV: {error.err})"
        ) from None
    return Image(
        stamp=stamp_ns(msg.header.stamp),
        frame_id=frame_name(msg.header.frame_id),
        bgr=np.ascontiguousarray(bgr),
        topic=topic,
        received=received,
    )


def to_8_bits(pixels: NDArray[np.uint16]) -> U8:
    """Scale 16 bit pixels to 8 bits, by the bit depth that the brightest pixel needs.

    Images of sensors with 10, 12 and 14 bits are published with 16 bits, mostly not shifted. The full scale
    is the smallest of 8, 10, 12, 14 and 16 bits that holds every pixel.
    """
    brightest = int(pixels.max())
    depth = next(bits for bits in (8, 10, 12, 14, 16) if brightest < 1 << bits)
    scaled: U8 = cv2.convertScaleAbs(pixels, alpha=255.0 / ((1 << depth) - 1))
    return scaled


_MEDIA_TYPES = {  # by the first bytes
    "image/jpeg": re.compile(rb"\xff\xd8\xff"),
    "image/png": re.compile(rb"\x89PNG\r\n\x1a\n"),
    "image/webp": re.compile(rb"RIFF.{4}WEBP", re.DOTALL),
}
# Raw Bayer pixels that compressed_image_transport compressed. A following "mono8" or "bgr8" names its result.
_MOSAIC = re.compile(r"(bayer_(?:rggb|bggr|gbrg|grbg)(?:8|16)); \w+ compressed\s*$")
_ANNEX_B = (b"\0\0\0\1", b"\0\0\1")  # start code of every unit of an H.264 or H.265 stream


def decode_compressed_image(msg: Any, topic: str, received: int) -> Image:
    """Decode a JPEG, PNG or WebP in a sensor_msgs/CompressedImage.

    The data tell the kind, because the format field has many spellings. The encoded bytes are kept unless
    Rerun cannot show them: WebP; PNG of 16 bits, which would look different from the image that ``to_8_bits``
    scaled; and the raw pixels of a colour sensor (Bayer).

    Raises:
        MessageError: the image is a depth image, of another kind, damaged, cut, or larger than
            ``MOST_PIXELS``. The size is checked before the pixels are decoded.
    """
    if "compressedDepth" in msg.format:
        raise MessageError(f"{topic}: '{msg.format}' is a depth image; choose a topic with colour images")
    data = np.frombuffer(msg.data, np.uint8)
    encoded = data.tobytes()
    media_type = next((kind for kind, magic in _MEDIA_TYPES.items() if magic.match(encoded)), "")
    if encoded.startswith(_ANNEX_B):
        raise MessageError(f"{topic}: '{msg.format}' is {VIDEO}")
    if not media_type:
        raise MessageError(
            f"{topic}: compressed image of format '{msg.format}' holds neither JPEG, PNG nor WebP data "
            f"({len(encoded)} bytes)"
        )
    width, height = encoded_size(encoded)
    if width * height > MOST_PIXELS:
        raise MessageError(
            f"{topic}: an image of {width} x {height} pixels is not taken: {MOST_PIXELS} at most"
        )
    cut = not width or not height
    if media_type == "image/jpeg" and encoded.rfind(b"\xff\xd9") < 0:
        cut = True  # OpenCV would fill the missing part with grey
    # EXIF's orientation is ignored: the calibration is for the pixels as they are stored.
    mosaic = _MOSAIC.match(msg.format)
    demosaic = _ENCODINGS[mosaic[1]].to_bgr if mosaic else None
    channels = cv2.IMREAD_GRAYSCALE if mosaic else cv2.IMREAD_COLOR
    flags = channels | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = None if cut else cv2.imdecode(data, flags)
    except cv2.error:
        bgr = None
    if bgr is None:
        raise MessageError(f"{topic}: the {media_type} data ({len(encoded)} bytes) is damaged or cut")
    deep = bgr.dtype == np.uint16
    bgr = to_8_bits(bgr) if deep else bgr
    if demosaic is not None:
        bgr = cv2.cvtColor(bgr, demosaic)
    kept = not deep and not mosaic and media_type != "image/webp"
    return Image(
        stamp=stamp_ns(msg.header.stamp),
        frame_id=frame_name(msg.header.frame_id),
        bgr=bgr,
        encoded=encoded if kept else None,
        media_type=media_type if kept else "",
        topic=topic,
        received=received,
    )


def encoded_size(encoded: bytes) -> tuple[int, int]:
    """Return width and height from the header of a PNG, JPEG or WebP; 0 if the header is missing or cut."""
    if encoded.startswith(b"RIFF"):
        return _size_of_webp(encoded)
    if encoded.startswith(b"\x89PNG"):
        at = 8
        while encoded[at + 4 : at + 8] != b"IEND":  # a decoder allocates a chunk before it reads it
            at += 12 + int.from_bytes(encoded[at : at + 4], "big")
            if at + 8 > len(encoded):
                return 0, 0
        return int.from_bytes(encoded[16:20], "big"), int.from_bytes(encoded[20:24], "big")
    from PIL.JpegImagePlugin import JpegImageFile

    try:
        size: tuple[int, int] = JpegImageFile(BytesIO(encoded)).size
    except Exception:  # Pillow raises errors of many kinds for damaged bytes.
        return 0, 0
    return size


def _size_of_webp(encoded: bytes) -> tuple[int, int]:
    """Return width and height from the header of a WebP (RFC 9649).

    Pillow would make a decoder, with memory for all pixels, before it knows them.
    """
    if len(encoded) < max(30, 8 + int.from_bytes(encoded[4:8], "little")):
        return 0, 0
    first, bits = encoded[12:16], int.from_bytes(encoded[21:25], "little")
    if first == b"VP8X":  # with alpha, a colour profile or several pictures
        return 1 + int.from_bytes(encoded[24:27], "little"), 1 + int.from_bytes(encoded[27:30], "little")
    if first == b"VP8L":  # lossless
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", encoded, 26)
    return (width & 0x3FFF, height & 0x3FFF) if first == b"VP8 " else (0, 0)
