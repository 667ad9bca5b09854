"""Controls of a recipe's fields: what a person can set, without any widget.

The controls are made by walking the recipe's models. A control has its field's path, the ends of
its values, and the scale of its slider: how a position stands for a value. `fields.py` makes the
widgets of a page from controls, and `page.py` puts them in order.
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
from recipes.schema import SECTIONS
from recipes.sections import Leaf, Section, recipe_file

STEPS = 400  # The number of steps of a slider.
# The upper end from which on a slider of numbers that are not negative is logarithmic.
MAX_LINEAR = 10.0
DECADES = 6  # The most decades that a slider spans.
# The position on a logarithmic slider, 0 to 1, at which an effect is likely to be visible.
VISIBLE_POSITION = 0.7
# The smallest value but 0 of a logarithmic slider; 0 lies at its left end, where it is allowed.
MIN_LOG_VALUE = 1e-3
MAX_SLIDER_INTEGERS = 1000  # The widest range of whole numbers that has a slider.
MAX_HINT = 180  # The longest tooltip, characters.
BOX_DIGITS = 3  # The digits of a box after those of its step.
MAX_MARKS = 5  # The most marks along a logarithmic slider, a decade from each other.
# The least distance of two marks, of a slider's length: else their words run into each other.
MIN_MARK_DISTANCE = 0.15

# The fields that a page shows first, by section. They are the words of a weather report or of a
# road user. All other fields, and effects without an entry, come under "more".
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
    "weather.smog.mor_m": (10.0, 15_000.0),  # the same by a sensor
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
    "weather.snowfall.rate_mm_h": (0.05, 20.0),
    "weather.snowfall.wind_mps": (0.01, 40.0),
    "camera.lens_drops.radius_mm": (0.1, 5.0),
    "camera.lens_drops.glass_m": (0.01, 1.0),
    "camera.lens_drops.focal_mm": (1.0, 100.0),
    "camera.lens_drops.f_number": (0.9, 22.0),
    "camera.lens_drops.wiper_s": (0.5, 60.0),
    "light.sky_luminance_cd_m2": (0.0001, 5000.0),  # far from towns; a bright overcast
    "light.moon_lux": (0.001, 0.3),  # a full moon
    "light.glow": (0.1, 10.0),
    "light.street_spacing_m": (10.0, 100.0),
    "light.street_height_m": (3.0, 15.0),
    "light.street_lumen": (500.0, 50_000.0),
    "light.street_kelvin": (1700.0, 6500.0),  # sodium; cold LED
    "light.exposure_ms": (0.1, 100.0),
    "light.iso": (100.0, 51_200.0),
    "light.f_number": (0.9, 22.0),
    "light.glare": (0.1, 10.0),
    "light.noise": (0.05, 2.0),
    "camera.noise": (0.0, 0.03),
    "camera.psf_px": (0.1, 4.0),
    "camera.exposure_ms": (0.1, 50.0),
    "render.scale": (0.1, 2.0),
    "render.near_m": (0.01, 10.0),
    "render.speed.radius_clip_px": (0.1, 10.0),
    "render.speed.lod_px": (0.1, 10.0),
    "render.speed.rain_min_width_px": (0.1, 4.0),
    "render.speed.snowfall_min_width_px": (0.1, 4.0),
}
# A full turn, degrees: directions run from 0, though models allow -360 to 360 of them.
FULL_TURN = 360.0
MAX_BOTH_SIDES = 100.0  # The largest absolute value on a slider of both signs without an entry.

# The symbol of a unit by the end of a field's name; longer ends come before shorter ones.
UNIT_SYMBOLS = {
    "_per_m": "1/m",
    "_mm_h": "mm/h",
    "_mps": "m/s",
    "_deg": "degrees",
    "_ntu": "NTU",
    "_mm": "mm",
    "_cd_m2": "cd/m²",
    "_lux": "lx",
    "_lumen": "lm",
    "_kelvin": "K",
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
    """The field's meaning, and its unit."""
    nullable: bool = False
    """True if the field may be null."""
    default: Any = None
    """Its value where nothing is given; None where the field must be given, or is null."""
    low: float = 0.0
    """The lower end of its slider or number."""
    high: float = 1.0
    """The upper end of its slider or number."""
    valid: tuple[float, float] = (-math.inf, math.inf)
    """The ends of what its model allows, which its box takes."""
    log_start: float | None = None
    """The smallest value above 0 of a logarithmic slider; None if it follows from the ends."""
    scale: Literal["linear", "log", "both sides"] = "linear"
    """The scale of the slider: how a position stands for a value."""
    is_integer: bool = False
    """True if its values are whole numbers."""
    words: tuple[str, ...] = ()
    """The values to choose from, where they can be listed."""

    @property
    def label(self) -> str:
        """The last name of the path."""
        return self.path.rpartition(".")[2]

    @property
    def unit(self) -> str:
        """The unit's symbol; empty for a pure number."""
        return next((u for end, u in UNIT_SYMBOLS.items() if self.path.endswith(end)), "")

    @property
    def tooltip(self) -> str:
        """The hint's first sentence, cut at a word where it is long; and the unit."""
        meaning, bracket, unit = self.hint.partition(" [")
        return shorten(meaning) + (bracket + unit)

    @property
    def has_box(self) -> bool:
        """True if the exact number has a separate box. The box that belongs to a slider takes only
        the slider's values; if the slider is not linear, it holds a position and not a value.
        """
        return self.scale != "linear" or (self.low, self.high) != self.valid

    @property
    def step(self) -> float:
        """Step of a linear slider: a power of ten, or twice or five times one."""
        if self.is_integer:
            return 1
        exact = (self.high - self.low) / STEPS
        power = 10.0 ** math.floor(math.log10(exact))
        return next(power * k for k in (1, 2, 5, 10) if power * k >= exact * 0.999)

    @property
    def box_step(self) -> float:
        """Change of the box's number by an arrow beside it."""
        return self.step if self.scale == "linear" else self.smallest_nonzero

    @property
    def box_digits(self) -> int:
        """Digits behind the point that the box takes."""
        return 0 if self.is_integer else BOX_DIGITS + max(0, math.ceil(-math.log10(self.box_step)))

    @property
    def start(self) -> Any:
        """The value of a field that has none when it is switched on."""
        if self.default is not None:
            return self.default
        if self.kind == "slider":
            value = self.value_at(0.5)
            return round(value) if self.is_integer else value
        return {
            "number": int(max(self.low, 0)),
            "colour": [0.5] * 3,
            "rates": [1.0] * 3,
            "words": self.words[0] if self.words else "",
        }.get(self.kind)

    @property
    def smallest_nonzero(self) -> float:
        """The smallest absolute value above 0 of a slider that is not linear."""
        if self.scale == "both sides":
            return 0.01
        if self.log_start is not None:
            return self.log_start
        return self.low if self.low > 0 else max(self.high * 10.0**-DECADES, MIN_LOG_VALUE)

    @property
    def marks(self) -> tuple[tuple[float, str], ...]:
        """Values along a slider that has a box, and the word for each.

        A linear slider has marks at both ends and in the middle. Other sliders have marks at no
        more than MAX_MARKS decades, and at 0 where there is room. The last word has the unit.
        """
        if self.scale == "linear":
            ends = (self.low, (self.low + self.high) / 2, self.high)
            return tuple(
                (v, f"{_brief(v)} {u}".strip())
                for v, u in zip(ends, ("", "", self.unit), strict=True)
            )
        both = self.scale == "both sides"
        first = 0 if both else math.ceil(math.log10(self.smallest_nonzero) - 1e-9)
        last = math.floor(math.log10(self.high) + 1e-9)
        mark_decades = 1 if last - first < MAX_MARKS else 2
        values = [10.0**power for power in range(first, last + 1, mark_decades)]
        if both:
            values = [*(-value for value in reversed(values) if value <= -self.low), 0.0, *values]
        elif self.low <= 0 and self.position_at(values[0]) > MIN_MARK_DISTANCE:
            values = [0.0, *values]
        words = [_brief(value) for value in values]
        words[-1] = f"{words[-1]} {self.unit}".strip()
        return tuple(zip(values, words, strict=True))

    def value_at(self, position: float) -> float:
        """Return the value at a position on the slider, 0 to 1, to three digits."""
        if self.scale == "log":
            if position <= 0 and self.low <= 0:
                return max(self.low, 0.0)
            low = math.log(self.smallest_nonzero)
            value = math.exp(low + position * (math.log(self.high) - low))
        elif self.scale == "both sides":
            most = max(-self.low, self.high)
            value = self.smallest_nonzero * math.sinh(
                (2 * position - 1) * math.asinh(most / self.smallest_nonzero)
            )
        else:
            value = self.low + position * (self.high - self.low)
        return min(max(float(f"{value:.3g}"), self.low), self.high)

    def position_at(self, value: float) -> float:
        """Return the position of a value on the slider, 0 to 1; an end if the value lies beyond."""
        if self.scale == "log":
            if value <= self.smallest_nonzero:
                return 0.0
            low = math.log(self.smallest_nonzero)
            position = (math.log(value) - low) / (math.log(self.high) - low)
        elif self.scale == "both sides":
            most = math.asinh(max(-self.low, self.high) / self.smallest_nonzero)
            position = (math.asinh(value / self.smallest_nonzero) / most + 1) / 2
        else:
            position = (value - self.low) / (self.high - self.low)
        return min(max(position, 0.0), 1.0)


