"""From a style to a scene's maps, by every method."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from fitted_scenes import fitted_scene
from scenes import camera_ahead
from snow_scenes import wall

from augment.cameras import Frame
from augment.effects.style import network as checkpoint
from augment.effects.style.color_maps import CLASSES, LEVELS, StyleMaps, sky_levels, styled_scene
from augment.effects.style.content import content_pictures, content_statistics, gaussian_statistics
from augment.effects.style.images import image_statistics, read_style_image
from augment.effects.style.network import Gscm
from augment.effects.style.statistics import LAND, ROAD, SKY, VEGETATION, WHOLE
from augment.effects.style.style import scene_style_of, style_maps
from augment.errors import StyleError
from augment.memo import memo_of
from augment.render.threads import limit_threads
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass
from augment.sky import ConstantSky
from augment.views import render_view
from recipes.schema import Recipe
from recipes.style import Style
from tests.scenes import one_gaussian
from tests.snow_scenes import drive, sheet


def colourful() -> object:
    """A scene whose colours vary in all three channels, under a sky."""
    rng = np.random.default_rng(3)
    scene = drive(sheet((0.5, 8), (-4, 4)), wall(8.0, (-4, 4), (0, 2)))
    colors = torch.from_numpy(rng.uniform(0.3, 0.6, (len(scene.background), 1, 3))).float()
    sh = (colors - 0.5) / 0.28209479
    return dataclasses.replace(scene, background=dataclasses.replace(scene.background, sh=sh))


@pytest.fixture
def photo(tmp_path):
    """Speckled ground under a bright, blue, graded sky."""
    rng = np.random.default_rng(0)
    rgb = rng.uniform((90, 70, 40), (170, 130, 90), (96, 128, 3))
    rgb[:40] = np.linspace((110, 160, 235), (150, 190, 245), 40)[:, None]
    path = tmp_path / "photo.png"
    assert cv2.imwrite(str(path), rgb[..., ::-1].astype(np.uint8))
    mask = np.zeros((96, 128), np.uint8)
    mask[:40] = 255
    assert cv2.imwrite(str(tmp_path / "mask.png"), mask)
    return path


IDENTITY_MAPS = StyleMaps(torch.eye(3, 4)[None], torch.eye(3, 4), torch.eye(3, 4))


def equal(a: StyleMaps, b: StyleMaps) -> bool:
    return all(torch.equal(getattr(a, n), getattr(b, n)) for n in ("splats", "sky", "picture"))


def test_the_scene_takes_on_the_colours(photo):
    scene = colourful()
    style = Style(image=str(photo), mask=str(photo.with_name("mask.png")))
    target = image_statistics(read_style_image(photo, photo.with_name("mask.png")))
    styled = styled_scene(scene, style_maps(scene, style))
    found = content_statistics(styled, per_region=False)
    before = content_statistics(scene, per_region=False)
    for region in (LAND, SKY):
        error = np.abs(found[region].mean - target[region].mean).max()
        assert error < 0.02, region  # pixels mix splats and clamp some of them
        assert np.abs(before[region].mean - target[region].mean).max() > 5 * error


def test_no_strength_changes_nothing_and_reads_nothing():
    maps = style_maps(fitted_scene(), Style(image="/no/such/file.png", strength=0))
    assert equal(maps, IDENTITY_MAPS) and torch.equal(maps.sky, torch.eye(3, 4))


def test_regions(photo, tmp_path):
    maps = style_maps(fitted_scene(), Style(image=str(photo), per_region=True))
    assert len(maps.splats) == CLASSES
    with pytest.raises(StyleError, match=r"none\.png"):
        style_maps(fitted_scene(), Style(image=str(tmp_path / "none.png")))


@pytest.fixture
def network(tmp_path):
    torch.manual_seed(0)
    net = Gscm("small")
    path = tmp_path / "net.safetensors"
    checkpoint.save_network(path, net, {})
    return path


def test_the_network_gives_one_map_for_all(photo, network):
    scene = colourful()
    style = Style(image=str(photo), method="gscm", checkpoint=str(network))
    maps = style_maps(scene, style)
    assert maps.splats.shape == (1, 3, 4)
    assert torch.equal(maps.splats[0], maps.sky) and torch.equal(maps.sky, maps.picture)
    again = style_maps(colourful(), style)
    assert equal(maps, again)
    half = style_maps(scene, style.model_copy(update={"strength": 0.5}))
    torch.testing.assert_close(
        half.sky, torch.lerp(torch.eye(3, 4), maps.sky, 0.5), rtol=0, atol=1e-5
    )


BLUE = (0.6, 0.7, 0.9)  # of a drive
STYLE = Style(preset="dusk")
RED = torch.tensor([[0, 0, 0, 0.9], [0, 0, 0, 0.1], [0, 0, 0, 0.1]])
GREEN = torch.tensor([[0, 0, 0, 0.1], [0, 0, 0, 0.9], [0, 0, 0, 0.1]])
SEEN = torch.cat([0.03**2 * torch.eye(3), torch.tensor(BLUE)[:, None]], 1)


def maps(splats: torch.Tensor = GREEN[None], seen: torch.Tensor | None = SEEN) -> StyleMaps:
    return StyleMaps(splats, RED, torch.eye(3, 4), seen)


def ball(mean, rgb=BLUE) -> Gaussians:
    return one_gaussian(mean, 1.0, 0.9, rgb)


def scene_of(*balls: Gaussians, sky=BLUE) -> Scene:
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


def test_the_sky_has_to_be_seen():
    """Splats always let a little through, and the light of two walls' gaps is no sky."""
    walls = [wall(x, (-9, 9), (-6, 9)) for x in (4.0, 4.1)]
    assert SKY in content_statistics(drive(walls[0]), per_region=True)
    assert list(content_statistics(drive(*walls), per_region=True)) == [WHOLE, LAND]


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


def test_bits_do_not_depend_on_threads():
    scene = dataclasses.replace(fitted_scene(), actors=())
    found = content_statistics(scene, per_region=True)
    pictures = content_pictures(scene)
    scene = dataclasses.replace(scene)  # another object: nothing is remembered
    limit_threads(2)
    assert same(content_statistics(scene, per_region=True), found)
    assert torch.equal(content_pictures(scene), pictures)
