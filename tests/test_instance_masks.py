"""Instance masks: where they lie in the image, and that the fusion takes the points in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun as rr
from hypothesis import given
from hypothesis import strategies as st

from bevviz.config import FusionConfig, load
from bevviz.model.decisions import mask_evidence
from bevviz.model.frame import F32, Bool
from bevviz.model.results import Detections, FrameResult, Fusion, Masks
from bevviz.recording import entities
from bevviz.recording.images import log_detections
from bevviz.recording.writer import Writer
from bevviz.report.fingerprints import detections_of as recorded
from bevviz.report.fingerprints import digest, pack, unpack
from bevviz.stages.clustering import cluster
from bevviz.stages.fusion import fuse
from bevviz.stages.mask_lookup import is_covered
from tests.support import kept_drives
from tests.support.fusion_scenes import (
    CAMERA,
    CAMERA_FROM_LIDAR,
    CLUSTERING,
    claim,
    detections_of,
    project_to_camera,
    silhouette,
    slab,
)
from tests.support.recordings import Recording

PERSON = slab(8, 0, -0.7, 0.5, 1.7)
BUSH = slab(8, 0.6, -0.7, 0.5, 1.7)  # in the person's box, and touching it
POINTS = np.concatenate([PERSON, BUSH])


def masks_of(*boxes: F32, scale: float = 0.5, corner: tuple[int, int] = (0, 10)) -> Masks:
    """Make masks that cover these boxes. Their grid is half as fine as the image and begins above it."""
    place, cells = [], []
    for box in boxes:
        edges = np.rint((box + 0.5) * scale).astype(int) + np.array(corner * 2)
        place.append([*edges[:2], *(edges[2:] - edges[:2])])
        cells.append(np.ones(place[-1][2] * place[-1][3], bool))
    grid = np.array([scale, scale, *corner], np.float32)
    return Masks(np.packbits(np.concatenate(cells)), np.array(place, np.int32), grid)


def outcome(detections: Detections, config: FusionConfig | None = None) -> tuple[Bool, Fusion]:
    """Return which points the detection takes, and the fusion."""
    config = config or FusionConfig()
    seen = project_to_camera(POINTS, detections)
    clusters, (claims,), _ = claim(POINTS, cluster(POINTS, CLUSTERING), seen, config=config)
    assert claims is not None and seen.uv is not None and seen.depth is not None
    fusion = fuse(seen.uv, seen.depth, clusters, detections, CAMERA, CAMERA_FROM_LIDAR, config, claims)
    return np.asarray(clusters.labels == claims.cluster[0]), fusion


WIDE = detections_of([silhouette(POINTS)])
SEGMENTED = replace(WIDE, masks=masks_of(silhouette(PERSON)))


def test_points_in_the_mask_are_taken_rather_than_in_the_box() -> None:
    by_box, _ = outcome(WIDE)
    assert by_box[len(PERSON) :].mean() > 0.5, "the box alone cannot tell them apart"
    taken, fusion = outcome(SEGMENTED)
    assert taken[: len(PERSON)].mean() > 0.9
    assert taken[len(PERSON) :].mean() < 0.2  # what is within the margin
    said = mask_evidence(fusion, 0, load())
    assert said.startswith(", ") and said.endswith(f" of {len(POINTS)} points in the frustum lie in the mask")
    assert abs(int(said.split()[1]) - len(PERSON)) < 0.2 * len(PERSON)


def test_masks_can_be_switched_off() -> None:
    config = FusionConfig(masks=False)
    taken, fusion = outcome(SEGMENTED, config)
    np.testing.assert_array_equal(taken, outcome(WIDE, config)[0])
    assert mask_evidence(fusion, 0, load(settings=["fusion.masks=false"])) == ""


def test_a_mask_without_points_is_left_aside() -> None:
    x0, y0, x1, _ = WIDE.xyxy[0]
    above = np.array([x0, y0 - 20, x1, y0 - 10], np.float32)
    taken, fusion = outcome(replace(WIDE, masks=masks_of(above)))
    np.testing.assert_array_equal(taken, outcome(WIDE)[0])
    assert f"only 0 of {len(POINTS)} points in the frustum in the mask, which is left aside" in mask_evidence(
        fusion, 0, load()
    )


def test_outlines_are_where_the_masks_are(tmp_path: Path) -> None:
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "masks.rrd")
    result = project_to_camera(POINTS, SEGMENTED)
    with Writer(recording) as to:
        to.begin(0, 1, 0)
        log_detections(to, result, [])
        to.end()
    recording.disconnect()
    (strips,) = Recording(tmp_path / "masks.rrd").column(entities.MASKS.path("front"), "LineStrips2D:strips")
    outline = np.concatenate([np.array(strip) for strip in strips])
    box = silhouette(PERSON) + 0.5  # counted from the corner of the first pixel
    np.testing.assert_allclose([*outline.min(axis=0), *outline.max(axis=0)], box, atol=2.0)  # a cell


def test_a_report_has_the_masks() -> None:
    frame = kept_drives.frame(0)
    image = frame.cameras[0].image
    result = replace(project_to_camera(POINTS, SEGMENTED), camera=replace(frame.cameras[0], name="front"))
    assert image is not None
    whole = FrameResult.unprocessed(frame, load(), (result,))
    found = recorded(unpack(*pack(digest(whole))))["front", image.stamp]
    assert found.masks is not None and SEGMENTED.masks is not None
    np.testing.assert_array_equal(found.masks.cells(0), SEGMENTED.masks.cells(0))
    np.testing.assert_array_equal(found.masks.place, SEGMENTED.masks.place)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 3.0]))
def test_a_pixel_is_covered_where_its_cell_is(seed: int, margin: float) -> None:
    rng = np.random.default_rng(seed)
    shapes = rng.integers(0, 9, (3, 2))
    cells = [rng.random(shape) < 0.5 for shape in shapes]
    place = np.array([[*rng.integers(0, 20, 2), w, h] for h, w in shapes], np.int32)
    packed = np.packbits(np.concatenate([one.ravel() for one in cells]))
    masks = Masks(packed, place, np.array([0.25, 0.5, 3, 1], np.float32))
    uv = rng.uniform(-5, 60, (40, 2)).astype(np.float32)
    uv[0] = np.nan
    for d, own in enumerate(cells):
        np.testing.assert_array_equal(masks.cells(d), own)
        whole = np.zeros((64, 64), bool)
        x, y, w, h = place[d]
        whole[y : y + h, x : x + w] = own

        def at(u: float, v: float, whole: Bool = whole) -> bool:
            column, row = np.floor([(u + 0.5) * 0.25 + 3, (v + 0.5) * 0.5 + 1]).astype(int)
            return bool(column >= 0 and row >= 0 and whole[row, column])

        beside = [(0, 0), (margin, 0), (-margin, 0), (0, margin), (0, -margin)]
        expected = [any(at(u + du, v + dv) for du, dv in beside) for u, v in uv[1:].tolist()]
        assert is_covered(masks, d, uv, margin).tolist() == [False, *expected]


def test_without_masks_nothing_is_said_of_them() -> None:
    _, fusion = outcome(WIDE)
    assert fusion.detection_covered is None
    assert mask_evidence(fusion, 0, load()) == ""
