"""A recipe as it is written, with its ranges, and the recipes in numbers that it stands for."""

from __future__ import annotations

import enum
import functools
import hashlib
import itertools
import json
import math
import operator
import re
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any, Literal, TypeGuard, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen
from pydantic import BaseModel, Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from recipes.errors import RecipeError
from recipes.fields import (
    Colour,
    Digest,
    FilePath,
    Flag,
    Number,
    OneOf,
    PerMetre,
    Rates,
    Unit,
    Whole,
)
from recipes.files import file_below, with_digest
from recipes.schema import SECTIONS, VERSION, Recipe

# ---- The random numbers of a recipe: each a pure function of (seed, variant, name of the field) --
# No generator hands its state from draw to draw: a new field or variant leaves all others alone.

_DOMAIN = "climategs recipe draw 1"  # a change of the scheme changes this, never silently a number


@dataclass(frozen=True)
class Draws:
    """The numbers of one variant."""

    seed: int
    variant: int

    def unit(self, path: str) -> float:
        """The number in [0, 1) that belongs to `path`: 53 bits of a SHA-256."""
        key = json.dumps([_DOMAIN, self.seed, self.variant, path])
        digest = hashlib.sha256(key.encode()).digest()
        return (int.from_bytes(digest[:8], "big") >> 11) * 2.0**-53


# ---- How one field of a recipe gets its value: a fixed one, or a draw from a range ---------------
# Drawn floats have 10 significant digits: exp, log and erf differ in the last bit by platform.

Triple = tuple[float, float, float]  # a colour, or three rates
RANGE_KINDS = ("uniform", "log_uniform", "normal", "choice")
Plain = bool | int | float | str | Triple | None


# What a template holds for a field has `is_range`, False where every variant gets the same; `draw`,
# the value of one variant, the path naming its random number; `probes`, the extreme values and
# every option, all of which must be allowed; and `describe`, the range in words, without its unit.


@dataclass(frozen=True)
class Fixed:
    value: Plain
    is_range = False

    def draw(self, draws: Draws, path: str) -> Plain:
        return self.value

    def probes(self) -> tuple[Plain, ...]:
        return (self.value,)

    def describe(self) -> str:
        return words(self.value)


@dataclass(frozen=True)
class Uniform:
    """Every value from low to high alike; both ends included where whole.

    log: of the logarithm, as often between 10 and 20 as between 100 and 200; 0 < low.
    """

    low: float
    high: float
    whole: bool = False
    log: bool = False
    is_range = True

    def draw(self, draws: Draws, path: str) -> float:
        unit, low, high = draws.unit(path), self.low, self.high
        if self.log:
            top = high + 1 if self.whole else high  # k stands for the reals in [k, k + 1)
            start, end = math.log(low), math.log(top)
            drawn = math.exp(start + unit * (end - start))
        elif self.whole:
            drawn = low + unit * (high - low + 1)
        else:
            drawn = low + unit * (high - low)
        return _whole(drawn, low, high) if self.whole else _rounded(drawn, low, high)

    def probes(self) -> tuple[float, ...]:
        return (self.low, self.high)

    def describe(self) -> str:
        kind = "log-uniform" if self.log else "uniform"
        return f"{kind} from {words(self.low)} to {words(self.high)}"


@dataclass(frozen=True)
class Normal:
    """Normal, cut off at low and high, by the inverse of its distribution. low <= mean <= high."""

    mean: float
    std: float
    low: float
    high: float
    whole: bool = False
    is_range = True

    def draw(self, draws: Draws, path: str) -> float:
        margin = 0.5 if self.whole else 0.0  # a whole number stands for the reals that round to it
        normal = NormalDist(self.mean, self.std)
        below = normal.cdf(self.low - margin)
        inside = normal.cdf(self.high + margin) - below
        # inv_cdf takes no 0 or 1; the values it would give there are cut off to an end anyway
        probability = min(max(below + draws.unit(path) * inside, 1e-300), 1 - 2.0**-53)
        drawn = normal.inv_cdf(probability)
        if self.whole:
            return _whole(drawn + 0.5, self.low, self.high)
        return _rounded(drawn, self.low, self.high)

    def probes(self) -> tuple[float, ...]:
        return (self.low, self.high)

    def describe(self) -> str:
        return (
            f"normal with mean {words(self.mean)} and deviation {words(self.std)}, "
            f"from {words(self.low)} to {words(self.high)}"
        )


