"""Cameras and returns in other axes or frames than they should be in."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from adapters.drive_checks import camera_problems, lidar_problems
from augment.scene.cameras import Camera, Frame
from tests.adapters import drives

OPENGL = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
BEHIND = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])
STEP_M = 2.0


def frames(*, turned: torch.Tensor | None = None, **rig: np.ndarray) -> tuple[Frame, ...]:
    """Four frames of a car that drives along x. rig: rotations by camera. turned: of their axes."""

    def camera(name: str, rotation: np.ndarray, number: int) -> Camera:
        place = (STEP_M * number, 0.0, 1.5)
        made = drives.camera(name, number, position=place, rotation=rotation)
        if turned is None:
            return made
        return dataclasses.replace(made, camera_from_world=turned @ made.camera_from_world)

    found = []
    for number in range(4):
        ego = torch.eye(4, dtype=torch.float64)
        ego[0, 3] = STEP_M * number
        cameras = {name: camera(name, rotation, number) for name, rotation in rig.items()}
        found.append(Frame(number, number * drives.FRAME_NS, ego, cameras))
    return tuple(found)


def test_cameras_in_opengl_axes_are_named_with_what_to_do() -> None:
    rig = {"front": drives.AHEAD, "left": drives.LEFT, "rear": BEHIND}
    assert camera_problems(frames(**rig)) == ()
    (problem,) = camera_problems(frames(turned=OPENGL, **rig))
    assert "front, left, rear are upside down" in problem and "negate the second" in problem
    (problem,) = camera_problems(frames(front_wide=BEHIND, left=drives.LEFT))
    assert "front_wide look back along the car" in problem
    upside_down = np.diag([-1.0, -1, 1]) @ drives.LEFT  # one camera may be mounted so
    assert camera_problems(frames(front=drives.AHEAD, left=upside_down, rear=BEHIND)) == ()


def street(seed: int, count: int) -> np.ndarray:
    """Poles, corners and a road, [N, 3]."""
    rng = np.random.default_rng(seed)
    places = rng.uniform([-25, -20], [35, 20], (count, 2))
    heights = rng.uniform(0, 3, (count, 40))
    poles = np.concatenate([np.repeat(places, 40, 0), heights.reshape(-1, 1)], 1)
    road = np.column_stack([rng.uniform(-30, 40, (4000, 2)), np.zeros(4000)])
    return np.concatenate([poles, road])


def wall() -> np.ndarray:
    """A wall along the road, which looks the same wherever the car is, [N, 3]."""
    x, z = np.meshgrid(np.arange(-60, 60, 0.2), np.arange(0, 3, 0.2))
    return np.column_stack([x.ravel(), np.full(x.size, 7.0), z.ravel()])


@pytest.mark.parametrize(
    ("points", "frame", "is_told"),
    [
        (street(0, 150), "world", False),
        (street(0, 150), "ego", True),
        (street(0, 150), "sensor", True),
        (street(0, 150), "twice", True),
        (wall(), "ego", False),  # nothing tells it
        (street(0, 10), "ego", False),
    ],
)
def test_returns_that_move_with_the_car_are_told(
    points: np.ndarray, frame: str, is_told: bool
) -> None:
    rng = np.random.default_rng(1)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    sweeps = []
    for number in range(4):
        some = points[rng.random(len(points)) < 0.8] + rng.normal(0, 0.02, 3)
        step = np.array([STEP_M * number, 0, 0])
        moved = {
            "world": some,
            "ego": some - step,
            "sensor": (some - step - [1, 0, 1.8]) @ turn,
            "twice": some + step,
        }[frame]
        sweeps.append((number * drives.FRAME_NS, moved))
    problems = lidar_problems(frames(), sweeps)
    assert bool(problems) == is_told
    if is_told:
        assert "LiDAR returns move with the car: where it drove 4.0 m" in problems[0]


def test_a_car_that_stands_tells_nothing() -> None:
    still = tuple(
        dataclasses.replace(frame, world_from_ego=torch.eye(4, dtype=torch.float64))
        for frame in frames()
    )
    assert lidar_problems(still, [(n * drives.FRAME_NS, street(0, 150)) for n in range(4)]) == ()
    assert lidar_problems(frames(), []) == ()
