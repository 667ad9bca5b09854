"""What a recipe may say once its ranges are resolved to numbers.

Every model is frozen and closed: an unknown key is an error, at every level. Units are in the
names, and numbers are strict.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from recipes.weather import (
    FILES,
    Closed,
    Colour,
    Flag,
    Flood,
    Number,
    Seed,
    Snow,
    Style,
    Whole,
    changed,
    found,
    is_given,
    one_of,
    replaced,
)

# ---- Speed against accuracy: a tier, or what an error or a frame may cost ------------------------

Tier = Literal["draft", "balanced", "reference"]
TARGETS = ("max_flip", "budget_ms")


class Quality(Closed):
    """Speed against accuracy. It chooses every setting of the table of knobs that the recipe does
    not give itself; `quality: balanced` is short for `quality: {tier: balanced}`.
    """

    SHORTHAND: ClassVar[str] = "tier"

    tier: Tier | None = None
    """draft is for a first look, balanced differs from reference by less than a person sees,
    reference takes no shortcut; null leaves every setting at its default."""
    max_flip: Number | None = Field(default=None, gt=0, le=1)
    """The fastest settings whose pictures of this scene differ from reference by no more than this:
    mean FLIP, the worst of a few views."""
    budget_ms: Number | None = Field(default=None, gt=0, le=1e7)
    """The most accurate settings whose frames of this scene take no longer than this on the machine
    that starts the job: the median of a few views, writing left out."""
    settled: Flag = False
    """Whether max_flip or budget_ms has made its choice, which the recipe then holds: so it is in
    the recipes that a job leaves, and nothing is chosen again."""

    @model_validator(mode="after")
    def _one_wish(self) -> Quality:
        given = [name for name in ("tier", *TARGETS) if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} each choose the settings: keep one of them")
        if self.settled and not self.has_target:
            raise ValueError("settled belongs to max_flip or budget_ms, and neither is given")
        return self

    @property
    def has_target(self) -> bool:
        return self.max_flip is not None or self.budget_ms is not None

    @property
    def is_open(self) -> bool:
        """Whether settings have still to be chosen, in view of a scene."""
        return self.has_target and not self.settled

    @property
    def words(self) -> str | None:
        """For the manifest: `balanced`, `max_flip 0.03`, `budget_ms 150`; None without a wish."""
        for name in TARGETS:
            if getattr(self, name) is not None:
                return f"{name} {getattr(self, name):g}"
        return self.tier


# What each tier sets, by dotted path, of the fields that a recipe does not give; the rest are at
# reference, the last value of every knob. By the rule of docs/trade.md from docs/trade/*.json.
TIERS: Mapping[str, Mapping[str, float | str]] = MappingProxyType({
    "draft": MappingProxyType({
        "render.scale": 0.75,
        "render.transmittance_stop": 0.01,
        "weather.snow.shading": "per_splat",
    }),
    "balanced": MappingProxyType({"render.transmittance_stop": 0.01}),
})  # fmt: skip


# ---- The knobs that trade speed for accuracy; `climategs bench trade` measures each value --------

RecipeT = TypeVar("RecipeT", bound=BaseModel)  # Recipe, which is made with this table
Value = float | int | str | bool | None


@dataclass(frozen=True)
class Knob:
    """One field. path: dotted. values: from the fastest to the most accurate, which is reference.
    what: of which error and which time, in a few words. chosen: whether a tier or a target may set
    it; else it is only measured: it says what is written, or has no value that saves time.
    """

    path: str
    values: tuple[Value, ...]
    what: str
    chosen: bool = True

    @property
    def reference(self) -> Value:
        return self.values[-1]

    @property
    def effect(self) -> str:
        """Dotted path of the section without which it has no effect; '' for none."""
        section, name, *_ = self.path.split(".")
        return {"weather": f"weather.{name}", "style": "style"}.get(section, "")


# Those that save most come first: they have first call on an error that is allowed.
KNOBS = (
    Knob("render.scale", (0.25, 0.5, 0.75, 1.0), "resolution, enlarged again for the comparison"),
    Knob("weather.flood.reflection", ("sky", "screen_space", "mirrored"), "what water reflects"),
    Knob("weather.snow.cell_m", (0.2, 0.1, 0.05), "size of the snow's splats near the path"),
    Knob("weather.snow.shading", ("per_splat", "per_pixel"), "light on the snow"),
    Knob("render.radius_clip_px", (3.0, 2.0, 1.0, 0.0), "splats no larger are left out"),
    Knob("render.transmittance_stop", (0.05, 0.01, 1e-3, 1e-4), "light behind it is given up"),
    Knob("render.sh_degree", (0, 1, 2, None), "bands of the colours' spherical harmonics"),
    Knob("weather.flood.waves.count", (6, 12, 24), "waves that make up the surface"),
    Knob("weather.flood.fresnel", ("schlick", "exact"), "share of reflected light"),
    Knob("style.evaluated", ("sh", "color"), "map folded into the scene or put on each colour"),
    # Smog on buffers saves nothing here, whatever it costs.
    Knob("weather.smog.model", ("deferred", "per_gaussian"), "smog on buffers or on splats", False),
    Knob("output.depth", ("none", "expected", "median", "mode"), "depth estimator", chosen=False),
    Knob("output.jpeg_quality", (60, 75, 92, 100), "size and error of jpg files", chosen=False),
)
BY_PATH = {knob.path: knob for knob in KNOBS}


def knobs_of(recipe: BaseModel) -> tuple[Knob, ...]:
    """The knobs that have an effect on the recipe's pictures or files."""
    return tuple(knob for knob in KNOBS if _has_effect(knob, recipe))


