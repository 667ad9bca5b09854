"""A recipe as it is written, with its ranges, and the recipes in numbers that it stands for."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from recipes.errors import RecipeError, join, readable
from recipes.files import with_digest
from recipes.ranges import Draws, Fixed, Value, as_number, words
from recipes.recipe_file import recipe_file
from recipes.schema import VERSION, Recipe

_INDEX = re.compile(r"\[[0-9]+\]")
_SHARE = ".probability"


@dataclass(frozen=True)
class RecipeTemplate:
    """A loaded recipe file.

    source: where it was read from, for messages. variants: how many recipes a run draws from it;
    first_variant: the number of the first. given: what the file gives, by section; a Value for a
    field, a list for a list of mappings. An effect's `probability` is the share of variants that
    have it.
    """

    name: str
    source: str
    seed: int = 0
    variants: int = 1
    first_variant: int = 0
    given: Mapping[str, Any] = field(default_factory=dict)

    def resolve(self, variant: int) -> Recipe:
        """The recipe number `variant`, counted from 0.

        Its numbers depend on the seed, on first_variant + variant and on each field's own path
        only, so there is no end to the variants. Files that it names are found and read: the recipe
        has their absolute paths, and a digest of what they hold.

        Raises:
            RecipeError: variant is negative or too large, what was drawn breaks a rule, or a file
                cannot be read or is not the one of which the recipe gives the digest.
        """
        number, numbers = self.first_variant + variant, recipe_file().LEAVES["variant"]
        if variant < 0 or not numbers.accepts(number):
            allowed = numbers.allowed(number)
            raise RecipeError(f"{self.source}: variant = {variant}: must be {allowed}")
        where = f"{self.source}: variant {number}"
        names = {"version": VERSION, "name": self.name, "seed": self.seed, "variant": number}
        try:
            drawn = _drawn(self.given, Draws(self.seed, number), "")
            return with_digest(Recipe.model_validate(names | drawn))
        except ValidationError as error:
            raise RecipeError(*(f"{where}: {text}" for text in readable(error))) from None
        except ValueError as error:  # a file that cannot be read
            raise RecipeError(f"{where}: {error}") from None
        except RecipeError as error:
            raise RecipeError(f"{self.source}: {error}") from None

    @property
    def values(self) -> dict[str, Value]:
        """Dotted path -> how the field gets its value, of every field that the file gives."""
        return {path: value for path, value in _walk(self.given) if not path.endswith(_SHARE)}

    def describe_ranges(self) -> dict[str, str]:
        """Dotted path -> its range in words, with the unit; only what differs between variants."""
        units = {leaf.path: leaf.unit for s in recipe_file().walk() for leaf in s.LEAVES.values()}
        described = {
            path.removesuffix(_SHARE): f"present with probability {share.describe()}"
            for path, share in _walk(self.given)
            if path.endswith(_SHARE) and share != Fixed(1.0)
        }
        for path, value in self.values.items():
            if value.is_range:
                unit = units.get(_INDEX.sub("[]", path))
                described[path] = value.describe() + (f" ({unit})" if unit else "")
        return described

    def describe_draws(self) -> str:
        """The ranges, then a line for every variant: its number, its hash and what it draws."""
        lines = [f"{path}: {text}" for path, text in self.describe_ranges().items()]
        for variant in range(self.variants):
            recipe = self.resolve(variant)
            draws, absent = Draws(self.seed, recipe.variant), tuple[str, ...]()
            drawn = []
            for path, share in _walk(self.given):
                if path.endswith(_SHARE) and draws.unit(path) >= as_number(share.draw(draws, path)):
                    absent += (path.removesuffix("probability"),)
            drawn = [f"{path.removesuffix('.')} absent" for path in absent]
            for path, value in self.values.items():
                if value.is_range and not path.startswith(absent):
                    drawn.append(f"{path} = {words(value.draw(draws, path))}")
            lines.append(f"{recipe.name}-{recipe.variant:03d} {recipe.hash}  {', '.join(drawn)}")
        return "\n".join(lines)


def _walk(given: Any, path: str = "") -> Iterator[tuple[str, Value]]:
    """Every value below a path."""
    if isinstance(given, Mapping):
        for name, below in given.items():
            yield from _walk(below, join(path, name))
    elif isinstance(given, list):
        for index, item in enumerate(given):
            yield from _walk(item, f"{path}[{index}]")
    else:
        yield path, given


def _drawn(given: Any, draws: Draws, path: str) -> Any:
    """What stands at a path, in numbers; None for an effect that the variant has not."""
    if isinstance(given, list):
        return [_drawn(item, draws, f"{path}[{index}]") for index, item in enumerate(given)]
    if not isinstance(given, Mapping):
        return given.draw(draws, path)
    share = given.get("probability")
    if share is not None and draws.unit(path + _SHARE) >= share.value:
        return None
    fields = {name: below for name, below in given.items() if name != "probability"}
    return {name: _drawn(below, draws, join(path, name)) for name, below in fields.items()}
