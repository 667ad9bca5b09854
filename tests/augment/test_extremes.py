"""Whole frames of extreme scenes, cameras and recipes: what tests/augment/extremes.py promises."""

from __future__ import annotations

import dataclasses
import itertools
import json
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError

from augment.cameras import Camera
from augment.effects.snow.cells import SnowCells
from augment.effects.snow.layer import find_depths, profile_of, surface_heights
from augment.effects.snow.snow import placement_settings
from augment.effects.snow.support import support_of
from augment.errors import SceneError
from augment.plan import make_plan
from augment.rng import rng_for
from augment.scene import Actor, Scene, Track
from augment.semantics import SemanticClass
from augment.views import WeatheredView, render_buffers, render_view
from recipes.errors import RecipeError
from recipes.load import parse_recipe
from recipes.schema import Recipe
from recipes.snow import Snow
from recipes.template import FieldSpec, Kind
from tests.augment.extremes import (
    CELL_M,
    EFFECTS,
    PAIRS,
    Place,
    camera_at,
    cameras,
    ends_of,
    nothing,
    number_fields,
    numbers_beyond,
    numbers_of,
    places,
    recipes,
    rendered,
    snow_model,
    street,
)
from tests.augment.hard_scenes import drawing
from tests.scenes import one_gaussian
from tests.snow_beds import cells_on_grid

EVERYTHING = {
    "smog": {"extinction_per_m": 0.1, "scale_height_m": 5.0},
    "flood": {"level_m": 0.2, "reflection": "screen_space"},
    "snow": {"depth_m": 0.3, "cell_m": 0.2, "sparkle": 1.0},
}


def weather(depth: str = "expected", **effects) -> Recipe:
    style = effects.pop("style", None)
    output = {"depth": depth}
    return Recipe.model_validate({"weather": effects, "style": style, "output": output})


@drawing(6)
@given(places(), cameras(levels_m=(0.2,)), recipes())
def test_any_scene_from_anywhere_in_any_weather(place: Place, camera: Camera, recipe: Recipe):
    rendered(place.scene(), camera, recipe)


@pytest.mark.long
@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: "-".join(sorted(pair)))
@drawing(4)
@given(data=st.data())
def test_every_pair_of_effects(pair: frozenset[str], data: st.DataObject):
    place, camera = data.draw(places()), data.draw(cameras(levels_m=(0.2,)))
    rendered(place.scene(), camera, data.draw(recipes(pair)))


@pytest.mark.long
@drawing(4)
@given(cameras(levels_m=(0.2,)), recipes(frozenset({"flood"})))
def test_the_eye_at_below_and_above_the_water(camera: Camera, recipe: Recipe):
    """The eye at the recipe's level, the next number beside it, or a little away from it."""
    data = recipe.model_dump(exclude_none=True)
    data["weather"]["flood"] |= {"level_m": 0.2, "reference": "absolute"}
    view = rendered(
        Place(nothing(), 3, on_street=True).scene(), camera, Recipe.model_validate(data)
    )
    assert view.masks.get("water") is not None
    if float(camera.centre[2]) <= 0.2:
        assert (view.masks["water"] == 255).all()


@pytest.mark.long
@pytest.mark.parametrize("size", [(8192, 1), (1, 8192)])
@pytest.mark.parametrize("effects", [("smog", "snow"), ("flood",)])
def test_images_of_one_row_or_column(size: tuple[int, int], effects: tuple[str, ...]):
    scene = Place(nothing(), 3, on_street=True).scene()
    camera = camera_at((0.0, 0.0, 1.2), pitch_deg=-10, size=size, fov_deg=100)
    chosen = {name: EVERYTHING[name] for name in effects}
    if "flood" in chosen:
        chosen["flood"] = {"level_m": 0.2, "reflection": "sky"}
    rendered(scene, camera, weather(style={"preset": "dusk"}, **chosen))


def test_nothing_at_all_is_refused():
    with pytest.raises(SceneError, match="holds no Gaussians"):
        Place(nothing(), 0, on_street=False).scene()


