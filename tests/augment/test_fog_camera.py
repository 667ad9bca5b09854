"""Fog and noise as a camera sees them: forward scatter, the lens's blur, and sensor noise."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from augment.render.fog import Fog
from augment.render.scatter import (
    DIFFRACTION_RAD,
    NOMINAL_DEPTH,
    NUM_LEVELS,
    level_shares,
    once_scattered,
    pyramid_down,
    pyramid_up,
    scatter_forward,
    scattered,
)
from augment.render.sensor import add_noise, blur_lens, draw_noise, noise_sigmas, noise_variance
from augment.scene.cameras import Camera
from augment.view.plan import make_plan
from augment.view.render_view import render_view
from recipes.flood import Flood
from recipes.schema import Output, Recipe, Render, Sensor, Smog, Weather
from tests.streets import open_street

GREY = (0.7, 0.7, 0.7)


def camera(width: int = 480, height: int = 272, *, fx: float = 490.0, pitch: float = 0.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    c, s = math.cos(pitch), math.sin(pitch)
    axes = torch.tensor([[1.0, 0, 0], [0, -s, -c], [0, c, -s]], dtype=torch.float64)
    pose[:3, :3], pose[2, 3] = axes, 0.0
    return Camera("front", width, height, fx, fx, width / 2, height / 2, pose, timestamp_ns=7)


def at_depth(view: Camera, tau: float, medium: Fog) -> torch.Tensor:
    """z at which every pixel stands behind this optical depth of uniform fog."""
    return tau / medium.extinction_per_m / view.ray_lengths()


FOG = Fog(0.05, GREY)


def spread_of(rgb: torch.Tensor, depth: torch.Tensor, view: Camera, strength: float = 1.0):
    return scatter_forward(rgb.clone(), torch.ones_like(depth), depth, view, FOG, strength)


# ---- Forward scatter -----------------------------------------------------------------------------


def test_single_scattering_is_the_integral_of_the_discs_autocorrelation():
    fine = np.array([1.0, 5.0, 40.0])
    # Beyond the cut-off only the droplets close to a thing count: 4 / (3 pi nu lambda / D).
    np.testing.assert_allclose(once_scattered(fine), 4 / (3 * np.pi * fine), rtol=2e-3)
    assert once_scattered(np.array([0.0])) == pytest.approx(1)
    # No light is lost, and of the finest detail all that is deflected is.
    assert scattered(np.array([0.0, 1e3]), 2.0) == pytest.approx([1, 0], abs=1e-3)


@pytest.mark.parametrize("diffraction_px", [6.0, 8.0, 12.0, 17.0, 23.9])
def test_the_pyramids_kernel_is_that_of_diffraction(diffraction_px: float):
    shares = np.array(level_shares(diffraction_px))
    assert shares.sum() == pytest.approx(1) and (shares >= 0).all()
    frequency = np.linspace(0.001, 0.5, 97)
    variance = np.array([sum(2 * 4**i for i in range(level)) for level in range(NUM_LEVELS + 1)])
    kernel = np.exp(-2 * np.pi**2 * variance * frequency[:, None] ** 2) @ shares
    expected = scattered(frequency * diffraction_px, NOMINAL_DEPTH)
    assert np.abs(kernel - expected).max() < 0.05


@pytest.mark.parametrize(("size", "fx"), [((480, 272), 490.0), ((960, 544), 980.0)])
@pytest.mark.parametrize("tau", [0.5, 1.5, 2.5])
def test_a_grating_keeps_the_contrast_of_the_small_angle_approximation(size, fx, tau):
    view = camera(*size, fx=fx)
    columns = torch.arange(view.width)
    for period in (4, 8, 16, 32):
        wave = 0.5 + 0.2 * torch.cos(2 * math.pi / period * (columns + 0.5))
        rgb = wave[None, :, None].expand(view.height, -1, 3).contiguous()
        seen = spread_of(rgb, at_depth(view, tau, FOG), view)
        inside = seen[100:-100, 96:-96, 1]
        kept = float(inside.std() / rgb[100:-100, 96:-96, 1].std())
        cycles = np.array([DIFFRACTION_RAD * fx / period])
        expected = math.exp(-tau * (1 - once_scattered(cycles)[0]))
        # The kernel is that of one optical depth, 1.5; at 2.5 a twelfth of the contrast is left.
        assert kept == pytest.approx(expected, abs=0.1 if tau > 2 else 0.06), period


def test_light_is_neither_made_nor_lost():
    view, generator = camera(), torch.Generator().manual_seed(1)
    depth = 5 + 60 * torch.rand(view.height // 16, view.width // 16, generator=generator)
    depth = depth.repeat_interleave(16, 0).repeat_interleave(16, 1)
    rgb = torch.rand(view.height, view.width, 3, generator=generator)
    rgb = rgb * depth[..., None] / 65  # dark things near, bright ones far
    seen = spread_of(rgb, depth, view)
    assert float((seen - rgb).abs().mean()) > 0.05
    # To the rounding of depths at edges by the picture's halving, and its border.
    torch.testing.assert_close(seen.mean((0, 1)), rgb.mean((0, 1)), rtol=2e-3, atol=0)
    flat = torch.full_like(rgb, 0.4)
    torch.testing.assert_close(spread_of(flat, depth, view), flat, rtol=0, atol=1e-5)


def test_what_is_near_stays_sharp_and_leaves_no_halo_in_the_fog():
    view = camera()
    depth = at_depth(view, 3.0, FOG)
    near = torch.zeros(view.height, view.width, dtype=torch.bool)
    near[:, : view.width // 2] = True
    depth = torch.where(near, at_depth(view, 0.05, FOG), depth)
    rgb = torch.where(near, 0.1, 0.7)[..., None].expand(-1, -1, 3).contiguous()
    seen = spread_of(rgb, depth, view)
    # A step of 0.6 under a blur of all pixels alike would be off by 0.2 on either side.
    assert float((seen - rgb).abs().max()) < 0.05
    halves = near.float()[..., None].expand(-1, -1, 3).contiguous()
    blurred = spread_of(halves, at_depth(view, 3.0, FOG), view)
    assert float((blurred - halves).abs().max()) > 0.2


def test_far_things_are_softer_than_near_ones():
    view = camera()
    rgb = torch.rand(view.height, view.width, 3, generator=torch.Generator().manual_seed(2))
    depths = (1e-5, 0.1, 0.5, 1, 3)
    kept = [float(spread_of(rgb, at_depth(view, t, FOG), view).std()) for t in depths]
    assert kept == sorted(kept, reverse=True)
    assert kept[0] == pytest.approx(float(rgb.std()), rel=1e-3)
    weak = spread_of(rgb, at_depth(view, 1.0, FOG), view, strength=0.1)
    assert float(weak.std()) == pytest.approx(kept[1], rel=1e-3)  # by strength times depth


@pytest.mark.parametrize("size", [(960, 540), (241, 135), (50, 33), (7, 4), (1, 1)])
@pytest.mark.parametrize("layered", [False, True])
def test_kernels_do_as_the_definition(size, layered):
    view = camera(*size, fx=float(size[0]), pitch=0.2)
    generator = torch.Generator().manual_seed(3)
    rgb = torch.rand(view.height, view.width, 3, generator=generator)
    alpha = torch.rand(view.height, view.width, generator=generator)
    depth = 100 * torch.rand(view.height, view.width, generator=generator)
    medium = Fog(0.04, GREY, 20.0, -2.0) if layered else FOG
    seen, expected = (
        scatter_forward(rgb.clone(), alpha, depth, view, medium, 1.0, backend=backend)
        for backend in ("cpu", "reference")
    )
    torch.testing.assert_close(seen, expected, rtol=0, atol=1e-4)  # of exp by plain sums


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_known_share_of_fog_scatters_as_its_depth_does(backend):
    """Recorded photos know the share at their own edges; here it is that of the depth."""
    view = camera(96, 54, fx=98.0)
    rgb = torch.rand(54, 96, 3, generator=torch.Generator().manual_seed(5))
    depth = at_depth(view, 1.0, FOG) * torch.linspace(0.1, 2, 96)
    share = -torch.expm1(-FOG.extinction_per_m * depth * view.ray_lengths())
    rest = torch.ones_like(depth), depth, view, FOG, 0.3
    by_depth = scatter_forward(rgb.clone(), *rest, backend=backend)
    by_share = scatter_forward(rgb.clone(), *rest, fog_share=share, backend=backend)
    torch.testing.assert_close(by_share, by_depth, rtol=0, atol=1e-4)
    assert float((by_share - rgb).abs().max()) > 0.05


@pytest.mark.parametrize("size", [(270, 480), (9, 9), (9, 8), (8, 9), (5, 4)])
def test_the_pyramid_of_torch_is_opencvs(size):
    image = np.random.default_rng(1).random((*size, 4), np.float32)
    small = pyramid_down(image)
    np.testing.assert_allclose(pyramid_down(torch.from_numpy(image)), small, atol=1e-6)
    large = pyramid_up(torch.from_numpy(small), size)
    np.testing.assert_allclose(large, pyramid_up(small, size), atol=1e-6)


@pytest.mark.parametrize("depth_m", [0.0, 1e-30, 1e30])
@pytest.mark.parametrize("medium", [Fog(100.0, GREY), Fog(1e-9, GREY), Fog(1.0, GREY, 0.1, 1e4)])
def test_extremes_stay_finite(depth_m, medium):
    view = camera(33, 20, pitch=0.3)
    rgb = torch.rand(20, 33, 3)
    depth, alpha = torch.full((20, 33), depth_m), torch.eye(33)[:20]
    for backend in ("cpu", "reference"):
        seen = scatter_forward(rgb.clone(), alpha, depth, view, medium, 4.0, backend=backend)
        assert bool(torch.isfinite(seen).all())
        assert float(seen.min()) > -0.1 and float(seen.max()) < 1.1


# ---- The camera ----------------------------------------------------------------------------------


def test_noise_has_its_sigma_at_mid_grey_and_that_of_photons_elsewhere():
    view, sigma = camera(), 0.02
    for level in (0.05, 0.5, 0.9):
        flat = torch.full((view.height, view.width, 3), level)
        noisy = add_noise(flat.clone(), sigma, view, seed=1, scene="street") - flat
        expected = sigma * noise_sigmas()[round(level * 255)]
        assert float(noisy.std()) == pytest.approx(float(expected), rel=0.02)
        assert abs(float(noisy.mean())) < 0.05 * sigma
    # Photons alone: sigma of linear light goes with its root, display-encoded nearly flat.
    dark, bright = noise_sigmas()[77], noise_sigmas()[230]
    assert 1.0 < dark / bright < 1.3 and noise_sigmas()[128] == pytest.approx(1, abs=0.01)


def test_neighbours_share_noise_so_that_jpeg_keeps_it():
    view = camera()
    flat = torch.full((view.height, view.width, 3), 0.7)
    noise = (add_noise(flat.clone(), 0.004, view, seed=1, scene="street") - flat).numpy()
    green = noise[..., 1]
    beside = np.corrcoef(green[:, 1:].ravel(), green[:, :-1].ravel())[0, 1]
    assert 0.2 < beside < 0.6
    image = np.rint(255 * (flat.numpy() + noise)).astype(np.uint8)
    kept: Any = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])[1], 1)
    assert kept[..., 1].std() > 0.3  # levels; white noise of this sigma leaves half of that


def test_noise_is_of_seed_scene_camera_and_time_alone():
    view = camera()
    own = draw_noise(view, seed=1, scene="a")
    assert np.array_equal(own, draw_noise(dataclasses.replace(view), seed=1, scene="a"))
    moved = view.camera_from_world.clone()
    moved[0, 3] += 1
    others = [
        draw_noise(dataclasses.replace(view, timestamp_ns=8), seed=1, scene="a"),
        draw_noise(dataclasses.replace(view, name="left"), seed=1, scene="a"),
        draw_noise(dataclasses.replace(view, camera_from_world=moved), seed=1, scene="a"),
        draw_noise(view, seed=2, scene="a"),
        draw_noise(view, seed=1, scene="b"),
    ]
    for other in others:
        assert abs(np.corrcoef(own.ravel(), other.ravel())[0, 1]) < 0.02


def test_the_lens_blurs_by_its_sigma():
    point = torch.zeros(41, 41, 3)
    point[20, 20] = 1
    for sigma in (0.5, 2.0):
        seen = blur_lens(point, sigma)[..., 1]
        assert float(seen.sum()) == pytest.approx(1, abs=1e-5)
        offsets = torch.arange(41.0) - 20
        # Cut at three sigmas; of half a pixel, sampled coarsely.
        assert float((seen.sum(0) * offsets**2).sum()) == pytest.approx(sigma**2, rel=0.15)


# ---- In a recipe ---------------------------------------------------------------------------------


def street_recipe(scatter: float = 0.0, **sensor: float) -> Recipe:
    smog = Smog(visibility_m=87, scatter=scatter)
    return Recipe(
        weather=Weather(smog=smog), render=Render(scale=0.3), camera=Sensor(**sensor), seed=3
    )


def detail(picture: np.ndarray, seen: np.ndarray, size: int) -> float:
    """Spread of the octave of detail of a picture that is so many times smaller, where `seen`."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    height, width = grey.shape

    def smaller(image: np.ndarray, times: int) -> np.ndarray:
        return cv2.resize(image, (width // times, height // times), interpolation=cv2.INTER_AREA)

    own = smaller(grey, size)
    coarse = cv2.resize(smaller(grey, 2 * size), own.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return float((own - coarse)[smaller(seen.astype(np.float32), size) > 0.5].std())


def test_fog_takes_fine_detail_and_leaves_what_is_measured():
    scene = open_street()
    view = scene.frames[0].cameras["front"]
    clear = render_view(scene, view, street_recipe())
    foggy = render_view(scene, view, street_recipe(1.0, noise=0.003, psf_px=0.5))
    again = render_view(scene, view, street_recipe(1.0, noise=0.003, psf_px=0.5))
    assert np.array_equal(foggy.rgb, again.rgb) and not np.array_equal(foggy.rgb, clear.rgb)
    assert clear.depth_m is not None and foggy.depth_m is not None
    assert np.array_equal(foggy.depth_m, clear.depth_m)
    arrives = np.exp(-3.912 / 87 * clear.depth_m)
    seen = (clear.depth_m > 0) & (arrives > 0.03) & (arrives < 0.5)
    before, after = ([detail(v.rgb, seen, n) for n in (2, 4)] for v in (clear, foggy))
    assert after[0] < 0.6 * before[0]
    assert after[0] / after[1] < 0.85 * before[0] / before[1]
    steps = {step.name: step.runs for step in make_plan(street_recipe(1.0), scene).steps}
    assert steps["forward scatter"] and not steps["lens blur"] and not steps["sensor noise"]


def test_a_flooded_view_scatters():
    scene = open_street()
    view = scene.frames[0].cameras["front"]
    flooded = [
        recipe.model_copy(
            update={
                "weather": Weather(smog=recipe.weather.smog, flood=Flood(level_m=0.3)),
                "output": Output(depth="none", labels=False),
            }
        )
        for recipe in (street_recipe(), street_recipe(1.0))
    ]
    sharp, soft = (render_view(scene, view, recipe).rgb.astype(float) for recipe in flooded)
    assert 0.5 < np.abs(soft - sharp).mean() < 20


def test_fields_of_fog_and_camera_are_limited():
    for wrong in ({"noise": -0.1}, {"noise": 0.3}, {"psf_px": -1.0}, {"psf_px": 17.0}, {"iso": 1}):
        with pytest.raises(ValueError):
            Sensor(**wrong)
    with pytest.raises(ValueError):
        Smog(visibility_m=80, scatter=-0.1)
    assert Recipe(camera=Sensor()).hash == Recipe().hash != Recipe(camera=Sensor(noise=0.01)).hash


@pytest.mark.parametrize(("down", "across"), [(0.0, 0.0), (0.3, 0.8), (0.5, 0.5)])
def test_the_variance_of_sampled_noise_is_known(down: float, across: float):
    """Which is less than a pixel's between pixels, and more than if neighbours were independent."""
    grey, sigma = torch.full((400, 400, 3), 0.35), 0.02
    seen = add_noise(grey.clone(), sigma, camera(400, 400), seed=4, scene="x").double().numpy()
    rows = (1 - down) * seen[:-1] + down * seen[1:]
    sampled = (1 - across) * rows[:, :-1] + across * rows[:, 1:]
    one = np.ones(1)
    expected = noise_variance(grey.numpy()[0, :1], down * one, across * one, sigma)[0]
    # The draws hold 256 numbers, rounded twice.
    assert sampled.reshape(-1, 3).var(0).mean() == pytest.approx(expected, rel=0.03)
