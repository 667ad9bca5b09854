"""Camera files: their formats, where they lie beside a scene, and their views.

The formats are INRIA's cameras.json, nerfstudio's transforms.json, this project's camera paths
(described below) and COLMAP sparse models. They are told apart by their contents. `read_views`
reads any of them; the callers are `adapters.camera_files.paths` and `adapters.gaussian_files`.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from adapters.camera_files.colmap_tables import check_colmap_tables
from adapters.camera_files.lenses import colmap_lens, nerfstudio_lens
from adapters.plain_files import LARGEST, Number, read_json
from adapters.world import invert_pose
from augment.errors import AdapterError
from augment.files.lens_records import LensRecord, ShutterRecord
from augment.output.manifest import MAX_SIDE_PX
from augment.scene.lenses import Lens as OpticalLens
from augment.scene.shutter import RollingShutter

# Largest error of a rotation, as in Camera. Poses written with four decimals or fewer fail.
_ORTHONORMAL_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class PosedView:
    """One posed image in the file's own world (its axes, its unit of length).

    Attributes:
        name: name of the image.
        width, height: pixels.
        fx, fy, cx, cy: pixels.
        world_from_camera: float64 [4, 4], OpenCV axes.
        image_path: the image's file. None if it does not exist.
        camera, frame: name and number. Both are None if the file does not say them.
        timestamp_ns: since the scene's first frame. None if the file has no times.
        lens: lens of the camera. None for a pinhole.
        shutter: rolling shutter of the camera. None if all pixels are exposed at once.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: np.ndarray
    image_path: str | None = None
    camera: str | None = None
    frame: int | None = None
    timestamp_ns: int | None = None
    lens: OpticalLens | None = None
    shutter: RollingShutter | None = None


# Width, height, fx, fy, cx, cy of a pinhole camera in pixels.
Lens = tuple[int, int, float, float, float, float]


def lens_of(
    width: int, height: int, fx: float, fy: float | None, cx: float | None, cy: float | None
) -> Lens:
    """Return a pinhole. A missing fy is fx, a missing principal point the image's middle."""
    fy = fx if fy is None else fy
    cx = width / 2 if cx is None else cx
    return width, height, fx, fy, cx, height / 2 if cy is None else cy


@dataclass(frozen=True, eq=False)
class ViewSet:
    """All views of a camera file, and one sentence for each problem in it."""

    views: tuple[PosedView, ...]
    problems: tuple[str, ...] = ()


def check_pose(world_from_camera: np.ndarray, *, where: str) -> np.ndarray:
    """Return a pose as float64 [4, 4] with an exact last row.

    Raises:
        AdapterError: the pose is not finite or not rigid.
    """
    pose = np.asarray(world_from_camera, dtype=np.float64)
    if not (np.abs(pose) <= LARGEST).all():  # NaN included
        raise AdapterError(
            f"{where}: the pose must be finite, at most {LARGEST:g}; got {pose.tolist()}"
        )
    rotation = pose[:3, :3]
    with np.errstate(all="ignore"):
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        determinant = np.linalg.det(rotation)
    if error >= _ORTHONORMAL_TOLERANCE:
        raise AdapterError(
            f"{where}: the rotation must be orthonormal to {_ORTHONORMAL_TOLERANCE:g}; it is off "
            f"by {error:.3g} (determinant {determinant:.3g}). Write more decimals, and take any "
            "scale out of the matrix"
        )
    if determinant < 0:
        raise AdapterError(
            f"{where}: the rotation must have determinant +1; got {determinant:.3g}, a mirrored "
            "camera"
        )
    return np.vstack([pose[:3], [0, 0, 0, 1]])


def look_at_pose(
    position: Sequence[float] | np.ndarray, target: Sequence[float] | np.ndarray, *, where: str
) -> np.ndarray:
    """Return world_from_camera of an upright camera (world +z up) that looks at `target`.

    If it looks straight up or down, the top of its image points to world +y.
    """
    eye = np.asarray(position, np.float64)
    forward = np.subtract(target, position, dtype=np.float64)
    length = np.linalg.norm(forward)
    if not (np.isfinite(length) and length > 1e-9):
        raise AdapterError(
            f"{where}: look_at must differ from position; got {list(target)} for both"
        )
    forward /= length
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 1 - 1e-9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0] = right
    pose[:3, 1] = np.cross(forward, right)
    pose[:3, 2] = forward
    pose[:3, 3] = eye
    return pose


