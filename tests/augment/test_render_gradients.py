"""Gradients of the reference rasteriser."""

import pytest
import torch

from augment.render.buffers import BUFFERS
from augment.render.constants import RasterSettings
from augment.render.fog import Fog
from augment.render.reference import rasterize_reference
from augment.scene import Gaussians, PosedGaussians
from tests.scenes import camera_ahead, random_gaussians, slight_pose, smooth_gaussians

FIELDS = ("means", "quats", "scales", "opacities", "sh")


def render(gaussians, camera, settings=None, smog=None, pose=None):
    parts, settings = [PosedGaussians(gaussians, pose)], settings or RasterSettings()
    return rasterize_reference(parts, camera, frozenset(BUFFERS), settings, smog)


@pytest.mark.parametrize("variant", ["classic", "antialiased", "smog"])
def test_gradients_of_every_tensor(variant):
    camera = camera_ahead(4, 3, 7.0)
    gaussians = smooth_gaussians(3, sh_degree=1 if variant == "classic" else 0)
    pose = slight_pose((0.1, 0.2, -0.1))
    smog = Fog(0.1, (0.7, 0.6, 0.5), 3.0) if variant == "smog" else None
    settings = RasterSettings(antialiased=variant == "antialiased")

    def image(*tensors):
        values = Gaussians(**dict(zip(FIELDS, tensors, strict=True)))
        output = render(values, camera, settings, smog, pose)
        return output.rgb, output.alpha, output.expected_depth, output.median_depth

    tensors = [getattr(gaussians, name).requires_grad_() for name in FIELDS]
    assert bool((image(*tensors)[3] > 0).any())  # the median depth is exercised too
    # 6 decimal steps in float64: central differences are good to about 1e-8
    assert torch.autograd.gradcheck(image, tensors, eps=1e-6, atol=1e-6, fast_mode=False)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_stay_finite_at_every_cut_off(dtype):
    gaussians = random_gaussians(400, seed=8, dtype=dtype)
    opacities = gaussians.opacities.clone()
    opacities[:40] = 1.0
    opacities[40:80] = 0.0
    opacities[80:120] = 1 / 255
    scales = gaussians.scales.clone()
    scales[120:160] = 1e-12  # the determinant of their covariance underflows in float32
    scales[160:200] = scales[160:200] * torch.tensor([100.0, 1e-4, 1e-4]).to(dtype)
    sh = gaussians.sh.clone()
    sh[200:240, 0] = -5.0  # colours clamped to 0
    fields = {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "scales": scales,
        "opacities": opacities,
        "sh": sh,
    }
    tensors = {name: value.clone().requires_grad_() for name, value in fields.items()}
    smog = Fog(0.05, (0.5, 0.6, 0.7), 10.0)
    settings = RasterSettings(antialiased=True)
    output = render(Gaussians(**tensors), camera_ahead(), settings, smog)
    total = output.rgb.sum() + output.alpha.sum() + output.expected_depth.sum()
    (total + output.median_depth.sum() + output.mode_depth.sum()).backward()
    for name, tensor in tensors.items():
        assert tensor.grad is not None
        assert bool(torch.isfinite(tensor.grad).all()), name
        assert float(tensor.grad.abs().max()) > 0, name
