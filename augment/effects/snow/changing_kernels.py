"""Numba kernels of snow whose depth changes from image to image.

`changing_snow` launches them, and defines the share and depth of a cell in NumPy. C counts cells, S
Gaussians of the layer as it was laid, V those that a view may show, B Gaussians that snow can bury.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from augment.effects.snow.layer_kernels import MIN_DEPTH_M
from augment.effects.snow.traffic import SATURATION
from augment.render.cpu.jit import kernel, kernel_function, serial_kernel
from augment.render.sh import SH_C0

# ---- Constants of the share and depth; all are judgement -----------------------------------------

RIM = 0.5  # rise of that noise over which the layer gets its depth
TRANSLUCENT_DEPTH_M = 0.0015  # depth of snow that hides all but 1/e of what it lies on
OVERLAP = 0.35  # 1 over the number of discs that cover a place
BARE_BAND = 0.5  # change of the passes, in those that bare the road, over which snow goes
MAX_TABLE_DEPTH_M = 0.05  # depth of the snow at the end of tables; deeper snow looks like it
TABLES_PER_M = 1 / MAX_TABLE_DEPTH_M  # its reciprocal
TABLE_SIZE = 1025  # number of values of a table
# Mean shares of snow between which the scene's Gaussians beneath it fade.
FADE_BEGIN = 0.15
FADE_END = 0.85


class ChangingCells(NamedTuple):
    """Numbers of C cells that do not change, float32."""

    noise: np.ndarray
    """Noise of about unit deviation: cells with more of it get snow earlier."""
    depths_m: np.ndarray
    """Depth of the layer as it was laid, metres; 0 where no snow ever lies."""
    road: np.ndarray
    """Share of the cell that is road, 0 to 1."""
    soft: np.ndarray
    """Share of the cell that is grass, 0 to 1."""
    passes: np.ndarray
    """Number of wheels that pass, of all cars of the traffic."""
    baring: np.ndarray
    """Factor of the number of passes that bare the road."""
    ridge: np.ndarray
    """Height of the slush that wheels push here, over that of a straight edge."""


class SnowState(NamedTuple):
    """Numbers of a moment."""

    hard_threshold: float
    """Noise from which on snow lies on roofs, pavements and all else but grass and roads."""
    soft_threshold: float
    """Noise from which on it lies on grass."""
    road_threshold: float
    """Noise from which on it lies on roads."""
    band: float
    """Rise of a cell's noise from its first snow to its full share."""
    road_band: float
    """The same on roads."""
    onset: float
    """Factor of all shares: below 1 only for the first flakes."""
    road_onset: float
    """The same on roads."""
    scale: float
    """Depth over the depth as laid."""
    road_scale: float
    """The same on roads."""
    driven: float
    """Share of the traffic's cars that have driven."""
    scraped: float
    """Share of the depth that traffic takes on all of the road."""
    pressed_share: float
    """Share of the depth that wheels take."""
    baring_passes: float
    """Passes that bare the road of the thinnest snow."""
    baring_passes_per_m: float
    """Further passes per metre of snow."""
    ridge_share: float
    """Largest height of a ridge over the depth."""
    max_ridge_m: float
    """Largest height of a ridge, metres."""


class SnowTables(NamedTuple):
    """Tables of functions that cost much, read with linear interpolation."""

    opacity: np.ndarray
    """float32, opacity of a disc, by the share that is covered from 0 to 1."""
    translucency: np.ndarray
    """float32, share of light that snow hides, by its depth from 0 to MAX_TABLE_DEPTH_M."""
    brightness: np.ndarray
    """float32, brightness of snow over that of deep snow, by the same depth."""


