"""Surfaces for a drive of which no distance is known: a start for reconstruction, no more.

The road is taken to lie under the ego origin, objects fill their boxes, and what the images show
elsewhere may be at any distance: coloured, nearly transparent splats on shells around the cameras,
among which optimisation chooses.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from adapters.lidar.box_tracks import BoxSample
from adapters.lidar.image_views import View, read_image
from adapters.lidar.initialise import SplatShape, gaussians_from_surfels
from adapters.lidar.split import Sweep
from adapters.lidar.surfels import Surfels
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.scene import Gaussians
from augment.semantics import SemanticClass

MOST_GAUSSIANS = 60_000
SHELL_SHARE = 2 / 3  # of them; the rest are ground and boxes
VOXEL_M = 0.15  # finer ground would only be a finer guess
SHELLS_M = 4.0 * 20.0 ** (np.arange(6) / 5)  # 4 m to 80 m, a factor of 1.8 apart
_GROUND_REACH_M = 40.0
_GROUND_STEP_M = 0.5
_BOX_STEP_M = 0.15
_MOST_VIEWS = 48
_DRIVEN_M = 1.6  # the car went through here: nothing stands there
_LOWEST_CAMERA_M = 0.1
_ABOVE_GROUND_M = 0.2  # a ray that is lower at a shell has met the ground before
_SHAPE = SplatShape(sigma_per_spacing=0.5, opacity=0.1)
_IMAGE_SCALE, _SMALL_PX = 0.125, 64  # smaller images are read as they are
_NEVER_NS = -(2**62)  # a time at which no object exists: these points belong to the static world


def ground_heights(frames: Sequence[Frame], ego_above_ground_m: float) -> np.ndarray:
    """Points of the road under the ego origins, float64 [F, 3]."""
    poses = np.stack([frame.world_from_ego.numpy() for frame in frames])
    return poses[:, :3, 3] - ego_above_ground_m * poses[:, :3, 2]


def check_cameras_above(path: Path, frames: Sequence[Frame], road: np.ndarray) -> None:
    """Raises AdapterError where a camera is not above the ground. path: of the calibration."""
    for frame, ground in zip(frames, road, strict=True):
        for name, camera in frame.cameras.items():
            height_m = float(camera.centre[2]) - ground[2]
            if height_m < _LOWEST_CAMERA_M:
                raise AdapterError(
                    f"{path}, frame {frame.index}, camera {name!r}: it is {height_m:.2f} m above "
                    f"the ground that is taken to lie under the ego origin; without LiDAR or depth "
                    f"the ground must be known: give ego_above_ground_m, the ego origin's height"
                )


def guess_surfaces(
    road: np.ndarray, moving: Sequence[BoxSample], still: Sequence[BoxSample]
) -> tuple[Sweep, ...]:
    """Points on the ground around the path and on the sides and tops of all boxes.

    road: float64 [F, 3], see `ground_heights`. Where the ground is between poses is the nearest
    pose's height.
    """
    sweeps = [_sweep(_ground(road), _NEVER_NS)]
    sweeps += [_sweep(_box_surface(box), _NEVER_NS) for box in still]
    once = {box.object_id: box for box in reversed(moving)}
    sweeps += [_sweep(_box_surface(box), box.timestamp_ns) for box in once.values()]
    return tuple(sweeps)


def guess_shells(views: Sequence[View], road: np.ndarray, count: int) -> Gaussians:
    """At most about `count` Gaussians at the distances SHELLS_M along rays of the images.

    Each ray gets one of the distances, its neighbours others. Nothing where the car drove, under
    the ground, or where an image cannot be decoded.
    """
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, _MOST_VIEWS).astype(int))]
    tree = cKDTree(road[:, :2])
    parts = []
    for number, view in enumerate(chosen):
        small = min(view.camera.width, view.camera.height) < _SMALL_PX
        image = read_image(view.path, 1.0 if small else _IMAGE_SCALE)
        if image is not None:
            parts.append(_shell_points(view.camera, image, number, count // len(chosen)))
    if not parts:
        return Gaussians.empty()
    points, normals, spacing, colours = (np.concatenate(p) for p in zip(*parts, strict=True))
    distance, nearest = tree.query(points[:, :2])
    keep = (distance > _DRIVEN_M) & (points[:, 2] > road[nearest, 2] + _ABOVE_GROUND_M)
    return _facing(points[keep], normals[keep], spacing[keep], colours[keep])


def _ground(road: np.ndarray) -> np.ndarray:
    low = np.floor((road[:, :2].min(axis=0) - _GROUND_REACH_M) / _GROUND_STEP_M)
    high = np.ceil((road[:, :2].max(axis=0) + _GROUND_REACH_M) / _GROUND_STEP_M)
    ticks = [np.arange(a, b + 1) * _GROUND_STEP_M for a, b in zip(low, high, strict=True)]
    xy = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 2)
    distance, nearest = cKDTree(road[:, :2]).query(xy)
    near = distance < _GROUND_REACH_M
    return np.column_stack([xy[near], road[nearest[near], 2]])


def _box_surface(box: BoxSample) -> np.ndarray:
    """A grid on the five faces of a box that can be seen from the street, world, [N, 3]."""
    half = box.size_m / 2
    faces = []
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1), (2, 1)):
        others = [other for other in range(3) if other != axis]
        steps = [max(2, int(np.ceil(2 * half[o] / _BOX_STEP_M)) + 1) for o in others]
        a, b = np.meshgrid(
            *(
                np.linspace(-half[o], half[o], min(n, 200))
                for o, n in zip(others, steps, strict=True)
            )
        )
        face = np.empty((a.size, 3))
        face[:, axis], face[:, others[0]], face[:, others[1]] = (
            sign * half[axis],
            a.ravel(),
            b.ravel(),
        )
        faces.append(face)
    local = np.concatenate(faces)
    return local @ box.world_from_box[:3, :3].T + box.world_from_box[:3, 3]


def _sweep(points: np.ndarray, timestamp_ns: int) -> Sweep:
    return Sweep(
        points.astype(np.float32),
        np.full(len(points), timestamp_ns, np.int64),
        np.full(len(points), SemanticClass.UNKNOWN, np.int16),
    )


def _shell_points(
    camera: Camera, image: np.ndarray, number: int, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, unit directions back to the camera, spacings (metres) and colours of one image."""
    columns = max(1, round((count * camera.width / camera.height) ** 0.5))
    rows = max(1, round(count / columns))
    colours = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    grid = camera.scaled(columns / camera.width)
    u = (np.arange(columns) + 0.5) / columns * camera.width
    v = (np.arange(rows) + 0.5) / rows * camera.height
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    local = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rotation = camera.world_from_camera.numpy()[:3, :3]
    rays = local @ rotation.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    j, i = np.divmod(np.arange(rows * columns), columns)
    # Neighbours in a row get all distances in turn; rows and images begin elsewhere.
    distance = SHELLS_M[(i + 2 * j + number) % len(SHELLS_M)]
    # The points of one shell are sqrt(shells) rays apart.
    spacing = distance / grid.fx * len(SHELLS_M) ** 0.5
    points = camera.centre.numpy() + distance[:, None] * rays
    return points, -rays, spacing, colours.reshape(-1, 3).astype(np.float32) / 255


def _facing(
    points: np.ndarray, normals: np.ndarray, spacing: np.ndarray, colours: np.ndarray
) -> Gaussians:
    if len(points) == 0:
        return Gaussians.empty()
    up = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    major = np.cross(up, normals)
    major /= np.linalg.norm(major, axis=1, keepdims=True)
    surfels = Surfels(
        points.astype(np.float32),
        normals.astype(np.float32),
        major.astype(np.float32),
        np.repeat(spacing[:, None], 2, axis=1).astype(np.float32),
        np.zeros(len(points), bool),
        np.zeros((len(points), 0), np.int64),
    )
    unknown = np.full(len(points), SemanticClass.UNKNOWN, np.int16)
    return gaussians_from_surfels(surfels, colours.astype(np.float32), unknown, _SHAPE)
