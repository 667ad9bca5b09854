"""The recipe in numbers: strict types, rules between fields, hash, and the table of fields."""

from __future__ import annotations

import math
import operator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from recipes.flood import MAX_WAVES, Flood, Wave, Waves
from recipes.load import load_recipe, parse_recipe
from recipes.schema import Output, Quality, Recipe, Render, Smog, Weather
from recipes.snow import Snow, SnowLight, SnowWind
from recipes.style import Style
from recipes.template import CHANNEL, RATE, FieldSpec, Kind, root

FIELDS = [spec for section in root().walk() for spec in section.fields.values()]
NUMBERS = [spec for spec in FIELDS if spec.kind in (Kind.NUMBER, Kind.WHOLE)] + [CHANNEL, RATE]


def smoggy(**smog: Any) -> Recipe:
    return Recipe(weather=Weather(smog=Smog(**smog)))


REFUSED: dict[type, list[dict[str, Any]]] = {
    Smog: [
        {"visibility_m": True},
        {"visibility_m": "300"},
        {"visibility_m": math.nan},
        {"visibility_m": 0},
        {"visibility_m": 300, "visibility_km": 3},
        {"visibility_m": 300, "color": (0.5, 0.5, math.nan)},
        {"visibility_m": 300, "color": (0.5, 0.5)},
    ],
    Flood: [
        {},
        {"level_m": "1"},
        {"level_m": math.inf},
        {"level_m": 1, "depth_m": 1},
        {"level_m": 1, "absorption_per_m": (1, 1)},
        {"level_m": 1, "absorption_per_m": (1, 1, math.inf)},
        {"level_m": 1, "reference": "highest"},
    ],
    Waves: [
        {"count": 2.0},
        {"components": ({"amplitude_m": 0.1},)},
        {"components": (Wave(amplitude_m=0, wavelength_m=1),) * (MAX_WAVES + 1)},
    ],
    Wave: [{"amplitude_m": -0.1, "wavelength_m": 1}, {"amplitude_m": 0.1, "wavelength_m": 0}],
    Snow: [{}, {"depth_m": 1, "seed": -1}, {"depth_m": 1, "wind": None}],
    SnowLight: [{"sun": 1.1}, {"sun_azimuth_deg": True}],
    SnowWind: [{"drift": None}, {"speed_mps": 3}],
    Style: [
        {"preset": "dusk", "per_region": 1},
        {"preset": "dusk", "applied_to": "picture", "per_region": True},
        {"preset": "dusk", "colour": 1},
        {"preset": "dawn of nothing"},
        {"image": 3},
        {"image": "a.jpg", "digest": "F" * 64},
        {"image": "a.jpg", "digest": "0" * 63},
    ],
    Render: [{"sh_degree": 2.0}, {"antialiased": 1}],
    Output: [{"jpeg_quality": True}, {"image": "gif"}],
    Recipe: [
        *({"seed": -1}, {"seed": 2**63}, {"version": 2}, {"wether": {}}),
        *({"name": "../escape"}, {"name": "a/b"}, {"name": ""}, {"name": "a\n"}),
    ],
}


@pytest.mark.parametrize("model", REFUSED)
def test_the_models_are_strict_and_closed(model: type) -> None:
    for data in REFUSED[model]:
        with pytest.raises(ValidationError):
            model(**data)


