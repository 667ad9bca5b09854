"""Gaussians in an order in which neighbours stand together, and the blocks that a view leaves out.

Each run of CELL_SIZE Gaussians along a Morton curve (Morton 1966) lies in a box. A camera tests the
boxes and reads only the runs that may be seen. Kernels get the original numbers, so no bit of an
image depends on the order. An order is made when means are drawn for the second time: for a single
image, and for Gaussians that change from view to view, it would cost more than it saves.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from augment.render import layout
from augment.render.buffers import ALPHA, RGB
from augment.render.constants import ALPHA_MIN, MAX_EXTENT_SIGMAS, RasterSettings
from augment.render.fog import Fog, optical_depth_numpy
from augment.render.fog_table import thinnest_fog
from augment.render.layout import HeightClip
from augment.scene.bounds import Bounds, may_show
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians

# Gaussians of a cell.
CELL_SIZE = 512
# Cells of a block.
_CELLS_PER_BLOCK = layout.BLOCK_SIZE // CELL_SIZE
# Smallest number of Gaussians for which an order is made: fewer are read as quickly as their boxes.
_MIN_COUNT = 32 * CELL_SIZE
# Smallest share of Gaussians too faint for any view at which leaving them out pays.
_MIN_FAINT_SHARE = 0.1
# Bits of each coordinate along the curve.
_BITS_PER_AXIS = 10
# Relative rounding margin of a sum's terms: a hundred times that of float32.
_ROUNDING = 1e-5
# Pixels by which a splat may exceed its box; 1.9 of it is the blur, as in augment.scene.bounds.
_BLUR_PX = 3.0

# ---- Values of tensors, cached as long as the tensors live and do not change ---------------------

Value = TypeVar("Value")


class TensorCache(dict[tuple[int, str], tuple[weakref.ref[Tensor], int, Any]]):
    """Cached values of tensors, by id and name.

    The values refer to the cache weakly, so that dropping a cache frees it at once.
    """


_tensor_cache = TensorCache()
_cache_lock = threading.RLock()  # views that are drawn at once need the same values


def cached_of_tensor(
    tensor: Tensor, name: str, make: Callable[[], Value], cache: TensorCache = _tensor_cache
) -> Value:
    """Return what `make` gave for the tensor under this name. It is made again after a change in
    place.

    Args:
        tensor: the tensor.
        name: name of the value.
        make: function that makes the value.
        cache: cache that holds the value.
    """
    key = (id(tensor), name)
    cache_ref = weakref.ref(cache)

    def forget(_: weakref.ref[Tensor]) -> None:
        if (live_cache := cache_ref()) is not None:
            live_cache.pop(key, None)

    def find() -> tuple[weakref.ref[Tensor], int, Any] | None:
        entry = cache.get(key)
        return entry if entry and entry[0]() is tensor and entry[1] == tensor._version else None

    entry = find()
    if entry is None:
        with _cache_lock:
            entry = find()
            if entry is None:
                entry = cache[key] = (weakref.ref(tensor, forget), tensor._version, make())
    return entry[2]


class _Uses:
    """Number of requests for an order, and the order once it pays.

    The uses of means hold the order of all Gaussians; those of opacities the order of the Gaussians
    that may be seen.
    """

    def __init__(self) -> None:
        self.count = 0
        self.order: Order | None = None
        self.parent_order: Order | None = (
            None  # the order of all Gaussians that `order` is a part of
        )


# ---- The order -----------------------------------------------------------------------------------


class Order(NamedTuple):
    """Gaussians in the order of a curve.

    ids: int32 [M], the Gaussian at every place.
    means: float32 [M, 3], means in this order.
    lows: float64 [C, 3], lower corner of the box of every cell's means, in the part's axes.
    highs: float64 [C, 3], upper corner of that box.
    cache: cache of tensors in this order.
    """

    ids: np.ndarray
    means: np.ndarray
    lows: np.ndarray
    highs: np.ndarray
    cache: TensorCache

    def visible_blocks(
        self,
        part: PosedGaussians,
        camera: Camera,
        settings: RasterSettings,
        fog: Fog | None,
        clip: HeightClip | None,
    ) -> np.ndarray:
        """Return the blocks in which a splat may be drawn (first, last + 1), int64 [B, 2]."""
        gaussians = part.gaussians
        halves = (self.highs - self.lows) / 2
        longest = self.sorted(gaussians.scales).largest
        owners = np.zeros(len(longest), np.int64)
        bounds = Bounds(self.lows + halves, halves, longest, owners)
        pose = None if part.world_from_part is None else part.world_from_part.numpy()
        # No comparison with NaN holds, so a cell with NaN stays.
        is_visible = find_visible_boxes(bounds, pose, camera, settings, fog, clip)
        is_visible &= ~(self.sorted(gaussians.opacities).largest < np.float32(ALPHA_MIN))
        return _blocks_of(is_visible, len(self.ids))

    def without_faint(self, faint: np.ndarray, means: np.ndarray) -> Order:
        """Return the order of the other Gaussians.

        Args:
            faint: bool [N], Gaussians that are left out, by number.
            means: [N, 3], means by number.
        """
        return _in_cells(self.ids[~faint[self.ids]], means)

    def sorted(self, tensor: Tensor) -> SortedRows:
        """Return the tensor's rows in this order."""
        return cached_of_tensor(tensor, "sorted", lambda: self._sort(tensor), self.cache)

    def _sort(self, tensor: Tensor) -> SortedRows:
        rows = tensor.detach().numpy()[self.ids]
        largest = rows if rows.ndim == 1 else rows.max(1)
        starts = np.arange(0, len(rows), CELL_SIZE)
        return SortedRows(rows, np.maximum.reduceat(largest, starts).astype(np.float64))


