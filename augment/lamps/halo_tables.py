"""Lamps whose light in the air a camera sees, and the tables of that light.

`augment.lamps.air_light` gives the equations and the symbols. A table has the light of one lamp at
some angles between ray and lamp, in planes through the lamp and the camera, up to some distances.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from augment.lamps import halo_table_kernels
from augment.lamps.air_light_kernels import COARSE_END, CORE_END, SOFT_STEPS
from augment.lamps.fog_phase import AirExtinction, Lobes, scatter_table, scattered_beyond
from augment.lamps.halo_table_kernels import (
    FIRST_NODE,
    FLUX_START,
    INTERVALS,
    MAX_FACTOR_ANGLE_RAD,
    NODES_PER_W,
    NUM_NODES,
    PLANES,
    REACH_NODES,
    REACH_START,
    SAMPLES,
    SCATTER,
    SLICE_START,
    W_END,
    HaloLamps,
)
from augment.lamps.lamp import EGO_OWNER, MIN_WIDE_SPREAD_DEG, Lamps
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Constant c of the factor for multiple scattering.
SCATTER_GAIN = 0.19
# Spread of a beam, degrees, at which c is half as large.
HALF_GAIN_SPREAD_DEG = 8.0
# What c gains for a narrow beam that passes by the camera.
PASSING_GAIN = 0.18
# Angle off the axis, in spreads of the beam, at which most of that is gained.
PASSING_SPREADS = 2.5
# Largest optical distance in the factor; beyond it the factor was not compared with anything.
MAX_FACTOR_DEPTH = 4.0
# Largest angle in the factor, degrees; beyond it the factor gives too much light.
MAX_FACTOR_ANGLE_DEG = math.degrees(MAX_FACTOR_ANGLE_RAD)
# Nearest distance of a lamp from the camera, metres; nearer ones would be inside the lens.
MIN_DISTANCE_M = 0.05
# Largest number of points of the recipe's sum.
MAX_POINTS = 16
# Spread of a beam, degrees, below which its planes are fine.
FINE_SPREAD_DEG = 25.0
# Planes, and samples in half a turn, of such a beam of the recording car, along which its camera
# looks.
OWN_PLANES = (192, 384)
# Planes, and samples in half a turn, of another such beam.
FINE_PLANES = (96, 128)
# Planes, and samples in half a turn, of other lamps.
WIDE_PLANES = (64, 64)
# Intervals of the table to a point of the recipe's sum.
INTERVALS_PER_POINT = 4
# Numbers of the tables that are held at a time: 64 MB.
MAX_TABLE_NUMBERS = 1 << 24
# Points along each side of an image at which its angles to a lamp are taken.
_NUM_SIDE_POINTS = 24
# Largest angle between coarse nodes, radians: 1 degree.
MAX_COARSE_RAD = 0.0167
# The same for lamps of the recording car, radians: its camera looks along their beams' edges.
MAX_OWN_COARSE_RAD = 0.0075
# Largest number of nodes between coarse ones.
MAX_COARSE_STEPS = 8
# Number of distances to which coarse nodes hold the light along their rays, and the sky's.
_NUM_SLICES = 23
# Ratio of neighbouring distances.
_SLICE_RATIO = 1.25
# Nearest of these distances, metres.
_FIRST_SLICE_M = 1.5
# Inverse of these distances, falling, 1/m.
SLICES_PER_M = np.append(
    _SLICE_RATIO ** -np.arange(_NUM_SLICES, dtype=np.float64) / _FIRST_SLICE_M, 0.0
)
# Angles at which a lamp's bound is compared with the threshold.
_NUM_BOUND_ANGLES = 512


def factor_gain(
    spreads_deg: Float[np.ndarray, "*N"], off_axis_deg: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N"]:
    """Return c of the factor for multiple scattering.

    Args:
        spreads_deg: standard deviations s of the beams about their middles, degrees.
        off_axis_deg: angles alpha between the beams' axes and the directions to the camera.
    """
    spreads = np.minimum(np.asarray(spreads_deg, np.float64), MIN_WIDE_SPREAD_DEG)
    on_axis = SCATTER_GAIN * spreads / (spreads + HALF_GAIN_SPREAD_DEG)
    passing = SCATTER_GAIN + PASSING_GAIN * (1 - spreads / MIN_WIDE_SPREAD_DEG)
    share = 1 - np.exp(-0.5 * (np.asarray(off_axis_deg) / (PASSING_SPREADS * spreads)) ** 2)
    gain = on_axis + (passing - on_axis) * share
    return np.where(spreads >= MIN_WIDE_SPREAD_DEG, SCATTER_GAIN, gain)


def scatter_factor(
    gain: float, optical_distance: float, gamma_rad: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N"]:
    """Return the light of all orders over the light that is scattered once.

    Args:
        gain: c, see `factor_gain`.
        optical_distance: T = sigma D of the lamp.
        gamma_rad: angles at the camera between rays and lamp, radians.
    """
    angle_deg = np.minimum(np.degrees(gamma_rad), MAX_FACTOR_ANGLE_DEG)
    return np.exp(gain * min(optical_distance, MAX_FACTOR_DEPTH) * np.sqrt(angle_deg))


@dataclass(frozen=True, eq=False)
class Halos:
    """Lamps that add light to a picture."""

    lamps: HaloLamps
    """Numbers of the lamps; their tables have no place yet."""
    scatter: Float32[np.ndarray, "P U T"]
    """Tables of G: of other lamps, and of lamps of the recording car."""
    flux: Float32[np.ndarray, "N"]
    """Integrals of the lamps' intensities over the angle at the lamp."""


