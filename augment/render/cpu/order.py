"""Gaussians in an order in which neighbours stand together, and which of them a view leaves out.

Runs of CELL Gaussians along a Morton curve (Morton 1966) lie in one box each. A camera tests the
boxes and reads only what may be seen; kernels get the original numbers, so that no bit of an image
depends on the order. It is made of means that are drawn a second time: an image on its own, and
Gaussians that change from view to view, would pay more for it than it saves.
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

from augment.bounds import Bounds, may_show
from augment.cameras import Camera
from augment.render import layout
from augment.render.buffers import ALPHA, RGB
from augment.render.constants import ALPHA_MIN, MAX_EXTENT_SIGMAS, RasterSettings
from augment.render.fog import Fog, optical_depth_of_arrays
from augment.render.layout import HeightClip
from augment.scene import Gaussians, PosedGaussians

CELL = 512
_CELLS = layout.BLOCK // CELL  # of a block
_MIN_COUNT = 32 * CELL  # fewer Gaussians are read as quickly as their boxes
_FAINT = 0.1  # the share of Gaussians that no view shows from which leaving them out pays
_LEVELS = 10  # bits of each coordinate along the curve
_ROUNDING = 1e-5  # of all terms of a sum: a hundred times float32's
_BLUR_PX = 3.0  # 1.9 of it is the blur, as in augment.bounds

# ---- What is known of tensors for as long as they live and stay as they are ----------------------

Value = TypeVar("Value")


class Known(dict[tuple[int, str], tuple[weakref.ref[Tensor], int, Any]]):
    """Of tensors, by id and name. What tensors hold refers to it weakly: whoever forgets it frees
    it at once.
    """


_known = Known()
_making = threading.RLock()  # views drawn at once want the same


def known_of(tensor: Tensor, name: str, make: Callable[[], Value], kept: Known = _known) -> Value:
    """What `make` gave for the tensor under this name; made anew after a change in place. kept:
    where it is looked for, and stays.
    """
    key, owner = (id(tensor), name), weakref.ref(kept)

    def forget(_: weakref.ref[Tensor]) -> None:
        if (those := owner()) is not None:
            those.pop(key, None)

    def find() -> tuple[weakref.ref[Tensor], int, Any] | None:
        known = kept.get(key)
        return known if known and known[0]() is tensor and known[1] == tensor._version else None

    known = find()
    if known is None:
        with _making:
            known = find()
            if known is None:
                known = kept[key] = (weakref.ref(tensor, forget), tensor._version, make())
    return known[2]


class _Uses:
    """How often an order has been asked for, and the order once that pays: of means, of all; of
    opacities, of those that may be seen.
    """

    def __init__(self) -> None:
        self.count = 0
        self.order: Order | None = None
        self.of: Order | None = None  # which that is a part of


# ---- The order -----------------------------------------------------------------------------------


class Order(NamedTuple):
    """ids: int32 [M], the Gaussian at every place. means: float32 [M, 3] in this order. lows,
    highs: float64 [C, 3], the box of every cell's means, in the part's axes. kept: rows of tensors.
    """

    ids: np.ndarray
    means: np.ndarray
    lows: np.ndarray
    highs: np.ndarray
    kept: Known

    def blocks_seen(
        self,
        part: PosedGaussians,
        camera: Camera,
        settings: RasterSettings,
        fog: Fog | None,
        clip: HeightClip | None,
    ) -> np.ndarray:
        """int64 [B, 2], first and last + 1 place of the blocks in which a splat may be drawn."""
        g = part.gaussians
        halves, longest = (self.highs - self.lows) / 2, self.sorted(g.scales).largest
        owners = np.zeros(len(longest), np.int64)
        bounds = Bounds(self.lows + halves, halves, longest, owners)
        pose = None if part.world_from_part is None else part.world_from_part.numpy()
        # Where nothing is known, of NaN, no comparison holds, and the cell stays.
        seen = may_be_drawn(bounds, pose, camera, settings, fog, clip)
        seen &= ~(self.sorted(g.opacities).largest < np.float32(ALPHA_MIN))
        return _blocks_of(seen, len(self.ids))

    def without(self, faint: np.ndarray, means: np.ndarray) -> Order:
        """The order of the others. faint: bool [N]; means: [N, 3], by number."""
        return _in_cells(self.ids[~faint[self.ids]], means)

    def sorted(self, tensor: Tensor) -> Sorted:
        """The tensor's rows in this order."""
        return known_of(tensor, "sorted", lambda: self._sort(tensor), self.kept)

    def _sort(self, tensor: Tensor) -> Sorted:
        rows = tensor.detach().numpy()[self.ids]
        largest = rows if rows.ndim == 1 else rows.max(1)
        starts = np.arange(0, len(rows), CELL)
        return Sorted(rows, np.maximum.reduceat(largest, starts).astype(np.float64))


