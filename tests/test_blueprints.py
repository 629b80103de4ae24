"""Layouts: those that come along, a user's own, and what is said of a file that makes none."""

from __future__ import annotations

import textwrap
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from bevviz.config import load
from bevviz.errors import UserError
from bevviz.model.frame import Scene
from bevviz.recording import blueprints

SCENES = {
    "lidar only": Scene("a", "lidar", ("lidar",)),
    "one camera": Scene("b", "lidar", ("lidar",), ("zed",), robot=True, truth=True),
    "many": Scene("c", "lidars", ("front", "rear"), ("left", "right", "rear_camera")),
}


def views(path: Path) -> dict[str, list[str]]:
    """Name -> contents of each view of a .rbl file."""
    return {name: contents for name, (contents, _) in properties(path).items()}


def properties(path: Path) -> dict[str, tuple[list[str], dict[str, Any]]]:
    """Name -> contents and properties of each view of a .rbl file."""
    names: dict[str, str] = {}
    contents: dict[str, list[str]] = {}
    others: dict[str, dict[str, Any]] = defaultdict(dict)
    reader = RrdReader(path)
    for chunk in reader.stream(store=reader.blueprints()[0]):
        parts = chunk.entity_path.strip("/").split("/")
        if parts[0] != "view":
            continue
        batch = chunk.to_record_batch()
        components = [name for name in batch.schema.names if ":" in name]
        for row in batch.select(components).to_pylist():
            if row.get("ViewBlueprint:display_name"):
                names[parts[1]] = row["ViewBlueprint:display_name"][0]
            if row.get("ViewContents:query"):
                contents[parts[1]] = row["ViewContents:query"]
            others[parts[1]].update(row)
    return {names[key]: (contents[key], others[key]) for key in names}


def save(layout: rrb.Blueprint, path: Path) -> Path:
    layout.save("bevviz", path)
    return path


def test_every_layout_is_listed() -> None:
    assert {"debug", "live", "bug_report"} <= set(blueprints.names())


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
@pytest.mark.parametrize("name", sorted({*blueprints.names()} - {"calib", "cameras", "compare"}))
def test_every_layout_fits_every_scene(name: str, scene: Scene, tmp_path: Path) -> None:
    found = views(save(blueprints.load(name, scene), tmp_path / "layout.rbl"))
    assert {"3D", "Bird's-eye view", *scene.cameras} <= set(found)
    assert found["3D"][:2] == ["/world/**", "/robot/**"]


def test_the_eye_follows_the_robot_and_the_explained_object(tmp_path: Path) -> None:
    scene = replace(SCENES["one camera"], focus=(10.0, 0.0, -1.0))
    _, debug = properties(save(blueprints.load("debug", scene), tmp_path / "debug.rbl"))["3D"]
    assert debug["EyeControls3D:position"] == [[-16, 5, 11]]
    assert debug["SpatialInformation:target_frame"] == ["tf#/world/lidar"]
    _, near = properties(save(blueprints.load("explain", scene), tmp_path / "explain.rbl"))["3D"]
    assert near["EyeControls3D:look_target"] == [[10, 0, -1]]
    assert near["EyeControls3D:position"] == [[-3, 4, 6]]


def test_the_views_of_the_page_show_frames_that_move(tmp_path: Path) -> None:
    scene = replace(SCENES["one camera"], moving=True)
    found = properties(save(blueprints.load("workbench", scene), tmp_path / "layout.rbl"))
    for view, name in (("3D", "space"), ("Bird's-eye view", "above"), ("zed", "zed")):
        assert found[view][1]["SpatialInformation:target_frame"] == [f"focus:{name}"]
    contents, image = found["3D"][0], found["zed"][1]
    assert "- /world/zed/**" in contents, "the viewer draws no camera in a scaled frame"
    assert image["VisualBounds2D:range"] == [{"x_range": [0, 1000], "y_range": [0, 562.5]}]


def test_the_view_from_above_starts_ahead_of_the_robot(tmp_path: Path) -> None:
    scene = SCENES["one camera"]
    path = save(blueprints.load("debug", scene, load()), tmp_path / "layout.rbl")
    _, above = properties(path)["Bird's-eye view"]
    assert above["VisualBounds2D:range"] == [{"x_range": [200, 600], "y_range": [40, 500]}]
    _, all_of_it = properties(save(blueprints.load("debug", scene), tmp_path / "all.rbl"))["Bird's-eye view"]
    assert not all_of_it.get("VisualBounds2D:range")


def test_logs_show_frame_time_and_text(tmp_path: Path) -> None:
    _, log = properties(save(blueprints.load("debug", SCENES["one camera"]), tmp_path / "layout.rbl"))["Log"]
    (columns,) = (value for name, value in log.items() if name.endswith("timeline_columns"))
    assert [column["timeline"] for column in columns] == ["frame", "stamp"]
    (parts,) = (value for name, value in log.items() if name.endswith("text_log_columns"))
    assert len(parts) == 1


