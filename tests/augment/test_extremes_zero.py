"""Effects of no strength leave every bit of a frame as it is, in any scene and from anywhere."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from augment.cameras import Camera
from augment.views import WeatheredView, render_view
from recipes.schema import Recipe
from tests.augment.examples import drawing
from tests.augment.extremes import (
    CELL_M,
    EFFECTS,
    Place,
    camera_at,
    cameras,
    nothing,
    places,
    recipes,
)

UNIT = st.sampled_from((0.0, 0.5, 1.0))
# Every other number of an effect without strength is free.
ZEROS: dict[str, st.SearchStrategy[dict[str, Any]]] = {
    "smog": st.fixed_dictionaries(
        {
            "extinction_per_m": st.sampled_from((0.0, -0.0)),
            "scale_height_m": st.sampled_from((None, 0.1, 1e5)),
            "base_height_m": st.sampled_from((-1e4, 0.0, 1e4)),
            "model": st.sampled_from(("per_gaussian", "deferred")),
        }
    ),
    "snow": st.fixed_dictionaries(
        {
            "cell_m": st.just(CELL_M),
            "shading": st.sampled_from(("per_splat", "per_pixel")),
            "sparkle": UNIT,
            "grain": UNIT,
        }
    ).flatmap(
        lambda snow: st.sampled_from(((0.0, 1.0), (10.0, 0.0), (0.0, 0.0))).map(
            lambda amount: {**snow, "depth_m": amount[0], "coverage": amount[1]}
        )
    ),
    "style": st.fixed_dictionaries(
        {
            "preset": st.just("dusk"),
            "strength": st.just(0.0),
            "method": st.sampled_from(("mkl", "reinhard")),
            "applied_to": st.sampled_from(("scene", "picture")),
        }
    ),
}


def with_effects(clean: Recipe, effects: dict[str, dict[str, Any]]) -> Recipe:
    """The recipe with these effects besides its own."""
    data = clean.model_dump(exclude_none=True)
    for name, effect in effects.items():
        holder = data if name == "style" else data["weather"]
        holder[name] = effect
    return Recipe.model_validate(data)


def assert_same_bits(view: WeatheredView, clean: WeatheredView) -> None:
    for name in ("rgb", "depth_m", "semantic", "instance"):
        one, other = getattr(view, name), getattr(clean, name)
        assert (one is None) == (other is None)
        assert one is None or np.array_equal(one, other), f"{name} differs"


@drawing(5)
@given(places(), cameras(), recipes(frozenset()), st.data())
def test_effects_without_strength_change_no_bit(
    place: Place, camera: Camera, recipe: Recipe, data: st.DataObject
):
    scene = place.scene()
    names = data.draw(st.sets(st.sampled_from(sorted(ZEROS)), min_size=1))
    zero = with_effects(recipe, {name: data.draw(ZEROS[name]) for name in sorted(names)})
    view = render_view(scene, camera, zero)
    assert_same_bits(view, render_view(scene, camera, recipe))
    assert view.masks.get("snow") is None or not view.masks["snow"].any()


@pytest.mark.long
@pytest.mark.parametrize("effect", EFFECTS)
@drawing(6)
@given(data=st.data())
def test_effects_without_strength_change_no_bit_of_another_effect(effect: str, data: st.DataObject):
    """Each effect as drawn, with and without the others at no strength."""
    place, camera = data.draw(places()), data.draw(cameras())
    recipe = data.draw(recipes(frozenset({effect})))
    others = sorted(set(ZEROS) - {effect})
    zero = with_effects(recipe, {name: data.draw(ZEROS[name]) for name in others})
    scene = place.scene()
    assert_same_bits(render_view(scene, camera, zero), render_view(scene, camera, recipe))


@pytest.mark.parametrize(
    "tier",
    ["sky", *(pytest.param(t, marks=pytest.mark.long) for t in ("screen_space", "mirrored"))],
)
def test_waves_without_height_are_still_water(tier: str):
    scene = Place(nothing(), sky=3, on_street=True).scene()
    camera = camera_at((0.0, 0.0, 1.2), pitch_deg=-20)
    flood = {"level_m": 0.2, "reflection": tier, "turbidity_ntu": 1.0}
    flat = {"direction_deg": 20.0, "amplitude_m": 0.0, "wavelength_m": 0.5, "steepness": 0.0}
    waves = ({"preset": "still"}, {"preset": "wind", "height": 0.0}, {"components": (flat,)})
    views = [
        render_view(scene, camera, with_effects(Recipe(), {"flood": {**flood, "waves": w}}))
        for w in waves
    ]
    assert views[0].masks["water"].any()
    for view in views[1:]:
        assert_same_bits(view, views[0])


def test_a_style_and_snow_without_strength_keep_a_recorded_exposure():
    """What comes last, a camera's colour map, is not touched by effects that do nothing."""
    import dataclasses

    scene = Place(nothing(), sky=3, on_street=True).scene()
    exposure = torch.tensor([[0.9, 0.1, 0.0, 0.02], [0, 1.1, 0, -0.3], [0, 0, 0.5, 0.4]])
    scene = dataclasses.replace(scene, color_maps={"extreme": exposure})
    camera = camera_at((0.0, 0.0, 1.2))
    zero = {"snow": {"depth_m": 0.0}, "style": {"preset": "dusk", "strength": 0.0}}
    view = render_view(scene, camera, with_effects(Recipe(), zero))
    assert_same_bits(view, render_view(scene, camera, Recipe()))
