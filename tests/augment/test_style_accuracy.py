"""Where maps of a style in SH are exact, and where a clamp of colours makes them differ."""

import dataclasses

import numpy as np
import torch

from augment.semantics import SemanticClass
from tests.scenes import sh_of
from tests.snow_scenes import drive, sheet, wall
from tools.bench import style


def test_pixels_are_touched_exactly_where_a_colour_is_below_zero():
    road = sheet((2, 9), (-2, 2), rgb=(0.3, 0.35, 0.3), semantic=int(SemanticClass.ROAD))
    scene = drive(road, wall(9.0, (-3, 3), (0, 2.5)), places=[(0.0, 0.0, 1.5)])
    camera = scene.frames[0].cameras["ahead"]
    assert not style.clamped_pixels(scene, camera).any()
    sh = scene.background.sh.clone()
    sh[: len(road)] = sh_of(np.full((len(road), 3), -0.1))
    dark = dataclasses.replace(scene, background=dataclasses.replace(scene.background, sh=sh))
    touched = style.clamped_pixels(dark, camera)
    assert touched[-5:, 60:100].all() and not touched[:20].any()
    assert style.map_error(dark, camera, "overcast").max() < 1e-5  # no directions: known exactly
    wide = dataclasses.replace(dark.background, sh=torch.cat([sh, torch.zeros(len(sh), 3, 3)], 1))
    error = style.map_error(dataclasses.replace(dark, background=wide), camera, "overcast")
    assert error[touched].max() > 1 / 255 > 1e-5 > error[~touched].max()
