"""Mode depth: its clusters against a plain account of them, kernels against the definition."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.render.buffers import BUFFERS, MODE_DEPTH
from augment.render.constants import RasterSettings
from augment.render.layout import UNCUT
from augment.render.mode_depth import GAMMA, HIGH, LOW, Clusters
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians
from tests.assertions import assert_images_close
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, smooth_gaussians, stack

BACKENDS = ("cpu", pytest.param("reference", marks=pytest.mark.long))
MODE = frozenset({MODE_DEPTH})
# Each set of buffers takes a kernel of its own, which is compiled for seconds: where a test is
# content with any set, it takes one of which other tests have the kernel anyway.
ALL = frozenset(BUFFERS)
DEFAULT = RasterSettings()


def render(scene, camera, backend="cpu", *, clip=None, settings=DEFAULT, buffers=MODE):
    parts = [PosedGaussians(scene)] if isinstance(scene, Gaussians) else scene
    return rasterize(parts, camera, buffers=buffers, clip=clip, settings=settings, backend=backend)


def in_float64(gaussians: Gaussians) -> Gaussians:
    names = ("means", "quats", "scales", "opacities", "sh")
    return Gaussians(**{n: getattr(gaussians, n).double() for n in names})


def open_scene(count=500, seed=0, *, nearest=2.0) -> Gaussians:
    """Random Gaussians with nothing close to the eye, which would hide all others."""
    scene = random_gaussians(4 * count, seed=seed, sh_degree=0)
    return scene.select((scene.means[:, 0] > nearest).nonzero()[:count, 0])


def modes_of(depths, weights, floor_m=0.2) -> np.ndarray:
    """float64 [rays] of samples [rays, samples], by the definition's own code."""
    depths, weights = (torch.as_tensor(a, dtype=torch.float64) for a in (depths, weights))
    clusters = Clusters.empty(len(depths), torch.float64)
    for z, w in zip(depths.T, weights.T, strict=True):
        clusters = clusters.add(z, w, floor_m)
    return clusters.heaviest_mode().numpy()


# ---- the clusters ------------------------------------------------------------------------------


def gumbel(x: float, mu: float, beta: float) -> float:
    u = (x - mu) / beta
    return math.exp(-(u + math.exp(-u))) / beta if u > -20 else 0.0


def plain_mode(samples: list[tuple[float, float]], floor: float) -> float:
    """Lists of samples, their moments by numpy, and the density itself."""
    clusters: list[list[tuple[float, float]]] = []
    for z, w in samples:
        if w == 0:
            continue
        if clusters:
            mean, sigma = moments(clusters[-1])
            beta = max(floor, math.sqrt(6) * sigma / math.pi)
            mu = mean - 0.57721566 * beta
            if gumbel(z, mu, beta) >= 0.5 * gumbel(mu, mu, beta):
                clusters[-1].append((z, w))
                continue
        clusters.append([(z, w)])
    if not clusters:
        return 0.0
    masses = [sum(w for _, w in cluster) for cluster in clusters]
    mean, sigma = moments(clusters[int(np.argmax(masses))])
    return mean - 0.57721566 * math.sqrt(6) * sigma / math.pi


def moments(samples: list[tuple[float, float]]) -> tuple[float, float]:
    z, w = np.array(samples).T
    mean = np.average(z, weights=w)
    return float(mean), float(np.sqrt(np.average((z - mean) ** 2, weights=w)))


def random_rays(rays=400, count=25, seed=0) -> tuple[np.ndarray, np.ndarray]:
    """Depths in two or three lumps and between, not quite in order; weights, some of them 0."""
    rng = np.random.default_rng(seed)
    lumps = np.sort(rng.uniform(2, 40, (rays, 3)), 1)
    chosen = np.sort(rng.integers(0, 3, (rays, count)), 1)
    depths = np.take_along_axis(lumps, chosen, 1) + rng.normal(0, 0.3, (rays, count))
    alphas = rng.beta(0.6, 1.5, (rays, count)) * (rng.random((rays, count)) > 0.2)
    before = np.cumprod(np.c_[np.ones(rays), 1 - alphas], 1)[:, :-1]
    return depths, alphas * before


@pytest.mark.parametrize(("bound", "start"), [(LOW, -1.0), (HIGH, 1.0)])
def test_the_bounds_are_where_the_density_is_half_its_peak(bound, start):
    u = start
    for _ in range(50):  # Newton
        u -= (u + math.exp(-u) - 1 - math.log(2)) / (1 - math.exp(-u))
    assert bound == pytest.approx(u, abs=1e-15)
    assert gumbel(bound, 0, 1) / gumbel(0, 0, 1) == pytest.approx(0.5, abs=1e-14)


def test_gamma_is_the_mean_of_the_distribution():
    x = np.linspace(-6, 40, 400_001)
    density = np.exp(-(x + np.exp(-x)))
    assert np.sum(x * density) * (x[1] - x[0]) == pytest.approx(GAMMA, abs=1e-9)
    variance = np.sum((x - GAMMA) ** 2 * density) * (x[1] - x[0])
    assert variance == pytest.approx(math.pi**2 / 6, abs=1e-9)


@pytest.mark.parametrize(("seed", "floor_m"), [(0, 0.02), (1, 0.2)])
def test_clusters_are_those_of_a_plain_account(seed, floor_m):
    depths, weights = random_rays(seed=seed)
    expected = [
        plain_mode(list(zip(z, w, strict=True)), floor_m)
        for z, w in zip(depths, weights, strict=True)
    ]
    # The same in another order of operations; none of these samples lies within 1e-9 of a bound.
    np.testing.assert_allclose(modes_of(depths, weights, floor_m), expected, rtol=1e-7)


