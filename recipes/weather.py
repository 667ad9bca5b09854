"""What a recipe may say of snow, style and flood; types of fields, and how they are changed."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, model_validator
from pydantic.config import JsonDict

from recipes.errors import RecipeError, did_you_mean

# ---- The types of a recipe's fields, shared by its models ----------------------------------------

MAX_PER_M = 1e6  # a micrometre of it is opaque

Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
Unit = Annotated[float, Strict(), Field(ge=0.0, le=1.0)]
Colour = tuple[Unit, Unit, Unit]
PerMetre = Annotated[float, Strict(), Field(ge=0.0, le=MAX_PER_M)]
Rates = tuple[PerMetre, PerMetre, PerMetre]
Angle = Annotated[float, Strict(), Field(ge=-360, le=360)]
Seed = Annotated[int, Strict(), Field(ge=0, lt=2**63)]
# In a recipe file a path below its folder; in a recipe in numbers any path.
FilePath = Annotated[str, Strict(), Field(min_length=1, max_length=4096)]
Digest = Annotated[str, Strict(), Field(pattern=r"^[0-9a-f]{64}$")]


class Closed(BaseModel):
    """Frozen, and an unknown key is an error: what every section of a recipe derives from.

    The text below a field is its description.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )


# ---- Fields of nested models by dotted path: read, given or not, and changed in a copy -----------

Model = TypeVar("Model", bound=BaseModel)


def found(model: BaseModel, path: str) -> Any:
    """The value at a dotted path; None where a section on the way is absent."""
    value: Any = model
    for name in path.split("."):
        if value is None:
            return None
        value = getattr(value, name)
    return value


def is_given(model: BaseModel, path: str) -> bool:
    """Whether the field was set when the model was made, and does not just have its default."""
    value: Any = model
    for name in path.split("."):
        if value is None or name not in value.model_fields_set:
            return False
        value = getattr(value, name)
    return True


def replaced(model: Model, path: str, value: object) -> Model:
    """A copy with one field set, unchecked, and given; KeyError where a section is absent."""
    name, _, rest = path.partition(".")
    if rest:
        section = getattr(model, name)
        if section is None:
            raise KeyError(f"{name} is absent, so {path} cannot be set")
        value = replaced(section, rest, value)
    return model.model_copy(update={name: value})


def changed(model: Model, values: Mapping[str, object]) -> Model:
    """A copy with fields set by their dotted paths; what else is given stays so.

    Raises:
        ValueError: what comes out breaks a rule of the model.
        KeyError: a section on the way is absent.
    """
    for path, value in values.items():
        model = replaced(model, path, value)
    type(model).model_validate(model.model_dump())
    return model


_PRESENT: JsonDict = {"not": {"type": "null"}}


def one_of(*names: str) -> JsonDict:
    """In words of JSON Schema: exactly one of the fields is present and not null."""
    return {"oneOf": [{"required": [name], "properties": {name: _PRESENT}} for name in names]}


# ---- What a recipe may say of snow that lies on the ground ---------------------------------------


class SnowLight(Closed):
    """The light on the snow; null leaves a field to what the scene's sky and ground show."""

    sun_azimuth_deg: Number | None = Field(default=None, ge=-360, le=360)
    """Where the sun stands: 0 is world +x, 90 is +y; null for the brightest part of the sky."""
    sun_elevation_deg: Number | None = Field(default=None, ge=0, le=90)
    """The sun's height above the horizon; null for the brightest part of the sky."""
    sun: Number | None = Field(default=None, ge=0, le=1)
    """How much of the light comes from the sun: 0 overcast, 1 a clear day; null for what the sky's
    contrast suggests."""
    brightness: Number | None = Field(default=None, ge=0, le=1)
    """Display-encoded brightness of snow of albedo 0.85 that faces the light; null for what the
    scene's ground suggests."""


class SnowWind(Closed):
    """The wind that the snow fell with."""

    direction_deg: Angle = 0.0
    """Where it blows to: 0 is world +x, 90 is +y."""
    drift: Unit = 0.3
    """How uneven the wind left the layer: 0 is level but for its grain, 1 has ridges across the
    wind and banks before obstacles."""


