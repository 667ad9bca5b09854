import json
import math

import pytest

from augment.effects.flood import flood_view
from tests.streets import SMALL_STREET, open_street
from tools import bench_commands, bench_flood
from tools.bench_flood import FloodCase, flood_text
from tools.bench_flood_cost import FRONT, MIRROR, STAGES, TIERS, bench_camera, cost_cases
from tools.bench_flood_masks import neighbours

TINY = FloodCase(
    scene=SMALL_STREET,
    width=120,
    height=80,
    street=SMALL_STREET,
    frames=(0, 1),
    cameras=("front",),
    scale=0.2,
)


@pytest.fixture(scope="module")
def figures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_flood, "open_scene", open_street)
        return bench_flood.bench_flood(TINY, repeats=1, memory=False, progress=False)


def test_figures_are_json_and_hang_together(figures):
    assert json.loads(json.dumps(figures, allow_nan=False)) is not None
    cost = figures["cost"]
    assert 0.2 < cost["water_share"] < 0.5
    for case in cost["cases"]:
        for name in ("clean_ms", "flooded_ms", "ratio"):
            assert 0 < case[name]["min"] <= case[name]["median"] <= case[name]["p90"]
    for tier in cost["stages"]:
        named = [stage for stage in tier["stages"] if stage["stage"] != "the rest"]
        assert all(stage["ms"]["min"] > 0 for stage in named)
    assert math.isfinite(cost["fresnel"]["exact_over_schlick"]["median"])
    assert len(figures["errors"]) == 2
    assert figures["dry_views"] == {"looking up": True, "level below everything": True}


def test_every_tier_is_timed_and_its_own_stages(figures):
    stages = {t["tier"]: {s["stage"] for s in t["stages"]} for t in figures["cost"]["stages"]}
    assert tuple(stages) == TIERS
    assert all({FRONT, STAGES["shade_water"], STAGES["wave_field"]} <= s for s in stages.values())
    assert [MIRROR in stages[tier] for tier in TIERS] == [False, True, True]
    march = STAGES["trace_screen"]
    assert [march in stages[tier] for tier in TIERS] == [False, True, False]


def test_functions_that_were_timed_are_put_back(figures):
    for name in ("rasterize", *STAGES):
        assert "bench" not in getattr(flood_view, name).__module__


def test_text_has_a_row_for_everything(figures):
    text = flood_text(figures)
    for heading in ("COST", "stages, mirrored", "ERROR", "FRESNEL", "MASKS", "memory of a frame"):
        assert heading in text
    for case in figures["cost"]["cases"]:
        assert case["case"] in text
        assert f"{case['flooded_ms']['median']:.1f}" in text
    assert "mirrored against mirrored splats" in text
    assert f"{figures['errors'][0]['analytic']['psnr_db']:.1f}" in text
    assert text.count("screen_space, still, against mirrored") == 2
    for angle in (0, 30, 50, 60, 70, 75, 80, 85, 88):
        assert f"\n  {angle:>7} " in text
    assert text.count("the clean frame to the bit") == 2


def test_a_view_that_is_not_clean_is_said_loudly(figures):
    broken = {**figures, "dry_views": {"looking up": False}}
    assert "looking up: NOT the clean frame" in flood_text(broken)


def test_the_camera_sees_a_third_of_water():
    scene = open_street()
    camera = bench_camera(scene, 120, 80)
    assert (camera.name, camera.width, camera.height) == ("front", 120, 80)
    assert camera.centre.tolist() == scene.frames[1].cameras["front"].centre.tolist()
    names = [case.name for case in cost_cases(camera)]
    assert len(set(names)) == len(names)


def test_neighbours_go_once_around():
    cameras = open_street().frames[0].cameras
    ring = ["front", "front_right", "right", "back", "left", "front_left"]
    assert neighbours(cameras) == list(zip(ring, [*ring[1:], ring[0]], strict=True))


def test_no_repeats_are_refused():
    with pytest.raises(ValueError, match="repeats >= 1"):
        bench_flood.bench_flood(TINY, repeats=0)


def test_the_command_passes_its_options_on(monkeypatch, capsys, figures, tmp_path):
    asked = {}

    def stand_in(case, **options):
        asked.update(case=case, **options)
        return figures

    monkeypatch.setattr(bench_flood, "bench_flood", stand_in)
    file = tmp_path / "flood.json"
    assert bench_commands.flood(repeats=3, quick=True, scene="a:b", json_file=file) == 0
    assert asked == {"case": bench_flood.QUICK, "scene_uri": "a:b", "repeats": 3}
    assert "COST" in capsys.readouterr().out
    assert json.loads(file.read_text())["dry_views"] == figures["dry_views"]
