"""The recipe in numbers: strict types, rules between fields, hash, and the table of fields."""

from __future__ import annotations

import math
import operator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from recipes.fields import ROOT, FieldSpec, Kind
from recipes.schema import KOSCHMIEDER, Output, Recipe, Render, Smog, Weather

FIELDS = [spec for section in ROOT.walk() for spec in section.fields.values()]


def smoggy(**smog: Any) -> Recipe:
    return Recipe(weather=Weather(smog=Smog(**smog)))


@pytest.mark.parametrize(
    ("model", "data"),
    [
        (Smog, {"visibility_m": True}),
        (Smog, {"visibility_m": "300"}),
        (Smog, {"visibility_m": math.nan}),
        (Smog, {"visibility_m": math.inf}),
        (Smog, {"visibility_m": 0}),
        (Smog, {"visibility_m": 300, "visibility_km": 3}),
        (Smog, {"extinction_per_m": -0.1}),
        (Smog, {"visibility_m": 300, "color": (0.5, 0.5, math.nan)}),
        (Smog, {"visibility_m": 300, "color": (0.5, 0.5, 1.1)}),
        (Smog, {"visibility_m": 300, "color": (0.5, 0.5)}),
        (Smog, {"visibility_m": 300, "scale_height_m": 0}),
        (Render, {"sh_degree": 2.0}),
        (Render, {"antialiased": 1}),
        (Output, {"jpeg_quality": True}),
        (Output, {"image": "gif"}),
        (Recipe, {"seed": -1}),
        (Recipe, {"seed": 2**63}),
        (Recipe, {"name": "../escape"}),
        (Recipe, {"name": "a/b"}),
        (Recipe, {"name": ""}),
        (Recipe, {"name": "a\n"}),
        (Recipe, {"version": 2}),
        (Recipe, {"wether": {}}),
    ],
)
def test_the_models_are_strict_and_closed(model: type, data: dict) -> None:
    with pytest.raises(ValidationError):
        model(**data)


@pytest.mark.parametrize(
    ("smog", "message"),
    [
        ({}, "needs a density: give visibility_m (metres) or extinction_per_m (1/metre)"),
        (
            {"visibility_m": 300, "extinction_per_m": 0.01},
            "visibility_m and extinction_per_m both give the density: keep one of them",
        ),
        ({"visibility_m": 0.001}, "visibility_m = 0.001 means an extinction of 3.91e+03/metre"),
    ],
)
def test_the_density_is_given_once(smog: dict, message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Smog(**smog)
    assert message in str(caught.value)


def test_extinction_from_visibility() -> None:
    assert Smog(visibility_m=300).sigma_per_m == KOSCHMIEDER / 300
    assert Smog(extinction_per_m=0.02).sigma_per_m == 0.02
    # visibility is where 2 % of the contrast is left
    assert math.exp(-Smog(visibility_m=300).sigma_per_m * 300) == pytest.approx(0.02, rel=1e-3)


def test_models_are_immutable() -> None:
    recipe = smoggy(visibility_m=300)
    with pytest.raises(ValidationError):
        recipe.seed = 3  # type: ignore
    assert hash(recipe.weather.smog) == hash(smoggy(visibility_m=300).weather.smog)


def test_the_hash_is_pinned() -> None:
    """Output folders are resumed by it: it changes only with the format."""
    assert smoggy(visibility_m=300).hash == "272920d93c3e113c"
    assert Recipe().hash == "8553a2737c7b8e42"


def test_the_hash_does_not_depend_on_how_a_number_was_written() -> None:
    assert smoggy(visibility_m=300).hash == smoggy(visibility_m=300.0).hash


OTHER = {
    "version": None,  # there is one version only
    "name": "other",
    "seed": 1,
    "variant": 1,
    "weather.smog.visibility_m": 301,
    "weather.smog.extinction_per_m": None,  # in place of visibility: below
    "weather.smog.color": (0.76, 0.78, math.nextafter(0.8, 1)),
    "weather.smog.scale_height_m": 100,
    "weather.smog.base_height_m": 1,
    "weather.smog.model": "deferred",
    "render.scale": 0.5,
    "render.near_m": 0.02,
    "render.alpha_max": 0.99,
    "render.antialiased": True,
    "render.sh_degree": 0,
    "render.exposure": "neutral",
    "output.image": "jpg",
    "output.jpeg_quality": 91,
    "output.depth": "none",
    "output.semantic": True,
    "output.instance": True,
    "output.lidar": False,
    "output.labels": False,
}


def test_every_field_changes_the_hash() -> None:
    assert OTHER.keys() == {spec.path for spec in FIELDS}, "a new field needs a value here"
    base = smoggy(visibility_m=300).model_dump()
    hashes = {Recipe.model_validate(base).hash, smoggy(extinction_per_m=0.01).hash}
    changes = {path: value for path, value in OTHER.items() if value is not None}
    for path, value in changes.items():
        data = smoggy(visibility_m=300).model_dump()
        *sections, name = path.split(".")
        inner = data
        for section in sections:
            inner = inner[section]
        inner[name] = value
        hashes.add(Recipe.model_validate(data).hash)
    assert len(hashes) == len(changes) + 2


def test_numbers_for_the_manifest() -> None:
    clear = Recipe().weather_numbers()
    assert clear["smog_extinction_per_m"] == 0 and math.isnan(clear["smog_scale_height_m"])
    thick = smoggy(extinction_per_m=0.02, scale_height_m=50).weather_numbers()
    assert thick == {"smog_extinction_per_m": 0.02, "smog_scale_height_m": 50.0}


def test_every_field_is_described() -> None:
    for spec in FIELDS:
        assert spec.description.endswith("."), spec.path


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    spec=st.sampled_from([spec for spec in FIELDS if spec.kind in (Kind.NUMBER, Kind.WHOLE)]),
    value=st.one_of(st.floats(), st.integers(), st.sampled_from([0, 1, 100, 4, 0.9999, 2**63])),
)
def test_the_limits_in_messages_are_those_of_the_schema(spec: FieldSpec, value: float) -> None:
    compare = {">": operator.gt, ">=": operator.ge, "<": operator.lt, "<=": operator.le}
    inside = all(compare[sign](value, bound) for sign, bound in spec.limits)
    right_type = spec.kind is Kind.NUMBER or isinstance(value, int)
    assert spec.accepts(value) == (inside and right_type)
