"""The CPU rasteriser: arrays for the numba kernels, and the order in which they run.

    rank      z and a generous box of every Gaussian                      (cpu_project)
    then slice by slice along z, until no tile is open:
      project   record, tiles and colour of the slice's splats            (cpu_project, cpu_color)
      sort      by z, ties by index
      bin       splats of every open tile, in that order                  (cpu_bin)
      raster    blend them; close the tiles that nothing shines through   (cpu_blend)

Slices change no bit of the image: what they leave out lies behind closed tiles.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.cameras import Camera
from augment.render import cpu_bin, cpu_blend, cpu_project
from augment.render import cpu_layout as layout
from augment.render.buffers import (
    ALPHA,
    BUFFERS,
    MEDIAN_DEPTH,
    RGB,
    SPLAT_IDS,
    RenderOutput,
)
from augment.render.constants import (
    ALPHA_MIN,
    COV2D_BLUR,
    MAX_EXTENT_SIGMAS,
    TAN_FOV_MARGIN,
    TRANSMITTANCE_STOP,
    RasterSettings,
)
from augment.render.cpu_scratch import Scratch, borrowed_scratch
from augment.render.sh import MAX_DEGREE
from augment.render.threads import kernel_threads, thread_count
from augment.scene import Gaussians, PosedGaussians
from augment.weather.smog import SmogMedium

_RANK_RUNS = 8  # pieces of work in ranking, each with its own histogram
# A slice ends where the splats before it would cover every pixel this many times over with opacity
# 1: by then, and each time that doubles, most tiles of a dense scene have closed.
_SLICE_COVER = 10.0
_SLICE_GROWTH = 1.4
_SMALLEST_SLICE = 20_000  # fewer splats cost less than another slice does
_MAX_PAIRS = 1 << 24  # (splat, tile) pairs listed at once: 64 MB


def rasterize_cpu(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
    smog: SmogMedium | None,
    *,
    stage_times: dict[str, float] | None = None,
) -> RenderOutput:
    """The image of the parts in float32, without gradients. Arguments are checked by `rasterize`.

    The same bits on any number of threads, whichever buffers are asked for. stage_times: seconds of
    "project", "sort", "bin" and "raster" and the counts "visible" (splats that touch a tile which
    nearer ones have not closed) and "pairs" (of splats and such tiles) are added to it.
    """
    clock = _Clock(stage_times)
    inputs = _inputs([part.gaussians for part in parts])
    views = np.stack([_view(part, camera, settings, smog) for part in parts])
    modes = _modes(RGB in buffers, settings, smog)
    images = _images(camera, buffers)
    with borrowed_scratch() as scratch, kernel_threads():
        tiles = _Tiles(camera, images, settings, scratch)
        depths, edges = _rank(inputs, views, camera, scratch)
        for bins in itertools.pairwise(edges):
            splats = _project(inputs, views, depths, bins, tiles, modes, scratch)
            clock.lap("project")
            slots, rects = _sort(splats, bins[0], scratch)
            clock.lap("sort")
            clock.count("visible", len(slots))
            tiles.blend(splats.records, slots, rects, is_last=bins[1] == edges[-1], clock=clock)
            if not tiles.open.any():
                break
    return RenderOutput(**{name: torch.from_numpy(image) for name, image in images.items()})


class _Clock:
    """Adds the time between laps, and counts, to the caller's dictionary."""

    def __init__(self, times: dict[str, float] | None) -> None:
        self._times = {} if times is None else times
        for name in ("project", "sort", "bin", "raster", "visible", "pairs"):
            self._times.setdefault(name, 0.0)
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self._times[name] += now - self._last
        self._last = now

    def count(self, name: str, number: int) -> None:
        self._times[name] += number


@dataclass(frozen=True, eq=False)
class _Inputs:
    """The parts as kernels read them; see cpu_project.rank_splats. arrays: kept alive by this."""

    arrays: list[np.ndarray]
    addresses: np.ndarray
    sizes: np.ndarray
    first_ids: np.ndarray
    blocks: np.ndarray

    @property
    def slots(self) -> int:
        return len(self.blocks) * layout.BLOCK


def _inputs(gaussians: list[Gaussians]) -> _Inputs:
    arrays, addresses, sizes, blocks = [], [], [], []
    for part, g in enumerate(gaussians):
        tensors = (g.means, g.quats, g.scales, g.opacities, g.sh)
        own = [t.detach().contiguous().numpy() for t in tensors]
        arrays += own
        addresses.append([array.ctypes.data for array in own])
        sizes.append([len(g), g.sh.shape[1]])
        starts = range(0, len(g), layout.BLOCK)
        blocks += [(part, start, min(start + layout.BLOCK, len(g))) for start in starts]
    counts = [size[0] for size in sizes]
    return _Inputs(
        arrays,
        np.array(addresses, np.uint64).reshape(-1, 5),
        np.array(sizes, np.int64).reshape(-1, 2),
        np.cumsum([0, *counts[:-1]], dtype=np.int64),
        np.array(blocks, np.int64).reshape(-1, 3),
    )


