"""Cuts at a height, parallel rays and the depth of a mode, by kernels and by geometry."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.effects.flood.water_plane import mirrored_camera
from augment.geometry import quat_from_rotmat, rigid, rotmat_from_quat
from augment.render.buffers import ALPHA, BUFFERS, MODE_DEPTH, RGB
from augment.render.composite import composite_sky
from augment.render.constants import COV2D_BLUR, RasterSettings
from augment.render.cpu import backward as cpu_backward
from augment.render.cpu.driver import Scratch, gather_inputs
from augment.render.fog import Fog
from augment.render.layout import UNCUT, HeightClip
from augment.render.mode_depth import GAMMA, HIGH, LOW, Clusters
from augment.render.rasterize import rasterize
from augment.render.reference import project_parts
from augment.scene import Gaussians, PosedGaussians
from augment.sky import ConstantSky, CubemapSky
from tests.assertions import assert_images_close
from tests.scenes import (
    camera_ahead,
    in_float64,
    one_gaussian,
    parts_in_float64,
    random_gaussians,
    random_pose,
    sh_of,
    smooth_gaussians,
    stack,
)

ALL = frozenset(BUFFERS)
BACKENDS = ("cpu", pytest.param("reference", marks=pytest.mark.long))


def render(parts, camera, clip=None, backend="cpu", buffers=ALL):
    parts = [PosedGaussians(parts)] if isinstance(parts, Gaussians) else parts
    return rasterize(parts, camera, buffers=buffers, clip=clip, backend=backend)


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
def test_kernels_cut_as_the_definition_does(seed, z_m, keep):
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
    double = parts_in_float64(parts)
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


EXACT = frozenset({RGB, ALPHA})


def map_camera(width=61, height=43, px_per_m=8.0, *, forward=(0.2, -0.1, -1.0)) -> Camera:
    """Looks down on `random_gaussians`, not quite along an axis of the world."""
    ahead = torch.tensor(forward, dtype=torch.float64)
    ahead = ahead / ahead.norm()
    right = torch.linalg.cross(ahead, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
    eye = torch.tensor([4.0, 0.0, 9.0], dtype=torch.float64) - 1.0 * ahead
    return Camera(
        "map",
        width,
        height,
        px_per_m,
        1.05 * px_per_m,  # not square, so that swapped axes show
        0.45 * width,
        0.55 * height,
        rigid(rotation, -rotation @ eye),
        is_orthographic=True,
    )


def down(width: int, height: int, px_per_m: float, eye_z_m=20.0) -> Camera:
    """Straight down on the origin: image right is world +x, image down is world -y."""
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    eye = torch.tensor([0.0, 0.0, eye_z_m], dtype=torch.float64)
    return Camera(
        "down",
        width,
        height,
        px_per_m,
        px_per_m,
        width / 2,
        height / 2,
        rigid(rotation, -rotation @ eye),
        is_orthographic=True,
    )


def render_orthographic(scene, camera, backend="cpu", clip=None, buffers=frozenset(BUFFERS)):
    parts = [PosedGaussians(scene)] if isinstance(scene, Gaussians) else scene
    return rasterize(parts, camera, buffers=buffers, clip=clip, backend=backend)


def disc(slope: float, sigma=0.3, heading=0.4) -> tuple[Gaussians, np.ndarray]:
    """An opaque disc of no thickness about the origin, tilted, and its unit normal."""
    axis = torch.tensor([math.cos(heading), math.sin(heading), 0.0], dtype=torch.float64)
    half = 0.5 * math.atan(slope)
    quat = torch.cat([torch.tensor([math.cos(half)]).double(), math.sin(half) * axis])
    gaussians = Gaussians(
        means=torch.zeros(1, 3),
        quats=quat.float()[None],
        scales=torch.tensor([[sigma, sigma, 1e-5]]),
        opacities=torch.tensor([0.99]),
        sh=sh_of([[0.5, 0.5, 0.5]]),
    )
    return gaussians, rotmat_from_quat(quat)[:, 2].numpy()


def test_a_camera_says_what_it_has_not():
    camera = map_camera()
    for ask in (camera.ray_directions, camera.ray_lengths, lambda: camera.K):
        with pytest.raises(ValueError, match="camera 'map' is orthographic"):
            ask()
    with pytest.raises(ValueError, match=r"fx must be finite and > 0 \(pixels per metre\)"):
        dataclasses.replace(camera, fx=0.0)


def test_the_image_covariance_is_the_worlds():
    scene, camera = random_gaussians(200, dtype=torch.float64), map_camera()
    splats = project_parts([PosedGaussians(scene)], camera, RasterSettings())
    chosen = scene.select(splats.ids)
    axes = rotmat_from_quat(chosen.quats) * chosen.scales[:, None, :]
    world = axes @ axes.mT
    to_px = torch.diag(torch.tensor([camera.fx, camera.fy], dtype=torch.float64))
    to_px = to_px @ camera.camera_from_world[:2, :3]
    exact = to_px @ world @ to_px.T + COV2D_BLUR * torch.eye(2).double()
    expected = torch.stack([exact[:, 0, 0], exact[:, 0, 1], exact[:, 1, 1]], -1)
    # float64 arithmetic in another order.
    torch.testing.assert_close(splats.covs2d, expected, rtol=1e-12, atol=1e-12)
    offset = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    offset = offset + to_px[:, :3] @ -camera.centre
    torch.testing.assert_close(splats.means2d, chosen.means @ to_px.T + offset)


def test_one_gaussian_is_its_density():
    """Alpha of a tilted ellipsoid at every pixel, by its covariance in the world."""
    camera = down(31, 25, 10.0)
    rotation = random_pose(2)[:3, :3]
    scene = dataclasses.replace(
        one_gaussian((0.2, -0.1, 0.5), (0.4, 0.2, 0.1), 0.9),
        quats=quat_from_rotmat(rotation).float()[None],
    )
    cov = (rotation * torch.tensor([0.4, 0.2, 0.1]) ** 2) @ rotation.T
    cov = cov[:2, :2].numpy() * [[1, -1], [-1, 1]] * 100 + COV2D_BLUR * np.eye(2)
    y, x = np.mgrid[:25, :31] + 0.5
    d = np.stack([x - (15.5 + 2.0), y - (12.5 + 1.0)], -1)
    alpha = 0.9 * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(cov), d))
    alpha[alpha < 1 / 255] = 0
    for backend in ("cpu", "reference"):
        image = render_orthographic(scene, camera, backend, buffers=EXACT)
        assert_images_close(image.alpha, alpha, p999=1e-5, max_flips=1)


@pytest.mark.parametrize("clip", [None, UNCUT, HeightClip(0.3, "above"), HeightClip(0.3, "below")])
def test_kernels_see_along_parallel_rays_as_the_definition_does(clip):
    scene, camera = random_gaussians(400), map_camera()
    actual = render_orthographic(scene, camera, "cpu", clip)
    expected = render_orthographic(in_float64(scene), camera, "reference", clip)
    is_cut = clip is not None and clip is not UNCUT
    # A cut that runs nearly parallel to its splat moves by pixels with the last bit of float32.
    for name in (RGB, ALPHA):
        assert_images_close(
            getattr(actual, name),
            getattr(expected, name),
            p999=2e-3 if is_cut else 1e-5,
            max_flips=8 if is_cut else 2,
        )
    assert int((expected.alpha > 0.1).sum()) > 400
    error = (actual.expected_depth - expected.expected_depth).abs()
    assert float(error.flatten().quantile(0.98)) < 2e-4


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("slope", [0.3, 2.0])
def test_a_tilted_discs_surface_is_its_plane(slope, backend):
    scene, normal = disc(slope)
    camera = down(60, 60, 20.0)
    image = render_orthographic(scene, camera, backend, UNCUT)
    y, x = np.mgrid[:60, :60] + 0.5
    x, y = (x - 30) / 20, -(y - 30) / 20
    plane = 20.0 + (normal[0] * x + normal[1] * y) / normal[2]
    # The image's covariance is sharpened by no more than 0.003 px^2, a 1/4000 of the slope here; a
    # splat's surface ends where the splat does, and its blur of half a pixel reaches beyond.
    seen = image.alpha.numpy() > 0.05
    assert seen.sum() > 150
    assert np.abs(image.expected_depth.numpy() - plane)[seen].max() < 1e-3
    if slope:
        plain = render_orthographic(scene, camera, backend).expected_depth.numpy()
        assert np.abs(plain - plane)[seen].max() > 0.1 * slope


def test_smog_and_skies_are_refused():
    camera, scene = map_camera(), one_gaussian()
    with pytest.raises(ValueError, match="orthographic: there is no eye"):
        rasterize([PosedGaussians(scene)], camera, fog=Fog(0.1, (1.0, 1.0, 1.0)))
    rgb, alpha = torch.zeros(43, 61, 3), torch.zeros(43, 61)
    for backend in ("cpu", "cuda", "reference"):
        with pytest.raises(ValueError, match="see the sky in one"):
            composite_sky(rgb, alpha, camera, CubemapSky(torch.zeros(6, 2, 2, 3)), backend=backend)
    grey = composite_sky(rgb, alpha, camera, ConstantSky(torch.full((3,), 0.5)))
    assert bool((grey == 0.5).all())


def test_training_refuses_it():
    camera, parts = map_camera(), [PosedGaussians(one_gaussian())]
    inputs = gather_inputs(parts, camera, RasterSettings(), None, with_color=True)
    with pytest.raises(ValueError, match="gradients are of pinhole cameras only"):
        cpu_backward.record(inputs, camera, RasterSettings(), Scratch(), with_depth=False)


MODE = frozenset({MODE_DEPTH})
# Each set of buffers takes a kernel of its own, which is compiled for seconds: where a test is
# content with any set, it takes one of which other tests have the kernel anyway.
DEFAULT = RasterSettings()


def render_mode_depth(scene, camera, backend="cpu", *, clip=None, settings=DEFAULT, buffers=MODE):
    parts = [PosedGaussians(scene)] if isinstance(scene, Gaussians) else scene
    return rasterize(parts, camera, buffers=buffers, clip=clip, settings=settings, backend=backend)


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


# ---- images ------------------------------------------------------------------------------------


@pytest.mark.parametrize("clip", [None, UNCUT], ids=["centres", "surfaces"])
@pytest.mark.parametrize("parallel", [False, True], ids=["pinhole", "orthographic"])
def test_kernels_find_the_modes_of_the_definition(parallel, clip):
    camera = camera_ahead(97, 61, 20.0 if parallel else 80.0)
    camera = dataclasses.replace(camera, is_orthographic=parallel)
    scene = open_scene()
    actual = render_mode_depth(scene, camera, clip=clip).mode_depth
    expected = render_mode_depth(in_float64(scene), camera, "reference", clip=clip).mode_depth
    assert int((expected > 2).sum()) > 3000 and float(expected.max()) > 6
    # A sample at a cluster's border, or two clusters of one weight, may go the other way, for as
    # long as the border of a splat is: a few pixels of 5917.
    assert_images_close(actual, expected, p999=2e-4, flip=5e-3, max_flips=8)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("opacity", "seen"), [(0.3, 8.0), (0.7, 3.0)])
def test_a_fence_before_a_wall(opacity, seen, backend):
    """What weighs most is seen, nothing in between; expected depth lies between."""
    scene = stack(
        one_gaussian((3.0, 0, 0), 20.0, opacity), *[one_gaussian((8.0, 0, 0), 20.0, 0.9)] * 3
    )
    image = render_mode_depth(scene, camera_ahead(), backend, buffers=ALL)
    middle = image.mode_depth[8:13, 12:20]
    torch.testing.assert_close(middle, torch.full_like(middle, seen))
    expected = image.expected_depth[8:13, 12:20]
    assert bool(((expected > 4) & (expected < 7)).all())


# ---- gradients ---------------------------------------------------------------------------------


def test_gradients_are_those_of_differences():
    """Splats far from every cut-off, of which the floor makes two clusters."""
    scene, camera = smooth_gaussians(4), camera_ahead(7, 5, 9.0)
    inputs = [t.clone().requires_grad_() for t in (scene.means, scene.opacities, scene.scales)]
    settings = RasterSettings(mode_depth_floor_m=0.3)

    def mode(means, opacities, scales):
        moved = dataclasses.replace(scene, means=means, opacities=opacities, scales=scales)
        return render_mode_depth(moved, camera, "reference", settings=settings).mode_depth

    assert torch.autograd.gradcheck(mode, inputs, eps=1e-6, atol=1e-5)
