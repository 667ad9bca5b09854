"""Beds kept: keys by content, files that are whole or refused, and what is remembered."""

from __future__ import annotations

import dataclasses
import gc
import json
import logging
import time
import weakref
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from augment.effects.snow import support as beds
from augment.effects.snow.cells import SnowCells, SnowSupport
from augment.effects.snow.placement import PlacementSettings, place_snow_support
from augment.effects.snow.support import (
    FORMAT,
    bed_key,
    bed_of,
    load_bed,
    remember_support,
    save_bed,
)
from augment.errors import OutputError, SceneError
from augment.scene import Gaussians, Scene, Track
from tests.scenes import random_gaussians
from tests.snow_scenes import box_car, cameras_of, drive, sheet

SETTINGS = PlacementSettings(cell_m=0.2)


@pytest.fixture(scope="module")
def scene() -> Scene:
    cars = [box_car(), box_car(start=(9.0, -3.0), track_id="täxi/2")]
    return drive(sheet((-2, 14), (-6, 6), semantic=1), actors=cars)


@pytest.fixture(scope="module")
def bed(scene: Scene) -> SnowSupport:
    found = place_snow_support(scene, cameras_of(scene), SETTINGS)
    assert len(found.ground) > 500 and set(found.actors) == {"car", "täxi/2"}
    return found


def assert_equal(a: SnowSupport, b: SnowSupport) -> None:
    assert list(a.actors) == list(b.actors)
    for one, other in ((a.ground, b.ground), *((a.actors[k], b.actors[k]) for k in a.actors)):
        for field in dataclasses.fields(SnowCells):
            x, y = getattr(one, field.name), getattr(other, field.name)
            assert x.dtype == y.dtype and torch.equal(x, y), field.name


def test_a_file_gives_back_the_bed_to_the_bit(bed: SnowSupport, tmp_path: Path) -> None:
    path = tmp_path / "new" / "snow.safetensors"
    save_bed(path, bed, "a key")
    assert_equal(load_bed(path, "a key"), bed)
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    save_bed(path, dataclasses.replace(bed, actors={}), "another")
    assert load_bed(path, "another").actors == {}


def test_the_same_bed_is_the_same_bytes(bed: SnowSupport, tmp_path: Path) -> None:
    slower = dataclasses.replace(bed, seconds={"views": 1e3})
    for name, one in (("a", bed), ("b", bed), ("c", slower)):
        save_bed(tmp_path / name, one, "k")
    contents = {path.read_bytes() for path in tmp_path.iterdir()}
    assert len(contents) == 1


def test_tensors_that_share_memory_are_kept(bed: SnowSupport, tmp_path: Path) -> None:
    ground = dataclasses.replace(bed.ground, light=bed.ground.tracks)
    shared = SnowSupport(ground, {"a": bed.actors["car"], "b": bed.actors["car"]})
    save_bed(tmp_path / "bed", shared, "k")
    assert_equal(load_bed(tmp_path / "bed", "k"), shared)


def test_an_empty_bed_is_kept_too(scene: Scene, tmp_path: Path) -> None:
    empty = place_snow_support(scene, [], SETTINGS)
    save_bed(tmp_path / "b", empty, "k")
    assert_equal(load_bed(tmp_path / "b", "k"), empty)


def changed(scene: Scene) -> dict[str, Scene]:
    """The scene with one thing different at a time."""
    ground, car, frame = scene.background, scene.actors[0], scene.frames[0]

    def with_actor(**changes) -> Scene:
        return dataclasses.replace(
            scene, actors=(dataclasses.replace(car, **changes), *scene.actors[1:])
        )

    def with_ground(**changes) -> Scene:
        return dataclasses.replace(scene, background=dataclasses.replace(ground, **changes))

    moved = ground.means.clone()
    moved[7, 2] += 1e-3
    track = Track(car.track.timestamps_ns, car.track.world_from_actor + 0)
    track.world_from_actor[1, 0, 3] += 0.1
    ego = frame.world_from_ego.clone()
    ego[1, 3] += 0.5
    return {
        "means": with_ground(means=moved),
        "opacities": with_ground(opacities=ground.opacities * 0.9),
        "colours": with_ground(sh=ground.sh * 0.9),
        "no classes": with_ground(semantic=None),
        "a class": with_ground(semantic=torch.full((len(ground),), 3).short()),
        "a label": with_actor(label="Pedestrian"),
        "a size": with_actor(size_m=(4.0, 1.8, 1.6)),
        "a track": with_actor(track=track),
        "fewer actors": dataclasses.replace(scene, actors=scene.actors[1:]),
        "ego": dataclasses.replace(
            scene, frames=(dataclasses.replace(frame, world_from_ego=ego), *scene.frames[1:])
        ),
    }


def test_keys_tell_contents_apart(scene: Scene) -> None:
    cameras = cameras_of(scene)
    keys = {"as it is": bed_key(scene, cameras, SETTINGS)}
    again = drive(sheet((-2, 14), (-6, 6), semantic=1), actors=scene.actors)
    assert bed_key(again, cameras_of(again), SETTINGS) == keys["as it is"]
    keys |= {what: bed_key(other, cameras, SETTINGS) for what, other in changed(scene).items()}
    keys["fewer cameras"] = bed_key(scene, cameras[:1], SETTINGS)
    keys["a wider camera"] = bed_key(
        scene, [dataclasses.replace(cameras[0], fx=70.0), *cameras[1:]], SETTINGS
    )
    for change in ({"cell_m": 0.3}, {"max_slope_deg": 40.0}, {"estimator": "median"}):
        settings = dataclasses.replace(SETTINGS, **change)
        keys[str(change)] = bed_key(scene, cameras, settings)
    assert len(set(keys.values())) == len(keys)
    assert all(len(key) == 40 and int(key, 16) >= 0 for key in keys.values())


