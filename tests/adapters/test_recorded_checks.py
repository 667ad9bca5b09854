"""Does the calibration fit, are the clocks right, is exposure steady."""

from __future__ import annotations

import dataclasses
import json
import math

import cv2
import numpy as np
import pytest
import torch

from adapters.training_views.checks import check_views, with_camera_times
from adapters.training_views.views import RecordedViews
from augment.errors import AdapterError
from tests.adapters import drives

SPEED_MPS = 5.0
WALL_Y = 12.0


def paint() -> np.ndarray:
    """Grey values of a wall, 10 cm a cell, 80 m x 10 m."""
    rng = np.random.default_rng(3)
    coarse = rng.uniform(30, 220, (100, 800)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(coarse, (0, 0), 2.0), None, 20, 235, cv2.NORM_MINMAX)


PAINT = paint()


def rig(frame: int):
    """A camera that looks at the wall on the left, driving along it."""
    place = (SPEED_MPS * 0.1 * frame, 0.0, 1.5)
    size = (240, 160)
    return {"left": drives.camera("left", frame, size=size, focal_px=150.0, position=place,
                                  rotation=drives.LEFT)}  # fmt: skip


def picture(camera, frame: int) -> np.ndarray:
    rays = camera.ray_directions().double().numpy()
    points = camera.centre.numpy() + (WALL_Y / rays[..., 1:2]) * rays
    column = ((points[..., 0] + 20) * 10).astype(np.float32)
    row = ((5 - points[..., 2]) * 10 + 50).astype(np.float32)
    grey = cv2.remap(PAINT, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.repeat(grey[..., None], 3, 2).astype(np.uint8)


def wall_returns() -> np.ndarray:
    x, z = np.meshgrid(np.arange(-15, 25, 0.15), np.arange(-4, 8, 0.2))
    column, row = ((x + 20) * 10).astype(np.float32), ((5 - z) * 10 + 50).astype(np.float32)
    intensity = cv2.remap(PAINT, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    points = [x.ravel(), np.full(x.size, WALL_Y), z.ravel(), 255 - intensity.ravel()]
    return np.stack(points, 1).astype(np.float64)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return drives.drive(
        tmp_path_factory.mktemp("wall"), 8, cameras=rig, picture=picture,
        sweeps={frame: wall_returns() for frame in range(8)}, speed_mps=SPEED_MPS,
    )  # fmt: skip


def with_cameras(scene, change):
    frames = tuple(
        dataclasses.replace(frame, cameras={n: change(c) for n, c in frame.cameras.items()})
        for frame in scene.frames
    )
    return dataclasses.replace(scene, frames=frames)


def pitched(camera, degrees: float):
    """The camera as the files claim it, looking further down than it did."""
    a = math.radians(degrees)
    turn = torch.eye(4, dtype=torch.float64)
    turn[1:3, 1:3] = torch.tensor([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    return dataclasses.replace(camera, camera_from_world=turn @ camera.camera_from_world)


def test_a_right_calibration_is_quiet(scene):
    checks = check_views(scene, RecordedViews(scene, scale=1.0))
    assert checks.problems == ()
    (offset,) = checks.offsets
    # A tenth of a pixel would be perfect; the paint's cells are 1.3 pixels wide.
    assert offset.is_sure and math.hypot(offset.right_px, offset.down_px) < 0.5
    assert abs(checks.time_offset_s) < 0.005
    assert json.loads(json.dumps(checks.report_facts)) == checks.report_facts


def test_images_of_several_sizes_are_compared(tmp_path):
    def cut(frame: int):
        (camera,) = rig(frame).values()
        return {"left": camera.cropped(0, 0, camera.width, camera.height - 5 * (frame % 3))}

    sweeps = {frame: wall_returns() for frame in range(8)}
    scene = drives.drive(
        tmp_path, 8, cameras=cut, picture=picture, sweeps=sweeps, speed_mps=SPEED_MPS
    )
    checks = check_views(scene, RecordedViews(scene, scale=1.0))
    assert checks.problems == () and checks.offsets[0].is_sure
    small = drives.drive(
        tmp_path / "small", 4, cameras=lambda f: {"a": drives.camera("a", f, size=(9, 9 - f % 2))}
    )
    assert check_views(small, RecordedViews(small, scale=1.0)).problems == ()


def test_a_rotated_camera_is_found(scene):
    turned = with_cameras(scene, lambda camera: pitched(camera, 0.5))
    checks = check_views(turned, RecordedViews(turned, scale=1.0))
    (offset,) = checks.offsets
    # 150 tan(0.5 degrees) = 1.3 px, whatever the sign of the fit's rounding.
    assert abs(offset.down_px) == pytest.approx(1.31, abs=0.3) and abs(offset.right_px) < 0.5
    assert any("camera left: its images lie 0." in p and "degrees" in p for p in checks.problems)


def test_a_late_clock_is_found_and_can_be_set_right(scene):
    # The stamps say 40 ms later, and the poses are those of the stamps.
    late = with_camera_times(scene, 0.040)
    views = RecordedViews(late, scale=1.0)
    checks = check_views(late, views)
    assert checks.time_offset_s == pytest.approx(-0.040, abs=0.006)
    assert any("40 ms before" in p or "39 ms" in p or "41 ms" in p for p in checks.problems)
    assert not any("degrees" in p for p in checks.problems)


def test_cameras_at_other_times_follow_their_path(scene):
    moved = with_camera_times(scene, 0.02)
    for frame, after in zip(scene.frames, moved.frames, strict=True):
        a, b = frame.cameras["left"], after.cameras["left"]
        np.testing.assert_allclose(b.centre - a.centre, [0.02 * SPEED_MPS, 0, 0], atol=1e-9)
        np.testing.assert_allclose(
            b.camera_from_world[:3, :3], a.camera_from_world[:3, :3], atol=1e-9
        )
        assert b.timestamp_ns - a.timestamp_ns == 20_000_000
    one = dataclasses.replace(scene, frames=scene.frames[:1])
    assert with_camera_times(one, 0.02).frames[0].cameras["left"] is one.frames[0].cameras["left"]


def test_a_turning_camera_turns_on(scene):
    def turning(camera):
        yaw = 1e-10 * camera.timestamp_ns  # 0.1 rad/s
        turn = torch.eye(4, dtype=torch.float64)
        turn[[0, 0, 1, 1], [0, 1, 0, 1]] = torch.tensor(
            [math.cos(yaw), -math.sin(yaw), math.sin(yaw), math.cos(yaw)], dtype=torch.float64
        )
        return dataclasses.replace(camera, camera_from_world=camera.camera_from_world @ turn)

    turned = with_cameras(scene, turning)
    moved = with_camera_times(turned, 0.1)  # a whole frame
    a, b = moved.frames[2].cameras["left"], turned.frames[3].cameras["left"]
    np.testing.assert_allclose(a.camera_from_world[:3, :3], b.camera_from_world[:3, :3], atol=1e-9)


def test_without_intensity_nothing_is_measured(tmp_path):
    plain = drives.drive(tmp_path, 4, sweeps={f: wall_returns()[:, :3] for f in range(4)})
    checks = check_views(plain, RecordedViews(plain, scale=1.0))
    assert checks.offsets == () and checks.time_offset_s is None
    bare = drives.drive(tmp_path / "bare", 1)
    assert check_views(bare, RecordedViews(bare, scale=1.0)).problems == ()


def test_jumps_of_exposure_are_named(tmp_path):
    def shot(camera, frame):
        gain = 1.0 if frame < 5 else 0.6
        return (picture(camera, frame) * gain).astype(np.uint8)

    scene = drives.drive(tmp_path, 9, cameras=rig, picture=shot, speed_mps=SPEED_MPS)
    (said,) = check_views(scene, RecordedViews(scene, scale=0.5)).problems
    assert said.startswith("camera left: brightness changes by a factor of 0.6")
    assert "between frames 4 and 5" in said

    def flicker(camera, frame):
        return (picture(camera, frame) * (0.5 if frame in (3, 9, 15) else 1)).astype(np.uint8)

    scene = drives.drive(tmp_path / "b", 20, cameras=rig, picture=flicker, speed_mps=SPEED_MPS)
    said = check_views(scene, RecordedViews(scene, scale=0.5)).problems
    assert len(said) == 4 and "jumps 3 more times, last after frame 15" in said[-1]


def test_a_camera_at_no_place_is_an_error_that_says_where(scene):
    def broken(camera):
        if camera.timestamp_ns != 3 * drives.FRAME_NS:
            return camera
        pose = camera.camera_from_world.clone()
        pose[0, 3] = float("nan")
        return dataclasses.replace(camera, camera_from_world=pose)

    with pytest.raises(AdapterError, match=r"camera left, frame 3: .*position in the scene"):
        RecordedViews(with_cameras(scene, broken), scale=1.0)