# ---- JSON of other tools: INRIA's cameras.json and nerfstudio's transforms.json ------------------

Model = TypeVar("Model", bound=BaseModel)
Vector = tuple[Number, Number, Number]
Row = tuple[Number, Number, Number, Number]
Pose = Annotated[list[Row], Field(min_length=3, max_length=4)]
Pixels = Annotated[Number, Field(ge=1, le=MAX_SIDE_PX, multiple_of=1), AfterValidator(int)]
Focal = Annotated[Number, Field(gt=0)]
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_MAX_LISTED_ERRORS = 5


class _ForeignModel(BaseModel):
    """Base of other tools' formats, which carry more keys than are needed here."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class _InriaCamera(_ForeignModel):
    img_name: str
    width: Pixels
    height: Pixels
    fx: Focal
    fy: Focal
    cx: Number | None = None
    cy: Number | None = None
    position: Vector
    rotation: tuple[Vector, Vector, Vector]


class _InriaFile(_ForeignModel):
    cameras: Annotated[list[_InriaCamera], Field(min_length=1)]


class _Intrinsics(_ForeignModel):
    """Intrinsics of nerfstudio's format.

    They stand at the top, in a frame, or divided between both.
    """

    w: Pixels | None = None
    h: Pixels | None = None
    fl_x: Focal | None = None
    fl_y: Focal | None = None
    cx: Number | None = None
    cy: Number | None = None
    camera_angle_x: Annotated[Number, Field(gt=0, lt=math.pi)] | None = None
    camera_model: str | None = None
    k1: Number | None = None
    k2: Number | None = None
    k3: Number | None = None
    k4: Number | None = None
    p1: Number | None = None
    p2: Number | None = None


class _NerfstudioFrame(_Intrinsics):
    file_path: str
    transform_matrix: Pose


class _NerfstudioFile(_Intrinsics):
    frames: Annotated[list[_NerfstudioFrame], Field(min_length=1)]


def validate(model: type[Model], content: object, path: Path | str, kind: str) -> Model:
    """Return `content` as the model.

    Raises:
        AdapterError: the content does not fit.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        lines = [
            f"{'.'.join(map(str, e['loc'])) or 'file'}: {e['msg']} (got {str(e['input'])[:60]})"
            for e in error.errors()[:_MAX_LISTED_ERRORS]
        ]
        num_more = error.error_count() - len(lines)
        raise AdapterError(
            f"{path}: not a valid {kind}: "
            + "; ".join(lines)
            + (f"; {num_more} more" if num_more else "")
        ) from error


