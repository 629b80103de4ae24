"""Recordings that keep less: what they lack, what they must not lack, and the same by several processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader

import bevviz
from bevviz.config import LoggingConfig
from bevviz.model.frame import F32, U8
from bevviz.recording import entities
from bevviz.recording.rerun_cli import too_large_for_web
from bevviz.recording.retention import RawCloudFrame, RawCloudSelector
from bevviz.recording.video import GOP, VideoEncoder, decode
from tests.support import bags
from tests.support.recordings import Recording, verify, without_nan

SETTINGS = ("clustering.eps=2 m", "clustering.min_points=2", "tracking.min_hits=1", "logging.raw_every=21")
SCANS, DARK = 24, 12  # scans, and the one without an image
TENTH = 100_000_000  # nanoseconds


# --- which raw clouds --------------------------------------------------------------------------


@given(
    steps=st.lists(st.integers(1, 4), min_size=1, max_size=60),
    strange=st.sets(st.integers(0, 59)),
    asked_for=st.sets(st.integers(0, 59), max_size=3),
    every=st.integers(1, 20),
    around=st.integers(0, 10),
    share=st.sampled_from((0.0, 0.1, 1.0)),
)
def test_raw_clouds_are_kept_around_anomalies(
    steps: list[int], strange: set[int], asked_for: set[int], every: int, around: int, share: float
) -> None:
    """Check which raw clouds are kept, each once: every n-th, and those near a strange or requested frame.

    No more clouds are held than fit into that time. A requested frame gets all clouds around it. A strange
    frame gets them the first time, and later up to a share of the frames.
    """
    stamps = (np.cumsum(steps) * TENTH).tolist()
    config = LoggingConfig(raw_every=every, raw_around=around / 10, raw_share=share)
    kept, found, at, left_out = RawCloudSelector(), list[int](), list[int](), 0
    for i, stamp in enumerate(stamps):
        for_reason = sum(one % every != 0 for one in found)
        given = RawCloudFrame((i, stamp, 0), ())
        more = kept.select(given, config, is_event=i in strange, is_requested=i in asked_for)
        found += [one.clock[0] for one in more]
        assert kept.buffered <= around + 1
        if i in asked_for or (i in strange and (not for_reason or for_reason < share * (i + 1))):
            at.append(stamp)
        elif i in strange:
            left_out += 1
    wanted = [
        i
        for i, stamp in enumerate(stamps)
        if i % every == 0 or any(abs(stamp - other) <= around * TENTH for other in at)
    ]
    assert sorted(found) == wanted
    assert kept.left_out == left_out


# --- H.264 -------------------------------------------------------------------------------------


def pictures(count: int, height: int = 95, width: int = 121) -> list[U8]:
    """Draw a disc that moves over a slope of colours."""
    y, x = np.mgrid[:height, :width]
    slope = np.stack([x * 2, y * 2, 255 - x], axis=-1).clip(0, 255).astype(np.uint8)
    return [cv2.circle(slope.copy(), (10 + 4 * i, 40), 9, (0, 200, 255), -1) for i in range(count)]


def test_each_kept_picture_shows_its_frame() -> None:
    encoder, shown = VideoEncoder(), pictures(25)
    samples = [encoder(picture, i * TENTH) for i, picture in enumerate(shown)]
    keys = [i for i, sample in enumerate(samples) if sample.key]
    assert keys == [0, 10, 20], "one a second"
    assert GOP == 10 * TENTH
    for i in (0, 7, 10, 19, 24):
        start = max(key for key in keys if key <= i)
        *_, found = decode([sample.data for sample in samples[start : i + 1]])
        assert found.shape == (96, 122, 3), "sides are even"
        assert cv2.PSNR(found[:95, :121], shown[i]) > 30


def test_gaps_begin_with_key_frames() -> None:
    encoder = VideoEncoder()
    small, large = pictures(2), pictures(2, 120, 160)
    given = [
        (small[0], 0),
        (small[1], TENTH),
        (large[0], 2 * TENTH),
        (large[1], TENTH),
        (large[0], 90 * TENTH),
    ]
    assert [encoder(*one).key for one in given] == [True, False, True, True, True]
    assert not encoder(large[1], 91 * TENTH).key
    encoder.restart()
    assert encoder(large[1], 92 * TENTH).key


# --- recordings --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    items = bags.small_items(scans=SCANS, points=1500)
    dark = [item for item in items if item.topic == bags.IMAGE][DARK]
    return bags.write(tmp_path_factory.mktemp("drive") / "bag", [item for item in items if item is not dark])


@pytest.fixture(scope="module")
def saved(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Save a recording of each kind."""
    folder = tmp_path_factory.mktemp("saved")
    found = {keep: folder / f"{keep}.rrd" for keep in ("everything", "inspect", "report")}
    for keep, path in found.items():
        with bevviz.open(bag, set=[*SETTINGS, f"logging.keep={keep}"]) as drive:
            drive.save(path)
        verify(path)
    return found


