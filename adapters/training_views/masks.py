"""Which pixels of a recorded image show sky, and which show the recording car itself.

Sky: a column of the image is known where the surfaces drawn in it end below the LiDAR's highest
view: the LiDAR looked over them and met nothing. Where they reach that view, a wall may go on
above, and the image decides: what is known says what sky and surfaces look like, and a graph cut
finds the border between them (Rother et al. 2004, GrabCut) on a small image; a guided filter (He
et al. 2010) brings it to the edges of the large one.

The recording car stays as it is while the road moves by. It is looked for from the image's bottom
upwards, where the road would be less than ten metres away. Only contrast along the road's apparent
motion counts: kerbs and lane lines that run with it stay as they are too. Smooth paint says nothing
by itself; it belongs to the edge above it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from adapters.lidar_scene.depth import read_returns
from adapters.plain_files import decode_image
from augment.cameras import Camera
from augment.errors import AdapterError
from augment.render.buffers import ALPHA
from augment.render.rasterize import rasterize
from augment.scene import Scene

T = TypeVar("T")

_TOP_MARGIN_RAD = math.radians(4.0)  # the camera is not where the LiDAR is
_FAR_M = 10.0  # from here on LiDAR and cameras see a return at nearly the same elevation
_TOP_QUANTILE = 0.999  # a few returns are stray
_ENOUGH_RETURNS = 5000
_DRAWN_ALPHA = 0.05
_DRAWN_PIXELS = 3  # fewer covered pixels one above another are no surface's edge
_BORDER_PART = 0.008  # of the image's width, that surfaces are grown by: splats end a little early
_SMOOTH_LEVELS = 6.0  # of 255: standard deviation within a small window
_WINDOW_PART = 0.01  # of the image's width
_DARK_LEVELS = 70.0  # of 255: this much darker than the image's bright sky is none
_MIN_LUMA = 90.0
_CUT_WIDTH = 240  # columns of the image that the graph cut works on, at most
_CUT_ROUNDS = 3
_CUT_SEED = 0  # of OpenCV's k-means: the same image has the same mask
_EDGE_PART = 0.015  # of the image's width: radius of the guided filter
_EDGE_LEVELS = 8.0  # of 255: smaller steps of the image are no edges to it
_THIN_PART = 0.04  # of the image's width: poles and wires are thinner
_THIN_LEVELS = 30.0  # of 255, darker than the sky around

WORK_WIDTH = 320  # columns of the images that are compared, at most
MAX_IMAGES = 24
_MIN_IMAGES = 6
_STEP_M = 0.25  # images are compared that were taken this far apart
_CAMERA_HEIGHT_M = 1.6  # above the road, about
_REACH_M = 10.0  # nobody follows another car this closely for a whole drive
_FLOW_WIDTH = 80
_MIN_MOTION_PX = 0.25  # of an image as wide as that
_CONTRAST = 2.0  # of 255 a pixel: what counts fully
_LEAK = 0.06  # of the energy at right angles to the motion that may appear along it
_STAYS = 0.4  # part of the contrast that stays: less speaks against, more for the car
_WINDOW = 7
_OVERREACH = 2
_AGAINST = 0.2
_STEP_COST = 0.1  # evidence that a step by a row between two columns must be worth
_JUMP_PART = 0.05  # of the height: what any step costs at most
_MIN_PART = 0.004  # of the height: mean evidence of a column without which there is no car
_MIN_WIDTH = 0.15  # of the image's width
_WHITE = 128


def lidar_top_rad(scene: Scene, frames: Sequence[int]) -> float | None:
    """Highest elevation that the LiDAR looks at, as cameras see it, from the frames' returns (too
    low where nothing tall stood near); None without enough of them."""
    tops = []
    for index in frames:
        frame = scene.frame(index)
        returns = read_returns(scene, index)
        if returns is None or not frame.cameras:
            continue
        centre = np.mean([camera.centre.numpy() for camera in frame.cameras.values()], axis=0)
        offset = returns.points - centre
        distance_m = np.hypot(offset[:, 0], offset[:, 1])
        far = distance_m > _FAR_M
        if far.sum() >= _ENOUGH_RETURNS:
            rise = np.arctan2(offset[far, 2], distance_m[far])
            tops.append(float(np.quantile(rise, _TOP_QUANTILE)))
    return float(np.median(tops)) if tops else None


def sky_mask(
    scene: Scene, camera: Camera, rgb: np.ndarray, returns: np.ndarray, lidar_top_rad: float | None
) -> np.ndarray:
    """Pixels of the view that show sky, bool [H, W]; none where nothing can be known. scene: as
    initialised from LiDAR. rgb: uint8 [H, W, 3]. returns: int [M], pixels with a LiDAR return."""
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
    beside = cv2.dilate(hit.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    sky = _refined(rgb, _cut(rgb, labels)) & above & ~beside
    return _joined_to(sky, sure) & ~_thin(rgb, sky)


def _as_bright_as_sky(rgb: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """What `looks_like_sky`, and clouds' edges: brighter than most of the candidates."""
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    if not candidates.any():
        return candidates
    bright = max(float(np.quantile(luma[candidates], 0.9)), _MIN_LUMA)
    return looks_like_sky(rgb, candidates) | (luma > bright)


