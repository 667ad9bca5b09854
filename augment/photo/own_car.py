"""Pixels of a camera's images that show the recording car itself.

In: the images of one camera, in the order in which the car moved. Out: a bool mask
(`find_own_car_mask`; `own_car_mask` for a scene's recorded images, where a user's masks come
first). `augment.view.render_view` keeps the weather off these pixels, and labels leave them out;
training views leave them out of the loss.

The recording car stays as it is while the road moves by. It is looked for from the image's bottom
upwards, where the road would be less than ten metres away. Only contrast along the road's apparent
motion counts, since kerbs and lane lines that run along it stay as they are, too. Smooth paint says
nothing by itself; it belongs to the edge above it. Where the car did not move, the edge itself has
to tell (`augment.photo.own_car_outline`), which also brings the outline to the pixel.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

from augment.files.recorded_images import ImageFault, read_scaled
from augment.memo import memo_of
from augment.photo.own_car_outline import find_symmetric_outline, refine_outline
from augment.scene.cameras import Camera, Frame
from augment.scene.pixel_rays import turn_between, turned_rays
from augment.scene.scene import Scene

T = TypeVar("T")

# Columns of the images that are compared, at most.
_WORK_WIDTH = 320
# Images that are compared, at most.
MAX_IMAGES = 24
# Images without which motion tells nothing.
_MIN_IMAGES = 6
# Distance between the places of compared images, metres.
_STEP_M = 0.25
# The same in a clip that is too short for that many steps.
_SHORT_STEP_M = 0.12
# Height of a camera above the road, about, metres.
_CAMERA_HEIGHT_M = 1.6
# Distance within which the road is looked at, metres: nobody follows another car this closely for a
# whole drive.
_REACH_M = 10.0
# Columns of the coarse image in which the road's motion is computed.
_FLOW_WIDTH = 80
# Motion of the road that counts, at least, pixels of the coarse image.
_MIN_MOTION_PX = 0.25
# Contrast that counts fully, levels of 255 a pixel.
_CONTRAST = 2.0
# Share of the energy across the motion that may appear along it.
_LEAK = 0.06
# Share of the contrast that stays at which evidence is zero: less speaks against, more for the car.
_STAYS = 0.4
# Side of the window in which evidence is averaged, pixels.
_WINDOW = 7
# Pixels by which the averaging window reaches over the car's edge.
_OVERREACH = 2
# Weight of evidence against the car.
_AGAINST = 0.2
# Evidence that a step by a row between two columns must be worth.
_STEP_COST = 0.1
# Cost of any step, at most, as a part of the height.
_JUMP_PART = 0.05
# Mean evidence of a column without which there is no car, as a part of the height.
_MIN_PART = 0.004
# Width of the car, at least, as a part of the image's width.
_MIN_WIDTH = 0.15
# Cosine between a camera's axis and the car's from which the car looks symmetric.
_MIN_AXIS_COSINE = 0.9
# Median distance between the outlines by motion and by the edge up to which they agree, a part of
# the height. The one by motion lies above the car by up to a window.
_MAX_DISTANCE = 0.05


def moving_frames(cameras: Sequence[Camera]) -> list[int]:
    """Return positions of at most MAX_IMAGES images of a drive, in order, between which it moved.

    Images of a car that stood still are all alike; some of them are returned.
    """
    positions = _positions_apart(cameras, _STEP_M)
    if len(positions) < _MIN_IMAGES:
        positions = _positions_apart(cameras, _SHORT_STEP_M)
    if len(positions) < _MIN_IMAGES:
        positions = list(range(len(cameras)))
    return spread_evenly(positions, MAX_IMAGES)


def _positions_apart(cameras: Sequence[Camera], step_m: float) -> list[int]:
    """Return the positions of images that lie a step apart along the drive."""
    positions: list[int] = []
    last_centre = None
    for i, camera in enumerate(cameras):
        centre = camera.centre.numpy()
        if last_centre is None or np.linalg.norm(centre - last_centre) >= step_m:
            positions.append(i)
            last_centre = centre
    return positions


def spread_evenly(items: Sequence[T], count: int) -> list[T]:
    """Return at most `count` of the items, evenly spread, with the first and the last."""
    places = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[i] for i in places]


def find_own_car_mask(
    cameras: Sequence[Camera],
    images: Sequence[np.ndarray],
    world_from_egos: Sequence[Tensor] | None = None,
) -> np.ndarray:
    """Return the pixels that show the recording car, bool [H, W].

    Nothing is found above the horizon, where the car shows no edge across the motion, or, in images
    of a car that stood still, where the camera does not look along the car's axis.

    Args:
        cameras: the camera at each image.
        images: images of one camera, uint8 [H, W, 3], in the order in which the car moved
            (`moving_frames`); their sizes may differ a little.
        world_from_egos: pose of the car at each image, float64 [4, 4]; None where unknown.

    Returns:
        The mask, at the first image's size.
    """
    height, width = images[0].shape[:2] if images else (0, 0)
    tops = find_own_car_outline(cameras, images, world_from_egos)
    if tops is None:
        return np.zeros((height, width), np.bool_)
    return np.arange(height)[:, None] + 0.5 >= tops[None]


def find_own_car_outline(
    cameras: Sequence[Camera],
    images: Sequence[np.ndarray],
    world_from_egos: Sequence[Tensor] | None = None,
) -> Float64[np.ndarray, " W"] | None:
    """Return the first row of the recording car in each column; None where nothing tells it.

    Rows are pixels of the first image; its height stands for a column without the car. The
    arguments are those of `find_own_car_mask`.
    """
    if not images:
        return None
    height, width = images[0].shape[:2]
    images = [_in_size(image, (width, height)) for image in images]
    rough_tops = _outline_by_motion(cameras, images)
    axis = _axis_in(cameras[0], None if world_from_egos is None else world_from_egos[0])
    edge_tops = None if axis is None else find_symmetric_outline(images, *axis)
    if edge_tops is None:
        return None if rough_tops is None else refine_outline(images, rough_tops)
    if rough_tops is not None and _distance(rough_tops, edge_tops) > _MAX_DISTANCE:
        return refine_outline(images, rough_tops)
    return refine_outline(images, edge_tops, by_edge=True)


def _outline_by_motion(
    cameras: Sequence[Camera], images: Sequence[np.ndarray]
) -> Float64[np.ndarray, " w"] | None:
    """Return a rough outline, as parts of the height, of what stays while the road moves by.

    None where the car did not move, or where it is not visible.
    """
    if len(images) < _MIN_IMAGES:
        return None
    height, width = images[0].shape[:2]
    num_columns = min(_WORK_WIDTH, width)
    size = (num_columns, max(1, round(height * num_columns / width)))
    flow = cv2.resize(_road_flow(cameras), size, interpolation=cv2.INTER_NEAREST)
    is_unknown = np.isnan(flow[..., 0])
    if is_unknown.all():
        return None
    car_tops = _car_tops(_evidence(images, size, flow), is_unknown)
    return car_tops / size[1] if (car_tops < size[1]).any() else None


def _distance(tops: np.ndarray, edge_tops: np.ndarray) -> float:
    """Return the median distance of two outlines, as a part of the height."""
    places = (np.arange(len(tops)) + 0.5) / len(tops)
    edge_places = (np.arange(len(edge_tops)) + 0.5) / len(edge_tops)
    edge_rows = np.minimum(np.interp(places, edge_places, edge_tops), 1)
    return float(np.median(np.abs(edge_rows - tops)))


def _in_size(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the image at a width and height."""
    if image.shape[1::-1] == size:
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _axis_in(camera: Camera, world_from_ego: Tensor | None) -> tuple[float, float] | None:
    """Return the column in which the car's axis vanishes, and the row from which the road below it
    would be less than _REACH_M away, as parts of the width and height.

    None where the camera does not look along the axis, or where the car's pose is not known.
    """
    if world_from_ego is None:
        return None
    axis = (camera.camera_from_world[:3, :3] @ world_from_ego[:3, 0]).tolist()
    if abs(axis[2]) < _MIN_AXIS_COSINE:
        return None
    column = camera.fx * axis[0] / axis[2] + camera.cx
    # The road's point at that distance ahead or behind, in the camera's axes.
    ahead = math.copysign(_REACH_M, axis[2])
    down = camera.camera_from_world[:3, :3] @ world_from_ego[:3, 2] * -_CAMERA_HEIGHT_M
    point = (ahead * torch.tensor(axis, dtype=down.dtype) + down).tolist()
    row = camera.fy * point[1] / point[2] + camera.cy
    return column / camera.width, row / camera.height


