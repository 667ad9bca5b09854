"""Which pixels of a recorded image show sky: by brightness, place and graph cut.

Bright smooth regions are sky; what lies below the horizon, or where the LiDAR had a return, is not;
GrabCut (Rother et al. 2004, OpenCV's) draws the line between them. `find_sky` needs the image alone
and says where it cannot tell. `sky_mask` decides everywhere by what a raw scene draws: a column of
the image is known where the surfaces drawn in it end below the LiDAR's highest view, since the
LiDAR looked over them and met nothing. Where they reach that view, a wall may go on above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from augment.cameras import Camera, Frame
from augment.files.recorded_images import decode_image
from augment.labels import KnowsLidarTop
from augment.memo import memo_of
from augment.render.buffers import ALPHA
from augment.render.rasterize import rasterize
from augment.scene import Scene

WORK_WIDTH = 256  # columns of the image that is cut: 0.1 s; finer lines than a twig's do not matter
_MAX_SQUEEZE = 0.05  # of its sides' ratio: beyond it is another camera's
_SMOOTH_LEVELS = 6.0  # of 255: standard deviation in a window; clouds pass, foliage does not
_DARK_LEVELS = 70.0  # of 255: this much darker than the brightest tenth of what may be sky is none
_MIN_LUMA = 90.0
_MIN_PART = 0.005  # of the image: a smaller bright region is a window or a lamp
_HIT_PX = 3  # pixels around a LiDAR return that are its surface's
TOP_MARGIN_RAD = math.radians(4.0)  # cameras are not where the LiDAR is
_BESIDE_PX = 9  # columns beside one whose surface goes on may show the same, leaning
_TOP_FROM_M = 10.0  # from here on LiDAR and cameras see a return at nearly the same elevation
_TOP_QUANTILE = 0.999  # a few returns are stray
_ENOUGH_RETURNS = 5000
_WINDOW_PX = 5
_CUTS = 2  # rounds; the line hardly moves after
# Of `sky_mask`:
_DRAWN_ALPHA = 0.05
_DRAWN_PIXELS = 3  # fewer covered pixels one above another are no surface's edge
_BORDER_PART = 0.008  # of the image's width, that surfaces are grown by: splats end a little early
_WINDOW_PART = 0.01  # of the image's width
_MASK_WIDTH = 240  # columns of the image that the graph cut works on, at most
_MASK_CUTS = 3
_EDGE_PART = 0.015  # of the image's width: radius of the guided filter
_EDGE_LEVELS = 8.0  # of 255: smaller steps of the image are no edges to it
_THIN_PART = 0.04  # of the image's width: poles and wires are thinner
_THIN_LEVELS = 30.0  # of 255, darker than the sky around


def _luma(rgb: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)


def looks_like_sky(
    rgb: UInt8[np.ndarray, "H W 3"],
    candidates: Bool[np.ndarray, "H W"],
    window_px: int | None = None,
) -> Bool[np.ndarray, "H W"]:
    """Pixels as smooth and about as bright as the bright part of the candidates: clouds pass;
    walls, foliage and wires seldom do. window_px: in which contrast is measured, by default a
    hundredth of the width.
    """
    if not candidates.any():
        return np.zeros_like(candidates)
    side = window_px or 2 * max(1, round(_WINDOW_PART * rgb.shape[1] / 2)) + 1
    luma, window = _luma(rgb), (side, side)
    mean = cv2.blur(luma, window)
    smooth = cv2.blur(luma * luma, window) - mean * mean < _SMOOTH_LEVELS**2
    bright = float(np.quantile(luma[candidates], 0.9))
    return smooth & (mean > max(bright - _DARK_LEVELS, _MIN_LUMA))


def _cut(
    image: UInt8[np.ndarray, "H W 3"], labels: UInt8[np.ndarray, "H W"], rounds: int
) -> Bool[np.ndarray, "H W"]:
    """The graph cut's sky. labels: OpenCV's, of which the cut's take the place."""
    is_sky = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    if not is_sky.any() or is_sky.all():
        return is_sky
    cv2.setRNGSeed(0)  # this thread's: the colours' first clusters are drawn from it
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(image, labels, (0, 0, 1, 1), *models, rounds, cv2.GC_INIT_WITH_MASK)
    return (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)


def _grown(mask: np.ndarray, rows: int, columns: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((rows, columns), np.uint8)) > 0


