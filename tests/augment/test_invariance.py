"""What pictures do not depend on, how far float32 is from float64, gradients at the extremes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from augment.reconstruct import kernels as adam
from augment.reconstruct.config import LearningRates
from augment.reconstruct.splats import CORRECTIONS, Splats, splat_rates
from augment.reconstruct.trainer import Knots, part_forces, splat_inputs
from augment.render.buffers import (
    ALPHA,
    BUFFERS,
    EXPECTED_DEPTH,
    MEDIAN_DEPTH,
    MODE_DEPTH,
    OVERLAY,
    RGB,
    SPLAT_IDS,
    RenderOutput,
)
from augment.render.constants import RasterSettings
from augment.render.cpu import backward as cpu_backward
from augment.render.cpu.driver import Scratch
from augment.render.layout import HeightClip
from augment.render.part_views import stack_poses
from augment.render.rasterize import rasterize
from augment.render.threads import kernel_threads, limit_threads
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rigid
from augment.scene.scene import Gaussians, Ground, PosedGaussians, Scene
from augment.scene.sky import ConstantSky
from augment.view.render_view import render_view
from recipes.schema import Flood, Output, Recipe, Smog, Weather
from tests.augment.extremes import street
from tests.augment.hard_scenes import (
    KINDS,
    SMOGS,
    drawing,
    hard_gaussians,
    in_weather,
    untied,
    wide_camera,
)
from tests.scenes import in_float64, parts_in_float64, slight_pose

# Kernels are compiled for each set of buffers: these are sets that pictures ask for.
ALL, SNOWY = frozenset(BUFFERS), frozenset({RGB, ALPHA, OVERLAY})
WEATHERS = ("clear", "uniform", "layered", "clip", "light", "maps")
weathers = st.sampled_from(WEATHERS)
seeds = st.integers(0, 2**31)


def render(parts: list[PosedGaussians], camera: Camera, weather: str) -> RenderOutput:
    clip = HeightClip(0.1, "above") if weather == "clip" else None
    buffers = SNOWY if weather == "light" else ALL
    smog = SMOGS.get(weather)
    return rasterize(parts, camera, buffers=buffers, fog=smog, clip=clip, backend="cpu")


def images(output: RenderOutput) -> dict[str, torch.Tensor]:
    return {n: getattr(output, n) for n in BUFFERS if getattr(output, n) is not None}


def assert_same_bits(actual: RenderOutput, expected: RenderOutput) -> None:
    for name, image in images(expected).items():
        assert torch.equal(getattr(actual, name), image), name


# ---- the order of the Gaussians ------------------------------------------------------------------


@drawing(10)
@given(st.sampled_from(KINDS), weathers, seeds, st.sampled_from((1, 60, 170)), st.integers(1, 3000))
def test_bits_do_not_depend_on_the_order_of_gaussians(kind, weather, seed, fov_deg, count):
    """Shuffled within its part, a splat keeps its z, and with no equal z the picture its bits."""
    camera = wide_camera(fov_deg)
    gaussians = untied(hard_gaussians(kind, camera, count, seed=seed), camera)
    order = torch.from_numpy(np.random.default_rng(seed).permutation(len(gaussians)))
    first = images(render([in_weather(gaussians, weather, seed)], camera, weather))
    part = in_weather(gaussians, weather, seed)
    shuffled = dataclasses.replace(part, gaussians=gaussians.select(order))
    if part.shading is not None:
        light = dataclasses.replace(part.shading, slopes=part.shading.slopes[order])
        shuffled = dataclasses.replace(shuffled, shading=light)
    second = images(render([shuffled], camera, weather))
    if SPLAT_IDS in second:
        ids = second[SPLAT_IDS]
        second[SPLAT_IDS] = torch.where(ids < 0, ids, order[ids.clamp_min(0).long()].int())
    for name, image in first.items():
        assert torch.equal(second[name], image), name


@drawing(8)
@given(st.sampled_from(KINDS), weathers, seeds, st.booleans(), st.integers(0, 3000))
def test_a_part_split_in_two_has_the_same_bits(kind, weather, seed, is_posed, cut):
    """Ids too, for they count through the parts. Blocks of 2048 begin anew with each part."""
    camera, count = wide_camera(60.0), 2600
    gaussians = hard_gaussians(kind, camera, count, seed=seed)
    whole = in_weather(gaussians, weather, seed, slight_pose() if is_posed else None)
    at = [slice(0, min(cut, count)), slice(min(cut, count), count)]
    halves = [dataclasses.replace(whole, gaussians=_sliced(gaussians, s)) for s in at]
    if whole.shading is not None:
        light, slopes = whole.shading, whole.shading.slopes
        halves = [
            dataclasses.replace(h, shading=dataclasses.replace(light, slopes=slopes[s]))
            for h, s in zip(halves, at, strict=True)
        ]
    assert_same_bits(render(halves, camera, weather), render([whole], camera, weather))


def _sliced(gaussians: Gaussians, rows: slice) -> Gaussians:
    return gaussians.select(torch.arange(len(gaussians))[rows])


# ---- where the picture lies ----------------------------------------------------------------------

# Pixels are numbered from the image's corner, so that float32 rounds a mean's place elsewhere in
# another image: by 2e-6 px in images of 33 px, 2.4e-4 px at column 8192. All else follows from it:
# alpha by as much times a splat's slope, and the cut-offs of alpha and transmittance (flips).
SHIFTED = {RGB: 3e-5, ALPHA: 3e-5, OVERLAY: 3e-5}
FLIP = 1e-3


def assert_same_picture(actual: RenderOutput, expected: dict[str, torch.Tensor], flips: int):
    """Within SHIFTED but for some pixels at a cut-off; ids and depths but for as many."""
    for name, image in expected.items():
        other = images(actual)[name]
        if name in SHIFTED:
            error = (other - image).abs().reshape(*image.shape[:2], -1).amax(-1)
        elif name == SPLAT_IDS:
            error = (other != image).float()
        else:
            error = (other - image).abs() / image.abs().clamp_min(0.01)
        wrong = error > SHIFTED.get(name, FLIP)
        assert int(wrong.sum()) <= flips, (name, int(wrong.sum()), float(error.max()))


def _centred(gaussians: Gaussians, camera: Camera, left=0, top=0, right=0, bottom=0) -> Gaussians:
    """Those whose centres lie in the image less some borders, in px.

    Of splats centred farther outside the image than 15 % of its size the projection is linearised
    at that border (constants.TAN_FOV_MARGIN), which moves with the image: these do look different.
    """
    points = gaussians.means.double() - camera.centre
    x, y, z = (points @ camera.camera_from_world[:3, :3].T).unbind(1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (z > 0) & (u > left) & (u < camera.width - right)
    return gaussians.select(inside & (v > top) & (v < camera.height - bottom))


shifts = st.tuples(st.integers(-15, 15), st.integers(-15, 15))


@drawing(12)
@given(st.sampled_from(KINDS), weathers, seeds, shifts, st.sampled_from((10, 60, 120, 170)))
def test_a_picture_moved_over_the_tiles_is_the_same(kind, weather, seed, shift, fov_deg):
    camera = wide_camera(fov_deg, (70, 53), turn=0.3)
    dx, dy = shift
    moved = dataclasses.replace(camera, cx=camera.cx + dx, cy=camera.cy + dy)
    margins = max(-dx, 0), max(-dy, 0), max(dx, 0), max(dy, 0)
    gaussians = _centred(hard_gaussians(kind, camera, 120, seed=seed), camera, *margins)
    parts = [in_weather(gaussians, weather, seed)]
    first = images(render(parts, camera, weather))
    second = images(render(parts, moved, weather))
    height, width = camera.height, camera.width
    here = slice(max(-dy, 0), height + min(-dy, 0)), slice(max(-dx, 0), width + min(-dx, 0))
    there = slice(max(dy, 0), height + min(dy, 0)), slice(max(dx, 0), width + min(dx, 0))
    moved_back = RenderOutput(**{n: image[there] for n, image in second.items()})
    assert_same_picture(moved_back, {n: image[here] for n, image in first.items()}, 40)


@pytest.mark.long
@drawing(8)
@given(st.sampled_from(KINDS), weathers, seeds, st.integers(1, 40), st.integers(1, 30))
def test_a_larger_image_holds_the_smaller_one_to_the_bit(kind, weather, seed, wider, higher):
    camera = wide_camera(60.0, (45, 37))
    gaussians = _centred(hard_gaussians(kind, camera, 300, seed=seed), camera)
    parts = [in_weather(gaussians, weather, seed)]
    larger = dataclasses.replace(camera, width=45 + wider, height=37 + higher)
    whole = images(render(parts, larger, weather))
    for name, image in images(render(parts, camera, weather)).items():
        assert torch.equal(whole[name][:37, :45], image), name


@drawing(8)
@given(st.sampled_from(KINDS), weathers, seeds, st.integers(0, 40), st.integers(0, 30))
def test_a_window_shows_its_part_of_the_picture(kind, weather, seed, left, top):
    """By a camera whose principal point is moved, as tiles of a picture are rendered apart."""
    camera = wide_camera(60.0, (90, 64))
    width, height = 90 - left - 17, 64 - top - 11
    gaussians = hard_gaussians(kind, camera, 200, seed=seed)
    gaussians = _centred(gaussians, camera, left, top, 17, 11)
    parts = [in_weather(gaussians, weather, seed)]
    window = camera.cropped(left, top, width, height)
    whole = images(render(parts, camera, weather))
    cut = {n: image[top : top + height, left : left + width] for n, image in whole.items()}
    assert_same_picture(render(parts, window, weather), cut, 40)


# ---- whole frames --------------------------------------------------------------------------------


def _valley(gaussians: Gaussians, camera: Camera) -> Scene:
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {"wide": camera})
    sky = ConstantSky(torch.tensor([0.6, 0.7, 0.9]))
    ground = Ground(-1.5, -1.5, "stated")
    return Scene(
        "valley", "test:valley", gaussians, (), sky, (frame,), ground_z_m=-1.5, ground=ground
    )


def test_weathered_frames_do_not_depend_on_order_and_threads():
    """Through every pass, down to the 8 bits of the picture."""
    smog = Smog(visibility_m=60.0, scale_height_m=5.0)
    weather = Weather(smog=smog, flood=Flood(level_m=0.8))
    recipe = Recipe(weather=weather, output=Output(depth="median"))
    camera = wide_camera(70.0, (70, 53))
    gaussians = untied(hard_gaussians("plain", camera, 40, seed=2), camera)
    order = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(0))
    first = render_view(_valley(gaussians, camera), camera, recipe)
    assert first.masks["water"].any()
    limit_threads(2)
    shuffled = render_view(_valley(gaussians.select(order), camera), camera, recipe)
    for name in ("rgb", "depth_m"):
        np.testing.assert_array_equal(getattr(shuffled, name), getattr(first, name), err_msg=name)
    np.testing.assert_equal(dict(shuffled.masks), dict(first.masks))


@pytest.mark.parametrize(
    "shading", ["per_splat", pytest.param("per_pixel", marks=pytest.mark.long)]
)
def test_frames_in_all_weathers_do_not_depend_on_threads(shading):
    """Of a street: snow is made anew, in waves of wind, styled, close to the eye and glinting."""
    data = {
        "weather": {
            "smog": {"visibility_m": 60.0, "scale_height_m": 5.0},
            "flood": {"level_m": 0.05, "waves": {"preset": "wind"}, "reflection": "screen_space"},
            "snow": {"depth_m": 0.2, "cell_m": 0.2, "sparkle": 1.0, "shading": shading},
        },
        "style": {"preset": "dusk", "per_region": True, "evaluated": "sh"},
        "output": {"depth": "expected"},
    }
    recipe, camera = Recipe.model_validate(data), street().frames[0].cameras["ahead"].scaled(0.3)
    views = []
    for count in (1, 2):
        limit_threads(count)
        scene = dataclasses.replace(street(), source=f"test:threads-{count}")
        views.append(render_view(scene, camera, recipe))
    first, second = views
    assert first.masks["snow"].any() and first.masks["water"].any()
    np.testing.assert_array_equal(first.rgb, second.rgb)
    np.testing.assert_array_equal(first.depth_m, second.depth_m)
    np.testing.assert_equal(dict(first.masks), dict(second.masks))


# ---- float32 against float64 ---------------------------------------------------------------------

# Kernels are compiled for each set of buffers: these are sets that pictures ask for.
CLIPPED_WEATHERS = ("clear", "uniform", "layered", "above", "below", "light", "maps")
FOVS_DEG = (1, 10, 60, 120, 170)


def render_on(parts, camera: Camera, weather: str, backend: str) -> dict[str, torch.Tensor]:
    clip = (
        HeightClip(float(camera.centre[2]) - 0.1, weather)
        if weather in ("above", "below")
        else None
    )
    buffers = SNOWY if weather == "light" else ALL
    output = rasterize(
        parts, camera, buffers=buffers, fog=SMOGS.get(weather), clip=clip, backend=backend
    )
    return {name: getattr(output, name) for name in buffers}


def errors(actual: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> dict:
    """Of every pixel, float64 [H W], by buffer; of ids 1 where they differ."""
    found = {}
    for name, image in expected.items():
        other, image = actual[name].double(), image.double()
        assert bool(torch.isfinite(other).all()) and bool(torch.isfinite(image).all()), name
        error = (other - image).abs()
        if name == RGB:
            error = error.amax(-1)
        elif name == SPLAT_IDS:
            error = (error > 0).double()
        elif name in (EXPECTED_DEPTH, MEDIAN_DEPTH, MODE_DEPTH):
            error = error / image.abs().clamp_min(0.01)
        found[name] = error.reshape(-1)
    return found


# Of the pixels that are no flips 99 % are off by less than this: at least twice the worst of 420
# images.
# Colour: forty float32 blends, an exp2 that is good to 3e-6, style maps of gain 3.
BOUNDS = {
    RGB: 3e-5,
    ALPHA: 1e-5,
    OVERLAY: 1e-5,
    EXPECTED_DEPTH: 1e-4,
    MEDIAN_DEPTH: 1e-6,
    MODE_DEPTH: 3e-5,
    SPLAT_IDS: 0.0,
}
# A needle's mean may lie thousands of pixels beside the image: float32 places it to 1e-7 of that.
NEEDLES = BOUNDS | {RGB: 5e-4, ALPHA: 5e-4, OVERLAY: 5e-4, EXPECTED_DEPTH: 1e-3, MODE_DEPTH: 3e-4}
# And a mean in column 8192 to 2.4e-4 px.
LONG = BOUNDS | {RGB: 1e-4, ALPHA: 1e-4, OVERLAY: 1e-4, EXPECTED_DEPTH: 1e-3}
FLIPS, FLIP_SHARE = 3, 0.002  # so many in an image, plus such a share


def assert_within(found: dict, bounds: dict[str, float], weather: str) -> None:
    for name, error in found.items():
        flips = error > FLIP
        allowed = FLIPS + FLIP_SHARE * error.numel()
        assert int(flips.sum()) <= allowed, (name, weather, int(flips.sum()), float(error.max()))
        rest = error[~flips]
        p99 = float(rest.quantile(0.99)) if len(rest) else 0.0
        assert p99 <= bounds[name], (name, weather, p99)


def compare(gaussians, camera: Camera, weather: str, seed: int) -> dict:
    part = in_weather(gaussians, weather, seed)
    return errors(
        render_on([part], camera, weather, "cpu"),
        render_on(parts_in_float64([part]), camera, weather, "reference"),
    )


cameras = st.builds(
    wide_camera,
    st.sampled_from(FOVS_DEG),
    st.sampled_from(((33, 21), (16, 16), (45, 30), (1, 1))),
    at=st.just((3.1, -2.2, 0.4)),
    turn=st.floats(-3, 3),
)


@pytest.mark.parametrize("kind", KINDS)
@drawing(2)
@given(cameras, st.sampled_from(CLIPPED_WEATHERS), seeds)
def test_kernels_match_the_definition(kind, camera, weather, seed):
    gaussians = hard_gaussians(kind, camera, 60, seed=seed)
    bounds = NEEDLES if kind == "needles" else BOUNDS
    assert_within(compare(gaussians, camera, weather, seed), bounds, weather)


@pytest.mark.long
@pytest.mark.parametrize("size", [(8192, 1), (1, 513)])
def test_long_images(size):
    """In light per pixel, which asks for fewest buffers: the definition takes tile after tile.

    A mean's place is rounded to 2.4e-4 px at column 8192, and to 3e-5 px at row 513."""
    camera = wide_camera(170.0, size)
    found = compare(hard_gaussians("plain", camera, 40, seed=5), camera, "light", 1)
    assert_within(found, LONG, "light")


