"""Folding a style into SH and sky: against the definition, the algebra, and to the bit."""

import dataclasses

import pytest
import torch
from fitted_scenes import fitted_scene
from scenes import camera_ahead, random_gaussians

from augment.effects.style.color_maps import (
    CLASSES,
    StyleMaps,
    map_sh,
    style_actor,
    style_gaussians,
    style_sky,
    styled_scene,
)
from augment.render.composite import composite_sky, map_colors
from augment.render.cuda import runtime as gpu
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0, evaluate_sh
from augment.render.threads import limit_threads
from augment.scene import Actor, ColorWaves, PosedGaussians, Track
from augment.sky import ConstantSky, CubemapSky, LatLongSky
from tests.augment.pretend_gpu import pretended_gpu

IDENTITY_MAPS = StyleMaps(torch.eye(3, 4)[None], torch.eye(3, 4), torch.eye(3, 4))


def some_map(seed: int = 0, size: float = 0.2) -> torch.Tensor:
    return torch.eye(3, 4) + size * torch.randn(3, 4, generator=torch.Generator().manual_seed(seed))


def maps_of(splats: torch.Tensor) -> StyleMaps:
    return StyleMaps(splats, some_map(1), some_map(2))


def maps_by_class() -> StyleMaps:
    splats = torch.stack([some_map(seed) for seed in range(CLASSES)])
    splats[3] = torch.eye(3, 4)
    return maps_of(splats)


def with_classes(count: int, sh_degree: int, *, runs: bool = False):
    gaussians = random_gaussians(count, sh_degree=sh_degree)
    classes = torch.randint(0, CLASSES, (count,), generator=torch.Generator().manual_seed(5))
    classes = (classes.sort().values if runs else classes).short()
    return dataclasses.replace(gaussians, semantic=classes)


def directions(count: int) -> torch.Tensor:
    drawn = torch.randn(count, 3, generator=torch.Generator().manual_seed(9))
    return torch.nn.functional.normalize(drawn, dim=1)


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
@pytest.mark.parametrize("backend, count", [("cpu", 7), ("cpu", 4500), ("cuda", 7)])
def test_the_kernel_equals_the_definition(backend, sh_degree, count):
    """Sizes that no run, no register and no program divides; sums of three products round alike."""
    gaussians = with_classes(count, sh_degree)
    for maps in (maps_of(some_map()[None]), maps_by_class()):
        classes = None if len(maps.splats) == 1 else gaussians.semantic
        expected = map_sh(gaussians.sh, maps.splats, classes)
        got = style_gaussians(gaussians, maps, backend=backend).sh.cpu()
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6)


def test_colours_are_mapped_in_every_direction():
    gaussians = random_gaussians(400, sh_degree=3)
    color_map, towards = some_map(), directions(400)
    before = 0.5 + evaluate_sh(gaussians.sh, towards)
    after = 0.5 + evaluate_sh(style_gaussians(gaussians, maps_of(color_map[None])).sh, towards)
    expected = before @ color_map[:, :3].T + color_map[:, 3]
    torch.testing.assert_close(after, expected, rtol=0, atol=1e-5)  # sums of 16 terms, float32


def test_every_class_takes_its_own_map():
    gaussians, maps = with_classes(600, 1, runs=True), maps_by_class()
    styled = style_gaussians(gaussians, maps).sh
    for value in range(CLASSES):
        own = gaussians.semantic == value
        alone = style_gaussians(gaussians.select(own), maps_of(maps.splats[value : value + 1])).sh
        assert torch.equal(styled[own], alone)
    assert torch.equal(styled[gaussians.semantic == 3], gaussians.sh[gaussians.semantic == 3])


def test_gaussians_without_classes_take_the_map_of_unknown():
    gaussians, maps = random_gaussians(50, sh_degree=1), maps_by_class()
    expected = style_gaussians(gaussians, maps_of(maps.splats[:1]))
    assert torch.equal(style_gaussians(gaussians, maps).sh, expected.sh)


@pytest.mark.parametrize("backend", ["cpu", "cuda"])
def test_identities_leave_every_bit(backend):
    gaussians = with_classes(100, 2)
    odd = torch.tensor([-0.0, float("nan"), float("inf"), 1e-42])
    gaussians.sh.view(-1)[: len(odd)] = odd
    bits = gaussians.sh.clone().view(torch.int32)
    every = maps_of(torch.eye(3, 4).repeat(CLASSES, 1, 1))
    for maps in (IDENTITY_MAPS, every):
        assert style_gaussians(gaussians, maps, backend=backend) is gaussians
        out = torch.zeros_like(gaussians.sh)
        out = out.to(gpu.gpu_device()) if backend == "cuda" else out
        assert style_gaussians(gaussians, maps, out=out, backend=backend).sh is out
        assert torch.equal(out.cpu().view(torch.int32), bits)
    slow = map_sh(gaussians.sh, torch.eye(3, 4)[None])
    assert torch.equal(slow.view(torch.int32), bits)