def _view(
    part: PosedGaussians, camera: Camera, settings: RasterSettings, smog: SmogMedium | None
) -> np.ndarray:
    """The numbers of cpu_layout's view, formed in float64."""
    world_from_part = np.eye(4) if part.world_from_part is None else part.world_from_part.numpy()
    camera_from_part = camera.camera_from_world.numpy() @ world_from_part
    rotation = camera_from_part[:3, :3]
    eye = np.linalg.solve(rotation, -camera_from_part[:3, 3])
    coarse_eye = eye.astype(np.float32)
    focal = np.array([camera.fx, camera.fy])
    centre = np.array([camera.cx, camera.cy])
    size = np.array([camera.width, camera.height], np.float64)
    margin = TAN_FOV_MARGIN * 0.5 * size / focal
    low, high = -(centre / focal + margin), (size - centre) / focal + margin
    widest = np.maximum(np.abs(low), np.abs(high))
    view = np.zeros(layout.VIEW)
    view[layout.V_ROTATION :][:9] = rotation.reshape(-1)
    view[layout.V_EYE :][:6] = *coarse_eye, *(eye - coarse_eye)
    view[layout.V_FOCAL :][:2], view[layout.V_CENTRE :][:2] = focal, centre
    view[layout.V_SIZE :][:2] = size
    view[layout.V_LOW :][:2], view[layout.V_HIGH :][:2] = low, high
    view[layout.V_GAIN :][:2] = MAX_EXTENT_SIGMAS * focal * np.sqrt(1 + widest**2)
    view[layout.V_NEAR], view[layout.V_BLUR] = settings.near_m, COV2D_BLUR
    view[layout.V_ALPHA_MIN], view[layout.V_LOG_CUT] = ALPHA_MIN, math.log2(ALPHA_MIN)
    if smog is not None:
        view[layout.V_SIGMA] = smog.sigma_per_m
        view[layout.V_AIRLIGHT :][:3] = smog.rgb
        if smog.scale_height_m is not None:
            above = float(camera.centre[2]) - smog.base_z_m
            view[layout.V_EYE_HEIGHT] = above / smog.scale_height_m
            view[layout.V_UP :][:3] = world_from_part[2, :3] / smog.scale_height_m
    return view.astype(np.float32)


def _modes(with_color: bool, settings: RasterSettings, smog: SmogMedium | None) -> np.ndarray:
    degree = MAX_DEGREE if settings.sh_degree is None else settings.sh_degree
    modes = np.zeros(layout.MODES, np.int64)
    modes[layout.M_COLOR] = with_color
    modes[layout.M_FUNCTIONS] = (degree + 1) ** 2
    modes[layout.M_ANTIALIASED] = settings.antialiased
    if smog is not None:
        is_uniform = smog.scale_height_m is None
        modes[layout.M_SMOG] = layout.UNIFORM_SMOG if is_uniform else layout.LAYERED_SMOG
    return modes


def _images(camera: Camera, buffers: frozenset[str]) -> dict[str, np.ndarray]:
    size = (camera.height, camera.width)
    shapes = {RGB: (*size, 3)}
    dtypes = {SPLAT_IDS: np.int32}
    return {
        name: np.empty(shapes.get(name, size), dtypes.get(name, np.float32)) for name in buffers
    }


def _rank(
    inputs: _Inputs, views: np.ndarray, camera: Camera, scratch: Scratch
) -> tuple[np.ndarray, list[int]]:
    """z of all Gaussians (0: cannot be seen), and where the slices begin and end, in bins of z."""
    depths = scratch.array("depths", (inputs.slots,), np.float32)
    histograms = scratch.array("histograms", (_RANK_RUNS, 2, layout.BINS), np.float64)
    cpu_project.rank_splats(
        inputs.addresses, inputs.sizes, views, inputs.blocks, depths, histograms
    )
    cover, counts = histograms.sum(0)
    return depths, _slice_edges(cover / (camera.width * camera.height), counts)


def _slice_edges(cover: np.ndarray, counts: np.ndarray) -> list[int]:
    """First bin of every slice, and the end of the last. cover, counts: of each bin of z."""
    filled = np.flatnonzero(counts)
    if len(filled) == 0:
        return [0, 1]
    edges, end = [int(filled[0])], int(filled[-1]) + 1
    cover, counts = cover.cumsum(), counts.cumsum()
    target, taken = _SLICE_COVER, 0.0
    while target < cover[-1]:
        edge = int(np.searchsorted(cover, target)) + 1
        if counts[-1] - counts[edge - 1] < _SMALLEST_SLICE:
            break
        if counts[edge - 1] - taken >= _SMALLEST_SLICE:
            edges.append(edge)
            taken = counts[edge - 1]
        target *= _SLICE_GROWTH
    return [*edges, end]


@dataclass(frozen=True, eq=False)
class _Splats:
    """What project_slice wrote."""

    records: np.ndarray
    rects: np.ndarray
    keys: np.ndarray
    found: np.ndarray
    counts: np.ndarray


