"""Light of lamps in the air: halos, beams, and the wall of light before the own car in fog.

The camera is at 0, r is the unit direction of a ray, d_s the distance of its surface. A lamp is at
distance D, gamma is the angle at the camera between ray and lamp, delta the angle at the lamp
between the camera and a point of the ray. h = D sin gamma is the lamp's distance from the ray.
Light from the lamp is scattered by theta = gamma + delta. With the equiangular substitution (Kulla
and Fajardo 2012, "Importance sampling techniques for path tracing in participating media") the
light that is scattered once is

    L_1 = sigma exp(-sigma D cos gamma) / h
          integral from 0 to delta_s of I(delta) p(theta) exp(-u tan(theta / 2)) d delta
    delta_s = atan2(d_s sin gamma, D - d_s cos gamma)          u = sigma h

sigma is the mean extinction between camera and lamp, and all of it scatters. The range of delta is
divided into intervals. In each the medium is integrated exactly, by the table of
`augment.lamps.fog_phase`, and the pattern I enters by its mean. Intervals are narrow at both ends
of the range, as the points of Gauss and Legendre are.

Light that is scattered several times is a factor on L_1, fitted to photons followed one by one
(isotropic lamp, endless fog; T = sigma D up to 4, gamma up to 45 degrees):

    L = L_1 exp(c T sqrt(gamma in degrees)),     c = 0.19 for lamps that shine all around

with gamma held at 45 degrees and T at 4. A beam of standard deviation s about its middle has
c = 0.19 s / (s + 8 degrees) if it points at the camera, and up to 0.37 if it passes by: then little
is scattered once towards the camera. From behind a beam has hardly any L_1. So L is at least L_1
and FLOOR_SHARE of what the factor adds to L_1 of a lamp of the beam's mean intensity.

The picture has a grid of nodes, `step_px` apart. A node has the light to the nearest and to the
furthest surface of the pixels that read it. Near a lamp L goes as 1 / gamma: nodes have it
softened, and pixels about the lamp get the difference at full resolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64

from augment.lamps import air_light_kernels
from augment.lamps.air_light_kernels import (
    COARSE_END,
    CORE_END,
    MAX_FACTOR_ANGLE_RAD,
    SOFT_STEPS,
    HaloLamps,
    ImageGrid,
)
from augment.lamps.fog_phase import (
    AirExtinction,
    Lobes,
    phase_function,
    scatter_table,
    scattered_beyond,
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
# Nearest distance of a surface, metres.
MIN_SURFACE_M = 0.05
# Largest number of intervals.
MAX_POINTS = 16
# Spread of a beam, degrees, below which its planes are fine.
FINE_SPREAD_DEG = 25.0
# Rows and cells of the planes of such a beam of the recording car, along which its camera looks.
OWN_PLANES = (192, 128)
# Rows and cells of the planes of another such beam.
FINE_PLANES = (96, 128)
# Rows and cells of the planes of other lamps.
WIDE_PLANES = (64, 64)
# Largest angle between coarse nodes, radians: 1.4 degrees.
MAX_COARSE_RAD = 0.025
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


def equiangular_sum(
    lobes: Lobes,
    sigma_per_m: float,
    distance_m: float,
    gamma_rad: Float[np.ndarray, "N"],
    surface_m: Float[np.ndarray, "N"],
    *,
    num_points: int = 64,
) -> Float64[np.ndarray, "N"]:
    """Return L_1 of an isotropic lamp of 1 cd, cd/m2, by the points of Gauss and Legendre.

    This is the plain definition, for one lamp without a pattern.

    Args:
        lobes: phase function.
        sigma_per_m: extinction, 1/m.
        distance_m: distance D of the lamp, metres.
        gamma_rad: angles at the camera between the rays and the lamp, radians.
        surface_m: distances of the rays' surfaces, metres; inf for none.
        num_points: number of points.
    """
    h = distance_m * np.maximum(np.sin(gamma_rad), 1e-9)
    with np.errstate(divide="ignore"):
        inverse = np.where(np.isinf(surface_m), 0.0, 1.0 / surface_m)
    reach = np.arctan2(np.sin(gamma_rad), distance_m * inverse - np.cos(gamma_rad))
    points, weights = np.polynomial.legendre.leggauss(num_points)
    theta = gamma_rad[:, None] + reach[:, None] * (1 + points) / 2  # [N, P]
    depth = sigma_per_m * h[:, None] * np.tan(np.minimum(theta, np.pi - 1e-12) / 2)
    values = phase_function(lobes, theta) * np.exp(-np.minimum(depth, 700.0))
    total = (values * weights).sum(1) * reach / 2
    return sigma_per_m * np.exp(-sigma_per_m * distance_m * np.cos(gamma_rad)) / h * total


def air_light(
    lamps: Lamps,
    camera: Camera,
    ray_distance_m: Float32[np.ndarray, "H W"],
    air: AirExtinction,
    *,
    num_points: int = 8,
    step_px: int = 4,
    threshold_cd_m2: float = 0.0,
    visible_shares: Float64[np.ndarray, "M"] | None = None,
    picture: Float32[np.ndarray, "H W 3"] | None = None,
) -> Float32[np.ndarray, "H W 3"]:
    """Return the luminance that lamps add to each pixel by the air before its surface.

    Args:
        lamps: the lamps.
        camera: a pinhole camera.
        ray_distance_m: Euclidean distance of each pixel's surface, metres; inf for the sky.
        air: extinction of the air.
        num_points: intervals of the integral, 1 to 16; the recording car's own beams take twice as
            many, up to 16, and lamps without a pattern take one, which is exact.
        step_px: pixels between the nodes.
        threshold_cd_m2: luminance below which a lamp's light may be left out, cd/m2.
        visible_shares: share of each lamp's light that is not hidden, 0 to 1; None for all of it.
        picture: picture to which the light is added, in place; None for a new one.

    Returns:
        Linear sRGB, cd/m2.

    Raises:
        ValueError: an argument is out of its range or has a wrong shape.
    """
    _check_arguments(camera, ray_distance_m, num_points, step_px, threshold_cd_m2)
    light = np.zeros((*ray_distance_m.shape, 3), np.float32) if picture is None else picture
    if air.is_clear or len(lamps) == 0:
        return light
    halos = _prepare(lamps, camera, air, num_points, threshold_cd_m2, visible_shares)
    if halos is None:
        return light
    focal_px = math.sqrt(camera.fx * camera.fy)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, focal_px], np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.float32(1) / np.maximum(ray_distance_m, np.float32(MIN_SURFACE_M))
    inverse = np.ascontiguousarray(np.where(np.isfinite(inverse), inverse, np.float32(0)))
    num_rows = -(-camera.height // step_px) + 1
    num_columns = -(-camera.width // step_px) + 1
    ranges = np.empty((num_rows, num_columns, 2), np.float32)
    nodes = np.zeros((num_rows, num_columns, 6), np.float32)
    core_px = math.sqrt(CORE_END) * SOFT_STEPS * step_px
    windows = _lamp_windows(halos.lamps, camera, step_px, core_px)
    tables = (halos.scatter, halos.planes, _interval_shares())
    with kernel_threads():
        air_light_kernels.find_node_ranges(inverse, step_px, ranges)
        is_own = halos.lamps.tables[:, 3] == 1
        for is_of_group, coarse_rad in ((~is_own, MAX_COARSE_RAD), (is_own, MAX_OWN_COARSE_RAD)):
            if not is_of_group.any():
                continue
            lamps_of_group = HaloLamps(*(array[is_of_group] for array in halos.lamps))
            num_steps = min(max(int(coarse_rad * focal_px / step_px), 1), MAX_COARSE_STEPS)
            coarse_px = num_steps * step_px
            size = (-(-camera.height // coarse_px) + 1, -(-camera.width // coarse_px) + 1)
            volume = np.empty((*size, len(SLICES_PER_M), 3), np.float32)
            radius_px = math.sqrt(COARSE_END) * SOFT_STEPS * coarse_px
            coarse_windows = _lamp_windows(lamps_of_group, camera, step_px, radius_px)
            if num_steps == 1:
                coarse_windows[:] = 0  # the coarse nodes are the nodes
            grid = _image_grid(lens, step_px, num_steps)
            air_light_kernels.light_slices(
                grid, lamps_of_group, *tables, SLICES_PER_M, ranges, volume
            )
            air_light_kernels.light_nodes(
                grid, lamps_of_group, *tables, SLICES_PER_M, volume, coarse_windows, ranges, nodes
            )
        grid = _image_grid(lens, step_px, 1)
        air_light_kernels.spread_nodes(grid, inverse, ranges, nodes, light)
        air_light_kernels.add_cores(grid, halos.lamps, *tables, windows, ranges, inverse, light)
    return light


def _image_grid(lens: np.ndarray, step_px: int, num_steps: int) -> ImageGrid:
    """Return the lens and the grid of nodes as kernels take them."""
    return ImageGrid(lens, np.array([step_px, num_steps], np.int64))


def _check_arguments(
    camera: Camera,
    ray_distance_m: np.ndarray,
    num_points: int,
    step_px: int,
    threshold_cd_m2: float,
) -> None:
    """Raise ValueError unless the arguments of `air_light` fit."""
    if ray_distance_m.shape != (camera.height, camera.width):
        raise ValueError(
            f"ray_distance_m must be [{camera.height}, {camera.width}] (from camera "
            f"{camera.name!r}); got {list(ray_distance_m.shape)}"
        )
    if not 1 <= num_points <= MAX_POINTS:
        raise ValueError(f"num_points must be 1 to {MAX_POINTS}; got {num_points}")
    if step_px < 1:
        raise ValueError(f"step_px must be >= 1; got {step_px}")
    if not (math.isfinite(threshold_cd_m2) and threshold_cd_m2 >= 0):
        raise ValueError(f"threshold_cd_m2 must be finite and >= 0; got {threshold_cd_m2}")


# ---- Lamps as the kernels read them --------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Halos:
    """Lamps that add light to a picture, with their tables."""

    lamps: HaloLamps
    """Numbers of the lamps."""
    scatter: Float32[np.ndarray, "P U T"]
    """Tables of G: of other lamps, and of lamps of the recording car."""
    planes: Float32[np.ndarray, "N"]
    """Integrals of the lamps' intensities over the angle at the lamp."""