class Sorted(NamedTuple):
    """rows: of a tensor in the order. largest: float64 [C], the largest number of each cell."""

    rows: np.ndarray
    largest: np.ndarray


def order_of(gaussians: Gaussians) -> Order | None:
    """The order of Gaussians that have been drawn before; None for others, and where none pays.
    Many that are too faint for any view are not in it, once they have been drawn in it.
    """
    g = gaussians
    if len(g) < _MIN_COUNT or not all(_is_plain(t) for t in (g.means, g.quats, g.scales)):
        return None
    uses = known_of(g.means, "order", _Uses)
    with _making:
        uses.count += 1
        if uses.count > 1 and uses.order is None and _is_plain(g.opacities):
            uses.order = _find_order(g.means.detach().numpy())
        return None if uses.order is None else _order_of_visible(g, uses)


def _order_of_visible(g: Gaussians, of_all: _Uses) -> Order | None:
    if not _is_plain(g.opacities):
        return of_all.order
    uses = known_of(g.opacities, "order", _Uses)
    uses.count += 1
    if uses.count == 1 or of_all.order is None:
        return of_all.order
    if uses.order is None or uses.of is not of_all.order:
        uses.of = uses.order = of_all.order
        faint = g.opacities.detach().numpy() < np.float32(ALPHA_MIN)
        if _FAINT * len(faint) < np.count_nonzero(faint) < len(faint):
            uses.order = of_all.order.without(faint, g.means.detach().numpy())
    return uses.order


def _is_plain(tensor: Tensor) -> bool:
    """Whether kernels read the tensor where it lies, and torch counts its changes."""
    return (
        tensor.dtype == torch.float32
        and tensor.is_contiguous()
        and not (tensor.requires_grad or tensor.is_inference())
    )


def _find_order(means: np.ndarray) -> Order:
    finite = np.isfinite(means).all(1)
    known = means[finite] if finite.any() else np.zeros((1, 3), np.float32)
    low, high = np.quantile(known, (0.001, 0.999), axis=0)  # strays must not make cells coarse
    side = max(float((high - low).max()), 1e-6) / (1 << _LEVELS)
    with np.errstate(invalid="ignore"):
        steps = np.clip((means - low) / side, 0, (1 << _LEVELS) - 1)
    steps = np.where(finite[:, None], steps, 0).astype(np.uint32)
    along = _spread(steps[:, 0]) | _spread(steps[:, 1]) << 1 | _spread(steps[:, 2]) << 2
    return _in_cells(np.argsort(along, kind="stable").astype(np.int32), means)


def _in_cells(ids: np.ndarray, means: np.ndarray) -> Order:
    for first in range(0, len(ids), CELL):
        ids[first : first + CELL].sort()  # colours are read in the scene's own order
    rows, starts = means[ids], np.arange(0, len(ids), CELL)
    bounds = (f.reduceat(rows, starts, axis=0).astype(np.float64) for f in (np.minimum, np.maximum))
    return Order(ids, rows, *bounds, Known())


