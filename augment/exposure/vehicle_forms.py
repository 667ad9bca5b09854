"""Generic side views of vehicles, by class and size, which a shell is fitted from.

A side view is a line of six knots along the middle of a vehicle, from the rear to the front:

0 the rear end of the boot or bed; 1 the foot of the rear window; 2 the roof's rear edge; 3 its
front edge; 4 the foot of the windscreen; 5 the front end of the bonnet.

The numbers were read off cars, vans and trucks of usual makes. They are where a fit starts, and
what is left where a vehicle has no points.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

NUM_KNOTS = 6
# Standard deviation of the knots about a form: along the vehicle, in lengths; upwards, in heights.
KNOT_X_SIGMAS = (0.02, 0.05, 0.05, 0.05, 0.04, 0.02)
KNOT_Z_SIGMAS = (0.06, 0.06, 0.03, 0.03, 0.06, 0.06)
# Height of a car from which on it may be a minivan, metres.
MIN_MINIVAN_HEIGHT_M = 1.75


@dataclass(frozen=True)
class VehicleForm:
    """Side view of a kind of vehicle, relative to its box."""

    name: str
    """Name of the kind."""
    knots_x: tuple[float, ...]
    """Places of the knots along the box from its centre, in lengths of the box; front positive."""
    knots_z: tuple[float, ...]
    """Heights of the knots over the bottom of the box, in heights of the box."""
    roof_rise: float
    """Rise of the roof's middle over the line between its edges, in heights of the box."""
    has_bed: bool = False
    """True if an open bed lies behind the cab."""
    has_upright_rear: bool = False
    """True if the rear window is too steep to hold a layer, whatever few points say."""
    has_upright_front: bool = False
    """True if the windscreen is."""


HATCHBACK = VehicleForm(
    "hatchback",
    (-0.485, -0.46, -0.33, 0.06, 0.24, 0.47),
    (0.63, 0.68, 0.945, 0.965, 0.665, 0.50),
    0.025,
)
SALOON = VehicleForm(
    "saloon",
    (-0.485, -0.36, -0.17, 0.08, 0.26, 0.47),
    (0.67, 0.71, 0.95, 0.965, 0.665, 0.50),
    0.025,
)
SUV = VehicleForm(
    "suv",
    (-0.49, -0.47, -0.40, 0.08, 0.25, 0.47),
    (0.56, 0.62, 0.93, 0.96, 0.66, 0.56),
    0.025,
    has_upright_rear=True,
)
VAN = VehicleForm(
    "van",
    (-0.495, -0.485, -0.46, 0.16, 0.34, 0.47),
    (0.50, 0.80, 0.96, 0.97, 0.64, 0.52),
    0.015,
    has_upright_rear=True,
)
PICKUP = VehicleForm(
    "pickup",
    (-0.485, -0.17, -0.115, 0.07, 0.24, 0.47),
    (0.70, 0.71, 0.955, 0.965, 0.68, 0.60),
    0.02,
    has_bed=True,
    has_upright_rear=True,
)
BOX_TRUCK = VehicleForm(
    "box truck",
    (-0.497, -0.494, -0.49, 0.17, 0.20, 0.45),
    (0.70, 0.90, 0.985, 0.985, 0.74, 0.70),
    0.005,
    has_upright_rear=True,
    has_upright_front=True,
)
BUS = VehicleForm(
    "bus",
    (-0.497, -0.495, -0.48, 0.47, 0.492, 0.497),
    (0.60, 0.80, 0.975, 0.975, 0.80, 0.60),
    0.02,
    has_upright_rear=True,
    has_upright_front=True,
)

# Words in labels of vehicles that no form describes.
_FORMLESS_WORDS = frozenset(
    {"construction", "emergency", "other", "towed", "trailer", "train", "tram", "uncommon"}
)
# Forms by words in a dataset's label; the first row with a word of the label counts.
_FORMS_BY_WORDS = (
    (frozenset({"pickup"}), (PICKUP,)),
    (frozenset({"bus", "coach"}), (BUS,)),
    (frozenset({"lorry", "semi", "truck"}), (VAN, BOX_TRUCK)),
    (frozenset({"minivan", "van"}), (VAN, SUV)),
)


def forms_of_label(label: str, height_m: float) -> tuple[VehicleForm, ...]:
    """Return the forms that a vehicle with a dataset's label can have; () where none is known.

    Args:
        label: the dataset's name for the kind of vehicle.
        height_m: height of the vehicle's box.
    """
    words = set(re.findall("[a-z]+", label.lower()))
    if words & _FORMLESS_WORDS:
        return ()
    for form_words, forms in _FORMS_BY_WORDS:
        if words & form_words:
            return forms
    cars = (HATCHBACK, SALOON, SUV)
    return (*cars, VAN) if height_m > MIN_MINIVAN_HEIGHT_M else cars
