"""Wet road in the tracks of traffic, on the finished picture: darker, with a sheen of the sky.

Input: a picture, its depth, and a `WetRoad`, a map of the bare road's wetness that `layer` makes
from the cells. Caller: `effect`. It is drawn pixel by pixel, so that recorded images get it too.

Darkening is that of wet ground (`augment.effects.wet.darkening`). The sheen is Schlick's
reflectance, averaged over the slopes of rough ground (Bruneton et al. 2010, "Real-time realistic
ocean lighting", equation 18), times the sky in the mirrored direction. Towards the horizon, houses
stand before the sky, and the colour of the ground takes its place. Cars and houses themselves are
not mirrored: a recipe with `weather.rain.wetness` draws them, and this pass then does nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from augment.effects.falling.air import UNKNOWN_AIRLIGHT
from augment.effects.snow.traffic import paint_cells
from augment.effects.snow.wet_track_kernels import (
    MAX_DISTANCE_M,
    MAX_HEIGHT_M,
    MAX_TABLE_COLOR,
    MIN_SHARE,
    MIN_TRANSMITTANCE,
    RoadMap,
    Sheen,
    TrackFog,
    TrackView,
    wet_pixels,
)
from augment.effects.wet.darkening import to_display, to_linear, wet_ratio, white_level
from augment.exposure.cells import ExposedCells
from augment.light.scene_light import SceneLight, find_scene_light
from augment.memo import memo_of
from augment.render.buffers import CPU, choose_kernels
from augment.render.fog import Fog, airlight_gain
from augment.render.fog_image import point_optical_depth
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.scene.sky import is_unknown_sky

GRID_M = 0.1  # side of a cell of the map
_BLOCK = 128  # cells on a side of a block of the map
_ROWS_PER_THREAD = 16  # image rows that a thread takes at a time
_SLOPE = 0.12  # standard deviation of the wet road's slopes
# The sheen: share of the wet road that is a film smooth enough to shine (the other part is damp
# grit), reflectance of water from straight above, factor and exponent of the mean over the slopes.
_FILM = (0.2, 0.02, 1 / (1 + 22.7 * _SLOPE**1.5), 5 * math.exp(-2.69 * _SLOPE))
_TABLE_SIZE = 1024  # number of values in a table of colours
_SKY_ROWS = 33  # elevations in the table of mirrored light
_SKY_COLUMNS = 64  # azimuths in it
# Mirrored elevation from which on all of the sheen is the sky's, degrees.
_FULL_SKY_DEG = 14.0


@dataclass(frozen=True, eq=False)
class WetRoad:
    """Map of the wetness of bare road in tracks, in B square blocks of n cells a side."""

    corner: tuple[float, float]
    """x and y of the first block's corner, world."""
    block_ids: Int64[Tensor, "Y X"]
    """Number of the block at each place, -1 where none is."""
    wetness: Float[Tensor, "B n n"]
    """Wetness, 0 to 1; rows go along y."""
    height_m: Float[Tensor, "B n n"]
    """Height of the road, world z."""

    def sample(self, points_m: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Return the wetness at points near the road; 0 elsewhere."""
        ids, heights, wetness = (
            t.to(points_m.device) for t in (self.block_ids, self.height_m, self.wetness)
        )
        place = (points_m[:, :2] - points_m.new_tensor(self.corner)) / GRID_M
        cell = place.floor().long()
        last = torch.tensor(ids.shape[::-1], device=ids.device) * _BLOCK - 1
        is_inside = ((cell >= 0) & (cell <= last)).all(1)
        cell = torch.minimum(cell.clamp_min(0), last)
        block = ids[cell[:, 1] // _BLOCK, cell[:, 0] // _BLOCK]
        inner = cell % _BLOCK
        where = (block.clamp_min(0), inner[:, 1], inner[:, 0])
        is_on_road = (points_m[:, 2] - heights[where]).abs() < MAX_HEIGHT_M
        return torch.where(is_inside & (block >= 0) & is_on_road, wetness[where], 0.0)


def make_wet_road(cells: ExposedCells, wetness: np.ndarray) -> WetRoad | None:
    """Return the map of wet road; None where no cell is wet.

    The map reaches a little under the snow beside the tracks, whose edges it leaves to the snow.

    Args:
        cells: cells of the ground.
        wetness: wetness of each cell, [C].
    """
    rows = np.flatnonzero(wetness > 0)
    if not len(rows):
        return None
    centers = cells.centers_m.numpy()[rows].astype(np.float64)
    sizes = cells.sizes_m.numpy()[rows].astype(np.float64)
    values = wetness[rows]
    side_m = _BLOCK * GRID_M
    low = np.floor((centers[:, :2].min(0) - 1) / side_m) * side_m
    num_columns, num_rows = np.ceil((centers[:, :2].max(0) + 1 - low) / side_m).astype(int)
    block_ids = np.full((num_rows, num_columns), -1, np.int64)
    maps = list[np.ndarray]()
    heights = list[np.ndarray]()
    margin = 4
    shape = (_BLOCK + 2 * margin, _BLOCK + 2 * margin)
    for row in range(num_rows):
        for column in range(num_columns):
            corner = low + np.array([column, row]) * side_m - margin * GRID_M
            reach = sizes[:, None]
            local = centers[:, :2] - corner
            near = ((local > -reach) & (local < shape[0] * GRID_M + reach)).all(1)
            if not near.any():
                continue
            mask = paint_cells(centers[near, :2], sizes[near], corner, GRID_M, shape)
            at = np.clip((local[near] / GRID_M).astype(int), 0, shape[0] - 1)
            cell_mask = np.zeros(shape, np.float32)
            height = np.zeros(shape, np.float32)
            wet = np.zeros(shape, np.float32)
            cell_mask[at[:, 1], at[:, 0]] = 1
            height[at[:, 1], at[:, 0]] = centers[near, 2]
            wet[at[:, 1], at[:, 0]] = values[near]
            weight = np.maximum(cv2.blur(cell_mask, (9, 9)), 1e-6)
            spread = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
            wet = spread * cv2.blur(wet, (9, 9)) / weight
            height = cv2.blur(height, (9, 9)) / weight
            inner = (slice(margin, -margin), slice(margin, -margin))
            block_ids[row, column] = len(maps)
            maps.append(np.clip(wet, 0, 1)[inner])
            heights.append(height[inner])
    return WetRoad(
        (float(low[0]), float(low[1])),
        torch.from_numpy(block_ids),
        torch.from_numpy(np.stack(maps).astype(np.float32)),
        torch.from_numpy(np.stack(heights).astype(np.float32)),
    )


def wet_tracks(
    rgb: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    share: Float[Tensor, "H W"],
    camera: Camera,
    wet_road: WetRoad,
    *,
    scene: Scene,
    fog: Fog | None = None,
    backend: str = CPU,
) -> Float[Tensor, "H W 3"]:
    """Return the picture with the bare road in tracks wet.

    On the CPU a kernel draws, equal to the definition within 1e-4, and `rgb` is overwritten.

    Args:
        rgb: the picture, display-encoded.
        depth: z of the surfaces, metres.
        share: share of each pixel that shows the scene's surface without snow, 0 to 1.
        camera: camera of the picture.
        wet_road: map of the wet road.
        scene: scene that gives the light.
        fog: the fog before the road.
        backend: name of the backend.
    """
    sheen = _sheen_of(scene)
    has_banks = fog is not None and fog.banks is not None
    uses_kernel = choose_kernels(backend, rgb, depth, share) == CPU and rgb.is_contiguous()
    if has_banks or not uses_kernel:
        return wet_by_definition(rgb, depth, share, camera, wet_road, sheen, fog)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    pose = np.ascontiguousarray(camera.world_from_camera[:3].double().numpy())
    road = RoadMap(
        np.array(wet_road.corner),
        wet_road.block_ids.numpy(),
        wet_road.wetness.numpy(),
        wet_road.height_m.numpy(),
        GRID_M,
    )
    arrays = (image.detach().float().contiguous().numpy() for image in (depth, share))
    with kernel_threads(_ROWS_PER_THREAD):
        wet_pixels(
            rgb.detach().numpy(), *arrays, TrackView(lens, pose), road, sheen, _fog_numbers(fog)
        )
    return rgb


def wet_by_definition(
    rgb: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    share: Float[Tensor, "H W"],
    camera: Camera,
    wet_road: WetRoad,
    sheen: Sheen,
    fog: Fog | None,
) -> Float[Tensor, "H W 3"]:
    """Return the picture with the bare road in tracks wet: the definition, on any device.

    The arguments are those of `wet_tracks`, and the tables of the light.
    """
    rows = _road_pixels(depth, share, camera)
    if not len(rows):
        return rgb
    flat = rgb.reshape(-1, 3)
    rays = camera.ray_directions(device=rgb.device).reshape(-1, 3)[rows]
    offsets_m = rays * depth.reshape(-1)[rows, None]
    wetness = wet_road.sample(offsets_m + camera.centre.to(offsets_m)) * share.reshape(-1)[rows]
    chosen = torch.nonzero(wetness > MIN_SHARE)[:, 0]
    if not len(chosen):
        return rgb
    rows = rows[chosen]
    wetness = wetness[chosen]
    offsets_m = offsets_m[chosen]
    directions = offsets_m / offsets_m.norm(dim=1, keepdim=True)
    clear = flat[rows]
    transmittance = torch.ones_like(wetness)
    if fog is not None and fog.extinction_per_m > 0:
        transmittance = torch.exp(-point_optical_depth(fog, camera, offsets_m))
        airlight = clear.new_tensor(fog.airlight_rgb).expand_as(clear)
        if fog.elevation_gain > 0:
            airlight = airlight + airlight_gain(fog, directions[:, 2])
        clear = (clear - (1 - transmittance)[:, None] * airlight) / transmittance.clamp_min(
            MIN_TRANSMITTANCE
        )[:, None]
    clear = clear.clamp_min(0)
    shine = rough_reflectance(-directions[:, 2])[:, None]
    mirrored = _sample_sky(torch.from_numpy(sheen.sky).to(clear), directions)
    dark = _look_up(torch.from_numpy(sheen.dark).to(clear), clear)
    wet = to_display((1 - shine) * dark + shine * mirrored)
    out = flat.clone()
    out[rows] += (wetness * transmittance)[:, None] * (wet - clear)
    return out.reshape(rgb.shape)


def rough_reflectance(cosine: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    """Return the mean reflectance of wet, rough ground, by the cosine of the angle of incidence."""
    share, facing, factor, exponent = _FILM
    rough = factor * (1 - cosine).clamp(0, 1) ** exponent
    return share * (facing + (1 - facing) * rough)


def _road_pixels(
    depth: Float[Tensor, "H W"], share: Float[Tensor, "H W"], camera: Camera
) -> Int64[Tensor, " N"]:
    """Return the flat indices of pixels that may show a road nearby."""
    fall = -camera.ray_directions(device=depth.device)[..., 2]
    is_road: Bool[Tensor, "H W"] = (share > MIN_SHARE) & (depth > 0) & (fall > 0)
    return torch.nonzero((is_road & (depth < MAX_DISTANCE_M)).reshape(-1))[:, 0]


def _look_up(table: Float[Tensor, " T"], values: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    """Return values of a table whose argument goes from 0 to MAX_TABLE_COLOR, interpolated."""
    last = len(table) - 1
    place = (values * (last / MAX_TABLE_COLOR)).clamp(0, last)
    low = place.long().clamp_max(last - 1)
    return table[low] + (place - low) * (table[low + 1] - table[low])


def _sample_sky(
    sky: Float[Tensor, "E A 3"], directions: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Return the light that ground mirrors along directions that fall onto it."""
    num_rows, num_columns, _ = sky.shape
    row = (-directions[:, 2]).clamp(0, 1) * (num_rows - 1)
    column = torch.atan2(directions[:, 1], directions[:, 0]) / (2 * math.pi) * num_columns
    r0 = row.long().clamp_max(num_rows - 2)
    fr = (row - r0)[:, None]
    c0 = column.floor()
    fc = (column - c0)[:, None]
    c1 = (c0.long() + 1) % num_columns
    c0 = c0.long() % num_columns
    low = sky[r0, c0] * (1 - fc) + sky[r0, c1] * fc
    high = sky[r0 + 1, c0] * (1 - fc) + sky[r0 + 1, c1] * fc
    return low + fr * (high - low)


def _sheen_of(scene: Scene) -> Sheen:
    """Return the tables of the light of wet road in a scene; they are computed once for it."""

    def compute() -> Sheen:
        light = find_scene_light(scene)
        values = torch.linspace(0, MAX_TABLE_COLOR, _TABLE_SIZE, dtype=torch.float64)
        greys = values[:, None].expand(-1, 3)
        dark = to_linear(greys * wet_ratio(greys, white_level(light), 1.0))[:, 0].contiguous()
        return Sheen(
            dark.numpy(), to_display(values).numpy(), _mirrored_light(scene, light), np.array(_FILM)
        )

    scene = scene.as_recorded
    return memo_of(scene).get(("sheen of wet tracks",), compute)


def _mirrored_light(scene: Scene, light: SceneLight) -> Float64[np.ndarray, "E A 3"]:
    """Return the linear light that wet ground mirrors, by sine of elevation and azimuth."""
    sines = torch.linspace(0, 1, _SKY_ROWS, dtype=torch.float64)
    azimuths = torch.arange(_SKY_COLUMNS, dtype=torch.float64) * (2 * math.pi / _SKY_COLUMNS)
    level = torch.sqrt(1 - sines**2)[:, None]
    directions = torch.stack(
        [level * torch.cos(azimuths), level * torch.sin(azimuths), sines[:, None] + 0 * azimuths], 2
    )
    ground = torch.tensor(light.ground_rgb_linear, dtype=torch.float64)
    sky = torch.tensor(UNKNOWN_AIRLIGHT, dtype=torch.float64).expand_as(directions)
    if not is_unknown_sky(scene.sky):
        sky = scene.sky.sample(directions.float()).double()
    share = (sines / math.sin(math.radians(_FULL_SKY_DEG))).clamp(0, 1)
    share = (share * share * (3 - 2 * share))[:, None, None]
    return (ground + share * (to_linear(sky.nan_to_num().clamp(0, 1)) - ground)).numpy()


def _fog_numbers(fog: Fog | None) -> TrackFog:
    """Return the fog's numbers, as the kernel takes them."""
    if fog is None:
        return TrackFog(0.0, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(3))
    varying = fog.airlight_rgb if fog.varying_airlight_rgb is None else fog.varying_airlight_rgb
    return TrackFog(
        float(fog.extinction_per_m),
        0.0 if fog.scale_height_m is None else 1 / fog.scale_height_m,
        float(fog.base_z_m),
        float(fog.elevation_gain),
        np.array(fog.airlight_rgb, np.float64),
        np.array(varying, np.float64),
    )
