"""Whole frames do not depend on the order of Gaussians and the number of threads."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from augment.cameras import Camera, Frame
from augment.render.threads import limit_threads
from augment.scene import Gaussians, Ground, Scene
from augment.sky import ConstantSky
from augment.views import render_view
from recipes.schema import Flood, Output, Recipe, Smog, Weather
from tests.augment.extremes import street
from tests.augment.hard_scenes import hard_gaussians, untied, wide_camera


def _valley(gaussians: Gaussians, camera: Camera) -> Scene:
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {"wide": camera})
    sky = ConstantSky(torch.tensor([0.6, 0.7, 0.9]))
    ground = Ground(-1.5, -1.5, "stated")
    return Scene(
        "valley", "test:valley", gaussians, (), sky, (frame,), ground_z_m=-1.5, ground=ground
    )


@pytest.mark.parametrize("effect", ["flood", "all"])
def test_weathered_frames_do_not_depend_on_order_and_threads(effect):
    """Through every pass, down to the 8 bits of the picture."""
    smog = Smog(visibility_m=60.0, scale_height_m=5.0) if effect != "flood" else None
    flood = Flood(level_m=0.8) if effect != "smog" else None
    recipe = Recipe(weather=Weather(smog=smog, flood=flood), output=Output(depth="median"))
    camera = wide_camera(70.0, (70, 53))
    gaussians = untied(hard_gaussians("plain", camera, 40, seed=2), camera)
    order = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(0))
    first = render_view(_valley(gaussians, camera), camera, recipe)
    assert effect == "smog" or first.masks["water"].any()
    try:
        limit_threads(1)
        shuffled = render_view(_valley(gaussians.select(order), camera), camera, recipe)
    finally:
        limit_threads(None)
    for name in ("rgb", "depth_m"):
        np.testing.assert_array_equal(getattr(shuffled, name), getattr(first, name), err_msg=name)
    np.testing.assert_equal(dict(shuffled.masks), dict(first.masks))


@pytest.mark.parametrize(
    "shading", ["per_splat", pytest.param("per_pixel", marks=pytest.mark.long)]
)
def test_frames_in_all_weathers_do_not_depend_on_threads(shading):
    """Of a street: snow is made anew, in waves of wind, styled, close to the eye and glinting."""
    data = {
        "weather": {
            "smog": {"visibility_m": 60.0, "scale_height_m": 5.0},
            "flood": {"level_m": 0.05, "waves": {"preset": "wind"}, "reflection": "screen_space"},
            "snow": {"depth_m": 0.2, "cell_m": 0.2, "sparkle": 1.0, "shading": shading},
        },
        "style": {"preset": "dusk", "per_region": True, "evaluated": "sh"},
        "output": {"depth": "expected"},
    }
    recipe, camera = Recipe.model_validate(data), street().frames[0].cameras["ahead"].scaled(0.3)
    views = []
    try:
        for count in (1, 2):
            limit_threads(count)
            scene = dataclasses.replace(street(), source=f"test:threads-{count}")
            views.append(render_view(scene, camera, recipe))
    finally:
        limit_threads(None)
    first, second = views
    assert first.masks["snow"].any() and first.masks["water"].any()
    np.testing.assert_array_equal(first.rgb, second.rgb)
    np.testing.assert_array_equal(first.depth_m, second.depth_m)
    np.testing.assert_equal(dict(first.masks), dict(second.masks))
