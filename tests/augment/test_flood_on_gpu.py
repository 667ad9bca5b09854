"""Flooded views whose layers lie on a GPU, here a pretended one: all passes run there."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from augment import drawing
from augment.cameras import Camera
from augment.drawing import LayerRenderer
from augment.effects.flood.flood import FloodMedium
from augment.effects.flood.flood_view import FloodedImage, render_flooded
from augment.effects.flood.water_plane import Margins, resized
from augment.effects.flood.waves import make_waves
from augment.geometry import rigid
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, SPLAT_IDS, RenderOutput
from augment.render.constants import RasterSettings
from augment.render.cuda import runtime as gpu
from augment.render.fog import Fog
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians
from augment.sky import CubemapSky
from recipes.flood import Waves
from tests.augment.pretend_gpu import pretended_gpu
from tests.scenes import sh_of

ROAD_Z, LEVEL = -1.5, -1.1
LAYERED, UNIFORM = (Fog(0.03, (0.6, 0.6, 0.65), h, LEVEL) for h in (8.0, None))


def camera(width=33, height=21, *, z=0.0, pitch=0.1, roll=0.05) -> Camera:
    """Looks along +x, down by pitch, from the origin at height z."""
    c, s = np.cos(pitch), np.sin(pitch)
    level = torch.tensor([[0.0, -1, 0], [-s, 0, -c], [c, 0, -s]], dtype=torch.float64)
    c, s = np.cos(roll), np.sin(roll)
    rows = torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=torch.float64) @ level
    pose = rigid(rows, -rows @ torch.tensor([0.0, 0, z], dtype=torch.float64))
    return Camera("front", width, height, 24.0, 24.0, width / 2, height / 2, pose, 10**18)


def discs(points: np.ndarray, flat_axis: int, size: float) -> Gaussians:
    rng = np.random.default_rng(flat_axis)
    scales = np.full((len(points), 3), size, np.float32)
    scales[:, flat_axis] = 0.01
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(len(points), 1),
        scales=torch.from_numpy(scales),
        opacities=torch.full((len(points),), 0.98),
        sh=sh_of(rng.uniform(0.1, 0.9, (len(points), 3))),
        semantic=torch.full((len(points),), flat_axis, dtype=torch.int16),
    )


def grid(*axes: np.ndarray) -> np.ndarray:
    return np.stack([m.ravel() for m in np.meshgrid(*axes, indexing="ij")], -1)


def parts() -> list[PosedGaussians]:
    """A road that ends at a wall, some fifty splats."""
    road = grid(np.arange(2.0, 10, 1.6), np.arange(-4.0, 5, 1.6), [ROAD_Z])
    wall = grid([9.0], np.arange(-5.0, 6, 2.0), np.arange(-1.0, 3, 1.5))
    return [PosedGaussians(discs(road, 2, 0.8)), PosedGaussians(discs(wall, 0, 0.8))]


def medium(reflection: str, preset: str = "breeze", **changes) -> FloodMedium:
    waves = make_waves(Waves(preset=preset, count=3), seed=1, depth_m=0.4)
    water = FloodMedium(LEVEL, (2.0, 1.5, 1.0), (0.4, 0.4, 0.3), waves, reflection=reflection)
    return dataclasses.replace(water, **changes)


def drawn_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers come from the CPU's rasteriser: interpreted, the GPU's takes most of the time."""

    def rasterize_here(parts, camera, *, pixel_mask, backend, **settings):
        assert backend == "cuda"
        asked = None if pixel_mask is None else pixel_mask.cpu()
        drawn = rasterize(parts, camera, pixel_mask=asked, backend="cpu", **settings)
        images = {f.name: getattr(drawn, f.name) for f in dataclasses.fields(drawn)}
        device = gpu.gpu_device()
        moved = {name: part.to(device) for name, part in images.items() if part is not None}
        return RenderOutput(**moved)

    monkeypatch.setattr(drawing, "rasterize", rasterize_here)


