"""Snow on a GPU that is pretended: what is seen, and where it can lie, as the CPU finds it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.effects.snow import placement
from augment.effects.snow.height_map import Views, draw_views, plain_gaussians
from augment.effects.snow.placement import PlacementSettings, place_snow_support
from augment.render.cuda import runtime as gpu
from augment.scene import PosedGaussians
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu
from tests.scenes import camera_ahead
from tests.snow_scenes import box_car, cameras_of, drive, sheet, side_wall, stack_all


def from_above(height_m: float = 20.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[1, 1] = pose[2, 2] = -1.0
    pose[:3, 3] = torch.tensor([-5.0, 0.0, height_m])
    return Camera("map", 24, 16, 3.0, 3.0, 12.0, 8.0, pose, is_orthographic=True)


@pytest.fixture(scope="module")
def views() -> Views:
    """A street with a wall, which hides what is behind it, seen by four cameras."""
    ground = sheet((0.0, 14.0), (-5.0, 5.0))
    wall = side_wall(2.0, (4.0, 10.0), (0.0, 2.0))
    parts = [PosedGaussians(plain_gaussians(stack_all([ground, wall])))]
    cameras = [
        camera_ahead(position=(0.0, 0.0, 1.5)),
        camera_ahead(position=(12.0, -3.0, 3.0), yaw=2.5),
        camera_ahead(position=(0.0, 4.0, 0.4), yaw=0.1),
        from_above(),
    ]
    return draw_views(cameras, parts)


def some_points(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = rng.uniform((-2, -6, -0.3), (16, 6, 2.2), (count, 3))
    normals = rng.normal((0, 0, 1), size=(count, 3))
    return points, normals / np.linalg.norm(normals, axis=1)[:, None], rng.random(count) < 0.3


@pytest.mark.parametrize("shift_m", [0.0, 40_000.0])
def test_the_gpu_sees_what_the_cpu_sees(views, shift_m, monkeypatch):
    """Also far from the world's origin, where float32 alone would be half a centimetre off."""
    points, normals, is_sure = some_points(128, 3)
    moved = views.views.copy()
    moved[:, 12] += shift_m
    views, points = dataclasses.replace(views, views=moved), points + np.array([shift_m, 0, 0])
    expected = views.see(points, normals, is_sure)
    assert 20 < expected.sum() < 110
    with pretended_gpu(monkeypatch):
        there = dataclasses.replace(views, depths=gpu.upload(views.depths), on_gpu=True)
        seen = there.see(points, normals, is_sure)
        assert len(there.see(points[:0], normals[:0], is_sure[:0])) == 0
    assert (seen != expected).sum() <= 1  # a threshold may lie within float32's rounding


@pytest.mark.long
def test_a_bed_placed_on_the_gpu_is_the_cpus(monkeypatch):
    small = sheet((0.0, 1.4), (-0.7, 0.7))  # few splats, for an interpreted blend
    ground = dataclasses.replace(small, means=16 * small.means, scales=16 * small.scales)
    scene = drive(ground, places=[(-3.0, 0.0, 1.5)])
    cameras = [camera.scaled(0.12) for camera in cameras_of(scene)]
    settings = PlacementSettings(cell_m=8.0)
    monkeypatch.setattr(placement, "_SQUARE_CELLS", 16)  # several, which threads work on
    expected = place_snow_support(scene, cameras, settings)
    assert len(expected.ground) > 5
    with pretended_gpu(monkeypatch):
        found = place_snow_support(scene, cameras, settings, backend="cuda")
    assert_alike(found.ground, expected.ground)


@pytest.mark.gpu
def test_a_larger_bed_with_a_vehicle_is_the_cpus():
    car = box_car(start=(6.0, 0.0))
    scene = drive(sheet((-6.0, 20.0), (-8.0, 8.0)), actors=[car])
    expected = place_snow_support(scene, cameras_of(scene), PlacementSettings(cell_m=0.1))
    found = place_snow_support(
        scene, cameras_of(scene), PlacementSettings(cell_m=0.1), backend="cuda"
    )
    assert found.actors.keys() == expected.actors.keys() == {"car"}
    for a, b in ((found.ground, expected.ground), (found.actors["car"], expected.actors["car"])):
        assert len(a) == pytest.approx(len(b), rel=1e-3)  # cells at a threshold
        assert float((a.sizes_m**2).sum()) == pytest.approx(float((b.sizes_m**2).sum()), rel=1e-3)


def assert_alike(found, expected) -> None:
    """The same cells; heights and colours within what float32 sums differ by."""
    for field in dataclasses.fields(expected):
        a, b = getattr(found, field.name), getattr(expected, field.name)
        assert not isinstance(a, AwayTensor)
        if a.dtype.is_floating_point:
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
        else:
            assert torch.equal(a, b), field.name