def _prepare(
    lamps: Lamps,
    camera: Camera,
    air: AirExtinction,
    num_points: int,
    threshold_cd_m2: float,
    visible_shares: np.ndarray | None,
) -> _Halos | None:
    """Return the lamps that can add the threshold to a pixel, or None if there are none."""
    shares = np.ones(len(lamps)) if visible_shares is None else visible_shares
    centre = camera.centre.numpy()
    offsets = lamps.positions_m - centre
    distances = np.linalg.norm(offsets, axis=1)
    sigmas = air.mean_extinction_per_m(np.broadcast_to(centre, offsets.shape), lamps.positions_m)
    fog_sigmas = sigmas - air.scattering_precipitation_per_m
    peaks = lamps.intensities_cd * lamps.tables.max((1, 2), initial=0.0)[lamps.patterns] * shares
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
    planes = np.empty(int((layouts[:, 1] * (layouts[:, 2] + 1)).sum()), np.float32)
    plane_peaks = np.empty(len(rows))
    intensities = lamps.intensities_cd * shares[rows]
    tables = lamps.tables.view()
    tables.setflags(write=False)  # one type for the compiled kernel
    with kernel_threads():
        air_light_kernels.fill_planes(
            np.ascontiguousarray(tables), lamps.patterns, lamps.axes, lamps.ups, frames,
            intensities, layouts, planes, plane_peaks,
        )  # fmt: skip
    # A lamp that shines away from all that the camera sees has no peak in its planes.
    ends = _cut_off(np.maximum(plane_peaks, means[rows]), bound_gains[rows], threshold_cd_m2)
    depth = np.minimum(sigmas[rows] * distances[rows], MAX_FACTOR_DEPTH)
    off_axis_deg = np.degrees(np.arccos(np.clip(-(lamps.axes * frames[:, 0]).sum(1), -1, 1)))
    gains = factor_gain(lamps.spreads_deg, off_axis_deg)
    rotation = camera.camera_from_world[:3, :3].numpy()
    is_lit = ends > 0
    if not is_lit.any():
        return None
    numbers = HaloLamps(
        np.ascontiguousarray((frames @ rotation.T)[is_lit]),
        distances[rows][is_lit],
        sigmas[rows][is_lit],
        np.ascontiguousarray(lamps.colors[is_lit]),
        means[rows][is_lit],
        np.stack([gains * depth, SCATTER_GAIN * depth], 1)[is_lit],
        np.stack([ends, np.where(ends >= np.pi, -2.0, np.cos(ends))], 1)[is_lit],
        np.ascontiguousarray(layouts[is_lit]),
    )
    return _Halos(numbers, np.stack([scatter_table(lobe) for lobe in lobes]), planes)