@pytest.fixture(scope="module")
def read(saved: dict[str, Path]) -> dict[str, Recording]:
    return {keep: Recording(path) for keep, path in saved.items()}


def points_at(recording: Recording, paths: list[str], frame: int) -> F32:
    found = [p for path in paths for p in recording.at[path]["Points3D:positions"].get(frame, ())]
    return np.array(found, np.float32)


@pytest.mark.long
def test_every_decision_box_track_and_explanation_is_kept(read: dict[str, Recording]) -> None:
    whole = read["everything"]
    thinned = (entities.WORLD, entities.BEV, entities.HEALTH)
    words = [entity for entity in whole.at if not entity.startswith(thinned)]
    boxes = [entity for entity in whole.at if any("Boxes" in name for name in whole.at[entity])]
    boxes += [entities.TRACKS, entities.TRAILS]
    assert {entities.EXPLAIN, entities.ANOMALY_LOG} <= set(words)
    for keep in ("inspect", "report"):
        less = read[keep]
        assert less.times == whole.times
        for entity in words:
            assert without_nan(less.at[entity]) == without_nan(whole.at[entity]), (keep, entity)
        for entity in boxes:
            for name in whole.at[entity]:
                if not name.startswith("Points"):
                    assert without_nan(less.at[entity][name]) == without_nan(whole.at[entity][name]), (
                        keep,
                        entity,
                    )


@pytest.mark.long
def test_inspect_keeps_voxels_and_raw_clouds_at_findings(
    saved: dict[str, Path], read: dict[str, Recording]
) -> None:
    whole, less = read["everything"], read["inspect"]
    (raw,) = [
        path
        for path in whole.at
        if path.endswith("/points") and path.startswith(entities.WORLD) and "/image/" not in path
    ]
    lidar = raw.split("/")[2]
    kept = less.at[raw]["Points3D:positions"]
    assert sorted(kept) == [0, *range(DARK - 5, DARK + 6), 21], "a camera is gone for a frame"
    for frame in kept:
        assert kept[frame] == whole.at[raw]["Points3D:positions"][frame], "exact"
        assert less.at[raw]["Points3D:class_ids"][frame] == whole.at[raw]["Points3D:class_ids"][frame]
    assert less.cleared(raw) == {1, DARK + 6, 22}, "nothing that is shown is older"
    places = [entities.OBSTACLES.path(lidar), entities.CLUSTERS.path(lidar)]
    for frame in (0, 7, DARK):
        before, after = points_at(whole, places[:1], frame), points_at(less, places, frame)
        assert len(before) == len(after)
        away = np.abs(before[:, None] - after[None]).max(axis=2)
        assert max(away.min(axis=0).max(), away.min(axis=1).max()) <= 1 / 32 + 1 / 128, "half a step, twice"
        for ids in (whole, less):
            columns = ids.at[entities.CLUSTERS.path(lidar)]
            assert len(columns["Points3D:class_ids"][frame]) == len(columns["Points3D:positions"][frame])
    assert saved["inspect"].stat().st_size < saved["everything"].stat().st_size
    assert saved["report"].stat().st_size < saved["inspect"].stat().st_size
    report = read["report"]
    assert raw not in report.at
    assert entities.CLUSTERS.path(lidar) in report.at


@pytest.mark.long
def test_the_recording_says_what_it_lacks(saved: dict[str, Path], read: dict[str, Recording]) -> None:
    for keep, path in saved.items():
        recording = read[keep]
        page = recording.static[entities.CONFIG]["TextDocument:text"][0]
        made = recording.static[f"/__properties/{entities.PROPERTY}"]
        assert made["keep"] == [keep]
        assert ("Not in this recording" in page) == (keep != "everything")
        assert ("left_out" in made) == (keep != "everything")
        names = " ".join(
            str(value)
            for store in RrdReader(path).blueprints()
            for chunk in RrdReader(path).stream(store=store)
            for value in chunk.to_record_batch().to_pydict().values()
        )
        assert ("raw clouds now and then" in names) == (keep != "everything")


def samples(recording: Recording) -> dict[int, Any]:
    (path,) = [path for path, columns in recording.at.items() if "VideoStream:sample" in columns]
    return recording.at[path]["VideoStream:sample"]


def test_a_recording_too_large_for_a_browser_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "drive.rrd"
    assert too_large_for_web(path, 2_000_000_000) == ""
    said = too_large_for_web(path, 10_600_000_000)
    assert "drive.rrd has 10.6 GB" in said
    assert f"rerun {path}" in said
