"""Lenses of camera specifications, and specifications of our lenses.

Our principal points count from the outer corner of the first pixel, whose centre is (0.5, 0.5).
Those of the interface's OpenCV cameras do so, too; those of its f-theta cameras count from the
centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from augment.scene.cameras import Camera
from augment.scene.lenses import FisheyeLens, FThetaLens, Lens, OpenCVLens
from augment.scene.shutter import ReadOut
from tools.serve.errors import invalid
from tools.serve.messages import enum_numbers, message_class

# Offset of an f-theta camera's principal point to ours, pixels.
FTHETA_OFFSET_PX = 0.5
# Coefficients of an f-theta polynomial, at most.
MAX_COEFFICIENTS = 16
# Read-outs of the interface's rolling shutters.
_READ_OUTS: dict[str, ReadOut] = {
    "ROLLING_TOP_TO_BOTTOM": "top_to_bottom",
    "ROLLING_LEFT_TO_RIGHT": "left_to_right",
    "ROLLING_BOTTOM_TO_TOP": "bottom_to_top",
    "ROLLING_RIGHT_TO_LEFT": "right_to_left",
}


class LensNumbers(NamedTuple):
    """Numbers of a camera's image, and its lens."""

    fx: float
    """Focal length along x, pixels."""
    fy: float
    """Focal length along y, pixels."""
    cx: float
    """Column of the principal point, pixels."""
    cy: float
    """Row of the principal point, pixels."""
    lens: Lens | None
    """Lens; None for a pinhole."""


def read_lens(spec: Any) -> LensNumbers:
    """Return the numbers and the lens of a `CameraSpec`.

    Raises:
        RequestRefused: it has no lens, one that cannot be drawn, or impossible numbers.
    """
    if spec.WhichOneof("external_distortion") is not None:
        raise invalid(
            "camera_intrinsics.bivariate_windshield_model_param: a windshield's distortion cannot "
            "be drawn; leave it out"
        )
    kind = spec.WhichOneof("camera_param")
    if kind is None:
        raise invalid(
            "camera_intrinsics has no lens: set opencv_pinhole_param, opencv_fisheye_param or "
            "ftheta_param (get_available_cameras has those of the scene's cameras)"
        )
    readers = {
        "opencv_pinhole_param": _read_pinhole,
        "opencv_fisheye_param": _read_fisheye,
        "ftheta_param": _read_ftheta,
    }
    try:
        return readers[kind](getattr(spec, kind))
    except ValueError as error:
        raise invalid(f"camera_intrinsics.{kind}: {error}") from error


def _read_pinhole(param: Any) -> LensNumbers:
    """Return the lens of an `OpenCVPinholeCameraParam`: none where nothing is distorted."""
    radial = _padded(param.radial_coeffs, 6, "radial_coeffs")
    tangential = _padded(param.tangential_coeffs, 2, "tangential_coeffs")
    thin_prism = _padded(param.thin_prism_coeffs, 4, "thin_prism_coeffs")
    is_distorted = any((*radial, *tangential, *thin_prism))
    lens = OpenCVLens(radial, tangential, thin_prism) if is_distorted else None
    return LensNumbers(*_opencv_numbers(param), lens)


def _read_fisheye(param: Any) -> LensNumbers:
    """Return the lens of an `OpenCVFisheyeCameraParam`."""
    radial = _padded(param.radial_coeffs, 4, "radial_coeffs")
    return LensNumbers(*_opencv_numbers(param), FisheyeLens(radial, _limit(param.max_angle)))


