"""Evaluation of a scene on views that were rendered from it, where every answer is known."""

from __future__ import annotations

import dataclasses
import json
import math
import sys

import cv2
import numpy as np
import pytest
import torch

from adapters.procedural import ExactView, open_procedural, open_truth
from augment.reconstruct.view import RecordedView, ViewKey
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rigid
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky
from tests.scenes import camera_ahead, one_gaussian
from tools.fit_report import (
    CELL_WIDTH,
    CURVES,
    PICTURES,
    TRAINING_PICTURES,
    ViewScore,
    evaluate_views,
    mean_scores,
    means_by_camera,
    render_recorded,
    true_depth_errors,
    write_report,
)
from tools.training import FIT_PANELS, write_curves

KEYS = tuple(ViewKey(frame, name) for frame in range(4) for name in ("left", "right"))
FIGURES = ("psnr", "ssim", "flip")


def small_scene(**changes) -> Scene:
    """A wall that covers most of the image, before a grey sky."""
    background = one_gaussian(scale=(0.05, 1.4, 0.6), opacity=0.95)
    camera = dataclasses.replace(camera_ahead(), name="left")
    cameras = {"left": camera, "right": dataclasses.replace(camera, name="right")}
    frames = tuple(Frame(i, i, torch.eye(4, dtype=torch.float64), cameras) for i in range(4))
    sky = ConstantSky(torch.tensor([0.5, 0.6, 0.7]))
    scene = Scene("wall", "test:wall", background, (), sky, frames)
    return dataclasses.replace(scene, **changes)


class Views:
    """What `scene` itself looks like, with its own depth as priors, changed by `change`."""

    def __init__(self, scene: Scene, *, test=KEYS[4:], train=KEYS[:4], change=lambda view: view):
        self.scene, self.test, self.train, self.change = scene, test, train, change

    @property
    def camera_of(self) -> dict[str, Camera]:
        return dict(self.scene.frames[0].cameras)

    def camera(self, key: ViewKey) -> Camera:
        return self.camera_of[key.camera]

    def load(self, key: ViewKey) -> RecordedView:
        camera = self.camera(key)
        rendered = render_recorded(self.scene, camera)
        pixels = np.flatnonzero(rendered.has_surface)[::3].astype(np.int32)
        view = RecordedView(
            camera=camera,
            rgb=rendered.rgb,
            weight=np.ones(rendered.alpha.shape, np.float32),
            sky=np.zeros(rendered.alpha.shape, np.bool_),
            depth_pixels=pixels,
            depth_m=rendered.median_depth_m.reshape(-1)[pixels],
            depth_weight=np.ones(len(pixels), np.float32),
        )
        return self.change(view)


def no_priors(view: RecordedView) -> RecordedView:
    none = np.zeros(0, np.float32)
    return dataclasses.replace(
        view, depth_pixels=none.astype(np.int32), depth_m=none, depth_weight=none
    )


def test_a_scene_matches_itself():
    scene = small_scene()
    scores = evaluate_views(scene, Views(scene), KEYS[:2])
    assert [score.key for score in scores] == list(KEYS[:2])
    for score in scores:
        exact = {"psnr": math.inf, "flip": 0, "scored": 1, "no_surface": 0}
        exact |= {"depth_median_m": 0, "depth_p90_m": 0, "depth_within_5cm": 1}
        assert score.numbers | exact == score.numbers
        assert score.numbers["ssim"] == pytest.approx(1, abs=1e-12)  # float64 rounding
        assert score.numbers["depth_pixels"] > 50
        assert score.numbers["expected_depth_median_m"] < 1e-5  # one surface: both are its own


