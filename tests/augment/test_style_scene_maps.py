"""From a style to a scene's maps, by every method."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from fitted_scenes import fitted_scene
from snow_scenes import drive, sheet, wall

from augment.effects.style import network as checkpoint
from augment.effects.style import style as scene_maps
from augment.effects.style.color_maps import CLASSES, StyleMaps, styled_scene
from augment.effects.style.content import content_pictures, content_statistics
from augment.effects.style.images import StyleImage, image_statistics, read_style_image
from augment.effects.style.network import Gscm
from augment.effects.style.statistics import LAND, SKY
from augment.effects.style.style import style_maps
from augment.errors import StyleError
from augment.memo import memo_of
from recipes.style import Style


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


@pytest.mark.parametrize("method", ["mkl", "reinhard"])
def test_strength_is_a_straight_way(photo, method):
    scene = colourful()
    half, whole = (
        style_maps(scene, Style(image=str(photo), method=method, strength=s)) for s in (0.5, 1.0)
    )
    assert not torch.equal(whole.splats[0], torch.eye(3, 4))
    for name in ("splats", "sky", "picture"):
        between = torch.lerp(torch.eye(3, 4), getattr(whole, name), 0.5)
        torch.testing.assert_close(getattr(half, name), between, rtol=0, atol=1e-6)


def test_regions(photo, tmp_path):
    maps = style_maps(fitted_scene(), Style(image=str(photo), per_region=True))
    assert len(maps.splats) == CLASSES
    with pytest.raises(StyleError, match=r"none\.png"):
        style_maps(fitted_scene(), Style(image=str(tmp_path / "none.png")))


def test_remembered_for_the_scene_the_style_and_the_cameras(photo, monkeypatch):
    scene, other = colourful(), colourful()
    style = Style(image=str(photo))
    maps = style_maps(scene, style)
    cameras = [next(iter(scene.frames[0].cameras.values()))]
    with monkeypatch.context() as patch:
        patch.setattr(scene_maps, "closed_maps", None)
        assert style_maps(scene, Style(image=str(photo))) is maps
        calls = [(scene, {"cameras": cameras}), (other, {})]
        for wanted, options in calls:
            with pytest.raises(TypeError):
                style_maps(wanted, style, **options)
        given = StyleMaps(torch.eye(3, 4)[None] / 2, maps.sky, maps.picture)
        memo_of(scene).put(("style maps", style), given, shared=True)
        assert style_maps(scene, style) is given
        assert style_maps(scene, style, cameras=cameras) is given
        with pytest.raises(TypeError):
            style_maps(scene, Style(image=str(photo), strength=0.5))
    assert equal(style_maps(other, style), maps)  # to the bit


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


def test_a_scene_is_looked_at_once_for_all_styles(photo, network, monkeypatch):
    from augment.effects.style import network as net

    looked = []
    original = net.content_side
    monkeypatch.setattr(net, "content_side", lambda *args: looked.append(args) or original(*args))
    scene = colourful()
    for strength in (1.0, 0.5):
        style_maps(
            scene,
            Style(image=str(photo), method="gscm", checkpoint=str(network), strength=strength),
        )
    assert len(looked) == 1
    style_maps(colourful(), Style(image=str(photo), method="gscm", checkpoint=str(network)))
    assert len(looked) == 2


@pytest.mark.parametrize("gain", [0.5, 8.0])
def test_the_networks_gains_are_limited(photo, network, monkeypatch, gain):
    """A map that is too steep is flattened about the content's mean."""
    color_map = torch.cat([gain * torch.eye(3), torch.full((3, 1), 0.1)], 1)
    monkeypatch.setattr("augment.effects.style.network.content_side", lambda *_: torch.eye(3, 4))
    monkeypatch.setattr("augment.effects.style.network.style_side", lambda *_: color_map)
    scene = colourful()
    style = Style(image=str(photo), method="gscm", checkpoint=str(network))
    found = style_maps(scene, style).sky
    mean = content_pictures(scene).mean((0, 2, 3))
    expected = color_map[:, :3] @ mean + color_map[:, 3]
    torch.testing.assert_close(found[:, :3] @ mean + found[:, 3], expected, rtol=1e-5, atol=1e-5)
    gains = torch.linalg.svdvals(found[:, :3])
    assert gains.max() == pytest.approx(min(gain, scene_maps.LAND_LIMITS.max_gain), rel=1e-6)
    if gain < 1:
        assert torch.equal(found, color_map)


def test_a_network_without_a_finite_map_says_so(photo, network, monkeypatch):
    monkeypatch.setattr(
        "augment.effects.style.network.style_side", lambda *_: torch.full((3, 4), float("nan"))
    )
    style = Style(image=str(photo), method="gscm", checkpoint=str(network))
    with pytest.raises(StyleError, match=r"no finite map.*use another checkpoint"):
        style_maps(colourful(), style)


def test_the_network_sees_what_counts_of_the_image():
    """A square of any shape; what is transparent takes the mean of the rest."""
    rgb = np.zeros((4, 6, 3), np.float32)
    rgb[:, :3], rgb[:, 3:] = (0.2, 0.4, 0.6), (0.9, 0.0, 0.0)
    weights = np.ones((4, 6), np.float32)
    square = scene_maps._style_picture(StyleImage(rgb, weights, weights > 2))
    assert square.shape == (1, 3, 256, 256) and square.dtype == torch.float32
    assert torch.allclose(square[0, :, 100, 0], torch.tensor([0.2, 0.4, 0.6]), atol=1e-6)
    weights[:, 3:] = 0
    plain = scene_maps._style_picture(StyleImage(rgb, weights, weights > 2))
    expected = torch.tensor([0.2, 0.4, 0.6])[:, None, None].expand(3, 256, 256)
    assert torch.allclose(plain[0], expected, atol=1e-6)
    one = StyleImage(rgb[:1, :1].copy(), weights[:1, :1].copy(), np.zeros((1, 1), bool))
    assert torch.allclose(scene_maps._style_picture(one)[0], expected, atol=1e-6)
