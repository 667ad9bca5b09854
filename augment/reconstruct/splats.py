"""Splats of a scene while they are fitted: one set of arrays, and the rules that change its size.

The trainer owns a `Splats`; the kernels read its arrays and Adam writes them. `densify` adds and
removes splats between two steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.errors import SceneError
from augment.reconstruct import kernels
from augment.reconstruct.config import Growth, LearningRates
from augment.reconstruct.kernels import GEOMETRY
from augment.render.cpu.backward_kernels import G_MEAN, G_OPACITY, G_QUAT, G_SCALE
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians


@dataclass(eq=False)
class Splats:
    """N splats of P parts, part after part, with activated values as in `Gaussians`.

    Values are float32, contiguous, in the part's own frame.
    """

    starts: np.ndarray  # int64 [P + 1]: part p owns splats starts[p] to starts[p + 1]
    means: np.ndarray  # [N, 3]
    quats: np.ndarray  # [N, 4], unit wxyz
    scales: np.ndarray  # [N, 3]
    opacities: np.ndarray  # [N]
    sh: np.ndarray  # [N, K, 3]
    semantic: np.ndarray  # int16 [N]
    geometry_m: np.ndarray  # [N, GEOMETRY], Adam's first moments of all but the colours
    geometry_v: np.ndarray  # [N, GEOMETRY], Adam's second moments
    sh_m: np.ndarray  # [N, K, 3], Adam's first moments of the colours
    sh_v: np.ndarray  # [N, K, 3], Adam's second moments
    age: np.ndarray  # int32 [N], updates so far
    # [N, 3], since the last densification: the sum of the image gradients' absolute size (with the
    # image's width and height normalised to [-1, 1]), the count of the views that show the splat,
    # and its largest radius in them as a fraction of the image's larger side.
    grads: np.ndarray
    min_scale_m: np.ndarray  # [N], the least scale, metres, see `bound_sizes`

    def __len__(self) -> int:
        return len(self.means)

    def adam_state(self) -> kernels.AdamState:
        """Return the arrays that the update kernel changes."""
        return kernels.AdamState(
            *(getattr(self, name).reshape(-1) for name in kernels.AdamState._fields)
        )

    @property
    def part_of(self) -> np.ndarray:
        """Return the part of each splat, int32 [N]."""
        return np.repeat(np.arange(len(self.starts) - 1, dtype=np.int32), np.diff(self.starts))

    @staticmethod
    def of(parts: Sequence[Gaussians], sh_degree: int) -> Splats:
        """Copy the parts' Gaussians, with zero moments; SH are cut off or filled up with zeros."""
        num_sh = NUM_SH_BY_DEGREE[sh_degree]
        counts = [len(part) for part in parts]
        total = sum(counts)

        def join(name: str) -> np.ndarray:
            tensors = [getattr(part, name).detach().float().numpy() for part in parts]
            return np.ascontiguousarray(np.concatenate(tensors))

        sh = np.zeros((total, num_sh, 3), np.float32)
        semantic = np.zeros(total, np.int16)
        start = 0
        for part in parts:
            part_sh = part.sh.detach().float().numpy()[:, :num_sh]
            sh[start : start + len(part), : part_sh.shape[1]] = part_sh
            if part.semantic is not None:
                semantic[start : start + len(part)] = part.semantic.numpy()
            start += len(part)
        return Splats(
            starts=np.cumsum([0, *counts], dtype=np.int64),
            means=join("means"),
            quats=join("quats"),
            scales=join("scales"),
            opacities=join("opacities"),
            sh=sh,
            semantic=semantic,
            geometry_m=np.zeros((total, GEOMETRY), np.float32),
            geometry_v=np.zeros((total, GEOMETRY), np.float32),
            sh_m=np.zeros_like(sh),
            sh_v=np.zeros_like(sh),
            age=np.zeros(total, np.int32),
            grads=np.zeros((total, 3), np.float32),
            min_scale_m=np.zeros(total, np.float32),
        )

    def gaussians(self, part: int) -> Gaussians:
        """Return a copy of one part."""
        rows = slice(int(self.starts[part]), int(self.starts[part + 1]))
        return Gaussians(
            means=torch.from_numpy(self.means[rows].copy()),
            quats=torch.from_numpy(self.quats[rows].copy()),
            scales=torch.from_numpy(self.scales[rows].copy()),
            opacities=torch.from_numpy(self.opacities[rows].copy()),
            sh=torch.from_numpy(self.sh[rows].copy()),
            semantic=torch.from_numpy(self.semantic[rows].copy()),
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Return every array by name: the content of a checkpoint."""
        return {name: getattr(self, name) for name in Splats.__dataclass_fields__}


# ---- Rows of a scene's splats: copied, dropped, reset, checked, rotated --------------------------

# One sigma as a fraction of the image's larger side: a larger splat fills the image.
MAX_RADIUS_FRACTION = 0.25
# One sigma as a fraction of the scene's extent: the limit of splats that have filled an image.
MAX_SCALE_FRACTION = 0.1
MIN_QUATERNION = 1e-6  # a shorter quaternion has no direction in float32


def rebuild(splats: Splats, source: np.ndarray) -> Splats:
    """Return new splats that are copies of the rows `source`.

    Adam's moments and ages are copied too, so nothing is shared; grads start again at zero.

    Args:
        splats: the splats to copy from.
        source: integer [M], not decreasing.
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


def reset_adam(splats: Splats, rows: np.ndarray) -> None:
    """Reset Adam's moments and ages of the rows to zero, in place."""
    for moments in (splats.geometry_m, splats.geometry_v, splats.sh_m, splats.sh_v, splats.age):
        moments[rows] = 0


def usable_rows(splats: Splats, extent_m: float) -> np.ndarray:
    """Return the rows that can be rendered and learnt, bool [N].

    A row is not usable with a number that is not finite, an opacity outside [0, 1], a scale of 0 or
    less, or a quaternion without direction. Nor is a splat larger than the scene's extent, or
    larger than a tenth of it that has also filled an image: that is fog in front of one camera and
    not a thing in the world. Size in the image alone is no reason, since objects that the car
    passes closely are large there.
    """
    largest_scale = splats.scales.max(1, initial=0)
    is_valid = (
        np.isfinite(splats.means).all(1)
        & np.isfinite(splats.quats).all(1)
        & np.isfinite(splats.scales).all(1)
        & np.isfinite(splats.sh).all((1, 2))
        & (splats.opacities >= 0)
        & (splats.opacities <= 1)
        & (splats.scales > 0).all(1)
        & (np.abs(splats.quats).max(1, initial=0) > MIN_QUATERNION)
    )
    is_fog = (splats.grads[:, 2] > MAX_RADIUS_FRACTION) & (
        largest_scale > MAX_SCALE_FRACTION * extent_m
    )
    return is_valid & ~is_fog & (largest_scale <= extent_m)


def rotate(quats: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotate vectors [N, 3] by unit wxyz quaternions [N, 4], in their dtype."""
    axis = quats[:, 1:]
    twice_cross = 2 * np.cross(axis, vectors)
    return vectors + quats[:, :1] * twice_cross + np.cross(axis, twice_cross)


# ---- Adaptive control: clones and splits splats with large gradients, removes faint ones ---------
# The method is that of Kerbl et al. 2023 (3D Gaussian Splatting, section 5.2). Splats are chosen by
# absolute image gradients as in Ye et al. 2024 (AbsGS): a large splat whose pixels pull it in
# opposite directions has a small gradient but a large absolute one. There are three departures.
# Growth has a budget (the best of each round, as in Rota Bulò et al. 2024) instead of a threshold
# alone. Opacity is corrected. Opacities are never reset: a reset removes clutter after a random
# start, while these splats start on measured surfaces, where it costs more than clutter does.

# The least mean absolute gradient of a splat that is doubled: an eighth of gsplat's threshold for
# the same measure, since the budget decides.
MIN_GRADIENT = 1e-4
# One sigma as a fraction of the image's larger side from which splats are split: 2 pixels of 480.
MIN_SPLIT_RADIUS = 0.004
# The same limit as a fraction of the scene's extent, for splats that no image has shown.
MIN_SPLIT_SCALE = 0.01
SHRINK = 1.6  # divisor of the longest scale in a split
SIDE_SHRINK = 1.2  # divisor of the other scales
OFFSET = float(np.sqrt(1 - 1 / SHRINK**2))  # sigmas: the pair keeps the parent's covariance


def densify_due(growth: Growth, step: int, steps: int) -> bool:
    """Return True if a round is due after `step` of `steps` steps."""
    is_growing = growth.start * steps <= step <= growth.stop * steps
    return is_growing and step > 0 and step % growth.steps_per_round == 0


def densify(
    splats: Splats,
    growth: Growth,
    *,
    max_splats: int,
    extent_m: float,
    refuted: np.ndarray | None = None,
) -> Splats:
    """Run one round: remove faint, refuted and unusable splats, then double the best others.

    If no splat would be left, only unusable ones are removed: a scene is never emptied.

    Args:
        splats: the splats; they are not changed.
        growth: the settings.
        max_splats: no splats are added beyond this number.
        extent_m: the extent of the scene, metres, which limits the sizes.
        refuted: bool [N], see `Sightings`.

    Returns:
        Splats with arrays of their own, part after part, children next to their parents, grads
        zero.

    Raises:
        SceneError: no splat is usable any more.
    """
    is_usable = usable_rows(splats, extent_m)
    if len(splats) and not is_usable.any():
        raise SceneError(
            f"none of the {len(splats)} splats is finite and of sensible size: the fit has "
            f"diverged; lower its learning rates, or begin again from an earlier checkpoint"
        )
    is_kept = is_usable & (splats.opacities >= growth.prune_opacity)
    if refuted is not None:
        is_kept &= ~refuted
    if not is_kept.any():
        is_kept = is_usable
    num_kept = int(is_kept.sum())
    counts = is_kept.astype(np.int64)
    is_large = _is_large(splats, extent_m)
    opacities = _child_opacities(splats, is_large)
    # Children fainter than prune_opacity would both be gone after the next round.
    is_candidate = is_kept & (opacities >= growth.prune_opacity)
    chosen_rows = _best_rows(
        splats, is_candidate, min(int(growth.fraction * num_kept), max(max_splats - num_kept, 0))
    )
    counts[chosen_rows] += 1
    first_rows = (np.cumsum(counts) - counts)[chosen_rows]
    new_splats = rebuild(splats, np.repeat(np.arange(len(splats)), counts))
    new_splats.opacities[first_rows] = opacities[chosen_rows]
    new_splats.opacities[first_rows + 1] = opacities[chosen_rows]
    # A clone's original keeps its momentum, while the copy starts with a whole step of Adam: two
    # equal splats at the same position would otherwise stay together for many steps.
    reset_adam(new_splats, first_rows + 1)
    _split_rows(new_splats, first_rows[is_large[chosen_rows]])
    bound_sizes(new_splats)
    return new_splats


def _is_large(splats: Splats, extent_m: float) -> np.ndarray:
    """Return the splats to split rather than to clone, bool [N].

    Size in the images decides: what one image can show of a splat does not depend on the size of
    the world. Size in the world decides for splats that no image has shown.
    """
    radius = splats.grads[:, 2]
    is_large_unseen = (radius <= 0) & (splats.scales.max(1, initial=0) > MIN_SPLIT_SCALE * extent_m)
    return (radius > MIN_SPLIT_RADIUS) | is_large_unseen


def _child_opacities(splats: Splats, is_large: np.ndarray) -> np.ndarray:
    """Return the opacity of each of the two splats that a splat would become, float32 [N].

    It is 1 - sqrt(1 - o) (Rota Bulò et al. 2024, section 4.3): two such splats at the same position
    have the transmittance of one with opacity o. 3DGS's two copies of o hide more of the
    background, and again more in every round. Large splats are split side by side, hardly overlap,
    and keep their parent's opacity.
    """
    halved = 1 - np.sqrt(np.clip(1 - splats.opacities, 0, 1))
    return np.where(is_large, splats.opacities, halved)


def _best_rows(splats: Splats, is_candidate: np.ndarray, budget: int) -> np.ndarray:
    """Return increasing rows of the `budget` best candidates, int64.

    The best have the largest mean absolute gradient of the views that show them; of equals the
    earlier.
    """
    num_views = splats.grads[:, 1]
    scores = splats.grads[:, 0] / np.maximum(num_views, 1)
    is_candidate = is_candidate & (num_views > 0) & np.isfinite(scores) & (scores > MIN_GRADIENT)
    rows = np.flatnonzero(is_candidate)
    return np.sort(rows[np.argsort(-scores[rows], kind="stable")[:budget]])


def _split_rows(splats: Splats, first_rows: np.ndarray) -> None:
    """Turn the equal pairs of rows (first, first + 1) into two smaller splats, in place.

    They lie side by side along the longest axis (as Deng et al. 2024 suggest), which disturbs the
    image least.
    """
    scales = splats.scales[first_rows]
    is_longest = np.arange(3) == scales.argmax(1)[:, None]
    local_offset = np.where(is_longest, np.float32(OFFSET) * scales, np.float32(0))
    divisors = np.where(is_longest, np.float32(SHRINK), np.float32(SIDE_SHRINK))
    offset = rotate(splats.quats[first_rows], local_offset)
    splats.means[first_rows] += offset
    splats.means[first_rows + 1] -= offset
    splats.scales[first_rows] = splats.scales[first_rows + 1] = scales / divisors
    reset_adam(splats, first_rows)


# ---- Limits from the recorded images: how small a splat may be, and where none can be ------------

# Sigma of the low-pass filter of Mip-Splatting (Yu et al. 2024, eq. 9; s^2 = 0.2 as there), in
# pixels of the view that resolves a splat best.
FILTER_PX = float(np.sqrt(0.2))
# A refuted splat lies in the sky of at least this many views,
MIN_IN_SKY = 2
# and of at least this fraction of the views that it is inside of: a wall may hide it in the others.
MIN_IN_SKY_FRACTION = 0.25


class Sightings:
    """Counts, for each of N splats, the views that show its position.

    px_per_m: float32 [N], the most pixels per metre at the splat in any view.
    num_views: int32 [N], the number of views that the splat's centre is inside of.
    num_in_sky: int32 [N], the number of views in whose sky it lies.
    """

    def __init__(self, count: int) -> None:
        self.px_per_m = np.zeros(count, np.float32)
        self.num_views = np.zeros(count, np.int32)
        self.num_in_sky = np.zeros(count, np.int32)

    def add(
        self,
        splats: Splats,
        part: int,
        world_from_part: np.ndarray,
        camera: Camera,
        sky: np.ndarray,
    ) -> None:
        """Add one view of one part.

        Args:
            splats: the splats.
            part: the part's number.
            world_from_part: float64 [4, 4].
            camera: the view's camera.
            sky: bool [H, W], the view's sky.
        """
        rows = slice(int(splats.starts[part]), int(splats.starts[part + 1]))
        camera_from_part = camera.camera_from_world.numpy() @ world_from_part
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        with kernel_threads():
            kernels.update_sightings(
                splats.means[rows],
                camera_from_part.astype(np.float32),
                intrinsics,
                sky,
                self.px_per_m[rows],
                self.num_views[rows],
                self.num_in_sky[rows],
            )

    @property
    def is_refuted(self) -> np.ndarray:
        """Return the splats that lie in front of the sky of several images, bool [N].

        The sky is infinitely far away: nothing can be there, however well it fits another image.
        """
        return (self.num_in_sky >= MIN_IN_SKY) & (
            self.num_in_sky >= MIN_IN_SKY_FRACTION * self.num_views
        )


def bound_sizes(splats: Splats) -> None:
    """Make no scale smaller than `min_scale_m`, in place.

    Mip-Splatting adds the filter to the learnt size and dims the splat by the ratio of volumes.
    Here the filtered size itself is learnt, bounded from below. The sizes are the same, but flat
    splats on measured surfaces may be opaque, which that ratio forbids. The scene stores the learnt
    sizes, so that no frame pays for a filter.
    """
    np.maximum(splats.scales, splats.min_scale_m[:, None], out=splats.scales)


# ---- Step sizes of one update, as the kernel takes them ------------------------------------------

BETA1 = 0.9  # Adam's decay of first moments
BETA2 = 0.999  # Adam's decay of second moments
CORRECTIONS = kernels.bias_corrections(BETA1, BETA2)
_MIN_SCALE_M = 1e-3  # metres; no scale gets smaller


def splat_rates(rates: LearningRates, done: float, camera: Camera, extent_m: float) -> np.ndarray:
    """Return the numbers of an update, float32 [NUM_RATES].

    Means decay exponentially over the run; the others fall exponentially to rates.late of their
    value.

    Args:
        rates: step sizes.
        done: the fraction of the run that is over.
        camera: the view's camera.
        extent_m: the largest scale, metres.
    """
    late_factor = rates.late**done
    values = np.zeros(kernels.NUM_RATES, np.float32)
    values[G_MEAN : G_MEAN + 3] = decayed(rates.means, rates.means_end, done)
    values[G_QUAT : G_QUAT + 4] = rates.quats * late_factor
    values[G_SCALE : G_SCALE + 3] = rates.scales * late_factor
    values[G_OPACITY] = -rates.opacities * late_factor
    values[kernels.R_SH_DC] = rates.sh_dc * late_factor
    values[kernels.R_SH_REST] = rates.sh_rest * late_factor
    values[kernels.R_BETA1] = BETA1
    values[kernels.R_BETA2] = BETA2
    values[kernels.R_SMALLEST] = _MIN_SCALE_M
    values[kernels.R_LARGEST] = extent_m
    side = max(camera.width, camera.height)
    values[kernels.R_ABS_UNIT] = 0.5 * side
    values[kernels.R_RADIUS_UNIT] = 1 / side
    return values


def decayed(start: float, end: float, done: float) -> float:
    """Return a value between start and end, exponentially; 0 if either is 0.

    Args:
        start: the value at the start of the run.
        end: the value at its end.
        done: the fraction of the run that is over.
    """
    return start ** (1 - done) * end**done if start and end else 0.0


_EPS = 1e-15  # added to the root of the second moment


class DenseAdam:
    """Adam on a small array, updated in place as a whole or one row at a time.

    Moments are float64; updates are counted by rows.
    """

    def __init__(self, values: np.ndarray, eps: float = _EPS) -> None:
        self._values = values
        self._eps = eps
        self._m = np.zeros(values.shape)
        self._v = np.zeros(values.shape)
        self._count = np.zeros(len(values), np.int64)

    def update(
        self, gradient: np.ndarray, rate: float | np.ndarray, row: int | None = None
    ) -> None:
        """Apply a gradient to the whole array or to one row."""
        rows = slice(None) if row is None else slice(row, row + 1)
        m = self._m[rows]
        v = self._v[rows]
        self._count[rows] += 1
        m += (1 - BETA1) * (gradient - m)
        v += (1 - BETA2) * (gradient * gradient - v)
        n = int(self._count[rows][0])
        corrected_m = m / (1 - BETA1**n)
        corrected_v = v / (1 - BETA2**n)
        step = rate * corrected_m / (np.sqrt(corrected_v) + self._eps)
        self._values[rows] -= step.astype(self._values.dtype)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the moments and counts themselves, by name."""
        return {"m": self._m, "v": self._v, "count": self._count}


class ColorAdam:
    """Adam on rows of a float32 array [N, 3] of colours, in place; each row counts its updates."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values
        self._m = np.zeros_like(values)
        self._v = np.zeros_like(values)
        self._count = np.zeros(len(values), np.int32)

    def update(self, rows: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """Apply a gradient to some rows. Colours stay within [0, 1].

        Args:
            rows: int32 [T], without repetitions.
            gradient: float32 [T, 3].
            rate: the step size.
        """
        with kernel_threads():
            kernels.update_rows(
                self._values.reshape(-1),
                self._m.reshape(-1),
                self._v.reshape(-1),
                self._count,
                rows,
                gradient,
                np.float32(rate),
                np.array([BETA1, BETA2], np.float32),
                CORRECTIONS.reshape(-1),
            )

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the moments and counts themselves, by name."""
        return {"m": self._m, "v": self._v, "count": self._count}