def _frames(directions: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, "M 3 3"]:
    """Return the unit directions, and two unit vectors at right angles to each."""
    is_steep = np.abs(directions[:, 2]) > 0.9
    helpers = np.where(is_steep[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    sides = np.cross(directions, helpers)
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    return np.stack([directions, sides, np.cross(directions, sides)], 1)


def _layouts(lamps: Lamps, num_points: int) -> np.ndarray:
    """Return HaloLamps.tables: int64 [M, 5]."""
    is_flat = np.ptp(lamps.tables, axis=(1, 2))[lamps.patterns] == 0
    is_fine = lamps.spreads_deg < FINE_SPREAD_DEG
    layouts = np.zeros((len(lamps), 5), np.int64)
    for column in range(2):
        fine_size = np.where(lamps.owners == EGO_OWNER, OWN_PLANES[column], FINE_PLANES[column])
        size = np.where(is_fine, fine_size, WIDE_PLANES[column])
        layouts[:, 1 + column] = np.where(is_flat, 1, size)
    layouts[:, 3] = lamps.owners == EGO_OWNER
    layouts[:, 4] = np.where(is_flat, 1, num_points)
    # The camera looks along the edges of the recording car's own beams, where bands would show.
    is_own_beam = is_fine & ~is_flat & (lamps.owners == EGO_OWNER)
    layouts[is_own_beam, 4] = min(2 * num_points, MAX_POINTS)
    sizes = layouts[:, 1] * (layouts[:, 2] + 1)
    layouts[:, 0] = np.cumsum(sizes) - sizes
    return layouts


def _interval_shares() -> Float64[np.ndarray, "K K 2"]:
    """Return in row K the shares of the range at which K intervals end, and 1 / their shares."""
    shares = np.ones((MAX_POINTS + 1, MAX_POINTS + 1, 2))
    for count in range(1, MAX_POINTS + 1):
        ends = (1 - np.cos(np.pi * np.arange(count + 1) / count)) / 2
        shares[count, :count, 0] = ends[1:]
        shares[count, :count, 1] = 1 / np.diff(ends)
    return shares


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
