"""The recipe section `light`: the hour, the lamps that shine, and the camera that sees them."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from recipes.effect import Column, EffectModel
from recipes.fields import Angle, ClosedModel, Digest, FilePath, Number, Unit
from recipes.smog import MOR_DEPTH

# Mean luminance of the sky by hour, cd/m2: pi times as many lux on level ground. 400 lx fall at
# sunset and 3.4 lx at the dark end of civil twilight; dusk lies between. Over cities the night sky
# has 0.02 to 0.1 cd/m2. By day the scene says how much sun there is.
DUSK_LUMINANCE_CD_M2 = 3.0
NIGHT_LUMINANCE_CD_M2 = 0.05
# Distance over which less than 5 % of the light must arrive for `auto` to turn lamps on, metres.
POOR_VISIBILITY_M = 500.0
# Illuminance of level ground below which `auto` turns lamps on, lux.
DIM_LUX = 1000.0
# Largest number of lamps that a recipe lists.
MAX_LISTED_LAMPS = 1000


class ListedLamp(ClosedModel):
    """A lamp of the recipe's own, fixed to the world."""

    x_m: Number = Field(ge=-1e7, le=1e7)
    """Where it is, in the scene's world as its labels have it: x."""
    y_m: Number = Field(ge=-1e7, le=1e7)
    """Its y."""
    z_m: Number = Field(ge=-1e5, le=1e5)
    """Its z; above the ground."""
    azimuth_deg: Angle = 0.0
    """Where its beam points to: 0 is world +x, 90 is +y."""
    elevation_deg: Number = Field(default=0.0, ge=-90, le=90)
    """How far above the horizon its beam points; of no effect on street lamps, which shine down."""
    candela: Number = Field(ge=0, le=1e7)
    """Its intensity where it is brightest."""
    kind: Literal["street", "dipped", "high", "tail", "stop", "signal", "flood", "bulb"] = "street"
    """How its light spreads: street along the road on both sides, dipped and high like headlamps,
    tail, stop and signal to the front within some 20 degrees, flood to the half space in front,
    bulb evenly to all sides."""
    kelvin: Number = Field(default=3000.0, ge=1700, le=20000)
    """Colour temperature: 2000 sodium, 3000 warm and 4000 neutral LED."""
    color: Literal["white", "red", "amber", "green"] = "white"
    """white for that of its temperature; or the colour of a signal."""
    radius_m: Number = Field(default=0.1, gt=0, le=5)
    """Radius of the disc that shines."""


