from __future__ import annotations

from pathlib import Path

import pytest

from bevviz import config
from bevviz.errors import UserError


def test_reference_preset_is_the_tutorial() -> None:
    reference = config.load(preset="reference")
    assert reference.voxel.size == 0.05
    assert reference.ground.method == "plane"
    assert reference.ground.distance_threshold == 0.5
    assert (reference.clustering.eps, reference.clustering.min_points) == (0.5, 50)
    assert reference.detector.conf_threshold == 0.25
    assert (reference.fusion.method, reference.fusion.match_radius) == ("centroid", 150.0)
    assert (reference.bev.range_x, reference.bev.range_y, reference.bev.resolution) == (10, 10, 0.05)


@pytest.mark.parametrize("preset", ["default", "reference"])
def test_a_printed_config_is_read_back(tmp_path: Path, preset: config.Preset) -> None:
    made = config.load(settings=["source.extrinsics={'base cam': [1, 2, 3, 0, 0, 0, 1]}"], preset=preset)
    file = tmp_path / "c.yaml"
    file.write_text(config.config_yaml(made))
    assert config.load(file) == made


def test_every_parameter_is_explained() -> None:
    assert all(one.text for key, one in config.parameters().items() if key != "preset")


def test_later_settings_win(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("preset: reference\nclustering: {eps: 0.7, min_points: 20}\nvoxel_size: 3 cm\n")
    made = config.load(file, ["cluster_tolerance=0.9"])
    assert (made.preset, made.clustering.eps, made.clustering.min_points) == ("reference", 0.9, 20)
    assert made.voxel.size == pytest.approx(0.03)


def test_command_line_preset_wins_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("preset: reference\n")
    made = config.load(file, preset="default")
    assert made == config.load()


@pytest.mark.parametrize(
    ("setting", "key", "value"),
    [
        ("clustering.eps=60 cm", "clustering.eps", 0.6),
        ("clustering.eps=600mm", "clustering.eps", 0.6),
        ("sync.tolerance=50 ms", "sync.tolerance", 0.05),
        ("ground.max_slope=0.2 rad", "ground.max_slope", 11.459155902616466),
        ("fusion.match_radius=100 px", "fusion.match_radius", 100.0),
        ("ground.sensor_height=173 cm", "ground.sensor_height", 1.73),
        ("max_cluster_size=1000", "clustering.max_cluster_points", 1000),
        ("detector.model=", "detector.model", ""),
        ("detector.classes=[person, car]", "detector.classes", ("person", "car")),
    ],
)
def test_units_and_tutorial_names(setting: str, key: str, value: object) -> None:
    section, name = key.split(".")
    got = getattr(getattr(config.load(settings=[setting]), section), name)
    assert got == (pytest.approx(value) if isinstance(value, float) else value)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("clustering.epss=1", "did you mean 'clustering.eps'?"),
        ("eps=1", "did you mean 'clustering.eps'?"),
        ("cluster_tolerence=1", "did you mean 'cluster_tolerance'?"),
        ("clustering.eps=30 deg", "is in metres, not in 'deg'"),
        ("sync.tolerance=100", "less than or equal to 10, in seconds (given: 100)"),
        ("clustering.eps=abc", "must be a valid number"),
        ("clustering.eps=-1", "must be greater than 0"),
        ("bev.resolution=0.001", "must leave 1 to 65500 cells a side"),
        ("bev.resolution=0.004", "at most 300 million in all, not 20000 x 20000"),
        ("ground.method=plan", "must be one of polar, plane, module:function, or topic:"),
        ("nonsense", "expected key=value"),
        ("detector.names=[a", "is not valid YAML"),
    ],
)
def test_a_wrong_setting_is_one_clear_line(setting: str, said: str) -> None:
    with pytest.raises(UserError) as caught:
        config.load(settings=[setting])
    assert said in str(caught.value)
    assert f"--set {setting}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_wrong_file_is_one_clear_line(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    for text, said in [
        ("clustering: {eps: 0.5, leaf: 3}\n", "unknown key 'clustering.leaf'"),
        ("clustering:\n  eps: [\n", "line 3 is not valid YAML"),
        ("- a\n", "expected 'section: {key: value}' lines"),
        ("clustering: {min_points: many}\n", "clustering.min_points must be a valid integer"),
    ]:
        file.write_text(text)
        with pytest.raises(UserError, match=str(file)) as caught:
            config.load(file)
        assert said in str(caught.value)
    with pytest.raises(UserError, match="No such file"):
        config.load(tmp_path / "absent.yaml")


@pytest.mark.parametrize("ranges", [(500, 1, 0.012), (4, 40, 10)])
def test_a_raster_that_is_no_image_is_refused(ranges: tuple[float, float, float]) -> None:
    keys = ("bev.range_x", "bev.range_y", "bev.resolution")
    settings = [f"{key}={value}" for key, value in zip(keys, ranges, strict=True)]
    with pytest.raises(UserError, match=r"bev\.resolution must leave 1 to 65500 cells a side"):
        config.load(settings=settings)
    assert config.load(settings=["bev.resolution=0.011"]).bev.resolution == 0.011


def test_clusters_that_could_have_no_size_are_refused() -> None:
    said = r"clustering\.max_cluster_points must not be below .* is 20 \(given: 10\)"
    for settings in (
        ["clustering.min_cluster_points=20", "clustering.max_cluster_points=10"],
        ["min_cluster_size=5", "clustering.min_cluster_points=20", "max_cluster_size=10"],
    ):
        with pytest.raises(UserError, match=said):
            config.load(settings=settings)
    least = config.load(settings=["clustering.max_cluster_points=10"]).clustering
    assert (least.min_cluster_points, least.max_cluster_points) == (10, 10)


def test_a_recording_is_no_configuration(tmp_path: Path) -> None:
    (tmp_path / "drive.rrd").write_bytes(b"RRF2\xff")
    with pytest.raises(UserError, match=r"drive\.rrd is a recording; --config takes a YAML file"):
        config.load(tmp_path / "drive.rrd")