# ---- far from the origin -------------------------------------------------------------------------


def far_scene(distance_m: float, seed: int):
    """float64 Gaussians before a camera that stands so far from the origin, a street wide."""
    camera = wide_camera(60.0, (33, 21), at=(distance_m, -distance_m, 0.4))
    return hard_gaussians("plain", camera, 60, seed=seed, dtype=torch.float64), camera


def in_float32(gaussians):
    names = ("means", "quats", "scales", "opacities", "sh")
    return dataclasses.replace(gaussians, **{n: getattr(gaussians, n).float() for n in names})


@pytest.mark.parametrize(("distance_m", "weather"), [(1e4, "layered"), (1e6, "above")])
def test_rendering_loses_nothing_far_from_the_origin(distance_m, weather):
    gaussians, camera = far_scene(distance_m, seed=7)
    assert_within(compare(in_float32(gaussians), camera, weather, 0), BOUNDS, weather)


@pytest.mark.parametrize(
    ("distance_m", "lost_m", "off"), [(1e4, 4.9e-4, 5e-4), (1e6, 0.0313, 0.04)]
)
def test_float32_coordinates_lose_centimetres_far_from_the_origin(distance_m, lost_m, off):
    """Which is why adapters move a drive to its own origin. lost_m: half of float32's step. off:
    nine tenths of the pixels' colours are off by less or thereabouts.
    """
    gaussians, camera = far_scene(distance_m, seed=7)
    stored = in_float32(gaussians)
    moved = stored.means.double() - gaussians.means
    assert 0.8 * lost_m < float(moved.abs().max()) <= lost_m
    part = PosedGaussians(stored)
    exact = dataclasses.replace(part, gaussians=gaussians)
    found = errors(
        render_on([part], camera, "clear", "cpu"), render_on([exact], camera, "clear", "reference")
    )
    assert off / 3 < float(found[RGB].quantile(0.9)) < 3 * off


