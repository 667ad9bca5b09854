"""Cameras of requests, and camera specifications of a scene's cameras.

Principal points count from the outer corner of the first pixel, as ours do (pixel centres at +0.5).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

from torch import Tensor

from augment.errors import SceneError
from augment.scene.cameras import Camera, check_lens
from augment.scene.geometry import invert_rigid
from tools.serve.errors import RequestRefused, invalid, shown
from tools.serve.messages import enum_numbers, message_class
from tools.serve.poses import is_within_rounding, pose_message, pose_pair
from tools.serve.scene_facts import NS_PER_US, RigCamera, SceneFacts

# Time before the first and after the last image in which images are made, nanoseconds.
MAX_TIME_BEYOND_DRIVE_NS = 3600 * 10**9
# Relative difference up to which intrinsics are those of a recorded camera.
_SAME_INTRINSICS = 1e-9
# Longest exposure that is believed, microseconds.
_MAX_EXPOSURE_US = 1_000_000
# Length of a camera's name, at most, characters.
_MAX_NAME_LENGTH = 200


class _Intrinsics(NamedTuple):
    """Numbers of a camera's image."""

    fx: float
    """Focal length along x, pixels."""
    fy: float
    """Focal length along y, pixels."""
    cx: float
    """Column of the principal point, pixels."""
    cy: float
    """Row of the principal point, pixels."""


def requested_camera(request: Any, facts: SceneFacts, max_pixels: int) -> Camera:
    """Return the camera of an `RGBRenderRequest`.

    A request for a recorded image, by the camera's name, its intrinsics, the image's time and its
    pose in float32, gets the recorded camera with all its digits: its image is the one that
    `climategs render` writes.

    Args:
        request: the message.
        facts: facts of the scene.
        max_pixels: pixels of an image, at most.

    Raises:
        RequestRefused: a field cannot be used.
    """
    spec = request.camera_intrinsics
    width, height = _image_size(request, max_pixels)
    name = spec.logical_id
    if len(name) > _MAX_NAME_LENGTH:
        raise invalid(
            f"camera_intrinsics.logical_id must have at most {_MAX_NAME_LENGTH} characters; got "
            f"{len(name)}"
        )
    timestamp_us = _middle_us(request, facts)
    start, end = pose_pair(request.sensor_pose, "sensor_pose")
    spec_width = spec.resolution_w or width
    spec_height = spec.resolution_h or height
    intrinsics = _intrinsics(spec)
    try:
        camera = Camera(
            name,
            spec_width,
            spec_height,
            *intrinsics,
            camera_from_world=invert_rigid(_middle_pose(start, end)),
            timestamp_ns=timestamp_us * NS_PER_US,
        )
        check_lens(camera, f"camera {shown(name)}")
    except (ValueError, SceneError) as error:
        raise invalid(f"camera_intrinsics: {error}") from error
    recorded = facts.image_cameras.get((name, timestamp_us))
    if recorded is not None and start is end:
        recorded = recorded.resized(spec_width, spec_height)
        is_same_pose = is_within_rounding(camera.world_from_camera, recorded.world_from_camera)
        if is_same_pose and _has_same_intrinsics(camera, recorded):
            camera = recorded
        elif recorded.timestamp_ns != camera.timestamp_ns:
            # Digits below a microsecond choose the colours and moving objects of the image.
            camera = dataclasses.replace(camera, timestamp_ns=recorded.timestamp_ns)
    return camera.resized(width, height)


def _image_size(request: Any, max_pixels: int) -> tuple[int, int]:
    """Return width and height of the requested image."""
    spec = request.camera_intrinsics
    width = request.resolution_w or spec.resolution_w
    height = request.resolution_h or spec.resolution_h
    if width < 1 or height < 1:
        raise invalid(f"resolution_w and resolution_h must be >= 1 pixel; got {width}x{height}")
    if width * height > max_pixels:
        raise invalid(
            f"an image may have at most {max_pixels} pixels on this server (--max-pixels); got "
            f"{width}x{height} = {width * height}"
        )
    if max(spec.resolution_w, spec.resolution_h) > 1 << 20:
        raise invalid(
            f"camera_intrinsics: resolution_w and resolution_h must be at most {1 << 20}; got "
            f"{spec.resolution_w}x{spec.resolution_h}"
        )
    return width, height


