"""What a picture does not depend on: where it lies on the tiles, how large it is, how the Gaussians
are ordered and split into parts, and the number of threads.
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from augment.cameras import Camera
from augment.render.buffers import ALPHA, BUFFERS, OVERLAY, RGB, SPLAT_IDS, RenderOutput
from augment.render.layout import HeightClip
from augment.render.rasterize import rasterize
from augment.render.threads import limit_threads
from augment.scene import Gaussians, PosedGaussians
from tests.augment.examples import drawing
from tests.augment.hard_scenes import (
    KINDS,
    SMOGS,
    colour_maps,
    hard_gaussians,
    snow_light,
    untied,
    wide_camera,
)
from tests.scenes import slight_pose

# Kernels are compiled for each set of buffers: these are sets that pictures ask for.
ALL, SNOWY = frozenset(BUFFERS), frozenset({RGB, ALPHA, OVERLAY})
WEATHERS = ("clear", "uniform", "layered", "clip", "light", "maps")
weathers = st.sampled_from(WEATHERS)
seeds = st.integers(0, 2**31)


def part_of(gaussians: Gaussians, weather: str, seed: int = 0, pose=None) -> PosedGaussians:
    part = PosedGaussians(gaussians, pose)
    if weather == "light":
        light = snow_light(len(gaussians), seed)
        return dataclasses.replace(part, is_overlay=True, shading=light)
    if weather == "maps":
        return dataclasses.replace(part, color_maps=colour_maps(seed))
    return part


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
    first = images(render([part_of(gaussians, weather, seed)], camera, weather))
    part = part_of(gaussians, weather, seed)
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
    whole = part_of(gaussians, weather, seed, slight_pose() if is_posed else None)
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


@pytest.mark.long
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one core: nothing to compare")
@drawing(4)
@given(st.sampled_from(KINDS), weathers, seeds)
def test_bits_do_not_depend_on_the_number_of_threads(kind, weather, seed):
    """As in clear air (test_render_cpu), so in every weather."""
    camera = wide_camera(60.0, (97, 61))
    parts = [part_of(hard_gaussians(kind, camera, 3000, seed=seed), weather, seed)]
    try:
        limit_threads(1)
        alone = render(parts, camera, weather)
        limit_threads(None)
        assert_same_bits(render(parts, camera, weather), alone)
    finally:
        limit_threads(None)


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
    parts = [part_of(gaussians, weather, seed)]
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
    parts = [part_of(gaussians, weather, seed)]
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
    parts = [part_of(gaussians, weather, seed)]
    window = camera.cropped(left, top, width, height)
    whole = images(render(parts, camera, weather))
    cut = {n: image[top : top + height, left : left + width] for n, image in whole.items()}
    assert_same_picture(render(parts, window, weather), cut, 40)