def elevation_rad(camera: Camera) -> Float[np.ndarray, "H W"]:
    """Of every pixel's ray above the world's horizontal plane."""
    rays = camera.ray_directions().numpy()
    return np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))


def _sweep_points(scene: Scene, frame: int, dtype: type[np.floating]) -> np.ndarray | None:
    """Finite points [N, 3] of a frame's sweep in the scene's world; None without a sweep."""
    sweep = scene.lidar(frame)
    if sweep is None:
        return None
    points = (sweep.points_m - np.asarray(scene.world_origin_m)).astype(dtype)
    return points[np.isfinite(points).all(1)]


def _top_rad(points: np.ndarray, centre: np.ndarray, least: int = 1) -> float | None:
    """The highest elevation of returns that are not close, a few stray ones left out; None of fewer
    than `least`.
    """
    offset = points - centre
    distance_m = np.hypot(offset[:, 0], offset[:, 1])
    far = distance_m > _TOP_FROM_M
    if far.sum() < least:
        return None
    return float(np.quantile(np.arctan2(offset[far, 2], distance_m[far]), _TOP_QUANTILE))


# ---- By the image alone --------------------------------------------------------------------------


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
    solid = unknown = np.zeros(above.shape, bool)
    if hits is not None:
        solid = _grown(hits, _HIT_PX, _HIT_PX)
        reaches = np.any(hits & (elevation_rad > lidar_top_rad - TOP_MARGIN_RAD), axis=0)[None]
        over = np.cumsum(solid, axis=0) == 0  # above all returns of its column
        unknown = over & above & _grown(reaches, 1, _BESIDE_PX)
    bright = looks_like_sky(rgb, above, _WINDOW_PX)
    first = _reaching_top(bright & above & ~solid & ~unknown)
    if first.mean() < _MIN_PART:
        return None
    luma = _luma(rgb)
    shines = above & ~solid & ~unknown & (luma > np.median(luma[first]))  # lit clouds
    mask = np.full(above.shape, cv2.GC_PR_BGD, np.uint8)
    mask[~above | solid] = cv2.GC_BGD
    mask[first | shines] = cv2.GC_PR_FGD
    mask[cv2.erode(first.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0] = cv2.GC_FGD
    sky = first
    if (mask == cv2.GC_FGD).any() and (mask == cv2.GC_BGD).any():
        bgr = np.ascontiguousarray(rgb[..., ::-1])
        sky = _cut(bgr, mask, _CUTS) & above & ~unknown
    return RecordedSky(sky, ~(sky | unknown | shines))


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
    rgb = None if path is None else read_small_image(Path(path), camera)
    if rgb is None:
        return None
    points = memo_of(scene).get(("sweep", frame.index), lambda: (_sweep(scene, frame),))[0]
    if points is None:
        return find_sky(rgb, elevation_rad(camera))
    if isinstance(scene.labels, KnowsLidarTop):
        top_rad = scene.labels.lidar_top_rad
    else:
        top_rad = _top_rad(points, camera.centre.numpy().astype(np.float32))
    return find_sky(
        rgb, elevation_rad(camera), _hits(points, camera), math.inf if top_rad is None else top_rad
    )


def read_small_image(path: Path, camera: Camera) -> np.ndarray | None:
    """RGB of an image at the camera's size; None for what is no image of its proportions."""
    image = decode_image(path, cv2.IMREAD_REDUCED_COLOR_2)
    if image is None:
        return None
    height, width = image.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1) > _MAX_SQUEEZE:
        return None
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_BGR2RGB)


def _sweep(scene: Scene, frame: Frame) -> np.ndarray | None:
    try:
        return _sweep_points(scene, frame.index, np.float32)
    except Exception:  # a damaged sweep is its own frame's matter, and not that of the sky
        return None


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


# ---- By a raw scene, for those that learn from images --------------------------------------------