def shorten(text: str) -> str:
    """Return the first sentence, cut at a word if it is longer than MAX_HINT characters."""
    first = re.split(r"(?<=\.)\s", text.strip(), maxsplit=1)[0]
    return textwrap.shorten(first, MAX_HINT, placeholder=" ...")


def _brief(value: float) -> str:
    return f"{value / 1e6:g}M" if abs(value) >= 1e6 else f"{value:g}"


@dataclass(frozen=True)
class Group:
    """The controls of a recipe's section and of the sections in it."""

    path: str
    """The dotted path of the section: "weather.smog"."""
    hint: str
    """The meaning of the section."""
    optional: bool
    """True if the section may be null, which means that its effect is absent."""
    controls: tuple[Control, ...]
    """The controls of its own fields."""
    groups: tuple[Group, ...]
    """The groups of the sections in it."""

    @property
    def label(self) -> str:
        """The last name of the path."""
        return self.path.rpartition(".")[2]

    @property
    def title(self) -> str:
        """The section's name, with an everyday word where PLAIN_WORDS has one."""
        words = PLAIN_WORDS.get(self.path)
        return self.label if words is None else f"{self.label} ({words})"

    @property
    def tooltip(self) -> str:
        """The first sentence of the hint."""
        return shorten(self.hint)

    @property
    def main_controls(self) -> tuple[Control, ...]:
        """The controls that a page shows first, in the order of MAIN_FIELDS."""
        by_label = {control.label: control for control in self.controls}
        return tuple(by_label[name] for name in MAIN_FIELDS.get(self.path, ()))

    @property
    def secondary_group(self) -> Group:
        """The group without its main controls."""
        controls = tuple(control for control in self.controls if control not in self.main_controls)
        return replace(self, controls=controls)

    def walk(self) -> Iterator[Control]:
        """Yield the group's controls, then those of the sections in it."""
        yield from self.controls
        for group in self.groups:
            yield from group.walk()