@dataclass(frozen=True, eq=False)
class HaloTables:
    """Tables of some lamps, which have one grid of coarse nodes."""

    lamps: HaloLamps
    """Numbers of the lamps."""
    num_steps: int
    """Number of nodes between coarse ones."""
    slice_table: Float32[np.ndarray, "S"]
    """Luminance times h, up to slices of distance."""
    reach_table: Float32[np.ndarray, "R"]
    """The same about the lamps, by the angle at the lamp."""
    coarse_windows: Int64[np.ndarray, "M 4"]
    """Nodes that lack light of the coarse ones."""
    windows: Int64[np.ndarray, "M 4"]
    """Nodes about the pixels that lack light of the nodes."""


def find_halos(
    lamps: Lamps,
    camera: Camera,
    air: AirExtinction,
    num_points: int,
    threshold_cd_m2: float,
    visible_shares: Float64[np.ndarray, "M"] | None,
) -> Halos | None:
    """Return the lamps that can add the threshold to a pixel, or None if there are none.

    Arguments are those of `augment.lamps.air_light.air_light`.
    """
    shares = np.ones(len(lamps)) if visible_shares is None else visible_shares
    centre = camera.centre.numpy()
    offsets = lamps.positions_m - centre
    distances = np.linalg.norm(offsets, axis=1)
    sigmas = air.mean_extinction_per_m(np.broadcast_to(centre, offsets.shape), lamps.positions_m)
    fog_sigmas = sigmas - air.scattering_precipitation_per_m
    peaks = lamps.peak_intensities_cd * shares
    can_light = (distances >= MIN_DISTANCE_M) & (sigmas > 0) & (peaks > 0)
    if not can_light.any():
        return None
    fog_sigma = float(fog_sigmas[can_light].mean())
    lobes = tuple(air.lobes(fog_sigma, is_own=is_own) for is_own in (False, True))
    is_own = lamps.owners == EGO_OWNER
    means = lamps.mean_intensities_cd * shares
    bound_gains = _bound_gains(lobes[0], lobes[1], is_own, sigmas, distances)
    can_light &= _cut_off(np.maximum(peaks, means), bound_gains, threshold_cd_m2) > 0
    rows = np.flatnonzero(can_light)
    if len(rows) == 0:
        return None
    lamps = lamps.select(rows)
    frames = _frames(offsets[rows] / distances[rows, None])
    layouts = _layouts(lamps, num_points)
    sizes = (layouts[:, INTERVALS] + 1) * layouts[:, PLANES]
    layouts[:, FLUX_START] = np.cumsum(sizes) - sizes
    flux = np.empty(int(sizes.sum()), np.float32)
    peaks_of_planes = np.empty(len(rows))
    tables = lamps.tables.view()
    tables.setflags(write=False)  # one type for the compiled kernel
    axes = np.stack([lamps.axes, np.cross(lamps.axes, lamps.ups), lamps.ups], 1)
    with kernel_threads():
        halo_table_kernels.fill_flux(
            np.ascontiguousarray(tables), lamps.patterns,
            (frames @ axes.transpose(0, 2, 1)).astype(np.float32),
            lamps.intensities_cd * shares[rows], layouts, flux, peaks_of_planes,
        )  # fmt: skip
    # A lamp that shines away from all that the camera sees has no peak in its planes.
    ends = _cut_off(np.maximum(peaks_of_planes, means[rows]), bound_gains[rows], threshold_cd_m2)
    depth = np.minimum(sigmas[rows] * distances[rows], MAX_FACTOR_DEPTH)
    off_axis_deg = np.degrees(np.arccos(np.clip(-(lamps.axes * frames[:, 0]).sum(1), -1, 1)))
    gains = factor_gain(lamps.spreads_deg, off_axis_deg)
    rotation = camera.camera_from_world[:3, :3].numpy()
    camera_frames = np.ascontiguousarray(frames @ rotation.T)
    nearest, furthest = _angles_of_view(camera_frames[:, 0], camera)
    # A node more than is needed at either side, since angles of the view are sampled.
    first = np.floor(NODES_PER_W * _node_scale(nearest)).astype(np.int64)
    last = np.ceil(NODES_PER_W * _node_scale(np.minimum(furthest, ends))).astype(np.int64)
    layouts[:, FIRST_NODE] = first
    layouts[:, NUM_NODES] = np.maximum(last - first, 1) + 1
    is_lit = (ends > 0) & (nearest < ends)
    if not is_lit.any():
        return None
    numbers = HaloLamps(
        np.ascontiguousarray(camera_frames[is_lit]),
        distances[rows][is_lit],
        sigmas[rows][is_lit],
        np.ascontiguousarray(lamps.colors[is_lit]),
        means[rows][is_lit],
        np.stack([gains * depth, SCATTER_GAIN * depth], 1)[is_lit],
        np.stack([ends, np.where(ends >= np.pi, -2.0, np.cos(ends))], 1)[is_lit],
        np.ascontiguousarray(layouts[is_lit]),
    )
    scatter = np.stack([scatter_table(lobe) for lobe in lobes])
    return Halos(numbers, scatter, flux)


