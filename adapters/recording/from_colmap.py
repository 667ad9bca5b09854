"""A recording from a COLMAP reconstruction of a video.

`record_colmap` writes images, undistorted or with their lens, poses in metres with z up, and depth
between the reconstructed points. COLMAP knows neither metres nor up. Both come from the road: the
plane under the cameras on which most of the low points lie is taken as level; a camera's height
above it, or GPS, gives the length of a unit. Without moving boxes everything that moves by itself
is part of the street.
"""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from scipy.interpolate import LinearNDInterpolator
from tqdm import tqdm

from adapters.camera_files.camera_files import find_colmap_model, open_colmap_model
from adapters.camera_files.lenses import colmap_lens
from adapters.plain_files import LARGEST, decode_image, read_text, resolve_inside
from adapters.recording.files import CALIBRATION, IMAGE_SUFFIXES
from adapters.world import invert_pose
from augment.errors import AdapterError
from augment.files.lens_records import optics_record
from augment.files.recorded_images import twelve_bits_fault
from augment.output.codecs import encode_depth
from augment.scene.cameras import Camera
from augment.scene.pixel_rays import depth_of, project_local

CAMERA = "camera"  # of images that lie in no folder of their own
_JPEG_QUALITY = 97
_MAX_ERROR_PX = 2.0  # of a point's reprojection
_ON_ROAD = 0.01  # heights of the road's points stray by this part of their distance
_MAX_TILT_DEG = 8.0  # of the road against the cameras' level
_MIN_ON_ROAD = 30  # points that a road needs
_MAX_RESIDUAL = 0.1  # of the cameras' height
_TRIES = 2000  # planes that are tried
_MOST_POINTS = 20_000  # low points that planes are tried on
_SEED = 20260101  # of the choice of points and planes
_MIN_PATH_HEIGHTS = 2.0  # extent of the cameras' path over their height above the road
_LOW_DEG = 3.0  # points that are seen further below the horizon may be the road's
# Depth between points: across triangles whose corners are this near in pixels of the width, and in
# depth; where the cameras drove, the road itself has points.
_MAX_EDGE = 1 / 6  # of a triangle, over the image's width
_MAX_RATIO = 1.5  # of the depths at a triangle's corners
_LANE_M = 1.0  # half the width of the lane that the cameras drove
_LANE_STEP_M = 0.5  # between points of the lane
_LANE_REACH_M = 30.0  # a camera uses points of the lane up to here; it ends half of this ahead
_EARTH_M = 6_378_137.0  # radius at the equator, WGS 84
_MIN_PATH_M = 5.0  # GPS is wrong by metres


@dataclass(frozen=True, eq=False)
class Shot:
    """An image with a pose.

    Attributes:
        name: in the model, which is its path below the images' folder.
        lens: pycolmap's camera.
        model_from_camera: float64 [4, 4].
        points: float64 [N, 3], points that the image shows, in the model's world.
    """

    name: str
    camera: str
    frame: int
    lens: Any
    model_from_camera: np.ndarray
    points: np.ndarray


class Road(NamedTuple):
    """The plane normal @ p + offset = 0 under the cameras, in the model's world.

    Attributes:
        normal: unit vector upwards.
        offset: see the equation.
        height: median height of the cameras above the plane, in the model's unit.
        points: number of points on it.
        residual: their median distance from it, over the height.
    """

    normal: np.ndarray
    offset: float
    height: float
    points: int
    residual: float


class RecordingSummary(NamedTuple):
    """Summary of a recording that `record_colmap` wrote.

    Attributes:
        frames, images: their numbers.
        num_images_without_pose: number of the folder's images without a pose.
        metres: length of the model's unit. None if it is not known.
        residual_m: median distance of the cameras from their given positions. None without
            positions.
    """

    frames: int
    images: int
    num_images_without_pose: int
    road: Road
    metres: float | None
    residual_m: float | None


