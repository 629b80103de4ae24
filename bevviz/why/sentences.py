"""The sentence of a verdict, made from the values of its reason."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from bevviz.evaluate import MAX_DISTANCE
from bevviz.model.reasons import Reason, ReasonKind
from bevviz.why.ideal import StageSet
from bevviz.why.subject import Subject, count
from bevviz.why.verdict import Verdict

WITHIN = f"evaluate allows {MAX_DISTANCE:g} m"
_ONLY = ("nothing", "only ground", "mostly ground")  # at a place without an object


def make_verdict(
    subject: Subject,
    reason: Reason,
    reported: bool,
    restored_by: tuple[StageSet, ...] = (),
    blamed: str = "",
    likely: Sequence[ReasonKind] = (),
) -> Verdict:
    """Return the verdict with its reason in one sentence.

    Args:
        subject: the object or place in question.
        reason: the stage or rule that decided.
        reported: whether it is an object of a right class.
        restored_by: sets of stages whose ideal results bring it back.
        blamed: stage that the reason blames; empty: none.
        likely: two reasons between which nothing decides; empty: the reason is plain.
    """
    is_false = subject.kind == "object" and reason.kind in FALSE_SENTENCES
    because = (FALSE_SENTENCES if is_false else SENTENCES)[reason.kind](reason, subject)
    head = subject.name[0].upper() + subject.name[1:]
    if reason.kind is ReasonKind.REPORTED:
        text = f"{head} was reported: {because}{_elsewhere_text(restored_by)}."
    elif reason.kind is ReasonKind.SECOND_NAME:
        first = f"the reported {reason['first']}, and nothing was missed"
        text = f"{head} is probably a second name of {first}: {because}."
    elif because.startswith(_ONLY):
        content, _, rest = because.partition(": ")
        text = f"There is {content} {subject.name.removeprefix('what is ')}: {rest}."
    elif likely:
        text = f"{head} was not reported; {' and '.join(likely)} each lost much of it: {because}."
    else:
        joint = "was reported, but" if reported else "was not reported because"
        text = f"{head} {joint} {because}{_restored_text(restored_by, blamed)}."
    return Verdict(reason, reported, text, restored_by)


_IDEAL = {  # ideal result of each stage
    "ground": "the right ground",
    "clustering": "a cluster of its own",
    "detector": "a right detection",
    "fusion": "the right match",
}


def _restored_text(sets: Sequence[StageSet], blamed: str) -> str:
    """Return a clause with the ideal results that bring an object back.

    It is empty if only that of the blamed stage does, or if none is known.
    """
    if not sets or sets == ((blamed,),):
        return ""
    ideals = [" and ".join(_IDEAL[stage] for stage in stages) for stages in sets]
    if len(sets[0]) > 1:
        return f"; only {' together, or '.join(ideals)} together bring it back"
    if (blamed,) in sets:
        others = " or ".join(_IDEAL[stage] for (stage,) in sets if stage != blamed)
        return f"; {others} alone brings it back, too"
    return f"; {' or '.join(ideals)} alone brings it back"


def _elsewhere_text(sets: Sequence[StageSet]) -> str:
    """Return a clause with the ideal results that report an object at another place; empty: it is right."""
    if not sets:
        return ""
    ideals = " or ".join(" and ".join(_IDEAL[stage] for stage in stages) for stages in sets)
    return f"; its image box fits an object at another place better, which {ideals} would report"


def _by(reason: Reason) -> str:
    """Return our parameter in brackets, or the name of the stage that is not ours."""
    return f"({reason.limit})" if reason.limit is not None else f"(by {reason['by']})"


# --- reported ----------------------------------------------------------------------------------


def _object(reason: Reason) -> str:
    """Name the object of the subject and its cluster."""
    if reason["by"]:
        return f"{reason['by']} has {reason['object']} there"
    return f"cluster {reason['cluster']} is named {reason['object'].name}"


def _reported(reason: Reason, _: Subject) -> str:
    exempt = reason.values.get("exempt")
    return _made_by(reason) + (f", {exempt}: neither right nor wrong" if exempt else "")


def _made_by(reason: Reason) -> str:
    """Say what made a reported object."""
    if "object" not in reason.values:
        return f"{reason['detection']} was kept {_by(reason)}; without a LiDAR nothing tells where it is"
    if reason["opinion"]:
        return f"{_object(reason)}, {reason['opinion']}"
    if not reason["camera"]:
        return _object(reason)
    text = f"{_object(reason)} by {reason['object']}"
    for rest, points, whole in reason["split_off"]:
        off = f"cluster {rest}" if rest >= 0 else "a cluster"
        text += f", which split it off {off} ({points:,} of {whole:,} points)"
    return text


def _also(reason: Reason) -> str:
    """Name the other clusters of the same detection."""
    return " and ".join(f"cluster {cluster}" for cluster in reason["also"])


def _box_owner(reason: Reason) -> str:
    """Name the object that the detection belongs to."""
    return f"which is the box of {reason['box_owner']}" if reason["box_owner"] else "a box that fits it badly"


def _shared_box(reason: Reason, _: Subject) -> str:
    return f"its box also names {_also(reason)} ({reason.limit}: each cluster takes the nearest box)"


def _borrowed(reason: Reason, _: Subject) -> str:
    if reason.limit is None:
        return f"{_object(reason)} by {reason['object']}, {_box_owner(reason)}"
    also = f"that also names {_also(reason)}" if reason["also"] else "that is not on it"
    return f"{_object(reason)} by a box {also} ({reason.limit}: each cluster takes the nearest box)"


def _misnamed(reason: Reason, _: Subject) -> str:
    text = _object(reason) + (f", {reason['opinion']}" if reason["opinion"] else "")
    if reason["camera"] and not reason["own"]:
        text += f" by a detection that is not its own, {_box_owner(reason)}"
    return text


def _misplaced(reason: Reason, _: Subject) -> str:
    return f"its object is too far off: {_object(reason)}, {reason['away']:.1f} m from it ({WITHIN})"


def _split(reason: Reason, _: Subject) -> str:
    parts = " and ".join(map(str, reason["clusters"][:4])) + (" and more" if reason["clusters"][4:] else "")
    by = f" by {reason['by']}" if reason["by"] else ""
    apart = f", {reason['apart']:.2f} m apart" if np.isfinite(reason["apart"]) else ""
    return f"it is split{by} into clusters {parts}{apart}"


def _merged(reason: Reason, _: Subject) -> str:
    names = " and ".join(reason["others"]) or f"{count(reason['rest'], 'point')} that are not its own"
    text = f"cluster {reason['cluster']} holds {names}, too"
    if not np.isfinite(reason["gap"]):
        return text
    gap = f"{reason['gap']:.2f} m"
    if reason["joined_by"] is not None:
        return f"{text}: the fusion joined clusters {gap} apart for {reason['joined_by']}"
    if reason.limit is not None and reason["gap"] > reason["eps"]:
        return f"{text}: other points of the cluster bridge the gap of {gap} between them, {reason.limit}"
    because = reason.limit if reason.limit is not None else f"{reason['by']} made one of them"
    return f"{text}: the gap between them is {reason['gap']:.2f} m and {because}"


# --- LiDAR -------------------------------------------------------------------------------------


def _failed(reason: Reason, _: Subject) -> str:
    failures = "; ".join(f"{stage} failed: {text}" for stage, text in reason["failures"])
    return failures or "there are no clusters"


def _hidden(reason: Reason, _: Subject) -> str:
    front = ""
    if reason["front"] >= 0:
        name = f" ({reason['front_name']})" if reason["front_name"] else ""
        front = f", most of them on cluster {reason['front']}{name}"
    returns = f"{reason['in_front']} of the {reason['aimed']} returns in its direction"
    return f"it is hidden: {count(reason['points'], 'point')} on it, and {returns} end in front of it{front}"


def _no_points(reason: Reason, subject: Subject) -> str:
    points = f"the LiDAR has {count(reason['points'], 'point')}"
    if reason["radius"] is None:
        return f"{_ONLY[0]}: {points} there" if subject.is_place else f"{points} there"
    text = f"{_ONLY[0]}: {points} within {reason['radius']:g} m"
    nearest = reason["nearest"]
    return f"{text}, the nearest is {nearest:.1f} m away" if np.isfinite(nearest) else text


def _ground(reason: Reason, subject: Subject) -> str:
    highest = reason["highest"]
    if not subject.is_place:
        removed = f"{reason['removed']} of its {reason['voxels']} voxels"
        height = float(np.nan_to_num(highest))
        where = (
            f"up to {height:.2f} m high" if height > -0.005 else f"{-height:.2f} m or more below that ground"
        )
        return f"it was taken for ground: {removed}, {where.replace('-0.00', '0.00')} {_by(reason)}"
    number, points = reason["ground_points"], reason["points"]
    all_of_it = number == points
    whole = "all ground" if all_of_it else f"{number} of them ground"
    known = np.isfinite(highest)
    height_text = f", {reason['lowest']:z.2f} to {highest:z.2f} m above its level" if known else ""
    by = f" (by {reason['by']})" if reason["by"] else ""
    return f"{_ONLY[1 if all_of_it else 2]}: {count(points, 'point')}, {whole}{height_text}{by}"


def _noise(reason: Reason, _: Subject) -> str:
    are = "is" if reason["noise"] == 1 else "are"
    points = f"its {count(reason['noise'], 'obstacle point')}"
    if reason["noise"] < reason["obstacles"]:
        points = f"{reason['noise']} of its {count(reason['obstacles'], 'obstacle point')}"
    most = f"none has more than {reason['neighbours']} neighbours within {reason['eps']:g} m"
    return f"{points} {are} noise: {most} ({reason.limit})"


def _no_cluster(reason: Reason, _: Subject) -> str:
    obstacles, noise, by = reason["obstacles"], reason["noise"], reason["by"]
    points = count(obstacles, "obstacle point")
    few = f"{obstacles - noise} of its {points} are" if obstacles > noise else f"none of its {points} is"
    text = f"{few} in a cluster of {by}"
    if "pair" in reason.values:
        nearest = f"the best for {reason['detection']} is cluster {reason['cluster']} ({_pair(reason)})"
        text = f"no cluster of {by} is its own, {nearest}"
    return f"the robot's clustering lost it: {text}" if reason["robot"] else text


def _set_aside(reason: Reason, _: Subject) -> str:
    points = count(reason["count"], "point")
    text = f"its cluster {reason['cluster']} has {points} ({reason.limit})"
    if reason["clusters"] > 1:
        text += f", and {reason['points']} of its points are in {reason['clusters']} such clusters"
    if reason["taker"] is None:
        return text
    whose = f", the box of {reason['taker_owner']}" if reason["taker_owner"] else ""
    return f"{text}: the fusion gave the rest of it to {reason['taker']}{whose}"


# --- detector ----------------------------------------------------------------------------------


def _not_run(reason: Reason, _: Subject) -> str:
    return "the detector never ran: " + "; ".join(reason["problems"])


def _not_detected(reason: Reason, subject: Subject) -> str:
    by, best = reason["by"], reason["detection"]
    wrong = f"; the camera has {best} there" if best is not None else ""
    class_ = "of its class " if subject.label else ""
    if reason["robot"]:
        return f"the robot's detector lost it: {by} has no detection {class_}there{wrong}"
    if reason.limit is None:
        return f"{by} gave no detection {class_}there{wrong}"
    if reason["shared"] is not None:
        fit = f"{reason['shared']} fits it ({reason['overlap']:.2f})"
        return (
            f"the detector has no box for it alone: {fit}, but is the box of {reason['shared_owner']}{wrong}"
        )
    least = reason.limit.number
    if reason["nearest"] is not None:
        fit = f"the best of its class there, {reason['nearest']}, overlaps it by {reason['overlap']:.2f}"
        return f"the detector has no box that fits it: {fit}{wrong}"
    if subject.kind == "detection":
        return "it is probably that of something else: the detector has no candidate for the object there"
    if best is not None and not subject.label:
        return f"the detector has no candidate for it: {best} there is probably that of something else"
    return f"the detector has no candidate {class_}there, not even with a score of {least}{wrong}"


def _below_threshold(reason: Reason, subject: Subject) -> str:
    best = reason["detection"]
    assert reason.limit is not None
    score = best.beside(float(reason.limit.value))
    weak = f"its detection is too weak: {best.name} {score}"
    return f"{f'it is too weak: {score}' if subject.kind == 'detection' else weak}, {reason.limit}"


def _suppressed(reason: Reason, subject: Subject) -> str:
    head = "it" if subject.kind == "detection" else f"its detection {reason['detection']}"
    if reason["rival"] is None:
        return f"{head} was suppressed by a better one"
    whose = f", the box of {reason['rival_owner']}" if reason["rival_owner"] else ""
    return f"{head} was suppressed by {reason['rival']}{whose} (IoU {reason['iou']:.2f}, {reason.limit})"


# --- fusion ------------------------------------------------------------------------------------


def _not_fused(reason: Reason, _: Subject) -> str:
    problems = f": {'; '.join(reason['problems'])}" if reason["problems"] else ""
    return f"{' and '.join(reason['cameras'])} could not be compared with clusters{problems}"


def _pair(reason: Reason) -> str:
    """Return the numbers that the rule of the fusion compared."""
    pair = reason["pair"]
    if not reason["compared"]:
        return "not compared"
    if pair is None:
        return "no point of it is in its frustum"
    if reason["centroid"]:
        return f"{pair.distance:.0f} px, {pair.depth:.1f} m"
    return f"{count(pair.points, 'point')} in its frustum, IoU {pair.iou:.2f}{reason['mask']}"


def _misfit(reason: Reason, _: Subject) -> str:
    part = f"no part of cluster {reason['cluster']}"
    return f"{part} suits {reason['detection']} in outline and size, {reason.limit}"


def _low_overlap(reason: Reason, _: Subject) -> str:
    both = f"{reason['detection']} and cluster {reason['cluster']}"
    return f"{both} overlap too little ({_pair(reason)}), {reason.limit}"


def _too_few_points(reason: Reason, _: Subject) -> str:
    cluster = reason["cluster"]
    if cluster < 0:
        return f"{reason['detection']} found no cluster"
    few = f"too few points of cluster {cluster} ({_pair(reason)})"
    return f"{reason['detection']} has {few}, {reason.limit}"


def _too_far(reason: Reason, _: Subject) -> str:
    both = f"cluster {reason['cluster']} is too far from {reason['detection']}"
    return f"{both} ({_pair(reason)}), {reason.limit}"


def _taken(reason: Reason, _: Subject) -> str:
    text = f"cluster {reason['cluster']}, the best for {reason['detection']}, was taken by "
    if reason["taker"] is None:
        return text + "another camera's detection"
    whose = f", the box of {reason['taker_owner']}" if reason["taker_owner"] else ""
    return f"{text}{reason['taker']}{whose}"


def _other_cluster(reason: Reason, _: Subject) -> str:
    own_cluster = f"cluster {reason['cluster']} ({_pair(reason)})"
    return f"{reason['detection']} went to cluster {reason['matched']}, not to its own, {own_cluster}"


# --- objects that are not ours -----------------------------------------------------------------


def _not_among(reason: Reason, _: Subject) -> str:
    text = f"it is not among the objects of {reason['by']}; "
    if reason["fused"] is None:
        return text + ", ".join(_other_stages(reason))
    points = count(reason["points"], "point")
    named = f"named by {reason['fused']} of {reason['camera']}"
    text += f"our fusion has it: cluster {reason['cluster']} ({points}), {named}"
    return text if reason["partner"] is None else f"{text}, in the box of {reason['partner']}"


def _other_stages(reason: Reason) -> Iterator[str]:
    """Yield the results of the other stages at the place."""
    if reason["cluster"] >= 0:
        yield f"cluster {reason['cluster']} is there"
    else:
        yield f"{count(reason['points'], 'point')} are there and no cluster"
    if reason["detector_known"]:
        best = reason["detection"]
        yield f"{best} as well" if best is not None else "and no detection of it"


def _lost_in_fusion(reason: Reason, _: Subject) -> str:
    ours: Reason | None = reason["ours"]
    cluster = f"cluster {reason['cluster']} of {reason['clustering']}"
    inputs = f"{cluster} and {reason['detection']} of {reason['detector']} are there"
    decision = "could not compare them"
    if ours is not None:
        matches = ours.kind is ReasonKind.MATCHED
        decision = "matches them" if matches else f"refuses them, too: {ours.kind.value}"
        decision += f" ({_pair(reason)})"
    return f"the robot's fusion lost it: {inputs}, but no object of {reason['objects']}; ours {decision}"


# --- false objects -----------------------------------------------------------------------------


def _duplicate(reason: Reason, _: Subject) -> str:
    if reason.values.get("inside"):
        whole = f"it is inside the box of {reason['truth']}"
        return f"{whole}: a second box of it, which {reason['other']} is already"
    what = f"{reason['truth']} is {reason['other']} already" if reason["truth"] else ""
    return f"it is a duplicate: {what or 'its box overlaps that of ' + str(reason['other'])}"


def _part(reason: Reason, _: Subject) -> str:
    return f"its points are a part of {reason['truth']}, which {reason['other']} is already"


def _named_wrongly(reason: Reason, _: Subject) -> str:
    return f"its points are those of {reason['truth']}"


def _off(reason: Reason, _: Subject) -> str:
    return f"its points are those of {reason['truth']}, {reason['away']:.1f} m from it ({WITHIN})"


def _wrong_depth(reason: Reason, _: Subject) -> str:
    whose = reason["truth"] or "the points in the middle of its 2D box"
    off = f"its cluster {reason['cluster']} is {_side(reason)}"
    return f"its 2D box is that of {whose}, and {off} it" if reason["truth"] else f"{off} {whose}"


def _side(reason: Reason) -> str:
    """Say how far an object is before or behind the thing of its 2D box."""
    return f"{abs(reason['off']):.1f} m {'behind' if reason['off'] > 0 else 'before'}"


def _wall(reason: Reason, _: Subject) -> str:
    length, height = reason["size"]
    larger = f"something {length:.1f} m long and {height:.1f} m high"
    text = f"its points (cluster {reason['cluster']}) are a part of {larger} in the frustum"
    return f"{text}, {_side(reason)} {reason['truth']}" if reason["truth"] else text


def _nothing_labelled(reason: Reason, _: Subject) -> str:
    text = "no label is in reach: it is unlabelled, or the detector's own error"
    return f"{text}, and it is {reason['opinion']}" if reason["opinion"] else text


FALSE_SENTENCES: dict[ReasonKind, Callable[[Reason, Subject], str]] = {  # the words after "but"
    ReasonKind.DUPLICATE: _duplicate,
    ReasonKind.SPLIT: _part,
    ReasonKind.MISNAMED: _named_wrongly,
    ReasonKind.MISPLACED: _off,
    ReasonKind.WRONG_DEPTH: _wrong_depth,
    ReasonKind.WALL: _wall,
    ReasonKind.DETECTOR_ERROR: _nothing_labelled,
}

SENTENCES: dict[ReasonKind, Callable[[Reason, Subject], str]] = {  # the words after "because"
    ReasonKind.REPORTED: _reported,
    ReasonKind.SHARED_BOX: _shared_box,
    ReasonKind.BORROWED: _borrowed,
    ReasonKind.SPLIT: _split,
    ReasonKind.MERGED: _merged,
    ReasonKind.MISNAMED: _misnamed,
    ReasonKind.MISPLACED: _misplaced,
    ReasonKind.FAILED: _failed,
    ReasonKind.OUT_OF_VIEW: lambda *_: "no camera has it in view, and only a camera names objects",
    ReasonKind.HIDDEN: _hidden,
    ReasonKind.NO_POINTS: _no_points,
    ReasonKind.GROUND: _ground,
    ReasonKind.NOISE: _noise,
    ReasonKind.NO_CLUSTER: _no_cluster,
    ReasonKind.TOO_SMALL: _set_aside,
    ReasonKind.TOO_LARGE: _set_aside,
    ReasonKind.NOT_RUN: _not_run,
    ReasonKind.NOT_DETECTED: _not_detected,
    ReasonKind.BELOW_THRESHOLD: _below_threshold,
    ReasonKind.SUPPRESSED: _suppressed,
    ReasonKind.SECOND_NAME: lambda reason, _: (
        f"both have the same image box and the same cluster {reason['cluster']}"
    ),
    ReasonKind.NOT_FUSED: _not_fused,
    ReasonKind.LOW_OVERLAP: _low_overlap,
    ReasonKind.TOO_FEW_POINTS: _too_few_points,
    ReasonKind.TOO_FAR: _too_far,
    ReasonKind.TAKEN: _taken,
    ReasonKind.MISFIT: _misfit,
    ReasonKind.OTHER_CLUSTER: _other_cluster,
    ReasonKind.CONTRADICTED: lambda reason, _: f"it is {reason['opinion']}",
    ReasonKind.NOT_AMONG: _not_among,
    ReasonKind.LOST_IN_FUSION: _lost_in_fusion,
}


# --- no change was tried -----------------------------------------------------------------------

_UNTRIED = {  # the reason why no parameter can be tried
    ReasonKind.FAILED: "a stage has failed, which has to be mended first",
    ReasonKind.OUT_OF_VIEW: "no camera has it in view",
    ReasonKind.HIDDEN: "something hides it from the LiDAR",
    ReasonKind.NO_POINTS: "the LiDAR has no points on it",
    ReasonKind.MERGED: "no smaller clustering.eps parts its points from the others",
    ReasonKind.NOT_RUN: "the detector needs a model and an image",
    ReasonKind.NOT_DETECTED: "the detector has no candidate for it, only another model may have one",
    ReasonKind.BELOW_THRESHOLD: "a threshold below its score lets noise pass, only another model may help",
    ReasonKind.SUPPRESSED: "its score is too low as well",
    ReasonKind.SECOND_NAME: "the thing is reported already",
    ReasonKind.NOT_FUSED: "the camera needs a pose and intrinsics",
    ReasonKind.DETECTOR_ERROR: "the detector is as sure of it as of right objects, another model may not be",
}


def untried_text(subject: Subject, verdict: Verdict) -> str:
    """Return a clause with the reason why no change was tried; empty: there is nothing to mend."""
    if verdict.kind is ReasonKind.REPORTED or subject.is_place:
        return ""
    by = verdict.reason.values.get("by", "")
    decided = f"{by} decides this, and bevviz cannot run it with other values" if by else ""
    return f"nothing was tried: {decided or _UNTRIED.get(verdict.kind, 'no parameter decides this')}"
