"""Tile lists on the GPU and its whole rasteriser: against stored renders, against the definition,
against the CPU's kernels and against itself. Without a GPU the kernels are interpreted.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch

from augment.render.buffers import (
    ALPHA,
    BUFFERS,
    CPU,
    CUDA,
    EXPECTED_DEPTH,
    MEDIAN_DEPTH,
    MODE_DEPTH,
    OVERLAY,
    RGB,
    SPLAT_IDS,
    RenderOutput,
)
from augment.render.constants import RasterSettings
from augment.render.cuda import runtime as gpu
from augment.render.cuda.driver import list_tiles
from augment.render.cuda.splats import BLOCK, HIDDEN, TILE, CudaSplats, CudaTiles
from augment.render.fog import Fog
from augment.render.fog_banks import FogBanks
from augment.render.fog_image import apply_fog_to_render
from augment.render.layout import SURFACE_DEPTHS_ONLY, HeightClip
from augment.render.rasterize import rasterize
from augment.scene.scene import Gaussians, PosedGaussians
from tests.assertions import assert_images_close, assert_labels_equal, assert_stored_render
from tests.augment.hard_scenes import (
    KINDS,
    SMOGS,
    colour_maps,
    hard_gaussians,
    in_weather,
    snow_light,
    wide_camera,
)
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu
from tests.scenes import (
    GOLDEN,
    camera_ahead,
    golden_view,
    one_gaussian,
    parts_in_float64,
    random_gaussians,
    slight_pose,
    stack,
)

ALL = frozenset(BUFFERS)
DEFAULT = RasterSettings()
LONG = pytest.mark.long


def as_given(parts) -> list[PosedGaussians]:
    return [PosedGaussians(parts)] if isinstance(parts, Gaussians) else parts


def on_cpu(output: RenderOutput) -> RenderOutput:
    fields = {f.name: getattr(output, f.name) for f in dataclasses.fields(output)}
    return RenderOutput(**{n: None if v is None else v.cpu() for n, v in fields.items()})


def render(parts, camera, buffers=ALL, settings=DEFAULT, **more) -> RenderOutput:
    return on_cpu(
        rasterize(as_given(parts), camera, buffers=buffers, settings=settings, backend=CUDA, **more)
    )


def assert_same_bits(actual, expected, buffers=ALL):
    for name in buffers:
        assert torch.equal(getattr(actual, name), getattr(expected, name)), name


def assert_agrees(actual, expected, *, max_flips=2, depth_p999=2e-4):
    """As far as float32 allows: forty blends, an exp2 good to 3e-6, depths of up to 9 m."""
    for name in (RGB, ALPHA, OVERLAY):
        a, b = getattr(actual, name), getattr(expected, name)
        assert_images_close(a, b, p999=1e-5, max_flips=max_flips)
    for name, more in ((EXPECTED_DEPTH, 0), (MEDIAN_DEPTH, 2), (MODE_DEPTH, 4)):
        # A pixel may name the next splat, or leave a sample out of a cluster, by another rounding.
        a, b = getattr(actual, name), getattr(expected, name)
        assert_images_close(a, b, p999=depth_p999, flip=5e-3, max_flips=max_flips + more)
    assert_labels_equal(actual.splat_ids, expected.splat_ids, max_flips=max_flips + 2)


def assert_matches_definition(
    parts, camera, settings=DEFAULT, *, max_flips=2, depth_p999=2e-4, smog=None, clip=None
):
    parts = as_given(parts)
    actual = render(parts, camera, ALL, settings, fog=smog, clip=clip)
    expected = rasterize(
        parts_in_float64(parts),
        camera,
        buffers=ALL,
        settings=settings,
        fog=smog,
        clip=clip,
        backend="reference",
    )
    assert_agrees(actual, expected, max_flips=max_flips, depth_p999=depth_p999)


# ---- tile lists --------------------------------------------------------------------------------


def brute_force_lists(splats: CudaSplats, columns: int, rows: int) -> list[list[int]]:
    lists: list[list[int]] = [[] for _ in range(columns * rows)]
    for row in np.argsort(splats.keys.cpu().numpy(), kind="stable").tolist():
        if splats.counts[row] > 0:
            first, last = splats.rects[row].tolist()
            spans = zip(divmod(first, 1 << 16), divmod(last, 1 << 16), strict=True)
            for down, across in itertools.product(*(range(a, b + 1) for a, b in spans)):
                lists[down * columns + across].append(row)
    return lists


def listed(tiles: CudaTiles) -> list[list[int]]:
    ids = tiles.tile_splat_ids.cpu().tolist()
    return [ids[a:b] for a, b in itertools.pairwise(tiles.tile_offsets.cpu().tolist())]


def random_splats(count: int, columns: int, rows: int, seed: int = 0) -> CudaSplats:
    """A third is hidden; few depths, so that most are shared."""
    rng = np.random.default_rng(seed)
    across = np.sort(rng.integers(0, columns, (count, 2)), 1)
    down = np.sort(rng.integers(0, rows, (count, 2)), 1)
    counts = (across[:, 1] - across[:, 0] + 1) * (down[:, 1] - down[:, 0] + 1)
    keys = rng.integers(1, 9, count).astype(np.float32).view(np.int32)
    hidden = rng.random(count) < 1 / 3
    counts[hidden], keys[hidden] = 0, HIDDEN
    rects = (across + (down << 16)).astype(np.int32)
    rects[hidden] = -1
    arrays = (np.empty((count, 16), np.float32), keys, rects, counts.astype(np.int32))
    return CudaSplats(*(torch.from_numpy(a).to(gpu.gpu_device()) for a in arrays), None, None)


@pytest.mark.parametrize(
    ("count", "columns", "rows"), [(300, 5, 3), pytest.param(3, 200, 170, marks=LONG), (0, 3, 2)]
)
def test_lists_hold_every_pair_once_in_order_of_depth(count, columns, rows):
    """34 000 tiles do not fit into 16 bits."""
    splats = random_splats(count, columns, rows)
    camera = camera_ahead(columns * TILE - 3, rows * TILE)
    tiles = list_tiles(splats, camera, None)
    assert (tiles.columns, tiles.rows) == (columns, rows)
    assert tiles.tile_splat_ids.dtype == tiles.tile_offsets.dtype == torch.int32
    assert listed(tiles) == brute_force_lists(splats, columns, rows)


def test_tiles_without_a_wanted_pixel_own_nothing():
    splats, camera = random_splats(200, 5, 4), camera_ahead(5 * TILE - 7, 4 * TILE - 1)
    wanted = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    wanted[17, 33] = wanted[-1, -1] = wanted[30, 0] = True
    tiles = list_tiles(splats, camera, wanted.to(gpu.gpu_device()))
    drawn = {1 * 5 + 2, 3 * 5 + 4, 1 * 5}
    expected = brute_force_lists(splats, 5, 4)
    assert listed(tiles) == [own if i in drawn else [] for i, own in enumerate(expected)]
    none = list_tiles(splats, camera, torch.zeros_like(wanted).to(gpu.gpu_device()))
    assert listed(none) == [[]] * 20


# ---- the whole rasteriser ----------------------------------------------------------------------


@pytest.mark.parametrize("size", [(17, 9), (1, 1)], ids=str)
def test_random_splats(size):
    camera = camera_ahead(*size, 0.9 * max(size))
    assert_matches_definition(random_gaussians(30, seed=sum(size), size=0.4), camera)


@LONG
def test_no_pixel_is_lost_to_the_look_at_blocks():
    """Thin splats in all directions, whose ellipses graze blocks: every pixel that the definition
    gives them gets its share.
    """
    scene = random_gaussians(150, seed=3, sh_degree=0)
    thin = dataclasses.replace(
        scene,
        scales=torch.tensor([[0.5, 0.004, 0.004]]).expand(150, 3),
        opacities=torch.full((150,), 0.02),  # so that nothing hides what is behind
    )
    camera, alpha = camera_ahead(48, 32, 45.0), frozenset({ALPHA})
    expected = rasterize(
        parts_in_float64(as_given(thin)), camera, buffers=alpha, backend="reference"
    )
    # A lost share is 1/255 and more; at the cut itself another rounding may take or give one.
    actual = render(thin, camera, alpha).alpha
    assert_images_close(actual, expected.alpha, p999=1e-5, flip=1e-3, max_flips=6)


def test_bits_do_not_depend_on_the_buffers_asked_for():
    parts, camera = random_gaussians(25, size=0.5), camera_ahead(17, 9, 16.0)
    whole = render(parts, camera)
    for buffer in (RGB, SPLAT_IDS):
        alone = render(parts, camera, frozenset({buffer}))
        assert_same_bits(alone, whole, {buffer})
        assert all(getattr(alone, name) is None for name in ALL - {buffer})


@LONG
@pytest.mark.parametrize(("name", "mode"), GOLDEN)
def test_stored_renders(shared_dir, name, mode):
    if gpu.is_interpreted() and (name, mode) != ("opaque", "a99_aa"):
        pytest.skip("interpreted kernels take minutes")
    parts, camera, settings, arrays = golden_view(shared_dir, name, mode)
    buffers = frozenset({RGB, ALPHA, EXPECTED_DEPTH})
    assert_stored_render(render(parts, camera, buffers, settings), arrays)


@LONG
@pytest.mark.parametrize(
    "settings",
    [
        RasterSettings(antialiased=True, sh_degree=1),
        RasterSettings(alpha_max=0.99, near_m=1.5),
        RasterSettings(transmittance_stop=0.05, radius_clip_px=2.5),
    ],
    ids=["antialiased", "near and alpha_max", "coarse"],
)
def test_settings(settings):
    assert_matches_definition(random_gaussians(60, size=0.4), camera_ahead(25, 19, 20.0), settings)


def test_all_kinds_of_parts():
    """A street, an actor, snow lit pixel by pixel, splats under colour maps of their rows and of
    their classes; more than a block holds; seen through smog.
    """
    seen, actor = random_gaussians(20, size=0.4), random_gaussians(9, seed=1, sh_degree=1)
    unseen = random_gaussians(240)
    street = stack(seen, dataclasses.replace(unseen, means=-unseen.means.abs() - 1))
    lit = random_gaussians(9, seed=2, sh_degree=0, size=0.5)
    styled = random_gaussians(9, seed=3, sh_degree=2)
    rows = torch.arange(9, dtype=torch.int16) - 2  # rows that are none mean the first map
    assert len(street) > BLOCK
    parts = [
        PosedGaussians(street),
        PosedGaussians(actor, slight_pose(), 1),
        PosedGaussians(lit, is_overlay=True, shading=snow_light(9)),
        PosedGaussians(styled, color_maps=colour_maps(), color_rows=rows),
        PosedGaussians(dataclasses.replace(styled, semantic=rows), color_maps=colour_maps(2)),
        PosedGaussians(Gaussians.empty(sh_degree=1)),
    ]
    assert_matches_definition(parts, camera_ahead(16, 9, 13.0), smog=SMOGS["layered"])


@pytest.mark.parametrize(
    ("clip", "is_orthographic"),
    [
        pytest.param(SURFACE_DEPTHS_ONLY, False, marks=LONG),
        pytest.param(HeightClip(0.1, "above"), False, marks=LONG),
        pytest.param(HeightClip(0.1, "below", max_distance_m=0.5), False, marks=LONG),
        (HeightClip(0.2, "below", has_overlap=True), True),
    ],
)
def test_clips_and_parallel_rays(clip, is_orthographic):
    camera = camera_ahead(17, 13, 14.0, position=(0.0, 0.0, 0.9))
    if is_orthographic:
        camera = dataclasses.replace(camera, is_orthographic=True, fx=4.0, fy=4.5)
    parts = [
        PosedGaussians(random_gaussians(40, size=0.5, sh_degree=1)),
        PosedGaussians(random_gaussians(20, seed=1, sh_degree=0, size=0.5), slight_pose(), 1),
    ]
    # Where a cut leaves little of a pixel, its depth is a small sum over a small alpha.
    assert_matches_definition(parts, camera, clip=clip, max_flips=4, depth_p999=2e-3)


WEATHERS = (*SMOGS, "above", "below", "light", "maps")


@pytest.mark.parametrize(
    ("kind", "weather"),
    [
        ("needles", "clear"),
        *(pytest.param(*p, marks=LONG) for p in zip(itertools.cycle(KINDS), WEATHERS)),
    ],
)
def test_hard_scenes(kind, weather):
    """Finite and in range whatever comes, and as the CPU's kernels draw it."""
    camera = wide_camera(100.0, (17, 9))
    parts = [in_weather(hard_gaussians(kind, camera, 16), weather)]
    clip = HeightClip(0.1, weather) if weather in ("above", "below") else None
    actual = render(parts, camera, fog=SMOGS.get(weather), clip=clip)
    for name in ALL - {SPLAT_IDS}:
        assert bool(torch.isfinite(getattr(actual, name)).all()), name
    expected = rasterize(parts, camera, buffers=ALL, fog=SMOGS.get(weather), clip=clip, backend=CPU)
    # Of balls and needles kilometres long, float32 keeps three digits of where a pixel lies.
    assert_images_close(actual.rgb, expected.rgb, p999=1e-3, flip=5e-3, max_flips=4)
    assert_images_close(actual.alpha, expected.alpha, p999=1e-3, flip=5e-3, max_flips=4)
    assert_labels_equal(actual.splat_ids, expected.splat_ids, max_flips=6)


