"""Colour statistics of a picture's regions: all that the closed forms know of a style or a scene.

Colours are display-encoded, as splats hold them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.style.color_maps import CLASSES, StyleMaps
from augment.semantics import SemanticClass

WHOLE = "whole"
SKY = "sky"
LAND = "land"  # everything except the sky
VEGETATION = "vegetation"
ROAD = "road"
REST = "rest"  # land without vegetation and road

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


Statistics = Mapping[str, ColorStatistics]  # by region; WHOLE is always there


def statistics_of(
    rgb: np.ndarray, weights: np.ndarray | None = None, *, total: float | None = None
) -> ColorStatistics | None:
    """Return the statistics of colours float [N, 3]; None if their weights sum to 0.

    weights: [N], >= 0. total: weight of the complete picture, for the share; by default the weight
    of these colours.
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
    total_weight = weight if total is None else total
    return ColorStatistics(mean, covariance, weight / total_weight)


# ---- Linear colour maps in closed form, from the statistics of a scene and of a style ------------
# Both are limited, so that no pair of statistics (grey, constant, black, night) makes a picture of
# noise or of one colour; a map that needs no limit is the exact one.

Method = Literal["mkl", "reinhard"]
_GREY = np.full(3, 3**-0.5)


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


LAND_LIMITS = Limits()
# A sky is smooth: gains show its steps of 8 bits; and a plain sky (overcast) is a wish.
SKY_LIMITS = Limits(max_gain=2.0, min_contrast=0.2)

_SMALL_SHARE = 0.02  # share of a picture from which a region's own map counts
_LARGE_SHARE = 0.15  # share of a picture from which a region's own map counts fully
_ROOM = 2.0  # standard deviations that a limited map keeps between its mean and black or white


def mkl_map(
    content: ColorStatistics, style: ColorStatistics, limits: Limits = LAND_LIMITS
) -> Float[Tensor, "3 4"]:
    """Monge-Kantorovich: of all linear maps that turn the content's mean and covariance into the
    style's, the one that moves colours least (Pitie and Kokaram 2007, eq. 9), float64.

    M = C^-1/2 (C^1/2 S C^1/2)^1/2 C^-1/2, symmetric and positive definite, within the limits;
    b = target - M mean_c, the target being the style's mean as far as the limits let it
    (see `_target_mean`).
    """
    return _mapped(content, style, limits, 1.0, _MKL)


def reinhard_map(
    content: ColorStatistics, style: ColorStatistics, limits: Limits = LAND_LIMITS
) -> Float[Tensor, "3 4"]:
    """Mean and standard deviation of each channel of RGB (Reinhard et al. 2001, eq. 10-11, without
    their change of colour space), float64, diagonal, within the limits.
    """
    return _mapped(content, style, limits, 1.0, _REINHARD)


def closed_maps(
    content: Statistics, style: Statistics, *, method: Method, strength: float, per_region: bool
) -> StyleMaps:
    """The maps of a scene's splats, sky and pictures.

    Where both sides know a SKY, it has its own map and all else goes from LAND to LAND; otherwise
    everything goes from WHOLE to WHOLE. Finished pictures always do. per_region: classes of road,
    vegetation and the rest take a map of their own where both sides know the region, mixed with
    the land's by how large the region is in both (none below 2 % of a picture, all of it from
    15 %). The class SKY takes the sky's map; UNKNOWN may be anything and takes the land's, as do
    WATER and SNOW.

    strength: 0 is the identity, 1 the map, between them straight; beyond 1 the map goes on
    straight as far as its limits allow.

    Raises:
        ValueError: the method is another, or the strength is not in [0, 2].
    """
    if method not in ("mkl", "reinhard"):
        raise ValueError(f"method must be mkl or reinhard; got {method!r}")
    if not 0 <= strength <= 2:
        raise ValueError(f"strength must be in [0, 2]; got {strength}")
    form = _MKL if method == "mkl" else _REINHARD

    def between(region: str, limits: Limits = LAND_LIMITS) -> Tensor:
        return _mapped(content[region], style[region], limits, strength, form)

    picture = between(WHOLE)
    common_regions = content.keys() & style.keys()
    has_sky = SKY in common_regions
    land = between(LAND) if has_sky and LAND in common_regions else picture
    sky = between(SKY, SKY_LIMITS) if has_sky else picture
    splats = land[None]
    if per_region:
        regions = {
            region: torch.lerp(land, between(region), _trust(content[region], style[region]))
            for region in (ROAD, VEGETATION, REST)
            if region in common_regions
        }
        splats = torch.stack([_of_class(value, regions, land, sky) for value in range(CLASSES)])
    content_sky = content[SKY] if has_sky else None
    about = (
        content_sky
        and torch.from_numpy(np.column_stack([content_sky.covariance, content_sky.mean])).float()
    )
    return StyleMaps(splats.float(), sky.float(), picture.float(), about)


