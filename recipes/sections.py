"""Sections and fields of a recipe file, as a table that is made from the models of `schema`.

Messages, the JSON Schema, the table in the docs and the viewer's controls describe fields from it.
"""

from __future__ import annotations

import functools
import operator
import re
import types
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, Union, get_args, get_origin

from annotated_types import MaxLen
from pydantic import BaseModel, Field, Strict, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from pydantic.json_schema import JsonSchemaValue

from recipes.effect import EffectModel
from recipes.errors import join
from recipes.fields import ClosedModel, Digest, FilePath, Unit, Whole
from recipes.ranges import RANGE_KINDS, is_number
from recipes.schema import KNOBS, SECTIONS, Recipe, timeline_holders
from recipes.timeline import TIMELINE

# Index of an item in a dotted path.
_INDEX = re.compile(r"\[[0-9]+\]")
# Units in words, by the end of a field's name.
UNITS = {
    "_per_m": "1/metre",
    "_cd_m2": "candela per square metre",
    "_lux": "lux",
    "_lumen": "lumens",
    "_kelvin": "kelvin",
    "_mm": "millimetres",
    "_m_s": "metres per second",
    "temperature_c": "degrees Celsius",
    "_warmer_k": "kelvin",
    "_m": "metres",
    "_s": "seconds",
    "_deg": "degrees",
    "_ntu": "nephelometric turbidity units",
}
# Signs of the limits in messages, by their keywords in JSON Schema.
_LIMITS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}


# ---- A field -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Leaf:
    """Field that holds a value.

    Attributes:
        path: as in a file, with [] for the items of a list.
        annotation: type of a value that is not null.
        nullable: True if null is allowed.
        rangeable: True if a range is allowed.
        takes_timeline: True if the value may change over time.
        info: further facts that pydantic has on the field.
    """

    path: str
    annotation: Any
    nullable: bool = False
    rangeable: bool = True
    takes_timeline: bool = False
    info: FieldInfo = field(default_factory=FieldInfo)

    @property
    def description(self) -> str:
        return _one_line(self.info.description)

    @cached_property
    def kind(self) -> Any:
        """Return float, int, bool, str, tuple (a colour or three rates), Literal, or a union of
        these.
        """
        kind = self.annotation
        while get_origin(kind) is Annotated:
            kind = get_args(kind)[0]
        return get_origin(kind) or kind

    @property
    def is_number(self) -> bool:
        return self.kind in (int, float)

    @property
    def only_steps(self) -> bool:
        """Return True if the field has no values between those of two points of a timeline."""
        return self.kind is not float

    @cached_property
    def channel(self) -> Leaf | None:
        """Return the leaf of one of the three numbers of a colour or rates, or None for any
        other field.
        """
        if self.kind is not tuple:
            return None
        return Leaf(f"{self.path}[]", get_args(self.annotation)[0], rangeable=self.rangeable)

    @property
    def range_kinds(self) -> tuple[str, ...]:
        """Return the kinds of ranges that the field takes, and of timelines."""
        if not self.rangeable:
            return ()
        timeline = (TIMELINE,) if self.takes_timeline else ()
        if self.channel is not None:
            return ("uniform", "choice")
        return (*(RANGE_KINDS if self.is_number else ("choice",)), *timeline)

    @cached_property
    def end(self) -> Leaf:
        """Return the leaf of one end of a range."""
        return replace(self, nullable=False, rangeable=False, takes_timeline=False)

    @cached_property
    def point(self) -> Leaf:
        """Return the leaf of the value at a point of a timeline, which may be a range."""
        return replace(self, nullable=False, takes_timeline=False)

    @property
    def unit(self) -> str | None:
        """Return the unit in words, or None for a pure number."""
        name = self.path.removesuffix("[]")
        return next((unit for end, unit in UNITS.items() if name.endswith(end)), None)

    # ---- What is allowed, by the value's JSON Schema

    @cached_property
    def _adapter(self) -> TypeAdapter[Any]:
        return TypeAdapter(self.annotation)

    @cached_property
    def _schema(self) -> JsonSchemaValue:
        return self._adapter.json_schema()

    @property
    def limits(self) -> tuple[tuple[str, float], ...]:
        """Return pairs such as (">", 0.0)."""
        return tuple((sign, self._schema[k]) for k, sign in _LIMITS.items() if k in self._schema)

    @property
    def allowed_words(self) -> tuple[str, ...]:
        """Return the words that the field takes besides true and false; empty if they cannot be
        listed.
        """
        parts = (self._schema, *self._schema.get("anyOf", ()))
        enums = [part.get("enum", [part["const"]] if "const" in part else []) for part in parts]
        return tuple(str(word) for enum in enums for word in enum)

    @cached_property
    def word_list(self) -> tuple[str, ...]:
        """Return the words that a list in the field's place may hold; none if it takes no list."""
        items = [part.get("items", {}) for part in self._schema.get("anyOf", ())]
        return tuple(str(word) for item in items for word in item.get("enum", ()))

    def accepts(self, value: object) -> bool:
        """Return True if the recipe's model takes this value."""
        if value is None:
            return self.nullable
        try:
            self._adapter.validate_python(value)
        except ValidationError:
            return False
        return True

    def describe_allowed_values(self, value: object = None) -> str:
        """Return in words which values the field takes.

        value: the refused value; conditions that it meets are left out.
        """
        if self.channel is not None:
            text = f"[red, green, blue], each {self.channel.describe_allowed_values()}"
        elif self.is_number:
            text = self._allowed_number(value) + (f" ({self.unit})" if self.unit else "")
        elif self.word_list:
            text = f"true, false or a list of {', '.join(self.word_list)}"
        elif self.kind is bool or "anyOf" in self._schema:
            *first, last = ("true", "false", *self.allowed_words)
            text = f"{', '.join(first)} or {last}"
        elif self.allowed_words:
            text = f"one of {', '.join(self.allowed_words)}"
        else:
            text = self.info.title or self._schema.get("title", "text")
        return text + (", or null" if self.nullable and not is_number(value) else "")

    def _allowed_number(self, value: object) -> str:
        limits = " and ".join(f"{sign} {_plain(bound)}" for sign, bound in self.limits)
        right_type = is_number(value) and (isinstance(value, int) or self.kind is float)
        if limits and right_type and value == value:
            return limits
        return f"{'a number' if self.kind is float else 'a whole number'} {limits}".strip()


