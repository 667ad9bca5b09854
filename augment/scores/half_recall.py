"""V50: the physical number of an effect at which recall has halved against clear air.

Recall is interpolated between neighbouring levels over the logarithm of the number. Between two
levels of the same number V50 has no value, and is stated in words. Intervals are those of a
bootstrap by scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from augment.scores.scene_bootstrap import interval_ends, resample_scenes
from augment.scores.suite_scores import HalfRecallScore

# Place of a limit that is milder than the first level, or harsher than the last.
MILDER = -np.inf
HARSHER = np.inf


class Levels(NamedTuple):
    """Levels of an effect that are scored, mildest first."""

    names: tuple[str, ...]
    """Names of the variants, such as `fog-3`."""
    values: tuple[float, ...]
    """Physical number of each level, above 0; two levels may have the same."""
    unit: str
    """Unit of that number, for texts."""


def half_places(
    clean_recalls: Float64[np.ndarray, " R"], recalls: Float64[np.ndarray, "R L"]
) -> Float64[np.ndarray, " R"]:
    """Return the place, between levels, at which recall first falls to half of the clean one.

    Args:
        clean_recalls: Recall in clear air.
        recalls: Recall at each level, mildest first.

    Returns:
        0 for the first level, 0.5 for the middle between the first two, and so on; MILDER or
        HARSHER outside.
    """
    half = clean_recalls / 2
    is_below = recalls <= half[:, None]
    upper = is_below.argmax(axis=1)
    rows = np.arange(len(recalls))
    lower = np.maximum(upper - 1, 0)
    drop = recalls[rows, lower] - recalls[rows, upper]
    share = (recalls[rows, lower] - half) / np.where(drop > 0, drop, 1.0)
    places = np.where(upper > 0, lower + share, np.where(recalls[:, 0] == half, 0.0, MILDER))
    return np.where(is_below.any(axis=1), places, HARSHER)


def value_at(place: float, values: Sequence[float]) -> float | None:
    """Return the number at a place between levels, by the logarithm.

    None outside the levels, and between two levels of the same number: they differ in something
    else, which the number does not tell.
    """
    if not math.isfinite(place):
        return None
    upper = math.ceil(place)
    if upper > 0 and values[upper - 1] == values[upper]:
        return None
    logarithms = np.log(np.asarray(values, np.float64))
    return float(np.exp(np.interp(place, np.arange(len(values)), logarithms)))


def find_half_recall(
    hits: Float64[np.ndarray, "S L"],
    clean_hits: Float64[np.ndarray, " S"],
    num_objects: Float64[np.ndarray, " S"],
    levels: Levels,
    rng: np.random.Generator,
) -> HalfRecallScore | None:
    """Return V50 of one effect; None if nothing is found in clear air.

    Args:
        hits: Number of objects that are found, by scene and level.
        clean_hits: Number of objects that are found in clear air, by scene.
        num_objects: Number of objects by scene.
        levels: The levels.
    """
    if not clean_hits.sum():
        return None
    weights = np.ones((1, len(hits)), np.int64)
    if len(hits) > 1:
        weights = np.concatenate([weights, resample_scenes(len(hits), rng)])
    count = np.maximum(weights @ num_objects, 1)
    clean_recalls = weights @ clean_hits / count
    places = half_places(clean_recalls, weights @ hits / count[:, None])
    interval = None
    if len(hits) > 1:
        milder, harsher = interval_ends(places[1:][clean_recalls[1:] > 0])
        interval = (place_text(milder, levels), place_text(harsher, levels))
    place = float(places[0])
    return HalfRecallScore(
        text=place_text(place, levels), value=value_at(place, levels.values), interval=interval
    )


def place_text(place: float, levels: Levels) -> str:
    """Return a place between levels as a text with its unit."""
    values = levels.values
    if place == MILDER:
        return f"milder than {values[0]:g} {levels.unit}"
    if place == HARSHER:
        last = f"{values[-1]:g} {levels.unit}"
        is_alone = values.count(values[-1]) == 1
        return f"harsher than {last}" if is_alone else f"harsher than {levels.names[-1]}, {last}"
    value = value_at(place, values)
    if value is not None:
        return f"{value:.3g} {levels.unit}"
    upper = math.ceil(place)
    return (
        f"{levels.names[upper]} but not {levels.names[upper - 1]}, both "
        f"{values[upper]:g} {levels.unit}"
    )
