"""Whole frames of extreme scenes, cameras and recipes: what tests/augment/extremes.py promises."""

from __future__ import annotations

import itertools
import json
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError

from augment.effects.snow.depth import find_depths, make_depth_profile
from augment.effects.snow.layer import find_snow_tops
from augment.effects.snow.plan import exposure_settings
from augment.exposure.cells import ExposedCells
from augment.exposure.exposed_surface import exposed_surface_of
from augment.rng import rng_for
from augment.scene.cameras import Camera
from augment.scene.scene import Actor, Gaussians, Track
from augment.scene.semantics import SemanticClass
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers, render_view
from augment.view.results import WeatheredView
from recipes.errors import RecipeError
from recipes.load import parse_recipe
from recipes.schema import Recipe
from recipes.snow import Snow
from tests.augment.extremes import (
    CELL_M,
    Place,
    camera_at,
    cameras,
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


def weather(depth: str = "expected", **effects) -> Recipe:
    style = effects.pop("style", None)
    output = {"depth": depth}
    return Recipe.model_validate({"weather": effects, "style": style, "output": output})


@drawing(3)
@given(places(), cameras(levels_m=(0.2,)), recipes())
def test_any_scene_from_anywhere_in_any_weather(place: Place, camera: Camera, recipe: Recipe):
    rendered(place.scene(), camera, recipe)


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
def test_images_of_one_row_or_column(size: tuple[int, int]):
    scene = Place(nothing(), 3, on_street=True).scene()
    camera = camera_at((0.0, 0.0, 1.2), pitch_deg=-10, size=size, fov_deg=100)
    snow = {"depth_m": 0.3, "cell_m": 0.2}
    for effects in ({"snow": snow, "smog": {"extinction_per_m": 0.1}}, {"flood": {"level_m": 0.2}}):
        rendered(scene, camera, weather(style={"preset": "dusk"}, **effects))


@pytest.mark.long
def test_two_million_gaussians():
    """In every effect at once; most of them far smaller than a pixel."""
    count = 2_000_000
    rng = np.random.default_rng(0)
    means = rng.uniform((0.5, -4, 0), (40, 4, 6), (count, 3)).astype(np.float32)
    quats = np.zeros((count, 4), np.float32)
    quats[:, 0] = 1
    many = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(10 ** rng.uniform(-8, -1, (count, 3)).astype(np.float32)),
        opacities=torch.from_numpy(rng.uniform(0, 1, count).astype(np.float32)),
        sh=torch.from_numpy(rng.normal(0, 1, (count, 1, 3)).astype(np.float32)),
        semantic=torch.ones(count, dtype=torch.int16),
    )
    scene = Place(many, 3, on_street=True).scene()
    rendered(
        scene,
        camera_at((0.0, 0.0, 1.2), size=(48, 27)),
        weather(snow={"depth_m": 0.3, "cell_m": 0.2}, smog={"extinction_per_m": 0.1}),
    )


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


def rough_cells(seed: int, relief_m: float) -> ExposedCells:
    """Ground no two neighbouring cells of which are level."""
    heights = np.random.default_rng(seed).normal(0, relief_m, (24, 20)).astype(np.float32)
    return cells_on_grid(heights, 0.05)


def surface(cells: ExposedCells, snow: Snow, seed: int) -> np.ndarray:
    """Height of every cell's surface, snow included."""
    rng = rng_for(seed=seed, scene="extremes", effect="snow")
    profile = make_depth_profile(snow, rng, on_ground=True)
    depths = find_depths(cells, profile, rng.integers(0, 2**64, dtype=np.uint64))
    return find_snow_tops(cells, depths.depths_m)


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
        cells = exposed_surface_of(street(), exposure_settings(snow_model(), street())).ground
    else:
        cells = rough_cells(seed, relief_m)
    more = {"coverage": coverage, "wind": {"drift": drift}, "tracks": tracks}
    tops = [surface(cells, snow_model(depth_m=d, **more), seed) for d in depths if d > 0]
    bare = cells.centers_m[:, 2].numpy().astype(np.float64)
    for low, high in zip([bare, *tops], tops, strict=False):
        sunk = float((low - high).max())
        # Heights are float32 numbers of metres.
        assert sunk <= 1e-6 * (1 + float(np.abs(low).max())), f"deeper snow sank by {sunk} m"


# What a recipe needs besides the field in question, by section.
BESIDE: dict[str, dict[str, Any]] = {
    "weather.smog": {"extinction_per_m": 0.1},
    "weather.flood": {"level_m": 0.1},
    "weather.flood.waves.components[]": {"amplitude_m": 0.0, "wavelength_m": 1.0},
    "weather.snow": {"depth_m": 0.1, "cell_m": CELL_M},
    "weather.rain": {"rate_mm_h": 10.0},
    "weather.snowfall": {"rate_mm_h": 1.0},
    "style": {"preset": "dusk"},
}
INSTEAD = {
    "weather.smog.visibility_m": "extinction_per_m",
    "weather.flood.absorption_per_m": "turbidity_ntu",
}
NUMBERS = {path: (number, three) for path, number, three in number_fields()}
# Settings that are not of a frame, or that would place the street's snow anew.
OTHERS = ("quality", "output.jpeg", "weather.snow.cell_m", "weather.snow.max_slope_deg", "seed")


def recipe_data(path: str, value: Any) -> dict[str, Any]:
    """The mapping of the smallest recipe that gives the field this value."""
    data: dict[str, Any] = {"output": {"depth": "expected", "labels": False}}
    here, at = data, ""
    *above, name = path.split(".")
    for part in above:
        at = f"{at}.{part}".lstrip(".")
        below = dict(BESIDE.get(at, {}))
        if part.endswith("[]"):
            here[part[:-2]] = (below,)
        else:
            below = here.setdefault(part, {}) | below
            here[part] = below
        here = below
    here.pop(INSTEAD.get(path, ""), None)
    here[name] = (value,) * 3 if NUMBERS[path][1] else value
    return data


def test_numbers_beyond_their_limits_are_refused_by_name():
    assert len(NUMBERS) > 40
    for path, (number, _) in NUMBERS.items():
        for value in numbers_beyond(number):
            data, name = recipe_data(path, value), path.rpartition(".")[2]
            with pytest.raises(ValidationError, match=name):
                Recipe.model_validate(data)
            text = json.dumps(data)
            for word, sign in (("NaN", ".nan"), ("-Infinity", "-.inf"), ("Infinity", ".inf")):
                text = text.replace(word, sign)
            with pytest.raises(RecipeError, match=name):
                parse_recipe(text, source="beyond.yaml")


@pytest.mark.long
@pytest.mark.parametrize("path", [path for path in NUMBERS if not path.startswith(OTHERS)])
def test_each_number_at_its_ends_makes_a_frame_or_is_refused_in_words(path: str):
    scene = Place(nothing(), sky=3, on_street=True).scene()
    camera = camera_at((0.0, 0.0, 1.2), pitch_deg=-20)
    made = 0
    for value in numbers_of(NUMBERS[path][0])[:3]:  # the ends and 0
        try:
            recipe = Recipe.model_validate(recipe_data(path, value))
        except ValidationError as error:  # a rule between fields
            assert path.rpartition(".")[2] in str(error)
            continue
        rendered(scene, camera, recipe)
        made += 1
    assert made


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
