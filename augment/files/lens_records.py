"""Lenses and rolling shutters in JSON files: calibrations, scene files, camera paths.

    "lens": {"model": "opencv", "k1": -0.37, "k2": 0.2, "p1": 0.001, "p2": 0.0006, "k3": -0.07}
    "lens": {"model": "opencv_fisheye", "k1": ..., "k4": ..., "max_angle_rad": 1.6}
    "lens": {"model": "ftheta", "reference": "angle_to_distance", "angle_to_distance": [0.0, ...],
             "distance_to_angle": [], "linear": [1.0, 0.0, 0.0], "max_angle_rad": 1.3}
    "shutter": {"read_out": "left_to_right", "duration_ns": 44000000,
                "start_from_camera": 4x4, "end_from_camera": 4x4}

Coefficients that are left out are 0. The camera's fx, fy, cx, cy stand beside the lens, in pixels
whose centres lie at +0.5. Floats keep all their digits.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter

from augment.scene.cameras import Camera
from augment.scene.lenses import OPENCV_ORDER, FisheyeLens, FThetaLens, Lens, OpenCVLens
from augment.scene.shutter import ReadOut, RollingShutter

# Largest number of coefficients of a polynomial that is read.
_MAX_COEFFICIENTS = 32
# Coefficients of an OpenCV lens that are always written; the others only where they are not 0.
_NUM_WRITTEN = 5


def _as_tuple(value: object) -> object:
    """Return JSON's list as a tuple."""
    return tuple(value) if isinstance(value, list) else value


_TUPLE = BeforeValidator(_as_tuple)
_Row4 = Annotated[tuple[float, float, float, float], _TUPLE]
_Matrix4x4 = Annotated[tuple[_Row4, _Row4, _Row4, _Row4], _TUPLE]
_Polynomial = Annotated[tuple[float, ...], _TUPLE, Field(max_length=_MAX_COEFFICIENTS)]
_Angle = Annotated[float, Field(gt=0, le=math.pi)]


class _Record(BaseModel):
    """Base of the records: closed, strict, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class OpenCVRecord(_Record):
    """OpenCV's pinhole with distortion."""

    model: Literal["opencv"]
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0

    def lens(self) -> Lens:
        """Return the lens."""
        return OpenCVLens.from_coefficients([getattr(self, name) for name in OPENCV_ORDER])


class FisheyeRecord(_Record):
    """OpenCV's fisheye, after Kannala and Brandt."""

    model: Literal["opencv_fisheye"]
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    max_angle_rad: _Angle = math.pi

    def lens(self) -> Lens:
        """Return the lens."""
        return FisheyeLens((self.k1, self.k2, self.k3, self.k4), self.max_angle_rad)


class FThetaRecord(_Record):
    """NVIDIA's f-theta lens."""

    model: Literal["ftheta"]
    angle_to_distance: _Polynomial = ()
    distance_to_angle: _Polynomial = ()
    reference: Literal["angle_to_distance", "distance_to_angle"] = "angle_to_distance"
    linear: Annotated[tuple[float, float, float], _TUPLE] = (1.0, 0.0, 0.0)
    max_angle_rad: _Angle = math.pi

    def lens(self) -> Lens:
        """Return the lens."""
        return FThetaLens(
            self.angle_to_distance,
            self.distance_to_angle,
            self.reference,
            self.max_angle_rad,
            self.linear,
        )


LensRecord = Annotated[OpenCVRecord | FisheyeRecord | FThetaRecord, Field(discriminator="model")]


class ShutterRecord(_Record):
    """A rolling shutter. Poses take points from the camera's axes at the middle of the read-out."""

    read_out: ReadOut
    duration_ns: int
    start_from_camera: _Matrix4x4
    end_from_camera: _Matrix4x4
    first_share: float = 0.0
    last_share: float = 1.0

    def shutter(self) -> RollingShutter:
        """Return the shutter.

        Raises:
            ValueError: a pose is not rigid, or the duration is beyond limits.
        """
        return RollingShutter(
            torch.tensor(self.start_from_camera, dtype=torch.float64),
            torch.tensor(self.end_from_camera, dtype=torch.float64),
            self.read_out,
            self.duration_ns,
            self.first_share,
            self.last_share,
        )


_LENS_ADAPTER: TypeAdapter[OpenCVRecord | FisheyeRecord | FThetaRecord] = TypeAdapter(LensRecord)


def lens_of_record(content: object) -> Lens:
    """Return the lens of a JSON object.

    Raises:
        ValueError: the object describes no lens.
    """
    return _LENS_ADAPTER.validate_python(content).lens()


def shutter_of_record(content: object) -> RollingShutter:
    """Return the shutter of a JSON object.

    Raises:
        ValueError: the object describes no shutter.
    """
    return ShutterRecord.model_validate(content).shutter()


def lens_record(lens: Lens) -> dict[str, Any]:
    """Return a lens as a JSON object.

    Raises:
        TypeError: the class of the lens has no form in JSON.
    """
    if isinstance(lens, OpenCVLens):
        k1, k2, k3, k4, k5, k6 = lens.radial
        numbers = (k1, k2, *lens.tangential, k3, k4, k5, k6, *lens.thin_prism)
        coefficients = {
            name: number
            for place, (name, number) in enumerate(zip(OPENCV_ORDER, numbers, strict=True))
            if place < _NUM_WRITTEN or number
        }
        return {"model": "opencv", **coefficients}
    if isinstance(lens, FisheyeLens):
        coefficients = dict(zip(("k1", "k2", "k3", "k4"), lens.radial, strict=True))
        return {"model": "opencv_fisheye", **coefficients, "max_angle_rad": lens.limit_rad}
    if isinstance(lens, FThetaLens):
        return {
            "model": "ftheta",
            "reference": lens.reference,
            "angle_to_distance": list(lens.angle_to_distance),
            "distance_to_angle": list(lens.distance_to_angle),
            "linear": list(lens.linear),
            "max_angle_rad": lens.limit_rad,
        }
    raise TypeError(f"a lens of class {type(lens).__name__} cannot be written to a file")


def shutter_record(shutter: RollingShutter) -> dict[str, Any]:
    """Return a shutter as a JSON object."""
    record: dict[str, Any] = {
        "read_out": shutter.read_out,
        "duration_ns": shutter.duration_ns,
        "start_from_camera": shutter.start_from_camera.tolist(),
        "end_from_camera": shutter.end_from_camera.tolist(),
    }
    if (shutter.first_share, shutter.last_share) != (0.0, 1.0):
        record["first_share"] = shutter.first_share
        record["last_share"] = shutter.last_share
    return record


def optics_record(camera: Camera) -> dict[str, Any]:
    """Return the entries `lens` and `shutter` of a camera; empty for a pinhole."""
    record: dict[str, Any] = {}
    if camera.lens is not None:
        record["lens"] = lens_record(camera.lens)
    if camera.shutter is not None:
        record["shutter"] = shutter_record(camera.shutter)
    return record


def lens_words(lens: Lens) -> str:
    """Return the kind of a lens, for messages."""
    names = {"opencv": "OpenCV distortion", "opencv_fisheye": "a fisheye", "ftheta": "f-theta"}
    return names[lens_record(lens)["model"]]
