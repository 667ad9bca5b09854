"""Cameras that other tools wrote as JSON: INRIA's cameras.json and nerfstudio's transforms.json."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from adapters.cameras.posed_views import PosedView, ViewSet, check_pose
from adapters.plain_files import LARGEST
from augment.batch.manifest import MAX_SIDE_PX
from augment.errors import AdapterError

Model = TypeVar("Model", bound=BaseModel)
# No texts, true or false, which pydantic otherwise takes for numbers; and none beyond LARGEST.
Number = Annotated[float, Field(strict=True, ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Vector = tuple[Number, Number, Number]
Row = tuple[Number, Number, Number, Number]
Pose = Annotated[list[Row], Field(min_length=3, max_length=4)]
Pixels = Annotated[Number, Field(ge=1, le=MAX_SIDE_PX, multiple_of=1), AfterValidator(int)]
Focal = Annotated[Number, Field(gt=0)]
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_ERRORS_SHOWN = 5


class _Foreign(BaseModel):
    """Other tools' formats carry more keys than are needed here."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class _InriaCamera(_Foreign):
    img_name: str
    width: Pixels
    height: Pixels
    fx: Focal
    fy: Focal
    cx: Number | None = None
    cy: Number | None = None
    position: Vector
    rotation: tuple[Vector, Vector, Vector]


class _InriaFile(_Foreign):
    cameras: Annotated[list[_InriaCamera], Field(min_length=1)]


class _Intrinsics(_Foreign):
    """nerfstudio's, which stand at the top, in a frame, or divided between both."""

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


def validate(model: type[Model], content: object, path: Path, kind: str) -> Model:
    """`content` as the model.

    Raises:
        AdapterError: names the first fields that do not fit, with their place and value.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        lines = [
            f"{'.'.join(map(str, e['loc'])) or 'file'}: {e['msg']} (got {str(e['input'])[:60]})"
            for e in error.errors()[:_ERRORS_SHOWN]
        ]
        more = error.error_count() - len(lines)
        raise AdapterError(
            f"{path}: not a valid {kind}: " + "; ".join(lines) + (f"; {more} more" if more else "")
        ) from error


def inria_views(content: list[object], path: Path) -> ViewSet:
    """Views of INRIA's list. Its cameras have no principal point, which is the middle then; our own
    exports add cx and cy.

    Raises:
        AdapterError: a field is missing or out of range; names it.
    """
    file = validate(_InriaFile, {"cameras": content}, path, "INRIA cameras.json")
    views = []
    for number, camera in enumerate(file.cameras):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.rotation, camera.position
        views.append(
            PosedView(
                name=camera.img_name,
                width=camera.width,
                height=camera.height,
                fx=camera.fx,
                fy=camera.fy,
                cx=camera.width / 2 if camera.cx is None else camera.cx,
                cy=camera.height / 2 if camera.cy is None else camera.cy,
                world_from_camera=check_pose(pose, where=f"{path}: {number} ({camera.img_name})"),
            )
        )
    return ViewSet(tuple(views))


def nerfstudio_views(content: object, path: Path) -> ViewSet:
    """Views of nerfstudio's frames: OpenGL axes turned to OpenCV's, lens distortion left out.

    Raises:
        AdapterError: a field is missing or out of range, or a lens with no pinhole near it.
    """
    file = validate(_NerfstudioFile, content, path, "nerfstudio transforms.json")
    views = []
    distorted: Counter[str] = Counter()
    shared = file.model_dump(exclude={"frames"}, exclude_none=True)
    for number, frame in enumerate(file.frames):
        where = f"{path}: frames.{number} ({frame.file_path})"
        own = frame.model_dump(exclude={"file_path", "transform_matrix"}, exclude_none=True)
        lens = _Intrinsics(**(shared | own))
        model = (lens.camera_model or "OPENCV").upper()
        if model.startswith(("EQUIRECT", "ORTHO")):
            raise AdapterError(f"{where}: camera_model {model} has no pinhole camera near it")
        if "FISHEYE" in model or any(getattr(lens, name) for name in _DISTORTION):
            distorted[model] += 1
        opencv_from_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
        pose = np.asarray(frame.transform_matrix, dtype=np.float64)
        pose = check_pose(np.vstack([pose[:3], [0, 0, 0, 1]]) @ opencv_from_opengl, where=where)
        image = path.parent / frame.file_path
        views.append(
            PosedView(
                name=frame.file_path,
                **_pinhole(lens, where),
                world_from_camera=pose,
                image_path=str(image) if image.is_file() else None,
            )
        )
    problems = [distortion_problem(str(path), n, m) for m, n in distorted.items()]
    return ViewSet(tuple(views), tuple(problems))


def distortion_problem(where: str, count: int, model: str) -> str:
    """The sentence for images whose lens is not a pinhole."""
    return (
        f"{where}: {count} images have lens distortion (model {model}), which is left out; they "
        "are rendered as pinhole cameras and will not line up with the distorted images"
    )


def _pinhole(lens: _Intrinsics, where: str) -> dict[str, Any]:
    if lens.w is None or lens.h is None:
        raise AdapterError(f"{where}: w and h (image size, pixels) are missing; add them")
    fl_x = lens.fl_x
    if fl_x is None and lens.camera_angle_x is not None:
        fl_x = 0.5 * lens.w / math.tan(0.5 * lens.camera_angle_x)
    if fl_x is None:
        raise AdapterError(f"{where}: fl_x (pixels) or camera_angle_x (radians) is missing; add it")
    return {
        "width": lens.w,
        "height": lens.h,
        "fx": fl_x,
        "fy": fl_x if lens.fl_y is None else lens.fl_y,
        "cx": lens.w / 2 if lens.cx is None else lens.cx,
        "cy": lens.h / 2 if lens.cy is None else lens.cy,
    }