def fill_halo_tables(halos: Halos, camera: Camera, step_px: int) -> Iterator[HaloTables]:
    """Return the tables of all lamps, some lamps at a time.

    Args:
        halos: the lamps.
        camera: a pinhole camera.
        step_px: pixels between the nodes.
    """
    focal_px = math.sqrt(camera.fx * camera.fy)
    layouts = halos.lamps.layouts
    lengths = len(SLICES_PER_M) + layouts[:, INTERVALS] + 1
    sizes = layouts[:, NUM_NODES] * layouts[:, PLANES] * lengths
    for is_own, coarse_rad in ((False, MAX_COARSE_RAD), (True, MAX_OWN_COARSE_RAD)):
        num_steps = min(max(int(coarse_rad * focal_px / step_px), 1), MAX_COARSE_STEPS)
        rows = np.flatnonzero(layouts[:, SCATTER] == is_own)
        batches = np.cumsum(sizes[rows]) // MAX_TABLE_NUMBERS
        for batch in np.unique(batches):
            lamps = HaloLamps(*(array[rows[batches == batch]] for array in halos.lamps))
            yield _fill_batch(halos, lamps, camera, step_px, num_steps)


def _fill_batch(
    halos: Halos, lamps: HaloLamps, camera: Camera, step_px: int, num_steps: int
) -> HaloTables:
    """Return the tables of some lamps.

    Args:
        halos: all lamps.
        lamps: those of the tables; their layouts are completed in place.
        camera: a pinhole camera.
        step_px: pixels between the nodes.
        num_steps: nodes between coarse ones.
    """
    core_radius_px = math.sqrt(CORE_END) * SOFT_STEPS * step_px
    windows = _lamp_windows(lamps, camera, step_px, core_radius_px)
    reach_px = core_radius_px + 2 * step_px  # pixels at the rim read nodes beyond it
    coarse_windows = np.zeros_like(windows)  # with one step the coarse nodes are the nodes
    if num_steps > 1:
        coarse_radius_px = math.sqrt(COARSE_END) * SOFT_STEPS * num_steps * step_px
        coarse_windows = _lamp_windows(lamps, camera, step_px, coarse_radius_px)
        reach_px = max(reach_px, coarse_radius_px)
    reach_rad = math.asin(min(reach_px / math.sqrt(camera.fx * camera.fy), 1.0))
    layouts = lamps.layouts
    first = layouts[:, FIRST_NODE]
    reach_nodes = math.ceil(NODES_PER_W * math.sqrt(2 * math.sin(reach_rad / 2))) - first + 1
    reach_nodes = np.clip(reach_nodes, 2, layouts[:, NUM_NODES])
    has_window = _is_open(windows) | _is_open(coarse_windows)
    layouts[:, REACH_NODES] = np.where(has_window, reach_nodes, 0)
    slice_sizes = layouts[:, NUM_NODES] * layouts[:, PLANES] * len(SLICES_PER_M)
    layouts[:, SLICE_START] = np.cumsum(slice_sizes) - slice_sizes
    reach_sizes = layouts[:, REACH_NODES] * layouts[:, PLANES] * (layouts[:, INTERVALS] + 1)
    layouts[:, REACH_START] = np.cumsum(reach_sizes) - reach_sizes
    slice_table = np.empty(int(slice_sizes.sum()), np.float32)
    reach_table = np.empty(int(reach_sizes.sum()), np.float32)
    with kernel_threads():
        halo_table_kernels.fill_tables(
            lamps, halos.scatter, SLICES_PER_M, halos.flux, slice_table, reach_table
        )
    return HaloTables(lamps, num_steps, slice_table, reach_table, coarse_windows, windows)


