"""The semantic classes of Gaussians and pixels, few enough to hold across datasets."""

import re
from enum import IntEnum


class SemanticClass(IntEnum):
    """Values are written to semantic images; they never change meaning between versions."""

    UNKNOWN = 0
    ROAD = 1
    LANE_MARKING = 2
    SIDEWALK = 3
    TERRAIN = 4
    VEGETATION = 5
    BUILDING = 6
    BARRIER = 7
    POLE = 8
    SIGN = 9
    VEHICLE = 10
    TWO_WHEELER = 11
    PEDESTRIAN = 12
    OTHER = 13
    SKY = 14
    WATER = 15
    SNOW = 16


# Words in a dataset's name for an object that tell its class.
_WORDS: dict[SemanticClass, frozenset[str]] = {
    SemanticClass.SIGN: frozenset({"sign"}),  # first, for the sign of a pedestrian crossing
    SemanticClass.TWO_WHEELER: frozenset(
        {"bicycle", "bicyclist", "bike", "cyclist", "motorbike", "motorcycle", "motorcyclist"}
        | {"moped", "rider", "scooter"}
    ),
    SemanticClass.PEDESTRIAN: frozenset({"human", "pedestrian", "person"}),
    SemanticClass.VEHICLE: frozenset(
        {"ambulance", "automobile", "bus", "car", "coach", "lorry", "minivan", "pickup", "suv"}
        | {"taxi", "trailer", "tram", "truck", "van", "vehicle"}
    ),
}


def class_of_label(label: str) -> SemanticClass:
    """Return the class of a dataset's name for an object, such as vehicle.bus.rigid or Cyclist.

    UNKNOWN for words that are not known.
    """
    words = set(re.findall("[a-z]+", label.lower()))
    return next(
        (c for c, class_words in _WORDS.items() if not class_words.isdisjoint(words)),
        SemanticClass.UNKNOWN,
    )
