"""The recipe section of a flood: its fields, knobs and manifest columns."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import ConfigDict, Field, model_validator
from pydantic.config import JsonDict

from recipes.effect import Column, EffectModel, Knob
from recipes.fields import PRESENT, Angle, ClosedModel, Colour, Number, Rates, Whole

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
    "not": {"required": [*_CLARITIES], "properties": dict.fromkeys(_CLARITIES, PRESENT)}
}


class Wave(ClosedModel):
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


class Waves(ClosedModel):
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

    @property
    def is_drawn(self) -> bool:
        """Return True if waves are drawn from a spectrum."""
        return self.components is None and self.preset != "still" and self.height > 0


class Flood(EffectModel):
    """Standing water with a horizontal surface: waves, reflection, refraction, absorption."""

    model_config = ConfigDict(json_schema_extra=_ONE_CLARITY)
    synonyms = (
        ("flood", "water puddle puddles"),
        ("level_m", "depth depth_m"),
        ("turbidity_ntu", "clarity"),
        ("refraction_index", "ior refraction"),
        ("waves", "wind ripples"),
    )
    knobs = (
        Knob(
            "reflection",
            ("sky", "screen_space", "mirrored"),
            "what water reflects",
            1,
            tiers={"draft": "screen_space"},
        ),
        Knob(
            "waves.count",
            (6, 12, 24),
            "waves that make up the surface",
            7,
            applies_to=lambda flood: flood.waves.is_drawn,
        ),
        Knob("fresnel", ("schlick", "exact"), "share of reflected light", 8),
    )
    columns = (
        Column(
            "flood_level_m",
            lambda flood: flood.level_m,
            "Water level",
            "m",
            presence_values="all",  # at a level of 0 too
            linear=True,
            label="water at",
            caption="water at {flood_level_m:.2f} m",
        ),
        # NaN where the recipe gives an absorption.
        Column(
            "flood_turbidity_ntu",
            lambda flood: flood.effective_turbidity_ntu,
            "Turbidity of water",
            "NTU",
        ),
        # A factor on a preset's waves, NaN where waves are listed.
        Column(
            "flood_wave_height",
            lambda flood: flood.waves.height if flood.waves.components is None else None,
            "Wave height, × preset",
        ),
    )

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

    def beam_surface(self, output_surface: str) -> tuple[str, bool] | None:
        return "water", output_surface == "first"

    @property
    def effective_turbidity_ntu(self) -> float | None:
        """Return the turbidity with which the water is drawn, or None if its extinction is
        given.
        """
        if self.absorption_per_m is not None:
            return None
        return DEFAULT_TURBIDITY_NTU if self.turbidity_ntu is None else self.turbidity_ntu

    @property
    def extinction_per_m_rgb(self) -> tuple[float, float, float]:
        """Return the extinction of red, green and blue light in the water, 1/metre.

        It is the recipe's, or that of pure water and grey particles.
        """
        if self.absorption_per_m is not None:
            return self.absorption_per_m
        assert self.effective_turbidity_ntu is not None
        particles = EXTINCTION_PER_M_PER_NTU * self.effective_turbidity_ntu
        red, green, blue = PURE_WATER_PER_M
        return (red + particles, green + particles, blue + particles)


def _rounded_down(number: float) -> str:
    """Return four digits that are at most the number: the limit in a message must itself be
    allowed.
    """
    step = 10.0 ** (math.floor(math.log10(number)) - 3)
    return f"{math.floor(number / step) * step:.4g}"
