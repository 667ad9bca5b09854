"""Lenses of COLMAP's camera models and of nerfstudio's, which count pixels as we do.

COLMAP's FOV and THIN_PRISM_FISHEYE, and nerfstudio's OPENCV with a k4 (of the eighth power of the
radius, which OpenCV does not have), are no lens here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from augment.scene.lenses import OPENCV_ORDER, FisheyeLens, Lens, OpenCVLens

# Parameters of COLMAP's models behind focal lengths and principal point, by our coefficients.
_COLMAP_PINHOLES = {
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_COLMAP_FISHEYES = {
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
    "RADIAL_FISHEYE": ("k1", "k2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
# Models of nerfstudio that are OpenCV's pinhole with distortion, or parts of it.
_NERFSTUDIO_PINHOLES = ("OPENCV", "SIMPLE_RADIAL", "RADIAL", "PINHOLE", "SIMPLE_PINHOLE")


def colmap_lens(camera: Any) -> Lens | None:
    """Return the lens of pycolmap's camera.

    The result is None for a pinhole, and for a model that no lens here is.
    """
    names = (_COLMAP_PINHOLES | _COLMAP_FISHEYES).get(camera.model_name)
    if names is None or camera.is_undistorted():
        return None
    numbers = [float(number) for number in camera.params[-len(names) :]]
    coefficients = dict(zip(names, numbers, strict=True))
    is_fisheye = camera.model_name in _COLMAP_FISHEYES
    return _fisheye(coefficients) if is_fisheye else _pinhole_with_distortion(coefficients)


def nerfstudio_lens(model: str, coefficients: Mapping[str, float]) -> Lens | None:
    """Return the lens of nerfstudio's intrinsics.

    The result is None for a pinhole, and for a model that no lens here is.

    Args:
        model: camera_model.
        coefficients: k1 to k4, p1 and p2 by name; 0 where the file has none.
    """
    if model == "OPENCV_FISHEYE":
        return _fisheye(coefficients)
    is_pinhole = not any(coefficients.values())
    if model not in _NERFSTUDIO_PINHOLES or coefficients["k4"] or is_pinhole:
        return None
    return _pinhole_with_distortion(coefficients)


def _fisheye(coefficients: Mapping[str, float]) -> Lens:
    """Return a fisheye; absent coefficients are 0."""
    k1, k2, k3, k4 = (coefficients.get(name, 0.0) for name in ("k1", "k2", "k3", "k4"))
    return FisheyeLens((k1, k2, k3, k4))


def _pinhole_with_distortion(coefficients: Mapping[str, float]) -> Lens:
    """Return OpenCV's pinhole with distortion; absent coefficients are 0."""
    return OpenCVLens.from_coefficients([coefficients.get(name, 0.0) for name in OPENCV_ORDER])
