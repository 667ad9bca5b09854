"""Rows of a scene's splats: copied, dropped, put to rest, checked, turned."""

from __future__ import annotations

import numpy as np

from augment.errors import SceneError
from augment.reconstruct.splats import Splats

ABSURD_RADIUS = 0.25  # one sigma, of the image's larger side: such a splat fills the image
ABSURD_SCALE = 0.1  # of the scene's extent, for splats that also look absurdly large
SMALLEST_QUATERNION = 1e-6  # a shorter one has no direction in float32


def rebuild(splats: Splats, source: np.ndarray, part: np.ndarray | None = None) -> Splats:
    """New splats that are copies of the rows `source`, grouped by part, order kept within each.

    source: integer [M], rows of `splats`, in any order, any number of times. part: integer [M],
    the part each copy goes to; None is the part of its source. Every array is copied, Adam's
    moments and ages too, so nothing is shared; means do not change, though the parts' frames
    differ. grads start anew at zero.

    Raises:
        ValueError: a source row or a part does not exist, or the lengths differ.
    """
    source = np.asarray(source)
    parts = len(splats.starts) - 1
    if source.size and not (source.min() >= 0 and source.max() < len(splats)):
        raise ValueError(
            f"source must hold rows from 0 to {len(splats) - 1}; "
            f"got {source.min()} to {source.max()}"
        )
    part = splats.part_of[source] if part is None else np.asarray(part)
    if part.shape != source.shape:
        raise ValueError(
            f"part must be {list(source.shape)}, one for each source; got {list(part.shape)}"
        )
    if part.size and not (part.min() >= 0 and part.max() < parts):
        raise ValueError(f"parts must be from 0 to {parts - 1}; got {part.min()} to {part.max()}")
    if np.any(part[1:] < part[:-1]):
        source = source[np.argsort(part, kind="stable")]
    counts = np.bincount(part, minlength=parts)
    rows = {
        name: np.take(array, source, axis=0)
        for name, array in splats.arrays().items()
        if name not in ("starts", "grads")
    }
    return Splats(
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        grads=np.zeros((len(source), 3), np.float32),
        **rows,
    )


def rest(splats: Splats, rows: np.ndarray) -> None:
    """Makes the rows new to Adam, in place: moments and age zero."""
    for moments in (splats.geometry_m, splats.geometry_v, splats.sh_m, splats.sh_v, splats.age):
        moments[rows] = 0


def usable(splats: Splats, extent_m: float) -> np.ndarray:
    """bool [N]: rows that can be drawn and learnt.

    Not so: a number that is not finite, an opacity outside [0, 1], a scale of 0 or less, a
    quaternion without direction; a splat larger than the scene's extent, or larger than a tenth of
    it that also filled an image: fog before one camera, not a thing in the world. Size
    in the image alone is no reason, since what the car passes closely is large there.
    """
    largest = splats.scales.max(1, initial=0)
    sound = (
        np.isfinite(splats.means).all(1)
        & np.isfinite(splats.quats).all(1)
        & np.isfinite(splats.scales).all(1)
        & np.isfinite(splats.sh).all((1, 2))
        & (splats.opacities >= 0)
        & (splats.opacities <= 1)
        & (splats.scales > 0).all(1)
        & (np.abs(splats.quats).max(1, initial=0) > SMALLEST_QUATERNION)
    )
    fog = (splats.grads[:, 2] > ABSURD_RADIUS) & (largest > ABSURD_SCALE * extent_m)
    return sound & ~fog & (largest <= extent_m)


def check_some_usable(splats: Splats, good: np.ndarray) -> None:
    """Raises SceneError where there are splats but none of them is usable."""
    if len(splats) and not good.any():
        raise SceneError(
            f"none of the {len(splats)} splats is finite and of sensible size: the fit has "
            f"diverged; lower its learning rates, or begin again from an earlier checkpoint"
        )


def rotate(quats: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors [N, 3] turned by unit wxyz quaternions [N, 4], in their dtype."""
    axis = quats[:, 1:]
    twice = 2 * np.cross(axis, vectors)
    return vectors + quats[:, :1] * twice + np.cross(axis, twice)
