"""The recipe section of smog: its fields, knobs and manifest columns."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import ConfigDict, Field, model_validator

from recipes.effect import Column, EffectModel, Knob
from recipes.fields import Angle, Colour, Number, Unit, one_of
from recipes.moment import Moment

# Optical depth of the visibility, -ln(0.02): contrast has fallen to 2 % there. No unit.
KOSCHMIEDER = 3.912
# Optical depth of the meteorological optical range, -ln(0.05): 5 % of a collimated beam arrives
# there (CIE S 017, term 17-31-018). No unit.
MOR_DEPTH = math.log(20)
# Largest speed of the wind.
MAX_WIND_MPS = 60.0
# Largest extinction: nothing is visible through 10 cm of it.
MAX_EXTINCTION_PER_M = 100.0
# Fields of which exactly one gives the density.
DENSITY_FIELDS = ("visibility_m", "extinction_per_m", "mor_m")


class Smog(EffectModel):
    """Fog, haze or smog: Beer-Lambert extinction towards an airlight colour."""

    model_config = ConfigDict(json_schema_extra=one_of(*DENSITY_FIELDS))
    in_first_release = True
    later_fields = (
        "mor_m",
        "overcast",
        "scatter",
        "shadow_fade",
        "gloss_fade",
        "blend",
        "patchiness",
        "bank_m",
        "wind_mps",
        "wind_from_deg",
        "drift_m",
    )
    synonyms = (
        ("smog", "fog haze mist"),
        ("extinction_per_m", "beta density sigma"),
        ("mor_m", "mor meteorological_optical_range sensor_visibility_m"),
        ("color", "airlight"),
        ("patchiness", "banks patchy fog_banks"),
        ("wind_mps", "wind_speed"),
        ("wind_from_deg", "wind_direction wind_deg"),
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
    mor_m: Number | None = Field(default=None, gt=0, le=1e6)
    """Meteorological optical range at the base height, as a transmissometer or a forward-scatter
    sensor reads it: 2.996 / (extinction (1 + scatter))."""
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
    gloss_fade: Unit = 0.0
    """How much of the blue that glossy surfaces mirror of a clear sky turns grey: 1 all, 0 none."""
    blend: Literal["display", "linear"] = "display"
    """display mixes the display-encoded colours of things and air, as splats are blended; linear
    mixes their light, as air does, so that dark things pale while they are still near."""
    patchiness: Number = Field(default=0.0, ge=0, le=2)
    """Standard deviation of the logarithm of the density in space, whose mean is the density given:
    0 is the same fog everywhere, 0.3 hardly uneven, 0.7 patchy, 2 clear gaps between banks."""
    bank_m: Number = Field(default=300.0, ge=50, le=10_000)
    """Width of the largest banks; they are twice as long along the wind."""
    wind_mps: Number = Field(default=2.0, ge=0, le=MAX_WIND_MPS)
    """Speed of the wind, with which banks drift; of no effect without patchiness."""
    wind_from_deg: Angle = 0.0
    """Where the wind comes from: 0 is world +x, 90 is +y."""
    drift_m: Number | None = Field(default=None, ge=-1e9, le=1e9)
    """Way that banks have drifted since the time 0; null for wind_mps times the time."""

    @model_validator(mode="after")
    def _one_density(self) -> Smog:
        present_fields = [name for name in DENSITY_FIELDS if getattr(self, name) is not None]
        if not present_fields:
            raise ValueError(
                "needs a density: give visibility_m (metres) or extinction_per_m (1/metre), or "
                "mor_m (metres), a sensor's reading"
            )
        if len(present_fields) > 1:
            count = "both" if len(present_fields) == 2 else "all"
            raise ValueError(
                f"{' and '.join(present_fields)} {count} give the density: keep one of them"
            )
        if self.resolved_extinction_per_m > MAX_EXTINCTION_PER_M:
            name = present_fields[0]
            raise ValueError(
                f"{name} = {getattr(self, name):g} means an extinction of "
                f"{self.resolved_extinction_per_m:.3g}/metre; at most "
                f"{MAX_EXTINCTION_PER_M:g}/metre is allowed"
            )
        return self

    def state_at(self, path: str, moment: Moment) -> EffectModel:
        """Return the section with the way that its banks have drifted, if the wind changes."""
        wind = moment.curves.get(f"{path}.wind_mps")
        if wind is None or self.patchiness == 0 or self.drift_m is not None:
            return self
        time_s = moment.time_s
        way_m = wind.integral(0, time_s) if time_s >= 0 else -wind.integral(time_s, 0)
        return self.model_copy(update={"drift_m": way_m})

    @property
    def resolved_extinction_per_m(self) -> float:
        """Return the extinction coefficient at the base height, 1/metre.

        It is that of large things. A sensor's beam is narrow: the beam loses the light that
        droplets diffract as well, which has `scatter` times the optical depth.
        """
        if self.extinction_per_m is not None:
            return self.extinction_per_m
        if self.mor_m is not None:
            return MOR_DEPTH / (self.mor_m * (1 + self.scatter))
        assert self.visibility_m is not None
        return KOSCHMIEDER / self.visibility_m