def test_only_sh_are_new():
    gaussians = with_classes(20, 1)
    before = gaussians.sh.clone()
    styled = style_gaussians(gaussians, maps_by_class())
    assert styled.sh is not gaussians.sh and torch.equal(gaussians.sh, before)
    for name in ("means", "quats", "scales", "opacities", "semantic"):
        assert getattr(styled, name) is getattr(gaussians, name)


def test_into_given_memory():
    """Its own, in place, and such that does not begin where registers do: all the same bits."""
    gaussians, maps = with_classes(3000, 3), maps_by_class()
    expected = style_gaussians(gaussians, maps).sh
    count = gaussians.sh.numel()
    for shift in (0, 1, 5):
        out = torch.zeros(count + 8)[shift : shift + count].view(gaussians.sh.shape)
        assert style_gaussians(gaussians, maps, out=out).sh is out
        assert torch.equal(out, expected)
    styled = style_gaussians(gaussians, maps, out=gaussians.sh)
    assert styled.sh is gaussians.sh and torch.equal(gaussians.sh, expected)


def test_bits_do_not_depend_on_threads():
    gaussians, maps = with_classes(9000, 3), maps_by_class()
    expected = style_gaussians(gaussians, maps).sh
    try:
        limit_threads(1)
        assert torch.equal(style_gaussians(gaussians, maps).sh, expected)
    finally:
        limit_threads(None)


def test_on_the_gpu_sh_of_either_side_give_new_ones_there_or_change_in_place(monkeypatch):
    """And some maps of classes leave their splats' bits."""
    gaussians, maps = with_classes(80, 3), maps_by_class()
    bits = gaussians.sh.clone()
    expected = style_gaussians(gaussians, maps).sh
    with pretended_gpu(monkeypatch):
        styled = style_gaussians(gaussians, maps, backend="cuda")
        assert styled.sh.device == gpu.gpu_device() and styled.means is gaussians.means
        got = styled.sh.cpu()
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6)
        assert torch.equal(gaussians.sh, bits)
        still = gaussians.semantic == 3
        assert still.any() and torch.equal(got[still], bits[still])
        there = dataclasses.replace(gaussians, sh=gpu.upload(gaussians.sh))
        assert torch.equal(style_gaussians(there, maps).sh.cpu(), got)
        in_place = style_gaussians(there, maps, out=there.sh).sh
        assert in_place is there.sh and torch.equal(in_place.cpu(), got)
        with pytest.raises(ValueError, match="out must lie on meta"):
            style_gaussians(gaussians, maps, out=torch.zeros_like(bits), backend="cuda")


@pytest.mark.parametrize("backend", ["cpu", "cuda"])
def test_none_and_strided_and_float64(backend):
    maps = maps_by_class()
    none = with_classes(5, 1).select(torch.zeros(0, dtype=torch.long))
    assert style_gaussians(none, maps, backend=backend).sh.shape == (0, 4, 3)
    wide = with_classes(40, 3)
    strided = dataclasses.replace(wide, sh=wide.sh[:, :4])
    tight = dataclasses.replace(wide, sh=wide.sh[:, :4].contiguous())
    assert torch.equal(
        style_gaussians(strided, maps, backend=backend).sh,
        style_gaussians(tight, maps, backend=backend).sh,
    )
    double = random_gaussians(40, sh_degree=1, dtype=torch.float64)
    single = random_gaussians(40, sh_degree=1)
    styled = style_gaussians(double, maps, backend=backend)
    assert styled.sh.dtype == torch.float64
    torch.testing.assert_close(
        styled.sh.float(), style_gaussians(single, maps).sh, rtol=1e-6, atol=1e-6
    )


