"""Every number of a recipe at its ends makes a frame, or is refused in words; beyond, always."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import ValidationError

from recipes.errors import RecipeError
from recipes.load import parse_recipe
from recipes.schema import Recipe
from recipes.template import FieldSpec, Kind
from tests.augment.extremes import (
    CELL_M,
    Place,
    camera_at,
    ends_of,
    nothing,
    number_fields,
    numbers_beyond,
    numbers_of,
    rendered,
    street,
)

NUMBERS = number_fields()
# What a recipe needs besides the field in question, by section.
BESIDE: dict[str, dict[str, Any]] = {
    "weather.smog": {"extinction_per_m": 0.1},
    "weather.flood": {"level_m": 0.1},
    "weather.flood.waves.components[]": {"amplitude_m": 0.0, "wavelength_m": 1.0},
    "weather.snow": {"depth_m": 0.1, "cell_m": CELL_M},
    "style": {"preset": "dusk"},
}
INSTEAD = {
    "weather.smog.visibility_m": "extinction_per_m",
    "weather.flood.absorption_per_m": "turbidity_ntu",
}
# Settings that are not of a frame, or that a job replaces before there is one.
NOT_OF_FRAMES = ("quality", "output.jpeg_quality")
PLACEMENT = ("weather.snow.cell_m", "weather.snow.max_slope_deg")


def name_of(field: FieldSpec) -> str:
    return field.path.rpartition(".")[2]


def recipe_data(field: FieldSpec, value: Any) -> dict[str, Any]:
    """The mapping of the smallest recipe that gives the field this value."""
    data: dict[str, Any] = {"output": {"depth": "expected", "labels": False}}
    here, path = data, ""
    *above, name = field.path.split(".")
    for part in above:
        path = f"{path}.{part}" if path else part
        below = dict(BESIDE.get(path, {}))
        if part.endswith("[]"):
            here[part[:-2]] = [below]
        else:
            below = here.setdefault(part, {}) | below
            here[part] = below
        here = below
    here.pop(INSTEAD.get(field.path, ""), None)
    here[name] = value
    return data


def filled(field: FieldSpec, number: float) -> Any:
    """What stands in a file: the number, or three of it."""
    return number if field.channel is None else [number] * 3


def by_path(field: FieldSpec) -> str:
    return field.path


def test_numbers_beyond_their_limits_are_refused_by_name():
    cases = [(f, number) for f in NUMBERS for number in numbers_beyond(f.channel or f)]
    assert {f.path for f, _ in cases} == {f.path for f in NUMBERS}
    for field, number in cases:
        data = recipe_data(field, filled(field, number))
        with pytest.raises(ValidationError, match=name_of(field)):
            Recipe.model_validate(_tuples(data))
        with pytest.raises(RecipeError, match=name_of(field)):
            parse_recipe(_yaml(data), source="beyond.yaml")


def _tuples(data: Any) -> Any:
    """Lists as the tuples that recipes in numbers hold."""
    if isinstance(data, dict):
        return {key: _tuples(value) for key, value in data.items()}
    return tuple(map(_tuples, data)) if isinstance(data, list) else data


def _yaml(data: dict[str, Any]) -> str:
    text = json.dumps(data)
    for name, sign in (("NaN", ".nan"), ("-Infinity", "-.inf"), ("Infinity", ".inf")):
        text = text.replace(name, sign)
    return text


FRAMED = [f for f in NUMBERS if not f.path.startswith(NOT_OF_FRAMES) and f.path not in PLACEMENT]


@pytest.mark.long
@pytest.mark.parametrize("field", FRAMED, ids=by_path)
def test_each_number_at_its_ends_makes_a_frame_or_is_refused_in_words(field: FieldSpec):
    scene = Place(nothing(), sky=3, on_street=True).scene()
    camera = camera_at((0.0, 0.0, 1.2), pitch_deg=-20)
    made = 0
    for number in ends_of(field.channel or field):
        data = _tuples(recipe_data(field, filled(field, number)))
        try:
            recipe = Recipe.model_validate(data)
        except ValidationError as error:
            # A rule between fields: each number is allowed for itself.
            assert field.accepts(_tuples(filled(field, number)))
            assert name_of(field) in str(error)
            continue
        rendered(scene, camera, recipe)
        made += 1
    assert made


@pytest.mark.long
def test_all_numbers_at_their_lowest_and_all_at_their_highest_make_frames():
    scene = Place(nothing(), sky=3, on_street=True).scene()
    for end in (0, 1):
        data: dict[str, Any] = {"style": {"preset": "dusk"}, "output": {"depth": "expected"}}
        for field in NUMBERS:
            if field.path.startswith(("quality", "weather.flood.waves.components")):
                continue
            if field.path in (*INSTEAD, *PLACEMENT) or field.kind is Kind.TEXT:
                continue
            *above, name = field.path.split(".")
            here = data
            for part in above:
                here = here.setdefault(part, {})
            here[name] = filled(field, numbers_of(field.channel or field)[end])
        data["weather"]["snow"]["cell_m"] = CELL_M
        recipe = Recipe.model_validate(_tuples(data))
        rendered(scene, camera_at((0.0, 0.0, 1.2), pitch_deg=-20, size=(6, 4)), recipe)


@pytest.mark.long
@pytest.mark.parametrize("cell_m", [0.05, 10.0])
@pytest.mark.parametrize("max_slope_deg", [0.0, 85.0])
def test_snow_is_placed_at_extreme_settings(cell_m: float, max_slope_deg: float):
    snow = {"depth_m": 0.1, "cell_m": cell_m, "max_slope_deg": max_slope_deg}
    recipe = Recipe.model_validate({"weather": {"snow": snow}})
    rendered(street(), camera_at((0.0, 0.0, 1.2), pitch_deg=-20), recipe)
