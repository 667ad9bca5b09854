"""Cameras of requests, and a scene's cameras as clients get them."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import grpc
from torch import Tensor

from augment.errors import SceneError
from augment.scene.cameras import Camera, check_lens
from augment.scene.geometry import invert_rigid
from augment.scene.shutter import RollingShutter, interpolate_pose
from tools.serve.errors import RequestRefused, invalid, quote_text
from tools.serve.lens_specs import camera_spec, read_lens, read_out
from tools.serve.messages import message_class
from tools.serve.poses import is_within_rounding, pose_message, pose_pair
from tools.serve.scene_facts import NS_PER_US, RigCamera, SceneFacts

# Time before the first and after the last image in which images are made, nanoseconds.
MAX_TIME_BEYOND_DRIVE_NS = 3600 * 10**9
# Relative difference up to which intrinsics are those of a recorded camera.
_SAME_INTRINSICS = 1e-9
# Longest exposure of an image, and longest spin of a sensor, that is believed, microseconds.
_MAX_EXPOSURE_US = 1_000_000
# Length of a camera's name, at most, characters.
_MAX_NAME_LENGTH = 200


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
    width, height = _checked_size(request, max_pixels)
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
    numbers = read_lens(spec)
    exposure_us = request.frame_end_us - request.frame_start_us
    try:
        camera = Camera(
            name,
            spec_width,
            spec_height,
            fx=numbers.fx,
            fy=numbers.fy,
            cx=numbers.cx,
            cy=numbers.cy,
            camera_from_world=_camera_from_world(start, end),
            timestamp_ns=timestamp_us * NS_PER_US,
            lens=numbers.lens,
            shutter=_shutter(spec, start, end, exposure_us),
        )
        check_lens(camera, f"camera {quote_text(name)}")
    except (ValueError, SceneError) as error:
        raise invalid(f"camera_intrinsics: {error}") from error
    recorded = facts.image_cameras.get((name, timestamp_us))
    if recorded is not None:
        recorded = recorded.resized(spec_width, spec_height)
        is_same_pose = is_within_rounding(camera.world_from_camera, recorded.world_from_camera)
        is_same_shutter = _is_same_shutter(camera.shutter, recorded.shutter)
        if is_same_pose and is_same_shutter and has_same_intrinsics(camera, recorded):
            camera = recorded
        elif recorded.timestamp_ns != camera.timestamp_ns:
            # Digits below a microsecond choose the colours and moving objects of the image.
            camera = dataclasses.replace(camera, timestamp_ns=recorded.timestamp_ns)
    return camera.resized(width, height)


def image_size(request: Any) -> tuple[int, int]:
    """Return width and height of the requested image: by default those of the camera's numbers."""
    spec = request.camera_intrinsics
    return request.resolution_w or spec.resolution_w, request.resolution_h or spec.resolution_h


def _checked_size(request: Any, max_pixels: int) -> tuple[int, int]:
    """Return width and height of the requested image, neither 0 nor too large."""
    spec = request.camera_intrinsics
    width, height = image_size(request)
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
    check_exposure(request)
    start_us = request.frame_start_us
    middle_us = start_us + (request.frame_end_us - start_us) // 2
    check_time(middle_us * NS_PER_US, facts)
    return middle_us


def check_exposure(request: Any) -> None:
    """Refuse an exposure, or a spin, that ends before it begins, or much later."""
    start_us = request.frame_start_us
    end_us = request.frame_end_us
    if not 0 <= end_us - start_us <= _MAX_EXPOSURE_US:
        raise invalid(
            f"frame_end_us must be from frame_start_us to {_MAX_EXPOSURE_US} microseconds later; "
            f"got {start_us} and {end_us}"
        )


def check_time(timestamp_ns: int, facts: SceneFacts) -> None:
    """Refuse a time far from a scene's drive, whose weather nobody means."""
    first_ns = facts.start_ns - MAX_TIME_BEYOND_DRIVE_NS
    last_ns = facts.end_ns + MAX_TIME_BEYOND_DRIVE_NS
    if not first_ns <= timestamp_ns <= last_ns:
        raise RequestRefused(
            grpc.StatusCode.OUT_OF_RANGE,
            f"the time {timestamp_ns // NS_PER_US} us is more than an hour away from the drive of "
            f"scene {facts.name!r}, from {facts.start_ns // NS_PER_US} to "
            f"{facts.end_ns // NS_PER_US} us",
        )


def _camera_from_world(start: Tensor, end: Tensor) -> Tensor:
    """Return the inverse of the pose in the middle between two."""
    if start is end:
        return invert_rigid(start)
    return interpolate_pose(invert_rigid(start), invert_rigid(end), 0.5)


def _shutter(spec: Any, start: Tensor, end: Tensor, exposure_us: int) -> RollingShutter | None:
    """Return the shutter of a moving camera whose rows or columns are read one after another."""
    direction = read_out(spec)
    if direction is None or start is end or exposure_us < 2:
        return None
    return RollingShutter.between(
        invert_rigid(start),
        invert_rigid(end),
        read_out=direction,
        duration_ns=exposure_us * NS_PER_US,
    )


def _is_same_shutter(first: RollingShutter | None, second: RollingShutter | None) -> bool:
    """Return True if two shutters are the same within the rounding of messages."""
    if first is None or second is None:
        return first is second
    return (
        first.read_out == second.read_out
        and abs(first.duration_ns - second.duration_ns) <= 2 * NS_PER_US
        and is_within_rounding(first.start_from_camera, second.start_from_camera)
        and is_within_rounding(first.end_from_camera, second.end_from_camera)
    )


def has_same_intrinsics(first: Camera, second: Camera) -> bool:
    """Return True if two cameras of the same size have the same numbers and lens."""
    return first.lens == second.lens and all(
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
