"""Controls of a recipe's fields, made by walking its models: what there is to set, between which
ends, how a slider's way stands for values that span decades, and which fields come first. Nothing
of a page is in here.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterator, Sequence
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
MAX_HINT = 180  # characters of a tooltip
BOX_DIGITS = 3  # more of the box than a step of it has
MAX_MARKS = 5  # along a logarithmic slider, a decade from each other
MIN_WAY_OF_MARKS = 0.15  # between two marks: their words would run into each other

# The fields that a page shows first, by section: what a weather report or a road user would say of
# the weather. All others, and effects without an entry, come under "more".
MAIN_FIELDS = {
    "weather.smog": ("visibility_m",),  # as weather services and drivers tell fog
    "weather.rain": ("rate_mm_h", "wetness"),  # what falls, and how dark and bright the road gets
    "weather.snowfall": ("rate_mm_h",),
    "weather.snow": ("depth_m", "coverage"),  # whether kerbs and lane marks can be seen
    "weather.flood": ("level_m", "turbidity_ntu"),  # how far up, and whether the bed is seen
    "style": ("preset", "strength"),  # the light of the day
}

# Words beside a section's name, where the name alone does not tell a driver what it is.
PLAIN_WORDS = {
    "weather.smog": "fog, haze",
    "weather.snow": "lying",
    "weather.snowfall": "flakes",
    "style": "light",
}

# Ends of sliders, where those that the recipe's model allows are far beyond what anyone looks for;
# the box beside a slider takes all that the model allows. Of a logarithmic slider the lower end is
# the least value but 0. Presets draw from within all of these.
USEFUL_ENDS = {
    "weather.smog.visibility_m": (10.0, 20_000.0),  # a car's length ahead; a clear day begins
    "weather.smog.extinction_per_m": (2e-4, 0.4),  # the same by Koschmieder's law
    "weather.smog.scale_height_m": (1.0, 2000.0),  # ground fog; the mixing layer
    "weather.smog.base_height_m": (-50.0, 50.0),  # a valley below, a hill above
    "weather.smog.scatter": (0.0, 2.0),  # twice what droplets diffract
    "weather.flood.level_m": (-1.0, 3.0),  # to the first floor
    "weather.flood.turbidity_ntu": (0.1, 1000.0),  # tap water; a river of mud
    "weather.flood.waves.height": (0.05, 5.0),
    "weather.snow.depth_m": (0.001, 1.0),  # hoar; over the bonnets
    "weather.snow.cell_m": (0.01, 1.0),
    "weather.rain.rate_mm_h": (0.1, 200.0),  # drizzle; a cloudburst
    "weather.rain.wind_mps": (0.1, 40.0),  # a hurricane begins at 33
    "weather.rain.min_width_px": (0.1, 4.0),
    "weather.snowfall.rate_mm_h": (0.05, 20.0),
    "weather.snowfall.wind_mps": (0.01, 40.0),
    "weather.snowfall.min_width_px": (0.1, 4.0),
    "camera.lens_drops.radius_mm": (0.1, 5.0),
    "camera.lens_drops.glass_m": (0.01, 1.0),
    "camera.lens_drops.focal_mm": (1.0, 100.0),
    "camera.lens_drops.f_number": (0.9, 22.0),
    "camera.lens_drops.wiper_s": (0.5, 60.0),
    "camera.noise": (0.0, 0.03),
    "camera.psf_px": (0.1, 4.0),
    "camera.exposure_ms": (0.1, 50.0),
    "render.scale": (0.1, 2.0),
    "render.near_m": (0.01, 10.0),
    "render.radius_clip_px": (0.1, 10.0),
    "render.lod_px": (0.1, 10.0),
}
FULL_TURN = 360.0  # degrees: directions run from 0, though models allow -360 to 360 of them
MAX_BOTH_SIDES = 100.0  # a slider of both signs without an entry runs no farther to either side

# By the end of a field's name, the longer end first.
UNIT_SYMBOLS = {
    "_per_m": "1/m",
    "_mm_h": "mm/h",
    "_mps": "m/s",
    "_deg": "degrees",
    "_ntu": "NTU",
    "_mm": "mm",
    "_ms": "ms",
    "_px": "px",
    "_m": "m",
    "_s": "s",
}

Kind = Literal["slider", "number", "flag", "words", "colour", "rates", "file", "text", "list"]


@dataclass(frozen=True)
class Control:
    """One field of a recipe, as something to set."""

    path: str
    """Dotted: "weather.smog.visibility_m"."""
    kind: Kind
    """The widget that it gets."""
    hint: str
    """What the field means, and its unit."""
    nullable: bool = False
    """Whether the field may be null."""
    default: Any = None
    """Its value where nothing is given; None where the field must be given, or is null."""
    low: float = 0.0
    """The lower end of its slider or number."""
    high: float = 1.0
    """The upper end of its slider or number."""
    valid: tuple[float, float] = (-math.inf, math.inf)
    """The ends of what its model allows, which its box takes."""
    least_value: float | None = None
    """The smallest value but 0 of a logarithmic slider; None for one that follows from its ends."""
    way: Literal["linear", "log", "both sides"] = "linear"
    """How the way along its slider stands for the values."""
    whole: bool = False
    """Whether it has no fractions."""
    words: tuple[str, ...] = ()
    """What may be chosen, where that can be listed."""

    @property
    def label(self) -> str:
        return self.path.rpartition(".")[2]

    @property
    def unit(self) -> str:
        """The unit's symbol; empty for a pure number."""
        return next((u for end, u in UNIT_SYMBOLS.items() if self.path.endswith(end)), "")

    @property
    def tooltip(self) -> str:
        """The hint's first sentence, cut at a word where it is long; and the unit."""
        said, bracket, unit = self.hint.partition(" [")
        return shorten(said) + (bracket + unit)

    @property
    def has_box(self) -> bool:
        """Whether the exact number has a box of its own: the slider's takes no other values than
        the slider, and of one that is not linear it holds the place along the way.
        """
        return self.way != "linear" or (self.low, self.high) != self.valid

    @property
    def step(self) -> float:
        """Of a linear slider: a power of ten, or twice or five times one."""
        if self.whole:
            return 1
        exact = (self.high - self.low) / STEPS
        power = 10.0 ** math.floor(math.log10(exact))
        return next(power * k for k in (1, 2, 5, 10) if power * k >= exact * 0.999)

    @property
    def box_step(self) -> float:
        """What an arrow beside the box adds."""
        return self.step if self.way == "linear" else self.least

    @property
    def box_digits(self) -> int:
        """Digits behind the point that the box takes."""
        return 0 if self.whole else BOX_DIGITS + max(0, math.ceil(-math.log10(self.box_step)))

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
        if self.least_value is not None:
            return self.least_value
        return self.low if self.low > 0 else max(self.high * 10.0**-DECADES, LEAST)

    @property
    def marks(self) -> tuple[tuple[float, str], ...]:
        """Values along a slider that has a box, and words for them: both ends and the middle of a
        linear one, of others at most five decades, and the end from which on the values are 0.
        The last has the unit.
        """
        if self.way == "linear":
            ends = (self.low, (self.low + self.high) / 2, self.high)
            return tuple(
                (v, f"{_brief(v)} {u}".strip())
                for v, u in zip(ends, ("", "", self.unit), strict=True)
            )
        both = self.way == "both sides"
        first = 0 if both else math.ceil(math.log10(self.least) - 1e-9)
        last = math.floor(math.log10(self.high) + 1e-9)
        every = 1 if last - first < MAX_MARKS else 2
        values = [10.0**power for power in range(first, last + 1, every)]
        if both:
            values = [*(-value for value in reversed(values) if value <= -self.low), 0.0, *values]
        elif self.low <= 0 and self.way_of(values[0]) > MIN_WAY_OF_MARKS:
            values = [0.0, *values]
        words = [_brief(value) for value in values]
        words[-1] = f"{words[-1]} {self.unit}".strip()
        return tuple(zip(values, words, strict=True))

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