class Snow(Closed):
    """Snow lying on what is open to the sky: ground, roofs, vehicles."""

    depth_m: Number = Field(ge=0, le=10)
    """Depth of the layer on level ground."""
    coverage: Unit = 1.0
    """Share of the open surface that is covered; below 1 in patches."""
    max_slope_deg: Number = Field(default=50.0, ge=0, le=85)
    """Snow lies on no surface steeper than this."""
    albedo: Unit = 0.85
    """Share of the light that the snow gives back."""
    grain: Unit = 0.5
    """Unevenness of the size of the splats: 0 smooth, 1 coarse."""
    sparkle: Unit = 0.0
    """How many crystals glint at the sun; 0 is none."""
    tracks: Literal["auto", "always", "never"] = "auto"
    """Packed grey wheel tracks where the ego and the scene's vehicles drive; auto up to a depth of
    0.3 m."""
    light: SnowLight = SnowLight()
    wind: SnowWind = SnowWind()
    shading: Literal["per_splat", "per_pixel"] = "per_splat"
    """Lit by one normal a splat, or by one a pixel of every splat."""
    cell_m: Number = Field(default=0.05, ge=0.001, le=10)
    """Size of the splats near the path; they grow with the distance from it."""
    seed: Whole | None = Field(default=None, ge=0, lt=2**63)
    """What drifts, patches and grain are drawn from; null for the recipe's seed."""

    @property
    def lies(self) -> bool:
        """Whether there is any: snow without depth or coverage changes nothing."""
        return self.depth_m > 0 and self.coverage > 0


# ---- The styles that come with the package: statistics of colours, in YAML, and no picture -------


@functools.cache
def packaged(folder: str) -> tuple[str, ...]:
    """The stems of the YAML files in a folder of this package, in alphabetical order."""
    names = (Path(entry.name) for entry in resources.files("recipes").joinpath(folder).iterdir())
    return tuple(sorted(path.stem for path in names if path.suffix == ".yaml"))


def packaged_text(folder: str, name: str) -> str:
    """One of these files."""
    file = resources.files("recipes").joinpath(folder, f"{name}.yaml")
    return file.read_text(encoding="utf-8")


def style_preset_names() -> tuple[str, ...]:
    """Their names, in alphabetical order."""
    return packaged("styles")


def style_preset_text(name: str) -> str:
    """The YAML of a style: mean and covariance of the colours of land and of sky.

    Raises:
        RecipeError: there is no style of that name.
    """
    if name not in style_preset_names():
        raise RecipeError(f"style {name!r}: {no_such_style(name)}")
    return packaged_text("styles", name)


def no_such_style(name: str) -> str:
    """What to say of a name that no style has."""
    names = style_preset_names()
    return f"no such style; {did_you_mean(name, names)}styles are {', '.join(names)}"


# ---- What a recipe may say of style: the colour mood of a photograph, or of a preset -------------

FILES = ("image", "mask", "checkpoint")  # the fields that name one


def _known(name: str) -> str:
    if name not in style_preset_names():
        raise ValueError(no_such_style(name))
    return name


StyleName = Annotated[str, Strict(), AfterValidator(_known)]


