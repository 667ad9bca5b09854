"""Cuts, parallel rays, modes of depth; light per pixel, colour maps and overlays of parts."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.effects.flood.water_plane import mirrored_camera
from augment.render.buffers import ALPHA, BUFFERS, MODE_DEPTH, OVERLAY, RGB
from augment.render.composite import composite_sky
from augment.render.constants import COV2D_BLUR, RasterSettings
from augment.render.cpu import backward as cpu_backward
from augment.render.cpu.driver import Scratch, gather_inputs
from augment.render.fog import Fog
from augment.render.layout import SURFACE_DEPTHS_ONLY, HeightClip
from augment.render.mode_depth import GAMMA, HIGH, LOW, Clusters
from augment.render.rasterize import rasterize
from augment.render.reference import project_parts
from augment.scene.cameras import Camera
from augment.scene.geometry import quat_from_rotmat, rigid, rotmat_from_quat
from augment.scene.scene import Gaussians, PosedGaussians, SplatShading
from augment.scene.sky import ConstantSky, CubemapSky
from tests.assertions import assert_images_close
from tests.scenes import (
    camera_ahead,
    in_float64,
    one_gaussian,
    parts_in_float64,
    random_gaussians,
    random_pose,
    sh_of,
    slight_pose,
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
    behind = HeightClip(z_m, "below", has_overlap=True)
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
    below = render(gaussians, camera, HeightClip(-0.9, "below", has_overlap=True))
    both = above.rgb + (1 - above.alpha)[..., None] * below.rgb
    error = (both - plain.rgb).abs().amax(-1)
    # At the edge of the cut a splat's two sides are blended as two splats, which covers a little
    # more than it does as one: a few pixels show it, most where the ball is translucent.
    assert float(error.median()) < 1e-3 and float(error.max()) < 0.15
    assert float((error > 0.02).float().mean()) < 0.03


@pytest.mark.parametrize(("z_m", "keep"), [(math.nan, "above"), (math.inf, "below")])
def test_what_no_clip_can_be(z_m, keep):
    with pytest.raises(ValueError, match="kept_side of a clip"):
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


# ---- parallel rays -------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    "clip", [None, SURFACE_DEPTHS_ONLY, HeightClip(0.3, "above"), HeightClip(0.3, "below")]
)
def test_kernels_see_along_parallel_rays_as_the_definition_does(clip):
    scene, camera = random_gaussians(400), map_camera()
    actual = render_orthographic(scene, camera, "cpu", clip)
    expected = render_orthographic(in_float64(scene), camera, "reference", clip)
    is_cut = clip is not None and clip is not SURFACE_DEPTHS_ONLY
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
    image = render_orthographic(scene, camera, backend, SURFACE_DEPTHS_ONLY)
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
        cpu_backward.record_render(inputs, camera, RasterSettings(), Scratch(), with_depth=False)


# ---- modes of depth ------------------------------------------------------------------------------

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


@pytest.mark.parametrize("clip", [None, SURFACE_DEPTHS_ONLY], ids=["centres", "surfaces"])
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


# ---- light per pixel -----------------------------------------------------------------------------

C0 = 0.28209479177387814
SIZE = 48


def camera(**changes) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    numbers = {"fx": 60.0, "fy": 55.0, "cx": SIZE / 2, "cy": SIZE / 2}
    return Camera("test", SIZE, SIZE, camera_from_world=pose, **(numbers | changes))


def facing(normals: torch.Tensor) -> torch.Tensor:
    """Quaternions whose z axes are the normals."""
    helper = torch.where(normals[:, :1].abs() > 0.9, torch.tensor([[0.0, 1, 0]]),
                         torch.tensor([[1.0, 0, 0]]))  # fmt: skip
    x = torch.nn.functional.normalize(torch.linalg.cross(helper, normals), dim=1)
    return quat_from_rotmat(torch.stack([x, torch.linalg.cross(normals, x), normals], 2))


def lit_disc(normal=(0.0, 0.0, -1.0), at=(0.0, 0.0, 5.0), opacity=0.99, radius=0.5) -> Gaussians:
    n = torch.nn.functional.normalize(torch.tensor([normal]), dim=1)
    return Gaussians(
        means=torch.tensor([at]),
        quats=facing(n),
        scales=torch.tensor([[radius, radius, 0.01]]),
        opacities=torch.tensor([opacity]),
        sh=torch.full((1, 1, 3), (0.2 - 0.5) / C0),
    )


def some_parts(seed=0, count=300, shaded=True) -> list[PosedGaussians]:
    """A lit part among others, one of them posed."""
    rng = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=rng)  # noqa: E731

    def cloud(n: int) -> Gaussians:
        normals = torch.nn.functional.normalize(draw(n, 3) - 0.5, dim=1)
        return Gaussians(
            means=(draw(n, 3) - 0.5) * torch.tensor([4.0, 4.0, 3.0]) + torch.tensor([0, 0, 5.0]),
            quats=facing(normals),
            scales=0.03 + 0.2 * draw(n, 3),
            opacities=0.1 + 0.89 * draw(n),
            sh=0.3 * (draw(n, 4, 3) - 0.5),
        )

    turn = torch.eye(4, dtype=torch.float64)
    angle = 0.4
    turn[:2, :2] = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    sun = torch.nn.functional.normalize(torch.tensor([0.3, -0.8, -0.4]), dim=0)
    sun = tuple((sun / sun.norm()).double().tolist())
    parts = [PosedGaussians(cloud(count))]
    for pose, share in ((None, 0.4), (turn, 0.8)):
        light = SplatShading(draw(count, 3), sun, share)
        shading = light if shaded else None
        parts.append(PosedGaussians(cloud(count), pose, is_overlay=True, shading=shading))
    return parts


def shaded(gaussians: Gaussians, sun, wrap=0.0, slopes=(0.5, 0.5, 0.5)) -> PosedGaussians:
    sun = np.array(sun) / np.linalg.norm(sun)
    light = SplatShading(torch.tensor([slopes]), tuple(sun.tolist()), wrap)
    return PosedGaussians(gaussians, shading=light)


def render_lit(parts, view, **options):
    """With the buffers that pictures of snow ask for, whose kernel there is."""
    return rasterize(parts, view, buffers=(RGB, ALPHA, OVERLAY), **options)


@pytest.mark.parametrize(
    ("smog", "orthographic"), [(None, False), (Fog(0.2, (0.7, 0.6, 0.5)), False), (None, True)]
)
def test_the_kernel_shows_what_the_definition_says(smog, orthographic):
    view = camera(is_orthographic=True, fx=12.0, fy=11.0) if orthographic else camera()
    fast, slow = (
        render_lit(some_parts(), view, fog=smog, backend=name) for name in ("cpu", "reference")
    )
    difference = (fast.rgb - slow.rgb).abs()
    assert float(difference.quantile(0.999)) < 1e-4
    assert float(difference.max()) < 5e-3  # an alpha at its cut-off may fall on either side
    plain = render_lit(some_parts(shaded=False), view, fog=smog)
    assert float((fast.rgb - plain.rgb).abs().max()) > 0.1
    assert torch.equal(fast.alpha, plain.alpha)


def test_a_pixel_is_lit_by_the_papers_normal():
    """D, d', n and the wrapped light written out for every pixel of one splat, in float64."""
    view, sun, wrap = camera(), np.array([0.5, -0.6, -0.62]), 0.3
    sun /= np.linalg.norm(sun)
    gaussians = lit_disc(normal=(0.3, -0.7, -0.5), at=(0.4, -0.2, 4.0))
    image = rasterize([shaded(gaussians, sun, wrap)], view, backend="reference")
    plain = rasterize([PosedGaussians(gaussians)], view, backend="reference")
    added = (image.rgb - plain.rgb)[..., 0].numpy().astype(np.float64)
    weight = image.alpha.numpy().astype(np.float64)

    n2 = np.array([0.3, -0.7, -0.5]) / np.linalg.norm([0.3, -0.7, -0.5])
    n1 = np.array([0.0, 0.0, -1.0])
    x0, y0, z0 = 0.4, -0.2, 4.0
    mean = np.array([60 * x0 / z0 + 24, 55 * y0 / z0 + 24])
    axes = rotmat_from_quat(gaussians.quats)[0].numpy() * gaussians.scales.numpy()
    jacobian = np.array([[60 / z0, 0, -60 * x0 / z0**2], [0, 55 / z0, -55 * y0 / z0**2]])
    cov = jacobian @ axes @ axes.T @ jacobian.T + 0.3 * np.eye(2)
    cut = math.sqrt(2 * math.log(255 * 0.99))
    checked = 0
    for row in range(SIZE):
        for column in range(SIZE):
            if weight[row, column] < 0.01:
                continue
            p = np.array([column + 0.5, row + 0.5]) - mean
            big_d = math.sqrt(p @ np.linalg.solve(cov, p)) / cut
            d = np.array([p[0] * z0 / 60, p[1] * z0 / 55, 0.0])
            d = d - (d @ n2) / (n1 @ n2) * n1
            assert abs(d @ n2) < 1e-12
            n = big_d * d / np.linalg.norm(d) + math.sqrt(1 - min(big_d, 1) ** 2) * n2
            assert np.linalg.norm(n) == pytest.approx(1, abs=1e-6)
            share = min(max((n @ sun + wrap) / (1 + wrap), 0), 1)
            assert added[row, column] == pytest.approx(0.5 * share * weight[row, column], abs=2e-5)
            checked += 1
    assert checked > 100


