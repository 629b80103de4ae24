"""Convert images to inputs of networks, and boxes back to images."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import cv2
import numpy as np

from bevviz.model.frame import F32, U8

BORDER_GREY = 114  # grey of the letterbox's border, the same in all these families


class ImageFit(Enum):
    """How an image is fitted into an input of another shape."""

    CENTRE = "letterbox, the image in its middle"
    CORNER = "letterbox, the image at the top left"
    STRETCH = "stretched"
    NATIVE = "as it is, where the input's size is open, else as CENTRE"


class Resampling(Enum):
    """How pixels are interpolated, as the family was trained and tested."""

    FOUR = "of the four nearest pixels, rounded to bytes"  # OpenCV
    ALL = "of all pixels that a new one covers, rounded to bytes"  # Pillow, and torchvision for Pillow images
    UNROUNDED = "of the four nearest pixels, not rounded"  # torchvision for tensors


@dataclass(frozen=True, slots=True)
class Placement:
    """Position of an image in a network's input."""

    input_size: tuple[int, int]  # height, width
    inner: tuple[int, int]  # height, width of the image in the input
    corner: tuple[int, int]  # row and column of its first pixel in the input
    image_size: tuple[int, int]  # height, width of the original image

    def to_image(self, xyxy: F32) -> F32:
        """Convert boxes from the input to the image, in pixels from the corner of its first pixel."""
        scale = np.array([inner / image for inner, image in zip(self.inner, self.image_size, strict=True)])
        moved: F32 = xyxy - np.array(self.corner[::-1] * 2, np.float32)
        with np.errstate(over="ignore"):  # an overflow is clipped to the image later
            moved /= np.tile(scale[::-1], 2).astype(np.float32)
        return moved


@dataclass(frozen=True, slots=True)
class InputFormat:
    """Input that a family of networks was trained with, in float32."""

    fit: ImageFit
    rgb: bool = True
    divisor: float = 255.0  # 1 keeps values of 0..255
    resampling: Resampling = Resampling.FOUR
    margin: int = 0  # pixels that the letterbox keeps free in height and width
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)  # subtracted from each channel after the division
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)  # divides each channel after that

    def place(
        self, image_size: tuple[int, int], size: tuple[int, int], is_open: tuple[bool, bool], stride: int
    ) -> Placement:
        """Place an image in the input.

        Args:
            image_size: height, width.
            size: height and width of the network's input, the largest size for an open axis.
            is_open: for height and width, whether the axis may be smaller.
            stride: pixels; an open axis is a multiple of this.
        """
        if self.fit is ImageFit.STRETCH:
            return Placement(size, size, (0, 0), image_size)
        if self.fit is ImageFit.NATIVE and all(is_open):
            return Placement(image_size, image_size, (0, 0), image_size)
        original, available = np.array(image_size), np.array(size)
        exact = original * float(np.min((available - self.margin) / original))
        # Megvii truncates the size of the resized image, the other families round it.
        inner = np.maximum(
            exact.astype(int) if self.fit is ImageFit.CORNER else np.rint(exact).astype(int), 1
        )
        outer = np.where(is_open, -(-inner // stride) * stride, available)
        corner = 0 * outer if self.fit is ImageFit.CORNER else (outer - inner) // 2
        (h, w), (height, width), (top, left) = outer.tolist(), inner.tolist(), corner.tolist()
        return Placement((h, w), (height, width), (top, left), image_size)

    def blob(self, bgr: U8, where: Placement, dtype: type) -> Any:
        """Return the (1, 3, height, width) input."""
        (height, width), (top, left) = where.inner, where.corner
        inner: Any = bgr
        if self.resampling is Resampling.UNROUNDED:
            inner = bgr.astype(np.float32) / np.float32(self.divisor)
        if bgr.shape[:2] != where.inner:
            if self.resampling is Resampling.ALL:
                from PIL import Image  # imported here because few models need it

                small = Image.fromarray(bgr).resize((width, height), Image.Resampling.BILINEAR)
                inner = np.asarray(small)
            else:
                inner = cv2.resize(inner, (width, height))
        canvas = inner
        if where.inner != where.input_size:
            canvas = np.full((*where.input_size, 3), BORDER_GREY, inner.dtype)
            canvas[top : top + height, left : left + width] = inner
        blob = cv2.dnn.blobFromImage(canvas, swapRB=self.rgb)
        if canvas.dtype == np.uint8 and self.divisor != 1:
            blob /= np.float32(self.divisor)  # multiplying with the reciprocal would change the last digits
        if any(self.mean):
            blob -= np.array(self.mean, np.float32)[:, None, None]
            blob /= np.array(self.std, np.float32)[:, None, None]
        return blob.astype(dtype, copy=False)
