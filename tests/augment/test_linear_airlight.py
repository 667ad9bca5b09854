"""Airlight mixed in linear light: the formula, the kernel, silhouettes, and a recipe with it."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from augment.render.fog import Fog, blend_airlight, optical_depth
from augment.render.linear_airlight import mix_linear_light
from augment.render.scatter import scattered_share
from augment.scene.cameras import Camera
from augment.view.plan import make_plan
from augment.view.render_view import render_view
from recipes.schema import Recipe, Render, Smog, Weather
from tests.streets import open_street

GREY = (0.7, 0.72, 0.75)
FOG = Fog(0.05, GREY)


def camera(width: int = 96, height: int = 54, pitch: float = 0.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    c, s = math.cos(pitch), math.sin(pitch)
    pose[:3, :3] = torch.tensor([[1.0, 0, 0], [0, -s, -c], [0, c, -s]], dtype=torch.float64)
    focal = float(width)
    return Camera("front", width, height, focal, focal, width / 2, height / 2, pose, timestamp_ns=7)


def random_view(view: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Colours and depths of opaque surfaces."""
    generator = torch.Generator().manual_seed(3)
    rgb = torch.rand(view.height, view.width, 3, generator=generator)
    return rgb, 1 + 60 * torch.rand(view.height, view.width, generator=generator)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_the_light_of_a_surface_and_of_the_air_add_up(backend: str) -> None:
    view = camera()
    rgb, depth = random_view(view)
    tau = optical_depth(FOG, depth * view.ray_lengths(), 0.0)
    display = blend_airlight(rgb, tau, FOG)
    t = torch.exp(-tau)[..., None]
    light = (t * rgb**2 + (1 - t) * torch.tensor(GREY) ** 2).sqrt()
    opaque = torch.ones_like(depth)
    share = scattered_share(opaque, depth, view, FOG, backend=backend)
    mixed = mix_linear_light(display.clone(), share, view, FOG, backend=backend)
    # Of roots of rounded differences: black surfaces deep in fog are the worst.
    torch.testing.assert_close(mixed, light, rtol=0, atol=1e-4)
    # Nothing is darker than it was, since a mean of squares is at least the square of the mean.
    assert float((mixed - display).min()) > -1e-4 and float((mixed - display).max()) > 0.15


@pytest.mark.parametrize("size", [(96, 54), (33, 20), (1, 1)])
@pytest.mark.parametrize(
    "medium",
    [
        FOG,
        Fog(0.04, GREY, 20.0, -2.0),
        Fog(0.05, GREY, elevation_gain=0.5),
        Fog(0.05, (0.9, 0.2, -0.1), 30.0, 0.0, 1.0, (0.3, 0.1, 0.1)),
        Fog(100.0, GREY),
        Fog(1e-9, GREY),
    ],
)
def test_the_kernel_does_as_the_definition_at_any_colour(size, medium) -> None:
    view = camera(*size, pitch=0.2)
    generator = torch.Generator().manual_seed(4)
    # Beyond 0 to 1, as splats and colour maps of cameras leave them.
    rgb = 2 * torch.rand(view.height, view.width, 3, generator=generator) - 0.5
    alpha = torch.rand(view.height, view.width, generator=generator)
    depth = 100 * torch.rand(view.height, view.width, generator=generator)
    depth[0, 0] = 0
    seen, expected = (
        mix_linear_light(
            rgb.clone(),
            scattered_share(alpha, depth, view, medium, backend=backend),
            view,
            medium,
            backend=backend,
        )
        for backend in ("cpu", "reference")
    )
    assert bool(torch.isfinite(seen).all())
    # exp by plain sums, under a root and over a transmittance of 1e-4 at least.
    torch.testing.assert_close(seen, expected, rtol=1e-3, atol=2e-3)


