"""Gradients of the CPU backend against those of the definition in float64, and against itself."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
import torch

from augment.render.buffers import ALPHA, DIFFERENTIABLE, EXPECTED_DEPTH, OVERLAY, RGB
from augment.render.composite import apply_color_map, composite_sky
from augment.render.constants import ALPHA_MIN, RasterSettings
from augment.render.fog import Fog
from augment.render.layout import HeightClip
from augment.render.rasterize import rasterize
from augment.render.threads import limit_threads
from augment.scene.scene import Gaussians, PosedGaussians, SplatShading
from augment.scene.sky import CubemapSky
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, sh_of, slight_pose

FIELDS = ("means", "quats", "scales", "opacities", "sh")
DEFAULT = RasterSettings()
# Alpha is 1 - T, good to 6e-8 of one, and the expected depth divides by it. Where a single splat
# covers a pixel by 1/255 that is 1.5e-5 of its depth; and its slope by that splat's opacity, in
# truth 0, is 255 times the error. (Losses leave out depths of pixels that are hardly covered.)
HARDLY_COVERED = 3e-3
TOP = dataclasses.replace(camera_ahead(17, 9, 3.0), is_orthographic=True)


# ---- comparing -------------------------------------------------------------------------------


def leaves(parts, dtype=torch.float32):
    """The parts with fresh float tensors that record gradients."""
    out = []
    for part in parts:
        tensors = {
            name: getattr(part.gaussians, name).detach().to(dtype).clone().requires_grad_()
            for name in FIELDS
        }
        out.append(dataclasses.replace(part, gaussians=Gaussians(**tensors)))
    return out


def weighting(camera, buffers=DIFFERENTIABLE, seed=0) -> dict[str, torch.Tensor]:
    """A random derivative of some loss by every pixel, of both signs."""
    rng = np.random.default_rng(seed)
    shapes = {RGB: (camera.height, camera.width, 3)}
    return {
        name: torch.from_numpy(
            rng.normal(size=shapes.get(name, (camera.height, camera.width))).astype(np.float32)
        )
        for name in sorted(buffers)
    }


def gradients(parts, camera, weights, settings=DEFAULT, backend="cpu"):
    """Gradients of the weighted sum of buffers: one dictionary a part, in float64."""
    tracked = leaves(parts, torch.float64 if backend == "reference" else torch.float32)
    out = rasterize(tracked, camera, buffers=list(weights), settings=settings, backend=backend)
    total = sum((getattr(out, name) * weight).sum() for name, weight in weights.items())
    if total.requires_grad or backend == "cpu":  # the definition of an empty image has no leaves
        total.backward()
    found = []
    for part in tracked:
        tensors = {name: getattr(part.gaussians, name) for name in FIELDS}
        if backend == "cpu":
            for name, tensor in tensors.items():
                assert tensor.grad is not None and tensor.grad.shape == tensor.shape, name
        found.append({
            name: np.zeros(tensor.shape) if tensor.grad is None else tensor.grad.double().numpy()
            for name, tensor in tensors.items()
        })  # fmt: skip
    return found


def row_norms(array: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(array).sum(axis=tuple(range(1, array.ndim))))


def sizes_and_errors(parts, actual, expected, name) -> tuple[np.ndarray, np.ndarray]:
    """Of every Gaussian of all parts: the size of its gradient by a field, and the error's.

    A turn moves what a scale stretches, and of a ball nothing: a quaternion's gradient is a
    difference of numbers as large as the one by the logarithm of scales, which counts as its size.
    """
    sizes, errors = [], []
    for part, got, want in zip(parts, actual, expected, strict=True):
        assert np.isfinite(got[name]).all() and np.isfinite(want[name]).all(), name
        size = row_norms(want[name])
        if name == "quats":
            size += row_norms(want["scales"] * part.gaussians.scales.double().numpy())
        sizes.append(size)
        errors.append(row_norms(got[name] - want[name]))
    return np.concatenate(sizes), np.concatenate(errors)


def assert_gradients_match(
    parts, camera, settings=DEFAULT, *, buffers=DIFFERENTIABLE, tolerance=2e-5, max_flips=0
):
    """Every Gaussian's gradient agrees with the definition's in float64, field by field.

    A Gaussian's error is taken relative to its own gradient, or to a thousandth of the root mean
    square where its own is smaller than that: sums of pixels that cancel keep the rounding errors
    of their terms. `tolerance` bounds a field's relative l2 error: the kernel's exp2 is good to
    3e-6 of alpha, and what lies behind a splat is a difference of float32 sums, which is 1e-6 to
    1e-5 together. The 95th percentile of single Gaussians, small ones too, may be 100 times that.

    max_flips: Gaussians that may be off by more than 1 %. The cut-offs (alpha at 1/255,
    transmittance at 1e-4, order of z) are crossed in float32 elsewhere than in float64 in about
    one of 1e5 pairs, and a Gaussian that shows in few pixels then gains or loses one of them.
    """
    weights = weighting(camera, buffers)
    actual = gradients(parts, camera, weights, settings)
    expected = gradients(parts, camera, weights, settings, backend="reference")
    flipped: set[int] = set()
    for name in FIELDS:
        size, error = sizes_and_errors(parts, actual, expected, name)
        shown = size > 0
        assert not error[~shown].any(), f"{name} of splats that show nothing"
        if not shown.any():
            continue
        floor = 1e-3 * np.sqrt(np.mean(size[shown] ** 2))
        relative = error / np.maximum(size, floor)
        flipped |= set(np.flatnonzero(relative > 1e-2).tolist())
        good = shown & (relative <= 1e-2)
        l2 = np.linalg.norm(error[good]) / np.linalg.norm(size[good])
        p95 = np.quantile(relative[good], 0.95)
        message = f"{name}: relative l2 error {l2:.2g}, 95th percentile {p95:.2g}"
        assert l2 <= tolerance and p95 <= 100 * tolerance, message
    assert len(flipped) <= max_flips, f"{len(flipped)} off by more than 1 %: {sorted(flipped)}"
    return actual


def posed(*gaussians):
    return [PosedGaussians(g) for g in gaussians]


def drawn_nowhere(gaussians: Gaussians) -> Gaussians:
    """The Gaussians behind the camera."""
    return dataclasses.replace(gaussians, means=-gaussians.means.abs() - 1)


# ---- the definition --------------------------------------------------------------------------


@pytest.mark.parametrize(("size", "antialiased"), [((37, 21), False), ((17, 33), True)], ids=str)
def test_random_gaussians(size, antialiased):
    settings = RasterSettings(antialiased=antialiased)
    camera = camera_ahead(*size, 28.0, position=(0.02, -0.1, 0.07), yaw=0.1)
    assert_gradients_match(
        [PosedGaussians(random_gaussians(200, seed=size[0]), slight_pose())],
        camera,
        settings,
        max_flips=2,
    )


def test_settings_that_leave_splats_out():
    settings = RasterSettings(transmittance_stop=0.05, radius_clip_px=6.0)
    found = assert_gradients_match(
        posed(crowd(600, opacity=0.6), random_gaussians(300)),
        camera_ahead(37, 21, 28.0),
        settings,
        tolerance=1e-4,
        max_flips=8,
    )
    small = found[1]["sh"]  # of random sizes
    assert 20 < (np.abs(small).reshape(300, -1).any(1)).sum() < 250


@pytest.mark.parametrize(("degree", "limit"), [(2, 1), (3, None)])
def test_every_sh_degree(degree, limit):
    gaussians = random_gaussians(60, seed=degree, sh_degree=degree, size=0.5)
    settings = RasterSettings(sh_degree=limit)
    found = assert_gradients_match(posed(gaussians), camera_ahead(19, 13, 18.0), settings)
    used = (min(degree, 3 if limit is None else limit) + 1) ** 2
    assert np.abs(found[0]["sh"][:, :used]).max(axis=(0, 2)).all()
    assert not found[0]["sh"][:, used:].any()  # bands that were not evaluated


@pytest.mark.parametrize(
    "buffers", [{RGB}, {ALPHA}, {EXPECTED_DEPTH}], ids=lambda names: "+".join(sorted(names))
)
def test_every_buffer_alone(buffers):
    found = assert_gradients_match(
        posed(random_gaussians(150, size=0.4)), camera_ahead(21, 17, 20.0), buffers=buffers
    )
    assert found[0]["opacities"].any()
    assert bool(found[0]["sh"].any()) == (RGB in buffers)


def test_parts_in_their_own_frames():
    parts = [
        PosedGaussians(random_gaussians(120, seed=1)),
        PosedGaussians(drawn_nowhere(random_gaussians(40, seed=2)), slight_pose(), 1),
        PosedGaussians(Gaussians.empty(sh_degree=3), slight_pose(), 2),
        PosedGaussians(random_gaussians(90, seed=3, sh_degree=1), slight_pose((0.3, 0, 0.2)), 3),
        PosedGaussians(one_gaussian(), None, 4),
    ]
    found = assert_gradients_match(parts, camera_ahead(33, 25), max_flips=1)
    assert not any(found[1][name].any() for name in FIELDS)
    assert all(found[part][name].any() for part in (0, 3) for name in FIELDS)


def test_more_gaussians_than_a_block_holds():
    """Blocks of 2048, of two parts, each with its own rows of gradients."""
    small = random_gaussians(2100, seed=4, sh_degree=0, size=0.03)
    parts = [PosedGaussians(small), PosedGaussians(random_gaussians(300, seed=5, size=0.05))]
    # Most Gaussians are of a few pixels, some of which lie within 1e-6 of a cut-off.
    assert_gradients_match(parts, camera_ahead(33, 25, 30.0), max_flips=12)


def test_one_gaussian_has_the_gradients_of_its_formula():
    """By opacity and colour they are sums that can be written down."""
    camera = camera_ahead(33, 21)
    weights = weighting(camera, {RGB})
    found = gradients(posed(one_gaussian(opacity=0.6)), camera, weights)[0]
    alpha = rasterize(posed(one_gaussian(opacity=0.6)), camera, backend="cpu").alpha.double()
    shade = (weights[RGB] * torch.tensor([0.9, 0.5, 0.1])).sum(-1)
    # 1e-5: rgb = opacity shape colour in float32, exp2 good to 3e-6
    assert found["opacities"][0] == pytest.approx(float((shade * alpha).sum()) / 0.6, rel=1e-5)
    by_color = (weights[RGB] * alpha[..., None]).sum((0, 1)).numpy() * 0.28209479177387814
    np.testing.assert_allclose(found["sh"][0, 0], by_color, rtol=1e-5)
    thin = posed(one_gaussian(scale=(0.3, 0.2, 0.5)))
    assert_gradients_match(thin, camera, buffers={RGB, ALPHA})
    assert_gradients_match(thin, camera, tolerance=HARDLY_COVERED)


@pytest.mark.parametrize("count", [0, 30])
def test_nothing_to_be_seen(count):
    gaussians = drawn_nowhere(random_gaussians(30)) if count else Gaussians.empty()
    camera = camera_ahead(17, 9)
    found = gradients(posed(gaussians), camera, weighting(camera))
    assert not any(found[0][name].any() for name in FIELDS)


# ---- cut-offs --------------------------------------------------------------------------------


def crowd(count: int, *, opacity: float, seed: int = 0) -> Gaussians:
    """Splats all over the image, two pixels wide, one behind the other."""
    rng = np.random.default_rng(seed)
    base = random_gaussians(count, seed=seed, sh_degree=1)
    x = rng.uniform(3.0, 6.0, count)
    means = np.stack([x, *(rng.uniform(-0.6, 0.6, (2, count)) * x)], -1)
    return dataclasses.replace(
        base,
        means=torch.from_numpy(means.astype(np.float32)),
        scales=torch.from_numpy(rng.uniform(0.15, 0.4, (count, 3)).astype(np.float32)),
        opacities=torch.full((count,), opacity),
    )


def test_tiles_that_close_long_before_their_list_ends():
    camera = camera_ahead(37, 21)
    gaussians = crowd(1500, opacity=0.999)
    assert float(rasterize(posed(gaussians), camera).alpha.min()) > 0.97
    # What lies behind a splat is known to a few 1e-7 of the pixel, and transmittance falls to 1e-4:
    # the last splats of a pixel, whose gradients are that small, keep two or three digits of them.
    found = assert_gradients_match(posed(gaussians), camera, tolerance=1e-4, max_flips=8)
    hidden = ~np.abs(found[0]["sh"]).reshape(1500, -1).any(1)
    assert hidden.sum() > 300  # what closed tiles hide gets exactly nothing


def degenerate() -> dict[str, Gaussians]:
    """Gaussians at the edges of what can be drawn, by name; sixty of each."""
    base = random_gaussians(60, seed=7, sh_degree=2, size=0.4)
    ahead = torch.cat([base.means[:, :1].abs() + 2, base.means[:, 1:] * 0.5], 1)
    base = dataclasses.replace(base, means=ahead)
    ones = torch.ones(60)

    def but(**changes):
        return dataclasses.replace(base, **changes)

    dark = base.sh.clone()
    dark[:30, 0] = -4.0  # all channels below 0 in every direction
    dark[30:, 0, 1] = -4.0
    side = torch.where(torch.arange(60) % 2 == 0, 1.1, -1.1)  # tangent; the image ends at 0.62
    outside = torch.stack([ahead[:, 0], side * ahead[:, 0], 1.2 * side.roll(1) * ahead[:, 0]], 1)
    near = torch.cat([torch.linspace(0.011, 0.3, 60)[:, None], 0.02 * base.means[:, 1:]], 1)
    return {
        "needles": but(scales=base.scales * torch.tensor([1.0, 1e-6, 1e-6])),
        "needles in depth": but(scales=base.scales * torch.tensor([1e-6, 1e-6, 3.0])),
        "flat": but(scales=base.scales * torch.tensor([1.0, 1.0, 1e-7])),
        "huge": but(scales=base.scales * 200, opacities=0.1 * ones),
        "specks": but(scales=base.scales * 1e-5),
        "opaque": but(opacities=ones),
        "faintest": but(opacities=ones * ALPHA_MIN),
        "just drawn": but(opacities=ones * ALPHA_MIN * 1.02),
        "invisible": but(opacities=ones * 0),
        "dark": but(sh=dark),
        "outside": but(means=outside, scales=base.scales * 8 + 1, opacities=0.8 * ones),
        "near": but(means=near, scales=base.scales * 0.01),
    }


@pytest.mark.parametrize(
    ("kind", "antialiased"),
    [
        *(("needles", False), ("huge", False), ("near", False), ("specks", True)),
        *(
            pytest.param(kind, kind == "needles", marks=pytest.mark.long)
            for kind in degenerate()
            if kind not in ("huge", "near")
        ),
    ],
)
def test_degenerate_gaussians(kind, antialiased):
    camera = camera_ahead(37, 21)
    settings = RasterSettings(antialiased=antialiased)
    parts = posed(degenerate()[kind])
    assert_gradients_match(parts, camera, settings, buffers={RGB, ALPHA}, max_flips=2)
    found = assert_gradients_match(parts, camera, settings, tolerance=HARDLY_COVERED, max_flips=2)
    thinned = antialiased and kind in ("needles", "needles in depth", "specks", "just drawn")
    hidden = thinned or kind in ("faintest", "invisible")
    shown = int((found[0]["opacities"] != 0).sum())
    assert shown == 0 if hidden else shown >= (10 if kind == "just drawn" else 30)


def test_alphas_that_are_clamped_do_not_move():
    """One splat wide enough that every pixel is clamped: only its colour has a gradient."""
    camera = camera_ahead(17, 9)
    wall = one_gaussian(scale=(1.0, 300.0, 300.0), opacity=0.9999)
    settings = RasterSettings(alpha_max=0.5)
    found = gradients(posed(wall), camera, weighting(camera, {RGB, ALPHA}), settings)[0]
    assert found["sh"].any()
    assert not any(found[name].any() for name in ("quats", "scales", "opacities", "means"))
    assert_gradients_match(posed(random_gaussians(100, size=0.5)), camera, settings, max_flips=1)


def test_equal_depths_keep_the_order_of_their_index():
    """Forty splats at one z, alternately of two colours, in two parts."""
    rng = np.random.default_rng(3)
    spread = torch.from_numpy(rng.uniform(-0.3, 0.3, (40, 2)).astype(np.float32))
    base = crowd(40, opacity=0.6)
    colors = np.tile([[0.9, 0.1, 0.2], [0.1, 0.8, 0.7]], (20, 1))
    flat = dataclasses.replace(
        base, means=torch.cat([torch.full((40, 1), 4.0), spread], 1), sh=sh_of(colors)
    )
    parts = [PosedGaussians(flat), PosedGaussians(flat, None, 1)]
    found = assert_gradients_match(parts, camera_ahead(25, 17))
    front, back = (np.linalg.norm(g["sh"]) for g in found)
    assert front > 3 * back  # the same splats, but the second part's stand behind


# ---- as a torch operation --------------------------------------------------------------------


def test_recording_gradients_changes_no_bit_of_the_image():
    parts = [
        PosedGaussians(random_gaussians(400)),
        PosedGaussians(crowd(3000, opacity=0.9), slight_pose(), 1),
    ]
    camera = camera_ahead(61, 43, 50.0)
    plain = rasterize(parts, camera, buffers=DIFFERENTIABLE, backend="cpu")
    tracked = rasterize(leaves(parts), camera, buffers=DIFFERENTIABLE, backend="cpu")
    for name in DIFFERENTIABLE:
        assert getattr(tracked, name).requires_grad
        assert torch.equal(getattr(tracked, name).detach(), getattr(plain, name)), name


def test_same_bits_for_any_number_of_threads_and_every_time():
    parts = [
        PosedGaussians(random_gaussians(3000, size=0.1)),
        PosedGaussians(crowd(2500, opacity=0.8), slight_pose(), 1),
    ]
    camera = camera_ahead(97, 65, 80.0)
    weights = weighting(camera)
    runs = []
    for threads in (1, 2, 2, 1):
        limit_threads(threads)
        runs.append(gradients(parts, camera, weights))
    for run in runs[1:]:
        for actual, expected in zip(run, runs[0], strict=True):
            for name in FIELDS:
                assert np.array_equal(actual[name], expected[name]), name


LIGHT = SplatShading(torch.ones(60, 3), (0.0, 0.0, 1.0), 0.5)


@pytest.mark.parametrize(
    ("part", "arguments", "what"),
    [
        ({}, {"fog": Fog(0.05, (0.5, 0.6, 0.7))}, "gradients through fog"),
        ({}, {"buffers": [RGB, "median_depth", "splat_ids"]}, "of median_depth, splat_ids are"),
        ({}, {"clip": HeightClip(0.0, "above")}, "gradients of a clip"),
        ({}, {"camera": TOP}, "gradients of an orthographic camera"),
        ({"shading": LIGHT}, {"buffers": [RGB, ALPHA, OVERLAY]}, "light per pixel"),
        ({"color_maps": torch.eye(3, 4)[None] * 0.9}, {}, "gradients through colour maps"),
    ],
    ids=["fog", "median depth and splat ids", "clip", "orthographic", "light", "colour maps"],
)
def test_what_the_kernels_have_no_gradients_of(part, arguments, what):
    """Naming the backend raises; auto takes the definition, to the bit."""
    parts = [PosedGaussians(random_gaussians(60), **part)]
    arguments = {"camera": camera_ahead(17, 9), **arguments}
    with pytest.raises(ValueError, match=re.escape(what)):
        rasterize(leaves(parts), backend="cpu", **arguments)
    found = []
    for backend in ("auto", "reference"):
        tracked = leaves(parts)
        out = rasterize(tracked, backend=backend, **arguments)
        total = out.rgb.square().sum()
        if out.median_depth is not None:
            total = total + out.median_depth.sum()
        total.backward()
        found.append([getattr(tracked[0].gaussians, name).grad for name in FIELDS])
    for actual, expected in zip(*found, strict=True):
        assert actual.any() and torch.equal(actual, expected)
    with torch.no_grad():  # nothing is recorded, so nothing stands in the way
        rasterize(leaves(parts), backend="cpu", **arguments)


# ---- through the rest of the picture ---------------------------------------------------------


def sky() -> CubemapSky:
    return CubemapSky(torch.rand(6, 8, 8, 3, generator=torch.Generator().manual_seed(1)))


def test_gradients_through_sky_and_colour_map():
    """The fast paths of both know no gradients, and must not be taken where they are recorded."""
    camera = camera_ahead(33, 21)
    weights = weighting(camera, {RGB})[RGB]
    color_map = torch.eye(3, 4) + 0.05
    found = []
    for backend in ("cpu", "reference"):
        dtype = torch.float32 if backend == "cpu" else torch.float64
        tracked = leaves(posed(random_gaussians(150, seed=2)), dtype)
        out = rasterize(tracked, camera, backend=backend)
        rgb = apply_color_map(composite_sky(out.rgb, out.alpha, camera, sky()), color_map)
        (rgb * weights).sum().backward()
        found.append({n: getattr(tracked[0].gaussians, n).grad.double() for n in FIELDS})
    for name in FIELDS:
        difference = (found[0][name] - found[1][name]).norm() / found[1][name].norm()
        assert float(difference) < 1e-4, name  # as in assert_gradients_match: a flip is smaller