def test_the_last_cluster_counts_and_the_first_of_equals_wins():
    assert modes_of([[2.0, 9.0]], [[0.25, 0.5]])[0] == 9
    assert modes_of([[2.0, 5.0, 9.0]], [[0.25, 0.5, 0.25]])[0] == 5
    assert modes_of([[2.0, 9.0]], [[0.25, 0.25]])[0] == 2


def test_moving_and_scaling_depths():
    depths, weights = random_rays()
    modes = modes_of(depths, weights, 0.2)
    np.testing.assert_allclose(modes_of(depths + 31, weights, 0.2), modes + 31, rtol=1e-9)
    np.testing.assert_allclose(modes_of(depths * 100, weights, 20.0), modes * 100, rtol=1e-9)
    np.testing.assert_allclose(modes_of(depths, weights * 0.3, 0.2), modes, rtol=1e-9)


def test_a_mode_lies_at_its_cluster():
    """Two depths joined: before their mean, and before the nearer by 5 % of the gap at most."""
    shares = np.linspace(0.001, 0.999, 999)
    ahead = modes_of(np.tile([5.0, 5.1], (999, 1)), np.c_[shares, 1 - shares]) - 5.0
    assert ahead.min() > -0.0052 and (ahead < 0.1 * (1 - shares)).all()


# ---- images ------------------------------------------------------------------------------------


@pytest.mark.parametrize("clip", [None, UNCUT], ids=["centres", "surfaces"])
@pytest.mark.parametrize("parallel", [False, True], ids=["pinhole", "orthographic"])
def test_kernels_match_the_definition(parallel, clip):
    camera = camera_ahead(97, 61, 20.0 if parallel else 80.0)
    camera = dataclasses.replace(camera, is_orthographic=parallel)
    scene = open_scene()
    actual = render(scene, camera, clip=clip).mode_depth
    expected = render(in_float64(scene), camera, "reference", clip=clip).mode_depth
    assert int((expected > 2).sum()) > 3000 and float(expected.max()) > 6
    # A sample at a cluster's border, or two clusters of one weight, may go the other way, for as
    # long as the border of a splat is: a few pixels of 5917.
    assert_images_close(actual, expected, p999=2e-4, flip=5e-3, max_flips=8)


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_opaque_splat_is_where_it_is(backend):
    image = render(one_gaussian((6.5, 0, 0), 0.8, 0.99), camera_ahead(), backend)
    hit = image.mode_depth > 0
    assert int(hit.sum()) > 50 and not bool(hit.all())
    torch.testing.assert_close(image.mode_depth[hit], torch.full((int(hit.sum()),), 6.5))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("opacity", "seen"), [(0.3, 8.0), (0.7, 3.0)])
def test_a_fence_before_a_wall(opacity, seen, backend):
    """What weighs most is seen, nothing in between; expected depth lies between."""
    scene = stack(
        one_gaussian((3.0, 0, 0), 20.0, opacity), *[one_gaussian((8.0, 0, 0), 20.0, 0.9)] * 3
    )
    image = render(scene, camera_ahead(), backend, buffers=ALL)
    middle = image.mode_depth[8:13, 12:20]
    torch.testing.assert_close(middle, torch.full_like(middle, seen))
    expected = image.expected_depth[8:13, 12:20]
    assert bool(((expected > 4) & (expected < 7)).all())


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_floor_decides_what_is_one_surface(backend):
    layers = [one_gaussian((x, 0, 0), 20.0, 0.3) for x in (5.0, 5.1, 5.2, 5.3, 5.4)]
    modes = []
    for floor_m in (0.01, 1.0):
        settings = RasterSettings(mode_depth_floor_m=floor_m)
        image = render(stack(*layers), camera_ahead(), backend, settings=settings)
        modes.append(float(image.mode_depth[10, 16]))
    assert modes[0] == pytest.approx(5.0, abs=1e-3) and 5.05 < modes[1] < 5.15


def test_another_unit_of_length_scales_the_image(scale=100.0):
    scene, camera = open_scene(), camera_ahead(97, 61, 80.0)
    other = dataclasses.replace(scene, means=scene.means * scale, scales=scene.scales * scale)
    settings = RasterSettings(near_m=0.01 * scale, mode_depth_floor_m=0.2 * scale)
    modes = render(other, camera, settings=settings).mode_depth / scale
    assert_images_close(modes, render(scene, camera).mode_depth, p999=2e-4, max_flips=8)


# ---- gradients ---------------------------------------------------------------------------------


def test_gradients_are_those_of_differences():
    """Splats far from every cut-off; the floor makes two clusters of them, or one."""
    scene, camera = smooth_gaussians(4), camera_ahead(7, 5, 9.0)
    inputs = [t.clone().requires_grad_() for t in (scene.means, scene.opacities, scene.scales)]
    for floor_m in (0.3, 5.0):
        settings = RasterSettings(mode_depth_floor_m=floor_m)

        def mode(means, opacities, scales, settings=settings):
            moved = dataclasses.replace(scene, means=means, opacities=opacities, scales=scales)
            return render(moved, camera, "reference", settings=settings).mode_depth

        assert torch.autograd.gradcheck(mode, inputs, eps=1e-6, atol=1e-5)
