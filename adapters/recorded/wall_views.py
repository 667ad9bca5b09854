"""What one recorded view says of surfaces that go on above the LiDAR's view."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from augment.cameras import Camera
from augment.geometry import rotmat_from_quat
from augment.reconstruct.view import RecordedView
from augment.render.buffers import ALPHA, MEDIAN_DEPTH, SPLAT_IDS
from augment.render.rasterize import rasterize
from augment.scene import Scene
from augment.semantics import SemanticClass as Class

LIDAR_REACH_M = 60.0  # the LiDAR meets a wall this far away, if nothing hides it
LIDAR_MARGIN_RAD = math.radians(4.0)  # the camera is not where the LiDAR is
COARSE_WIDTH = 320  # columns: walls are continued in cells wider than its pixels
_COLUMN_PX = 2.0  # width of a sector of azimuth, coarse pixels
_SOLID_ALPHA = 0.5
_NEAR_M, _FAR_M = 2.0, 80.0
_SHIFT = 4  # colours are compared in steps of 2^_SHIFT levels
_SIDE = 256 >> _SHIFT
_ENOUGH_SKY = 400  # coarse pixels of sure sky that make an image's own colours
_RARE = 0.003  # part of the commonest sky colour's count below which a colour is no sky
_NO_WALL = np.array(
    [
        Class.ROAD, Class.LANE_MARKING, Class.SIDEWALK, Class.TERRAIN,
        Class.VEHICLE, Class.TWO_WHEELER, Class.PEDESTRIAN,
    ]
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Rims:
    """Topmost points of surfaces that probably go on. points: float64 [R, 3], scene world.
    normals: float32 [R, 3], of the splat there. semantic: int16 [R]. reach_z_m: float64 [R], height
    at which the image ends above the point."""

    points: np.ndarray
    normals: np.ndarray
    semantic: np.ndarray
    reach_z_m: np.ndarray


@dataclass(frozen=True, eq=False)
class WallView:
    """A view at COARSE_WIDTH or less, H x W.

    rgb: uint8 [H, W, 3]. depth_m: float32 [H, W]: z of the surface drawn; above a surface that
    probably goes on, minus the z of its vertical continuation; infinite where nothing is.
    used: bool [H, W]. sky_counts: float32 [_SIDE^3], how often each coarse colour is sure sky.
    """

    camera: Camera
    rgb: np.ndarray
    depth_m: np.ndarray
    used: np.ndarray
    sky_counts: np.ndarray
    rims: Rims

    @staticmethod
    def of(scene: Scene, view: RecordedView, lowest_rim_rad: float) -> WallView:
        """lowest_rim_rad: elevation from which a surface's top may be the LiDAR's, not its own."""
        camera = view.camera.scaled(min(1.0, COARSE_WIDTH / view.camera.width))
        size = (camera.width, camera.height)
        rgb = cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA)
        used = _shrunk(view.weight > 0, size)
        depth_m, rims = _continue_upward(scene, camera, used, lowest_rim_rad)
        sky_counts = np.bincount(
            colour_cells(rgb[_shrunk(view.sky, size)]), minlength=_SIDE**3
        ).astype(np.float32)
        return WallView(camera, rgb, depth_m, used, sky_counts, rims)


def colour_cells(rgb: np.ndarray) -> np.ndarray:
    """The coarse colour of each pixel, int64 [...], for rgb uint8 [..., 3]."""
    steps = rgb.astype(np.int64) >> _SHIFT
    return (steps[..., 0] * _SIDE + steps[..., 1]) * _SIDE + steps[..., 2]


def sky_colours(own: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which coarse colours look like sky in an image, bool [_SIDE^3].

    own: counts of the image's sure sky; others: of all images of its camera, for an image that
    shows too little sky. Without any sky only white is taken for it.
    """
    counts = own if own.sum() >= _ENOUGH_SKY else others
    if counts.sum() < _ENOUGH_SKY:
        luma = np.indices((_SIDE,) * 3).reshape(3, -1).min(axis=0)
        return luma >= _SIDE - 2
    cube = counts.reshape((_SIDE,) * 3)
    for axis in range(3):  # colours one step beside are sky too
        padded = np.pad(cube, [(1, 1) if a == axis else (0, 0) for a in range(3)])
        cube = sum(np.take(padded, np.arange(_SIDE) + k, axis=axis) for k in range(3))
    return cube.reshape(-1) > _RARE * cube.max()