def flooded(
    backend: str,
    view: Camera,
    water: FloodMedium,
    smog: Fog | None,
    *,
    deferred: bool,
    hidden_by: Gaussians | None = None,
) -> FloodedImage:
    """hidden_by: stands for the scene."""
    faces = torch.rand(6, 4, 4, 3, generator=torch.Generator().manual_seed(3))
    seen = parts() if hidden_by is None else [PosedGaussians(hidden_by)]
    renderer = LayerRenderer(seen, CubemapSky(faces), smog, deferred, RasterSettings(), backend)
    image = render_flooded(renderer, view, water, frozenset({EXPECTED_DEPTH, SPLAT_IDS}))
    assert image is not None
    return image


def same_picture(there: FloodedImage, here: FloodedImage, budget: float) -> None:
    """But for a share of pixels: silhouettes, where float32 picks another neighbour."""
    error = (there.rgb.cpu() - here.rgb).abs().amax(-1)
    assert float(error.median()) < 1e-5 and float((error > 1e-3).float().mean()) <= budget
    water = there.water.cpu() == here.water
    assert float((~water).float().mean()) <= budget
    for name in (ALPHA, EXPECTED_DEPTH, SPLAT_IDS):
        a, b = getattr(there.scene, name).cpu().double(), getattr(here.scene, name).double()
        assert float((~torch.isclose(a, b, rtol=1e-4, atol=1e-4)).float().mean()) <= budget, name


@pytest.mark.parametrize(
    ("reflection", "smog", "deferred"),
    [("screen_space", LAYERED, False), ("mirrored", UNIFORM, True)],
)
def test_a_flooded_view_stays_on_the_gpu_and_is_the_cpu_s(monkeypatch, reflection, smog, deferred):
    view, water = camera(), medium(reflection)
    here = flooded("cpu", view, water, smog, deferred=deferred)
    assert 0.3 < float(here.water.float().mean()) < 0.9
    with pretended_gpu(monkeypatch):
        drawn_elsewhere(monkeypatch)
        there = flooded("cuda", view, water, smog, deferred=deferred)
        # The screen's march interpolates on the CPU, and traces all pixels on the GPU.
        same_picture(there, here, 0.05 if reflection == "screen_space" else 0.01)


def test_a_view_from_under_the_water_stays_on_the_gpu(monkeypatch):
    view, water = camera(z=-1.3, pitch=-0.3), medium("sky", "still")
    here = flooded("cpu", view, water, LAYERED, deferred=False)
    with pretended_gpu(monkeypatch):
        drawn_elsewhere(monkeypatch)
        same_picture(flooded("cuda", view, water, LAYERED, deferred=False), here, 0.01)


@pytest.mark.long
def test_a_small_flooded_view_from_its_splats_on(monkeypatch):
    view, water = camera(17, 11, roll=0.0), medium("sky", "still")
    few = parts()[0].gaussians.select(torch.arange(6, 14))
    here = flooded("cpu", view, water, None, deferred=False, hidden_by=few)
    with pretended_gpu(monkeypatch):
        there = flooded("cuda", view, water, None, deferred=False, hidden_by=few)
        same_picture(there, here, 0.02)


def test_masks_grow_and_shrink_on_a_gpu_as_they_do_here(monkeypatch):
    mask = torch.rand(45, 70, generator=torch.Generator().manual_seed(1)) > 0.995
    assert 3 < int(mask.sum()) < 60
    margins, reach = Margins(5, 20, 0, 33), Margins(17, 3, 0, 40)
    grown = margins.around(mask, reach)
    small = camera(19, 13)
    with pretended_gpu(monkeypatch):
        away = mask.to("meta")
        there = margins.around(away, reach)
        assert there.shape == grown.shape and torch.equal(there.cpu(), grown)
        assert torch.equal(resized(there, small).cpu(), resized(grown, small))
