"""The fields of a recipe as a table, read off the models of `schema`: nothing is stated twice.

The loader, its messages, the JSON Schema and the documentation all walk `ROOT`.
"""

from __future__ import annotations

import enum
import types
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import BaseModel, Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from recipes.schema import VERSION, Recipe
from recipes.style import StyleName
from recipes.style_presets import style_preset_names
from recipes.types import (
    MOST_PER_M,
    Colour,
    Digest,
    FilePath,
    Flag,
    Number,
    PerMetre,
    Rates,
    Unit,
    Whole,
)
from recipes.values import is_number

# the end of a field's name says its unit
UNITS = {
    "_per_m": "1/metre",
    "_m": "metres",
    "_deg": "degrees",
    "_ntu": "nephelometric turbidity units",
}

_LIMITS = {
    annotated_types.Gt: (">", "gt"),
    annotated_types.Ge: (">=", "ge"),
    annotated_types.Lt: ("<", "lt"),
    annotated_types.Le: ("<=", "le"),
}


class Kind(enum.Enum):
    """What a field holds, in the words of the messages."""

    NUMBER = "a number"
    WHOLE = "a whole number"
    FLAG = "true or false"
    WORD = "one of"
    COLOUR = "a colour"
    RATES = "three rates"
    TEXT = "text"
    PATH = "a file in the recipe's folder or below it"
    DIGEST = "64 hexadecimal digits, small letters"

    @property
    def is_text(self) -> bool:
        """Whether it is taken as it is written, though it may look like a number."""
        return self in (Kind.TEXT, Kind.PATH, Kind.DIGEST)


_TEXTS = ((StyleName, Kind.WORD), (FilePath, Kind.PATH), (Digest, Kind.DIGEST))


@dataclass(frozen=True)
class FieldSpec:
    """One field that holds a value.

    path: as in a file, with [] for the items of a list. limits: pairs such as (">", 0.0). words:
    what a WORD may be, or a FLAG besides true and false. rangeable: a range may stand here.
    required: there is no default.
    annotation: what pydantic checks a value against. channel: what each of a COLOUR's or RATES'
    three numbers is; None for other kinds.
    """

    path: str
    kind: Kind
    description: str
    annotation: Any
    nullable: bool = False
    default: Any = None
    limits: tuple[tuple[str, float], ...] = ()
    words: tuple[str, ...] = ()
    rangeable: bool = True
    required: bool = False
    channel: FieldSpec | None = None

    @property
    def name(self) -> str:
        return self.path.rpartition(".")[2]

    @property
    def unit(self) -> str | None:
        """The unit in words; None for a pure number."""
        for suffix, unit in UNITS.items():
            if self.name.endswith(suffix):
                return unit
        return None

    @cached_property
    def _adapter(self) -> TypeAdapter[Any]:
        return TypeAdapter(self.annotation)

    def accepts(self, value: object) -> bool:
        """Whether the schema takes this value."""
        if value is None:
            return self.nullable
        try:
            self._adapter.validate_python(value)
        except ValidationError:
            return False
        return True

    def allowed(self, value: object = None) -> str:
        """What may stand here. `value`: the one refused; what is right about it goes unsaid."""
        if self.kind is Kind.WORD:
            text = f"one of {', '.join(self.words)}"
        elif self.kind is Kind.FLAG and self.words:
            text = f"{', '.join(('true', 'false', *self.words[:-1]))} or {self.words[-1]}"
        elif self.channel is not None:
            text = f"[red, green, blue], each {self.channel.allowed()}"
        elif self.kind is Kind.TEXT:
            text = "up to 64 letters, digits, '.', '_' or '-', the first a letter or a digit"
        elif self.kind.is_text:
            text = self.kind.value
        else:
            text = self._allowed_number(value)
        if self.unit and self.channel is None:
            text += f" ({self.unit})"
        return text + (", or null" if self.nullable and not is_number(value) else "")

    def _allowed_number(self, value: object) -> str:
        limits = " and ".join(f"{sign} {plain(bound)}" for sign, bound in self.limits)
        right_type = is_number(value) and (isinstance(value, int) or self.kind is Kind.NUMBER)
        if limits and right_type and value == value:
            return limits
        return f"{self.kind.value} {limits}".strip()

    @property
    def without_null(self) -> FieldSpec:
        return replace(self, nullable=False)


@dataclass(frozen=True)
class ListSpec:
    """A list of mappings, which may be absent. most: how many. description: of all of them."""

    most: int
    description: str


@dataclass(frozen=True)
class SectionSpec:
    """A mapping of fields. effect: it may be absent, and then has a probability of being there.

    items: set where not one such mapping stands but a list of them; the path then ends in [].
    shorthand: name of the field whose value may stand in place of the mapping.
    """

    path: str
    model: type[BaseModel]
    description: str
    effect: bool = False
    items: ListSpec | None = None
    shorthand: str | None = None
    fields: dict[str, FieldSpec] = field(default_factory=dict)
    sections: dict[str, SectionSpec] = field(default_factory=dict)
    extra: dict[str, FieldSpec] = field(default_factory=dict)

    @property
    def known(self) -> tuple[str, ...]:
        """Every key that may stand here, fields of the template alone included."""
        return (*self.fields, *self.extra, *self.sections)

    def walk(self) -> Iterator[SectionSpec]:
        """This section, then all below it."""
        yield self
        for section in self.sections.values():
            yield from section.walk()


