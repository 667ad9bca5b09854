"""Every effect and tier, by the kernels that run for one image and the buffers they fill: exactly
those, so that a pass that nothing asked for fails here.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import NamedTuple

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.geometry import rigid
from augment.ground_heights import Ground
from augment.labels import Boxes
from augment.render.cpu import driver as cpu
from augment.scene import Scene
from augment.sky import CubemapSky
from augment.views import render_view
from recipes.schema import Output, Recipe, Render, Smog, Weather
from recipes.weather import Flood, Snow, Style, Waves
from tests.augment.kernel_counts import CountingKernel, counted_kernels, launch_sites
from tests.snow_scenes import box_car, drive, sheet, side_wall

RASTER = (
    "rank_splats",
    "project_slice",
    "scatter_to_bins",
    "sort_bins",
    "count_corners",
    "fill_lists",
    "blend_tiles",
)
PICTURE = Output(depth="none", labels=False)
STILL, CALM = Waves(preset="still"), Waves()
PACKED = 6  # mip levels of the layers that rough water looks up in: of an image this size


class Layer(NamedTuple):
    """One run of the rasteriser. light: per pixel. maps: colour maps."""

    buffers: str
    smog: bool = False
    clip: bool = False
    light: bool = False
    maps: bool = False


class Ran(NamedTuple):
    kernels: Counter[str]
    layers: list[Layer]


class Labels:
    """Of a drive on which nothing was labelled."""

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> None:
        return None


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A road that ends, a wall beside it, a car on it; a sky that is sampled."""
    road = sheet((-2.0, 24.0), (-4.0, 4.0), semantic=1)
    wall = side_wall(4.0, (2.0, 24.0), (0.0, 1.0))
    drove = drive(road, wall, actors=[box_car(start=(8.0, -2.0), size=(3.0, 1.8, 1.0))])
    faces = torch.rand(6, 8, 8, 3, generator=torch.Generator().manual_seed(0))
    level = Ground(0.0, 0.0, "stated", None, 0, None)
    return dataclasses.replace(drove, sky=CubemapSky(faces), ground=level, ground_z_m=0.0)


def run(
    scene: Scene, recipe: Recipe, monkeypatch: pytest.MonkeyPatch, camera: Camera | None = None
) -> Ran:
    """One image, once what is kept for later ones is there."""
    camera = scene.frames[0].cameras["ahead"] if camera is None else camera
    render_view(scene, camera, recipe)
    layers, real = [], cpu.rasterize_cpu

    def spy(parts, camera, buffers, settings, smog, clip=None, pixel_mask=None):
        light = any(part.shading is not None for part in parts)
        maps = any(part.color_maps is not None for part in parts)
        names = " ".join(sorted(buffers))
        layers.append(Layer(names, smog is not None, clip is not None, light, maps))
        return real(parts, camera, buffers, settings, smog, clip, wanted)

    with monkeypatch.context() as patched, counted_kernels() as counts:
        patched.setattr(cpu, "rasterize_cpu", spy)
        render_view(scene, camera, recipe)
    return Ran(counts, layers)


def kernels(layers: int = 1, *names: str, sky: int = 1, **counts: int) -> dict[str, int]:
    """Those of so many runs of the rasteriser, a sky, an 8-bit picture, and the others named."""
    found = dict.fromkeys(RASTER, layers) | {"quantise": 1} | dict.fromkeys(names, 1) | counts
    return found | ({"composite_cubemap": sky} if sky else {})


def recipe_of(style: Style | None = None, output: Output = PICTURE, **weather) -> Recipe:
    return Recipe(style=style, weather=Weather(**weather), output=output)


def test_every_way_to_a_kernel_is_counted_and_given_back():
    sites = launch_sites()
    launched = {name for _, name in sites}
    assert set(RASTER) | {"composite_cubemap", "quantise", "shade", "trace", "pour"} <= launched
    with counted_kernels():
        from augment.render.cpu import project as cpu_project

        assert isinstance(cpu_project.rank_splats, CountingKernel)
    assert launch_sites() == sites


@pytest.mark.parametrize("nothing", [{}, {"smog": Smog(extinction_per_m=0.0)},
    {"snow": Snow(depth_m=0.0)}, {"snow": Snow(depth_m=0.1, coverage=0.0)},
    {"flood": Flood(level_m=-9.0)}, {"style": Style(preset="dusk", strength=0.0)}])  # fmt: skip
