"""Requests of a closed-loop simulator, as tests send them."""

from __future__ import annotations

from typing import Any

import grpc

from augment.scene.cameras import Camera
from tools.serve.lens_specs import camera_spec
from tools.serve.messages import enum_numbers, message_class
from tools.serve.poses import pose_message

EMPTY = message_class("common.Empty")()


def image_request(scene_id: str, camera: Camera, image_format: str = "PNG") -> Any:
    """A request for the image of a camera, at its time, pose and size."""
    pose = pose_message(camera.world_from_camera)
    time_us = camera.timestamp_ns // 1000
    return message_class("RGBRenderRequest")(
        scene_id=scene_id,
        resolution_h=camera.height,
        resolution_w=camera.width,
        camera_intrinsics=camera_spec(camera),
        frame_start_us=time_us,
        frame_end_us=time_us + 1,
        sensor_pose={"start_pose": pose, "end_pose": pose},
        image_format=enum_numbers("ImageFormat")[image_format],
    )


def changed(request: Any, **changes: Any) -> Any:
    """A copy of a message with other values; `a__b=1` sets the field b of the field a."""
    copy = type(request)()
    copy.CopyFrom(request)
    for path, value in changes.items():
        *parents, name = path.split("__")
        message = copy
        for parent in parents:
            message = getattr(message, parent)
        setattr(message, name, value)
    return copy


def refusal(call: Any, request: Any) -> tuple[str, str]:
    """Status and words with which a call is refused; ("OK", "") if it is not."""
    try:
        call(request, timeout=60)
    except grpc.RpcError as error:
        return error.code().name, error.details()
    return "OK", ""
