"""Sky masks of recorded images, by brightness, place and graph cut.

In: a recorded image, its camera, and LiDAR returns where there are any. Out: a bool mask, or two
(`RecordedSky`). `augment.photo.trust` judges views by it, and training views learn their sky from
it.

Bright smooth regions are sky. Regions below the horizon, or where the LiDAR had a return, are not.
GrabCut (Rother et al. 2004, OpenCV's) draws the line between them. `find_sky` needs the image alone
and says where it cannot tell. `sky_mask` decides everywhere, by the surfaces that a scene from
LiDAR renders. A column of the image is known where its surfaces end below the LiDAR's highest view,
since the LiDAR looked over them and met nothing. Where they reach that view, a wall may go on
above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from augment.files.recorded_images import decode_image
from augment.memo import memo_of
from augment.render.buffers import ALPHA
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera, Frame
from augment.scene.labels import KnowsLidarElevation
from augment.scene.scene import Scene

# Columns of the image that is cut, which takes 0.1 s; finer lines than a twig's do not matter.
WORK_WIDTH = 256
# Difference of the image's proportions from the camera's beyond which it is another camera's.
_MAX_SQUEEZE = 0.05
# Standard deviation in a window below which it is smooth, of 255; clouds pass, foliage does not.
_SMOOTH_LEVELS = 6.0
# Difference from the brightest tenth of the candidates beyond which a pixel is no sky, of 255.
_DARK_LEVELS = 70.0
# Luma below which a pixel is no sky, of 255.
_MIN_LUMA = 90.0
# Share of the image below which a bright region is a window or a lamp.
_MIN_PART = 0.005
# Side of the square around a LiDAR return that is its surface's, pixels.
_HIT_PX = 3
# Margin below the LiDAR's highest view, since cameras are not where the LiDAR is.
TOP_MARGIN_RAD = math.radians(4.0)
# Columns beside one whose surface goes on that may show the same surface, leaning.
_BESIDE_PX = 9
# Distance from which LiDAR and cameras see a return at nearly the same elevation, metres.
_TOP_FROM_M = 10.0
# Quantile of the returns' elevations that is the highest view; a few returns are stray.
_TOP_QUANTILE = 0.999
# Returns that the highest view is measured from, at least.
_ENOUGH_RETURNS = 5000
# Side of the window in which contrast is measured, pixels of the small image.
_WINDOW_PX = 5
# Rounds of the graph cut; the line hardly moves after these.
_CUTS = 2

# ---- Constants of `sky_mask`
# Alpha from which a pixel shows a surface.
_DRAWN_ALPHA = 0.05
# Covered pixels one above another that a surface has at least.
_DRAWN_PIXELS = 3
# Width by which surfaces are grown, as a part of the image's width: splats end a little early.
_BORDER_PART = 0.008
# Side of the window in which contrast is measured, as a part of the image's width.
_WINDOW_PART = 0.01
# Columns of the image that the graph cut works on, at most.
_MASK_WIDTH = 240
# Rounds of the graph cut.
_MASK_CUTS = 3
# Radius of the guided filter, as a part of the image's width.
_EDGE_PART = 0.015
# Steps of the image below which the guided filter sees no edge, of 255.
_EDGE_LEVELS = 8.0
# Width of poles and wires, at most, as a part of the image's width.
_THIN_PART = 0.04
# Difference of poles and wires from the sky around them, at least, of 255.
_THIN_LEVELS = 30.0


def _luma(rgb: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    """Return the luma of an image, 0 to 255."""
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)


def find_sky_like_pixels(
    rgb: UInt8[np.ndarray, "H W 3"],
    candidates: Bool[np.ndarray, "H W"],
    window_px: int | None = None,
) -> Bool[np.ndarray, "H W"]:
    """Return the mask of pixels as smooth and about as bright as the bright part of the candidates.

    Clouds pass; walls, foliage and wires seldom do.

    Args:
        rgb: the image.
        candidates: pixels that may be sky.
        window_px: side of the window in which contrast is measured; None takes a hundredth of the
            width.
    """
    if not candidates.any():
        return np.zeros_like(candidates)
    side_px = window_px or 2 * max(1, round(_WINDOW_PART * rgb.shape[1] / 2)) + 1
    luma = _luma(rgb)
    window = (side_px, side_px)
    mean = cv2.blur(luma, window)
    is_smooth = cv2.blur(luma * luma, window) - mean * mean < _SMOOTH_LEVELS**2
    bright_luma = float(np.quantile(luma[candidates], 0.9))
    return is_smooth & (mean > max(bright_luma - _DARK_LEVELS, _MIN_LUMA))


def _cut_sky(
    image: UInt8[np.ndarray, "H W 3"], labels: UInt8[np.ndarray, "H W"], rounds: int
) -> Bool[np.ndarray, "H W"]:
    """Return the sky of a graph cut.

    Args:
        image: the image, as OpenCV has it.
        labels: OpenCV's labels of the pixels, which the cut's replace in place.
        rounds: rounds of the cut.
    """
    is_sky = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    if not is_sky.any() or is_sky.all():
        return is_sky
    # The colours' first clusters are drawn from the generator of this thread.
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(image, labels, (0, 0, 1, 1), *models, rounds, cv2.GC_INIT_WITH_MASK)
    return (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)


def _grow_mask(mask: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return a mask grown by a window of so many rows and columns."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((rows, columns), np.uint8)) > 0


def elevation_rad(camera: Camera) -> Float[np.ndarray, "H W"]:
    """Return the elevation of every pixel's ray above the world's horizontal plane."""
    rays = camera.ray_directions().numpy()
    return np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))


def _sweep_points(scene: Scene, frame: int, dtype: type[np.floating]) -> np.ndarray | None:
    """Return the finite points [N, 3] of a frame's sweep, scene world; None without a sweep."""
    sweep = scene.lidar(frame)
    if sweep is None:
        return None
    points = (sweep.points_m - np.asarray(scene.world_origin_m)).astype(dtype)
    return points[np.isfinite(points).all(1)]


