"""A painted wall and a painted board that moves before it, seen exactly: truth for warping."""

from __future__ import annotations

import numpy as np
import torch

from augment.metrics.consistency import DepthView
from augment.output.tables import FrameBoxes
from augment.scene.cameras import Camera
from augment.scene.labels import Boxes
from tests.scenes import camera_ahead

WALL_M, BOARD_M, THICKNESS_M = 12.0, 6.0, 0.4  # the board's front face, and how thick it is
BOARD_SIZE_M = np.array([THICKNESS_M, 2.0, 1.6])
SPEED_MPS = np.array([0.0, 2.0, 0.0])
FRAME_NS = 100_000_000


def board_centre(timestamp_ns: int) -> np.ndarray:
    start = np.array([BOARD_M + THICKNESS_M / 2, -0.5, 0.0])
    return start + SPEED_MPS * (timestamp_ns * 1e-9)


def board_boxes(frames: int, **changes) -> dict[int, FrameBoxes]:
    """The board's labels at the frames' times."""
    found = {}
    for number in range(frames):
        centre = board_centre(number * FRAME_NS)[None]
        boxes = Boxes(("board",), ("Car",), centre, BOARD_SIZE_M[None], np.array([[1.0, 0, 0, 0]]))
        found[number] = FrameBoxes(number * FRAME_NS, boxes)
    return found


def wall_view(camera: Camera, *, board: bool = True) -> DepthView:
    """The wall x = WALL_M, and the board where it is at the camera's time. Colours are linear in
    the place on the wall or on the board, so bilinear interpolation has next to no error.
    """
    rays = camera.ray_directions(torch.float64).numpy()
    centre = camera.centre.numpy()
    depth = (WALL_M - centre[0]) / rays[..., 0]
    hit = centre + depth[..., None] * rays
    picture = _paint(hit[..., 1], hit[..., 2], 0.02)
    if board:
        front = (BOARD_M - centre[0]) / rays[..., 0]
        local = centre + front[..., None] * rays - board_centre(camera.timestamp_ns)
        on = (np.abs(local[..., 1:]) <= BOARD_SIZE_M[1:] / 2).all(-1)
        depth = np.where(on, front, depth)
        picture[on] = _paint(local[on, 1], local[on, 2], 0.2)
    return DepthView(camera, picture, depth, np.ones_like(depth))


def driving_camera(frame: int, *, name: str = "ahead", yaw: float = 0.0) -> Camera:
    """Of a car that drives towards the wall at 1 m/s; the picture is taken at the frame's time."""
    import dataclasses

    camera = camera_ahead(
        64, 48, 40.0, position=(0.1 * frame, 0.0, 0.0), yaw=yaw, timestamp_ns=frame * FRAME_NS
    )
    return dataclasses.replace(camera, name=name)


def _paint(y: np.ndarray, z: np.ndarray, slope: float) -> np.ndarray:
    return np.stack([0.5 + slope * y, 0.5 - slope * z, 0.4 + slope * (y + z)], -1).clip(0, 1)
