"""The benchmark of snow on a street small enough to be quick; parts whose answer is known."""

import json

import numpy as np
import pytest
import torch

from adapters.base import parse_uri
from adapters.procedural import open_truth
from augment.effects.snow.cells import FLUSH, SnowCells
from augment.semantics import SemanticClass
from tests.streets import SMALL_STREET, open_street
from tools import bench_commands, bench_snow
from tools.bench_snow import SnowCase
from tools.bench_snow_accuracy import AccuracyCase
from tools.bench_snow_cells import bed_heights, cells_over, height_error, sheltered_share
from tools.bench_snow_cost import PARTS, STAGES, cost_cases
from tools.bench_snow_depths import BUFFERS, ZONES, hidden_returns, lidar_depths, lidar_zones
from tools.bench_snow_masks import SnowView, pair_agreement
from tools.bench_snow_text import snow_text
from tools.bench_snow_truth import (
    camera_from_above,
    pixel_places,
    still,
    surface_below,
    true_points,
)

TINY = SnowCase(
    scene=SMALL_STREET,
    width=120,
    height=80,
    street=SMALL_STREET,
    accuracy=AccuracyCase(reach_m=6.0, pixel_m=0.2, every=2),
    frames=(0,),
    cameras=("front",),
    scale=0.2,
    cell_m=0.2,
)


@pytest.fixture(scope="module")
def figures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_snow, "open_scene", open_street)
        return bench_snow.bench_snow(TINY, repeats=1, memory=False, progress=False)


@pytest.fixture(scope="module")
def truth():
    return still(open_truth(parse_uri(SMALL_STREET)[2]))


@pytest.fixture(scope="module")
def cameras():
    scene = open_street()
    return [camera for frame in scene.frames for camera in frame.cameras.values()]


@pytest.fixture(scope="module")
def points(truth, cameras):
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


def test_figures_are_json_and_hang_together(figures):
    assert json.loads(json.dumps(figures, allow_nan=False)) is not None
    accuracy = figures["accuracy"]
    assert 0 < accuracy["exposed_flat_seen"] <= accuracy["points"]
    assert [each["estimator"] for each in accuracy["estimators"]] == ["mode", "expected", "median"]
    for each in accuracy["estimators"]:
        assert 0.5 < each["covered"] <= 1 and 0 <= each["sheltered"] < 0.2
        assert [drawn["depth_m"] for drawn in each["depths"]] == [0.02, 0.1, 0.4]
    assert set(figures["depths"]) == set(BUFFERS)
    (scene,) = figures["scenes"]
    for case in scene["cost"]["cases"]:
        for name in ("clean_ms", "snowy_ms", "ratio"):
            assert 0 < case[name]["min"] <= case[name]["median"] <= case[name]["p90"]
    for each in scene["cost"]["stages"]:
        assert [stage["stage"] for stage in each["stages"]][:-1] == [PARTS, *STAGES]
        assert each["counts"]["snowy"]["splats"] > each["counts"]["clean"]["splats"]
    placed = scene["placement"]
    stages = sum(stage["median"] for stage in placed["stages_s"].values())
    assert stages == pytest.approx(placed["place_s"]["median"], rel=0.5, abs=0.2)
    assert placed["cells"] > 0 and placed["file"]["mib"] > 0
    for kinds in figures["masks"].values():
        assert 0.9 < kinds["frames"]["agreeing"] <= 1


def test_text_has_a_row_for_everything(figures):
    text = snow_text(figures)
    for heading in ("ACCURACY", "DEPTHS OF CAMERAS", "PLACEMENT", "COST", "VIEWS"):
        assert heading in text
    for name in (*cost_cases(), *BUFFERS, "per_pixel, frames", "per_splat, cameras"):
        assert f"\n  {name} " in text
    assert f"{100 * figures['accuracy']['estimators'][0]['covered']:.2f} %" in text


def test_cells_that_are_the_truth_cover_it_and_those_that_are_not_do_not(truth, points):
    whole = cells_at(points.xy, points.z)
    assert (cells_over(whole, points) >= 0).all()
    level = points.slope < 0.01
    np.testing.assert_allclose(bed_heights(whole, points)[level], points.z[level], atol=1e-5)
    assert sheltered_share(whole, truth, points)["sheltered"] < 1e-3
    half = cells_at(points.xy[::2], points.z[::2])
    over = cells_over(half, points)
    assert (over[::2] == np.arange(len(half))).all() and (over[1::2] == -1).all()
    assert (cells_over(cells_at(points.xy, points.z + 0.5), points) == -1).all()


