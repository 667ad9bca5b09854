"""Scenes, cameras and recipes at their extremes, as hypothesis draws them, and what every frame of
them must be. World: x ahead, z up, metres; the road is at z = 0.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from hypothesis import assume
from hypothesis import strategies as st
from pydantic import ValidationError

from augment import effects
from augment.effects.snow.plan import exposure_settings
from augment.exposure.exposed_surface import exposed_surface_of
from augment.memo import memo_of
from augment.render.composite import to_byte_array
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.scene import Actor, Gaussians, Ground, Scene, Track
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky, CubemapSky, LatLongSky, Sky
from augment.view.plan import plan_at
from augment.view.render_view import render_buffers, render_view
from augment.view.results import WeatheredBuffers, WeatheredView
from recipes.schema import Recipe
from tests.augment.hard_scenes import examples
from tests.snow_scenes import box_car, drive, sheet, side_wall, wall

SOAKING = examples(0) > 0  # asked for by the environment: kernels may take their time to compile
CELL_M = 0.2  # of the snow on the street: drawing cells as they come would place snow anew
SLOPES_DEG = (0.0, 50.0, 85.0)  # steepest that it lies on, for the same reason

# Coordinates, semi-axes and colours that the promises hold for; docs/stability.md states them.
FAR_M, WIDEST_M, BRIGHTEST = 1e6, 1e4, 1e4
_PLACES_M = (0.0, 5e-324, 1e-40, 1e-8, 0.01, 0.5, 1.2, 3.0, 6.0, 100.0, 1e4, FAR_M)
_SIZES_M = (1e-45, 1e-20, 1e-8, 1e-3, 0.05, 0.5, 3.0, 100.0, WIDEST_M)
_OPACITIES = (0.0, 1e-45, 1 / 256, 1 / 255, 0.05, 0.5, 0.99, 1.0)
_COLOURS = (0.0, 1e-45, 0.1, 1.0, 10.0, BRIGHTEST)
_UNIT_QUATS = (
    (1.0, 0.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
    (0.0, 1.0, 0.0, 0.0),
    (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0),
    (0.5, -0.5, 0.5, -0.5),
    (1.0, 1e-20, 1e-40, 0.0),
    (0.99995, 0.0, 0.0, 0.0),  # as far off unit length as files may be
    (0.8, 0.0, 0.6, 0.0),
)


def _signed(values: Sequence[float]) -> list[float]:
    return [*values, *(-value for value in values)]


_coordinates = st.sampled_from(_signed(_PLACES_M)) | st.floats(-8, 8, width=32)
_means = st.tuples(_coordinates, _coordinates, _coordinates)
_scales = st.tuples(*[st.sampled_from(_SIZES_M)] * 3)
_splats = st.tuples(
    _means,
    st.sampled_from(_UNIT_QUATS),
    _scales,
    st.sampled_from(_OPACITIES),
    st.tuples(*[st.sampled_from(_signed(_COLOURS))] * 3),
    st.sampled_from([int(c) for c in SemanticClass]),
)


@st.composite
def wild_gaussians(draw: st.DrawFn, most: int = 6) -> Gaussians:
    """Up to `most` Gaussians, each number of which may be extreme."""
    splats = draw(st.lists(_splats, max_size=most))
    degree = draw(st.sampled_from((0, 3)))
    if not splats:
        return nothing(degree)
    means, quats, scales, opacities, colours, classes = zip(*splats, strict=True)
    sh = torch.zeros(len(splats), (degree + 1) ** 2, 3)
    sh[:, 0] = torch.tensor(colours)
    if degree:
        sh[:, 1:] = torch.tensor(colours)[:, None] * torch.tensor([1.0, -1.0, 0.5])
    return Gaussians(
        means=torch.tensor(means, dtype=torch.float64).float(),
        quats=torch.tensor(quats),
        scales=torch.tensor(scales, dtype=torch.float64).float(),
        opacities=torch.tensor(opacities, dtype=torch.float64).float(),
        sh=sh,
        semantic=torch.tensor(classes, dtype=torch.int16),
    )


def nothing(sh_degree: int = 0) -> Gaussians:
    """No Gaussians, whose classes are known."""
    empty = Gaussians.empty(sh_degree)
    return dataclasses.replace(empty, semantic=torch.zeros(0, dtype=torch.int16))


@functools.cache
def street() -> Scene:
    """A road with a wall at its end and one beside it, and a car; snow is placed on it once."""
    car = box_car(size=(2.0, 1.0, 0.8), start=(4.0, 1.0), moved_m=0.5, semantic=10)
    road = sheet((0.6, 7), (-2, 2), semantic=int(SemanticClass.ROAD))
    walls = [wall(7, (-2, 2), (0, 2)), side_wall(-2, (0.6, 7), (0, 1))]
    walls = [_classed(w, SemanticClass.BUILDING) for w in walls]
    stated = Ground(0.0, 0.0, "stated")
    return drive(
        road, *walls, actors=[car], places=((0.0, 0.0, 1.2),), ground_z_m=0.0, ground=stated
    )


def _classed(gaussians: Gaussians, semantic: SemanticClass) -> Gaussians:
    classes = torch.full((len(gaussians),), int(semantic), dtype=torch.int16)
    return dataclasses.replace(gaussians, semantic=classes)


SKIES = 6


@functools.cache
def skies() -> tuple[Sky, ...]:
    rng = np.random.default_rng(0)
    faces = torch.from_numpy(rng.uniform(0, 1, (6, 4, 4, 3)).astype(np.float32))
    dots = torch.from_numpy(rng.integers(0, 2, (3, 5, 3)).astype(np.float32))
    constants = [ConstantSky(torch.tensor([v] * 3)) for v in (0.0, 0.7, 1.0)]
    one_texel = CubemapSky(torch.full((6, 1, 1, 3), 0.5))
    return (*constants, CubemapSky(faces), one_texel, LatLongSky(dots))


def joined(*parts: Gaussians) -> Gaussians:
    """One after the other, their SH padded to the highest degree among them."""
    count = max(part.sh.shape[1] for part in parts)
    padded = [torch.cat([p.sh, p.sh.new_zeros(len(p), count - p.sh.shape[1], 3)], 1) for p in parts]
    fields = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in ("means", "quats", "scales", "opacities", "semantic")
    }
    return Gaussians(**fields, sh=torch.cat(padded))


@dataclass(frozen=True)
class Place:
    """A scene in numbers: nothing is drawn or placed before `scene` is called. sky: its number."""

    wild: Gaussians
    sky: int
    on_street: bool
    actor: Actor | None = None

    def scene(self) -> Scene:
        """The street, or nothing, with more Gaussians in it; its snow lies where the street's does.

        Without the street there are no frames: no camera has seen any ground that snow could be
        placed on.
        """
        base, sky = street(), skies()[self.sky]
        actors = () if self.actor is None else (self.actor,)
        if not self.on_street:
            return dataclasses.replace(
                base, background=self.wild, actors=actors, sky=sky, frames=()
            )
        scene = dataclasses.replace(
            base,
            background=joined(base.background, self.wild),
            actors=(*base.actors, *actors),
            sky=sky,
        )
        for slope in SLOPES_DEG:
            settings = exposure_settings(snow_model(max_slope_deg=slope), base)
            memo_of(scene).put(("exposed surface", settings), exposed_surface_of(base, settings))
        return scene


def snow_model(**fields: Any) -> Any:
    """The recipe's snow on the street's cells."""
    snow = {"depth_m": 0.1, "cell_m": CELL_M, **fields}
    return Recipe.model_validate({"weather": {"snow": snow}}).weather.snow


@st.composite
def wild_actors(draw: st.DrawFn) -> Actor:
    """A thing of a few Gaussians at an extreme place, turned any way."""
    gaussians = draw(wild_gaussians(most=2))
    place = torch.tensor(draw(_means), dtype=torch.float64)
    yaw = draw(st.sampled_from((0.0, math.pi / 2, math.pi, 1e-9)))
    turn = torch.tensor(
        [[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0, 0, 1.0]],
        dtype=torch.float64,
    )
    track = Track(torch.tensor([0]), rigid(turn, place)[None])
    label = draw(st.sampled_from(("Car", "Pedestrian")))
    size = draw(st.sampled_from(((1e-3, 1e-3, 1e-3), (4.0, 2.0, 1.5), (1e4, 1e4, 1e4))))
    in_world = draw(st.booleans())
    return Actor("wild", label, gaussians, track, size, colors_in_world=in_world)


@st.composite
def places(draw: st.DrawFn) -> Place:
    """Mostly the street with a few Gaussians that are extreme; also those alone, down to one."""
    wild = draw(wild_gaussians())
    actor = draw(st.none() | wild_actors())
    held = len(wild) + (0 if actor is None else len(actor.gaussians))
    on_street = held == 0 or draw(st.integers(0, 3)) > 0
    return Place(wild, draw(st.integers(0, SKIES - 1)), on_street, actor)


_SHAPES = ((24, 16), (1, 1), (1, 33), (33, 1), (17, 13))
_EYES_M = (
    (0.0, 0.0, 1.2),
    (0.0, 0.0, 0.2),
    (3.0, 0.5, 0.0),  # on the road
    (3.0, 0.0, -0.5),
    (2.0, -0.3, 6.0),
    (6.99, 0.0, 1.0),  # with the wall across the near plane
    (0.0, 0.0, 1e4),
    (FAR_M, -FAR_M, 1.2),
)
_PITCHES_DEG = (0.0, -10.0, -90.0, 90.0, -89.999, 45.0, 180.0)


def camera_at(
    eye_m: Sequence[float],
    *,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
    fov_deg: float = 80.0,
    size: tuple[int, int] = (24, 16),
    centre: tuple[float, float] = (0.5, 0.5),
    timestamp_ns: int = 0,
) -> Camera:
    """A camera that looks along +x, turned left, up and about its axis. fov_deg: of the longer
    side. centre: the principal point in images' widths and heights.
    """
    yaw, pitch, roll = (math.radians(a) for a in (yaw_deg, pitch_deg, roll_deg))
    ahead = [math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)]
    right = [math.sin(yaw), -math.cos(yaw), 0.0]
    ahead_t, right_t = (torch.tensor(v, dtype=torch.float64) for v in (ahead, right))
    down_t = torch.linalg.cross(ahead_t, right_t)
    turned = math.cos(roll) * right_t + math.sin(roll) * down_t
    rotation = torch.stack([turned, torch.linalg.cross(ahead_t, turned), ahead_t])
    eye = torch.tensor(eye_m, dtype=torch.float64)
    focal = 0.5 * max(size) / math.tan(math.radians(fov_deg) / 2)
    return Camera(
        name="extreme",
        width=size[0],
        height=size[1],
        fx=focal,
        fy=focal,
        cx=centre[0] * size[0],
        cy=centre[1] * size[1],
        camera_from_world=rigid(rotation, -rotation @ eye),
        timestamp_ns=timestamp_ns,
    )


@st.composite
def cameras(draw: st.DrawFn, levels_m: Sequence[float] = ()) -> Camera:
    """Small images of any field of view, from any place in any direction.

    levels_m: heights at which the eye may be too, exactly and nearly.
    """
    x, y, z = draw(st.sampled_from(_EYES_M))
    if levels_m:
        level = draw(st.sampled_from(levels_m))
        beside = [level, math.nextafter(level, math.inf), level - 1e-7, level + 1e-7, level + 1e-3]
        z = draw(st.sampled_from([z, *beside]))
    return camera_at(
        (x, y, z),
        yaw_deg=draw(st.sampled_from((0.0, 90.0, 180.0, 33.0))),
        pitch_deg=draw(st.sampled_from(_PITCHES_DEG)),
        roll_deg=draw(st.sampled_from((0.0, 90.0, 180.0, 17.0))),
        fov_deg=draw(st.sampled_from((80.0, 1.0, 170.0, 120.0))),
        size=draw(st.sampled_from(_SHAPES)),
        centre=draw(st.sampled_from(((0.5, 0.5), (-1.5, 0.5), (0.5, 4.0), (0.0, 1.0)))),
        timestamp_ns=draw(st.sampled_from((0, -(2**40), 1_700_000_000_123_456_789))),
    )


Schema = Mapping[str, Any]
SCHEMA: Schema = Recipe.model_json_schema()


def resolved(spec: Schema) -> tuple[Schema, bool]:
    """What a reference or an alternative to null stands for, and whether it may be null."""
    if "$ref" in spec:
        return SCHEMA["$defs"][spec["$ref"].rpartition("/")[2]], False
    given = [one for one in spec.get("anyOf", ()) if one.get("type") != "null"]
    return (resolved(given[0])[0], True) if given else (spec, False)


def ends_of(number: Schema) -> tuple[float, float]:
    """The least and the greatest allowed value."""
    is_whole = number["type"] == "integer"
    low, high = number.get("minimum", -math.inf), number.get("maximum", math.inf)
    if (above := number.get("exclusiveMinimum")) is not None:
        low = above + 1 if is_whole else math.nextafter(above, math.inf)
    if (below := number.get("exclusiveMaximum")) is not None:
        high = below - 1 if is_whole else math.nextafter(below, -math.inf)
    return low, high


def numbers_of(number: Schema) -> list[float]:
    """Allowed values worth trying: the ends, 0, the smallest, the default."""
    low, high = ends_of(number)
    values = [low, high, 0, 1, -1, low + (high - low) / 2, number.get("default", 0) or 0]
    if number["type"] == "number":
        values += [math.nextafter(low, high), math.nextafter(high, low), 1e-8, 5e-324, 0.3]
    cast = float if number["type"] == "number" else int
    return list(dict.fromkeys(v for v in map(cast, values) if low <= v <= high))


def numbers_beyond(number: Schema) -> list[float]:
    """Values that must be refused: just past the ends, far past them, not finite."""
    low, high = ends_of(number)
    if number["type"] == "integer":
        return [int(low) - 1, int(high) + 1, 10**30, -(10**30)]
    past = [math.nextafter(low, -math.inf), math.nextafter(high, math.inf), 1e308, -1e308]
    return [math.nan, math.inf, -math.inf, *past]


def number_fields(spec: Schema = SCHEMA, path: str = "") -> Iterator[tuple[str, Schema, bool]]:
    """Every field of a recipe that holds numbers: its path, the number, whether there are three."""
    for name, field in spec["properties"].items():
        own, at = resolved(field)[0], f"{path}.{name}".lstrip(".")
        if at == "timelines":  # points over the fields that are listed
            continue
        if "properties" in own:
            yield from number_fields(own, at)
        elif "items" in own:
            yield from number_fields(resolved(own["items"])[0], f"{at}[]")
        elif "prefixItems" in own:
            yield at, own["prefixItems"][0], True
        elif own.get("type") in ("number", "integer") and at not in ("version", "variant"):
            yield at, own, False


# What is drawn as a rule, where the schema would allow what takes minutes or needs a file.
_TAMED: dict[str, st.SearchStrategy[Any]] = {
    "version": st.just(1),
    "variant": st.just(0),
    "name": st.just("extreme"),
    "render.scale": st.sampled_from((1.0, 5e-324, 0.3, 4.0)),
    "weather.snow.cell_m": st.just(CELL_M),
    "weather.snow.max_slope_deg": st.sampled_from(SLOPES_DEG),
    "style.method": st.sampled_from(("mkl", "reinhard")),
    "style.preset": st.sampled_from(("dusk", "night")),
    "timelines": st.just(()),
    **dict.fromkeys(("style.image", "style.mask", "style.checkpoint", "style.digest"), st.none()),
    **dict.fromkeys(("light.street_ies", "light.digest", "light.lamps"), st.none()),
    "light.street_spacing_m": st.sampled_from((30.0, 200.0)),
}
EFFECTS = ("smog", "flood", "snow", "style", "rain", "snowfall", "light", "lens_drops")
_OPTIONAL_SECTIONS = ("road",)  # sections of an effect that most recipes lack
_NOT_OF_FRAMES = ("quality", "output")  # chooses settings; drawn after the weather


@st.composite
def values(draw: st.DrawFn, own: Schema, path: str, effects: frozenset[str]) -> Any:
    """An allowed value, the extreme ones before others."""
    if path in _TAMED:
        return draw(_TAMED[path])
    if "properties" in own:
        return draw(mappings(own, path, effects))
    if "items" in own:
        items = values(resolved(own["items"])[0], path, effects)
        return tuple(draw(st.lists(items, max_size=3)))
    if "prefixItems" in own:
        return tuple(draw(st.sampled_from(numbers_of(one))) for one in own["prefixItems"])
    if "enum" in own or own["type"] == "boolean":
        return draw(st.sampled_from(own.get("enum", (False, True))))
    return draw(st.sampled_from(numbers_of(own)))


@st.composite
def mappings(draw: st.DrawFn, spec: Schema, path: str, effects: frozenset[str]) -> dict[str, Any]:
    """A section; of the effects below it, those that are asked for."""
    found = {}
    for name, field in spec["properties"].items():
        own, may_be_null = resolved(field)
        is_section = "properties" in own
        if name in _NOT_OF_FRAMES or (is_section and name in EFFECTS and name not in effects):
            continue
        is_certain = is_section and name not in _OPTIONAL_SECTIONS
        is_certain |= name in spec.get("required", ())
        chance = 3 if is_certain else draw(st.integers(0, 3))
        if chance:
            given_null = may_be_null and not is_section and chance == 1
            at = f"{path}.{name}".lstrip(".")
            found[name] = None if given_null else draw(values(own, at, effects))
    return found


@st.composite
def recipes(draw: st.DrawFn, effects: frozenset[str] | None = None) -> Recipe:
    """A valid recipe of extreme numbers, with the given effects, or some of them."""
    if effects is None:
        effects = draw(st.frozensets(st.sampled_from(EFFECTS)))
    data = draw(mappings(SCHEMA, "", effects))
    weather = data["weather"]
    if smog := weather.get("smog"):  # one of two densities; the visibility of the most allowed
        extinction, seen_m = smog.pop("extinction_per_m", None), smog.pop("visibility_m", None)
        if seen_m is not None and draw(st.booleans()):
            smog["visibility_m"] = max(seen_m, 0.03913)
        else:
            smog["extinction_per_m"] = 0.1 if extinction is None else extinction
    if flood := weather.get("flood"):
        flood.pop("turbidity_ntu" if flood.get("absorption_per_m") else "absorption_per_m", None)
        for wave in flood.get("waves", {}).get("components") or ():
            wave["amplitude_m"] = min(wave["amplitude_m"], wave["wavelength_m"] / 6.2832)
            wave["steepness"] = min(wave.get("steepness", 0.0), 0.33)
    if style := data.get("style"):
        style.setdefault("preset", "dusk")
        if style.get("applied_to") == "picture":
            style["per_region"] = False
    data["output"] = draw(outputs(data))
    data.get("render", {}).pop("base", None)  # these scenes have no recorded images
    try:
        return Recipe.model_validate(data)
    except ValidationError:  # a rule between fields that is younger than this file
        assume(False)
        raise


@st.composite
def outputs(draw: st.DrawFn, data: dict[str, Any]) -> dict[str, Any]:
    """Images to ask for, from the sets of buffers whose kernels other tests compile anyway."""
    weather = data["weather"]
    flood, snow, smog = (weather.get(name) for name in ("flood", "snow", "smog"))
    deferred = smog is not None and smog.get("model") == "deferred"
    options: list[tuple[str, bool, str]] = []  # depth, whether classes are shown, surface
    if flood is None:
        options += [("expected", True, "solid"), ("expected", True, "first")]
    if flood is None and snow is None:
        options += [("median", False, "solid"), ("none", False, "scene")]
        if not deferred:
            options += [("median", True, "first")]
    elif flood is None:
        lit = snow.get("shading") == "per_pixel"
        if not deferred:
            options += [("none", False, "solid"), ("median", False, "first")]
            options += [("mode", False, "solid"), ("none", True, "scene")][: 1 if lit else 2]
    elif snow is None:
        options += [("expected", True, "first"), ("median", True, "solid")]
        options += [("none", False, "first")]
    else:
        options += [("expected", False, "solid"), ("expected", False, "first")]
        if not SOAKING:  # light per pixel in a flood takes kernels that nothing else does
            snow["shading"] = "per_splat"
    depth, classes, surface = draw(st.sampled_from(options))
    return {"depth": depth, "semantic": classes, "instance": classes, "surface": surface}


def rendered(scene: Scene, camera: Camera, recipe: Recipe) -> WeatheredView:
    """The view, after checking all that is promised of every frame."""
    view = render_view(scene, camera, recipe)
    _, plan = plan_at(recipe, scene, camera.timestamp_ns)
    buffers = render_buffers(scene, camera.scaled(recipe.render.scale), plan)
    check_buffers(buffers, recipe)
    check_view(view, scene, recipe)
    assert np.array_equal(to_byte_array(buffers.rgb), view.rgb), "two renders of one frame differ"
    return view


def check_buffers(buffers: WeatheredBuffers, recipe: Recipe) -> None:
    """Finite colours; alpha and snow in [0, 1]; depth of what is seen positive, else 0."""
    size = (buffers.camera.height, buffers.camera.width)
    assert tuple(buffers.rgb.shape) == (*size, 3)
    assert bool(torch.isfinite(buffers.rgb).all()), "a colour is not finite"
    rasters = [buffers.raster] + (
        [] if buffers.bare_buffers is None else [buffers.bare_buffers.raster]
    )
    for raster in rasters:
        alpha = raster.alpha
        if alpha is None:  # of a view with water, of which nothing but the picture was asked
            assert "water" in buffers.masks
            continue
        assert bool(((alpha >= 0) & (alpha <= 1)).all()), f"alpha {alpha.min()} to {alpha.max()}"
        for name in ("expected_depth", "median_depth", "mode_depth"):
            depth = getattr(raster, name)
            if depth is not None:
                assert bool(torch.isfinite(depth).all()), f"{name} is not finite"
                assert bool((depth >= 0).all()), f"{name} {depth.min()}"
        if raster.overlay is not None:
            # Two sums of the same weights: they differ by rounding. An alpha below float32's step
            # at 1 is lost in transmittance, which thousands of splats then leave at 1.
            room = 1e-5 if recipe.render.speed.alpha_max > 6e-8 else 1e-3
            assert bool((raster.overlay >= 0).all())
            assert bool((raster.overlay <= alpha + room).all()), "more snow than surface"
    if buffers.depth_m is not None:
        assert bool(torch.isfinite(buffers.depth_m).all()) and bool((buffers.depth_m >= 0).all())


def check_view(view: WeatheredView, scene: Scene, recipe: Recipe) -> None:
    """Images of one size; depth finite and >= 0; masks of 0 and 255 that agree with the classes."""
    size = (view.camera.height, view.camera.width)
    assert view.rgb.dtype == np.uint8 and view.rgb.shape == (*size, 3)
    assert (view.depth_m is None) == (recipe.output.depth == "none")
    if view.depth_m is not None:
        assert view.depth_m.dtype == np.float32 and view.depth_m.shape == size
        assert np.isfinite(view.depth_m).all() and (view.depth_m >= 0).all()
    masks = {
        e.mask_name for e in effects.EFFECTS if e.mask_name and e.section_of(recipe) is not None
    }
    assert view.masks.keys() == masks
    for mask in view.masks.values():
        assert mask.dtype == np.uint8 and mask.shape == size
        assert np.isin(mask, (0, 255)).all()
    if {"water", "snow"} <= view.masks.keys():
        assert not (view.masks["water"] & view.masks["snow"]).any(), (
            "a pixel shows snow and water first"
        )
    if view.semantic is not None:
        assert np.isin(view.semantic, [int(c) for c in SemanticClass]).all()
        if view.masks.get("water") is not None and recipe.output.surface == "first":
            assert ((view.semantic == SemanticClass.WATER) >= (view.masks["water"] == 255)).all()
    if view.instance is not None:
        assert (view.instance <= len(scene.actors)).all()