def test_the_explained_chain_is_in_its_layout_alone(tmp_path: Path) -> None:
    scene = SCENES["one camera"]
    explain = views(save(blueprints.load("explain", scene), tmp_path / "explain.rbl"))
    assert explain["3D"][2:] == ["/explain/why/**"]
    assert "/explain/why/zed/**" in explain["zed"]
    assert "Why" in explain
    debug = views(save(blueprints.load("debug", scene), tmp_path / "debug.rbl"))
    assert not any("/explain/why/**" in contents for contents in debug.values())


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
def test_compare_has_both_sides(scene: Scene, tmp_path: Path) -> None:
    found = views(save(blueprints.load("compare", scene), tmp_path / "layout.rbl"))
    for side, root, other in (("A", "", "b"), ("B", "/b", "a")):
        assert {f"{name} {side}" for name in ("3D", "Bird's-eye view", *scene.cameras)} <= set(found)
        assert f"{root}/world/**" in found[f"3D {side}"]
        assert f"/compare/objects/only_{other}/**" not in found[f"3D {side}"]
        for camera in scene.cameras:
            image = f"/world/{camera}/image"
            assert found[f"{camera} {side}"][:2] == [image, f"{root}{image}/**"]
    assert "Differences" in found


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
def test_the_layout_of_a_calibration_has_every_camera(scene: Scene, tmp_path: Path) -> None:
    found = views(save(blueprints.load("calib", scene), tmp_path / "layout.rbl"))
    assert {f"{camera}, {how}" for camera in scene.cameras for how in ("as stated", "corrected")} <= set(
        found
    )
    assert ("image time, ms" in found) == bool(scene.cameras)


def test_a_python_file_of_the_user_is_a_layout(tmp_path: Path) -> None:
    own = tmp_path / "own.py"
    own.write_text(
        textwrap.dedent("""
            import rerun.blueprint as rrb
            from bevviz.recording import views

            def blueprint(scene):
                cameras = [views.camera(scene, name) for name in scene.cameras]
                return rrb.Blueprint(rrb.Tabs(views.space(scene), *cameras))
        """)
    )
    layout = blueprints.load(str(own), SCENES["many"])
    assert set(views(save(layout, tmp_path / "own.rbl"))) == {"3D", "left", "right", "rear_camera"}


def test_a_saved_layout_is_sent_on_as_it_is(tmp_path: Path) -> None:
    original = save(blueprints.load("live", SCENES["one camera"]), tmp_path / "original.rbl")
    again = save(blueprints.load(str(original), SCENES["lidar only"]), tmp_path / "again.rbl")
    assert views(again) == views(original)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.py", "def blueprint(scene): return 1", "must return an rrb.Blueprint, not int"),
        ("a.py", "x = 1", "has no attribute 'blueprint'"),
        ("a.py", "def blueprint(scene) return 1", "SyntaxError"),
        ("a.py", "import nothing_of_the_kind", "ModuleNotFoundError: No module named 'nothing_of_the_kind'"),
        (
            "a.py",
            "def blueprint(scene): return scene.wheels",
            "AttributeError: 'Scene' object has no",
        ),
        ("a.rbl", "not a blueprint", "a.rbl: cannot be read"),
        ("a.rbl", "", "a.rbl: "),
    ],
)
def test_a_file_without_a_layout_is_one_line(name: str, text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(UserError, match=message) as caught:
        blueprints.load(str(path), SCENES["one camera"])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("bugreport", "unknown; did you mean 'bug_report'"),
        ("zzz", "unknown; there are bug_report, "),
        ("/nonexistent/a.py", "no such file"),
        ("/nonexistent/a.rbl", "no such file"),
    ],
)
def test_an_unknown_layout_is_one_line(name: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        blueprints.load(name, SCENES["lidar only"])


def test_layouts_are_installed_with_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the wheel: blueprints/ inside the package's folder goes first."""
    package = tmp_path / "bevviz"
    (package / "blueprints").mkdir(parents=True)
    (package / "blueprints" / "mine.py").write_text("")
    monkeypatch.setattr(blueprints, "PACKAGE", package)
    assert blueprints.names() == ["mine"]


def test_each_layout_has_its_own_application_id() -> None:
    ids = {
        blueprints.application_id(name, Scene("a", "lidar", ("lidar",), (camera,)))
        for name in ("debug", "explain")
        for camera in ("zed", "left")
    }
    assert len(ids) == 4
    renamed = Scene("b", "lidar", ("lidar",), ("zed",))
    assert blueprints.application_id("debug", renamed) in ids
