"""Models of a recipe in numbers, after its ranges are resolved.

Every model is frozen and closed: an unknown key is an error, at every level. Units are in the
names, and numbers are strict.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import operator
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator
from pydantic.fields import FieldInfo

from recipes.curve import Curve
from recipes.effect import Column, EffectModel, Knob, Section, Value
from recipes.fields import (
    ClosedModel,
    Flag,
    Number,
    Seed,
    Unit,
    Whole,
    changed,
    is_given,
    section_at,
    with_unchecked_field,
)
from recipes.flood import Flood
from recipes.lens_drops import LensDrops
from recipes.light import Light
from recipes.moment import ANY_DRIVE, Air, Clock, Moment, SceneTimes
from recipes.rain import Rain
from recipes.smog import Smog
from recipes.snow import Snow
from recipes.snowfall import Snowfall
from recipes.speed import Speed, put_in_former_places
from recipes.style import Style
from recipes.timeline import FieldTimeline, take_timelines

# ---- Speed against accuracy: a tier, or what an error or a frame may cost ------------------------

Tier = Literal["draft", "balanced", "reference"]
TARGETS = ("max_flip", "budget_ms")


class Quality(ClosedModel):
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

    @model_validator(mode="after")
    def _one_wish(self) -> Quality:
        names = [name for name in ("tier", *TARGETS) if getattr(self, name) is not None]
        if len(names) > 1:
            raise ValueError(f"{' and '.join(names)} each choose the settings: keep one of them")
        return self

    @property
    def has_target(self) -> bool:
        return self.max_flip is not None or self.budget_ms is not None

    @property
    def summary(self) -> str | None:
        """Return the target for the manifest: `balanced`, `max_flip 0.03`, `budget_ms 150`, or
        None.
        """
        for name in TARGETS:
            if getattr(self, name) is not None:
                return f"{name} {getattr(self, name):g}"
        return self.tier


# ---- Frame numbers as people write them: `all`, `4`, `0,5,9`, `0:20:2`, `::5` --------------------

GRAMMAR = "write all, 4, 0,5,9, 0:20:2 or ::5 (start:stop:step, stop excluded)"


@dataclass(frozen=True)
class FramePattern:
    """Numbers and ranges of numbers, in the order written. pieces: None stands for all frames."""

    text: str
    pieces: tuple[int | slice, ...] | None

    def select(self, numbers: Sequence[int], *, clip: bool = False) -> tuple[int, ...] | None:
        """Return the selected numbers, each once, in the order written, or None for all.

        Args:
            numbers: the frames that exist. An open range ends with the last of them.
            clip: if True, numbers of a range that do not exist are left out. A single number is
                never left out: the code that looks it up refuses it.
        """
        if self.pieces is None:
            return None
        number_set = set(numbers)
        end = max(numbers, default=-1) + 1
        selected: list[int] = []
        for piece in self.pieces:
            if isinstance(piece, int):
                selected.append(piece)
                continue
            start = 0 if piece.start is None else piece.start
            stop = end if piece.stop is None else piece.stop
            is_open = piece.start is None or piece.stop is None
            run = range(start, min(stop, end) if clip else stop, piece.step or 1)
            selected += [n for n in run if n in number_set] if clip or is_open else run
        return tuple(dict.fromkeys(selected))


def parse_frames(text: str) -> FramePattern:
    """Return the pattern in a text.

    Raises:
        ValueError: the text is no pattern. The message says what is one.
    """
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


class Weather(ClosedModel):
    """The effects of a recipe, null if one is absent, and what they share: time and air."""

    smog: Smog | None = None
    flood: Flood | None = None
    snow: Snow | None = None
    rain: Rain | None = None
    snowfall: Snowfall | None = None
    air: Air | None = None
    clock: Clock = Clock()


class Render(Section):
    """How the scene is drawn."""

    later_fields = ("base", "exposure", "own_car", "shutter_strips")
    knobs = (
        Knob(
            "scale",
            (0.25, 0.5, 0.75, 1.0),
            "resolution, enlarged again for the comparison",
            0,
            tiers={"draft": 0.75},
        ),
        Knob("sh_degree", (0, 1, 2, None), "bands of the colours' spherical harmonics", 6),
    )

    base: Literal["splats", "recorded"] = "splats"
    """splats draws the scene; recorded keeps each camera's recorded image as the picture and takes
    only the weather from the scene: at recorded poses, with a scale of at most 1."""
    scale: Number = Field(default=1.0, gt=0, le=4)
    """Resolution relative to the cameras'."""
    near_m: Number = Field(default=0.01, gt=0, le=100)
    """Splats nearer to the camera's plane are dropped."""
    sh_degree: Whole | None = Field(default=None, ge=0, le=3)
    """Highest spherical-harmonics band; null for all."""
    exposure: Literal["common", "recorded", "neutral"] = "common"
    """recorded gives each camera's picture the colours of its recording, the weather's own colours
    (fog, snow, rain, spray, water) included, where the scene knows them; common gives those one
    look in all cameras, by the mean of their exposures; neutral leaves the scene's own colours."""
    own_car: Literal["dry", "snowy"] = "dry"
    """Of base recorded: dry keeps all weather off the pixels that show the recording car; snowy
    lets snow that lies on the scene lie on it, too."""
    shutter_strips: Whole = Field(default=4, ge=1, le=4096)
    """Strips of rows in which an image of a rolling shutter is drawn, each at the pose and time of
    its middle; then rows move to their own poses by depth. Cameras without one are drawn at
    once."""
    speed: Speed = Speed()

    @property
    def is_on_recorded(self) -> bool:
        """Return True if the recorded images stay the picture."""
        return self.base == "recorded"


