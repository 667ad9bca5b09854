"""What a recipe may say of a flood."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, model_validator

Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Unit = Annotated[float, Strict(), Field(ge=0.0, le=1.0)]
Colour = tuple[Unit, Unit, Unit]
Rate = Annotated[float, Strict(), Field(ge=0.0, le=1e6)]
Rates = tuple[Rate, Rate, Rate]

MOST_WAVES = 64


class _Closed(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Wave(_Closed):
    """One Gerstner wave."""

    direction_deg: Number = Field(
        default=0.0, ge=-360, le=360, description="Where it runs to: 0 is world +x, 90 is +y."
    )
    amplitude_m: Number = Field(ge=0, le=100, description="Half its height.")
    wavelength_m: Number = Field(ge=1e-3, le=1e4, description="Crest to crest.")
    steepness: Number = Field(
        default=0.0,
        ge=0,
        le=1,
        description="0 is a sine, 1 the sharpest crest it can have without looping.",
    )
    phase_deg: Number = Field(default=0.0, ge=-360, le=360, description="At the origin at time 0.")


class Waves(_Closed):
    """The water's surface: a preset's spectrum, drawn from a seed, or waves one by one."""

    preset: Literal["still", "calm", "breeze", "wind"] = Field(
        default="calm", description="Spectrum to draw waves from; of no effect beside components."
    )
    count: Whole = Field(
        default=24, ge=1, le=MOST_WAVES, description="How many waves are drawn from the spectrum."
    )
    direction_deg: Number = Field(
        default=30.0, ge=-360, le=360, description="Where the wind blows to: 0 is world +x."
    )
    height: Number = Field(
        default=1.0, ge=0, le=10, description="Factor on the amplitudes of the preset's waves."
    )
    seed: Whole | None = Field(
        default=None, ge=0, lt=2**63, description="Of the waves; the recipe's seed if null."
    )
    components: tuple[Wave, ...] | None = Field(
        default=None, max_length=MOST_WAVES, description="Waves one by one, instead of a preset."
    )


class Flood(_Closed):
    """Standing water with a horizontal surface: waves, reflection, refraction, absorption."""

    level_m: Number = Field(
        ge=-1e4, le=1e4, description="Height of the surface above the reference."
    )
    reference: Literal["lowest", "median", "absolute"] = Field(
        default="lowest",
        description="What level_m counts from: the lowest or the median height of the road along "
        "the drive, or z = 0 of the scene's world.",
    )
    turbidity_ntu: Number | None = Field(
        default=None,
        ge=0,
        le=1e6,
        description="How cloudy the water is; 0 is pure water. 50 where neither it nor "
        "absorption_per_m is given.",
    )
    absorption_per_m: Rates | None = Field(
        default=None,
        description="Extinction along the way through the water, for red, green and blue.",
    )
    color: Colour = Field(
        default=(0.42, 0.38, 0.30),
        description="Colour of deep water seen from above, display-encoded sRGB.",
    )
    refraction_index: Number = Field(
        default=1.333, ge=1, le=3, description="Of the water; 1 neither reflects nor bends."
    )
    waves: Waves = Waves()
    fresnel: Literal["exact", "schlick"] = Field(
        default="exact", description="How the share of reflected light follows from the angle."
    )
    reflection: Literal["sky", "screen_space", "mirrored"] = Field(
        default="mirrored",
        description="What is reflected: the sky alone; what the image shows, the rest from a "
        "coarse mirrored view; or a second view from the camera mirrored in the water.",
    )

    @model_validator(mode="after")
    def _one_extinction(self) -> Flood:
        if self.turbidity_ntu is not None and self.absorption_per_m is not None:
            raise ValueError(
                "turbidity_ntu and absorption_per_m both say how clear the water is: keep one"
            )
        return self
