"""Rules between the fields of a section, tried at the ends of their ranges before any draw."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from recipes.fields import SectionSpec
from recipes.template import readable
from recipes.values import Plain, Value, is_number, words

Corner = tuple[dict[str, Any], ...]  # a list's items in numbers


@dataclass(frozen=True)
class Items:
    """The mappings of a list, as a rule of the section that holds the list sees them."""

    mappings: tuple[Mapping[str, Value | Items], ...]

    @property
    def is_range(self) -> bool:
        return any(value.is_range for mapping in self.mappings for value in mapping.values())

    def ends(self) -> tuple[Corner, Corner]:
        """All numbers at their low ends, then all at their high ends.

        Not every combination, of which there may be 2^300: no rule over a list's items trades one
        number off against another.
        """
        low, high = (
            tuple({k: _outer(v)[end] for k, v in mapping.items()} for mapping in self.mappings)
            for end in (0, 1)
        )
        return (low, high)


def broken_rules(spec: SectionSpec, given: Mapping[str, Value | Items]) -> Iterator[str]:
    """What the section's model says against any combination of the ranges' ends, each text once."""
    said: set[str] = set()
    free = {name for name, field in spec.fields.items() if field.kind.is_text}
    corners = {name: _ends(value, name in free) for name, value in given.items()}
    for combination in itertools.product(*corners.values()):
        corner = dict(zip(corners, combination, strict=True))
        try:
            spec.model.model_validate(corner)
        except ValidationError as error:
            ranged = [name for name, value in given.items() if value.is_range]
            drawn = [_drawn(name, given[name], corner[name]) for name in ranged]
            where = f" (in a draw with {', '.join(drawn)})" if drawn else ""
            for text in readable(error):
                if text not in said:
                    said.add(text)
                    yield f"{text}{where}"


def _drawn(name: str, value: Value | Items, end: Any) -> str:
    if isinstance(value, Items):
        which = "low" if end == value.ends()[0] else "high"
        return f"all {name} at the {which} ends of their ranges"
    return f"{name} = {words(end)}"


def _ends(value: Value | Items, is_free_text: bool) -> list[Any]:
    """What a rule between fields can depend on: the extreme numbers, null, and every word.

    A handful, so that the product over a section's fields stays in the hundreds. No rule compares
    colours, rates or names of files, so one stands for all.
    """
    if isinstance(value, Items):
        return list(value.ends())
    probes = value.probes()
    numbers = [p for p in probes if is_number(p)]
    triples = [p for p in probes if isinstance(p, tuple)]
    others = [p for p in probes if p is None or isinstance(p, str | bool)]
    if is_free_text:
        others = [p for p in others if p is None] + [p for p in others if p is not None][:1]
    ends: list[Plain] = [min(numbers), max(numbers)] if numbers else []
    return list(dict.fromkeys([*ends, *triples[:1], *others]))


def _outer(value: Value | Items) -> tuple[Any, Any]:
    """The least and the greatest number; of what is none, the first and the last option."""
    if isinstance(value, Items):
        return value.ends()
    probes = value.probes()
    numbers = [p for p in probes if is_number(p)]
    return (min(numbers), max(numbers)) if numbers else (probes[0], probes[-1])