def shorten(text: str) -> str:
    """The first sentence, or as many of its words as a tooltip has room for."""
    first = re.split(r"(?<=\.)\s", text.strip(), maxsplit=1)[0]
    return textwrap.shorten(first, MAX_HINT, placeholder=" ...")


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

    @property
    def title(self) -> str:
        """The section's name, with words of daily use where it has some."""
        words = PLAIN_WORDS.get(self.path)
        return self.label if words is None else f"{self.label} ({words})"

    @property
    def tooltip(self) -> str:
        return shorten(self.hint)

    @property
    def main(self) -> tuple[Control, ...]:
        """The controls that are shown first, in the order of MAIN_FIELDS."""
        by_label = {control.label: control for control in self.controls}
        return tuple(by_label[name] for name in MAIN_FIELDS.get(self.path, ()))

    @property
    def rest(self) -> Group:
        """The group without its main controls."""
        others = tuple(control for control in self.controls if control not in self.main)
        return replace(self, controls=others)

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


def split_by_rank(groups: Sequence[Group]) -> tuple[tuple[Group, ...], tuple[Group, ...]]:
    """The effects that have main fields, in the order of MAIN_FIELDS, and the others."""
    by_path = {group.path: group for group in groups}
    main = tuple(by_path[path] for path in MAIN_FIELDS if path in by_path)
    return main, tuple(group for group in groups if group.path not in MAIN_FIELDS)


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
        return Control(kind="number", low=low, high=high, valid=(low, high), whole=whole, **own)
    start, end = _useful_ends(leaf.path, low, high)
    way: Literal["linear", "log", "both sides"] = "linear"
    least = None
    if not whole and "_deg" not in leaf.path:
        # By what the model allows: a field that may span decades is thought of in decades.
        if low >= 0 and (high >= MAX_LINEAR or (low > 0 and high > 100 * low)):
            way, least = "log", start or None
            start = 0.0 if low == 0 else start
        elif start < 0 and end - start > 2 * MAX_LINEAR:
            way = "both sides"
    control = Control(
        kind="slider",
        low=start,
        high=end,
        valid=(low, high),
        least_value=least,
        way=way,
        whole=whole,
        **own,
    )
    if ">" not in limits:
        return control
    # The end itself is not allowed.
    first = low + control.step if way == "linear" else low + min(control.least, LEAST)
    start = control.least if way == "log" else max(start, first)
    return replace(control, low=start, valid=(first, high))


def _useful_ends(path: str, low: float, high: float) -> tuple[float, float]:
    """The ends of a field's slider. low, high: the ends of what the model allows."""
    if path in USEFUL_ENDS:
        return USEFUL_ENDS[path]
    if path.endswith("_deg") and (low, high) == (-FULL_TURN, FULL_TURN):
        return 0.0, FULL_TURN
    if low < 0 < high:
        return max(low, -MAX_BOTH_SIDES), min(high, MAX_BOTH_SIDES)
    return low, high


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
