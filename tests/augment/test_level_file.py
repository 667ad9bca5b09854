"""Large scenes: written piece by piece, opened unread, drawn as the same scene in memory."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from augment.detail import lod
from augment.errors import SceneError
from augment.files.large_scene import save_large_scene
from augment.files.level_file import LEVELS
from augment.files.scene_file import load_scene_parts, save_scene
from augment.render.constants import RasterSettings
from augment.render.rasterize import rasterize
from augment.scene.scene import PosedGaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky
from augment.view.plan import make_plan
from recipes.schema import Flood, Recipe, Smog, Snowfall, Weather
from tests.augment.test_lod import eye, road

SETTINGS = RasterSettings(lod_px=2.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene("road", "test:road", road(24.0), (), ConstantSky(torch.ones(3)), ())


@pytest.fixture(scope="module")
def written(scene, tmp_path_factory):
    rows = torch.arange(len(scene.background)).chunk(3)
    folder = tmp_path_factory.mktemp("large") / "road"
    save_large_scene(scene, (scene.background.select(own) for own in rows), folder)
    return folder


@pytest.fixture
def folder(written, tmp_path):
    return Path(shutil.copytree(written, tmp_path / "road"))


def draw(background, x_m=-30.0):
    return rasterize([PosedGaussians(background)], eye(x_m), settings=SETTINGS).rgb


def test_a_large_scene_is_drawn_as_the_same_scene_in_memory(scene, folder):
    opened = load_scene_parts(folder)
    assert len(opened.background) == len(scene.background)
    levels = lod.levels_of(opened.background)
    assert levels.levels[0].unchecked_file is not None  # those of the file, none made anew
    assert torch.equal(draw(opened.background), draw(scene.background))


def test_pieces_change_no_bit(scene, folder, tmp_path):
    save_large_scene(scene, [scene.background], tmp_path / "whole")
    for name in ("gaussians.safetensors", LEVELS):
        assert (folder / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def damage(folder, name, change, file="gaussians.safetensors"):
    tensors = load_file(folder / file)
    with safe_open(folder / file, "pt") as opened:
        facts = opened.metadata()
    change(tensors[name])
    save_file(tensors, folder / file, facts)


def set_first(value):
    return lambda tensor: tensor.view(-1)[:1].fill_(value)


def test_numbers_are_looked_at_when_they_are_drawn_and_before_an_effect_works_on_them(folder):
    """The first splats, along the Z-curve, lie where the road begins."""
    damage(folder, "background.scales", set_first(float("nan")))
    opened = load_scene_parts(folder)  # nothing is read
    with pytest.raises(SceneError, match=r"levels.safetensors: splats 0 to .* cannot be drawn"):
        draw(opened.background, -7.0)
    smog = Smog(visibility_m=100.0)
    snowfall = Snowfall(rate_mm_h=1.0, shadow_fade=0.0, gloss_fade=0.0)
    make_plan(Recipe(weather=Weather(smog=smog, snowfall=snowfall)), opened)
    with pytest.raises(SceneError, match="splats 0 to"):
        make_plan(Recipe(weather=Weather(flood=Flood(level_m=0.1))), opened)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("1.keys", -1, "the squares of level 1 must have increasing keys"),
        ("0.starts", 1, "the squares of level 0 must .* starts from 0 to 28800"),
        ("1.lows", float("nan"), "1.lows, highs and longest must be boxes"),
        ("1.longest", -1.0, "1.lows, highs and longest must be boxes"),
        ("1.boxes.highs", -1e9, "1.boxes.lows, highs and longest must be boxes"),
    ],
)
def test_damaged_squares_are_refused_on_opening(folder, name, value, said):
    damage(folder, name, set_first(value), LEVELS)
    with pytest.raises(SceneError, match=said):
        load_scene_parts(folder)


@pytest.mark.parametrize(("name", "value"), [("stands_for", 28800), ("opacities", 50.0)])
def test_damaged_splats_of_a_level_are_refused_when_they_are_drawn(folder, name, value):
    levels = lod.levels_of(load_scene_parts(folder).background)
    number = len(levels.levels) - 1
    damage(folder, f"{number}.{name}", set_first(value), LEVELS)
    damaged = lod.levels_of(load_scene_parts(folder).background).levels[number]
    with pytest.raises(SceneError, match=r"splats 0 to .* cannot be drawn"):
        damaged.check(np.array([0]))


def test_what_effects_have_edited_keeps_the_files_levels_and_their_shapes(folder):
    """Half as bright, and the road gone: nothing is merged anew."""
    background = load_scene_parts(folder).background
    stored = lod.levels_of(background).levels
    dark = lod.levels_of(dataclasses.replace(background, sh=background.sh / 2)).levels
    is_road = background.semantic == int(SemanticClass.ROAD)
    opacities = torch.where(is_road, 0.0, background.opacities)
    bare = dataclasses.replace(background, opacities=opacities)
    for level, own, left in zip(stored, dark, lod.levels_of(bare).levels, strict=True):
        for name in ("means", "quats", "scales"):
            kept = getattr(level.gaussians, name).data_ptr()
            assert getattr(own.gaussians, name).data_ptr() == kept
            assert getattr(left.gaussians, name).data_ptr() == kept
        # Sums in another order, rounded to float32.
        torch.testing.assert_close(own.gaussians.sh, level.gaussians.sh / 2, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(own.gaussians.opacities, level.gaussians.opacities)
    shown, built = draw(bare), draw(bare.select(torch.arange(len(bare))))  # the latter merged anew
    assert float((shown - built).abs().mean()) < 0.5 / 255 < float(shown.mean())
    assert float((draw(background) - shown).abs().mean()) > 1 / 255


def test_levels_of_another_background_are_refused(scene, folder):
    piece = scene.background.select(torch.arange(20_000))
    other = folder.parent / "other"
    save_large_scene(scene, [piece], other)
    (folder / LEVELS).write_bytes((other / LEVELS).read_bytes())
    with pytest.raises(SceneError, match="starts from 0 to 28800"):
        load_scene_parts(folder)


def test_a_plain_scene_in_its_place_leaves_no_levels(scene, folder):
    save_scene(dataclasses.replace(scene), folder)
    assert not (folder / LEVELS).exists()
    assert torch.equal(load_scene_parts(folder).background.means, scene.background.means)


def test_without_a_piece_nothing_is_written(scene, tmp_path):
    with pytest.raises(SceneError, match="at least one piece"):
        save_large_scene(scene, [], tmp_path / "road")
    assert not np.any([path.name == "road" for path in tmp_path.iterdir()])
