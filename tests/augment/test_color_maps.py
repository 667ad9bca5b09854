"""Colour maps on the Gaussians of a part: kernel against definition, and what they leave alone."""

import dataclasses

import pytest
import torch

from augment.render.fog import Fog
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians, SplatShading
from tests.assertions import assert_images_close
from tests.scenes import camera_ahead, random_gaussians, random_pose

CLASSES = 5
SMOG = Fog(0.2, (0.7, 0.75, 0.8), None, 0.0)


def some_maps(count: int, seed: int = 0, spread: float = 0.3) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    return torch.eye(3, 4) + spread * (torch.rand(count, 3, 4, generator=rng) - 0.5)


def labelled(seed: int = 0, count: int = 300) -> Gaussians:
    rng = torch.Generator().manual_seed(seed)
    semantic = torch.randint(0, CLASSES, (count,), generator=rng, dtype=torch.int16)
    return dataclasses.replace(random_gaussians(count, seed=seed), semantic=semantic)


def folded(gaussians: Gaussians, maps: torch.Tensor) -> Gaussians:
    """The maps put into the spherical harmonics, one Gaussian at a time."""
    c0, sh = 0.28209479177387814, gaussians.sh.double().clone()
    for i in range(len(gaussians)):
        kind = 0 if gaussians.semantic is None else int(gaussians.semantic[i])
        matrix, offset = maps[kind, :, :3].double(), maps[kind, :, 3].double()
        mean = matrix @ (c0 * sh[i, 0] + 0.5) + offset
        sh[i] = sh[i] @ matrix.T
        sh[i, 0] = (mean - 0.5) / c0
    return dataclasses.replace(gaussians, sh=sh.float())


@pytest.mark.parametrize(("count", "smog"), [(1, SMOG), (CLASSES, None)])
def test_the_kernel_maps_as_the_definition_does(count, smog):
    parts = [
        PosedGaussians(labelled(1), color_maps=some_maps(count)),
        PosedGaussians(labelled(2), random_pose(), 1, color_maps=some_maps(count, 3)),
        PosedGaussians(random_gaussians(100, seed=4), color_maps=some_maps(count, 5)),
        PosedGaussians(random_gaussians(100, seed=6, sh_degree=1)),
    ]
    fast, slow = (
        rasterize(parts, camera_ahead(), fog=smog, backend=name) for name in ("cpu", "reference")
    )
    assert_images_close(fast.rgb, slow.rgb, max_flips=2)
    assert_images_close(fast.alpha, slow.alpha, max_flips=2)
    bare = rasterize([dataclasses.replace(p, color_maps=None) for p in parts], camera_ahead())
    assert (fast.rgb - bare.rgb).abs().max() > 0.02
    assert torch.equal(fast.alpha, bare.alpha)


@pytest.mark.parametrize("count", [1, CLASSES])
def test_where_nothing_is_clamped_a_map_is_one_on_the_coefficients(count):
    gaussians = labelled(7)
    dim = dataclasses.replace(gaussians, sh=gaussians.sh * 0.1)  # every colour near 0.5
    maps = some_maps(count, 8)
    once = dim if count > 1 else dataclasses.replace(dim, semantic=None)
    seen = rasterize([PosedGaussians(dim, color_maps=maps)], camera_ahead()).rgb
    assert_images_close(seen, rasterize([PosedGaussians(folded(once, maps))], camera_ahead()).rgb)


def test_the_identity_changes_no_bit():
    gaussians = labelled(9)
    bare = rasterize([PosedGaussians(gaussians)], camera_ahead()).rgb
    same = torch.eye(3, 4).repeat(CLASSES, 1, 1)
    for maps in (same[:1], same):
        assert torch.equal(
            rasterize([PosedGaussians(gaussians, color_maps=maps)], camera_ahead()).rgb, bare
        )


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_classes_without_a_map_take_the_first(backend):
    gaussians = labelled(10)
    beyond = dataclasses.replace(
        gaussians, semantic=torch.where(gaussians.semantic == 0, 30, gaussians.semantic).short()
    )
    negative = dataclasses.replace(
        gaussians, semantic=torch.where(gaussians.semantic == 0, -1, gaussians.semantic).short()
    )
    maps = some_maps(CLASSES, 11)
    images = [
        rasterize([PosedGaussians(g, color_maps=maps)], camera_ahead(), backend=backend).rgb
        for g in (gaussians, beyond, negative)
    ]
    assert torch.equal(images[0], images[1]) and torch.equal(images[0], images[2])


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_rows_come_before_classes(backend):
    gaussians = labelled(10)
    rows = torch.arange(len(gaussians), dtype=torch.int16) % CLASSES
    maps = some_maps(CLASSES, 11)
    chosen = PosedGaussians(gaussians, color_maps=maps, color_rows=rows)
    instead = PosedGaussians(dataclasses.replace(gaussians, semantic=rows), color_maps=maps)
    images = [rasterize([p], camera_ahead(), backend=backend).rgb for p in (chosen, instead)]
    assert torch.equal(*images)
    with pytest.raises(ValueError, match=r"color_rows must be int16 \[300\]"):
        rasterize([dataclasses.replace(chosen, color_rows=rows[1:])], camera_ahead())


@pytest.mark.parametrize(
    ("maps", "words"),
    [
        (torch.zeros(0, 3, 4), r"\[C, 3, 4\] with C >= 1; got \[0, 3, 4\]"),
        (torch.full((1, 3, 4), torch.nan), "finite"),
        (torch.zeros(1, 3, 4, dtype=torch.int32), "finite floats"),
    ],
)
def test_maps_that_are_none_are_refused(maps, words):
    part = PosedGaussians(random_gaussians(3))
    object.__setattr__(part, "color_maps", maps)  # past what the tests' type checks refuse
    with pytest.raises(ValueError, match=words):
        rasterize([part], camera_ahead())


def test_light_per_pixel_is_not_mapped():
    gaussians = random_gaussians(3)
    light = SplatShading(torch.ones(3, 3), (0.0, 0.0, 1.0), 0.5)
    part = PosedGaussians(gaussians, shading=light, color_maps=some_maps(1))
    with pytest.raises(ValueError, match="light per pixel"):
        rasterize([part], camera_ahead())