class SortedRows(NamedTuple):
    """Rows of a tensor in an order.

    rows: the rows.
    largest: float64 [C], the largest number of each cell.
    """

    rows: np.ndarray
    largest: np.ndarray


def spatial_order(gaussians: Gaussians) -> Order | None:
    """Return the order of Gaussians that have been drawn before; None for others, or if no order
    pays.

    Once they have been drawn in it, many Gaussians that are too faint for any view are left out.
    """
    g = gaussians
    if len(g) < _MIN_COUNT or not all(_is_plain(t) for t in (g.means, g.quats, g.scales)):
        return None
    mean_uses = cached_of_tensor(g.means, "order", _Uses)
    with _cache_lock:
        mean_uses.count += 1
        if mean_uses.count > 1 and mean_uses.order is None and _is_plain(g.opacities):
            mean_uses.order = _find_order(g.means.detach().numpy())
        return None if mean_uses.order is None else _order_of_visible(g, mean_uses)


def _order_of_visible(gaussians: Gaussians, mean_uses: _Uses) -> Order | None:
    """Return the order without the Gaussians that are too faint for any view, once it pays."""
    if not _is_plain(gaussians.opacities):
        return mean_uses.order
    opacity_uses = cached_of_tensor(gaussians.opacities, "order", _Uses)
    opacity_uses.count += 1
    if opacity_uses.count == 1 or mean_uses.order is None:
        return mean_uses.order
    if opacity_uses.order is None or opacity_uses.parent_order is not mean_uses.order:
        opacity_uses.parent_order = opacity_uses.order = mean_uses.order
        is_faint = gaussians.opacities.detach().numpy() < np.float32(ALPHA_MIN)
        if _MIN_FAINT_SHARE * len(is_faint) < np.count_nonzero(is_faint) < len(is_faint):
            opacity_uses.order = mean_uses.order.without_faint(
                is_faint, gaussians.means.detach().numpy()
            )
    return opacity_uses.order


def _is_plain(tensor: Tensor) -> bool:
    """Return True if kernels read the tensor in place and torch counts its changes."""
    return (
        tensor.dtype == torch.float32
        and tensor.is_contiguous()
        and not (tensor.requires_grad or tensor.is_inference())
    )


def _find_order(means: np.ndarray) -> Order:
    """Return the order along a Morton curve through the box of the means."""
    is_finite = np.isfinite(means).all(1)
    finite_means = means[is_finite] if is_finite.any() else np.zeros((1, 3), np.float32)
    low_corner, high_corner = np.quantile(
        finite_means, (0.001, 0.999), axis=0
    )  # strays must not make cells coarse
    cell_side = max(float((high_corner - low_corner).max()), 1e-6) / (1 << _BITS_PER_AXIS)
    with np.errstate(invalid="ignore"):
        steps = np.clip((means - low_corner) / cell_side, 0, (1 << _BITS_PER_AXIS) - 1)
    steps = np.where(is_finite[:, None], steps, 0).astype(np.uint32)
    curve_positions = (
        _spread_bits(steps[:, 0]) | _spread_bits(steps[:, 1]) << 1 | _spread_bits(steps[:, 2]) << 2
    )
    return _in_cells(np.argsort(curve_positions, kind="stable").astype(np.int32), means)


def _in_cells(ids: np.ndarray, means: np.ndarray) -> Order:
    """Return the order of ids, which are sorted within each cell, and the cells' boxes."""
    for first in range(0, len(ids), CELL_SIZE):
        ids[first : first + CELL_SIZE].sort()  # colours are read in the scene's own order
    rows = means[ids]
    starts = np.arange(0, len(ids), CELL_SIZE)
    bounds = (
        extremum.reduceat(rows, starts, axis=0).astype(np.float64)
        for extremum in (np.minimum, np.maximum)
    )
    return Order(ids, rows, *bounds, TensorCache())


