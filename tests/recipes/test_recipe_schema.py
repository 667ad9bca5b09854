"""The recipe in numbers: strict types, rules between fields, hash, and the table of fields."""

from __future__ import annotations

import json
import math
import operator
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from recipes.errors import RecipeError
from recipes.flood import MAX_WAVES, Flood, Wave, Waves
from recipes.json_schema import recipe_json_schema, write_schema
from recipes.lens_drops import LensDrops
from recipes.light import Light, ListedLamp
from recipes.load import dump_recipe, load_recipe, parse_recipe, preset_names
from recipes.moment import Air
from recipes.rain import Rain, RoadWater
from recipes.ranges import format_value
from recipes.schema import Category, Output, Quality, Recipe, Render, Sensor, Smog, Weather
from recipes.sections import Leaf, recipe_file
from recipes.shower import RateAtPlace
from recipes.snow import Snow, SnowLight, SnowRoad, SnowWind
from recipes.snowfall import Snowfall
from recipes.speed import Speed
from recipes.style import Style, style_preset_names

FIELDS = [
    section.leaves[name]
    for section in recipe_file().walk()
    for name in section.model.model_fields
    if name in section.leaves
]
NUMBERS = [part for leaf in FIELDS if (part := leaf.channel or leaf).is_number]


def smoggy(**smog: Any) -> Recipe:
    return Recipe(weather=Weather(smog=Smog(**smog)))