def test_actors_that_are_all_gone_leave_the_sky():
    """Without a background: no part of the view has a splat to look up."""
    track = Track(torch.tensor([0]), torch.eye(4, dtype=torch.float64)[None])
    actor = Actor("a", "Car", one_gaussian(), track, (1.0, 1.0, 1.0))
    scene = Place(nothing(), 0, on_street=False, actor=actor).scene()
    output = {"depth": "expected", "semantic": True, "instance": True}
    camera = camera_at((0.0, 0.0, 0.0), timestamp_ns=2**40)
    view = render_view(scene, camera, Recipe.model_validate({"output": output}))
    assert view.semantic is not None and (view.semantic == SemanticClass.SKY).all()
    assert view.instance is not None and not view.instance.any()
    assert view.depth_m is not None and not view.depth_m.any()


@pytest.mark.long
@drawing(3)
@given(places())
def test_snow_is_placed_among_extreme_gaussians(place: Place):
    """The placement itself, and not the street's, of the street and what else there is."""
    base = place.scene()
    frames = street().frames
    scene: Scene = dataclasses.replace(base, frames=frames)  # another object: nothing remembered
    snow = {"depth_m": 0.3, "cell_m": 0.5}
    try:
        support_of(scene, placement_settings(snow_model(cell_m=0.5)))
    except SceneError as error:
        assert "cell" in str(error)
        return
    rendered(scene, camera_at((0.0, 0.0, 1.2), pitch_deg=-20), weather(snow=snow))


DENSITIES_PER_M = (0.0, 1e-8, 1e-3, 0.02, 0.1, 0.5, 3.0, 100.0)
ROUNDING = 4e-6  # of the brightest colour: a dozen roundings of float32


def deviation(place: Place, camera: Camera, smog: dict[str, Any]) -> torch.Tensor:
    """|colour - airlight| of every pixel and channel, float64."""
    recipe = Recipe.model_validate({"weather": {"smog": smog}, "output": {"depth": "none"}})
    scene = place.scene()
    rgb = render_buffers(scene, camera, make_plan(recipe, scene)).rgb
    return (rgb.double() - torch.tensor(smog["color"], dtype=torch.float64)).abs()


def assert_never_grows(less: torch.Tensor, more: torch.Tensor) -> None:
    room = ROUNDING * (1 + float(less.max()))
    worst = float((more - less).max())
    assert worst <= room, f"denser smog adds {worst} of contrast; rounding may add {room}"


@pytest.mark.long
@drawing(4)
@given(
    places(),
    cameras(),
    st.lists(st.sampled_from(DENSITIES_PER_M), min_size=2, max_size=3, unique=True).map(sorted),
    st.sampled_from((None, 0.1, 5.0, 1e5)),
    st.sampled_from(("per_gaussian", "deferred")),
)
def test_denser_smog_never_adds_contrast_to_a_black_airlight(
    place: Place, camera: Camera, densities: list[float], height_m: float | None, model: str
):
    smog = {"color": (0.0, 0.0, 0.0), "scale_height_m": height_m, "model": model}
    seen = [deviation(place, camera, {**smog, "extinction_per_m": d}) for d in densities]
    for less, more in itertools.pairwise(seen):
        assert_never_grows(less, more)


@pytest.mark.long
@drawing(4)
@given(
    places(),
    cameras(),
    st.lists(st.sampled_from(DENSITIES_PER_M[1:]), min_size=2, max_size=3, unique=True).map(sorted),
    st.tuples(*[st.sampled_from((0.0, 0.3, 0.76, 1.0))] * 3),
)
def test_denser_smog_on_buffers_never_adds_contrast_to_any_airlight(
    place: Place, camera: Camera, densities: list[float], color: tuple[float, float, float]
):
    smog = {"color": color, "model": "deferred"}
    seen = [deviation(place, camera, {**smog, "extinction_per_m": d}) for d in densities]
    for less, more in itertools.pairwise(seen):
        assert_never_grows(less, more)


@pytest.mark.long
@drawing(4)
@given(
    places(),
    cameras(),
    st.lists(st.sampled_from((-0.5, 0.0, 1e-6, 0.01, 0.2, 0.5, 1.1)), min_size=2, unique=True),
)
def test_higher_water_never_uncovers(place: Place, camera: Camera, levels: list[float]):
    scene = place.scene()
    masks = []
    for level in sorted(levels)[:3]:
        if not float(camera.centre[2]) > level:
            break
        flood = {"level_m": level, "reference": "absolute", "reflection": "sky"}
        data = {"weather": {"flood": flood}, "output": {"depth": "none"}}
        view = render_view(scene, camera, Recipe.model_validate(data))
        assert view.masks.get("water") is not None
        masks.append(view.masks["water"] == 255)
    for low, high in itertools.pairwise(masks):
        assert (high >= low).all(), f"{int((low & ~high).sum())} pixels dried as the water rose"


