"""Poses of Street Gaussians' actors against the same done one number at a time, and corrections."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from street_gaussians_models import random_part

from adapters.street_gaussians.adapter import (
    camera_changes,
    check_changes,
    color_maps,
    image_poses,
    make_actor,
    vehicle_poses,
)
from adapters.street_gaussians.data import (
    ModelConfig,
    StreetData,
    StreetImage,
    TrackedObject,
    Tracklets,
)
from adapters.street_gaussians.model import Part, PoseChanges
from augment.cameras import Camera
from augment.errors import AdapterError
from augment.scene import Gaussians

FRAMES = 6
CAMERA = Camera("any", 64, 48, 50.0, 50.0, 32.0, 24.0, torch.eye(4, dtype=torch.float64))
CAMS = (0, 2)
DELAYS_S = {0: 0.013, 2: 0.031}
START_S = 1550083467.25


def heading_quat(angle: float) -> np.ndarray:
    return np.array([math.cos(angle / 2), 0, 0, math.sin(angle / 2)])


def ego(seconds: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zyx", [0.3 * seconds, 0.02, -0.01]).as_matrix()
    pose[:3, 3] = [8 * seconds, -2 + seconds, 0.1]
    return pose


def image(step: int, number: int, cam: int, *, is_held_out: bool) -> StreetImage:
    time_s = START_S + 0.1 * step + DELAYS_S[cam]
    return StreetImage(
        frame=10 + step, cam=cam, path=None, timestamp_s=time_s,
        world_from_ego=ego(0.1 * step + DELAYS_S[cam]), camera=CAMERA, is_held_out=is_held_out,
        number=number,
    )  # fmt: skip


def street(held_out: tuple[int, ...] = ()) -> StreetData:
    """Objects 5, in frames 1 to 4 and in another column in each, and 8, in frame 2 only."""
    rng = np.random.default_rng(0)
    ids = np.full((FRAMES, 3), -1)
    for step, column in zip(range(1, 5), (2, 0, 1, 0), strict=True):
        ids[step, column] = 5
    ids[2, 1] = 8
    quats = np.zeros((FRAMES, 3, 4))
    quats[...] = [[heading_quat(a) for a in row] for row in rng.uniform(2.9, 3.3, (FRAMES, 3))]
    times = START_S + 0.1 * np.arange(FRAMES)
    steps = [(step, cam) for step in range(FRAMES) for cam in CAMS]
    return StreetData(
        root=Path("drive"),
        world_origin_m=np.zeros(3),
        frames=tuple(range(10, 10 + FRAMES)),
        frame_times_s=times,
        world_from_ego=np.stack([ego(0.1 * step) for step in range(FRAMES)]),
        images=tuple(
            image(step, number, cam, is_held_out=step in held_out)
            for number, (step, cam) in enumerate(steps)
        ),
        objects=(
            TrackedObject(
                5, "vehicle", (4.0, 2.0, 1.5), 11, 14, times[1] - 0.1, min(times[4] + 0.1, times[5])
            ),
            TrackedObject(8, "vehicle", (4.0, 2.0, 1.5), 12, 12, times[2] - 0.1, times[2] + 0.1),
        ),
        tracklets=Tracklets(ids, rng.normal(size=(FRAMES, 3, 3)) * 5, quats),
    )


def some_changes(seed: int = 1) -> PoseChanges:
    rng = np.random.default_rng(seed)
    return PoseChanges(0.3 * rng.normal(size=(FRAMES, 3, 3)), 0.2 * rng.normal(size=(FRAMES, 3)))


def scipy_rotation(wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(wxyz, -1))


def between(first: Rotation, second: Rotation, share: float) -> Rotation:
    """Along the arc from the first to the second, and beyond."""
    return first * Rotation.from_rotvec((first.inv() * second).as_rotvec() * share)


def expected_pose(
    data: StreetData, track_id: int, time: float, changes: PoseChanges | None, bug: bool = False
) -> tuple[np.ndarray, Rotation]:
    """One pose, step by step: frames by distance in time, earlier ones first where equal."""
    rows = [(f, m) for f in range(FRAMES) for m in range(3) if data.tracklets.ids[f, m] == track_id]
    rows.sort(key=lambda row: abs(data.frame_times_s[row[0]] - time))
    poses = []
    for f, m in rows[:2]:
        position = data.tracklets.positions[f, m].copy()
        rotation = scipy_rotation(data.tracklets.quats[f, m])
        if changes is not None:
            position += changes.positions[f, m]
            rotation = rotation * Rotation.from_euler("z", 2 * changes.half_turns[f, m])
        poses.append((position, rotation))
    if len(poses) == 1:
        return poses[0]
    (p1, r1), (p2, r2) = poses
    if bug:
        r2 = r1 * Rotation.from_euler("z", 2 * changes.half_turns[rows[0][0], rows[1][1]])
    t1, t2 = (data.frame_times_s[f] for f, _ in rows[:2])
    share = (time - t1) / (t2 - t1)
    return p1 * (t2 - time) / (t2 - t1) + p2 * (time - t1) / (t2 - t1), between(r1, r2, share)


def check(poses, index: int, expected: tuple[np.ndarray, Rotation]) -> None:
    # 1e-6 m and rad: seconds since 1970 have steps of 2.4e-7 s, and things move at 50 m/s here.
    np.testing.assert_allclose(poses.positions[index], expected[0], atol=1e-4)
    turn = scipy_rotation(poses.quats[index]).inv() * expected[1]
    assert turn.magnitude() < 1e-5


@pytest.mark.parametrize("bug", [False, True])
@pytest.mark.parametrize("changes", [None, some_changes()])
def test_between_and_beyond_frames(changes, bug) -> None:
    data = street()
    times = START_S + np.array([0.04, 0.11, 0.149, 0.2, 0.231, 0.38, 0.42, 0.47])
    for tracked in data.objects:
        poses = vehicle_poses(data, tracked, times, changes, rotation_bug=bug)
        for index, time in enumerate(times):
            used = bug and changes is not None
            check(poses, index, expected_pose(data, tracked.track_id, time, changes, used))


def test_images_that_were_not_trained_on() -> None:
    """Between the poses at the two nearest images of the camera that were, and not their own."""
    data, changes = street(held_out=(2, 4, 5)), some_changes()
    tracked = data.objects[0]
    index = np.arange(len(data.images))
    shown = index[[tracked.start_s <= i.timestamp_s <= tracked.end_s for i in data.images]]
    poses = image_poses(data, tracked, shown, changes, interpolate_held_out=True)
    # Steps that the camera was trained with within the object's time: 0, 1, 3.
    nearest = {2: {0: (1, 3), 2: (1, 3)}, 4: {0: (3, 1), 2: (3, 1)}}
    seen = 0
    for position, number in enumerate(shown):
        found = data.images[number]
        step = found.frame - 10
        if step not in nearest:
            check(poses, position, expected_pose(data, 5, found.timestamp_s, changes))
            continue
        seen += 1
        times = [START_S + 0.1 * s + DELAYS_S[found.cam] for s in nearest[step][found.cam]]
        (p1, r1), (p2, r2) = (expected_pose(data, 5, time, changes) for time in times)
        share = (found.timestamp_s - times[0]) / (times[1] - times[0])
        check(poses, position, (p1 + share * (p2 - p1), between(r1, r2, share)))
    assert seen == 4
    own = image_poses(data, tracked, shown, changes, interpolate_held_out=False)
    assert np.abs(own.positions - poses.positions).max() > 0.01


def test_without_two_trained_images_a_pose_is_the_images_own() -> None:
    data = street(held_out=(0, 1, 2, 3, 5))
    poses = image_poses(data, data.objects[0], np.array([2]), None, interpolate_held_out=True)
    check(poses, 0, expected_pose(data, 5, data.images[2].timestamp_s, None))


def part_of(terms: int, degree: int = 0) -> Part:
    raw = random_part(3, 7, terms=terms, degree=degree)
    gaussians = Gaussians(
        means=torch.from_numpy(raw.xyz),
        quats=torch.nn.functional.normalize(torch.from_numpy(raw.rotation)),
        scales=torch.from_numpy(raw.scaling).exp(),
        opacities=torch.from_numpy(raw.opacity[:, 0]).sigmoid(),
        sh=torch.from_numpy(np.concatenate([raw.dc[:, :1], raw.rest], 1)),
    )
    return Part(gaussians, torch.from_numpy(raw.dc[:, 1:].copy()) if terms > 1 else None)


PLAIN = ModelConfig(fourier_scale=2.0)
STILL = camera_changes(None, street(), PLAIN, "model")


def test_an_actor_is_where_and_when_its_images_are() -> None:
    data, changes = street(), some_changes()
    actor, problems = make_actor(data, data.objects[0], part_of(5), changes, STILL, PLAIN)
    assert actor is not None and problems == ()
    assert (actor.track_id, actor.label, actor.size_m) == ("5", "vehicle", (4.0, 2.0, 1.5))
    for found in data.images:
        pose = actor.track.pose_at(found.timestamp_ns)
        shown = data.objects[0].start_s <= found.timestamp_s <= data.objects[0].end_s
        assert (pose is not None) == shown, found
        if pose is None:
            continue
        position, rotation = expected_pose(data, 5, found.timestamp_s, changes)
        expected = np.eye(4)
        expected[:3, :3], expected[:3, 3] = rotation.as_matrix(), position
        np.testing.assert_allclose(pose, found.world_from_ego @ expected, atol=1e-4)
        phase = 2.0 * (found.frame - 11) / (14 - 11)
        assert actor.color_waves.phase_at(found.timestamp_ns) == pytest.approx(phase)
    assert {i.frame for i in data.images if i.timestamp_s > data.objects[0].end_s} == {15}


def test_the_background_is_moved_and_actors_stay() -> None:
    """The camera sees the moved background where it was, and the actor where it is."""
    data = street()
    rng = np.random.default_rng(5)
    moves = np.tile(np.eye(4), (len(data.images), 1, 1))
    moves[:, :3, :3] = Rotation.from_rotvec(0.05 * rng.normal(size=(len(moves), 3))).as_matrix()
    moves[:, :3, 3] = 0.2 * rng.normal(size=(len(moves), 3))
    config = ModelConfig(cameras=CAMS, use_pose_correction=True)
    changes = camera_changes(moves, data, config, "model")
    plain, _ = make_actor(data, data.objects[0], part_of(1), None, STILL, PLAIN)
    moved, _ = make_actor(data, data.objects[0], part_of(1), None, changes, PLAIN)
    assert plain.color_waves is None
    np.testing.assert_array_equal(changes, moves)
    for found in data.images[2:10]:
        change = moves[found.number]
        there = moved.track.pose_at(found.timestamp_ns).numpy()
        here = plain.track.pose_at(found.timestamp_ns).numpy()
        np.testing.assert_allclose(change @ there, here, atol=1e-12)
    by_frame = camera_changes(
        moves[:FRAMES], data, config.model_copy(update={"pose_correction_mode": "frame"}), "model"
    )
    np.testing.assert_array_equal(by_frame, moves[[i.frame - 10 for i in data.images]])


def test_an_object_of_one_frame_has_one_pose_and_colour() -> None:
    data = street()
    actor, problems = make_actor(data, data.objects[1], part_of(3), some_changes(), STILL, PLAIN)
    assert len(problems) == 1 and "tracked in one frame only" in problems[0]
    assert actor.color_waves.phases.tolist() == [0.0] * len(actor.track.timestamps_ns)
    shown = [i for i in data.images if actor.track.pose_at(i.timestamp_ns) is not None]
    assert {i.frame for i in shown} == {11, 12}


def test_an_object_between_images_is_left_out() -> None:
    data = street()
    tracked = dataclasses.replace(data.objects[0], start_s=START_S + 0.02, end_s=START_S + 0.03)
    actor, problems = make_actor(data, tracked, part_of(1), None, STILL, PLAIN)
    assert actor is None and "in none of the images' moments" in problems[0]


def test_images_of_one_moment_are_said() -> None:
    data = street()
    first, second = data.images[2], data.images[3]
    twin = dataclasses.replace(second, timestamp_s=first.timestamp_s)
    data = dataclasses.replace(data, images=(*data.images[:3], twin, *data.images[4:]))
    actor, problems = make_actor(data, data.objects[0], part_of(1, degree=1), None, STILL, PLAIN)
    assert any("apart in images of one moment" in problem for problem in problems)
    assert actor.colors_in_world
    assert bool((actor.track.timestamps_ns.diff() > 0).all())


def test_poses_of_another_selection_are_refused() -> None:
    data = street()
    check_changes(some_changes(), data, "model.pth")
    for shape in ((FRAMES + 2, 3), (FRAMES, 4)):
        other = PoseChanges(np.zeros((*shape, 3)), np.zeros(shape))
        words = (
            rf"model.pth: actor_pose has {shape[0]} frames and {shape[1]} columns.*give {FRAMES} "
            r"frames and 3 columns.*selected_frames.*data.cameras and data.use_tracker"
        )
        with pytest.raises(AdapterError, match=words):
            check_changes(other, data, "model.pth")


def test_colour_maps_of_images_and_cameras() -> None:
    data = street(held_out=(2, 4))
    maps = torch.randn(12, 3, 4, generator=torch.Generator().manual_seed(0))
    config = ModelConfig(cameras=CAMS, use_color_correction=True)
    by_camera, by_image = color_maps(maps, data, config, "model")
    for number, step_cam in enumerate((s, c) for s in range(FRAMES) for c in CAMS):
        seen = next(i for i in data.images if (i.frame - 10, i.cam) == step_cam)
        assert torch.equal(by_image[seen.name, seen.timestamp_ns], maps[number])
    right = maps[[1, 3, 7, 11]].mean(0)  # trained on: frames 0, 1, 3, 5
    torch.testing.assert_close(by_camera["FRONT_RIGHT"], right)
    sensor = config.model_copy(update={"color_correction_mode": "sensor", "cameras": (0, 1, 2)})
    by_camera, by_image = color_maps(maps[:3], data, sensor, "model")
    assert torch.equal(by_camera["FRONT_RIGHT"], maps[2]) and not by_image
    with pytest.raises(AdapterError, match=r"maps of cameras 0 to 1.*cameras has"):
        color_maps(maps[:2], data, sensor.model_copy(update={"cameras": CAMS}), "model")


@pytest.mark.parametrize("mode", ["image", "frame"])
def test_corrections_of_another_selection_are_refused(mode: str) -> None:
    data = street()
    config = ModelConfig(cameras=CAMS, pose_correction_mode=mode)
    with pytest.raises(AdapterError, match=rf"pose_correction has 5 entries.*mode '{mode}'"):
        camera_changes(np.tile(np.eye(4), (5, 1, 1)), data, config, "model.pth")
    with pytest.raises(AdapterError, match=r"color_correction has 11 entries.*must have 12"):
        color_maps(torch.zeros(11, 3, 4), data, config, "model.pth")