def plain(number: float) -> str:
    """A number without exponent or trailing zeros where it is short so."""
    whole = isinstance(number, int) or (number.is_integer() and abs(number) < 1e15)
    return str(int(number)) if whole else repr(number)


def join(path: str, name: str) -> str:
    """The dotted path of a key in a section; '' is the top."""
    return f"{path}.{name}" if path else name


def _section(
    path: str, model: type[BaseModel], *, effect: bool = False, items: ListSpec | None = None
) -> SectionSpec:
    description = " ".join((model.__doc__ or "").split())
    shorthand: str | None = getattr(model, "SHORTHAND", None)
    spec = SectionSpec(path, model, description, effect, items, shorthand)
    for name, info in model.model_fields.items():
        below = join(path, name)
        inner, nullable = _without_none(info.annotation)
        item = _item(inner)
        if item is not None:
            items = ListSpec(_most(info), info.description or "")
            spec.sections[name] = _section(f"{below}[]", item, items=items)
        elif isinstance(inner, type) and issubclass(inner, BaseModel):
            spec.sections[name] = _section(below, inner, effect=nullable)
        else:
            spec.fields[name] = _field(below, info, rangeable=bool(path))
    if effect:
        spec.extra["probability"] = FieldSpec(
            path=join(path, "probability"),
            kind=Kind.NUMBER,
            description="Share of the variants that have this effect.",
            annotation=Unit,
            default=1.0,
            limits=((">=", 0.0), ("<=", 1.0)),
            rangeable=False,
        )
    return spec


def _field(path: str, info: FieldInfo, *, rangeable: bool) -> FieldSpec:
    inner, nullable = _without_none(info.annotation)
    bounds = [
        (sign, getattr(rule, attribute))
        for rule in info.metadata
        for kind, (sign, attribute) in _LIMITS.items()
        if isinstance(rule, kind)
    ]
    required, kind = info.is_required(), _kind(inner)
    return FieldSpec(
        path=path,
        kind=kind,
        description=info.description or "",
        annotation=Annotated[info.annotation, info],
        nullable=nullable,
        default=None if required else info.default,
        limits=tuple(bounds),
        words=_words(inner),
        rangeable=rangeable and kind is not Kind.DIGEST,
        required=required,
        channel={Kind.COLOUR: CHANNEL, Kind.RATES: RATE}.get(kind),
    )


def _item(annotation: Any) -> type[BaseModel] | None:
    """The model of a list's items; None for what is no list of models."""
    arguments = get_args(annotation)
    if get_origin(annotation) is not tuple or arguments[1:] != (...,):
        return None
    item: type[BaseModel] = arguments[0]
    return item


def _most(info: FieldInfo) -> int:
    (most,) = (r.max_length for r in info.metadata if isinstance(r, annotated_types.MaxLen))
    return most


def _without_none(annotation: Any) -> tuple[Any, bool]:
    """The annotation without `| None` and `Annotated`, and whether None was there.

    The kinds of text stay as they are annotated: nothing else tells them apart.
    """
    nullable = False
    if get_origin(annotation) in (Union, types.UnionType):
        members = [member for member in get_args(annotation) if member is not type(None)]
        nullable = len(members) < len(get_args(annotation))
        if len(members) == 2 and members[0] == Flag and get_origin(members[1]) is Literal:
            return members[0] | members[1], nullable
        assert len(members) == 1, f"a field is of one type or null, or a flag or a word; {members}"
        annotation = members[0]
    if get_origin(annotation) is Annotated and all(annotation != text for text, _ in _TEXTS):
        annotation = get_args(annotation)[0]
    return annotation, nullable


def _words(annotation: Any) -> tuple[str, ...]:
    if annotation == StyleName:
        return style_preset_names()
    if get_origin(annotation) in (Union, types.UnionType):  # true, false, or a word
        annotation = get_args(annotation)[1]
    return tuple(map(str, get_args(annotation))) if get_origin(annotation) is Literal else ()


def _kind(annotation: Any) -> Kind:
    for text, kind in _TEXTS:
        if annotation == text:
            return kind
    if annotation == Colour:
        return Kind.COLOUR
    if annotation == Rates:
        return Kind.RATES
    if get_origin(annotation) is Literal:
        return Kind.WORD
    if get_origin(annotation) in (Union, types.UnionType):
        return Kind.FLAG
    return {float: Kind.NUMBER, int: Kind.WHOLE, bool: Kind.FLAG, str: Kind.TEXT}[annotation]


CHANNEL = FieldSpec(
    path="channel",
    kind=Kind.NUMBER,
    description="One channel of a colour.",
    annotation=Unit,
    limits=((">=", 0.0), ("<=", 1.0)),
)
RATE = FieldSpec(
    path="rate_per_m",
    kind=Kind.NUMBER,
    description="One channel of three rates.",
    annotation=PerMetre,
    limits=((">=", 0.0), ("<=", MOST_PER_M)),
)
ANY_NUMBER = FieldSpec("number", Kind.NUMBER, "", Annotated[Number, Field(allow_inf_nan=False)])
VARIANTS = FieldSpec(
    path="variants",
    kind=Kind.WHOLE,
    description="How many recipes are drawn from this file.",
    annotation=Annotated[Whole, Field(ge=1, le=1_000_000)],
    default=1,
    limits=((">=", 1), ("<=", 1_000_000)),
    rangeable=False,
)


def _root() -> SectionSpec:
    root = _section("", Recipe)
    root.extra["variants"] = VARIANTS
    assert root.fields["version"].words == (str(VERSION),)
    return root


ROOT = _root()
