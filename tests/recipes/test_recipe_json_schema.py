"""The JSON Schema agrees with the loader."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from recipes.errors import RecipeError
from recipes.json_schema import DIALECT, recipe_json_schema, write_schema
from recipes.load import dump_recipe, load_recipe, parse_recipe, preset_names
from recipes.template import root


@pytest.fixture(scope="module")
def validator() -> Any:
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    schema = recipe_json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_every_field_is_in_the_schema_with_its_description() -> None:
    schema = recipe_json_schema()
    assert schema["$schema"] == DIALECT
    for section in root().walk():
        node = schema
        for name in filter(None, section.path.split(".")):
            node = node["properties"][name.removesuffix("[]")]["oneOf"][0]
            if name.endswith("[]"):
                assert node["description"].endswith("."), name
                node = node["items"]
        assert node["additionalProperties"] is False
        assert set(node["properties"]) == set(section.known)
        required = [name for name, spec in section.fields.items() if spec.required]
        assert node.get("required", []) == required
        for name, spec in section.fields.items():
            if name != "version":
                assert spec.description in node["properties"][name]["description"]
    visibility = schema["properties"]["weather"]["oneOf"][0]["properties"]["smog"]["oneOf"][0]
    assert visibility["properties"]["visibility_m"]["description"].endswith("[metres]")


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
