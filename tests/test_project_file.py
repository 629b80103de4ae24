"""What a project states once: ``bevviz.toml`` and ``BEVVIZ_MODEL``; and one parameter explained."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from bevviz.cli import main
from bevviz.config import load, stated_lines
from bevviz.config.project import read_project_layers
from bevviz.errors import UserError
from tests.support import bags
from tests.support.recordings import Recording

Capture = pytest.CaptureFixture[str]

PROJECT = """model = "nets/yolo.onnx"
config = "robot.yaml"
preset = "reference"
voxel_size = "3 cm"
[source]
lidar_topics = ["/points"]
[clustering]
eps = "60 cm"
"""


@pytest.fixture(autouse=True)
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "runs" / "monday").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "runs" / "monday")
    for name in ("BEVVIZ_MODEL", "DISPLAY", "WAYLAND_DISPLAY", "NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "robot.yaml").write_text("clustering: {eps: 0.9, min_points: 7}\n")
    path = tmp_path / "bevviz.toml"
    path.write_text(PROJECT)
    return path


def test_a_project_file_in_a_parent_folder_is_found() -> None:
    config = load(layers=read_project_layers(Path.cwd(), {}))
    assert config.detector.model == "../../nets/yolo.onnx"
    assert config.preset == "reference"
    assert config.source.lidar_topics == ("/points",)
    assert (config.clustering.eps, config.clustering.min_points, config.voxel.size) == (0.6, 7, 0.03)


def test_the_nearest_project_file_is_used(project: Path) -> None:
    (project.parent / "runs" / "bevviz.toml").write_text("[clustering]\neps = 0.8\n")
    config = load(layers=read_project_layers(Path.cwd(), {}))
    assert (config.clustering.eps, config.detector.model, config.preset) == (0.8, "", "default")


@pytest.mark.parametrize("model", ["demo", "mine:Detector", "topic:/detections", ""])
def test_values_that_are_no_paths_stay_unchanged(project: Path, model: str) -> None:
    project.write_text(f'model = "{model}"\n')
    if "mine" not in model:  # which is code, and asks for trust
        assert load(layers=read_project_layers(Path.cwd(), {})).detector.model == model
    (layer,) = read_project_layers(Path.cwd(), {})
    assert layer.values.get("detector.model", "") == model


def test_options_override_project_and_environment(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Command line, environment, project file, preset."""

    def model(*more: str) -> str:
        assert main(["config", "detector.model", *more]) == 0
        return capsys.readouterr().out

    assert '"../../nets/yolo.onnx"' in model() and "stated by  ../../bevviz.toml" in model()
    monkeypatch.setenv("BEVVIZ_MODEL", "other.onnx")
    assert '"other.onnx"' in model() and "stated by  BEVVIZ_MODEL" in model()
    assert '"demo"' in model("--set", "detector.model=demo")
    assert main(["config", "clustering.min_points", "--set", "min_cluster_size=9"]) == 0
    assert "clustering.min_points = 9" in capsys.readouterr().out
    Path("mine.yaml").write_text("clustering: {eps: 0.7}\npreset: default\n")
    assert main(["config", "clustering.eps", "--config", "mine.yaml"]) == 0
    said = capsys.readouterr().out
    assert "clustering.eps = 0.7" in said and "stated by  mine.yaml" in said
    assert load("mine.yaml", layers=read_project_layers(Path.cwd())).preset == "default"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('modle = "x"', "unknown key 'modle'; did you mean 'model'?"),
        ("[clusterin]\neps = 1", "unknown key 'clusterin'; did you mean 'clustering'?"),
        ("[detector]\nconf = 1", "unknown key 'detector.conf'; did you mean 'detector.conf_threshold'?"),
        ("[clustering]\nepss = 1", "unknown key 'clustering.epss'; did you mean 'clustering.eps'?"),
        ('[clustering]\neps = "3 deg"', "clustering.eps is in metres, not in 'deg'"),
        ("model = 3", "model must be a valid string (given: 3)"),
        ('preset = "best"', "preset must be 'default' or 'reference'"),
        ("model = [", "is no TOML"),
    ],
)
def test_a_wrong_project_is_one_clear_line(project: Path, capsys: Capture, text: str, said: str) -> None:
    project.write_text(text)
    assert main(["config"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("bevviz: error: ../../bevviz.toml: ")
    assert said in line


def test_a_missing_file_of_a_project_is_one_line(project: Path) -> None:
    project.write_text('config = ["robot.yaml", "absent.yaml"]')
    with pytest.raises(UserError, match=r"\.\./\.\./absent\.yaml: cannot read"):
        read_project_layers(Path.cwd(), {})


def test_the_origin_of_values_is_shown(project: Path) -> None:
    config = load(settings=["fusion.min_iou=0.2"], layers=read_project_layers(Path.cwd(), {}))
    assert stated_lines(config, folders=False) == [
        "bevviz.toml: clustering.eps, voxel.size, source.lidar_topics, preset, detector.model",
        "robot.yaml: clustering.min_points",
        "command line: fusion.min_iou",
    ]
    assert config == load(base=config) == pickle.loads(pickle.dumps(config))
    assert load(base=config).stated == config.stated


def test_info_and_recordings_name_the_project(tmp_path: Path, project: Path, capsys: Capture) -> None:
    project.write_text("[clustering]\neps = 0.6\n")
    bags.write(Path("drive"), bags.small_items(scans=3))
    assert main(["info", "drive"]) == 0
    assert "configured by\n  ../../bevviz.toml: clustering.eps\n" in capsys.readouterr().out
    assert main(["bag", "drive", "--save", "out.rrd", "--set", "fusion.min_iou=0.2"]) == 0
    (text,) = Recording(Path("out.rrd")).static["/config"]["TextDocument:text"]
    assert "- bevviz.toml: clustering.eps\n- command line: fusion.min_iou\n" in text
    capsys.readouterr()
    # A recording that stands for its bag goes on as it was made, whatever the project says by now.
    project.write_text("[clustering]\neps = 0.1\n")
    assert main(["bag", "out.rrd", "--save", "again.rrd"]) == 0
    (text,) = Recording(Path("again.rrd")).static["/config"]["TextDocument:text"]
    assert "eps: 0.6" in text


def test_one_parameter_is_explained(capsys: Capture, project: Path) -> None:
    project.unlink()
    assert main(["config", "cluster_tolerance"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "clustering.eps = 0.5",
        "  DBSCAN neighbourhood radius",
        "  unit       metres; a unit can be given: m, cm, mm",
        "  allowed    above 0, at most 20",
        "  presets    default: 0.5, reference: 0.5",
        "  tutorial   cluster_tolerance, which is accepted, too",
        "  stated by  the preset, default",
        "  change it  --set clustering.eps=VALUE, in YAML 'clustering: {eps: VALUE}', "
        "in bevviz.toml under [clustering]",
    ]
    assert main(["config", "voxel"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "voxel.size = 0.1"
    assert main(["config", "clustering.epss"]) == 2
    assert "did you mean 'clustering.eps'?" in capsys.readouterr().err


@pytest.mark.parametrize("preset", ["default", "reference"])
def test_every_parameter_can_be_explained(preset: str, project: Path, capsys: Capture) -> None:
    from bevviz.config import parameters
    from bevviz.config.descriptions import describe_parameters

    config = load(preset=preset)  # type: ignore[arg-type]
    for key in parameters():
        text = describe_parameters(key, config)
        assert text.startswith(f"{key} = ") and "stated by" in text and "None" not in text, text
