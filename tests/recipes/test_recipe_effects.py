"""An effect is one recipe model: whoever registers it finds it wherever recipes are read."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Literal

import pytest
from pydantic import Field, ValidationError

from recipes.effect import Column, EffectModel, Knob
from recipes.errors import RecipeError
from recipes.fields import FilePath, Number, Unit, Whole
from recipes.files import read_files
from recipes.json_schema import recipe_json_schema
from recipes.load import dump_recipe, load_recipe, parse_recipe
from recipes.schema import (
    KNOBS,
    SECTIONS,
    TIERS,
    Recipe,
    add_section,
    knobs_of,
    remove_section,
    settings_of,
)

TEXT = """
seed: 4
variants: 3
weather:
  dust: {density: {uniform: [0.1, 0.4]}, probability: 0.5}
"""


class Dust(EffectModel):
    """Dust in the air."""

    synonyms = (("dust", "sand"),)
    file_fields = ("map",)
    knobs = (
        Knob("steps", (1, 8), "steps along a ray", 3.5, tiers={"draft": 1}),
        Knob(
            "light", ("flat", "soft"), "light on dust", 20, applies_to=lambda it: it.density > 0.5
        ),
    )
    columns = (
        Column(
            "dust_density",
            lambda it: it.density,
            "Dust",
            value_if_absent=0.0,
            presence_values="nonzero",
        ),
        Column("dust_kind", lambda it: it.light, value_if_absent=None),
    )

    density: Unit
    """How dense it is."""
    depth_m: Number = Field(default=2.0, gt=0)
    """Of the layer."""
    steps: Whole = Field(default=8, ge=1)
    """Along a ray."""
    light: Literal["flat", "soft"] = "soft"
    """How it is lit."""
    map: FilePath | None = None
    """Where it lies."""
    digest: str | None = None
    """Of the map."""

    @property
    def has_effect(self) -> bool:
        return self.density > 0

    def beam_surface(self, output_surface: str) -> tuple[str, bool] | None:
        return ("dust", False) if output_surface == "first" else None


@pytest.fixture(params=["weather.dust", "dust"])
def path(request: pytest.FixtureRequest) -> Iterator[str]:
    before = recipe_json_schema(), Recipe().canonical_json(), list(KNOBS), str(TIERS)
    add_section(request.param, Dust)
    yield request.param
    remove_section(request.param)
    assert (recipe_json_schema(), Recipe().canonical_json(), list(KNOBS), str(TIERS)) == before
    with pytest.raises(ValidationError, match="Extra inputs"):
        Recipe.model_validate(section(request.param, density=0.2))
    with pytest.raises(RecipeError, match="unknown field"):
        parse_recipe("weather: {dust: {density: 0.1}}", source="test")


def section(path: str, **values: object) -> dict:
    return {"weather": {"dust": values}} if "." in path else {"dust": values}


def read(path: str, text: str) -> Recipe:
    return parse_recipe(text, source="test", name="test").resolve(0)


@pytest.mark.parametrize("path", ["weather.dust"], indirect=True)
def test_a_file_gives_it_ranges_and_a_probability(path: str) -> None:
    template = parse_recipe(TEXT, source="test", name="test")
    assert template.describe_ranges() == {
        "weather.dust": "present with probability 0.5",
        "weather.dust.density": "uniform from 0.1 to 0.4",
    }
    drawn = [template.resolve(number).sections() for number in range(40)]
    densities = [found[path].density for found in drawn if path in found]
    assert 10 < len(densities) < 30 and len(set(densities)) == len(densities)
    assert 0.1 <= min(densities) < max(densities) <= 0.4


@pytest.mark.parametrize("path", ["weather.dust"], indirect=True)
def test_its_mistakes_have_the_messages_of_all_others(path: str) -> None:
    for text, message in (
        ("{sand: {}}", "weather.sand: unknown field; did you mean dust?"),
        ("{dust: {density: 2}}", "weather.dust.density = 2: must be >= 0 and <= 1"),
        ("{dust: {density: 1, depth: 2}}", "did you mean depth_m (metres)?"),
        ("{dust: {}}", "weather.dust.density: must be given"),
    ):
        with pytest.raises(RecipeError) as caught:
            parse_recipe(f"weather: {text}", source="test")
        assert message in str(caught.value)


def test_it_is_in_the_schema_and_reads_back(path: str) -> None:
    dust = recipe_json_schema()["$defs"]["Dust"]
    assert dust["properties"]["density"]["description"] == "How dense it is."
    assert dust["required"] == ["density"]
    recipe = Recipe.model_validate(section(path, density=0.2))
    assert read(path, dump_recipe(recipe)) == recipe.model_copy(update={"name": "recipe"})


def test_hashes_of_recipes_without_it_stay(path: str) -> None:
    without, there = Recipe(), Recipe.model_validate(section(path, density=0.2))
    assert "dust" not in without.canonical_json() and without.hash != there.hash
    said = json.loads(there.canonical_json())
    assert (said["weather"] if "." in path else said)["dust"]["density"] == 0.2


def test_columns_and_surfaces_are_its_own(path: str) -> None:
    assert Recipe().columns()["dust_density"] == 0 and Recipe().columns()["dust_kind"] is None
    there = Recipe.model_validate(section(path, density=0.2) | {"output": {"surface": "first"}})
    assert there.columns()["dust_density"] == 0.2 and there.columns()["dust_kind"] == "soft"
    assert math.isnan(there.columns()["snow_depth_m"]) and there.sections().keys() == {path}
    assert there.lidar == "weather"
    assert str(there.lidar_note("clean")).startswith("dust in images, not in depth or sweeps")


def test_its_knobs_stand_where_their_ranks_say(path: str) -> None:
    order = list(KNOBS)
    assert order.index("weather.snow.shading") + 1 == order.index(f"{path}.steps")
    assert order[-1] == f"{path}.light" and TIERS["draft"][f"{path}.steps"] == 1
    recipe = Recipe.model_validate(section(path, density=0.2) | {"quality": {"tier": "draft"}})
    assert settings_of(recipe)[f"{path}.steps"] == 1
    assert f"{path}.light" not in {knob.path for knob in knobs_of(recipe)}
    dense = Recipe.model_validate(section(path, density=0.7))
    assert f"{path}.light" in {knob.path for knob in knobs_of(dense)} and path in SECTIONS


def test_its_files_lie_beside_the_recipe(path: str, tmp_path) -> None:
    (tmp_path / "map.png").write_bytes(b"a map")
    (tmp_path / "dusty.yaml").write_text(json.dumps(section(path, density=0.2, map="map.png")))
    dust = load_recipe(tmp_path / "dusty.yaml").resolve(0).sections()[path]
    assert isinstance(dust, Dust) and dust.map == str(tmp_path / "map.png")
    assert read_files(dust) == {"map": b"a map"} and dust.digest is not None
    (tmp_path / "map.png").write_bytes(b"another")
    with pytest.raises(RecipeError, match=rf"^{path}\.digest = .*the file has changed"):
        read_files(dust)
