"""Recipes that go on from others, and fields that are replaced from outside a file."""

from __future__ import annotations

from pathlib import Path

import pytest

from recipes.errors import RecipeError
from recipes.job import load_job, load_job_recipes, parse_job
from recipes.load import dump_recipe, load_recipe, parse_recipe, read_overrides
from recipes.ranges import Uniform
from recipes.schema import Recipe


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def resolved(text: str) -> Recipe:
    return parse_recipe(text, source="r.yaml", name="mine").resolve(0)


def refusal(text: str, overrides: dict | None = None) -> str:
    with pytest.raises(RecipeError) as caught:
        parse_recipe(text, source="r.yaml", overrides=overrides)
    return str(caught.value)


PARENT = """\
seed: 4
variants: 3
weather:
  smog: {visibility_m: {uniform: [100, 300]}, color: [0.6, {uniform: [0.5, 0.6]}, 0.6]}
  snow: {depth_m: 0.1, light: {sun: 0.5}}
render: {scale: 0.5}
"""
CHILD = """\
extends: base/parent.yaml
weather:
  smog: {color: [0.7, 0.7, 0.7], scale_height_m: 80}
  snow: {light: {brightness: 0.8}}
"""
MERGED = """\
seed: 4
variants: 3
weather:
  smog: {visibility_m: {uniform: [100, 300]}, color: [0.7, 0.7, 0.7], scale_height_m: 80}
  snow: {depth_m: 0.1, light: {sun: 0.5, brightness: 0.8}}
render: {scale: 0.5}
"""


def test_a_child_is_the_merged_recipe_written_out(tmp_path: Path) -> None:
    """Same numbers, hash and document; sections merge, lists and ranges replace whole."""
    write(tmp_path / "base/parent.yaml", PARENT)
    child = load_recipe(write(tmp_path / "child.yaml", CHILD))
    merged = load_recipe(write(tmp_path / "merged/child.yaml", MERGED))
    assert (child.name, child.seed, child.variants) == ("child", 4, 3)
    for variant in range(3):
        assert child.resolve(variant) == merged.resolve(variant)
        assert dump_recipe(child.resolve(variant)) == dump_recipe(merged.resolve(variant))
    text = "extends: child.yaml\nweather: {smog: {visibility_m: {log_uniform: [1, 2]}}, snow: null}"
    grandchild = load_recipe(write(tmp_path / "last.yaml", f"{text}\n"))
    assert grandchild.values["weather.smog.visibility_m"] == Uniform(1.0, 2.0, log=True)
    assert grandchild.name == "last" and grandchild.resolve(0).weather.snow is None


def test_a_preset_is_a_parent_whose_draws_stay() -> None:
    smog = load_recipe("dense-fog").resolve(0).weather.smog
    child = resolved("extends: dense-fog\nrender: {scale: 0.5}\n")
    assert child.weather.smog == smog and (child.name, child.render.scale) == ("mine", 0.5)
    assert load_recipe("clear", {"extends": None}).resolve(0) == load_recipe("clear").resolve(0)
    clear = resolved("extends: dense-fog\nweather:\n  smog:\n")
    assert clear.weather == Recipe().weather


def test_what_a_parent_names_lies_beside_it(tmp_path: Path) -> None:
    write(tmp_path / "base/dusk.jpg", "a picture")
    write(tmp_path / "base/warm.yaml", "style: {image: dusk.jpg}\n")
    style = load_recipe(write(tmp_path / "r.yaml", "extends: base/warm.yaml\n")).resolve(0).style
    assert style is not None and style.image == str(tmp_path / "base/dusk.jpg")


def test_messages_name_the_file_and_line_that_hold_the_bad_value(tmp_path: Path) -> None:
    write(tmp_path / "bad.yaml", "weather:\n  smog:\n    visibility_m: -1\n    color: 3\n")
    path = write(tmp_path / "r.yaml", "extends: bad.yaml\nrender:\n  scal: 1\n")
    with pytest.raises(RecipeError) as caught:
        load_recipe(path)
    found = [str(tmp_path / place) for place in ("bad.yaml:3: ", "bad.yaml:4: ", "r.yaml:3: ")]
    assert len(caught.value.problems) == 3
    assert all(any(p.startswith(place) for p in caught.value.problems) for place in found)


def test_parents_that_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "one.yaml", "seed: 1\nextends: two.yaml\n")
    write(tmp_path / "two.yaml", "extends: one.yaml\n")
    write(tmp_path / "self.yaml", "extends: ./self.yaml\n")
    write(tmp_path / "later.yaml", "version: 2\n")
    write(tmp_path / "in/out.yaml", "extends: ../one.yaml\n")
    write(tmp_path / "typo.yaml", "extends: dense-fg\n")
    write(tmp_path / "list.yaml", "extends: [dense-fog]\n")
    write(tmp_path / "child.yaml", "extends: later.yaml\n")
    for name, place, said in (
        ("one", "two.yaml:1", "a circle: one.yaml -> two.yaml -> one.yaml"),
        ("self", "self.yaml:1", "a circle: self.yaml -> self.yaml"),
        ("in/out", "in/out.yaml:1", "leads out of the recipe's folder"),
        ("typo", "typo.yaml:1", "did you mean dense-fog?"),
        ("list", "list.yaml:1", "must be a preset's name, or a file in the recipe's folder"),
        ("child", "later.yaml:1", "version = 2: this package reads version 1"),
    ):
        with pytest.raises(RecipeError) as caught:
            load_recipe(tmp_path / f"{name}.yaml")
        assert f"{tmp_path}/{place}: " in str(caught.value) and said in str(caught.value)
    assert "in no folder to look in" in refusal("extends: other.yaml")


