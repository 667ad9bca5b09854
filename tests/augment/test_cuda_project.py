"""The GPU's projection: its splats against the definition.

Without a GPU its kernel is interpreted.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
import torch
from hypothesis import given

from augment.render import layout
from augment.render.constants import RasterSettings
from augment.render.cuda import runtime as gpu
from augment.render.cuda.driver import project
from augment.render.cuda.splats import BLOCK, HIDDEN, TILE, CudaSplats, gather_inputs
from augment.render.layout import ABOVE, BELOW, UNCUT, HeightClip
from augment.scene import Gaussians, PosedGaussians
from tests.augment.drawn_splats import drawn_splats
from tests.augment.examples import drawing
from tests.augment.extremes import wild_gaussians
from tests.augment.hard_scenes import (
    KINDS,
    SMOGS,
    colour_maps,
    hard_gaussians,
    in_float64,
    snow_light,
    wide_camera,
)
from tests.augment.pretend_gpu import pretended_gpu
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, slight_pose, stack

DEFAULT = RasterSettings()
WEATHERS = (*SMOGS, ABOVE, BELOW, "light", "maps")
# Relative errors of float32 against float64: of what is far from 0, and, of slopes and centres
# about 0, absolute. At least twice the worst of the scenes here.
CLOSE, NEAR_ZERO = 1e-4, 2e-4
FLIPS = 2  # splats on the other side of a threshold, or in one more tile


def splats_of(parts, camera, settings=DEFAULT, smog=None, clip=None, *, with_color=True):
    """What the GPU projects, on the CPU; NaN in rows that nobody may read."""
    inputs = gather_inputs(parts, camera, settings, smog, clip, with_color=with_color)
    splats = project(inputs)
    fields = {f.name: getattr(splats, f.name) for f in dataclasses.fields(splats)}
    fields = {name: None if v is None else v.cpu() for name, v in fields.items()}
    for name in ("records", "cuts", "lights"):
        if fields[name] is not None:
            fields[name][fields["counts"] == 0] = math.nan
    fields["rects"][fields["counts"] == 0] = -1
    return CudaSplats(**fields)


def bits(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.contiguous().view(torch.int32)


def assert_close(actual: CudaSplats, expected: CudaSplats, flips: int = FLIPS) -> None:
    """The same splats, but for rounding and for a few at a threshold."""
    drawn = (actual.counts > 0) & (expected.counts > 0)
    assert int(((actual.counts > 0) != (expected.counts > 0)).sum()) <= flips
    assert bool((actual.keys[actual.counts == 0] == HIDDEN).all())
    assert int((actual.rects[drawn] != expected.rects[drawn]).any(1).sum()) <= flips
    same = drawn & (actual.rects == expected.rects).all(1)
    assert torch.equal(actual.counts[same], expected.counts[same])
    z = [splats.keys[drawn].view(torch.float32) for splats in (actual, expected)]
    torch.testing.assert_close(*z, rtol=3e-7, atol=0)
    ids = [bits(splats.records[drawn, layout.SPLAT_ID]) for splats in (actual, expected)]
    assert torch.equal(*ids)
    for name in ("records", "cuts", "lights"):
        ours, theirs = getattr(actual, name), getattr(expected, name)
        assert (ours is None) == (theirs is None), name
        if ours is None:
            continue
        for column in range(ours.shape[1] if name != "cuts" else layout.C_REACH + 1):
            if (name, column) != ("records", layout.SPLAT_ID):
                torch.testing.assert_close(
                    ours[drawn, column], theirs[drawn, column], rtol=CLOSE, atol=NEAR_ZERO,
                    msg=lambda text, at=(name, column): f"{at}: {text}",
                )  # fmt: skip


# ---- against the definition ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "weather"), [*zip(itertools.cycle(KINDS), WEATHERS, strict=False)]
)
def test_splats_are_the_definitions(kind, weather):
    seed = KINDS.index(kind) + 10 * WEATHERS.index(weather)
    camera = wide_camera((60.0, 10.0, 120.0)[seed % 3], at=(3.1, -2.2, 0.4), turn=0.2 * seed)
    gaussians = hard_gaussians(kind, camera, 100, seed=seed, sh_degree=3)
    part = PosedGaussians(gaussians, is_overlay=bool(seed % 2))
    level = 0.397 if kind == "near" else 0.3
    clip = HeightClip(level, weather) if weather in (ABOVE, BELOW) else None
    if weather == "light":
        part = dataclasses.replace(part, shading=snow_light(100, seed))
    if weather == "maps":
        part = dataclasses.replace(part, color_maps=colour_maps(seed))
    smog = SMOGS.get(weather)
    actual = splats_of([part], camera, DEFAULT, smog, clip)
    expected = drawn_splats(in_float64([part]), camera, DEFAULT, clip, smog)
    assert int((actual.counts > 0).sum()) > 20
    assert_close(actual, expected)


@pytest.mark.parametrize(
    ("degree", "settings"),
    [
        (0, RasterSettings(antialiased=True)),
        (1, RasterSettings(near_m=3.0)),
        (2, RasterSettings(sh_degree=1)),
        (3, RasterSettings(sh_degree=0, radius_clip_px=2.5)),
    ],
    ids=["antialiased", "near", "degree 1 of 2", "large ones, degree 0 of 3"],
)
def test_settings_and_every_degree_of_spherical_harmonics(degree, settings):
    camera = camera_ahead()
    part = PosedGaussians(random_gaussians(60, seed=3, sh_degree=degree))
    actual = splats_of([part], camera, settings)
    assert int((actual.counts > 0).sum()) > 10
    assert_close(actual, drawn_splats(in_float64([part]), camera, settings), flips=0)


@pytest.mark.long
@pytest.mark.parametrize("weather", [ABOVE, "light"])
def test_an_orthographic_camera(weather):
    camera = dataclasses.replace(camera_ahead(focal=6.0), is_orthographic=True)
    part = PosedGaussians(random_gaussians(80, seed=5), slight_pose())
    if weather == "light":
        part = dataclasses.replace(part, shading=snow_light(80))
    clip = None if weather != ABOVE else HeightClip(0.2, ABOVE)
    assert_close(
        splats_of([part], camera, clip=clip), drawn_splats(in_float64([part]), camera, None, clip)
    )


@pytest.mark.long
@pytest.mark.parametrize("keep", [BELOW])
def test_what_a_clip_cannot_reach_is_not_drawn(keep):
    camera, part = camera_ahead(), PosedGaussians(random_gaussians(100, seed=6))
    clip = HeightClip(0.1, keep, reach_m=0.5, overlaps=True)
    actual = splats_of([part], camera, clip=clip)
    assert_close(actual, drawn_splats(in_float64([part]), camera, None, clip))
    whole = splats_of([part], camera)
    assert 0 < int((actual.counts > 0).sum()) < int((whole.counts > 0).sum())


@pytest.mark.parametrize("rows", ["rows", pytest.param("classes", marks=pytest.mark.long)])
def test_maps_by_class_or_by_row(rows):
    camera, gaussians = camera_ahead(), random_gaussians(70, seed=7)
    # Rows that are none mean the first map.
    numbers = torch.arange(70, dtype=torch.int16) % 9 - 2
    maps = colour_maps(2)
    part = PosedGaussians(dataclasses.replace(gaussians, semantic=numbers), color_maps=maps)
    if rows == "rows":
        part = dataclasses.replace(part, color_rows=numbers.flip(0))
    assert_close(splats_of([part], camera), drawn_splats(in_float64([part]), camera))


def street_of_parts() -> list[PosedGaussians]:
    """Parts of all kinds: of every degree, posed, snow, empty, lit, mapped, larger than a block."""
    one = random_gaussians(150, seed=1, sh_degree=3)
    classes = torch.arange(150, dtype=torch.int16) % 6
    few = [random_gaussians(40, seed=degree, sh_degree=degree) for degree in range(4)]
    return [
        PosedGaussians(dataclasses.replace(one, semantic=classes), color_maps=colour_maps()),
        PosedGaussians(few[0], slight_pose(), instance_id=1),
        PosedGaussians(Gaussians.empty(3), slight_pose(), instance_id=2),
        PosedGaussians(
            few[1], slight_pose((0.5, 0.1, 0.2)), is_overlay=True, shading=snow_light(40)
        ),
        PosedGaussians(few[2], color_maps=colour_maps(3)[1:2]),
        PosedGaussians(few[3], slight_pose((1.0, 0.0, 0.0)), is_overlay=True),
    ]


@pytest.mark.parametrize("weather", ["layered", pytest.param(ABOVE, marks=pytest.mark.long)])
def test_many_parts_in_one_launch(weather):
    camera, parts = camera_ahead(), street_of_parts()
    clip, smog = (HeightClip(0.1, ABOVE) if weather == ABOVE else None), SMOGS.get(weather)
    actual = splats_of(parts, camera, smog=smog, clip=clip)
    assert_close(actual, drawn_splats(in_float64(parts), camera, None, clip, smog))
    assert len(actual.keys) == 310 > BLOCK
    # Lights of splats of one colour are 0.
    lit = torch.zeros(310, dtype=torch.bool)
    lit[190:230] = True
    drawn = actual.counts > 0
    assert actual.lights is not None
    assert bool((actual.lights[drawn & ~lit] == 0).all())
    assert bool((actual.lights[drawn & lit][:, 6:].amax(1) > 0).all())


# ---- what must not change a bit ------------------------------------------------------------------


def test_ties_stay_ties():
    """The same mean has the same z at any place of the list."""
    one = one_gaussian((4.2, 0.3, -0.1))
    gaussians = stack(
        random_gaussians(37, seed=8, sh_degree=0),
        one,
        random_gaussians(150, seed=9, sh_degree=0),
        one,
    )
    splats = splats_of([PosedGaussians(gaussians, slight_pose())], camera_ahead())
    assert splats.keys[37] == splats.keys[-1] != HIDDEN
    assert torch.equal(splats.rects[37], splats.rects[-1])


# ---- extremes ------------------------------------------------------------------------------------


@pytest.mark.long
@drawing(8)
@given(wild_gaussians())
def test_whatever_is_drawn_is_finite(gaussians):
    camera = camera_ahead()
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    for clip, settings in ((None, DEFAULT), (UNCUT, RasterSettings(antialiased=True))):
        smog = SMOGS["layered"]
        splats = splats_of([PosedGaussians(gaussians)], camera, settings, smog, clip)
        drawn = splats.counts > 0
        assert bool(torch.isfinite(splats.records[drawn]).all())
        assert bool((splats.records[drawn, layout.SHARP_X] > 0).all())
        assert splats.cuts is None or bool(torch.isfinite(splats.cuts[drawn]).all())
        corners = splats.rects[drawn]
        assert bool((corners & 0xFFFF < columns).all()) and bool((corners >> 16 < rows).all())
        assert bool((corners >= 0).all())


# ---- on a GPU ------------------------------------------------------------------------------------


def test_gaussians_within_a_larger_tensor_on_the_gpu(monkeypatch):
    """As a trainer holds them: they need not begin at a multiple of 16 bytes, nor be contiguous."""
    camera, gaussians = camera_ahead(), random_gaussians(50, seed=4)
    expected = splats_of([PosedGaussians(gaussians)], camera)
    names = ("means", "quats", "scales", "opacities", "sh")
    with pretended_gpu(monkeypatch):
        given = {}
        for name in names:
            values = getattr(gaussians, name)
            flat = torch.cat([torch.zeros(1), values.flatten()]).to(gpu.gpu_device())
            given[name] = flat[1:].view(values.shape)
        given["quats"] = given["quats"].t().contiguous().t()
        splats = splats_of([PosedGaussians(Gaussians(**given))], camera)
    assert torch.equal(bits(splats.records), bits(expected.records))


@pytest.mark.gpu
def test_a_large_scene_is_the_definitions_and_the_same_every_time():
    camera = camera_ahead(1600, 1066, 1500.0)
    many = random_gaussians(20_000, seed=1, size=0.05)
    parts = [PosedGaussians(many), *street_of_parts()]
    for weather in ("clear", "uniform", "layered", ABOVE):
        clip, smog = (HeightClip(0.1, ABOVE) if weather == ABOVE else None), SMOGS.get(weather)
        first, second = (splats_of(parts, camera, smog=smog, clip=clip) for _ in range(2))
        for name in ("records", "cuts", "lights"):
            one, other = getattr(first, name), getattr(second, name)
            assert (one is None) == (other is None)
            assert one is None or torch.equal(bits(one), bits(other))
        # Of 20 000 splats, more lie at the edge of a tile.
        expected = drawn_splats(in_float64(parts), camera, None, clip, smog)
        assert_close(first, expected, flips=40)