def inria_views(content: list[object], path: Path) -> ViewSet:
    """Return the views of INRIA's list.

    Its cameras have no principal point, which then is the image's middle. Our own exports add cx
    and cy.
    """
    file = validate(_InriaFile, {"cameras": content}, path, "INRIA cameras.json")
    views = []
    for number, camera in enumerate(file.cameras):
        pose = np.eye(4)
        pose[:3, :3] = camera.rotation
        pose[:3, 3] = camera.position
        pose = check_pose(pose, where=f"{path}: {number} ({camera.img_name})")
        lens = lens_of(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        views.append(PosedView(camera.img_name, *lens, pose))
    return ViewSet(tuple(views))


def nerfstudio_views(content: object, path: Path, *, has_lenses: bool = False) -> ViewSet:
    """Return the views of nerfstudio's frames, in OpenCV's axes.

    Args:
        content: JSON.
        path: its file.
        has_lenses: if True, views have their lenses; if False, lens distortion is left out.
    """
    file = validate(_NerfstudioFile, content, path, "nerfstudio transforms.json")
    views = []
    num_distorted: Counter[str] = Counter()
    shared_intrinsics = file.model_dump(exclude={"frames"}, exclude_none=True)
    for number, frame in enumerate(file.frames):
        where = f"{path}: frames.{number} ({frame.file_path})"
        own_intrinsics = frame.model_dump(
            exclude={"file_path", "transform_matrix"}, exclude_none=True
        )
        lens = _Intrinsics(**(shared_intrinsics | own_intrinsics))
        model = (lens.camera_model or "OPENCV").upper()
        if model.startswith(("EQUIRECT", "ORTHO")):
            raise AdapterError(f"{where}: camera_model {model} has no pinhole camera near it")
        optical_lens = nerfstudio_lens(model, _distortion_of(lens)) if has_lenses else None
        is_distorted = "FISHEYE" in model or any(_distortion_of(lens).values())
        if is_distorted and optical_lens is None:
            num_distorted[model] += 1
        opencv_from_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
        pose = np.asarray(frame.transform_matrix, dtype=np.float64)
        pose = check_pose(np.vstack([pose[:3], [0, 0, 0, 1]]) @ opencv_from_opengl, where=where)
        image = path.parent / frame.file_path
        image_path = str(image) if image.is_file() else None
        pinhole = _pinhole(lens, where)
        views.append(PosedView(frame.file_path, *pinhole, pose, image_path, lens=optical_lens))
    problems = [distortion_problem(str(path), n, m) for m, n in num_distorted.items()]
    return ViewSet(tuple(views), tuple(problems))


def _distortion_of(lens: _Intrinsics) -> dict[str, float]:
    """Return the coefficients of nerfstudio's intrinsics by name."""
    return {name: getattr(lens, name) or 0.0 for name in _DISTORTION}


def distortion_problem(where: str, count: int, model: str) -> str:
    """Return the sentence on images whose lens is not a pinhole."""
    return (
        f"{where}: {count} images have lens distortion (model {model}), which is left out; they "
        "are rendered as pinhole cameras and will not line up with the distorted images"
    )


def _pinhole(lens: _Intrinsics, where: str) -> Lens:
    """Return the pinhole of nerfstudio's intrinsics."""
    if lens.w is None or lens.h is None:
        raise AdapterError(f"{where}: w and h (image size, pixels) are missing; add them")
    fl_x = lens.fl_x
    if fl_x is None and lens.camera_angle_x is not None:
        fl_x = 0.5 * lens.w / math.tan(0.5 * lens.camera_angle_x)
    if fl_x is None:
        raise AdapterError(f"{where}: fl_x (pixels) or camera_angle_x (radians) is missing; add it")
    return lens_of(lens.w, lens.h, fl_x, lens.fl_y, lens.cx, lens.cy)


# ---- Cameras of a COLMAP sparse model (cameras, images; .bin or .txt), read by pycolmap ----------

_MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")


def find_colmap_model(folder: Path) -> Path | None:
    """Return the folder of the sparse model in or below `folder`, or None if there is none."""
    for name, suffix in itertools.product(_MODEL_FOLDERS, (".bin", ".txt")):
        model = folder / name
        if all((model / f"{table}{suffix}").is_file() for table in ("cameras", "images")):
            return model
    return None


def open_colmap_model(model: Path) -> Any:
    """Return pycolmap's Reconstruction of the model in a folder."""
    try:
        import pycolmap  # a large native library: only those who have COLMAP models need it
    except ImportError:
        raise AdapterError(
            f"{model}: COLMAP models are read by pycolmap, which is not installed: "
            "pip install 'climategs[colmap]'"
        ) from None
    check_colmap_tables(model)
    try:
        reconstruction = pycolmap.Reconstruction(str(model))
    except (ValueError, RuntimeError, LookupError, ArithmeticError, MemoryError) as error:
        raise AdapterError(
            f"{model}: pycolmap cannot read this COLMAP model: {error}. Expected cameras, images "
            "and points3D, all .bin or all .txt"
        ) from error
    for number, camera in reconstruction.cameras.items():
        _check_colmap_camera(camera, f"{model}: camera {number}")
    return reconstruction


def _check_colmap_camera(camera: Any, where: str) -> None:
    """Refuse cameras that pycolmap accepts unchecked.

    A request for a missing focal length would end the process.
    """
    if not len(camera.focal_length_idxs()):
        raise AdapterError(
            f"{where} is of the model {camera.model_name}, which has no focal length: its images "
            f"are no pinhole camera's; run COLMAP with another camera model"
        )
    size = (camera.width, camera.height)
    params = np.asarray(camera.params, np.float64)
    focals = params[list(camera.focal_length_idxs())]
    if not (1 <= min(size) <= max(size) <= MAX_SIDE_PX):
        raise AdapterError(f"{where} must be 1 to {MAX_SIDE_PX} pixels wide and high; got {size}")
    if not ((np.abs(params) <= LARGEST).all() and (focals > 0).all()):
        raise AdapterError(
            f"{where}: its parameters must be finite, at most {LARGEST:g}, and focal lengths above "
            f"0; got {params.tolist()}"
        )


def read_colmap_views(model: Path, *, has_lenses: bool = False) -> ViewSet:
    """Read the views of the registered images.

    Args:
        model: the folder of the model.
        has_lenses: if True, views have their lenses; if False, lens distortion is left out and
            reported.
    """
    reconstruction = open_colmap_model(model)
    # Images of a model in project/sparse/0, project/sparse or project.
    folders = [parent / "images" for parent in (model, model.parent, model.parent.parent)]
    folder = next((f for f in folders if f.is_dir()), None)
    views = []
    num_distorted: Counter[str] = Counter()
    for image in sorted(reconstruction.images.values(), key=lambda image: image.name):
        if not image.has_pose:
            continue
        camera = reconstruction.cameras[image.camera_id]
        lens = colmap_lens(camera) if has_lenses else None
        if lens is None and not camera.is_undistorted():
            num_distorted[camera.model_name] += 1
        where = f"{model}: image {image.name}"
        camera_from_world = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        path = folder / image.name if folder else None
        image_size = (camera.width, camera.height)
        focal = (camera.focal_length_x, camera.focal_length_y)
        principal_point = (camera.principal_point_x, camera.principal_point_y)
        pose = invert_pose(check_pose(camera_from_world, where=where))
        image_path = str(path) if path and path.is_file() else None
        pinhole = (*image_size, *focal, *principal_point)
        views.append(PosedView(image.name, *pinhole, pose, image_path, lens=lens))
    if not views:
        raise AdapterError(f"{model}: this COLMAP model holds no image with a pose")
    problems = [distortion_problem(str(model), n, m) for m, n in num_distorted.items()]
    return ViewSet(tuple(views), tuple(problems))


# ---- The camera path: a small JSON format for poses made by hand or by a script ------------------
#     {"width": 960, "height": 540, "fx": 600, "fy": 600, "cx": 480, "cy": 270,
#      "frames": [{"timestamp_s": 0.0, "camera": "front",
#                  "position": [0, 0, 1.6], "look_at": [9, 0, 1.6]},
#                 {"timestamp_s": 0.1, "camera": "front",
#                  "world_from_camera": [[…], […], […], […]]}]}
#
# Lengths and axes are those of the world the path is used in; cameras are OpenCV (x right, y down,
# z forward). `fy` defaults to `fx`, `cx, cy` to the middle, `camera` to "camera". `timestamp_s`
# counts from the scene's first frame, and entries of one time are one frame. Without times, the
# n-th entry of every camera is frame n, 0.1 s apart. Beside `width` there may be a `lens`, and in a
# frame a `shutter`, in the form of augment.files.lens_records.

# int64 nanoseconds reach 9.2e9 s.
Seconds = Annotated[float, Field(strict=True, ge=-9e9, le=9e9, allow_inf_nan=False)]


class _PathFrame(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    timestamp_s: Seconds | None = None
    camera: Annotated[str, Field(pattern=r"^\w[\w.-]*$", max_length=64)] = "camera"
    position: Vector | None = None
    look_at: Vector | None = None
    world_from_camera: Pose | None = None
    shutter: ShutterRecord | None = None

    @model_validator(mode="after")
    def _check_pose_fields(self) -> _PathFrame:
        pair = (self.position is not None, self.look_at is not None)
        if pair != ((self.world_from_camera is None),) * 2:
            raise ValueError("give either position and look_at, or world_from_camera")
        return self


class _PathFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    width: Pixels
    height: Pixels
    fx: Focal
    fy: Focal | None = None
    cx: Number | None = None
    cy: Number | None = None
    lens: LensRecord | None = None
    frames: Annotated[list[_PathFrame], Field(min_length=1)]

    @model_validator(mode="after")
    def _check_times(self) -> _PathFile:
        has_time = [f.timestamp_s is not None for f in self.frames]
        if any(has_time) and not all(has_time):
            raise ValueError(
                f"timestamp_s must be in all frames or in none; it is in {sum(has_time)} of "
                f"{len(has_time)} (missing first in frames.{has_time.index(False)})"
            )
        keys = Counter((f.timestamp_s, f.camera) for f in self.frames)
        repeated_key, num_entries = keys.most_common(1)[0]
        if all(has_time) and num_entries > 1:
            raise ValueError(
                f"camera {repeated_key[1]!r} stands {num_entries} times at timestamp_s "
                f"{repeated_key[0]}"
            )
        return self


def _shutter_of(frame: _PathFrame, where: str) -> RollingShutter | None:
    """Return the rolling shutter of an entry of a camera path."""
    try:
        return None if frame.shutter is None else frame.shutter.shutter()
    except ValueError as error:
        raise AdapterError(f"{where}: shutter: {error}") from None


def path_views(content: object, path: Path) -> ViewSet:
    """Return the views of a camera path."""
    file = validate(_PathFile, content, path, "camera path")
    times = sorted({f.timestamp_s for f in file.frames if f.timestamp_s is not None})
    frame_of_time = {time: number for number, time in enumerate(times)}
    num_views_of_camera: Counter[str] = Counter()
    try:
        lens = None if file.lens is None else file.lens.lens()
    except ValueError as error:
        raise AdapterError(f"{path}: lens: {error}") from None
    views = []
    for number, frame in enumerate(file.frames):
        where = f"{path}: frames.{number}"
        if frame.position is not None and frame.look_at is not None:
            pose = look_at_pose(frame.position, frame.look_at, where=where)
        else:
            pose = check_pose(np.asarray(frame.world_from_camera), where=where)
        time = frame.timestamp_s
        views.append(
            PosedView(
                f"frames.{number}",
                *lens_of(file.width, file.height, file.fx, file.fy, file.cx, file.cy),
                pose,
                camera=frame.camera,
                frame=num_views_of_camera[frame.camera] if time is None else frame_of_time[time],
                timestamp_ns=None if time is None else round(time * 1e9),
                lens=lens,
                shutter=_shutter_of(frame, where),
            )
        )
        num_views_of_camera[frame.camera] += 1
    return ViewSet(tuple(views))


# ---- Any of them ---------------------------------------------------------------------------------

_JSON_NAMES = ("cameras.json", "transforms.json")


def read_views(path: Path, *, has_lenses: bool = False) -> ViewSet:
    """Read the views of a camera file, or of a folder with a COLMAP model or a JSON of a known
    name.

    Args:
        path: the file or folder.
        has_lenses: if True, views of COLMAP and nerfstudio have their lenses; if False, lens
            distortion is left out and reported. A camera path always has the lens that it states.
    """
    if not path.exists():
        raise AdapterError(
            f"{path}: no such file; expected an INRIA cameras.json, a nerfstudio transforms.json, "
            "a camera path (JSON) or a COLMAP sparse model"
        )
    camera_file = find_camera_file(path) if path.is_dir() else path
    if camera_file is None:
        raise AdapterError(
            f"{path}: no cameras in this folder; looked for {', '.join(_JSON_NAMES)} and a COLMAP "
            "sparse model (cameras and images, .bin or .txt) in it, sparse/0 and sparse"
        )
    read_file = read_colmap_views if camera_file.is_dir() else read_camera_json
    return read_file(camera_file, has_lenses=has_lenses)


def find_camera_file(folder: Path) -> Path | None:
    """Return the camera file of a folder (a COLMAP model is itself a folder).

    The result is None if there is none.
    """
    for name in _JSON_NAMES:
        if (folder / name).is_file():
            return folder / name
    return find_colmap_model(folder)


def read_camera_json(path: Path, *, has_lenses: bool = False) -> ViewSet:
    """Read any of the three JSON formats, told apart by their keys.

    Args:
        path: the file.
        has_lenses: see `read_views`.
    """
    content = read_json(path, object)
    if isinstance(content, list):
        return inria_views(content, path)
    frames = content.get("frames") if isinstance(content, dict) else None
    first_frame = frames[0] if isinstance(frames, list) and frames else None
    if isinstance(first_frame, dict) and "transform_matrix" in first_frame:
        return nerfstudio_views(content, path, has_lenses=has_lenses)
    if isinstance(content, dict) and "frames" in content:
        return path_views(content, path)
    description = f"a {type(content).__name__}"
    if isinstance(content, dict):
        description = f"an object with keys {sorted(content)[:8]}"
    raise AdapterError(
        f"{path}: expected a list of cameras (INRIA cameras.json), 'frames' with "
        "'transform_matrix' (nerfstudio transforms.json), or 'frames' with 'position' and "
        f"'look_at' or 'world_from_camera' (a camera path); got {description}"
    )