REFUSED: dict[type, list[dict[str, Any]]] = {
    Rain: [
        {},
        {"rate_mm_h": -1e-9},
        {"rate_mm_h": 301.0},
        {"rate_mm_h": math.nan},
        {"rate_mm_h": 5.0, "wind_mps": 60.1},
        {"rate_mm_h": 5.0, "wind_mps": -1.0},
        {"rate_mm_h": 5.0, "wind_from_deg": 400},
        {"rate_mm_h": 5.0, "wetness": 1.01},
        {"rate_mm_h": 5.0, "puddles": -0.1},
    ],
    Snowfall: [
        {},
        {"rate_mm_h": -1.0},
        {"rate_mm_h": 51.0},
        {"rate_mm_h": 1.0, "turbulence_mps": -0.1},
        {"rate_mm_h": 1.0, "wind_mps": math.inf},
    ],
    Sensor: [{"exposure_ms": 0}, {"exposure_ms": -5.0}, {"exposure_ms": 100.1}],
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
    Render: [{"sh_degree": 2.0}],
    Speed: [{"antialiased": 1}, {"rain_min_width_px": 0}],
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
        ({"visibility_m": 300, "mor_m": 80}, "visibility_m and mor_m both give the density"),
        ({"mor_m": 0.01, "scatter": 1.0}, "mor_m = 0.01 means an extinction of 150/metre"),
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
    before = {"clear": "205ce53115366998", "light-haze": "2f5fabf9fcad2c3e"}
    assert {name: load_recipe(name).resolve(0).hash for name in before} == before


def test_recipes_from_before_snow_keep_their_hashes() -> None:
    """Floods were resumed by these when `output.surface` was `scene` where nothing was said."""
    before = {"deep-flood": "172bb044982a1589", "street-flood": "8e0fcd6fb1df7b39"}
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
ELSEWHERE |= {
    "weather.smog.mor_m",
    "camera.lens_drops.share",
    "style.image",
    "style.preset",
    "style.mask",
    "style.checkpoint",
    "light.street_ies",
    "render.speed.settled",
}
CANDIDATES = (0, 1, 2, 0.5, 0.1, True, False, "other", "1" * 64, (0.1, 0.2, 0.3), 10, 2000)


def test_every_field_changes_the_hash() -> None:
    wave = Wave(amplitude_m=0.01, wavelength_m=1.0)
    flood = Flood(level_m=0.2, waves=Waves(components=(wave,)))
    smog = Smog(visibility_m=300)
    snow = Snow(depth_m=0.1, road=SnowRoad())
    along = (RateAtPlace(distance_m=5, rate_mm_h=5),)
    rain = Rain(rate_mm_h=5.0, along=along, road=RoadWater())
    snowfall = Snowfall(rate_mm_h=1.0, along=along)
    weather = Weather(smog=smog, flood=flood, snow=snow, rain=rain, snowfall=snowfall, air=Air())
    camera = Sensor(lens_drops=LensDrops(count=5))
    style = Style(image="a.png", digest="0" * 64)
    output = Output(categories=(Category(label="car", name="Car"),))
    lamp = ListedLamp(x_m=0, y_m=5, z_m=6, candela=100)
    light = Light(street_ies="a.ies", digest="0" * 64, lamps=(lamp,))
    base = Recipe(weather=weather, style=style, light=light, camera=camera, output=output)
    cleared = flood.model_copy(update={"absorption_per_m": (1.0, 1.0, 1.0)})
    hashes = {base.hash, smoggy(extinction_per_m=0.01).hash, smoggy(mor_m=300).hash}
    hashes.add(base.model_copy(update={"camera": Sensor()}).hash)
    hashes.add(Recipe(camera=Sensor(lens_drops=LensDrops(share=0.1))).hash)
    hashes.add(
        Recipe(
            weather=Weather(smog=smog, flood=cleared, snow=snow, rain=rain, snowfall=snowfall)
        ).hash
    )
    settled = {"quality": Quality(max_flip=0.1), "render": Render(speed=Speed(settled=True))}
    hashes.add(base.model_copy(update=settled).hash)
    hashes |= {Recipe(weather=weather, style=style).hash for style in (None, Style(preset="dusk"))}
    changed = [spec for spec in FIELDS if spec.path not in ELSEWHERE]
    for spec in changed:
        data = base.model_dump()
        *sections, name = spec.path.split(".")
        inner = data
        for section in sections:
            key = section.removesuffix("[]")
            inner = inner[key] if key == section else inner[key][0]
        accepted = (value for value in (*spec.allowed_words, *CANDIDATES) if spec.accepts(value))
        inner[name] = next(value for value in accepted if value != inner[name])
        hashes.add(Recipe.model_validate(data).hash)
    assert len(hashes) == len(changed) + 9
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
def test_the_limits_in_messages_are_those_of_the_schema(spec: Leaf, value: float) -> None:
    compare = {">": operator.gt, ">=": operator.ge, "<": operator.lt, "<=": operator.le}
    inside = all(compare[sign](value, bound) for sign, bound in spec.limits)
    right_type = spec.kind is float or isinstance(value, int)
    assert spec.accepts(value) == (inside and right_type)


@pytest.fixture(scope="module")
def validator() -> Any:
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    schema = recipe_json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_every_field_is_in_the_schema_with_its_description() -> None:
    schema = recipe_json_schema()
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    for section in recipe_file().walk():
        node = schema["$defs"][section.model.__name__] if section.path else schema
        node = node.get("anyOf", [node])[0]  # quality takes a word, too
        assert node["additionalProperties"] is False
        assert set(node["properties"]) == set(section.keys)
        required = [name for name, leaf in section.leaves.items() if leaf.info.is_required()]
        assert node.get("required", []) == required
        for name, leaf in section.leaves.items():
            assert leaf.description in node["properties"][name]["description"]
    visibility = schema["$defs"]["Smog"]["properties"]["visibility_m"]
    assert visibility["description"].endswith("[metres]")


def test_the_file_is_the_schema(tmp_path: Path) -> None:
    write_schema(tmp_path / "recipe.schema.json")
    text = (tmp_path / "recipe.schema.json").read_text(encoding="utf-8")
    assert json.loads(text) == recipe_json_schema() and text.endswith("}\n")


def test_files_are_named_as_text(validator: Any) -> None:
    for style in (
        {"image": "a.jpg", "mask": "looks/sky.png", "digest": "0" * 64},
        {"image": {"choice": ["a.jpg", "b.jpg"]}, "method": "gscm", "checkpoint": None},
    ):
        validator.validate({"style": style})


@pytest.mark.parametrize("name", preset_names())
def test_presets_and_what_is_drawn_from_them_are_valid(name: str, validator: Any) -> None:
    preset = Path(__file__).parents[2] / "recipes" / "presets" / f"{name}.yaml"
    validator.validate(yaml.safe_load(preset.read_text(encoding="utf-8")))
    validator.validate(yaml.safe_load(dump_recipe(load_recipe(name).resolve(0))))


SMOG = {"visibility_m": 300.0}


def with_smog(**fields: Any) -> dict:
    return {"weather": {"smog": {**SMOG, **fields}}}


def with_flood(**fields: Any) -> dict:
    return {"weather": {"flood": {"level_m": 0.2, **fields}}}


def with_waves(*components: Any) -> dict:
    return with_flood(waves={"components": list(components)})


def with_style(**fields: Any) -> dict:
    return {"style": {"preset": "dusk", **fields}}


def with_snow(**fields: Any) -> dict:
    return {"weather": {"snow": {"depth_m": 0.1, **fields}}}


WAVE = {"amplitude_m": 0.02, "wavelength_m": 2.0}


@pytest.mark.parametrize(
    "data",
    [
        {},
        {"weather": None},
        {"name": 2024, "seed": 3, "variants": 2},
        with_smog(probability=0.5),
        with_smog(visibility_m={"log_uniform": [1.0, 2.0]}),
        with_smog(visibility_m={"normal": {"mean": 2.0, "std": 1.0, "min": 1.0, "max": 3.0}}),
        with_smog(scale_height_m={"choice": [None, 5.0, {"uniform": [1.0, 2.0]}]}),
        with_smog(
            visibility_m={"timeline": [[-3, 50], [{"uniform": [0, 1]}, {"choice": [60, 70]}]]}
        ),
        with_smog(
            visibility_m={"timeline": [[0, 50], [1, 9]], "shape": "smooth", "times": "share"}
        ),
        with_smog(scale_height_m={"choice": [None, {"timeline": [[0, 50.0], [1, 9.0]]}]}),
        with_snow(tracks={"timeline": [[0, "never"], [2, "always"]], "shape": "step"}),
        {
            "weather": {
                "air": {"humidity": {"timeline": [[0, 0.9], [60, 0.4]]}},
                "clock": {"speed": 60},
            }
        },
        with_smog(color=[0.5, {"uniform": [0.0, 1.0]}, {"choice": [0.5]}]),
        with_smog(color={"uniform": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]}),
        with_smog(model={"choice": ["deferred"], "weights": [2.0]}),
        {"output": {"jpeg_quality": {"uniform": [1, 2]}, "lidar": {"choice": [True, False]}}},
        with_flood(),
        with_flood(turbidity_ntu=3, absorption_per_m=None),
        with_flood(turbidity_ntu=None, absorption_per_m=[0.0, 1e6, {"log_uniform": [1.0, 2.0]}]),
        with_flood(absorption_per_m={"uniform": [[0.0, 0.0, 0.0], [9.0, 9.0, 9.0]]}),
        with_flood(waves={"components": None, "seed": None}),
        with_waves(),
        with_waves(WAVE, {**WAVE, "steepness": {"uniform": [0.0, 0.5]}}),
        with_snow(),
        with_snow(light=None, wind=None),
        with_snow(light={"sun": {"choice": [None, {"uniform": [0.0, 1.0]}]}, "brightness": None}),
        with_snow(tracks={"choice": ["auto", "never"]}, shading="per_pixel", cell_m=0.001),
        with_style(),
        with_style(preset={"choice": ["dusk", "dusk"]}, probability=0.5, image=None, digest=None),
        with_style(strength={"uniform": [0.0, 2.0]}, per_region={"choice": [True, False]}),
    ],
)
def test_both_accept(data: dict, validator: Any) -> None:
    parse_recipe(json.dumps(data), source="json")
    validator.validate(data)


