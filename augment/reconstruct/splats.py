"""All Gaussians of a scene while they are fitted, one set of arrays that the kernels read; when and
how their number changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.cameras import Camera
from augment.errors import SceneError
from augment.reconstruct import kernels
from augment.reconstruct.config import Growth, LearningRates
from augment.reconstruct.kernels import GEOMETRY
from augment.render.cpu.backward_kernels import G_MEAN, G_OPACITY, G_QUAT, G_SCALE
from augment.render.threads import kernel_threads
from augment.scene import SH_COUNTS, Gaussians


@dataclass(eq=False)
class Splats:
    """N splats of P parts, part after part, activated values as in `Gaussians`.

    starts: int64 [P + 1], part p owns splats starts[p] to starts[p + 1]. means [N, 3],
    quats [N, 4] unit wxyz, scales [N, 3], opacities [N], sh [N, K, 3]: float32, contiguous, in the
    part's own frame. semantic: int16 [N]. geometry_m, geometry_v [N, GEOMETRY], sh_m, sh_v
    [N, K, 3]: Adam's moments. age: int32 [N], updates so far. grads: float32 [N, 3], since the
    last densification: sum of the image gradients' absolute size (pixels of the image's width and
    height normalised to [-1, 1]), count of the views that saw the splat, and largest radius seen
    as a part of the image's larger side. smallest: float32 [N], metres, see `bound_sizes`.
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
    smallest: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    def adam_state(self) -> kernels.AdamState:
        return kernels.AdamState(
            *(getattr(self, name).reshape(-1) for name in kernels.AdamState._fields)
        )

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
            starts=np.cumsum([0, *counts], dtype=np.int64), means=joined("means"),
            quats=joined("quats"), scales=joined("scales"), opacities=joined("opacities"), sh=sh,
            semantic=semantic, geometry_m=np.zeros((total, GEOMETRY), np.float32),
            geometry_v=np.zeros((total, GEOMETRY), np.float32), sh_m=np.zeros_like(sh),
            sh_v=np.zeros_like(sh), age=np.zeros(total, np.int32),
            grads=np.zeros((total, 3), np.float32), smallest=np.zeros(total, np.float32),
        )  # fmt: skip

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


def rebuild(splats: Splats, source: np.ndarray) -> Splats:
    """New splats that are copies of the rows `source`, integer [M], not decreasing.

    Adam's moments and ages are copied too, so nothing is shared; grads start anew at zero.
    """
    counts = np.bincount(splats.part_of[source], minlength=len(splats.starts) - 1)
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


