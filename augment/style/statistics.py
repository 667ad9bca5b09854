"""Colour statistics of a picture's regions: all that the closed forms know of a style or a scene.

Colours are display-encoded, as splats hold them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from augment.semantics import SemanticClass

WHOLE, SKY, LAND = "whole", "sky", "land"  # land: all but the sky
VEGETATION, ROAD, REST = "vegetation", "road", "rest"  # of the land
REGIONS = (WHOLE, SKY, LAND, VEGETATION, ROAD, REST)

# What a Gaussian's class says of its region; every other class is of the rest.
REGION_OF_CLASS: Mapping[SemanticClass, str] = {
    SemanticClass.ROAD: ROAD,
    SemanticClass.LANE_MARKING: ROAD,
    SemanticClass.SIDEWALK: ROAD,
    SemanticClass.TERRAIN: VEGETATION,
    SemanticClass.VEGETATION: VEGETATION,
    SemanticClass.SKY: SKY,
}


@dataclass(frozen=True, eq=False)
class ColorStatistics:
    """Of one region. mean: float64 [3]. covariance: float64 [3, 3], symmetric, not negative
    definite. share: of the picture's weight that the region has, in (0, 1].
    """

    mean: np.ndarray
    covariance: np.ndarray
    share: float = 1.0

    def __post_init__(self) -> None:
        if self.mean.shape != (3,) or self.covariance.shape != (3, 3):
            raise ValueError(
                f"colour statistics are a mean [3] and a covariance [3, 3]; got "
                f"{list(self.mean.shape)} and {list(self.covariance.shape)}"
            )
        if not (np.isfinite(self.mean).all() and np.isfinite(self.covariance).all()):
            raise ValueError(
                f"colour statistics must be finite; got mean {self.mean.tolist()} and covariance "
                f"{self.covariance.tolist()}"
            )


Statistics = Mapping[str, ColorStatistics]  # by region; WHOLE is always there


def statistics_of(
    rgb: np.ndarray, weights: np.ndarray | None = None, *, total: float | None = None
) -> ColorStatistics | None:
    """Of colours float [N, 3] with weights [N] >= 0; None where they weigh nothing.

    total: the whole picture's weight, for the share; the region's own by default.
    """
    rgb = np.asarray(rgb, np.float64).reshape(-1, 3)
    w = np.ones(len(rgb)) if weights is None else np.asarray(weights, np.float64).reshape(-1)
    weight = float(w.sum())
    if weight <= 0:
        return None
    # einsum sums in one order, whatever the threads of a BLAS
    mean = np.einsum("n,nc->c", w, rgb) / weight
    channels = np.ascontiguousarray((rgb - mean).T)
    covariance = np.empty((3, 3))
    for i, channel in enumerate(channels):
        weighted = w * channel
        for j in range(i + 1):
            product = np.einsum("n,n->", weighted, channels[j]) / weight
            covariance[i, j] = covariance[j, i] = product
    whole = weight if total is None else total
    return ColorStatistics(mean, covariance, weight / whole)
