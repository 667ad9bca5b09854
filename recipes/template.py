"""A recipe as it is written, with its ranges, and the recipes in numbers that are drawn from it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from recipes.errors import RecipeError, join, readable
from recipes.files import with_digest
from recipes.ranges import Draws, describe, draw, format_value, is_range
from recipes.schema import VERSION, Recipe
from recipes.sections import recipe_file, unit_of_field

_SHARE = ".probability"


@dataclass(frozen=True)
class RecipeTemplate:
    """A loaded recipe file.

    Attributes:
        name: name of the recipe.
        source: file or preset, for messages.
        seed: seed of the draws.
        variants: number of recipes that a run draws from it.
        first_variant: number of the first one.
        field_values: given fields, by section: a value or a range for a field, a tuple for a
            colour, a list for a list of mappings. An effect's `probability` is the share of
            variants that have it.
    """

    name: str
    source: str
    seed: int = 0
    variants: int = 1
    first_variant: int = 0
    field_values: Mapping[str, Any] = field(default_factory=dict)

    def resolve(self, variant: int) -> Recipe:
        """Draw the recipe number `variant`, counted from 0.

        Its numbers depend only on the seed, on first_variant + variant and on each field's own
        path, so there is no end to the variants. Files that it names are searched and read: the
        recipe has their absolute paths, and a digest of their contents.

        Raises:
            RecipeError: variant is negative or too large, the draw breaks a rule, or a file cannot
                be read or has another digest than the recipe gives.
        """
        number = self.first_variant + variant
        leaf = recipe_file().leaves["variant"]
        if variant < 0 or not leaf.accepts(number):
            allowed = leaf.describe_allowed_values(number)
            raise RecipeError(f"{self.source}: variant = {variant}: must be {allowed}")
        prefix = f"{self.source}: variant {number}"
        names = {"version": VERSION, "name": self.name, "seed": self.seed, "variant": number}
        try:
            fields = draw(self.field_values, Draws(self.seed, number), "")
            return with_digest(Recipe.model_validate(names | fields))
        except ValidationError as error:
            raise RecipeError(*(f"{prefix}: {text}" for text in readable(error))) from None
        except ValueError as error:  # a file that cannot be read
            raise RecipeError(f"{prefix}: {error}") from None
        except RecipeError as error:
            raise RecipeError(f"{self.source}: {error}") from None

    @property
    def values(self) -> dict[str, Any]:
        """Return the value or range of every given field, by dotted path."""
        return {
            path: value for path, value in _walk(self.field_values) if not path.endswith(_SHARE)
        }

    @property
    def _shares(self) -> dict[str, float]:
        """Return the probability of every effect that some variants lack, by its path."""
        fields = _walk(self.field_values)
        shares = {
            path.removesuffix(_SHARE): value for path, value in fields if path.endswith(_SHARE)
        }
        return {path: share for path, share in shares.items() if share != 1}

    def describe_ranges(self) -> dict[str, str]:
        """Return the range in words, with the unit, of every field that differs between
        variants, by path.
        """
        ranges = {
            path: f"present with probability {format_value(share)}"
            for path, share in self._shares.items()
        }
        for path, value in self.values.items():
            if is_range(value):
                unit = unit_of_field(path)
                ranges[path] = describe(value) + (f" ({unit})" if unit else "")
        return ranges

    def describe_draws(self) -> str:
        """Return the ranges, then a line for every variant: its number, its hash and its draws."""
        lines = [f"{path}: {text}" for path, text in self.describe_ranges().items()]
        for variant in range(self.variants):
            recipe = self.resolve(variant)
            draws = Draws(self.seed, recipe.variant)
            absent = [p for p, share in self._shares.items() if draws.unit(p + _SHARE) >= share]
            parts = [f"{path} absent" for path in absent]
            absent_paths = tuple(f"{path}." for path in absent)
            for path, value in self.values.items():
                if is_range(value) and not path.startswith(absent_paths):
                    parts.append(f"{path} = {format_value(draw(value, draws, path))}")
            lines.append(f"{recipe.name}-{recipe.variant:03d} {recipe.hash}  {', '.join(parts)}")
        return "\n".join(lines)


def _walk(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted path and value of every field below a node of `field_values`."""
    if isinstance(node, Mapping):
        for name, inner_node in node.items():
            yield from _walk(inner_node, join(path, name))
    elif isinstance(node, list):
        for index, item in enumerate(node):
            yield from _walk(item, f"{path}[{index}]")
    else:
        yield path, node
