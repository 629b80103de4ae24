"""What ``bevviz why`` says would help: changes that are joined, and what is said where none helps."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bevviz.config import load
from bevviz.model.reasons import Reason, ReasonKind
from bevviz.pipeline.session import Session
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.answer import Hint, TriedChange
from bevviz.why.neighbours import NeighbourRuns
from tests.support.planted_faults import at, run

CLASSES = ("car", "person", "cyclist")


@cache
def questioner(preset: str) -> FrameExplainer:
    return FrameExplainer(run("flat_car", preset), classes=CLASSES)


@cache
def near(preset: str) -> tuple[Answer, ...]:
    """With hints: what was missed within 25 m."""
    asked = questioner(preset)
    return tuple(asked.with_hints(a) for a in asked.missed() if a.distance < 25)


def again(preset: str, answer: Answer) -> Answer:
    """Ask the same question after running everything again with the settings of the hint."""
    model = "detector.model=demo"
    config = load(
        None, [model, *answer.hints[0].settings], "reference" if preset == "reference" else "default"
    )
    after = FrameExplainer(Session(config).run(at("flat_car").frame), classes=CLASSES)
    return after.ask(Selection(truth=answer.subject.row))[0]


@pytest.mark.long
def test_changes_that_help_together_only_are_named_together() -> None:
    """Two planted values each lose the object: the hint sets both back, and none is there for nothing."""
    wrong = ["clustering.min_cluster_points=400", "detector.conf_threshold=0.97"]
    config = load(None, ["detector.model=demo", *wrong])
    frame = at("flat_car").frame
    asked = FrameExplainer(Session(config).run(frame), classes=CLASSES)
    answers = [asked.with_hints(answer) for answer in asked.missed()[:4]]
    together = [a for a in answers if a.hints and len(a.hints[0].settings) == 2]
    assert together
    for answer in together[:1]:
        hint = answer.hints[0]
        keys = {setting.partition("=")[0] for setting in hint.settings}
        assert keys == {"clustering.min_cluster_points", "detector.conf_threshold"}
        for setting in hint.settings:
            alone = load(None, ["detector.model=demo", *wrong, setting])
            after = FrameExplainer(Session(alone).run(frame), classes=CLASSES)
            assert answer.subject.row in {missed.subject.row for missed in after.missed()}, setting


@pytest.mark.parametrize(
    "wrong", ["fusion.min_points=300", "fusion.min_rating=0.9", "clustering.min_cluster_points=400"]
)
def test_a_value_that_was_changed_is_set_back(wrong: str) -> None:
    """The preset's value is the hint, not the smallest step that helps this object alone."""
    key = wrong.partition("=")[0]
    config = load(None, ["detector.model=demo", wrong])
    asked = FrameExplainer(Session(config).run(at("flat_car").frame), classes=CLASSES)
    hints = [hint for answer in asked.missed()[:4] for hint in asked.with_hints(answer).hints]
    section, _, name = key.partition(".")
    preset = getattr(getattr(load(), section), name)
    assert (f"{key}={preset:g}",) in [hint.settings for hint in hints]


@pytest.mark.long
def test_without_a_remedy_each_tried_change_is_named() -> None:
    asked = questioner("default")
    answers = [asked.with_hints(a) for a in asked.missed()[:4]]
    vain = [a for a in answers if not a.hints and a.verdict.kind is not ReasonKind.REPORTED]
    assert any(len(answer.tried) > 1 for answer in vain)
    for answer in vain[:2]:
        assert all(change.text in answer.verdict.text for change in answer.tried)
        assert " and ".join(answer.tried[0].settings) in answer.verdict.text
        tried = next(change for change in answer.tried if change.text.startswith("it stays"))
        config = load(None, ["detector.model=demo", *tried.settings])
        after = FrameExplainer(Session(config).run(at("flat_car").frame), classes=CLASSES)
        assert not after.ask(Selection(truth=answer.subject.row))[0].verdict.reported


def _as_hint(settings: tuple[str, ...]) -> Hint:
    hint = next(a.hints[0] for a in near("reference") if a.hints)
    return replace(hint, settings=settings)


@pytest.mark.parametrize(
    ("tried", "said"),
    [
        (
            (TriedChange(("fusion.method=frustum",), "it is reported, but 'split'"),),
            "; the one tried change does not help: with fusion.method=frustum it is reported, but 'split'.",
        ),
        (
            (
                TriedChange(("clustering.eps=0.3",), "it stays 'merged'"),
                TriedChange(("clustering.eps=0.4",), "it stays 'merged'"),
                TriedChange(("clustering.eps=0.3", "fusion.min_iou=0"), "it is lost as 'taken'"),
            ),
            "; no tried change helps: with clustering.eps=0.3 or clustering.eps=0.4 it stays 'merged', "
            "with clustering.eps=0.3 and fusion.min_iou=0 it is lost as 'taken'.",
        ),
        ((), "."),
    ],
)
def test_the_sentence_names_the_changes(
    tried: tuple[TriedChange, ...], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = questioner("reference")
    answer = asked.missed()[0]
    monkeypatch.setattr(FrameExplainer, "search", lambda self, answer: replace(answer, hints=(), tried=tried))
    assert asked.with_hints(answer).verdict.text == answer.verdict.text.removesuffix(".") + said


@pytest.mark.long
@pytest.mark.parametrize("eps", [0.5, 19.0])
def test_only_valid_values_are_tried(eps: float) -> None:
    """Of parts whose distance is not known, too, and where a larger value is beyond the limit."""
    config = load(settings=["detector.model=demo", f"clustering.eps={eps}"])
    asked = FrameExplainer(Session(config).run(at("flat_car").frame), classes=CLASSES)
    answer = next(a for a in asked.ask(Selection()) if a.subject.kind == "truth" and a.evidence.parts)
    odd = replace(answer, evidence=replace(answer.evidence, apart=float("nan")))
    split = replace(odd, verdict=replace(odd.verdict, reason=Reason(ReasonKind.SPLIT)))
    search = asked.search(split)
    assert search.tried or search.hints
    assert all("nan" not in setting for hint in search.hints for setting in hint.settings)


def test_values_are_not_tried_twice() -> None:
    """Answers of a frame share their runs; the second question is answered alike."""
    answer = next(a for a in near("reference") if a.hints)
    asked = questioner("reference")
    first = asked.ask(Selection(truth=answer.subject.row))[0]
    assert asked.with_hints(first).verdict.text == answer.verdict.text
    assert np.isfinite(answer.distance)


def test_a_change_that_harms_the_frames_beside_is_no_hint(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each change that helps is run there, also those that come after the first one."""
    config = load(None, ["detector.model=demo", "fusion.min_rating=0.9"])
    result = Session(config).run(at("flat_car").frame)
    asked = FrameExplainer(result, classes=CLASSES)
    answer = asked.missed()[0]
    assert asked.with_hints(answer).hints
    monkeypatch.setattr(NeighbourRuns, "balance", lambda self, change: -1)
    after = FrameExplainer(result, classes=CLASSES).with_hints(answer)
    assert not after.hints
    assert any("breaks more than it fixes in the frames before and after" in t.text for t in after.tried)
    monkeypatch.setattr(NeighbourRuns, "balance", lambda self, change: 2)
    hints = FrameExplainer(result, classes=CLASSES).with_hints(answer).hints
    assert hints and all(hint.beside == 2 for hint in hints)
