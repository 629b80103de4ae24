"""Names that a detector of COCO's classes may rightly give to the objects that data sets label."""

from __future__ import annotations

from collections.abc import Iterable

_PERSON = frozenset({"pedestrian", "person"})

KITTI = {  # Geiger, Lenz and Urtasun 2012. The fourth name is that of the raw drives.
    "Pedestrian": _PERSON,
    "Person_sitting": _PERSON | {"person_sitting"},
    "Person": _PERSON,
    "Person (sitting)": _PERSON | {"person_sitting"},
    "Cyclist": frozenset({"cyclist", "person", "bicycle"}),
    "Car": frozenset({"car"}),
    "Van": frozenset({"van", "car", "truck", "bus"}),
    "Truck": frozenset({"truck", "car", "bus"}),
    "Tram": frozenset({"tram", "train", "bus"}),
}
NUSCENES = {  # classes of its detection task (Caesar et al. 2020) that COCO lacks
    "pedestrian": _PERSON,
    "bicycle": frozenset({"bicycle", "cyclist"}),  # nuScenes' boxes include the rider.
    "motorcycle": frozenset({"motorcycle", "motorcyclist"}),
    "trailer": frozenset({"trailer", "truck"}),
    "construction_vehicle": frozenset({"construction_vehicle", "truck"}),
    "traffic_cone": frozenset({"traffic_cone", "traffic cone"}),
}
SEMANTIC_KITTI = {  # Behley et al. 2019, classes that COCO lacks
    "bicyclist": frozenset({"bicyclist", "cyclist", "person", "bicycle"}),
    "motorcyclist": frozenset({"motorcyclist", "person", "motorcycle"}),
    "on-rails": frozenset({"on-rails", "tram", "train", "bus"}),
    "other-vehicle": frozenset({"other-vehicle", "car", "truck", "bus", "train"}),
}
VIEW_OF_DELFT = {  # Palffy et al. 2022, classes that COCO lacks
    "moped_scooter": frozenset({"moped_scooter", "motorcycle"}),
    "motor": frozenset({"motor", "motorcycle"}),
    "rider": frozenset({"rider", "cyclist", "person", "bicycle", "motorcycle"}),
}
SUSTECHPOINTS = {  # Li et al. 2020, classes that COCO lacks
    "Rider": frozenset({"rider", "cyclist", "person", "bicycle", "motorcycle"}),
    "BicycleRider": frozenset({"bicyclerider", "rider", "cyclist", "person", "bicycle"}),
    "MotorcyleRider": frozenset({"motorcylerider", "rider", "person", "motorcycle"}),  # as it is spelt there
    "Motor": frozenset({"motor", "motorcycle"}),
    "ScooterRider": frozenset({"scooterrider", "rider", "person"}),
}
# Labels of things that no detector has to find. A box on one is not false, if its name is accepted.
OPTIONAL = frozenset(
    {
        "bicycle_rack",
        "human_depiction",
        "ride_other",
        "ride_uncertain",
        "vehicle_other",
        "misc",
        "unknown",
        "static_object.bicycle_rack",
    }
)
PART_OF = {"rider": "cyclist"}  # one object with two labels: View of Delft labels the rider, too
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
ACCEPTED_NAMES = KITTI | NUSCENES | SEMANTIC_KITTI | VIEW_OF_DELFT | SUSTECHPOINTS

_STREET = frozenset(
    {"person", "bicycle", "car", "motorcycle", "bus", "truck"}
)  # COCO's own classes of a street

_SYNONYMS = {label.lower(): names for label, names in ACCEPTED_NAMES.items()} | {
    "cyclist": ACCEPTED_NAMES["Cyclist"] | {"rider"}
}


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
    if label in ACCEPTED_NAMES:
        return frozenset(ACCEPTED_NAMES[label] | _SYNONYMS[name])
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
    own = (ACCEPTED_NAMES.get(label, frozenset({label.lower()})) for label in labels)
    return shared.union(*own, *(names for family in families for names in family.values()))