def _spread_bits(bits: np.ndarray) -> np.ndarray:
    """Return the lowest ten bits, with two zeros after each."""
    bits = (bits | bits << 16) & np.uint32(0x030000FF)
    bits = (bits | bits << 8) & np.uint32(0x0300F00F)
    bits = (bits | bits << 4) & np.uint32(0x030C30C3)
    return (bits | bits << 2) & np.uint32(0x09249249)


# ---- Boxes that a view leaves out ----------------------------------------------------------------


def cut_in_fog(
    settings: RasterSettings, fog: Fog | None, clip: HeightClip | None, buffers: frozenset[str]
) -> RasterSettings:
    """Return the settings. Their fog_cut is 0 unless only colour and alpha of a whole image are
    asked for.
    """
    is_hidden = fog is not None and fog.extinction_per_m > 0
    if is_hidden and clip is None and buffers <= {RGB, ALPHA}:
        return settings
    return replace(settings, fog_cut=0.0)


def find_visible_boxes(
    bounds: Bounds,
    pose: np.ndarray | None,
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None,
) -> np.ndarray:
    """Return the boxes in which a splat may be drawn, bool [B].

    Args:
        bounds: the boxes.
        pose: world_from_part; None for the identity.
        camera: the camera.
        settings: thresholds of the image.
        fog: fog before the splats; None for clear air.
        clip: height at which splats are cut; None for no cut.
    """
    is_visible = may_show(bounds, pose, camera, settings.near_m)
    if clip is not None:
        low_heights, high_heights = (
            z - clip.z_m for z in _heights(bounds, pose, np.array(clip.up))
        )
        nearest, farthest = (
            (low_heights, high_heights) if clip.sign > 0 else (-high_heights, -low_heights)
        )
        is_visible &= ~((farthest < 0) | (nearest > clip.max_distance_m))
    if fog is not None and settings.fog_cut > 0:
        depths = _min_optical_depth(bounds, pose, camera, thinnest_fog(fog, camera))
        is_visible &= ~(depths > -math.log(settings.fog_cut))
    return is_visible


def _heights(
    bounds: Bounds, pose: np.ndarray | None, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and largest up . x (world) that splats of each box reach."""
    shift = 0.0
    if pose is not None:
        shift = float(up @ pose[:3, 3])
        up = up @ pose[:3, :3]
    middle = bounds.centres @ up + shift
    extent = bounds.halves @ np.abs(up) + MAX_EXTENT_SIGMAS * bounds.max_scales
    extent += _ROUNDING * (np.abs(middle) + extent)
    return middle - extent, middle + extent


def _min_optical_depth(
    bounds: Bounds, pose: np.ndarray | None, camera: Camera, fog: Fog
) -> np.ndarray:
    """Return a lower bound of the fog's optical depth before the splats of each box.

    If the fog thins with height, it is a bound for any point where a ray that meets a box leaves
    the splats.
    """
    eye = camera.centre.numpy()
    if pose is not None:
        eye = np.linalg.solve(pose[:3, :3], eye - pose[:3, 3])
    is_layered = fog.scale_height_m is not None
    halves = bounds.halves
    if is_layered:  # rays must not climb out: the sky shows where splats are left out
        halves = halves + (MAX_EXTENT_SIGMAS * bounds.max_scales)[:, None]
    offsets = np.maximum(np.abs(eye - bounds.centres) - halves, 0)
    distance = np.linalg.norm(offsets, axis=1) * (1 - _ROUNDING)
    if not is_layered:
        return fog.extinction_per_m * distance
    blur = _BLUR_PX * distance / min(camera.fx, camera.fy)
    highest_z_m = _heights(bounds, pose, np.array([0.0, 0.0, 1.0]))[1] + blur
    return optical_depth_numpy(fog, distance, float(camera.centre[2]), highest_z_m)


def _blocks_of(is_visible: np.ndarray, count: int) -> np.ndarray:
    """Return the visible cells in few blocks, each without invisible cells at its ends."""
    cells = np.zeros((-(-len(is_visible) // _CELLS_PER_BLOCK), _CELLS_PER_BLOCK), bool)
    cells.reshape(-1)[: len(is_visible)] = is_visible
    blocks = np.flatnonzero(cells.any(1))
    first = blocks * _CELLS_PER_BLOCK + cells[blocks].argmax(1)
    last = (blocks + 1) * _CELLS_PER_BLOCK - cells[blocks][:, ::-1].argmax(1)
    return np.stack([first * CELL_SIZE, np.minimum(last * CELL_SIZE, count)], 1)
