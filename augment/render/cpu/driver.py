"""The CPU rasteriser: arrays for the numba kernels, and the order in which the kernels run.

    choose    blocks of Gaussians that the view may see                   (order)
    rank      z and a generous box of their Gaussians                     (project)
    then slice by slice along z, until no tile is open:
      project   record, tiles and colour of the slice's splats            (project)
      sort      by z, ties by index
      bin       splats of every open tile, in that order                  (blend)
      raster    blend them; close the tiles that nothing shines through   (blend)

Slices change no bit of the image: what they leave out lies behind closed tiles. `rasterize` calls
`rasterize_cpu`; `backward` and the trainer use the stages one by one.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from augment.render import layout
from augment.render.buffers import (
    ALPHA,
    BUFFERS,
    MEDIAN_DEPTH,
    MODE_DEPTH,
    OVERLAY,
    RGB,
    SPLAT_IDS,
    RenderOutput,
)
from augment.render.constants import (
    ALPHA_MIN,
    MAX_TRANSMITTANCE_STOP,
    TRANSMITTANCE_STOP,
    RasterSettings,
)
from augment.render.cpu import blend as blend_kernels
from augment.render.cpu import geometry
from augment.render.cpu import project as project_kernels
from augment.render.cpu.order import cut_in_fog, spatial_order
from augment.render.fog import MAX_EXPONENT, Fog, optical_depth_numpy
from augment.render.fog_table import bank_table, thinnest_fog
from augment.render.layout import HeightClip
from augment.render.part_views import raster_modes, views_of
from augment.render.threads import kernel_threads, num_kernel_threads, usable_cores
from augment.scene.cameras import Camera
from augment.scene.geometry import any_in_squares
from augment.scene.scene import Gaussians, PosedGaussians

# ---- Inputs of the CPU kernels: scene parts by address, and the numbers of a view ----------------


@dataclass(frozen=True, eq=False)
class Inputs:
    """All parts for one launch. Nothing is concatenated, and actors cost no launch of their own.

    addresses, sizes, first_ids, views, blocks: see project.Parts.
    modes: see layout.
    array_owners: owners of the memory that the addresses point to.
    orders: see project.Parts; None if every part stands in its own order.
    """

    addresses: np.ndarray
    sizes: np.ndarray
    first_ids: np.ndarray
    views: np.ndarray
    blocks: np.ndarray
    modes: np.ndarray
    array_owners: list[Any]
    orders: np.ndarray | None = None

    @property
    def read(self) -> project_kernels.Parts:
        """Arrays that the kernels read."""
        orders = np.zeros(len(self.sizes), np.uint64) if self.orders is None else self.orders
        return project_kernels.Parts(
            self.addresses, self.sizes, self.first_ids, orders, self.views, self.blocks, self.modes
        )

    @property
    def is_ordered(self) -> bool:
        """True if any part stands in another order than its own."""
        return self.orders is not None and bool(self.orders.any())

    @property
    def num_slots(self) -> int:
        """Number of slots: room for every Gaussian, block by block."""
        return len(self.blocks) * layout.BLOCK_SIZE


def gather_inputs(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None = None,
    *,
    with_color: bool,
    is_culled: bool = False,
) -> Inputs:
    """Return addresses and numbers of all parts. Contiguous tensors are not copied.

    Args:
        parts: Gaussians with their poses.
        camera: the camera.
        settings: thresholds of the image.
        fog: fog before the splats; None for clear air.
        clip: height at which splats are cut; None for no cut.
        with_color: if True, colours are computed.
        is_culled: if True, blocks that the view cannot see are left out.
    """
    kept_alive = list[Any]()
    addresses = []
    orders = []
    blocks = []
    for number, part in enumerate(parts):
        gaussians = part.gaussians
        count = len(part.gaussians)
        order = spatial_order(gaussians) if is_culled and part.rows is None else None
        if order is None:
            rows = np.array([[0, count]]) if part.rows is None else part.rows
            block_rows = (
                _split_into_blocks(rows)
                if count > layout.BLOCK_SIZE or part.rows is not None
                else rows
            )
            geometry_arrays = [
                gaussians.means,
                gaussians.quats,
                gaussians.scales,
                gaussians.opacities,
            ]
        else:
            block_rows = order.visible_blocks(part, camera, settings, fog, clip)
            geometry_arrays = [
                order.means,
                *(
                    order.sorted(t).rows
                    for t in (gaussians.quats, gaussians.scales, gaussians.opacities)
                ),
            ]
            kept_alive.append(order.ids)
        part_arrays = [
            _as_kernel_array(array)
            for array in (*geometry_arrays, gaussians.sh, *_appearance_arrays(part))
        ]
        kept_alive += part_arrays
        addresses.append([_address(array) for array in part_arrays])
        orders.append(0 if order is None else _address(order.ids))
        blocks += [(number, first, last) for first, last in block_rows.tolist()]
    sizes = [(len(part.gaussians), part.gaussians.sh.shape[1]) for part in parts]
    counts = [size[0] for size in sizes]
    modes = raster_modes(settings, fog, clip, with_color=with_color)
    modes[layout.M_LIGHT] = with_color and any(part.shading is not None for part in parts)
    if fog is not None and fog.banks is not None and with_color:
        table = bank_table(fog, camera).numbers
        kept_alive.append(table)
        modes[layout.M_BANKS] = _address(table)
        modes[layout.M_BANKS_COUNT] = table.size
    return Inputs(
        addresses=np.array(addresses, np.uint64).reshape(-1, layout.NUM_ADDRESSES),
        sizes=np.array(sizes, np.int64).reshape(-1, 2),
        first_ids=np.cumsum([0, *counts[:-1]], dtype=np.int64),
        views=views_of(parts, camera, settings, fog, clip),
        blocks=np.array(blocks, np.int64).reshape(-1, 3),
        modes=modes,
        array_owners=kept_alive,
        orders=np.array(orders, np.uint64),
    )


def _split_into_blocks(rows: np.ndarray) -> np.ndarray:
    """Return runs of rows (first, last + 1) in pieces of at most a block, int64 [B, 2]."""
    counts = -(-(rows[:, 1] - rows[:, 0]) // layout.BLOCK_SIZE)
    run = np.repeat(np.arange(len(rows)), counts)
    first = rows[run, 0] + layout.BLOCK_SIZE * (
        np.arange(len(run)) - (counts.cumsum() - counts)[run]
    )
    return np.stack([first, np.minimum(first + layout.BLOCK_SIZE, rows[run, 1])], 1)


_KERNEL_DTYPES = (torch.float32, torch.int16)
_UNREAD_ARRAYS = torch.zeros(1), torch.zeros(1), torch.zeros(1, dtype=torch.int16)


def _appearance_arrays(part: PosedGaussians) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return slopes of light float32 [N, 3], colour maps float32 [C, 3, 4] and their rows int16
    [N].

    An array that the kernels do not read has one number.
    """
    slopes, maps, map_rows = _UNREAD_ARRAYS
    if part.shading is not None:
        slopes = part.shading.slopes
    if part.color_maps is not None:
        maps = part.color_maps
    return slopes, maps, map_rows if part.color_map_rows is None else part.color_map_rows