def _is_open(windows: Int64[np.ndarray, "M 4"]) -> Bool[np.ndarray, "M"]:
    """Return True for windows that have nodes."""
    return (windows[:, 1] > windows[:, 0]) & (windows[:, 3] > windows[:, 2])


def _node_scale(gamma_rad: Float[np.ndarray, "*N"]) -> Float64[np.ndarray, "*N"]:
    """Return w of angles between rays and lamps, radians."""
    folded = np.clip(np.minimum(gamma_rad, np.pi - gamma_rad), 0, np.pi / 2)
    w = np.sqrt(2 * np.sin(folded / 2))
    return np.where(gamma_rad > np.pi / 2, W_END - w, w)


def _angles_of_view(
    directions: Float64[np.ndarray, "M 3"], camera: Camera
) -> tuple[Float64[np.ndarray, "M"], Float64[np.ndarray, "M"]]:
    """Return the least and the greatest angle between the rays of an image and each lamp, radians.

    Args:
        directions: unit vectors to the lamps, in camera axes.
        camera: a pinhole camera.
    """
    margin = 0.1  # of the image: coarse nodes lie beyond its border
    shares = np.linspace(-margin, 1 + margin, _NUM_SIDE_POINTS)
    low = np.full(_NUM_SIDE_POINTS, -margin)
    high = np.full(_NUM_SIDE_POINTS, 1 + margin)
    across = np.concatenate([shares, shares, low, high])
    down = np.concatenate([low, high, shares, shares])
    u = (across * camera.width - camera.cx) / camera.fx
    v = (down * camera.height - camera.cy) / camera.fy
    rays = np.stack([u, v, np.ones_like(u)], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angles = np.arccos(np.clip(directions @ rays.T, -1, 1))  # [M, R]
    # Between two points of the border the angle differs by their half distance at most.
    gaps = np.linalg.norm(rays.reshape(4, -1, 3)[:, 1:] - rays.reshape(4, -1, 3)[:, :-1], axis=2)
    slack = 0.6 * float(gaps.max())
    depth = directions[:, 2]
    safe_depth = np.where(np.abs(depth) > 1e-9, depth, 1e-9)
    place = directions[:, :2] / safe_depth[:, None]
    is_inside = (np.abs(place[:, 0] - (u.min() + u.max()) / 2) <= (u.max() - u.min()) / 2) & (
        np.abs(place[:, 1] - (v.min() + v.max()) / 2) <= (v.max() - v.min()) / 2
    )
    nearest = np.where(is_inside & (depth > 0), 0.0, np.maximum(angles.min(1) - slack, 0.0))
    furthest = np.where(is_inside & (depth < 0), np.pi, np.minimum(angles.max(1) + slack, np.pi))
    return nearest, furthest


def _frames(directions: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, "M 3 3"]:
    """Return the unit directions, and two unit vectors at right angles to each."""
    is_steep = np.abs(directions[:, 2]) > 0.9
    helpers = np.where(is_steep[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    sides = np.cross(directions, helpers)
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    return np.stack([directions, sides, np.cross(directions, sides)], 1)


def _layouts(lamps: Lamps, num_points: int) -> Int64[np.ndarray, "M 10"]:
    """Return HaloLamps.layouts without places in the tables."""
    is_flat = np.ptp(lamps.tables, axis=(1, 2))[lamps.patterns] == 0
    is_fine = lamps.spreads_deg < FINE_SPREAD_DEG
    is_own = lamps.owners == EGO_OWNER
    layouts = np.zeros((len(lamps), int(REACH_NODES) + 1), np.int64)
    for column, number in ((PLANES, 0), (SAMPLES, 1)):
        fine_size = np.where(is_own, OWN_PLANES[number], FINE_PLANES[number])
        size = np.where(is_fine, fine_size, WIDE_PLANES[number])
        layouts[:, column] = np.where(is_flat, 1, size)
    layouts[:, SCATTER] = is_own
    points = np.where(is_own & is_fine, min(2 * num_points, MAX_POINTS), num_points)
    layouts[:, INTERVALS] = INTERVALS_PER_POINT * np.where(is_flat, MAX_POINTS, points)
    return layouts


def _bound_gains(
    lobes: Lobes, own_lobes: Lobes, is_own: np.ndarray, sigmas: np.ndarray, distances: np.ndarray
) -> Float64[np.ndarray, "M A"]:
    """Return bounds of a lamp's light per candela, cd/m2, by the angle to the lamp.

    The path over a point of the ray is no shorter than D, and no intensity exceeds its peak.
    """
    gamma = _bound_angles()
    beyond = np.stack([scattered_beyond(lobe, gamma) for lobe in (lobes, own_lobes)])
    depths = sigmas * distances
    factors = np.exp(
        (SCATTER_GAIN + PASSING_GAIN)
        * np.minimum(depths, MAX_FACTOR_DEPTH)[:, None]
        * np.sqrt(np.minimum(np.degrees(gamma), MAX_FACTOR_ANGLE_DEG))
    )
    scale = sigmas * np.exp(-depths) / np.maximum(distances, MIN_DISTANCE_M)
    return scale[:, None] * factors * beyond[is_own.astype(int)] / np.sin(gamma)


def _bound_angles() -> Float64[np.ndarray, "A"]:
    """Return the angles of `_bound_gains`, radians, inside 0 to pi."""
    return (np.arange(_NUM_BOUND_ANGLES) + 0.5) / _NUM_BOUND_ANGLES * np.pi


def _cut_off(
    peaks_cd: np.ndarray, bound_gains: np.ndarray, threshold_cd_m2: float
) -> Float64[np.ndarray, "M"]:
    """Return the angle beyond which each lamp's light stays below the threshold; 0 for all angles,
    pi for none.
    """
    if threshold_cd_m2 == 0:
        return np.where(peaks_cd > 0, np.pi, 0.0)
    is_above = peaks_cd[:, None] * bound_gains >= threshold_cd_m2
    last = _NUM_BOUND_ANGLES - np.argmax(is_above[:, ::-1], axis=1)
    return np.where(is_above.any(1), last / _NUM_BOUND_ANGLES * np.pi, 0.0)


def _lamp_windows(lamps: HaloLamps, camera: Camera, step_px: int, radius_px: float) -> np.ndarray:
    """Return the nodes about each lamp within a radius at the image's centre: int64 [M, 4].

    Args:
        lamps: the lamps.
        camera: the camera.
        step_px: pixels between nodes.
        radius_px: the radius, pixels.
    """
    x, y, z = lamps.frames[:, 0].T
    is_ahead = z > 0.02
    depth = np.where(is_ahead, z, 1.0)
    u = x / depth
    v = y / depth
    # A step is an angle at the image's centre; further out more pixels lie in it.
    radius = radius_px * (1 + u * u + v * v) * 1.05 + 1
    ratio = math.sqrt(camera.fx * camera.fy)
    half_width = radius * camera.fx / ratio
    half_height = radius * camera.fy / ratio
    column = camera.fx * u + camera.cx
    row = camera.fy * v + camera.cy
    last_row = -(-camera.height // step_px) + 1
    last_column = -(-camera.width // step_px) + 1
    begin = np.stack([row - half_height, column - half_width], 1) / step_px
    end = np.stack([row + half_height, column + half_width], 1) / step_px
    sizes = np.array([last_row, last_column])
    first = np.clip(np.floor(begin), 0, sizes)
    stop = np.clip(np.ceil(end) + 1, 0, sizes)
    windows = np.stack([first[:, 0], stop[:, 0], first[:, 1], stop[:, 1]], 1).astype(np.int64)
    windows[~is_ahead] = 0
    return windows