class Sensor(Section):
    """Effects of the camera on the light that reaches it, after all weather. Depth, classes,
    masks and labels do not have them.
    """

    later_fields = ("exposure_ms",)

    noise: Number = Field(default=0.0, ge=0, le=0.2)
    """Sigma of sensor noise at mid grey, of photons and reading, demosaiced; 0.004 is one level of
    255."""
    psf_px: Number = Field(default=0.0, ge=0, le=16)
    """Sigma of the lens's blur, pixels of the rendered picture."""
    exposure_ms: Number = Field(default=5.0, gt=0, le=100)
    """How long the shutter is open: falling drops and flakes streak for as long."""
    lens_drops: LensDrops | None = None


LabelFormat = Literal["coco", "kitti", "yolo"]
ANY_LABEL = "*"  # in a category's label: any characters


class Category(ClosedModel):
    """One row of the table from the dataset's labels to categories."""

    label: str = Field(min_length=1, max_length=200, title="a label, where * stands for any text")
    """The dataset's label, or several by `*`, as in vehicle.*; of several rows the first counts."""
    name: str = Field(
        pattern=r"^[^\s\x00-\x1f]([^\x00-\x1f]{0,62}[^\s\x00-\x1f])?$", title="up to 64 characters"
    )
    """The category; several rows may have the same."""

    def matches(self, label: str) -> bool:
        """Return True if a label of the dataset belongs to this row."""
        parts = map(re.escape, self.label.split(ANY_LABEL))
        return re.fullmatch(".*".join(parts), label, re.DOTALL) is not None


class Output(Section):
    """Files that are written for each image."""

    later_fields = ("surface", "trust", "categories", "min_visibility", "on_hidden")
    knobs = (
        Knob("depth", ("none", "expected", "median", "mode"), "depth estimator", 11, False),
        Knob(
            "jpeg_quality",
            (60, 75, 92, 100),
            "size and error of jpg files",
            12,
            is_selectable=False,
            applies_to=lambda output: output.image == "jpg",
        ),
    )

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
    """LiDAR sweeps: true passes them through as recorded, weather writes them as the recipe's
    weather would have them, false writes none; auto is weather where the recipe has snow or a flood
    and surface is not scene, else true: smog, rain and snowfall alone put no surface there."""
    labels: Flag | Annotated[tuple[LabelFormat, ...], Field(min_length=1)] = True
    """Pass 3D boxes through; a list writes them for trainers too: 2D boxes, masks of the pixels
    that show each object, and 3D labels."""
    categories: tuple[Category, ...] | None = Field(default=None, max_length=256)
    """Labels of the dataset to categories of coco, kitti and yolo, in their order; null for the
    labels themselves. Labels of no row are left out."""
    min_visibility: Unit = 0.0
    """Objects of which the weather leaves less than this are hidden, in coco, kitti and yolo."""
    on_hidden: Literal["leave_out", "mark"] = "leave_out"
    """Hidden objects are left out, or marked: iscrowd in coco, DontCare in kitti; yolo has no
    mark."""
    trust: Flag = False
    """Write how far each pixel can be believed, 0 to 255: by what the scene's images saw there."""

    @property
    def label_formats(self) -> tuple[LabelFormat, ...]:
        """Return the formats in which labels are written, besides their tables."""
        return () if isinstance(self.labels, bool) else tuple(sorted(set(self.labels)))