def _as_kernel_array(array: Any) -> Any:
    """Return the tensor or array as kernels read it: float32 or int16, row after row."""
    if isinstance(array, np.ndarray) or (array.dtype in _KERNEL_DTYPES and array.is_contiguous()):
        return array
    return array.to(torch.float32 if array.is_floating_point() else torch.int16).contiguous()


def _address(array: Any) -> int:
    return array.ctypes.data if isinstance(array, np.ndarray) else array.data_ptr()


# ---- Work space, kept between frames: fresh pages cost as much as the work -----------------------
# Every render takes its own space, so threads that render at once never share one.

# Bytes of a cache line.
_LINE = 64
# Free work spaces. There are rarely more renders at a time. Append and pop are atomic.
_SPACES: deque[Scratch] = deque(maxlen=max(2, usable_cores()))


class Scratch:
    """Named arrays that keep their memory; each grows to the largest requested size."""

    def __init__(self) -> None:
        self._buffers: dict[str, np.ndarray] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
        """Return an array that starts at a cache line; it holds what the last render left in it."""
        count = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        buffer = self._buffers.get(name)
        if buffer is None or buffer.nbytes < count:
            raw = np.empty(count + count // 8 + _LINE, np.uint8)  # some room for the next frame
            start = -raw.ctypes.data % _LINE
            buffer = self._buffers[name] = raw[start:]
        return buffer[:count].view(dtype).reshape(shape)

    @property
    def nbytes(self) -> int:
        return sum(buffer.nbytes for buffer in self._buffers.values())


@contextmanager
def borrowed_scratch() -> Iterator[Scratch]:
    """Lend a work space to one render; it is handed back afterwards."""
    try:
        scratch = _SPACES.pop()
    except IndexError:
        scratch = Scratch()
    try:
        yield scratch
    finally:
        _SPACES.append(scratch)


def free_scratch() -> None:
    """Free all work spaces; the next render allocates its own."""
    _SPACES.clear()


# Pieces of work in ranking, each with its own histogram.
_RANK_RUNS = 8
# Cover at which the first slice ends: the splats before it would cover every pixel this many times
# with opacity 1. By then most tiles of a dense scene have closed.
_SLICE_COVER = 10.0
# Factor by which the cover grows from one slice's end to the next.
_SLICE_GROWTH = 1.4
# Smallest number of splats in a slice: fewer splats cost less than another slice does.
_MIN_SLICE = 20_000
# Dtypes of images that are not float32.
_DTYPES = {SPLAT_IDS: np.int32}
# Largest number of (splat, tile) pairs that are listed at once: 64 MB.
_MAX_PAIRS = 1 << 24


def rasterize_cpu(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None = None,
    pixel_mask: np.ndarray | None = None,
    *,
    stage_times: dict[str, float] | None = None,
) -> RenderOutput:
    """Return the image of the parts in float32, without gradients. `rasterize` checks the
    arguments.

    The bits are the same on any number of threads and for any choice of buffers.

    Args:
        parts: Gaussians with their poses.
        camera: the camera.
        buffers: names of the buffers.
        settings: thresholds of the image.
        fog: fog before the splats; None for clear air.
        clip: height at which splats are cut; None for no cut.
        pixel_mask: bool [H, W]; tiles without a pixel of the mask are left out and hold zeros.
        stage_times: dictionary to which are added the seconds of "project", "sort", "bin" and
            "raster" and the counts "visible" (splats that touch a tile which nearer ones have not
            closed) and "pairs" (of splats and such tiles).
    """
    timer = StageTimer(stage_times)
    settings = cut_in_fog(settings, fog, clip, buffers)
    inputs = gather_inputs(
        parts, camera, settings, fog, clip, with_color=RGB in buffers, is_culled=True
    )
    images = image_arrays(camera, buffers)
    with borrowed_scratch() as scratch, kernel_threads():
        tiles = Tiles(camera, images, settings, scratch)
        if pixel_mask is not None:
            tiles.leave_out(pixel_mask)
        depths, edges = rank(inputs, camera, scratch)
        for bins in itertools.pairwise(edges):
            if fog is not None and settings.fog_cut > 0:
                nearest_m = float(np.uint32(bins[0] << layout.BIN_SHIFT).view(np.float32))
                tiles.stop_at(settings.fog_cut / _max_transmittance(fog, camera, nearest_m))
            splats = project(inputs, depths, bins, tiles, scratch)
            timer.end_stage("project")
            slots, rects = sort(splats, bins[0], scratch, is_ordered=inputs.is_ordered)
            timer.end_stage("sort")
            timer.count("visible", len(slots))
            tiles.blend(splats, slots, rects, is_last=bins[1] == edges[-1], timer=timer)
            if not tiles.status.any():
                break
    return RenderOutput(**{name: torch.from_numpy(image) for name, image in images.items()})


def _max_transmittance(fog: Fog, camera: Camera, distance_m: float) -> float:
    """Return the largest transmittance of the fog from any point at this distance.

    It is the transmittance from straight up.
    """
    eye_z_m = float(camera.centre[2])
    ray_distance = np.array([distance_m])
    fog = thinnest_fog(fog, camera)
    depth = float(optical_depth_numpy(fog, ray_distance, eye_z_m, eye_z_m + ray_distance)[0])
    return math.exp(-min(depth, MAX_EXPONENT))


class StageTimer:
    """Adds the time between the ends of stages, and counts, to the caller's dictionary."""

    def __init__(self, times: dict[str, float] | None) -> None:
        self._times = {} if times is None else times
        for name in ("project", "sort", "bin", "raster", "visible", "pairs"):
            self._times.setdefault(name, 0.0)
        self._last = time.perf_counter()

    def end_stage(self, name: str) -> None:
        now = time.perf_counter()
        self._times[name] = self._times.get(name, 0.0) + now - self._last
        self._last = now

    def count(self, name: str, number: int) -> None:
        self._times[name] += number


def image_arrays(camera: Camera, buffers: frozenset[str]) -> dict[str, np.ndarray]:
    size = (camera.height, camera.width)
    shapes = {RGB: (*size, 3)}
    return {
        name: np.empty(shapes.get(name, size), _DTYPES.get(name, np.float32)) for name in buffers
    }


def rank(inputs: Inputs, camera: Camera, scratch: Scratch) -> tuple[np.ndarray, list[int]]:
    """Return z of all Gaussians and the edges of the slices.

    Returns:
        z [slots], 0 for a Gaussian that cannot be seen, and the bins of z where the slices begin
        and end.
    """
    depths = scratch.array("depths", (inputs.num_slots,), np.float32)
    histograms = scratch.array("histograms", (_RANK_RUNS, 2, layout.BINS), np.float64)
    project_kernels.rank_splats(inputs.read, depths, histograms)
    cover, counts = histograms.sum(0)
    return depths, _slice_edges(cover / (camera.width * camera.height), counts)


def _slice_edges(cover: np.ndarray, counts: np.ndarray) -> list[int]:
    """Return the first bin of every slice, and the end of the last.

    Bin 0 is left out: it holds the Gaussians that cannot be seen.

    Args:
        cover: opacity times area of the splats in each bin of z, relative to the image.
        counts: number of splats in each bin of z.
    """
    filled_bins = np.flatnonzero(counts[1:]) + 1
    if len(filled_bins) == 0:
        return [1, 2]
    edges = [int(filled_bins[0])]
    end = int(filled_bins[-1]) + 1
    cover = cover.cumsum()
    counts = counts.cumsum()
    target = _SLICE_COVER
    num_before = 0.0
    while target < cover[-1]:
        edge = int(np.searchsorted(cover, target)) + 1
        if counts[-1] - counts[edge - 1] < _MIN_SLICE:
            break
        if counts[edge - 1] - num_before >= _MIN_SLICE:
            edges.append(edge)
            num_before = counts[edge - 1]
        target *= _SLICE_GROWTH
    return [*edges, end]


def project(
    inputs: Inputs, depths: np.ndarray, bins: tuple[int, int], tiles: Tiles, scratch: Scratch
) -> project_kernels.Splats:
    """Return the slice's splats. Cuts and lights are empty if no part needs them."""
    blocks = len(inputs.blocks)
    cuts = geometry.CUT * inputs.num_slots if inputs.modes[layout.M_CLIP] else 0
    lights = geometry.SHADING_LINES * inputs.num_slots if inputs.modes[layout.M_LIGHT] else 0
    splats = project_kernels.Splats(
        scratch.array("records", (inputs.num_slots * layout.RECORD,), np.float32),
        scratch.array("rects", (inputs.num_slots,), np.uint64),
        scratch.array("keys", (inputs.num_slots,), np.uint32),
        scratch.array("splat_counts", (blocks,), np.int64),
        scratch.array("bin_counts", (blocks, bins[1] - bins[0]), np.int32),
        scratch.array("cuts", (cuts,), np.float32),
        scratch.array("lights", (lights,), np.float32),
    )
    project_kernels.project_slice(
        inputs.read, depths.view(np.uint32), np.array(bins, np.int64), tiles.open_sums(), splats
    )
    return splats


def sort(
    splats: project_kernels.Splats, first_bin: int, scratch: Scratch, *, is_ordered: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return the slots nearest first (ties in index order), and their tiles in that order.

    is_ordered: if True, some part's slots are in another order than its Gaussians.
    """
    # Bin after bin, and in each of them block after block.
    bin_offsets = np.append(0, splats.bin_counts.sum(0, dtype=np.int64).cumsum())
    heads = bin_offsets[:-1] + splats.bin_counts.cumsum(0, dtype=np.int64) - splats.bin_counts
    count = int(bin_offsets[-1])
    keys, spare_keys = (scratch.array(f"sorted_keys{i}", (count,), np.uint32) for i in range(2))
    slots, spare_slots = (scratch.array(f"sorted_slots{i}", (count,), np.int32) for i in range(2))
    rects = scratch.array("sorted_rects", (count,), np.uint64)
    blend_kernels.scatter_to_bins(splats.keys, splats.splat_counts, first_bin, heads, keys, slots)
    blend_kernels.sort_bins(bin_offsets, keys, slots, splats.rects, spare_keys, spare_slots, rects)
    if is_ordered:
        project_kernels.order_ties(keys, slots, rects, splats.records)
    return slots, rects


class Tiles:
    """The image's tiles during a render: their status and their state."""

    def __init__(
        self,
        camera: Camera,
        images: dict[str, np.ndarray],
        settings: RasterSettings,
        scratch: Scratch,
    ) -> None:
        self._columns = -(-camera.width // layout.TILE_W)
        self._rows = -(-camera.height // layout.TILE_H)
        count = self._columns * self._rows
        size = np.array([camera.width, camera.height], np.int64)
        limits = np.array(
            [
                settings.alpha_max,
                math.log2(ALPHA_MIN),
                min(settings.transmittance_stop, TRANSMITTANCE_STOP),
                camera.is_orthographic,
                settings.mode_depth_floor_m,
                camera.fx**-2,
                camera.fy**-2,
                settings.transmittance_stop,
            ],
            np.float32,
        )
        self.frame = blend_kernels.Frame(size, limits)
        self._stop = settings.transmittance_stop
        # Alpha is always written, so that kernels come in fewer variants.
        alpha_buffer = {ALPHA: scratch.array("alpha", (camera.height, camera.width), np.float32)}
        empty_images = {name: np.empty(0, _DTYPES.get(name, np.float32)) for name in BUFFERS}
        flat_images = {
            name: image.reshape(-1)
            for name, image in (empty_images | alpha_buffer | images).items()
        }
        self._images = blend_kernels.Images(*(flat_images[name] for name in BUFFERS))
        self._buffer_bits = sum(1 << BUFFERS.index(name) for name in {ALPHA, *images})
        state_size = _state_size(images)
        self._scratch = scratch
        self._states = scratch.array("states", (count * state_size,), np.float32)
        self.status = scratch.array("open", (count,), np.uint8)
        self.status[:] = blend_kernels.FRESH

    def leave_out(self, pixel_mask: np.ndarray) -> None:
        """Close the tiles without a pixel of the mask [H, W]; their pixels become 0."""
        has_masked_pixel = any_in_squares(pixel_mask, layout.TILE_W)
        self.status[~has_masked_pixel.reshape(-1)] = blend_kernels.CLOSED
        for image in self._images:
            image.fill(0)

    def stop_at(self, transmittance: float) -> None:
        """Finish pixels at this transmittance, or at the settings' stop if that is greater."""
        stop = min(max(transmittance, self._stop), MAX_TRANSMITTANCE_STOP)
        self.frame.limits[-1] = stop  # see blend.Frame

    def open_sums(self) -> np.ndarray:
        """Return the number of open tiles above and to the left, int32 [rows + 1, columns + 1]."""
        sums = np.zeros((self._rows + 1, self._columns + 1), np.int32)
        is_open = (self.status != blend_kernels.CLOSED).reshape(self._rows, self._columns)
        sums[1:, 1:] = is_open.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
        return sums

    def blend(
        self,
        splats: project_kernels.Splats,
        slots: np.ndarray,
        rects: np.ndarray,
        *,
        is_last: bool,
        timer: StageTimer,
    ) -> None:
        """Blend splats, nearest first, into the open tiles; is_last closes all tiles."""
        first = 0
        count = len(slots)
        while True:
            end, tile_splat_ids, tile_offsets = self.list_tile_splats(slots, rects, first)
            timer.end_stage("bin")
            timer.count("pairs", len(tile_splat_ids))
            self.blend_lists(splats, tile_splat_ids, tile_offsets, is_last=is_last and end == count)
            timer.end_stage("raster")
            first = end
            if first == count or not self.status.any():
                return

    def blend_lists(
        self,
        splats: project_kernels.Splats,
        tile_splat_ids: np.ndarray,
        tile_offsets: np.ndarray,
        *,
        is_last: bool,
    ) -> blend_kernels.TileSplats:
        """Blend every open tile's list, and return the lists; is_last closes all tiles."""
        tile_splats = blend_kernels.TileSplats(
            splats.records, splats.cuts, splats.lights, tile_splat_ids, tile_offsets
        )
        buffer_bits = self._buffer_bits
        buffer_bits |= blend_kernels.CLIP if splats.cuts.size else 0
        buffer_bits |= (
            blend_kernels.LIT_RGB if splats.lights.size and buffer_bits & blend_kernels.RGB else 0
        )
        blend_kernels.blend_tiles(
            tile_splats,
            self.status,
            self._states,
            is_last,
            self.frame,
            self._images,
            None if buffer_bits == blend_kernels.RGB | blend_kernels.ALPHA else buffer_bits,
        )
        return tile_splats

    def list_all(self, slots: np.ndarray, rects: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the lists of all splats, however long, and the position where each begins."""
        _, tile_splat_ids, tile_offsets = self.list_tile_splats(slots, rects, 0, limit=None)
        return tile_splat_ids, tile_offsets

    def list_tile_splats(
        self, slots: np.ndarray, rects: np.ndarray, first: int, limit: int | None = _MAX_PAIRS
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """Return the lists of every open tile's splats, nearest first, from the splat `first` on.

        Returns:
            The splat before which the lists stop, which is not the end if they would exceed
            `limit`; the lists one after the other; and the position where each begins.
        """
        end = len(slots)
        counts = self._count(rects, first, end)
        if limit is not None and counts.sum() > limit:
            end = first + _num_splats_within(rects[first:], limit)
            counts = self._count(rects, first, end)
        tile_offsets = np.append(0, np.cumsum(counts))
        heads = np.where(self.status != blend_kernels.CLOSED, tile_offsets[:-1], -1)
        tile_splat_ids = self._scratch.array("tile_splat_ids", (int(tile_offsets[-1]),), np.int32)
        bands = min(self._rows, 2 * num_kernel_threads())
        blend_kernels.fill_lists(
            slots, rects, first, end, self._columns, heads, tile_splat_ids, bands
        )
        return end, tile_splat_ids, tile_offsets

    def _count(self, rects: np.ndarray, first: int, end: int) -> np.ndarray:
        """Return the number of the splats [first, end) in each tile, int64 [tiles]; 0 if closed."""
        shape = (self._rows + 1, self._columns + 1)
        corners = self._scratch.array(
            "corners", (num_kernel_threads(), shape[0] * shape[1]), np.int32
        )
        blend_kernels.count_corners(rects, first, end, self._columns, corners)
        totals = corners.sum(0, dtype=np.int64).reshape(shape).cumsum(0).cumsum(1)
        return np.where(self.status != blend_kernels.CLOSED, totals[:-1, :-1].reshape(-1), 0)


def _state_size(images: dict[str, np.ndarray]) -> int:
    """Return how many float32 numbers a tile keeps between slices for these images."""
    names = set(images) - {RGB, ALPHA}
    if MODE_DEPTH in names:
        return blend_kernels.STATE
    if names - {OVERLAY}:
        return blend_kernels.MODELESS_STATE
    return blend_kernels.OVERLAY_STATE if names else blend_kernels.COLOR_STATE


def _num_splats_within(rects: np.ndarray, limit: int) -> int:
    """Return how many splats in turn touch at most `limit` tiles; at least one."""
    corners = rects.view(np.uint16).reshape(-1, 4).astype(np.int64)  # as in blend
    tiles = (corners[:, 2] - corners[:, 0] + 1) * (corners[:, 3] - corners[:, 1] + 1)
    return max(1, int(np.searchsorted(tiles.cumsum(), limit, side="right")))


def warm_up() -> float:
    """Compile every kernel that colour, alpha and median depth need, and return the seconds it
    took.

    Later processes read the compiled kernels from the cache folder (see kernel_cache.py).
    """
    start = time.perf_counter()
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), 0.1),
        opacities=torch.tensor([0.5]),
        sh=torch.zeros(1, 1, 3),
    )
    camera = Camera("warm-up", 16, 16, 16.0, 16.0, 8.0, 8.0, torch.eye(4, dtype=torch.float64))
    parts = [PosedGaussians(gaussians)]
    for buffers in ({RGB, ALPHA}, {RGB, ALPHA, MEDIAN_DEPTH}):
        rasterize_cpu(parts, camera, frozenset(buffers), RasterSettings(), None)
    return time.perf_counter() - start
