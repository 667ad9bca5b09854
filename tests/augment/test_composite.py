import dataclasses

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.geometry import rigid, rotmat_from_quat
from augment.render.composite import composite_sky, map_colors, quantise
from augment.render.fog import Fog
from augment.sky import CubemapSky


def cameras() -> list[Camera]:
    """Six views of a cube map, so that every face and every edge between faces is crossed."""
    generator = torch.Generator().manual_seed(3)
    quats = torch.randn(6, 4, generator=generator, dtype=torch.float64)
    base = Camera("c", 61, 37, 30.0, 31.0, 29.0, 19.0, torch.eye(4, dtype=torch.float64))
    shift = torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)
    return [
        dataclasses.replace(base, camera_from_world=rigid(rotmat_from_quat(q), shift))
        for q in quats
    ]


@pytest.mark.parametrize("number", [1, 2])
def test_the_kernel_matches_the_definition(number):
    camera, smog = cameras()[number], (None, Fog(0.01, (0.5, 0.6, 0.7), 30.0, -2.0))[number % 2]
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(37, 61, 3, generator=generator)
    alpha = torch.rand(37, 61, generator=generator)
    sky = CubemapSky(torch.rand(6, 16, 16, 3, generator=generator))
    fast = composite_sky(rgb, alpha, camera, sky, fog=smog)
    slow = composite_sky(rgb, alpha, camera, sky, fog=smog, backend="reference")
    # Noise textures of 16 texels: float32 rounding of coordinates (1e-6) times 16 texels; a
    # pixel whose direction lies on an edge between faces may fall to either side.
    difference = (fast - slow).abs().amax(-1)
    assert float(difference.quantile(0.995)) < 1e-4
    assert int((difference > 1e-3).sum()) <= 2


def test_opaque_pixels_keep_their_colour_to_the_bit():
    rgb = torch.rand(37, 61, 3)
    out = composite_sky(rgb, torch.ones(37, 61), cameras()[0], CubemapSky(torch.rand(6, 4, 4, 3)))
    assert torch.equal(out, rgb)


def test_gradients_pass_through_the_sky():
    rgb = torch.rand(37, 61, 3, requires_grad=True)
    alpha = torch.rand(37, 61, requires_grad=True)
    sky = CubemapSky(torch.rand(6, 4, 4, 3))
    composite_sky(rgb, alpha, cameras()[0], sky).sum().backward()
    assert torch.equal(rgb.grad, torch.ones_like(rgb))
    behind = sky.sample(cameras()[0].ray_directions()).sum(-1)
    assert torch.allclose(alpha.grad, -behind, atol=1e-5)  # float32 sums of three numbers


def test_eight_bits_round_to_nearest_and_clamp():
    values = torch.tensor([-0.2, 0.0, 0.4 / 255, 0.6 / 255, 127.5 / 255, 1.0, 7.0])
    image = values[:, None, None].expand(7, 1, 3).contiguous()
    expected = np.array([0, 0, 0, 1, 128, 255, 255], np.uint8)
    assert np.array_equal(quantise(image)[:, 0, 0], expected)
    assert np.array_equal(quantise(image.double())[:, 0, 0], expected)


COLOR_MAP = torch.tensor([[1.1, 0.05, 0.0, 0.02], [-0.1, 0.9, 0.1, 0.0], [0.0, 0.2, 1.2, -0.05]])


@pytest.mark.parametrize("size", [(37, 61), (1, 1)])
def test_colour_maps_match_their_definition(size):
    rgb = torch.rand(*size, 3) * 1.5 - 0.2  # pictures are not clamped before
    expected = rgb.double() @ COLOR_MAP[:, :3].double().T + COLOR_MAP[:, 3].double()
    slow = map_colors(rgb, COLOR_MAP, backend="reference")
    fast = map_colors(rgb.clone(), COLOR_MAP)
    # Sums of four float32 products below 2.
    torch.testing.assert_close(slow.double(), expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(fast.double(), expected, atol=1e-6, rtol=0)
    assert torch.equal(map_colors(rgb.double(), COLOR_MAP), expected)


def test_gradients_pass_through_colour_maps():
    rgb = torch.rand(5, 4, 3, requires_grad=True)
    map_colors(rgb, COLOR_MAP).sum().backward()
    torch.testing.assert_close(rgb.grad, COLOR_MAP[:, :3].sum(0).expand(5, 4, 3))
