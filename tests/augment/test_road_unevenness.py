"""Unevenness of wet roads: waves of one variance, which streaks keep their light over."""

from __future__ import annotations

import numpy as np
import torch

from augment.lamps.road_unevenness import OCTAVES_M, make_uneven, slopes_of_wave
from augment.lamps.wet_surface import WetSurface
from augment.scene.cameras import Camera

HEIGHT_M = 1.5


def _road(roughness: float = 0.1) -> tuple[Camera, WetSurface]:
    """Return a camera that looks along a level road, and the road's water."""
    pose = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, HEIGHT_M], [0, 1, 0, 0], [0, 0, 0, 1]])
    camera = Camera("front", 160, 80, 200.0, 200.0, 80.0, 40.0, pose.double())
    rows = (np.arange(80) + 0.5 - 40) / 200
    depth = np.where(rows > 0, HEIGHT_M / np.maximum(rows, 1e-3), 0)
    depth_m = np.repeat(depth[:, None], 160, axis=1).astype(np.float32)
    share = (depth_m > 0).astype(np.float32)
    m = np.full(share.shape, roughness, np.float32)
    return camera, WetSurface(share, m, depth_m, (0.0, 0.0, 1.0))


def test_waves_have_a_standard_deviation_of_1():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1e3, 1e3, (2, 200_000))
    for octave in range(len(OCTAVES_M)):
        slopes = slopes_of_wave(x, y, octave)
        np.testing.assert_allclose(slopes.std(axis=0), 1, rtol=0.02)  # 2.33 is rounded
        np.testing.assert_allclose(slopes.mean(axis=0), 0, atol=0.02)


def test_a_road_sums_the_waves_that_are_longer_than_two_pixels():
    camera, water = _road()
    uneven = make_uneven(water, camera, np.full(water.share.shape, 0.6, np.float32))
    rays = camera.ray_directions().double().numpy()
    points = camera.centre.numpy() + rays * water.depth_m[..., None]
    lengths = np.linalg.norm(rays, axis=-1)
    sines = np.abs(rays[..., 2]) / lengths
    is_water = water.share > 0
    footprint_m = water.depth_m[is_water] * lengths[is_water] / camera.fy / sines[is_water]
    expected = np.zeros((is_water.sum(), 2))
    variance = 0.5 * 0.1**2 * 0.6 / len(OCTAVES_M)
    resolved = np.zeros(is_water.sum())
    for octave, wave_m in enumerate(OCTAVES_M):
        weight = np.clip(0.5 * wave_m / footprint_m - 0.5, 0, 1)
        slopes = slopes_of_wave(points[is_water][:, 0], points[is_water][:, 1], octave)
        expected += (weight * np.sqrt(variance))[:, None] * slopes
        resolved += weight**2 * 2 * variance
    assert uneven.tilts is not None
    np.testing.assert_allclose(uneven.tilts[is_water], expected, atol=1e-4)  # z is float32
    np.testing.assert_allclose(uneven.roughness[is_water], np.sqrt(0.01 - resolved), atol=1e-6)


def test_far_roads_and_puddles_are_flat():
    camera, water = _road()
    uneven = make_uneven(water, camera, np.full(water.share.shape, 0.6, np.float32))
    assert uneven.tilts is not None
    is_far = water.depth_m > 40
    assert is_far.any() and not uneven.tilts[is_far].any()
    assert (uneven.roughness[is_far] == water.roughness[is_far]).all()
    puddle = make_uneven(water, camera, np.zeros(water.share.shape, np.float32))
    assert puddle.tilts is not None and not puddle.tilts.any()
    assert (puddle.roughness == water.roughness).all()