def free_knobs(recipe: BaseModel) -> tuple[Knob, ...]:
    """Those of them that a tier or a target may set: the recipe does not give their field."""
    return tuple(k for k in knobs_of(recipe) if k.chosen and not is_given(recipe, k.path))


def settings_of(recipe: BaseModel) -> dict[str, Value]:
    """The values of its knobs, by path."""
    return {knob.path: found(recipe, knob.path) for knob in knobs_of(recipe)}


def with_settings(recipe: RecipeT, settings: Mapping[str, Value]) -> RecipeT:
    """The recipe with some knobs set, which then count as given; ValueError if one is refused."""
    return changed(recipe, settings)


def tier_settings(recipe: BaseModel, tier: str) -> dict[str, Value]:
    """What a tier sets of this recipe: of its free knobs."""
    chosen = TIERS.get(tier, {})
    return {knob.path: chosen.get(knob.path, knob.reference) for knob in free_knobs(recipe)}


def as_reference(recipe: RecipeT) -> RecipeT:
    """The recipe with all its knobs that a tier may set at reference, given or not."""
    return with_settings(recipe, {k.path: k.reference for k in knobs_of(recipe) if k.chosen})


def _has_effect(knob: Knob, recipe: BaseModel) -> bool:
    section: Any = found(recipe, knob.effect) if knob.effect else recipe
    if section is None:
        return False
    if knob.path == "weather.flood.waves.count":
        waves = found(recipe, "weather.flood.waves")
        return bool(waves.components is None and waves.preset != "still" and waves.height > 0)
    if knob.path == "style.evaluated":
        return bool(found(recipe, "style.applied_to") == "scene")
    if knob.path == "output.jpeg_quality":
        return bool(found(recipe, "output.image") == "jpg")
    return True


# ---- Frame numbers as people write them: `all`, `4`, `0,5,9`, `0:20:2`, `::5` --------------------

GRAMMAR = "write all, 4, 0,5,9, 0:20:2 or ::5 (start:stop:step, stop excluded)"


