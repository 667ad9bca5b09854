"""What a recipe may say of style, and the messages for what was meant to be said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from recipes.errors import RecipeError
from recipes.load import parse_recipe
from recipes.ranges import Choice, NamedFile, Uniform
from recipes.style import Style, style_preset_names, style_preset_text
from recipes.template import RecipeTemplate


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.jpg", "b.jpg", "sky.png", "net.safetensors", "2024"):
        (tmp_path / name).write_bytes(name.encode())
    return tmp_path


def problems(text: str, folder: Path | None = None) -> tuple[str, ...]:
    with pytest.raises(RecipeError) as caught:
        parse_recipe(text, source="r.yaml", folder=folder)
    return caught.value.problems


def template(text: str, folder: Path | None = None) -> RecipeTemplate:
    return parse_recipe(text, source="r.yaml", folder=folder)


def test_a_preset_is_enough() -> None:
    recipe = template("style: {preset: dusk}").resolve(0)
    style = Style(preset="dusk")
    assert recipe.style == style and style.has_effect and (style.name, style.files) == ("dusk", {})
    assert not Style(preset="dusk", strength=0).has_effect


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("preset: dsk", "preset = 'dsk': must be one of "),
        ("preset: dsk", ", or null; did you mean dusk?"),
        ("preset: {choice: [dusk, Dusk]}", "preset.choice[1] = 'Dusk': must be one of "),
        ("method: mlk", "must be one of mkl, reinhard, gscm; did you mean mkl?"),
        ("strength: {uniform: [0, 3]}", "strength.uniform[1] = 3: must be >= 0 and <= 2"),
        ("per_region: yes", "must be true or false; write true"),
        ("applied_to: pictures", "one of scene, picture; did you mean picture?"),
        ("digest: 12ab", "digest = '12ab': must be 64 hexadecimal digits, small letters, or null"),
        ("photo: a.jpg", "photo: unknown field; did you mean image?"),
        ("visibility_m: 1", "did you mean weather.smog.visibility_m?"),
        ("image: ''", "image = '': must be a file in the recipe's folder or below it, or null"),
    ],
)
def test_a_wrong_field_is_named_with_its_line_and_what_is_allowed(field: str, message: str) -> None:
    text = f"version: 1\nstyle:\n  strength: 1\n  {field}\n"
    if "strength:" in field:
        text = text.replace("strength: 1", "method: mkl")
    (problem, *_) = [line for line in problems(text) if "image and preset" not in line]
    assert problem.startswith("r.yaml:4: style.")
    assert message in problem


RULES = [
    ({}, "image and preset neither gives the style: give one of them"),
    ({"image": "a.jpg", "preset": "dusk"}, "image and preset both give the style"),
    ({"preset": "dusk", "mask": "sky.png"}, "mask belongs to an image, and there is none"),
    ({"preset": "dusk", "digest": "0" * 64}, "digest belongs to an image, and there is none"),
    ({"preset": "dusk", "method": "gscm"}, "method gscm looks at an image"),
    ({"image": "a.jpg", "checkpoint": "net.safetensors"}, "checkpoint belongs to method gscm"),
    ({"image": "a.jpg", "method": "gscm", "per_region": True}, "per_region is for mkl and"),
]


@pytest.mark.parametrize(("fields", "message"), RULES)
def test_rules_between_fields(fields: dict[str, Any], message: str, folder: Path) -> None:
    with pytest.raises(ValidationError, match=message):
        Style(**fields)
    (problem,) = problems(yaml.safe_dump({"style": fields}), folder)
    assert problem.startswith("r.yaml:1: style: ") and message in problem


def test_rules_are_tried_at_every_word_of_a_choice(folder: Path) -> None:
    text = "style: {image: {choice: [a.jpg, b.jpg]}, per_region: true, method: {choice: [%s]}}"
    assert template(text % "mkl, reinhard", folder).resolve(0).style is not None
    (problem,) = problems(text % "mkl, gscm", folder)
    assert "(in a draw with image = b.jpg, method = gscm)" in problem
    (problem,) = problems("style: {image: {choice: [a.jpg, null, b.jpg]}}", folder)
    assert "neither gives the style" in problem and "image = null" in problem


def test_an_unknown_preset_in_python_is_explained() -> None:
    with pytest.raises(ValidationError, match=r"no such style; did you mean dusk[?] styles are"):
        Style(preset="dusc")


RANGED = """
seed: 3
style:
  image: {choice: [a.jpg, b.jpg]}
  mask: {choice: [null, sky.png], weights: [1, 3]}
  method: {choice: [mkl, reinhard]}
  strength: {uniform: [0.25, 1]}
  per_region: {choice: [true, false]}
"""


def styles(text: str, folder: Path, count: int) -> list[Style | None]:
    read = template(text, folder)
    return [read.resolve(number).style for number in range(count)]


def test_every_field_takes_ranges(folder: Path) -> None:
    read = template(RANGED, folder)
    values = read.values
    assert values["style.strength"] == Uniform(0.25, 1)
    assert values["style.image"] == Choice(
        (NamedFile("a.jpg", folder), NamedFile("b.jpg", folder)), (1.0, 1.0)
    )
    assert read.describe_ranges()["style.image"] == "one of a.jpg, b.jpg"
    drawn = [style for style in styles(RANGED, folder, 30) if style is not None]
    assert len({style.strength for style in drawn}) == 30
    assert {style.name for style in drawn} == {"a.jpg", "b.jpg"}
    assert {style.mask for style in drawn} == {None, str(folder / "sky.png")}
    assert {style.method for style in drawn} == {"mkl", "reinhard"}
    assert {style.per_region for style in drawn} == {True, False}
    order = RANGED.replace(
        "per_region: {choice: [true, false]}", "applied_to: {choice: [scene, picture]}"
    )
    drawn = [style for style in styles(order, folder, 30) if style is not None]
    assert {style.applied_to for style in drawn} == {"scene", "picture"}
    assert len({style.digest for style in drawn}) == 4, "one for each pair of image and mask"


def test_a_style_that_is_absent_reads_no_files(folder: Path) -> None:
    text = RANGED + "  probability: 0.5\n"
    pairs = list(zip(styles(RANGED, folder, 12), styles(text, folder, 12), strict=True))
    kept = [(a, b) for a, b in pairs if b is not None]
    assert 0 < len(kept) < 12 and all(a == b for a, b in kept)


def test_names_are_taken_as_they_are_written(folder: Path) -> None:
    """A file's name and a digest may look like a number or a word of YAML."""
    style = template("style: {image: 2024}", folder).resolve(0).style
    assert style is not None and style.image == str(folder / "2024")
    for digest in ("1e" + "5" * 62, "12" * 32):
        with pytest.raises(RecipeError, match=digest):
            template(f"style: {{image: a.jpg, digest: {digest}}}", folder).resolve(0)


def test_the_presets_hold_statistics_of_land_and_of_sky() -> None:
    assert "dusk" in style_preset_names()
    for name in style_preset_names():
        statistics = yaml.safe_load(style_preset_text(name))
        for region in ("land", "sky"):
            rows = [statistics[region]["mean"], *statistics[region]["covariance"]]
            assert [len(row) for row in rows] == [3] * 4, name
            assert all(isinstance(number, float) for row in rows for number in row), name
    with pytest.raises(RecipeError, match=r"no such style; did you mean dusk[?] styles are"):
        style_preset_text("dust")
