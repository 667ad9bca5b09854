"""Colours of a scene as its cameras show them."""

import dataclasses
import gc
import weakref

import numpy as np
import pytest
import torch
from fitted_scenes import fitted_scene
from scenes import camera_ahead, one_gaussian, random_gaussians
from snow_scenes import box_car, drive, sheet, wall

from augment.cameras import Frame
from augment.effects.style import content
from augment.effects.style.content import (
    content_pictures,
    content_statistics,
    gaussian_statistics,
    knows_regions,
    select_views,
)
from augment.effects.style.statistics import LAND, REST, ROAD, SKY, VEGETATION, WHOLE
from augment.render.threads import limit_threads
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass
from augment.sky import ConstantSky

ROAD_RGB, HEDGE_RGB, SKY_RGB = (0.3, 0.32, 0.35), (0.1, 0.4, 0.05), (0.5, 0.7, 0.9)


def of_class(gaussians: Gaussians, value: int) -> Gaussians:
    classes = torch.full((len(gaussians),), value, dtype=torch.int16)
    return dataclasses.replace(gaussians, semantic=classes)


def street(*more: Gaussians, **changes) -> Scene:
    """A road before a hedge, under a sky of one colour, and whatever else."""
    road = of_class(sheet((0.5, 8), (-4, 4), rgb=ROAD_RGB), SemanticClass.ROAD)
    hedge = of_class(wall(8.0, (-4, 4), (0, 2), rgb=HEDGE_RGB), SemanticClass.VEGETATION)
    scene = drive(road, hedge, *more)
    return dataclasses.replace(scene, sky=ConstantSky(torch.tensor(SKY_RGB)), **changes)


def same(a, b) -> bool:
    return list(a) == list(b) and all(
        np.array_equal(a[k].mean, b[k].mean)
        and np.array_equal(a[k].covariance, b[k].covariance)
        and a[k].share == b[k].share
        for k in a
    )


def test_every_region_has_its_colour():
    found = content_statistics(street(), per_region=True)
    assert list(found) == [WHOLE, LAND, SKY, ROAD, VEGETATION]
    # Edges mix the colours of what is on both sides of them.
    for region, rgb in ((SKY, SKY_RGB), (ROAD, ROAD_RGB), (VEGETATION, HEDGE_RGB)):
        assert np.abs(found[region].mean - rgb).max() < 0.02, region
        assert np.sqrt(np.diag(found[region].covariance)).max() < 0.06, region
    assert found[WHOLE].share == 1
    assert found[LAND].share + found[SKY].share == pytest.approx(1, abs=1e-5)
    assert found[ROAD].share + found[VEGETATION].share == pytest.approx(found[LAND].share, abs=1e-4)
    mixed = sum(found[r].share * found[r].mean for r in (SKY, LAND))
    assert np.abs(found[WHOLE].mean - mixed).max() < 1e-5
    assert min(found[r].share for r in (SKY, ROAD, VEGETATION)) > 0.05


def test_regions_are_wanted_and_known():
    assert list(content_statistics(street(), per_region=False)) == [WHOLE, LAND, SKY]
    unknown = dataclasses.replace(
        street(), background=dataclasses.replace(street().background, semantic=None)
    )
    assert knows_regions(street()) and not knows_regions(unknown)
    assert list(content_statistics(unknown, per_region=True)) == [WHOLE, LAND, SKY]


def test_actors_count_where_they_are():
    car = box_car()
    scene = dataclasses.replace(street(), actors=(car,))
    found = content_statistics(scene, per_region=True)
    assert found[REST].share > 0.01
    assert not same(found, content_statistics(street(), per_region=True))


def test_the_sky_has_to_be_seen():
    """Splats always let a little through, and the light of two walls' gaps is no sky."""
    walls = [wall(x, (-9, 9), (-6, 9)) for x in (4.0, 4.1)]
    assert SKY in content_statistics(drive(walls[0]), per_region=True)
    assert list(content_statistics(drive(*walls), per_region=True)) == [WHOLE, LAND]