def test_pixels_of_weight_0_are_left_out_and_counted():
    def spoil(view):
        rgb, weight = view.rgb.copy(), view.weight.copy()
        rgb[:7], weight[:7] = 255 - rgb[:7], 0
        weight[7:9] = 0.3  # learning little from a pixel does not excuse its errors
        return dataclasses.replace(view, rgb=rgb, weight=weight)

    scene = small_scene()
    (score,) = evaluate_views(scene, Views(scene, change=spoil), KEYS[:1])
    assert score.numbers["psnr"] == math.inf and score.numbers["flip"] == 0
    assert score.numbers["scored"] == pytest.approx(14 / 21)


def test_recorded_exposure_is_part_of_the_picture():
    scene = small_scene()
    darker = torch.eye(3, 4) * 0.5
    mapped = dataclasses.replace(scene, color_maps={"left": darker})
    rendered = {s: render_recorded(s, s.frames[0].cameras["left"]).rgb for s in (scene, mapped)}
    # Halves of 8-bit levels, each rounded on its own.
    assert np.abs(rendered[mapped] * 2.0 - rendered[scene]).max() <= 1.5
    left, right = evaluate_views(mapped, Views(scene), KEYS[:2], with_flip=False)
    assert left.numbers["psnr"] < 20 and right.numbers["psnr"] == math.inf


def test_means_are_of_what_is_known():
    scene = small_scene()
    (known,) = evaluate_views(scene, Views(scene), KEYS[:1])
    known = known._replace(numbers=known.numbers | {"psnr": 20.0, "flip": 0.5})
    other = ViewScore(KEYS[1], known.numbers | {"psnr": 30.0, "flip": math.nan})
    means = mean_scores([known, other])
    assert means["psnr"] == 25 and means["flip"] == 0.5
    assert "psnr" not in mean_scores([ViewScore(KEYS[0], known.numbers | {"psnr": math.inf})])
    assert mean_scores([]) == {}
    by_camera = means_by_camera([known, other])
    assert {name: row["psnr"] for name, row in by_camera.items()} == {"left": 20, "right": 30}
    assert by_camera["left"]["views"] == 1


def history():
    rows = []
    for step in range(0, 501, 50):
        rows.append({"step": step, "seconds": 0.2 * step, "loss": 1 / (step + 10), "splats": 7})
    for split in ("test", "train"):
        rows.append({"step": 0, "seconds": 0.0, "split": split, "psnr": 20.0})
        rows.append({"step": 500, "seconds": 99.0, "split": split, "psnr": 24.5})
    return rows


def noisy(view):
    noise = np.random.default_rng(0).integers(-9, 9, view.rgb.shape)
    return dataclasses.replace(view, rgb=np.clip(view.rgb + noise, 0, 255).astype(np.uint8))


def test_report(tmp_path):
    scene = small_scene()
    facts = {"scene": "pandaset:x", "step": 500, "steps": 500, "seconds": 99.0, "loss": math.nan}
    facts |= {"problems": ["camera left, frame 2: no image"], "settings": {"scale": 0.25}}
    folder = tmp_path / "new" / "report"
    report = write_report(folder, scene, Views(scene, change=noisy), history(), facts)
    write_report(tmp_path, scene, Views(scene, change=noisy), history(), facts)
    assert all((tmp_path / p.name).read_bytes() == p.read_bytes() for p in folder.iterdir())
    assert {p.name for p in folder.iterdir()} == {"report.json", "report.md", CURVES, PICTURES}
    read = json.loads((folder / "report.json").read_text(), parse_constant=pytest.fail)
    assert read == report
    assert report["scored"] == {"split": "test", "views": 4, "note": ""}
    assert report["loss"] is None  # NaN is no JSON
    assert report["cameras"]["left"]["views"] == 2
    assert [v["frame"] for v in report["views"]] == [2, 2, 3, 3]
    assert report["training_sample"]["views"] == 4
    assert "history" in report and report["gaussians"] == 1

    text = (folder / "report.md").read_text()
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert len(table) == 5  # head, rule, two cameras, all
    assert len({line.count("|") for line in table}) == 1
    assert f"{report['mean']['psnr']:.2f}" in table[-1] and "**all**" in table[-1]
    for part in ("4 held-out views", "500 of 500 steps in 1.6 minutes", PICTURES, "no image"):
        assert part in text

    image = cv2.imread(str(folder / PICTURES))
    assert image.shape[1] > 4 * CELL_WIDTH and image.shape[0] > 4 * CELL_WIDTH * 21 / 33


