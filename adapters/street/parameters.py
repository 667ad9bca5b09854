"""What a procedural street may be asked for, and the URI that says so."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

from augment.errors import AdapterError

# Smallest and largest value of each parameter; both are allowed.
LIMITS: dict[str, tuple[float, float]] = {
    "seed": (0, 2**31 - 1),
    "frames": (1, 300),
    "width": (16, 4096),
    "height": (16, 4096),
    "speed_mps": (0.0, 20.0),
    "gaussians": (60_000, 4_000_000),
    "parked": (0, 40),
    "moving": (0, 6),
    "pedestrians": (0, 6),
    "lidar_columns": (16, 4096),
    "lidar_rings": (2, 256),
}


@dataclass(frozen=True)
class StreetParameters:
    """Everything that decides a street: equal parameters give equal bits.

    seed: layout, colours, sky. frames: at 10 Hz. width, height: of every camera's image, pixels.
    speed_mps: of the ego car. gaussians: how many to aim for, actors included (met within a few
    per cent). parked, moving: cars beside and on the road. pedestrians: walking on the pavements.
    lidar_columns, lidar_rings: rays per turn and per column.
    """

    seed: int = 0
    frames: int = 20
    width: int = 960
    height: int = 540
    speed_mps: float = 8.0
    gaussians: int = 290_000
    parked: int = 12
    moving: int = 3
    pedestrians: int = 2
    lidar_columns: int = 1024
    lidar_rings: int = 64

    @property
    def name(self) -> str:
        return f"street-seed{self.seed}"

    @property
    def uri(self) -> str:
        """Canonical: the seed, then whatever differs from its default, in the order above."""
        shown = [
            f"{field.name}={getattr(self, field.name)}"
            for field in dataclasses.fields(self)
            if field.name == "seed" or getattr(self, field.name) != field.default
        ]
        return "procedural:street?" + "&".join(shown)


def parse_parameters(query: Mapping[str, str]) -> StreetParameters:
    """Parameters of a URI's query.

    Raises:
        AdapterError: an unknown key, a value that is no number, or one outside its limits.
    """
    fields = {field.name: type(field.default) for field in dataclasses.fields(StreetParameters)}
    unknown = sorted(set(query) - set(fields))
    if unknown:
        raise AdapterError(
            f"procedural:street does not know {', '.join(map(repr, unknown))}; "
            f"it takes {', '.join(fields)}"
        )
    return StreetParameters(**{k: _number(k, text, fields[k]) for k, text in query.items()})


def _number(key: str, text: str, kind: type) -> int | float:
    low, high = LIMITS[key]
    expected = f"{'a whole number' if kind is int else 'a number'} from {low} to {high}"
    try:
        value = kind(text)
    except ValueError as error:
        raise AdapterError(f"procedural:street: {key} must be {expected}; got {text!r}") from error
    if not (math.isfinite(value) and low <= value <= high):
        raise AdapterError(f"procedural:street: {key} must be {expected}; got {text!r}")
    return value