def test_no_weather_is_the_clean_frame(scene, monkeypatch, nothing):
    clean = render_view(scene, scene.frames[0].cameras["ahead"], recipe_of())
    again = render_view(scene, scene.frames[0].cameras["ahead"], recipe_of(**nothing))
    assert np.array_equal(again.rgb, clean.rgb)
    ran = run(scene, recipe_of(**nothing), monkeypatch)
    assert ran.kernels == kernels() and ran.layers == [Layer("alpha rgb")]


def test_images_beside_the_picture_take_a_buffer_each_and_no_pass(scene, monkeypatch):
    for output, buffers in (
        (Output(depth="expected"), "alpha expected_depth rgb"),
        (Output(depth="median"), "alpha median_depth rgb"),
    ):
        ran = run(scene, recipe_of(output=output), monkeypatch)
        assert ran.kernels == kernels() and ran.layers == [Layer(buffers)]


def test_smog(scene, monkeypatch):
    for smog, buffers, sky in (
        (Smog(visibility_m=50), "alpha rgb", 0),
        (Smog(visibility_m=50, scale_height_m=20), "alpha rgb", 1),
        (Smog(visibility_m=50, model="deferred"), "alpha expected_depth rgb", 0),
        (Smog(visibility_m=50, model="deferred", scale_height_m=9), "alpha expected_depth rgb", 1),
    ):
        ran = run(scene, recipe_of(smog=smog), monkeypatch)
        assert ran.kernels == kernels(sky=sky)
        assert ran.layers == [Layer(buffers, smog=smog.model == "per_gaussian")]


def test_boxes_in_smog_take_a_depth(scene, monkeypatch):
    labelled = dataclasses.replace(scene, labels=Labels())
    recipe = recipe_of(smog=Smog(visibility_m=50), output=Output(depth="none"))
    assert run(labelled, recipe, monkeypatch).layers == [Layer("alpha expected_depth rgb", True)]
    assert run(scene, recipe, monkeypatch).layers == [Layer("alpha rgb", True)]


@pytest.mark.parametrize("waves", [STILL, CALM], ids=["still", "waves"])
@pytest.mark.parametrize("fresnel", ["exact", "schlick"])
@pytest.mark.parametrize("tier", ["sky", "screen_space", "mirrored"])
def test_floods(scene, monkeypatch, tier, fresnel, waves):
    flood = Flood(level_m=0.3, reflection=tier, fresnel=fresnel, waves=waves)
    ran = run(scene, recipe_of(flood=flood), monkeypatch)
    deep, front = Layer("alpha expected_depth rgb", clip=True), Layer("alpha rgb", clip=True)
    expected = kernels(2 if tier == "sky" else 3, "find_water", "shade", "pour")
    if waves is CALM:
        expected |= {"fill_field": 1}
        if tier != "sky":
            expected |= {"pack": 1, "halve_mip": PACKED}
    if tier == "screen_space":
        expected |= dict.fromkeys(("build_pyramid", "trace", "spread"), 1)
        front = deep
    assert ran.kernels == expected
    assert ran.layers == [front, deep, deep][: 2 if tier == "sky" else 3]


def test_depth_through_water_joins_two_layers(scene, monkeypatch):
    output, flood = Output(depth="expected", labels=False), Flood(level_m=0.3, waves=STILL)
    for surface in ("solid", "first"):
        recipe = recipe_of(output=output.model_copy(update={"surface": surface}), flood=flood)
        ran = run(scene, recipe, monkeypatch)
        joins = ("join_depth", "join_alpha")
        assert ran.kernels == kernels(3, "find_water", "shade", "pour", *joins)
        assert ran.layers == [Layer("alpha expected_depth rgb", clip=True)] * 3


@pytest.mark.parametrize("shading", ["per_splat", "per_pixel"])
@pytest.mark.parametrize("surface", ["solid", "scene", "first"])
def test_snow(scene, monkeypatch, shading, surface):
    snow = Snow(depth_m=0.1, cell_m=0.2, shading=shading)
    light = shading == "per_pixel"
    images = Output(depth="expected", surface=surface, labels=False)
    ran = run(scene, recipe_of(snow=snow, output=images), monkeypatch)
    if surface == "scene":  # the bare scene's depth is a run of its own, and the snow's none
        assert ran.kernels == kernels(2, "count_splits")
        expected = [Layer("alpha rgb snow", light=light), Layer("alpha expected_depth")]
    else:
        assert ran.kernels == kernels(1, "count_splits")
        expected = [Layer("alpha expected_depth rgb snow", light=light)]
    assert ran.layers == expected
    plain = run(scene, recipe_of(snow=snow), monkeypatch)  # neither is asked for: no depth
    assert plain.layers == [Layer("alpha rgb snow", light=light)]


