"""The benchmarks of effects on a scene of sheets, and measures whose answer is known."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from adapters.base import parse_uri
from adapters.procedural import open_truth
from augment.effects.snow.cells import FLUSH, SnowCells
from augment.effects.style.network import load_network
from augment.metrics.consistency import DepthView
from augment.semantics import SemanticClass
from tests.scenes import sh_of
from tests.snow_scenes import drive, sheet, wall
from tests.streets import SMALL_STREET, open_street
from tools.bench import effects, flood, smog, snow, style
from tools.bench.effects import EffectCase, MaskedView, mask_agreement, neighbours
from tools.bench.snow import (
    all_cameras,
    bed_heights,
    camera_from_above,
    cells_over,
    pixel_places,
    sheltered_share,
    still,
    surface_below,
    true_points,
)

TINY = EffectCase(
    scene=SMALL_STREET,
    width=96,
    height=64,
    street=SMALL_STREET,
    frames=(0,),
    cameras=("front",),
    scale=0.2,
    cell_m=0.2,
)
BENCHES = {
    "smog": smog.bench_smog,
    "flood": flood.bench_flood,
    "snow": snow.bench_snow,
    "style": style.bench_style,
}


@pytest.mark.parametrize("name", BENCHES)
def test_every_subject_has_its_tables(name, monkeypatch):
    for module in (effects, snow, style):
        monkeypatch.setattr(module, "open_scene", open_street)
    monkeypatch.setattr(style, "PRESETS", ("overcast",))
    found = BENCHES[name](case=TINY, repeats=1, memory=False)
    assert json.loads(json.dumps(found, allow_nan=False))["bench"] == name
    assert all(table["rows"] for table in found["tables"])
    frames, stages = (
        next(t for t in found["tables"] if t["title"].startswith(title))
        for title in ("Frames", "Stages")
    )
    assert all(min(row[1:]) > 0 for row in frames["rows"])
    assert "rasterise" in [row[0] for row in stages["rows"]]
    if name == "style":
        assert found["facts"]["folding_error"] < 1e-5


def test_neighbours_go_once_around():
    cameras = open_street().frames[0].cameras
    ring = ["front", "front_right", "right", "back", "left", "front_left"]
    assert neighbours(cameras) == list(zip(ring, [*ring[1:], ring[0]], strict=True))


def test_views_agree_with_themselves_and_not_with_what_is_elsewhere():
    camera = open_street().frames[0].cameras["front"].scaled(0.1)
    size = (camera.height, camera.width)
    rgb = np.random.default_rng(0).uniform(0.1, 0.9, (*size, 3))
    mask = np.zeros(size, bool)
    mask[: size[0] // 2] = True

    def agreement(rgb2, mask2, depth_m):
        other = dataclasses.replace(camera)
        views = {
            camera: MaskedView(DepthView(camera, rgb, np.full(size, 10.0), np.ones(size)), mask),
            other: MaskedView(DepthView(other, rgb2, np.full(size, depth_m), np.ones(size)), mask2),
        }
        return mask_agreement([("same", camera, other)], views.__getitem__)[0][1:]

    points, agreeing, worst, rms = agreement(rgb, mask, 10.0)
    assert points > 0.9 * mask.size and agreeing == worst == 1
    assert rms == pytest.approx(0, abs=1e-6)
    assert agreement(rgb + 0.1, mask, 10.0)[3] == pytest.approx(25.5)
    assert agreement(rgb, ~mask, 10.0)[1:] == [0, 0, None]
    assert agreement(rgb, mask, 11.0) == [0, None, None, None]


# ---- snow: cells against the true surface -------------------------------------------------------


@pytest.fixture(scope="module")
def truth():
    return still(open_truth(parse_uri(SMALL_STREET)[2]))


@pytest.fixture(scope="module")
def points(truth):
    cameras = all_cameras(open_street())
    above = camera_from_above(cameras, reach_m=6.0, pixel_m=0.2)
    return true_points(truth, cameras, pixel_places(above).reshape(-1, 2), reach_m=6.0)


def cells_at(xy, z, size_m=0.2):
    """Level cells at places [C, 2] and heights [C]."""
    count = len(xy)
    centers = np.concatenate([xy, np.asarray(z)[:, None]], 1)
    return SnowCells(
        centers_m=torch.from_numpy(centers).float(),
        normals=torch.tensor([[0.0, 0, 1]]).repeat(count, 1),
        sizes_m=torch.full((count,), size_m),
        edge_m=torch.full((count,), size_m),
        neighbours=torch.full((count, 4), FLUSH, dtype=torch.int32),
        light=torch.ones(count),
        tracks=torch.zeros(count),
        banks=torch.zeros(count, 2),
        semantic=torch.zeros(count, dtype=torch.int16),
        buried=torch.zeros(0, dtype=torch.int32),
        buried_by=torch.zeros(0, 5, dtype=torch.int32),
    )


def test_points_are_the_street_from_above(truth, points):
    np.testing.assert_allclose(points.z, surface_below(truth, points.xy))
    road = points.semantic == SemanticClass.ROAD
    assert road.mean() > 0.2
    assert np.abs(points.z[road]).max() < 0.2 and (points.slope[road] < 0.1).all()
    assert points.is_seen[road].mean() > 0.3  # not beneath the cameras, nor behind cars
    eaves = points.z > 6  # roofs, from below
    assert eaves.any() and points.is_seen[eaves].mean() < 0.05


def test_cells_that_are_the_truth_cover_it_and_those_that_are_not_do_not(truth, points):
    whole = cells_at(points.xy, points.z)
    assert (cells_over(whole, points) >= 0).all()
    level = points.slope < 0.01
    np.testing.assert_allclose(bed_heights(whole, points)[level], points.z[level], atol=1e-5)
    half = cells_over(cells_at(points.xy[::2], points.z[::2]), points)
    assert (half[::2] == np.arange(len(half[::2]))).all() and (half[1::2] == -1).all()
    assert (cells_over(cells_at(points.xy, points.z + 0.5), points) == -1).all()
    for lift, expected in ((0, (0, 0)), (-1, (1, 0)), (1, (0, 1))):  # under a roof; on nothing
        found = sheltered_share(cells_at(points.xy, points.z + lift), truth, points)
        assert tuple(found.values()) == pytest.approx(expected, abs=1e-3)


# ---- styles -------------------------------------------------------------------------------------


def test_pixels_are_touched_exactly_where_a_colour_is_below_zero():
    road = sheet((2, 9), (-2, 2), rgb=(0.3, 0.35, 0.3), semantic=int(SemanticClass.ROAD))
    scene = drive(road, wall(9.0, (-3, 3), (0, 2.5)), places=[(0.0, 0.0, 1.5)])
    camera = scene.frames[0].cameras["ahead"]
    assert not style.clamped_pixels(scene, camera).any()
    sh = scene.background.sh.clone()
    sh[: len(road)] = sh_of(np.full((len(road), 3), -0.1))
    dark = dataclasses.replace(scene, background=dataclasses.replace(scene.background, sh=sh))
    touched = style.clamped_pixels(dark, camera)
    assert touched[-5:, 60:100].all() and not touched[:20].any()
    assert style.map_error(dark, camera, "overcast").max() < 1e-5  # no directions: known exactly
    wide = dataclasses.replace(dark.background, sh=torch.cat([sh, torch.zeros(len(sh), 3, 3)], 1))
    error = style.map_error(dataclasses.replace(dark, background=wide), camera, "overcast")
    assert error[touched].max() > 1 / 255 > 1e-5 > error[~touched].max()


def test_the_shipped_network_is_one_map():
    assert style.folding_error(load_network(None)) < 1e-5
