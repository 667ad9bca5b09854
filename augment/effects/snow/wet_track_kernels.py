"""A numba kernel: wet road in the tracks of traffic, as `wet_tracks.wet_by_definition` defines it.

`wet_tracks` prepares the arrays. Kernels trust them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel, kernel_function

MIN_SHARE = 0.02  # least share of a pixel that wet road must have
MAX_DISTANCE_M = 90.0  # depth beyond which tracks are left as they are
MAX_HEIGHT_M = 0.2  # height over or under the road within which a pixel shows it
MIN_TRANSMITTANCE = 0.05  # least transmittance of fog at which the road has a known colour
MAX_EXPONENT = 80.0  # largest exponent of the fog's density
MAX_TABLE_COLOR = 1.5  # largest value of a table's argument


class TrackView(NamedTuple):
    """View of a camera, float64."""

    lens: np.ndarray  # fx, fy, cx, cy
    pose: np.ndarray  # [3, 4], world_from_camera


class RoadMap(NamedTuple):
    """Map of the wet road, see `wet_tracks.WetRoad`."""

    corner: np.ndarray  # float64 [2]
    block_ids: np.ndarray  # int64 [Y, X]
    wetness: np.ndarray  # float32 [B, n, n]
    height_m: np.ndarray  # float32 [B, n, n]
    cell_m: float  # side of a cell


class Sheen(NamedTuple):
    """Tables of the light of wet road."""

    # Linear light of the dark, wet road, by the display-encoded colour of the dry one; from 0 to
    # MAX_TABLE_COLOR in equal steps, float64 [T].
    dark: np.ndarray
    display: np.ndarray  # display-encoded colour, by linear light, float64 [T]
    sky: np.ndarray  # mirrored linear light, by sine of elevation and azimuth, float64 [E, A, 3]
    film: np.ndarray  # share of film, reflectance at a facing angle, factor and exponent of Schlick


class TrackFog(NamedTuple):
    """Fog before the road, float64."""

    extinction_per_m: float
    inverse_height_per_m: float  # 0 for uniform fog
    base_z_m: float
    elevation_gain: float
    airlight: np.ndarray  # [3], airlight at the horizon
    varying: np.ndarray  # [3], share of it that depends on the elevation


@kernel
def wet_pixels(rgb, depth, share, view, road, sheen, fog):
    """Wet the pixels of rgb [H, W, 3] that show bare road in tracks, in place.

    depth [H, W]: z of the surfaces, metres. share [H, W]: share of bare surface in each pixel.
    """
    for i in prange(rgb.shape[0]):
        _wet_row(np.int64(i), rgb, depth, share, view, road, sheen, fog)


@kernel_function()
def _wet_row(i, rgb, depth, share, view, road, sheen, fog):
    """Wet the pixels of one row."""
    lens = view.lens
    pose = view.pose
    corner = road.corner
    block_ids = road.block_ids
    wet_map = road.wetness
    heights = road.height_m
    side = wet_map.shape[1]
    num_columns = side * block_ids.shape[1]
    num_rows = side * block_ids.shape[0]
    film = sheen.film
    v = (i + 0.5 - lens[3]) / lens[1]
    for j in range(rgb.shape[1]):
        z = np.float64(depth[i, j])
        bare = np.float64(share[i, j])
        if not (bare > MIN_SHARE and 0.0 < z < MAX_DISTANCE_M):
            continue
        u = (j + 0.5 - lens[2]) / lens[0]
        rx = u * pose[0, 0] + v * pose[0, 1] + pose[0, 2]
        ry = u * pose[1, 0] + v * pose[1, 1] + pose[1, 2]
        rz = u * pose[2, 0] + v * pose[2, 1] + pose[2, 2]
        if not rz < 0.0:
            continue
        column = np.int64(math.floor((z * rx + pose[0, 3] - corner[0]) / road.cell_m))
        line = np.int64(math.floor((z * ry + pose[1, 3] - corner[1]) / road.cell_m))
        if not (0 <= column < num_columns and 0 <= line < num_rows):
            continue
        block = block_ids[line // side, column // side]
        if block < 0:
            continue
        height = np.float64(heights[block, line % side, column % side])
        point_z = z * rz + pose[2, 3]
        if not abs(point_z - height) < MAX_HEIGHT_M:
            continue
        wetness = bare * wet_map[block, line % side, column % side]
        if not wetness > MIN_SHARE:
            continue
        length = math.sqrt(rx * rx + ry * ry + rz * rz)
        slope = rz / length
        transmittance = 1.0
        growth = 0.0
        if fog.extinction_per_m > 0.0:
            tau = _optical_depth(fog, z * length, pose[2, 3], point_z)
            transmittance = math.exp(-tau)
            if fog.elevation_gain > 0.0:
                growth = 1.0 / (1.0 + 2.0 * fog.elevation_gain * -slope) ** (1.0 / 2.2) - 1.0
        rough = film[2] * max(1.0 + slope, 0.0) ** film[3]
        shine = film[0] * (film[1] + (1.0 - film[1]) * rough)
        for k in range(3):
            color = np.float64(rgb[i, j, k])
            if transmittance < 1.0:
                airlight = fog.airlight[k] + growth * fog.varying[k]
                color = (color - (1.0 - transmittance) * airlight) / max(
                    transmittance, MIN_TRANSMITTANCE
                )
            color = max(color, 0.0)
            mirrored = _mirrored(sheen.sky, rx, ry, -slope, k)
            light = (1.0 - shine) * _look_up(sheen.dark, color) + shine * mirrored
            wet = _look_up(sheen.display, light)
            rgb[i, j, k] += np.float32(wetness * transmittance * (wet - color))


@kernel_function()
def _optical_depth(fog, distance_m, eye_z_m, point_z_m):
    """Return tau as `augment.render.fog.optical_depth` defines it."""
    tau = fog.extinction_per_m * distance_m
    if fog.inverse_height_per_m == 0.0:
        return tau
    a = (eye_z_m - fog.base_z_m) * fog.inverse_height_per_m
    b = (point_z_m - fog.base_z_m) * fog.inverse_height_per_m
    difference = abs(b - a)
    mean = 1.0 - 0.5 * difference
    if difference >= 1e-4:
        mean = -math.expm1(-difference) / difference
    return tau * math.exp(min(-min(a, b), MAX_EXPONENT)) * mean


@kernel_function()
def _look_up(table, value):
    """Return a table's value, interpolated; the argument goes from 0 to MAX_TABLE_COLOR."""
    last = len(table) - 1
    place = min(value * (last / MAX_TABLE_COLOR), np.float64(last))
    low = min(np.int64(place), last - 1)
    return table[low] + (place - low) * (table[low + 1] - table[low])


@kernel_function()
def _mirrored(sky, x, y, sine, channel):
    """Return the mirrored light of one channel from an azimuth (x, y) and a sine of elevation."""
    rows = sky.shape[0]
    columns = sky.shape[1]
    row = min(max(sine, 0.0), 1.0) * (rows - 1)
    column = math.atan2(y, x) / (2.0 * math.pi) * columns
    r0 = min(np.int64(row), rows - 2)
    fr = row - r0
    c0 = math.floor(column)
    fc = column - c0
    c1 = (np.int64(c0) + 1) % columns
    c0 = np.int64(c0) % columns
    low = sky[r0, c0, channel] * (1.0 - fc) + sky[r0, c1, channel] * fc
    high = sky[r0 + 1, c0, channel] * (1.0 - fc) + sky[r0 + 1, c1, channel] * fc
    return low + fr * (high - low)
