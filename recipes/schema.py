"""What a recipe may say once its ranges are resolved to numbers.

Every model is frozen and closed: an unknown key is an error, at every level. Units are in the names.
"""

from __future__ import annotations

import hashlib
import json
import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

KOSCHMIEDER = 3.912  # -ln(0.02): visibility is where contrast falls to 2 %

Unit = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]
Colour = tuple[Unit, Unit, Unit]


class _Closed(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Smog(_Closed):
    """Fog, haze or smog: Beer-Lambert extinction towards one airlight colour."""

    visibility_m: float | None = Field(
        default=None,
        gt=0,
        le=1e6,
        description="Meteorological visibility, metres: 3.912 / extinction.",
    )
    extinction_per_m: float | None = Field(
        default=None,
        ge=0,
        le=100,
        description="Extinction coefficient at the base height, 1/metre.",
    )
    color: Colour = Field(
        default=(0.76, 0.78, 0.80), description="Airlight colour, display-encoded sRGB in [0, 1]."
    )
    scale_height_m: float | None = Field(
        default=None,
        gt=0,
        le=1e5,
        description="Height over which the density falls by e, metres; null for uniform smog.",
    )
    base_height_m: float = Field(
        default=0.0,
        ge=-1e4,
        le=1e4,
        description="Height above the road where extinction_per_m holds, metres.",
    )
    model: Literal["per_gaussian", "deferred"] = Field(
        default="per_gaussian",
        description="per_gaussian fogs every splat before blending; deferred fogs the finished buffers.",
    )

    @model_validator(mode="after")
    def _one_density(self) -> Smog:
        if (self.visibility_m is None) == (self.extinction_per_m is None):
            raise ValueError(
                "give either visibility_m or extinction_per_m, "
                + ("not both" if self.visibility_m is not None else "one of them is needed")
            )
        return self

    @property
    def sigma_per_m(self) -> float:
        """Extinction coefficient at the base height, 1/metre."""
        if self.extinction_per_m is not None:
            return self.extinction_per_m
        assert self.visibility_m is not None
        return KOSCHMIEDER / self.visibility_m


class Weather(_Closed):
    """The effects of a recipe; null where one is absent."""

    smog: Smog | None = None


class Render(_Closed):
    """How the scene is drawn."""

    scale: float = Field(
        default=1.0, gt=0, le=4, description="Resolution relative to the cameras'."
    )
    near_m: float = Field(default=0.01, gt=0, le=100, description="Near plane, metres.")
    alpha_max: float = Field(
        default=0.999,
        gt=0,
        le=0.9999,
        description="Cap of one splat's alpha: 0.999, or 3DGS's 0.99.",
    )
    antialiased: bool = Field(default=False, description="Opacity compensated for the screen blur.")
    sh_degree: int | None = Field(
        default=None, ge=0, le=3, description="Highest spherical-harmonics band; null for all."
    )


class Output(_Closed):
    """What is written for each image."""

    image: Literal["png", "jpg"] = Field(default="png", description="Image format.")
    jpeg_quality: int = Field(default=92, ge=1, le=100, description="JPEG quality.")
    depth: Literal["median", "expected", "none"] = Field(
        default="median", description="Depth estimator written as 16-bit PNG, metres x 256."
    )
    semantic: bool = Field(default=False, description="Write the class of the heaviest splat.")
    instance: bool = Field(
        default=False, description="Write the actor number of the heaviest splat."
    )
    lidar: bool = Field(default=True, description="Pass LiDAR sweeps through.")
    labels: bool = Field(default=True, description="Pass 3D boxes through.")


class Recipe(_Closed):
    """A recipe in numbers: together with the package version it determines every pixel."""

    version: Literal[1] = 1
    name: str = Field(default="recipe", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")
    seed: int = Field(default=0, ge=0, lt=2**63)
    variant: int = Field(default=0, ge=0, description="Which draw from the ranges this is.")
    weather: Weather = Weather()
    render: Render = Render()
    output: Output = Output()

    def canonical_json(self) -> str:
        """One text per recipe: sorted keys, no spaces."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))

    @property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of canonical_json()."""
        return hashlib.sha256(self.canonical_json().encode()).hexdigest()[:16]

    def weather_numbers(self) -> dict[str, float]:
        """Flat numbers for the manifest, `smog.extinction_per_m` and so on; NaN where absent."""
        smog = self.weather.smog
        return {
            "smog_extinction_per_m": 0.0 if smog is None else smog.sigma_per_m,
            "smog_scale_height_m": math.nan
            if smog is None or smog.scale_height_m is None
            else smog.scale_height_m,
        }