@dataclass(frozen=True)
class Choice:
    """One of the options, which may be ranges themselves. weights: >= 0, their sum > 0."""

    options: tuple[Value, ...]
    weights: tuple[float, ...]
    is_range = True

    def draw(self, draws: Draws, path: str) -> Plain:
        remaining = draws.unit(path) * math.fsum(self.weights)
        chosen = -1
        for index, weight in enumerate(self.weights):
            if weight > 0:
                chosen = index
                if remaining < weight:
                    break
                remaining -= weight
        return self.options[chosen].draw(draws, f"{path}.choice[{chosen}]")

    def probes(self) -> tuple[Plain, ...]:
        return tuple(probe for option in self.options for probe in option.probes())

    def describe(self) -> str:
        total = math.fsum(self.weights)
        even = len(set(self.weights)) == 1
        parts = [
            option.describe() + ("" if even else f" ({100 * weight / total:.3g} %)")
            for option, weight in zip(self.options, self.weights, strict=True)
        ]
        return f"one of {', '.join(parts)}"


@dataclass(frozen=True)
class TripleLine:
    """On the straight line from one to another: one random number, so no odd mixtures."""

    start: Triple
    end: Triple
    is_range = True

    def draw(self, draws: Draws, path: str) -> Triple:
        unit = draws.unit(path)
        ends = zip(self.start, self.end, strict=True)
        return as_triple(_rounded(a + unit * (b - a), min(a, b), max(a, b)) for a, b in ends)

    def probes(self) -> tuple[Triple, ...]:
        return (self.start, self.end)

    def describe(self) -> str:
        return f"uniform from {words(self.start)} to {words(self.end)}"


@dataclass(frozen=True)
class Channels:
    """Three channels that are drawn one by one."""

    channels: tuple[Value, Value, Value]
    is_range = True

    def draw(self, draws: Draws, path: str) -> Triple:
        return as_triple(c.draw(draws, f"{path}[{i}]") for i, c in enumerate(self.channels))

    def probes(self) -> tuple[Triple, ...]:
        probes = [[as_number(probe) for probe in channel.probes()] for channel in self.channels]
        return (as_triple(map(min, probes)), as_triple(map(max, probes)))

    def describe(self) -> str:
        return f"[{', '.join(channel.describe() for channel in self.channels)}]"


Value = Fixed | Uniform | Normal | Choice | TripleLine | Channels


def _rounded(drawn: float, low: float, high: float) -> float:
    return min(max(float(f"{drawn:.10g}"), low), high)


def _whole(drawn: float, low: float, high: float) -> int:
    return min(max(math.floor(drawn), int(low)), int(high))


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether this is a number; True and False are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def as_number(value: Plain) -> float:
    """The value of a field that was checked to hold a number."""
    assert is_number(value), value
    return value


def as_triple(values: Iterable[Plain]) -> Triple:
    """The three channels of a field that was checked to hold a colour or rates."""
    red, green, blue = map(as_number, values)
    return (red, green, blue)


