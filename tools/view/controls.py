"""Controls of a recipe's fields, made by walking its models: what there is to set, between which
ends, and how a slider's way stands for values that span decades. Nothing of a page is in here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

from pydantic import ValidationError

from recipes.effect import EffectModel
from recipes.fields import FilePath
from recipes.ranges import is_number
from recipes.recipe_file import Leaf, Section, recipe_file
from recipes.schema import SECTIONS

STEPS = 400  # of a slider
MAX_LINEAR = 10.0  # from it on a slider of numbers that are not negative is logarithmic
DECADES = 6  # that a slider spans at most
SEEN = 0.7  # the way along a logarithmic slider at which an effect is likely to be seen
LEAST = 1e-3  # of a logarithmic slider; 0 lies at its left end, where it is allowed
MAX_WORDS_WHOLE = 1000  # whole numbers in a wider range have no slider

Kind = Literal["slider", "number", "flag", "words", "colour", "rates", "file", "text", "list"]


@dataclass(frozen=True)
class Control:
    """One field. path: dotted. default: None where the field must be given, or is null. low, high:
    the ends of its slider or number. way: how a slider's way stands for them. whole: no fractions.
    words: what may be chosen.
    """

    path: str
    kind: Kind
    hint: str
    nullable: bool = False
    default: Any = None
    low: float = 0.0
    high: float = 1.0
    way: Literal["linear", "log", "both sides"] = "linear"
    whole: bool = False
    words: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        return self.path.rpartition(".")[2]

    @property
    def step(self) -> float:
        """Of a linear slider: a power of ten, or twice or five times one; of a number."""
        if self.whole:
            return 1
        if self.way != "linear":
            return self.least / 10
        exact = (self.high - self.low) / STEPS
        power = 10.0 ** math.floor(math.log10(exact))
        return next(power * k for k in (1, 2, 5, 10) if power * k >= exact * 0.999)

    @property
    def start(self) -> Any:
        """The value of a field that has none when it is switched on."""
        if self.default is not None:
            return self.default
        if self.kind == "slider":
            value = self.value_at(0.5)
            return round(value) if self.whole else value
        return {
            "number": int(max(self.low, 0)),
            "colour": [0.5] * 3,
            "rates": [1.0] * 3,
            "words": self.words[0] if self.words else "",
        }.get(self.kind)

    @property
    def least(self) -> float:
        """The smallest value but 0 of a slider that is not linear."""
        if self.way == "both sides":
            return 0.01
        return self.low if self.low > 0 else max(self.high * 10.0**-DECADES, LEAST)

    @property
    def marks(self) -> tuple[tuple[float, str], ...]:
        """Values along a slider that is not linear, and words for them: every second decade."""
        both = self.way == "both sides"
        first = 0 if both else math.ceil(math.log10(self.least))
        last = math.floor(math.log10(self.high) + 1e-9)
        values = [10.0**power for power in range(first, last + 1, 2)]
        if both:
            values = [*(-value for value in reversed(values) if value <= -self.low), 0.0, *values]
        return tuple((value, _brief(value)) for value in values)

    def value_at(self, way: float) -> float:
        """What a slider of this field stands for so far along its way, 0 to 1: three digits."""
        if self.way == "log":
            if way <= 0 and self.low <= 0:
                return max(self.low, 0.0)
            low = math.log(self.least)
            value = math.exp(low + way * (math.log(self.high) - low))
        elif self.way == "both sides":
            most = max(-self.low, self.high)
            value = self.least * math.sinh((2 * way - 1) * math.asinh(most / self.least))
        else:
            value = self.low + way * (self.high - self.low)
        return min(max(float(f"{value:.3g}"), self.low), self.high)

    def way_of(self, value: float) -> float:
        """Where a slider stands for a value; at an end where the value lies beyond."""
        if self.way == "log":
            if value <= self.least:
                return 0.0
            low = math.log(self.least)
            way = (math.log(value) - low) / (math.log(self.high) - low)
        elif self.way == "both sides":
            most = math.asinh(max(-self.low, self.high) / self.least)
            way = (math.asinh(value / self.least) / most + 1) / 2
        else:
            way = (value - self.low) / (self.high - self.low)
        return min(max(way, 0.0), 1.0)


def _brief(value: float) -> str:
    return f"{value / 1e6:g}M" if abs(value) >= 1e6 else f"{value:g}"


@dataclass(frozen=True)
class Group:
    """The controls of a section and of the sections in it. optional: null where it is absent."""

    path: str
    hint: str
    optional: bool
    controls: tuple[Control, ...]
    groups: tuple[Group, ...]

    @property
    def label(self) -> str:
        return self.path.rpartition(".")[2]

    def walk(self) -> Iterator[Control]:
        """Its controls, then those of the sections in it."""
        yield from self.controls
        for group in self.groups:
            yield from group.walk()


def group_of(path: str) -> Group:
    """The section at a dotted path: `weather.smog`, `camera`."""
    section = recipe_file()
    for name in path.split("."):
        section = section.INNER[name]
    return _group(section, optional=path in SECTIONS)


def effect_groups() -> tuple[Group, ...]:
    """Every effect that recipes know at this time."""
    return tuple(map(group_of, SECTIONS))


def _group(section: type[Section], *, optional: bool) -> Group:
    fields = section.MODEL.model_fields
    # What a section's files hold is worked out.
    is_effect = issubclass(section.MODEL, EffectModel) and section.MODEL.file_fields
    left_out = {"digest"} if is_effect else set[str]()
    leaves = [leaf for name, leaf in section.LEAVES.items() if name in fields.keys() - left_out]
    lists = [inner for inner in section.INNER.values() if inner.MAX_ITEMS is not None]
    sections = (inner for inner in section.INNER.values() if inner.MAX_ITEMS is None)
    inner = [each for each in sections if each.PATH not in SECTIONS]  # effects have their own
    return Group(
        path=section.PATH,
        hint=" ".join((section.MODEL.__doc__ or "").split()),
        optional=optional,
        controls=(*map(_control, leaves), *map(_list_control, lists)),
        groups=tuple(_group(each, optional=False) for each in inner),
    )


def _list_control(item: type[Section]) -> Control:
    hint = f"{item.LIST_DESCRIPTION} YAML, each with {', '.join(item.model_fields)}."
    return Control(item.PATH.removesuffix("[]"), "list", hint, nullable=True)


def _control(leaf: Leaf) -> Control:
    default = None if leaf.info.is_required() else leaf.info.default
    unit = f" [{leaf.unit}]" if leaf.unit else ""
    hint = f"{leaf.description}{unit}"
    own = {"path": leaf.path, "hint": hint, "nullable": leaf.nullable, "default": default}
    if leaf.kind is bool:
        return Control(kind="flag", **own)
    if leaf.is_number:
        return _numeric(leaf, own)
    if leaf.channel is not None:
        high = dict(leaf.channel.limits).get("<=", math.inf)
        return Control(kind="colour" if high == 1 else "rates", high=high, **own)
    if leaf.annotation == FilePath:
        return Control(kind="file", **own)
    if leaf.words:
        boolean = ("true", "false") if leaf.accepts(True) else ()
        return Control(kind="words", words=(*boolean, *leaf.words), **own)
    return Control(kind="text", **own)


def _numeric(leaf: Leaf, own: dict[str, Any]) -> Control:
    limits = dict(leaf.limits)
    low = limits.get(">=", limits.get(">", -math.inf))
    high = limits.get("<=", limits.get("<", math.inf))
    whole = leaf.kind is int
    if math.isinf(low) or math.isinf(high) or (whole and high - low > MAX_WORDS_WHOLE):
        return Control(kind="number", low=low, high=high, whole=whole, **own)
    way: Literal["linear", "log", "both sides"] = "linear"
    if not whole and "_deg" not in leaf.path:
        if low >= 0 and (high >= MAX_LINEAR or (low > 0 and high > 100 * low)):
            way = "log"
        elif low < 0 and high - low > 2 * MAX_LINEAR:
            way = "both sides"
    control = Control(kind="slider", low=low, high=high, way=way, whole=whole, **own)
    if ">" not in limits:
        return control
    # The end itself is not allowed.
    return replace(control, low=low + control.step if way == "linear" else control.least)


def start_of_model(section: str) -> dict[str, Any]:
    """Values that make a valid section which changes something: the middle of what must be given,
    and of one field more where the section's rules want one, or where it is 0.
    """
    model, controls = SECTIONS[section], group_of(section).controls
    required = [c for c in controls if model.model_fields[c.label].is_required()]
    needed = {c.label: c.value_at(SEEN) if c.way == "log" else c.start for c in required}
    optional = [{c.label: c.start} for c in controls if c.nullable and is_number(c.start)]
    zero = [c for c in controls if c.kind == "slider" and c.default == 0 and not c.nullable]
    some = [{c.label: (int if c.whole else float)(c.value_at(0.2))} for c in zero]
    for more in ({}, *optional, *some):
        try:
            made = model.model_validate(needed | more)
        except ValidationError:
            continue
        if made.changes:
            return needed | more
    return needed