FIELDS = ("means", "quats", "scales", "opacities", "sh")


# ---- gradients -----------------------------------------------------------------------------------

kinds = st.sampled_from(KINDS)
fovs = st.sampled_from((1, 10, 60, 120, 170))
sizes = st.sampled_from(((33, 21), (1, 1), (17, 1), (16, 16)))


def learnt(gaussians: Gaussians) -> Gaussians:
    tensors = {n: getattr(gaussians, n).clone().requires_grad_() for n in FIELDS}
    return dataclasses.replace(gaussians, **tensors)


def gradients(gaussians: Gaussians, camera, *, backend: str, seed: int, **options) -> dict:
    """Of a loss in which every pixel of colour, alpha and depth has a weight of its own."""
    own = learnt(gaussians)
    output = rasterize(
        [PosedGaussians(own)],
        camera,
        buffers=(RGB, ALPHA, EXPECTED_DEPTH),
        backend=backend,
        **options,
    )
    generator = torch.Generator().manual_seed(seed % 2**31)
    loss = output.alpha.new_zeros(())
    for image in (output.rgb, output.alpha, output.expected_depth):
        assert torch.isfinite(image).all()
        loss = loss + (image * torch.rand(image.shape, generator=generator).to(image)).sum()
    loss.backward()
    return {name: getattr(own, name).grad for name in FIELDS}


