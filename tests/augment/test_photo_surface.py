"""Surfaces of photos: depth that spreads, alpha by the matte, and mixed pixels at the sky line."""

from __future__ import annotations

import heapq
from dataclasses import replace

import numpy as np
import pytest
import torch

from augment.effects.falling.air import Precipitation, glow_of, veil_of
from augment.effects.falling.reference import blend_by_torch
from augment.photo import outline_kernels as kernels
from augment.photo.photo_surface import FAR_DEPTH_M, complete_surfaces
from augment.photo.recorded_base import Photo
from augment.photo.sky_matte import SkyMatte
from augment.render.buffers import RenderOutput
from augment.render.fog import Fog
from augment.render.layout import ABOVE, HeightClip
from augment.scene.cameras import Camera
from tests.snow_scenes import drive, sheet

HEIGHT = 60
WIDTH = 90
AIRLIGHT = (0.4, 0.45, 0.5)


def camera_of() -> Camera:
    scene = drive(sheet((0.6, 20), (-9, 9)), ground_z_m=0.0)
    return scene.frames[0].cameras["ahead"].resized(WIDTH, HEIGHT)


def find_costs(pixels, state, step_costs, max_cost) -> dict[tuple[int, int], tuple[int, set]]:
    """Return the cost of the cheapest path to each open pixel, and the roots of all such paths."""
    height, width = state.shape
    costs = {}
    queue = [(0, (i, j), (i, j)) for i in range(height) for j in range(width) if state[i, j] == 2]
    heapq.heapify(queue)
    while queue:
        cost, pixel, root = heapq.heappop(queue)
        if pixel in costs and (costs[pixel][0] < cost or root in costs[pixel][1]):
            continue
        costs.setdefault(pixel, (cost, set()))[1].add(root)
        steps = ((-1, 0), (1, 0), (0, -1), (0, 1))
        for step_cost, (down, right) in zip(step_costs, steps, strict=True):
            other = pixel[0] + down, pixel[1] + right
            if not (0 <= other[0] < height and 0 <= other[1] < width) or state[other] != 1:
                continue
            change = np.abs(pixels[pixel].astype(int) - pixels[other].astype(int)).max()
            heapq.heappush(queue, (cost + min(int(change) + step_cost, max_cost), other, root))
    return costs


def test_depth_comes_along_the_cheapest_path():
    numbers = np.random.default_rng(2)
    pixels = numbers.integers(0, 80, (9, 11, 3)).astype(np.uint8)
    state = numbers.choice([0, 1, 1, 1, 2], (9, 11)).astype(np.uint8)
    roots = np.empty(state.shape, np.int64)
    step_costs = np.array([1, 24, 8, 8], np.int64)
    kernels.spread_roots(pixels, state, step_costs, np.int64(60), roots)
    costs = find_costs(pixels, state, step_costs.tolist(), 60)
    for pixel in np.ndindex(state.shape):
        if state[pixel] == 0 or pixel not in costs:
            assert roots[pixel] == -1
        else:
            assert tuple(map(int, divmod(roots[pixel], 11))) in costs[pixel][1]


def tower() -> tuple[np.ndarray, np.ndarray, RenderOutput]:
    """Return photo, share of sky and buffers: a tower above a wall, whose top no splat shows."""
    pixels = np.full((HEIGHT, WIDTH, 3), 220, np.uint8)
    pixels[:, 20:50] = 90
    sky_share = np.zeros((HEIGHT, WIDTH), np.float32)
    sky_share[:40] = 1
    sky_share[5:, 20:50] = 0
    alpha = torch.zeros(HEIGHT, WIDTH)
    depth = torch.zeros(HEIGHT, WIDTH)
    alpha[30:] = 1
    depth[30:] = 40.0
    depth[30:, 20:50] = 25.0
    alpha[3:6, 60:80] = 1  # a bar of splats before the sky
    depth[3:6, 60:80] = 12.0
    return pixels, sky_share, RenderOutput(alpha=alpha, expected_depth=depth)


def test_a_wall_goes_on_upwards_as_far_as_the_photo_shows_it():
    pixels, sky_share, raster = tower()
    done = complete_surfaces(raster, sky_share, pixels, camera_of())
    assert torch.equal(done.alpha, 1 - torch.from_numpy(sky_share))
    assert (done.expected_depth[5:, 22:48] == 25.0).all()
    assert (done.expected_depth[41:, :18] == 40.0).all()


def test_a_thing_that_borders_on_nothing_is_far():
    pixels, sky_share, raster = tower()
    sky_share[10:14, 70:74] = 0
    done = complete_surfaces(raster, sky_share, pixels, camera_of())
    assert (done.expected_depth[10:14, 70:74] == FAR_DEPTH_M).all()


def test_snow_on_a_roof_stays_before_the_sky():
    pixels, sky_share, raster = tower()
    overlay = torch.zeros(HEIGHT, WIDTH)
    overlay[3:5, 20:50] = 1
    done = complete_surfaces(replace(raster, overlay=overlay), sky_share, pixels, camera_of())
    assert (done.alpha[3:5, 20:50] == 1).all() and (done.alpha[:3] == 0).all()