def test_without_held_out_views_training_views_are_scored_and_it_says_so(tmp_path):
    scene = small_scene()
    for name in (CURVES, PICTURES, "report.json"):  # of an earlier report
        (tmp_path / name).touch()
    views = Views(scene, test=(), train=KEYS, change=lambda view: no_priors(noisy(view)))
    report = write_report(tmp_path, scene, views, [])
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"report.json", "report.md", TRAINING_PICTURES}  # and none of the first report
    assert report["scored"]["split"] == "train" and report["scored"]["views"] == 8
    text = (tmp_path / "report.md").read_text()
    assert "No view was held out" in text and "8 training views" in text
    assert "depth error" not in text.split("## What")[0]  # without priors there is no such column


def drawn(folder, history, panels=FIT_PANELS) -> np.ndarray | None:
    path = folder / "curves.png"
    return cv2.imread(str(path)) if write_curves(path, history, panels) else None


class OwnTruth:
    """A truth that is the scene itself, 0.25 m farther on the right half, with sky at the top."""

    def __init__(self, scene: Scene):
        self.scene = scene

    def render(self, camera: Camera) -> ExactView:
        depth = render_recorded(self.scene, camera).median_depth_m.astype(np.float64)
        depth[depth == 0] = 7.0
        semantic = np.full(depth.shape, SemanticClass.ROAD, np.int16)
        half = camera.width // 2
        depth[:, half:] += 0.25
        semantic[:, half:] = SemanticClass.BUILDING
        depth[:10], semantic[:10] = np.inf, SemanticClass.SKY
        nothing = np.zeros((*depth.shape, 3), np.float32)
        return ExactView(nothing, depth, nothing, semantic, semantic.astype(np.int32))


def test_depth_errors_are_those_of_a_known_difference():
    scene = small_scene()
    camera = scene.frames[0].cameras["left"]
    seen = render_recorded(scene, camera)
    errors = true_depth_errors(scene, OwnTruth(scene), [camera, camera])
    assert errors["views"] == 2 and errors["by_class"].keys() == {"road", "building"}
    assert errors["by_class"]["road"]["p90_m"] == 0
    assert errors["by_class"]["building"]["median_m"] == pytest.approx(0.25)
    solid, below = seen.has_surface, np.arange(camera.height) >= 10
    assert errors["median"]["pixels"] == 2 * solid[below].sum()
    assert errors["no_surface"] == pytest.approx(1 - solid[below].mean())
    assert errors["sky_covered"] == pytest.approx(solid[:10].mean())
    assert errors["sky_alpha"] == pytest.approx(seen.alpha[:10].mean())

    away = one_gaussian(mean=(0.0, 0.0, -500.0), opacity=0.01)
    nothing = true_depth_errors(small_scene(background=away), OwnTruth(scene), [camera])
    assert nothing["no_surface"] == 1 and nothing["sky_alpha"] == nothing["sky_covered"] == 0
    assert nothing["median"]["pixels"] == 0 and math.isnan(nothing["median"]["median_m"])
    none = true_depth_errors(scene, OwnTruth(scene), [])
    assert none["views"] == 0 and none["by_class"] == {} and np.isnan(none["sky_alpha"])

    shift = torch.tensor([100.0, -20.0, 3.0], dtype=torch.float64)  # of the dataset's origin
    background = dataclasses.replace(scene.background, means=scene.background.means - shift.float())
    moved = small_scene(background=background, world_origin_m=shift.numpy())
    back = rigid(torch.eye(3, dtype=torch.float64), shift)  # dataset from scene
    there = dataclasses.replace(camera, camera_from_world=camera.camera_from_world @ back)
    expected = true_depth_errors(scene, OwnTruth(scene), [camera])
    actual = true_depth_errors(moved, OwnTruth(scene), [there])
    # float32 means 100 m away: 1e-5 m each.
    for name in ("median_m", "p90_m"):
        assert actual["median"][name] == pytest.approx(expected["median"][name], abs=1e-3)
    assert actual["sky_alpha"] == pytest.approx(expected["sky_alpha"], abs=1e-3)


