"""Colours of surfels and of the sky from the recorded images, in one pass over all images of a
drive.

The caller is `adapters.lidar_scene.scene`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from tqdm import tqdm

from adapters.lidar_scene import kernels
from adapters.lidar_scene.kernels import SkyGatherer, row_slices
from adapters.lidar_scene.split import ObjectTrack
from adapters.lidar_scene.surfels import Surfels
from adapters.plain_files import decode_image
from augment.jobs.processes import available_cores
from augment.scene.cameras import Camera

DEPTH_WIDTH = 480  # columns of the z-buffers
DISC_PER_SPACING = 0.75  # radius of a disc in units of the spacing: neighbours overlap
_LEVELS = 5  # sizes of an image in its pyramid
_KEEP_SCORE = 0.5  # part of a camera's best score from which its observations count
_CAMERA_POWER = 2.0  # power of that best score that is the camera's weight
_COVER_MARGIN_M = 0.15  # growth of a moving object's box to all sides, where it covers the world
_AHEAD = 2  # images that are decoded before their turn
_MIN_SKY_FRAMES = 12  # frames whose images show the sky's colours, at least; others show the same
IMAGE_SCALES = (0.125, 0.25, 0.5, 1.0)  # scales that recorded images can be decoded at
_REDUCED = {
    1.0: cv2.IMREAD_COLOR,
    0.5: cv2.IMREAD_REDUCED_COLOR_2,
    0.25: cv2.IMREAD_REDUCED_COLOR_4,
    0.125: cv2.IMREAD_REDUCED_COLOR_8,
}


@dataclass(frozen=True, eq=False)
class View:
    """A recorded image.

    Attributes:
        camera: its camera.
        path: its file.
        used_rows: fraction of its rows, from the top, that does not show the recording car.
        own_car: pixels of the recording car, bool [h, w] at any size, if they are known.
        frame: number of the frame, for messages.
    """

    camera: Camera
    path: Path
    frame: int
    used_rows: float = 1.0
    own_car: np.ndarray | None = None

    def shows_car(self, width: int, height: int) -> np.ndarray:
        """Return the pixels of the recording car in the image at another size, bool [height,
        width].
        """
        car_mask = np.zeros((height, width), np.bool_)
        if self.own_car is not None:
            mask = self.own_car.astype(np.uint8)
            car_mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST) > 0
        car_mask[int(self.used_rows * height) :] = True
        return car_mask


@dataclass(frozen=True, eq=False)
class Body:
    """Surfels of the world (track None) or of a moving object, in its own frame."""

    surfels: Surfels
    track: ObjectTrack | None = None


class SurfelColours(NamedTuple):
    """Colours of N surfels from the images.

    Attributes:
        colours: float32 [N, 3] in [0, 1].
        is_observed: bool [N], True if some image shows the surfel.
    """

    colours: np.ndarray
    is_observed: np.ndarray


class _Observations(NamedTuple):
    """Best observations of N surfels, K = NUM_OBSERVATIONS of each.

    Attributes:
        scores: float32 [N, K], 0 where there is no observation.
        colours: uint8 [N, K, 3].
        cameras: uint8 [N, K], numbers of the cameras.
    """

    scores: np.ndarray
    colours: np.ndarray
    cameras: np.ndarray


def observe_views(
    bodies: Sequence[Body], views: Sequence[View], sky: SkyGatherer, *, image_scale: float = 0.5
) -> tuple[tuple[SurfelColours, ...], tuple[str, ...]]:
    """Return the colours of every body's surfels, and a sentence for each image that cannot be
    decoded.

    In each image the bodies are drawn into a z-buffer as they stood then. A surfel at its front
    takes the image's colour there. A camera's best observations count by their median. Cameras are
    averaged with weights that fall towards the border. Uncovered pixels of some frames go to the
    sky.
    """
    names = list(dict.fromkeys(view.camera.name for view in views))
    frames = list(dict.fromkeys(view.frame for view in views))
    sky_frames = set(frames[:: max(1, len(frames) // _MIN_SKY_FRAMES)])
    discs = [_Discs.of(body) for body in bodies]
    levels = np.zeros((_LEVELS, 0, 0, 3), np.uint8)
    problems: list[str] = []
    with ThreadPoolExecutor(available_cores()) as pool:
        images = read_ahead(pool, views, image_scale)
        bar = tqdm(views, desc="colours from images", unit="image", disable=None)
        for view, image in zip(bar, images, strict=True):
            where = f"camera {view.camera.name}, frame {view.frame}: image {view.path}"
            if image is None:
                problems.append(f"{where} cannot be decoded")
            elif abs(image.shape[1] - view.camera.width * image_scale) > 1:
                width = round(image.shape[1] / image_scale)
                problems.append(f"{where} is {width} px wide, not {view.camera.width}; left out")
            else:
                number = names.index(view.camera.name)
                if levels.shape[1:] != image.shape:
                    levels = np.zeros((_LEVELS, *image.shape), np.uint8)
                sizes = _fill_pyramid(levels, image)
                frame_sky = sky if view.frame in sky_frames else None
                _observe_one(discs, view, number, levels, sizes, frame_sky, pool)
    # A camera's observations by their median, cameras averaged.
    blended = (
        kernels.blended_colours(*body_discs.store, _KEEP_SCORE, _CAMERA_POWER)
        for body_discs in discs
    )
    return tuple(SurfelColours(*columns) for columns in blended), tuple(problems)


def read_ahead(
    pool: Executor, views: Sequence[View], image_scale: float
) -> Iterator[np.ndarray | None]:
    """Yield `read_image` of each view. The next images are decoded meanwhile."""
    waiting: deque[Future[np.ndarray | None]] = deque()
    for view in views:
        waiting.append(pool.submit(read_image, view.path, image_scale))
        if len(waiting) > _AHEAD:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def read_image(path: Path, image_scale: float) -> np.ndarray | None:
    """Read an image at a fraction (1, 1/2, 1/4, 1/8) of its size, RGB uint8 [H, W, 3].

    The result is None if it cannot be decoded.
    """
    image = decode_image(path, _REDUCED[image_scale])
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


class _Discs(NamedTuple):
    """Discs of a body, and what images show of them."""

    body: Body
    """The body."""
    store: _Observations
    """Observations of its surfels."""
    extent: np.ndarray
    """Half axes of the discs, metres, float32 [N, 2]."""
    middle: np.ndarray
    """Middle of the discs in the body's frame, float64 [3]."""
    radius_m: float
    """Radius of a ball around the middle that holds all discs."""

    @staticmethod
    def of(body: Body) -> _Discs:
        """Return the discs of a body, without observations."""
        shape = len(body.surfels), kernels.NUM_OBSERVATIONS
        store = _Observations(
            np.zeros(shape, np.float32), np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8)
        )
        extent = body.surfels.spacing * np.float32(DISC_PER_SPACING)
        if len(body.surfels) == 0:
            return _Discs(body, store, extent, np.zeros(3), 0.0)
        centres = body.surfels.centres.astype(np.float64)
        middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
        radius_m = np.linalg.norm(centres - middle, axis=1).max() + extent.max()
        return _Discs(body, store, extent, middle, float(radius_m))

    def may_be_in(self, camera: Camera, camera_from_body: np.ndarray) -> bool:
        """Return False if no disc reaches into the image."""
        x, y, z = camera_from_body[:3, :3] @ self.middle + camera_from_body[:3, 3]
        tangents = (
            camera.cx / camera.fx,
            (camera.width - camera.cx) / camera.fx,
            camera.cy / camera.fy,
            (camera.height - camera.cy) / camera.fy,
        )
        # Distances from the four sides of the image's pyramid; the ball may lie across them.
        return z > -self.radius_m and all(
            across + tangent * z > -self.radius_m * math.hypot(1.0, tangent)
            for across, tangent in zip((x, -x, y, -y), tangents, strict=True)
        )


