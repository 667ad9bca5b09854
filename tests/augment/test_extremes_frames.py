"""Whole frames of extreme scenes, cameras and recipes: what tests/augment/extremes.py promises."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from augment.cameras import Camera
from augment.effects.snow.snow import placement_settings
from augment.effects.snow.support import support_of
from augment.errors import SceneError
from augment.scene import Actor, Gaussians, Scene, Track
from augment.semantics import SemanticClass
from augment.views import render_view
from recipes.schema import Recipe
from tests.augment.examples import drawing
from tests.augment.extremes import (
    PAIRS,
    Place,
    camera_at,
    cameras,
    nothing,
    places,
    recipes,
    rendered,
    snow_model,
    street,
)
from tests.scenes import one_gaussian

EVERYTHING = {
    "smog": {"extinction_per_m": 0.1, "scale_height_m": 5.0},
    "flood": {"level_m": 0.2, "reflection": "screen_space"},
    "snow": {"depth_m": 0.3, "cell_m": 0.2, "sparkle": 1.0},
}


def weather(depth: str = "expected", **effects) -> Recipe:
    style = effects.pop("style", None)
    output = {"depth": depth}
    return Recipe.model_validate({"weather": effects, "style": style, "output": output})


@drawing(6)
@given(places(), cameras(levels_m=(0.2,)), recipes())
def test_any_scene_from_anywhere_in_any_weather(place: Place, camera: Camera, recipe: Recipe):
    rendered(place.scene(), camera, recipe)


@pytest.mark.long
@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: "-".join(sorted(pair)))
@drawing(4)
@given(data=st.data())
def test_every_pair_of_effects(pair: frozenset[str], data: st.DataObject):
    place, camera = data.draw(places()), data.draw(cameras(levels_m=(0.2,)))
    rendered(place.scene(), camera, data.draw(recipes(pair)))


@pytest.mark.long
@drawing(4)
@given(cameras(levels_m=(0.2,)), recipes(frozenset({"flood"})))
def test_the_eye_at_below_and_above_the_water(camera: Camera, recipe: Recipe):
    """The eye at the recipe's level, the next number beside it, or a little away from it."""
    data = recipe.model_dump(exclude_none=True)
    data["weather"]["flood"] |= {"level_m": 0.2, "reference": "absolute"}
    view = rendered(
        Place(nothing(), 3, on_street=True).scene(), camera, Recipe.model_validate(data)
    )
    assert view.masks.get("water") is not None
    if float(camera.centre[2]) <= 0.2:
        assert (view.masks["water"] == 255).all()


@pytest.mark.long
@pytest.mark.parametrize("size", [(8192, 1), (1, 8192)])
@pytest.mark.parametrize("effects", [("smog", "snow"), ("flood",)])
def test_images_of_one_row_or_column(size: tuple[int, int], effects: tuple[str, ...]):
    scene = Place(nothing(), 3, on_street=True).scene()
    camera = camera_at((0.0, 0.0, 1.2), pitch_deg=-10, size=size, fov_deg=100)
    chosen = {name: EVERYTHING[name] for name in effects}
    if "flood" in chosen:
        chosen["flood"] = {"level_m": 0.2, "reflection": "sky"}
    rendered(scene, camera, weather(style={"preset": "dusk"}, **chosen))


@pytest.mark.parametrize("opacity", [0.0, 1 / 255, 1.0])
def test_one_gaussian(opacity: float):
    """Of opacity 0 it is the sky that shows; at 1/255 and above, the Gaussian."""
    one = dataclasses.replace(
        one_gaussian(opacity=opacity), semantic=torch.ones(1, dtype=torch.int16)
    )
    place = Place(one, 1, on_street=False)
    view = rendered(place.scene(), camera_at((0.0, 0.0, 0.0)), weather())
    assert view.depth_m is not None
    assert bool(view.depth_m.any()) == (opacity == 1.0)
    assert np.unique(view.rgb).size == (1 if opacity == 0 else np.unique(view.rgb).size)


@pytest.mark.long
def test_two_million_gaussians():
    """In every effect at once; most of them far smaller than a pixel."""
    count = 2_000_000
    rng = np.random.default_rng(0)
    means = rng.uniform((0.5, -4, 0), (40, 4, 6), (count, 3)).astype(np.float32)
    quats = np.zeros((count, 4), np.float32)
    quats[:, 0] = 1
    many = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(10 ** rng.uniform(-8, -1, (count, 3)).astype(np.float32)),
        opacities=torch.from_numpy(rng.uniform(0, 1, count).astype(np.float32)),
        sh=torch.from_numpy(rng.normal(0, 1, (count, 1, 3)).astype(np.float32)),
        semantic=torch.ones(count, dtype=torch.int16),
    )
    scene = Place(many, 3, on_street=True).scene()
    rendered(scene, camera_at((0.0, 0.0, 1.2), size=(48, 27)), weather(**EVERYTHING))


def test_nothing_at_all_is_refused():
    with pytest.raises(SceneError, match="holds no Gaussians"):
        Place(nothing(), 0, on_street=False).scene()


def test_actors_that_are_all_gone_leave_the_sky():
    """Without a background: no part of the view has a splat to look up."""
    track = Track(torch.tensor([0]), torch.eye(4, dtype=torch.float64)[None])
    actor = Actor("a", "Car", one_gaussian(), track, (1.0, 1.0, 1.0))
    scene = Place(nothing(), 0, on_street=False, actor=actor).scene()
    output = {"depth": "expected", "semantic": True, "instance": True}
    camera = camera_at((0.0, 0.0, 0.0), timestamp_ns=2**40)
    view = render_view(scene, camera, Recipe.model_validate({"output": output}))
    assert view.semantic is not None and (view.semantic == SemanticClass.SKY).all()
    assert view.instance is not None and not view.instance.any()
    assert view.depth_m is not None and not view.depth_m.any()


@pytest.mark.long
@drawing(3)
@given(places())
def test_snow_is_placed_among_extreme_gaussians(place: Place):
    """The placement itself, and not the street's, of the street and what else there is."""
    base = place.scene()
    frames = street().frames
    scene: Scene = dataclasses.replace(base, frames=frames)  # another object: nothing remembered
    snow = {"depth_m": 0.3, "cell_m": 0.5}
    try:
        support_of(scene, placement_settings(snow_model(cell_m=0.5)))
    except SceneError as error:
        assert "cell" in str(error)
        return
    rendered(scene, camera_at((0.0, 0.0, 1.2), pitch_deg=-20), weather(snow=snow))