def test_nothing_to_see():
    camera = camera_ahead(19, 7)
    behind, aside = one_gaussian(mean=(-4.0, 0.0, 0.0)), one_gaussian(mean=(4.0, 90.0, 0.0))
    for parts in (
        Gaussians.empty(3),
        stack(behind, aside, one_gaussian(opacity=0.0039)),
        [PosedGaussians(Gaussians.empty()), PosedGaussians(behind, slight_pose())],
    ):
        output = render(parts, camera)
        for name in ALL - {SPLAT_IDS}:
            assert torch.count_nonzero(getattr(output, name)) == 0
        assert (output.splat_ids == -1).all()


def test_equal_depths_keep_the_order_of_indices():
    """Layers at one depth: what is seen depends on their order alone."""
    layers = [one_gaussian(opacity=0.3, rgb=(i % 7 / 7, 0.5, i / 40)) for i in range(40)]
    assert_matches_definition(stack(*layers), camera_ahead(17, 5, 15.0), max_flips=0)


def test_wanted_pixels_have_the_bits_of_the_whole_image():
    parts, camera = random_gaussians(20, size=0.3), camera_ahead(18, 18, 16.0)
    wanted = torch.zeros(18, 18, dtype=torch.bool)
    wanted[17, 16:] = True
    whole = render(parts, camera)
    partly = render(parts, camera, pixel_mask=wanted)
    for name in ALL:
        assert torch.equal(getattr(partly, name)[wanted], getattr(whole, name)[wanted]), name
    assert torch.count_nonzero(partly.alpha[:16]) == 0