DEPTHS_M = (0.0, 1e-8, 0.002, 0.01, 0.03, 0.05, 0.1, 0.2, 0.29, 0.3, 0.31, 0.5, 1.0, 2.0, 10.0)


def rough_cells(seed: int, relief_m: float) -> SnowCells:
    """Ground no two neighbouring cells of which are level."""
    heights = np.random.default_rng(seed).normal(0, relief_m, (24, 20)).astype(np.float32)
    return cells_on_grid(heights, 0.05)


def surface(cells: SnowCells, snow: Snow, seed: int) -> np.ndarray:
    """Height of every cell's surface, snow included."""
    rng = rng_for(seed=seed, scene="extremes", effect="snow")
    profile = profile_of(snow, rng, on_ground=True)
    depths = find_depths(cells, profile, rng.integers(0, 2**64, dtype=np.uint64))
    return surface_heights(cells, depths.heights)


@pytest.mark.long
@drawing(20)
@given(
    st.sampled_from((0.0, 0.003, 0.1, 3.0)) | st.none(),
    st.lists(st.sampled_from(DEPTHS_M), min_size=2, unique=True).map(sorted),
    st.sampled_from((0.01, 0.5, 1.0)),
    st.sampled_from((0.0, 0.3, 1.0)),
    st.sampled_from(("auto", "always", "never")),
    st.integers(0, 1000),
)
# Evening out the relief once hung on the snow's depth: 4 mm lower where it was 2 cm deeper.
@example(0.1, [0.03, 0.05], 1.0, 1.0, "never", 1)
def test_deeper_snow_never_lowers_the_surface(
    relief_m: float | None, depths: list[float], coverage: float, drift: float, tracks: str, seed
):
    if relief_m is None:
        cells = support_of(street(), placement_settings(snow_model())).ground
    else:
        cells = rough_cells(seed, relief_m)
    more = {"coverage": coverage, "wind": {"drift": drift}, "tracks": tracks}
    tops = [surface(cells, snow_model(depth_m=d, **more), seed) for d in depths if d > 0]
    bare = cells.centers_m[:, 2].numpy().astype(np.float64)
    for low, high in zip([bare, *tops], tops, strict=False):
        sunk = float((low - high).max())
        # Heights are float32 numbers of metres.
        assert sunk <= 1e-6 * (1 + float(np.abs(low).max())), f"deeper snow sank by {sunk} m"


@pytest.mark.long
@pytest.mark.parametrize("shading", ["per_splat", "per_pixel"])
def test_deeper_snow_comes_nearer_to_a_camera_above_it(shading: str):
    """Depth along the rays of a frame, within what the discs of neighbouring cells blur."""
    scene = Place(nothing(), sky=1, on_street=True).scene()
    camera = camera_at((2.5, 0.0, 30.0), pitch_deg=-90, fov_deg=6, size=(12, 8))
    before = None
    for depth_m in (0.0, 0.05, 0.2, 0.5, 1.0, 5.0):
        snow = {"depth_m": depth_m, "cell_m": 0.2, "shading": shading, "tracks": "never"}
        data = {"weather": {"snow": snow}, "output": {"depth": "median"}}
        view = render_view(scene, camera, Recipe.model_validate(data))
        assert view.depth_m is not None and (view.depth_m > 0).all()
        if before is not None:
            assert (view.depth_m <= before + 0.01).all()
            assert view.depth_m.mean() < before.mean()
        before = view.depth_m


NUMBERS = number_fields()
# What a recipe needs besides the field in question, by section.
BESIDE: dict[str, dict[str, Any]] = {
    "weather.smog": {"extinction_per_m": 0.1},
    "weather.flood": {"level_m": 0.1},
    "weather.flood.waves.components[]": {"amplitude_m": 0.0, "wavelength_m": 1.0},
    "weather.snow": {"depth_m": 0.1, "cell_m": CELL_M},
    "style": {"preset": "dusk"},
}
INSTEAD = {
    "weather.smog.visibility_m": "extinction_per_m",
    "weather.flood.absorption_per_m": "turbidity_ntu",
}
# Settings that are not of a frame, or that a job replaces before there is one.
NOT_OF_FRAMES = ("quality", "output.jpeg_quality")
PLACEMENT = ("weather.snow.cell_m", "weather.snow.max_slope_deg")


