"""`climategs style`: a scene folder in other colours, and networks trained on a few photos."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from augment.effects.style.color_maps import style_gaussians, style_sky
from augment.effects.style.network import load_network, network_facts
from augment.effects.style.style import style_maps
from augment.effects.style.train import train_network
from augment.errors import ClimateGSError, OutputError, StyleError
from augment.files.scene_file import load_scene_parts, save_scene
from recipes.style import Style
from tests.fitted_scenes import fitted_scene
from tools import style
from tools.cli import ApplyOptions
from tools.options import StyleTrainOptions
from tools.style import apply_style, picture_path, style_text, train_style


def styled(scene, style, out, **options):
    return apply_style(ApplyOptions(scene=scene, style=style, out=out, **options))


@pytest.fixture
def scene_uri(tmp_path):
    save_scene(fitted_scene(), tmp_path / "scene")
    return f"scene:{tmp_path / 'scene'}"


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.png"
    rgb = np.random.default_rng(0).uniform(40, 120, (40, 60, 3)) * (1.8, 1.0, 0.6)
    assert cv2.imwrite(str(path), rgb[..., ::-1].astype(np.uint8))
    return path


def files_of(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_scene_is_written_in_its_new_colours(scene_uri, photo, tmp_path, capsys):
    out = tmp_path / "new" / "styled"
    facts = styled(scene_uri, str(photo), out)
    before, after = open_scene(scene_uri), open_scene(f"scene:{out}")
    maps = style_maps(before, Style(image=str(photo)))
    assert torch.equal(after.background.sh, style_gaussians(before.background, maps).sh)
    assert torch.equal(after.sky.faces, style_sky(before.sky, maps.sky).faces)
    assert not torch.equal(after.background.sh, before.background.sh)
    for a, b in zip(before.actors, after.actors, strict=True):
        assert torch.equal(b.gaussians.sh, style_gaussians(a.gaussians, maps).sh)
        assert torch.equal(a.track.timestamps_ns, b.track.timestamps_ns)
    for name in ("name", "recorded_source", "ground", "ground_z_m", "problems", "camera_names"):
        assert getattr(after, name) == getattr(before, name), name
    for name in ("means", "quats", "scales", "opacities", "semantic"):
        assert torch.equal(getattr(after.background, name), getattr(before.background, name))
    assert {**after.made_by, "styles": None} == {**before.made_by, "styles": None}
    (done,) = after.made_by["styles"]
    assert done["image"]["name"] == "photo.png" and done["method"] == "mkl"
    assert done["maps"]["splats"]["map"] == maps.splats[0].tolist()
    said = capsys.readouterr().out
    assert style_text(facts) in said and f"scene:{out}" in said and "GB/s" in said
    picture = cv2.imread(str(picture_path(out)))
    assert picture_path(out).parent == out.parent and picture.shape[1] > 2 * 33


def test_the_same_bytes_again_and_a_second_style_on_top(scene_uri, photo, tmp_path):
    one, two, three = (tmp_path / name for name in ("one", "two", "three"))
    for out in (one, two):
        styled(scene_uri, str(photo), out, strength=0.5)
    assert files_of(one) == files_of(two)
    styled(f"scene:{one}", "dusk", three, method="reinhard")
    styles = open_scene(f"scene:{three}").made_by["styles"]
    assert [s.get("preset") for s in styles] == [None, "dusk"]
    assert styles[1]["scene"] == f"scene:{one}"


def test_clamps_are_counted(scene_uri, tmp_path):
    """A style of black with a few white dots: dark, and of more contrast than fits above 0."""
    path = tmp_path / "dots.png"
    dots = np.random.default_rng(0).uniform(size=(64, 64, 1)) < 0.15
    assert cv2.imwrite(str(path), np.repeat(dots, 3, 2).astype(np.uint8) * 255)
    clamped = styled(scene_uri, str(path), tmp_path / "out")["clamped"]
    assert clamped["Gaussians"]["below 0"][1] > clamped["Gaussians"]["below 0"][0] + 0.1
    assert all(0 <= share <= 1 for pair in clamped["pixels"].values() for share in pair)
    # Splats of one colour are folded as they show, so the clamp makes no difference.
    assert clamped["pixels off a render under the style"] == 0


def test_a_recording_that_is_away_today_is_not_forgotten(tmp_path, monkeypatch):
    """Its relative path goes on meaning the same place, and its absence is no lasting problem."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    save_scene(fitted_scene(recorded_source="recording:data/drive"), tmp_path / "scene")
    monkeypatch.chdir(tmp_path)
    styled("scene:scene", "dusk", tmp_path / "out")
    written = load_scene_parts(tmp_path / "out")
    assert written.recorded_source == f"recording:{tmp_path}/elsewhere/data/drive"
    assert written.problems == fitted_scene().problems


def test_what_stands_there_is_kept(scene_uri, photo, tmp_path):
    out = tmp_path / "out"
    styled(scene_uri, str(photo), out)
    before = files_of(out)
    with pytest.raises(OutputError, match="--overwrite"):
        styled(scene_uri, "dusk", out)
    assert files_of(out) == before
    styled(scene_uri, "dusk", out, overwrite=True)
    assert files_of(out) != before
    other = tmp_path / "other"
    other.mkdir()
    (other / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="something else than a scene"):
        styled(scene_uri, "dusk", other, overwrite=True)
    assert files_of(other) == {"notes.txt": b"mine"}


