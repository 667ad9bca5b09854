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
`augment.lamps.fog_phase`, and the pattern I enters by its mean. Intervals are narrow towards the
camera. `augment.lamps.halo_tables` has the sum of each lamp at some angles.

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

import numpy as np
from jaxtyping import Float, Float32, Float64

from augment.lamps import air_light_kernels
from augment.lamps.air_light_kernels import ImageGrid
from augment.lamps.fog_phase import AirExtinction, Lobes, phase_function
from augment.lamps.halo_tables import MAX_POINTS, SLICES_PER_M, fill_halo_tables, find_halos
from augment.lamps.lamp import Lamps
from augment.render.composite import unit_depth_coordinates
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Nearest distance of a surface, metres.
MIN_SURFACE_M = 0.05


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
    distance_m: Float32[np.ndarray, "H W"],
    air: AirExtinction,
    *,
    num_points: int = 8,
    step_px: int = 4,
    threshold_cd_m2: float = 0.0,
    visible_shares: Float64[np.ndarray, "M"] | None = None,
    picture: Float32[np.ndarray, "H W 3"] | None = None,
    is_depth: bool = False,
) -> Float32[np.ndarray, "H W 3"]:
    """Return the luminance that lamps add to each pixel by the air before its surface.

    Args:
        lamps: the lamps.
        camera: a pinhole camera.
        distance_m: distance of each pixel's surface along its ray, metres; 0, inf or nan for the
            sky.
        air: extinction of the air.
        num_points: fours of intervals of the integral, 1 to 16; the recording car's own beams take
            twice as many, up to 16.
        step_px: pixels between the nodes.
        threshold_cd_m2: luminance below which a lamp's light may be left out, cd/m2.
        visible_shares: share of each lamp's light that is not hidden, 0 to 1; None for all of it.
        picture: picture to which the light is added, in place; None for a new one.
        is_depth: if True, distances are depths along the optical axis.

    Returns:
        Linear sRGB, cd/m2.

    Raises:
        ValueError: an argument is out of its range or has a wrong shape.
    """
    _check_arguments(camera, distance_m, num_points, step_px, threshold_cd_m2)
    light = picture
    if light is None:
        light = np.zeros((*distance_m.shape, 3), np.float32)
    if air.is_clear or len(lamps) == 0:
        return light
    halos = find_halos(lamps, camera, air, num_points, threshold_cd_m2, visible_shares)
    if halos is None:
        return light
    focal_px = math.sqrt(camera.fx * camera.fy)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, focal_px], np.float64)
    rays = unit_depth_coordinates(camera) if is_depth else _no_coordinates(camera)
    num_rows = -(-camera.height // step_px) + 1
    num_columns = -(-camera.width // step_px) + 1
    inverse = np.empty((camera.height, camera.width), np.float32)
    cells = np.empty((num_rows - 1, num_columns - 1, 2), np.float32)
    nodes = np.zeros((num_rows, num_columns, 6), np.float32)
    with kernel_threads():
        air_light_kernels.invert_distances(
            np.ascontiguousarray(distance_m), np.float32(MIN_SURFACE_M), *rays, step_px, inverse,
            cells,
        )  # fmt: skip
        ranges = _ranges_of_nodes(cells)
        for batch in fill_halo_tables(halos, camera, step_px):
            grid = ImageGrid(lens, np.array([step_px, batch.num_steps], np.int64))
            coarse_px = batch.num_steps * step_px
            size = (-(-camera.height // coarse_px) + 1, -(-camera.width // coarse_px) + 1)
            volume = np.empty((*size, 3, len(SLICES_PER_M)), np.float32)
            air_light_kernels.light_slices(
                grid, batch.lamps, batch.slice_table, SLICES_PER_M, ranges, volume
            )
            air_light_kernels.light_nodes(
                grid, batch.lamps, batch.reach_table, SLICES_PER_M, volume, batch.coarse_windows,
                ranges, nodes,
            )  # fmt: skip
            air_light_kernels.add_cores(
                grid, batch.lamps, batch.reach_table, batch.windows, ranges, inverse, light
            )
        rows = light.reshape(camera.height, 3 * camera.width)
        air_light_kernels.spread_nodes(step_px, inverse, ranges, nodes, rows)
    return light


def _no_coordinates(camera: Camera) -> tuple[Float32[np.ndarray, "W"], Float32[np.ndarray, "H"]]:
    """Return the coordinates of rays along which depth is distance."""
    return np.zeros(camera.width, np.float32), np.zeros(camera.height, np.float32)


def _ranges_of_nodes(cells: Float32[np.ndarray, "R C 2"]) -> Float32[np.ndarray, "R1 C1 2"]:
    """Return the largest and the smallest inverse distance in the four cells about each node."""
    cells = np.pad(cells, ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows = np.empty((cells.shape[0] - 1, *cells.shape[1:]), np.float32)
    np.maximum(cells[:-1, :, 0], cells[1:, :, 0], out=rows[..., 0])
    np.minimum(cells[:-1, :, 1], cells[1:, :, 1], out=rows[..., 1])
    ranges = np.empty((cells.shape[0] - 1, cells.shape[1] - 1, 2), np.float32)
    np.maximum(rows[:, :-1, 0], rows[:, 1:, 0], out=ranges[..., 0])
    np.minimum(rows[:, :-1, 1], rows[:, 1:, 1], out=ranges[..., 1])
    return ranges


def _check_arguments(
    camera: Camera, distance_m: np.ndarray, num_points: int, step_px: int, threshold_cd_m2: float
) -> None:
    """Raise ValueError unless the arguments of `air_light` fit."""
    if distance_m.shape != (camera.height, camera.width):
        raise ValueError(
            f"distance_m must be [{camera.height}, {camera.width}] (from camera "
            f"{camera.name!r}); got {list(distance_m.shape)}"
        )
    if not 1 <= num_points <= MAX_POINTS:
        raise ValueError(f"num_points must be 1 to {MAX_POINTS}; got {num_points}")
    if step_px < 1:
        raise ValueError(f"step_px must be >= 1; got {step_px}")
    if not (math.isfinite(threshold_cd_m2) and threshold_cd_m2 >= 0):
        raise ValueError(f"threshold_cd_m2 must be finite and >= 0; got {threshold_cd_m2}")