def assert_finite(found: dict) -> None:
    for name, value in found.items():
        assert value is not None and bool(torch.isfinite(torch.as_tensor(value)).all()), name


@pytest.mark.long
@drawing(8)
@given(kinds, seeds, fovs, sizes, st.booleans())
def test_gradients_of_the_cpu_rasteriser_are_finite(kind, seed, fov_deg, size, antialiased):
    camera = wide_camera(fov_deg, size)
    gaussians = hard_gaussians(kind, camera, 60, seed=seed)
    settings = RasterSettings(antialiased=antialiased)
    assert_finite(gradients(gaussians, camera, backend="cpu", seed=seed, settings=settings))


@pytest.mark.long
@pytest.mark.parametrize("smog", SMOGS)
@drawing(2)
@given(kinds, seeds, fovs, st.booleans(), st.booleans())
def test_gradients_of_the_definition_are_finite(smog, kind, seed, fov_deg, antialiased, is_double):
    camera = wide_camera(fov_deg, (16, 9))
    gaussians = hard_gaussians(kind, camera, 30, seed=seed)
    if is_double:
        gaussians = in_float64(gaussians)
    settings = RasterSettings(antialiased=antialiased)
    found = gradients(
        gaussians, camera, backend="reference", seed=seed, settings=settings, fog=SMOGS[smog]
    )
    assert_finite(found)