def test_light_from_behind_adds_nothing_and_wrapping_lets_some_through():
    base = render_lit([PosedGaussians(lit_disc())], camera())
    dark = render_lit([shaded(lit_disc(), (0.0, 0.0, 1.0))], camera())
    assert torch.allclose(dark.rgb, base.rgb, atol=1e-6)
    wrapped = render_lit([shaded(lit_disc(), (1.0, 0.0, 0.3), wrap=0.6)], camera())
    assert float((wrapped.rgb - base.rgb).max()) > 0.05


def test_a_splat_seen_from_behind_is_lit_on_the_side_that_is_seen():
    front = render_lit([shaded(lit_disc((0.1, 0.2, -1.0)), (0.0, 0.0, -1.0))], camera())
    back = render_lit([shaded(lit_disc((-0.1, -0.2, 1.0)), (0.0, 0.0, -1.0))], camera())
    assert torch.allclose(front.rgb, back.rgb, atol=1e-5)


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, -1e-6)])
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_splats_seen_edge_on_stay_finite(normal, backend):
    part = shaded(lit_disc(normal), (0.6, -0.8, 0.0), wrap=0.2)
    image = render_lit([part], camera(), backend=backend)
    assert torch.isfinite(image.rgb).all()
    assert float(image.rgb.max()) <= 0.2 + 0.5 + 1e-5


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"slopes": torch.zeros(2, 3)}, r"slopes must be floats \[1, 3\]"),
        ({"sun": (0.0, 0.0, 0.5)}, "of length 1"),
        ({"sun": (math.nan, 0.0, 1.0)}, "of length 1"),
        ({"wrap": -0.1}, "wrap must be finite"),
    ],
)
def test_light_that_cannot_be_is_refused(change, says):
    part = shaded(lit_disc(), (0.0, 0.0, -1.0))
    part = dataclasses.replace(part, shading=dataclasses.replace(part.shading, **change))
    with pytest.raises(ValueError, match=says):
        rasterize([part], camera())


