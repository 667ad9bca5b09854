"""Colour statistics of a picture's regions, and the closed-form colour maps between them.

Statistics of a scene (`content`) and of a style come in, from `augment.effects.style.content` and
`images`; `closed_maps` turns them into `StyleMaps` for `augment.effects.style.style`. Colours are
display-encoded, as splats hold them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.style.color_maps import NUM_CLASSES, StyleMaps
from augment.scene.semantics import SemanticClass

# Region of the complete picture.
WHOLE = "whole"
# Region of the sky.
SKY = "sky"
# Region of everything except the sky.
LAND = "land"
# Region of the vegetation and the terrain.
VEGETATION = "vegetation"
# Region of the road with its markings and pavements.
ROAD = "road"
# Region of the land without vegetation and road.
REST = "rest"

# Region of a Gaussian by its class; every other class belongs to REST.
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
    """Colour statistics of one region."""

    mean: np.ndarray
    """Mean colour, float64 [3]."""

    covariance: np.ndarray
    """Covariance of the colours, float64 [3, 3], symmetric, positive semidefinite."""

    share: float = 1.0
    """Share of the picture's weight that the region has, in (0, 1]."""

    def __post_init__(self) -> None:
        shapes = (self.mean.shape, self.covariance.shape)
        finite = np.isfinite(self.mean).all() and np.isfinite(self.covariance).all()
        if shapes != ((3,), (3, 3)) or not finite:
            raise ValueError(
                f"colour statistics are a finite mean [3] and covariance [3, 3]; got "
                f"{self.mean.tolist()} and {self.covariance.tolist()}"
            )


# Colour statistics by region. WHOLE is always among them.
Statistics = Mapping[str, ColorStatistics]


def color_statistics(
    rgb: np.ndarray, weights: np.ndarray | None = None, *, total: float | None = None
) -> ColorStatistics | None:
    """Return the statistics of colours; None if their weights sum to 0.

    Args:
        rgb: display-encoded colours, [N, 3].
        weights: weights of the colours, [N], >= 0; None for 1 each.
        total: weight of the complete picture, for the share; None for the weight of these colours.
    """
    rgb = np.asarray(rgb, np.float64).reshape(-1, 3)
    pixel_weights = (
        np.ones(len(rgb)) if weights is None else np.asarray(weights, np.float64).reshape(-1)
    )
    weight_sum = float(pixel_weights.sum())
    if weight_sum <= 0:
        return None
    # einsum sums in one order, whatever the threads of a BLAS
    mean = np.einsum("n,nc->c", pixel_weights, rgb) / weight_sum
    channels = np.ascontiguousarray((rgb - mean).T)
    covariance = np.empty((3, 3))
    for i, channel in enumerate(channels):
        weighted = pixel_weights * channel
        for j in range(i + 1):
            product = np.einsum("n,n->", weighted, channels[j]) / weight_sum
            covariance[i, j] = covariance[j, i] = product
    total_weight = weight_sum if total is None else total
    return ColorStatistics(mean, covariance, weight_sum / total_weight)


# ---- Linear colour maps in closed form, from the statistics of a scene and of a style ------------
# Both are limited, so that no pair of statistics (grey, constant, black, night) makes a picture of
# noise or of one colour. A map that needs no limit is exact.

# Closed forms: Monge-Kantorovich or Reinhard.
Method = Literal["mkl", "reinhard"]
# Unit vector of the grey axis of RGB space.
_GREY_AXIS = np.full(3, 3**-0.5)


@dataclass(frozen=True)
class Limits:
    """Limits of a colour map."""

    floor: float = 1 / 255
    """Standard deviation added to both sides (in quadrature), about one step of 8 bits: smaller
    deviations are rounding.
    """

    max_gain: float = 3.0
    """Largest gain of any direction of colour; more shows noise and banding."""

    min_gain: float = 0.05
    """Smallest gain of any direction; far below one, because a grey style wants grey."""

    min_contrast: float = 0.4
    """Smallest gain of the grey axis: a constant style tints a scene but leaves its shapes."""

    def __post_init__(self) -> None:
        if not (
            self.floor > 0 and 0 < self.min_gain <= self.min_contrast <= 1 <= self.max_gain < np.inf
        ):
            raise ValueError(
                "limits need floor > 0 and 0 < min_gain <= min_contrast <= 1 <= max_gain; "
                f"got {self}"
            )


# Limits of the maps of the land and of whole pictures.
LAND_LIMITS = Limits()
# Limits of the maps of skies. A sky is smooth, so gains show its steps of 8 bits. A style with a
# plain sky (overcast) wants a plain sky, so less contrast is required.
SKY_LIMITS = Limits(max_gain=2.0, min_contrast=0.2)