def words(value: Plain) -> str:
    """A value as it would be written in a recipe, floats shortened."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(words(channel) for channel in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


# ---- The fields of a recipe as a table, read off the models of `schema`: nothing is stated twice -
# The loader, its messages, the JSON Schema and the documentation all walk `root()`.

# the end of a field's name says its unit
UNITS = {
    "_per_m": "1/metre",
    "_m": "metres",
    "_deg": "degrees",
    "_ntu": "nephelometric turbidity units",
}

_LIMITS = {Gt: (">", "gt"), Ge: (">=", "ge"), Lt: ("<", "lt"), Le: ("<=", "le")}


class Kind(enum.Enum):
    """What a field holds, in the words of the messages."""

    NUMBER = "a number"
    WHOLE = "a whole number"
    FLAG = "true or false"
    WORD = "one of"
    COLOUR = "a colour"
    RATES = "three rates"
    TEXT = "up to 64 letters, digits, '.', '_' or '-', the first a letter or a digit"
    PATH = "a file in the recipe's folder or below it"
    DIGEST = "64 hexadecimal digits, small letters"

    @property
    def is_text(self) -> bool:
        """Whether it is taken as it is written, though it may look like a number."""
        return self in (Kind.TEXT, Kind.PATH, Kind.DIGEST)


_KINDS = (
    (FilePath, Kind.PATH),
    (Digest, Kind.DIGEST),
    (Colour, Kind.COLOUR),
    (Rates, Kind.RATES),
    *((float, Kind.NUMBER), (int, Kind.WHOLE), (bool, Kind.FLAG), (str, Kind.TEXT)),
)


@dataclass(frozen=True)
class FieldSpec:
    """One field that holds a value.

    path: as in a file, with [] for the items of a list. annotation: what pydantic checks a value
    against. limits: pairs such as (">", 0.0). words: what a WORD may be, or a FLAG besides true and
    false. channel: what each of a COLOUR's or RATES' three numbers is; None for other kinds.
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
    def unit(self) -> str | None:
        """The unit in words; None for a pure number."""
        return next((unit for end, unit in UNITS.items() if self.path.endswith(end)), None)

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
        else:
            text = self.kind.value if self.kind.is_text else self._allowed_number(value)
        if self.unit and self.channel is None:
            text += f" ({self.unit})"
        return text + (", or null" if self.nullable and not is_number(value) else "")

    def _allowed_number(self, value: object) -> str:
        limits = " and ".join(f"{sign} {plain(bound)}" for sign, bound in self.limits)
        right_type = is_number(value) and (isinstance(value, int) or self.kind is Kind.NUMBER)
        is_close = limits and right_type and value == value
        return limits if is_close else f"{self.kind.value} {limits}".strip()

    @property
    def without_null(self) -> FieldSpec:
        return replace(self, nullable=False)


@dataclass(frozen=True)
class SectionSpec:
    """A mapping of fields. effect: it may be absent, and then has a probability of being there.

    max_items: set where a list of up to so many such mappings stands, which `list_description`
    describes; the path then ends in []. shorthand: name of the field whose value may stand in place
    of the mapping.
    """

    path: str
    model: type[BaseModel]
    description: str
    effect: bool = False
    max_items: int | None = None
    list_description: str = ""
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
    path: str, model: type[BaseModel], *, effect: bool = False, of_list: FieldInfo | None = None
) -> SectionSpec:
    most = [m.max_length for m in of_list.metadata if isinstance(m, MaxLen)] if of_list else [None]
    spec = SectionSpec(
        path,
        model,
        _one_line(model.__doc__),
        effect,
        max_items=most[0],
        list_description=_one_line(of_list.description if of_list else None),
        shorthand=getattr(model, "SHORTHAND", None),
    )
    for name, info in model.model_fields.items():
        below = join(path, name)
        inner, nullable = _without_none(info.annotation)
        arguments = get_args(inner)
        if get_origin(inner) is tuple and arguments[1:] == (...,):
            spec.sections[name] = _section(f"{below}[]", arguments[0], of_list=info)
        elif isinstance(inner, type) and issubclass(inner, BaseModel):
            spec.sections[name] = _section(below, inner, effect=nullable)
        else:
            spec.fields[name] = _field(below, info, rangeable=bool(path))
    if effect:
        share = Field(default=1.0, description="Share of the variants that have this effect.")
        spec.extra["probability"] = _spec(join(path, "probability"), Unit, share, rangeable=False)
    return spec


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