def _read_ftheta(param: Any) -> LensNumbers:
    """Return the lens of an `FthetaCameraParam`."""
    types = enum_numbers("FthetaCameraParam.PolynomialType")
    references = {
        types["ANGLE_TO_PIXELDIST"]: "angle_to_distance",
        types["PIXELDIST_TO_ANGLE"]: "distance_to_angle",
    }
    reference = references.get(param.reference_poly)
    if reference is None:
        raise ValueError(
            f"reference_poly must be PIXELDIST_TO_ANGLE (1) or ANGLE_TO_PIXELDIST (2); got "
            f"{param.reference_poly}"
        )
    for name in ("angle_to_pixeldist_poly", "pixeldist_to_angle_poly"):
        if len(getattr(param, name)) > MAX_COEFFICIENTS:
            raise ValueError(
                f"{name} must have at most {MAX_COEFFICIENTS} coefficients; got "
                f"{len(getattr(param, name))}"
            )
    cde = param.linear_cde
    linear = (cde.linear_c, cde.linear_d, cde.linear_e)
    lens = FThetaLens(
        tuple(param.angle_to_pixeldist_poly),
        tuple(param.pixeldist_to_angle_poly),
        reference,
        _limit(param.max_angle),
        linear if any(linear) else (1.0, 0.0, 0.0),
    )
    cx = param.principal_point_x + FTHETA_OFFSET_PX
    cy = param.principal_point_y + FTHETA_OFFSET_PX
    return LensNumbers(lens.slope_px, lens.slope_px, cx, cy, lens)


def _opencv_numbers(param: Any) -> tuple[float, float, float, float]:
    """Return focal lengths and principal point of an OpenCV camera."""
    return (
        param.focal_length_x,
        param.focal_length_y,
        param.principal_point_x,
        param.principal_point_y,
    )


def _padded(values: Sequence[float], count: int, name: str) -> Any:
    """Return coefficients as a tuple of a length; absent ones are 0."""
    if len(values) > count:
        raise ValueError(f"{name} must have at most {count} coefficients; got {len(values)}")
    return (*values, *[0.0] * (count - len(values)))


def _limit(max_angle: float) -> float:
    """Return the largest angle that a lens shows, radians; 0 stands for no limit."""
    return min(max_angle, math.pi) if max_angle else math.pi


def read_out(spec: Any) -> ReadOut | None:
    """Return the direction in which a `CameraSpec` reads its image; None if all at once."""
    names = {number: name for name, number in enum_numbers("ShutterType").items()}
    return _READ_OUTS.get(names.get(spec.shutter_type, ""))


def camera_spec(camera: Camera) -> Any:
    """Return the `CameraSpec` of a camera."""
    shutters = enum_numbers("ShutterType")
    name_by_read_out = {value: name for name, value in _READ_OUTS.items()}
    shutter = "GLOBAL" if camera.shutter is None else name_by_read_out[camera.shutter.read_out]
    lens = camera.lens
    spec = message_class("CameraSpec")(
        logical_id=camera.name,
        resolution_h=camera.height,
        resolution_w=camera.width,
        shutter_type=shutters[shutter],
    )
    if isinstance(lens, FThetaLens):
        types = enum_numbers("FthetaCameraParam.PolynomialType")
        is_by_angle = lens.reference == "angle_to_distance"
        param = spec.ftheta_param
        param.principal_point_x = camera.cx - FTHETA_OFFSET_PX
        param.principal_point_y = camera.cy - FTHETA_OFFSET_PX
        param.reference_poly = types["ANGLE_TO_PIXELDIST" if is_by_angle else "PIXELDIST_TO_ANGLE"]
        param.angle_to_pixeldist_poly.extend(lens.angle_to_distance)
        param.pixeldist_to_angle_poly.extend(lens.distance_to_angle)
        param.max_angle = lens.limit_rad
        c, d, e = lens.linear
        param.linear_cde.linear_c = c
        param.linear_cde.linear_d = d
        param.linear_cde.linear_e = e
        return spec
    if isinstance(lens, FisheyeLens):
        param = spec.opencv_fisheye_param
        param.radial_coeffs.extend(lens.radial)
        param.max_angle = lens.limit_rad
    else:
        distortion = OpenCVLens() if lens is None else lens
        assert isinstance(distortion, OpenCVLens)
        param = spec.opencv_pinhole_param
        param.radial_coeffs.extend(distortion.radial)
        param.tangential_coeffs.extend(distortion.tangential)
        param.thin_prism_coeffs.extend(distortion.thin_prism)
    param.focal_length_x = camera.fx
    param.focal_length_y = camera.fy
    param.principal_point_x = camera.cx
    param.principal_point_y = camera.cy
    return spec
