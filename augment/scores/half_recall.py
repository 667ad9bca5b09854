"""V50: the physical number of an effect at which recall has halved against clear air.

Recall is interpolated between neighbouring levels over the logarithm of the number. Intervals are
those of a bootstrap by scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from augment.scores.scene_bootstrap import interval_ends, resample_scenes

# Place of a limit that is milder than the first level, or harsher than the last.
MILDER = -np.inf
HARSHER = np.inf


@dataclass(frozen=True)
class HalfRecall:
    """The number at which recall has halved, with its interval."""

    value: float | None
    """The number; None if recall halves before the first level, or not by the last."""
    bound: str
    """`milder` if recall halves before the first level, `harsher` if not by the last, or empty."""
    interval: tuple[str, str] | None
    """Mildest and harshest end of the interval, as texts; None with a single scene."""


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


def value_at(place: float, values: Sequence[float]) -> float:
    """Return the number at a place between levels, by the logarithm."""
    logarithms = np.log(np.asarray(values, np.float64))
    return float(np.exp(np.interp(place, np.arange(len(values)), logarithms)))


def find_half_recall(
    hits: Float64[np.ndarray, "S L"],
    clean_hits: Float64[np.ndarray, " S"],
    num_objects: Float64[np.ndarray, " S"],
    values: Sequence[float],
    unit: str,
    rng: np.random.Generator,
) -> HalfRecall | None:
    """Return V50 of one effect; None if nothing is found in clear air.

    Args:
        hits: Number of objects that are found, by scene and level.
        clean_hits: Number of objects that are found in clear air, by scene.
        num_objects: Number of objects by scene.
        values: Physical number of each level, above 0.
        unit: Unit of that number, for texts.
    """
    if not clean_hits.sum():
        return None
    weights = np.ones((1, len(hits)), np.int64)
    if len(hits) > 1:
        weights = np.concatenate([weights, resample_scenes(len(hits), rng)])
    count = np.maximum(weights @ num_objects, 1)
    clean_recalls = weights @ clean_hits / count
    places = half_places(clean_recalls, weights @ hits / count[:, None])
    place = float(places[0])
    interval = None
    if len(hits) > 1:
        milder, harsher = interval_ends(places[1:][clean_recalls[1:] > 0])
        interval = (place_text(milder, values, unit), place_text(harsher, values, unit))
    return HalfRecall(
        value=value_at(place, values) if np.isfinite(place) else None,
        bound="" if np.isfinite(place) else "milder" if place < 0 else "harsher",
        interval=interval,
    )


def place_text(place: float, values: Sequence[float], unit: str) -> str:
    """Return a place between levels as a text with its unit."""
    if place == MILDER:
        return f"milder than {values[0]:g} {unit}"
    if place == HARSHER:
        return f"harsher than {values[-1]:g} {unit}"
    return f"{value_at(place, values):.3g} {unit}"
