"""`climategs export`: files that open again, what is printed, and what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from fitted_scenes import assert_same, fitted_scene

from adapters.base import open_scene
from augment.errors import ClimateGSError, OutputError, SceneError
from augment.files.scene_file import load_scene_parts, save_scene
from tools.cli import ExportOptions


@pytest.fixture
def uri(tmp_path: Path) -> str:
    save_scene(fitted_scene(), tmp_path / "scene")
    return f"scene:{tmp_path / 'scene'}"


def export_scene(scene: str, out: Path, **options) -> int:
    return ExportOptions(scene=scene, out=out, **options).run()


def names(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def test_a_file_is_the_scene(uri, tmp_path, capsys):
    assert export_scene(uri, tmp_path / "new" / "drive") == 0
    path = tmp_path / "new" / "drive.climategs"
    assert names(tmp_path / "new") == ["drive.climategs"]
    said = capsys.readouterr()
    assert f"wrote {path} (0.0 MB)" in said.out and "read from test:recording" in said.out
    assert "is not there" in said.err  # the note of the opened scene
    assert_same(load_scene_parts(path), fitted_scene(), but=("source",))
    for again in (open_scene(str(path)), open_scene(f"scene:{path}")):
        assert_same(again, fitted_scene(), but=("source", "problems"))
        assert again.source == f"scene:{path}"

    export_scene(f"scene:{path}", tmp_path / "half.climategs", half=True)
    assert "0.05 degrees" in capsys.readouterr().out
    half = open_scene(str(tmp_path / "half.climategs"))
    assert half.made_by["precision"] == "float16"
    assert torch.equal(half.background.means, fitted_scene().background.means)
    export_scene(str(path), tmp_path / "folder", kind="scene")
    assert_same(load_scene_parts(tmp_path / "folder"), fitted_scene(), but=("source",))


def test_a_recording_is_found_from_the_exported_file(tmp_path, monkeypatch):
    street = "procedural:street?seed=5&frames=2&gaussians=60000&lidar_columns=16&parked=0"
    save_scene(fitted_scene(recorded_source=street), tmp_path / "scene")
    export_scene(f"scene:{tmp_path / 'scene'}", tmp_path / "a")
    scene = open_scene(str(tmp_path / "a.climategs"))
    assert scene.problems == fitted_scene().problems and len(scene.boxes(1)) > 0
    # A recording named relative to where the scene was saved, and not there today.
    monkeypatch.chdir(tmp_path)
    save_scene(fitted_scene(recorded_source="pandaset:raw/002"), "scene")
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    export_scene(f"scene:{tmp_path / 'scene'}", Path("b"))
    again = load_scene_parts("b.climategs")
    assert again.recorded_source == f"pandaset:{tmp_path}/raw/002"
    assert again.problems == fitted_scene().problems


def test_baked_files_have_cameras_beside_them(uri, tmp_path, capsys, caplog):
    for kind in ("ply", "splat"):
        assert export_scene(uri, tmp_path / kind / "a", kind=kind, frame=5) == 0
        assert names(tmp_path / kind) == [f"a.{kind}", "cameras.json"]
        said = capsys.readouterr().out
        assert f"wrote {tmp_path / kind / 'cameras.json'}" in said
        assert "note: the sky is left out" in said
        assert "stand still where they are in frame 5" in said
        again = open_scene(str(tmp_path / kind / f"a.{kind}"))
        assert (
            again.camera_names == ("ahead", "left") and len(again.background) == 50
        )  # no actor then
    assert not caplog.messages  # what is lost is said once
    export_scene(uri, tmp_path / "ply" / "b.ply", kind="ply")
    said = capsys.readouterr()
    assert "stand still where they are in frame 4" in said.out and "not this" not in said.err
    (tmp_path / "ply" / "cameras.json").write_text("[]")
    export_scene(uri, tmp_path / "ply" / "b.ply", kind="ply", overwrite=True)
    assert "not this scene's; it is left as it is" in capsys.readouterr().err
    assert (tmp_path / "ply" / "cameras.json").read_text() == "[]"


def test_parts(uri, tmp_path, capsys):
    assert export_scene(uri, tmp_path / "parts", kind="ply-parts") == 0
    said = capsys.readouterr().out
    for name in names(tmp_path / "parts"):
        assert f"wrote {tmp_path / 'parts' / name}" in said
    assert len(names(tmp_path / "parts")) == 5
    with pytest.raises(OutputError, match="is there already"):
        export_scene(uri, tmp_path / "parts", kind="ply-parts")
    export_scene(uri, tmp_path / "parts", kind="ply-parts", overwrite=True)


def test_without_frames_the_first_moment_of_an_actor_is_shown(tmp_path, capsys):
    scene = dataclasses.replace(fitted_scene(), frames=())
    save_scene(scene, tmp_path / "scene")
    export_scene(f"scene:{tmp_path / 'scene'}", tmp_path / "a.ply", kind="ply")
    assert "actors (2) stand still" in capsys.readouterr().out
    assert not (tmp_path / "cameras.json").exists()


def test_what_is_refused(uri, tmp_path):
    for kind, name in (("file", "a.ply"), ("ply", "a.climategs"), ("scene", "a.splat")):
        with pytest.raises(
            ClimateGSError, match=rf"is named as --kind \w+ .* is --kind {kind}: say"
        ):
            export_scene(uri, tmp_path / name, kind=kind)
    with pytest.raises(SceneError, match="has no frame 7; it has 4 to 5"):
        export_scene(uri, tmp_path / "a", kind="ply", frame=7)
    with pytest.raises(OutputError, match="root"):
        export_scene(uri, Path("/"))
    assert {Path(name).parent.name for name in names(tmp_path)} == {"scene"}


def test_what_is_there_is_replaced_only_if_wanted(uri, tmp_path):
    for kind, suffix in {"file": "climategs", "ply": "ply", "splat": "splat"}.items():
        path = tmp_path / f"a.{suffix}"
        path.write_text("keep")
        with pytest.raises(OutputError, match=r"is there already: .* --overwrite"):
            export_scene(uri, tmp_path / "a", kind=kind)
        assert path.read_text() == "keep"
        export_scene(uri, tmp_path / "a", kind=kind, overwrite=True)
        assert path.stat().st_size > 1000
        (tmp_path / f"b.{suffix}").mkdir()
        with pytest.raises(OutputError, match="is a folder"):
            export_scene(uri, tmp_path / "b", kind=kind, overwrite=True)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").touch()
    for kind in ("scene", "ply-parts"):
        with pytest.raises(OutputError, match="holds something else"):
            export_scene(uri, tmp_path / "photos", kind=kind, overwrite=True)
    assert names(tmp_path / "photos") == ["holiday.jpg"]
