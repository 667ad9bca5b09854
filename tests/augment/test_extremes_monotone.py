"""More weather, more of what it does: monotone where physics is.

smog    adds no contrast to its airlight, in any channel of any pixel. Where what a pixel mixes lies
        on both sides of the airlight, layers at different distances can cancel in clear air and
        no longer do in smog, so that this holds for a black airlight, which nothing is darker than,
        and, of smog on finished buffers, for any airlight that hides the sky.
water   that rises uncovers nothing, for a camera above it.
snow    that is deeper lies nowhere lower.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from augment.cameras import Camera
from augment.effects.snow.cells import SnowCells
from augment.effects.snow.layer import find_depths, profile_of, surface_heights
from augment.effects.snow.snow import placement_settings
from augment.effects.snow.support import support_of
from augment.plan import make_plan
from augment.rng import rng_for
from augment.views import render_buffers, render_view
from recipes.schema import Recipe
from recipes.snow import Snow
from tests.augment.examples import drawing
from tests.augment.extremes import Place, camera_at, cameras, nothing, places, snow_model, street
from tests.snow_beds import cells_on_grid

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