class Style(Closed):
    """The colours of the scene, turned into those of an image or of a preset."""

    model_config = ConfigDict(json_schema_extra=one_of("image", "preset"))

    image: FilePath | None = None
    """The picture whose colours the scene takes on."""
    preset: StyleName | None = None
    """A style that comes with the package, in place of an image."""
    mask: FilePath | None = None
    """An image of the style image's shape, white where that shows sky; null to look for the sky at
    its top."""
    method: Literal["mkl", "reinhard", "gscm"] = "mkl"
    """mkl maps mean and covariance of the colours (Monge-Kantorovich), reinhard mean and spread of
    each channel; gscm is the network."""
    strength: Number = Field(default=1.0, ge=0, le=2)
    """0 leaves the scene's colours, 1 takes on the style's."""
    per_region: Flag = False
    """Maps of their own for road, vegetation and the rest, where the scene knows its classes."""
    applied_to: Literal["scene", "picture"] = "scene"
    """scene styles what stands in the weather, picture also the weather itself."""
    evaluated: Literal["color", "sh"] = "color"
    """color maps every colour as it is seen; sh maps the background's spherical harmonics once,
    which frames pay nothing for and which differs where colours that change with the direction
    reach below 0. Of applied_to scene."""
    checkpoint: FilePath | None = None
    """A trained network for gscm; null for the one that comes with the package."""
    digest: Digest | None = None
    """SHA-256 over what the files above hold; checked where given, worked out where null."""

    @model_validator(mode="after")
    def _one_source(self) -> Style:
        if (self.image is None) == (self.preset is None):
            both = "both give" if self.image is not None else "neither gives"
            raise ValueError(f"image and preset {both} the style: give one of them")
        if self.image is None and self.mask is not None:
            raise ValueError("mask belongs to an image, and there is none")
        if self.image is None and self.method == "gscm":
            raise ValueError("method gscm looks at an image: give image instead of preset")
        if self.image is None and self.digest is not None:
            raise ValueError("digest belongs to an image, and there is none")
        if self.checkpoint is not None and self.method != "gscm":
            raise ValueError(f"checkpoint belongs to method gscm; method is {self.method}")
        if self.method == "gscm" and self.per_region:
            raise ValueError("per_region is for mkl and reinhard: gscm gives one map for all")
        if self.applied_to == "picture" and self.per_region:
            raise ValueError("per_region is for applied_to scene: a picture has one map for all")
        return self

    @property
    def changes(self) -> bool:
        """Whether there is any: a style of no strength changes nothing."""
        return self.strength > 0

    @property
    def name(self) -> str:
        """Of the preset, or of the image's file without its folders."""
        return self.preset or PurePath(self.image or "").name

    @property
    def files(self) -> dict[str, str]:
        """The files that it names, by field."""
        named = {name: getattr(self, name) for name in FILES}
        return {name: path for name, path in named.items() if path is not None}


# ---- flood ---------------------------------------------------------------------------------------

MAX_WAVES = 64
# Absorption of pure water at 650, 550 and 450 nm, 1/metre (Pope and Fry 1997).
PURE_WATER_PER_M = (0.340, 0.0565, 0.00922)
# Extinction that one nephelometric turbidity unit of particles adds, 1/metre, to a factor of two. A
# black disc is seen as far as 4.8 / extinction (Davies-Colley and Smith 2001).
EXTINCTION_PER_M_PER_NTU = 0.5
DEFAULT_TURBIDITY_NTU = 50.0  # moderately turbid, as a street's run-off is

_CLARITIES = ("turbidity_ntu", "absorption_per_m")
# In words of JSON Schema: the two are not both present and not null.
_ONE_CLARITY: JsonDict = {
    "not": {"required": [*_CLARITIES], "properties": dict.fromkeys(_CLARITIES, _PRESENT)}
}


class Wave(Closed):
    """One Gerstner wave."""

    direction_deg: Angle = 0.0
    """Where it runs to: 0 is world +x, 90 is +y."""
    amplitude_m: Number = Field(ge=0, le=100)
    """Half its height from trough to crest; at most its wavelength / 2 pi."""
    wavelength_m: Number = Field(ge=1e-3, le=1e4)
    """From crest to crest."""
    steepness: Number = Field(default=0.0, ge=0, le=1)
    """0 is a sine, 1 the sharpest crest it can have without looping; at most 1 over all waves
    together."""
    phase_deg: Angle = 0.0
    """At the world's origin at time 0."""

    @model_validator(mode="after")
    def _not_breaking(self) -> Wave:
        highest_m = self.wavelength_m / (2 * math.pi)
        if self.amplitude_m > highest_m:
            raise ValueError(
                f"amplitude_m = {self.amplitude_m:g} is too high for "
                f"wavelength_m = {self.wavelength_m:g}: the wave would break; "
                f"at most {_rounded_down(highest_m)} (wavelength / 2 pi)"
            )
        return self


