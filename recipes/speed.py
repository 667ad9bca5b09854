"""The recipe section `render.speed`: settings of the renderer that few recipes give.

Its fields were fields of other sections before. The hashes of recipes, the draws from ranges, the
settings in manifests and the stored choices of settings still name them by their former paths, so
that outputs of older versions go on.
"""

from __future__ import annotations

from typing import Any

from pydantic import Field

from recipes.effect import Knob, Section
from recipes.fields import Flag, Number, Whole

# Paths of the fields, by their former paths. Files that people write are refused with a former
# path. Recipes in numbers, which jobs leave beside their images, are read with either.
MOVED_FIELDS = {
    "render.alpha_max": "render.speed.alpha_max",
    "render.antialiased": "render.speed.antialiased",
    "render.radius_clip_px": "render.speed.radius_clip_px",
    "render.transmittance_stop": "render.speed.transmittance_stop",
    "render.fog_cut": "render.speed.fog_cut",
    "render.prune": "render.speed.prune",
    "render.lod_px": "render.speed.lod_px",
    "weather.flood.layers_px": "render.speed.layers_px",
    "weather.flood.bed_cut": "render.speed.bed_cut",
    "weather.rain.mirror_px": "render.speed.mirror_px",
    "weather.rain.min_width_px": "render.speed.rain_min_width_px",
    "weather.snowfall.min_width_px": "render.speed.snowfall_min_width_px",
    "quality.settled": "render.speed.settled",
}
# Paths of all fields, by their places in hashes: the sections whose pictures they change.
HASHED_PLACES = {
    **MOVED_FIELDS,
    "light.lamp_points": "render.speed.lamp_points",
    "light.lamp_halo_px": "render.speed.lamp_halo_px",
    "light.lamps_per_pixel": "render.speed.lamps_per_pixel",
}
_FORMER_PATHS = {path: former for former, path in MOVED_FIELDS.items()}