# ---- colour maps ---------------------------------------------------------------------------------

CLASSES = 5
SMOG = Fog(0.2, (0.7, 0.75, 0.8), None, 0.0)


def some_maps(count: int, seed: int = 0, spread: float = 0.3) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    return torch.eye(3, 4) + spread * (torch.rand(count, 3, 4, generator=rng) - 0.5)


def labelled(seed: int = 0, count: int = 300) -> Gaussians:
    rng = torch.Generator().manual_seed(seed)
    semantic = torch.randint(0, CLASSES, (count,), generator=rng, dtype=torch.int16)
    return dataclasses.replace(random_gaussians(count, seed=seed), semantic=semantic)


def folded(gaussians: Gaussians, maps: torch.Tensor) -> Gaussians:
    """The maps put into the spherical harmonics, one Gaussian at a time."""
    c0, sh = 0.28209479177387814, gaussians.sh.double().clone()
    for i in range(len(gaussians)):
        kind = 0 if gaussians.semantic is None else int(gaussians.semantic[i])
        matrix, offset = maps[kind, :, :3].double(), maps[kind, :, 3].double()
        mean = matrix @ (c0 * sh[i, 0] + 0.5) + offset
        sh[i] = sh[i] @ matrix.T
        sh[i, 0] = (mean - 0.5) / c0
    return dataclasses.replace(gaussians, sh=sh.float())


@pytest.mark.parametrize(("count", "smog"), [(1, SMOG), (CLASSES, None)])
def test_the_kernel_maps_as_the_definition_does(count, smog):
    parts = [
        PosedGaussians(labelled(1), color_maps=some_maps(count)),
        PosedGaussians(labelled(2), random_pose(), 1, color_maps=some_maps(count, 3)),
        PosedGaussians(random_gaussians(100, seed=4), color_maps=some_maps(count, 5)),
        PosedGaussians(random_gaussians(100, seed=6, sh_degree=1)),
    ]
    fast, slow = (
        rasterize(parts, camera_ahead(), fog=smog, backend=name) for name in ("cpu", "reference")
    )
    assert_images_close(fast.rgb, slow.rgb, max_flips=2)
    assert_images_close(fast.alpha, slow.alpha, max_flips=2)
    bare = rasterize([dataclasses.replace(p, color_maps=None) for p in parts], camera_ahead())
    assert (fast.rgb - bare.rgb).abs().max() > 0.02
    assert torch.equal(fast.alpha, bare.alpha)


