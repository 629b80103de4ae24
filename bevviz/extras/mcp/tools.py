"""Tools that an agent calls. Every answer is JSON and has the command that gives the same in a terminal."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_json

from bevviz.bags.source import iso
from bevviz.config import changes, parameters
from bevviz.config.descriptions import describe_parameters
from bevviz.errors import UserError
from bevviz.evaluate import truth_source
from bevviz.extras.mcp.drives import AskedDrive, agent_config
from bevviz.findings.frame_findings import KINDS
from bevviz.pipeline.run import run
from bevviz.support.extensions import find
from bevviz.support.json_form import json_tree
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.answer_results import AnswerResult

LIMIT = 12_000  # bytes of an answer
WORST = 30  # frames of a batch
MOST = 5  # answers with their stages in one answer
CALIB_FRAMES = 30


class AgentTools:
    """Tools of the server. Each public method is one; its docstring is what the agent reads.

    Args:
        opened: opens each drive by its name, when it is first asked about.
        batch: results of ``bevviz batch``; empty: there is one drive.
        folder: folder in which files may be written. None: nothing is written.
    """

    def __init__(
        self,
        opened: Mapping[str, Callable[[], AskedDrive]],
        batch: Sequence[tuple[Path, Any]] = (),
        folder: Path | None = None,
    ) -> None:
        self._openers, self._batch, self._folder = dict(opened), batch, folder
        self._drives: dict[str, AskedDrive] = {}

    def _drive(self, name: str) -> AskedDrive:
        """Return a drive by its name. An empty name is the only drive."""
        name = name or (next(iter(self._openers)) if len(self._openers) == 1 else "")
        if name not in self._openers:
            raise UserError(f"drive '{name}': which one? There are {', '.join(self._openers)}")
        if name not in self._drives:
            for other in list(self._drives):  # One is open at a time: each holds frames and a network.
                self._drives.pop(other).session.close()
            self._drives[name] = self._openers[name]()
        return self._drives[name]

    def drives(self) -> str:
        """List the drives, and the worst frames of a batch with the reason."""
        if not self._batch:
            return fitted({"drives": list(self._openers)})
        table, bags = find("commands", "batch").sum_up(self._batch)
        columns = table.select(["recording", "frame", "badness", "remarks"])
        drives = [
            {
                "drive": bag.name,
                "frames": bag.info.frames,
                "frames_by_severity": bag.kinds,
                "false_causes": bag.false_causes,
                "warnings": list(bag.info.warnings),
            }
            for bag in bags
        ]
        return fitted({"drives": drives, "worst_frames": columns.slice(0, WORST).to_pylist()})

    def overview(self, drive: str = "") -> str:
        """State sensors, topics and transforms of a drive, its faults, and what a full run lacks."""
        from bevviz.pipeline.bag_info import describe_bag

        asked = self._drive(drive)
        info = json_tree(describe_bag(asked.paths, asked.drive.config, all_frames=True))
        kept = ("name", "role", "count", "rate", "pause", "pause_at")  # Hz and seconds
        topics = [{key: value for key, value in topic.items() if key in kept} for topic in info["topics"]]
        head = {key: info.get(key) for key in ("missing", "warnings", "configured", "network", "transforms")}
        head |= {"frames": len(asked.drive), "lidars": info["lidars"], "topics": topics}
        head |= {"cameras": {camera["name"]: camera["problems"] for camera in info["cameras"]}}
        return fitted({"command": asked.command("info", "--sensors"), **head})

    def findings(self, drive: str = "", kind: str = "", limit: int = 25) -> str:
        """Run a drive and list what went wrong, each thing once for all its frames, and the counts by cause.

        Kinds are missed and false (with ground truth), contradicted, lost, unmatched, doubtful, unnamed
        (without), and anomaly (sensors, clocks, transforms, tracks). `frame` is the nearest one. Give `about`
        to `why`.
        """
        asked = self._drive(drive)
        found = asked.findings
        rows: list[dict[str, Any]] = []
        for what, name, frames in found.list.content():
            nearest = min(frames, key=lambda frame: np.nan_to_num(frame.distance, nan=np.inf))
            rows.append(
                {
                    "kind": what,
                    "name": name,
                    "cause": nearest.text,
                    "frame": nearest.frame,
                    "distance_m": round(nearest.distance, 1),
                    "frames": len(frames),
                    "about": nearest.pick,
                    "in_way": nearest.in_way,
                    "command": asked.command("why", *_where(nearest.frame, nearest.pick)),
                }
            )
        rows.sort(key=lambda row: (-KINDS[row["kind"]], -row["frames"]))
        causes: Counter[str] = Counter()
        for row in rows:
            causes[f"{row['kind']}: {row['name' if row['kind'] == 'anomaly' else 'cause']}"] += row["frames"]
        shown = [row for row in rows if kind in ("", row["kind"])]
        return fitted(
            {
                "frames": found.frames,
                "frames_by_cause": dict(causes.most_common()),
                "failures": found.failures.warnings,
                "warnings": found.checks.warnings,
                "findings": shown[:limit],
                "not_shown": max(0, len(shown) - limit),
            }
        )

    def why(
        self,
        frame: int,
        drive: str = "",
        about: str = "",
        label: str = "",
        pixel: Sequence[float] = (),
        point: Sequence[float] = (),
        camera: str = "",
        settings: Sequence[str] = (),
    ) -> str:
        """Explain why objects of a frame were reported or missed, stage by stage, with changes that help.

        Select by `about` of a finding, a class `label`, a `pixel` [u, v], or a `point` [x, y, z] in metres.
        Nothing selects everything that went wrong. A hint was run: it says what it fixes and loses.
        """
        asked = self._drive(drive)
        agent_config(asked.drive.config, settings)
        selection = _selection(about, label, pixel, point, camera)
        source = asked.session.source
        result = source.look(_number(asked, frame), tuple(settings))
        explainer: FrameExplainer = source.explainer(result)
        answers = explainer.explain(selection, MOST)
        words = [*_where(frame, str(selection) if selection.one else "", label), *_set(settings)]
        answered = {answer.subject.key for answer in answers}
        hopeless = [
            a for a in explainer.ask(selection) if a.folded and a.subject.key not in answered and not a.weak
        ]
        return fitted(
            {
                "frame": frame,
                "time_s": round(float(asked.drive.times[frame]), 3),
                "command": asked.command("why", *words),
                "answers": [_brief(answer) for answer in answers[:MOST]],
                "further": [answer.verdict.text for answer in answers[MOST:]],
                "out_of_sight": [_brief(answer, chain=False) for answer in hopeless],
            }
        )

    def try_values(
        self, frame: int, settings: Sequence[str], drive: str = "", about: str = "", whole_drive: bool = False
    ) -> str:
        """Run a frame with other values (`key=value` each), and say what that fixes, adds and loses.

        `about` of a finding adds the verdict on that object then. `whole_drive` compares all frames, too.
        """
        asked = self._drive(drive)
        agent_config(asked.drive.config, settings)
        number, session = _number(asked, frame), asked.session
        answer = session.ask(number, (), _selection(about))[0] if about else None
        then = session.tried_on(number, tuple(settings), answer).answer if answer else None
        tree = {
            "frame": frame,
            "command": asked.command("why", *_where(frame, about), *_set(settings)),
            "verdict_before": answer and answer.verdict.text,
            "verdict_after": then and then.verdict.text,
            "reported_after": then and then.verdict.reported,
            **session.try_values(number, tuple(settings)),
        }
        return fitted(tree | ({"drive": self._compared(asked, (), settings)} if whole_drive else {}))

    def compare(self, settings_b: Sequence[str], settings_a: Sequence[str] = (), drive: str = "") -> str:
        """Run two sets of values (`key=value` each) on all frames: objects fixed, broken, new and gone."""
        return fitted(self._compared(self._drive(drive), settings_a, settings_b))

    def _compared(self, asked: AskedDrive, a: Sequence[str], b: Sequence[str]) -> dict[str, Any]:
        from bevviz.compare.sides import Comparison
        from bevviz.compare.summary import ComparisonSummary

        configs = [agent_config(asked.drive.config, settings) for settings in (a, b)]
        summary = ComparisonSummary((" ".join(a) or "as opened", " ".join(b)), changes(*configs))
        truth_of = truth_source(asked.source, *asked.truth)
        run(asked.source, Comparison(configs, truth=truth_of), [summary])
        tree = summary.result()
        sides = [
            word for side, settings in (("a", a), ("b", b)) for s in settings for word in (f"--set-{side}", s)
        ]
        worst = [
            {"frame": frame.frame, "fixed": frame.fixed, "broken": frame.broke}
            | {"objects": [f"{row.text} {row.place}" for row in frame.objects]}
            for frame in summary.worst
        ]
        head = {"command": asked.command("compare", *sides), "frames": len(tree.frames)}
        return {**head, "config": tree.config, "truth": tree.truth, "objects": tree.objects, "worst": worst}

    def evaluate(self, drive: str = "", settings: Sequence[str] = ()) -> str:
        """Compare all frames with the ground truth: recall, precision, tracks, causes of false objects."""
        from bevviz.evaluate.evaluation import Evaluation
        from bevviz.evaluate.ground_truth import truth_in
        from bevviz.why import RunExplainer

        asked = self._drive(drive)
        evaluation = Evaluation(truth_in(asked.source, *asked.truth), RunExplainer().false_causes)
        asked.run(settings, [evaluation])
        tree = json_tree(evaluation.result())
        tree.pop("limits")
        metrics = {name: value for name, value in tree["metrics"].items() if value is not None}
        command = asked.command("evaluate", *_set(settings))
        return fitted({"command": command, **tree, "metrics": metrics})

    def calibration(self, drive: str = "") -> str:
        """Check mounting and stamps of each camera: offset, interval and finding by axis."""
        asked = self._drive(drive)
        names = asked.source.scene.cameras
        if not names:
            raise UserError(
                f"{asked.source.scene.name}: no camera to calibrate ({asked.source.roles.no_camera})"
            )
        step = max(1, len(asked.drive) // CALIB_FRAMES)
        chosen = (frame for number, frame in enumerate(asked.source) if number % step == 0)
        offsets = asked.drive.config.sync.offsets
        calibrate = find("commands", "calib").calibrate_cameras
        calibrated, _ = calibrate(chosen, None, names, asked.source.pose, offsets)
        results = [calibration.result() for calibration in calibrated]
        keep = ("camera", "answer", "frames", "axes", "notes")
        cameras = [{key: getattr(result, key) for key in keep} for result in results]
        return fitted({"command": asked.command("calib"), "cameras": cameras})

    def parameters(self, words: str, drive: str = "") -> str:
        """Explain a parameter or section (`clustering.eps`), or find some by words of their meaning."""
        config = self._drive(drive).drive.config
        table = parameters(config)
        known = [key for key in table if words == key or key.startswith(f"{words}.")]
        wanted = words.lower().split()
        found = [key for key, one in table.items() if all(w in f"{key} {one.text}".lower() for w in wanted)]
        lines = [describe_parameters(key, config) for key in (known or found)]
        return fitted({"command": f"bevviz config {words if known else ''}".strip(), "parameters": lines})

    # --- what writes -------------------------------------------------------------------------------

    def report(self, frame: int, name: str, note: str, drive: str = "", seconds: float = 2.0) -> str:
        """Write a bug report around a frame (NAME.rrd, .html, .mcap) into the allowed folder."""
        from bevviz.report.make import ReportRequest, make

        asked, output = self._drive(drive), self._target(name, ".rrd")
        at = iso(asked.session.source.look(_number(asked, frame)).frame.received)
        config = asked.drive.config
        written = make(
            ReportRequest(
                paths=asked.paths,
                config=config,
                at=at,
                before=seconds,
                after=seconds,
                output=output,
                note=note,
            )
        )
        command = asked.command("report", "--at", at, "-o", output)
        return fitted({"frame": frame, "frames": written.frames, "files": written.files, "command": command})

    def picture(self, frame: int, name: str, drive: str = "", about: str = "") -> str:
        """Write JPEGs of a frame into the allowed folder: cameras, or the object of `about` marked."""
        from bevviz.report.pictures import camera_picture, jpeg, marked_pictures

        asked, target = self._drive(drive), self._target(name, ".jpg")
        result = asked.session.source.look(_number(asked, frame))
        if about:
            answer = asked.session.ask(frame, (), _selection(about))[0]
            pictures = marked_pictures(result, answer, 960)
            images = {str(part): jpeg(picture) for part, (picture, _) in enumerate(pictures)}
        else:
            drawn = {
                camera.camera.name: camera_picture(camera, 960, labels=True) for camera in result.cameras
            }
            images = {camera: jpeg(image) for camera, image in drawn.items() if image is not None}
        files = []
        for part, data in images.items():
            files.append(target.with_stem(f"{target.stem}-{re.sub(r'[^A-Za-z0-9]+', '-', part)}"))
            with files[-1].open("xb") as file:
                file.write(data)
        return fitted({"frame": frame, "files": files, "command": asked.command("open", "--at-frame", frame)})

    def _target(self, name: str, suffix: str) -> Path:
        """Return the path of a new file in the allowed folder."""
        if self._folder is None:
            raise UserError(
                "nothing may be written: the user must start bevviz mcp with --allow-write FOLDER"
            )
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", name):
            raise UserError(
                f"name '{name}': expected letters, digits, _ and - alone; files go to {self._folder}"
            )
        target = self._folder / f"{name}{suffix}"
        if any(self._folder.glob(f"{name}[.-]*")):
            raise UserError(f"{target}: exists already; give another name")
        return target


def _number(asked: AskedDrive, frame: int) -> int:
    """Return the number of a frame that the drive has."""
    if not 0 <= frame < len(asked.drive):
        raise UserError(f"frame {frame}: the drive has frames 0 to {len(asked.drive) - 1}")
    return frame


def _selection(
    about: str, label: str = "", pixel: Sequence[float] = (), point: Sequence[float] = (), camera: str = ""
) -> Selection:
    """Return the selection that the arguments of a tool name."""
    if about:
        return Selection.parse(about)
    if len(pixel) not in (0, 2, 4) or len(point) not in (0, 3):
        raise UserError("pixel is [u, v] or [u0, v0, u1, v1], and point is [x, y, z] in metres")
    return Selection(label=label, box=tuple(pixel), point=tuple(point), camera=camera)


def _where(frame: int, about: str, label: str = "") -> list[str]:
    """Return the words of ``bevviz why`` that ask about the same. It lists a ground truth object with all."""
    words = ["--at-frame", str(frame), *(["--class", label] if label else [])]
    if not about:
        return words
    kind, camera, number = about.split("/", 2)
    option = {"pixel": "--box"}.get(kind, f"--{kind}")
    words += [] if kind in ("truth", "track") else [f"{option}={number}"]
    return words + (["--camera", camera] if camera and kind in ("detection", "pixel") else [])


def _set(settings: Sequence[str]) -> list[str]:
    """Return settings as words of a command line."""
    return [word for setting in settings for word in ("--set", setting)]


def _brief(answer: Answer, *, chain: bool = True) -> dict[str, Any]:
    """Return an answer with its stages in words. The numbers with their units are in these words."""
    tree = json_tree(AnswerResult.of(answer))
    kept = ("name", "reported", "reason", "verdict", "restored_by", "likely", "distance", "points", "remark")
    selection = answer.selection
    brief = {"about": "" if selection is None else str(selection), **{key: tree[key] for key in kept}}
    if not chain:
        return brief
    return brief | {
        "chain": [f"{step['stage']}: {step['text']}" for step in tree["chain"]],
        "hints": [{key: value for key, value in hint.items() if value} for hint in tree["hints"]],
        "tried": [f"{' '.join(tried['settings'])}: {tried['text']}" for tried in tree["tried"]],
    }


def fitted(tree: Mapping[str, Any]) -> str:
    """Return a tree as JSON of at most ``LIMIT`` bytes. The longest lists lose their last elements.

    ``left_out`` counts the elements that are left out, by the key of their list.
    """
    plain = json.loads(to_json(tree, inf_nan_mode="null", fallback=str))
    left_out: dict[str, int] = {}
    while len(text := json.dumps(plain, ensure_ascii=False).encode()) > LIMIT:
        lists = list(_lists(plain))
        if not lists:
            raise UserError(f"the answer has {len(text)} bytes and cannot be cut: ask about less")
        _, key, longest = max(lists, key=lambda entry: entry[0])
        drop = max(1, len(longest) // 5)
        del longest[-drop:]
        left_out[key] = left_out.get(key, 0) + drop
        plain["left_out"] = left_out
    return text.decode()


def _lists(value: Any, key: str = "") -> Iterator[tuple[int, str, list[Any]]]:
    """Yield size, key and list of each list in a tree that can be cut."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _lists(inner, name)
    elif isinstance(value, list) and value:
        yield len(json.dumps(value)), key, value
        for inner in value:
            yield from _lists(inner, key)