def test_directions_of_colour_do_not_change_a_key(scene: Scene) -> None:
    wide = torch.cat([scene.background.sh, torch.ones(len(scene.background), 3, 3)], 1)
    other = dataclasses.replace(scene, background=dataclasses.replace(scene.background, sh=wide))
    cameras = cameras_of(scene)
    assert bed_key(other, cameras, SETTINGS) == bed_key(scene, cameras, SETTINGS)


def test_a_key_is_found_quickly() -> None:
    few = random_gaussians(1000, sh_degree=3)
    many = Gaussians(
        *(
            getattr(few, name).repeat(1000, *[1] * (getattr(few, name).ndim - 1))
            for name in ("means", "quats", "scales", "opacities", "sh")
        )
    )
    scene = drive(many)
    start = time.process_time()
    bed_key(scene, cameras_of(scene), SETTINGS)
    assert time.process_time() - start < 1.0  # about 0.1 s


def test_files_of_something_else_are_refused(bed: SnowSupport, tmp_path: Path) -> None:
    path = tmp_path / "snow.safetensors"
    with pytest.raises(SceneError, match="no such file"):
        load_bed(path, "k")
    save_bed(path, bed, "k")
    with pytest.raises(SceneError, match="of something else: its key is 'k', expected 'other'"):
        load_bed(path, "other")
    save_file({"x": torch.zeros(3)}, path)
    with pytest.raises(SceneError, match="no snow bed of this version"):
        load_bed(path, "k")
    path.write_text("no tensors")
    with pytest.raises(SceneError, match="damaged"):
        load_bed(path, "k")
    with pytest.raises(SceneError, match="damaged"):
        load_bed(tmp_path, "k")


@pytest.mark.parametrize("keep", [0, 1, 7, 100, 0.5, 0.99])
def test_cut_files_are_refused(bed: SnowSupport, tmp_path: Path, keep: float) -> None:
    path = tmp_path / "snow.safetensors"
    save_bed(path, bed, "k")
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(len(data) * keep)])
    with pytest.raises(SceneError, match="damaged"):
        load_bed(path, "k")


@pytest.mark.parametrize(
    "how", ["shape", "missing", "type", "neighbour", "cell", "gaussian", "ids"]
)
def test_contents_that_do_not_fit_are_refused(bed: SnowSupport, tmp_path: Path, how: str) -> None:
    path = tmp_path / "snow.safetensors"
    save_bed(path, bed, "k")
    tensors = load_file(path)
    about: dict = {"format": FORMAT, "key": "k", "track_ids": list(bed.actors)}
    if how == "shape":
        tensors["ground.light"] = tensors["ground.light"][1:].clone()
    elif how == "missing":
        del tensors["actors.1.banks"]
    elif how == "type":
        tensors["ground.tracks"] = tensors["ground.tracks"].double()
    elif how == "neighbour":
        tensors["ground.neighbours"][0, 0] = -3
    elif how == "cell":
        tensors["ground.buried_by"][0, 0] = len(bed.ground)
    elif how == "gaussian":
        tensors["ground.buried"][0] = -1
    else:
        about["track_ids"] = 3
    save_file(tensors, path, metadata={"snow_bed": json.dumps(about)})
    with pytest.raises(SceneError, match="damaged"):
        load_bed(path, "k")


def test_a_bed_is_found_once(scene: Scene, monkeypatch, tmp_path: Path, caplog) -> None:
    calls = []

    def counted(*arguments, **options) -> SnowSupport:
        calls.append(arguments)
        return place_snow_support(*arguments, **options)

    monkeypatch.setattr(beds, "place_snow_support", counted)
    own = dataclasses.replace(scene)
    first = bed_of(own, SETTINGS, folder=tmp_path)
    assert bed_of(own, SETTINGS, folder=tmp_path) is first
    assert bed_of(own, SETTINGS) is first
    (path,) = tmp_path.iterdir()
    assert path.name == f"snow-{bed_key(own, cameras_of(own), SETTINGS)}.safetensors"
    assert len(calls) == 1
    again = dataclasses.replace(scene)
    assert_equal(bed_of(again, SETTINGS, folder=tmp_path), first)
    assert len(calls) == 1
    path.write_bytes(path.read_bytes()[:-5])
    with caplog.at_level(logging.WARNING):
        bed_of(dataclasses.replace(scene), SETTINGS, folder=tmp_path)
    assert len(calls) == 2 and "placed anew" in caplog.text and str(path) in caplog.text
    caplog.clear()
    bed_of(dataclasses.replace(scene), SETTINGS, folder=tmp_path)
    assert len(calls) == 2 and not caplog.text
    bed_of(own, dataclasses.replace(SETTINGS, max_slope_deg=10.0))
    assert len(calls) == 3


def test_what_is_remembered_is_what_is_given(scene: Scene, bed: SnowSupport) -> None:
    own = dataclasses.replace(scene)
    remember_support(own, SETTINGS, bed)
    assert bed_of(own, SETTINGS) is bed
    gone = weakref.ref(own)
    del own
    gc.collect()
    assert gone() is None  # memory of a scene ends with it


def test_a_folder_that_cannot_be_written_is_an_error(scene: Scene, tmp_path: Path) -> None:
    in_the_way = tmp_path / "file"
    in_the_way.write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        bed_of(dataclasses.replace(scene), SETTINGS, folder=in_the_way)


def test_progress_is_shown_where_asked_for(scene: Scene, capsys) -> None:
    place_snow_support(scene, cameras_of(scene), SETTINGS)
    assert capsys.readouterr().err == ""
    place_snow_support(scene, cameras_of(scene), SETTINGS, progress=True)
    assert "placing snow: 100%" in capsys.readouterr().err
