"""Error of a picture against its reference (PSNR, SSIM, FLIP), and errors of depth.

Pictures are display-encoded RGB [H, W, 3]: uint8, or floats in [0, 1]; both arguments may differ in
that. `weight` [H, W], bool or >= 0, is the weight of each pixel. Where it is 0, the picture is
replaced by the reference, so that pixels that are left out do not disturb their neighbours either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

WINDOW = 11  # width of SSIM's window, pixels
SIGMA = 1.5  # standard deviation of SSIM's window, pixels
C1 = 0.01**2  # constant of SSIM that keeps the ratio of means finite; colours are in [0, 1]
C2 = 0.03**2  # constant of SSIM that keeps the ratio of variances finite; colours are in [0, 1]
PIXELS_PER_DEGREE = 67.0206  # resolution in FLIP's default: a 0.7 m wide 3840 px screen at 0.7 m
CLOSE_M = 0.05  # largest error of a depth that counts as close, metres


def psnr(picture: np.ndarray, reference: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Return the peak signal-to-noise ratio, dB: 10 log10(1 / mean squared error).

    It is infinite for equal pictures.

    Raises:
        ValueError: shapes, types or values are not as this module says, or no pixel counts.
    """
    a, b, w = _pair(picture, reference, weight)
    error = ((a - b) ** 2).mean(axis=2)
    mean = float(np.average(error, weights=w))
    return math.inf if mean == 0 else -10 * math.log10(mean)