def test_everything_lies_on_the_gpu(monkeypatch):
    """A pretended one, which refuses what a real one would; and the bits are the same there."""
    street = PosedGaussians(random_gaussians(9, size=0.4))
    snow = PosedGaussians(
        random_gaussians(6, seed=2, sh_degree=0), is_overlay=True, shading=snow_light(6)
    )
    camera, clip = camera_ahead(18, 9, 16.0), HeightClip(-0.2, "above")
    settings = RasterSettings(transmittance_stop=0.02)
    arguments = {"buffers": ALL, "settings": settings, "clip": clip, "backend": CUDA}
    wanted = torch.ones(camera.height, camera.width, dtype=torch.bool)
    expected = rasterize([street, snow], camera, **arguments)
    with pretended_gpu(monkeypatch):
        output = rasterize([street, snow], camera, pixel_mask=wanted, **arguments)
        assert all(isinstance(getattr(output, name), AwayTensor) for name in ALL)
        held = on_cpu(output)
    assert_same_bits(held, on_cpu(expected))


def test_gaussians_within_a_larger_tensor(monkeypatch):
    """As a trainer holds them: they need not begin at a multiple of 16 bytes, nor be contiguous."""
    camera, gaussians = camera_ahead(9, 9, 9.0), random_gaussians(20, seed=4)
    expected = render(gaussians, camera)
    with pretended_gpu(monkeypatch):
        given = {}
        for name in ("means", "quats", "scales", "opacities", "sh"):
            values = getattr(gaussians, name)
            flat = torch.cat([torch.zeros(1), values.flatten()]).to(gpu.gpu_device())
            given[name] = flat[1:].view(values.shape)
        given["quats"] = given["quats"].t().contiguous().t()
        found = render(Gaussians(**given), camera)
    assert_same_bits(found, expected)


