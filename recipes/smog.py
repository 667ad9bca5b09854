"""The recipe section of smog: its fields, knobs and manifest columns."""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict, Field, model_validator

from recipes.effect import Column, EffectModel, Knob
from recipes.fields import Colour, Number, Unit, one_of

# Optical depth of the visibility, -ln(0.02): contrast has fallen to 2 % there. No unit.
KOSCHMIEDER = 3.912
# Largest extinction: nothing is visible through 10 cm of it.
MAX_EXTINCTION_PER_M = 100.0


class Smog(EffectModel):
    """Fog, haze or smog: Beer-Lambert extinction towards an airlight colour."""

    model_config = ConfigDict(json_schema_extra=one_of("visibility_m", "extinction_per_m"))
    in_first_release = True
    later_fields = ("overcast", "scatter", "shadow_fade")
    synonyms = (
        ("smog", "fog haze mist"),
        ("extinction_per_m", "beta density sigma"),
        ("color", "airlight"),
    )
    # Smog on buffers saves nothing here, whatever it costs.
    knobs = (
        Knob("model", ("deferred", "per_gaussian"), "smog on buffers or on splats", 10, False),
    )
    columns = (
        Column(
            "smog_extinction_per_m",
            lambda smog: smog.resolved_extinction_per_m,
            "Visibility in smog",
            "m",
            value_if_absent=0.0,
            presence_values="nonzero",
            numerator=KOSCHMIEDER,
            label="visibility",
            caption="visibility {smog_extinction_per_m:.0f} m",
        ),
        Column(
            "smog_scale_height_m", lambda smog: smog.scale_height_m, "Scale height of smog", "m"
        ),
    )

    visibility_m: Number | None = Field(default=None, gt=0, le=1e6)
    """Meteorological visibility at the base height: 3.912 / extinction."""
    extinction_per_m: Number | None = Field(default=None, ge=0, le=MAX_EXTINCTION_PER_M)
    """Extinction coefficient at the base height."""
    color: Colour = (0.76, 0.78, 0.80)
    """Airlight colour, at the horizon: red, green, blue, display-encoded sRGB."""
    scale_height_m: Number | None = Field(default=None, ge=0.1, le=1e5)
    """Height over which the density falls by e; null for uniform smog."""
    base_height_m: Number = Field(default=0.0, ge=-1e4, le=1e4)
    """Height above the road where the density is the one given; of no effect on uniform smog."""
    model: Literal["per_gaussian", "deferred"] = "per_gaussian"
    """per_gaussian fogs every splat before blending; deferred fogs the finished buffers."""
    overcast: Number = Field(default=0.0, ge=0, le=1)
    """How much brighter airlight is above the horizon, and darker towards the road: 0 is one colour
    in all directions, 0.5 what light scattered in thick fog over asphalt comes to, 1 an overcast
    sky, whose zenith has three times the horizon's luminance."""
    scatter: Number = Field(default=0.0, ge=0, le=4)
    """Forward scatter, which blurs what stands deep in fog: 1 for all that droplets of 20 um
    diffract, 0 for none, as of the finer particles of smog and haze."""
    shadow_fade: Unit = 0.0
    """How much of the ground's cast shadows goes with the sun's light that smog keeps from it: 1
    all that its optical depth towards the sun says, 0 none."""

    @model_validator(mode="after")
    def _one_density(self) -> Smog:
        both = "visibility_m and extinction_per_m both give the density: keep one of them"
        neither = "needs a density: give visibility_m (metres) or extinction_per_m (1/metre)"
        if (self.visibility_m is None) == (self.extinction_per_m is None):
            raise ValueError(neither if self.visibility_m is None else both)
        if self.resolved_extinction_per_m > MAX_EXTINCTION_PER_M:
            raise ValueError(
                f"visibility_m = {self.visibility_m:g} means an extinction of "
                f"{self.resolved_extinction_per_m:.3g}/metre; at most "
                f"{MAX_EXTINCTION_PER_M:g}/metre is allowed"
            )
        return self

    @property
    def resolved_extinction_per_m(self) -> float:
        """Return the extinction coefficient at the base height, 1/metre."""
        if self.extinction_per_m is not None:
            return self.extinction_per_m
        assert self.visibility_m is not None
        return KOSCHMIEDER / self.visibility_m
