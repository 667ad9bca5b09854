"""A recipe's snow in a scene, before any of it is laid."""

from __future__ import annotations

from dataclasses import dataclass

from recipes.snow import Snow


@dataclass(frozen=True)
class PlacedSnow:
    """Snow of one recipe. seed: of its drifts. water_level_z_m: of the flood that melts what it
    reaches, scene world; None without one.
    """

    snow: Snow
    seed: int
    water_level_z_m: float | None = None