def _spec(path: str, annotation: Any, info: Any, *, rangeable: bool = True) -> FieldSpec:
    """A field that no model of the schema has."""
    return _field(path, FieldInfo.from_annotated_attribute(annotation, info), rangeable=rangeable)


def _field(path: str, info: FieldInfo, *, rangeable: bool) -> FieldSpec:
    inner, nullable = _without_none(info.annotation)
    bounds = [
        (sign, getattr(rule, attribute))
        for rule in info.metadata
        for kind, (sign, attribute) in _LIMITS.items()
        if isinstance(rule, kind)
    ]
    required, (kind, labels) = info.is_required(), _kind(inner)
    return FieldSpec(
        path=path,
        kind=kind,
        description=_one_line(info.description),
        annotation=Annotated[info.annotation, info],
        nullable=nullable,
        default=None if required else info.default,
        limits=tuple(bounds),
        words=labels,
        rangeable=rangeable and kind is not Kind.DIGEST,
        required=required,
        channel=CHANNEL if kind is Kind.COLOUR else RATE if kind is Kind.RATES else None,
    )


def _without_none(annotation: Any) -> tuple[Any, bool]:
    """The annotation without `| None`, and whether None was there."""
    if get_origin(annotation) not in (Union, types.UnionType):
        return annotation, False
    members = [member for member in get_args(annotation) if member is not type(None)]
    nullable = len(members) < len(get_args(annotation))
    return functools.reduce(operator.or_, members), nullable


def _kind(annotation: Any) -> tuple[Kind, tuple[str, ...]]:
    """What a field of this type holds, and the words that it may be."""
    for known, kind in _KINDS:
        if annotation == known:
            return kind, ()
    if get_origin(annotation) is Literal:
        return Kind.WORD, tuple(map(str, get_args(annotation)))
    if get_origin(annotation) is Annotated:  # Number and its like
        named = [rule.names() for rule in annotation.__metadata__ if isinstance(rule, OneOf)]
        return (Kind.WORD, named[0]) if named else _kind(get_args(annotation)[0])
    flag, choices = get_args(annotation)  # true, false, or a word
    assert flag == Flag, annotation
    return Kind.FLAG, _kind(choices)[1]


CHANNEL = _spec("channel", Unit, Field(description="One channel of a colour."))
RATE = _spec("rate_per_m", PerMetre, Field(description="One channel of three rates."))
ANY_NUMBER = _spec("number", Number, Field(allow_inf_nan=False))


def root() -> SectionSpec:
    """The fields of recipe files."""
    return _root(tuple(SECTIONS.items()))


@functools.lru_cache(2)
def _root(sections: tuple[tuple[str, type[BaseModel]], ...]) -> SectionSpec:
    """sections: those of Recipe at the time."""
    spec = _section("", Recipe)
    text = "How many recipes are drawn from this file."
    variants = Field(default=1, ge=1, le=1_000_000, description=text)
    spec.extra["variants"] = _spec("variants", Whole, variants, rangeable=False)
    return spec


# ---- What a file says, and the recipes that it stands for ----------------------------------------

_INDEX = re.compile(r"\[[0-9]+\]")


