"""True places of snow on the procedural street, and errors of snow's places and heights.

The true surface of the procedural street is known, and so are the points on which snow should lie.
They are points on a grid of the ground plan, on the surface that is highest there, that are

- open: the vertical ray from the sky meets the point first;
- flat: the true surface is no steeper than the limit of snow;
- seen: nothing stands between the point and a camera.

Moving objects shelter no point and hide no point.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import torch

from adapters.procedural import RayHits, StreetTruth
from augment.effects.snow.layer import lay_snow
from augment.effects.snow.light import find_snow_light
from augment.exposure.cells import ExposedCells, ExposedSurface
from augment.exposure.height_map import DepthEstimator
from augment.exposure.search import ExposureSettings, find_exposed_surface
from augment.render.buffers import BUFFERS
from augment.render.constants import RasterSettings
from augment.render.layout import SURFACE_DEPTHS_ONLY
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.scene import PosedGaussians, Scene
from augment.scene.semantics import SemanticClass
from tools.bench.scenes import all_cameras, recipe_of

# The estimators of height that a placement can use.
ESTIMATORS: tuple[DepthEstimator, ...] = get_args(DepthEstimator)
SKY_Z_M = 60.0  # A height above everything on the street, metres.
# The largest height difference, metres, at which a cell still lies on the true surface.
OVER_M = 0.2
# The limits of the rings around the cameras' path in which covered points are counted, metres.
RINGS_M = (0.0, 8.0, 16.0, 32.0)
# The lift of a point above its surface, metres, before rays to cameras are cast from it.
LIFT_M = 1e-3


@dataclass(frozen=True, eq=False)
class TruePoints:
    """P points on a grid of the ground plan, on the surface that is highest there."""

    xy: np.ndarray
    """[P, 2]. Positions in the world, metres."""
    z: np.ndarray
    """[P]. Heights of the surface in the world, metres."""
    slope: np.ndarray
    """[P]. Slopes of the surface, radians."""
    semantic: np.ndarray
    """[P]. Classes of the surface."""
    from_path_m: np.ndarray
    """[P]. Horizontal distances to the nearest camera, metres."""
    is_seen: np.ndarray
    """[P], bool. True if a camera sees the point."""

    def __len__(self) -> int:
        return len(self.z)

    def select(self, mask: np.ndarray) -> TruePoints:
        """Return the points of a mask [P]."""
        return TruePoints(*(getattr(self, f.name)[mask] for f in dataclasses.fields(self)))


def without_movers(truth: StreetTruth) -> StreetTruth:
    """Return the street without moving objects."""
    return StreetTruth(dataclasses.replace(truth.street, movers=()))


def camera_from_above(cameras: Sequence[Camera], *, reach_m: float, pixel_m: float) -> Camera:
    """Return an orthographic camera that looks down on the surroundings of cameras.

    Its rows run towards -y.

    Args:
        cameras: The cameras.
        reach_m: The image reaches so far beyond the outermost cameras along x and y, metres.
        pixel_m: The side of a pixel on the ground, metres.
    """
    centres = np.stack([camera.centre.numpy()[:2] for camera in cameras])
    low = centres.min(0) - reach_m
    high = centres.max(0) + reach_m
    width, height = (int(n) for n in np.ceil((high - low) / pixel_m))
    eye = torch.tensor([*((low + high) / 2), SKY_Z_M], dtype=torch.float64)
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    pose = rigid(rotation, -rotation @ eye)
    scale = 1 / pixel_m
    return Camera(
        "from above", width, height, scale, scale, width / 2, height / 2, pose, is_orthographic=True
    )


def pixel_positions(camera: Camera) -> np.ndarray:
    """Return x and y of the pixel centres of a camera from above, [H, W, 2]."""
    centre = camera.centre.numpy()
    x = centre[0] + (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = centre[1] - (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.stack(np.meshgrid(x, y), -1)


def pixels_of(camera: Camera, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of positions [P, 2] in a camera from above."""
    off = (xy - camera.centre.numpy()[:2]) * [camera.fx, -camera.fy] + [camera.cx, camera.cy]
    columns, rows = np.floor(off).astype(np.int64).T
    return rows, columns


def surface_below(truth: StreetTruth, xy: np.ndarray) -> np.ndarray:
    """Return z [P] of the highest surface at xy [P, 2]; -infinity where there is none."""
    return SKY_Z_M - _cast_down(truth, xy).distance


def _cast_down(truth: StreetTruth, xy: np.ndarray) -> RayHits:
    """Return the first hits of vertical rays from the sky at xy [P, 2]."""
    origins = np.concatenate([xy, np.full((len(xy), 1), SKY_Z_M)], 1)
    down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
    return truth.cast(origins, down, 0, with_rgb=False)