# Share of a picture from which a region's map counts.
_SMALL_SHARE = 0.02
# Share of a picture from which a region's map counts fully.
_LARGE_SHARE = 0.15
# Standard deviations that a limited map keeps between its mean and black or white.
_MARGIN_STD = 2.0


def mkl_map(
    content: ColorStatistics, style: ColorStatistics, limits: Limits = LAND_LIMITS
) -> Float[Tensor, "3 4"]:
    """Return the Monge-Kantorovich map, float64.

    Of all linear maps that turn the content's mean and covariance into the style's, it moves
    colours least (Pitie and Kokaram 2007, eq. 9). M = C^-1/2 (C^1/2 S C^1/2)^1/2 C^-1/2 is
    symmetric and positive definite, for the covariances C of the content and S of the style.
    b = target - M mean_c. The target is the style's mean as far as the limits allow it (see
    `_target_mean`).

    Args:
        content: statistics of the scene.
        style: statistics of the style.
        limits: limits of M.
    """
    return _limited_map(content, style, limits, 1.0, _MKL)


def reinhard_map(
    content: ColorStatistics, style: ColorStatistics, limits: Limits = LAND_LIMITS
) -> Float[Tensor, "3 4"]:
    """Return Reinhard's map, float64, with a diagonal matrix.

    It gives each channel of RGB the style's mean and standard deviation (Reinhard et al. 2001,
    eq. 10-11, without their change of colour space), within the limits.
    """
    return _limited_map(content, style, limits, 1.0, _REINHARD)


def closed_maps(
    content: Statistics, style: Statistics, *, method: Method, strength: float, per_region: bool
) -> StyleMaps:
    """Return the maps of a scene's splats, sky and finished pictures.

    If both sides have a SKY, the sky gets its own map, and everything else is mapped from LAND to
    LAND. Otherwise everything is mapped from WHOLE to WHOLE. Finished pictures always are.

    Args:
        content: statistics of the scene, by region.
        style: statistics of the style, by region.
        method: closed form of the maps, "mkl" or "reinhard".
        strength: 0 is the identity and 1 the map, with a straight line between them. Beyond 1 the
            line goes on as far as the limits allow.
        per_region: if True, classes of road, vegetation and the rest get the map of their region
            where both sides have it. It is mixed with the land's map by the region's share in both:
            nothing of it below 2 % of a picture, all of it from 15 %. The class SKY gets the sky's
            map. UNKNOWN may be anything and gets the land's map, as do WATER and SNOW.

    Raises:
        ValueError: there is no such method, or the strength is not in [0, 2].
    """
    if method not in ("mkl", "reinhard"):
        raise ValueError(f"method must be mkl or reinhard; got {method!r}")
    if not 0 <= strength <= 2:
        raise ValueError(f"strength must be in [0, 2]; got {strength}")
    closed_form = _MKL if method == "mkl" else _REINHARD

    def map_between(region: str, limits: Limits = LAND_LIMITS) -> Tensor:
        return _limited_map(content[region], style[region], limits, strength, closed_form)

    picture_map = map_between(WHOLE)
    common_regions = content.keys() & style.keys()
    has_sky = SKY in common_regions
    land_map = map_between(LAND) if has_sky and LAND in common_regions else picture_map
    sky_map = map_between(SKY, SKY_LIMITS) if has_sky else picture_map
    splats = land_map[None]
    if per_region:
        region_maps = {
            region: torch.lerp(
                land_map, map_between(region), _region_weight(content[region], style[region])
            )
            for region in (ROAD, VEGETATION, REST)
            if region in common_regions
        }
        splats = torch.stack(
            [_map_of_class(value, region_maps, land_map, sky_map) for value in range(NUM_CLASSES)]
        )
    content_sky = content[SKY] if has_sky else None
    sky_moments = (
        content_sky
        and torch.from_numpy(np.column_stack([content_sky.covariance, content_sky.mean])).float()
    )
    return StyleMaps(splats.float(), sky_map.float(), picture_map.float(), sky_moments)


def _region_weight(content: ColorStatistics, style: ColorStatistics) -> float:
    """Return the weight of a region's own map, by the smaller share: smooth from 0 to 1."""
    share = min(content.share, style.share)
    x = float(np.clip((share - _SMALL_SHARE) / (_LARGE_SHARE - _SMALL_SHARE), 0, 1))
    return x * x * (3 - 2 * x)


