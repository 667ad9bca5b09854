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
from augment.effects.style.train import StyleTrainer
from augment.errors import ClimateGSError, OutputError, StyleError
from augment.files.scene_file import load_scene_parts, save_scene
from recipes.style import Style
from tests.fitted_scenes import fitted_scene
from tools import style
from tools.cli import ApplyOptions
from tools.options import StyleTrainOptions
from tools.style import apply_style, checkpoint_folder, picture_path, style_text, train_style


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
def light(monkeypatch):
    """Few pictures to score by; torch in one thread, as trainings are."""
    monkeypatch.setattr(style, "SCORED", 2)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def without_curves(monkeypatch, light):
    """Which take ten times as long to draw as what they show."""
    monkeypatch.setattr(style, "write_curves", lambda *_: False)


@pytest.fixture
def photos(tmp_path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(4):
        coarse = rng.integers(0, 256, (4, 5, 3), np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), cv2.resize(coarse, (30, 24)))
    return folder


def train(options, **more):
    return train_style(options, progress=False, **more)


def options_of(out: Path, photos: Path, **changes) -> StyleTrainOptions:
    made = {
        "out": out, "photos": (photos,), "steps": 5, "size_px": 16, "batch": 1, "pair_batch": 1,
        "pairs": 0.0, "holdout": 0, **changes,
    }  # fmt: skip
    return StyleTrainOptions(**made)


def learnt(out: Path) -> bytes:
    return (out / "network.safetensors").read_bytes()


@pytest.mark.usefixtures("light")
def test_photos_and_a_scene_become_a_network(tmp_path, photos, capsys):
    save_scene(fitted_scene(), tmp_path / "scene")
    out = tmp_path / "out"
    options = options_of(out, photos, scenes=(f"scene:{tmp_path / 'scene'}",), views=2, pairs=1.0)
    outcome = train(options)
    assert outcome.code == 0 and outcome.report["complete"] and outcome.report["steps"] == 5
    assert outcome.report == json.loads((out / "report.json").read_bytes())
    assert set(fitted_scene().problems) < set(outcome.report["problems"])
    assert outcome.report["data"]["photos"] == 4 and outcome.report["data"]["views"] == 2
    assert {"content_rmse", "restoration_psnr", "style_loss"} <= set(outcome.report["scores"])
    steps = [row["step"] for row in outcome.report["history"] if "loss" in row]
    assert steps == [1, 2, 3, 4, 5]
    assert cv2.imread(str(out / "curves.png")) is not None
    about = network_facts(out / "network.safetensors")["about"]
    settings = about["settings"]
    assert settings["scenes"] == ["scene:scene"] and settings["photos"] == ["photos"]
    assert (settings["learning_rate"], settings["cycle"], settings["pair_range"]) == (1e-3, 10, 4)
    assert str(tmp_path) not in json.dumps(about)  # the same bytes wherever it was trained
    assert not load_network(out / "network.safetensors").training
    assert "4 photos and 2 views of 1 scenes" in capsys.readouterr().err

    again = train(options)
    assert "finished already" in capsys.readouterr().out and again.report == outcome.report


@pytest.mark.usefixtures("without_curves")
def test_an_interrupted_training_ends_with_the_same_bytes(tmp_path, photos, monkeypatch, capsys):
    whole = options_of(tmp_path / "whole", photos)
    train(whole)
    parted = options_of(tmp_path / "parted", photos)
    step = StyleTrainer.run_step

    def interrupted(trainer):
        record = step(trainer)
        if record.step == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return record

    with monkeypatch.context() as patch:
        patch.setattr(StyleTrainer, "run_step", interrupted)
        outcome = train(parted)
    assert outcome.code == 130 and outcome.report["step"] == 2 and not outcome.report["complete"]
    assert "stopped after step 2 of 5; the same command goes on" in capsys.readouterr().err
    assert learnt(parted.out) != learnt(whole.out)
    torch.set_num_threads(2)
    outcome = train(parted)
    assert "going on after step 2 of 5" in capsys.readouterr().err
    assert outcome.code == 0 and learnt(parted.out) == learnt(whole.out)
    rows = [json.loads((o.out / "report.json").read_bytes())["history"] for o in (whole, parted)]
    learning = [[{k: v for k, v in row.items() if k != "seconds"} for row in r] for r in rows]
    assert learning[0] == learning[1]
    other = options_of(tmp_path / "other", photos, seed=1)
    train(other)
    assert learnt(other.out) != learnt(whole.out)


@pytest.mark.usefixtures("without_curves")
def test_other_settings_or_data_need_another_folder(tmp_path, photos):
    out = tmp_path / "out"
    train(options_of(out, photos, steps=1))
    with pytest.raises(OutputError, match=r"cycle was 10\.0, now 5\.0.*--overwrite"):
        train(options_of(out, photos, steps=1, cycle=5.0))
    with pytest.raises(OutputError, match="its length was --steps 1"):
        train(options_of(out, photos, steps=2))
    plan = checkpoint_folder(out) / "fit.json"
    plan.write_text(plan.read_text().replace("true", "false"))
    (photos / "3.png").unlink()
    with pytest.raises(
        OutputError, match=r"not those .* was trained on so far: photos was 4, now 3"
    ):
        train(options_of(out, photos, steps=1))
    train(options_of(out, photos, steps=1, overwrite=True))
    for path in checkpoint_folder(out).iterdir():
        path.unlink()
    with pytest.raises(OutputError, match="no checkpoint to go on from"):
        train(options_of(out, photos, steps=1))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        train(options_of(tmp_path / "file", photos))


def test_options_that_cannot_be_are_named(tmp_path, photos):
    for changes, match in (
        ({"minutes": 1.0}, "--minutes or --steps, not both"),
        ({"encoder": "b1"}, "--encoder must be 'small' or 'b0'; got b1"),
        ({"encoder_weights": photos / "0.png"}, "add --encoder b0"),
        ({"vgg": Path("absent.pth")}, "--vgg .*there is no file absent.pth"),
        ({"steps": 0}, "--steps must be greater than or equal to 1; got 0"),
        ({"size_px": 4}, "--size-px must be .* 16; got 4"),
        ({"cycle": -1.0}, "--cycle must be .* 0; got -1"),
        ({"learning_rate": float("nan")}, "--learning-rate must be a finite number; got nan"),
        (dict.fromkeys(["style", "consistency", "cycle", "pairs"], 0.0), "nothing would be learnt"),
    ):
        with pytest.raises(ClimateGSError, match=match):
            options_of(tmp_path / "out", photos, **changes)
    with pytest.raises(ClimateGSError, match="give --photos FOLDER, --scene URI"):
        StyleTrainOptions(out=tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(StyleError, match="holds no images"):
        train(options_of(tmp_path / "out", tmp_path / "empty"))
    assert not (tmp_path / "out").exists()