class Recipe(ClosedModel):
    """A recipe in numbers: together with the package version it determines every pixel."""

    version: Literal[1] = VERSION
    """Version of the recipe format."""
    name: str = Field(
        default="recipe",
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$",
        title="up to 64 letters, digits, '.', '_' or '-', the first a letter or a digit",
    )
    """Used for folders and in the manifest; the file's name if absent."""
    seed: Seed = 0
    """What all random numbers are made from."""
    variant: Whole = Field(default=0, ge=0, lt=2**31)
    """Which draw from the ranges this is; in a file with ranges, the first one."""
    weather: Weather = Weather()
    style: Style | None = None
    light: Light | None = None
    quality: Quality = Quality()
    render: Render = Render()
    camera: Sensor = Sensor()
    output: Output = Output()
    timelines: tuple[FieldTimeline, ...] = ()
    """Fields whose values change over time; their sections hold the largest value."""

    @model_validator(mode="before")
    @classmethod
    def _take_timelines(cls, data: Any) -> Any:
        """Move timelines from the places of their fields to `timelines`."""
        if not isinstance(data, Mapping) or data.get("timelines"):
            return data
        fields, timelines = take_timelines(data)
        return {**fields, "timelines": timelines} if timelines else fields

    @model_validator(mode="after")
    def _values_of_timelines(self) -> Recipe:
        for timeline in self.timelines:
            holder, _, name = timeline.path.rpartition(".")
            section = section_at(self, holder)
            if section is None:
                raise ValueError(f"{timeline.path} has a timeline, and {holder} is absent")
            for value in dict.fromkeys(timeline.values):
                type(section).model_validate({**section.model_dump(), name: value})
        return self

    @model_validator(mode="after")
    def _settled_by_target(self) -> Recipe:
        if self.render.speed.settled and not self.quality.has_target:
            raise ValueError(
                "render.speed.settled belongs to quality.max_flip or quality.budget_ms, and "
                "neither is given"
            )
        return self

    @model_validator(mode="after")
    def _settings_of_tier(self) -> Recipe:
        """Replace a tier by its numbers. This happens once; the tier's name stays beside them."""
        if self.quality.tier is not None:
            for path, value in tier_settings(self, self.quality.tier).items():
                name, _, inner_path = path.partition(".")
                section = with_unchecked_field(getattr(self, name), inner_path, value)
                object.__setattr__(self, name, section)  # as yet nobody else has it
                self.model_fields_set.add(name)
        return self

    def canonical_json(self) -> str:
        """Return one text per recipe: sorted keys, no spaces, floats that read back to the same
        bits.

        Fields that are younger than the first release are left out at their defaults, which mean
        what recipes without them meant, so that hashes stay. Sweeps that auto passes through are
        those of `lidar: true`. Paths of files are left out: their digest identifies their contents.
        """
        data = self.model_dump(mode="json")
        put_in_former_places(data)
        effects = self.sections()
        sections: dict[str, Section] = {"render": self.render, "output": self.output, **effects}
        omitted_paths = [] if self.quality != Quality() else ["quality"]
        if not self.timelines:
            omitted_paths.append("timelines")
        if self.weather.clock == Clock():
            omitted_paths.append("weather.clock")
        if self.weather.air is None:
            omitted_paths.append("weather.air")
        if self.camera == Sensor():
            omitted_paths.append("camera")
        else:
            sections["camera"] = self.camera
        absent_paths = (
            p for p, m in SECTIONS.items() if p not in effects and not m.in_first_release
        )
        omitted_paths += [
            path for path in absent_paths if path.partition(".")[0] not in omitted_paths
        ]
        omitted_paths += [
            f"{path}.{name}"
            for path, section in sections.items()
            for name in section.later_fields
            if getattr(section, name) == type(section).model_fields[name].default
        ]
        omitted_paths += [
            f"{p}.{name}" for p, section in effects.items() for name in section.file_fields
        ]
        for path in omitted_paths:
            *parents, name = path.split(".")
            del functools.reduce(operator.getitem, parents, data)[name]
        if self.output.lidar == "auto" and self.lidar == "clean":
            data["output"]["lidar"] = True
        return json.dumps(data, sort_keys=True, separators=(",", ":"))

    # ---- Over time

    @functools.cached_property
    def is_at_moment(self) -> bool:
        """True of a recipe that `at` has made: it holds the numbers of one moment."""
        return False

    @property
    def changes_over_time(self) -> bool:
        """Return True if images of different times may have different weather."""
        has_history = bool(self.timelines) or self.weather.air is not None
        return has_history and not self.is_at_moment

    def weather_time_s(self, scene_times: SceneTimes, timestamp_ns: int) -> float:
        """Return the time of the weather at an image, seconds.

        Args:
            scene_times: the drive's times.
            timestamp_ns: the image's time.
        """
        return self.weather.clock.time_s(scene_times.drive_s(timestamp_ns))

    def at(self, scene_times: SceneTimes, timestamp_ns: int) -> Recipe:
        """Return the recipe at the time of an image: numbers only, also those that have a history.

        Timelines give way to their values, and every section derives its state from them
        (`EffectModel.state_at`). A recipe in which nothing changes is returned as it is, and so is
        one that is at a moment already.

        Args:
            scene_times: the drive's times.
            timestamp_ns: the image's time.

        Raises:
            RecipeError: a timeline goes beyond the drive.
        """
        return self.at_weather_time(scene_times, self.weather_time_s(scene_times, timestamp_ns))

    def at_weather_time(self, scene_times: SceneTimes, time_s: float) -> Recipe:
        """Return the recipe at a time of the weather; see `at`.

        Args:
            scene_times: the drive's times.
            time_s: the time of the weather, seconds.
        """
        if self.is_at_moment:
            return self
        recipe = self
        curves: dict[str, Curve] = {}
        for timeline in self.timelines:
            if section_at(self, timeline.path.rpartition(".")[0]) is None:
                continue  # the effect was taken out of the recipe
            times_s = timeline.times_s(self.weather.clock, scene_times)
            if timeline.is_number:
                curves[timeline.path] = timeline.curve(times_s)
            value = timeline.value(times_s, time_s)
            recipe = with_unchecked_field(recipe, timeline.path, value)
        if self.timelines:
            recipe = recipe.model_copy(update={"timelines": ()})
        weather = self.weather
        constants = {
            f"weather.{name}.rate_mm_h": section.rate_mm_h
            for name, section in (("rain", weather.rain), ("snowfall", weather.snowfall))
            if section is not None
        }
        end_s = weather.clock.time_s(scene_times.duration_s)
        moment = Moment(time_s, recipe.weather.air, curves, constants, end_s)
        for path, section in recipe.sections().items():
            state = section.state_at(path, moment)
            if state is not section:
                recipe = with_unchecked_field(recipe, path, state)
        if recipe is not self:
            vars(recipe)["is_at_moment"] = True  # as a cached property, which no comparison reads
        return recipe

    def check_times(self, scene_times: SceneTimes) -> None:
        """Refuse timelines that do not fit a drive.

        Args:
            scene_times: the drive's times.

        Raises:
            RecipeError: a timeline goes beyond the drive, or has shares of a drive without length.
        """
        for timeline in self.timelines:
            timeline.times_s(self.weather.clock, scene_times)

    def key_times_s(self, scene_times: SceneTimes) -> tuple[float, ...]:
        """Return the times of the weather at which the recipe is at its extremes, in order.

        These are the drive's ends and the points of all timelines in it, and the middles between
        them, since what has a history may be largest there.

        Args:
            scene_times: the drive's times.
        """
        clock = self.weather.clock
        start_s = clock.start_s
        end_s = clock.time_s(scene_times.duration_s)
        times = {start_s, end_s}
        for timeline in self.timelines:
            times.update(t for t in timeline.times_s(clock, scene_times) if start_s < t < end_s)
        ordered = sorted(times)
        middles = [(a + b) / 2 for a, b in itertools.pairwise(ordered)]
        return tuple(sorted({*ordered, *middles}))

    def over_time(self, scene_times: SceneTimes) -> tuple[Recipe, ...]:
        """Return the recipe at its key times, each once; a recipe that never changes is the only
        one.

        Args:
            scene_times: the drive's times.

        Raises:
            RecipeError: a timeline goes beyond the drive.
        """
        if not self.changes_over_time:
            return (self,)
        states: list[Recipe] = []
        for time_s in self.key_times_s(scene_times):
            state = self.at_weather_time(scene_times, time_s)
            if state not in states:
                states.append(state)
        return tuple(states)

    @property
    def hash(self) -> str:
        """Return the first 16 hex digits of the SHA-256 of canonical_json()."""
        return hashlib.sha256(self.canonical_json().encode()).hexdigest()[:16]

    @property
    def has_open_choice(self) -> bool:
        """Return True while a target has still to choose settings for a scene."""
        return self.quality.has_target and not self.render.speed.settled

    @property
    def lidar(self) -> Literal["weather", "clean"] | None:
        """Return the kind of the LiDAR sweeps that are written, or None for none.

        `auto` becomes the kind that agrees with the depth images.
        """
        setting = self.output.lidar
        if setting == "auto":
            in_weather = bool(self._surfaces()) and self.output.surface != "scene"
            return "weather" if in_weather else "clean"
        return ("clean" if setting else None) if setting != "weather" else "weather"

    def lidar_note(self, lidar: Literal["weather", "clean"] | None) -> str | None:
        """Return a note on the surfaces in which images, depth and sweeps differ.

        The result is None if they agree, or there are no sweeps. lidar: the kind of the sweeps.
        """
        output = self.output
        has_depth = output.depth != "none" or output.semantic or output.instance
        notes = []
        for surface, in_depth in self._surfaces().items() if lidar else ():
            outputs_with = ["images"]
            outputs_without = []
            if has_depth:
                (outputs_with if in_depth else outputs_without).append("depth")
            (outputs_with if lidar == "weather" else outputs_without).append("sweeps")
            if outputs_without:
                names = " and ".join(outputs_with)
                notes.append(f"{surface} in {names}, not in {' or '.join(outputs_without)}")
        setting = str(output.lidar).lower()
        settings = f"(output: {{lidar: {setting}, surface: {output.surface}}})"
        return f"{'; '.join(notes)} {settings}" if notes else None

    def _surfaces(self) -> dict[str, bool]:
        """Return the weather's surfaces on which a beam can end, and whether depth images show
        each.

        A surface that only the course of the weather makes has no number: it depends on the drive.
        """
        surfaces = {
            path: section.beam_surface(self.output.surface)
            for path, section in self.sections().items()
            if type(section).beam_surface is not EffectModel.beam_surface
        }
        if self.changes_over_time:
            for time_s in reversed(self.key_times_s(ANY_DRIVE)):
                if None not in surfaces.values():
                    break
                sections = self.at_weather_time(ANY_DRIVE, time_s).sections()
                for path in [path for path, surface in surfaces.items() if surface is None]:
                    derived = sections[path].beam_surface(self.output.surface)
                    if derived is not None:
                        words = f"{path.rpartition('.')[2]} that changes over time"
                        surfaces[path] = (words, derived[1])
        return dict(sorted(surface for surface in surfaces.values() if surface is not None))

    def sections(self) -> dict[str, EffectModel]:
        """Return the effects of the recipe, by dotted path."""
        sections = ((path, section_at(self, path)) for path in SECTIONS)
        return {path: section for path, section in sections if section is not None}

    def columns(self) -> dict[str, float | str | None]:
        """Return the manifest values of the recipe's effects, by column."""
        return {
            column.name: column.value_of(section_at(self, path))
            for path, model in SECTIONS.items()
            for column in model.columns
        }