def _map_of_class(
    value: int, region_maps: dict[str, Tensor], land_map: Tensor, sky_map: Tensor
) -> Tensor:
    """Return the map of the semantic class with this value."""
    cls = SemanticClass(value)
    if cls is SemanticClass.SKY:
        return sky_map
    if cls in (SemanticClass.UNKNOWN, SemanticClass.WATER, SemanticClass.SNOW):
        return land_map
    return region_maps.get(REGION_OF_CLASS.get(cls, REST), land_map)


class _Form(NamedTuple):
    """Functions of one closed form."""

    gain: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """Returns the matrix [3, 3] between the content's and the style's floored covariances."""

    limit: Callable[[np.ndarray, Limits], np.ndarray]
    """Returns such a matrix, changed to keep the limits."""


def _limited_map(
    content: ColorStatistics,
    style: ColorStatistics,
    limits: Limits,
    strength: float,
    closed_form: _Form,
) -> Tensor:
    """Return the map of a closed form at a strength, within the limits, float64 [3, 4]."""
    floor = limits.floor**2 * np.eye(3)
    full_matrix = closed_form.limit(
        closed_form.gain(content.covariance + floor, style.covariance + floor), limits
    )
    target = _target_mean(content, style, full_matrix, floor)
    matrix = np.eye(3) + strength * (full_matrix - np.eye(3))
    mean = content.mean + strength * (target - content.mean)
    if strength > 1:  # up to 1 it lies between the identity and a map within the limits
        matrix = closed_form.limit(matrix, limits)
        margin = np.minimum(np.sqrt(np.diag(matrix @ (content.covariance + floor) @ matrix.T)), 0.5)
        lowest = np.minimum(margin, np.minimum(content.mean, target))
        highest = np.maximum(1 - margin, np.maximum(content.mean, target))
        mean = np.clip(mean, lowest, highest)
    offset = mean - matrix @ content.mean
    return torch.from_numpy(np.concatenate([matrix, offset[:, None]], axis=1))


def _mkl_gain(content: np.ndarray, style: np.ndarray) -> np.ndarray:
    """Return the Monge-Kantorovich matrix between two covariances (see `mkl_map`)."""
    values, vectors = np.linalg.eigh(content)
    values = np.maximum(values, 1e-12)  # above the floor, only rounding is smaller
    root = (vectors * np.sqrt(values)) @ vectors.T
    inverse = (vectors / np.sqrt(values)) @ vectors.T
    middle, axes = np.linalg.eigh(root @ style @ root)
    middle_root = (axes * np.sqrt(np.maximum(middle, 0))) @ axes.T
    matrix = inverse @ middle_root @ inverse
    return (matrix + matrix.T) / 2


def _limit_channels(matrix: np.ndarray, limits: Limits) -> np.ndarray:
    """Return the diagonal matrix within the limits; every channel keeps the smallest contrast."""
    return np.diag(np.clip(np.diag(matrix), limits.min_contrast, limits.max_gain))


def _limit_matrix(matrix: np.ndarray, limits: Limits) -> np.ndarray:
    """Return the symmetric matrix with its gains within the limits; itself if they already are."""
    values, vectors = np.linalg.eigh(matrix)
    if values[0] < limits.min_gain or values[-1] > limits.max_gain:
        values = np.clip(values, limits.min_gain, limits.max_gain)
        matrix = (vectors * values) @ vectors.T
        matrix = (matrix + matrix.T) / 2
    missing = limits.min_contrast - _GREY_AXIS @ matrix @ _GREY_AXIS
    return matrix + max(missing, 0.0) * np.outer(_GREY_AXIS, _GREY_AXIS)


_MKL = _Form(_mkl_gain, _limit_matrix)
_REINHARD = _Form(
    lambda content, style: np.diag(np.sqrt(np.diag(style) / np.diag(content))), _limit_channels
)


def _target_mean(
    content: ColorStatistics, style: ColorStatistics, matrix: np.ndarray, floor: np.ndarray
) -> np.ndarray:
    """Return the style's mean, moved off black and white by the room that the contrast needs.

    A constant style may have any mean, up to pure white, and colours that keep some contrast around
    it would be cut off. Only the spread beyond that of the style counts, so that a map that meets
    no limit has the style's mean.
    """
    mapped_variances = np.diag(matrix @ (content.covariance + floor) @ matrix.T)
    style_variances = np.diag(style.covariance + floor)
    margin = np.clip(_MARGIN_STD * (np.sqrt(mapped_variances) - np.sqrt(style_variances)), 0, 0.5)
    # Beyond rounding: without a limit both spreads are the same.
    is_limited = margin > 1e-9
    return np.clip(
        style.mean, np.where(is_limited, margin, -np.inf), np.where(is_limited, 1 - margin, np.inf)
    )