class Speed(Section):
    """Settings that trade accuracy for speed. `quality` sets most of them, and few recipes give
    any.
    """

    later_fields = (
        "radius_clip_px",
        "transmittance_stop",
        "fog_cut",
        "prune",
        "lod_px",
        "layers_px",
        "bed_cut",
        "lamp_points",
        "lamp_halo_px",
        "lamps_per_pixel",
    )
    knobs = (
        Knob(
            "prune",
            (0.006, 0.001, 0.0007, 0.0004, 0.0),
            "splats that no view would miss are left out",
            1.5,
            tiers={"draft": 0.006, "balanced": 0.0007},
        ),
        Knob(
            "layers_px",
            (4.0, 2.0, 1.0),
            "width of the bed's and the mirrored view's pixels",
            3,
            tiers={"draft": 4.0, "balanced": 2.0},
            section="weather.flood",
        ),
        Knob("radius_clip_px", (3.0, 2.0, 1.0, 0.0), "splats no larger are left out", 4),
        Knob(
            "transmittance_stop",
            (0.05, 0.02, 0.01, 1e-3, 1e-4),
            "light behind it is given up",
            5,
            tiers={"draft": 0.02, "balanced": 0.02},
        ),
        Knob(
            "fog_cut",
            (0.02, 0.0039, 0.0),
            "splats behind so much fog are left out",
            5.5,
            tiers={"draft": 0.02, "balanced": 0.0039},
        ),
        Knob(
            "bed_cut",
            (0.03, 0.006, 0.001),
            "bed that hardly shows through water",
            6,
            section="weather.flood",
        ),
        Knob(
            "mirror_px",
            (8.0, 4.0, 2.0),
            "resolution of what wet ground mirrors",
            6.5,
            tiers={"draft": 4.0},
            applies_to=lambda rain: rain.wets_ground,
            section="weather.rain",
        ),
        Knob(
            "rain_min_width_px",
            (1.0, 0.5, 0.35, 0.25),
            "drops drawn one by one; the rest is veil",
            7.5,
            tiers={"draft": 0.5, "balanced": 0.5},
            section="weather.rain",
        ),
        Knob(
            "snowfall_min_width_px",
            (2.0, 1.0, 0.5, 0.35),
            "flakes drawn one by one; the rest is veil",
            8.5,
            tiers={"draft": 1.0},
            section="weather.snowfall",
        ),
        Knob(
            "lamp_points",
            (4, 8, 16),
            "points of the sum for lamps' light in the air",
            8.6,
            section="light",
        ),
        Knob(
            "lamp_halo_px", (8, 4, 2), "width of the pixels of lamps' halos", 8.7, section="light"
        ),
        Knob("lamps_per_pixel", (2, 4, 8), "lamps that light one surface", 8.8, section="light"),
        Knob(
            "lod_px",
            (2.0, 1.0, 0.5, 0.0),
            "far splats are merged in cells as large",
            13,
            is_selectable=False,  # it saves in scenes of many millions, and there nothing is pruned
        ),
    )

    alpha_max: Number = Field(default=0.999, gt=0, le=0.9999)
    """Cap of one splat's alpha: 0.999, or the original 3DGS's 0.99."""
    antialiased: Flag = False
    """Opacity compensated for the screen blur."""
    radius_clip_px: Number = Field(default=0.0, ge=0, le=64)
    """Splats that reach no farther than this from their centre along x or y, pixels of the rendered
    picture, are left out; 0 leaves out none."""
    transmittance_stop: Number = Field(default=1e-4, ge=1e-6, le=0.25)
    """A pixel is finished once no more than this share of the light behind shines through; what it
    shows by then stands for the rest. 1e-6 blends what no picture in 8 bits shows; 0.5 would leave
    no median depth, hence the limit."""
    fog_cut: Number = Field(default=0.0039, ge=0, le=0.1)
    """Splats of which smog lets no more than this share through are left out, and pixels finished
    once no more of what is behind would be seen: at 0.0039 a level of 255. It counts where the
    picture alone is wanted: depth, classes, snow and water are drawn through any smog."""
    prune: Number = Field(default=0.0, ge=0, le=0.5)
    """Splats of the background are left out of which each alone changes the mean of a recorded view
    so little that it adds up to no more than this share of white; 0 leaves out none. Found once a
    scene, for views from within 2 m of a recorded one; of no effect with lod_px or on recorded
    images."""
    lod_px: Number = Field(default=0.0, ge=0, le=64)
    """Far splats of large backgrounds are merged, once a scene, in cells that are no larger than
    this in the picture, pixels, or twice that where they are of one colour; 0 draws all as they
    are. For scenes of many millions."""
    layers_px: Number = Field(default=2.0, ge=1, le=8)
    """Width of the pixels that the bed and the mirrored view of a flood are drawn in, of the
    picture's; the bed's only where the picture alone is wanted."""
    bed_cut: Number = Field(default=0.006, ge=0.001, le=0.1)
    """Bed of which no more than this share comes up through the water is left out: at 0.006 one and
    a half levels of 255, of a bed as far from the water's colour as white from black. Depth and
    classes show it."""
    mirror_px: Number = Field(default=2.0, ge=1, le=16)
    """What wet ground mirrors is drawn with pixels this wide, pixels of the rendered picture."""
    rain_min_width_px: Number = Field(default=0.35, ge=0.1, le=16)
    """Drops are drawn one by one up to where they are this wide, pixels of the rendered picture;
    farther ones are the veil."""
    snowfall_min_width_px: Number = Field(default=0.5, ge=0.1, le=16)
    """Flakes are drawn one by one up to where they are this wide, pixels of the rendered picture;
    farther ones are the veil."""
    lamp_points: Whole = Field(default=8, ge=2, le=16)
    """Points of the sum along each ray for the light that the air scatters out of lamps' beams."""
    lamp_halo_px: Whole = Field(default=4, ge=1, le=32)
    """Width of the pixels in which that light is computed, of the picture's."""
    lamps_per_pixel: Whole = Field(default=8, ge=1, le=64)
    """Lamps that light one part of a surface at most: the strongest."""
    settled: Flag = False
    """Whether max_flip or budget_ms has made its choice, which the recipe then holds: so it is in
    the recipes that a job leaves, and nothing is chosen again."""


def former_path(path: str) -> str:
    """Return the path by which hashes, draws, manifests and stored choices name a field."""
    return _FORMER_PATHS.get(path, path)


def put_in_former_places(recipe: dict[str, Any]) -> None:
    """Move the fields of a recipe, as plain mappings, to the sections that had them before.

    A recipe's hash names every image that has been rendered with it. So it is the hash of the
    recipe in its former form: of the same fields in the same sections. A field of an absent effect
    has no place there. Later fields at their defaults are left out, as everywhere in hashes.
    """
    speed = recipe["render"].pop("speed")
    for former, path in HASHED_PLACES.items():
        name = path.rpartition(".")[2]
        section_path, _, former_name = former.rpartition(".")
        section: Any = recipe
        for key in section_path.split("."):
            section = section and section[key]
        is_default = speed[name] == Speed.model_fields[name].default
        if section is not None and not (is_default and name in Speed.later_fields):
            section[former_name] = speed[name]
