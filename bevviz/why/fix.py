"""Search of parameters that repair what is missed or false: chosen on some frames, confirmed on others."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from bevviz.bags.source import BagSource
from bevviz.config import Config, load, preset_differences
from bevviz.errors import UserError
from bevviz.evaluate import ObjectScore
from bevviz.evaluate.differences import before_after
from bevviz.evaluate.f1_change import f1, f1_change
from bevviz.evaluate.ground_truth import Truth, truth_source
from bevviz.model.frame import F64, Frame
from bevviz.model.reasons import FACTS, facts_of
from bevviz.model.results import FrameResult, Objects
from bevviz.pipeline.session import Variants
from bevviz.support.json_form import json_form, rounded
from bevviz.why.explainer import FrameExplainer
from bevviz.why.false_objects import false_reasons
from bevviz.why.parameter_search import Settings, search
from bevviz.why.selection import Selection

FRAMES = 60  # frames to choose on, and as many to confirm
TRIALS = 72
OF_CAUSE = 0.5  # share of these frames that have findings of the cause
FEW = 6  # drives below which parts of drives are left out instead of whole drives
PARTS = 10  # of a drive
COMMON = 0.05  # least share of a reason among the findings whose parameters are searched


@dataclass(frozen=True, slots=True)
class SampleFrame:
    """Frame of a sample.

    Attributes:
        frame: the decoded frame.
        truth: its ground truth.
        unit: drive, or part of a drive, that the bootstrap draws as a whole.
        of_cause: whether it has findings of the cause.
        weight: number of frames that it stands for.
    """

    frame: Frame
    truth: Truth
    unit: str
    of_cause: bool
    weight: float


@dataclass
class Sample:
    """Frames that configurations are scored on.

    Attributes:
        frames: the frames.
        variants: runs the stages.
    """

    frames: Sequence[SampleFrame]
    variants: Variants = field(default_factory=Variants)

    def results(self, configs: Sequence[Config]) -> Iterator[tuple[SampleFrame, list[FrameResult]]]:
        """Yield the result of each configuration on each frame."""
        for sampled in self.frames:
            yield sampled, [self.variants.perceive(sampled.frame, config) for config in configs]

    def counts(self, score: ObjectScore) -> F64:
        """Return (F, 3) true, missed and false objects of each frame, by the weight of the frames."""
        return np.asarray(score.frames * np.array([[sampled.weight] for sampled in self.frames]))

    def f1(self, configs: Sequence[Config]) -> list[float]:
        """Run each configuration on each frame. Return the F1 of each, by the weight of the frames."""
        scores = [ObjectScore() for _ in configs]
        for sampled, results in self.results(configs):
            for score, result in zip(scores, results, strict=True):
                score.add(result.objects or Objects.empty(), sampled.truth, result.cameras)
        return [float(f1(self.counts(score).sum(axis=0))) for score in scores]

    def reasons(self, config: Config) -> Counter[str]:
        """Run a configuration. Return the number of missed and false objects by reason."""
        reasons: Counter[str] = Counter()
        for sampled, [result] in self.results([config]):
            explainer = FrameExplainer(result, truth=sampled.truth)
            if (matches := explainer.traces.matches) is not None:
                missed = np.flatnonzero(sampled.truth.must & matches.missed).tolist()
                reasons.update(explainer.about(Selection(truth=row)).verdict.kind.value for row in missed)
                reasons.update(reason.kind.value for reason in false_reasons(explainer.traces).values())
        return reasons


F1 = Annotated[float, rounded(6)]


@json_form
@dataclass(frozen=True, slots=True)
class Fix:
    """Changed parameters, and their effect on frames that were not used to choose them."""

    settings: Settings
    """changed parameters; empty: none is better"""
    confirmed: bool
    """the whole interval is an improvement"""
    searched: Sequence[str]
    """parameters"""
    trials: int
    f1_before: F1
    f1_after: F1
    f1_change: Sequence[F1]
    """95 % interval"""
    fixed: int
    """objects that were missed and are found"""
    missed: int
    """before"""
    broken: int
    """objects that were found and are missed"""
    found: int
    """before"""
    cause_fixed: int
    """in frames of the cause"""
    cause_missed: int
    false_before: int
    false_after: int
    frames: int
    """that confirm"""
    units: int
    """drives, or parts of drives, that the interval draws"""
    parts: bool
    """whether the units are parts of drives"""

    def lines(self) -> Iterator[str]:
        """Yield the result for the terminal."""
        yield f"{self.trials} settings of {', '.join(self.searched)} tried"
        if not self.settings:
            yield "none is better than the present ones"
            return
        for key, value in self.settings.items():
            yield f"  --set {key}={text_of(value)}"
        units = "parts of drives" if self.parts else "drives"
        yield f"on {self.frames} frames of {self.units} {units} that were not used to choose them:"
        yield f"  fixes {self.fixed} of {self.missed} missed objects" + (
            f", {self.cause_fixed} of {self.cause_missed} in frames of the cause" if self.cause_missed else ""
        )
        false = f"false objects {self.false_before} -> {self.false_after}"
        yield f"  breaks {self.broken} of {self.found} found ones; {false}"
        low, high = self.f1_change
        change = f"the change is {low:+.3f} to {high:+.3f} (95 %)"
        yield f"  F1 {self.f1_before:.3f} -> {self.f1_after:.3f}; {change}"
        if not self.confirmed:
            yield "not confirmed: it may as well be chance"

    def yaml(self) -> str:
        """Return the changed parameters as a configuration file."""
        sections: dict[str, dict[str, Any]] = {}
        for key, value in self.settings.items():
            section, _, name = key.partition(".")
            sections.setdefault(section, {})[name] = value
        head = [f"# {line.strip()}" for line in self.lines() if "--set" not in line]
        body = [
            line
            for section, parameters in sections.items()
            for line in (f"{section}:", *(f"  {name}: {json.dumps(v)}" for name, v in parameters.items()))
        ]
        return "\n".join([*head, *body, ""])


def text_of(value: Any) -> str:
    """Return a value as ``--set`` takes it."""
    return value if isinstance(value, str) else json.dumps(value)


def find_fix(
    config: Config,
    keys: Sequence[str],
    choosing: Sample,
    confirming: Sample,
    trials: int = TRIALS,
    tick: Callable[[int], None] = lambda _: None,
    *,
    parts: bool = False,
    defaults: bool = True,
) -> Fix:
    """Search settings on one sample, and confirm the best on the other.

    Args:
        config: present configuration.
        keys: parameters to search.
        choosing: sample that the settings are chosen on.
        confirming: sample of other drives, or of other parts of drives.
        trials: number of settings to try.
        tick: called with the number of settings that were tried since the last call.
        parts: whether the units of the samples are parts of drives.
        defaults: whether the default values are tried first.
    """

    def scored(settings: Sequence[Settings]) -> list[float]:
        configs = [changed(config, one) for one in settings]
        valid = [config for config in configs if config is not None]
        values = iter(choosing.f1(valid))
        tick(len(settings))
        return [-1.0 if config is None else next(values) for config in configs]

    tried: dict[tuple[tuple[str, Any], ...], float] = {}
    for point, value in search(config, keys, scored, trials, defaults=defaults):
        tried[tuple(point.items())] = value
    best = max(tried.items(), key=lambda item: (round(item[1], 6), -len(item[0])))
    settings = _simplified(dict(best[0]), best[1], scored, choosing)
    return _confirmed(config, settings, keys, len(tried), confirming, parts)


def changed(config: Config, settings: Settings) -> Config | None:
    """Return the configuration with settings. None: they contradict each other."""
    try:
        return load(settings=[f"{key}={text_of(value)}" for key, value in settings.items()], base=config)
    except UserError:
        return None


def _simplified(
    best: Settings, value: float, scored: Callable[[Sequence[Settings]], Sequence[float]], sample: Sample
) -> Settings:
    """Leave out each change without which F1 is lower by less than one object."""
    weights = sum(s.weight * s.truth.must.sum() for s in sample.frames)
    one_object = max((s.weight for s in sample.frames), default=1.0) / max(weights, 1)
    while best:
        fewer = [{k: v for k, v in best.items() if k != key} for key in best]
        values = scored(fewer)
        at = int(np.argmax(values))
        if values[at] < value - one_object:
            break
        best, value = fewer[at], max(value, values[at])
    return best


def _confirmed(
    config: Config, settings: Settings, keys: Sequence[str], trials: int, sample: Sample, parts: bool
) -> Fix:
    """Compare the present configuration with the changed one on the frames to confirm on."""
    after = changed(config, settings)
    assert after is not None
    old, new = ObjectScore(), ObjectScore()
    totals: Counter[str] = Counter(cause_fixed=0, cause_missed=0)
    for sampled, (before, then) in sample.results([config, after]):
        truth, cameras = sampled.truth, (before.cameras, then.cameras)
        change = before_after(before.objects, then.objects, truth, cameras=cameras)
        assert change.before is not None and change.after is not None
        old.count(change.a, truth, change.before)
        new.count(change.b, truth, change.after)
        there, found, _ = change.found
        fixed = len(change.fixed)
        totals.update(fixed=fixed, missed=there - found, found=found, broken=len(change.broken))
        if sampled.of_cause:
            totals.update(cause_fixed=fixed, cause_missed=there - found)
    units = [sampled.unit for sampled in sample.frames]
    gain = f1_change(sample.counts(old), sample.counts(new), units)
    return Fix(
        settings=settings,
        confirmed=bool(settings) and gain.is_better,
        searched=keys,
        trials=trials,
        f1_before=gain.before,
        f1_after=gain.after,
        f1_change=(gain.low, gain.high),
        frames=len(sample.frames),
        units=len(set(units)),
        parts=parts,
        false_before=old.total["false"],
        false_after=new.total["false"],
        **totals,
    )


def keys_for(reasons: Mapping[str, int], config: Config | None = None) -> list[str]:
    """Return the parameters that reasons depend on, those of frequent reasons first.

    If some do, those with another value in the configuration than in its preset follow: one error can show as
    the reasons of another.
    """
    total = sum(reasons.values())
    keys: dict[str, None] = {}
    for reason, number in sorted(reasons.items(), key=lambda item: -item[1]):
        if number >= COMMON * total:
            keys |= dict.fromkeys(facts_of(reason).searched)
    if keys and config is not None:
        known = {key for facts in FACTS.values() for key in facts.searched}
        keys |= dict.fromkeys(key for key in preset_differences(config) if key in known)
    return list(keys)


# --- frames ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DriveFrames:
    """Frames of one drive that a sample may take.

    Attributes:
        paths: files of the drive.
        name: name of the drive.
        numbers: numbers of its frames.
        of_cause: numbers of the frames with findings of the cause.
    """

    paths: tuple[Path, ...]
    name: str
    numbers: Sequence[int]
    of_cause: frozenset[int]


def draw_samples(
    drives: Sequence[DriveFrames],
    config: Config,
    frames: int = FRAMES,
    truth: str | None = None,
    kitti: Path | None = None,
    tick: Callable[[int], None] = lambda _: None,
) -> tuple[Sample, Sample, bool]:
    """Draw frames to choose on and frames to confirm on, from different drives or parts of drives.

    Returns:
        choosing: the first sample.
        confirming: the second sample.
        parts: whether they are of different parts of the same drives, because there are few drives.

    Raises:
        UserError: no frame has ground truth, or a bag cannot be read.
    """
    parts = len(drives) < FEW
    units: dict[str, list[tuple[DriveFrames, int]]] = {}
    for drive in drives:
        for place, number in enumerate(drive.numbers):
            part = f"#{place * PARTS // len(drive.numbers)}" if parts else ""
            units.setdefault(drive.name + part, []).append((drive, number))
    rng = np.random.default_rng(0)
    # Each half gets every second unit in the order of their findings of the cause, so that both have some.
    order = sorted(units, key=lambda unit: -sum(n in d.of_cause for d, n in units[unit]))
    pairs = [order[i : i + 2] for i in range(0, len(order), 2)]
    sides: tuple[list[str], list[str]] = ([], [])
    for pair in pairs:
        first = int(rng.integers(2)) if len(pair) == 2 else 0
        for i, unit in enumerate(pair):
            sides[(i + first) % 2].append(unit)
    chosen: list[list[tuple[DriveFrames, int, str, float, bool]]] = []
    for side in sides:
        pool = [(drive, number, unit) for unit in side for drive, number in units[unit]]
        bad = [entry for entry in pool if entry[1] in entry[0].of_cause]
        others = [entry for entry in pool if entry[1] not in entry[0].of_cause]
        count = min(len(bad), max(round(OF_CAUSE * frames), frames - len(others)))
        picked = []
        for stratum, number in ((bad, count), (others, min(len(others), frames - count))):
            drawn = rng.permutation(len(stratum))[:number].tolist()
            picked += [(*stratum[at], len(stratum) / number, stratum is bad) for at in drawn]
        chosen.append(picked)
    read = _read(drives, chosen, config, truth, kitti, tick)
    if not all(sample.frames for sample in read):
        raise UserError("no ground truth in the frames: a fix is judged by it")
    return read[0], read[1], parts


def _read(
    drives: Sequence[DriveFrames],
    chosen: Sequence[Sequence[tuple[DriveFrames, int, str, float, bool]]],
    config: Config,
    topic: str | None,
    kitti: Path | None,
    tick: Callable[[int], None],
) -> tuple[Sample, Sample]:
    """Read the frames of both samples, one bag after the other."""
    samples: tuple[list[SampleFrame], list[SampleFrame]] = ([], [])
    for drive in drives:
        wanted = sorted(
            (number, side, unit, weight, of_cause)
            for side, picked in enumerate(chosen)
            for d, number, unit, weight, of_cause in picked
            if d is drive
        )
        if not wanted:
            continue
        with BagSource(drive.paths, config) as source:
            truths = truth_source(source, topic, kitti)
            for number, side, unit, weight, of_cause in wanted:
                frame = source.frame(number)
                truth = truths(frame) if frame is not None and truths is not None else None
                if frame is not None and truth is not None:
                    samples[side].append(SampleFrame(frame, truth, unit, of_cause, weight))
                tick(1)
    return Sample(samples[0]), Sample(samples[1])
