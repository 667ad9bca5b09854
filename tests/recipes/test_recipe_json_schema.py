"""The JSON Schema agrees with the loader."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from recipes.dump import dump_recipe
from recipes.errors import RecipeError
from recipes.fields import ROOT
from recipes.json_schema import DIALECT, recipe_json_schema, write_schema
from recipes.load import load_recipe, preset_names
from recipes.parse import parse_recipe


@pytest.fixture(scope="module")
def validator() -> Any:
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    schema = recipe_json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_every_field_is_in_the_schema_with_its_description() -> None:
    schema = recipe_json_schema()
    assert schema["$schema"] == DIALECT
    for section in ROOT.walk():
        node = schema
        for name in filter(None, section.path.split(".")):
            node = node["properties"][name]["oneOf"][0]
        assert node["additionalProperties"] is False
        assert set(node["properties"]) == set(section.known)
        for name, spec in section.fields.items():
            if name != "version":
                assert spec.description in node["properties"][name]["description"]
    visibility = schema["properties"]["weather"]["oneOf"][0]["properties"]["smog"]["oneOf"][0]
    assert visibility["properties"]["visibility_m"]["description"].endswith("[metres]")


def test_the_file_is_the_schema(tmp_path: Path) -> None:
    write_schema(tmp_path / "recipe.schema.json")
    text = (tmp_path / "recipe.schema.json").read_text(encoding="utf-8")
    assert json.loads(text) == recipe_json_schema() and text.endswith("}\n")


@pytest.mark.parametrize("name", preset_names())
def test_presets_and_what_is_drawn_from_them_are_valid(name: str, validator: Any) -> None:
    preset = Path(__file__).parents[2] / "recipes" / "presets" / f"{name}.yaml"
    validator.validate(yaml.safe_load(preset.read_text(encoding="utf-8")))
    validator.validate(yaml.safe_load(dump_recipe(load_recipe(name).resolve(0))))


SMOG = {"visibility_m": 300.0}


def with_smog(**fields: Any) -> dict:
    return {"weather": {"smog": {**SMOG, **fields}}}


@pytest.mark.parametrize(
    "data",
    [
        {},
        {"weather": None},
        {"weather": {"smog": None}},
        {"name": 2024, "seed": 3, "variants": 2},
        with_smog(probability=0.5),
        with_smog(extinction_per_m=None),
        with_smog(visibility_m={"log_uniform": [1.0, 2.0]}),
        with_smog(visibility_m={"normal": {"mean": 2.0, "std": 1.0, "min": 1.0, "max": 3.0}}),
        with_smog(scale_height_m={"choice": [None, 5.0, {"uniform": [1.0, 2.0]}]}),
        with_smog(color=[0.5, {"uniform": [0.0, 1.0]}, {"choice": [0.5]}]),
        with_smog(color={"uniform": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]}),
        with_smog(model={"choice": ["deferred"], "weights": [2.0]}),
        {"output": {"jpeg_quality": {"uniform": [1, 2]}, "lidar": {"choice": [True, False]}}},
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
        {"seed": 1.5},
        {"seed": {"choice": [1]}},
        {"variants": 0},
        {"weather": 3},
        {"weather": {"smog": {}}},
        with_smog(extinction_per_m=0.1),
        with_smog(visibility_km=3),
        with_smog(visibility_m=-5),
        with_smog(visibility_m=0),
        with_smog(visibility_m="300"),
        with_smog(visibility_m=True),
        with_smog(visibility_m={"uniform": [0.0, 1.0]}),
        with_smog(visibility_m={"uniform": [1.0]}),
        with_smog(visibility_m={"uniform": [None, 1.0]}),
        with_smog(visibility_m={"unifrom": [1.0, 2.0]}),
        with_smog(visibility_m={"choice": []}),
        with_smog(base_height_m={"log_uniform": [0.0, 2.0]}),
        with_smog(base_height_m={"normal": {"mean": 1.0, "std": 0.0, "min": 0.0, "max": 2.0}}),
        with_smog(base_height_m={"normal": {"mean": 1.0, "std": 1.0}}),
        with_smog(base_height_m=None),
        with_smog(color=[0.5, 0.5]),
        with_smog(color=[0.5, 0.5, 1.5]),
        with_smog(color={"log_uniform": [[0.1, 0.1, 0.1], [1.0, 1.0, 1.0]]}),
        with_smog(model="fast"),
        with_smog(model={"uniform": ["deferred", "per_gaussian"]}),
        with_smog(probability={"uniform": [0.0, 1.0]}),
        {"render": {"sh_degree": 1.5}},
        {"output": {"lidar": "yes"}},
    ],
)
def test_both_refuse(data: dict, validator: Any) -> None:
    with pytest.raises(RecipeError):
        parse_recipe(json.dumps(data), source="json")
    assert not validator.is_valid(data)
