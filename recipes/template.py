"""A recipe as it is written, with its ranges, and the recipes in numbers that it stands for."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from recipes.errors import RecipeError
from recipes.fields import ROOT
from recipes.files import file_below, with_digest
from recipes.sampler import Draws
from recipes.schema import VERSION, Recipe
from recipes.style import FILES
from recipes.values import Value

_INDEX = re.compile(r"\[[0-9]+\]")


@dataclass(frozen=True)
class RecipeTemplate:
    """A loaded recipe file.

    name: for folders and the manifest. source: where it was read from, for messages. variants: how
    many recipes a run draws from it; first_variant: the number of the first. values: dotted path ->
    how the field gets its value, for the fields that the file gives. effects: dotted path -> the
    share of variants that have it, for the effects that the file names. lists: dotted path -> how
    many items, for the lists that the file gives. folder: where the files lie that values name.
    """

    name: str
    source: str
    seed: int = 0
    variants: int = 1
    first_variant: int = 0
    values: tuple[tuple[str, Value], ...] = ()
    effects: tuple[tuple[str, float], ...] = ()
    lists: tuple[tuple[str, int], ...] = ()
    folder: Path | None = None

    def resolve(self, variant: int) -> Recipe:
        """The recipe number `variant`, counted from 0.

        Its numbers depend on the seed, on first_variant + variant and on each field's own path
        only: not on other fields, other variants, or what was resolved before. So there is no end
        to the variants; `variants` says how many a run draws. Files that it names are found and
        read: the recipe has their absolute paths, and a digest of what they hold.

        Raises:
            RecipeError: variant is negative or too large, what was drawn breaks a rule, or a file
                cannot be read or is not the one of which the recipe gives the digest.
        """
        number = self.first_variant + variant
        if variant < 0 or not ROOT.fields["variant"].accepts(number):
            allowed = ROOT.fields["variant"].allowed(number)
            raise RecipeError(f"{self.source}: variant = {variant}: must be {allowed}")
        draws = Draws(self.seed, number)
        data: dict[str, Any] = {
            "version": VERSION,
            "name": self.name,
            "seed": self.seed,
            "variant": number,
        }
        off: list[str] = []
        for path, probability in self.effects:
            present = draws.unit(f"{path}.probability") < probability
            _put(data, path, {} if present else None)
            if not present:
                off.append(path + ".")
        for path, count in self.lists:
            if not path.startswith(tuple(off)):
                _put(data, path, [{} for _ in range(count)])
        for path, value in self.values:
            if not path.startswith(tuple(off)):
                _put(data, path, value.draw(draws, path))
        where = f"{self.source}: variant {number}"
        self._find_files(data.get("style"), where)
        try:
            return with_digest(Recipe.model_validate(data))
        except ValidationError as error:
            raise RecipeError(*(f"{where}: {text}" for text in readable(error))) from None
        except RecipeError as error:
            raise RecipeError(f"{self.source}: {error}") from None

    def _find_files(self, style: dict[str, Any] | None, where: str) -> None:
        """Replace the names of files by absolute paths."""
        for name in FILES:
            written = (style or {}).get(name)
            if style is None or written is None:
                continue
            try:
                if self.folder is None:
                    raise ValueError("the recipe is in no folder to look in")
                style[name] = str(file_below(self.folder, written))
            except ValueError as error:
                raise RecipeError(f"{where}: style.{name} = {written!r}: {error}") from None

    def describe_ranges(self) -> dict[str, str]:
        """Dotted path -> its range in words, with the unit; only what differs between variants."""
        units = {
            spec.path: spec.unit for section in ROOT.walk() for spec in section.fields.values()
        }
        said = {
            path: f"present with probability {probability:g}"
            for path, probability in self.effects
            if probability < 1
        }
        for path, value in self.values:
            if value.is_range:
                unit = units.get(_INDEX.sub("[]", path))
                said[path] = value.describe() + (f" ({unit})" if unit else "")
        return said


def readable(error: ValidationError) -> list[str]:
    """pydantic's problems, one line each: the field, then what is wrong."""
    lines = []
    for item in error.errors(include_url=False):
        parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in item["loc"])
        path = "".join(parts).removeprefix(".")
        cause = item.get("ctx", {}).get("error")
        text = str(cause) if isinstance(cause, ValueError) else item["msg"]
        lines.append(f"{path}: {text}" if path else text)
    return lines


def _put(data: dict[str, Any], path: str, value: object) -> None:
    *sections, name = path.split(".")
    for section in sections:
        key, _, index = section.removesuffix("]").partition("[")
        # a list is put before its items' fields, with a mapping for each
        data = data[key][int(index)] if index else data.setdefault(key, {})
    data[name] = value
