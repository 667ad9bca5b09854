"""Boxes joined into tracks, points moved along them, sweeps taken apart."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from adapters.lidar_scene.split import (
    FLOOR_M,
    HALO_M,
    Motion,
    indices_between,
    join_tracks,
    split_sweeps,
)
from adapters.raw_drive import BoxSample, Sweep
from augment.scene.geometry import rigid, rotmat_from_quat
from augment.scene.scene import Track
from augment.scene.semantics import SemanticClass

MS = 1_000_000
SIZE = np.array([4.0, 2.0, 1.5])


def pose(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    quat = torch.tensor([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)], dtype=torch.float64)
    return rigid(rotmat_from_quat(quat), torch.tensor([x, y, SIZE[2] / 2])).numpy()


def sample(name, frame, x, *, sibling=None, at_ms=None, yaw=0.0, y=0.0) -> BoxSample:
    time = (100 * frame if at_ms is None else at_ms) * MS
    return BoxSample(name, sibling, "Car", frame, time, pose(x, y, yaw), SIZE)


def test_siblings_become_one_sample_between_them():
    (track,) = join_tracks(
        [
            sample("a", 0, 0.0, sibling="b", at_ms=0),
            sample("b", 0, 0.4, sibling="a", at_ms=40),
            sample("a", 1, 1.0, sibling="b", at_ms=100),
            sample("b", 1, 1.4, sibling="a", at_ms=140),
        ]
    )
    assert track.track_id == "a"
    assert track.track.timestamps_ns.tolist() == [20 * MS, 120 * MS]
    np.testing.assert_allclose(track.track.world_from_actor[:, 0, 3], [0.2, 1.2])


def test_siblings_are_followed_through_a_change_of_name():
    # The forward sensor's box is renamed half way; the other sensor's box ties all three together.
    tracks = join_tracks(
        [
            sample("a", 0, 0, sibling="b"),
            sample("b", 0, 0, sibling="a"),
            sample("a", 1, 1, sibling="c"),
            sample("c", 1, 1, sibling="a"),
            sample("c", 2, 2, sibling="gone"),
            sample("other", 2, 9),
        ]
    )
    assert [t.track_id for t in tracks] == ["a", "other"]
    assert len(tracks[0].track.timestamps_ns) == 3


def test_headings_either_side_of_half_a_turn_are_averaged_the_short_way():
    (track,) = join_tracks(
        [
            sample("a", 0, 0, sibling="b", yaw=np.pi - 0.1),
            sample("b", 0, 0, sibling="a", yaw=-np.pi + 0.1, at_ms=1),
        ]
    )
    np.testing.assert_allclose(track.track.world_from_actor[0, 0, 0], -1, atol=1e-12)


def test_times_always_increase():
    # The second frame's box was seen no later than the first's: one of the two is kept.
    (track,) = join_tracks([sample("a", 0, 0.0, at_ms=50), sample("a", 1, 0.1, at_ms=50)])
    assert track.track.timestamps_ns.tolist() == [50 * MS]


def random_track(knots: int = 5) -> Track:
    rng = np.random.default_rng(3)
    quats = torch.from_numpy(rng.normal(size=(knots, 4)))
    times = torch.from_numpy(np.cumsum(rng.integers(20, 150, knots)) * MS)
    return Track(
        times, rigid(rotmat_from_quat(quats), torch.from_numpy(rng.normal(size=(knots, 3))))
    )


@pytest.mark.parametrize("knots", [1, 2, 5])
def test_motion_is_the_track(knots):
    track = random_track(knots)
    motion = Motion.of(track)
    first, last = int(track.timestamps_ns[0]), int(track.timestamps_ns[-1])
    times = np.linspace(first - 120 * MS, last + 120 * MS, 41).astype(np.int64)
    for time in [*times, *track.timestamps_ns.tolist()]:
        expected = track.pose_at(int(time))
        got = motion.pose_at(int(time))
        assert (expected is None) == (got is None) == (not motion.exists_at(np.array([time]))[0])
        if expected is not None:
            # Two routes through float64 quaternions.
            np.testing.assert_allclose(got, expected, atol=1e-9)


def test_points_go_into_the_actor_each_at_its_own_time():
    track = random_track()
    motion = Motion.of(track)
    local = np.random.default_rng(1).normal(size=(50, 3))
    first, last = int(track.timestamps_ns[0]), int(track.timestamps_ns[-1])
    times = np.linspace(first, last, 50).astype(np.int64)
    poses = [track.pose_at(int(t)).numpy() for t in times]
    world = np.stack([m[:3, :3] @ p + m[:3, 3] for m, p in zip(poses, local, strict=True)])
    np.testing.assert_allclose(motion.into_actor(world, times), local, atol=1e-9)


def sweep_of(points, times_ms, classes) -> Sweep:
    return Sweep(
        np.array(points, np.float32), np.array(times_ms, np.int64) * MS, np.array(classes, np.int16)
    )


def test_returns_follow_the_box_through_the_sweep():
    (track,) = join_tracks([sample("a", 0, 0.0), sample("a", 1, 10.0)])
    car = SemanticClass.VEHICLE
    # The same bumper seen at three moments, and a post where the car stood before.
    sweep = sweep_of(
        [[2.0, 0, 0.5], [7.0, 0, 0.5], [12.0, 0, 0.5], [0.0, 0, 0.5]],
        [0, 50, 100, 100],
        [car, car, car, SemanticClass.POLE],
    )
    world, (actor,) = split_sweeps([sweep], [track])
    np.testing.assert_allclose(actor.points, [[2.0, 0, 0.5 - SIZE[2] / 2]] * 3, atol=1e-6)
    np.testing.assert_allclose(world.points, [[0, 0, 0.5]])


def test_ground_in_a_box_is_ground_and_the_halo_is_nobodys():
    (track,) = join_tracks([sample("a", 0, 0.0), sample("a", 1, 0.5)])
    vehicle, road, unknown = SemanticClass.VEHICLE, SemanticClass.ROAD, SemanticClass.UNKNOWN
    side = SIZE[1] / 2
    sweep = sweep_of(
        [
            [0, 0, 0.02],  # road under the car
            [0, side + HALO_M / 2, 0.7],  # a stray return beside it
            [0, side + HALO_M * 1.1, 0.7],  # the world
            [0, 0, FLOOR_M / 2],  # of no class: tyre or road
            [0, side, 0.7],  # its side
        ],
        [0] * 5,
        [road, vehicle, vehicle, unknown, vehicle],
    )
    world, (actor,) = split_sweeps([sweep], [track])
    assert world.semantic.tolist() == [road, vehicle]
    assert len(actor) == 1


def test_returns_after_the_track_belong_to_the_world():
    (track,) = join_tracks([sample("a", 0, 0.0), sample("a", 1, 0.5)])
    sweep = sweep_of([[0.5, 0, 0.7]], [300], [SemanticClass.VEHICLE])
    world, (actor,) = split_sweeps([sweep], [track])
    assert len(world) == 1 and len(actor) == 0


def test_points_between_two_corners_lie_strictly_inside():
    corners = np.array([[-1.0, 0.0, 2.0], [1.0, 0.5, 3.0]])
    points = np.random.default_rng(0).uniform(-4, 4, (5000, 3)).astype(np.float32)
    points[:1000] = points[:1000] * 0.2 + corners.mean(axis=0)
    points[7] = np.nan
    points[11] = corners[0]
    expected = np.flatnonzero(((points > corners[0]) & (points < corners[1])).all(axis=1))
    assert len(expected) > 100
    np.testing.assert_array_equal(indices_between(points, *corners), expected)
    assert len(indices_between(points[:0], *corners)) == 0