def record_colmap(
    model: Path,
    images: Path,
    out: Path,
    *,
    fps: float,
    camera_height_m: float | None = None,
    positions: Path | None = None,
    keeps_lens: bool = False,
) -> RecordingSummary:
    """Write the recording of a COLMAP model to the folder `out`.

    Args:
        model: folder of the model.
        images: folder of its images. An image in a subfolder is of a camera of that name. An
            image's last digits are its frame.
        out: folder of the recording.
        fps: frames per second; an image is taken at frame / fps seconds.
        camera_height_m: height of the cameras' middle above the road.
        positions: table of the places where images were taken, see `read_positions`. It also gives
            the north.
        keeps_lens: if True, images keep their distortion and the calibration has the lens; if
            False, images are undistorted.

    Raises:
        AdapterError: there is no model, image or road under the cameras, or the positions tell
            nothing.
    """
    if out.exists() and any(out.iterdir()):
        raise AdapterError(f"{out} is not empty; give a new folder")
    shots = read_shots(model)
    road = find_road(shots)
    _check_path(shots, road, model)
    metres = None if camera_height_m is None else camera_height_m / road.height
    world_from_model = _level_pose(shots[0], road)
    residual_m = None
    if positions is not None:
        position_of_image = read_positions(positions)
        turn, measured, residual_m = _fit_positions(
            shots, world_from_model, position_of_image, positions
        )
        world_from_model = turn @ world_from_model
        metres = measured if metres is None else metres
    scale = 1.0 if metres is None else metres
    poses = {shot.name: _scaled(world_from_model @ shot.model_from_camera, scale) for shot in shots}
    egos = _egos(shots, poses, scale * road.height)
    lane = _lane(list(egos.values()))
    frames: dict[int, dict[str, Any]] = {}
    for shot in tqdm(shots, desc="images", unit="image", disable=None):
        camera = _write_image(shot, images, out, keeps_lens=keeps_lens)
        world = shot.points @ world_from_model[:3, :3].T + world_from_model[:3, 3]
        _write_depth(out, shot, camera, poses[shot.name], scale * world, lane)
        frame = frames.setdefault(
            shot.frame,
            {
                "frame": shot.frame,
                "timestamp_ns": round(shot.frame / fps * 1e9),
                "world_from_ego": egos[shot.frame].tolist(),
                "cameras": {},
            },
        )
        frame["cameras"][shot.camera] = {
            **{"width": camera.width, "height": camera.height, **camera.intrinsics._asdict()},
            "world_from_camera": poses[shot.name].tolist(),
            **optics_record(camera),
        }
    content = {
        "scene": out.absolute().name,
        "has_metric_scale": metres is not None,
        "frames": [frames[number] for number in sorted(frames)],
    }
    (out / CALIBRATION).write_text(json.dumps(content, indent=1), encoding="utf-8")
    num_files = sum(path.suffix.lower() in IMAGE_SUFFIXES for path in images.rglob("*"))
    return RecordingSummary(
        len(frames), len(shots), num_files - len(shots), road, metres, residual_m
    )


# ---- The model -----------------------------------------------------------------------------------


def read_shots(model: Path) -> list[Shot]:
    """Read the images that have poses, by frame and camera."""
    model_dir = find_colmap_model(model)
    if model_dir is None:
        raise AdapterError(
            f"{model} holds no COLMAP model: expected cameras, images and points3D, .bin or .txt, "
            f"in it or in sparse/0"
        )
    reconstruction = open_colmap_model(model_dir)
    points = {
        number: np.asarray(point.xyz)
        for number, point in reconstruction.points3D.items()
        if point.error <= _MAX_ERROR_PX
    }
    shots: dict[tuple[int, str], Shot] = {}
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        digits = re.search(r"(\d{1,15})\D*$", Path(image.name).stem)
        if digits is None:
            raise AdapterError(
                f"{model_dir}: image {image.name} has no frame number; name images as 000001.jpg"
            )
        camera = re.sub(r"[^\w.-]", "-", Path(image.name).parent.as_posix().replace("/", "-"))
        camera = CAMERA if camera == "." else camera
        ids = [p.point3D_id for p in image.points2D if p.has_point3D()]
        shown_points = [points[number] for number in ids if number in points]
        key = int(digits[1]), camera
        if key in shots:
            raise AdapterError(
                f"{model_dir}: {shots[key].name} and {image.name} are both frame {key[0]} of "
                f"camera {camera}; give each camera a folder of its own"
            )
        pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        lens = reconstruction.cameras[image.camera_id]
        shot_points = np.array(shown_points).reshape(-1, 3)
        shots[key] = Shot(image.name, camera, key[0], lens, invert_pose(pose), shot_points)
    if not shots:
        raise AdapterError(f"{model_dir}: no image of this model has a pose")
    return [shots[key] for key in sorted(shots)]


