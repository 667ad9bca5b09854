"""A part of a scene as seen from straight above: heights, colours, classes."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera
from augment.effects.snow import surface_kernels
from augment.render.buffers import (
    ALPHA,
    AUTO,
    BUFFERS,
    CUDA,
    DEPTH_ESTIMATORS,
    EXPECTED_DEPTH,
    MEDIAN_DEPTH,
    MODE_DEPTH,
    RGB,
    SPLAT_IDS,
)
from augment.render.constants import ALPHA_MIN, MAX_EXTENT_SIGMAS, RasterSettings
from augment.render.cuda import runtime as gpu
from augment.render.layout import UNCUT
from augment.render.rasterize import rasterize
from augment.render.threads import kernel_threads, thread_count
from augment.scene import Gaussians, PosedGaussians
from augment.semantics import SemanticClass

# ---- Work on several threads ---------------------------------------------------------------------

Item = TypeVar("Item")
Result = TypeVar("Result")

_MAX_AT_ONCE = 8  # a square of cells takes up to some 300 MB while it is worked on
_ROWS = 8192  # of arrays, in one part: what is made from them stays in a core's caches


class _Worker(threading.local):
    is_busy = False

    def begin(self) -> None:
        self.is_busy = True


_worker = _Worker()


def in_order(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    after_each: Callable[[], object] = lambda: None,
    backend: str = AUTO,
) -> list[Result]:
    """The function's results for each item, in the items' order, found by as many threads as
    kernels use: numpy, cv2 and kernels let other threads go on. backend: with "cuda" by the calling
    thread alone, which has the device and the stream that are meant.

    after_each: called in this thread, for one item after another.
    """
    items, results = list(items), []
    threads = min(thread_count(), len(items), _MAX_AT_ONCE)
    alone = threads <= 1 or _worker.is_busy or backend == CUDA
    with (
        nullcontext()
        if alone
        else ThreadPoolExecutor(threads, "placing snow", initializer=_worker.begin) as pool
    ):
        for result in map(function, items) if pool is None else pool.map(function, items):
            results.append(result)
            after_each()
    return results


def slices_of(count: int) -> list[slice]:
    """Parts of `count` rows, for `in_order`."""
    return [slice(start, min(count, start + _ROWS)) for start in range(0, count, _ROWS)]


# ---- What lies highest ---------------------------------------------------------------------------

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
    g = gaussians
    columns = (g.means, g.quats, g.scales, g.opacities, g.sh[:, :1])
    plain = (c.detach().to(torch.float32).contiguous() for c in columns)
    return Gaussians(*plain, semantic=g.semantic)


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
    pixel_mask: np.ndarray | None = None,
    with_thin: bool = True,
    top_m: float | None = None,
    backend: str = AUTO,
) -> HeightMap:
    """Draw parts of plain Gaussians from above. corner_m: least x and y. shape: rows and columns of
    cells. pixel_mask: bool of that shape; other cells may be left empty. with_thin: whether what is
    thin is looked for, by a second drawing in which it is blurred to a pixel's width. top_m: of
    `top_of`, where that is known.
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
    lens = (1 / cell_m, 1 / cell_m, columns / 2, rows / 2)
    camera = Camera("from above", columns, rows, *lens, pose, is_orthographic=True)
    shown = None
    if pixel_mask is not None:
        shown = torch.from_numpy(np.ascontiguousarray(pixel_mask[::-1]))
        shown = gpu.upload(shown) if backend == CUDA else shown
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
    pixel_mask: torch.Tensor | None,
    *,
    antialiased: bool,
    backend: str,
) -> list[np.ndarray]:
    """Buffers of a view from above, rows towards +y."""
    # Other depths than the mode's are for comparing them: rather slower with all buffers, which
    # takes a kernel of the CPU that there is, than at once after one has been compiled for each.
    out = rasterize(
        parts,
        camera,
        buffers=names if MODE_DEPTH in names else BUFFERS,
        settings=RasterSettings(sh_degree=0, antialiased=antialiased),
        clip=UNCUT,
        pixel_mask=gpu.upload(pixel_mask)
        if pixel_mask is not None and backend == CUDA
        else pixel_mask,
        backend=backend,
    )
    images = (getattr(out, name).cpu().numpy() for name in names)
    return [np.ascontiguousarray(image[::-1]) for image in images]