@dataclass(frozen=True)
class FramePattern:
    """Numbers and ranges of numbers, in the order written. pieces: None stands for all frames."""

    text: str
    pieces: tuple[int | slice, ...] | None

    def select(self, numbers: Sequence[int], *, clip: bool = False) -> tuple[int, ...] | None:
        """The selected numbers, each once, in the order written; None for all.

        numbers: those there are, to which an open range goes. clip: leave out what of a range is
        not among them; a number on its own is kept even so, for whoever looks it up to refuse.
        """
        if self.pieces is None:
            return None
        there, end = set(numbers), max(numbers, default=-1) + 1
        selected: list[int] = []
        for piece in self.pieces:
            if isinstance(piece, int):
                selected.append(piece)
                continue
            start = 0 if piece.start is None else piece.start
            stop = end if piece.stop is None else piece.stop
            is_open = piece.start is None or piece.stop is None
            run = range(start, min(stop, end) if clip else stop, piece.step or 1)
            selected += [n for n in run if n in there] if clip or is_open else run
        return tuple(dict.fromkeys(selected))


def parse_frames(text: str) -> FramePattern:
    """The pattern in a text; ValueError, which says what is one, where the text is none."""
    if text.strip() == "all":
        return FramePattern(text, None)
    try:
        return FramePattern(text, tuple(_piece(piece) for piece in text.split(",")))
    except ValueError:
        raise ValueError(f"{text!r} is not understood; {GRAMMAR}") from None


_PIECE = re.compile(r"\s*(\d*)\s*(?::\s*(\d*)\s*(?::\s*(\d*)\s*)?)?")


def _piece(text: str) -> int | slice:
    match = _PIECE.fullmatch(text)
    if match is None:
        raise ValueError
    start, stop, step = (int(number) if number else None for number in match.groups())
    if ":" not in text:
        return int(match[1])
    if step == 0 or (start is not None and stop is not None and stop <= start):
        raise ValueError
    return slice(start, stop, step)


# ---- The recipe ---------------------------------------------------------------------------------

VERSION = 1
KOSCHMIEDER = 3.912  # -ln(0.02): visibility is where contrast falls to 2 %
_LATER_FIELDS = (
    ("render", "exposure"),
    ("render", "transmittance_stop"),
    ("render", "radius_clip_px"),
    ("weather", "flood"),
    ("weather", "snow"),
    ("output", "surface"),
    ("style", "evaluated"),
    ("", "style"),
    ("", "quality"),
)
MAX_EXTINCTION_PER_M = 100.0  # nothing is seen through 10 cm of it


class Smog(Closed):
    """Fog, haze or smog: Beer-Lambert extinction towards one airlight colour."""

    model_config = ConfigDict(json_schema_extra=one_of("visibility_m", "extinction_per_m"))

    visibility_m: Number | None = Field(default=None, gt=0, le=1e6)
    """Meteorological visibility at the base height: 3.912 / extinction."""
    extinction_per_m: Number | None = Field(default=None, ge=0, le=MAX_EXTINCTION_PER_M)
    """Extinction coefficient at the base height."""
    color: Colour = (0.76, 0.78, 0.80)
    """Airlight colour: red, green, blue, display-encoded sRGB."""
    scale_height_m: Number | None = Field(default=None, ge=0.1, le=1e5)
    """Height over which the density falls by e; null for uniform smog."""
    base_height_m: Number = Field(default=0.0, ge=-1e4, le=1e4)
    """Height above the road where the density is the one given; of no effect on uniform smog."""
    model: Literal["per_gaussian", "deferred"] = "per_gaussian"
    """per_gaussian fogs every splat before blending; deferred fogs the finished buffers."""

    @model_validator(mode="after")
    def _one_density(self) -> Smog:
        both = "visibility_m and extinction_per_m both give the density: keep one of them"
        neither = "needs a density: give visibility_m (metres) or extinction_per_m (1/metre)"
        if (self.visibility_m is None) == (self.extinction_per_m is None):
            raise ValueError(neither if self.visibility_m is None else both)
        if self.sigma_per_m > MAX_EXTINCTION_PER_M:
            raise ValueError(
                f"visibility_m = {self.visibility_m:g} means an extinction of "
                f"{self.sigma_per_m:.3g}/metre; at most {MAX_EXTINCTION_PER_M:g}/metre is allowed"
            )
        return self

    @property
    def sigma_per_m(self) -> float:
        """Extinction coefficient at the base height, 1/metre."""
        if self.extinction_per_m is not None:
            return self.extinction_per_m
        assert self.visibility_m is not None
        return KOSCHMIEDER / self.visibility_m