def name_of(field: FieldSpec) -> str:
    return field.path.rpartition(".")[2]


def recipe_data(field: FieldSpec, value: Any) -> dict[str, Any]:
    """The mapping of the smallest recipe that gives the field this value."""
    data: dict[str, Any] = {"output": {"depth": "expected", "labels": False}}
    here, path = data, ""
    *above, name = field.path.split(".")
    for part in above:
        path = f"{path}.{part}" if path else part
        below = dict(BESIDE.get(path, {}))
        if part.endswith("[]"):
            here[part[:-2]] = [below]
        else:
            below = here.setdefault(part, {}) | below
            here[part] = below
        here = below
    here.pop(INSTEAD.get(field.path, ""), None)
    here[name] = value
    return data


def filled(field: FieldSpec, number: float) -> Any:
    """What stands in a file: the number, or three of it."""
    return number if field.channel is None else [number] * 3


def by_path(field: FieldSpec) -> str:
    return field.path


def test_numbers_beyond_their_limits_are_refused_by_name():
    cases = [(f, number) for f in NUMBERS for number in numbers_beyond(f.channel or f)]
    assert {f.path for f, _ in cases} == {f.path for f in NUMBERS}
    for field, number in cases:
        data = recipe_data(field, filled(field, number))
        with pytest.raises(ValidationError, match=name_of(field)):
            Recipe.model_validate(_tuples(data))
        with pytest.raises(RecipeError, match=name_of(field)):
            parse_recipe(_yaml(data), source="beyond.yaml")


def _tuples(data: Any) -> Any:
    """Lists as the tuples that recipes in numbers hold."""
    if isinstance(data, dict):
        return {key: _tuples(value) for key, value in data.items()}
    return tuple(map(_tuples, data)) if isinstance(data, list) else data


def _yaml(data: dict[str, Any]) -> str:
    text = json.dumps(data)
    for name, sign in (("NaN", ".nan"), ("-Infinity", "-.inf"), ("Infinity", ".inf")):
        text = text.replace(name, sign)
    return text


FRAMED = [f for f in NUMBERS if not f.path.startswith(NOT_OF_FRAMES) and f.path not in PLACEMENT]


@pytest.mark.long
@pytest.mark.parametrize("field", FRAMED, ids=by_path)
def test_each_number_at_its_ends_makes_a_frame_or_is_refused_in_words(field: FieldSpec):
    scene = Place(nothing(), sky=3, on_street=True).scene()
    camera = camera_at((0.0, 0.0, 1.2), pitch_deg=-20)
    made = 0
    for number in ends_of(field.channel or field):
        data = _tuples(recipe_data(field, filled(field, number)))
        try:
            recipe = Recipe.model_validate(data)
        except ValidationError as error:
            # A rule between fields: each number is allowed for itself.
            assert field.accepts(_tuples(filled(field, number)))
            assert name_of(field) in str(error)
            continue
        rendered(scene, camera, recipe)
        made += 1
    assert made


@pytest.mark.long
def test_all_numbers_at_their_lowest_and_all_at_their_highest_make_frames():
    scene = Place(nothing(), sky=3, on_street=True).scene()
    for end in (0, 1):
        data: dict[str, Any] = {"style": {"preset": "dusk"}, "output": {"depth": "expected"}}
        for field in NUMBERS:
            if field.path.startswith(("quality", "weather.flood.waves.components")):
                continue
            if field.path in (*INSTEAD, *PLACEMENT) or field.kind is Kind.TEXT:
                continue
            *above, name = field.path.split(".")
            here = data
            for part in above:
                here = here.setdefault(part, {})
            here[name] = filled(field, numbers_of(field.channel or field)[end])
        data["weather"]["snow"]["cell_m"] = CELL_M
        recipe = Recipe.model_validate(_tuples(data))
        rendered(scene, camera_at((0.0, 0.0, 1.2), pitch_deg=-20, size=(6, 4)), recipe)


@pytest.mark.long
@pytest.mark.parametrize("cell_m", [0.05, 10.0])
@pytest.mark.parametrize("max_slope_deg", [0.0, 85.0])
def test_snow_is_placed_at_extreme_settings(cell_m: float, max_slope_deg: float):
    snow = {"depth_m": 0.1, "cell_m": cell_m, "max_slope_deg": max_slope_deg}
    recipe = Recipe.model_validate({"weather": {"snow": snow}})
    rendered(street(), camera_at((0.0, 0.0, 1.2), pitch_deg=-20), recipe)