class Light(EffectModel):
    """The hour of the day, lamps, and the exposure of the camera at dusk and night."""

    file_fields = ("street_ies",)
    synonyms = (
        ("light", "lights lamps lighting headlights night illumination"),
        ("time", "hour time_of_day daytime"),
        ("sky_luminance_cd_m2", "sky_luminance sky luminance"),
        ("moon_lux", "moon moonlight"),
        ("vehicles", "cars car_lights headlights vehicle_lamps"),
        ("own_beams", "own_lights ego_beams headlamps beams"),
        ("street", "street_lamps street_lights lamp_posts"),
        ("street_ies", "ies photometry"),
        ("glare", "bloom veil flare"),
        ("iso", "gain sensitivity"),
        ("digest", "sha256"),
    )
    columns = (
        Column("light_time", lambda light: light.time, "Hour", value_if_absent=None, label="light"),
        Column(
            "light_sky_cd_m2",
            lambda light: light.sky_luminance,
            "Luminance of the sky",
            "cd/m2",
            presence_values="nonzero",
            decides_absence=False,
            caption="{light_time}",
        ),
        Column("light_vehicles", lambda light: light.vehicles, value_if_absent=None),
        Column("light_exposure", lambda light: light.exposure_in_words, value_if_absent=None),
    )

    time: Literal["day", "dusk", "night"] = "day"
    """day leaves the scene's own light and adds lamps; dusk and night take the sun away and darken
    scene and sky to sky_luminance_cd_m2."""
    sky_luminance_cd_m2: Number | None = Field(default=None, ge=0, le=1e5)
    """Mean luminance of the sky, of which pi times as many lux fall on level ground; null for 3 at
    dusk, 0.05 at night (a town's sky; 0.0002 far from towns), and by day for as much as the scene's
    sun and the recipe's weather suggest."""
    moon_lux: Number = Field(default=0.0, ge=0, le=1)
    """The moon's light on level ground at dusk and night: a full one 0.25."""
    glow: Number = Field(default=2.0, ge=0, le=20)
    """How much brighter the sky is at the horizon than overhead, at dusk and night: 0 evenly."""
    vehicles: Literal["auto", "on", "off"] = "auto"
    """Lamps of vehicles; auto turns them on at dusk and night, in rain and snowfall, where less
    than 5 % of the light arrives over 500 m, and by day where less than 1000 lx are stated."""
    vehicle_share: Unit = 1.0
    """Share of the vehicles whose lamps are on; parked ones stay dark but for a few."""
    own_beams: Literal["auto", "dipped", "high", "off"] = "auto"
    """The recording car's beams; auto is dipped whenever auto turns on those of vehicles."""
    street: Literal["auto", "on", "off"] = "auto"
    """Street lamps, where the scene has poles, or else by a rule along the street; auto is on at
    dusk and night."""
    street_ies: FilePath | None = None
    """How street lamps spread their light: an IES LM-63 file; null for a common LED lamp's."""
    street_spacing_m: Number = Field(default=30.0, ge=5, le=200)
    """Distance between street lamps along the street, on alternate sides, where the scene has no
    poles."""
    street_height_m: Number = Field(default=8.0, ge=2, le=40)
    """Height of those lamps above the road."""
    street_lumen: Number = Field(default=8000.0, ge=0, le=200000)
    """Light of one street lamp."""
    street_kelvin: Number = Field(default=3000.0, ge=1700, le=20000)
    """Colour temperature of street lamps: 2000 sodium, 3000 warm and 4000 neutral LED."""
    traffic: Literal["right", "left"] = "right"
    """Side of the road that traffic keeps to, to which dipped beams reach farther."""
    lamps: tuple[ListedLamp, ...] | None = Field(default=None, max_length=MAX_LISTED_LAMPS)
    """Further lamps, one by one, that are on at any hour."""
    exposure: Literal["auto", "fixed"] = "auto"
    """Of the camera at dusk and night: auto is chosen once for a scene by the light of sky and
    lamps on its road, the same for all cameras and times, with exposure_ms and iso as its limits;
    fixed takes these as they are."""
    exposure_ms: Number = Field(default=16.0, ge=0.001, le=1000)
    """How long the shutter is open."""
    iso: Number = Field(default=6400.0, ge=1, le=1e6)
    """Sensitivity of the sensor."""
    f_number: Number = Field(default=2.0, ge=0.5, le=32)
    """Focal length over the diameter of the lens."""
    white_balance: Unit = 0.6
    """How far the camera takes out the colour of the light on the road at dusk and night: 0 keeps
    that of daylight, so that warm lamps turn all brown, 1 makes the road grey."""
    glare: Number = Field(default=1.0, ge=0, le=20)
    """Light that lens and glass scatter around bright lamps: 1 for a clean lens, whose halo has 3 %
    of it; 3 to 10 wet or dirty, 0 none."""
    noise: Number = Field(default=0.4, ge=0, le=4)
    """Noise of the picture at dusk and night, over that of its electrons and their reading: 1 raw,
    0.4 as cameras' denoising leaves it, 0 none."""
    digest: Digest | None = None
    """SHA-256 over what the file above holds; checked where given, worked out where null."""

    @model_validator(mode="after")
    def _files_with_digest(self) -> Light:
        if self.digest is not None and self.street_ies is None:
            raise ValueError("digest belongs to street_ies, and there is none")
        return self

    @property
    def is_dark(self) -> bool:
        """Return True if the scene's own light is replaced."""
        return self.time != "day"

    @property
    def sky_luminance(self) -> float | None:
        """Return the mean luminance of the sky, cd/m2; None for that of the scene's day."""
        if self.sky_luminance_cd_m2 is not None:
            return self.sky_luminance_cd_m2
        by_time = {"dusk": DUSK_LUMINANCE_CD_M2, "night": NIGHT_LUMINANCE_CD_M2}
        return by_time.get(self.time)

    @property
    def exposure_in_words(self) -> str:
        """Return the exposure of dark scenes as `auto` or as `16 ms, ISO 800, f/2`."""
        if not self.is_dark:
            return "recorded"
        if self.exposure == "auto":
            return "auto"
        return f"{self.exposure_ms:g} ms, ISO {self.iso:g}, f/{self.f_number:g}"

    @property
    def has_effect(self) -> bool:
        """Return False by day without any lamp."""
        are_off = self.vehicles == "off" and self.own_beams == "off" and self.street != "on"
        return self.is_dark or not are_off or bool(self.lamps)


def foul_weather(rain_mm_h: float, snowfall_mm_h: float, extinction_per_m: float) -> str:
    """Return the weather that makes drivers turn on their lamps, in words; empty for none.

    Args:
        rain_mm_h: rate of rain.
        snowfall_mm_h: rate of snowfall.
        extinction_per_m: extinction of fog.
    """
    if rain_mm_h > 0:
        return "it rains"
    if snowfall_mm_h > 0:
        return "it snows"
    if extinction_per_m * POOR_VISIBILITY_M > MOR_DEPTH:
        return f"less than 5 % of the light arrives over {POOR_VISIBILITY_M:g} m of fog"
    return ""