class Waves(Closed):
    """The water's surface: a preset's spectrum, drawn from a seed, or waves one by one."""

    preset: Literal["still", "calm", "breeze", "wind"] = "calm"
    """Spectrum to draw waves from; of no effect beside components."""
    count: Whole = Field(default=24, ge=1, le=MAX_WAVES)
    """How many waves are drawn from the spectrum."""
    direction_deg: Angle = 30.0
    """Where the preset's wind blows to: 0 is world +x, 90 is +y."""
    height: Number = Field(default=1.0, ge=0, le=10)
    """Factor on the amplitudes of the preset's waves."""
    seed: Whole | None = Field(default=None, ge=0, lt=2**63)
    """What the preset's waves are drawn from; null for the recipe's seed."""
    components: tuple[Wave, ...] | None = Field(default=None, max_length=MAX_WAVES)
    """Waves one by one, in place of a preset's; an empty list is still water."""

    @model_validator(mode="after")
    def _no_loops(self) -> Waves:
        waves = self.components or ()
        steepness = math.fsum(wave.steepness for wave in waves)
        if steepness > 1:
            raise ValueError(
                f"the steepness of its {len(waves)} components adds up to {steepness:.6g}; "
                "above 1 the surface would loop"
            )
        return self


class Flood(Closed):
    """Standing water with a horizontal surface: waves, reflection, refraction, absorption."""

    model_config = ConfigDict(json_schema_extra=_ONE_CLARITY)

    level_m: Number = Field(ge=-1e4, le=1e4)
    """Height of the water's surface above the reference."""
    reference: Literal["lowest", "median", "absolute"] = "lowest"
    """What level_m counts from: the lowest or the median height of the road along the drive, or z =
    0 of the scene's world."""
    turbidity_ntu: Number | None = Field(
        default=None,
        ge=0,
        le=1e6,
        description="How cloudy the water is; 0 is pure water. "
        f"{DEFAULT_TURBIDITY_NTU:g} where neither it nor absorption_per_m is given.",
    )
    absorption_per_m: Rates | None = None
    """Extinction along the way through the water, in place of turbidity_ntu."""
    color: Colour = (0.42, 0.38, 0.30)
    """Colour of deep water seen from above, without reflections, display-encoded sRGB."""
    refraction_index: Number = Field(default=1.333, ge=1, le=3)
    """Of the water; 1 neither reflects nor bends."""
    waves: Waves = Waves()
    fresnel: Literal["exact", "schlick"] = "exact"
    """How the share of reflected light follows from the angle."""
    reflection: Literal["sky", "screen_space", "mirrored"] = "mirrored"
    """What is reflected: the sky alone; what the image shows, the rest from a coarse mirrored view;
    or a second view from the camera mirrored in the water."""

    @model_validator(mode="after")
    def _one_clarity(self) -> Flood:
        if self.turbidity_ntu is not None and self.absorption_per_m is not None:
            both = "turbidity_ntu and absorption_per_m both say how clear the water is"
            raise ValueError(f"{both}: keep one of them")
        return self

    @property
    def effective_turbidity_ntu(self) -> float | None:
        """The turbidity that the water is drawn with; None where its extinction is given."""
        if self.absorption_per_m is not None:
            return None
        return DEFAULT_TURBIDITY_NTU if self.turbidity_ntu is None else self.turbidity_ntu

    @property
    def extinction_per_m_rgb(self) -> tuple[float, float, float]:
        """Along the way through the water: given, or pure water and grey particles."""
        if self.absorption_per_m is not None:
            return self.absorption_per_m
        assert self.effective_turbidity_ntu is not None
        particles = EXTINCTION_PER_M_PER_NTU * self.effective_turbidity_ntu
        red, green, blue = PURE_WATER_PER_M
        return (red + particles, green + particles, blue + particles)


def _rounded_down(number: float) -> str:
    """Four digits that are at most the number: what a message allows must be allowed."""
    step = 10.0 ** (math.floor(math.log10(number)) - 3)
    return f"{math.floor(number / step) * step:.4g}"
