"""Whole frames of extreme scenes, cameras and recipes: what tests/augment/extremes.py promises."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from augment.cameras import Camera
from recipes.schema import Recipe
from tests.augment.examples import drawing
from tests.augment.extremes import (
    PAIRS,
    Place,
    cameras,
    places,
    recipes,
    rendered,
)


@drawing(60)
@given(places(), cameras(), recipes())
def test_any_scene_from_anywhere_in_any_weather(place: Place, camera: Camera, recipe: Recipe):
    rendered(place.scene(), camera, recipe)


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: "-".join(sorted(pair)))
@drawing(10)
@given(data=st.data())
def test_every_pair_of_effects(pair: frozenset[str], data: st.DataObject):
    rendered(data.draw(places()).scene(), data.draw(cameras()), data.draw(recipes(pair)))
