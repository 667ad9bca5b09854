"""Splats that paint sky: which they are, and that they change with it."""

import dataclasses

import numpy as np
import pytest
import torch

from augment.effects.style.color_maps import (
    CLASSES,
    LEVELS,
    StyleMaps,
    level_maps,
    map_rows,
    sky_levels,
    style_gaussians,
    styled_scene,
)
from augment.effects.style.style import scene_style_of
from augment.memo import memo_of
from augment.scene import Gaussians, Scene
from augment.sky import ConstantSky
from augment.views import render_view
from recipes.schema import Recipe
from recipes.style import Style
from tests.scenes import one_gaussian, stack
from tests.snow_scenes import drive, sheet

SKY_RGB = (0.6, 0.7, 0.9)  # of a drive
STYLE = Style(preset="dusk")
RED = torch.tensor([[0, 0, 0, 0.9], [0, 0, 0, 0.1], [0, 0, 0, 0.1]])
GREEN = torch.tensor([[0, 0, 0, 0.1], [0, 0, 0, 0.9], [0, 0, 0, 0.1]])
SEEN = torch.cat([0.03**2 * torch.eye(3), torch.tensor(SKY_RGB)[:, None]], 1)


def maps(splats: torch.Tensor = GREEN[None], seen: torch.Tensor | None = SEEN) -> StyleMaps:
    return StyleMaps(splats, RED, torch.eye(3, 4), seen)


def ball(mean, rgb=SKY_RGB) -> Gaussians:
    return one_gaussian(mean, 1.0, 0.9, rgb)


def scene_of(*balls: Gaussians, sky=SKY_RGB) -> Scene:
    """A road of which nothing is sky, and balls ahead of a camera 1.5 m above it."""
    made = drive(sheet((0.0, 4.0), (-2.0, 2.0)), *balls)
    return dataclasses.replace(made, sky=ConstantSky(torch.tensor(sky)))


def levels_of(*balls: Gaussians, **options) -> list[int]:
    found = sky_levels(scene_of(*balls, **options), maps())
    return [0] * len(balls) if found is None else found[-len(balls) :].tolist()


def test_what_has_the_skys_colour_above_the_horizon_is_sky():
    pale, brick = (0.62, 0.69, 0.88), (0.6, 0.3, 0.2)
    high, low = (30.0, 0.0, 12.0), (30.0, 0.0, 0.5)
    assert levels_of(ball(high), ball(high, pale), ball(high, brick), ball(low)) == [
        LEVELS, LEVELS, 0, 0,
    ]  # fmt: skip


def test_between_sky_and_land_there_is_no_step():
    shades = torch.linspace(0, 0.2, 41)
    balls = [ball((30.0, 0.0, 12.0), (0.6, 0.7, 0.9 - float(s))) for s in shades]
    wide = dataclasses.replace(maps(), seen_sky=torch.cat([torch.eye(3), SEEN[:, 3:]], 1))
    found = sky_levels(scene_of(*balls), wide)[-41:]
    steps = found.diff()
    assert found[0] == LEVELS and found[-1] == 0 and steps.max() <= 0 and steps.min() >= -1


def test_a_wall_in_front_of_what_the_sky_holds_of_it_is_no_sky():
    # Where nothing is seen of a cube map, a fit leaves the wall's own colour in it.
    wall = (0.5, 0.4, 0.3)
    assert levels_of(ball((30.0, 0.0, 12.0), wall), sky=wall) == [0]


def test_without_a_map_of_its_own_no_sky_is_looked_for():
    scene = scene_of(ball((30.0, 0.0, 12.0)))
    assert sky_levels(scene, maps(seen=None)) is None
    assert sky_levels(scene, maps()) is not None
    assert sky_levels(dataclasses.replace(scene, frames=()), maps()) is None
    pale = scene_of(ball((30.0, 0.0, 12.0), (0.8, 0.8, 0.8)), sky=(0.8, 0.8, 0.8))
    grey = torch.cat([torch.eye(3) / 100, torch.full((3, 1), 0.8)], 1)
    assert sky_levels(pale, maps(seen=grey)) is None  # nobody saw that sky, so no splat paints it
    assert sky_levels(dataclasses.replace(scene, has_known_gravity=False), maps()) is None
    assert sky_levels(scene_of(ball((30.0, 0.0, 12.0), (0.1, 0.1, 0.1))), maps()) is None


@pytest.mark.parametrize("count", [1, CLASSES])
def test_rows_lead_from_the_class_to_the_sky(count):
    rng = torch.Generator().manual_seed(0)
    splats = torch.rand(count, 3, 4, generator=rng)
    table = level_maps(maps(splats))
    assert table.shape == ((LEVELS + 1) * count, 3, 4)
    levels = torch.tensor([0, 3, LEVELS, 0, 2], dtype=torch.int16)
    classes = torch.tensor([2, 2, 5, 99, -1], dtype=torch.int16)
    rows = map_rows(levels, classes, count).long()
    for row, level, kind in zip(rows, levels, classes, strict=True):
        own = splats[int(kind) if 0 <= kind < count else 0]
        torch.testing.assert_close(table[row], torch.lerp(own, RED, float(level) / LEVELS))
    assert torch.equal(map_rows(levels, None, count).long(), count * levels.long())


def test_the_halo_changes_with_the_sky_in_pictures_and_in_styled_scenes():
    scene = scene_of(ball((30.0, 0.0, 12.0)), ball((30.0, 4.0, 12.0), (0.5, 0.3, 0.2)))
    memo_of(scene).put(("style maps", STYLE), maps(), shared=True)
    camera = scene.frames[0].cameras["ahead"]
    look = scene_style_of(scene, STYLE)
    rows = look.on(scene.parts_for(camera))[0].color_rows
    assert rows is not None and rows[-2:].tolist() == [LEVELS, 0] and not rows[:-2].any()
    fused = render_view(scene, camera, Recipe(style=STYLE))
    folded = render_view(styled_scene(scene, maps()), camera, Recipe())
    assert np.abs(fused.rgb.astype(int) - folded.rgb).max() <= 1
    colors = (styled_scene(scene, maps()).background.sh[-2:, 0] * 0.28209479 + 0.5).tolist()
    np.testing.assert_allclose(colors, [[0.9, 0.1, 0.1], [0.1, 0.9, 0.1]], atol=1e-5)
    assert torch.equal(look.lighting_scene.background.sh[-1], look.lighting_scene.background.sh[0])


def test_folding_by_levels_is_the_definitions():
    gaussians = stack(*[ball((3.0, 0.0, z)) for z in range(5)])
    gaussians = dataclasses.replace(gaussians, semantic=torch.arange(5, dtype=torch.int16))
    levels = torch.tensor([0, 1, 4, 7, LEVELS], dtype=torch.int16)
    rng = torch.Generator().manual_seed(1)
    some = maps(torch.rand(CLASSES, 3, 4, generator=rng))
    slow, fast, on_gpu = (
        style_gaussians(gaussians, some, levels=levels, backend=backend).sh
        for backend in ("reference", "cpu", "cuda")
    )
    torch.testing.assert_close(fast, slow, rtol=0, atol=1e-6)
    torch.testing.assert_close(on_gpu, slow, rtol=0, atol=1e-6)
    alone = style_gaussians(gaussians, some).sh
    assert torch.equal(fast[0], alone[0]) and not torch.allclose(fast[1], alone[1])
