"""Renders parts of a scene from straight above, and the depth that the cameras of a drive see.

Input: posed Gaussians. Output: `HeightMap` (heights, colours and classes of the highest surface)
and `Views` (small depth images that tell if a camera sees a cell). Callers: `search`, `surface`.
"""

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

from augment.exposure import surface_kernels
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
from augment.render.layout import SURFACE_DEPTHS_ONLY
from augment.render.rasterize import rasterize
from augment.render.threads import kernel_threads, num_kernel_threads
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians
from augment.scene.semantics import SemanticClass

# ---- Work on several threads ---------------------------------------------------------------------

Item = TypeVar("Item")
Result = TypeVar("Result")

_MAX_THREADS = 8  # largest number of threads; each square of cells takes up to some 300 MB
# Rows of arrays in a slice, so that its intermediates stay in a core's caches.
_ROWS_PER_SLICE = 8192


class _Worker(threading.local):
    """State of a thread: True while it works on an item."""

    is_busy = False

    def begin(self) -> None:
        """Mark the thread as busy."""
        self.is_busy = True


_worker = _Worker()


def in_order(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    after_each: Callable[[], object] = lambda: None,
    backend: str = AUTO,
) -> list[Result]:
    """Call a function for each item and return the results in the items' order.

    Items are shared among as many threads as kernels use: numpy, cv2 and kernels release the GIL.

    Args:
        function: function of one item.
        items: items to work on.
        after_each: called in this thread after each item, in order.
        backend: with "cuda" the calling thread works alone, since it holds the device and the
            stream.
    """
    items = list(items)
    results = []
    threads = min(num_kernel_threads(), len(items), _MAX_THREADS)
    is_serial = threads <= 1 or _worker.is_busy or backend == CUDA
    with (
        nullcontext()
        if is_serial
        else ThreadPoolExecutor(threads, "exposed surfaces", initializer=_worker.begin) as pool
    ):
        for result in map(function, items) if pool is None else pool.map(function, items):
            results.append(result)
            after_each()
    return results


def slices_of(count: int) -> list[slice]:
    """Split `count` rows into slices, for `in_order`."""
    return [
        slice(start, min(count, start + _ROWS_PER_SLICE))
        for start in range(0, count, _ROWS_PER_SLICE)
    ]


# ---- The highest surface -------------------------------------------------------------------------

DepthEstimator = Literal["mode", "expected", "median"]

MIN_COVERED_ALPHA = 0.5  # least alpha of a pixel in which something lies
_EYE_HEIGHT_M = 100.0  # height of the camera over the highest centre
# Height over a surface: where half of what falls lands so high up, the surface is sheltered.
_MIN_OVERHANG_M = 1.0
_MIN_SHELTER_HEIGHT_M = 1.0  # a thing less far above a cell hides no sky from it
_MIN_SHELTER_CELLS = 2  # narrower things hide too little of the sky
# In coarser cells, splats are drawn without antialiasing: those that cover a cell together would be
# too faint one by one.
_MAX_ANTIALIASED_CELL_M = 1.0
_MAX_THIN_CELL_M = 0.3  # in coarser cells, thin things cannot be found by blurring