# ---- on a real GPU -----------------------------------------------------------------------------


@pytest.fixture
def crowd():
    """A few hundred thousand Gaussians in three parts; hundreds deep, opaque and not."""
    parts = [
        PosedGaussians(random_gaussians(300_000, size=0.05, sh_degree=3)),
        PosedGaussians(random_gaussians(50_000, seed=1, size=0.1, sh_degree=1), slight_pose(), 1),
        PosedGaussians(random_gaussians(500, seed=2, size=2.0, sh_degree=0)),
    ]
    return parts, camera_ahead(801, 533, 500.0)


@pytest.mark.gpu
def test_a_crowd_looks_as_on_the_cpu(crowd):
    parts, camera = crowd
    actual = render(parts, camera)
    expected = rasterize(parts, camera, buffers=ALL, backend=CPU)
    pixels = camera.width * camera.height
    for name in (RGB, ALPHA, OVERLAY):
        assert_images_close(
            getattr(actual, name), getattr(expected, name), p999=1e-3, max_flips=pixels // 2000
        )
    for name in (EXPECTED_DEPTH, MEDIAN_DEPTH, MODE_DEPTH):
        assert_images_close(
            getattr(actual, name),
            getattr(expected, name),
            p999=1e-3,
            flip=5e-3,
            max_flips=pixels // 500,
        )
    assert_labels_equal(actual.splat_ids, expected.splat_ids, max_flips=pixels // 500)


@pytest.mark.gpu
def test_a_crowd_has_the_same_bits_every_time(crowd):
    first = render(*crowd)
    for _ in range(3):
        assert_same_bits(render(*crowd), first)


def test_fog_with_banks_is_applied_to_the_finished_buffers():
    """Kernels of the GPU know no banks."""
    banks = FogBanks(1.0, 100.0, 0.3, 5.0, 7)
    fog = Fog(0.2, (0.5, 0.6, 0.7), banks=banks)
    parts = [PosedGaussians(random_gaussians(40, seed=3))]
    camera = camera_ahead(33, 21)
    got = render(parts, camera, {RGB}, fog=fog)
    clear = render(parts, camera, {RGB, ALPHA, EXPECTED_DEPTH})
    torch.testing.assert_close(got.rgb, apply_fog_to_render(clear, camera, fog), atol=1e-5, rtol=0)
    assert got.alpha is None and got.expected_depth is None
    assert render(parts, camera, {ALPHA}, fog=fog).alpha is not None