def _project(
    inputs: _Inputs,
    views: np.ndarray,
    depths: np.ndarray,
    bins: tuple[int, int],
    tiles: _Tiles,
    modes: np.ndarray,
    scratch: Scratch,
) -> _Splats:
    blocks = len(inputs.blocks)
    splats = _Splats(
        scratch.array("records", (inputs.slots * layout.RECORD,), np.float32),
        scratch.array("rects", (inputs.slots,), np.uint64),
        scratch.array("keys", (inputs.slots,), np.uint32),
        scratch.array("found", (blocks,), np.int64),
        scratch.array("bin_counts", (blocks, bins[1] - bins[0]), np.int32),
    )
    cpu_project.project_slice(
        inputs.addresses,
        inputs.sizes,
        views,
        inputs.blocks,
        inputs.first_ids,
        depths.view(np.uint32),
        np.array(bins, np.int64),
        tiles.open_sums(),
        modes,
        splats.records,
        splats.rects,
        splats.keys,
        splats.found,
        splats.counts,
    )
    return splats


def _sort(splats: _Splats, first_bin: int, scratch: Scratch) -> tuple[np.ndarray, np.ndarray]:
    """Slots nearest first (ties in index order), and their tiles in that order."""
    heads = scratch.array("bin_heads", splats.counts.shape, np.int64)
    starts = scratch.array("bin_starts", (splats.counts.shape[1] + 1,), np.int64)
    count = int(cpu_bin.place_bins(splats.counts, heads, starts))
    keys, spare_keys = (scratch.array(f"sorted_keys{i}", (count,), np.uint32) for i in range(2))
    slots, spare_slots = (scratch.array(f"sorted_slots{i}", (count,), np.int32) for i in range(2))
    rects = scratch.array("sorted_rects", (count,), np.uint64)
    cpu_bin.scatter_to_bins(splats.keys, splats.found, first_bin, heads, keys, slots)
    cpu_bin.sort_bins(starts, keys, slots, splats.rects, spare_keys, spare_slots, rects)
    return slots, rects


class _Tiles:
    """The image's tiles while it is rendered: which are open, and what they hold."""

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
        self._size = np.array([camera.width, camera.height], np.int64)
        self._limits = np.array(
            [settings.alpha_max, math.log2(ALPHA_MIN), TRANSMITTANCE_STOP], np.float32
        )
        flat = {name: image.reshape(-1) for name, image in images.items()}
        self._images = [flat.get(name) for name in BUFFERS]
        used = cpu_blend.STATE if set(images) - {RGB, ALPHA} else cpu_blend.COLOR_STATE
        self._scratch = scratch
        self._states = scratch.array("states", (count * used,), np.float32)
        self.open = scratch.array("open", (count,), np.uint8)
        self.open[:] = cpu_blend.FRESH

    def open_sums(self) -> np.ndarray:
        """int32 [rows + 1, columns + 1]: open tiles above and to the left."""
        sums = np.zeros((self._rows + 1, self._columns + 1), np.int32)
        is_open = (self.open != cpu_blend.CLOSED).reshape(self._rows, self._columns)
        sums[1:, 1:] = is_open.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
        return sums

    def blend(
        self,
        records: np.ndarray,
        slots: np.ndarray,
        rects: np.ndarray,
        *,
        is_last: bool,
        clock: _Clock,
    ) -> None:
        """Blend splats, nearest first, into the open tiles; close those that end, all if this is_last."""
        first, count = 0, len(slots)
        while True:
            end = int(cpu_bin.next_cut(rects, first, _MAX_PAIRS))
            members, starts = self._list(slots, rects, first, end)
            clock.lap("bin")
            clock.count("pairs", len(members))
            cpu_blend.blend_tiles(
                records,
                members,
                starts,
                self.open,
                self._states,
                is_last and end == count,
                self._size,
                self._limits,
                *self._images,
            )
            clock.lap("raster")
            first = end
            if first == count:
                return

    def _list(
        self, slots: np.ndarray, rects: np.ndarray, first: int, end: int
    ) -> tuple[np.ndarray, np.ndarray]:
        threads = thread_count()
        corners = self._scratch.array(
            "corners", (threads, (self._rows + 1) * (self._columns + 1)), np.int32
        )
        cpu_bin.count_corners(rects, first, end, self._columns, corners)
        heads = self._scratch.array("heads", (self._rows, self._columns), np.int64)
        starts = self._scratch.array("starts", (len(self.open) + 1,), np.int64)
        pairs = int(cpu_bin.place_lists(corners, self.open, heads, starts))
        members = self._scratch.array("members", (pairs,), np.int32)
        cpu_bin.fill_lists(
            slots,
            rects,
            first,
            end,
            self._columns,
            heads.reshape(-1),
            members,
            min(self._rows, 4 * threads),
        )
        return members, starts


def warm_up() -> float:
    """Compile every kernel that colour, alpha and median depth need; seconds it took.

    Later processes read the compiled kernels from numba's cache beside the sources.
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