def true_points(
    truth: StreetTruth, cameras: Sequence[Camera], xy: np.ndarray, *, reach_m: float
) -> TruePoints:
    """Return the open points at some positions that are near the cameras' path.

    Args:
        truth: The street without moving objects.
        cameras: The cameras.
        xy: [P, 2]. The positions in the world, metres.
        reach_m: The largest horizontal distance to a camera, metres.
    """
    path_distance_m = np.full(len(xy), np.inf)
    for centre in {tuple(camera.centre.numpy()[:2].round(1)) for camera in cameras}:
        np.minimum(path_distance_m, np.hypot(*(xy - centre).T), out=path_distance_m)
    hits = _cast_down(truth, xy)
    points = TruePoints(
        xy=xy,
        z=SKY_Z_M - hits.distance,
        slope=np.arccos(np.clip(hits.normal[:, 2], -1, 1)),
        semantic=hits.semantic,
        from_path_m=path_distance_m,
        is_seen=np.zeros(len(xy), bool),
    )
    is_hit = (path_distance_m <= reach_m) & np.isfinite(hits.distance)
    points = points.select(is_hit)
    return dataclasses.replace(points, is_seen=_seen(truth, cameras, points, hits.normal[is_hit]))


def _seen(
    truth: StreetTruth, cameras: Sequence[Camera], points: TruePoints, normals: np.ndarray
) -> np.ndarray:
    """Return True for every point that a camera sees, at any distance; bool [P].

    Args:
        truth: The street without moving objects.
        cameras: The cameras.
        points: The points.
        normals: [P, 3]. Normals of the surface at the points.
    """
    places = np.concatenate([points.xy, points.z[:, None]], 1) + LIFT_M * normals
    is_seen = np.zeros(len(points), bool)
    for camera in cameras:
        point_ids = np.flatnonzero(~is_seen)
        pose = camera.camera_from_world.numpy()
        to_eye = camera.centre.numpy() - places[point_ids]
        x, y, z = (places[point_ids] @ pose[:3, :3].T + pose[:3, 3]).T
        depth = np.maximum(z, 1e-9)
        u = camera.fx * x / depth + camera.cx
        v = camera.fy * y / depth + camera.cy
        is_inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        is_inside &= (to_eye * normals[point_ids]).sum(1) > 0
        if is_inside.any():
            point_ids = point_ids[is_inside]
            to_eye = to_eye[is_inside]
            is_seen[point_ids] = ~truth.street.static.tree.occluded(places[point_ids], to_eye, 1.0)
    return is_seen


def snow_accuracy(
    scene: Scene,
    truth: StreetTruth,
    *,
    cell_m: float,
    reach_m: float,
    pixel_m: float,
    depths_m: Sequence[float],
    estimators: Sequence[DepthEstimator] = ESTIMATORS,
) -> dict[str, Any]:
    """Measure the accuracy of snow's places and heights with every estimator of height.

    Args:
        scene: The street's scene.
        truth: The street's exact surfaces.
        cell_m: The edge of the cells of the snow, metres.
        reach_m: The largest horizontal distance of points from the cameras, metres.
        pixel_m: The side of a pixel of the view from above, metres. Every second pixel along each
            axis is a point.
        depths_m: The depths of snow whose heights are measured, metres.
        estimators: The estimators.
    """
    cameras = all_cameras(scene)
    street = without_movers(truth)
    above = camera_from_above(cameras, reach_m=reach_m, pixel_m=pixel_m)
    points = true_points(
        street, cameras, pixel_positions(above)[1::2, 1::2].reshape(-1, 2), reach_m=reach_m
    )
    max_slope = math.radians(ExposureSettings(cell_m=cell_m).max_slope_deg)
    flat = points.select(points.is_seen & (points.slope < max_slope))
    is_crown = flat.semantic == SemanticClass.VEGETATION
    bias = _scene_bias_m(scene, street, flat, above)
    estimator_rows = []
    for estimator in estimators:
        settings = ExposureSettings(cell_m=cell_m, estimator=estimator)
        support = find_exposed_surface(scene, cameras, settings)
        covered = cells_over(support.ground, flat) >= 0
        rings = {}
        for low, high in itertools.pairwise(RINGS_M):
            in_ring = (flat.from_path_m >= low) & (flat.from_path_m < high)
            rings[f"{low:g}-{high:g} m"] = float(covered[in_ring].mean()) if in_ring.any() else None
        estimator_rows.append(
            {
                "estimator": estimator,
                "covered": float(covered[~is_crown].mean()),
                "rings": rings,
                "error_m": height_error(support_heights(support.ground, flat) - flat.z),
                "depths": [
                    _measure_layer(scene, support, street, flat, above, d, bias) for d in depths_m
                ],
            }
        )
    return {"points": len(flat), "scene_bias_m": bias, "estimators": estimator_rows}


def cells_over(cells: ExposedCells, points: TruePoints) -> np.ndarray:
    """Return the id of the cell that lies over each point, int64 [P]; -1 where there is none.

    A cell counts only within OVER_M of the true surface.
    """
    centers = cells.centers_m.numpy().astype(np.float64)
    sizes = cells.sizes_m.numpy()
    out = np.full(len(points), -1, np.int64)
    for size in np.unique(sizes):
        cell_ids = np.flatnonzero(sizes == size)
        low = centers[cell_ids, :2] - size / 2
        offset = low[0] % size  # cells of one size share a grid
        key = _keys(np.round((low - offset) / size).astype(np.int64))
        place = _keys(np.floor((points.xy - offset) / size).astype(np.int64))
        order = np.argsort(key)
        at = np.minimum(np.searchsorted(key[order], place), len(cell_ids) - 1)
        candidate_ids = cell_ids[order[at]]
        is_match = key[order[at]] == place
        is_match &= np.abs(_heights(cells, candidate_ids, points.xy) - points.z) <= OVER_M
        out[is_match] = candidate_ids[is_match]
    return out


