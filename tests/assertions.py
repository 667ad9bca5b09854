"""Comparisons of images that renderers make, with room for threshold flips and for nothing else."""

from __future__ import annotations

import numpy as np


def assert_images_close(
    actual, expected, *, p999: float = 1e-4, flip: float = 1e-3, max_flips: int = 0
) -> None:
    """Images [H, W] or [H, W, C] agree; a pixel's error is the largest of its channels.

    Alpha and transmittance have cut-offs, and float rounding may put a pixel on the other side of
    one. Pixels off by more than `flip` count as such flips, of which `max_flips` are allowed; of
    the others 99.9 % must lie within `p999`. NaN or infinity anywhere fails.
    """
    error = _pixel_errors(actual, expected)
    flips = error > flip
    assert flips.sum() <= max_flips, (
        f"{flips.sum()} of {error.size} pixels differ by more than {flip}, {max_flips} allowed; "
        f"largest {error.max():.3g} at (row, column) {_where(error)}"
    )
    rest = error[~flips]
    quantile = np.quantile(rest, 0.999) if rest.size else 0.0
    assert quantile <= p999, (
        f"99.9 % of the pixels must be within {p999}, but that quantile is {quantile:.3g}; "
        f"largest error {error.max():.3g} at (row, column) {_where(error)}"
    )


def assert_labels_equal(actual, expected, *, max_flips: int = 0) -> None:
    """Integer images [H, W] agree but for `max_flips` pixels."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape, f"shape {actual.shape}, expected {expected.shape}"
    wrong = actual != expected
    assert wrong.sum() <= max_flips, (
        f"{wrong.sum()} of {wrong.size} pixels differ, {max_flips} allowed; "
        f"first at (row, column) {_where(wrong)}"
    )


def assert_stored_render(output, arrays) -> None:
    """A float32 render of `scenes.golden_view` is the stored one.

    The required bound is 1e-4; exp2's 3e-6 a splat leaves less than 1e-5. Antialiasing puts one
    splat of garden_small on the other side of 1/255, in up to 3 of 17 010 pixels.
    """
    assert_images_close(output.rgb, arrays["rgb"], p999=1e-5, max_flips=5)
    if "alpha" in arrays:
        assert_images_close(output.alpha, arrays["alpha"], p999=1e-5, max_flips=5)
        depth = arrays["ED"].reshape(arrays["alpha"].shape)
        far = np.maximum(depth, 1e-3)
        actual = _as_array(output.expected_depth) / far
        assert_images_close(actual, depth / far, p999=1e-5, max_flips=5)


def _pixel_errors(actual, expected) -> np.ndarray:
    actual, expected = (_as_array(image) for image in (actual, expected))
    assert actual.shape == expected.shape, f"shape {actual.shape}, expected {expected.shape}"
    for name, image in (("actual", actual), ("expected", expected)):
        assert np.isfinite(image).all(), f"the {name} image holds NaN or infinity"
    error = np.abs(actual - expected)
    return error.max(-1) if error.ndim == 3 else error


def _as_array(image) -> np.ndarray:
    if hasattr(image, "detach"):
        image = image.detach().numpy()
    return np.asarray(image, np.float64)


def _where(error: np.ndarray) -> tuple[int, ...]:
    return tuple(int(i) for i in np.unravel_index(np.argmax(error), error.shape))
