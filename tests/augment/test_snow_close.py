"""Discs of snow near the camera are split into finer ones that cover the same and show grain."""

import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.effects.snow.kernels import FARTHEST_M, MAX_SPLITS, REACH, SPREAD
from augment.effects.snow.near_camera import Grain, split_near
from augment.geometry import rigid
from augment.render.buffers import ALPHA, RGB
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.render.threads import limit_threads
from augment.scene import Gaussians, PosedGaussians

CELL_M, OPACITY = 0.05, 0.98
SUN = torch.tensor([math.cos(0.6), 0.0, math.sin(0.6)], dtype=torch.float64)
GRAIN = Grain(amount=0.5, contrast=0.4, seed=5)


def sheet(first_m=2.0, last_m=8.0, half_m=1.5, color=0.7) -> Gaussians:
    """Level snow at z = 0, ahead along +x, its discs scattered as those of a layer."""
    x, y = torch.meshgrid(
        torch.arange(first_m, last_m, CELL_M), torch.arange(-half_m, half_m, CELL_M), indexing="ij"
    )
    count = x.numel()
    scatter = (
        0.4 * CELL_M * (torch.rand(2, count, generator=torch.Generator().manual_seed(1)) - 0.5)
    )
    side = SPREAD * CELL_M
    return Gaussians(
        means=torch.stack(
            [x.flatten() + scatter[0], y.flatten() + scatter[1], torch.zeros(count)], 1
        ),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.tensor([[side, side, 0.01]]).repeat(count, 1),
        opacities=torch.full((count,), OPACITY),
        sh=torch.full((count, 1, 3), (color - 0.5) / SH_C0),
    )


def camera(x_m=0.0, y_m=0.0, z_m=1.4, f=500.0, width=320, height=240) -> Camera:
    """Looking along +x, 20 degrees down."""
    tilt = math.radians(20)
    forward = torch.tensor([math.cos(tilt), 0.0, -math.sin(tilt)], dtype=torch.float64)
    right = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    centre = torch.tensor([x_m, y_m, z_m], dtype=torch.float64)
    pose = rigid(rotation, -rotation @ centre)
    return Camera("close", width, height, f, f, width / 2, height / 2, pose)


def picture(*gaussians: Gaussians, view: Camera):
    parts = [PosedGaussians(g) for g in gaussians]
    return rasterize(parts, view, buffers=(RGB, ALPHA))


def colors(gaussians: Gaussians) -> torch.Tensor:
    return gaussians.sh[:, 0] * SH_C0 + 0.5


def test_what_is_split_covers_what_it_covered():
    snow, view = sheet(1.0, 7.0), camera(f=900.0, width=640, height=480)
    near = split_near(snow, None, view, SUN, GRAIN)
    before, after = picture(snow, view=view), picture(near.whole, near.fine, view=view)
    inside = before.alpha > 0.99
    assert int(inside.sum()) > 20_000
    assert float(after.alpha[inside].min()) > 0.97
    assert float((before.alpha - after.alpha).abs().mean()) < 0.01
    tone = (after.rgb[inside].mean() - before.rgb[inside].mean()).abs()
    assert float(tone) < 0.01  # grain is neither lighter nor darker than the snow
    assert float(after.rgb[inside].std()) > 3 * float(before.rgb[inside].std())


def test_every_disc_is_drawn_once_and_inputs_stay():
    snow, view = sheet(), camera()
    kept = snow.opacities.clone()
    near = split_near(snow, None, view, SUN, GRAIN)
    assert torch.equal(snow.opacities, kept)
    gone = near.whole.opacities == 0
    assert torch.equal(near.whole.opacities[~gone], kept[~gone])
    area = snow.scales[:, :2].prod(1)
    fine = float(near.fine.scales[:, :2].prod(1).sum())
    assert fine == pytest.approx(REACH**2 * float(area[gone].sum()), rel=1e-4)
    assert torch.allclose(near.fine.means[:, 2], torch.zeros(len(near.fine)), atol=1e-6)