class _Part(NamedTuple):
    """Some surfels of a body, as it stood in one image.

    Attributes:
        surfels: surfels of the body.
        store: observations of the body.
        extent: float32 [N, 2], half axes.
        pose: rotation and translation of the body in the camera's frame.
        moves: True if it is no part of the world.
        rows: rows of the body's surfels that the part holds.
    """

    surfels: Surfels
    store: _Observations
    extent: np.ndarray
    pose: tuple[np.ndarray, np.ndarray]
    moves: bool
    rows: slice


def _observe_one(
    discs: Sequence[_Discs],
    view: View,
    camera_number: int,
    levels: np.ndarray,
    sizes: np.ndarray,
    sky: SkyGatherer | None,
    pool: Executor,
) -> None:
    """Store what one image shows.

    Surfels are processed in slices by threads, with the bits of one pass.

    Args:
        discs: discs of all bodies.
        view: the image.
        camera_number: number of its camera.
        levels: uint8 [L, H, W, 3], the image halved again and again.
        sizes: int [L, 2], rows and columns of the levels.
        sky: collects the colours of the sky; None if the image is left out of it.
        pool: threads that run the loops.
    """
    camera = view.camera.scaled(DEPTH_WIDTH / view.camera.width)
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    cover = depth.copy()
    no_cover = depth.copy()
    parts = []
    for body_discs in discs:
        body = body_discs.body
        transform = camera.camera_from_world.numpy()
        if body.track is not None:
            pose = body.track.motion.pose_at(camera.timestamp_ns)
            if pose is None:
                continue
            transform = transform @ pose
            draw_cover(cover, camera, transform, body.track.size_m)
            if not body_discs.may_be_in(camera, transform):
                continue
        part_pose = transform[:3, :3].copy(), transform[:3, 3].copy()
        parts += [
            _Part(
                body.surfels,
                body_discs.store,
                body_discs.extent,
                part_pose,
                body.track is not None,
                rows,
            )
            for rows in row_slices(len(body.surfels))
        ]

    def draw(part: _Part) -> np.ndarray:
        s = part.surfels
        rows = part.rows
        nearest = np.full_like(depth, np.inf)
        kernels.draw_depth(
            s.centres[rows],
            s.normals[rows],
            s.major[rows],
            part.extent[rows],
            *part.pose,
            *intrinsics,
            nearest,
        )
        return nearest

    def observe(part: _Part) -> None:
        s = part.surfels
        rows = part.rows
        kernels.observe(
            s.centres[rows],
            s.normals[rows],
            part.extent[rows],
            *part.pose,
            *intrinsics,
            depth,
            no_cover if part.moves else cover,
            levels,
            sizes,
            view.used_rows,
            camera_number,
            *(column[rows] for column in part.store),
        )

    depth_images = pool.map(draw, parts)
    for nearest in depth_images:
        np.minimum(depth, nearest, out=depth)
    car = view.shows_car(camera.width, camera.height)
    cover[car] = no_cover[car] = 0  # it stands before all else
    observations = pool.map(observe, parts)
    if sky is not None:
        sky.add(camera, np.isinf(depth) & np.isinf(cover), levels, sizes, pool)
    list(observations)


