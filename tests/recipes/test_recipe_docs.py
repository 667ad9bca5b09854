"""docs/recipes.md says what the code does."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from recipes.errors import RecipeError
from recipes.load import parse_recipe, preset_names
from recipes.style import style_preset_names
from recipes.template import root, words

PAGE = (Path(__file__).parents[2] / "docs" / "recipes.md").read_text(encoding="utf-8")


def field_table() -> str:
    """A row for every key of a recipe file, sections in their order."""
    rows = ["| Field | Allowed | Default | Meaning |\n| --- | --- | --- | --- |\n"]
    for section in root().walk():
        if section.max_items is not None:
            path = section.path.removesuffix("[]")
            allowed = f"a list of up to {section.max_items} mappings, or null"
            rows.append(f"| `{path}` | {allowed} | `null` | {section.list_description} |\n")
        for spec in (*section.fields.values(), *section.extra.values()):
            known = "" if spec.default is None else f"`{words(spec.default)}`"
            default = "required" if spec.required else "`null`" if spec.nullable else known
            rows.append(f"| `{spec.path}` | {spec.allowed()} | {default} | {spec.description} |\n")
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
