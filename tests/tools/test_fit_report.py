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

from augment.cameras import Camera, Frame
from augment.errors import OutputError
from augment.reconstruct.view import RecordedView, ViewKey
from augment.scene import Scene
from augment.sky import ConstantSky
from tests.scenes import camera_ahead, one_gaussian
from tools.drawing import linear_ticks, log_ticks, short_number
from tools.fit_report import (
    CELL_WIDTH,
    CURVES,
    MAX_ROWS,
    PICTURES,
    TRAINING_PICTURES,
    ViewScore,
    choose_views,
    draw_views,
    evaluate_views,
    mean_scores,
    means_by_camera,
    render_recorded,
    write_report,
)
from tools.training import FIT_PANELS, STYLE_PANELS, write_curves

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


def test_a_view_without_pixels_or_priors_has_no_figures():
    def blank(view):
        return dataclasses.replace(no_priors(view), weight=np.zeros_like(view.weight))

    scene = small_scene()
    scores = evaluate_views(scene, Views(scene, change=blank), KEYS[:1])
    assert all(math.isnan(scores[0].numbers[name]) for name in (*FIGURES, "no_surface"))
    assert mean_scores(scores) == {"scored": 0.0, "depth_pixels": 0.0}


def test_missing_surfaces_are_a_share_and_not_an_error():
    def everywhere(view):
        count = view.camera.width * view.camera.height
        return dataclasses.replace(
            view,
            depth_pixels=np.arange(count, dtype=np.int32),
            depth_m=np.full(count, 4.1, np.float32),
            depth_weight=np.ones(count, np.float32),
        )

    scene = small_scene()
    source = Views(scene, change=everywhere)
    (score,) = evaluate_views(scene, source, KEYS[:1], with_flip=False)
    assert math.isnan(score.numbers["flip"])  # as it was left out
    surface = render_recorded(scene, source.camera(KEYS[0])).has_surface
    assert 0 < score.numbers["no_surface"] < 1
    assert score.numbers["no_surface"] == pytest.approx(1 - surface.mean())
    assert score.numbers["depth_pixels"] == surface.sum()
    assert score.numbers["depth_median_m"] == pytest.approx(0.1, abs=1e-6)


def test_recorded_exposure_is_part_of_the_picture():
    scene = small_scene()
    darker = torch.eye(3, 4) * 0.5
    mapped = dataclasses.replace(scene, color_maps={"left": darker})
    rendered = {s: render_recorded(s, s.frames[0].cameras["left"]).rgb for s in (scene, mapped)}
    # Halves of 8-bit levels, each rounded on its own.
    assert np.abs(rendered[mapped] * 2.0 - rendered[scene]).max() <= 1.5
    left, right = evaluate_views(mapped, Views(scene), KEYS[:2], with_flip=False)
    assert left.numbers["psnr"] < 20 and right.numbers["psnr"] == math.inf


def test_pictures_are_clamped():
    bright = small_scene(background=one_gaussian(rgb=(3.0, 0.5, 0.2), scale=2.0))
    rgb = render_recorded(bright, bright.frames[0].cameras["left"]).rgb
    assert rgb[..., 0].max() == 255
    (score,) = evaluate_views(bright, Views(bright), KEYS[:1], with_flip=False)
    assert score.numbers["psnr"] == math.inf


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
    write_report(tmp_path, scene, Views(scene, change=noisy), history())
    views = Views(scene, test=(), train=KEYS, change=lambda view: no_priors(noisy(view)))
    report = write_report(tmp_path, scene, views, [])
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"report.json", "report.md", TRAINING_PICTURES}  # and none of the first report
    assert report["scored"]["split"] == "train" and report["scored"]["views"] == 8
    text = (tmp_path / "report.md").read_text()
    assert "No view was held out" in text and "8 training views" in text
    assert "depth error" not in text.split("## What")[0]  # without priors there is no such column


def test_report_of_equal_pictures_and_unknown_unit(tmp_path):
    scene = small_scene(has_metric_scale=False)
    report = write_report(tmp_path, scene, Views(scene), [])
    assert report["views"][0]["psnr"] is None and "psnr" not in report["mean"]
    text = (tmp_path / "report.md").read_text()
    assert "not known to be a metre" in text and "0.000 m" not in text