def find_road(shots: Sequence[Shot]) -> Road:
    """Return the plane under the cameras with most low points on it and few below.

    It is deterministic.

    Raises:
        AdapterError: too few points lie on any plane.
    """
    centres = np.stack([shot.model_from_camera[:3, 3] for shot in shots])
    up = -np.mean([shot.model_from_camera[:3, 1] for shot in shots], axis=0)
    up /= np.linalg.norm(up)
    low = []
    for shot, centre in zip(shots, centres, strict=True):
        rays = shot.points - centre
        below = rays @ up < -np.sin(np.radians(_LOW_DEG)) * np.linalg.norm(rays, axis=1)
        low.append(shot.points[below])
    points = np.unique(np.concatenate(low), axis=0)
    rng = np.random.default_rng(_SEED)
    if len(points) > _MOST_POINTS:
        points = points[np.sort(rng.choice(len(points), _MOST_POINTS, replace=False))]
    far = np.linalg.norm(points - centres.mean(axis=0), axis=1)
    best_score = 0
    best_plane = None
    for _ in range(_TRIES if len(points) >= _MIN_ON_ROAD else 0):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        plane = _plane_under(np.cross(b - a, c - a), a, centres, up)
        if plane is None:
            continue
        heights = (points @ plane[0] + plane[1]) / far
        score = int((np.abs(heights) < _ON_ROAD).sum()) - 2 * int((heights < -3 * _ON_ROAD).sum())
        if score > best_score:
            best_score = score
            best_plane = plane
    for _ in range(3 if best_plane is not None else 0):
        assert best_plane is not None
        road_points = points[np.abs(points @ best_plane[0] + best_plane[1]) < _ON_ROAD * far]
        normal = (
            np.linalg.svd(road_points - road_points.mean(axis=0))[2][2]
            if len(road_points) > 2
            else best_plane[0]
        )
        best_plane = _plane_under(normal, road_points.mean(axis=0), centres, up) or best_plane
    if best_plane is None or best_score < _MIN_ON_ROAD:
        raise AdapterError(
            f"no road is seen under the cameras: at most {max(best_score, 0)} of {len(points)} low "
            f"points lie on one plane within {_MAX_TILT_DEG:.0f} degrees of the cameras' level; "
            f"{_MIN_ON_ROAD} are needed. Film with the road in view, hold the camera level, take "
            f"more frames"
        )
    distance = np.abs(points @ best_plane[0] + best_plane[1])
    road_distance = distance[distance < _ON_ROAD * far]
    road = Road(*best_plane, len(road_distance), float(np.median(road_distance)) / best_plane[2])
    if road.residual > _MAX_RESIDUAL:
        raise AdapterError(
            f"no road is clear under the cameras: {road.points} points of the best plane stray "
            f"from it by {100 * road.residual:.0f} % of the cameras' height (median; at most "
            f"{100 * _MAX_RESIDUAL:.0f}). Film with more of the road in view, take more frames"
        )
    return road


def _plane_under(
    normal: np.ndarray, point: np.ndarray, centres: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, float, float] | None:
    """Return the unit normal and offset of a plane, and the cameras' median height over it.

    The normal points upwards. Returns None where the plane is too steep or above a camera."""
    length = np.linalg.norm(normal)
    if length == 0:
        return None
    normal = normal * np.sign(normal @ up) / length
    if normal @ up < np.cos(np.radians(_MAX_TILT_DEG)):
        return None
    heights = (centres - point) @ normal
    return (
        (normal, float(-normal @ point), float(np.median(heights))) if heights.min() > 0 else None
    )


def _check_path(shots: Sequence[Shot], road: Road, model: Path) -> None:
    """Refuse cameras that hardly moved: the whole reconstruction rests on that base."""
    centres = np.stack([shot.model_from_camera[:3, 3] for shot in shots])
    heights = float(np.linalg.norm(np.ptp(centres, axis=0))) / road.height
    if heights < _MIN_PATH_HEIGHTS:
        raise AdapterError(
            f"{model}: the cameras of its {len(shots)} images moved by {heights:.1f} of their "
            f"height above the road, too little to tell distances by; take frames over "
            f"{_MIN_PATH_HEIGHTS:.0f} heights at least, some 10 m are better"
        )


def _level_pose(shot: Shot, road: Road) -> np.ndarray:
    """Return world_from_model in the model's unit: z up, the road at 0.

    The shot stands at x = y = 0 and looks along x.
    """
    forward = shot.model_from_camera[:3, 2]
    forward = forward - (forward @ road.normal) * road.normal
    if np.linalg.norm(forward) < 1e-6:
        raise AdapterError(
            f"image {shot.name} looks straight down; which way is ahead is not known"
        )
    forward /= np.linalg.norm(forward)
    out = np.eye(4)
    out[:3, :3] = np.stack([forward, np.cross(road.normal, forward), road.normal])
    out[:3, 3] = -out[:3, :3] @ shot.model_from_camera[:3, 3]
    out[2, 3] = road.offset
    return out


def _scaled(pose: np.ndarray, scale: float) -> np.ndarray:
    out = pose.copy()
    out[:3, 3] *= scale
    return out


