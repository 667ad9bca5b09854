"""The section `render.speed`: moving fields into it changed no hash, draw or setting."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from recipes.errors import RecipeError
from recipes.fields import changed
from recipes.job import load_job_recipes, parse_job
from recipes.load import dump_recipe, load_recipe, parse_recipe, read_overrides
from recipes.schema import KNOBS, Recipe, settings_of
from recipes.speed import HASHED_PLACES, MOVED_FIELDS, Speed, former_path

# The recipe of version 0.6 and the same recipe of today, with ranges in the fields that moved.
FORMER = """
seed: 11
quality: {max_flip: 0.1, settled: true}
weather:
  flood: {level_m: 0.3, layers_px: {uniform: [1, 8]}, bed_cut: {log_uniform: [0.001, 0.1]}}
  rain:
    rate_mm_h: {uniform: [1, 20]}
    min_width_px: {choice: [0.3, {uniform: [0.4, 0.9]}]}
    mirror_px: {normal: {mean: 3, std: 1, min: 1, max: 8}}
  snowfall: {rate_mm_h: 2, min_width_px: {uniform: [0.2, 3]}}
render:
  scale: 0.5
  alpha_max: {uniform: [0.9, 0.999]}
  antialiased: {choice: [true, false]}
  radius_clip_px: {uniform: [0, 3]}
  transmittance_stop: {log_uniform: [0.0001, 0.1]}
  fog_cut: {uniform: [0, 0.1]}
  prune: {uniform: [0, 0.1]}
  lod_px: {uniform: [0, 2]}
"""
TODAY = """
seed: 11
quality: {max_flip: 0.1}
weather:
  flood: {level_m: 0.3}
  rain: {rate_mm_h: {uniform: [1, 20]}}
  snowfall: {rate_mm_h: 2}
render:
  scale: 0.5
  speed:
    alpha_max: {uniform: [0.9, 0.999]}
    antialiased: {choice: [true, false]}
    radius_clip_px: {uniform: [0, 3]}
    transmittance_stop: {log_uniform: [0.0001, 0.1]}
    fog_cut: {uniform: [0, 0.1]}
    prune: {uniform: [0, 0.1]}
    lod_px: {uniform: [0, 2]}
    layers_px: {uniform: [1, 8]}
    bed_cut: {log_uniform: [0.001, 0.1]}
    mirror_px: {normal: {mean: 3, std: 1, min: 1, max: 8}}
    rain_min_width_px: {choice: [0.3, {uniform: [0.4, 0.9]}]}
    snowfall_min_width_px: {uniform: [0.2, 3]}
    settled: true
"""
NUMBERS = "# A recipe in numbers, hash 0123456789abcdef.\n"
# The hashes of the first draws of FORMER in version 0.6.
HASHES = ("6a535f7cb005d632", "90d2b21f83b6033a", "53787b9f3c677703")
# The digest over the hashes of presets in version 0.6.
PRESETS_DIGEST = "c3f1fb725f41589f"


def parsed(text: str, **options) -> Recipe:
    return parse_recipe(text, source="foggy.yaml", name="foggy", **options).resolve(0)


def test_draws_and_hashes_are_those_of_the_former_fields() -> None:
    template = parse_recipe(TODAY, source="foggy.yaml", name="foggy")
    assert tuple(template.resolve(variant).hash for variant in range(3)) == HASHES


def test_tiers_and_presets_have_the_hashes_of_version_0_6() -> None:
    hashes = [
        load_recipe(preset, {} if tier is None else {"quality": tier}).resolve(variant).hash
        for preset in ("storm", "deep-flood", "blizzard")
        for tier in (None, "draft", "balanced", "reference")
        for variant in range(2)
    ]
    assert hashlib.sha256("\n".join(hashes).encode()).hexdigest()[:16] == PRESETS_DIGEST


def test_every_field_of_the_section_has_one_place_in_hashes() -> None:
    paths = sorted(f"render.speed.{name}" for name in Speed.model_fields)
    assert sorted(HASHED_PLACES.values()) == paths


def test_a_moved_field_has_a_former_place_and_no_setting_there() -> None:
    assert not MOVED_FIELDS.keys() & KNOBS.keys()
    assert former_path("render.speed.prune") == "render.prune"
    assert former_path("render.scale") == "render.scale"


@pytest.mark.parametrize("former", MOVED_FIELDS)
def test_a_former_name_is_refused_with_todays_and_its_line(former: str) -> None:
    section, _, name = former.rpartition(".")
    line = f"{section.replace('.', ': {')}: {{\n{name}: 1}}" + "}" * section.count(".")
    message = f"{former}: has moved; write {MOVED_FIELDS[former]}"
    job = f"scenes: [street]\nrecipes:\n  - recipe: storm\n    set:\n      {former}: 1\n"
    with pytest.raises(RecipeError) as of_file:
        parsed(line)
    assert f"foggy.yaml:2: {message}" in of_file.value.problems
    with pytest.raises(RecipeError) as of_option:
        parsed("{}", overrides=read_overrides([f"{former}=1"]))
    assert f"--set {former}=1: {message}" in of_option.value.problems
    with pytest.raises(RecipeError, match=r"job\.yaml:5: ") as of_job:
        load_job_recipes(parse_job(job, source="job.yaml"), Path())
    assert message in str(of_job.value)


def test_a_recipe_that_an_older_job_left_is_read() -> None:
    former = parse_recipe(NUMBERS + FORMER, source="recipe.yaml", name="foggy")
    today = parse_recipe(TODAY, source="foggy.yaml", name="foggy")
    assert former.field_values == today.field_values
    recipe = today.resolve(1)
    assert parsed(dump_recipe(recipe)) == recipe


def test_a_tier_chooses_for_an_effect_that_is_added_to_a_recipe_in_numbers() -> None:
    text = dump_recipe(parsed("quality: draft"))
    flooded = parsed(text, overrides={"weather.flood.level_m": 0.2})
    assert flooded.render.speed.layers_px == 4.0
    given = parsed("quality: draft\nrender: {speed: {layers_px: 3}}")
    assert parsed(dump_recipe(given)).render.speed.layers_px == 3.0


def test_a_field_of_an_absent_effect_changes_neither_hash_nor_settings() -> None:
    recipe = parsed("weather: {rain: {rate_mm_h: 2}}")
    other = changed(recipe, {"render.speed.layers_px": 3.0})
    assert other.hash == recipe.hash and settings_of(other) == settings_of(recipe)
    assert changed(recipe, {"render.speed.mirror_px": 3.0}).hash != recipe.hash