# ---- reconstruction ------------------------------------------------------------------------------


@pytest.mark.long
@drawing(5)
@given(kinds, seeds, fovs, st.sampled_from((0.0, 1e-30, 1.0, 1e10)))
def test_splats_and_poses_are_finite_after_a_step(kind, seed, fov_deg, steepness):
    """Adam keeps logarithms of scales and logits of opacities within what can be drawn."""
    camera = wide_camera(fov_deg)
    start = hard_gaussians(kind, camera, 60, seed=seed, sh_degree=3)
    pose = rigid(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    splats = Splats.of([start, start.select(torch.arange(20))], 3)
    poses = stack_poses([None, pose])
    rates = LearningRates()
    inputs = splat_inputs(splats, [0, 1], poses, camera, RasterSettings())
    knots = Knots([np.array([0, 10])], 6)
    rng, scratch = np.random.default_rng(seed), Scratch()
    for step in range(2):
        tape = cpu_backward.record_render(
            inputs, camera, RasterSettings(), scratch, with_depth=True
        )
        images = [
            (steepness * rng.normal(size=image.shape)).astype(np.float32)
            for image in (tape.rgb, tape.alpha, tape.expected_depth)
        ]
        found = tape.backward(*images)
        forces = part_forces(inputs, found)
        on_camera = forces.on_camera(camera.camera_from_world.numpy() @ poses)
        knots.update(0, 5, on_camera, np.full(6, 0.1), 1e-3)
        with kernel_threads():
            adam.update_splats(
                inputs.addresses, inputs.sizes, inputs.views, inputs.blocks, inputs.first_ids,
                adam.GradientRows(found.rows.reshape(-1), found.ids, found.counts), 16,
                splat_rates(rates, step / 10, camera, 50.0), CORRECTIONS.reshape(-1),
                splats.adam_state(),
            )  # fmt: skip
    for name, array in splats.arrays().items():
        assert np.isfinite(array).all(), name
    assert np.isfinite(knots.values).all() and np.isfinite(on_camera).all()
    assert splats.scales.min() > 0
    assert splats.opacities.min() >= 0 and splats.opacities.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(splats.quats, axis=1), 1, atol=1e-5)