def ssim(picture: np.ndarray, reference: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Return the structural similarity (Wang et al. 2004), averaged over the picture and its
    channels.

    An 11x11 Gaussian window of sigma 1.5 on each colour channel, C1 = 0.01^2, C2 = 0.03^2, range 1.
    As in 3D Gaussian Splatting (Kerbl et al. 2023) every pixel counts, and outside the picture all
    is 0. That lifts the score of pixels near the border slightly against Wang's valid windows.

    Raises:
        ValueError: as psnr.
    """
    a, b, w = _pair(picture, reference, weight)
    return float(np.average(_ssim_map(a, b), weights=w))


def flip(picture: np.ndarray, reference: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Return the mean of `flip_map`: 0 for equal pictures, 1 for the largest difference.

    Raises:
        ValueError: as psnr.
    """
    w = None if weight is None else _checked_weight(weight, np.shape(reference)[:2])
    error = flip_map(picture, reference, weight).astype(np.float64)
    return float(np.average(error, weights=w))


def flip_map(
    picture: np.ndarray, reference: np.ndarray, weight: np.ndarray | None = None
) -> np.ndarray:
    """Return the difference a person sees when the two alternate, float32 [H, W].

    This is LDR-FLIP (Andersson et al. 2020) by the authors' own package, at PIXELS_PER_DEGREE.

    Raises:
        ValueError: as psnr.
    """
    from flip_evaluator import evaluate

    a, b, _ = _pair(picture, reference, weight)
    error, _, _ = evaluate(
        np.ascontiguousarray(b, np.float32),
        np.ascontiguousarray(a, np.float32),
        "LDR",
        applyMagma=False,
        computeMeanError=False,
        parameters={"ppd": PIXELS_PER_DEGREE},
    )
    return error[..., 0]


@dataclass(frozen=True)
class DepthErrors:
    """Errors of depth over a number of pixels; NaN where there are none.

    Quantiles are the smallest error that at least this part of the weight does not exceed.
    """

    pixels: int
    """Number of pixels."""
    median_m: float
    """Median of |depth - true|, metres."""
    p90_m: float
    """90 % quantile of |depth - true|, metres."""
    abs_rel: float
    """Mean of |depth - true| / true."""
    within_5cm: float
    """Part of the weight whose error is at most CLOSE_M, 0 to 1."""


def depth_errors(
    depth_m: np.ndarray, true_m: np.ndarray, weight: np.ndarray | None = None
) -> DepthErrors:
    """Return errors of depths against true ones.

    Args:
        depth_m: depths, metres.
        true_m: true depths, metres, of the same shape.
        weight: weights >= 0 of that shape; pixels of weight 0 are left out, whatever they hold.
            None gives all the same weight.

    Raises:
        ValueError: shapes differ, or a pixel that counts has no finite depth or no true depth > 0.
    """
    depth = np.asarray(depth_m, np.float64)
    true = np.asarray(true_m, np.float64)
    if depth.shape != true.shape:
        raise ValueError(f"depths must have one shape; got {depth.shape} and {true.shape}")
    w = np.ones(depth.shape) if weight is None else _checked_weight(weight, depth.shape)
    counts = w > 0
    depth = depth[counts]
    true = true[counts]
    w = w[counts]
    if not (np.isfinite(depth).all() and np.isfinite(true).all() and (true > 0).all()):
        raise ValueError(
            "depths must be finite and true depths > 0 (metres) wherever the weight is > 0; "
            f"{int((~np.isfinite(depth)).sum())} of {depth.size} depths and "
            f"{int((~(true > 0) | np.isinf(true)).sum())} true depths are not"
        )
    if depth.size == 0:
        return DepthErrors(0, math.nan, math.nan, math.nan, math.nan)
    error = np.abs(depth - true)
    return DepthErrors(
        pixels=int(depth.size),
        median_m=_quantile(error, w, 0.5),
        p90_m=_quantile(error, w, 0.9),
        abs_rel=float(np.average(error / true, weights=w)),
        within_5cm=float(np.average(error <= CLOSE_M, weights=w)),
    )


def _quantile(values: np.ndarray, weight: np.ndarray, part: float) -> float:
    """Return the smallest value that at least a part of the weight does not exceed."""
    order = np.argsort(values, kind="stable")
    weight_sums = np.cumsum(weight[order])
    # Sums of weights round: an exact half must count as reached.
    first = int(np.searchsorted(weight_sums, part * weight_sums[-1] * (1 - 1e-12)))
    return float(values[order[min(first, len(order) - 1)]])


def _ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the mean of SSIM over the channels of pictures [H, W, 3], float64 [H, W]."""
    offsets = np.arange(WINDOW) - WINDOW // 2
    window = np.exp(-(offsets**2) / (2 * SIGMA**2))
    window /= window.sum()

    def blurred(image: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(image, cv2.CV_64F, window, window, borderType=cv2.BORDER_CONSTANT)

    mean_a = blurred(a)
    mean_b = blurred(b)
    var_a = blurred(a * a) - mean_a**2
    var_b = blurred(b * b) - mean_b**2
    covariance = blurred(a * b) - mean_a * mean_b
    similarity = (
        (2 * mean_a * mean_b + C1)
        * (2 * covariance + C2)
        / ((mean_a**2 + mean_b**2 + C1) * (var_a + var_b + C2))
    )
    return similarity.mean(axis=2)


def _pair(
    picture: np.ndarray, reference: np.ndarray, weight: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return picture, reference and weight.

    Both pictures are float64 in [0, 1]; where the weight is 0, the picture has the reference's
    colours.
    """
    a = _unit("picture", picture)
    b = _unit("reference", reference)
    if a.shape != b.shape:
        raise ValueError(f"pictures must have one size; got {a.shape} and {b.shape}")
    if weight is None:
        return a, b, None
    w = _checked_weight(weight, b.shape[:2])
    if not w.any():
        raise ValueError("the weight is 0 everywhere, so no pixel counts")
    return np.where((w > 0)[..., None], a, b), b, w


def _unit(name: str, image: np.ndarray) -> np.ndarray:
    """Return a picture as float64 in [0, 1]; raises ValueError for other types and values."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"{name} must be [H, W, 3] with H, W >= 1; got {list(image.shape)}")
    if image.dtype == np.uint8:
        return image / 255.0
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(f"{name} must be uint8, or floats in [0, 1]; got {image.dtype}")
    low = float(image.min())
    high = float(image.max())
    if not (low >= 0 and high <= 1):  # `not` also catches NaN
        raise ValueError(f"{name} must lie in [0, 1] (clamp it first); got {low:g} to {high:g}")
    return image.astype(np.float64)


def _checked_weight(weight: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the weight as float64; raises ValueError unless it fits the image."""
    w = np.asarray(weight, np.float64)
    if w.shape != tuple(shape):
        raise ValueError(f"weight must be {list(shape)}, as the image; got {list(w.shape)}")
    if not (np.isfinite(w).all() and (w >= 0).all()):
        raise ValueError("weight must be finite and >= 0 everywhere")
    return w