class Weather(Closed):
    """The effects of a recipe; null where one is absent."""

    smog: Smog | None = None
    flood: Flood | None = None
    snow: Snow | None = None


class Render(Closed):
    """How the scene is drawn."""

    scale: Number = Field(default=1.0, gt=0, le=4)
    """Resolution relative to the cameras'."""
    near_m: Number = Field(default=0.01, gt=0, le=100)
    """Splats nearer to the camera's plane are dropped."""
    alpha_max: Number = Field(default=0.999, gt=0, le=0.9999)
    """Cap of one splat's alpha: 0.999, or the original 3DGS's 0.99."""
    antialiased: Flag = False
    """Opacity compensated for the screen blur."""
    sh_degree: Whole | None = Field(default=None, ge=0, le=3)
    """Highest spherical-harmonics band; null for all."""
    exposure: Literal["recorded", "neutral"] = "recorded"
    """recorded gives each camera's picture the colours of its recording, where the scene knows
    them; neutral leaves the scene's own."""
    transmittance_stop: Number = Field(default=1e-4, ge=1e-6, le=0.25)
    """A pixel is finished once no more than this share of the light behind shines through; what it
    shows by then stands for the rest. 1e-6 blends what no picture in 8 bits shows; 0.5 would leave
    no median depth, hence the limit."""
    radius_clip_px: Number = Field(default=0.0, ge=0, le=64)
    """Splats that reach no farther than this from their centre along x or y, pixels of the rendered
    picture, are left out; 0 leaves out none."""


class Output(Closed):
    """What is written for each image."""

    image: Literal["png", "jpg"] = "png"
    """Image format."""
    jpeg_quality: Whole = Field(default=92, ge=1, le=100)
    """Quality of jpg images."""
    depth: Literal["median", "expected", "mode", "none"] = "median"
    """Depth estimator written as 16-bit PNG, metres x 256."""
    surface: Literal["solid", "scene", "first"] = "solid"
    """What depth, semantic and instance images show of the weather: solid counts snow as a surface
    and water not; scene shows the scene without either; first shows whatever a ray meets first,
    water too."""
    semantic: Flag = False
    """Write the class of the heaviest splat."""
    instance: Flag = False
    """Write which object each pixel shows: an actor's heaviest splat, or the labelled box that its
    surface lies in."""
    lidar: Flag | Literal["auto", "weather"] = "auto"
    """LiDAR sweeps: true passes them through as recorded, weather writes them as the recipe's smog,
    flood and snow would have them, false writes none; auto is weather where the recipe has snow or
    a flood and surface is not scene, else true."""
    labels: Flag = True
    """Pass 3D boxes through."""


