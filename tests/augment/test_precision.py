"""float32 kernels against the definition in float64, over extreme scenes: how far apart they are.

Both get the same float32 numbers, so that what is measured is rendering, not storage; what float32
storage loses far from the origin is measured apart. Errors of alpha, colour and snow are absolute,
of depths relative. A pixel may fall on the other side of a cut-off (1/255 of alpha, 1e-4 of
transmittance, one half for the median, a sample's cluster, the heavier of two splats): such pixels
are counted.
"""

from __future__ import annotations

import dataclasses

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from augment.cameras import Camera
from augment.render.buffers import (
    ALPHA,
    BUFFERS,
    EXPECTED_DEPTH,
    MEDIAN_DEPTH,
    MODE_DEPTH,
    OVERLAY,
    RGB,
    SPLAT_IDS,
)
from augment.render.layout import HeightClip
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians
from tests.augment.examples import drawing
from tests.augment.hard_scenes import (
    KINDS,
    SMOGS,
    colour_maps,
    hard_gaussians,
    in_float64,
    snow_light,
    wide_camera,
)

# Kernels are compiled for each set of buffers: these are sets that pictures ask for.
ALL, SNOWY = frozenset(BUFFERS), frozenset({RGB, ALPHA, OVERLAY})
WEATHERS = ("clear", "uniform", "layered", "above", "below", "light", "maps")
FOVS_DEG = (1, 10, 60, 120, 170)


def render(parts, camera: Camera, weather: str, backend: str) -> dict[str, torch.Tensor]:
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


def part_of(gaussians, weather: str, seed: int) -> PosedGaussians:
    part = PosedGaussians(gaussians, is_overlay=bool(seed % 2))
    if weather == "light":
        return dataclasses.replace(part, shading=snow_light(len(gaussians), seed))
    if weather == "maps":
        return dataclasses.replace(part, color_maps=colour_maps(seed))
    return part


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
FLIP, FLIPS, FLIP_SHARE = 1e-3, 3, 0.002  # off by more; so many in an image, plus such a share


def assert_within(found: dict, bounds: dict[str, float], weather: str) -> None:
    for name, error in found.items():
        flips = error > FLIP
        allowed = FLIPS + FLIP_SHARE * error.numel()
        assert int(flips.sum()) <= allowed, (name, weather, int(flips.sum()), float(error.max()))
        rest = error[~flips]
        p99 = float(rest.quantile(0.99)) if len(rest) else 0.0
        assert p99 <= bounds[name], (name, weather, p99)


def compare(gaussians, camera: Camera, weather: str, seed: int) -> dict:
    part = part_of(gaussians, weather, seed)
    return errors(
        render([part], camera, weather, "cpu"),
        render(in_float64([part]), camera, weather, "reference"),
    )


cameras = st.builds(
    wide_camera,
    st.sampled_from(FOVS_DEG),
    st.sampled_from(((33, 21), (16, 16), (45, 30), (1, 1))),
    at=st.just((3.1, -2.2, 0.4)),
    turn=st.floats(-3, 3),
)
seeds = st.integers(0, 2**31)


@pytest.mark.parametrize("kind", KINDS)
@drawing(2)
@given(cameras, st.sampled_from(WEATHERS), seeds)
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
        render([part], camera, "clear", "cpu"), render([exact], camera, "clear", "reference")
    )
    assert off / 3 < float(found[RGB].quantile(0.9)) < 3 * off