def test_near_discs_are_split_most_and_far_ones_not_at_all():
    snow, view = sheet(0.8, 14.0, half_m=0.6), camera(f=1500.0, width=960, height=720)
    near = split_near(snow, None, view, SUN, GRAIN)
    distance = (near.fine.means - view.centre.float()).norm(dim=1)
    parts = REACH * SPREAD * CELL_M / near.fine.scales[:, 0]  # into how many, along a side
    assert float(distance.max()) < FARTHEST_M + CELL_M
    assert set(parts.round().int().tolist()) <= set(range(2, MAX_SPLITS + 1))
    close, far = parts[distance < 2.5], parts[distance > 5]
    assert float(close.mean()) > float(far.mean()) + 0.5
    wide = camera(f=60.0, width=64, height=48)  # whose pixels are coarser than the discs
    assert split_near(sheet(4.0, 9.0), None, wide, SUN, GRAIN) is None
    assert split_near(sheet(11.0, 14.0), None, view, SUN, GRAIN) is None


def test_grain_belongs_to_the_place():
    """Two cameras at one distance from a disc split it into the same discs, of the same colours."""
    snow = sheet(3.0, 3.05, 0.02)
    here, there = camera(y_m=0.2, f=900.0), camera(y_m=-0.2, f=900.0)
    one = split_near(snow, None, here, SUN, GRAIN).fine
    two = split_near(snow, None, there, SUN, GRAIN).fine
    assert torch.equal(one.means, two.means)
    assert torch.allclose(colors(one), colors(two), atol=2e-3)  # 1 cm of difference in the fade
    assert float(colors(one).std()) > 0.005
    other = split_near(snow, None, here, SUN, Grain(0.5, 0.4, seed=6)).fine
    assert not torch.allclose(colors(one), colors(other), atol=2e-3)


def test_the_light_that_is_added_per_pixel_has_the_same_grain():
    snow, view = sheet(), camera()
    slopes = torch.full((len(snow), 3), 0.2)
    near = split_near(snow, slopes, view, SUN, GRAIN)
    factor = colors(near.fine) / 0.7
    assert torch.allclose(near.fine_slopes, 0.2 * factor, atol=1e-5)


def test_grain_fades_out_with_the_distance_and_smooth_snow_has_none():
    snow, view = sheet(1.0, 9.9, half_m=0.6), camera(f=1500.0, width=960, height=720)
    near = split_near(snow, None, view, SUN, GRAIN)
    off = (colors(near.fine)[:, 0] - 0.7).abs()
    distance = (near.fine.means - view.centre.float()).norm(dim=1)
    assert float(distance.max()) > 6
    assert float(off[distance > 6].mean()) < 0.4 * float(off[distance < 4].mean())
    smooth = split_near(snow, None, view, SUN, Grain(0.0, 0.4, 5)).fine
    assert torch.allclose(colors(smooth), torch.tensor(0.7), atol=1e-6)


def test_the_side_towards_the_sun_is_brighter_than_the_other():
    """Where the noise falls towards the sun, snow faces it: reversed light reverses the relief."""
    snow, view = sheet(), camera()
    grain = Grain(0.5, 1.0, 5)
    lit = colors(split_near(snow, None, view, SUN, grain).fine)[:, 0]
    back = colors(split_near(snow, None, view, SUN * torch.tensor([-1.0, 1, 1]), grain).fine)[:, 0]
    flat = colors(split_near(snow, None, view, SUN, Grain(0.5, 0.0, 5)).fine)[:, 0]
    relief, reverse = (lit - flat).numpy(), (back - flat).numpy()
    assert float(lit.std()) > 1.2 * float(flat.std())
    assert np.abs(relief + reverse).max() < 1e-5


def test_the_same_bits_on_any_number_of_threads():
    snow, view = sheet(), camera()
    many = split_near(snow, None, view, SUN, GRAIN).fine
    try:
        limit_threads(1)
        one = split_near(snow, None, view, SUN, GRAIN).fine
    finally:
        limit_threads(None)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(many, name), getattr(one, name))