# ---- The effects, and all that follows from their models -----------------------------------------

SECTIONS: dict[str, type[EffectModel]] = {
    "weather.smog": Smog,
    "weather.flood": Flood,
    "weather.snow": Snow,
    "weather.rain": Rain,
    "weather.snowfall": Snowfall,
    "style": Style,
    "light": Light,
    "camera.lens_drops": LensDrops,
}
# By dotted path, those that save most first.
KNOBS: dict[str, Knob] = {}
# What each tier sets, by dotted path, of the fields that a recipe does not give; the rest are at
# reference, the last value of every knob. By the rule of docs/trade.md from docs/trade/*.json.
TIERS: dict[str, dict[str, Value]] = {"draft": {}, "balanced": {}}


def timeline_holders() -> tuple[str, ...]:
    """Return the dotted paths of the sections whose fields may have timelines."""
    return (*SECTIONS, "weather.air")


def add_section(path: str, model: type[EffectModel]) -> None:
    """Add an effect to all recipes that are made from now on. path: `weather.dust`, or `dust`."""
    holder, name = _place(path)
    annotation: Any = model | None
    holder.model_fields[name] = FieldInfo.from_annotated_attribute(annotation, None)
    SECTIONS[path] = model
    _rebuild()


def remove_section(path: str) -> None:
    """Undo add_section."""
    holder, name = _place(path)
    del holder.model_fields[name], SECTIONS[path]
    _rebuild()


