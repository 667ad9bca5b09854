"""Passes over finished images on the GPU, and whole frames: the pictures of the other backends.

Kernels are interpreted where there is no GPU, and a pretended one tells where a tensor lies on the
wrong side.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import pytest
import torch

from augment.cameras import Camera
from augment.geometry import rigid, rotmat_from_quat
from augment.render.buffers import RenderOutput
from augment.render.composite import composite_sky, map_colors, quantise
from augment.render.gpu import upload
from augment.render.remainder import share_remainder
from augment.sky import ConstantSky, CubemapSky, LatLongSky, Sky
from augment.weather.smog import SmogMedium, fog_raster
from tests.augment.pretend_gpu import pretended_gpu

WIDTH, HEIGHT = 33, 21
UNIFORM = SmogMedium(0.03, (0.5, 0.6, 0.7))
LAYERED = SmogMedium(0.03, (0.5, 0.6, 0.7), 30.0, -2.0)


@pytest.fixture
def away(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with pretended_gpu(monkeypatch):
        yield


def camera(seed: int = 0) -> Camera:
    """Looks somewhere: over all seeds every face and edge of a cube map is crossed."""
    quat = torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    pose = rigid(rotmat_from_quat(quat), torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64))
    return Camera("c", WIDTH, HEIGHT, 15.0, 15.5, 15.2, 10.1, pose)


def images(seed: int = 0) -> RenderOutput:
    """Premultiplied colour, alpha with both its ends, depth up to 200 m and 0 at some pixels."""
    generator = torch.Generator().manual_seed(seed)
    alpha = torch.rand(HEIGHT, WIDTH, generator=generator)
    alpha[:3], alpha[3:5] = 0, 1
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=generator) * alpha[..., None]
    depth = 200 * torch.rand(HEIGHT, WIDTH, generator=generator) ** 3
    depth[:3] = 0
    return RenderOutput(rgb=rgb, alpha=alpha, expected_depth=depth, snow=0.7 * alpha)


def on_gpu(seen: RenderOutput) -> RenderOutput:
    moved = {f.name: getattr(seen, f.name) for f in dataclasses.fields(seen)}
    return RenderOutput(**{k: None if v is None else upload(v) for k, v in moved.items()})


class Gradient:
    """A sky that only it can sample."""

    def sample(self, directions: torch.Tensor) -> torch.Tensor:
        return 0.5 + 0.5 * torch.nn.functional.normalize(directions, dim=-1)


def skies() -> dict[str, Sky]:
    generator = torch.Generator().manual_seed(1)
    return {
        "cube": CubemapSky(torch.rand(6, 8, 8, 3, generator=generator)),
        "constant": ConstantSky(torch.tensor([0.2, 0.5, 0.9])),
        "panorama": LatLongSky(torch.rand(16, 32, 3, generator=generator)),
        "another": Gradient(),
    }


@pytest.mark.parametrize("smog", [None, UNIFORM, LAYERED], ids=["clear", "uniform", "layered"])
@pytest.mark.parametrize("name", skies())
def test_the_sky_behind_the_splats(away, name, smog):
    sky = skies()[name]
    for seed in range(4 if name == "cube" else 1):
        seen, view = images(seed), camera(seed)
        expected = composite_sky(seen.rgb, seen.alpha, view, sky, smog=smog, backend="reference")
        moved = on_gpu(seen)
        got = composite_sky(moved.rgb, moved.alpha, view, sky, smog=smog, backend="cuda")
        # Textures of noise, whose coordinates float32 rounds, and edges between faces: see
        # test_composite.
        difference = (got.cpu() - expected).abs().amax(-1)
        assert float(difference.quantile(0.99)) < 1e-4
        assert int((difference > 1e-3).sum()) <= 2
        assert torch.equal(got.cpu()[3:5], seen.rgb[3:5])  # opaque pixels show no sky


@pytest.mark.parametrize("medium", [UNIFORM, LAYERED, SmogMedium(5.0, (0.1, 0.2, 0.3), 3.0)])
def test_smog_on_buffers(away, medium):
    for seed in range(3):
        seen, view = images(seed), camera(seed)
        expected = fog_raster(seen, view, medium)
        got = fog_raster(on_gpu(seen), view, medium, backend="cuda")
        torch.testing.assert_close(got.cpu(), expected, atol=2e-6, rtol=0)


def test_smog_without_density_is_the_identity_to_the_bit(away):
    seen = images()
    for height in (None, 20.0):
        got = fog_raster(on_gpu(seen), camera(), SmogMedium(0.0, (0.5, 0.6, 0.7), height))
        assert torch.equal(got.cpu(), seen.rgb)


def test_colour_maps(away):
    matrix = torch.tensor([[1.1, 0.05, 0, 0.02], [-0.1, 0.9, 0.1, 0], [0, 0.2, 1.2, -0.05]])
    rgb = images().rgb
    expected = map_colors(rgb, matrix, backend="reference")
    got = map_colors(upload(rgb), matrix, backend="cuda")
    torch.testing.assert_close(got.cpu(), expected, atol=1e-6, rtol=0)
    double = map_colors(upload(rgb.double()), matrix, backend="cuda")  # left to torch
    torch.testing.assert_close(double.cpu(), expected.double(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("without", [(), ("rgb",), ("snow",)], ids=["all", "no colour", "no snow"])
def test_finished_pixels_become_opaque(away, without):
    seen = dataclasses.replace(images(), **dict.fromkeys(without))
    expected = share_remainder(seen, 0.3, backend="reference")
    got = share_remainder(on_gpu(seen), 0.3, backend="cuda")
    for name in {"rgb", "alpha", "snow"} - set(without):
        value = getattr(got, name).cpu()
        torch.testing.assert_close(value, getattr(expected, name), atol=1e-6, rtol=0)


def test_eight_bits_of_an_image_on_the_gpu(away):
    rgb = 1.4 * images().rgb - 0.2
    assert (quantise(upload(rgb)) == quantise(rgb)).all()
