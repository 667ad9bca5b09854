"""All Gaussians of a scene while they are fitted: one set of arrays that the kernels read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.errors import SceneError
from augment.scene import SH_COUNTS, Gaussians

# Columns of the geometry's moments, two registers: means 3, quats 4, one unused, logarithms of
# scales 3, logit of opacity 1, four unused.
GEOMETRY = 16


@dataclass(eq=False)
class Splats:
    """N splats of P parts, part after part, activated values as in `Gaussians`.

    starts: int64 [P + 1], part p owns splats starts[p] to starts[p + 1]. means [N, 3],
    quats [N, 4] unit wxyz, scales [N, 3], opacities [N], sh [N, K, 3]: float32, contiguous, in the
    part's own frame. semantic: int16 [N]. geometry_m, geometry_v [N, GEOMETRY], sh_m, sh_v
    [N, K, 3]: Adam's moments. age: int32 [N], updates so far. grads: float32 [N, 3], since the
    last densification: sum of the image gradients' absolute size (pixels of the image's width and
    height normalised to [-1, 1]), count of the views that saw the splat, and largest radius seen
    as a part of the image's larger side.
    """

    starts: np.ndarray
    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    semantic: np.ndarray
    geometry_m: np.ndarray
    geometry_v: np.ndarray
    sh_m: np.ndarray
    sh_v: np.ndarray
    age: np.ndarray
    grads: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    @property
    def part_of(self) -> np.ndarray:
        """int32 [N]: the part each splat belongs to."""
        return np.repeat(np.arange(len(self.starts) - 1, dtype=np.int32), np.diff(self.starts))

    @staticmethod
    def of(parts: Sequence[Gaussians], sh_degree: int) -> Splats:
        """Copies of the parts' Gaussians with moments at rest; SH cut or filled up with zeros."""
        functions = SH_COUNTS[sh_degree]
        counts = [len(part) for part in parts]
        total = sum(counts)

        def joined(name: str) -> np.ndarray:
            tensors = [getattr(part, name).detach().float().numpy() for part in parts]
            return np.ascontiguousarray(np.concatenate(tensors))

        sh = np.zeros((total, functions, 3), np.float32)
        semantic = np.zeros(total, np.int16)
        at = 0
        for part in parts:
            own = part.sh.detach().float().numpy()[:, :functions]
            sh[at : at + len(part), : own.shape[1]] = own
            if part.semantic is not None:
                semantic[at : at + len(part)] = part.semantic.numpy()
            at += len(part)
        return Splats(
            starts=np.cumsum([0, *counts], dtype=np.int64),
            means=joined("means"),
            quats=joined("quats"),
            scales=joined("scales"),
            opacities=joined("opacities"),
            sh=sh,
            semantic=semantic,
            geometry_m=np.zeros((total, GEOMETRY), np.float32),
            geometry_v=np.zeros((total, GEOMETRY), np.float32),
            sh_m=np.zeros_like(sh),
            sh_v=np.zeros_like(sh),
            age=np.zeros(total, np.int32),
            grads=np.zeros((total, 3), np.float32),
        )

    def gaussians(self, part: int) -> Gaussians:
        """A copy of one part."""
        own = slice(int(self.starts[part]), int(self.starts[part + 1]))
        return Gaussians(
            means=torch.from_numpy(self.means[own].copy()),
            quats=torch.from_numpy(self.quats[own].copy()),
            scales=torch.from_numpy(self.scales[own].copy()),
            opacities=torch.from_numpy(self.opacities[own].copy()),
            sh=torch.from_numpy(self.sh[own].copy()),
            semantic=torch.from_numpy(self.semantic[own].copy()),
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Every array by name: what a checkpoint holds."""
        return {name: getattr(self, name) for name in Splats.__dataclass_fields__}


# ---- Rows of a scene's splats: copied, dropped, put to rest, checked, turned ---------------------

ABSURD_RADIUS = 0.25  # one sigma, of the image's larger side: such a splat fills the image
ABSURD_SCALE = 0.1  # of the scene's extent, for splats that also look absurdly large
MIN_QUATERNION = 1e-6  # a shorter one has no direction in float32


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
        & (np.abs(splats.quats).max(1, initial=0) > MIN_QUATERNION)
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