def _place(path: str) -> tuple[type[ClosedModel], str]:
    holder, _, name = path.rpartition(".")
    return {"weather": Weather, "camera": Sensor, "": Recipe}[holder], name


def _rebuild() -> None:
    Weather.model_rebuild(force=True)
    Recipe.model_fields["weather"].default = Weather()
    Recipe.model_rebuild(force=True)
    _collect_knobs()


def _collect_knobs() -> None:
    sections: dict[str, type[Section]] = {
        "render": Render,
        "render.speed": Speed,
        "output": Output,
        **SECTIONS,
    }
    knobs = [
        replace(knob, path=f"{path}.{knob.path}", section=knob.section or path)
        for path, model in sections.items()
        for knob in model.knobs
    ]
    KNOBS.clear()
    KNOBS.update((knob.path, knob) for knob in sorted(knobs, key=lambda knob: knob.rank))
    for tier, settings in TIERS.items():
        settings.clear()
        settings.update((k.path, k.tiers[tier]) for k in KNOBS.values() if tier in k.tiers)


_collect_knobs()


def columns_of_effects() -> dict[str, Column]:
    """Return the columns of manifests that effects fill, by name."""
    return {column.name: column for model in SECTIONS.values() for column in model.columns}


# ---- Settings of the knobs of a recipe -----------------------------------------------------------


