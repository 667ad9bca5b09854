"""Gradients on the GPU: colours' by our own kernels, interpreted here; the others' by gsplat."""

from __future__ import annotations

import dataclasses
import math
import sys
import types

import numpy as np
import pytest
import torch

pytest.importorskip("triton")

from augment.errors import BackendUnavailable
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, MEDIAN_DEPTH, RGB
from augment.render.constants import RasterSettings
from augment.render.cuda import runtime as gpu
from augment.render.fog import Fog
from augment.render.gsplat_backend import render_with_gsplat
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians
from tests.augment import gsplat_stand_in
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, slight_pose, stack

DEFAULT = RasterSettings()
FIELDS = ("means", "quats", "scales", "opacities", "sh")


def tracked(part: PosedGaussians, *names: str, dtype=torch.float32) -> PosedGaussians:
    """The part with copies of its tensors, of which the named ones record gradients."""
    tensors = {name: getattr(part.gaussians, name).detach().to(dtype).clone() for name in FIELDS}
    for name in names:
        tensors[name].requires_grad_()
    return dataclasses.replace(part, gaussians=Gaussians(**tensors))


def weights_of(camera: Camera, channels: int = 3) -> torch.Tensor:
    rng = np.random.default_rng(camera.width)
    return torch.from_numpy(rng.normal(size=(camera.height, camera.width, channels))).float()


