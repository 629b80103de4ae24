"""The robot's own chain: which topic of objects is made from which, and which step lost an object.

Nothing is set: stamps, times of receipt, places, sizes, ids and class names of the objects tell it.
"""

from __future__ import annotations

import bisect
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bevviz.model.frame import F32, F64, I64, Bool

SECOND = 1_000_000_000
NEAR = 2.0  # metres between an object and itself one step later
FAR = 15.0  # metres that a step may move an object by mistake
SAMPLE = 24  # messages of a topic that the inference looks at
AGE = SECOND  # a message is made from one that is not older
SAME_STAMPS = 0.5  # share of messages with the stamp of another topic's, from which on they belong together
LEAST = 0.3  # share of the objects of a topic that each parent has, at least
LIMIT = 0.7  # cost above which a topic is not made from the best parents
BESIDE = 0.5  # cost of a topic that is not late where its parents are
FITTED = 10  # messages that a fit of delays needs
FOLLOWS = 0.5  # part of a delay of the parents that a topic has as well
FURTHER = 0.6  # share of the remaining objects that a further parent has, at least
REST = 0.05  # share of the objects that remain, from which on a further parent is looked for
WAITS = 0.6  # ratio of the spread of a delay with a further parent to that without it
REGULAR = 1.35  # ratio of two spreads that tells nothing
CLOSE = 0.04  # difference of two costs that tells nothing
ENDED = "cannot be told, as the messages end before it"

State = Literal["kept", "dropped", "not made", "message lost", "moved", "renamed", "delayed", "unknown"]


@dataclass(frozen=True, slots=True)
class ObjectMessage:
    """One message with objects, in a frame that all topics share.

    Attributes:
        stamp: stamp, in nanoseconds.
        received: time of receipt, in nanoseconds.
        center: (N, 3) centres, in metres.
        size: (N, 3) sizes, in metres.
        labels: (N,) class names.
        ids: (N,) ids. Empty: the message has none.
    """

    stamp: int
    received: int
    center: F32
    size: F32
    labels: tuple[str, ...]
    ids: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ChainStep:
    """How one topic is made from others.

    Attributes:
        topic: the topic.
        parents: topics that it is made from. Empty: this cannot be told.
        rivals: topics that the first parent cannot be told apart from.
        same_stamps: whether its messages keep the stamps of their parent.
        delay: median seconds from the parent's message to its own.
        spread: usual deviation from the delay, in seconds.
        lost: share of the first parent's messages without one of its own.
        dropped: share of the first parent's objects that are not among its own.
        moved: metres that nine of ten objects are moved at most.
        names: usual class name by that of the parent.
        keeps_ids: whether the objects keep their ids.
    """

    topic: str
    parents: tuple[str, ...] = ()
    rivals: tuple[str, ...] = ()
    same_stamps: bool = True
    delay: float = float("nan")
    spread: float = 0.0
    lost: float = 0.0
    dropped: float = 0.0
    moved: float = 0.0
    names: Mapping[str, str] = field(default_factory=dict)
    keeps_ids: bool = False

    def outcome(self, parent: str, state: State, text: str, row: int = -1) -> StepOutcome:
        """Return what the step did with an object of a parent."""
        return StepOutcome(self.topic, parent, state, f"{self.topic}: {text}", row)


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """What one step did with an object.

    Attributes:
        topic: topic that the step makes.
        parent: topic that had the object before. Empty: the step is the first.
        state: what happened.
        text: one sentence.
        row: row of the object in the message of the topic. -1: it is not there.
    """

    topic: str
    parent: str
    state: State
    text: str
    row: int = -1


@dataclass(frozen=True, slots=True)
class _Pair:
    """Statistics of a topic that may be made from another one."""

    same_stamps: bool
    cost: float  # of the parent, with what it leaves out
    befores: list[ObjectMessage | None]  # message of the parent for each sampled message
    explained: list[Bool]  # objects of each sampled message that the parent has
    delay: float
    spread: float
    survived: float  # share of the parent's objects
    differences: float  # cost of different places, sizes and ids
    moved: float
    names: Mapping[str, str]
    keeps_ids: bool