@pytest.mark.parametrize(
    "data",
    [
        {"wether": {}},
        {"version": 2},
        {"seed": {"choice": [1]}},
        {"weather": 3},
        {"weather": {"smog": {}}},
        with_smog(extinction_per_m=0.1),
        with_smog(visibility_km=3),
        with_smog(visibility_m="300"),
        with_smog(visibility_m={"uniform": [0.0, 1.0]}),
        with_smog(visibility_m={"uniform": [None, 1.0]}),
        with_smog(visibility_m={"unifrom": [1.0, 2.0]}),
        with_smog(visibility_m={"choice": []}),
        with_smog(visibility_m={"timeline": []}),
        with_smog(visibility_m={"timeline": [[0, 0.0], [1, 5.0]]}),
        with_smog(visibility_m={"timeline": [[0, None], [1, 5.0]]}),
        with_smog(visibility_m={"timeline": [[0, 3.0, 4.0]]}),
        with_smog(visibility_m={"timeline": [[0, 3.0], ["late", 5.0]]}),
        with_smog(visibility_m={"timeline": [[0, 3.0], [1, 5.0]], "shape": "round"}),
        with_smog(visibility_m={"timeline": [[0, 3.0], [1, 5.0]], "times": "minutes"}),
        with_smog(color={"timeline": [[0, [0.1, 0.1, 0.1]], [1, [0.5, 0.5, 0.5]]]}),
        with_snow(cell_m={"timeline": [[0, 0.1], [1, 0.2]]}),
        with_snow(tracks={"timeline": [[0, "never"], [2, "always"]], "shape": "linear"}),
        {"render": {"scale": {"timeline": [[0, 1.0], [1, 0.5]]}}},
        {"timelines": []},
        with_smog(base_height_m={"log_uniform": [0.0, 2.0]}),
        with_smog(base_height_m={"normal": {"mean": 1.0, "std": 0.0, "min": 0.0, "max": 2.0}}),
        with_smog(color={"log_uniform": [[0.1, 0.1, 0.1], [1.0, 1.0, 1.0]]}),
        with_smog(model="fast"),
        {"render": {"sh_degree": 1.5}},
        {"weather": {"flood": {"level_m": None}}},
        with_flood(turbidity_ntu=3, absorption_per_m=[1.0, 1.0, 1.0]),
        with_flood(absorption_per_m={"normal": {"mean": 1, "std": 1, "min": 0, "max": 2}}),
        with_flood(waves="calm"),
        with_flood(waves={"components": {"choice": [[WAVE]]}}),
        with_waves({**WAVE, "speed_mps": 2}),
        with_waves(*[WAVE] * 65),
        with_snow(depth_m=None),
        with_snow(coverage={"uniform": [0.5, 1.5]}),
        with_snow(wind={"drift": None}),
        {"style": {}},
        {"style": "dusk"},
        {"style": {"image": "/a.jpg"}},
        {"style": {"image": "a\\b.jpg"}},
        {"weather": with_style()},
        with_style(preset="no such style"),
        with_style(digest="0"),
        with_style(digest={"choice": [None]}),
    ],
)
def test_both_refuse(data: dict, validator: Any) -> None:
    with pytest.raises(RecipeError):
        parse_recipe(json.dumps(data), source="json")
    assert not validator.is_valid(data)


