"""Causes of a batch: planted slices are found and named, chance is not, and batches are compared."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bevviz.cli import main
from bevviz.extras.batch.causes import Bound, Findings, compare_causes, find_causes
from bevviz.extras.batch.findings import SCHEMA
from bevviz.extras.batch.summary import page
from tests.support.documented_json import check

Row = dict[str, Any]
DRIVES, FRAMES = 20, 20


def batch(miss: Callable[[Row], str] = lambda row: "", seed: int = 0) -> list[Row]:
    """Return findings of drives with three objects a frame. ``miss`` returns the reason why one is missed."""
    rng = np.random.default_rng(seed)
    rows: list[Row] = []
    for drive in range(DRIVES):
        light, robot = float(rng.uniform(20, 220)), drive % 4
        for frame in range(FRAMES):
            shared = {
                "bag": f"/data/robot{robot}/d{drive}.mcap",
                "recording": f"d{drive}",
                "frame": frame,
                "stamp": 1_750_000_000_000_000_000 + frame * 10**8,
                "brightness": light,
                "time_s": frame / 10,
            }
            rows.append({**shared, "outcome": "quiet"})
            for number in range(6):
                row = {
                    **shared,
                    "outcome": "found",
                    "object": str(number + 10 * (frame // 2)),
                    "class": str(rng.choice(["person", "car"])),
                    "range_m": float(rng.uniform(2, 40)),
                    "bearing_deg": float(rng.uniform(-45, 45)),
                    "height_m": float(rng.uniform(0.8, 2)),
                    "text": "",
                }
                if reason := miss(row) or ("noise" if rng.random() < 0.02 else ""):
                    row |= {"outcome": "missed", "reason": reason, "text": f"because of {reason}"}
                rows.append(row)
    return rows


def findings(rows: list[Row], folder: Path = Path("runs")) -> Findings:
    return Findings(pa.Table.from_pylist(rows, schema=SCHEMA), folder)


def far_persons(row: Row) -> str:
    return "ground" if row["class"] == "person" and row["range_m"] >= 25 and row["bearing_deg"] < -10 else ""


def dark(row: Row) -> str:
    return "not detected" if row["brightness"] < 60 and row["height_m"] < 1.2 else ""


def test_planted_causes_are_found_and_named() -> None:
    table = findings(batch(lambda row: far_persons(row) or dark(row)))
    causes = find_causes(table).causes
    named = {cause.reason: {bound.attribute for bound in cause.conditions} for cause in causes}
    assert named == {
        "ground": {"class", "range_m", "bearing_deg"},
        "not detected": {"brightness", "height_m"},
    }
    ground = next(cause for cause in causes if cause.reason == "ground")
    assert "persons, beyond 25 m, more than 10° to the right" in ground.text
    rows = table.table.to_pylist()
    planted = [i for i, row in enumerate(rows) if row["reason"] == "ground"]
    assert sorted(ground.rows.tolist()) == planted
    assert ground.count == ground.among == len(planted)
    assert ground.drives == len({rows[i]["recording"] for i in planted})
    missed = sum(row["reason"] == "ground" for row in rows)
    objects = sum(row["outcome"] in ("found", "missed") for row in rows)
    assert ground.lift == pytest.approx(objects / missed)


def test_two_causes_of_one_reason_are_told_apart() -> None:
    """A condition that holds for both would have more findings, of which most are found objects."""

    def miss(row: Row) -> str:
        low = row["class"] == "car" and row["range_m"] >= 25 and row["height_m"] < 1.2
        return "ground" if low or far_persons(row) else ""

    causes = find_causes(findings(batch(miss))).causes
    assert [{bound.attribute for bound in cause.conditions} for cause in causes] == [
        {"class", "range_m", "bearing_deg"},
        {"class", "range_m", "height_m"},
    ]
    assert all(cause.count == cause.among for cause in causes)


def test_chance_gives_no_cause() -> None:
    for seed in range(5):
        causes = find_causes(findings(batch(seed=seed)))
        assert not causes.causes
        assert causes.rest["missed"].total() > 10


def test_what_makes_objects_hard_is_no_cause() -> None:
    """Most objects with few points are missed in any drive, for several reasons."""
    rng = np.random.default_rng(1)

    def hard(row: Row) -> str:
        row["points"] = float(rng.integers(10, 60))
        reasons = ("not detected", "below threshold", "noise")
        return str(rng.choice(reasons)) if row["points"] < 30 and rng.random() < 0.8 else ""

    causes = find_causes(findings(batch(hard)))
    assert causes.totals["missed"] > 500 and not causes.causes
    text = "\n".join(causes.lines(5))
    assert "without a condition in common" in text and "points" not in text


@pytest.mark.parametrize(("reason", "stage"), [("not detected", ""), ("too small", "clustering")])
def test_few_points_are_a_cause_where_a_stage_counts(reason: str, stage: str) -> None:
    rng = np.random.default_rng(1)

    def few_points(row: Row) -> str:
        row["points"] = float(rng.integers(10, 100))
        return reason if row["points"] < 20 else ""

    causes = find_causes(findings(batch(few_points))).causes
    assert [(c.text, c.reason) for c in causes] == (
        [("all objects, with fewer than 20 points", reason)] if stage else []
    )
    if stage:
        assert causes[0].decided_by == "stage clustering, clustering.min_cluster_points decides"


def test_a_cause_of_several_reasons_names_the_most_frequent() -> None:
    rng = np.random.default_rng(1)

    def in_the_dark(row: Row) -> str:
        return str(rng.choice(["not detected", "ground"], p=[0.7, 0.3])) if row["brightness"] < 60 else ""

    cause = find_causes(findings(batch(in_the_dark))).causes[0]
    assert cause.reason == "not detected" and set(cause.reasons) <= {"not detected", "ground", "noise"}
    assert "missed (not detected) in" in cause.title
    assert cause.decided_by == "stage detector"


def test_the_page_of_a_batch_shows_the_causes() -> None:
    causes = find_causes(findings(batch(lambda row: far_persons(row) or dark(row))))
    text = page("runs", [], [], [], "", causes)
    assert all(html.escape(cause.title) in text for cause in causes.causes)
    assert causes.causes[0].examples[0].command in text


def test_many_frames_of_few_objects_are_no_cause() -> None:
    """An object that is missed in each of its frames is one object."""

    def same(row: Row) -> str:
        return "ground" if row["recording"] == "d3" and row["object"] in ("1", "11") else ""

    assert not find_causes(findings(batch(same))).causes


def test_examples_come_from_different_drives() -> None:
    causes = find_causes(findings(batch(far_persons)))
    examples = causes.causes[0].examples
    assert len({example.recording for example in examples}) == len(examples) == 3
    assert all(e.command.startswith(f"bevviz open runs/{e.recording}.rrd --at 2025-06-15T") for e in examples)


def test_words_say_each_side_of_an_interval() -> None:
    texts = {
        Bound("range_m", low=25.0): "beyond 25 m",
        Bound("range_m", high=5.0): "nearer than 5 m",
        Bound("range_m", low=5.0, high=10.0): "5 to 10 m away",
        Bound("bearing_deg", low=10.0): "more than 10° to the left",
        Bound("bearing_deg", high=-10.0): "more than 10° to the right",
        Bound("bearing_deg", low=-10.0, high=20.0): "from 10° right to 20° left",
        Bound("u", low=0.75): "in the right 25 % of the image",
        Bound("u", high=0.25): "in the left 25 % of the image",
        Bound("scan_points", high=20000.0): "in scans of fewer than 20,000 points",
        Bound("camera", value="front"): "in camera front",
    }
    assert {bound: bound.text for bound in texts} == texts


def test_an_unknown_number_meets_no_condition() -> None:
    rows = batch()
    rows[1]["range_m"] = math.nan
    table = findings(rows)
    assert not Bound("range_m", low=0.0).holds(table)[1]
    assert not Bound("range_m").holds(table)[1]
    assert not Bound("class", value="tram").holds(table).any()


def test_a_new_cause_and_a_gone_one() -> None:
    new, old = find_causes(findings(batch(far_persons))), find_causes(findings(batch(dark, seed=1)))
    states = {c.state: c.reason for c in compare_causes(new, old)}
    assert states == {"new": "ground", "gone": "not detected"}
    again = compare_causes(new, find_causes(findings(batch(far_persons, seed=2))))
    assert [c.state for c in again] == ["as before"]


def write(folder: Path, rows: list[Row]) -> None:
    folder.mkdir()
    pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), folder / "findings.parquet")


def test_the_command_prints_text_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new, old = tmp_path / "new", tmp_path / "old"
    write(new, batch(far_persons))
    write(old, batch(dark))
    assert main(["causes", str(new)]) == 0
    text = capsys.readouterr().out
    assert "missed (ground) in 20 drives: persons, beyond 25 m, more than 10° to the right" in text
    assert f"bevviz open {new}/d" in text and "without a condition in common" in text
    assert main(["causes", str(new), "--against", str(old)]) == 0
    assert capsys.readouterr().out.startswith("1 causes new, 1 causes gone, 0 causes as before")
    assert main(["causes", str(new), "--against", str(old), "--json"]) == 0
    tree = json.loads(capsys.readouterr().out)
    check(tree, "bevviz.causes/1")
    assert tree["causes"][0]["reasons"] == {"ground": tree["causes"][0]["count"]}
    assert [c["state"] for c in tree["compared"]] == ["new", "gone"]


def test_a_folder_without_findings_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["causes", str(tmp_path)]) == 2
    assert "no findings.parquet in it; 'bevviz batch BAGS" in capsys.readouterr().err
    (tmp_path / "findings.parquet").write_text("no table")
    assert main(["causes", str(tmp_path)]) == 2
    assert "cannot be read" in capsys.readouterr().err