def lidar_top_rad(scene: Scene, frames: Sequence[int]) -> float | None:
    """Highest elevation that the LiDAR looks at, as cameras see it: what the labels know, or from
    the frames' returns (too low where nothing tall stood near); None without enough of them.
    """
    if isinstance(scene.labels, KnowsLidarTop):
        return scene.labels.lidar_top_rad
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
    """Pixels of the view that show sky; none where nothing can be known. scene: as initialised from
    LiDAR. returns: pixels with a LiDAR return.
    """
    none = np.zeros((camera.height, camera.width), np.bool_)
    if lidar_top_rad is None:
        return none
    alpha = rasterize(scene.parts_for(camera), camera, buffers=(ALPHA,)).alpha
    assert alpha is not None
    drawn = alpha.numpy() > _DRAWN_ALPHA
    hit = none.copy()
    hit.reshape(-1)[returns] = True  # also thin things that are not in the scene: wires, twigs
    free = _above_surfaces(camera, drawn | hit, lidar_top_rad)
    sure = free & looks_like_sky(rgb, free)
    rise = camera.ray_directions().numpy()[..., 2]
    above = (rise > 0) & ~hit
    likely = above & ~drawn & _as_bright_as_sky(rgb, free if free.any() else above)
    if not likely.any():
        return none
    labels = np.full(none.shape, cv2.GC_PR_BGD, np.uint8)
    labels[likely] = cv2.GC_PR_FGD
    labels[sure] = cv2.GC_FGD
    labels[~above] = cv2.GC_BGD
    small = _small(rgb, cv2.INTER_AREA), _small(labels, cv2.INTER_NEAREST)
    sky = _refined(rgb, _cut(*small, _MASK_CUTS)) & above & ~_grown(hit, 3, 3)
    return _joined_to(sky, sure) & ~_thin(rgb, sky)


def _as_bright_as_sky(rgb: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """What `looks_like_sky`, and clouds' edges: brighter than most of the candidates."""
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    if not candidates.any():
        return candidates
    bright = max(float(np.quantile(luma[candidates], 0.9)), _MIN_LUMA)
    return looks_like_sky(rgb, candidates) | (luma > bright)


def _small(image: np.ndarray, how: int) -> np.ndarray:
    """An image [H, W, ...] as the graph cut takes it."""
    height, width = image.shape[:2]
    across = min(_MASK_WIDTH, width)
    return cv2.resize(image, (across, max(1, round(height * across / width))), interpolation=how)


def _refined(rgb: np.ndarray, small: np.ndarray) -> np.ndarray:
    """The small mask at the image's size, along its edges."""
    height, width = rgb.shape[:2]
    mask = cv2.resize(small.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    radius = max(2, round(_EDGE_PART * width))
    return cv2.ximgproc.guidedFilter(rgb, mask, radius, _EDGE_LEVELS**2) > 0.5


def _joined_to(sky: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """The sky's connected pieces that are sure in part or reach the image's upper border: a bright
    window is neither. Wires part nothing.
    """
    border = max(2, round(_BORDER_PART * sky.shape[1]))
    grown = _grown(sky, 2 * border + 1, 2 * border + 1).astype(np.uint8)
    pieces = np.asarray(cv2.connectedComponents(grown, connectivity=4)[1], np.int32)
    kept = np.zeros(int(pieces.max()) + 1, np.bool_)
    kept[pieces[sure & sky]] = True
    kept[pieces[0][sky[0]]] = True
    return kept[pieces] & sky


def _thin(rgb: np.ndarray, sky: np.ndarray) -> np.ndarray:
    """Pixels clearly darker than the sky around them: poles, wires and twigs, which are too thin
    for the cut.
    """
    luma = _luma(rgb)
    side = (2 * round(_THIN_PART * rgb.shape[1] / 2) + 1,) * 2
    share = sky.astype(np.float32)
    mean = cv2.blur(luma * share, side) / np.maximum(cv2.blur(share, side), 1e-3)
    return luma < mean - _THIN_LEVELS


def _above_surfaces(camera: Camera, drawn: np.ndarray, lidar_top_rad: float) -> np.ndarray:
    """What lies above the top-most surface of its column, where that is sure to be its end."""
    border = max(2, round(_BORDER_PART * camera.width))
    solid = cv2.morphologyEx(
        drawn.astype(np.uint8), cv2.MORPH_OPEN, np.ones((_DRAWN_PIXELS, 1), np.uint8)
    )
    rays = camera.ray_directions().numpy()
    rise = rays[..., 2] / np.linalg.norm(rays, axis=2)
    last = len(drawn) - 1
    top = np.where(solid.any(axis=0), solid.argmax(axis=0), last)
    known = rise[top, np.arange(camera.width)] < math.sin(lidar_top_rad - TOP_MARGIN_RAD)
    # A column beside one whose surface goes on may show the same surface, leaning.
    known = cv2.erode(known.astype(np.uint8)[None], np.ones((1, 2 * border + 1), np.uint8))[0] > 0
    covered = np.maximum.accumulate(_grown(drawn, 2 * border + 1, 2 * border + 1), axis=0)
    return known[None] & ~covered