def _fill_pyramid(levels: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Fill an array with the image halved again and again, each in its corner.

    Args:
        levels: uint8 [L, H, W, 3], changed in place.
        image: uint8 [H, W, 3].

    Returns:
        Rows and columns of the levels, int64 [L, 2].
    """
    sizes = np.zeros((len(levels), 2), np.int64)
    for i in range(len(levels)):
        levels[i, : image.shape[0], : image.shape[1]] = image
        sizes[i] = image.shape[:2]
        half = (max(1, image.shape[1] // 2), max(1, image.shape[0] // 2))
        image = cv2.resize(image, half, interpolation=cv2.INTER_AREA)
    return sizes


_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64) / 2
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
_CLIP_M = 0.05  # depth of the plane that a box's edges are clipped at


def draw_cover(
    cover: np.ndarray, camera: Camera, camera_from_box: np.ndarray, size_m: np.ndarray
) -> None:
    """Fill the outline of a moving object's box, a little grown, with its nearest depth.

    LiDAR sees through its windows and misses its dark paint, but the image shows the object there.
    """
    corners = _CORNERS * (size_m + 2 * _COVER_MARGIN_M)
    corners = corners @ camera_from_box[:3, :3].T + camera_from_box[:3, 3]
    if corners[:, 2].max() < _CLIP_M:
        return
    points = [c for c in corners if c[2] >= _CLIP_M]
    for a, b in _EDGES:
        za = corners[a, 2]
        zb = corners[b, 2]
        if (za - _CLIP_M) * (zb - _CLIP_M) < 0:
            points.append(corners[a] + (corners[b] - corners[a]) * ((_CLIP_M - za) / (zb - za)))
    if len(points) < 3:
        return
    p = np.array(points)
    u = np.clip(camera.fx * p[:, 0] / p[:, 2] + camera.cx, -1e4, 1e4)
    v = np.clip(camera.fy * p[:, 1] / p[:, 2] + camera.cy, -1e4, 1e4)
    hull = cv2.convexHull(np.stack([u, v], 1).astype(np.int32))
    left, top, width, height = cv2.boundingRect(hull)
    if left >= camera.width or top >= camera.height or left + width <= 0 or top + height <= 0:
        return
    mask = np.zeros(cover.shape, np.uint8)
    cv2.fillConvexPoly(mask, hull, 1)
    window = (
        slice(max(top, 0), min(top + height, camera.height)),
        slice(max(left, 0), min(left + width, camera.width)),
    )
    depth_m = np.float32(p[:, 2].min())
    np.minimum(cover[window], depth_m, out=cover[window], where=mask[window] > 0)