def group_of(path: str) -> Group:
    """Return the group of the section at a dotted path, such as `weather.smog` or `camera`."""
    section = recipe_file()
    for name in path.split("."):
        section = section.sections[name]
    return _group(section, optional=path in SECTIONS)


def effect_groups() -> tuple[Group, ...]:
    """Return the groups of all effects that recipes know now."""
    return tuple(map(group_of, SECTIONS))


def split_by_rank(groups: Sequence[Group]) -> tuple[tuple[Group, ...], tuple[Group, ...]]:
    """Return the effects that have main fields, in the order of MAIN_FIELDS, and the others."""
    by_path = {group.path: group for group in groups}
    main = tuple(by_path[path] for path in MAIN_FIELDS if path in by_path)
    return main, tuple(group for group in groups if group.path not in MAIN_FIELDS)


def _group(section: Section, *, optional: bool) -> Group:
    fields = section.model.model_fields
    # The digest of a section's files is computed, and jobs set the mark of a settled choice.
    has_files = issubclass(section.model, EffectModel) and section.model.file_fields
    hidden_names = {"digest"} if has_files else {"settled"}
    names = fields.keys() - hidden_names
    leaves = [leaf for name, leaf in section.leaves.items() if name in names]
    lists = [inner for inner in section.sections.values() if inner.max_items is not None]
    sections = (inner for inner in section.sections.values() if inner.max_items is None)
    # Effects have groups of their own.
    inner_sections = [inner for inner in sections if inner.path not in SECTIONS]
    return Group(
        path=section.path,
        hint=" ".join((section.model.__doc__ or "").split()),
        optional=optional,
        controls=(*map(_control, leaves), *map(_list_control, lists)),
        groups=tuple(_group(inner, optional=False) for inner in inner_sections),
    )


