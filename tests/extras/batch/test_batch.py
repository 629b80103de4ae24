"""Many bags: nothing is lost or done twice, whatever dies; the summary says what the frames say."""

from __future__ import annotations

import os
import re
import shutil
import signal
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import rerun as rr
from hypothesis import given
from hypothesis import strategies as st

from bevviz.bags.source import BagSource, FrameSelection
from bevviz.cli import main
from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.extras.batch.bag_job import run
from bevviz.extras.batch.jobs import (
    PARTIAL,
    Job,
    find_bags,
    intact_results,
    lock_folder,
    make_jobs,
    name_bags,
    tables,
    unfinished_jobs,
)
from bevviz.extras.batch.table import SEVERITIES, severity
from bevviz.findings.frame_findings import find_findings, findings_of
from bevviz.findings.frame_row import row
from bevviz.model.decisions import unmatched_detections
from bevviz.model.results import DetectionState, FrameResult
from bevviz.pipeline.session import Session
from bevviz.why import FrameExplainer
from bevviz.why.frame_index import FrameIndex
from tests.support import bags
from tests.support.html_pages import Page
from tests.support.recordings import Recording, verify
from tests.support.waiting import meanwhile

GOOD = ("kitti", "one-drive", "two_b_-drive")
SCANS = 8
JOB = re.compile(r"(?P<bag>.+)-(?P<process>\d+)-[0-9a-f]{8}\b")  # unfinished file of a worker
WEAK = "detector.conf_threshold=0.05"  # so that KITTI has persons that match nothing


@dataclass
class Batch:
    """What a batch over good bags and a bad one left, of whose workers one was killed at work."""

    root: Path
    status: int
    said: str
    killed: list[Path]

    @property
    def folder(self) -> Path:
        return self.root / "runs"

    @property
    def arguments(self) -> list[str]:
        return ["batch", str(self.root / "bags"), "-o", str(self.folder)]


@contextmanager
def killing(folder: Path, pattern: str) -> Iterator[list[Path]]:
    """Kill the first process that writes such a recording, when it has got under way. Yields which it was."""
    killed: list[Path] = []

    def kill() -> None:
        for path in (folder / PARTIAL).glob(pattern):
            if not killed and path.stat().st_size and (job := JOB.match(path.name)):
                os.kill(int(job["process"]), signal.SIGKILL)
                killed.append(path)

    with meanwhile(kill):
        yield killed


def write_bags(root: Path, shared: Path) -> None:
    bags.write(root / "kitti", bags.kitti_items(shared, step=2))
    for folder in ("one", "two<b>"):
        (root / folder).mkdir()
        bags.write(root / folder / "drive", bags.small_items(scans=SCANS))
    (root / "bad.mcap").write_text("not a bag")


@pytest.fixture(scope="module")
def model(shared: Path) -> str:
    return str(shared / "models/yolox_nano.onnx")


@pytest.fixture(scope="module")
def batch(shared: Path, model: str, tmp_path_factory: pytest.TempPathFactory) -> Batch:
    root = tmp_path_factory.mktemp("batch")
    (root / "bags").mkdir()
    write_bags(root / "bags", shared)
    done = Batch(root, 0, "", [])
    said = StringIO()
    with redirect_stderr(said), killing(done.folder, "one-drive-*.rrd") as done.killed:
        done.status = main([*done.arguments, "--jobs", "2", "--model", model, "--set", WEAK])
    done.said = said.getvalue()
    return done


def jobs_of(batch: Batch, model: str, **settings: Any) -> list[Job]:
    config = load(None, [f"detector.model={model}", WEAK, *(f"{k}={v}" for k, v in settings.items())])
    return make_jobs([batch.root / "bags"], batch.folder, config, FrameSelection(), "debug")


# --- what is done ------------------------------------------------------------------------------


@pytest.mark.long
def test_dead_workers_and_bad_bags_cost_nothing_else(batch: Batch) -> None:
    assert batch.killed
    assert batch.status == 1
    assert "bad: " in batch.said and "not a bag" in batch.said
    assert "3 bags complete, 1 failed" in batch.said
    assert {path.name for path in batch.folder.iterdir()} == {
        *("summary.html", "summary.parquet", "findings.parquet"),
        *(f"{name}.{kind}" for name in GOOD for kind in ("rrd", "parquet")),
    }
    for name in GOOD:
        verify(batch.folder / f"{name}.rrd")
    assert len(Recording(batch.folder / "one-drive.rrd").rows["/bev"]) == SCANS


