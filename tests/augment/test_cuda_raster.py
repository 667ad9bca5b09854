"""The GPU's projection, tile lists and blend, and the whole rasteriser: against stored renders,
against the definition, against the CPU's kernels. Without a GPU the kernels are interpreted.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.render import layout
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
from augment.render.constants import ALPHA_MIN, RasterSettings
from augment.render.cuda import runtime as gpu
from augment.render.cuda.driver import blend, list_tiles, project
from augment.render.cuda.splats import BLOCK, HIDDEN, TILE, CudaSplats, CudaTiles, gather_inputs
from augment.render.fog import Fog
from augment.render.layout import ABOVE, BELOW, CUT, UNCUT, HeightClip
from augment.render.rasterize import rasterize
from augment.render.reference import half_extents, project_parts, rasterize_reference
from augment.render.shading import LINES
from augment.scene import Gaussians, PosedGaussians
from tests.assertions import assert_images_close, assert_labels_equal
from tests.augment import hard_scenes
from tests.augment.hard_scenes import (
    KINDS,
    SMOGS,
    colour_maps,
    hard_gaussians,
    in_float64,
    snow_light,
    wide_camera,
)
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu
from tests.scenes import (
    camera_ahead,
    golden_view,
    one_gaussian,
    random_gaussians,
    slight_pose,
    stack,
)

_K = 0.5 * math.log2(math.e)


def drawn_splats(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings | None = None,
    clip: HeightClip | None = None,
    smog: Fog | None = None,
) -> CudaSplats:
    """The splats of the parts, computed in their own precision; NaN in rows that nobody may read.

    Lies on the CPU.
    """
    splats = project_parts(parts, camera, settings or RasterSettings(), smog, clip)
    half, size = half_extents(splats), torch.tensor([camera.width, camera.height])
    low = torch.ceil((splats.means2d - half - 0.5).clamp_min(0))
    high = torch.floor(torch.minimum(splats.means2d + half - 0.5, size - 1))
    drawn = (low <= high).all(1) & (splats.opacities >= ALPHA_MIN)
    splats, half = splats.select(drawn), half[drawn]
    first, last = (edge[drawn].int() // TILE for edge in (low, high))

    count, rows = sum(len(part.gaussians) for part in parts), splats.ids
    xx, xy, yy = splats.covs2d.unbind(1)
    fields = {
        layout.MEAN_X: splats.means2d[:, 0],
        layout.MEAN_Y: splats.means2d[:, 1],
        layout.LEAN_X: xy / yy,
        layout.SHARP_X: torch.sqrt(_K * yy / splats.dets),
        layout.FALL_Y: _K / yy,
        layout.LOG_OPACITY: torch.log2(splats.opacities),
        layout.RADIUS_Y: half[:, 1],
        layout.FALL_X: _K / xx,
        layout.LEAN_Y: xy / xx,
        layout.BLUNT_Y: torch.sqrt(splats.dets / xx / _K),
        layout.DEPTH: splats.depths,
        layout.IS_OVERLAY: splats.overlay,
    }
    assert splats.colors is not None
    fields |= {layout.RED + channel: splats.colors[:, channel] for channel in range(3)}
    records = torch.full((count, layout.RECORD), math.nan)
    for field, values in fields.items():
        records[rows, field] = values.float()
    records[rows, layout.SPLAT_ID] = rows.int().view(torch.float32)
    keys = torch.full((count,), HIDDEN, dtype=torch.int32)
    keys[rows] = splats.depths.float().view(torch.int32)
    rects = torch.full((count, 2), -1, dtype=torch.int32)
    for corner, tile in enumerate((first, last)):
        rects[rows, corner] = tile[:, 0] + (tile[:, 1] << 16)
    counts = torch.zeros(count, dtype=torch.int32)
    counts[rows] = (last - first + 1).prod(1).int()
    cuts = lights = None
    if splats.cuts is not None:
        cuts = torch.full((count, CUT), math.nan)
        cuts[rows, : splats.cuts.shape[1]] = splats.cuts.float()
    if splats.lights is not None:
        lights = torch.full((count, LINES), math.nan)
        lights[rows] = splats.lights.float()
    return CudaSplats(records, keys, rects, counts, cuts, lights)


DEFAULT = RasterSettings()
WEATHERS = (*SMOGS, ABOVE, BELOW, "light", "maps")
# Relative errors of float32 against float64: of what is far from 0, and, of slopes and centres
# about 0, absolute. At least twice the worst of the scenes here.
CLOSE, NEAR_ZERO = 1e-4, 2e-4
FLIPS = 2  # splats on the other side of a threshold, or in one more tile


def splats_of(parts, camera, settings=DEFAULT, smog=None, clip=None, *, with_color=True):
    """What the GPU projects, on the CPU; NaN in rows that nobody may read."""
    inputs = gather_inputs(parts, camera, settings, smog, clip, with_color=with_color)
    splats = project(inputs)
    fields = {f.name: getattr(splats, f.name) for f in dataclasses.fields(splats)}
    fields = {name: None if v is None else v.cpu() for name, v in fields.items()}
    for name in ("records", "cuts", "lights"):
        if fields[name] is not None:
            fields[name][fields["counts"] == 0] = math.nan
    fields["rects"][fields["counts"] == 0] = -1
    return CudaSplats(**fields)


def bits(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.contiguous().view(torch.int32)


def assert_close(actual: CudaSplats, expected: CudaSplats, flips: int = FLIPS) -> None:
    """The same splats, but for rounding and for a few at a threshold."""
    drawn = (actual.counts > 0) & (expected.counts > 0)
    assert int(((actual.counts > 0) != (expected.counts > 0)).sum()) <= flips
    assert bool((actual.keys[actual.counts == 0] == HIDDEN).all())
    assert int((actual.rects[drawn] != expected.rects[drawn]).any(1).sum()) <= flips
    same = drawn & (actual.rects == expected.rects).all(1)
    assert torch.equal(actual.counts[same], expected.counts[same])
    z = [splats.keys[drawn].view(torch.float32) for splats in (actual, expected)]
    torch.testing.assert_close(*z, rtol=3e-7, atol=0)
    ids = [bits(splats.records[drawn, layout.SPLAT_ID]) for splats in (actual, expected)]
    assert torch.equal(*ids)
    for name in ("records", "cuts", "lights"):
        ours, theirs = getattr(actual, name), getattr(expected, name)
        assert (ours is None) == (theirs is None), name
        if ours is None:
            continue
        for column in range(ours.shape[1] if name != "cuts" else layout.C_REACH + 1):
            if (name, column) != ("records", layout.SPLAT_ID):
                torch.testing.assert_close(
                    ours[drawn, column], theirs[drawn, column], rtol=CLOSE, atol=NEAR_ZERO,
                    msg=lambda text, at=(name, column): f"{at}: {text}",
                )  # fmt: skip


# ---- against the definition ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "weather"), [*zip(itertools.cycle(KINDS), WEATHERS, strict=False)]
)
def test_splats_are_the_definitions(kind, weather):
    seed = KINDS.index(kind) + 10 * WEATHERS.index(weather)
    camera = wide_camera((60.0, 10.0, 120.0)[seed % 3], at=(3.1, -2.2, 0.4), turn=0.2 * seed)
    gaussians = hard_gaussians(kind, camera, 100, seed=seed, sh_degree=3)
    part = PosedGaussians(gaussians, is_overlay=bool(seed % 2))
    level = 0.397 if kind == "near" else 0.3
    clip = HeightClip(level, weather) if weather in (ABOVE, BELOW) else None
    if weather == "light":
        part = dataclasses.replace(part, shading=snow_light(100, seed))
    if weather == "maps":
        part = dataclasses.replace(part, color_maps=colour_maps(seed))
    smog = SMOGS.get(weather)
    actual = splats_of([part], camera, DEFAULT, smog, clip)
    expected = drawn_splats(in_float64([part]), camera, DEFAULT, clip, smog)
    assert int((actual.counts > 0).sum()) > 20
    assert_close(actual, expected)


@pytest.mark.parametrize(
    ("degree", "settings"),
    [
        (0, RasterSettings(antialiased=True)),
        (1, RasterSettings(near_m=3.0)),
        (2, RasterSettings(sh_degree=1)),
        (3, RasterSettings(sh_degree=0, radius_clip_px=2.5)),
    ],
    ids=["antialiased", "near", "degree 1 of 2", "large ones, degree 0 of 3"],
)
def test_settings_and_every_degree_of_spherical_harmonics(degree, settings):
    camera = camera_ahead()
    part = PosedGaussians(random_gaussians(60, seed=3, sh_degree=degree))
    actual = splats_of([part], camera, settings)
    assert int((actual.counts > 0).sum()) > 10
    assert_close(actual, drawn_splats(in_float64([part]), camera, settings), flips=0)


@pytest.mark.long
@pytest.mark.parametrize("weather", [ABOVE, "light"])
def test_an_orthographic_camera(weather):
    camera = dataclasses.replace(camera_ahead(focal=6.0), is_orthographic=True)
    part = PosedGaussians(random_gaussians(80, seed=5), slight_pose())
    if weather == "light":
        part = dataclasses.replace(part, shading=snow_light(80))
    clip = None if weather != ABOVE else HeightClip(0.2, ABOVE)
    assert_close(
        splats_of([part], camera, clip=clip), drawn_splats(in_float64([part]), camera, None, clip)
    )


@pytest.mark.parametrize("rows", ["rows", pytest.param("classes", marks=pytest.mark.long)])
def test_maps_by_class_or_by_row(rows):
    camera, gaussians = camera_ahead(), random_gaussians(70, seed=7)
    # Rows that are none mean the first map.
    numbers = torch.arange(70, dtype=torch.int16) % 9 - 2
    maps = colour_maps(2)
    part = PosedGaussians(dataclasses.replace(gaussians, semantic=numbers), color_maps=maps)
    if rows == "rows":
        part = dataclasses.replace(part, color_rows=numbers.flip(0))
    assert_close(splats_of([part], camera), drawn_splats(in_float64([part]), camera))


def street_of_parts() -> list[PosedGaussians]:
    """Parts of all kinds: of every degree, posed, snow, empty, lit, mapped, larger than a block."""
    one = random_gaussians(150, seed=1, sh_degree=3)
    classes = torch.arange(150, dtype=torch.int16) % 6
    few = [random_gaussians(40, seed=degree, sh_degree=degree) for degree in range(4)]
    return [
        PosedGaussians(dataclasses.replace(one, semantic=classes), color_maps=colour_maps()),
        PosedGaussians(few[0], slight_pose(), instance_id=1),
        PosedGaussians(Gaussians.empty(3), slight_pose(), instance_id=2),
        PosedGaussians(
            few[1], slight_pose((0.5, 0.1, 0.2)), is_overlay=True, shading=snow_light(40)
        ),
        PosedGaussians(few[2], color_maps=colour_maps(3)[1:2]),
        PosedGaussians(few[3], slight_pose((1.0, 0.0, 0.0)), is_overlay=True),
    ]


@pytest.mark.parametrize("weather", ["layered", pytest.param(ABOVE, marks=pytest.mark.long)])
def test_many_parts_in_one_launch(weather):
    camera, parts = camera_ahead(), street_of_parts()
    clip, smog = (HeightClip(0.1, ABOVE) if weather == ABOVE else None), SMOGS.get(weather)
    actual = splats_of(parts, camera, smog=smog, clip=clip)
    assert_close(actual, drawn_splats(in_float64(parts), camera, None, clip, smog))
    assert len(actual.keys) == 310 > BLOCK
    # Lights of splats of one colour are 0.
    lit = torch.zeros(310, dtype=torch.bool)
    lit[190:230] = True
    drawn = actual.counts > 0
    assert actual.lights is not None
    assert bool((actual.lights[drawn & ~lit] == 0).all())
    assert bool((actual.lights[drawn & lit][:, 6:].amax(1) > 0).all())


# ---- what must not change a bit ------------------------------------------------------------------


def test_ties_stay_ties():
    """The same mean has the same z at any place of the list."""
    one = one_gaussian((4.2, 0.3, -0.1))
    gaussians = stack(
        random_gaussians(37, seed=8, sh_degree=0),
        one,
        random_gaussians(150, seed=9, sh_degree=0),
        one,
    )
    splats = splats_of([PosedGaussians(gaussians, slight_pose())], camera_ahead())
    assert splats.keys[37] == splats.keys[-1] != HIDDEN
    assert torch.equal(splats.rects[37], splats.rects[-1])


# ---- on a GPU ------------------------------------------------------------------------------------


def test_gaussians_within_a_larger_tensor_on_the_gpu(monkeypatch):
    """As a trainer holds them: they need not begin at a multiple of 16 bytes, nor be contiguous."""
    camera, gaussians = camera_ahead(), random_gaussians(50, seed=4)
    expected = splats_of([PosedGaussians(gaussians)], camera)
    names = ("means", "quats", "scales", "opacities", "sh")
    with pretended_gpu(monkeypatch):
        given = {}
        for name in names:
            values = getattr(gaussians, name)
            flat = torch.cat([torch.zeros(1), values.flatten()]).to(gpu.gpu_device())
            given[name] = flat[1:].view(values.shape)
        given["quats"] = given["quats"].t().contiguous().t()
        splats = splats_of([PosedGaussians(Gaussians(**given))], camera)
    assert torch.equal(bits(splats.records), bits(expected.records))


@pytest.mark.gpu
def test_a_large_scene_is_the_definitions_and_the_same_every_time():
    camera = camera_ahead(1600, 1066, 1500.0)
    many = random_gaussians(20_000, seed=1, size=0.05)
    parts = [PosedGaussians(many), *street_of_parts()]
    for weather in ("clear", "uniform", "layered", ABOVE):
        clip, smog = (HeightClip(0.1, ABOVE) if weather == ABOVE else None), SMOGS.get(weather)
        first, second = (splats_of(parts, camera, smog=smog, clip=clip) for _ in range(2))
        for name in ("records", "cuts", "lights"):
            one, other = getattr(first, name), getattr(second, name)
            assert (one is None) == (other is None)
            assert one is None or torch.equal(bits(one), bits(other))
        # Of 20 000 splats, more lie at the edge of a tile.
        expected = drawn_splats(in_float64(parts), camera, None, clip, smog)
        assert_close(first, expected, flips=40)


ALL = frozenset(BUFFERS)
LONG = pytest.mark.long


def on_gpu(splats: CudaSplats) -> CudaSplats:
    device = gpu.gpu_device()
    fields = {f.name: getattr(splats, f.name) for f in dataclasses.fields(splats)}
    return CudaSplats(**{n: None if v is None else v.to(device) for n, v in fields.items()})


def as_given(parts) -> list[PosedGaussians]:
    return [PosedGaussians(parts)] if isinstance(parts, Gaussians) else parts


def on_cpu(output: RenderOutput) -> RenderOutput:
    fields = {f.name: getattr(output, f.name) for f in dataclasses.fields(output)}
    return RenderOutput(**{n: None if v is None else v.cpu() for n, v in fields.items()})


def render(parts, camera, buffers=ALL, settings=DEFAULT, **more) -> RenderOutput:
    return on_cpu(
        rasterize(as_given(parts), camera, buffers=buffers, settings=settings, backend=CUDA, **more)
    )


def blend_alone(parts, camera, buffers=ALL, settings=DEFAULT, clip=None) -> RenderOutput:
    """Splats of the definition's projection through the lists and the blend."""
    splats = on_gpu(drawn_splats(as_given(parts), camera, settings, clip))
    images = blend(splats, list_tiles(splats, camera, None), camera, buffers, settings)
    return on_cpu(RenderOutput(**images))


