"""Which pixels of a recorded image show sky: by brightness, place and graph cut.

Bright smooth regions that reach the top of the image are sky; what lies below the horizon, or where
the LiDAR had a return, is not; GrabCut (Rother et al. 2004, OpenCV's) draws the line between them.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from augment.cameras import Camera, Frame
from augment.files.recorded_images import decode_image
from augment.memo import memo_of
from augment.scene import Scene

WORK_WIDTH = 256  # columns of the image that is cut: 0.1 s; finer lines than a twig's do not matter
_MAX_SQUEEZE = 0.05  # of its sides' ratio: beyond it is another camera's
_SMOOTH_LEVELS = 6.0  # of 255: standard deviation within 5x5 pixels; clouds pass, foliage does not
_DARK_LEVELS = 70.0  # of 255: this much darker than the brightest tenth above the horizon is none
_MIN_LUMA = 90.0
_MIN_PART = 0.005  # of the image: a smaller bright region is a window or a lamp
_HIT_PX = 3  # pixels around a LiDAR return that are its surface's
_TOP_MARGIN_RAD = math.radians(4.0)  # cameras are not where the LiDAR is
_BESIDE_PX = 9  # columns beside one whose surface goes on may show the same, leaning
_TOP_FROM_M = 10.0  # from here on LiDAR and cameras see a return at nearly the same elevation
_CUTS = 2  # iterations; the line hardly moves after


class RecordedSky(NamedTuple):
    """Of an image: pixels that surely show sky, and that surely show none; what is neither cannot
    be told.
    """

    sky: Bool[np.ndarray, "H W"]
    solid: Bool[np.ndarray, "H W"]


def find_sky(
    rgb: UInt8[np.ndarray, "H W 3"],
    elevation_rad: Float[np.ndarray, "H W"],
    hits: Bool[np.ndarray, "H W"] | None = None,
    lidar_top_rad: float = math.inf,
) -> RecordedSky | None:
    """What an image shows of the sky; None where nothing is bright and smooth enough to begin with:
    night, or no sky in view.

    elevation_rad: of the pixels' rays above the horizon. hits: pixels with a LiDAR return.
    lidar_top_rad: where the LiDAR's view ends; above a surface that reaches it, a wall may go on.
    """
    above = elevation_rad > 0
    if not above.any():
        return RecordedSky(above, ~above)
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.blur(luma, (5, 5))
    smooth = cv2.blur(luma * luma, (5, 5)) - mean * mean < _SMOOTH_LEVELS**2
    bright = mean > max(float(np.quantile(luma[above], 0.9)) - _DARK_LEVELS, _MIN_LUMA)
    solid = unknown = np.zeros(above.shape, bool)
    if hits is not None:
        solid = _grown(hits, _HIT_PX)
        reaches = np.any(hits & (elevation_rad > lidar_top_rad - _TOP_MARGIN_RAD), axis=0)[None]
        over = np.cumsum(solid, axis=0) == 0  # above all returns of its column
        unknown = over & above & _grown(reaches, _BESIDE_PX)
    first = _reaching_top(smooth & bright & above & ~solid & ~unknown)
    if first.mean() < _MIN_PART:
        return None
    shines = above & ~solid & ~unknown & (luma > np.median(luma[first]))  # lit clouds
    mask = np.full(above.shape, cv2.GC_PR_BGD, np.uint8)
    mask[~above | solid] = cv2.GC_BGD
    mask[first | shines] = cv2.GC_PR_FGD
    mask[cv2.erode(first.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0] = cv2.GC_FGD
    sky = first
    if (mask == cv2.GC_FGD).any() and (mask == cv2.GC_BGD).any():
        cv2.setRNGSeed(0)  # this thread's: the colours' first clusters are drawn from it
        models = np.zeros((1, 65)), np.zeros((1, 65))
        bgr = np.ascontiguousarray(rgb[..., ::-1])
        cv2.grabCut(bgr, mask, (0, 0, 1, 1), *models, _CUTS, cv2.GC_INIT_WITH_MASK)
        sky = ((mask == cv2.GC_FGD) | (mask == cv2.GC_PR_FGD)) & above & ~unknown
    return RecordedSky(sky, ~(sky | unknown | shines))


def _grown(mask: np.ndarray, px: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((px, px), np.uint8)) > 0


def _reaching_top(region: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    labels = cv2.connectedComponents(region.astype(np.uint8))[1]
    top = np.unique(labels[0])
    return np.isin(labels, top[top > 0])


def recorded_sky(
    scene: Scene, frame: Frame, name: str, width: int = WORK_WIDTH
) -> RecordedSky | None:
    """`find_sky` of the recorded image of a camera in a frame, `width` columns wide at most; None
    where there is no image that can be read, or it tells nothing.
    """
    full = frame.cameras[name]
    camera = full.scaled(min(1.0, width / full.width))
    key = "recorded sky", frame.index, name, camera.width
    return memo_of(scene).get(key, lambda: (_recorded_sky(scene, frame, camera),))[0]


def _recorded_sky(scene: Scene, frame: Frame, camera: Camera) -> RecordedSky | None:
    path = frame.image_paths.get(camera.name)
    rgb = None if path is None else _read_image(Path(path), camera)
    if rgb is None:
        return None
    points = memo_of(scene).get(("sweep", frame.index), lambda: (_sweep(scene, frame),))[0]
    if points is None:
        return find_sky(rgb, elevation_rad(camera))
    return find_sky(rgb, elevation_rad(camera), _hits(points, camera), _top_rad(points, camera))


def elevation_rad(camera: Camera) -> Float[np.ndarray, "H W"]:
    """Of every pixel's ray above the world's horizontal plane."""
    rays = camera.ray_directions().numpy()
    return np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))


def _read_image(path: Path, camera: Camera) -> np.ndarray | None:
    """RGB at the camera's size; None for what is no image of its proportions."""
    image = decode_image(path, cv2.IMREAD_REDUCED_COLOR_2 | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        return None
    height, width = image.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1) > _MAX_SQUEEZE:
        return None
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_BGR2RGB)


def _sweep(scene: Scene, frame: Frame) -> np.ndarray | None:
    """Points of the frame's sweep in the scene's world; None without a readable one."""
    try:
        sweep = scene.lidar(frame.index)
    except Exception:  # a damaged sweep is its own frame's matter, and not that of the sky
        return None
    if sweep is None:
        return None
    points = (sweep.points_m - np.asarray(scene.world_origin_m)).astype(np.float32)
    return points[np.isfinite(points).all(1)]


def _hits(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels with a return."""
    pose = camera.camera_from_world.numpy().astype(np.float32)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    local = local[local[:, 2] > 0.5]
    u = np.floor(camera.fx * local[:, 0] / local[:, 2] + camera.cx)
    v = np.floor(camera.fy * local[:, 1] / local[:, 2] + camera.cy)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    hits = np.zeros((camera.height, camera.width), bool)
    hits[v[inside].astype(int), u[inside].astype(int)] = True
    return hits


def _top_rad(points: np.ndarray, camera: Camera) -> float:
    """The highest elevation of returns that are not close, a few stray ones left out."""
    offset = points - camera.centre.numpy().astype(np.float32)
    distance_m = np.hypot(offset[:, 0], offset[:, 1])
    far = distance_m > _TOP_FROM_M
    if not far.any():
        return math.inf
    return float(np.quantile(np.arctan2(offset[far, 2], distance_m[far]), 0.999))
