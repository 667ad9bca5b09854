"""Where a camera sees a level plane, and the mirrored camera."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.effects.flood.water_plane import (
    Margins,
    Window,
    mirrored_camera,
    plane_depth,
    plane_window,
)
from augment.geometry import rigid, rotmat_from_quat


def turned_camera(seed: int, width=31, height=19, position=(0.0, 0.0, 0.0)) -> Camera:
    quat = torch.from_numpy(np.random.default_rng(seed).normal(size=4))
    rotation = rotmat_from_quat(quat / quat.norm())
    centre = torch.tensor(position, dtype=torch.float64)
    return Camera(
        "turned", width, height, 25.0, 27.0, 14.2, 9.7, rigid(rotation, -rotation @ centre)
    )


def test_the_window_is_the_least_that_holds_all_rays_that_meet_the_plane():
    for seed, level_z_m in itertools.product(range(12), [-1.5, 1.5, 0.0]):
        camera = turned_camera(seed)
        meets = plane_depth(camera, level_z_m).isfinite()
        if level_z_m == 0.0:  # an eye in the plane: rays that rise
            meets = camera.ray_directions(torch.float64)[..., 2] > 0
        rows, columns = meets.any(1).nonzero(), meets.any(0).nonzero()
        expected = None
        if len(rows):
            first, last = (int(columns.min()), int(rows.min())), (columns.max(), rows.max())
            expected = Window(*first, int(last[0]) + 1, int(last[1]) + 1)
        assert plane_window(camera, level_z_m) == expected


def test_depths_reach_the_plane():
    camera = turned_camera(1, position=(3.0, -2.0, 5.0))
    depth = plane_depth(camera, 2.0)
    points = camera.centre + depth[..., None] * camera.ray_directions(torch.float64)
    met = depth.isfinite()
    assert bool(met.any()) and float((points[met][:, 2] - 2.0).abs().max()) < 1e-12
    assert bool((depth[met] > 0).all())


@pytest.mark.parametrize("seed", range(2))
def test_a_pixel_of_the_mirrored_camera_looks_along_the_reflected_ray(seed):
    camera, level = turned_camera(seed, position=(0.4, 0.3, 1.7)), -0.2
    mirrored = mirrored_camera(camera, level)
    rays = camera.ray_directions(torch.float64)
    expected = rays * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    assert torch.allclose(mirrored.ray_directions(torch.float64).flip(0), expected, atol=1e-12)
    assert mirrored.centre.tolist() == pytest.approx([0.4, 0.3, 2 * level - 1.7])
    # Twice mirrored is where it was.
    back = mirrored_camera(mirrored, level)
    assert torch.allclose(back.camera_from_world, camera.camera_from_world, atol=1e-12)


def test_masks_grow_at_least_by_their_margins():
    margins = Margins(5, 40, 20, 0)
    mask = torch.zeros(100, 120, dtype=torch.bool)
    mask[50, 60] = True
    grown = margins.around(mask, margins)
    assert grown.shape == (140, 145)
    row, column = 50 + 40, 60 + 5  # where that pixel stands in the grown window
    assert bool(grown[row - 40 : row + 1, column - 5 : column + 21].all())
    rows, columns = grown.any(1).nonzero(), grown.any(0).nonzero()
    # No farther than the squares of 16 pixels that hold the margins.
    assert row - int(rows.min()) < 40 + 32 and int(rows.max()) - row < 32
    assert column - int(columns.min()) < 5 + 32 and int(columns.max()) - column < 20 + 32
    none = torch.zeros(10, 10, dtype=torch.bool)
    assert not margins.around(none, margins).any()
    further = margins.around(mask, Margins(5, 40, 20, 33))
    assert bool(further[row : row + 34, column].all())
