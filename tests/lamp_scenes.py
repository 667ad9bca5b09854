"""Lamps, cameras and flat roads for tests of light."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from augment.lamps.lamp import LampKind, Lamps, lamp_frame
from augment.lamps.patterns import Pattern, standard_tables
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid

# Rotation of a camera that looks along the world's x.
CAMERA_AXES = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)


def camera_at(
    height_m: float,
    *,
    width: int = 320,
    height: int = 200,
    focal_px: float = 300.0,
    pitch_deg: float = 0.0,
) -> Camera:
    """Return a camera above the origin that looks along x, and down by the pitch."""
    pitch = math.radians(pitch_deg)
    turn = torch.tensor(
        [[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]],
        dtype=torch.float64,
    )
    axes = turn @ CAMERA_AXES
    pose = rigid(axes, -axes @ torch.tensor([0, 0, height_m], dtype=torch.float64))
    focal = float(focal_px)
    return Camera("front", width, height, focal, focal, width / 2, height / 2, pose)


def road_depth(camera: Camera, max_m: float = 400.0) -> np.ndarray:
    """Return z of the road z = 0 in each pixel; 0 beyond max_m and above the horizon."""
    rays = camera.ray_directions(torch.float64).numpy()
    with np.errstate(divide="ignore"):
        depth = -float(camera.centre[2]) / rays[..., 2]
    return np.where((depth > 0) & (depth < max_m), depth, 0).astype(np.float32)


def lamps_at(
    positions_m: Sequence[Sequence[float]],
    axis: Sequence[float] = (-1, 0, 0),
    *,
    candela: float = 1000.0,
    pattern: Pattern = Pattern.ISOTROPIC,
    color: Sequence[float] = (1.0, 1.0, 1.0),
    kind: LampKind = LampKind.OTHER,
    owner: int = 0,
    radius_m: float = 0.05,
) -> Lamps:
    """Return equal lamps at several places that face along an axis."""
    count = len(positions_m)
    axes, ups = lamp_frame(np.tile(np.array(axis, float), (count, 1)), np.array([0, 0, 1.0]))
    return Lamps(
        np.array(positions_m, float).reshape(-1, 3),
        axes,
        ups,
        np.full(count, float(candela)),
        np.full(count, int(pattern)),
        standard_tables(),
        np.tile(np.array(color, float), (count, 1)),
        np.full(count, radius_m),
        np.full(count, 90.0),
        np.full(count, float(candela)),
        np.full(count, int(kind)),
        np.full(count, owner),
    )