def _top_rad(points: np.ndarray, centre: np.ndarray, min_returns: int = 1) -> float | None:
    """Return the highest elevation of returns that are not close, without a few stray ones.

    Args:
        points: the returns, [N, 3].
        centre: where they are seen from, [3].
        min_returns: number of returns below which the result is None.
    """
    offset = points - centre
    distance_m = np.hypot(offset[:, 0], offset[:, 1])
    is_far = distance_m > _TOP_FROM_M
    if is_far.sum() < min_returns:
        return None
    return float(np.quantile(np.arctan2(offset[is_far, 2], distance_m[is_far]), _TOP_QUANTILE))


# ---- Sky by the image alone ----------------------------------------------------------------------


class RecordedSky(NamedTuple):
    """Sky of one image.

    Pixels in neither mask cannot be told.
    """

    is_sky: Bool[np.ndarray, "H W"]
    """Pixels that surely show sky."""
    is_solid: Bool[np.ndarray, "H W"]
    """Pixels that surely show no sky."""


def find_sky(
    rgb: UInt8[np.ndarray, "H W 3"],
    elevation_rad: Float[np.ndarray, "H W"],
    has_return: Bool[np.ndarray, "H W"] | None = None,
    lidar_top_rad: float = math.inf,
) -> RecordedSky | None:
    """Return the sky of an image; None at night, or with no sky in view.

    In these cases nothing is bright and smooth enough to begin with.

    Args:
        rgb: the image.
        elevation_rad: elevation of the pixels' rays above the horizon.
        has_return: pixels with a LiDAR return; None without LiDAR.
        lidar_top_rad: elevation at which the LiDAR's view ends; above a surface that reaches it, a
            wall may go on.
    """
    is_above_horizon = elevation_rad > 0
    if not is_above_horizon.any():
        return RecordedSky(is_above_horizon, ~is_above_horizon)
    is_solid = is_unknown = np.zeros(is_above_horizon.shape, bool)
    if has_return is not None:
        is_solid = _grow_mask(has_return, _HIT_PX, _HIT_PX)
        reaches_top = np.any(has_return & (elevation_rad > lidar_top_rad - TOP_MARGIN_RAD), axis=0)[
            None
        ]
        is_above_returns = np.cumsum(is_solid, axis=0) == 0  # above all returns of the column
        is_unknown = is_above_returns & is_above_horizon & _grow_mask(reaches_top, 1, _BESIDE_PX)
    is_bright = find_sky_like_pixels(rgb, is_above_horizon, _WINDOW_PX)
    sky_seed = _regions_at_top(is_bright & is_above_horizon & ~is_solid & ~is_unknown)
    if sky_seed.mean() < _MIN_PART:
        return None
    luma = _luma(rgb)
    is_shining = (
        is_above_horizon & ~is_solid & ~is_unknown & (luma > np.median(luma[sky_seed]))
    )  # lit clouds
    labels = np.full(is_above_horizon.shape, cv2.GC_PR_BGD, np.uint8)
    labels[~is_above_horizon | is_solid] = cv2.GC_BGD
    labels[sky_seed | is_shining] = cv2.GC_PR_FGD
    labels[cv2.erode(sky_seed.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0] = cv2.GC_FGD
    sky = sky_seed
    if (labels == cv2.GC_FGD).any() and (labels == cv2.GC_BGD).any():
        bgr = np.ascontiguousarray(rgb[..., ::-1])
        sky = _cut_sky(bgr, labels, _CUTS) & is_above_horizon & ~is_unknown
    return RecordedSky(sky, ~(sky | is_unknown | is_shining))


def _regions_at_top(region: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Return the connected regions that reach the image's first row."""
    labels = cv2.connectedComponents(region.astype(np.uint8))[1]
    top = np.unique(labels[0])
    return np.isin(labels, top[top > 0])


def recorded_sky(
    scene: Scene, frame: Frame, name: str, width: int = WORK_WIDTH
) -> RecordedSky | None:
    """Return the sky of a camera's recorded image in a frame, as `find_sky`.

    None where there is no image that can be read, or where it tells nothing.

    Args:
        scene: the scene.
        frame: one of its frames.
        name: name of the camera.
        width: columns of the image, at most.
    """
    full_camera = frame.cameras[name]
    camera = full_camera.scaled(min(1.0, width / full_camera.width))
    key = "recorded sky", frame.index, name, camera.width
    return memo_of(scene).get(key, lambda: (_recorded_sky(scene, frame, camera),))[0]


def _recorded_sky(scene: Scene, frame: Frame, camera: Camera) -> RecordedSky | None:
    """Return the sky of a frame's image at the camera's size, as `recorded_sky`."""
    path = frame.image_paths.get(camera.name)
    rgb = None if path is None else read_small_image(Path(path), camera)
    if rgb is None:
        return None
    points = memo_of(scene).get(("sweep", frame.index), lambda: (_sweep(scene, frame),))[0]
    if points is None:
        return find_sky(rgb, elevation_rad(camera))
    if isinstance(scene.labels, KnowsLidarElevation):
        top_rad = scene.labels.max_lidar_elevation_rad
    else:
        top_rad = _top_rad(points, camera.centre.numpy().astype(np.float32))
    return find_sky(
        rgb,
        elevation_rad(camera),
        _find_returns(points, camera),
        math.inf if top_rad is None else top_rad,
    )


def read_small_image(path: Path, camera: Camera) -> np.ndarray | None:
    """Return an image at the camera's size, RGB; None for what is no image of its proportions."""
    image = decode_image(path, cv2.IMREAD_REDUCED_COLOR_2)
    if image is None:
        return None
    height, width = image.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1) > _MAX_SQUEEZE:
        return None
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_BGR2RGB)