def test_gradients_flow_through_the_definition():
    gaussians = random_gaussians(5, sh_degree=1)
    sh = gaussians.sh.clone().requires_grad_()
    color_map = some_map()
    styled = style_gaussians(dataclasses.replace(gaussians, sh=sh), maps_of(color_map[None]))
    styled.sh.sum().backward()
    expected = color_map[:, :3].sum(0).expand(sh.shape)
    torch.testing.assert_close(sh.grad, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("wrong", [-1, CLASSES])
def test_classes_without_a_map_are_refused(wrong):
    gaussians = with_classes(5, 0)
    gaussians.semantic[2] = wrong
    with pytest.raises(ValueError, match=rf"maps for classes 0 to {CLASSES - 1}.*{wrong}"):
        style_gaussians(gaussians, maps_by_class())
    style_gaussians(gaussians, maps_of(some_map()[None]))  # one map asks for no class


@pytest.mark.parametrize(
    "out", [torch.zeros(5, 1, 4)[..., :3], torch.zeros(4, 1, 3), torch.zeros(5, 1, 3).double()]
)
def test_memory_that_does_not_fit_is_refused(out):
    with pytest.raises(ValueError, match=r"contiguous torch.float32 \[5, 1, 3\]"):
        style_gaussians(with_classes(5, 0), maps_of(some_map()[None]), out=out)


def test_a_styled_scene_shows_the_mapped_picture():
    """Where no clamp acts: pale colours and a gentle map."""
    gaussians = random_gaussians(200, sh_degree=1)
    gaussians.sh.mul_(0.3)
    color_map = some_map(size=0.05)
    camera, sky = camera_ahead(), ConstantSky(torch.tensor([0.4, 0.5, 0.6]))
    pictures = []
    for splats, behind in (
        (gaussians, sky),
        (style_gaussians(gaussians, maps_of(color_map[None])), style_sky(sky, color_map)),
    ):
        seen = rasterize([PosedGaussians(splats)], camera)
        pictures.append(composite_sky(seen.rgb, seen.alpha, camera, behind))
    expected = map_colors(pictures[0], color_map, backend="reference")
    torch.testing.assert_close(pictures[1], expected, rtol=0, atol=2e-5)  # blends of 200 splats
    assert (pictures[1] - pictures[0]).abs().max() > 0.01


SKIES = (
    ConstantSky(torch.tensor([0.3, 0.5, 0.7])),
    LatLongSky(0.3 + 0.3 * torch.rand(5, 9, 3, generator=torch.Generator().manual_seed(0))),
    CubemapSky(0.3 + 0.3 * torch.rand(6, 4, 4, 3, generator=torch.Generator().manual_seed(0))),
)


class OwnSky:
    """None of the known ones."""

    def sample(self, directions):
        return (0.5 + 0.2 * torch.nn.functional.normalize(directions, dim=-1)).clamp(0, 1)


@pytest.mark.parametrize("sky", [*SKIES, OwnSky()], ids=lambda sky: type(sky).__name__)
def test_skies(sky):
    towards, color_map = directions(200), some_map(size=0.05)
    expected = sky.sample(towards) @ color_map[:, :3].T + color_map[:, 3]
    assert expected.min() > 0 and expected.max() < 1
    torch.testing.assert_close(
        style_sky(sky, color_map).sample(towards), expected, rtol=0, atol=1e-6
    )
    assert style_sky(sky, torch.eye(3, 4)) is sky
    extreme = style_sky(sky, 9 * some_map()).sample(towards)
    assert extreme.min() >= 0 and extreme.max() <= 1


def test_a_styled_scene_keeps_everything_else():
    scene, maps = fitted_scene(), maps_by_class()
    styled = styled_scene(scene, maps)
    same = [f.name for f in dataclasses.fields(scene) if f.name not in changed]
    assert all(getattr(styled, name) is getattr(scene, name) for name in same)
    assert torch.equal(styled.background.sh, style_gaussians(scene.background, maps).sh)
    assert torch.equal(styled.sky.faces, style_sky(scene.sky, maps.sky).faces)
    for before, after in zip(scene.actors, styled.actors, strict=True):
        assert torch.equal(after.gaussians.sh, style_gaussians(before.gaussians, maps).sh)
        assert after.gaussians.means is before.gaussians.means
        for name in ("track_id", "label", "track", "size_m"):
            assert getattr(after, name) is getattr(before, name)
    same_bits = styled_scene(scene, IDENTITY_MAPS)
    assert same_bits.background is scene.background and same_bits.sky is scene.sky


changed = {"background", "actors", "sky"}


@pytest.mark.parametrize("backend", ["reference", "cpu", "cuda"])
def test_without_directions_a_colour_below_0_is_mapped_as_the_black_that_it_shows(backend):
    dark = dataclasses.replace(random_gaussians(3, sh_degree=0), sh=torch.full((3, 1, 3), -9.0))
    lift = torch.cat([0.5 * torch.eye(3), torch.tensor([[0.2], [0.1], [0.3]])], 1)
    maps = StyleMaps(lift[None], lift, lift)
    colors = 0.5 + SH_C0 * style_gaussians(dark, maps, backend=backend).sh[:, 0].cpu()
    torch.testing.assert_close(colors, lift[:, 3].expand(3, 3), rtol=0, atol=1e-6)


def test_colours_that_change_over_time_are_mapped_at_all_times():
    gaussians = with_classes(50, 1)
    waves = ColorWaves(
        0.1 * torch.randn(50, 4, 3, generator=torch.Generator().manual_seed(3)),
        torch.tensor([0, 1_000]),
        torch.tensor([0.0, 1.0], dtype=torch.float64),
    )
    track = Track(torch.tensor([0]), torch.eye(4, dtype=torch.float64)[None])
    actor = Actor("a", "car", gaussians, track, (4.0, 2.0, 1.5), waves)
    for maps in (maps_of(some_map()[None]), maps_by_class()):
        styled = style_actor(actor, maps)
        for timestamp_ns in (0, 300, 1_000):
            expected = style_gaussians(actor.gaussians_at(timestamp_ns), maps).sh
            got = styled.gaussians_at(timestamp_ns).sh
            torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)
