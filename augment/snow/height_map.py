"""A part of a scene as seen from straight above: heights, colours, classes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch

from augment.cameras import Camera
from augment.render import gpu
from augment.render.backends import AUTO, CUDA
from augment.render.buffers import (
    ALPHA,
    BUFFERS,
    DEPTH_ESTIMATORS,
    MEDIAN_DEPTH,
    MODE_DEPTH,
    RGB,
    SPLAT_IDS,
)
from augment.render.clip import UNCUT
from augment.render.constants import ALPHA_MIN, MAX_EXTENT_SIGMAS, RasterSettings
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians
from augment.semantics import SemanticClass
from augment.snow.in_threads import on_device

Estimator = Literal["mode", "expected", "median"]

COVERED = 0.5  # of a pixel must be opaque, for something to lie there
_EYE_ABOVE_M = 100.0
_HANGS_M = 1.0  # over a surface: where half of what falls lands so high up, it is sheltered
_SHELTER_M = 1.0  # what stands less far above a cell hides no sky from it
_SHELTER_CELLS = 2  # narrower things hide too little of it
_TRUE_M = 1.0  # in coarser cells, splats that together cover one are too faint one by one
_FINE_M = 0.3  # in coarser cells, what is blurred to their width is no measure


@dataclass(frozen=True, eq=False)
class HeightMap:
    """What is highest at each cell of a grid. Arrays [H, W, ...], rows towards +y.

    left_m, bottom_m: the grid's corner; cell_m: its step. alpha: float32. height_m: float32, z of
    the surface; 0 where not covered. rgb: float32 [H, W, 3], of what is there, light from all sides
    alike. ids: int32, heaviest Gaussian, counted through the parts, -1 where none. is_thin: bool,
    what is there is narrower than a cell (a wall on edge, a fence, twigs): it keeps snow off what
    is below and carries none itself.
    """

    left_m: float
    bottom_m: float
    cell_m: float
    alpha: np.ndarray
    height_m: np.ndarray
    rgb: np.ndarray
    ids: np.ndarray
    is_thin: np.ndarray

    @property
    def covered(self) -> np.ndarray:
        """bool [H, W]: something lies there that can carry snow."""
        return self.alpha >= COVERED

    def centers(self) -> tuple[np.ndarray, np.ndarray]:
        """x [W] and y [H] of the cells' middles, float64."""
        rows, columns = self.alpha.shape
        return (
            self.left_m + (np.arange(columns) + 0.5) * self.cell_m,
            self.bottom_m + (np.arange(rows) + 0.5) * self.cell_m,
        )


def plain_gaussians(gaussians: Gaussians) -> Gaussians:
    """float32, with the colour that all directions share, without gradients."""
    return Gaussians(
        means=_plain(gaussians.means),
        quats=_plain(gaussians.quats),
        scales=_plain(gaussians.scales),
        opacities=_plain(gaussians.opacities),
        sh=_plain(gaussians.sh[:, :1]),
        semantic=gaussians.semantic,
    )


def classes_of(gaussians: Gaussians) -> np.ndarray:
    """int16 [N]: UNKNOWN throughout where classes are not known."""
    if gaussians.semantic is None:
        return np.full(len(gaussians), SemanticClass.UNKNOWN, np.int16)
    return gaussians.semantic.numpy()


