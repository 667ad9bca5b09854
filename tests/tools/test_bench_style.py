"""The benchmark of styles on a scene of sheets; parts whose answer is known."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from augment.scene import Scene
from augment.semantics import SemanticClass
from tests.scenes import camera_ahead, sh_of
from tests.snow_scenes import drive, sheet, wall
from tools import bench_style
from tools.bench_scene import RasterCase
from tools.bench_style import StyleCase
from tools.bench_style_cost import bench_apply, front_camera
from tools.bench_style_exact import bench_exact, clamped_pixels, folding_error, with_directions
from tools.bench_style_network import BenchNetwork, bench_network, random_network
from tools.bench_style_scores import ScoreCase, bench_scores, held_out_photos
from tools.bench_style_text import style_text
from tools.bench_style_views import KINDS, bench_views

TINY = StyleCase(
    scene="test:sheets",
    width=80,
    gaussians=500,
    street="test:sheets",
    frames=(0,),
    views_width=80,
    presets=("overcast",),
    scores=ScoreCase(size_px=32, repeats=1, pairs=2),
    b0=False,
)
EXACT = 1e-5  # of a colour in [0, 1]: float32 sums of a few tens of terms


def sheets(places: int = 8, **options) -> Scene:
    """A coloured road and walls, seen from places 0.2 m apart."""
    road = sheet((2, 9), (-2, 2), rgb=(0.3, 0.35, 0.3), semantic=int(SemanticClass.ROAD))
    rng = np.random.default_rng(0)
    far = wall(9.0, (-3, 3), (0, 2.5))
    classes = torch.full((len(far),), int(SemanticClass.BUILDING), dtype=torch.int16)
    colors = sh_of(rng.uniform(0.1, 0.9, (len(far), 3)))
    far = dataclasses.replace(far, sh=colors, semantic=classes)
    return drive(road, far, places=[(0.2 * n, 0.0, 1.5) for n in range(places)], **options)


@pytest.fixture(scope="module")
def figures(tmp_path_factory):
    photos = tmp_path_factory.mktemp("photos")
    rng = np.random.default_rng(0)
    for number in range(16):  # two of which are held out
        write_photo(photos / f"{number:02}.png", rng)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_style, "open_scene", lambda _: sheets())
        found = BenchNetwork(random_network(), True, {"name": "random", "encoder": "small"})
        patch.setattr(bench_style, "bench_network", lambda _: found)
        return bench_style.bench_style(TINY, photos=photos, repeats=1, memory=False, progress=False)


def write_photo(path, rng):
    import cv2

    ramp = np.linspace(0.2, 0.8, 24)[:, None, None]
    picture = np.clip(ramp * rng.uniform(0.3, 1, 3) + rng.normal(0, 0.1, (24, 36, 3)), 0, 1)
    cv2.imwrite(str(path), (255 * picture).astype(np.uint8))


def test_figures_are_json_and_hang_together(figures):
    assert json.loads(json.dumps(figures, allow_nan=False)) is not None
    assert all(0 <= error < EXACT for error in figures["folding"].values())
    (scene,) = figures["scenes"]
    for each in scene["exact"]:
        assert 0 <= each["touched_share"] <= 1 and 0 <= each["visible_share"] <= 1
        assert each["untouched_max"] < EXACT
        assert each["visible_share"] <= each["touched_share"]
    assert {each["colors"] for each in scene["exact"]} == {"SH 0", "SH 3"}
    for case in scene["frames"]["cases"]:
        for name in ("clean_ms", "styled_ms", "ratio"):
            assert 0 < case[name]["min"] <= case[name]["median"] <= case[name]["p90"]
    assert scene["memory"] is None
    maps = figures["maps"]
    for ms in (maps["read_ms"], *maps["map_ms"].values(), *maps["scene_ms"].values()):
        assert 0 < ms["min"] <= ms["p90"]
    scores = {each["method"]: each for each in figures["scores"]["methods"]}
    assert figures["scores"]["photos"] == 2
    best = figures["scores"]["limits_db"]
    assert scores["none"]["same"] < scores["mkl"]["same"] <= best["3x4"] + 1e-3
    assert best["3x3"] <= best["3x4"] + 1e-3


def test_text_has_a_row_for_everything(figures):
    text = style_text(figures)
    for heading in (
        "FOLDING",
        "APPLY",
        "SH AGAINST COLOURS",
        "FRAMES",
        "STYLE IMAGE TO MAP",
        "SCORES",
        "VIEWS",
    ):
        assert f"\n{heading} " in text
    for name in ("one map, in place", "one map, as it is", "mkl", "reinhard", "clean"):
        assert f"\n  {name} " in text


def test_without_photos_scores_say_so(figures):
    found = bench_scores(bench_network(None), [], TINY.scores, progress=False)
    assert found == {"skipped": "no photos were given"}
    text = style_text({**figures, "scores": found})
    assert "SCORES  left out: no photos were given" in text


def test_photos_that_the_network_was_not_trained_on_are_scored_on(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for number in range(8):
            write_photo(tmp_path / name / f"{number}.png", rng)
    every = held_out_photos([tmp_path], (), 16, 8)
    assert len(every) == 2
    named = held_out_photos([tmp_path], ("a/7.png", "b/7.png", "c/7.png"), 16, 8)
    assert torch.equal(named, every)
    one = held_out_photos([tmp_path / "b" / "7.png", tmp_path / "a"], ("b/7.png",), 16, 8)
    assert torch.equal(one, every[1:])


def test_views_of_a_styled_scene_agree_as_those_of_the_clean_one_do():
    rows = bench_views(sheets(), (0,), ("night",), 80)
    clean, night = rows[0], rows[1]
    for kind in KINDS[:2]:
        assert clean[kind]["rmse_ratio"] == clean[kind]["relative_ratio"] == 1
        assert clean[kind]["rmse"] > 0 and 0 < clean[kind]["share"] <= 1
        assert night[kind]["rmse_ratio"] < 1  # less contrast, less error
        # A map of three channels scales errors and spread by nearly the same.
        assert night[kind]["relative_ratio"] == pytest.approx(1, abs=0.15)
    assert clean[KINDS[1]]["rmse"] > clean[KINDS[0]]["rmse"]
    short = bench_views(sheets(2), (0,), ("night",), 80)[0]
    assert short[KINDS[0]] is not None and short[KINDS[1]] is None


def test_random_networks_map_colours_and_fold():
    for offset in (True, False):
        net = random_network(offset=offset)
        assert folding_error(net) < EXACT
        picture = torch.rand(1, 3, net.size, net.size, generator=torch.Generator().manual_seed(1))
        with torch.no_grad():
            found = net.style_map(net.encode(picture)[1])[0]
        assert float((found - torch.eye(3, 4)).abs().max()) > 0.01
    state = torch.get_rng_state()
    random_network()
    assert torch.equal(state, torch.get_rng_state())


def test_pixels_are_touched_exactly_where_a_colour_is_below_zero():
    scene = sheets(1)
    camera = scene.frames[0].cameras["ahead"]
    assert not clamped_pixels(scene, camera).any()
    sh = scene.background.sh.clone()
    is_road = scene.background.semantic == int(SemanticClass.ROAD)
    sh[is_road] = sh_of(np.full((int(is_road.sum()), 3), -0.1))
    dark = dataclasses.replace(scene, background=dataclasses.replace(scene.background, sh=sh))
    touched = clamped_pixels(dark, camera)
    assert touched[-5:, 60:100].all() and not touched[:20].any()
    (flat,) = [e for e in bench_exact(dark, camera, ("overcast",)) if e["colors"] == "SH 0"]
    assert flat["touched_share"] == pytest.approx(touched.mean())
    assert flat["touched_max"] < EXACT  # folding knows what a splat without directions shows
    no_slopes = torch.zeros(len(sh), 3, 3)
    wide = dataclasses.replace(dark.background, sh=torch.cat([sh, no_slopes], 1))
    (found,) = bench_exact(dataclasses.replace(dark, background=wide), camera, ("overcast",))
    assert found["colors"] == "SH 1" and found["touched_share"] == flat["touched_share"]
    assert found["touched_max"] > 1 / 255 > EXACT > found["untouched_max"]


def test_directions_leave_the_mean_colour():
    scene = sheets(1)
    wide = with_directions(scene)
    assert wide.background.sh.shape[1] == 16
    assert torch.equal(wide.background.sh[:, :1], scene.background.sh)
    assert torch.equal(wide.background.sh, with_directions(scene).background.sh)


def test_applying_counts_what_it_moves():
    found = bench_apply(RasterCase(300, 640, 480), 1)
    assert found["bytes"] == 2 * 300 * 16 * 3 * 4
    for name in ("one map, in place", "one map, new memory", "a map a class, in place"):
        each = found[name]
        speed = found["bytes"] / each["ms"]["median"] / 1e6
        assert each["gb_per_s"]["median"] == pytest.approx(speed)


def test_the_front_camera_has_the_width_asked_for():
    scene = sheets(3)
    camera = front_camera(scene, 40)
    own = scene.frames[1].cameras["ahead"]
    assert camera.width == 40 and camera.fx == pytest.approx(own.fx * 40 / own.width)
    assert torch.equal(camera.centre, own.centre)
    assert camera_ahead().name == camera.name


def test_no_repeats_are_refused():
    with pytest.raises(ValueError, match="repeats >= 1"):
        bench_style.bench_style(TINY, repeats=0)