UNIT = st.sampled_from((0.0, 0.5, 1.0))
# Every other number of an effect without strength is free.
ZEROS: dict[str, st.SearchStrategy[dict[str, Any]]] = {
    "smog": st.fixed_dictionaries(
        {
            "extinction_per_m": st.sampled_from((0.0, -0.0)),
            "scale_height_m": st.sampled_from((None, 0.1, 1e5)),
            "base_height_m": st.sampled_from((-1e4, 0.0, 1e4)),
            "model": st.sampled_from(("per_gaussian", "deferred")),
        }
    ),
    "snow": st.fixed_dictionaries(
        {
            "cell_m": st.just(CELL_M),
            "shading": st.sampled_from(("per_splat", "per_pixel")),
            "sparkle": UNIT,
            "grain": UNIT,
        }
    ).flatmap(
        lambda snow: st.sampled_from(((0.0, 1.0), (10.0, 0.0), (0.0, 0.0))).map(
            lambda amount: {**snow, "depth_m": amount[0], "coverage": amount[1]}
        )
    ),
    "style": st.fixed_dictionaries(
        {
            "preset": st.just("dusk"),
            "strength": st.just(0.0),
            "method": st.sampled_from(("mkl", "reinhard")),
            "applied_to": st.sampled_from(("scene", "picture")),
        }
    ),
}


def with_effects(clean: Recipe, effects: dict[str, dict[str, Any]]) -> Recipe:
    """The recipe with these effects besides its own."""
    data = clean.model_dump(exclude_none=True)
    for name, effect in effects.items():
        holder = data if name == "style" else data["weather"]
        holder[name] = effect
    return Recipe.model_validate(data)


def assert_same_bits(view: WeatheredView, clean: WeatheredView) -> None:
    for name in ("rgb", "depth_m", "semantic", "instance"):
        one, other = getattr(view, name), getattr(clean, name)
        assert (one is None) == (other is None)
        assert one is None or np.array_equal(one, other), f"{name} differs"


@drawing(5)
@given(places(), cameras(), recipes(frozenset()), st.data())
def test_effects_without_strength_change_no_bit(
    place: Place, camera: Camera, recipe: Recipe, data: st.DataObject
):
    scene = place.scene()
    names = data.draw(st.sets(st.sampled_from(sorted(ZEROS)), min_size=1))
    zero = with_effects(recipe, {name: data.draw(ZEROS[name]) for name in sorted(names)})
    view = render_view(scene, camera, zero)
    assert_same_bits(view, render_view(scene, camera, recipe))
    assert view.masks.get("snow") is None or not view.masks["snow"].any()


@pytest.mark.long
@pytest.mark.parametrize("effect", EFFECTS)
@drawing(6)
@given(data=st.data())
def test_effects_without_strength_change_no_bit_of_another_effect(effect: str, data: st.DataObject):
    """Each effect as drawn, with and without the others at no strength."""
    place, camera = data.draw(places()), data.draw(cameras())
    recipe = data.draw(recipes(frozenset({effect})))
    others = sorted(set(ZEROS) - {effect})
    zero = with_effects(recipe, {name: data.draw(ZEROS[name]) for name in others})
    scene = place.scene()
    assert_same_bits(render_view(scene, camera, zero), render_view(scene, camera, recipe))


@pytest.mark.parametrize(
    "tier",
    ["sky", *(pytest.param(t, marks=pytest.mark.long) for t in ("screen_space", "mirrored"))],
)
def test_waves_without_height_are_still_water(tier: str):
    scene = Place(nothing(), sky=3, on_street=True).scene()
    camera = camera_at((0.0, 0.0, 1.2), pitch_deg=-20)
    flood = {"level_m": 0.2, "reflection": tier, "turbidity_ntu": 1.0}
    flat = {"direction_deg": 20.0, "amplitude_m": 0.0, "wavelength_m": 0.5, "steepness": 0.0}
    waves = ({"preset": "still"}, {"preset": "wind", "height": 0.0}, {"components": (flat,)})
    views = [
        render_view(scene, camera, with_effects(Recipe(), {"flood": {**flood, "waves": w}}))
        for w in waves
    ]
    assert views[0].masks["water"].any()
    for view in views[1:]:
        assert_same_bits(view, views[0])