def test_styles(scene, monkeypatch):
    for style, layer, more in (
        (Style(preset="dusk"), Layer("alpha rgb", maps=True), ()),
        (Style(preset="dusk", per_region=True), Layer("alpha rgb", maps=True), ()),
        (Style(preset="dusk", applied_to="picture"), Layer("alpha rgb"), ("map_colors",)),
    ):
        ran = run(scene, recipe_of(style), monkeypatch)
        assert ran.kernels == kernels(1, *more) and ran.layers == [layer]


def test_effects_together_take_no_more_than_each_alone(scene, monkeypatch):
    snow, smog = Snow(depth_m=0.1, cell_m=0.2), Smog(visibility_m=50)
    ran = run(scene, recipe_of(snow=snow, smog=smog), monkeypatch)
    assert ran.kernels == kernels(1, "count_splits", sky=0)
    assert ran.layers == [Layer("alpha rgb snow", smog=True)]
    ran = run(scene, recipe_of(Style(preset="dusk"), smog=smog), monkeypatch)
    assert ran.kernels == kernels(sky=0) and ran.layers == [Layer("alpha rgb", True, maps=True)]
    flood = Flood(level_m=0.3, reflection="sky", waves=STILL)
    ran = run(scene, recipe_of(Style(preset="dusk"), flood=flood), monkeypatch)
    assert ran.kernels == kernels(2, "find_water", "shade", "pour")
    assert all(layer.maps and layer.clip and not layer.smog for layer in ran.layers)


def test_a_colour_map_of_the_camera_is_one_kernel_more(scene, monkeypatch):
    mapped = dataclasses.replace(scene, color_maps={"ahead": torch.eye(3, 4) * 0.5})
    assert run(mapped, recipe_of(), monkeypatch).kernels == kernels(1, "map_colors")
    neutral = recipe_of().model_copy(update={"render": Render(exposure="neutral")})
    assert run(mapped, neutral, monkeypatch).kernels == kernels()


def upwards(camera: Camera) -> Camera:
    """Looks straight up from the same place, x to the right."""
    rows = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    rows[0] = torch.linalg.cross(rows[1], rows[2])
    return dataclasses.replace(camera, camera_from_world=rigid(rows, -rows @ camera.centre))


@pytest.mark.parametrize(
    "weather",
    [
        {"flood": Flood(level_m=0.3)},
        {"snow": Snow(depth_m=0.1, cell_m=0.2, shading="per_pixel")},
        {"flood": Flood(level_m=0.3), "snow": Snow(depth_m=0.1, cell_m=0.2)},
    ],
    ids=["flood", "snow", "both"],
)
def test_a_camera_that_looks_at_the_sky_draws_the_clean_frame(scene, monkeypatch, weather):
    camera = upwards(scene.frames[0].cameras["ahead"])
    output = Output(depth="expected", surface="scene", labels=False)
    clean = run(scene, recipe_of(output=output), monkeypatch, camera)
    ran = run(scene, recipe_of(output=output, **weather), monkeypatch, camera)
    assert clean.layers == [Layer("alpha expected_depth rgb")]
    assert ran == clean
    view = render_view(scene, camera, recipe_of(output=output, **weather))
    bare = render_view(scene, camera, recipe_of(output=output))
    assert np.array_equal(view.rgb, bare.rgb) and np.array_equal(view.depth_m, bare.depth_m)
    for mask in (view.snow, view.water):
        assert mask is None or not mask.any()


def test_water_behind_what_stands_before_it_is_one_layer(scene, monkeypatch):
    """A camera with its eye on a wall: the plane's rays all meet the wall first."""
    high = side_wall(0.6, (-3.0, 5.0), (-0.5, 3.0))
    near = drive(high, sheet((-3.0, 5.0), (-4.0, 0.6)), yaw=np.pi / 2)
    near = dataclasses.replace(near, ground=scene.ground, ground_z_m=0.0, sky=scene.sky)
    ran = run(near, recipe_of(flood=Flood(level_m=0.3)), monkeypatch)
    assert ran.kernels == kernels(1, "find_water")
    assert ran.layers == [Layer("alpha rgb", clip=True)]