class Recipe(Closed):
    """A recipe in numbers: together with the package version it determines every pixel."""

    version: Literal[1] = VERSION
    """Version of the recipe format."""
    name: str = Field(default="recipe", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")
    """Used for folders and in the manifest; the file's name if absent."""
    seed: Seed = 0
    """What all random numbers are made from."""
    variant: Whole = Field(default=0, ge=0, lt=2**31)
    """Which draw from the ranges this is; in a file with ranges, the first one."""
    weather: Weather = Weather()
    style: Style | None = None
    quality: Quality = Quality()
    render: Render = Render()
    output: Output = Output()

    @model_validator(mode="after")
    def _settings_of_tier(self) -> Recipe:
        """A tier stands for numbers: it is resolved once, here, and stays as a word beside them."""
        if self.quality.tier is not None:
            for path, value in tier_settings(self, self.quality.tier).items():
                name, _, rest = path.partition(".")
                section = replaced(getattr(self, name), rest, value)
                object.__setattr__(self, name, section)  # as yet nobody else has it
                self.model_fields_set.add(name)
        return self

    def canonical_json(self) -> str:
        """One text per recipe: sorted keys, no spaces, floats that read back to the same bits.

        Fields younger than the first release are left out at their defaults, which mean what
        recipes without them meant, so that hashes stay; sweeps that auto passes through are those
        of `lidar: true`. Where files lie is left out: their digest says what they hold.
        """
        data = self.model_dump(mode="json")
        for section, name in _LATER_FIELDS:
            model, holder = (getattr(self, section), data[section]) if section else (self, data)
            if model is None:
                continue
            default = type(model).model_fields[name].default
            if getattr(model, name) == default:
                del holder[name]
        if self.output.lidar == "auto" and self.lidar == "clean":
            data["output"]["lidar"] = True
        for name in FILES if self.style is not None else ():
            del data["style"][name]
        return json.dumps(data, sort_keys=True, separators=(",", ":"))

    @property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of canonical_json()."""
        return hashlib.sha256(self.canonical_json().encode()).hexdigest()[:16]

    @property
    def lidar(self) -> Literal["weather", "clean"] | None:
        """Which LiDAR sweeps are written, auto resolved: those that agree with the depth images."""
        asked = self.output.lidar
        if asked == "auto":
            in_weather = bool(self._surfaces()) and self.output.surface != "scene"
            return "weather" if in_weather else "clean"
        return ("clean" if asked else None) if asked != "weather" else "weather"

    def lidar_note(self, lidar: Literal["weather", "clean"] | None) -> str | None:
        """Where images, depth and sweeps show different surfaces, if sweeps are such as `lidar`
        says; None where they agree, or there are no sweeps.
        """
        output = self.output
        has_depth = output.depth != "none" or output.semantic or output.instance
        notes = []
        for what, in_depth in self._surfaces().items() if lidar else ():
            there, absent = ["images"], []
            if has_depth:
                (there if in_depth else absent).append("depth")
            (there if lidar == "weather" else absent).append("sweeps")
            if absent:
                notes.append(f"{what} in {' and '.join(there)}, not in {' or '.join(absent)}")
        asked = str(output.lidar).lower()
        settings = f"(output: {{lidar: {asked}, surface: {output.surface}}})"
        return f"{'; '.join(notes)} {settings}" if notes else None

    def _surfaces(self) -> dict[str, bool]:
        """What of the weather a ray can end on, and whether depth images show it."""
        snow, shown = self.weather.snow, self.output.surface
        found = {}
        if snow is not None and snow.lies:
            found[f"snow {snow.depth_m:.3g} m deep"] = shown != "scene"
        if self.weather.flood is not None:
            found["water"] = shown == "first"
        return found

    def weather_numbers(self) -> dict[str, float]:
        """Flat numbers for the manifest: NaN where absent; no smog and no style are 0.

        flood_turbidity_ntu is NaN where the recipe gives an absorption, flood_wave_height (a factor
        on a preset's waves) where waves are listed.
        """
        smog, flood, snow = self.weather.smog, self.weather.flood, self.weather.snow
        height_m = None if smog is None else smog.scale_height_m
        turbidity = None if flood is None else flood.effective_turbidity_ntu
        waves = None if flood is None or flood.waves.components is not None else flood.waves
        return {
            "smog_extinction_per_m": 0.0 if smog is None else smog.sigma_per_m,
            "smog_scale_height_m": math.nan if height_m is None else height_m,
            "flood_level_m": math.nan if flood is None else flood.level_m,
            "flood_turbidity_ntu": math.nan if turbidity is None else turbidity,
            "flood_wave_height": math.nan if waves is None else waves.height,
            "snow_depth_m": math.nan if snow is None else snow.depth_m,
            "snow_coverage": math.nan if snow is None else snow.coverage,
            "style_strength": 0.0 if self.style is None else self.style.strength,
        }

    def style_words(self) -> dict[str, str | None]:
        """For the manifest: the name of the style's preset or image, and the method; or null."""
        style = self.style
        return {"style": style and style.name, "style_method": style and style.method}