# ---- A section -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Section:
    """Mapping of a recipe file, or each mapping of a list.

    Attributes:
        path: dotted, with [] for the items of a list.
        model: the model of `schema` that checks it.
        keys: names of all its fields and sections, in order.
        leaves: its fields, by name.
        sections: the sections in it, by name.
        max_items: largest number of such mappings in a list; None if the section is no list.
        list_description: description of that list.
    """

    path: str
    model: type[BaseModel]
    keys: tuple[str, ...]
    leaves: dict[str, Leaf]
    sections: dict[str, Section]
    max_items: int | None = None
    list_description: str = ""

    @property
    def shorthand(self) -> str | None:
        """Return the field that a word in place of the mapping means, if there is one."""
        return getattr(self.model, "SHORTHAND", None)

    @cached_property
    def file_keys(self) -> frozenset[str]:
        """Return the fields that only recipe files have, such as `probability`."""
        return frozenset(self.keys) - self.model.model_fields.keys()

    @cached_property
    def has_rules(self) -> bool:
        """Return True if the model has rules between fields."""
        return bool(self.model.__pydantic_decorators__.model_validators)

    def walk(self) -> Iterator[Section]:
        """Yield this section, then all below it."""
        yield self
        for section in self.sections.values():
            yield from section.walk()


class _FileFields(ClosedModel):
    """Fields of a recipe file that a recipe in numbers does not have."""

    variants: Whole = Field(default=1, ge=1, le=1_000_000)
    """How many recipes are drawn from this file."""
    extends: Annotated[str, Strict()] | None = Field(
        default=None,
        min_length=1,
        max_length=4096,
        title="a preset's name, or a file in the recipe's folder or below it",
    )
    """The recipe whose fields hold where this file gives none."""