def test_a_folder_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    scene = small_scene()
    with pytest.raises(OutputError, match="file"):
        write_report(tmp_path / "file" / "report", scene, Views(scene), [])


def fake_scores(cameras: int, each: int) -> list[ViewScore]:
    scene = small_scene()
    (score,) = evaluate_views(scene, Views(scene), KEYS[:1], with_flip=False)
    keys = [ViewKey(f, f"camera {c}") for f in range(each) for c in range(cameras)]
    return [score._replace(key=key) for key in keys]


def test_chosen_views_are_few_and_spread():
    for cameras, each, frames in ((1, 9, [1, 4, 7]), (6, 10, [2, 7]), (2, 2, [0, 1]), (40, 1, [0])):
        chosen = choose_views(fake_scores(cameras, each))
        assert len(chosen) == min(MAX_ROWS, cameras * len(frames))
        assert [s.key.frame for s in chosen if s.key.camera == "camera 0"] == frames


def test_pictures_of_views_show_what_is_left_out(tmp_path):
    def half(view):
        weight = view.weight.copy()
        weight[:, 16:] = 0
        return dataclasses.replace(noisy(view), weight=weight)

    scene = small_scene()
    source = Views(scene, change=half)
    sheet = draw_views(scene, source, evaluate_views(scene, source, KEYS[:1]))
    error = sheet[-160:-60, 16 + 2 * (CELL_WIDTH + 6) :][:, :CELL_WIDTH]
    assert (error[:, CELL_WIDTH // 2 + 20 :] == 90).all() and not (error[:, :200] == 90).all()


def drawn(folder, history, panels=FIT_PANELS) -> np.ndarray | None:
    path = folder / "curves.png"
    return cv2.imread(str(path)) if write_curves(path, history, panels) else None


def test_curves_have_a_panel_for_each_known_quantity(tmp_path):
    assert drawn(tmp_path, []) is None
    assert drawn(tmp_path, [{"step": 50, "seconds": 1.0, "loss": math.nan}]) is None
    image = drawn(tmp_path, history())
    assert (image != 255).any(axis=2).mean() > 0.01
    one = drawn(tmp_path, [{"step": 0, "seconds": 0.0, "split": "train", "psnr": 20.0}])
    assert image.shape[0] == 2 * one.shape[0] and image.shape[1] == 2 * one.shape[1]
    rows = [{"step": s, "seconds": s / 2, "loss": -s, "cycle": 1 / s} for s in (1, 2, 3)]
    style = drawn(tmp_path, rows, STYLE_PANELS)
    assert style.shape == (one.shape[0], image.shape[1], 3)


def test_curves_take_any_number(tmp_path):
    for loss in (0.0, -1.0, 1e-30, 1e30):
        rows = [{"step": n, "seconds": n, "loss": v, "splats": 0} for n, v in ((5, loss), (9, 0.1))]
        assert drawn(tmp_path, rows) is not None


def test_without_matplotlib_the_report_lacks_its_curves_and_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    scene = small_scene()
    report = write_report(tmp_path, scene, Views(scene, change=noisy), history())
    assert {p.name for p in tmp_path.iterdir()} == {"report.json", "report.md", PICTURES}
    assert CURVES not in (tmp_path / "report.md").read_text() and report["history"]
    assert "pip install 'climategs[plots]'" in capsys.readouterr().err


def test_ticks_are_round_and_inside():
    assert linear_ticks(0, 6000) == [0, 1000, 2000, 3000, 4000, 5000, 6000]
    assert linear_ticks(3, 3) == [3]
    assert log_ticks(0.045, 0.3) == pytest.approx([0.05, 0.1, 0.2])
    assert log_ticks(1e-4, 1e3) == pytest.approx([10.0**e for e in range(-4, 4)])
    numbers = (5000, 1.5e6, 0.02, 0.0)
    assert [short_number(v) for v in numbers] == ["5k", "1.5M", "0.02", "0"]