def _egos(
    shots: Sequence[Shot], poses: Mapping[str, np.ndarray], height_m: float
) -> dict[int, np.ndarray]:
    """Return world_from_ego by frame: on the road under the frame's first camera, level, x along
    its view.
    """
    egos: dict[int, np.ndarray] = {}
    for shot in shots:
        pose = poses[shot.name]
        yaw = np.arctan2(pose[1, 2], pose[0, 2])
        ego = np.eye(4)
        ego[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        ego[:3, 3] = pose[:3, 3] - [0, 0, height_m]
        egos.setdefault(shot.frame, ego)
    return egos


# ---- GPS -----------------------------------------------------------------------------------------


def read_positions(path: Path) -> dict[str, np.ndarray]:
    """Read metres east and north [2] by image from a table (CSV).

    Its columns are image, lat, lon (degrees), or image, x, y (metres). image: its path below the
    images' folder, or its name.
    """
    rows = list(
        csv.DictReader(io.StringIO(read_text(path, if_missing="give a table of positions")))
    )
    names = set(rows[0]) if rows else set()
    columns = next((c for c in (("lat", "lon"), ("x", "y")) if {"image", *c} <= names), None)
    if columns is None:
        raise AdapterError(
            f"{path} must be a table with the columns image, lat, lon or image, x, y, separated by "
            f"commas; it has {sorted(map(str, names))[:10]}"
        )
    positions: dict[str, np.ndarray] = {}
    for number, row in enumerate(rows, start=2):
        try:
            value = np.array([float(row[name]) for name in columns])
        except (TypeError, ValueError):
            value = np.full(2, np.nan)
        if not (np.abs(value) <= LARGEST).all():
            raise AdapterError(
                f"{path}, line {number}: {', '.join(columns)} must be numbers; got {row}"
            )
        positions[str(row["image"])] = value
    if columns == ("x", "y"):
        return positions
    first = next(iter(positions.values()))
    east = np.cos(np.radians(first[0]))
    scale = np.radians(1.0) * _EARTH_M
    return {n: scale * (v - first)[::-1] * [east, 1.0] for n, v in positions.items()}


def _fit_positions(
    shots: Sequence[Shot],
    world_from_model: np.ndarray,
    positions: Mapping[str, np.ndarray],
    path: Path,
) -> tuple[np.ndarray, float, float]:
    """Fit the cameras' path to the positions.

    Returns the rotation about z, [4, 4]; metres per unit of the model; and the median distance of
    the fitted path from the positions, metres. path: of the table, for messages."""
    pairs = [
        ((world_from_model @ shot.model_from_camera)[:2, 3], positions[name])
        for shot in shots
        for name in (shot.name, Path(shot.name).name)[: 1 if shot.name in positions else 2]
        if name in positions
    ]
    model, metres = (np.array([p[i] for p in pairs]).reshape(-1, 2) for i in (0, 1))
    spread = float(np.linalg.norm(np.ptp(metres, axis=0))) if len(pairs) else 0.0
    if len(pairs) < 3 or spread < _MIN_PATH_M:
        raise AdapterError(
            f"{path} gives positions of {len(pairs)} of the {len(shots)} images, {spread:.1f} m "
            f"apart; three are needed, over {_MIN_PATH_M:.0f} m. Names must be those of the "
            f"images, such as {shots[0].name}"
        )
    a, b = (xy[:, 0] + 1j * xy[:, 1] - (xy[:, 0] + 1j * xy[:, 1]).mean() for xy in (model, metres))
    ratio = (np.conj(a) * b).sum() / (np.abs(a) ** 2).sum()
    unit = ratio / abs(ratio)
    turn = np.eye(4)
    turn[:2, :2] = [[unit.real, -unit.imag], [unit.imag, unit.real]]
    return turn, float(abs(ratio)), float(np.median(np.abs(ratio * a - b)))


# ---- Files ---------------------------------------------------------------------------------------


def _write_image(shot: Shot, images: Path, out: Path, *, keeps_lens: bool) -> Camera:
    """Write the image, and return its camera at the identity pose.

    Args:
        shot: the image.
        images: the folder of the model's images.
        out: the folder of the recording.
        keeps_lens: if True, the image keeps its distortion, and its camera has the lens.

    Raises:
        AdapterError: the image cannot be used, or its lens cannot be kept.
    """
    import pycolmap

    source = resolve_inside(images, shot.name, "the model")
    target = out / "images" / shot.camera / f"{shot.frame:06d}.jpg"
    target.parent.mkdir(parents=True, exist_ok=True)
    lens = shot.lens
    optical_lens = colmap_lens(lens) if keeps_lens else None
    if keeps_lens and optical_lens is None and not lens.is_undistorted():
        raise AdapterError(
            f"image {shot.name}: a lens of COLMAP's model {lens.model_name} cannot be kept; run "
            f"COLMAP with OPENCV or OPENCV_FISHEYE, or record without --lens recorded"
        )
    is_kept = lens.is_undistorted() or optical_lens is not None
    pinhole = shot.lens
    if not is_kept:
        pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    fx = pinhole.focal_length_x
    fy = pinhole.focal_length_y
    cx = pinhole.principal_point_x
    cy = pinhole.principal_point_y
    image = decode_image(source, cv2.IMREAD_COLOR)
    if image is None or image.shape[:2] != (lens.height, lens.width):
        got = "no image" if image is None else f"{image.shape[1]}x{image.shape[0]} pixels"
        raise AdapterError(
            f"{source} is {got}, the model's camera {lens.width}x{lens.height}; give the folder of "
            f"the images that COLMAP was run on"
        )
    if fault := twelve_bits_fault(source):
        raise AdapterError(f"{source} {fault}")
    if is_kept and source.suffix.lower() in (".jpg", ".jpeg"):
        shutil.copyfile(source, target)
    elif optical_lens is not None:
        target = target.with_suffix(".png")
        target.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    else:
        u, v = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
        rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1)
        # OpenCV has whole numbers at the middle of pixels, COLMAP at their corners.
        lens_px = (
            lens.img_from_cam(rays.reshape(-1, 3)).reshape(*u.shape, 2).astype(np.float32) - 0.5
        )
        image = cv2.remap(image, lens_px[..., 0], lens_px[..., 1], cv2.INTER_LINEAR)
        flags = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        target.write_bytes(cv2.imencode(".jpg", image, flags)[1].tobytes())
    return Camera(
        shot.camera,
        *(int(pinhole.width), int(pinhole.height)),
        *(float(fx), float(fy), float(cx), float(cy)),
        camera_from_world=torch.eye(4, dtype=torch.float64),
        lens=optical_lens,
    )