class LaidSplats(NamedTuple):
    """Gaussians of a layer as it was laid, in the colours of deep snow, or at a moment."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    normals: np.ndarray  # [S, 3], or empty
    slopes: np.ndarray  # [S, 3], or empty


@kernel_function()
def _smooth(t):
    """Return a cubic from (0, 0) to (1, 1) that is level at both, constant beyond."""
    t = min(max(t, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@kernel_function()
def _look_up(table, t):
    """Return the value of a table at t, 0 to 1."""
    place = min(max(t, 0.0), 1.0) * (TABLE_SIZE - 1)
    k = min(np.int64(place), TABLE_SIZE - 2)
    return table[k] + (place - k) * (table[k + 1] - table[k])


# Arrays of a record are read into variables before a loop, and numbers are handed on: numba counts
# references to each array of a record that it hands on, which takes ten times as long.


@kernel_function()
def _cell_snow(noise, laid_m, road, soft, passes, factor, ridge, state, translucency):
    """Return the share of a cell that snow covers, and its depth, as `define_snow` defines it.

    Args:
        noise: the cell's number in `ChangingCells`, and so on up to `ridge`.
        laid_m: its `depths_m`.
        road: its `road`.
        soft: its `soft`.
        passes: its `passes`.
        factor: its `baring`.
        ridge: its `ridge`.
        state: the moment.
        translucency: the table of that name.
    """
    if laid_m == 0.0:
        return 0.0, 0.0
    threshold = (
        state.hard_threshold
        + soft * (state.soft_threshold - state.hard_threshold)
        + road * (state.road_threshold - state.hard_threshold)
    )
    over = noise - threshold
    share = _smooth(0.5 + over / (state.band + road * (state.road_band - state.band)))
    share *= state.onset + road * (state.road_onset - state.onset)
    if share <= 0.0:
        return 0.0, 0.0
    depth_m = laid_m * (state.scale + road * (state.road_scale - state.scale))
    rim = min(max(0.5 + over / RIM, 0.0), 1.0)
    depth_m = MIN_DEPTH_M + max(depth_m - MIN_DEPTH_M, 0.0) * rim
    passes = passes * state.driven
    if passes > 0.0:
        fresh_m = depth_m
        pressed = 1.0 - math.exp(-passes / SATURATION)
        depth_m *= (1.0 - road * state.scraped) * (1.0 - state.pressed_share * pressed)
        ridge_m = min(state.ridge_share * fresh_m, state.max_ridge_m)
        depth_m += ridge_m * state.driven * ridge
        baring = (state.baring_passes + state.baring_passes_per_m * fresh_m) * factor
        share *= 1.0 - _smooth(0.5 + (passes / baring - 1.0) / BARE_BAND)
    return share * _look_up(translucency, depth_m * TABLES_PER_M), depth_m


@kernel
def scale_splats(runs, laid, floors, cell_ids, cells, state, tables, shares, scaled):
    """Write the Gaussians of runs of the laid layer as they are at a moment.

    Args:
        runs: int64 [R, 3], first row, last row + 1, and the first row in `scaled`.
        laid: the layer as it was laid.
        floors: float32 [S], z of the surface under each Gaussian.
        cell_ids: int32 [S], cell of each Gaussian.
        cells: the cells.
        state: the moment.
        tables: the tables.
        shares: float32 [C], share that is covered of each cell that has one; written.
        scaled: Gaussians at the moment, [V]; written.
    """
    for r in prange(len(runs)):
        _scale_run(runs[r], laid, floors, cell_ids, cells, state, tables, shares, scaled)


@serial_kernel
def scale_few_splats(run, laid, floors, cell_ids, cells, state, tables, shares, scaled):
    """Write the Gaussians of one run, int64 [3], as `scale_splats` does, without other threads."""
    _scale_run(run, laid, floors, cell_ids, cells, state, tables, shares, scaled)


@kernel_function()
def _scale_run(run, laid, floors, cell_ids, cells, state, tables, shares, scaled):
    """Write the Gaussians of one run."""
    last_cell = -1
    opacity = np.float32(0)
    ratio = np.float32(0)
    tone = np.float32(1)
    shift = np.float32(0)
    thickness = np.float32(1)
    grey = np.float32(0.5 / SH_C0)
    noise = cells.noise
    depths_m = cells.depths_m
    road = cells.road
    soft = cells.soft
    passes = cells.passes
    baring = cells.baring
    ridge = cells.ridge
    has_cars = state.driven > 0.0  # the three tables above need not be read without any
    translucency = tables.translucency
    opacities = tables.opacity
    tones = tables.brightness
    means = laid.means
    quats = laid.quats
    scales = laid.scales
    sh = laid.sh
    slopes = laid.slopes
    normals = laid.normals
    new_means = scaled.means
    new_quats = scaled.quats
    new_scales = scaled.scales
    new_opacities = scaled.opacities
    new_sh = scaled.sh
    new_slopes = scaled.slopes
    new_normals = scaled.normals
    for s in range(run[0], run[1]):
        v = run[2] + s - run[0]
        i = cell_ids[s]
        if i != last_cell:
            last_cell = i
            share, depth_m = _cell_snow(
                np.float64(noise[i]),
                np.float64(depths_m[i]),
                np.float64(road[i]),
                np.float64(soft[i]),
                np.float64(passes[i]) if has_cars else 0.0,
                np.float64(baring[i]) if has_cars else 1.0,
                np.float64(ridge[i]) if has_cars else 0.0,
                state,
                translucency,
            )
            shares[i] = np.float32(share)
            ratio = np.float32(depth_m / max(np.float64(depths_m[i]), 1e-6))
            thickness = min(np.float32(0.4) + np.float32(0.6) * ratio, np.float32(1))
            opacity = np.float32(_look_up(opacities, share))
            tone = np.float32(_look_up(tones, depth_m * TABLES_PER_M))
            shift = (tone - np.float32(1)) * grey
        new_opacities[v] = opacity
        new_means[v, 0] = means[s, 0]
        new_means[v, 1] = means[s, 1]
        new_means[v, 2] = floors[s] + ratio * (means[s, 2] - floors[s])
        for k in range(4):
            new_quats[v, k] = quats[s, k]
        new_scales[v, 0] = scales[s, 0]
        new_scales[v, 1] = scales[s, 1]
        new_scales[v, 2] = thickness * scales[s, 2]
        for c in range(3):
            new_sh[v, 0, c] = tone * sh[s, 0, c] + shift
        if len(slopes) > 0:
            for c in range(3):
                new_slopes[v, c] = tone * slopes[s, c]
        if len(normals) > 0:
            for c in range(3):
                new_normals[v, c] = normals[s, c]


@kernel
def fade_buried(
    runs, hideable_ids, covering_cells, cells, state, tables, shares, laid_opacities, opacities
):
    """Fade the Gaussians that snow buries by the mean share of it over them, in place.

    Gaussians are often larger than cells: one bare cell must not keep them whole, or they hide the
    snow on all cells behind their centres.

    Args:
        runs: int64 [R, 2], first row and last row + 1 of `hideable_ids`.
        hideable_ids: int32 [B], numbers of the Gaussians.
        covering_cells: int32 [B, 5], cells over each.
        cells: the cells.
        state: the moment.
        tables: the tables.
        shares: float32 [C], share that is covered of each cell; below 0 it is computed here.
        laid_opacities: float32 [N], opacities without snow.
        opacities: float32 [N]; written.
    """
    for r in prange(len(runs)):
        _fade_run(
            runs[r],
            hideable_ids,
            covering_cells,
            cells,
            state,
            tables,
            shares,
            laid_opacities,
            opacities,
        )


@serial_kernel
def fade_few_buried(
    run, hideable_ids, covering_cells, cells, state, tables, shares, laid_opacities, opacities
):
    """Fade the Gaussians of one run, int64 [2], as `fade_buried` does, without other threads."""
    _fade_run(
        run, hideable_ids, covering_cells, cells, state, tables, shares, laid_opacities, opacities
    )


@kernel_function()
def _fade_run(
    run, hideable_ids, covering_cells, cells, state, tables, shares, laid_opacities, opacities
):
    """Fade the Gaussians of one run."""
    noise = cells.noise
    depths_m = cells.depths_m
    road = cells.road
    soft = cells.soft
    passes = cells.passes
    baring = cells.baring
    ridge = cells.ridge
    translucency = tables.translucency
    num_cells = covering_cells.shape[1]
    for b in range(run[0], run[1]):
        total = 0.0
        for k in range(num_cells):
            cell_id = covering_cells[b, k]
            if cell_id < 0:
                total = 0.0
                break
            share = shares[cell_id]
            if share < 0:
                exact_share, _ = _cell_snow(
                    np.float64(noise[cell_id]),
                    np.float64(depths_m[cell_id]),
                    np.float64(road[cell_id]),
                    np.float64(soft[cell_id]),
                    np.float64(passes[cell_id]),
                    np.float64(baring[cell_id]),
                    np.float64(ridge[cell_id]),
                    state,
                    translucency,
                )
                share = np.float32(exact_share)
            total += share
        mean = total / num_cells
        if mean > FADE_BEGIN:
            n = hideable_ids[b]
            fade = _smooth((mean - FADE_BEGIN) / (FADE_END - FADE_BEGIN))
            opacities[n] = np.float32(laid_opacities[n] * (1.0 - fade))


@kernel
def find_cell_depths(cells, state, tables, depths_m):
    """Compute the depth on all cells whose snow hides half of what it lies on; 0 elsewhere."""
    noise = cells.noise
    laid_depths_m = cells.depths_m
    road = cells.road
    soft = cells.soft
    passes = cells.passes
    baring = cells.baring
    ridge = cells.ridge
    translucency = tables.translucency
    for i in prange(len(depths_m)):
        share, depth_m = _cell_snow(
            np.float64(noise[i]),
            np.float64(laid_depths_m[i]),
            np.float64(road[i]),
            np.float64(soft[i]),
            np.float64(passes[i]),
            np.float64(baring[i]),
            np.float64(ridge[i]),
            state,
            translucency,
        )
        depths_m[i] = np.float32(depth_m if share >= 0.5 else 0.0)