def knobs_of(recipe: Recipe) -> tuple[Knob, ...]:
    """Return the knobs that have an effect on the recipe's pictures or files."""
    sections = ((knob, section_at(recipe, knob.section)) for knob in KNOBS.values())
    return tuple(
        knob for knob, section in sections if section is not None and knob.applies_to(section)
    )


def free_knobs(recipe: Recipe) -> tuple[Knob, ...]:
    """Return the knobs that a tier or a target may set: the recipe does not give their field."""
    return tuple(k for k in knobs_of(recipe) if k.is_selectable and not is_given(recipe, k.path))


def idle_speed_knobs(recipe: Recipe) -> tuple[Knob, ...]:
    """Return the knobs in `render.speed` of absent effects, if the recipe does not give them."""
    return tuple(
        knob
        for knob in KNOBS.values()
        if knob.path.startswith("render.speed.")
        and section_at(recipe, knob.section) is None
        and not is_given(recipe, knob.path)
    )


def settings_of(recipe: Recipe) -> dict[str, Value]:
    """Return the values of the recipe's knobs, by path."""
    return {knob.path: section_at(recipe, knob.path) for knob in knobs_of(recipe)}


def with_settings(recipe: Recipe, settings: Mapping[str, Value]) -> Recipe:
    """Return the recipe with some knobs set, which then count as given.

    Raises:
        ValueError: a value is refused.
    """
    return changed(recipe, settings)


def tier_settings(recipe: Recipe, tier: str) -> dict[str, Value]:
    """Return the values that a tier gives to the free knobs of this recipe, by path."""
    values = TIERS.get(tier, {})
    return {knob.path: values.get(knob.path, knob.reference) for knob in free_knobs(recipe)}


def with_reference_settings(recipe: Recipe) -> Recipe:
    """Return the recipe with every knob that a tier may set at its reference, given or not."""
    return with_settings(recipe, {k.path: k.reference for k in knobs_of(recipe) if k.is_selectable})