def _shrunk(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Coarse pixels that lie wholly in the mask, bool [H, W]."""
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99


def _continue_upward(
    scene: Scene, camera: Camera, used: np.ndarray, lowest_rim_rad: float
) -> tuple[np.ndarray, Rims]:
    """The view's signed depth (see WallView) and the rims in it."""
    parts = scene.parts_for(camera)
    out = rasterize(parts, camera, buffers=(ALPHA, MEDIAN_DEPTH, SPLAT_IDS))
    assert out.alpha is not None and out.median_depth is not None and out.splat_ids is not None
    z, ids = out.median_depth.numpy(), out.splat_ids.numpy().ravel()
    solid = (out.alpha.numpy() >= _SOLID_ALPHA) & (z > 0)
    depth = np.where(solid, z, np.float32(np.inf)).ravel()
    rays = camera.ray_directions().numpy().reshape(-1, 3).astype(np.float64)
    level = np.hypot(rays[:, 0], rays[:, 1])
    rise = np.arctan2(rays[:, 2], level)
    sector = _sectors(camera, rays)
    top = _topmost(np.where(solid.ravel(), rise, -np.inf), sector)
    rim = (top >= 0) & (rise[top] >= lowest_rim_rad) & used.ravel()[top]
    own = np.maximum(ids[top], 0)
    background = scene.background
    rim &= (ids[top] >= 0) & (ids[top] < len(background))
    own[~rim] = 0
    semantic = np.zeros(len(own), np.int16)
    if background.semantic is not None and len(background):
        semantic = background.semantic.numpy()[own]
    distance_m = np.where(rim, depth[top], 0.0) * level[top]
    rim &= ~np.isin(semantic, _NO_WALL) & (distance_m > _NEAR_M) & (distance_m < _FAR_M)
    above = rim[sector] & (rise > rise[top][sector]) & ~solid.ravel() & used.ravel()
    depth[above] = -(distance_m[sector] / level)[above]
    centre = camera.centre.numpy()
    reach = np.full(len(top), -np.inf)
    np.maximum.at(reach, sector[above], rise[above])
    chosen = np.flatnonzero(rim & np.isfinite(reach))
    at = top[chosen]
    rims = Rims(
        points=centre + depth[at, None].astype(np.float64) * rays[at],
        normals=_normals(scene, own[chosen]),
        semantic=semantic[chosen],
        reach_z_m=centre[2] + distance_m[chosen] * np.tan(reach[chosen]),
    )
    return depth.reshape(z.shape), rims


def _sectors(camera: Camera, rays: np.ndarray) -> np.ndarray:
    """Number of the vertical plane through the camera's centre that each pixel lies in, int64."""
    forward = camera.world_from_camera[:3, 2].numpy()
    ahead = rays[:, 0] * forward[0] + rays[:, 1] * forward[1]
    aside = rays[:, 1] * forward[0] - rays[:, 0] * forward[1]
    azimuth = np.arctan2(aside, ahead)
    number = np.floor(azimuth * (camera.fx / _COLUMN_PX)).astype(np.int64)
    return number - number.min()


def _topmost(rise: np.ndarray, sector: np.ndarray) -> np.ndarray:
    """Index of the pixel of largest rise in each sector, -1 where none is finite; int64."""
    order = np.lexsort((-np.arange(len(rise)), rise, sector))
    last = np.append(np.flatnonzero(np.diff(sector[order])), len(order) - 1)
    out = np.full(int(sector.max()) + 1, -1, np.int64)
    out[sector[order[last]]] = order[last]
    out[(out >= 0) & ~np.isfinite(rise[out])] = -1
    return out


def _normals(scene: Scene, splats: np.ndarray) -> np.ndarray:
    """Unit normals of background splats: their thinnest axes, float32 [R, 3]."""
    if len(splats) == 0:
        return np.zeros((0, 3), np.float32)
    axes = rotmat_from_quat(scene.background.quats[splats]).numpy()
    thinnest = scene.background.scales[splats].numpy().argmin(axis=1)
    return axes[np.arange(len(splats)), :, thinnest].astype(np.float32)


def elevation_rad(offsets: np.ndarray) -> np.ndarray:
    """Elevation above the horizon of offsets [N, 3] from an eye, float64 [N]."""
    return np.arctan2(offsets[:, 2], np.hypot(offsets[:, 0], offsets[:, 1]))