def test_colours_that_two_distances_mix_change_without_a_jump() -> None:
    view = camera(64, 1)
    share = torch.full((1, 64), 0.6)
    ramp = torch.linspace(-0.05, 1.2, 64)[None, :, None].expand(-1, -1, 3).contiguous()
    mixed = mix_linear_light(ramp.clone(), share, view, FOG)[0, :, 0]
    steps = mixed.diff()
    assert float(steps.min()) > 0, "a brighter pixel stays brighter"
    # The steepest part is the one below (1 - t) airlight: 1 / sqrt(1 - t), which is 1.3 here.
    assert float(steps.max()) < 1.4 * 1.25 / 63


def test_endless_fog_and_clear_air_keep_their_colours() -> None:
    view = camera()
    sky = torch.tensor(GREY).expand(view.height, view.width, 3).contiguous()
    nothing = torch.zeros(view.height, view.width)
    torch.testing.assert_close(
        mix_linear_light(sky.clone(), 1 - nothing, view, FOG), sky, rtol=0, atol=1e-5
    )
    rgb, _ = random_view(view)
    clear = mix_linear_light(rgb.clone(), nothing, view, FOG)
    torch.testing.assert_close(clear, rgb, rtol=0, atol=1e-5)


def recipe(blend: str | None, **fields) -> Recipe:
    smog = Smog(
        visibility_m=80, color=GREY, **fields, **({} if blend is None else {"blend": blend})
    )
    return Recipe(weather=Weather(smog=smog), render=Render(scale=0.3), seed=3)


def test_the_street_in_fog_has_the_light_that_its_depth_says() -> None:
    scene = open_street()
    view = scene.frames[0].cameras["front"]
    clear = render_view(scene, view, Recipe(render=Render(scale=0.3), seed=3))
    foggy = {blend: render_view(scene, view, recipe(blend)) for blend in ("display", "linear")}
    depth = clear.depth_m
    assert depth is not None and foggy["linear"].depth_m is not None
    assert np.array_equal(foggy["linear"].depth_m, depth)
    lengths = foggy["linear"].camera.ray_lengths().numpy()
    t = np.exp(-3.912 / 80 * depth * lengths)[..., None]
    exact = np.sqrt(t * (clear.rgb / 255.0) ** 2 + (1 - t) * np.array(GREY) ** 2)
    # Away from silhouettes, where a pixel has one distance.
    is_calm = (depth > 0) & (cv2.dilate(depth, np.ones((5, 5))) < 1.05 * depth)
    errors = np.abs(255 * exact - foggy["linear"].rgb)[is_calm]
    assert np.median(errors) < 1 and np.quantile(errors, 0.99) < 4
    assert np.abs(255 * exact - foggy["display"].rgb)[is_calm].mean() > 3


def test_the_near_field_has_less_contrast() -> None:
    scene = open_street()
    view = scene.frames[0].cameras["front"]
    pictures = {blend: render_view(scene, view, recipe(blend)) for blend in ("display", "linear")}
    depth = pictures["display"].depth_m
    assert depth is not None
    is_near = (depth > 4) & (depth < 15)
    contrast = {
        blend: picture.rgb[is_near].std() / picture.rgb[is_near].mean()
        for blend, picture in pictures.items()
    }
    # The street's road is pale. On recorded photos with dark cars the contrast is halved.
    assert contrast["linear"] < 0.9 * contrast["display"]


def test_a_recipe_without_the_field_keeps_its_bits() -> None:
    scene = open_street()
    view = scene.frames[0].cameras["front"]
    implicit, explicit = (render_view(scene, view, recipe(blend)) for blend in (None, "display"))
    assert np.array_equal(implicit.rgb, explicit.rgb)
    assert recipe(None).hash == recipe("display").hash != recipe("linear").hash
    steps = {step.name: step.runs for step in make_plan(recipe("linear"), scene).steps}
    assert steps["airlight in linear light"] and not steps["forward scatter"]
    layered = render_view(scene, view, recipe("linear", scale_height_m=30.0, overcast=0.5))
    assert layered.rgb.std() > 10
