"""What a detector of COCO's classes may rightly call the objects that data sets label."""

from __future__ import annotations

_PERSON = frozenset({"pedestrian", "person"})

KITTI = {  # Geiger, Lenz and Urtasun 2012; the fourth as the raw drives have it
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
NUSCENES = {  # classes of its detection task (Caesar et al. 2020), where COCO has others
    "pedestrian": _PERSON,
    "bicycle": frozenset({"bicycle", "cyclist"}),  # its boxes are around whoever rides it
    "motorcycle": frozenset({"motorcycle", "motorcyclist"}),
    "trailer": frozenset({"trailer", "truck"}),
    "construction_vehicle": frozenset({"construction_vehicle", "truck"}),
    "traffic_cone": frozenset({"traffic_cone", "traffic cone"}),
}
SEMANTIC_KITTI = {  # Behley et al. 2019, where COCO has others
    "bicyclist": frozenset({"bicyclist", "cyclist", "person", "bicycle"}),
    "motorcyclist": frozenset({"motorcyclist", "person", "motorcycle"}),
    "on-rails": frozenset({"on-rails", "tram", "train", "bus"}),
    "other-vehicle": frozenset({"other-vehicle", "car", "truck", "bus", "train"}),
}
ACCEPTED = KITTI | NUSCENES | SEMANTIC_KITTI