def test_only_missing_or_outdated_bags_are_run(batch: Batch, model: str) -> None:
    def left(**settings: Any) -> set[str]:
        return {job.name for job in unfinished_jobs(jobs_of(batch, model, **settings), force=False)}

    assert left() == {"bad"}
    assert left(**{"live.nice": 5}) == {"bad"}
    assert left(**{"clustering.eps": 0.7}) == {"bad", *GOOD}
    bag = next((batch.root / "bags/kitti").glob("*.mcap"))
    before = bag.stat()
    os.utime(bag, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
    assert left() == {"bad", "kitti"}
    os.utime(bag, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert left() == {"bad"}


def test_a_table_without_its_recording_is_ignored(batch: Batch, model: str, tmp_path: Path) -> None:
    shutil.copytree(batch.folder, tmp_path / "runs")
    other = Batch(batch.root, 0, "", [])
    jobs = [
        Job(j.name, j.bag, tmp_path / "runs", j.config, j.selection, j.blueprint)
        for j in jobs_of(other, model)
    ]
    (tmp_path / "runs/kitti.rrd").unlink()
    (tmp_path / "runs/one-drive.parquet").write_bytes(b"cut off")
    assert {job.name for job in unfinished_jobs(jobs, force=False)} == {"bad", "kitti", "one-drive"}
    assert {job.name for job in unfinished_jobs(jobs, force=True)} == {"bad", *GOOD}


@pytest.mark.long
def test_an_interrupted_batch_can_be_continued(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, scans in (("long", 400), ("short", 2)):
        bags.write(tmp_path / "bags" / name, bags.small_items(scans=scans))
    arguments = ["batch", str(tmp_path / "bags"), "-o", str(tmp_path / "runs"), "--jobs", "2"]

    interrupted = Event()

    def interrupt() -> None:
        if not interrupted.is_set() and (tmp_path / "runs/short.parquet").exists():
            interrupted.set()
            os.kill(os.getpid(), signal.SIGINT)

    with meanwhile(interrupt):
        status = main([*arguments, "--every", "2"])
        interrupted.set()
    assert status == 130
    assert "1 bags are complete" in capsys.readouterr().err
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {
        *("short.rrd", "short.parquet", "summary.html", "summary.parquet", "findings.parquet")
    }
    before = (tmp_path / "runs/short.rrd").stat()
    assert main([*arguments, "--every", "2"]) == 0
    assert "1 of 2 bags are complete" in capsys.readouterr().err
    assert (tmp_path / "runs/short.rrd").stat().st_mtime_ns == before.st_mtime_ns
    assert pq.read_metadata(tmp_path / "runs/long.parquet").num_rows == 200


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed", reason="needs Dask: pip install 'bevviz[dask]'")
    with distributed.LocalCluster(
        n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None
    ) as started:
        yield started


@pytest.mark.long
def test_death_of_a_dask_worker_loses_and_repeats_no_bag(
    cluster: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scans = {"a": 6, "b": 120, "c": 4, "d": 5, "e": 3}
    for name, count in scans.items():
        bags.write(tmp_path / "bags" / name, bags.small_items(scans=count))
    (tmp_path / "bags/bad.db3").write_text("not a bag")
    folder = tmp_path / "runs"
    written: dict[str, set[tuple[int, int]]] = {}  # each version of each table that was ever there
    begun: dict[str, set[str]] = {}  # processes that began each bag

    def watch() -> None:
        for table in folder.glob("*.parquet"):
            stat = table.stat()
            written.setdefault(table.stem, set()).add((stat.st_ino, stat.st_mtime_ns))
        for path in (folder / PARTIAL).glob("*.rrd"):
            if job := JOB.match(path.name):
                begun.setdefault(job["bag"], set()).add(job[0])

    with meanwhile(watch, every=0.002), killing(folder, "b-*.rrd") as killed:
        status = main(
            ["batch", str(tmp_path / "bags"), "-o", str(folder), "--dask", cluster.scheduler_address]
        )
    assert status == 1
    said = capsys.readouterr().err
    assert killed and {name for name, jobs in begun.items() if len(jobs) > 1} <= {"b"}
    assert begun.keys() <= scans.keys() and "b" in begun
    assert "bevviz: bad: " in said and "5 bags complete, 1 failed" in said
    tables = {name: len(versions) for name, versions in written.items() if name in scans}
    assert tables == dict.fromkeys(scans, 1)
    rows = pq.read_table(folder / "summary.parquet", columns=["recording", "frame"]).to_pylist()
    assert sorted((r["recording"], r["frame"]) for r in rows) == [
        (name, i) for name, count in scans.items() for i in range(count)
    ]
    assert not (folder / PARTIAL).exists()


# --- the summary -------------------------------------------------------------------------------


def test_the_summary_agrees_with_a_direct_run(batch: Batch, model: str) -> None:
    config = load(None, [f"detector.model={model}", WEAK])
    with BagSource([batch.root / "bags/kitti"], config) as source:
        session = Session(config)
        results = [session.run(frame) for frame in source]
        names = session.stages.class_names
    summary = pq.read_table(batch.folder / "summary.parquet")
    badness = summary["badness"].to_pylist()
    assert badness == sorted(badness, reverse=True)
    assert summary.num_rows == 2 + 2 * SCANS
    found = {r["frame"]: r for r in summary.drop_columns("stamp").to_pylist() if r["recording"] == "kitti"}
    for result in results:
        mine = found[result.frame.index]
        wanted = row(result, find_findings(FrameExplainer(result, classes=names)), evaluated=False)
        assert mine["bag"] == str(batch.root / "bags/kitti")
        assert {k: mine[k] for k in wanted if not k.startswith("time_ms_") and k != "stamp"} == {
            k: v for k, v in wanted.items() if not k.startswith("time_ms_") and k != "stamp"
        }
        detections = result.cameras[0].detections
        assert detections is not None and result.objects is not None and result.clusters is not None
        kept = int((detections.state == DetectionState.KEPT).sum())
        assert mine["detections"] == kept
        assert mine["matched"] == len(result.objects)
        unmatched = unmatched_detections(result.cameras[0])
        assert len(mine["unmatched"]) <= len(unmatched) <= kept - mine["matched"]
        assert mine["points"] == len(result.frame.points)
        assert mine["clusters"] + mine["set_aside"] == len(result.clusters)
        assert mine["time_ms_total"] > 0
    assert found[0]["matched"] > 0 and "person" in found[0]["unmatched"]


def test_findings_hold_each_object_and_detection(batch: Batch) -> None:
    findings = pq.read_table(batch.folder / "findings.parquet").drop_columns("stamp").to_pylist()
    summary = pq.read_table(batch.folder / "summary.parquet").drop_columns("stamp").to_pylist()
    assert {(f["recording"], f["frame"]) for f in findings} == {(r["recording"], r["frame"]) for r in summary}
    for frame in summary:
        mine = [f for f in findings if (f["recording"], f["frame"]) == (frame["recording"], frame["frame"])]
        outcomes = Counter(f["outcome"] for f in mine)
        assert outcomes["found"] + outcomes["doubtful"] == frame["objects"]
        assert outcomes["unexplained"] == len(frame["unmatched"])
        severity = sum(f["severity"] for f in mine if f["severity"] is not None)
        assert -1e-5 <= frame["badness"] - severity - 3 * frame["problems"] - 10 * frame["failures"] < 10
        assert outcomes["anomaly"] == frame["anomalies"] and outcomes["quiet"] == (not frame["anomalies"])
        assert {f["scan_points"] for f in mine} == {float(frame["points"])}
    lost = [f for f in findings if f["outcome"] == "unexplained"]
    assert lost and all(f["reason"] and f["text"] and f["camera"] for f in lost)
    assert all(0 <= f["u"] <= 1 and 0 <= f["v"] <= 1 for f in lost)


def row_of(result: FrameResult) -> dict[str, Any]:
    return row(result, findings_of(FrameIndex(result)), evaluated=False)


def test_badness_weighs_the_findings_of_a_frame(batch: Batch) -> None:
    config = Config()
    with BagSource([batch.root / "bags/one/drive"], config) as source:
        session = Session(config)
        frame = next(iter(source))
        without = replace(frame, points=frame.points[:0], problems=("late",))
        good, empty = (row_of(session.run(one)) for one in (frame, without))
    assert good["failures"] == good["anomalies"] == 0 and good["remarks"] == []
    assert empty["failures"] >= 1
    assert good["badness"] == pytest.approx(
        good["sync_error_ms"] / 100 + good["tf_age_ms"] / 1000 / config.sync.tf_tolerance
    )
    assert empty["badness"] == pytest.approx(
        good["badness"] + 10 * empty["failures"] + 3 + 0.5 * empty["anomalies"]
    )
    assert empty["remarks"][0] == "cloud: the cloud holds no finite point"
    assert "late" in empty["remarks"]


def test_the_page_needs_no_other_files(batch: Batch) -> None:
    text = (batch.folder / "summary.html").read_text()
    page = Page(text)
    assert not {"link", "iframe", "b>", "object"} & {tag for tag, _ in page.tags}
    assert not [attrs for _, attrs in page.tags if {"href", "onclick"} & set(attrs)]
    sources = [tag["src"] for _, tag in page.tags if tag.get("src")]
    assert all(str(source).startswith("data:image/jpeg;base64,") for source in sources)
    assert "url(" not in text and "@import" not in text
    assert str(batch.root / "bags/two<b>/drive") in [attrs.get("title") for _, attrs in page.tags]
    assert "not a bag" in page.text
    worst = pq.read_table(batch.folder / "summary.parquet", columns=["remarks", "recording"]).to_pylist()[0]
    assert worst["remarks"][0] in page.text
    assert page.text.index(worst["remarks"][0]) > page.text.index("Worst frames")
    assert f"bevviz open {worst['recording']}.rrd --at 20" in page.text


def test_the_worst_frames_have_pictures(batch: Batch) -> None:
    for path in batch.folder.glob("*.parquet"):
        if path.stem == "findings":
            continue
        rows = sorted(pq.read_table(path).to_pylist(), key=lambda row: -row["badness"])
        pictured = [row for row in rows if row["above"] is not None]
        if path.stem == "summary" or not pictured:
            continue
        assert len(pictured) == min(12, len(rows))
        assert pictured[-1]["badness"] >= rows[len(pictured) - 1]["badness"]
        above = cv2.imdecode(np.frombuffer(pictured[0]["above"], np.uint8), cv2.IMREAD_COLOR)
        assert above is not None and above.shape[1] == 150
    shown = (batch.folder / "summary.html").read_text().count("-eye view, frame ")
    assert (
        shown
        == sum(
            row["above"] is not None
            for row in pq.read_table(batch.folder / "summary.parquet").to_pylist()[:30]
        )
        > 0
    )


def test_frames_are_counted_by_their_worst_finding(batch: Batch) -> None:
    text = (batch.folder / "summary.html").read_text()
    frames = pq.read_table(batch.folder / "summary.parquet").to_pylist()
    kinds = Counter(severity(row) for row in frames)
    counted = re.findall(r'<li class="(\w+)(?: none)?"><b>(\d+)</b>', text)
    assert dict(counted) == {kind: str(kinds[kind]) for kind in SEVERITIES}
    assert sum(int(number) for _, number in counted) == len(frames)
    nothing: dict[str, Any] = dict.fromkeys(("failures", "problems", "missed", "false", "anomalies"), 0)
    nothing["unmatched"] = []
    assert severity(nothing) == "well"
    assert severity({**nothing, "missed": None, "false": None}) == "unjudged"
    assert severity({**nothing, "unmatched": ["car"]}) == "unmatched"
    assert severity({**nothing, "unmatched": ["car"], "anomalies": 1, "false": None}) == "strange"
    assert severity({**nothing, "anomalies": 1, "missed": 2}) == "wrong"
    assert severity({**nothing, "problems": 1, "missed": 2}) == "lacking"
    assert severity({**nothing, "problems": 1, "failures": 1}) == "failed"
    shown = re.findall(r'^<tr class="(\w+)">$', text, re.MULTILINE)
    assert shown == [severity(row) for row in frames[: len(shown)]]
    assert {f"only-{kind}" for kind in SEVERITIES if kind not in ("well", "unjudged")} == set(
        re.findall(r'id="(only-\w+)"', text)
    )
    assert all(f"#only-{kind}:checked" in text for kind in SEVERITIES if kind not in ("well", "unjudged"))


# --- the catalog -------------------------------------------------------------------------------


def test_a_query_reads_all_recordings_of_a_catalog(
    batch: Batch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("datafusion", reason="needs datafusion: pip install 'bevviz[catalog]'")
    from datafusion import col, functions, lit

    folder = tmp_path / "fleet"
    shutil.copytree(batch.folder, folder)
    with rr.server.Server(host="127.0.0.1") as server:
        for _ in range(2):
            assert main(["batch", "-o", str(folder), "--catalog", server.url()]) == 0
            assert "3 recordings in dataset 'fleet'" in capsys.readouterr().err
        dataset = server.client().get_dataset("fleet")
        ids = {about.recording_id: table.stem for table, about in tables(folder)}
        assert sorted(dataset.segment_ids()) == sorted(ids)
        assert len(dataset.blueprints()) == 1

        explained = dataset.filter_contents(["/explain"]).reader(index="frame")
        lost = explained.filter(
            functions.regexp_like(col('"/explain:TextDocument:text"')[0], lit(r"\*\*low overlap\*\* person"))
        ).select("rerun_segment_id", "frame")
        answer = {(ids[r["rerun_segment_id"]], r["frame"]) for r in lost.to_pylist()}

        summary = pq.read_table(folder / "summary.parquet").drop_columns("stamp").to_pylist()
        for mine in summary:
            id_ = next(i for i, name in ids.items() if name == mine["recording"])
            assert mine["link"] == f"{dataset.segment_url(id_)}#when=frame@{mine['frame']}"
        links = [a["href"] for tag, a in Page((folder / "summary.html").read_text()).tags if tag == "a"]
        assert links == [mine["link"] for mine in summary]
    wanted = {
        (mine["recording"], mine["frame"])
        for mine in summary
        if mine["low_overlap"] and mine["recording"] == "kitti"
    }
    assert answer == wanted != set()


def test_a_new_recording_replaces_the_old_one(batch: Batch, tmp_path: Path) -> None:
    pytest.importorskip("datafusion", reason="needs datafusion: pip install 'bevviz[catalog]'")
    from bevviz.extras.batch.catalog import register

    with rr.server.Server(host="127.0.0.1") as server:
        ((table, about), *_) = tables(batch.folder)
        path = table.with_suffix(".rrd")
        register(server.url(), "fleet", [(path, about)], "debug")
        dataset = server.client().get_dataset("fleet")
        dataset.unregister(segments_to_drop=dataset.segment_ids(), layers_to_drop=[]).wait()
        with rr.RecordingStream("bevviz", recording_id=f"{table.stem}-0123abcd") as old:
            old.save(tmp_path / "old.rrd")
            old.log("/bev", rr.TextDocument("old"))
        dataset.register([(tmp_path / "old.rrd").as_uri()]).wait()
        register(server.url(), "fleet", [(path, about)], "debug")
        assert dataset.segment_ids() == [about.recording_id]


# --- names and bags ----------------------------------------------------------------------------


parts = st.text("ab-_. <é", min_size=1, max_size=3).filter(lambda p: p not in (".", ".."))
paths = st.lists(st.builds(lambda *p: Path("/", *p), parts, parts, parts), unique=True, max_size=8)


@given(paths, paths)
def test_names_are_unique_safe_and_stay(first: list[Path], second: list[Path]) -> None:
    names = name_bags(first, {})
    assert set(names) == set(first)
    assert len(set(names.values())) == len(first)
    assert all(
        "/" not in n and not n.startswith(".") and n.isascii() and n != "summary" for n in names.values()
    )
    both = list(dict.fromkeys([*second, *first]))
    after = name_bags(both, {str(bag): name for bag, name in names.items()})
    assert {bag: after[bag] for bag in first} == names
    assert len(set(after.values())) == len(both)


def test_bags_are_found_in_folders_and_by_pattern(tmp_path: Path) -> None:
    (tmp_path / "x/y/drive").mkdir(parents=True)
    for name in ("x/a.mcap", "x/b.bag", "x/b.txt", "x/y/c.db3.zstd", "x/y/drive/drive_0.mcap"):
        (tmp_path / name).touch()
    (tmp_path / "x/y/drive/metadata.yaml").touch()
    found = [str(bag.relative_to(tmp_path)) for bag in find_bags([tmp_path / "x", tmp_path / "x/a.mcap"])]
    assert found == ["x/a.mcap", "x/b.bag", "x/y/c.db3.zstd", "x/y/drive"]
    assert [bag.name for bag in find_bags([tmp_path / "**/*.mcap"])] == ["a.mcap", "drive_0.mcap"]


def test_a_plain_folder_is_a_drive_unless_it_holds_bags(tmp_path: Path) -> None:
    for name in ("day/lidar/000000.pcd", "day/camera/000000.png"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).touch()
    assert find_bags([tmp_path / "day"]) == find_bags([tmp_path]) == [tmp_path / "day"]
    (tmp_path / "day/recorded").mkdir()
    (tmp_path / "day/recorded/a.mcap").touch()
    assert tmp_path / "day/recorded/a.mcap" in find_bags([tmp_path / "day"])


def test_wrong_options_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=1))
    runs = tmp_path / "runs"

    def error_of(*arguments: str | Path) -> str:
        assert main(["batch", *map(str, arguments)]) == 2
        said = capsys.readouterr().err
        assert said.splitlines()[-1].startswith("bevviz: error: ")
        return said

    assert "no such file" in error_of(tmp_path / "none", "-o", runs)
    (tmp_path / "empty").mkdir()
    assert "no bag in this folder" in error_of(tmp_path / "empty", "-o", runs)
    assert "give one of them" in error_of("-o", runs, "--catalog", "rerun+http://a", "--serve-catalog")
    assert "unknown; did you mean" in error_of(bag, "-o", runs, "--blueprint", "debg")
    assert "no such file" in error_of(bag, "-o", runs, "--model", "none.onnx")
    assert "nobody answers" in error_of(bag, "-o", runs, "--dask", "tcp://127.0.0.1:1")
    assert "Not a directory" in error_of(bag, "-o", bag / "metadata.yaml" / "runs")
    with lock_folder(runs), pytest.raises(UserError, match="another batch is running"), lock_folder(runs):
        pass


# --- results that were damaged later -----------------------------------------------------------


def misspell(path: Path, name: bytes) -> None:
    """Change the last letter of a name in a file. Its size stays as it is."""
    data = path.read_bytes()
    assert name in data
    path.write_bytes(data.replace(name, name[:-1] + b"x"))


def recount(path: Path) -> None:
    """Change the number of frames that a table says of itself."""
    table = pq.read_table(path)
    metadata = dict(table.schema.metadata)
    metadata[b"bevviz"] = metadata[b"bevviz"].replace(b'"frames":2', b'"frames":3')
    pq.write_table(table.replace_schema_metadata(metadata), path)


@pytest.fixture
def done(tmp_path: Path) -> Job:
    """Return the job of a bag whose result is complete."""
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=2))
    (job,) = make_jobs([bag], tmp_path / "runs", load(), FrameSelection(), "debug")
    job.folder.mkdir()
    assert not run(job, 1).error
    return job


DAMAGES = [
    (lambda job: os.truncate(job.recording, 0), "drive.rrd has 0 bytes instead of "),
    (lambda job: os.truncate(job.recording, job.recording.stat().st_size - 1), "drive.rrd has "),
    (lambda job: misspell(job.recording, b"/health"), "drive.rrd was changed or damaged (SHA-256)"),
    (lambda job: job.recording.unlink(), "drive.rrd is missing"),
    (lambda job: os.truncate(job.table, job.table.stat().st_size // 2), "drive.parquet is damaged"),
    (lambda job: misspell(job.table, b"JFIF"), "drive.parquet is damaged"),  # in a picture
    (lambda job: misspell(job.table, b"badness"), "drive.parquet is damaged"),  # name of a column
    (lambda job: recount(job.table), "drive.parquet is damaged"),
]


@pytest.mark.parametrize(("damage", "line"), DAMAGES)
def test_a_damaged_result_is_named_and_made_again(done: Job, damage: Any, line: str) -> None:
    warnings: list[str] = []
    assert unfinished_jobs([done], False, warnings.append) == [] == warnings
    damage(done)
    assert intact_results(done.folder, warnings.append) == []
    assert unfinished_jobs([done], False, warnings.append) == [done]
    assert len(warnings) == 2 and all(text.startswith(f"drive: {line}") for text in warnings)
    assert not run(done, 1).error
    assert unfinished_jobs([done], False, warnings.append) == [] and len(warnings) == 2


@pytest.mark.long
def test_a_batch_goes_on_over_damaged_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        bags.write(tmp_path / "bags" / name, bags.small_items(scans=2))
    arguments = ["batch", str(tmp_path / "bags"), "-o", str(tmp_path / "runs"), "--jobs", "1"]
    assert main(arguments) == 0
    misspell(tmp_path / "runs/a.parquet", b"JFIF")
    os.truncate(tmp_path / "runs/summary.parquet", 9)
    capsys.readouterr()
    assert main(["batch", "-o", str(tmp_path / "runs")]) == 0
    assert "a: a.parquet is damaged; it is left out" in capsys.readouterr().err
    assert main(arguments) == 0
    said = capsys.readouterr().err
    assert "a: a.parquet is damaged; its bag is run again" in said
    assert "1 of 2 bags are complete" in said and "2 bags complete, 0 failed, 4 frames" in said
    assert pq.read_table(tmp_path / "runs/summary.parquet").num_rows == 4