PAGE = (Path(__file__).parents[2] / "docs" / "recipes.md").read_text(encoding="utf-8")


SPEED = """
## Speed

`render.speed` holds settings of the renderer that trade accuracy for speed, and the mark of a \
choice that a job has made. `quality` sets most of them, so that few recipes have this section. A \
field that a recipe gives keeps its value under every `quality`. Up to version 0.6 these were \
fields of `render`, `weather.flood`, `weather.rain`, `weather.snowfall` and `quality`. A recipe \
with a former name is refused, and the message has the new name.

"""


def field_table() -> str:
    """A row for every key of a recipe file, sections in their order, `render.speed` at the end."""
    speed = recipe_file().sections["render"].sections["speed"]
    sections = [section for section in recipe_file().walk() if section is not speed]
    return f"{table_of(sections)}{SPEED}{table_of([speed])}"


def table_of(sections: list[Any]) -> str:
    rows = ["| Field | Allowed | Default | Meaning |\n| --- | --- | --- | --- |\n"]
    for section in sections:
        if section.max_items is not None:
            path = section.path.removesuffix("[]")
            allowed = f"a list of up to {section.max_items} mappings, or null"
            rows.append(f"| `{path}` | {allowed} | `null` | {section.list_description} |\n")
        for name, spec in section.leaves.items():
            if name == "probability":  # told once, above the table
                continue
            default = spec.info.get_default()
            known = "" if default is None else f"`{format_value(default)}`"
            default = "`null`" if spec.nullable else known
            default = "required" if spec.info.is_required() else default
            allowed = spec.describe_allowed_values()
            rows.append(f"| `{spec.path}` | {allowed} | {default} | {spec.description} |\n")
    return "".join(rows)


def test_the_table_of_fields_is_the_schemas() -> None:
    """To renew it, replace the end of the page by field_table()."""
    assert PAGE.endswith(field_table())


def test_every_preset_is_described() -> None:
    for name in preset_names():
        assert f"\n| `{name}` |" in PAGE


def test_every_style_is_described() -> None:
    section = PAGE.partition("\n## Style\n")[2].partition("\n## ")[0]
    assert re.findall(r"\n\| `(.*?)` \| [a-z]", section) == list(style_preset_names())


def test_the_examples_load(tmp_path: Path) -> None:
    (tmp_path / "looks").mkdir()
    for name in ("sunset.jpg", "looks/harbour.png"):
        (tmp_path / name).write_bytes(b"")
    examples = re.findall(r"```yaml\n(.*?)```", PAGE, flags=re.DOTALL)
    assert len(examples) >= 2
    for example in examples:
        template = parse_recipe(example, source="docs", folder=tmp_path)
        for variant in range(template.variants):
            template.resolve(variant)


def test_the_ranges_of_the_table_load() -> None:
    ranges = re.findall(r"\| `(\{.*?\})` \|", PAGE)
    assert len(ranges) == 5
    for text in ranges:
        parse_recipe(f"weather: {{smog: {{visibility_m: {text}}}}}", source="docs").resolve(0)


def test_the_messages_are_those_of_the_loader() -> None:
    text = (
        "version: 1\nseed: 7\nvariants: 4\nweather:\n  smog:\n    visibility_km: 3\n"
        "    color: [194, 0.5, 0.5]\n    scale_height_m: {uniform: [0, 10]}\n"
    )
    with pytest.raises(RecipeError) as caught:
        parse_recipe(text, source="foggy.yaml")
    assert f"```\n{caught.value}\n```" in PAGE