@pytest.mark.parametrize("count", [1, CLASSES])
def test_where_nothing_is_clamped_a_map_is_one_on_the_coefficients(count):
    gaussians = labelled(7)
    dim = dataclasses.replace(gaussians, sh=gaussians.sh * 0.1)  # every colour near 0.5
    maps = some_maps(count, 8)
    once = dim if count > 1 else dataclasses.replace(dim, semantic=None)
    seen = rasterize([PosedGaussians(dim, color_maps=maps)], camera_ahead()).rgb
    assert_images_close(seen, rasterize([PosedGaussians(folded(once, maps))], camera_ahead()).rgb)


def test_the_identity_changes_no_bit():
    gaussians = labelled(9)
    bare = rasterize([PosedGaussians(gaussians)], camera_ahead()).rgb
    same = torch.eye(3, 4).repeat(CLASSES, 1, 1)
    for maps in (same[:1], same):
        assert torch.equal(
            rasterize([PosedGaussians(gaussians, color_maps=maps)], camera_ahead()).rgb, bare
        )


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_rows_come_before_classes(backend):
    gaussians = labelled(10)
    rows = torch.arange(len(gaussians), dtype=torch.int16) % CLASSES
    maps = some_maps(CLASSES, 11)
    chosen = PosedGaussians(gaussians, color_maps=maps, color_rows=rows)
    instead = PosedGaussians(dataclasses.replace(gaussians, semantic=rows), color_maps=maps)
    images = [rasterize([p], camera_ahead(), backend=backend).rgb for p in (chosen, instead)]
    assert torch.equal(*images)
    with pytest.raises(ValueError, match=r"color_rows must be int16 \[300\]"):
        rasterize([dataclasses.replace(chosen, color_rows=rows[1:])], camera_ahead())


@pytest.mark.parametrize(
    ("maps", "words"),
    [
        (torch.zeros(0, 3, 4), r"\[C, 3, 4\] with C >= 1; got \[0, 3, 4\]"),
        (torch.full((1, 3, 4), torch.nan), "finite"),
        (torch.zeros(1, 3, 4, dtype=torch.int32), "finite floats"),
    ],
)
def test_maps_that_are_none_are_refused(maps, words):
    part = PosedGaussians(random_gaussians(3))
    object.__setattr__(part, "color_maps", maps)  # past what the tests' type checks refuse
    with pytest.raises(ValueError, match=words):
        rasterize([part], camera_ahead())


# ---- overlays ------------------------------------------------------------------------------------

CAMERA = camera_ahead(97, 61, 80.0)


def crowd(*snowy: bool) -> list[PosedGaussians]:
    """Parts that stand among each other, not too near the eye."""
    scenes = [random_gaussians(900, seed=i, sh_degree=0) for i in range(len(snowy))]
    scenes = [s.select(s.means[:, 0] > 2) for s in scenes]
    pose = slight_pose()
    return [
        PosedGaussians(scene, pose if i else None, i, is_overlay=is_overlay)
        for i, (scene, is_overlay) in enumerate(zip(scenes, snowy, strict=True))
    ]


# Of what a picture of snow asks for: other sets of buffers would take kernels of their own, which
# are compiled for seconds.
def render_overlay(parts, backend="cpu", buffers=(RGB, ALPHA, OVERLAY), camera=CAMERA):
    return rasterize(parts, camera, buffers=buffers, backend=backend)


def test_kernels_match_the_definition():
    parts = crowd(False, True, False)
    names = ("means", "quats", "scales", "opacities", "sh")
    doubled = [
        dataclasses.replace(
            part, gaussians=Gaussians(**{n: getattr(part.gaussians, n).double() for n in names})
        )
        for part in parts
    ]
    actual, expected = render_overlay(parts), render_overlay(doubled, "reference")
    assert_images_close(actual.overlay, expected.overlay, p999=1e-5, max_flips=2)
    assert 0.2 < float(actual.overlay.mean()) < 0.8 * float(actual.alpha.mean())


@pytest.mark.parametrize("backend", BACKENDS)
def test_all_of_it_is_alpha_and_none_of_it_is_nothing(backend):
    image = render_overlay(crowd(True, True), backend)
    # One is a sum of weights, the other 1 - transmittance: forty roundings.
    torch.testing.assert_close(image.overlay, image.alpha, rtol=0, atol=1e-5)
    assert not render_overlay(crowd(False, False), backend).overlay.any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_hides_snow_counts_against_it(backend):
    snow = PosedGaussians(one_gaussian((6.0, 0, 0), 30.0, 0.9), is_overlay=True)
    glass = PosedGaussians(one_gaussian((3.0, 0, 0), 30.0, 0.75))
    middle = render_overlay([glass, snow], backend).overlay[20:40, 40:60]
    torch.testing.assert_close(middle, torch.full_like(middle, 0.25 * 0.9), rtol=0, atol=1e-4)