def sh_gradients(parts, camera, backend, settings=DEFAULT, buffers=(RGB,)) -> list[torch.Tensor]:
    """dL by sh of every part, of a random weighting of rgb."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = [tracked(part, "sh", dtype=dtype) for part in parts]
    out = rasterize(leaves, camera, buffers=buffers, settings=settings, backend=backend)
    (out.rgb * weights_of(camera).to(out.rgb.device)).sum().backward()
    return [part.gaussians.sh.grad for part in leaves]


def assert_close(actual, expected, tolerance: float) -> None:
    """Relative l2 error of all together; where nothing is expected, nothing is found."""
    for got, want in zip(actual, expected, strict=True):
        assert torch.isfinite(got).all() and got.shape == want.shape
        assert not got[want == 0].any()
    error = sum(float((a - b).square().sum()) for a, b in zip(actual, expected, strict=True))
    size = sum(float(b.double().square().sum()) for b in expected)
    assert math.sqrt(error) <= tolerance * math.sqrt(size), math.sqrt(error / max(size, 1e-30))


def small_scene(count: int = 90) -> list[PosedGaussians]:
    return [
        PosedGaussians(random_gaussians(count, seed=4)),
        PosedGaussians(Gaussians.empty(sh_degree=2), slight_pose(), 1),
        PosedGaussians(random_gaussians(count // 3, seed=5, sh_degree=1), slight_pose(), 2),
    ]


# ---- colours -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [
        DEFAULT,
        pytest.param(RasterSettings(antialiased=True, sh_degree=1), marks=pytest.mark.long),
        pytest.param(RasterSettings(transmittance_stop=0.1), marks=pytest.mark.long),
    ],
    ids=["default", "antialiased-degree-1", "coarse-stop"],
)
def test_colours_gradients_are_those_of_the_definition(settings):
    # float32 against float64: 1e-6 of sums of pixels, and 3e-6 of alpha by exp2.
    parts, camera = small_scene(30), camera_ahead(17, 9, 13.0)
    expected = sh_gradients(parts, camera, "reference", settings)
    assert_close(sh_gradients(parts, camera, "cuda", settings), expected, 2e-5)


def test_a_colour_held_by_its_clamp_has_no_gradient():
    dark = one_gaussian(rgb=(-0.2, 0.4, 0.9))
    (found,) = sh_gradients([PosedGaussians(dark)], camera_ahead(9, 9, 9.0), "cuda")
    assert found[0, 0, 0] == 0 and found[0, 0, 1:].all()


# ---- the transposed blend alone ----------------------------------------------------------------


@pytest.mark.gpu
def test_many_splats_on_a_real_gpu():
    parts = [PosedGaussians(random_gaussians(20000, size=0.1))]
    camera = camera_ahead(320, 180, 300.0)
    expected = sh_gradients(parts, camera, "cpu", buffers=(RGB, ALPHA))
    found = sh_gradients(parts, camera, "cuda")
    assert_close(found, expected, 1e-3)  # some splats flip at a threshold
    assert torch.equal(found[0], sh_gradients(parts, camera, "cuda")[0])


# ---- where tensors lie -------------------------------------------------------------------------


def test_all_stays_on_the_gpu(monkeypatch):
    parts, camera = small_scene(15), camera_ahead(9, 8, 9.0)
    expected = sh_gradients(parts, camera, "cuda")
    with pretended_gpu(monkeypatch):
        device = gpu.gpu_device()
        away = [
            dataclasses.replace(
                part,
                gaussians=Gaussians(
                    **{name: getattr(part.gaussians, name).to(device) for name in FIELDS}
                ),
            )
            for part in parts
        ]
        for part in away:
            part.gaussians.sh.requires_grad_()
        out = rasterize(away, camera, buffers=(RGB, ALPHA))
        assert isinstance(out.rgb, AwayTensor) and isinstance(out.alpha, AwayTensor)
        (out.rgb * weights_of(camera).to(device)).sum().backward()
        found = [part.gaussians.sh.grad for part in away]
        assert all(isinstance(grad, AwayTensor) for grad in found)
        assert all(torch.equal(a.cpu(), b) for a, b in zip(found, expected, strict=True))


# ---- geometry, by gsplat -----------------------------------------------------------------------


def all_gradients(parts, camera, backend, settings=DEFAULT):
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = [tracked(part, *FIELDS, dtype=dtype) for part in parts]
    names = (RGB, ALPHA, EXPECTED_DEPTH)
    out = rasterize(leaves, camera, buffers=names, settings=settings, backend=backend)
    weights = weights_of(camera, 5).to(out.rgb.device)
    (out.rgb * weights[..., :3]).sum().add(
        (out.alpha * weights[..., 3]).sum() + (out.expected_depth * weights[..., 4]).sum()
    ).backward()
    return {name: [getattr(part.gaussians, name).grad for part in leaves] for name in FIELDS}


def moved(part: PosedGaussians, by: torch.Tensor) -> PosedGaussians:
    means = part.gaussians.means + by
    return dataclasses.replace(part, gaussians=dataclasses.replace(part.gaussians, means=means))


@pytest.mark.parametrize("antialiased", [True])
def test_geometrys_gradients_are_gsplats(monkeypatch, antialiased):
    gsplat_stand_in.install(monkeypatch)
    settings = RasterSettings(antialiased=antialiased, sh_degree=2)
    camera = camera_ahead(19, 14, 18.0, position=(3.0, -2.0, 1.5), yaw=0.2)
    parts = [moved(part, torch.tensor([3.0, -2.0, 1.5])) for part in small_scene()]
    expected = all_gradients(parts, camera, "reference", settings)
    found = all_gradients(parts, camera, "cuda", settings)
    for name in FIELDS:
        # Of quats, what changes their length is nothing in truth and the rounding of a product.
        scale = 1e-3 if name == "quats" else 1e-4
        for got, want in zip(found[name], expected[name], strict=True):
            got, want = torch.zeros(0) if got is None else got, want
            error = float((got - want).norm()) if len(want) else 0.0
            assert error <= scale * float(want.norm()) + 1e-9, name


def test_gsplat_says_which_splats_it_drew(monkeypatch):
    gsplat_stand_in.install(monkeypatch)
    gaussians = stack(one_gaussian((-3.0, 0.0, 0.0)), one_gaussian())
    part = tracked(PosedGaussians(gaussians), "means")
    drawn = render_with_gsplat([part], camera_ahead(9, 9, 9.0), DEFAULT, with_depth=False)
    assert drawn.ids.tolist() == [1] and drawn.means2d.shape == (1, 2)
    assert drawn.expected_depth is None and drawn.colors.shape == (2, 3)
    drawn.rgb.sum().backward()
    assert drawn.means2d.absgrad.shape == (1, 2)


def test_without_gsplat_both_ways_out_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    part = tracked(PosedGaussians(one_gaussian()), "means")
    with pytest.raises(BackendUnavailable, match=r"climategs\[gsplat\].*backend 'cpu'"):
        rasterize([part], camera_ahead(9, 9, 9.0), backend="cuda")
    gsplat_stand_in.install(monkeypatch, __version__="1.6.0")
    with pytest.raises(BackendUnavailable, match=r"gsplat 1\.6\.0 is installed"):
        rasterize([part], camera_ahead(9, 9, 9.0), backend="cuda")
    gsplat_stand_in.install(monkeypatch)
    backend = types.SimpleNamespace(_backend=types.SimpleNamespace(_C=None))
    monkeypatch.setitem(sys.modules, "gsplat.cuda", backend)
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", backend._backend)
    with pytest.raises(BackendUnavailable, match="found no CUDA toolkit"):
        rasterize([part], camera_ahead(9, 9, 9.0), backend="cuda")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (RasterSettings(alpha_max=0.99), "alpha_max must be 0.999"),
        (RasterSettings(transmittance_stop=0.01), "transmittance_stop must be 0.0001"),
    ],
)
def test_what_is_compiled_into_gsplat_cannot_be_set(monkeypatch, settings, message):
    gsplat_stand_in.install(monkeypatch)
    part = tracked(PosedGaussians(one_gaussian()), "scales")
    with pytest.raises(ValueError, match=message):
        rasterize([part], camera_ahead(9, 9, 9.0), settings=settings, backend="cuda")


def test_gradients_that_no_kernel_has_are_refused():
    camera = camera_ahead(9, 9, 9.0)
    colour, shape = (tracked(PosedGaussians(one_gaussian()), name) for name in ("sh", "means"))
    smog = Fog(extinction_per_m=0.1, airlight_rgb=(0.5, 0.5, 0.5))
    with pytest.raises(ValueError, match=r"gradients through fog.* 'reference', on the CPU"):
        rasterize([colour], camera, fog=smog, backend="cuda")
    with pytest.raises(ValueError, match="gradients of median_depth"):
        rasterize([shape], camera, buffers=(MEDIAN_DEPTH,), backend="cuda")
    above = dataclasses.replace(camera, is_orthographic=True)
    with pytest.raises(ValueError, match="of an orthographic camera"):
        rasterize([shape], above, backend="cuda")