def rotate(quats: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors [N, 3] turned by unit wxyz quaternions [N, 4], in their dtype."""
    axis = quats[:, 1:]
    twice = 2 * np.cross(axis, vectors)
    return vectors + quats[:, :1] * twice + np.cross(axis, twice)


# ---- Adaptive control: clones and splits where the image pulls at a splat, removes faint ones ----
# Kerbl et al. 2023 (3D Gaussian Splatting, section 5.2), chosen by absolute image gradients as in
# Ye et al. 2024 (AbsGS): a large splat whose pixels pull it in opposite directions has a small
# gradient but a large absolute one. Departures: growth has a budget (the best of each round, as in
# Rota Bulò et al. 2024) instead of a threshold alone, opacity is corrected, and opacities are never
# reset: that is a cure for clutter from a random start, while these splats start on measured
# surfaces and lose more by being made transparent than clutter costs.

GRADIENT_FLOOR = 1e-4  # an eighth of gsplat's threshold for the same measure: the budget decides
SPLIT_RADIUS = 0.004  # one sigma, of the image's larger side: two pixels of 480
SPLIT_SCALE = 0.01  # of the scene's extent, where no image has shown the splat
SHRINK = 1.6
SIDE_SHRINK = 1.2  # the other axes', for a split along the longest
OFFSET = float(np.sqrt(1 - 1 / SHRINK**2))  # sigmas: the pair keeps the parent's covariance


def densify_due(growth: Growth, step: int, steps: int) -> bool:
    """Whether a round is due after `step` of `steps` steps."""
    growing = growth.start * steps <= step <= growth.stop * steps
    return growing and step > 0 and step % growth.every == 0


def densify(
    splats: Splats,
    growth: Growth,
    *,
    max_splats: int,
    extent_m: float,
    refuted: np.ndarray | None = None,
) -> Splats:
    """One round: removes the faint, the refuted and the unusable, then doubles the best others.

    If none would be left, only unusable ones go: a scene is never emptied. extent_m: how far the
    scene reaches, against which absurd sizes show. refuted: bool [N], see `Sightings`. The result's
    arrays are its own, part after part, children next to their parents, grads zero.

    Raises:
        SceneError: no splat is usable any more.
    """
    good = usable(splats, extent_m)
    if len(splats) and not good.any():
        raise SceneError(
            f"none of the {len(splats)} splats is finite and of sensible size: the fit has "
            f"diverged; lower its learning rates, or begin again from an earlier checkpoint"
        )
    keep = good & (splats.opacities >= growth.prune_opacity)
    if refuted is not None:
        keep &= ~refuted
    if not keep.any():
        keep = good
    kept = int(keep.sum())
    counts = keep.astype(np.int64)
    large = _is_large(splats, extent_m)
    opacities = _child_opacities(splats, large)
    # Children fainter than prune_opacity would both be gone after the next round.
    candidates = keep & (opacities >= growth.prune_opacity)
    chosen = _best(splats, candidates, min(int(growth.fraction * kept), max(max_splats - kept, 0)))
    counts[chosen] += 1
    first = (np.cumsum(counts) - counts)[chosen]
    grown = rebuild(splats, np.repeat(np.arange(len(splats)), counts))
    grown.opacities[first] = opacities[chosen]
    grown.opacities[first + 1] = opacities[chosen]
    # A clone's original keeps its momentum and the copy starts with a whole step of Adam: two
    # equal splats at one place would otherwise stay together for long.
    rest(grown, first + 1)
    _split(grown, first[large[chosen]])
    bound_sizes(grown)
    return grown


def _is_large(splats: Splats, extent_m: float) -> np.ndarray:
    """bool [N]: split rather than clone. By size in the images, since what one image can show of a
    splat does not depend on how large the world is; by size in the world where none saw it.
    """
    radius = splats.grads[:, 2]
    unseen = (radius <= 0) & (splats.scales.max(1, initial=0) > SPLIT_SCALE * extent_m)
    return (radius > SPLIT_RADIUS) | unseen


def _child_opacities(splats: Splats, large: np.ndarray) -> np.ndarray:
    """float32 [N]: the opacity of each of the two that a splat would become.

    1 - sqrt(1 - o) (Rota Bulò et al. 2024, section 4.3): two such splats at one place let through
    what the one let through, where 3DGS's two copies of o hide more of what is behind them, in
    every round again. Large ones are split side by side, hardly overlap, and keep their parent's.
    """
    halved = 1 - np.sqrt(np.clip(1 - splats.opacities, 0, 1))
    return np.where(large, splats.opacities, halved)


def _best(splats: Splats, candidates: np.ndarray, budget: int) -> np.ndarray:
    """int64: increasing rows of the `budget` candidates of the largest mean absolute gradient of
    the views that saw them; the earlier of equals.
    """
    seen = splats.grads[:, 1]
    scores = splats.grads[:, 0] / np.maximum(seen, 1)
    candidates = candidates & (seen > 0) & np.isfinite(scores) & (scores > GRADIENT_FLOOR)
    rows = np.flatnonzero(candidates)
    return np.sort(rows[np.argsort(-scores[rows], kind="stable")[:budget]])


def _split(splats: Splats, first: np.ndarray) -> None:
    """Turns the equal pairs of rows (first, first + 1) into two smaller splats, in place: side by
    side along the longest axis (as Deng et al. 2024 suggest), which disturbs the image least.
    """
    scales = splats.scales[first]
    along = np.arange(3) == scales.argmax(1)[:, None]
    local = np.where(along, np.float32(OFFSET) * scales, np.float32(0))
    shrink = np.where(along, np.float32(SHRINK), np.float32(SIDE_SHRINK))
    offset = rotate(splats.quats[first], local)
    splats.means[first] += offset
    splats.means[first + 1] -= offset
    splats.scales[first] = splats.scales[first + 1] = scales / shrink
    rest(splats, first)


# ---- What the recorded images can tell of a splat: how small it may be, and that it is not there -

# Of the low-pass filter of Mip-Splatting (Yu et al. 2024, eq. 9; s^2 = 0.2 as there), in pixels of
# the view that resolves a splat best.
FILTER_PX = float(np.sqrt(0.2))
MIN_IN_SKY = 2  # views whose sky a splat must lie in ...
REFUTED_PART = 0.25  # ... and of those that it is inside of: others may hide it behind a wall


class Sightings:
    """Of N splats, over views: float32 the most pixels per metre that one of them has there, int32
    the number of views that they are inside of, and of those whose sky they lie in.
    """

    def __init__(self, count: int) -> None:
        self.px_per_m = np.zeros(count, np.float32)
        self.seen = np.zeros(count, np.int32)
        self.in_sky = np.zeros(count, np.int32)

    def add(
        self,
        splats: Splats,
        part: int,
        world_from_part: np.ndarray,
        camera: Camera,
        sky: np.ndarray,
    ) -> None:
        """One view of one part. world_from_part: float64 [4, 4]. sky: bool [H, W]."""
        own = slice(int(splats.starts[part]), int(splats.starts[part + 1]))
        pose = camera.camera_from_world.numpy() @ world_from_part
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        with kernel_threads():
            kernels.sight(
                splats.means[own], pose.astype(np.float32), intrinsics, sky,
                self.px_per_m[own], self.seen[own], self.in_sky[own],
            )  # fmt: skip

    @property
    def refuted(self) -> np.ndarray:
        """bool [N]: who lies before the sky of several images. The sky is infinitely far away:
        nothing can be there, however well it fits another image.
        """
        return (self.in_sky >= MIN_IN_SKY) & (self.in_sky >= REFUTED_PART * self.seen)


def bound_sizes(splats: Splats) -> None:
    """No axis is thinner than `smallest`, in place.

    Mip-Splatting adds the filter to what it learns and dims it by the ratio of volumes. Here what
    is learnt is the filtered size itself, bounded from below: the same sizes, but flat splats on
    measured surfaces may be opaque, which that ratio forbids. The scene holds them as they are
    learnt, so that no frame pays for a filter.
    """
    np.maximum(splats.scales, splats.smallest[:, None], out=splats.scales)


# ---- Step sizes of one update, as the kernel takes them ------------------------------------------

BETA1, BETA2 = 0.9, 0.999
CORRECTIONS = kernels.bias_corrections(BETA1, BETA2)
_MIN_M = 1e-3  # no splat gets thinner along any axis


def splat_rates(rates: LearningRates, done: float, camera: Camera, extent_m: float) -> np.ndarray:
    """float32 [RATES] for an update. done: the part of the run that lies behind.

    Means decay exponentially over the run; the others fall to rates.late of their value likewise.
    """
    late = rates.late**done
    values = np.zeros(kernels.RATES, np.float32)
    values[G_MEAN : G_MEAN + 3] = decayed(rates.means, rates.means_end, done)
    values[G_QUAT : G_QUAT + 4] = rates.quats * late
    values[G_SCALE : G_SCALE + 3] = rates.scales * late
    values[G_OPACITY] = -rates.opacities * late
    values[kernels.R_SH_DC] = rates.sh_dc * late
    values[kernels.R_SH_REST] = rates.sh_rest * late
    values[kernels.R_BETA1], values[kernels.R_BETA2] = BETA1, BETA2
    values[kernels.R_SMALLEST], values[kernels.R_LARGEST] = _MIN_M, extent_m
    side = max(camera.width, camera.height)
    values[kernels.R_ABS_UNIT], values[kernels.R_RADIUS_UNIT] = 0.5 * side, 1 / side
    return values


def decayed(start: float, end: float, done: float) -> float:
    """From start to end exponentially, done being the part of the run; 0 where either is 0."""
    return start ** (1 - done) * end**done if start and end else 0.0


_EPS = 1e-15


class DenseAdam:
    """Adam on a small array, which is updated in place as a whole or a row at a time; moments in
    float64, updates counted by rows.
    """

    def __init__(self, values: np.ndarray, eps: float = _EPS) -> None:
        self._values, self._eps = values, eps
        self._m, self._v = np.zeros(values.shape), np.zeros(values.shape)
        self._count = np.zeros(len(values), np.int64)

    def update(
        self, gradient: np.ndarray, rate: float | np.ndarray, row: int | None = None
    ) -> None:
        at = slice(None) if row is None else slice(row, row + 1)
        m, v = self._m[at], self._v[at]
        self._count[at] += 1
        m += (1 - BETA1) * (gradient - m)
        v += (1 - BETA2) * (gradient * gradient - v)
        n = int(self._count[at][0])
        first, second = m / (1 - BETA1**n), v / (1 - BETA2**n)
        step = rate * first / (np.sqrt(second) + self._eps)
        self._values[at] -= step.astype(self._values.dtype)

    def arrays(self) -> dict[str, np.ndarray]:
        """The moments and counts themselves, by name."""
        return {"m": self._m, "v": self._v, "count": self._count}


class ColorAdam:
    """Adam on rows of a float32 array [N, 3] of colours in place, counting each row's updates."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values
        self._m = np.zeros_like(values)
        self._v = np.zeros_like(values)
        self._count = np.zeros(len(values), np.int32)

    def update(self, rows: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """rows: int32 [T], each once. gradient: float32 [T, 3]. Colours stay within [0, 1]."""
        with kernel_threads():
            kernels.update_rows(
                self._values.reshape(-1), self._m.reshape(-1), self._v.reshape(-1), self._count,
                rows, gradient, np.float32(rate), np.array([BETA1, BETA2], np.float32),
                CORRECTIONS.reshape(-1),
            )  # fmt: skip

    def arrays(self) -> dict[str, np.ndarray]:
        """The moments and counts themselves, by name."""
        return {"m": self._m, "v": self._v, "count": self._count}
