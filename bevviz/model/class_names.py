"""One table of what the labels of data sets accept, and of which objects have to be found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple


class LabelRule(NamedTuple):
    """Rule for the objects with one label: which names find them, and whether they have to be found.

    Attributes:
        names: right names of such an object, in lower case.
        judged: False: no such object has to be found, and an object on one is neither right nor wrong.
        whole: label of the object that it is a part of. Beside one, it need not be found. Empty: it is whole.
    """

    names: frozenset[str]
    judged: bool = True
    whole: str = ""


def _rule(*names: str, whole: str = "") -> LabelRule:
    """Return the rule of a label that accepts names."""
    return LabelRule(frozenset(names), whole=whole)


def _ignored(*labels: str) -> dict[str, LabelRule]:
    """Return the rules of labels that are not judged."""
    return {label: LabelRule(frozenset({label.lower()}), judged=False) for label in labels}


KITTI = {  # Geiger, Lenz and Urtasun 2012. The fourth name is that of the raw drives.
    "Pedestrian": _rule("pedestrian", "person"),
    "Person_sitting": _rule("pedestrian", "person", "person_sitting"),
    "Person": _rule("pedestrian", "person"),
    "Person (sitting)": _rule("pedestrian", "person", "person_sitting"),
    "Cyclist": _rule("cyclist", "person", "bicycle"),
    "Car": _rule("car"),
    "Van": _rule("van", "car", "truck", "bus"),
    "Truck": _rule("truck", "car", "bus"),
    "Tram": _rule("tram", "train", "bus"),
    **_ignored("Misc"),
}
NUSCENES = {  # classes of its detection task (Caesar et al. 2020) that COCO lacks
    "pedestrian": _rule("pedestrian", "person"),
    "bicycle": _rule("bicycle", "cyclist"),  # nuScenes' boxes include the rider.
    "motorcycle": _rule("motorcycle", "motorcyclist"),
    "trailer": _rule("trailer", "truck"),
    "construction_vehicle": _rule("construction_vehicle", "truck"),
    "traffic_cone": _rule("traffic_cone", "traffic cone"),
    **_ignored("static_object.bicycle_rack"),
}
SEMANTIC_KITTI = {  # Behley et al. 2019, classes that COCO lacks
    "bicyclist": _rule("bicyclist", "cyclist", "person", "bicycle"),
    "motorcyclist": _rule("motorcyclist", "person", "motorcycle"),
    "on-rails": _rule("on-rails", "tram", "train", "bus"),
    "other-vehicle": _rule("other-vehicle", "car", "truck", "bus", "train"),
}
VIEW_OF_DELFT = {  # Palffy et al. 2022, classes that COCO lacks. The rider of a cyclist has a label, too.
    "moped_scooter": _rule("moped_scooter", "motorcycle"),
    "motor": _rule("motor", "motorcycle"),
    "rider": _rule("rider", "cyclist", "person", "bicycle", "motorcycle", whole="cyclist"),
    **_ignored("bicycle_rack", "human_depiction", "ride_other", "ride_uncertain", "vehicle_other"),
}
SUSTECHPOINTS = {  # Li et al. 2020, classes that COCO lacks
    "Rider": _rule("rider", "cyclist", "person", "bicycle", "motorcycle", whole="cyclist"),
    "BicycleRider": _rule("bicyclerider", "rider", "cyclist", "person", "bicycle"),
    "MotorcyleRider": _rule("motorcylerider", "rider", "person", "motorcycle"),  # as it is spelt there
    "Motor": _rule("motor", "motorcycle"),
    "ScooterRider": _rule("scooterrider", "rider", "person"),
    **_ignored("Unknown"),
}
NUSCENES_CLASSES = {  # nuScenes' category -> class of its detection task, which omits the other categories
    "movable_object.barrier": "barrier",
    "movable_object.trafficcone": "traffic_cone",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.construction": "construction_vehicle",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
}
DATA_SETS = (KITTI, NUSCENES, SEMANTIC_KITTI, VIEW_OF_DELFT, SUSTECHPOINTS)
RULES = KITTI | NUSCENES | SEMANTIC_KITTI | VIEW_OF_DELFT | SUSTECHPOINTS
_IGNORED = {label.lower(): rule for label, rule in RULES.items() if not rule.judged}

_STREET = frozenset(
    {"person", "bicycle", "car", "motorcycle", "bus", "truck"}
)  # COCO's own classes of a street

_SYNONYMS = {label.lower(): rule.names for label, rule in RULES.items()} | {
    "cyclist": RULES["Cyclist"].names | {"rider"}
}
_NONE: Mapping[str, tuple[str, ...]] = MappingProxyType({})


def rule_of(label: str, stated: Mapping[str, tuple[str, ...]] = _NONE) -> LabelRule:
    """Return the rule of a label. A label without a rule accepts its own name only.

    Args:
        label: label of a data set or of a topic with ground truth.
        stated: label -> right names, of the user (``source.labels``). No name: the label is not judged.
    """
    if label in stated:
        names = frozenset(name.lower() for name in stated[label])
        return LabelRule(names or frozenset({label.lower()}), judged=bool(names))
    name = label.lower()
    return RULES.get(label) or _IGNORED.get(name) or LabelRule(frozenset({name}))


def accepted_names(label: str, known: Iterable[str]) -> frozenset[str]:
    """Return the names, in lower case, that a detector may rightly give to an object with a label.

    A detector that knows the label must use it. KITTI's labels accept several names. A category of nuScenes
    stands for its class.

    Args:
        label: label of a data set.
        known: class names of the detector.
    """
    label = NUSCENES_CLASSES.get(label, label)
    name = label.lower()
    if label in RULES:
        return frozenset(RULES[label].names | _SYNONYMS[name])
    if any(name == other.lower() for other in known):
        return frozenset({name})
    return frozenset({name, *_SYNONYMS.get(name, ())})


def judged_names(labels: Iterable[str]) -> frozenset[str]:
    """Return the names, in lower case, of which an object without a label of its own is false.

    A label speaks for the names that it accepts, and for those of its data set, which labels such objects in
    other frames. A frame without labels speaks for the names of all data sets. An object of another name is
    neither right nor wrong, since nobody labelled such objects.

    Args:
        labels: labels of a frame.
    """
    labels = frozenset(labels)
    families = [family for family in DATA_SETS if family.keys() & labels] if labels else DATA_SETS
    shared = _STREET if any(family is not KITTI for family in families) else frozenset[str]()
    own = (rule_of(label).names for label in labels)
    return shared.union(*own, *(rule.names for family in families for rule in family.values()))
