"""Orthographic cameras: parallel rays, pixels per metre, and surfaces seen from above."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.geometry import quat_from_rotmat, rigid, rotmat_from_quat
from augment.render.buffers import ALPHA, BUFFERS, RGB
from augment.render.composite import composite_sky
from augment.render.constants import COV2D_BLUR, RasterSettings
from augment.render.cpu import backward as cpu_backward
from augment.render.cpu.driver import Scratch, gather_inputs
from augment.render.fog import Fog
from augment.render.layout import UNCUT, HeightClip
from augment.render.rasterize import rasterize
from augment.render.reference import project_parts
from augment.scene import Gaussians, PosedGaussians
from augment.sky import ConstantSky, CubemapSky
from tests.assertions import assert_images_close
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, random_pose, sh_of

BACKENDS = ("cpu", pytest.param("reference", marks=pytest.mark.long))
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


def in_float64(gaussians: Gaussians) -> Gaussians:
    names = ("means", "quats", "scales", "opacities", "sh")
    return Gaussians(**{n: getattr(gaussians, n).double() for n in names})


def render(scene, camera, backend="cpu", clip=None, buffers=frozenset(BUFFERS)):
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
        image = render(scene, camera, backend, buffers=EXACT)
        assert_images_close(image.alpha, alpha, p999=1e-5, max_flips=1)


@pytest.mark.parametrize("clip", [None, UNCUT, HeightClip(0.3, "above"), HeightClip(0.3, "below")])
def test_kernels_match_the_definition(clip):
    scene, camera = random_gaussians(400), map_camera()
    actual = render(scene, camera, "cpu", clip)
    expected = render(in_float64(scene), camera, "reference", clip)
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
def test_it_is_the_limit_of_a_long_lens_far_away(backend):
    """Ten times as far through a lens ten times as long: ten times nearer to parallel rays."""
    camera = map_camera()
    scene = in_float64(random_gaussians(300)) if backend == "reference" else random_gaussians(300)
    expected = render(scene, camera, backend)
    errors = []
    # float32 knows positions 3 km away to 0.2 mm, and float64 those at 100 km.
    for far_m in (1e4, 1e5) if backend == "reference" else (300.0, 3000.0):
        pose = camera.camera_from_world.clone()
        pose[2, 3] += far_m - 9.0  # 9 m is where the scene stands
        lens = dataclasses.replace(
            camera,
            fx=camera.fx * far_m,
            fy=camera.fy * far_m,
            camera_from_world=pose,
            is_orthographic=False,
        )
        actual = render(scene, lens, backend)
        errors.append(float((actual.rgb - expected.rgb).abs().flatten().quantile(0.98)))
        seen = (actual.alpha > 0.05) & (expected.alpha > 0.05)
        depth = actual.expected_depth - (far_m - 9.0)
        error = (depth - expected.expected_depth).abs()[seen]
        assert int(seen.sum()) > 400 and float(error.median()) < 10 / far_m
    # Some metres of scene over the (first) distance is the error's relative size.
    assert errors[0] < 300 / far_m and errors[1] < 0.2 * errors[0]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("slope", [0.3, 2.0])
def test_a_tilted_discs_surface_is_its_plane(slope, backend):
    scene, normal = disc(slope)
    camera = down(60, 60, 20.0)
    image = render(scene, camera, backend, UNCUT)
    y, x = np.mgrid[:60, :60] + 0.5
    x, y = (x - 30) / 20, -(y - 30) / 20
    plane = 20.0 + (normal[0] * x + normal[1] * y) / normal[2]
    # The image's covariance is sharpened by no more than 0.003 px^2, a 1/4000 of the slope here; a
    # splat's surface ends where the splat does, and its blur of half a pixel reaches beyond.
    seen = image.alpha.numpy() > 0.05
    assert seen.sum() > 150
    assert np.abs(image.expected_depth.numpy() - plane)[seen].max() < 1e-3
    if slope:
        plain = render(scene, camera, backend).expected_depth.numpy()
        assert np.abs(plain - plane)[seen].max() > 0.1 * slope


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_tilted_view_is_cut_at_the_height(backend):
    """A wall of discs seen obliquely: the kept part ends where the height does, to a pixel."""
    grid = np.mgrid[-2:2.01:0.2, -2:2.01:0.2].reshape(2, -1).T
    scene = Gaussians(
        means=torch.from_numpy(np.c_[np.full(len(grid), 5.0), grid]).float(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(len(grid), 1),
        scales=torch.tensor([[0.002, 0.2, 0.2]]).repeat(len(grid), 1),
        opacities=torch.full((len(grid),), 0.99),
        sh=sh_of(np.full((len(grid), 3), 0.6)),
    )
    camera = dataclasses.replace(camera_ahead(40, 60, 15.0), is_orthographic=True)
    above = render(scene, camera, backend, HeightClip(0.35, "above"))
    rows = torch.arange(60) + 0.5
    edge = camera.cy - camera.fy * 0.35
    inside = (rows > camera.cy - camera.fy * 1.7) & (rows < camera.cy + camera.fy * 1.7)
    assert float(above.alpha[inside & (rows < edge - 1.5), 10:30].min()) > 0.98
    assert float(above.alpha[rows > edge + 1.5].max()) < 1e-3


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
