"""Bootstrap by scene: images of a scene resemble each other, so scenes are drawn and not boxes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

# Number of resamples.
NUM_RESAMPLES = 10_000
# Share of resamples inside an interval.
CONFIDENCE = 0.95


def resample_scenes(
    num_scenes: int, rng: np.random.Generator, num_resamples: int = NUM_RESAMPLES
) -> Int64[np.ndarray, "R S"]:
    """Return how often each scene is in each resample."""
    return rng.multinomial(num_scenes, np.full(num_scenes, 1 / num_scenes), size=num_resamples)


def interval_ends(values: Float64[np.ndarray, " R"]) -> tuple[float, float]:
    """Return the lower and the upper end of an interval of resampled values.

    The ends are values of resamples, since values may be infinite.
    """
    tail = (1 - CONFIDENCE) / 2
    lower, upper = np.quantile(values, [tail, 1 - tail], method="inverted_cdf")
    return float(lower), float(upper)


def recall_interval(
    hits: Float64[np.ndarray, " S"],
    num_objects: Float64[np.ndarray, " S"],
    rng: np.random.Generator,
) -> tuple[float, float] | None:
    """Return the interval of the share of objects that are found.

    None with a single scene, and without objects.

    Args:
        hits: Number of objects that are found, by scene.
        num_objects: Number of objects, by scene.
    """
    if len(hits) < 2 or not num_objects.any():
        return None
    weights = resample_scenes(len(hits), rng)
    count = weights @ num_objects
    has_objects = count > 0
    return interval_ends((weights @ hits)[has_objects] / count[has_objects])
