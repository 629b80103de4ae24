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
from bevviz.why.hints import Hint, HintSearch, TriedChange
from tests.support.planted_faults import at, run

CLASSES = ("car", "person", "cyclist")


@cache
def questioner(preset: str) -> FrameExplainer:
    return FrameExplainer(run("flat_car", preset), classes=CLASSES)


@cache
def near(preset: str) -> tuple[Answer, ...]:
    """With hints: what was missed within 25 m (``reference``), or for its size (``default``)."""
    asked = questioner(preset)
    missed = [a for a in asked.missed() if a.subject.kind == "truth"]
    chosen = [
        a
        for a in missed
        if (a.distance < 25 if preset == "reference" else a.verdict.kind is ReasonKind.TOO_SMALL)
    ]
    return tuple(asked.with_hints(a) for a in chosen)


def again(preset: str, answer: Answer) -> Answer:
    """Ask the same question after running everything again with the settings of the hint."""
    model = "detector.model=demo"
    config = load(
        None, [model, *answer.hints[0].settings], "reference" if preset == "reference" else "default"
    )
    after = FrameExplainer(Session(config).run(at("flat_car").frame), classes=CLASSES)
    return after.ask(Selection(truth=answer.subject.row))[0]


def test_changes_that_help_together_only_are_named_together() -> None:
    """Out of the ground, but then in pieces: the hint takes what each stage needs."""
    both = [
        a
        for a in near("reference")
        if a.hints
        and len({setting.partition(".")[0] for setting in a.hints[0].settings}) > 1
        and "but" not in a.hints[0].text  # found with a fault
    ]
    assert both, "nothing needs two changes any more: another frame is to be asked about"
    for answer in both[:1]:
        (hint,) = answer.hints
        assert f"; change {', '.join(hint.settings)}: it is cluster " in answer.verdict.text
        assert again("reference", answer).verdict.kind is ReasonKind.REPORTED
        for setting in hint.settings:  # none of them is there for nothing
            alone = replace(answer, hints=(replace(hint, settings=(setting,)),))
            assert again("reference", alone).verdict.kind is not ReasonKind.REPORTED, setting


def test_limits_of_two_stages_are_tried_together_and_refused_if_they_break_as_much() -> None:
    """Too small, and then the score is too low: three settings would name it, and two false objects too."""
    (answer,) = near("default")
    assert not answer.hints
    keys = [setting.partition("=")[0] for setting in answer.tried[-1].settings]
    assert keys == ["clustering.min_cluster_points", "detector.conf_threshold", "fusion.min_rating"]
    assert "named person, but it breaks as much as it fixes" in answer.tried[-1].text


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


def test_without_a_remedy_each_tried_change_is_named() -> None:
    vain = [a for a in near("reference") if not a.hints and a.verdict.kind is not ReasonKind.REPORTED]
    assert any(len(answer.tried) > 1 for answer in vain)
    for answer in vain[:3]:
        assert answer.tried, "a change that the reason suggests is tried"
        assert all(change.text in answer.verdict.text for change in answer.tried)
        assert " and ".join(answer.tried[0].settings) in answer.verdict.text
        last = answer.tried[-1]
        there = again("reference", replace(answer, hints=(_as_hint(last.settings),))).verdict
        assert there.kind.value in last.text and there.reported == last.text.startswith("it is reported")


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
    monkeypatch.setattr(FrameExplainer, "search", lambda self, answer: HintSearch((), tried))
    assert asked.with_hints(answer).verdict.text == answer.verdict.text.removesuffix(".") + said


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