@pytest.mark.parametrize(
    ("smog", "message"),
    [
        ({}, "needs a density: give visibility_m (metres) or extinction_per_m (1/metre)"),
        ({"visibility_m": 300, "extinction_per_m": 0.01}, "visibility_m and extinction_per_m both"),
        ({"visibility_m": 0.001}, "visibility_m = 0.001 means an extinction of 3.91e+03/metre"),
    ],
)
def test_the_density_is_given_once(smog: dict, message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Smog(**smog)
    assert message in str(caught.value)


def test_the_hash_is_pinned() -> None:
    """Output folders are resumed by it: it changes only with the format."""
    assert smoggy(visibility_m=300).hash == "272920d93c3e113c"
    assert Recipe().hash == "8553a2737c7b8e42"
    clean = Output(lidar=True)
    flooded, snowy = Weather(flood=Flood(level_m=0.2)), Weather(snow=Snow(depth_m=0.1))
    assert Recipe(weather=flooded, output=clean).hash == "efb12819c12b5307"
    assert Recipe(weather=snowy, output=clean).hash == "0b005b8e06d7eedd"
    assert Recipe(style=Style(preset="dusk")).hash == "535470ef48aaa9f4"


def test_recipes_from_before_floods_keep_their_hashes() -> None:
    """Every hash here is of the version before `weather.flood` and `output.surface`."""
    text = """
name: old
seed: 5
weather:
  smog:
    visibility_m: {uniform: [100, 500]}
    color: {uniform: [[0.6, 0.5, 0.4], [0.7, 0.6, 0.5]]}
    scale_height_m: 80
render: {scale: 0.5, exposure: neutral}
output: {semantic: true, image: jpg}
"""
    assert parse_recipe(text, source="old").resolve(3).hash == "031828409378fcb4"
    before = {
        "brown-smog": "74e961af5b7d3fe0",
        "clear": "205ce53115366998",
        "dense-fog": "d7f20162c99b23fc",
        "light-haze": "2f5fabf9fcad2c3e",
    }
    assert {name: load_recipe(name).resolve(0).hash for name in before} == before


def test_recipes_from_before_snow_keep_their_hashes() -> None:
    """Floods were resumed by these when `output.surface` was `scene` where nothing was said."""
    before = {
        "deep-flood": "172bb044982a1589",
        "puddled": "602327c5f75e697a",
        "street-flood": "8e0fcd6fb1df7b39",
    }
    old = {"output": Output(lidar=True)}  # what they said of LiDAR where nothing was said
    recipes = {name: load_recipe(name).resolve(0).model_copy(update=old) for name in before}
    assert {name: recipe.hash for name, recipe in recipes.items()} == before
    first = Output(surface="first", lidar=True)
    flooded = Recipe(weather=Weather(flood=Flood(level_m=0.2)), output=first)
    assert flooded.hash == "cac7905aab0116ca"


def test_auto_weathers_lidar_where_the_depth_images_show_a_surface_of_the_weather() -> None:
    """Recipes whose sweeps are as before keep their hashes; others are not mixed with them."""
    smog, flood, snow = Smog(visibility_m=300), Flood(level_m=0.2), Snow(depth_m=0.1)
    no_snow = [Snow(depth_m=0), Snow(depth_m=0.1, coverage=0)]
    snow_depth, water_depth = "snow 0.1 m deep in images and", "water in images and"
    for weather, surface, lidar, note in (
        (Weather(), "solid", "clean", None),
        (Weather(smog=smog), "first", "clean", None),
        *((Weather(snow=each), "solid", "clean", None) for each in no_snow),
        (Weather(smog=smog, snow=snow), "solid", "weather", None),
        (Weather(snow=snow), "first", "weather", None),
        (Weather(snow=snow), "scene", "clean", "snow 0.1 m deep in images, not in depth or sweeps"),
        (Weather(flood=flood), "solid", "weather", f"{water_depth} sweeps, not in depth"),
        (Weather(flood=flood), "first", "weather", None),
        (Weather(flood=flood), "scene", "clean", "water in images, not in depth or sweeps"),
    ):
        recipe = Recipe(weather=weather, output=Output(surface=surface))
        said = recipe.lidar_note(recipe.lidar)
        expected = note and f"{note} (output: {{lidar: auto, surface: {surface}}})"
        assert (recipe.lidar, said) == (lidar, expected), (weather, surface)
        plain = Recipe(weather=weather, output=Output(surface=surface, lidar=True))
        assert (recipe.hash == plain.hash) == (lidar == "clean")
        for kind in (False, "weather"):
            other = Recipe(weather=weather, output=Output(surface=surface, lidar=kind))
            assert other.lidar == (kind or None) and other.hash not in (recipe.hash, plain.hash)
    clean = Recipe(weather=Weather(flood=flood, snow=snow), output=Output(lidar=True))
    assert clean.lidar_note("clean") == (
        f"{snow_depth} depth, not in sweeps; water in images, not in depth or sweeps "
        "(output: {lidar: true, surface: solid})"
    )
    assert clean.lidar_note(None) is None
    forced = Recipe(
        weather=Weather(snow=snow), output=Output(lidar="weather", surface="scene", depth="none")
    )
    assert forced.lidar_note("weather") is None  # there is no depth to disagree


# what stands in place of another field, or changes nothing by itself
ELSEWHERE = {"version", "weather.smog.extinction_per_m", "weather.flood.absorption_per_m"}
ELSEWHERE |= {"style.image", "style.preset", "style.mask", "style.checkpoint", "quality.settled"}
CANDIDATES = (0, 1, 2, 0.5, 0.1, True, False, "other", "1" * 64, (0.1, 0.2, 0.3))


def test_every_field_changes_the_hash() -> None:
    wave = Wave(amplitude_m=0.01, wavelength_m=1.0)
    flood = Flood(level_m=0.2, waves=Waves(components=(wave,)))
    smog, snow = Smog(visibility_m=300), Snow(depth_m=0.1)
    weather = Weather(smog=smog, flood=flood, snow=snow)
    base = Recipe(weather=weather, style=Style(image="a.png", digest="0" * 64))
    cleared = flood.model_copy(update={"absorption_per_m": (1.0, 1.0, 1.0)})
    hashes = {base.hash, smoggy(extinction_per_m=0.01).hash}
    hashes.add(Recipe(weather=Weather(smog=smog, flood=cleared, snow=snow)).hash)
    hashes.add(base.model_copy(update={"quality": Quality(max_flip=0.1, settled=True)}).hash)
    hashes |= {Recipe(weather=weather, style=style).hash for style in (None, Style(preset="dusk"))}
    changed = [spec for spec in FIELDS if spec.path not in ELSEWHERE]
    for spec in changed:
        data = base.model_dump()
        *sections, name = spec.path.split(".")
        inner = data
        for section in sections:
            key = section.removesuffix("[]")
            inner = inner[key] if key == section else inner[key][0]
        accepted = (value for value in (*spec.words, *CANDIDATES) if spec.accepts(value))
        inner[name] = next(value for value in accepted if value != inner[name])
        hashes.add(Recipe.model_validate(data).hash)
    assert len(hashes) == len(changed) + 6
    scene = Recipe(output=Output(surface="scene"))
    assert len({scene.hash, Recipe().hash, Recipe(output=Output(surface="first")).hash}) == 3


def test_numbers_for_the_manifest() -> None:
    clear = Recipe().columns()
    assert clear["smog_extinction_per_m"] == 0 and math.isnan(clear["smog_scale_height_m"])
    thick = smoggy(extinction_per_m=0.02, scale_height_m=50).columns()
    assert (thick["smog_extinction_per_m"], thick["smog_scale_height_m"]) == (0.02, 50.0)
    flooded = Recipe(weather=Weather(flood=Flood(level_m=0.2))).columns()
    assert clear.keys() == thick.keys() == flooded.keys()
    names = ("flood_level_m", "flood_turbidity_ntu", "flood_wave_height")
    assert all(math.isnan(clear[name]) and math.isnan(thick[name]) for name in names)
    assert [flooded[name] for name in names] == [0.2, 50.0, 1.0]
    snowy = Recipe(weather=Weather(snow=Snow(depth_m=0.1, coverage=0.7))).columns()
    assert snowy.keys() == clear.keys() and all(math.isnan(snowy[name]) for name in names)
    assert (snowy["snow_depth_m"], snowy["snow_coverage"]) == (0.1, 0.7)
    absent = [
        n[name] for n in (clear, thick, flooded) for name in ("snow_depth_m", "snow_coverage")
    ]
    assert all(map(math.isnan, absent))


def test_a_style_for_the_manifest() -> None:
    assert Recipe().columns()["style_strength"] == 0
    names = ("style", "style_method")
    assert [Recipe().columns()[name] for name in names] == [None, None]
    dusk = Recipe(style=Style(preset="dusk", strength=0.5))
    assert dusk.columns()["style_strength"] == 0.5
    assert [dusk.columns()[name] for name in names] == ["dusk", "mkl"]
    photo = Recipe(style=Style(image="/photos/sunset 3.jpg", method="reinhard"))
    assert [photo.columns()[name] for name in names] == ["sunset 3.jpg", "reinhard"]


def test_every_field_is_described() -> None:
    for spec in FIELDS:
        assert spec.description.endswith("."), spec.path


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    spec=st.sampled_from(NUMBERS),
    value=st.one_of(st.floats(), st.integers(), st.sampled_from([0, 1, 100, 4, 0.9999, 2**63])),
)
def test_the_limits_in_messages_are_those_of_the_schema(spec: FieldSpec, value: float) -> None:
    compare = {">": operator.gt, ">=": operator.ge, "<": operator.lt, "<=": operator.le}
    inside = all(compare[sign](value, bound) for sign, bound in spec.limits)
    right_type = spec.kind is Kind.NUMBER or isinstance(value, int)
    assert spec.accepts(value) == (inside and right_type)