def test_a_grey_stand_in_for_a_sky_moves_nothing_but_its_own_statistics():
    greys = [
        dataclasses.replace(street(), sky=ConstantSky(torch.full((3,), level)))
        for level in (0.0, 0.85)
    ]
    dark, bright = (content_statistics(scene, per_region=True) for scene in greys)
    for region in (WHOLE, LAND, ROAD, VEGETATION):
        assert np.array_equal(dark[region].mean, bright[region].mean), region
        assert np.array_equal(dark[region].covariance, bright[region].covariance), region
    assert np.array_equal(bright[WHOLE].mean, bright[LAND].mean) and bright[WHOLE].share == 1
    assert np.abs(bright[SKY].mean - 0.85).max() < 1e-6
    assert torch.equal(*(content_pictures(scene) for scene in greys))
    blue = content_statistics(street(), per_region=True)  # a colour is there to be seen
    assert np.abs(blue[WHOLE].mean - blue[LAND].mean).max() > 0.02


def test_black_and_one_gaussian():
    black = drive(sheet((0.5, 8), (-4, 4), rgb=(0, 0, 0)))
    black = dataclasses.replace(black, sky=ConstantSky(torch.zeros(3)))
    found = content_statistics(black, per_region=True)
    assert all(np.abs(one.mean).max() < 1e-6 for one in found.values())
    assert all(np.abs(one.covariance).max() < 1e-9 for one in found.values())
    scene = drive(one_gaussian(mean=(4.0, 0.0, 1.5)))
    found = content_statistics(scene, per_region=False)
    assert np.abs(found[LAND].mean - (0.9, 0.5, 0.1)).max() < 1e-5
    assert 0 < found[LAND].share < found[SKY].share


@pytest.mark.parametrize("why", ["no frames", "no cameras", "nothing seen", "orthographic"])
def test_what_no_camera_sees_speaks_for_itself(why):
    scene = street()
    behind = camera_ahead(position=(-50.0, 0, 1.5), yaw=np.pi)
    cameras = {
        "no cameras": {},
        "nothing seen": {"behind": behind},
        "orthographic": {"above": dataclasses.replace(behind, is_orthographic=True)},
    }.get(why)
    frames = () if cameras is None else (Frame(0, 0, torch.eye(4).double(), cameras),)
    blind = dataclasses.replace(scene, frames=frames)
    found = content_statistics(blind, per_region=True)
    assert same(found, gaussian_statistics(scene, per_region=True))
    assert SKY not in found and found[ROAD].share + found[VEGETATION].share == pytest.approx(1)
    assert np.abs(found[ROAD].mean - ROAD_RGB).max() < 1e-6
    assert np.abs(found[VEGETATION].mean - HEDGE_RGB).max() < 1e-6
    picture = content_pictures(blind)
    assert picture.shape == (1, 3, 256, 256)
    mean = picture[0].mean((1, 2)).double().numpy()
    assert np.abs(mean - found[WHOLE].mean).max() < 1e-3


def test_gaussians_weigh_what_they_could_cover():
    """By opacity and extent; where nothing has any, they count alike."""
    near = one_gaussian(rgb=(1, 0, 0), opacity=0.5, scale=0.2)
    far = one_gaussian(rgb=(0, 0, 1), opacity=1.0, scale=0.4)
    found = gaussian_statistics(drive(near, far), per_region=False)
    assert found[WHOLE].mean == pytest.approx([1 / 9, 0, 8 / 9], abs=1e-6)
    clear = gaussian_statistics(
        drive(*(dataclasses.replace(g, opacities=torch.zeros(1)) for g in (near, far))),
        per_region=False,
    )
    assert clear[WHOLE].mean == pytest.approx([0.5, 0, 0.5], abs=1e-6)