def assert_same_bits(actual, expected, buffers=ALL):
    for name in buffers:
        assert torch.equal(getattr(actual, name), getattr(expected, name)), name


def assert_agrees(actual, expected, *, max_flips=2, depth_p999=2e-4, buffers=ALL):
    """As far as float32 allows: forty blends, an exp2 good to 3e-6, depths of up to 9 m."""
    for name in buffers & {RGB, ALPHA, OVERLAY}:
        assert_images_close(
            getattr(actual, name), getattr(expected, name), p999=1e-5, max_flips=max_flips
        )
    for name, more in ((EXPECTED_DEPTH, 0), (MEDIAN_DEPTH, 2), (MODE_DEPTH, 4)):
        # A pixel may name the next splat, or leave a sample out of a cluster, by another rounding.
        if name in buffers:
            assert_images_close(
                getattr(actual, name),
                getattr(expected, name),
                p999=depth_p999,
                flip=5e-3,
                max_flips=max_flips + more,
            )
    if SPLAT_IDS in buffers:
        assert_labels_equal(actual.splat_ids, expected.splat_ids, max_flips=max_flips + 2)


def assert_matches_definition(
    parts, camera, settings=DEFAULT, *, max_flips=2, depth_p999=2e-4, smog=None, clip=None
):
    parts = as_given(parts)
    actual = render(parts, camera, ALL, settings, fog=smog, clip=clip)
    expected = rasterize(
        in_float64(parts),
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
    for row in np.argsort(splats.keys.numpy(), kind="stable").tolist():
        if splats.counts[row] > 0:
            first, last = splats.rects[row].tolist()
            spans = zip(divmod(first, 1 << 16), divmod(last, 1 << 16), strict=True)
            for down, across in itertools.product(*(range(a, b + 1) for a, b in spans)):
                lists[down * columns + across].append(row)
    return lists


def listed(tiles: CudaTiles) -> list[list[int]]:
    tile_splat_ids, tile_offsets = (
        tiles.tile_splat_ids.cpu().tolist(),
        tiles.tile_offsets.cpu().tolist(),
    )
    return [tile_splat_ids[a:b] for a, b in itertools.pairwise(tile_offsets)]


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
    return CudaSplats(
        torch.empty(count, 16),
        torch.from_numpy(keys),
        torch.from_numpy(rects),
        torch.from_numpy(counts.astype(np.int32)),
        None,
        None,
    )


@pytest.mark.parametrize(
    ("count", "columns", "rows"), [(300, 5, 3), pytest.param(3, 200, 170, marks=LONG), (0, 3, 2)]
)
def test_lists_hold_every_pair_once_in_order_of_depth(count, columns, rows):
    """34 000 tiles do not fit into 16 bits."""
    splats = random_splats(count, columns, rows)
    camera = camera_ahead(columns * TILE - 3, rows * TILE)
    tiles = list_tiles(on_gpu(splats), camera, None)
    assert (tiles.columns, tiles.rows) == (columns, rows)
    assert tiles.tile_splat_ids.dtype == tiles.tile_offsets.dtype == torch.int32
    assert listed(tiles) == brute_force_lists(splats, columns, rows)


def test_tiles_without_a_wanted_pixel_own_nothing():
    splats, camera = random_splats(200, 5, 4), camera_ahead(5 * TILE - 7, 4 * TILE - 1)
    wanted = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    wanted[17, 33] = wanted[-1, -1] = wanted[30, 0] = True
    tiles = list_tiles(on_gpu(splats), camera, wanted.to(gpu.gpu_device()))
    drawn = {1 * 5 + 2, 3 * 5 + 4, 1 * 5}
    expected = brute_force_lists(splats, 5, 4)
    assert listed(tiles) == [own if i in drawn else [] for i, own in enumerate(expected)]
    none = list_tiles(on_gpu(splats), camera, torch.zeros_like(wanted).to(gpu.gpu_device()))
    assert listed(none) == [[]] * 20


# ---- blending ----------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(17, 9), (1, 1)], ids=lambda s: f"{s[0]}x{s[1]}")
def test_blending_random_splats(size):
    camera = camera_ahead(*size, 0.9 * max(size))
    parts = [PosedGaussians(random_gaussians(30, seed=sum(size), size=0.4))]
    expected = rasterize_reference(in_float64(parts), camera, ALL, DEFAULT, None)
    assert_agrees(blend_alone(in_float64(parts), camera), expected)


@pytest.mark.long
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
    camera = camera_ahead(48, 32, 45.0)
    parts = [PosedGaussians(thin)]
    actual = blend_alone(in_float64(parts), camera, frozenset({ALPHA}))
    expected = rasterize_reference(in_float64(parts), camera, frozenset({ALPHA}), DEFAULT, None)
    # A lost share is 1/255 and more; at the cut itself another rounding may take or give one.
    assert_images_close(actual.alpha, expected.alpha, p999=1e-5, flip=1e-3, max_flips=6)


@pytest.fixture(scope="module")
def blended():
    """Some splats and all their images."""
    parts, camera = random_gaussians(25, size=0.5), camera_ahead(20, 9, 16.0)
    return parts, camera, blend_alone(parts, camera)


@pytest.mark.parametrize("buffer", [RGB, SPLAT_IDS])
def test_bits_do_not_depend_on_the_buffers_asked_for(blended, buffer):
    parts, camera, whole = blended
    alone = blend_alone(parts, camera, frozenset({buffer}))
    assert_same_bits(alone, whole, {buffer})
    assert all(getattr(alone, name) is None for name in ALL - {buffer})


# ---- the whole rasteriser ----------------------------------------------------------------------


@LONG
def test_a_stored_render(shared_dir):
    check_stored_render(shared_dir, "opaque", "a99_aa")


@pytest.mark.gpu
@pytest.mark.parametrize(
    "mode",
    [
        *("a999_classic", "a999_aa", "a99_classic", "a99_aa"),
        *(f"a99_classic_sh{degree}" for degree in range(4)),
    ],
)
@pytest.mark.parametrize("name", ["edge", "garden_small", "opaque"])
def test_all_stored_renders(shared_dir, name, mode):
    check_stored_render(shared_dir, name, mode)


def check_stored_render(shared_dir, name: str, mode: str) -> None:
    with_sh = mode[-3:-1] == "sh"
    parts, camera, arrays = golden_view(shared_dir / "golden" / f"{name}.npz", with_sh=with_sh)
    settings = RasterSettings(
        alpha_max=0.999 if mode.startswith("a999") else 0.99,
        antialiased="_aa" in mode,
        sh_degree=int(mode[-1]) if with_sh else None,
    )
    output = render(parts, camera, frozenset({RGB, ALPHA, EXPECTED_DEPTH}), settings)
    for key, image in {"rgb": output.rgb, "alpha": output.alpha}.items():
        if f"{mode}_{key}" in arrays:
            assert_images_close(image, arrays[f"{mode}_{key}"], p999=1e-5, max_flips=5)
    if not with_sh:
        expected = torch.from_numpy(arrays[f"{mode}_ED"]).reshape(output.alpha.shape)
        relative = output.expected_depth / expected.clamp_min(1e-3)
        assert_images_close(relative, expected / expected.clamp_min(1e-3), p999=1e-5, max_flips=5)


@pytest.mark.long
@pytest.mark.parametrize(
    "settings",
    [
        DEFAULT,
        RasterSettings(antialiased=True, sh_degree=1),
        RasterSettings(alpha_max=0.99, near_m=1.5),
        RasterSettings(transmittance_stop=0.05, radius_clip_px=2.5),
    ],
    ids=["default", "antialiased", "near and alpha_max", "coarse"],
)
def test_settings(settings):
    parts = [PosedGaussians(random_gaussians(60, size=0.4))]
    assert_matches_definition(parts, camera_ahead(25, 19, 20.0), settings)


@pytest.mark.long
def test_all_kinds_of_parts():
    """A street, an actor, snow lit pixel by pixel, splats under colour maps; seen through smog."""
    street, actor = random_gaussians(40, size=0.4), random_gaussians(20, seed=1, sh_degree=1)
    lit = random_gaussians(20, seed=2, sh_degree=0, size=0.5)
    styled = random_gaussians(20, seed=3, sh_degree=2)
    rows = torch.arange(20, dtype=torch.int16) % 6
    parts = [
        PosedGaussians(street),
        PosedGaussians(actor, slight_pose(), 1),
        PosedGaussians(lit, is_overlay=True, shading=snow_light(20)),
        PosedGaussians(styled, color_maps=colour_maps(), color_rows=rows),
        PosedGaussians(Gaussians.empty(sh_degree=1)),
    ]
    assert_matches_definition(parts, camera_ahead(17, 13, 14.0), smog=hard_scenes.SMOGS["layered"])


@pytest.mark.long
@pytest.mark.parametrize(
    ("clip", "is_orthographic"),
    [
        (UNCUT, False),
        (HeightClip(0.1, "above"), False),
        (HeightClip(0.2, "below", overlaps=True), True),
    ],
)
def test_clips_and_parallel_rays(clip, is_orthographic):
    camera = camera_ahead(25, 19, 20.0, position=(0.0, 0.0, 0.9))
    if is_orthographic:
        camera = dataclasses.replace(camera, is_orthographic=True, fx=5.0, fy=5.5)
    parts = [
        PosedGaussians(random_gaussians(40, size=0.5, sh_degree=1)),
        PosedGaussians(random_gaussians(20, seed=1, sh_degree=0, size=0.5), slight_pose(), 1),
    ]
    # Where a cut leaves little of a pixel, its depth is a small sum over a small alpha.
    assert_matches_definition(parts, camera, clip=clip, max_flips=4, depth_p999=2e-3)


@pytest.mark.parametrize(
    "kind", ["needles", *(pytest.param(k, marks=LONG) for k in ("mixed", "edges", "near"))]
)
def test_hard_scenes(kind):
    """Finite and in range whatever comes, and as the CPU's kernels draw it."""
    camera = hard_scenes.wide_camera(100.0, (23, 18))
    parts = [PosedGaussians(hard_gaussians(kind, camera, 16))]
    actual = render(parts, camera)
    for name in ALL - {SPLAT_IDS}:
        assert bool(torch.isfinite(getattr(actual, name)).all()), name
    expected = rasterize(parts, camera, buffers=ALL, backend=CPU)
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
    street = PosedGaussians(random_gaussians(20, size=0.4))
    snow = PosedGaussians(
        random_gaussians(10, seed=2, sh_degree=0), is_overlay=True, shading=snow_light(10)
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
