"""Levels of detail: what merging keeps, which level a camera takes, and that nothing pops."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch

from augment.detail import lod, lod_kernels
from augment.render.buffers import ALPHA, BUFFERS, RGB, SPLAT_IDS
from augment.render.constants import RasterSettings
from augment.render.rasterize import rasterize
from augment.render.threads import kernel_threads
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Gaussians, PosedGaussians
from augment.scene.semantics import SemanticClass
from tests.scenes import camera_ahead, one_gaussian, random_gaussians, sh_of

STEP_M, SHARP = 0.1, RasterSettings(lod_px=2.0)


def road(length_m: float = 64.0, seed: int = 0) -> Gaussians:
    """A speckled road 8 m wide with a wall beside it, one splat every 10 cm, in no order."""
    rng = np.random.default_rng(seed)
    x, across = np.meshgrid(np.arange(0, length_m, STEP_M), np.arange(0, 12, STEP_M))
    x, across = x.reshape(-1), across.reshape(-1)
    is_wall = across >= 8
    means = np.stack(
        [x, np.where(is_wall, 4, across - 4), np.where(is_wall, across - 8, 0) - 1.5], 1
    )
    means += rng.uniform(-0.02, 0.02, means.shape)
    thin = np.where(is_wall[:, None], (0.6, 0.05, 0.6), (0.6, 0.6, 0.05)) * STEP_M
    rgb = np.where(is_wall[:, None], (0.6, 0.45, 0.35), 0.4) + rng.uniform(-0.15, 0.15, (len(x), 1))
    classes = np.where(is_wall, SemanticClass.BUILDING, SemanticClass.ROAD)
    order = torch.from_numpy(rng.permutation(len(x)))
    return Gaussians(
        torch.from_numpy(means.astype(np.float32)),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(len(x), 1),
        torch.from_numpy(thin.astype(np.float32)),
        torch.full((len(x),), 0.9),
        sh_of(rgb),
        torch.from_numpy(classes.astype(np.int16)),
    ).select(order)


@pytest.fixture(scope="module")
def part() -> PosedGaussians:
    return PosedGaussians(road())


def eye(x: float = 0.0, yaw: float = 0.0):
    return camera_ahead(128, 72, 100.0, position=(x, 0, 0), yaw=yaw)


def draw(part: PosedGaussians, camera, settings=SHARP, buffers=(RGB, ALPHA)):
    return rasterize([part], camera, buffers=buffers, settings=settings)


# ---- merging -------------------------------------------------------------------------------------


def test_a_merged_splat_has_the_mean_covariance_and_colour_of_the_mixture():
    g = random_gaussians(7)
    g = dataclasses.replace(g, scales=g.scales.clamp(max=0.2), opacities=g.opacities * 0.02)
    merged, _ = lod.merge_groups(g, np.array([0]), 0.0)
    s, turn = g.scales.double(), rotmat_from_quat(g.quats.double())
    weight = g.opacities.double() * (s[:, 0] * s[:, 1] + s[:, 1] * s[:, 2] + s[:, 2] * s[:, 0])
    weight = weight / weight.sum()
    mean = (weight[:, None] * g.means.double()).sum(0)
    off = g.means.double() - mean
    covariances = turn @ torch.diag_embed(s**2) @ turn.mT + off[:, :, None] * off[:, None]
    covariance = (weight[:, None, None] * covariances).sum(0)
    turn = rotmat_from_quat(merged.quats)[0]
    merged_covariance = turn @ torch.diag(merged.scales[0] ** 2) @ turn.T
    torch.testing.assert_close(merged.means[0], mean)  # float64: rounding alone
    torch.testing.assert_close(merged_covariance, covariance)
    torch.testing.assert_close(merged.sh[0], (weight[:, None, None] * g.sh.double()).sum(0))


@pytest.mark.parametrize("opacity", [0.1, 0.9])
def test_one_place_covers_what_its_splats_cover_together(opacity):
    """n equal splats at one place let (1 - alpha)^n through."""
    out, count = np.empty(1), 3
    args = np.full(count, opacity), np.zeros((count, 2)), np.tile(np.eye(2), (count, 1, 1))
    with kernel_threads():
        lod_kernels.sum_covered_areas(np.array([0, count]), *args, out)
    r = np.arange(0, 6, 1e-3)
    exact = 2 * np.pi * (r * (1 - (1 - opacity * np.exp(-r * r / 2)) ** count)).sum() * 1e-3
    assert out[0] == pytest.approx(exact, rel=0.02)  # what lies beyond 3.15 deviations is left out


def test_large_splats_stay_as_they_are_and_clear_ones_are_left_out():
    small, large = one_gaussian((1.0, 1.0, 0.0), 0.02), one_gaussian((1.0, 1.0, 0.01), 0.9)
    g = lod.join_pieces(
        lod.LevelPiece(splat, np.zeros(1, np.int32), np.zeros(1, np.int64))
        for splat in (small, large, small, dataclasses.replace(small, opacities=torch.zeros(1)))
    ).gaussians
    merged, leads, into = lod.merge_cells(g, np.zeros(4, np.int64), 0.4, 0.1)
    assert sorted(leads.tolist()) == [0, 1]
    assert into[0] == into[2] != into[1] and into[3] == -1
    large_row = int(np.flatnonzero(leads == 1)[0])
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(merged, name)[large_row], getattr(g, name)[1])


def test_a_merged_splat_stands_for_the_heaviest_of_the_class_that_weighs_most():
    g = random_gaussians(5)
    g = dataclasses.replace(
        g,
        scales=torch.full_like(g.scales, 0.1),
        opacities=torch.tensor([0.5, 0.3, 0.35, 0.1, 0.2]),
        semantic=torch.tensor([1, 2, 2, 3, 3], dtype=torch.int16),
    )
    assert lod.merge_groups(g, np.array([0, 3]), 0.1)[1].tolist() == [2, 4]


def test_only_splats_of_nearly_one_colour_are_merged_in_wider_cells():
    """Four splats in a cell of twice the width, each in a cell of its own."""
    means = np.array([(x, y, 0.1) for x in (0.0, 0.2) for y in (0.0, 0.2)], np.float32)
    g = one_gaussian((0.0, 0.0, 0.0), 0.05)
    g = g.select(torch.zeros(4, dtype=torch.int64))
    g = dataclasses.replace(g, means=torch.from_numpy(means))
    for differs, left in ((0.9 * lod.MAX_COLOR_DIFFERENCE, 1), (1.1 * lod.MAX_COLOR_DIFFERENCE, 4)):
        rgb = np.full((4, 3), 0.5)
        rgb[0, 1] += differs
        colored = dataclasses.replace(g, sh=sh_of(rgb))
        assert len(lod.merge_cells(colored, np.zeros(4, np.int64), 0.2, 0.1)[1]) == left


def test_each_level_has_about_a_quarter_of_the_one_before(part):
    levels = lod.levels_of(part.gaussians).levels
    counts = [len(level.gaussians) for level in levels]
    assert len(counts) >= 3 and counts[0] == len(part.gaussians)
    assert counts[1] <= lod.MAX_REMAINING_SHARE * counts[0]
    # Cells at borders, and where the wall stands on the road, hold fewer splats.
    assert all(b < 0.4 * a for a, b in itertools.pairwise(counts[1:]))
    assert sorted(levels[0].stands_for.tolist()) == list(range(counts[0]))


def test_merged_surfaces_stay_closed_and_keep_their_mean_colour(part):
    """One level for the whole image, at cells of the pixel's size: what it is made for. A hundredth
    of the light shines through, which is as much as balanced lets a pixel lose.
    """
    levels = lod.levels_of(part.gaussians)
    for number in (1, 2):
        cell_m = levels.cell_m(number)
        camera = dataclasses.replace(
            camera_ahead(64, 40, 1 / cell_m, position=(32, 0, 0), yaw=np.pi / 2),
            is_orthographic=True,
        )
        full = draw(part, camera, RasterSettings())
        merged = draw(part, camera, RasterSettings(lod_px=1.1))
        is_opaque = full.alpha > 0.99
        assert is_opaque.float().mean() > 0.2
        assert float((merged.alpha - full.alpha)[is_opaque].abs().mean()) < 0.01
        color_errors = (merged.rgb / merged.alpha[..., None] - full.rgb / full.alpha[..., None])[
            is_opaque
        ]
        # Where the wall stands on the road, cells have the colours of both.
        assert float(color_errors.mean().abs()) < 1 / 255


# ---- what a camera takes -------------------------------------------------------------------------


def test_without_levels_no_bit_changes_and_near_ones_change_only_the_order_of_equal_depths(part):
    camera = eye()
    full = draw(part, camera, RasterSettings())
    again = draw(part, camera, RasterSettings(lod_px=0.0))
    finest = draw(part, camera, RasterSettings(lod_px=1e-6))
    assert torch.equal(full.rgb, again.rgb)
    assert float((full.rgb - finest.rgb).abs().max()) < 1e-5  # float32 sums of the same splats


def test_shares_add_up_to_one_wherever_the_camera_is(part):
    levels = lod.levels_of(part.gaussians)
    leaves = levels.levels[0].squares
    for x in (-7.0, 3.3, 21.7, 90.0):
        camera, total = camera_ahead(9, 9, 1.0, position=(x - 500, 0, 0)), np.zeros(len(leaves))
        camera = dataclasses.replace(camera, fx=100.0, fy=100.0, width=9000, cx=4500.0)
        near = dataclasses.replace(SHARP, lod_px=SHARP.lod_px * 30)
        for settings in (near, SHARP):
            total[:] = 0
            for square, share in zip(
                *lod.choose_squares(levels, part, camera, settings), strict=True
            ):
                number = int(levels.tree.numbers[square])
                within = int(square) - np.searchsorted(levels.tree.numbers, number)
                key = levels.levels[number].squares.keys[within]
                total[leaves.keys >> (2 * number) == key] += share
            np.testing.assert_allclose(total, 1)


def test_turning_the_camera_changes_no_share(part):
    levels = lod.levels_of(part.gaussians)

    def taken(yaw):
        squares, shares = lod.choose_squares(levels, part, eye(20.0, yaw), SHARP)
        return dict(zip(squares.tolist(), shares.tolist(), strict=True))

    ahead, turned = taken(0.0), taken(0.3)
    both = ahead.keys() & turned.keys()
    assert len(both) > 5 and all(ahead[key] == turned[key] for key in both)


def test_nothing_pops_along_a_drive(part):
    """From step to step images differ no more than full ones do, but for what merging takes from
    the speckle and what a fade moves in a step: a grey level in the mean of any 8 x 8 pixels.
    """

    def steps(settings):
        images = torch.stack([draw(part, eye(0.1 * i), settings).rgb for i in range(12)])
        change = (images[1:] - images[:-1]).abs().mean(-1)
        return torch.nn.functional.avg_pool2d(change, 8)

    full, merged = steps(RasterSettings()), steps(RasterSettings(lod_px=3.0))
    assert float((merged - full).max()) < 1 / 255


def test_a_fade_keeps_what_an_opaque_surface_hides():
    for opacity in (0.2, 0.9, 2.0):
        o = torch.tensor([opacity])
        low = o.clamp(max=0.99)
        both = (
            lod.fade_opacities(o, 0.3).clamp(max=0.999),
            lod.fade_opacities(o, 0.7).clamp(max=0.999),
        )
        left = (1 - both[0]) * (1 - both[1])
        assert float(left) <= float(1 - low) + 1e-6
        assert float(lod.fade_opacities(o, 1.0)) == pytest.approx(opacity)


def test_numbers_of_splats_are_the_parts_own_and_actors_keep_theirs(part):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([20.0, 1.0, 0.0])
    actor = PosedGaussians(one_gaussian((0.0, 0.0, 0.0), 0.4, 0.99), pose, 1)
    id_images = [
        rasterize([part, actor], eye(), buffers=BUFFERS, settings=s).splat_ids
        for s in (RasterSettings(), RasterSettings(lod_px=4.0))
    ]
    assert int(id_images[1].max()) == len(part.gaussians)  # the actor's, the last of all
    # In its rim, of some 40 pixels, a merged splat may be the heaviest.
    is_actor = [ids == len(part.gaussians) for ids in id_images]
    assert int(is_actor[0].sum()) > 10 and int((is_actor[0] & ~is_actor[1]).sum()) <= 15
    classes = torch.cat([part.gaussians.semantic, torch.zeros(2, dtype=torch.int16)])
    class_images = [torch.where(ids < 0, -1, classes[ids]) for ids in id_images]
    assert (
        float((class_images[0] == class_images[1]).float().mean()) > 0.98
    )  # but where wall and road meet


def test_a_camera_that_sees_nothing_of_the_part_draws_nothing(part):
    behind = eye(-50.0, np.pi)
    out = draw(part, behind, SHARP, (RGB, ALPHA, SPLAT_IDS))
    assert not out.rgb.any() and not out.alpha.any() and bool((out.splat_ids == -1).all())


def test_colour_maps_by_row_follow_the_splats_that_merged_ones_stand_for(part):
    g = part.gaussians
    swap = torch.eye(3, 4)[[1, 0, 2]]
    maps = torch.stack([torch.eye(3, 4), swap])
    rows = (g.semantic == int(SemanticClass.BUILDING)).to(torch.int16)
    mapped = dataclasses.replace(part, color_maps=maps, color_rows=rows)
    plain_view, mapped_view = draw(part, eye()), draw(mapped, eye())
    wall = draw(part, eye(), SHARP, (SPLAT_IDS,)).splat_ids
    is_wall = (wall >= 0) & (g.semantic[wall.clamp_min(0)] == int(SemanticClass.BUILDING))
    inside = torch.nn.functional.max_pool2d(1 - is_wall[None].float(), 5, 1, 2)[0] == 0
    assert inside.sum() > 50
    close = (mapped_view.rgb[..., [1, 0, 2]] - plain_view.rgb).abs().amax(-1)[inside]
    assert float(close.mean()) < 0.01  # but where the road's own colour shines in


def test_levels_are_made_once_for_the_same_gaussians(part):
    assert lod.levels_of(part.gaussians) is lod.levels_of(part.gaussians)
    level_gaussians = [lod.choose_parts([part], eye(), SHARP).parts[0].gaussians for _ in range(2)]
    assert (
        level_gaussians[0].means is level_gaussians[1].means
    )  # what a backend remembers of it stays known


def test_a_size_that_is_no_number_of_pixels_is_refused(part):
    with pytest.raises(ValueError, match="lod_px must be finite and >= 0"):
        draw(part, eye(), RasterSettings(lod_px=-1.0))