# ---- Overrides -----------------------------------------------------------------------------------


def test_an_override_is_the_field_written_in_the_file() -> None:
    texts = ["weather.smog.visibility_m={uniform: [40, 80]}", "weather.smog.color=[0.5, 0.5, 0.5]"]
    template = load_recipe("dense-fog", read_overrides([*texts, "variants=2"]))
    assert template.values["weather.smog.visibility_m"] == Uniform(40.0, 80.0)
    smog = "{visibility_m: {uniform: [40, 80]}, color: [0.5, 0.5, 0.5]}"
    text = f"extends: dense-fog\nweather: {{smog: {smog}}}"
    written = parse_recipe(text, source="r.yaml", name="dense-fog")
    assert template.variants == 2 and template.resolve(1) == written.resolve(1)
    without = load_recipe("winter-fog", {"weather.snow": None, "extends": "clear"}).resolve(0)
    assert without.weather.snow is None and without.weather.smog is not None
    assert load_recipe("clear", {"weather.snow.depth_m": 0.2}).resolve(0).weather.snow is not None


def test_wrong_overrides_name_the_option_and_the_nearest_field() -> None:
    for text, said in (
        ("weather.smog.visibilty_m=60", "unknown field; did you mean visibility_m (metres)?"),
        ("visibility_m=60", "did you mean weather.smog.visibility_m?"),
        ("wether.smog.visibility_m=60", "did you mean weather?"),
        ("weather.smog.visibility_m=-1", "visibility_m = -1: must be > 0"),
        ("weather.smog.visibility_m=", "a value is missing"),
        ("weather.smog.visibility_m=[1, 2", "not valid YAML"),
        ("weather.smog.extinction_per_m=0.1", "both give the density"),
        ("weather.smog.visibility_m", "write PATH=VALUE"),
        ("weather.smog={a: 1, a: 2}", "a is given twice"),
        ("version=2", "version = 2: this package reads version 1"),
    ):
        with pytest.raises(RecipeError) as caught:
            load_recipe("dense-fog", read_overrides([text]))
        assert str(caught.value).startswith(f"--set {text}: ") and said in str(caught.value)
    with pytest.raises(RecipeError, match=r"--set .*udcff=1: .* which is no character"):
        read_overrides(["\udcff=1"])


def test_files_in_overrides_start_at_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "looks/dusk.jpg", "a picture")
    overrides = read_overrides(["style.image=looks/dusk.jpg"])
    style = load_recipe("clear", overrides).resolve(0).style
    assert style is not None and style.image == str(tmp_path / "looks/dusk.jpg")


@pytest.mark.parametrize("written", ["[40, 300]", "[40.5, 300]"])
def test_two_numbers_where_one_is_expected_are_taken_for_a_range(written: str) -> None:
    text = f"weather:\n  smog:\n    visibility_m: {written}\n"
    assert f"r.yaml:3: weather.smog.visibility_m = {written}: must be a number" in refusal(text)
    assert f"a range is written {{uniform: {written}}}" in refusal(text)
    assert "a range is written" not in refusal("weather: {smog: {probability: [0, 1]}}")


JOB = """\
scenes: [a]
recipes:
  - dense-fog
  - {recipe: dense-fog, name: thick, set: {weather.smog.visibility_m: {uniform: [20, 30]}}}
  - recipe: clear
    set:
      style.image: dusk.jpg
"""


def test_an_entry_of_a_job_sets_fields(tmp_path: Path) -> None:
    write(tmp_path / "dusk.jpg", "a picture")
    job = load_job(write(tmp_path / "job.yaml", JOB))
    templates = load_job_recipes(job, tmp_path).templates
    assert list(templates) == ["dense-fog", "thick", "clear"]
    assert templates["thick"].values["weather.smog.visibility_m"] == Uniform(20.0, 30.0)
    assert templates["thick"].resolve(0).hash != templates["dense-fog"].resolve(0).hash
    style = templates["clear"].resolve(0).style
    assert style is not None and style.image == str(tmp_path / "dusk.jpg")


def test_entries_of_a_job_that_are_refused() -> None:
    recipe = "scenes: [a]\nrecipes:\n  - recipe: dense-fog\n    set:"
    with pytest.raises(RecipeError, match="are called the same: dense-fog; give one of them a na"):
        parse_job(f"{recipe} {{seed: 1}}\n  - {{recipe: dense-fog, set: {{seed: 2}}}}", source="j")
    with pytest.raises(RecipeError, match=r"job.yaml:4: recipes\[0\].set: must be a mapping"):
        parse_job(f"{recipe} 3\n", source="job.yaml")
    job = parse_job(f"{recipe}\n      weather.smog.visibilty_m: 3\n", source="job.yaml")
    with pytest.raises(RecipeError, match=r"job.yaml:5: .*visibilty_m: unknown field; did you me"):
        load_job_recipes(job, Path())