def _heights(alpha: np.ndarray, depths: np.ndarray, eye_z_m: float) -> tuple[np.ndarray, ...]:
    """Where something lies, bool [H, W], and its z, float32, 0 elsewhere."""
    covered = (alpha >= COVERED) & (depths > 0) & np.isfinite(depths)
    height = np.where(covered, eye_z_m - depths.astype(np.float64), 0.0)
    return covered, height.astype(np.float32)


def _top_m(part: PosedGaussians) -> float:
    """A height that no centre of the part exceeds, world."""
    means = part.gaussians.means
    if part.world_from_part is None:
        return float(means[:, 2].max())
    pose = part.world_from_part
    return float(pose[2, 3]) + math.sqrt(float((means * means).sum(1).max()))


# ---- What the cameras of a drive can see of what lies on the ground ------------------------------

WIDTH_PX = 200  # of the depth images: they tell houses apart, not posts
LIFTS_M = (0.0, 0.3, 1.0)  # depths of snow at which a cell may be seen
_FAR_SHARE, _FAR_M = 1.05, 0.3  # of the depth there, and beyond it: what blurred images hide
_BELOW_SHARE = 1.02  # of the depth there: snow on top of what shows its underside
_GRAZING = math.sin(math.radians(3))  # how far normals may be off
_MARGIN_PX = 3.0
_VIEW_ROWS = 256  # points a thread takes at a time


@dataclass(frozen=True, eq=False)
class Views:
    """Cameras with the depth that they see. See surface_kernels.find_seen."""

    views: np.ndarray
    sizes: np.ndarray
    depths: np.ndarray

    @property
    def lowest_m(self) -> float:
        """z of the lowest of them; infinite where there are none."""
        return float(self.views[:, 14].min(initial=np.inf))

    def near(self, low: np.ndarray, high: np.ndarray, reach_m: float) -> Views:
        """Those whose centre is within reach_m of the rectangle between two corners (x, y)."""
        centres = self.views[:, 12:14]
        gap = np.maximum(np.maximum(low - centres, centres - high), 0)
        chosen = (np.hypot(gap[:, 0], gap[:, 1]) <= reach_m) | (self.views[:, 15] == 1)
        return replace(self, views=self.views[chosen], sizes=self.sizes[chosen])

    def see(self, points: np.ndarray, normals: np.ndarray, is_sure: np.ndarray) -> np.ndarray:
        """bool [C]: points float64 [C, 3], of surfaces with unit normals [C, 3], that one sees.

        What most views look through, where they should show it, is not there for any of them, but
        where is_sure, bool [C].
        """
        points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
        lifts = np.array(LIFTS_M)
        tolerances = np.array([_FAR_SHARE, _FAR_M, _BELOW_SHARE, _GRAZING, _MARGIN_PX])
        seen = np.empty(len(points), bool)
        with kernel_threads(_VIEW_ROWS):
            surface_kernels.find_seen(
                np.ascontiguousarray(points),
                np.ascontiguousarray(normals),
                np.ascontiguousarray(is_sure),
                *(self.views, self.sizes, self.depths, lifts, tolerances, seen),
            )
        return seen


def draw_views(
    cameras: Sequence[Camera],
    parts: Sequence[PosedGaussians],
    *,
    backend: str = AUTO,
    after_each: Callable[[], object] = lambda: None,
) -> Views:
    """The depth that each camera sees of the parts, in small images; drawn by `backend`."""
    views, sizes, start = [], [], 0
    depths: list[Tensor] = []
    for camera in cameras:
        small = camera.scaled(min(1.0, WIDTH_PX / max(camera.width, camera.height)))
        out = rasterize(parts, small, buffers=(ALPHA, EXPECTED_DEPTH), clip=UNCUT, backend=backend)
        assert out.alpha is not None and out.expected_depth is not None
        depths.append(torch.where(out.alpha >= COVERED, out.expected_depth, math.inf).flatten())
        views.append(_numbers(small))
        sizes.append((small.width, small.height, start))
        start += small.width * small.height
        after_each()
    return Views(
        np.array(views, np.float64).reshape(-1, 17),
        np.array(sizes, np.int64).reshape(-1, 3),
        (torch.cat(depths) if depths else torch.zeros(0)).cpu().numpy(),
    )


def _numbers(camera: Camera) -> np.ndarray:
    """A row of `Views.views`."""
    rotation = camera.camera_from_world[:3, :3].numpy().ravel()
    lens = (camera.fx, camera.cx, camera.fy)
    parallel = float(camera.is_orthographic)
    return np.array([*rotation, *lens, *camera.centre.numpy(), parallel, camera.cy])