@pytest.mark.long
def test_the_streets_own_splats_are_near_its_exact_surfaces():
    query = {"seed": "3", "gaussians": "60000", "frames": "2", "width": "96", "height": "54"}
    scene, truth = open_procedural(query), open_truth(query)
    cameras = list(scene.frames[1].cameras.values())[:2]
    errors = true_depth_errors(scene, truth, cameras)
    # In so small an image a splat's blur of half a pixel spans metres of the road ahead.
    assert errors["median"]["abs_rel"] < 0.1 and errors["expected"]["abs_rel"] < 0.1
    assert errors["no_surface"] < 0.05 and errors["sky_covered"] < 0.4
    assert sum(e["pixels"] for e in errors["by_class"].values()) == errors["median"]["pixels"]
    assert "road" in errors["by_class"] and "sky" not in errors["by_class"]


def test_views_and_reports_that_lack_something_say_so(tmp_path, monkeypatch, capsys):
    def blank(view):
        return dataclasses.replace(no_priors(view), weight=np.zeros_like(view.weight))

    def everywhere(view):
        count = view.camera.width * view.camera.height
        depth, weight = np.full(count, 4.1, np.float32), np.ones(count, np.float32)
        pixels = np.arange(count, dtype=np.int32)
        priors = {"depth_pixels": pixels, "depth_m": depth, "depth_weight": weight}
        return dataclasses.replace(view, **priors)

    scene = small_scene(has_metric_scale=False)
    scores = evaluate_views(scene, Views(scene, change=blank), KEYS[:1])
    assert all(math.isnan(scores[0].numbers[name]) for name in (*FIGURES, "no_surface"))
    assert mean_scores(scores) == {"scored": 0.0, "depth_pixels": 0.0}
    # Missing surfaces are a share and not an error.
    source = Views(scene, change=everywhere)
    (score,) = evaluate_views(scene, source, KEYS[:1], with_flip=False)
    assert math.isnan(score.numbers["flip"])  # as it was left out
    surface = render_recorded(scene, source.camera(KEYS[0])).has_surface
    assert 0 < score.numbers["no_surface"] < 1
    assert score.numbers["no_surface"] == pytest.approx(1 - surface.mean())
    assert score.numbers["depth_median_m"] == pytest.approx(0.1, abs=1e-6)

    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    report = write_report(tmp_path, scene, Views(scene), history())
    assert report["views"][0]["psnr"] is None and "psnr" not in report["mean"]
    assert {p.name for p in tmp_path.iterdir()} == {"report.json", "report.md", PICTURES}
    text = (tmp_path / "report.md").read_text()
    assert "not known to be a metre" in text and "0.000 m" not in text and CURVES not in text
    assert "pip install 'climategs[plots]'" in capsys.readouterr().err


def test_curves_have_a_panel_for_each_known_quantity(tmp_path):
    assert drawn(tmp_path, []) is None
    assert drawn(tmp_path, [{"step": 50, "seconds": 1.0, "loss": math.nan}]) is None
    rows = [{"step": s, "seconds": s, "loss": v, "splats": 1} for s, v in enumerate((0, -1, 1e30))]
    image, one = drawn(tmp_path, rows), drawn(tmp_path, rows, FIT_PANELS[:1])
    assert image.shape[1] == 2 * one.shape[1] and (image != 255).any(axis=2).mean() > 0.01