@dataclass(frozen=True)
class RecipeTemplate:
    """A loaded recipe file.

    source: where it was read from, for messages. variants: how many recipes a run draws from it;
    first_variant: the number of the first. values: how each field that the file gives gets its
    value, by dotted path. effects: the share of variants that have it, of each effect that the file
    names. lists: how many items, of each list. folder: where the files lie that values name.
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
        only, so there is no end to the variants. Files that it names are found and read: the recipe
        has their absolute paths, and a digest of what they hold.

        Raises:
            RecipeError: variant is negative or too large, what was drawn breaks a rule, or a file
                cannot be read or is not the one of which the recipe gives the digest.
        """
        number = self.first_variant + variant
        if variant < 0 or not root().fields["variant"].accepts(number):
            allowed = root().fields["variant"].allowed(number)
            raise RecipeError(f"{self.source}: variant = {variant}: must be {allowed}")
        draws = Draws(self.seed, number)
        data: dict[str, Any] = {"version": VERSION, "name": self.name, "seed": self.seed}
        data["variant"] = number
        absent: tuple[str, ...] = ()
        for path, probability in self.effects:
            present = draws.unit(f"{path}.probability") < probability
            _put(data, path, {} if present else None)
            absent += () if present else (f"{path}.",)
        for path, count in self.lists:
            if not path.startswith(absent):
                _put(data, path, [{} for _ in range(count)])
        where = f"{self.source}: variant {number}"
        files = {f"{p}.{name}" for p, model in SECTIONS.items() for name in model.file_fields}
        for path, value in self.values:
            if not path.startswith(absent):
                drawn = value.draw(draws, path)
                is_file = path in files and drawn is not None
                _put(data, path, self._file(path, str(drawn), where) if is_file else drawn)
        try:
            return with_digest(Recipe.model_validate(data))
        except ValidationError as error:
            raise RecipeError(*(f"{where}: {text}" for text in readable(error))) from None
        except RecipeError as error:
            raise RecipeError(f"{self.source}: {error}") from None

    def _file(self, path: str, written: str, where: str) -> str:
        """The absolute path of a file that a field names."""
        try:
            if self.folder is None:
                raise ValueError("the recipe is in no folder to look in")
            return str(file_below(self.folder, written))
        except ValueError as error:
            raise RecipeError(f"{where}: {path} = {written!r}: {error}") from None

    def describe_ranges(self) -> dict[str, str]:
        """Dotted path -> its range in words, with the unit; only what differs between variants."""
        units = {spec.path: spec.unit for part in root().walk() for spec in part.fields.values()}
        described = {
            path: f"present with probability {probability:g}"
            for path, probability in self.effects
            if probability < 1
        }
        for path, value in self.values:
            if value.is_range:
                unit = units.get(_INDEX.sub("[]", path))
                described[path] = value.describe() + (f" ({unit})" if unit else "")
        return described


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


# ---- Rules between the fields of a section, tried at the ends of their ranges before any draw ----

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
    found: set[str] = set()
    corners = {
        k: _ends(v, k in spec.fields and spec.fields[k].kind.is_text) for k, v in given.items()
    }
    for combination in itertools.product(*corners.values()):
        corner = dict(zip(corners, combination, strict=True))
        try:
            spec.model.model_validate(corner)
        except ValidationError as error:
            drawn = [_drawn(k, v, corner[k]) for k, v in given.items() if v.is_range]
            where = f" (in a draw with {', '.join(drawn)})" if drawn else ""
            texts = dict.fromkeys(readable(error))
            yield from (f"{text}{where}" for text in texts if text not in found)
            found.update(texts)


def _drawn(name: str, value: Value | Items, end: Any) -> str:
    if isinstance(value, Items):
        which = "low" if end == value.ends()[0] else "high"
        return f"all {name} at the {which} ends of their ranges"
    return f"{name} = {words(end)}"


def _ends(value: Value | Items, is_free_text: bool) -> list[Any]:
    """What a rule between fields can depend on: the extreme numbers, null, and every word.

    A handful, for the product over a section's fields. No rule compares colours or names of files.
    """
    if isinstance(value, Items):
        return list(value.ends())
    probes = value.probes()
    numbers = [p for p in probes if is_number(p)]
    triples = [p for p in probes if isinstance(p, tuple)]
    others = [p for p in probes if p is None or isinstance(p, str | bool)]
    if is_free_text:
        others = sorted(others, key=lambda p: p is not None)[: 1 + (None in others)]
    ends: list[Plain] = [min(numbers), max(numbers)] if numbers else []
    return list(dict.fromkeys([*ends, *triples[:1], *others]))


def _outer(value: Value | Items) -> tuple[Any, Any]:
    """The least and the greatest number; of what is none, the first and the last option."""
    if isinstance(value, Items):
        return value.ends()
    probes = value.probes()
    numbers = [p for p in probes if is_number(p)]
    return (min(numbers), max(numbers)) if numbers else (probes[0], probes[-1])