def _cut(rgb: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """The graph cut's sky, bool at the small size. labels: OpenCV's, uint8 [H, W]."""
    height, width = labels.shape
    across = min(_CUT_WIDTH, width)
    size = (across, max(1, round(height * across / width)))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    labels = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    is_sky = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    if is_sky.any() and not is_sky.all():
        cv2.setRNGSeed(_CUT_SEED)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        whole = (0, 0, *size)
        cv2.grabCut(small, labels, whole, *models, _CUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
        is_sky = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    return is_sky


def _refined(rgb: np.ndarray, small: np.ndarray) -> np.ndarray:
    """The small mask at the image's size, along its edges."""
    height, width = rgb.shape[:2]
    mask = cv2.resize(small.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    radius = max(2, round(_EDGE_PART * width))
    return cv2.ximgproc.guidedFilter(rgb, mask, radius, _EDGE_LEVELS**2) > 0.5


def _joined_to(sky: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """The sky's connected pieces that are sure in part or reach the image's upper border: a bright
    window is neither. Wires part nothing."""
    border = max(2, round(_BORDER_PART * sky.shape[1]))
    grown = cv2.dilate(sky.astype(np.uint8), np.ones((2 * border + 1,) * 2, np.uint8))
    pieces = np.asarray(cv2.connectedComponents(grown, connectivity=4)[1], np.int32)
    kept = np.zeros(int(pieces.max()) + 1, np.bool_)
    kept[pieces[sure & sky]] = True
    kept[pieces[0][sky[0]]] = True
    return kept[pieces] & sky


def _thin(rgb: np.ndarray, sky: np.ndarray) -> np.ndarray:
    """Pixels clearly darker than the sky around them: poles, wires and twigs, which are too thin
    for the cut."""
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
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
    known = rise[top, np.arange(camera.width)] < math.sin(lidar_top_rad - _TOP_MARGIN_RAD)
    # A column beside one whose surface goes on may show the same surface, leaning.
    known = cv2.erode(known.astype(np.uint8)[None], np.ones((1, 2 * border + 1), np.uint8))[0] > 0
    grown = cv2.dilate(drawn.astype(np.uint8), np.ones((2 * border + 1,) * 2, np.uint8))
    covered = np.maximum.accumulate(grown, axis=0) > 0
    return known[None] & ~covered


def looks_like_sky(rgb: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Pixels as smooth and about as bright as the bright part of the candidates, bool [H, W]:
    clouds pass; walls, foliage and wires seldom do."""
    if not candidates.any():
        return np.zeros_like(candidates)
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    side = 2 * max(1, round(_WINDOW_PART * rgb.shape[1] / 2)) + 1
    mean = cv2.blur(luma, (side, side))
    variance = cv2.blur(luma * luma, (side, side)) - mean * mean
    smooth = variance < _SMOOTH_LEVELS**2
    bright = float(np.quantile(luma[candidates], 0.9))
    return smooth & (mean > max(bright - _DARK_LEVELS, _MIN_LUMA))


def moving_frames(cameras: Sequence[Camera]) -> list[int]:
    """Positions of at most MAX_IMAGES images of a drive, in order, between which it moved."""
    chosen: list[int] = []
    last = None
    for i, camera in enumerate(cameras):
        centre = camera.centre.numpy()
        if last is None or np.linalg.norm(centre - last) >= _STEP_M:
            chosen.append(i)
            last = centre
    return spread(chosen, MAX_IMAGES)


def spread(items: Sequence[T], count: int) -> list[T]:
    """At most so many of the items, evenly spread, the first and the last among them."""
    places = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[i] for i in places]


def find_ego_mask(cameras: Sequence[Camera], images: Sequence[np.ndarray]) -> np.ndarray:
    """Pixels that show the recording car, bool [H, W], from one camera's images uint8 [H, W, 3] in
    the order in which the car moved (see `moving_frames`). Nothing is found in fewer than six,
    above the horizon, or where the car shows no edge across the motion."""
    height, width = images[0].shape[:2] if images else (0, 0)
    if len(images) < _MIN_IMAGES:
        return np.zeros((height, width), np.bool_)
    across = min(WORK_WIDTH, width)
    size = (across, max(1, round(height * across / width)))
    flow = cv2.resize(_road_flow(cameras), size, interpolation=cv2.INTER_NEAREST)
    evidence = _evidence(images, size, flow)
    top = _car_tops(evidence, np.isnan(flow[..., 0]))
    mask = (np.arange(size[1])[:, None] >= top[None]).astype(np.uint8)
    return cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST) > 0


def _road_flow(cameras: Sequence[Camera]) -> np.ndarray:
    """Direction in which the road would move at each pixel, unit float32 [h, w, 2], coarsely; NaN
    where it would be far away or hardly move."""
    flows = []
    coarse = [camera.scaled(_FLOW_WIDTH / camera.width) for camera in cameras]
    for camera, after in itertools.pairwise(coarse):
        rays = camera.ray_directions().double().numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -_CAMERA_HEIGHT_M / rays[..., 2]
            far = along * np.hypot(rays[..., 0], rays[..., 1]) > _REACH_M
        along[(rays[..., 2] >= 0) | far] = np.nan
        points = camera.centre.numpy() + along[..., None] * rays
        pose = after.camera_from_world.numpy()
        local = points @ pose[:3, :3].T + pose[:3, 3]
        local[local[..., 2] < 0.1] = np.nan
        u = after.fx * local[..., 0] / local[..., 2] + after.cx
        v = after.fy * local[..., 1] / local[..., 2] + after.cy
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        flows.append(np.stack([u - columns, v - rows], -1))
    mean = np.mean(flows, axis=0)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.where(length >= _MIN_MOTION_PX, mean / length, np.nan).astype(np.float32)


def _evidence(images: Sequence[np.ndarray], size: tuple[int, int], flow: np.ndarray) -> np.ndarray:
    """For (up to 1 - _STAYS) or against (down to -_STAYS) the car at each pixel, float32 [H, W]."""
    direction = np.nan_to_num(flow)
    mean = np.zeros(size[::-1], np.float32)
    energy = np.zeros(size[::-1], np.float32)  # of the contrast along the motion
    beside = np.zeros(size[::-1], np.float32)  # and of that at right angles to it
    for image in images:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
        dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8)
        dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8)
        slope = dx * direction[..., 0] + dy * direction[..., 1]
        mean += slope / len(images)
        energy += slope * slope / len(images)
        beside += (dx * direction[..., 1] - dy * direction[..., 0]) ** 2 / len(images)
    window = (_WINDOW, _WINDOW)
    total = cv2.blur(energy, window)
    # Chance alone leaves 1 / N of the energy in the mean of N images.
    stays = (cv2.blur(mean * mean, window) / np.maximum(total, 1e-6) - 1 / len(images)) / (
        1 - 1 / len(images)
    )
    # Lines along the motion have some contrast along it too: they are rough, and it is not exact.
    along = np.maximum(total - np.float32(_LEAK) * cv2.blur(beside, window), 0)
    strength = np.minimum(np.sqrt(along) / np.float32(_CONTRAST), 1)
    return (stays - np.float32(_STAYS)) * strength


def _car_tops(evidence: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """The first row of the car in each column, int [W]; the height where there is none: of all
    lines through the columns that of most evidence below it and fewest steps (Viterbi)."""
    height, width = evidence.shape
    first = int((~unknown).any(axis=1).argmax())  # the rows above cannot be the car
    evidence, unknown = evidence[first:], unknown[first:]
    rows_left = len(evidence)
    # What is reflected in paint moves, so that evidence against the car counts less.
    weighed = np.where(evidence > 0, evidence, _AGAINST * evidence)
    score = np.zeros((rows_left + 1, width))
    score[:-1] = np.cumsum(weighed[::-1], axis=0)[::-1]
    # Beyond the first unknown row from below nothing can be known.
    score[:-1][np.logical_or.accumulate(unknown[::-1], axis=0)[::-1]] = -np.inf
    rows = np.arange(rows_left + 1)
    step = np.minimum(_STEP_COST * np.abs(rows[:, None] - rows), _JUMP_PART * height)
    best = score[:, 0]
    came_from = np.zeros((width, rows_left + 1), np.int64)
    for x in range(1, width):
        scores = best[None] - step
        came_from[x] = scores.argmax(axis=1)
        best = scores[rows, came_from[x]] + score[:, x]
    top = np.empty(width, np.int64)
    top[-1] = best.argmax()
    for x in range(width - 1, 0, -1):
        top[x - 1] = came_from[x, top[x]]
    # The window the evidence was averaged in reaches over the edge.
    top = np.minimum(top + _OVERREACH, rows_left)
    gain = score[top, np.arange(width)]
    enough = (top < rows_left).mean() >= _MIN_WIDTH and gain.mean() >= _MIN_PART * height
    return first + top if enough else np.full(width, height)


def read_ego_mask(path: Path, camera: Camera) -> np.ndarray:
    """A mask image, white where the camera sees the recording car, at the camera's size."""
    image = decode_image(path, cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise AdapterError(f"{path} cannot be decoded; expected an image, white on the own car")
    error = (image.shape[1] / image.shape[0]) / (camera.width / camera.height) - 1
    if abs(error) > 0.01:
        raise AdapterError(
            f"{path} is of {image.shape[1]}x{image.shape[0]} pixels; the mask of camera "
            f"{camera.name!r} has the proportions of its images, {camera.width}x{camera.height}"
        )
    size = (camera.width, camera.height)
    how = cv2.INTER_AREA if image.shape[1] >= camera.width else cv2.INTER_LINEAR
    # Any part of a pixel on the car spoils it.
    return cv2.resize(image, size, interpolation=how) >= _WHITE // 2