def _list_control(item: Section) -> Control:
    hint = f"{item.list_description} YAML, each with {', '.join(item.keys)}."
    return Control(item.path.removesuffix("[]"), "list", hint, nullable=True)


def _control(leaf: Leaf) -> Control:
    default = None if leaf.info.is_required() else leaf.info.default
    unit = f" [{leaf.unit}]" if leaf.unit else ""
    hint = f"{leaf.description}{unit}"
    attributes = {"path": leaf.path, "hint": hint, "nullable": leaf.nullable, "default": default}
    if leaf.kind is bool:
        return Control(kind="flag", **attributes)
    if leaf.is_number:
        return _numeric(leaf, attributes)
    if leaf.channel is not None:
        high = dict(leaf.channel.limits).get("<=", math.inf)
        return Control(kind="colour" if high == 1 else "rates", high=high, **attributes)
    if leaf.annotation == FilePath:
        return Control(kind="file", **attributes)
    if leaf.allowed_words:
        boolean = ("true", "false") if leaf.accepts(True) else ()
        return Control(kind="words", words=(*boolean, *leaf.allowed_words), **attributes)
    return Control(kind="text", **attributes)


def _numeric(leaf: Leaf, attributes: dict[str, Any]) -> Control:
    limits = dict(leaf.limits)
    low = limits.get(">=", limits.get(">", -math.inf))
    high = limits.get("<=", limits.get("<", math.inf))
    is_integer = leaf.kind is int
    ends = (low, high)
    if any(map(math.isinf, ends)) or (is_integer and high - low > MAX_SLIDER_INTEGERS):
        return Control(
            kind="number", low=low, high=high, valid=ends, is_integer=is_integer, **attributes
        )
    start, end = _useful_ends(leaf.path, low, high)
    scale: Literal["linear", "log", "both sides"] = "linear"
    log_start = None
    if not is_integer and "_deg" not in leaf.path:
        # By what the model allows: a field that may span decades is thought of in decades.
        if low >= 0 and (high >= MAX_LINEAR or (low > 0 and high > 100 * low)):
            scale = "log"
            log_start = start or None
            start = 0.0 if low == 0 else start
        elif start < 0 and end - start > 2 * MAX_LINEAR:
            scale = "both sides"
    control = Control(
        kind="slider",
        low=start,
        high=end,
        valid=ends,
        log_start=log_start,
        scale=scale,
        is_integer=is_integer,
        **attributes,
    )
    if ">" not in limits:
        return control
    # The end itself is not allowed.
    first = low + (
        control.step if scale == "linear" else min(control.smallest_nonzero, MIN_LOG_VALUE)
    )
    start = control.smallest_nonzero if scale == "log" else max(start, first)
    return replace(control, low=start, valid=(first, high))


def _useful_ends(path: str, low: float, high: float) -> tuple[float, float]:
    """Return the ends of a field's slider. low, high: ends of the values that the model allows."""
    if path in USEFUL_ENDS:
        return USEFUL_ENDS[path]
    if path.endswith("_deg") and (low, high) == (-FULL_TURN, FULL_TURN):
        return 0.0, FULL_TURN
    if low < 0 < high:
        return max(low, -MAX_BOTH_SIDES), min(high, MAX_BOTH_SIDES)
    return low, high


def start_values_of_model(section: str) -> dict[str, Any]:
    """Return values of a valid section that changes the picture.

    Every required field gets a value in the middle of its slider. One further field gets a value if
    the section would otherwise be invalid or without effect.
    """
    model = SECTIONS[section]
    controls = group_of(section).controls
    required = [c for c in controls if model.model_fields[c.label].is_required()]
    required_values = {
        c.label: c.value_at(VISIBLE_POSITION) if c.scale == "log" else c.start for c in required
    }
    optional = [{c.label: c.start} for c in controls if c.nullable and is_number(c.start)]
    zero = [c for c in controls if c.kind == "slider" and c.default == 0 and not c.nullable]
    small = [{c.label: (int if c.is_integer else float)(c.value_at(0.2))} for c in zero]
    for extra_values in ({}, *optional, *small):
        try:
            effect = model.model_validate(required_values | extra_values)
        except ValidationError:
            continue
        if effect.has_effect:
            return required_values | extra_values
    return required_values
