"""Pixels of traffic signs, against the definition: the heaviest splat of a pixel is a sign's."""

from __future__ import annotations

import numpy as np
import torch

from augment.effects.lamps.signs import sign_pixels
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, SPLAT_IDS
from augment.render.constants import RasterSettings
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.scene import Gaussians, PosedGaussians
from augment.scene.semantics import SemanticClass
from tests.lamp_scenes import camera_at

SETTINGS = RasterSettings()
CAMERA = camera_at(1.5)


def board(
    x_m: float, left_m: float, bottom_m: float, side_m: float, semantic: SemanticClass
) -> Gaussians:
    """Return a square of splats across x, 5 cm apart."""
    steps = np.arange(0, side_m, 0.05)
    y, z = (grid.ravel() for grid in np.meshgrid(left_m - steps, bottom_m + steps))
    count = len(y)
    means = np.stack([np.full(count, x_m), y, z], 1).astype(np.float32)
    return Gaussians(
        torch.from_numpy(means),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous(),
        torch.tensor([0.005, 0.03, 0.03]).expand(count, 3).contiguous(),
        torch.full((count,), 0.98),
        torch.zeros(count, 1, 3),
        torch.full((count,), int(semantic), dtype=torch.int16),
    )


def signs_in(parts: list[PosedGaussians], camera: Camera) -> np.ndarray | None:
    depth = rasterize(parts, camera, buffers={EXPECTED_DEPTH, ALPHA}, settings=SETTINGS)
    assert depth.expected_depth is not None and depth.alpha is not None
    surface_m = torch.where(depth.alpha >= 0.5, depth.expected_depth, 0).numpy()
    return sign_pixels(parts, camera, surface_m, settings=SETTINGS, backend="cpu")


def test_sign_pixels_are_those_whose_heaviest_splat_is_a_signs() -> None:
    wall = PosedGaussians(board(20.0, 8.0, -6.0, 16.0, SemanticClass.BUILDING))
    sign = PosedGaussians(board(9.9, 0.5, 1.5, 0.8, SemanticClass.SIGN))
    moved = rigid(torch.eye(3, dtype=torch.float64), torch.tensor([0, -2.0, 0]).double())
    posed = PosedGaussians(sign.gaussians, moved, instance_id=1)
    parts = [wall, sign, posed]
    is_sign = signs_in(parts, CAMERA)
    assert is_sign is not None
    raster = rasterize(parts, CAMERA, buffers={SPLAT_IDS}, settings=SETTINGS)
    assert raster.splat_ids is not None
    expected = (raster.splat_ids >= len(wall.gaussians)).numpy()
    assert expected.sum() > 500
    # Along the edges the two halves of a pixel are nearly equal.
    edge_pixels = 2 * 4 * round(0.8 / 9.9 * CAMERA.fx)
    assert (is_sign != expected).sum() <= edge_pixels / 2


def test_hidden_signs_have_no_pixels() -> None:
    wall = PosedGaussians(board(8.0, 4.0, -2.0, 8.0, SemanticClass.BUILDING))
    sign = PosedGaussians(board(9.9, 0.5, 1.5, 0.8, SemanticClass.SIGN))
    is_sign = signs_in([wall, sign], CAMERA)
    assert is_sign is not None and not is_sign.any()


def test_signs_beside_and_behind_the_view_are_not_drawn() -> None:
    for x_m, left_m in ((-9.9, 0.5), (9.9, 40.0)):
        sign = PosedGaussians(board(x_m, left_m, 1.5, 0.8, SemanticClass.SIGN))
        assert signs_in([sign], CAMERA) is None
    wall = PosedGaussians(board(8.0, 4.0, -2.0, 8.0, SemanticClass.BUILDING))
    assert signs_in([wall], CAMERA) is None