def test_snow_under_a_roof_is_sheltered_and_snow_on_nothing_in_the_air(truth, points):
    low = sheltered_share(cells_at(points.xy, points.z - 1), truth, points)
    assert (low["sheltered"], low["in_the_air"]) == (1, 0)
    high = sheltered_share(cells_at(points.xy, points.z + 1), truth, points)
    assert (high["sheltered"], high["in_the_air"]) == (0, 1)


def test_points_are_the_street_from_above(truth, points):
    np.testing.assert_allclose(points.z, surface_below(truth, points.xy))
    road = points.semantic == SemanticClass.ROAD
    assert road.mean() > 0.2
    assert np.abs(points.z[road]).max() < 0.2 and (points.slope[road] < 0.1).all()
    assert points.is_seen[road].mean() > 0.3  # not beneath the cameras, nor behind cars
    eaves = points.z > 6  # roofs, from below
    assert eaves.any() and points.is_seen[eaves].mean() < 0.05


def test_height_errors():
    assert height_error(np.array([-0.01, -0.03, -0.02, np.nan])) == {
        "median": pytest.approx(0.02),
        "p95": pytest.approx(0.029),
        "bias": pytest.approx(-0.02),
    }
    assert height_error(np.array([np.nan]))["median"] is None


def test_views_agree_with_themselves_and_not_with_what_is_elsewhere(cameras):
    camera = cameras[0].scaled(0.1)
    size = (camera.height, camera.width)
    depth, rgb = np.full(size, 10.0), np.random.default_rng(0).uniform(0, 1, (*size, 3))
    snow = np.zeros(size, bool)
    snow[size[0] // 2 :] = True
    view = SnowView(camera, rgb, snow, depth)
    same = pair_agreement(view, view)
    assert same == {"points": snow.size, "agreeing": 1.0, "both": int(snow.sum()), "color_rms": 0.0}
    none = pair_agreement(view, SnowView(camera, rgb + 0.1, ~snow, depth))
    assert (none["agreeing"], none["both"], none["color_rms"]) == (0.0, 0, None)
    brighter = pair_agreement(view, SnowView(camera, rgb + 0.1, snow, depth))
    assert brighter["color_rms"] == pytest.approx(25.5)
    assert pair_agreement(view, SnowView(camera, rgb, snow, depth + 1))["points"] == 0


def test_returns_behind_most_of_those_about_them_are_hidden():
    depth = np.zeros((40, 40), np.float32)
    depth[::4, ::4] = 5.0
    depth[20, 20] = 9.0
    depth[:, 32:] = 20.0  # beside a straight silhouette, seen
    hidden = hidden_returns(depth, 6)
    assert hidden[20, 20] and hidden.sum() == 1
    zones = lidar_zones(depth, 4)
    assert not zones["overall"][20, 20] and zones["smooth"][8, 8] and zones["silhouettes"][8, 32]
    assert not (zones["smooth"] & zones["silhouettes"]).any()


def test_a_street_is_measured_against_its_own_lidar():
    scene = open_street()
    found = lidar_depths(scene, [0], ["front"], 0.5)
    assert found is not None and set(found) == set(BUFFERS)
    for zones in found.values():
        assert tuple(zones) == ZONES and zones["smooth"]["pixels"] > 1000
        assert zones["smooth"]["median_m"] < 0.3


def test_no_repeats_are_refused():
    with pytest.raises(ValueError, match="repeats >= 1"):
        bench_snow.bench_snow(TINY, repeats=0)


def test_the_command_passes_its_options_on(monkeypatch, capsys, figures, tmp_path):
    asked = {}

    def stand_in(case, **options):
        asked.update(case=case, **options)
        return figures

    monkeypatch.setattr(bench_snow, "bench_snow", stand_in)
    file = tmp_path / "snow.json"
    assert bench_commands.snow(repeats=3, quick=True, scene="a:b", json_file=file) == 0
    assert asked == {"case": bench_snow.QUICK, "scene_uri": "a:b", "repeats": 3}
    assert "ACCURACY" in capsys.readouterr().out
    assert json.loads(file.read_text())["masks"] == figures["masks"]
