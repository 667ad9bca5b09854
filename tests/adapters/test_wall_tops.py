"""Walls go on above the LiDAR's view, where images show them, and nowhere else."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from adapters.training_views.starting_scene import continue_walls
from adapters.training_views.views import RecordedViews
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from tests.adapters import drives

AWAY_M, LEFT_TOP_M, RIGHT_TOP_M = 20.0, 10.0, 2.0
SIZE, FOCAL_PX = (160, 120), 100.0


def photo(camera, number) -> np.ndarray:
    """Bright sky over a wall that is 10 m high on the left and 2 m on the right, with a window on
    the left that mirrors the sky."""
    rgb = np.full((120, 160, 3), 200, np.uint8)
    rows = np.arange(120)[:, None]
    z = 1.5 + AWAY_M * (60 - rows - 0.5) / FOCAL_PX
    wall = z < np.where(np.arange(160) < 80, LEFT_TOP_M, RIGHT_TOP_M)
    rgb[wall] = 110
    rgb[(wall & (rows % 4 == 0))] = 130
    rgb[40:46, 20:30] = 200
    return rgb


def drive(tmp_path, semantic: SemanticClass = SemanticClass.BUILDING, *, sweep=True) -> Scene:
    """A LiDAR that looks up to 15 degrees, so to 6.9 m of the wall, and through the window."""
    y, z = (a.ravel() for a in np.meshgrid(np.arange(-20, 20, 0.15), np.arange(0, 12, 0.15)))
    wall = np.stack([np.full(y.size, AWAY_M), y, z], 1)
    wall = wall[
        (z < np.where(y > 0, 6.8, RIGHT_TOP_M)) & ~((y > 10) & (y < 12) & (z > 4) & (z < 6))
    ]
    background = dataclasses.replace(
        drives.flat_splats(wall, 0.15), semantic=torch.full((len(wall),), int(semantic)).short()
    )
    return drives.drive(
        tmp_path, 1, cameras=lambda f: {"front": drives.camera(size=SIZE, focal_px=FOCAL_PX)},
        picture=photo, background=background, sweeps={0: wall} if sweep else None,
    )  # fmt: skip


def test_a_wall_goes_on_to_the_sky_straight_above_what_the_lidar_saw(tmp_path):
    scene = drive(tmp_path)
    background = continue_walls(scene, RecordedViews(scene, scale=1.0))
    new = background.select(torch.arange(len(scene.background), len(background)))
    x, y, z = new.means.T
    # Where the wall was drawn last, within a splat's size; a pixel is 0.2 m there.
    assert (x - AWAY_M).abs().max() < 0.3
    # Above the low wall is sky; below its top, discs close what leaks.
    assert (y[z > RIGHT_TOP_M + 0.3] > -0.5).all()
    assert z.max() < LEFT_TOP_M + 0.3
    heights = torch.histc(z[(y > 1) & (y < 9)], 12, 0, 12)
    assert (heights[7:9] > 100).all()  # 8 m at 0.2 m are 40 a row, and five rows a metre
    in_window = (y > 10.2) & (y < 11.8) & (z > 4.2) & (z < 5.8)
    assert in_window.sum() > 8  # 6 x 10 pixels, in discs of one to four pixels each
    assert (new.semantic == SemanticClass.BUILDING).all()
    colours = new.sh[:, 0] * 0.28209479 + 0.5
    above = z > 7.5
    assert ((colours[above] > 0.4) & (colours[above] < 0.55)).all()


def test_nothing_goes_on_where_the_lidars_top_is_unknown(tmp_path):
    scene = drive(tmp_path, sweep=False)
    assert len(continue_walls(scene, RecordedViews(scene, scale=1.0))) == len(scene.background)
