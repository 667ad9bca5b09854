"""Small scenes of flat splats that snow can be placed on, and drives through them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch

from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rigid
from augment.scene.scene import Actor, Gaussians, Scene, Track
from augment.scene.sky import ConstantSky
from tests.scenes import camera_ahead, sh_of, stack

STEP_M = 0.2  # between the splats of a sheet


def sheet(
    x: tuple[float, float],
    y: tuple[float, float],
    z_m: float = 0.0,
    *,
    slope_deg: float = 0.0,
    rgb=(0.4, 0.4, 0.4),
    semantic: int | None = None,
    opacity: float = 0.99,
) -> Gaussians:
    """An opaque rectangle of flat splats; its height is z_m at x[0] and rises towards +x."""
    spots = _spots(x, y)
    angle = math.radians(slope_deg)
    z = z_m + math.tan(angle) * (spots[:, :1] - x[0])
    turn = [math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0]
    scales = [0.7 * STEP_M / math.cos(angle), 0.7 * STEP_M, 0.004]
    return splats(np.hstack([spots, z]), scales, turn, rgb, semantic, opacity)


def wall(x_m: float, y: tuple[float, float], z: tuple[float, float], *, rgb=(0.7, 0.6, 0.5)):
    """An opaque wall across the x axis."""
    spots = _spots(y, z)
    means = np.hstack([np.full((len(spots), 1), x_m), spots])
    return splats(means, [0.004, 0.7 * STEP_M, 0.7 * STEP_M], rgb=rgb)


def side_wall(y_m: float, x: tuple[float, float], z: tuple[float, float], *, rgb=(0.7, 0.6, 0.5)):
    """An opaque wall along the x axis."""
    spots = _spots(x, z)
    means = np.stack([spots[:, 0], np.full(len(spots), y_m), spots[:, 1]], 1)
    return splats(means, [0.7 * STEP_M, 0.004, 0.7 * STEP_M], rgb=rgb)


def drive(
    *parts: Gaussians,
    actors: Sequence[Actor] = (),
    places: Sequence[tuple[float, float, float]] = ((0.0, 0.0, 1.5), (1.0, 0.0, 1.5)),
    yaw: float = 0.0,
    **options,
) -> Scene:
    """A scene seen by one camera that looks ahead from each of the places."""
    frames = []
    for number, place in enumerate(places):
        time_ns = 100_000_000 * number
        camera = camera_ahead(160, 90, 80.0, position=place, yaw=yaw, timestamp_ns=time_ns)
        ego = rigid(torch.eye(3).double(), torch.tensor([place[0], place[1], place[2] - 1.5]))
        frames.append(Frame(number, time_ns, ego.double(), {"ahead": camera}))
    return Scene(
        name="sheets",
        source="test:sheets",
        background=stack_all(parts),
        actors=tuple(actors),
        sky=ConstantSky(torch.tensor([0.6, 0.7, 0.9])),
        frames=tuple(frames),
        **options,
    )


def cameras_of(scene: Scene) -> list[Camera]:
    return [camera for frame in scene.frames for camera in frame.cameras.values()]


def stack_all(parts: Sequence[Gaussians]) -> Gaussians:
    """Parts one after the other, with their classes where all have them."""
    joined = stack(*parts)
    if any(part.semantic is None for part in parts):
        return joined
    classes = torch.cat([part.semantic for part in parts])
    return dataclasses.replace(joined, semantic=classes)


def box_car(
    *,
    start=(6.0, 3.0),
    moved_m: float = 5.0,
    size=(4.0, 1.8, 1.5),
    label: str = "Car",
    semantic: int | None = None,
    with_shadow: bool = True,
    track_id: str = "car",
) -> Actor:
    """A box with a flat roof, which drives along +x on ground at z = 0."""
    half = [value / 2 for value in size]
    parts = [
        sheet((-half[0], half[0]), (-half[1], half[1]), half[2], semantic=semantic),
        side_wall(-half[1], (-half[0], half[0]), (-half[2], half[2])),
        side_wall(half[1], (-half[0], half[0]), (-half[2], half[2])),
    ]
    if with_shadow:
        shadow = sheet((-half[0] - 1, half[0] + 1), (-half[1] - 1, half[1] + 1), -half[2])
        parts.append(shadow)
    gaussians = stack(*parts)
    if semantic is not None:
        classes = torch.full((len(gaussians),), semantic, dtype=torch.int16)
        if with_shadow:
            classes[-len(shadow) :] = 1
        gaussians = dataclasses.replace(gaussians, semantic=classes)
    times = torch.tensor([0, 100_000_000])
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[:, 0, 3] = torch.tensor([start[0], start[0] + moved_m])
    poses[:, 1, 3], poses[:, 2, 3] = start[1], half[2]
    return Actor(track_id, label, gaussians, Track(times, poses), size)


def _spots(a: tuple[float, float], b: tuple[float, float]) -> np.ndarray:
    """Middles of squares of about STEP_M that fill a rectangle, [N, 2]."""
    axes = []
    for low, high in (a, b):
        count = max(1, round((high - low) / STEP_M))
        axes.append(low + (np.arange(count) + 0.5) * (high - low) / count)
    grid = np.meshgrid(*axes, indexing="ij")
    return np.stack([g.ravel() for g in grid], 1)


def splats(
    means, scales, turn=(1.0, 0.0, 0.0, 0.0), rgb=(0.5, 0.5, 0.5), semantic=None, opacity=0.99
) -> Gaussians:
    """Gaussians at means [N, 3]; scales and turn: of each, or [N, 3] and [N, 4]; rgb: the same."""
    count = len(means)
    turns, sizes, colors = (
        torch.as_tensor(values, dtype=torch.float64).expand(count, width).clone()
        for values, width in ((turn, 4), (scales, 3), (rgb, 3))
    )
    return Gaussians(
        means=torch.as_tensor(means).float(),
        quats=turns.float(),
        scales=sizes.float(),
        opacities=torch.full((count,), opacity),
        sh=sh_of(colors.numpy()),
        semantic=None if semantic is None else torch.full((count,), int(semantic)).short(),
    )
