"""Sweeps as sparse depth images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from adapters.lidar_scene.depth import lidar_depth, read_returns
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.labels import Boxes, LidarSweep
from augment.scene import Actor, Gaussians, Scene, Track
from augment.sky import ConstantSky

FORWARD = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # the camera looks along +x
ORIGIN = np.array([5000.0, -3000.0, 0.0])
SECOND = 1_000_000_000


@dataclass(frozen=True)
class OneSweep:
    columns: dict | None

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> LidarSweep | None:
        return None if self.columns is None else LidarSweep(self.columns)


def camera(time_s: float = 10.0) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = FORWARD
    time = round(time_s * SECOND)
    return Camera("front", 40, 30, 20.0, 20.0, 20.0, 15.0, torch.from_numpy(pose), time)


def scene(points, times_s, *, actors=(), **extra) -> Scene:
    world = np.asarray(points, np.float64) + ORIGIN  # labels are in the dataset's world
    columns = {c: world[:, i] for i, c in enumerate("xyz")}
    columns |= {"t": np.asarray(times_s, np.float64)} | extra
    return made(columns, actors)


def made(columns, actors=()) -> Scene:
    one = Gaussians(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1),
        torch.zeros(1, 1, 3),
    )  # fmt: skip
    sky = ConstantSky(torch.ones(3))
    frame = Frame(0, 10 * SECOND, torch.eye(4, dtype=torch.float64), {}, {})
    return Scene("s", "test:", one, actors, sky, (frame,), OneSweep(columns), world_origin_m=ORIGIN)


def driving_actor(speed_mps: float) -> Actor:
    """A box of 4 x 2 x 1.5 m, 10 m ahead at 10 s, driving away."""
    times = torch.tensor([9 * SECOND, 10 * SECOND, 11 * SECOND])
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([10 - speed_mps, 10.0, 10 + speed_mps])
    g = Gaussians(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1),
        torch.zeros(1, 1, 3),
    )  # fmt: skip
    return Actor("a", "Car", g, Track(times, poses), (4.0, 2.0, 1.5))


def test_points_land_on_their_pixel_with_depth_and_time():
    depth = lidar_depth(scene([[10, 0, 0], [4, 1, 0.5]], [9.95, 10.02]), 0, camera())
    # u = 20 - 20 y / x, v = 15 - 20 z / x
    assert depth.uv.tolist() == [[15, 12], [20, 15]] and depth.uv.dtype == np.int32
    np.testing.assert_allclose(depth.depth_m, [4, 10])
    assert depth.depth_m.dtype == np.float32
    assert np.abs(depth.timestamp_ns - [10_020_000_000, 9_950_000_000]).max() < 1000


def test_the_nearest_of_a_pixel_wins():
    depth = lidar_depth(scene([[10, 0, 0], [7, 0, 0], [9, 0, 0]], [1, 2, 3]), 0, camera())
    assert len(depth) == 1 and depth.depth_m[0] == 7 and depth.timestamp_ns[0] == 2 * SECOND


def test_a_moving_objects_returns_are_carried_to_the_cameras_time():
    # Its rear face, 2 m behind its centre, seen a tenth of a second early and late.
    actor = driving_actor(20.0)
    points = [[10 - 2 - 2, 0.0, 0.2], [10 - 2 + 2, 0.5, 0.2], [6.0, 3.0, 0.2]]
    sparse = lidar_depth(scene(points, [9.9, 10.1, 9.9], actors=(actor,)), 0, camera())
    np.testing.assert_allclose(np.sort(sparse.depth_m), [6, 8, 8], atol=1e-6)
    later = lidar_depth(scene(points, [9.9, 10.1, 9.9], actors=(actor,)), 0, camera(10.05))
    np.testing.assert_allclose(np.sort(later.depth_m), [6, 9, 9], atol=1e-6)


def test_returns_of_an_object_that_is_gone_are_left_out():
    actor = driving_actor(20.0)
    points = [[8.0, 0.0, 0.2], [6.0, 3.0, 0.2]]
    sparse = lidar_depth(scene(points, [10, 10], actors=(actor,)), 0, camera(20.0))
    np.testing.assert_allclose(sparse.depth_m, [6])


def test_the_floor_of_a_box_is_ground():
    actor = driving_actor(20.0)
    sparse = lidar_depth(scene([[6.0, 0.0, -0.7]], [9.9], actors=(actor,)), 0, camera())
    np.testing.assert_allclose(sparse.depth_m, [6])


def test_classes_can_be_left_out():
    points, semantic = [[10, 0, 0], [5, 0, 1]], np.array([7, 4])
    one = scene(points, [10, 10], semantic=semantic)
    assert len(lidar_depth(one, 0, camera())) == 2
    kept = read_returns(one, 0, without_semantic=(4,))
    np.testing.assert_allclose(kept.points, [[10, 0, 0]])


def test_integer_times_and_missing_ones():
    columns = {c: np.full(1, v) for c, v in zip("xyz", ORIGIN + np.array([8, 0, 0]), strict=True)}
    timed = made(columns | {"timestamp_ns": np.array([7])})
    assert lidar_depth(timed, 0, camera()).timestamp_ns.tolist() == [7]
    assert lidar_depth(made(columns), 0, camera()).timestamp_ns.tolist() == [10 * SECOND]
    with pytest.raises(AdapterError, match=r"frame 0: its sweep's column timestamp_ns must hold"):
        lidar_depth(made(columns | {"timestamp_ns": np.array([7.5])}), 0, camera())


def test_no_sweep_gives_no_depth():
    assert len(lidar_depth(made(None), 0, camera())) == 0
