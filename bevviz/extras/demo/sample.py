"""Write the drive that ships with bevviz: ``python -m bevviz.extras.demo.sample bevviz/data/demo.mcap``.

Few scans, positions in steps of 1/128 m and images as JPEG keep it below 8 MB. There is a child in it whom
the reference preset takes for ground.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from bevviz.extras.demo.bag import write_bag
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.extras.demo.sensors import Lidar
from bevviz.model.frame import Frame

FRAMES = 16
PLANT = ("small_child",)
BEAMS, AZIMUTHS = 64, 1400
STEPS = 128  # of a position in a metre: the LiDAR's noise is larger
QUALITY = 85  # of the JPEGs


def main(path: Path) -> None:
    """Simulate the drive and write it to an MCAP file."""
    source = SyntheticSource(FRAMES, plant=PLANT, lidar=Lidar(BEAMS, AZIMUTHS))
    write_bag(source, path, _compact(source), compress=True)


def _compact(source: SyntheticSource) -> Iterator[Frame]:
    """Yield the frames with rounded positions, whole intensities, and images as JPEG."""
    for frame in source:
        cloud, camera = frame.clouds[0], frame.cameras[0]
        assert camera.image is not None
        xyz = (np.round(cloud.xyz * STEPS) / STEPS).astype(np.float32)
        intensity = (cloud.fields["intensity"] / 16).astype(np.uint8) * np.uint8(16)
        cloud = replace(cloud, xyz=xyz, fields={"intensity": intensity})
        jpeg = cv2.imencode(".jpg", camera.image.bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
        image = replace(camera.image, encoded=jpeg)
        yield replace(frame, clouds=(cloud,), cameras=(replace(camera, image=image),))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