def _trust(content: ColorStatistics, style: ColorStatistics) -> float:
    """Return the weight of a region's own map, by the smaller share: smooth from 0 to 1."""
    share = min(content.share, style.share)
    x = float(np.clip((share - _SMALL_SHARE) / (_LARGE_SHARE - _SMALL_SHARE), 0, 1))
    return x * x * (3 - 2 * x)


def _of_class(value: int, regions: dict[str, Tensor], land: Tensor, sky: Tensor) -> Tensor:
    kind = SemanticClass(value)
    if kind is SemanticClass.SKY:
        return sky
    if kind in (SemanticClass.UNKNOWN, SemanticClass.WATER, SemanticClass.SNOW):
        return land
    return regions.get(REGION_OF_CLASS.get(kind, REST), land)


class _Form(NamedTuple):
    """gain: the 3 x 3 between two floored covariances. limited: one like it within limits."""

    gain: Callable[[np.ndarray, np.ndarray], np.ndarray]
    limited: Callable[[np.ndarray, Limits], np.ndarray]


def _mapped(
    content: ColorStatistics, style: ColorStatistics, limits: Limits, strength: float, form: _Form
) -> Tensor:
    floor = limits.floor**2 * np.eye(3)
    full = form.limited(form.gain(content.covariance + floor, style.covariance + floor), limits)
    target = _target_mean(content, style, full, floor)
    matrix = np.eye(3) + strength * (full - np.eye(3))
    mean = content.mean + strength * (target - content.mean)
    if strength > 1:  # up to 1 it lies between the identity and a map within the limits
        matrix = form.limited(matrix, limits)
        room = np.minimum(np.sqrt(np.diag(matrix @ (content.covariance + floor) @ matrix.T)), 0.5)
        lowest = np.minimum(room, np.minimum(content.mean, target))
        highest = np.maximum(1 - room, np.maximum(content.mean, target))
        mean = np.clip(mean, lowest, highest)
    offset = mean - matrix @ content.mean
    return torch.from_numpy(np.concatenate([matrix, offset[:, None]], axis=1))


def _mkl_gain(content: np.ndarray, style: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(content)
    values = np.maximum(values, 1e-12)  # with a floor only rounding comes below it
    root = (vectors * np.sqrt(values)) @ vectors.T
    inverse = (vectors / np.sqrt(values)) @ vectors.T
    middle, axes = np.linalg.eigh(root @ style @ root)
    middle_root = (axes * np.sqrt(np.maximum(middle, 0))) @ axes.T
    matrix = inverse @ middle_root @ inverse
    return (matrix + matrix.T) / 2


def _limited_channels(matrix: np.ndarray, limits: Limits) -> np.ndarray:
    """The diagonal matrix within the limits; each channel carries contrast, and keeps some."""
    return np.diag(np.clip(np.diag(matrix), limits.min_contrast, limits.max_gain))


def _limited(matrix: np.ndarray, limits: Limits) -> np.ndarray:
    """The symmetric matrix with its gains within the limits; itself where they are."""
    values, vectors = np.linalg.eigh(matrix)
    if values[0] < limits.min_gain or values[-1] > limits.max_gain:
        values = np.clip(values, limits.min_gain, limits.max_gain)
        matrix = (vectors * values) @ vectors.T
        matrix = (matrix + matrix.T) / 2
    missing = limits.min_contrast - _GREY @ matrix @ _GREY
    return matrix + max(missing, 0.0) * np.outer(_GREY, _GREY)


_MKL = _Form(_mkl_gain, _limited)
_REINHARD = _Form(
    lambda content, style: np.diag(np.sqrt(np.diag(style) / np.diag(content))), _limited_channels
)


def _target_mean(
    content: ColorStatistics, style: ColorStatistics, matrix: np.ndarray, floor: np.ndarray
) -> np.ndarray:
    """The style's mean, moved off black and white as far as the least contrast asks for room.

    A constant style has its mean anywhere, up to pure white, and colours that keep some contrast
    around it would be cut off. What counts is the spread beyond the style's own, so that a map
    that meets no limit has the style's mean.
    """
    mapped = np.diag(matrix @ (content.covariance + floor) @ matrix.T)
    style_variances = np.diag(style.covariance + floor)
    room = np.clip(_ROOM * (np.sqrt(mapped) - np.sqrt(style_variances)), 0, 0.5)
    # Beyond rounding: without a limit both spreads are the same.
    is_limited = room > 1e-9
    return np.clip(
        style.mean, np.where(is_limited, room, -np.inf), np.where(is_limited, 1 - room, np.inf)
    )