def _road_flow(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the direction in which the road would move at each pixel, unit float32 [h, w, 2].

    It is coarse, and NaN where the road would be far away or hardly move. Images of other sizes are
    squeezed to the first's.
    """
    flows = []
    first_camera = cameras[0].scaled(_FLOW_WIDTH / cameras[0].width)
    coarse_cameras = [camera.resized(first_camera.width, first_camera.height) for camera in cameras]
    for camera, next_camera in itertools.pairwise(coarse_cameras):
        rays = camera.ray_directions().double().numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            ray_scale = -_CAMERA_HEIGHT_M / rays[..., 2]
            is_far = ray_scale * np.hypot(rays[..., 0], rays[..., 1]) > _REACH_M
        ray_scale[(rays[..., 2] >= 0) | is_far] = np.nan
        points = camera.centre.numpy() + ray_scale[..., None] * rays
        pose = next_camera.camera_from_world.numpy()
        local = points @ pose[:3, :3].T + pose[:3, 3]
        local[local[..., 2] < 0.1] = np.nan
        u = next_camera.fx * local[..., 0] / local[..., 2] + next_camera.cx
        v = next_camera.fy * local[..., 1] / local[..., 2] + next_camera.cy
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        flows.append(np.stack([u - columns, v - rows], -1))
    mean = np.mean(flows, axis=0)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.where(length >= _MIN_MOTION_PX, mean / length, np.nan).astype(np.float32)


def _evidence(images: Sequence[np.ndarray], size: tuple[int, int], flow: np.ndarray) -> np.ndarray:
    """Return the evidence for the car at each pixel, float32 [H, W].

    It goes from -_STAYS, against the car, to 1 - _STAYS, for it.
    """
    direction = np.nan_to_num(flow)
    mean = np.zeros(size[::-1], np.float32)
    energy = np.zeros(size[::-1], np.float32)  # of contrast along the motion
    energy_across = np.zeros(size[::-1], np.float32)  # of contrast across it
    for image in images:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
        dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8)
        dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8)
        slope = dx * direction[..., 0] + dy * direction[..., 1]
        mean += slope / len(images)
        energy += slope * slope / len(images)
        energy_across += (dx * direction[..., 1] - dy * direction[..., 0]) ** 2 / len(images)
    window = (_WINDOW, _WINDOW)
    mean_energy = cv2.blur(energy, window)
    # Chance alone leaves 1 / N of the energy in the mean of N images.
    static_share = (
        cv2.blur(mean * mean, window) / np.maximum(mean_energy, 1e-6) - 1 / len(images)
    ) / (1 - 1 / len(images))
    # Lines along the motion have some contrast along it, too: they are rough, and the motion is
    # not exact.
    motion_energy = np.maximum(mean_energy - np.float32(_LEAK) * cv2.blur(energy_across, window), 0)
    strength = np.minimum(np.sqrt(motion_energy) / np.float32(_CONTRAST), 1)
    return (static_share - np.float32(_STAYS)) * strength


def _car_tops(evidence: np.ndarray, is_unknown: np.ndarray) -> np.ndarray:
    """Return the first row of the car in each column, int [W]; the height where there is none.

    Of all lines through the columns it is the one with most evidence below it and fewest steps
    (Viterbi).
    """
    height, width = evidence.shape
    first_row = int((~is_unknown).any(axis=1).argmax())  # the rows above cannot be the car
    evidence = evidence[first_row:]
    is_unknown = is_unknown[first_row:]
    rows_left = len(evidence)
    # What is reflected in paint moves, so that evidence against the car counts less.
    weighted = np.where(evidence > 0, evidence, _AGAINST * evidence)
    score = np.zeros((rows_left + 1, width))
    score[:-1] = np.cumsum(weighted[::-1], axis=0)[::-1]
    # Above the first unknown row, from below, nothing can be known.
    score[:-1][np.logical_or.accumulate(is_unknown[::-1], axis=0)[::-1]] = -np.inf
    rows = np.arange(rows_left + 1)
    step = np.minimum(_STEP_COST * np.abs(rows[:, None] - rows), _JUMP_PART * height)
    best_scores = score[:, 0]
    came_from = np.zeros((width, rows_left + 1), np.int64)
    for x in range(1, width):
        scores = best_scores[None] - step
        came_from[x] = scores.argmax(axis=1)
        best_scores = scores[rows, came_from[x]] + score[:, x]
    top_row = np.empty(width, np.int64)
    top_row[-1] = best_scores.argmax()
    for x in range(width - 1, 0, -1):
        top_row[x - 1] = came_from[x, top_row[x]]
    # The window the evidence was averaged in reaches over the edge.
    top_row = np.minimum(top_row + _OVERREACH, rows_left)
    gain = score[top_row, np.arange(width)]
    is_found = (top_row < rows_left).mean() >= _MIN_WIDTH and gain.mean() >= _MIN_PART * height
    return first_row + top_row if is_found else np.full(width, height)


# ---- The recording car in a scene's recorded images ----------------------------------------------

# Scale of the images in which the recording car is looked for.
_SCALE = 0.5
# Width of the border outside the car in which the weather begins, pixels.
_BORDER_PX = 2


def own_car_mask(
    scene: Scene, camera: Camera, lens_camera: Camera | None = None
) -> Bool[np.ndarray, "H W"] | None:
    """Return the pixels of a recorded image that show the recording car.

    They are a user's (`Scene.ego_masks`) or, without those, what the images tell. None where the
    images show no car, or where too little tells. The mask is found once for all images of a
    camera.

    Args:
        scene: the scene, whose frames have the images.
        camera: a camera of the scene, at any scale, or a window of it.
        lens_camera: the camera through whose lens the image was recorded, if `camera` is a view of
            this image, which may be turned.
    """
    scene = scene.as_recorded
    shape = memo_of(scene).get(("own car", camera.name), lambda: _shape_in(scene, camera.name))
    if shape is None:
        return None
    turn = None if lens_camera is None else turn_between(lens_camera, camera)
    if turn is not None and not np.array_equal(turn, np.eye(3)):
        return _mask_in_turned_view(shape, camera, turn)
    # The place of each pixel's centre in the image of the shape.
    columns = (np.arange(camera.width) + 0.5 - camera.cx) * (
        shape.camera.fx / camera.fx
    ) + shape.camera.cx
    rows = (np.arange(camera.height) + 0.5 - camera.cy) * (
        shape.camera.fy / camera.fy
    ) + shape.camera.cy
    if shape.mask is None:
        assert shape.tops is not None
        tops = np.interp(columns, np.arange(len(shape.tops)) + 0.5, shape.tops)
        return rows[:, None] >= tops
    # OpenCV's pixels are centred at whole numbers.
    places = np.meshgrid((columns - 0.5).astype(np.float32), (rows - 0.5).astype(np.float32))
    border = cv2.BORDER_REPLICATE
    share = cv2.remap(shape.mask.astype(np.float32), *places, cv2.INTER_LINEAR, borderMode=border)
    return share >= 0.5


def _mask_in_turned_view(
    shape: _CarShape, camera: Camera, turn: np.ndarray
) -> Bool[np.ndarray, "H W"]:
    """Return the pixels of a turned view that show the recording car.

    Args:
        shape: the car in images.
        camera: the view.
        turn: rotation from the view's axes to those of the images, [3, 3].
    """
    rays = turned_rays(camera, turn)
    is_ahead = rays[..., 2] > 0
    z = np.where(is_ahead, rays[..., 2], 1.0)
    u = shape.camera.fx * rays[..., 0] / z + shape.camera.cx
    v = shape.camera.fy * rays[..., 1] / z + shape.camera.cy
    if shape.mask is None:
        assert shape.tops is not None
        tops = np.interp(u, np.arange(len(shape.tops)) + 0.5, shape.tops)
        return is_ahead & (v >= tops)
    far = 4.0 * max(shape.camera.width, shape.camera.height)
    places = (
        (u.clip(-far, far) - 0.5).astype(np.float32),
        (v.clip(-far, far) - 0.5).astype(np.float32),
    )
    border = cv2.BORDER_REPLICATE
    share = cv2.remap(shape.mask.astype(np.float32), *places, cv2.INTER_LINEAR, borderMode=border)
    return is_ahead & (share >= 0.5)


@dataclass(frozen=True, eq=False)
class _CarShape:
    """Shape of the recording car in the images of one camera: an outline or a mask."""

    camera: Camera
    """Camera at the size of the shape."""
    tops: Float64[np.ndarray, " W"] | None = None
    """First row of the car in each column, below which all pixels show it."""
    mask: Bool[np.ndarray, "H W"] | None = None
    """Pixels that show the car."""


@dataclass(frozen=True, eq=False)
class OwnCar:
    """Recording car in the pixels of one view."""

    mask: Bool[np.ndarray, "H W"]
    """Pixels that show the car."""
    rows: slice
    """Rows with weights above 0."""
    weights: Float32[np.ndarray, "h W"]
    """Weight of the car's colours in these rows: 1 in the mask, less in a narrow border around it,
    0 elsewhere."""

    def mask_at(self, width: int, height: int) -> Bool[np.ndarray, "h w"]:
        """Return the pixels of a smaller image that show some of the car.

        Args:
            width: width of the smaller image, pixels.
            height: height of the smaller image, pixels.
        """
        area = cv2.resize(
            self.mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA
        )
        return area > 0


def own_car_in_view(
    scene: Scene, camera: Camera, lens_camera: Camera | None = None
) -> OwnCar | None:
    """Return the recording car in a view of recorded images; None where they show none.

    The result is computed once for all images of a camera.

    Args:
        scene: the scene, whose frames have the images.
        camera: a camera of the scene, at any scale, or a window of it.
        lens_camera: see `own_car_mask`.
    """

    def make() -> tuple[OwnCar | None]:  # a value that is None would be made again
        mask = own_car_mask(scene, camera, lens_camera)
        if mask is None or not mask.any():
            return (None,)
        distance_px = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
        weights = np.clip(1 - distance_px / np.float32(_BORDER_PX + 1), 0, 1)
        rows_with_car = np.flatnonzero((weights > 0).any(axis=1))
        rows = slice(int(rows_with_car[0]), int(rows_with_car[-1]) + 1)
        return (OwnCar(mask, rows, np.ascontiguousarray(weights[rows])),)

    lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    turn = np.eye(3) if lens_camera is None else turn_between(lens_camera, camera)
    key = ("own car in view", camera.name, *lens, turn.tobytes())
    return memo_of(scene.as_recorded).get(key, make)[0]


def _shape_in(scene: Scene, name: str) -> _CarShape | None:
    """Return the car's shape in the images of a camera; None where these show no car."""
    if scene.ego_masks is None:
        return _find_own_car(scene, name)
    mask = scene.ego_masks.get(name)
    images = _image_frames(scene, name)
    camera = next((f.cameras[name] for f in (*images, *scene.frames) if name in f.cameras), None)
    if mask is None or camera is None or not mask.any():
        return None
    return _CarShape(camera.resized(mask.shape[1], mask.shape[0]), mask=mask)


def _image_frames(scene: Scene, name: str) -> list[Frame]:
    """Return the frames in which the camera of this name has an image of a pinhole.

    Where a scene shows images with their lenses, these are the frames with the undistorted copies.
    """
    frames, copies = (
        [f for f in of_scene if name in f.image_paths and name in f.cameras]
        for of_scene in (scene.frames, scene.seen_frames or ())
    )
    return [f for f in (copies if frames and copies else frames) if f.cameras[name].is_pinhole]


def _find_own_car(scene: Scene, name: str) -> _CarShape | None:
    """Return the outline that a camera's images at _SCALE tell; None where they tell none."""
    frames = _image_frames(scene, name)
    frames = [frames[i] for i in moving_frames([f.cameras[name] for f in frames])]
    cameras = []
    images = []
    world_from_egos = []
    for frame in frames:
        camera = frame.cameras[name]
        try:
            image = read_scaled(Path(frame.image_paths[name]), camera, camera.scaled(_SCALE))
        except ImageFault:
            continue
        cameras.append(camera)
        images.append(image)
        world_from_egos.append(frame.world_from_ego)
    if len({image.shape for image in images}) != 1:  # none, or of several sizes
        return None
    tops = find_own_car_outline(cameras, images, world_from_egos)
    return None if tops is None else _CarShape(cameras[0].scaled(_SCALE), tops=tops)