def _spread(bits: np.ndarray) -> np.ndarray:
    """The lowest ten bits, two zeros after each."""
    bits = (bits | bits << 16) & np.uint32(0x030000FF)
    bits = (bits | bits << 8) & np.uint32(0x0300F00F)
    bits = (bits | bits << 4) & np.uint32(0x030C30C3)
    return (bits | bits << 2) & np.uint32(0x09249249)


# ---- What a view leaves out ----------------------------------------------------------------------


def cut_in_fog(
    settings: RasterSettings, fog: Fog | None, clip: HeightClip | None, buffers: frozenset[str]
) -> RasterSettings:
    """The settings, whose fog_cut counts where a whole picture alone is wanted."""
    is_hidden = fog is not None and fog.sigma_per_m > 0
    if is_hidden and clip is None and buffers <= {RGB, ALPHA}:
        return settings
    return replace(settings, fog_cut=0.0)


def may_be_drawn(
    bounds: Bounds,
    pose: np.ndarray | None,
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None,
) -> np.ndarray:
    """bool [B]: boxes in which a splat may be drawn. pose: world_from_part; None: the identity."""
    seen = may_show(bounds, pose, camera, settings.near_m)
    if clip is not None:
        low, high = (z - clip.z_m for z in _heights(bounds, pose, np.array(clip.up)))
        near, far = (low, high) if clip.sign > 0 else (-high, -low)
        seen &= ~((far < 0) | (near > clip.reach_m))
    if fog is not None and settings.fog_cut > 0:
        depths = _least_optical_depth(bounds, pose, camera, fog)
        seen &= ~(depths > -math.log(settings.fog_cut))
    return seen


def _heights(
    bounds: Bounds, pose: np.ndarray | None, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The least and largest up . x, world, of all that splats of each box reach."""
    shift = 0.0
    if pose is not None:
        up, shift = up @ pose[:3, :3], float(up @ pose[:3, 3])
    middle = bounds.centres @ up + shift
    extent = bounds.halves @ np.abs(up) + MAX_EXTENT_SIGMAS * bounds.longest
    extent += _ROUNDING * (np.abs(middle) + extent)
    return middle - extent, middle + extent


def _least_optical_depth(
    bounds: Bounds, pose: np.ndarray | None, camera: Camera, fog: Fog
) -> np.ndarray:
    """At most that of the fog before any splat of each box; where it thins with height, at most
    that before any place where a ray that meets one leaves the splats.
    """
    eye = camera.centre.numpy()
    if pose is not None:
        eye = np.linalg.solve(pose[:3, :3], eye - pose[:3, 3])
    layered, halves = fog.scale_height_m is not None, bounds.halves
    if layered:  # the sky is seen where splats are left out: their rays must not climb out
        halves = halves + (MAX_EXTENT_SIGMAS * bounds.longest)[:, None]
    beside = np.maximum(np.abs(eye - bounds.centres) - halves, 0)
    distance = np.linalg.norm(beside, axis=1) * (1 - _ROUNDING)
    if not layered:
        return fog.sigma_per_m * distance
    blur = _BLUR_PX * distance / min(camera.fx, camera.fy)
    highest = _heights(bounds, pose, np.array([0.0, 0.0, 1.0]))[1] + blur
    return optical_depth_of_arrays(fog, distance, float(camera.centre[2]), highest)


def _blocks_of(seen: np.ndarray, count: int) -> np.ndarray:
    """The seen cells in as few blocks as there are, each without unseen ones at its ends."""
    cells = np.zeros((-(-len(seen) // _CELLS), _CELLS), bool)
    cells.reshape(-1)[: len(seen)] = seen
    blocks = np.flatnonzero(cells.any(1))
    first = blocks * _CELLS + cells[blocks].argmax(1)
    last = (blocks + 1) * _CELLS - cells[blocks][:, ::-1].argmax(1)
    return np.stack([first * CELL, np.minimum(last * CELL, count)], 1)