def test_styles_that_cannot_be_used(scene_uri, tmp_path):
    for name, options, message in (
        ("dusc", {}, "no such style; did you mean dusk"),
        ("none.png", {}, r"none\.png"),
        ("dusk", {"method": "gscm"}, "give image instead of preset"),
        ("dusk", {"strength": 3}, "strength"),
    ):
        with pytest.raises(StyleError, match=message):
            styled(scene_uri, name, tmp_path / "out", **options)
        assert not (tmp_path / "out").exists()


# ---- Training ------------------------------------------------------------------------------------


@pytest.fixture
def photos(tmp_path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(4):
        coarse = rng.integers(0, 256, (4, 5, 3), np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), cv2.resize(coarse, (30, 24)))
    return folder


def options_of(out: Path, folder: Path, **changes) -> StyleTrainOptions:
    return StyleTrainOptions(**{"out": out, "photos": (folder,), "size_px": 16, **changes})


def learnt(out: Path) -> bytes:
    return (out / "network.safetensors").read_bytes()


def test_photos_and_a_scene_become_a_network(tmp_path, photos, capsys):
    save_scene(fitted_scene(), tmp_path / "scene")
    scenes = (f"scene:{tmp_path / 'scene'}",)
    outs = [tmp_path / name for name in ("out", "again", "other")]
    reports = [
        train_style(options_of(out, photos, scenes=scenes, steps=3, seed=seed))
        for out, seed in zip(outs, (0, 0, 1), strict=True)
    ]
    out, again, other = outs
    assert learnt(out) == learnt(again) != learnt(other)
    report = reports[0]
    assert report == json.loads((out / "report.json").read_bytes())
    assert report["complete"] and report["steps"] == 3
    assert report["data"] == {"views": 4, "photos": 4, "held_out_photos": 0}
    assert set(fitted_scene().problems) < set(report["problems"])
    (row,) = report["history"]
    assert row.keys() == {"step", "loss", "cycle", "consistency", "style", "pairs"}
    about = network_facts(out / "network.safetensors")["about"]
    settings = about["settings"]
    assert settings["scenes"] == ["scene:scene"] and settings["photos"] == ["photos"]
    assert settings["learning_rate"] == 1e-3
    assert str(tmp_path) not in json.dumps(about)  # the same bytes wherever it was trained
    assert not load_network(out / "network.safetensors").training
    assert "4 photos and 4 views of 1 scenes" in capsys.readouterr().err


def test_a_training_stops_when_asked_to_or_when_its_time_is_over(
    tmp_path, photos, monkeypatch, capsys
):
    whole = train_style(options_of(tmp_path / "whole", photos, minutes=0.02))
    assert whole["complete"] and whole["steps"] > 1

    def interrupted(*arguments, **options):
        for record in train_network(*arguments, **options):
            if record.step == 2:
                os.kill(os.getpid(), signal.SIGINT)
            yield record

    monkeypatch.setattr(style, "train_network", interrupted)
    options = options_of(tmp_path / "stopped", photos, steps=100)
    assert options.run() == 130
    assert network_facts(options.out / "network.safetensors")["about"]["steps"] == 2
    report = json.loads((options.out / "report.json").read_bytes())
    assert report["steps"] == 2 and not report["complete"]
    assert "stopped after step 2" in capsys.readouterr().err


def test_a_network_is_replaced_only_when_asked_to(tmp_path, photos):
    options = options_of(tmp_path / "out", photos, steps=1)
    assert options.run() == 0
    with pytest.raises(OutputError, match=r"holds a network: .*--overwrite"):
        train_style(options)
    train_style(options.model_copy(update={"overwrite": True}))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        train_style(options_of(tmp_path / "file", photos))


def test_options_that_cannot_be_are_named(tmp_path, photos):
    (tmp_path / "empty").mkdir()
    for changes, match in (
        ({"minutes": 1.0, "steps": 5}, "--minutes or --steps, not both"),
        ({"encoder": "b1"}, "--encoder must be 'small' or 'b0'; got b1"),
        ({"encoder_weights": photos / "0.png"}, "add --encoder b0"),
        ({"vgg": Path("absent.pth")}, "--vgg .*there is no file absent.pth"),
        ({"steps": 0}, "--steps must be greater than or equal to 1; got 0"),
        ({"size_px": 4}, "--size-px must be .* 16; got 4"),
        ({"learning_rate": float("nan")}, "--learning-rate must be a finite number; got nan"),
        ({"device": "nowhere"}, "--device nowhere: .*train on cpu, or cuda"),
        ({"photos": ()}, "give --photos FOLDER, --scene URI"),
        ({"photos": (tmp_path / "empty",)}, "holds no images"),
    ):
        with pytest.raises(ClimateGSError, match=match):
            train_style(options_of(tmp_path / "out", photos, **changes))
    assert not (tmp_path / "out").exists()