def names_of(views) -> list[str]:
    return [camera.name for camera in views]


def test_views_are_spread_over_cameras_and_time():
    cameras = [
        dataclasses.replace(camera_ahead(timestamp_ns=t), name=name)
        for t in range(40)
        for name in ("left", "front", "right")
    ]
    views = select_views(street(), cameras, 12)
    assert sorted(names_of(views)) == ["front"] * 4 + ["left"] * 4 + ["right"] * 4
    times = [camera.timestamp_ns for camera in views]
    assert times == sorted(times) and max(np.diff([0, *times, 39])) <= 4
    few = select_views(street(), cameras[:7], 12)
    assert set(map(id, few)) == set(map(id, cameras[:7]))
    many = [dataclasses.replace(camera_ahead(), name=f"image {n}") for n in range(300)]
    numbers = [int(name.split()[1]) for name in names_of(select_views(street(), many, 12))]
    assert len(set(numbers)) == 12 and np.diff(numbers).max() == 25
    assert select_views(street(), [], 12) == ()


def test_cameras_that_are_given_are_used():
    scene = street()
    up = camera_ahead(position=(0, 0, 1.5), yaw=0.0)
    down = dataclasses.replace(up, cy=-40.0)  # looks at the road alone
    found = content_statistics(scene, [down], per_region=False)
    assert found[LAND].share > 0.9
    assert not same(found, content_statistics(scene, per_region=False))
    own = [camera for frame in scene.frames for camera in frame.cameras.values()]
    assert content_statistics(scene, own, per_region=False) is content_statistics(
        scene, per_region=False
    )


def test_remembered_by_what_cameras_are_and_as_long_as_the_scene_lives(monkeypatch):
    scene = street()
    found = content_statistics(scene, per_region=False)
    with monkeypatch.context() as patch:
        patch.setattr(content, "rasterize", None)
        again = [dataclasses.replace(c) for f in scene.frames for c in f.cameras.values()]
        assert content_statistics(scene, again, per_region=False) is found
        for change in ({"fx": 20.0}, {"timestamp_ns": 7}, {"width": 10}):
            other = [dataclasses.replace(again[0], **change), *again[1:]]
            with pytest.raises(TypeError):
                content_statistics(scene, other, per_region=False)
    gone = weakref.ref(scene)
    del scene
    gc.collect()
    assert gone() is None


def test_bits_do_not_depend_on_threads():
    scene = dataclasses.replace(fitted_scene(), actors=())
    found = content_statistics(scene, per_region=True)
    pictures = content_pictures(scene)
    scene = dataclasses.replace(scene)  # another object: nothing is remembered
    try:
        limit_threads(1)
        assert same(content_statistics(scene, per_region=True), found)
        assert torch.equal(content_pictures(scene), pictures)
    finally:
        limit_threads(None)


def test_pictures_are_whole_and_squeezed():
    scene = street()
    wide = camera_ahead(200, 60, 60.0, position=(0, 0, 1.5))
    pictures = content_pictures(scene, [wide])
    assert pictures.shape == (1, 3, 256, 256) and pictures.dtype == torch.float32
    assert pictures.min() >= 0 and pictures.max() <= 1
    expected = content_statistics(scene, [wide], per_region=False)[WHOLE].mean
    # Other pixels of the same view.
    assert np.abs(pictures[0].mean((1, 2)).double().numpy() - expected).max() < 0.02
    assert torch.allclose(pictures[0, :, 0, 128], torch.tensor(SKY_RGB), atol=0.01)
    assert len(content_pictures(fitted_scene())) <= content.PICTURES


def test_float64_scenes():
    scene = drive(random_gaussians(30, sh_degree=0))
    double = drive(random_gaussians(30, sh_degree=0, dtype=torch.float64))
    found = [content_statistics(s, per_region=False) for s in (scene, double)]
    assert np.abs(found[0][WHOLE].mean - found[1][WHOLE].mean).max() < 1e-4
