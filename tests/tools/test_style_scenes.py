"""`climategs style apply`: a scene folder in other colours, and what is said of it."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from augment.effects.style.color_maps import style_gaussians, style_sky
from augment.effects.style.style import style_maps
from augment.errors import OutputError, StyleError
from augment.files.scene_file import load_scene_parts, save_scene
from recipes.style import Style
from tests.fitted_scenes import fitted_scene
from tools.cli import ApplyOptions
from tools.style import apply_style, picture_path, style_text


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


def test_no_strength_keeps_every_bit(scene_uri, photo, tmp_path):
    facts = styled(scene_uri, str(photo), tmp_path / "same", strength=0)
    before, after = files_of(tmp_path / "scene"), files_of(tmp_path / "same")
    for name in ("gaussians.safetensors", "sky.safetensors"):
        assert before[name] == after[name]
    assert facts["clamped"]["pixels off a render under the style"] == 0


def test_where_folding_differs_is_counted(scene_uri, tmp_path):
    """Half of what is seen shines to one side alone: below 0 to the other, where it shows black."""
    scene = open_scene(scene_uri)
    g = scene.background
    sh = torch.zeros(len(g), 4, 3)
    sh[:, 3] = 4.0
    sh[::2, 3] = -4.0
    lit = dataclasses.replace(scene, background=dataclasses.replace(g, sh=sh))
    save_scene(lit, tmp_path / "lit")
    facts = styled(f"scene:{tmp_path / 'lit'}", "overcast", tmp_path / "out")
    assert 0.02 < facts["clamped"]["pixels off a render under the style"] < 1


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


def test_a_scene_without_cameras_has_no_picture(photo, tmp_path):
    save_scene(dataclasses.replace(fitted_scene(), frames=()), tmp_path / "blind")
    facts = styled(f"scene:{tmp_path / 'blind'}", str(photo), tmp_path / "out")
    assert "picture" not in facts and "pixels" not in facts["clamped"]
    assert not picture_path(tmp_path / "out").exists()


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
    for style, options, message in (
        ("dusc", {}, "no such style; did you mean dusk"),
        ("none.png", {}, r"none\.png"),
        ("dusk", {"method": "gscm"}, "give image instead of preset"),
        ("dusk", {"strength": 3}, "strength"),
    ):
        with pytest.raises(StyleError, match=message):
            styled(scene_uri, style, tmp_path / "out", **options)
        assert not (tmp_path / "out").exists()
