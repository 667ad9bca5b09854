"""Styles that come with the package: colour statistics of a mood, in place of an image."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from augment.errors import StyleError
from augment.style.statistics import LAND, SKY, WHOLE, ColorStatistics, Statistics
from recipes.errors import RecipeError
from recipes.style_presets import style_preset_text
from recipes.yaml_tree import read_plain

# Of a street's picture; they only matter where a map of the whole stands in for land and sky.
SHARES: Mapping[str, float] = {LAND: 0.75, SKY: 0.25}
_FIELDS = {"mean": (3,), "covariance": (3, 3)}


def preset_statistics(name: str) -> Statistics:
    """Of LAND, SKY and, put together from SHARES of both, WHOLE.

    Raises:
        StyleError: there is no style of that name, or its file is not as it should be.
    """
    try:
        text = style_preset_text(name)
    except RecipeError as error:
        raise StyleError(str(error)) from None
    return parse_statistics(text, source=f"style {name}")


def parse_statistics(text: str, *, source: str) -> Statistics:
    """The statistics in a preset's YAML: mean and covariance (display-encoded) of land and of sky.

    Raises:
        StyleError: keys are missing or unknown, numbers are not finite or of another count, a mean
            is outside [0, 1], a covariance is not symmetric or is negative definite.
    """
    try:
        document = read_plain(text, source=source)
    except RecipeError as error:
        raise StyleError(str(error)) from None
    regions = _fields(document, tuple(SHARES), source)
    found = {
        region: _statistics(regions[region], share, f"{source}: {region}")
        for region, share in SHARES.items()
    }
    return {WHOLE: together(tuple(found.values())), **found}


def together(parts: tuple[ColorStatistics, ...]) -> ColorStatistics:
    """The statistics of disjoint parts as one, each by its share."""
    share = sum(part.share for part in parts)
    mean = sum((part.share / share * part.mean for part in parts), np.zeros(3))
    second = sum(
        (
            part.share / share * (part.covariance + np.outer(part.mean - mean, part.mean - mean))
            for part in parts
        ),
        np.zeros((3, 3)),
    )
    return ColorStatistics(mean, second, share)


def _fields(value: Any, expected: tuple[str, ...], where: str) -> dict[str, Any]:
    if not isinstance(value, dict) or set(value) != set(expected):
        got = sorted(map(str, value)) if isinstance(value, dict) else type(value).__name__
        raise StyleError(f"{where}: expected the keys {', '.join(expected)}; got {got}")
    return value


def _statistics(value: Any, share: float, where: str) -> ColorStatistics:
    fields = _fields(value, tuple(_FIELDS), where)
    mean, covariance = (_numbers(fields[key], shape, f"{where}.{key}") for key, shape in
                        _FIELDS.items())  # fmt: skip
    if not ((mean >= 0) & (mean <= 1)).all():
        raise StyleError(f"{where}.mean: must be in [0, 1]; got {mean.tolist()}")
    if not np.array_equal(covariance, covariance.T):
        raise StyleError(f"{where}.covariance: must be symmetric; got {covariance.tolist()}")
    least = float(np.linalg.eigvalsh(covariance)[0])
    if least < -1e-9:
        raise StyleError(
            f"{where}.covariance: must have no variance below zero; got {covariance.tolist()}, "
            f"with {least:g} along one direction"
        )
    return ColorStatistics(mean, covariance, share)


def _numbers(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.empty(0)
    if array.shape != shape or array.dtype.kind not in "if" or not np.isfinite(array).all():
        size = " x ".join(map(str, shape))
        raise StyleError(f"{where}: expected {size} finite numbers; got {value}")
    return array.astype(np.float64)