def _keys(columns_rows: np.ndarray) -> np.ndarray:
    """Return one int64 for each column and row, [P]."""
    return (columns_rows[:, 0] << 32) + columns_rows[:, 1]


def _heights(cells: ExposedCells, which: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return z of cells' planes at positions, [P]. which: cell ids [P]; xy: positions [P, 2]."""
    centers = cells.centers_m.numpy()[which].astype(np.float64)
    normals = cells.normals.numpy()[which].astype(np.float64)
    slopes = -normals[:, :2] / normals[:, 2:]
    return centers[:, 2] + (slopes * (xy - centers[:, :2])).sum(1)


def support_heights(cells: ExposedCells, points: TruePoints) -> np.ndarray:
    """Return z of the exposed surface at each point, [P]; NaN where a point has no cell."""
    over = cells_over(cells, points)
    z = np.full(len(points), np.nan)
    is_covered = over >= 0
    z[is_covered] = _heights(cells, over[is_covered], points.xy[is_covered])
    return z


def height_error(off: np.ndarray) -> dict[str, float | None]:
    """Return figures of height differences [P] without NaN."""
    off = off[np.isfinite(off)]
    if len(off) == 0:
        return {"median": None, "p95": None, "bias": None}
    median, p95 = map(float, np.quantile(np.abs(off), [0.5, 0.95]))
    return {"median": median, "p95": p95, "bias": float(np.median(off))}


def _scene_bias_m(scene: Scene, truth: StreetTruth, points: TruePoints, above: Camera) -> float:
    """Return the offset of the scene's surface above the true surface at points, metres.

    It is the median over the centres of the Gaussians with the largest weight at the points. A
    fitted or sampled surface has such an offset, and no placement can know it.
    """
    out = rasterize(
        [PosedGaussians(scene.background)], above, buffers=BUFFERS, clip=SURFACE_DEPTHS_ONLY
    )
    ids = np.unique(out.splat_ids.numpy()[pixels_of(above, points.xy)])
    means = scene.background.means.numpy()[ids[ids >= 0]].astype(np.float64)
    off = means[:, 2] - surface_below(truth, means[:, :2])
    return float(np.median(off[np.abs(off) < OVER_M]))


def _measure_layer(
    scene: Scene,
    support: ExposedSurface,
    truth: StreetTruth,
    flat: TruePoints,
    above: Camera,
    depth_m: float,
    scene_bias: float,
) -> dict[str, Any]:
    """Draw the layer of snow from above and compare it with the true surface.

    Args:
        scene: The street's scene.
        support: The surface on which snow is placed.
        truth: The street without moving objects.
        flat: The points that snow should cover.
        above: The camera from above.
        depth_m: The depth of the snow, metres.
        scene_bias: The offset of the scene's surface above the true one, metres.

    Returns:
        depth_m: the depth.
        covered: the share of the points, without vegetation, that snow covers.
        sheltered: the share of snow that is drawn below the surface that is open to the sky.
        error_m: height differences from the true surface raised by the depth.
        error_on_scene_m: the same differences without the offset of the scene.
    """
    snow = recipe_of({"snow": {"depth_m": depth_m}}).weather.snow
    layer = lay_snow(support, scene, snow, find_snow_light(scene, snow), seed=0).ground
    without_snow = dataclasses.replace(scene.background, opacities=layer.visible_opacities)
    parts = [PosedGaussians(without_snow), PosedGaussians(layer.gaussians, is_overlay=True)]
    settings = RasterSettings(sh_degree=0)
    out = rasterize(parts, above, buffers=BUFFERS, settings=settings, clip=SURFACE_DEPTHS_ONLY)
    height = SKY_Z_M - out.mode_depth.to(torch.float64).numpy()
    shows_snow = out.overlay.numpy() >= 0.5
    z = height[pixels_of(above, flat.xy)]
    shows_snow_there = shows_snow[pixels_of(above, flat.xy)]
    is_covered = shows_snow_there & (np.abs(z - depth_m - flat.z) <= OVER_M + 0.5 * depth_m)
    off = np.where(is_covered, z - flat.z - depth_m, np.nan)
    step = max(1, int(shows_snow.sum()) // 400_000)
    places = pixel_positions(above)[shows_snow][::step]
    heights = height[shows_snow][::step]
    is_sheltered = heights < surface_below(truth, places) - OVER_M
    return {
        "depth_m": depth_m,
        "covered": float(is_covered[flat.semantic != SemanticClass.VEGETATION].mean()),
        "sheltered": float(is_sheltered.mean()) if len(is_sheltered) else 0.0,
        "error_m": height_error(off),
        "error_on_scene_m": height_error(off - scene_bias),
    }
