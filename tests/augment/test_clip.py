"""Splats cut at a height: where the cut runs, and that nothing is lost or shown twice."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.effects.flood.water_plane import mirrored_camera
from augment.render.buffers import ALPHA, BUFFERS, RGB
from augment.render.layout import HeightClip
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians
from tests.assertions import assert_images_close
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, random_pose, sh_of, stack

ALL = frozenset(BUFFERS)
BACKENDS = ("cpu", pytest.param("reference", marks=pytest.mark.long))


def render(parts, camera, clip=None, backend="cpu", buffers=ALL):
    parts = [PosedGaussians(parts)] if isinstance(parts, Gaussians) else parts
    return rasterize(parts, camera, buffers=buffers, clip=clip, backend=backend)


def in_float64(gaussians: Gaussians) -> Gaussians:
    names = ("means", "quats", "scales", "opacities", "sh")
    return Gaussians(**{n: getattr(gaussians, n).double() for n in names})


def sheet(points, flat_axis: int, size: float, thickness=0.002) -> Gaussians:
    """Opaque discs that are thin along one axis of the world. points [N, 3]."""
    points = np.asarray(points, np.float32)
    scales = np.full((len(points), 3), size, np.float32)
    scales[:, flat_axis] = thickness
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(points), 1))
    return Gaussians(
        means=torch.from_numpy(points),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(scales),
        opacities=torch.full((len(points),), 0.99),
        sh=sh_of(np.full((len(points), 3), 0.6)),
    )


def wall(distance=5.0) -> Gaussians:
    grid = np.mgrid[-3:3.01:0.4, -3:3.01:0.4].reshape(2, -1).T
    return sheet(np.c_[np.full(len(grid), distance), grid], 0, 0.35)


def floor(z: float) -> Gaussians:
    grid = np.mgrid[1:20:0.4, -8:8.01:0.4].reshape(2, -1).T
    return sheet(np.c_[grid, np.full(len(grid), z)], 2, 0.4)


@pytest.mark.parametrize(
    ("seed", "z_m", "keep"), [(0, -0.6, "above"), (1, 0.0, "below"), (0, 0.21, "below")]
)
def test_kernels_match_the_definition(seed, z_m, keep):
    gaussians = random_gaussians(300, seed=seed)
    clip, camera = HeightClip(z_m, keep), camera_ahead()
    actual = render(gaussians, camera, clip)
    expected = render(in_float64(gaussians), camera, clip, "reference")
    # A cut that runs nearly parallel to its splat moves by pixels with the last bit of float32.
    for name in (RGB, ALPHA):
        assert_images_close(getattr(actual, name), getattr(expected, name), p999=2e-3, max_flips=4)
        error = (getattr(actual, name) - getattr(expected, name)).abs()
        assert float(error.flatten().quantile(0.98)) < 2e-5
    assert float((actual.expected_depth - expected.expected_depth).abs().median()) < 2e-5


@pytest.mark.parametrize("pose", [None, random_pose(3)])
def test_posed_parts_and_the_mirrored_eye(pose):
    parts = [PosedGaussians(random_gaussians(200, seed=4), pose)]
    double = [dataclasses.replace(parts[0], gaussians=in_float64(parts[0].gaussians))]
    camera = mirrored_camera(camera_ahead(), -0.3)  # stands below the plane and looks up at it
    clip = HeightClip(-0.3, "above")
    actual, expected = render(parts, camera, clip), render(double, camera, clip, "reference")
    assert_images_close(actual.rgb, expected.rgb, p999=2e-3, max_flips=4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_wall_is_cut_along_its_waterline(backend, z_m=-0.52):
    """The wall stands 5 m ahead, so the cut is the row that looks at height z_m there."""
    camera = camera_ahead(40, 60, 60.0)
    row = camera.cy - camera.fy * z_m / 5.0
    above = render(wall(), camera, HeightClip(z_m, "above"), backend).alpha
    behind = HeightClip(z_m, "below", overlaps=True)
    below = render(wall(), camera, behind, backend).alpha
    centres = torch.arange(60) + 0.5
    # Row by row the kept share is clamp(pixels above the line + 0.5, 0, 1) of an opaque wall's
    # alpha; the wall's discs overlap, and each is cut, so what is left lies between one cut layer
    # and an opaque one. A pixel and a half from the line there is all or nothing.
    assert float(above[centres < row - 1.5].min()) > 0.98
    assert float(above[centres > row + 1.5].max()) < 1e-3
    assert float(below[centres > row + 0.5].min()) > 0.98  # one pixel more, behind the other's edge
    assert float(below[centres < row - 2.5].max()) < 1e-3


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_flat_road_is_on_one_side_however_shallow_the_water(backend, depth_m=0.01):
    """Discs of 0.4 m seen at a grazing angle: told apart by their surface, not by their centre."""
    camera = camera_ahead(40, 60, 60.0)
    road = floor(-1.5)
    plain = render(road, camera, None, backend, frozenset({RGB, ALPHA}))
    above = render(road, camera, HeightClip(-1.5 + depth_m, "above"), backend)
    below = render(road, camera, HeightClip(-1.5 + depth_m, "below"), backend)
    near = torch.arange(60) > camera.cy + 60 * 1.5 / 12  # nearer than 12 m
    assert float(above.alpha[near].max()) < 0.02
    assert float((below.alpha - plain.alpha)[near].abs().max()) < 0.02


def test_both_sides_together_are_the_whole():
    """Blended one behind the other, the sides of a cut give the picture without one."""
    camera = camera_ahead(40, 60, 60.0)
    gaussians = stack(wall(9.0), floor(-1.5), one_gaussian((4.0, 0.3, -0.9), 0.4, 0.999))
    plain = render(gaussians, camera)
    above = render(gaussians, camera, HeightClip(-0.9, "above"))
    below = render(gaussians, camera, HeightClip(-0.9, "below", overlaps=True))
    both = above.rgb + (1 - above.alpha)[..., None] * below.rgb
    error = (both - plain.rgb).abs().amax(-1)
    # At the edge of the cut a splat's two sides are blended as two splats, which covers a little
    # more than it does as one: a few pixels show it, most where the ball is translucent.
    assert float(error.median()) < 1e-3 and float(error.max()) < 0.15
    assert float((error > 0.02).float().mean()) < 0.03


def test_the_sign_follows_the_height_not_the_distance():
    """A road seen from under it, as by the mirrored eye: above, though it lies beyond the cut."""
    camera = camera_ahead(40, 60, 60.0, position=(0.0, 0.0, -3.0))
    ceiling = floor(-1.5)
    assert float(render(ceiling, camera, HeightClip(-2.0, "above")).alpha.max()) > 0.9
    assert float(render(ceiling, camera, HeightClip(-2.0, "below")).alpha.max()) < 0.02


@pytest.mark.parametrize(("z_m", "keep"), [(math.nan, "above"), (math.inf, "below")])
def test_what_no_clip_can_be(z_m, keep):
    with pytest.raises(ValueError, match="a clip keeps"):
        HeightClip(z_m, keep)


@pytest.mark.parametrize("backend", BACKENDS)
def test_expected_depth_follows_the_surface_of_large_splats(backend):
    """A road of discs 0.4 m wide, 1.5 m below the eye: z = 1.5 f / rows below the horizon."""
    camera = camera_ahead(40, 60, 60.0)
    image = render(floor(-1.5), camera, HeightClip(-1.4, "below"), backend)
    rows = torch.arange(60)[:, None] + 0.5 - camera.cy
    exact = camera.fy * 1.5 / rows
    near = ((rows > 0) & (exact > 4) & (exact < 9)).expand(60, 40) & (image.alpha > 0.95)
    error = (image.expected_depth / exact - 1).abs()[near]
    # Discs are flat to 2 mm, so what is left is the linearised projection; their centres, as the
    # plain buffer takes them, are several times as far off.
    assert int(near.sum()) > 200 and float(error.max()) < 0.02
    plain = render(floor(-1.5), camera, None, backend)
    assert float((plain.expected_depth / exact - 1).abs()[near].min()) > 0.05


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_reach_leaves_out_what_lies_deeper(backend):
    camera = camera_ahead(40, 60, 60.0)
    road = floor(-1.5)
    shallow = render(road, camera, HeightClip(-1.2, "below", reach_m=0.1), backend)
    whole = render(road, camera, HeightClip(-1.2, "below"), backend)
    assert not shallow.alpha.any() and float(whole.alpha[-10:].min()) > 0.9
    enough = render(road, camera, HeightClip(-1.2, "below", reach_m=0.4), backend)
    for name in (RGB, ALPHA):
        assert torch.equal(getattr(enough, name), getattr(whole, name))


def test_unwanted_tiles_are_left_out():
    gaussians, camera = random_gaussians(2000, seed=5), camera_ahead(100, 70, 90.0)
    wanted = torch.zeros(70, 100, dtype=torch.bool)
    wanted[20, 40] = wanted[65, 99] = True  # in two tiles, one at the image's corner
    part = rasterize([PosedGaussians(gaussians)], camera, buffers=ALL, pixel_mask=wanted)
    plain = render(gaussians, camera)
    for rows, columns in ((slice(16, 32), slice(32, 48)), (slice(64, 70), slice(96, 100))):
        for name in ALL:
            piece = getattr(part, name)[rows, columns]
            assert torch.equal(piece, getattr(plain, name)[rows, columns]), name
    assert int((part.alpha > 0).sum()) <= 16 * 16 + 6 * 4 and bool((part.splat_ids[:16] == 0).all())
    with pytest.raises(ValueError, match="pixel_mask must be bool"):
        rasterize([PosedGaussians(gaussians)], camera, pixel_mask=wanted[1:])
