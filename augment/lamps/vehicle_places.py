"""Places of the lamps on a vehicle's box, by the kind of vehicle.

Heights and insets lie within the limits of UN R48: dipped beams 0.5 to 1.2 m high and at most 0.4 m
from the side, tail and stop lamps 0.35 to 1.5 m high. Boxes: x forward, y left, z up from the
centre, metres.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum, auto

from augment.lamps.lamp_types import (
    BICYCLE_FRONT,
    BICYCLE_REAR,
    DAYTIME,
    DIPPED,
    FRONT_FOG,
    HIGH,
    REAR_FOG,
    STOP,
    TAIL,
    THIRD_STOP,
    LampType,
)
from augment.scene.labels import EGO_VEHICLE
from augment.scene.semantics import SemanticClass, class_of_label

# Length from which on a vehicle whose label does not say more is a truck, metres.
TRUCK_LENGTH_M = 6.5
# Height from which on it is one, metres.
TRUCK_HEIGHT_M = 2.7
# Height of a car's headlamps, in heights of its box: 0.70 m of 1.45 m.
CAR_HEAD_SHARE = 0.48
# Height of a car's tail lamps, in heights of its box: 0.90 m of 1.45 m.
CAR_REAR_SHARE = 0.62
# Distance of the middle of a car's headlamps from the sides of its box, metres. Labelled boxes
# include mirrors.
CAR_HEAD_INSET_M = 0.3
# Distance of the middle of a car's tail lamps from the sides of its box, metres.
CAR_REAR_INSET_M = 0.35
# Length from which on a two-wheeler whose label does not say more is a motorcycle, metres.
MOTORCYCLE_LENGTH_M = 2.0


class Body(Enum):
    """Kinds of vehicles that differ in their lamps."""

    CAR = auto()
    TRUCK = auto()
    TRAILER = auto()
    MOTORCYCLE = auto()
    BICYCLE = auto()


@dataclass(frozen=True)
class LampPlace:
    """Place of a lamp, or of a pair of lamps, on a box."""

    lamp_type: LampType
    """Type of the lamp."""
    along: float
    """Distance ahead of the centre, in half lengths; negative for rear lamps, which face back."""
    inset_m: float | None
    """Distance from the sides of the box, metres; None for one lamp in the middle."""
    height_m: float
    """Height above the bottom of the box, metres."""
    height_share: float = 0.0
    """Further height, in heights of the box."""
    is_left_only: bool = False
    """If True, only the left one of the pair exists (the right one where traffic keeps left)."""


_TRUCK_WORDS = frozenset({"truck", "bus", "coach", "lorry", "tram", "train", "trolley", "subway"})
_TRAILER_WORDS = frozenset({"trailer", "towed"})
_MOTOR_WORDS = frozenset({"motorbike", "motorcycle", "motorcyclist", "moped", "motorized"})
_BICYCLE_WORDS = frozenset({"bicycle", "bicyclist", "bike", "cyclist"})
# Words of vehicles without lamps of this kind.
_DARK_WORDS = frozenset({"construction"})


def body_of(label: str, size_m: tuple[float, float, float]) -> Body | None:
    """Return the kind of body that a label and a box mean; None for what has no lamps.

    Args:
        label: the dataset's name for the object.
        size_m: length, width and height of the box, metres.
    """
    if label == EGO_VEHICLE:
        return None
    words = set(re.findall("[a-z]+", label.lower()))
    object_class = class_of_label(label)
    if object_class == SemanticClass.TWO_WHEELER or not words.isdisjoint(_MOTOR_WORDS):
        if not words.isdisjoint(_MOTOR_WORDS):
            return Body.MOTORCYCLE
        is_bicycle = not words.isdisjoint(_BICYCLE_WORDS) or size_m[0] < MOTORCYCLE_LENGTH_M
        return Body.BICYCLE if is_bicycle else Body.MOTORCYCLE
    if not words.isdisjoint(_TRAILER_WORDS):
        return Body.TRAILER
    if object_class != SemanticClass.VEHICLE or not words.isdisjoint(_DARK_WORDS):
        return None
    is_large = size_m[0] > TRUCK_LENGTH_M or size_m[2] > TRUCK_HEIGHT_M
    is_truck = not words.isdisjoint(_TRUCK_WORDS) and "pickup" not in words
    return Body.TRUCK if is_large or is_truck else Body.CAR


_PLACES: dict[Body, tuple[LampPlace, ...]] = {
    Body.CAR: (
        LampPlace(DIPPED, 0.9, CAR_HEAD_INSET_M, 0.0, CAR_HEAD_SHARE),
        LampPlace(HIGH, 0.9, CAR_HEAD_INSET_M, 0.0, CAR_HEAD_SHARE),
        LampPlace(DAYTIME, 0.9, CAR_HEAD_INSET_M, 0.0, CAR_HEAD_SHARE),
        LampPlace(FRONT_FOG, 0.93, 0.3, 0.4),
        LampPlace(TAIL, -0.98, CAR_REAR_INSET_M, 0.0, CAR_REAR_SHARE),
        LampPlace(STOP, -0.98, CAR_REAR_INSET_M, 0.0, CAR_REAR_SHARE),
        LampPlace(THIRD_STOP, -0.6, None, 0.0, 0.93),
        LampPlace(REAR_FOG, -0.98, 0.35, 0.6, is_left_only=True),
    ),
    Body.TRUCK: (
        LampPlace(DIPPED, 0.97, 0.3, 0.9),
        LampPlace(HIGH, 0.97, 0.3, 0.9),
        LampPlace(DAYTIME, 0.97, 0.3, 0.9),
        LampPlace(FRONT_FOG, 0.97, 0.35, 0.55),
        LampPlace(TAIL, -0.99, 0.3, 1.1),
        LampPlace(STOP, -0.99, 0.3, 1.1),
        LampPlace(REAR_FOG, -0.99, 0.4, 0.9, is_left_only=True),
    ),
    Body.TRAILER: (
        LampPlace(TAIL, -0.98, 0.2, 0.9),
        LampPlace(STOP, -0.98, 0.2, 0.9),
        LampPlace(REAR_FOG, -0.98, 0.3, 0.9, is_left_only=True),
    ),
    Body.MOTORCYCLE: (
        LampPlace(DIPPED, 0.75, None, 0.85),
        LampPlace(HIGH, 0.75, None, 0.85),
        LampPlace(DAYTIME, 0.75, None, 0.85),
        LampPlace(TAIL, -0.85, None, 0.7),
        LampPlace(STOP, -0.85, None, 0.7),
    ),
    Body.BICYCLE: (
        LampPlace(BICYCLE_FRONT, 0.55, None, 0.8),
        LampPlace(BICYCLE_REAR, -0.8, None, 0.65),
    ),
}


def places_of(body: Body) -> tuple[LampPlace, ...]:
    """Return the places of all lamps that a kind of body may have, lit or not."""
    return _PLACES[body]


def points_of(
    place: LampPlace, size_m: tuple[float, float, float], *, left_hand_traffic: bool
) -> list[tuple[float, float, float]]:
    """Return the points of a place on a box: x, y, z from its centre, metres.

    Args:
        place: the place.
        size_m: length, width and height of the box, metres.
        left_hand_traffic: if True, lamps of one side are on the other one.
    """
    length, width, height = size_m
    x = place.along * length / 2
    # Low boxes, as of a pile of toys, keep their lamps inside.
    z = min(place.height_m + place.height_share * height, 0.97 * height) - height / 2
    if place.inset_m is None:
        return [(x, 0.0, z)]
    y = max(width / 2 - place.inset_m, 0.1)
    if place.is_left_only:
        return [(x, -y if left_hand_traffic else y, z)]
    return [(x, y, z), (x, -y, z)]