def photo_at_sky_line(share: float, style=None) -> tuple[Photo, RenderOutput]:
    """Return a photo of bright sky above a dark wall, with a row that shows both."""
    surface = np.array([40, 50, 60], np.float32)
    sky = np.array([250, 240, 230], np.float32)
    sky_share = np.zeros((HEIGHT, WIDTH), np.float32)
    sky_share[:20] = 1
    sky_share[20] = share
    shown = sky_share[..., None] * sky + (1 - sky_share[..., None]) * surface
    pixels = np.rint(shown).astype(np.uint8)
    surface_rgb = pixels.copy()
    surface_rgb[20] = surface
    matte = SkyMatte(sky_share, surface_rgb, np.broadcast_to(sky, pixels.shape).astype(np.uint8))
    photo = Photo(camera_of(), pixels, "cpu", height_m=1.5, matte=matte, style=style)
    alpha = torch.ones(HEIGHT, WIDTH)
    alpha[:15] = 0  # splats reach into the sky
    depth = torch.full((HEIGHT, WIDTH), 20.0)
    raster = RenderOutput(
        alpha=alpha, expected_depth=depth * alpha, rgb=torch.zeros(HEIGHT, WIDTH, 3)
    )
    return photo, photo.complete(raster)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_dark_fog_leaves_no_halo_of_the_recorded_sky(backend):
    photo, raster = photo_at_sky_line(0.6)
    photo = replace(photo, backend=backend)
    fog = Fog(0.03, AIRLIGHT, None, 0.0)
    rgb = photo.fade(raster, (), fog)[0].numpy()
    airlight = np.array(AIRLIGHT)
    assert np.abs(rgb[:20] - airlight).max() < 1e-5
    rays = photo.camera.ray_lengths().numpy()
    t = np.exp(-0.03 * 20.0 * rays[20])[:, None]
    wall = t * np.array([40, 50, 60]) / 255 + (1 - t) * airlight
    expected = 0.4 * wall + 0.6 * airlight
    # The guided filter averages T over some pixels of one depth, whose rays differ in length.
    assert np.abs(rgb[20, 6:-6] - expected[6:-6]).max() < 0.01
    assert rgb[20].max() < max(AIRLIGHT)  # the recorded row is brighter than any of it


def test_the_sky_of_layered_fog_shows_through_mixed_pixels():
    photo, raster = photo_at_sky_line(0.5)
    fog = Fog(0.01, AIRLIGHT, 30.0, 0.0)
    by_kernel = photo.fade(raster, (), fog)[0]
    in_torch = replace(photo, backend="reference").fade(raster, (), fog)[0]
    torch.testing.assert_close(by_kernel, in_torch, rtol=0, atol=2e-5)
    assert (by_kernel[:18] != torch.tensor(AIRLIGHT)).any()


def test_without_weather_mixed_pixels_stay_the_photos():
    photo, raster = photo_at_sky_line(0.6)
    rgb = photo.clear_picture(raster, ())
    np.testing.assert_array_equal(np.rint(255 * rgb.numpy()), photo.pixels)


def test_rain_veils_sky_and_surface_of_a_mixed_pixel_each_by_its_own():
    photo, raster = photo_at_sky_line(0.6)
    rgb = photo.clear_picture(raster, ())
    part = photo.surface_part(rgb, raster.alpha, None)
    assert torch.equal(part[21:], rgb[21:]) and (part[:20] == 0).all()
    np.testing.assert_allclose(
        part[20].numpy(),
        np.broadcast_to(0.4 * np.array([40, 50, 60]) / 255, (WIDTH, 3)),
        atol=0.003,
    )
    scene = drive(sheet((0.6, 20), (-9, 9)), ground_z_m=0.0)
    rain = Precipitation("rain", 30.0, (0.0, 0.0), 0.0, 0, 0.005, 1.0)
    veil = veil_of(rain, photo.camera, glow_of(scene))
    clear = torch.ones(HEIGHT, WIDTH)
    arguments = raster.alpha, raster.expected_depth, clear, veil
    parted = blend_by_torch(rgb, *arguments, part)
    together = blend_by_torch(rgb, *arguments)
    # Without the parts, the recorded sky shines through the pixel.
    assert (together[20] - parted[20]).min() > 0.03


def test_pixels_that_fall_to_water_stay_as_they_are():
    photo, _ = photo_at_sky_line(0.6)
    camera = photo.camera
    alpha = torch.zeros(HEIGHT, WIDTH)
    raster = RenderOutput(alpha=alpha, expected_depth=torch.zeros(HEIGHT, WIDTH))
    done = photo.complete(raster, HeightClip(0.5, ABOVE))
    falls = photo.ray_fall > 0
    assert (done.alpha[falls] == 0).all() and (done.expected_depth[falls] == 0).all()
    is_wall = ~falls & (torch.from_numpy(photo.matte.sky_share) == 0)
    assert is_wall.any() and (done.alpha[is_wall] == 1).all()
    assert camera.height == HEIGHT
