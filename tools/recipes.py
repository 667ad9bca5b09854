"""`climategs recipes`: the presets, the text and the draws of a recipe, and the JSON Schema."""

from __future__ import annotations

from typing import TYPE_CHECKING

from recipes.json_schema import write_schema
from recipes.load import describe_preset, load_recipe, preset_names, read_overrides, recipe_text

if TYPE_CHECKING:
    from tools.cli import RecipesOptions


def show_recipes(options: RecipesOptions) -> int:
    """Write the schema, or print the presets, or one recipe or its draws. Return 0."""
    if options.schema_file is not None:
        write_schema(options.schema_file)
        print(f"wrote {options.schema_file}")
    elif options.name is None:
        for name in preset_names():
            print(f"{name:<14} {describe_preset(name)}")
    else:
        template = load_recipe(options.name, read_overrides(options.overrides))
        text = recipe_text(options.name).rstrip("\n")
        print(template.describe_draws() if options.draws or options.overrides else text)
    return 0