class RobotChain:
    """Chain of the topics of objects of a robot.

    Args:
        messages: messages by topic, in order of receipt.
        sensors: stamps of the messages of each sensor, sorted.

    Attributes:
        steps: one for each topic with messages, in the order in which they are made.
    """

    def __init__(
        self,
        messages: Mapping[str, Sequence[ObjectMessage]],
        sensors: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        self.messages = {topic: list(those) for topic, those in messages.items() if those}
        self._stamps = {topic: _by_stamp(those) for topic, those in self.messages.items()}
        self._periods = {topic: _period(those) for topic, those in self.messages.items()}
        self._received = {topic: [one.received for one in those] for topic, those in self.messages.items()}
        self._end = max((times[-1] for times in self._received.values()), default=0)
        self.steps: tuple[ChainStep, ...] = ()
        self._infer(sensors or {})

    def __getitem__(self, topic: str) -> ChainStep:
        return next(step for step in self.steps if step.topic == topic)

    # --- inference -----------------------------------------------------------------------------

    def _infer(self, sensors: Mapping[str, Sequence[int]]) -> None:
        pairs: dict[str, dict[str, _Pair]] = {}  # by child and parent
        for child in self.messages:
            found = {parent: self._pair(parent, child) for parent in self.messages if parent != child}
            pairs[child] = {parent: pair for parent, pair in found.items() if pair is not None}
        steps: dict[str, ChainStep] = {}
        # A topic with fewer earlier ones comes first, so that the ancestors of its children are known.
        for child, candidates in sorted(pairs.items(), key=lambda item: len(item[1])):
            step = self._made_from(child, candidates, steps) if candidates else None
            steps[child] = step or self._first_step(child, sensors)
        self.steps = tuple(_in_order(steps))

    def _made_from(
        self, child: str, pairs: Mapping[str, _Pair], steps: Mapping[str, ChainStep]
    ) -> ChainStep | None:
        """Return the step with the best parents of a topic. None: it is made from no other topic."""
        ranked = _ranked(pairs)
        best = pairs[ranked[0]]
        rivals = [one for one in ranked[1:] if pairs[one].cost - best.cost < CLOSE]
        parents, explained = self._further_parents(ranked, pairs, steps)
        delays, ages = self._delays(child, parents, pairs)
        for one in ranked:  # A step may wait for a topic that has hardly an object of its own.
            if one not in parents and not _are_related(one, parents, steps):
                with_it, its_ages = self._delays(child, [*parents, one], pairs)
                if min(with_it) > 0 and _spread(with_it) < WAITS * _spread(delays):
                    parents, (delays, ages) = [*parents, one], (with_it, its_ages)
                    explained = [
                        mine | rows for rows, mine in zip(pairs[one].explained, explained, strict=True)
                    ]
        covered, spread = len(delays) / len(self.messages[child]), _spread(delays)
        share = sum(map(np.sum, explained)) / max(sum(map(len, explained)), 1)
        cost = 2 * (1 - covered) + 1.5 * (1 - share) + 0.5 * min(1.0, spread / 0.02) + best.differences
        if best.same_stamps and _is_beside(np.subtract(ages, delays), np.asarray(ages)):
            cost += BESIDE
        if cost > LIMIT:
            return None
        awaited = [
            self._awaited(one, ranked[0], child, best.same_stamps) for one in self._inner(ranked[0], child)
        ]
        return ChainStep(
            child,
            tuple(parents),
            tuple(one for one in rivals if one not in parents),
            best.same_stamps,
            best.delay,
            best.spread,
            1 - sum(awaited) / len(awaited) if awaited else 0.0,
            1 - best.survived,
            best.moved,
            best.names,
            best.keeps_ids,
        )

    def _delays(
        self, child: str, parents: Sequence[str], pairs: Mapping[str, _Pair]
    ) -> tuple[list[float], list[float]]:
        """Return the seconds of each message from the last of its parents, and from its own stamp."""
        delays, ages = [], []
        for message in self.messages[child]:
            befores = [self._parent_of(message, one, pairs[one].same_stamps) for one in parents]
            times = [before.received for before in befores if before is not None]
            if times:  # A step that waits for several topics begins with the last one.
                delays.append((message.received - max(times)) / SECOND)
                ages.append((message.received - message.stamp) / SECOND)
        return delays, ages

    def _sample(self, topic: str) -> list[ObjectMessage]:
        """Return the messages of a topic that the inference looks at."""
        those = self.messages[topic]
        return those[:: -(-len(those) // SAMPLE)]

    def _first_step(self, topic: str, sensors: Mapping[str, Sequence[int]]) -> ChainStep:
        """Return the step of a topic that is made from a sensor with its stamps, or from nothing known."""
        stamps = self._stamps[topic].keys()
        shares = {
            name: len(stamps & set(theirs)) / len(stamps) for name, theirs in sensors.items() if len(theirs)
        }
        best = max(shares, key=lambda name: shares[name], default="")
        if not best or shares[best] < SAME_STAMPS:
            return ChainStep(topic)
        theirs = set(sensors[best])
        delays = [(one.received - one.stamp) / SECOND for one in self.messages[topic] if one.stamp in theirs]
        first, last = min(stamps), max(stamps)
        awaited = [stamp for stamp in theirs if first <= stamp <= last]
        lost = 1 - len(stamps & theirs) / max(len(awaited), 1)
        return ChainStep(topic, (best,), (), True, float(np.median(delays)), _spread(delays), max(0.0, lost))

    def _further_parents(
        self, ranked: Sequence[str], pairs: Mapping[str, _Pair], steps: Mapping[str, ChainStep]
    ) -> tuple[list[str], list[Bool]]:
        """Return the parents, and the objects that they have in each sampled message.

        Each parent after the first has most of the objects that the ones before it lack. It is no ancestor
        of them.
        """
        parents, explained = [ranked[0]], [rows.copy() for rows in pairs[ranked[0]].explained]
        total = sum(len(rows) for rows in explained)
        while (rest := sum(int((~rows).sum()) for rows in explained)) >= max(REST * total, 3):
            gains = {
                parent: sum(
                    int((rows & ~mine).sum())
                    for rows, mine in zip(pairs[parent].explained, explained, strict=True)
                )
                for parent in ranked
                if parent not in parents and not _are_related(parent, parents, steps)
            }
            most = max(gains.values(), default=0)
            if most < FURTHER * rest:
                break
            best = next(parent for parent in ranked if gains.get(parent, 0) >= most - max(1, REST * rest))
            parents.append(best)
            explained = [mine | rows for rows, mine in zip(pairs[best].explained, explained, strict=True)]
        return parents, explained

    def _pair(self, parent: str, child: str) -> _Pair | None:
        """Return the statistics of a pair of topics. None: the child is not made from the parent."""
        sample = self._sample(child)
        shared = len(self._stamps[parent].keys() & self._stamps[child].keys())
        same_stamps = shared >= SAME_STAMPS * min(len(self._stamps[parent]), len(self._stamps[child]))
        befores = [self._parent_of(message, parent, same_stamps) for message in sample]
        couples = [(one, other) for one, other in zip(befores, sample, strict=True) if one is not None]
        delays = [(after.received - before.received) / SECOND for before, after in couples]
        if not delays or float(np.median(delays)) <= 0:
            return None
        moves, sizes, explained = [np.zeros(0)], [np.zeros(0)], []
        own = theirs = linked = same_ids = with_ids = 0
        names: dict[str, Counter[str]] = {}
        for before, message in zip(befores, sample, strict=True):
            own += len(message.center)
            if before is None:
                explained.append(np.zeros(len(message.center), bool))
                continue
            rows = _link(before, message, NEAR)
            explained.append(rows >= 0)
            kept = np.flatnonzero(rows >= 0)
            was = rows[kept]
            theirs, linked = theirs + len(before.center), linked + len(kept)
            moves.append(np.linalg.norm(message.center[kept] - before.center[was], axis=1))
            sizes.append(np.abs(message.size[kept] / np.maximum(before.size[was], 0.01) - 1).mean(axis=1))
            for row, earlier in zip(kept.tolist(), was.tolist(), strict=True):
                names.setdefault(before.labels[earlier], Counter())[message.labels[row]] += 1
                if before.ids and message.ids:
                    with_ids += 1
                    same_ids += before.ids[earlier] == message.ids[row]
        if own == 0 or linked < max(LEAST * own, 1):
            return None
        usual = {name: counts.most_common(1)[0][0] for name, counts in names.items()}
        renamed = 1 - sum(counts[usual[name]] for name, counts in names.items()) / linked
        strangers = 1 - same_ids / with_ids if with_ids else 0.0
        move, resized = np.concatenate(moves), float(np.median(np.concatenate(sizes)))
        spread, survived = _spread(delays), linked / max(theirs, 1)
        differences = 0.5 * min(1.0, float(np.median(move)) / 0.5) + 0.5 * min(1.0, resized / 0.05)
        differences += 0.5 * renamed + 0.3 * strangers + (0.0 if same_stamps else 0.1)
        cost = 2 * (1 - len(couples) / len(sample)) + 1.5 * (1 - linked / own) + 1 - survived + differences
        return _Pair(
            same_stamps,
            cost + 0.5 * min(1.0, spread / 0.02),
            befores,
            explained,
            float(np.median(delays)),
            spread,
            survived,
            differences,
            float(np.quantile(move, 0.9)),
            usual,
            with_ids > 0 and same_ids >= 0.8 * with_ids,
        )

    def _inner(self, parent: str, child: str) -> list[ObjectMessage]:
        """Return the parent's messages from the child's first to its last one."""
        first, last = self._received[child][0], self._received[child][-1]
        return [one for one in self.messages[parent] if first < one.received < last]

    def _awaited(self, message: ObjectMessage, parent: str, child: str, same_stamps: bool) -> bool:
        """Return whether a message of the parent has one of the child."""
        if same_stamps:
            return message.stamp in self._stamps[child]
        row = bisect.bisect_right(self._received[child], message.received)
        later = self._received[parent][bisect.bisect_right(self._received[parent], message.received) :]
        return row < len(self._received[child]) and (
            not later or self._received[child][row] < later[0] + AGE // 10
        )

    def _parent_of(self, message: ObjectMessage, parent: str, same_stamps: bool) -> ObjectMessage | None:
        """Return the message of the parent that a message may be made from."""
        if same_stamps:
            return self._stamps[parent].get(message.stamp)
        row = bisect.bisect_left(self._received[parent], message.received) - 1
        before = self.messages[parent][row] if row >= 0 else None
        return before if before is not None and message.received - before.received <= AGE else None

    # --- questions -----------------------------------------------------------------------------

    def follow(self, stamp: int, place: F64 | Sequence[float], reach: float = NEAR) -> list[StepOutcome]:
        """Follow the object at a place through the chain, from the first step on.

        Args:
            stamp: time of the object, in nanoseconds.
            place: x, y, z in the frame of the messages.
            reach: metres around the place.

        Returns:
            One outcome for each topic that the object could have reached.
        """
        where = np.asarray(place, np.float32)
        rows: dict[str, tuple[ObjectMessage, int]] = {}
        outcomes = []
        for step in self.steps:
            parents = [parent for parent in step.parents if parent in self.messages]
            before = next(((parent, *rows[parent]) for parent in parents if parent in rows), None)
            if before is not None:
                outcome, message = self._step(step, *before)
            elif not parents:
                outcome, message = self._first_outcome(step, stamp, where, reach)
            else:
                continue
            outcomes.append(outcome)
            if outcome.row >= 0 and message is not None:
                rows[step.topic] = message, outcome.row
        return outcomes

    def _first_outcome(
        self, step: ChainStep, stamp: int, where: F32, reach: float
    ) -> tuple[StepOutcome, ObjectMessage | None]:
        """Return whether a topic at the beginning of the chain has an object at a place."""
        message = self._stamps[step.topic].get(stamp) or self.nearest(step.topic, stamp)
        source = step.parents[0] if step.parents else ""
        if message is None and self._ends_before(step, stamp):
            return step.outcome(source, "unknown", ENDED), None
        if message is None:
            return step.outcome(source, "message lost", "no message at that time"), None
        steps = np.linalg.norm(message.center[:, :2] - where[:2], axis=1)
        row = int(steps.argmin()) if len(steps) else -1
        if row < 0 or steps[row] > reach:
            made = f", made from {source}" if source else ""
            return step.outcome(source, "not made", f"nothing there{made}"), message
        late = (message.received - message.stamp) / SECOND
        if step.parents and _is_late(late, step):
            text = f"has it, {late:.2f} s after its stamp instead of {step.delay:.2f} s"
            return step.outcome(source, "delayed", text, row), message
        text = f"has it, {message.labels[row] or 'without a name'}"
        return step.outcome(source, "kept", text, row), message

    def _ends_before(self, step: ChainStep, time: int) -> bool:
        """Return whether the messages end before the one that a step makes of an earlier one."""
        return time + (step.delay + 5 * step.spread) * SECOND > self._end

    def nearest(self, topic: str, stamp: int) -> ObjectMessage | None:
        """Return the message nearest to a stamp, within the usual distance of two messages."""
        best = min(self._stamps[topic], key=lambda other: abs(other - stamp))
        return self._stamps[topic][best] if abs(best - stamp) <= 0.75 * self._periods[topic] else None

    def _step(
        self, step: ChainStep, parent: str, before: ObjectMessage, row: int
    ) -> tuple[StepOutcome, ObjectMessage | None]:
        """Return what a step did with an object of its parent."""
        message = self._child_of(step, parent, before)
        name = before.labels[row] or "the object"
        if message is None and self._ends_before(step, before.received):
            return step.outcome(parent, "unknown", ENDED), None
        if message is None:
            return step.outcome(parent, "message lost", f"no message was made from that of {parent}"), None
        gate = max(0.5, 3 * step.moved)
        found = int(np.append(_partners(before, message, gate, by_ids=step.keeps_ids), -1)[row])
        if found < 0:
            return step.outcome(parent, "dropped", f"{name} of {parent} is not there: dropped"), message
        move = float(np.linalg.norm(message.center[found] - before.center[row]))
        usual, label = step.names.get(before.labels[row], message.labels[found]), message.labels[found]
        took = (message.received - before.received) / SECOND
        if move > gate:
            text = f"moved by {move:.1f} m; nine of ten objects by less than {step.moved:.1f} m"
            return step.outcome(parent, "moved", text, found), message
        if label != usual:
            text = f"renamed from {name} to {label or 'nothing'}"
            return step.outcome(parent, "renamed", text, found), message
        if _is_late(took, step) and parent == step.parents[0]:
            text = f"{took:.2f} s after {parent} instead of {step.delay:.2f} s"
            return step.outcome(parent, "delayed", text, found), message
        return step.outcome(parent, "kept", f"kept as {label or name}", found), message

    def _child_of(self, step: ChainStep, parent: str, before: ObjectMessage) -> ObjectMessage | None:
        """Return the message of a topic that was made from one of its parent."""
        topic, received = step.topic, self._received[step.topic]
        if step.same_stamps and (parent == step.parents[0] or before.stamp in self._stamps[topic]):
            return self._stamps[topic].get(before.stamp)
        row = bisect.bisect_right(received, before.received)
        if row == len(received):
            return None
        limit = before.received + 1.5 * self._periods[topic] + (step.delay + 5 * step.spread) * SECOND
        return self.messages[topic][row] if received[row] <= limit else None


# --- helpers -----------------------------------------------------------------------------------


def _ranked(pairs: Mapping[str, _Pair]) -> list[str]:
    """Return the parents, best first.

    Of those that cost the same, a topic is made from the one after which it comes most regularly. If that is
    the same as well, it is made from the one that it follows soonest.
    """
    ranked = sorted(pairs, key=lambda parent: pairs[parent].cost)
    equal = [one for one in ranked if pairs[one].cost - pairs[ranked[0]].cost < CLOSE]
    regular = REGULAR * min(pairs[one].spread for one in equal)
    first = min((one for one in equal if pairs[one].spread <= regular), key=lambda one: pairs[one].delay)
    return [first, *(one for one in ranked if one != first)]


def _are_related(topic: str, others: Sequence[str], steps: Mapping[str, ChainStep]) -> bool:
    """Return whether a topic is made from one of the others, or one of them from it."""
    return any(topic in _ancestors(one, steps) or one in _ancestors(topic, steps) for one in others)


def _ancestors(topic: str, steps: Mapping[str, ChainStep]) -> set[str]:
    """Return the topics that a topic is made from, with theirs."""
    ancestors: set[str] = set()
    left = [topic]
    while left:
        step = steps.get(left.pop())
        new = set(step.parents) - ancestors if step is not None else set()
        ancestors |= new
        left += new
    return ancestors


def verdict(outcomes: Sequence[StepOutcome]) -> StepOutcome | None:
    """Return the first step that lost, renamed, delayed or moved the object. None: all have kept it."""
    changed = [one for one in outcomes if one.state not in ("kept", "not made", "unknown")]
    if changed:
        return changed[0]
    made = any(one.row >= 0 for one in outcomes)
    return None if made else next(iter(outcomes), None)


def _by_stamp(messages: Sequence[ObjectMessage]) -> dict[int, ObjectMessage]:
    return {message.stamp: message for message in reversed(messages)}


def _period(messages: Sequence[ObjectMessage]) -> float:
    """Return the usual nanoseconds from one message to the next."""
    return float(np.median(np.diff([one.stamp for one in messages]))) if len(messages) > 1 else 0.1 * SECOND


def _spread(values: Sequence[float]) -> float:
    """Return the median deviation from the median, as a standard deviation."""
    array = np.asarray(values)
    return 1.48 * float(np.median(np.abs(array - np.median(array))))


def _is_beside(before: F64, after: F64) -> bool:
    """Return whether the delays of a topic surely do not follow those of its parents.

    Args:
        before: (N,) seconds from the stamp to the parents' message.
        after: (N,) seconds from the stamp to the message of the topic.
    """
    x, y = _clipped(before), _clipped(after)
    varies = float((x**2).mean())
    if len(x) < FITTED or varies < 1e-8:
        return False
    slope = float((x * y).mean()) / varies
    error = float(np.sqrt(((y - slope * x) ** 2).mean() / (varies * len(x))))
    return slope < FOLLOWS and slope + 2 * error < 1


def _clipped(values: F64) -> F64:
    """Return the deviations from the median. Outliers count little."""
    deviations = values - np.median(values)
    limit = 3 * _spread(values.tolist())
    clipped: F64 = np.clip(deviations, -limit, limit)
    return clipped


def _is_late(seconds: float, step: ChainStep) -> bool:
    return seconds > step.delay + max(6 * step.spread, 0.5 * step.delay, 0.03)


def _distances(one: ObjectMessage, other: ObjectMessage) -> NDArray[np.float32]:
    difference = one.center[:, None, :2] - other.center[None, :, :2]
    distances: NDArray[np.float32] = np.sqrt((difference**2).sum(axis=2))
    return distances


def _link(before: ObjectMessage, after: ObjectMessage, reach: float) -> I64:
    """Return the row before of each object after: the nearest one, if each is nearest to the other."""
    rows = np.full(len(after.center), -1)
    if len(rows) and len(before.center):
        distances = _distances(before, after)
        nearest = distances.argmin(axis=0)
        mutual = distances.argmin(axis=1)[nearest] == np.arange(len(rows))
        good = mutual & (distances[nearest, np.arange(len(rows))] <= reach)
        rows[good] = nearest[good]
    return rows


def _partners(before: ObjectMessage, after: ObjectMessage, reach: float, *, by_ids: bool) -> I64:
    """Return the row after of each object before: by its id, by its place, or else by its name and size."""
    partners = np.full(len(before.center), -1)
    if by_ids and before.ids and after.ids:
        row_of = {identity: row for row, identity in enumerate(after.ids)}
        return np.array([row_of.get(identity, -1) for identity in before.ids], np.int64)
    for row, partner in enumerate(_link(before, after, reach).tolist()):
        if partner >= 0:
            partners[partner] = row
    left, free = np.flatnonzero(partners < 0), np.setdiff1d(np.arange(len(after.center)), partners)
    if len(left) and len(free):
        distances = _distances(before, after)
        for row in left.tolist():
            sizes = np.abs(after.size[free] - before.size[row]) <= 0.02 + 0.05 * before.size[row]
            alike = free[sizes.all(axis=1) & (distances[row, free] <= FAR)]
            if len(alike):
                partners[row] = alike[distances[row, alike].argmin()]
                free = np.setdiff1d(free, partners[row])
    return partners


def _in_order(found: Mapping[str, ChainStep]) -> Iterator[ChainStep]:
    """Yield the steps so that each comes after its parents. A circle, which cannot be, is cut."""
    done: set[str] = set()
    left = dict(found)
    while left:
        ready = [topic for topic, step in left.items() if not any(one in left for one in step.parents)]
        for topic in ready or [next(iter(left))]:
            done.add(topic)
            yield left.pop(topic)
