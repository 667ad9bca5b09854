"""A scene of thousands of tiny frames, and a renderer that draws nothing: what is left is the job.

Worker processes import this module by name.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from augment.cameras import Camera, Frame
from augment.effects.smog import SmogMedium
from augment.scene import Gaussians, Scene
from augment.sky import ConstantSky
from recipes.schema import Recipe

CAMERAS = ("front", "rear")
WIDTH, HEIGHT = 32, 18
_PERIOD_NS = 100_000_000


@dataclass(frozen=True)
class _Smoggy:
    medium: SmogMedium | None = None
    surface_depth_m: np.ndarray | None = None
    water_level_z_m: float | None = None


@dataclass(frozen=True)
class _View:
    rgb: np.ndarray
    depth_m: np.ndarray | None
    semantic: None = None
    instance: None = None
    water: None = None
    flood: None = None
    snow: None = None
    snowy: None = None
    smoggy: _Smoggy | None = None
    surface: None = None


def open_tiny(uri: str) -> Scene:
    """`tiny:N`: N frames of two cameras."""
    count = int(uri.removeprefix("tiny:"))
    one = torch.zeros(1, 3)
    splat = Gaussians(
        one, torch.tensor([[1.0, 0, 0, 0]]), one + 0.1, torch.ones(1), torch.zeros(1, 1, 3)
    )
    return Scene(uri, uri, splat, (), ConstantSky(one[0]), tuple(map(_frame, range(count))))


def render_tiny(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> _View:
    """An image of one colour, another for every time."""
    shade = camera.timestamp_ns // _PERIOD_NS % 256
    rgb = np.full((camera.height, camera.width, 3), shade, np.uint8)
    smoggy = _Smoggy() if recipe.weather.smog is not None else None
    return _View(rgb, np.full(rgb.shape[:2], 4.0, np.float32), smoggy=smoggy)


def _frame(index: int) -> Frame:
    pose, time_ns = torch.eye(4, dtype=torch.float64), index * _PERIOD_NS
    cameras = {
        name: Camera(name, WIDTH, HEIGHT, 20.0, 20.0, WIDTH / 2, HEIGHT / 2, pose, time_ns)
        for name in CAMERAS
    }
    return Frame(index, time_ns, pose, cameras)