class Footprints:
    """What Gaussians may cover, seen from above: rectangles (x, y) of those that are not too faint,
    and the heights of all.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        means, reach = gaussians.means.numpy(), gaussians.scales.numpy().max(1, initial=0)
        reach = reach * np.float32(MAX_EXTENT_SIGMAS)
        self._shown = np.flatnonzero(gaussians.opacities.numpy() >= np.float32(ALPHA_MIN))
        middles, reach = means[self._shown, :2].T, reach[self._shown]
        self._least, self._most = middles - reach, middles + reach  # [2, N]
        self._z_m = np.ascontiguousarray(means[:, 2])

    def in_box(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """int64: numbers of the Gaussians that may be seen between two corners (x, y)."""
        inside = np.ones(len(self._shown), bool)
        for axis in range(2):
            inside &= self._most[axis] >= low[axis]
            inside &= self._least[axis] <= high[axis]
        return self._shown[inside]

    def top_m(self, chosen: np.ndarray | None = None) -> float:
        """z of the highest centre, of those chosen by number; -inf where there is none."""
        z_m = self._z_m if chosen is None else self._z_m[chosen]
        return float(z_m.max(initial=-np.inf))


def in_box(gaussians: Gaussians, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """int64: numbers of the Gaussians that may be seen, from above, between two corners (x, y)."""
    return Footprints(gaussians).in_box(low, high)


def top_of(parts: Sequence[PosedGaussians]) -> float:
    """z that no centre of the parts exceeds, world; -inf where there is none."""
    return max((_top_m(part) for part in parts if len(part.gaussians)), default=-math.inf)


def draw_from_above(
    parts: Sequence[PosedGaussians],
    *,
    corner_m: tuple[float, float],
    cell_m: float,
    shape: tuple[int, int],
    estimator: Estimator,
    wanted: np.ndarray | None = None,
    with_thin: bool = True,
    top_m: float | None = None,
    backend: str = AUTO,
) -> HeightMap:
    """Draw parts of plain Gaussians from above. corner_m: least x and y. shape: rows and columns of
    cells. wanted: bool of that shape; the others may be left empty. with_thin: what is thin is
    looked for. top_m: as `top_of` finds it, where that is known. backend: that draws.

    A pixel of the drawing is opaque for the share that is truly covered; a second drawing, in which
    whatever is thin is blurred to a pixel's width, shows what is thin.
    """
    rows, columns = shape
    if top_m is None:
        top_m = top_of(parts)
    top = top_m if math.isfinite(top_m) else 0.0
    middle = (corner_m[0] + columns * cell_m / 2, corner_m[1] + rows * cell_m / 2)
    pose = torch.eye(4, dtype=torch.float64)
    pose[1, 1] = pose[2, 2] = -1.0  # x to +x, rows towards -y, depth downwards
    eye = torch.tensor([*middle, top + _EYE_ABOVE_M], dtype=torch.float64)
    pose[:3, 3] = -pose[:3, :3] @ eye
    camera = Camera(
        "from above",
        columns,
        rows,
        1 / cell_m,
        1 / cell_m,
        columns / 2,
        rows / 2,
        pose,
        is_orthographic=True,
    )
    shown = None if wanted is None else torch.from_numpy(np.ascontiguousarray(wanted[::-1]))
    names = (ALPHA, DEPTH_ESTIMATORS[estimator], MEDIAN_DEPTH, RGB, SPLAT_IDS)
    alpha, depths, medians, rgb, ids = _draw(
        parts, camera, names, shown, antialiased=cell_m <= _TRUE_M, backend=backend
    )
    covered, height = _heights(alpha, depths, float(eye[2]))
    alpha = np.where(covered, alpha, np.minimum(alpha, np.float32(COVERED / 2)))
    is_thin = np.zeros(shape, bool)
    if with_thin and cell_m <= _FINE_M:
        alpha_wide, depths = _draw(
            parts, camera, names[:2], shown, antialiased=False, backend=backend
        )
        covered_wide, height_wide = _heights(alpha_wide, depths, float(eye[2]))
        shelters = covered & covered_wide & (height_wide - height > _SHELTER_M)
        wide = np.ones((_SHELTER_CELLS, _SHELTER_CELLS), np.uint8)
        shelters = cv2.morphologyEx(shelters.astype(np.uint8), cv2.MORPH_OPEN, wide) > 0
        is_thin = shelters | (covered_wide & ~covered)
        height[is_thin], alpha[is_thin] = height_wide[is_thin], alpha_wide[is_thin]
    above = np.where(medians > 0, eye[2].item() - medians.astype(np.float64), 0).astype(np.float32)
    hangs = (alpha >= COVERED) & (medians > 0) & (above - height > _HANGS_M)
    height[hangs], is_thin = above[hangs], is_thin | hangs
    return HeightMap(
        left_m=corner_m[0],
        bottom_m=corner_m[1],
        cell_m=cell_m,
        alpha=alpha,
        height_m=height,
        rgb=rgb / np.maximum(alpha, np.float32(COVERED / 2))[..., None],
        ids=np.where(alpha > 0, ids, -1),
        is_thin=is_thin,
    )


def _draw(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    names: tuple[str, ...],
    wanted: torch.Tensor | None,
    *,
    antialiased: bool,
    backend: str,
) -> list[np.ndarray]:
    """Buffers of a view from above, rows towards +y."""
    # Other depths than the mode's are for comparing them: rather slower with all buffers, which
    # takes a kernel of the CPU that there is, than at once after one has been compiled for each.
    asked = names if MODE_DEPTH in names else BUFFERS

    def draw() -> list[np.ndarray]:
        out = rasterize(
            parts,
            camera,
            buffers=asked,
            settings=RasterSettings(sh_degree=0, antialiased=antialiased),
            clip=UNCUT,
            wanted=gpu.upload(wanted) if wanted is not None and backend == CUDA else wanted,
            backend=backend,
        )
        return [getattr(out, name).cpu().numpy() for name in names]

    return [np.ascontiguousarray(image[::-1]) for image in on_device(draw, backend)]


def _heights(alpha: np.ndarray, depths: np.ndarray, eye_z_m: float) -> tuple[np.ndarray, ...]:
    """Where something lies, bool [H, W], and its z, float32, 0 elsewhere."""
    covered = (alpha >= COVERED) & (depths > 0) & np.isfinite(depths)
    height = np.where(covered, eye_z_m - depths.astype(np.float64), 0.0)
    return covered, height.astype(np.float32)


def _plain(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.detach().to(torch.float32).contiguous()


def _top_m(part: PosedGaussians) -> float:
    """A height that no centre of the part exceeds, world."""
    means = part.gaussians.means
    if part.world_from_part is None:
        return float(means[:, 2].max())
    pose = part.world_from_part
    return float(pose[2, 3]) + math.sqrt(float((means * means).sum(1).max()))