def _middle_us(request: Any, facts: SceneFacts) -> int:
    """Return the middle of the exposure, microseconds, rounded down."""
    start_us = request.frame_start_us
    end_us = request.frame_end_us
    if not 0 <= end_us - start_us <= _MAX_EXPOSURE_US:
        raise invalid(
            f"frame_end_us must be from frame_start_us to {_MAX_EXPOSURE_US} microseconds later; "
            f"got {start_us} and {end_us}"
        )
    middle_us = start_us + (end_us - start_us) // 2
    check_time(middle_us * NS_PER_US, facts)
    return middle_us


def check_time(timestamp_ns: int, facts: SceneFacts) -> None:
    """Refuse a time far from a scene's drive, whose weather nobody means."""
    import grpc

    first_ns = facts.start_ns - MAX_TIME_BEYOND_DRIVE_NS
    last_ns = facts.end_ns + MAX_TIME_BEYOND_DRIVE_NS
    if not first_ns <= timestamp_ns <= last_ns:
        raise RequestRefused(
            grpc.StatusCode.OUT_OF_RANGE,
            f"the time {timestamp_ns // NS_PER_US} us is more than an hour away from the drive of "
            f"scene {facts.name!r}, from {facts.start_ns // NS_PER_US} to "
            f"{facts.end_ns // NS_PER_US} us",
        )


def _middle_pose(start: Tensor, end: Tensor) -> Tensor:
    """Return the pose in the middle between two."""
    if start is end:
        return start
    from augment.scene.geometry import quat_from_rotmat, rigid, rotmat_from_quat

    first = quat_from_rotmat(start[:3, :3])
    second = quat_from_rotmat(end[:3, :3])
    second = second if float(first @ second) >= 0 else -second
    return rigid(rotmat_from_quat(first + second), (start[:3, 3] + end[:3, 3]) / 2)


def _intrinsics(spec: Any) -> _Intrinsics:
    """Return the numbers of a specification."""
    if spec.WhichOneof("external_distortion") is not None:
        raise invalid(
            "camera_intrinsics.bivariate_windshield_model_param: a windshield's distortion cannot "
            "be drawn; leave it out, or undistort for it on the client's side"
        )
    kind = spec.WhichOneof("camera_param")
    if kind is None:
        raise invalid(
            "camera_intrinsics has no lens: set opencv_pinhole_param, opencv_fisheye_param or "
            "ftheta_param (get_available_cameras has those of the scene's cameras)"
        )
    param = getattr(spec, kind)
    if kind != "opencv_pinhole_param":
        raise invalid(f"camera_intrinsics.{kind}: this lens cannot be drawn; use a pinhole")
    distortion = [*param.radial_coeffs, *param.tangential_coeffs, *param.thin_prism_coeffs]
    if any(distortion):
        raise invalid("camera_intrinsics.opencv_pinhole_param: distortion cannot be drawn")
    return _Intrinsics(
        param.focal_length_x, param.focal_length_y, param.principal_point_x, param.principal_point_y
    )


def _has_same_intrinsics(first: Camera, second: Camera) -> bool:
    """Return True if two cameras of the same size have the same numbers."""
    return all(
        math.isclose(a, b, rel_tol=_SAME_INTRINSICS)
        for a, b in (
            (first.fx, second.fx),
            (first.fy, second.fy),
            (first.cx, second.cx),
            (first.cy, second.cy),
        )
    )


def available_camera(rig_camera: RigCamera) -> Any:
    """Return the `AvailableCamera` of a camera of a scene."""
    camera = rig_camera.camera
    response_class = message_class("AvailableCamerasReturn")
    return response_class.AvailableCamera(
        intrinsics=camera_spec(camera),
        rig_to_camera=pose_message(rig_camera.rig_from_camera),
        logical_id=camera.name,
    )


def camera_spec(camera: Camera) -> Any:
    """Return the `CameraSpec` of a camera."""
    return message_class("CameraSpec")(
        logical_id=camera.name,
        resolution_h=camera.height,
        resolution_w=camera.width,
        shutter_type=enum_numbers("ShutterType")["GLOBAL"],
        opencv_pinhole_param={
            "principal_point_x": camera.cx,
            "principal_point_y": camera.cy,
            "focal_length_x": camera.fx,
            "focal_length_y": camera.fy,
            "radial_coeffs": [0.0] * 6,
            "tangential_coeffs": [0.0] * 2,
            "thin_prism_coeffs": [0.0] * 4,
        },
    )