@dataclass(frozen=True, eq=False)
class HeightMap:
    """Highest surface at each cell of a grid. Arrays are [H, W, ...], rows towards +y."""

    left_m: float  # least x of the grid
    bottom_m: float  # least y of the grid
    cell_m: float  # side of a cell
    alpha: np.ndarray  # float32, opacity of what lies there
    height_m: np.ndarray  # float32, z of the surface; 0 where not covered
    rgb: np.ndarray  # float32 [H, W, 3], colour of the surface, the same from all directions
    ids: np.ndarray  # int32, heaviest Gaussian, counted through the parts; -1 where there is none
    # bool: the surface is narrower than a cell (a wall on edge, a fence, twigs). It shelters
    # what is below and is not exposed itself.
    is_thin: np.ndarray

    @property
    def covered(self) -> np.ndarray:
        """Cells where something solid lies, bool [H, W]."""
        return self.alpha >= MIN_COVERED_ALPHA

    def centers(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x [W] and y [H] of the cells' middles, float64."""
        rows, columns = self.alpha.shape
        return (
            self.left_m + (np.arange(columns) + 0.5) * self.cell_m,
            self.bottom_m + (np.arange(rows) + 0.5) * self.cell_m,
        )


def plain_gaussians(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians in float32 without gradients; sh keeps the constant colour only."""
    g = gaussians
    columns = (g.means, g.quats, g.scales, g.opacities, g.sh[:, :1])
    converted = (c.detach().to(torch.float32).contiguous() for c in columns)
    return Gaussians(*converted, semantic=g.semantic)


def classes_of(gaussians: Gaussians) -> np.ndarray:
    """Classes of the Gaussians, int16 [N]; UNKNOWN everywhere if they have none."""
    if gaussians.semantic is None:
        return np.full(len(gaussians), SemanticClass.UNKNOWN, np.int16)
    return gaussians.semantic.numpy()


class Footprints:
    """Bounds of Gaussians seen from above.

    It holds rectangles (x, y) of the Gaussians that are not too faint to show, and z of all.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        means = gaussians.means.numpy()
        reach = gaussians.scales.numpy().max(1, initial=0)
        reach = reach * np.float32(MAX_EXTENT_SIGMAS)
        self._visible_ids = np.flatnonzero(gaussians.opacities.numpy() >= np.float32(ALPHA_MIN))
        centers_xy = means[self._visible_ids, :2].T
        reach = reach[self._visible_ids]
        self._lows = centers_xy - reach  # [2, N]
        self._highs = centers_xy + reach
        self._z_m = np.ascontiguousarray(means[:, 2])

    def in_box(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the indices of the Gaussians that may show between two corners (x, y), int64."""
        is_inside = np.ones(len(self._visible_ids), bool)
        for axis in range(2):
            is_inside &= self._highs[axis] >= low[axis]
            is_inside &= self._lows[axis] <= high[axis]
        return self._visible_ids[is_inside]

    def top_m(self, chosen_ids: np.ndarray | None = None) -> float:
        """Return z of the highest centre of all or of the chosen Gaussians; -inf without any."""
        z_m = self._z_m if chosen_ids is None else self._z_m[chosen_ids]
        return float(z_m.max(initial=-np.inf))


def top_of(parts: Sequence[PosedGaussians]) -> float:
    """Return a z that no centre of the parts exceeds, world; -inf without any Gaussians."""
    return max((_top_m(part) for part in parts if len(part.gaussians)), default=-math.inf)


def draw_from_above(
    parts: Sequence[PosedGaussians],
    *,
    corner_m: tuple[float, float],
    cell_m: float,
    shape: tuple[int, int],
    estimator: DepthEstimator,
    pixel_mask: np.ndarray | None = None,
    with_thin: bool = True,
    top_m: float | None = None,
    backend: str = AUTO,
) -> HeightMap:
    """Render parts of plain Gaussians from straight above.

    Args:
        parts: posed parts, see `plain_gaussians`.
        corner_m: least x and y of the grid.
        cell_m: side of a cell.
        shape: rows and columns of cells.
        estimator: depth buffer that heights are taken from.
        pixel_mask: bool of that shape; other cells may be left empty.
        with_thin: if True, thin things are found by a second rendering, which blurs them to a
            pixel's width.
        top_m: result of `top_of`, if known.
        backend: backend that renders.
    """
    rows, columns = shape
    if top_m is None:
        top_m = top_of(parts)
    top_z_m = top_m if math.isfinite(top_m) else 0.0
    middle_m = (corner_m[0] + columns * cell_m / 2, corner_m[1] + rows * cell_m / 2)
    pose = torch.eye(4, dtype=torch.float64)
    pose[1, 1] = pose[2, 2] = -1.0  # x to +x, rows towards -y, depth downwards
    eye = torch.tensor([*middle_m, top_z_m + _EYE_HEIGHT_M], dtype=torch.float64)
    pose[:3, 3] = -pose[:3, :3] @ eye
    intrinsics = (1 / cell_m, 1 / cell_m, columns / 2, rows / 2)
    camera = Camera("from above", columns, rows, *intrinsics, pose, is_orthographic=True)
    mask = None
    if pixel_mask is not None:
        mask = torch.from_numpy(np.ascontiguousarray(pixel_mask[::-1]))
        mask = gpu.upload(mask) if backend == CUDA else mask
    names = (ALPHA, DEPTH_ESTIMATORS[estimator], MEDIAN_DEPTH, RGB, SPLAT_IDS)
    alpha, depths, medians, rgb, ids = _render_buffers(
        parts, camera, names, mask, antialiased=cell_m <= _MAX_ANTIALIASED_CELL_M, backend=backend
    )
    covered, height = _heights_from_depths(alpha, depths, float(eye[2]))
    alpha = np.where(covered, alpha, np.minimum(alpha, np.float32(MIN_COVERED_ALPHA / 2)))
    is_thin = np.zeros(shape, bool)
    if with_thin and cell_m <= _MAX_THIN_CELL_M:
        alpha_wide, depths = _render_buffers(
            parts, camera, names[:2], mask, antialiased=False, backend=backend
        )
        covered_wide, height_wide = _heights_from_depths(alpha_wide, depths, float(eye[2]))
        is_shelter = covered & covered_wide & (height_wide - height > _MIN_SHELTER_HEIGHT_M)
        kernel = np.ones((_MIN_SHELTER_CELLS, _MIN_SHELTER_CELLS), np.uint8)
        is_shelter = cv2.morphologyEx(is_shelter.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
        is_thin = is_shelter | (covered_wide & ~covered)
        height[is_thin] = height_wide[is_thin]
        alpha[is_thin] = alpha_wide[is_thin]
    median_heights = np.where(medians > 0, eye[2].item() - medians.astype(np.float64), 0).astype(
        np.float32
    )
    is_overhang = (
        (alpha >= MIN_COVERED_ALPHA) & (medians > 0) & (median_heights - height > _MIN_OVERHANG_M)
    )
    height[is_overhang] = median_heights[is_overhang]
    is_thin = is_thin | is_overhang
    return HeightMap(
        left_m=corner_m[0],
        bottom_m=corner_m[1],
        cell_m=cell_m,
        alpha=alpha,
        height_m=height,
        rgb=rgb / np.maximum(alpha, np.float32(MIN_COVERED_ALPHA / 2))[..., None],
        ids=np.where(alpha > 0, ids, -1),
        is_thin=is_thin,
    )


def _render_buffers(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    names: tuple[str, ...],
    pixel_mask: torch.Tensor | None,
    *,
    antialiased: bool,
    backend: str,
) -> list[np.ndarray]:
    """Render buffers of a view from above, rows towards +y."""
    # Other depths than the mode's serve comparisons only. Rendering all buffers is slower, but uses
    # the CPU kernel that is compiled already; a kernel of its own would be compiled for each.
    render = rasterize(
        parts,
        camera,
        buffers=names if MODE_DEPTH in names else BUFFERS,
        settings=RasterSettings(sh_degree=0, antialiased=antialiased),
        clip=SURFACE_DEPTHS_ONLY,
        pixel_mask=gpu.upload(pixel_mask)
        if pixel_mask is not None and backend == CUDA
        else pixel_mask,
        backend=backend,
    )
    images = (getattr(render, name).cpu().numpy() for name in names)
    return [np.ascontiguousarray(image[::-1]) for image in images]


def _heights_from_depths(
    alpha: np.ndarray, depths: np.ndarray, eye_z_m: float
) -> tuple[np.ndarray, ...]:
    """Return the covered cells, bool [H, W], and their z, float32 [H, W], 0 elsewhere."""
    covered = (alpha >= MIN_COVERED_ALPHA) & (depths > 0) & np.isfinite(depths)
    height = np.where(covered, eye_z_m - depths.astype(np.float64), 0.0)
    return covered, height.astype(np.float32)


def _top_m(part: PosedGaussians) -> float:
    """Return a z that no centre of the part exceeds, world."""
    means = part.gaussians.means
    if part.world_from_part is None:
        return float(means[:, 2].max())
    pose = part.world_from_part
    return float(pose[2, 3]) + math.sqrt(float((means * means).sum(1).max()))


# ---- Which points of the ground the cameras of a drive can see -----------------------------------

DEPTH_IMAGE_WIDTH_PX = 200  # longer side of the depth images: they resolve houses, not posts
LIFTS_M = (0.0, 0.3, 1.0)  # heights of a layer's top over its cell at which it may be visible
# A point is visible up to this factor of the image's depth plus this distance, since images are
# blurred.
_DEPTH_TOLERANCE_SHARE = 1.05
_DEPTH_TOLERANCE_M = 0.3
# The same factor for a layer on top of a surface that shows its underside.
_UNDERSIDE_SHARE = 1.02
_MAX_NORMAL_ERROR_SINE = math.sin(math.radians(3))  # sine of the largest error of normals
_MARGIN_PX = 3.0  # pixels beyond the image that count as inside
_POINTS_PER_TASK = 256  # number of points that a thread takes at a time


@dataclass(frozen=True, eq=False)
class Views:
    """Cameras with the depth that they see, in the layout of surface_kernels.find_visible."""

    views: np.ndarray  # float64 [V, 17], a camera a row
    sizes: np.ndarray  # int64 [V, 3]: width, height, and where the camera's depths begin
    depths: np.ndarray  # float32, depths of all cameras, infinite where nothing is

    @property
    def lowest_m(self) -> float:
        """z of the lowest camera; infinite without cameras."""
        return float(self.views[:, 14].min(initial=np.inf))

    def near(self, low: np.ndarray, high: np.ndarray, reach_m: float) -> Views:
        """Select the cameras whose centre is within reach_m of a rectangle given by two corners."""
        centres = self.views[:, 12:14]
        gaps = np.maximum(np.maximum(low - centres, centres - high), 0)
        is_near = (np.hypot(gaps[:, 0], gaps[:, 1]) <= reach_m) | (self.views[:, 15] == 1)
        return replace(self, views=self.views[is_near], sizes=self.sizes[is_near])

    def see(self, points: np.ndarray, normals: np.ndarray, is_sure: np.ndarray) -> np.ndarray:
        """Tell for each point if some camera sees it, bool [C].

        A point that more views look through than show is not there for any of them.

        Args:
            points: float64 [C, 3], points of surfaces, world.
            normals: [C, 3], unit normals of the surfaces.
            is_sure: bool [C], points whose surface is known to be there.
        """
        points = np.asarray(points, np.float64)
        normals = np.asarray(normals, np.float64)
        lifts = np.array(LIFTS_M)
        tolerances = np.array(
            [
                _DEPTH_TOLERANCE_SHARE,
                _DEPTH_TOLERANCE_M,
                _UNDERSIDE_SHARE,
                _MAX_NORMAL_ERROR_SINE,
                _MARGIN_PX,
            ]
        )
        is_visible = np.empty(len(points), bool)
        with kernel_threads(_POINTS_PER_TASK):
            surface_kernels.find_visible(
                np.ascontiguousarray(points),
                np.ascontiguousarray(normals),
                np.ascontiguousarray(is_sure),
                self.views,
                self.sizes,
                self.depths,
                lifts,
                tolerances,
                is_visible,
            )
        return is_visible


def draw_views(
    cameras: Sequence[Camera],
    parts: Sequence[PosedGaussians],
    *,
    backend: str = AUTO,
    after_each: Callable[[], object] = lambda: None,
) -> Views:
    """Render small depth images of the parts for each camera, with `backend`."""
    views = []
    sizes = []
    start = 0
    depths: list[Tensor] = []
    for camera in cameras:
        small_camera = camera.scaled(
            min(1.0, DEPTH_IMAGE_WIDTH_PX / max(camera.width, camera.height))
        )
        render = rasterize(
            parts,
            small_camera,
            buffers=(ALPHA, EXPECTED_DEPTH),
            clip=SURFACE_DEPTHS_ONLY,
            backend=backend,
        )
        assert render.alpha is not None and render.expected_depth is not None
        depths.append(
            torch.where(
                render.alpha >= MIN_COVERED_ALPHA, render.expected_depth, math.inf
            ).flatten()
        )
        views.append(_camera_row(small_camera))
        sizes.append((small_camera.width, small_camera.height, start))
        start += small_camera.width * small_camera.height
        after_each()
    return Views(
        np.array(views, np.float64).reshape(-1, 17),
        np.array(sizes, np.int64).reshape(-1, 3),
        (torch.cat(depths) if depths else torch.zeros(0)).cpu().numpy(),
    )


def _camera_row(camera: Camera) -> np.ndarray:
    """Return a camera's row of `Views.views`."""
    rotation = camera.camera_from_world[:3, :3].numpy().ravel()
    intrinsics = (camera.fx, camera.cx, camera.fy)
    is_orthographic = float(camera.is_orthographic)
    return np.array([*rotation, *intrinsics, *camera.centre.numpy(), is_orthographic, camera.cy])
