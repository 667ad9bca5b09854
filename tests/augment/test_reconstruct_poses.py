"""Corrections of actors' and cameras' poses: the forces they follow, and where these lead."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from augment.geometry import rigid, rotmat_from_quat
from augment.labels import EGO_VEHICLE
from augment.reconstruct.splats import Splats
from augment.reconstruct.trainer import (
    ActorPoses,
    CameraPoses,
    Forces,
    Knots,
    part_forces,
    splat_inputs,
)
from augment.reconstruct.view import ViewKey
from augment.render.constants import RasterSettings
from augment.render.cpu import backward as cpu_backward
from augment.render.cpu.driver import Scratch
from augment.scene import Actor, Gaussians, Track
from tests.scenes import camera_ahead, random_gaussians

NS = 1_000_000_000


def pose(shift=(0.0, 0.0, 0.0), yaw=0.0) -> np.ndarray:
    quat = torch.tensor([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)], dtype=torch.float64)
    return rigid(rotmat_from_quat(quat), torch.tensor(shift, dtype=torch.float64)).numpy()


def actor_on(times, label="Car", name="a") -> Actor:
    poses = np.stack([pose((float(i), 0.0, 0.0)) for i in range(len(times))])
    track = Track(torch.tensor(times), torch.from_numpy(poses))
    return Actor(name, label, Gaussians.empty(), track, (4.0, 2.0, 1.5))


def ahead(count: int, seed: int) -> Gaussians:
    """Gaussians 4 to 14 m before the camera: none is cut off by the near plane."""
    gaussians = random_gaussians(count, seed=seed)
    return dataclasses.replace(gaussians, means=gaussians.means + torch.tensor([5.0, 0.0, 0.0]))


def moved(change: np.ndarray) -> np.ndarray:
    """A small rigid motion: rotation vector, then shift."""
    quat = torch.tensor([1.0, *(change[:3] / 2)], dtype=torch.float64)
    return rigid(rotmat_from_quat(quat), torch.from_numpy(change[3:])).numpy()


def camera_moved(camera, motion: np.ndarray):
    matrix = torch.from_numpy(motion @ camera.camera_from_world.numpy())
    return dataclasses.replace(camera, camera_from_world=matrix)


class CameraTimes:
    """A view source as far as CameraPoses looks at one."""

    def __init__(self, cameras) -> None:
        self._cameras = {ViewKey(i, camera.name): camera for i, camera in enumerate(cameras)}
        self.train = tuple(self._cameras)
        self.test = ()

    def camera(self, key):
        return self._cameras[key]

    def load(self, key):
        raise NotImplementedError


def test_knots_are_linear_in_time_and_hold_outside():
    knots = Knots([np.array([10, 20, 40]), np.zeros(0, np.int64)], 2)
    knots.values[:] = [[0.0, 1.0], [2.0, 3.0], [6.0, 0.0]]
    for time, expected in ((0, [0, 1]), (10, [0, 1]), (15, [1, 2]), (30, [4, 1.5]), (99, [6, 0])):
        found = knots.at(0, time)
        assert found is not None and found == pytest.approx(expected)
    assert knots.at(1, 15) is None
    before = knots.values.copy()
    knots.update(1, 15, np.ones(2), np.ones(2), 0.0)
    assert (knots.values == before).all()


def test_forces_are_the_slopes_of_the_loss():
    """Against central differences of the loss, in float32, of a part and of the camera."""
    splats = Splats.of([ahead(200, 5), ahead(150, 6)], 0)
    camera = camera_ahead(64, 48, 60.0)
    poses = np.stack([np.eye(4), pose((1.0, 0.2, 0.1), 0.4)])
    settings, scratch = RasterSettings(), Scratch()
    rows, columns = np.mgrid[:48, :64] / 20  # smooth, so that splats' cut-offs hardly show
    weights = np.cos(np.stack([rows + columns, 2 * rows, columns - rows], 2)).astype(np.float32)

    def render(poses, camera):
        inputs = splat_inputs(splats, [0, 1], poses, camera, settings)
        return cpu_backward.record(inputs, camera, settings, scratch, with_depth=False)

    def loss(poses, camera):
        return float((render(poses, camera).rgb.astype(np.float64) * weights).sum())

    tape = render(poses, camera)
    forces = part_forces(tape.inputs, tape.backward(weights, np.zeros_like(tape.alpha)))
    on_camera = forces.on_camera(camera.camera_from_world.numpy() @ poses)
    step = 1e-3
    slopes = np.zeros((2, 6))
    for axis in range(6):
        change = np.zeros(6)
        change[axis] = step
        there, back = (moved(sign * change) for sign in (1, -1))
        part = [np.stack([poses[0], poses[1] @ m]) for m in (there, back)]
        slopes[0, axis] = (loss(part[0], camera) - loss(part[1], camera)) / (2 * step)
        cameras = [camera_moved(camera, m) for m in (there, back)]
        slopes[1, axis] = (loss(poses, cameras[0]) - loss(poses, cameras[1])) / (2 * step)
    found = np.stack([np.append(forces.turn[1], forces.shift[1]), on_camera])
    # Cut-offs of splats at single pixels make differences rough; a splat that did not turn with
    # its part would be off by more than half.
    for kind in (slice(0, 3), slice(3, 6)):
        scale = np.abs(slopes[:, kind]).max(1, keepdims=True)
        assert (np.abs(found[:, kind] - slopes[:, kind]) < 0.15 * scale).all()


def test_a_camera_is_found_again():
    splats = Splats.of([ahead(300, 5)], 0)
    truth = camera_ahead(64, 48, 60.0, timestamp_ns=NS)
    tilt = torch.tensor([1.0, 0.004, -0.006, 0.003], dtype=torch.float64)
    change = rigid(rotmat_from_quat(tilt), torch.tensor([0.05, -0.03, 0.02], dtype=torch.float64))
    start = dataclasses.replace(truth, camera_from_world=change @ truth.camera_from_world)
    found = CameraPoses(CameraTimes([start]))
    assert found.corrected(start) is start  # nothing learnt, nothing changed
    poses, settings, scratch = np.eye(4)[None], RasterSettings(), Scratch()

    def render(camera):
        inputs = splat_inputs(splats, [0], poses, camera, settings)
        return cpu_backward.record(inputs, camera, settings, scratch, with_depth=False)

    target = render(truth).rgb.copy()

    def error(camera):
        return float(np.abs(render(camera).rgb - target).mean())

    first = error(start)
    for step in range(200):
        camera = found.corrected(start)
        tape = render(camera)
        grads = tape.backward(tape.rgb - target, np.zeros_like(tape.alpha))
        forces = part_forces(tape.inputs, grads)
        found.update(camera, poses, forces, rate_px=0.02 * 0.98**step, pull=0.0)
    # Adam steps by its rate: 3 mm to begin with, 0.06 mm at the end, 15 cm in all
    assert error(found.corrected(start)) < 0.2 * first
    at_another_time = dataclasses.replace(start, timestamp_ns=5 * NS)
    assert (
        found.corrected(at_another_time).camera_from_world
        == found.corrected(start).camera_from_world
    ).all()  # the only knot holds
    stranger = dataclasses.replace(start, name="another")
    assert found.corrected(stranger) is stranger


def test_an_actor_is_pushed_along_its_forces_in_the_world():
    times = [i * NS for i in range(9)]
    poses = ActorPoses([actor_on(times), actor_on(times, EGO_VEHICLE, "b")])
    turned = pose((3.0, 0.0, 0.0), np.pi / 2)
    forces = Forces(
        seen=np.array([True, True, True]),
        shift=np.array([[9.0, 9, 9], [1.0, 0, 0], [1.0, 0, 0]]),
        turn=np.array([[0.0, 0, 0], [0.0, 0, 2.0], [0.0, 0, 2.0]]),
    )
    views = np.stack([np.eye(4), turned, turned])
    poses.update([0, 1, 2], views, forces, 2 * NS, rate_m=0.01, pull=0.0)
    moved = poses.corrected(0, turned, 2 * NS)
    # forwards in its own frame is +y in the world; downhill is the other way
    assert moved[:3, 3] == pytest.approx([3.0, -0.01, 0.0])
    angle = np.arctan2(moved[1, 0], moved[0, 0])
    assert angle == pytest.approx(np.pi / 2 - 0.01 / 2.0)  # 1 cm of arc at 2 m
    assert poses.corrected(1, turned, 2 * NS) is turned  # the recording car's own body
    track = poses.track(0, actor_on(times).track)
    assert track.world_from_actor[0, 1, 3] == pytest.approx(-0.01)
    assert track.world_from_actor[8, 1, 3] == 0.0  # a knot that no view has touched