def _sweep(scene: Scene, frame: Frame) -> np.ndarray | None:
    """Return the points of a frame's sweep; None without one that can be read."""
    try:
        return _sweep_points(scene, frame.index, np.float32)
    except Exception:  # a damaged sweep is its own frame's matter, and not that of the sky
        return None


def _find_returns(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the mask of pixels with a LiDAR return."""
    pose = camera.camera_from_world.numpy().astype(np.float32)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    local = local[local[:, 2] > 0.5]
    u = np.floor(camera.fx * local[:, 0] / local[:, 2] + camera.cx)
    v = np.floor(camera.fy * local[:, 1] / local[:, 2] + camera.cy)
    is_inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    has_return = np.zeros((camera.height, camera.width), bool)
    has_return[v[is_inside].astype(int), u[is_inside].astype(int)] = True
    return has_return


# ---- Sky by the surfaces of a scene from LiDAR, for training views -------------------------------


def lidar_top_rad(scene: Scene, frames: Sequence[int]) -> float | None:
    """Return the highest elevation that the LiDAR looks at, as cameras see it.

    It is known from the labels, or measured from the returns of some frames (too low where nothing
    tall stood near). None where there are not enough of them.
    """
    if isinstance(scene.labels, KnowsLidarElevation):
        return scene.labels.max_lidar_elevation_rad
    tops = []
    for index in frames:
        cameras = scene.frame(index).cameras.values()
        points = _sweep_points(scene, index, np.float64)
        if points is None or not cameras:
            continue
        centre = np.mean([camera.centre.numpy() for camera in cameras], axis=0)
        top_rad = _top_rad(points, centre, _ENOUGH_RETURNS)
        if top_rad is not None:
            tops.append(top_rad)
    return float(np.median(tops)) if tops else None


def sky_mask(
    scene: Scene,
    camera: Camera,
    rgb: UInt8[np.ndarray, "H W 3"],
    returns: Int[np.ndarray, " M"],
    lidar_top_rad: float | None,
) -> Bool[np.ndarray, "H W"]:
    """Return the mask of the view's pixels that show sky; empty where nothing can be known.

    Args:
        scene: the scene, as initialised from LiDAR.
        camera: the view.
        rgb: the recorded image.
        returns: flat indices of pixels with a LiDAR return.
        lidar_top_rad: highest elevation that the LiDAR looks at; None where unknown.
    """
    empty_mask = np.zeros((camera.height, camera.width), np.bool_)
    if lidar_top_rad is None:
        return empty_mask
    alpha = rasterize(scene.parts_for(camera), camera, buffers=(ALPHA,)).alpha
    assert alpha is not None
    is_covered = alpha.numpy() > _DRAWN_ALPHA
    has_return = empty_mask.copy()
    has_return.reshape(-1)[returns] = (
        True  # also thin things that are not in the scene: wires, twigs
    )
    is_open = _find_open_pixels(camera, is_covered | has_return, lidar_top_rad)
    is_sure = is_open & find_sky_like_pixels(rgb, is_open)
    ray_rise = camera.ray_directions().numpy()[..., 2]
    is_above_horizon = (ray_rise > 0) & ~has_return
    is_likely = (
        is_above_horizon
        & ~is_covered
        & _as_bright_as_sky(rgb, is_open if is_open.any() else is_above_horizon)
    )
    if not is_likely.any():
        return empty_mask
    labels = np.full(empty_mask.shape, cv2.GC_PR_BGD, np.uint8)
    labels[is_likely] = cv2.GC_PR_FGD
    labels[is_sure] = cv2.GC_FGD
    labels[~is_above_horizon] = cv2.GC_BGD
    small = _shrink(rgb, cv2.INTER_AREA), _shrink(labels, cv2.INTER_NEAREST)
    sky = (
        _refine_mask(rgb, _cut_sky(*small, _MASK_CUTS))
        & is_above_horizon
        & ~_grow_mask(has_return, 3, 3)
    )
    return _keep_sure_pieces(sky, is_sure) & ~_find_thin_things(rgb, sky)


def _as_bright_as_sky(rgb: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Return the pixels of `find_sky_like_pixels`, and those brighter than most of the
    candidates.
    """
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    if not candidates.any():
        return candidates
    bright_luma = max(float(np.quantile(luma[candidates], 0.9)), _MIN_LUMA)
    return find_sky_like_pixels(rgb, candidates) | (luma > bright_luma)


def _shrink(image: np.ndarray, interpolation: int) -> np.ndarray:
    """Return an image [H, W, ...] at the size that the graph cut works on."""
    height, width = image.shape[:2]
    num_columns = min(_MASK_WIDTH, width)
    return cv2.resize(
        image,
        (num_columns, max(1, round(height * num_columns / width))),
        interpolation=interpolation,
    )


def _refine_mask(rgb: np.ndarray, small_mask: np.ndarray) -> np.ndarray:
    """Return a small mask at the image's size, along the image's edges."""
    height, width = rgb.shape[:2]
    mask = cv2.resize(
        small_mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR
    )
    radius = max(2, round(_EDGE_PART * width))
    return cv2.ximgproc.guidedFilter(rgb, mask, radius, _EDGE_LEVELS**2) > 0.5


def _keep_sure_pieces(sky: np.ndarray, is_sure: np.ndarray) -> np.ndarray:
    """Return the connected pieces of sky that are sure in part or reach the image's first row.

    A bright window is neither. Wires do not divide pieces.
    """
    border = max(2, round(_BORDER_PART * sky.shape[1]))
    grown_sky = _grow_mask(sky, 2 * border + 1, 2 * border + 1).astype(np.uint8)
    components = np.asarray(cv2.connectedComponents(grown_sky, connectivity=4)[1], np.int32)
    is_kept = np.zeros(int(components.max()) + 1, np.bool_)
    is_kept[components[is_sure & sky]] = True
    is_kept[components[0][sky[0]]] = True
    return is_kept[components] & sky


def _find_thin_things(rgb: np.ndarray, sky: np.ndarray) -> np.ndarray:
    """Return the pixels clearly darker than the sky around them.

    They are poles, wires and twigs, which are too thin for the cut.
    """
    luma = _luma(rgb)
    window = (2 * round(_THIN_PART * rgb.shape[1] / 2) + 1,) * 2
    sky_weight = sky.astype(np.float32)
    mean = cv2.blur(luma * sky_weight, window) / np.maximum(cv2.blur(sky_weight, window), 1e-3)
    return luma < mean - _THIN_LEVELS


def _find_open_pixels(camera: Camera, is_covered: np.ndarray, lidar_top_rad: float) -> np.ndarray:
    """Return the pixels above the highest surface of their column, where it surely ends there."""
    border = max(2, round(_BORDER_PART * camera.width))
    is_solid = cv2.morphologyEx(
        is_covered.astype(np.uint8), cv2.MORPH_OPEN, np.ones((_DRAWN_PIXELS, 1), np.uint8)
    )
    rays = camera.ray_directions().numpy()
    ray_rise = rays[..., 2] / np.linalg.norm(rays, axis=2)
    last_row = len(is_covered) - 1
    top_row = np.where(is_solid.any(axis=0), is_solid.argmax(axis=0), last_row)
    is_known = ray_rise[top_row, np.arange(camera.width)] < math.sin(lidar_top_rad - TOP_MARGIN_RAD)
    # A column beside one whose surface goes on may show the same surface, leaning.
    is_known = (
        cv2.erode(is_known.astype(np.uint8)[None], np.ones((1, 2 * border + 1), np.uint8))[0] > 0
    )
    is_shadowed = np.maximum.accumulate(
        _grow_mask(is_covered, 2 * border + 1, 2 * border + 1), axis=0
    )
    return is_known[None] & ~is_shadowed