class _EffectFields(ClosedModel):
    """Fields of an effect in a recipe file that its model does not have."""

    probability: Unit = 1.0
    """Share of the variants that have this effect."""


def recipe_file() -> Section:
    """Return the section of a whole recipe file, which holds all others."""
    return _recipe_file(tuple(SECTIONS.items()))


def unit_of_field(path: str) -> str | None:
    """Return the unit of a recipe's field in words; None for a pure number or an unknown path.

    Args:
        path: dotted path, in which items of lists have their index.
    """
    general_path = _INDEX.sub("[]", path)
    leaves = (leaf for section in recipe_file().walk() for leaf in section.leaves.values())
    return next((leaf.unit for leaf in leaves if leaf.path == general_path), None)


@functools.lru_cache(2)
def _recipe_file(sections: tuple[tuple[str, type[BaseModel]], ...]) -> Section:
    """Return the file's section for the present effects of Recipe, which are the cache's key."""
    return _section("", Recipe, _FileFields)


def _section(
    path: str,
    model: type[BaseModel],
    file_fields: type[ClosedModel] = ClosedModel,
    list_info: FieldInfo | None = None,
) -> Section:
    leaves: dict[str, Leaf] = {}
    sections: dict[str, Section] = {}
    infos = {**model.model_fields, **file_fields.model_fields}
    if model is Recipe:
        del infos["timelines"]  # in a file each one stands in its field
    for name, info in infos.items():
        field_path = join(path, name)
        kind, nullable = _without_none(info.annotation)
        arguments = get_args(kind)
        if get_origin(kind) is tuple and arguments[1:] == (...,):
            sections[name] = _section(f"{field_path}[]", arguments[0], list_info=info)
        elif isinstance(kind, type) and issubclass(kind, BaseModel):
            is_effect = nullable and not issubclass(model, EffectModel)
            inner_fields = _EffectFields if is_effect else ClosedModel
            sections[name] = _section(field_path, kind, inner_fields)
        else:
            rangeable = bool(path) and name not in file_fields.model_fields and kind != Digest
            annotation = Annotated[kind, *info.metadata] if info.metadata else kind
            leaf = Leaf(field_path, annotation, nullable, rangeable, info=info)
            leaves[name] = replace(leaf, takes_timeline=_can_change(leaf))
    if list_info is None:
        return Section(path, model, tuple(infos), leaves, sections)
    (max_items,) = (m.max_length for m in list_info.metadata if isinstance(m, MaxLen))
    description = _one_line(list_info.description)
    return Section(path, model, tuple(infos), leaves, sections, max_items, description)


def _can_change(leaf: Leaf) -> bool:
    """Return True if a field may have a timeline.

    Seeds, files and settings of speed hold for a whole scene.
    """
    holder, _, name = leaf.path.rpartition(".")
    is_state = any(f"{holder}.".startswith(f"{path}.") for path in timeline_holders())
    is_value = leaf.is_number or leaf.kind is bool or bool(leaf.allowed_words)
    has_place = leaf.rangeable and "[]" not in leaf.path and leaf.annotation != FilePath
    return is_state and is_value and has_place and name != "seed" and leaf.path not in KNOBS


def _without_none(annotation: Any) -> tuple[Any, bool]:
    """Return the annotation without `| None`, and whether None was part of it."""
    if get_origin(annotation) not in (Union, types.UnionType):
        return annotation, False
    members = [member for member in get_args(annotation) if member is not type(None)]
    return functools.reduce(operator.or_, members), len(members) < len(get_args(annotation))


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


def _plain(number: float) -> str:
    """Return a number without exponent or trailing zeros if it is short so."""
    is_whole = isinstance(number, int) or (number.is_integer() and abs(number) < 1e15)
    return str(int(number)) if is_whole else repr(number)
