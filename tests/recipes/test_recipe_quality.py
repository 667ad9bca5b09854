"""Quality: tiers resolve to numbers, and what a recipe gives itself stays."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from recipes import schema as knobs
from recipes.errors import RecipeError
from recipes.fields import changed, is_given, section_at, with_unchecked_field
from recipes.flood import Flood, Wave, Waves
from recipes.job import scaled_recipe
from recipes.load import dump_recipe, parse_recipe
from recipes.schema import TIERS, Quality, Recipe, Render, Weather
from recipes.sections import recipe_file
from recipes.style import Style

SNOW_AND_FLOOD = "weather: {snow: {depth_m: 0.1}, flood: {level_m: 0.2}}\n"


def resolved(text: str) -> Recipe:
    return parse_recipe(text, source="test", name="test").resolve(0)


def test_every_knob_is_a_field_whose_values_the_schema_takes() -> None:
    fields = {leaf.path: leaf for s in recipe_file().walk() for leaf in s.leaves.values()}
    for knob in knobs.KNOBS.values():
        assert all(fields[knob.path].accepts(value) for value in knob.values), knob
        assert len(set(knob.values)) == len(knob.values) >= 2


def test_tiers_set_knobs_to_values_of_the_table() -> None:
    assert set(TIERS) == {"draft", "balanced"}
    for settings in TIERS.values():
        for path, value in settings.items():
            assert value in knobs.KNOBS[path].values and knobs.KNOBS[path].is_selectable


def test_without_a_wish_nothing_changes() -> None:
    assert resolved("quality:\n") == resolved("{}") == Recipe(name="test")
    assert Recipe().quality.summary is None
    assert '"quality"' not in Recipe().canonical_json()


def test_a_word_is_short_for_its_mapping() -> None:
    assert resolved("quality: draft") == resolved("quality: {tier: draft}")
    assert resolved("quality: draft").quality.summary == "draft"


def test_reference_sets_every_knob_of_what_the_recipe_has() -> None:
    recipe = resolved(f"quality: reference\n{SNOW_AND_FLOOD}")
    for knob in knobs.knobs_of(recipe):
        if knob.is_selectable:
            assert section_at(recipe, knob.path) == knob.reference, knob.path
    assert recipe.weather.snow is not None and recipe.weather.snow.shading == "per_pixel"
    assert recipe.weather.smog is None and recipe.style is None


@pytest.mark.parametrize("tier", ["draft", "balanced", "reference"])
def test_what_a_recipe_gives_itself_stays(tier: str) -> None:
    given = "weather: {snow: {depth_m: 0.1, cell_m: 0.07}}\nrender: {scale: 0.9, sh_degree: 1}\n"
    recipe = resolved(f"quality: {tier}\n{given}")
    assert recipe.render.scale == 0.9 and recipe.render.sh_degree == 1
    assert recipe.weather.snow is not None and recipe.weather.snow.cell_m == 0.07


@pytest.mark.parametrize("tier", ["draft", "balanced", "reference"])
def test_a_tier_is_numbers_once_resolved(tier: str) -> None:
    recipe = resolved(f"quality: {tier}\n{SNOW_AND_FLOOD}")
    again = resolved(dump_recipe(recipe))
    assert again == recipe and again.hash == recipe.hash
    built = Recipe(name="test", quality=Quality(tier=tier), weather=recipe.weather)
    assert knobs.settings_of(built) == knobs.settings_of(recipe)


def test_a_target_is_open_until_it_is_settled() -> None:
    recipe = resolved(f"quality: {{max_flip: 0.03}}\nrender: {{sh_degree: 2}}\n{SNOW_AND_FLOOD}")
    assert recipe.has_open_choice and recipe.quality.summary == "max_flip 0.03"
    free = {knob.path for knob in knobs.free_knobs(recipe)}
    assert "render.sh_degree" not in free and "render.scale" in free
    assert "weather.smog.model" not in free and not any(p.startswith("output") for p in free)
    reread = resolved(dump_recipe(recipe))
    assert reread == recipe
    assert {knob.path for knob in knobs.free_knobs(reread)} == free


def test_settings_count_as_given() -> None:
    recipe = resolved(f"quality: {{budget_ms: 150}}\n{SNOW_AND_FLOOD}")
    chosen = {"render.scale": 0.5, "weather.flood.waves.count": 6, "render.speed.settled": True}
    settled = knobs.with_settings(recipe, chosen)
    assert not settled.has_open_choice and settled.quality.summary == "budget_ms 150"
    assert settled.render.scale == 0.5 and settled.weather.flood is not None
    assert settled.weather.flood.waves.count == 6
    assert "render.scale" not in {knob.path for knob in knobs.free_knobs(settled)}
    assert resolved(dump_recipe(settled)) == settled
    with pytest.raises(ValueError, match="scale"):
        knobs.with_settings(recipe, {"render.scale": 9.0})
    with pytest.raises(KeyError, match="smog is absent"):
        knobs.with_settings(recipe, {"weather.smog.model": "deferred"})


def test_another_scale_leaves_the_rest_free() -> None:
    recipe = scaled_recipe(resolved("quality: {max_flip: 0.1}"), 0.5)
    free = {knob.path for knob in knobs.free_knobs(recipe)}
    assert recipe.render.scale == 0.5 and "render.scale" not in free
    assert "render.sh_degree" in free


def test_knobs_of_what_is_not_there_have_no_effect() -> None:
    def paths(flood: Flood) -> set[str]:
        return {knob.path for knob in knobs.knobs_of(Recipe(weather=Weather(flood=flood)))}

    count = "weather.flood.waves.count"
    assert count in paths(Flood(level_m=0.2))
    assert count not in paths(Flood(level_m=0.2, waves=Waves(preset="still")))
    assert count not in paths(Flood(level_m=0.2, waves=Waves(height=0)))
    listed = Waves(components=(Wave(amplitude_m=0.01, wavelength_m=1.0),))
    assert count not in paths(Flood(level_m=0.2, waves=listed))
    for place, has_effect in (("scene", True), ("picture", False)):
        style = Style(preset="dusk", applied_to=place)
        known = {knob.path for knob in knobs.knobs_of(Recipe(style=style))}
        assert ("style.evaluated" in known) is has_effect
    assert "output.jpeg_quality" not in {knob.path for knob in knobs.knobs_of(Recipe())}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("quality: blanced", "did you mean balanced"),
        ("quality: 3", "one of draft, balanced, reference"),
        ("quality: {max_flip: 0}", "> 0"),
        ("quality: {max_flip: 1.5}", "<= 1"),
        ("quality: {budget_ms: -1}", "> 0"),
        ("quality: {budget_ms: 100, max_flip: 0.1}", "keep one of them"),
        ("quality: {tier: draft, max_flip: 0.1}", "keep one of them"),
        ("render: {speed: {settled: true}}", "settled belongs to"),
        ("quality: {tiers: draft}", "tier"),
        ("quality: [draft]", "must be a mapping"),
    ],
)
def test_bad_wishes_are_refused(text: str, message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        resolved(text)


def test_fields_are_changed_in_a_copy() -> None:
    recipe = Recipe(render=Render(near_m=0.5))
    other = changed(recipe, {"render.scale": 2.0})
    assert (recipe.render.scale, other.render.scale, other.render.near_m) == (1.0, 2.0, 0.5)
    assert is_given(other, "render.near_m") and is_given(other, "render.scale")
    assert not is_given(other, "render.sh_degree") and not is_given(recipe, "render.scale")
    assert section_at(recipe, "weather.smog.model") is None
    with pytest.raises(ValidationError):
        changed(recipe, {"render.scale": -1.0})
    assert (
        with_unchecked_field(recipe, "render.scale", -1.0).render.scale == -1
    )  # nothing is checked
