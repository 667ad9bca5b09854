"""Which pixels of a camera's images show the recording car itself.

The recording car stays as it is while the road moves by. It is looked for from the image's bottom
upwards, where the road would be less than ten metres away. Only contrast along the road's apparent
motion counts: kerbs and lane lines that run with it stay as they are too. Smooth paint says nothing
by itself; it belongs to the edge above it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Bool

from augment.cameras import Camera
from augment.files.recorded_images import ImageFault, read_scaled
from augment.memo import memo_of
from augment.scene import Scene

T = TypeVar("T")

_WORK_WIDTH = 320  # columns of the images that are compared, at most
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
    above the horizon, or where the car shows no edge across the motion. The mask is of the first
    image's size; the sizes of the others may differ a little."""
    height, width = images[0].shape[:2] if images else (0, 0)
    if len(images) < _MIN_IMAGES:
        return np.zeros((height, width), np.bool_)
    across = min(_WORK_WIDTH, width)
    size = (across, max(1, round(height * across / width)))
    flow = cv2.resize(_road_flow(cameras), size, interpolation=cv2.INTER_NEAREST)
    evidence = _evidence(images, size, flow)
    top = _car_tops(evidence, np.isnan(flow[..., 0]))
    mask = (np.arange(size[1])[:, None] >= top[None]).astype(np.uint8)
    return cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST) > 0


def _road_flow(cameras: Sequence[Camera]) -> np.ndarray:
    """Direction in which the road would move at each pixel, unit float32 [h, w, 2], coarsely; NaN
    where it would be far away or hardly move. Images of other sizes are squeezed to the first's."""
    flows = []
    first = cameras[0].scaled(_FLOW_WIDTH / cameras[0].width)
    coarse = [camera.resized(first.width, first.height) for camera in cameras]
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


# ---- Of a scene's recorded images ----------------------------------------------------------------

_SCALE = 0.25  # of the images in which the recording car is looked for


def own_car_mask(scene: Scene, camera: Camera) -> Bool[np.ndarray, "H W"] | None:
    """Return the pixels of a recorded image that show the recording car; None where it shows none,
    or too few of the scene's images are there to tell. Found once for all images of a camera.

    Args:
        scene: whose frames have the images.
        camera: of the scene, at any scale, or a window of it.
    """
    found = memo_of(scene).get(("own car", camera.name), lambda: _find_own_car(scene, camera.name))
    if found is None:
        return None
    small, mask = found
    # The place of each pixel's centre in the small image.
    across = (np.arange(camera.width) + 0.5 - camera.cx) * (small.fx / camera.fx) + small.cx
    down = (np.arange(camera.height) + 0.5 - camera.cy) * (small.fy / camera.fy) + small.cy
    columns = np.clip(across.astype(int), 0, small.width - 1)
    rows = np.clip(down.astype(int), 0, small.height - 1)
    return mask[np.ix_(rows, columns)]


def _find_own_car(scene: Scene, name: str) -> tuple[Camera, np.ndarray] | None:
    """A camera at _SCALE and the mask of its images; None where these show no recording car."""
    frames = [f for f in scene.frames if name in f.cameras and name in f.image_paths]
    frames = [frames[i] for i in moving_frames([f.cameras[name] for f in frames])]
    cameras, images = [], []
    for frame in frames:
        full = frame.cameras[name]
        try:
            image = read_scaled(Path(frame.image_paths[name]), full, full.scaled(_SCALE))
        except ImageFault:
            continue
        cameras.append(full)
        images.append(image)
    if len({image.shape for image in images}) != 1:  # none, or of several sizes
        return None
    mask = find_ego_mask(cameras, images)
    return (cameras[0].scaled(_SCALE), mask) if mask.any() else None
