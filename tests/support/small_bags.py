"""Small bags with one fault of a sensor."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.support import bags


def frozen_after(seconds: float, path: Path) -> Path:
    """Write 12 s of a drive whose camera repeats one image from a moment on."""
    messages, image = bags.Messages(), np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8)
    items = [
        item._replace(message=messages.image(item.received, image))
        if item.topic == bags.IMAGE and item.received >= bags.START + seconds * 1e9
        else item
        for item in bags.small_items(messages, scans=120)
    ]
    return bags.write(path, items, messages)