def _lane(egos: Sequence[np.ndarray]) -> np.ndarray:
    """Return points of the road that the cameras drove over, and a little beyond its end, [N,
    3].
    """
    steps = np.arange(0, _LANE_REACH_M / 2, _LANE_STEP_M)
    across = np.arange(-_LANE_M, _LANE_M + 1e-6, _LANE_STEP_M)
    local = [[0.0, y, 0.0, 1.0] for y in across]
    ahead = [[x, y, 0.0, 1.0] for x in steps for y in across]
    parts = [np.array(local) @ ego.T for ego in egos] + [np.array(ahead) @ egos[-1].T]
    return np.concatenate(parts)[:, :3]


def _write_depth(
    out: Path,
    shot: Shot,
    camera: Camera,
    world_from_camera: np.ndarray,
    points: np.ndarray,
    lane: np.ndarray,
) -> None:
    """Write the depth image of a shot: interpolated in triangles between near points.

    points: those that the image shows, world. lane: points of the road, world."""
    centre = world_from_camera[:3, 3]
    turn = world_from_camera[:3, :3]
    near = lane[np.linalg.norm(lane - centre, axis=1) < _LANE_REACH_M]
    local = (np.concatenate([points, near]) - centre) @ turn
    local = local[local[:, 2] > 0.1]
    size = np.array([camera.width, camera.height])
    uv = project_local(camera, local)
    with np.errstate(invalid="ignore"):
        is_in_image = ((uv > 0) & (uv < size)).all(axis=1)
    uv = uv[is_in_image]
    inverse = 1 / depth_of(camera, local[is_in_image])
    if len(np.unique(uv.round(), axis=0)) < 4:
        return
    interpolator = LinearNDInterpolator(uv, inverse, fill_value=0.0)
    corners = interpolator.tri.simplices
    edges = np.linalg.norm(uv[corners] - uv[np.roll(corners, 1, axis=1)], axis=2).max(axis=1)
    ratio = inverse[corners].max(axis=1) / inverse[corners].min(axis=1)
    is_small = (edges < _MAX_EDGE * size[0]) & (ratio < _MAX_RATIO)
    u, v = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    triangle = interpolator.tri.find_simplex(pixels)
    is_known = (triangle >= 0) & is_small[triangle]
    depth = np.zeros(len(pixels), np.float32)
    depth[is_known] = 1 / interpolator(pixels[is_known])
    path = out / "depth" / shot.camera / f"{shot.frame:06d}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_depth(depth.reshape(size[1], size[0])))
