"""Snow supports kept: keys by content, files that are whole or refused, and what is remembered."""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from augment.effects.snow import support as supports
from augment.effects.snow.cells import SnowCells, SnowSupport
from augment.effects.snow.placement import PlacementSettings, place_snow_support
from augment.effects.snow.support import FORMAT, load_support, save_support, support_key, support_of
from augment.errors import OutputError, SceneError
from augment.scene import Scene, Track
from tests.snow_scenes import box_car, cameras_of, drive, sheet

SETTINGS = PlacementSettings(cell_m=0.2)


@pytest.fixture(scope="module")
def scene() -> Scene:
    cars = [box_car(), box_car(start=(9.0, -3.0), track_id="täxi/2")]
    return drive(sheet((-2, 14), (-6, 6), semantic=1), actors=cars)


@pytest.fixture(scope="module")
def support(scene: Scene) -> SnowSupport:
    found = place_snow_support(scene, cameras_of(scene), SETTINGS)
    assert len(found.ground) > 500 and set(found.actors) == {"car", "täxi/2"}
    return found


def assert_equal(a: SnowSupport, b: SnowSupport) -> None:
    assert list(a.actors) == list(b.actors)
    for one, other in ((a.ground, b.ground), *((a.actors[k], b.actors[k]) for k in a.actors)):
        for field in dataclasses.fields(SnowCells):
            x, y = getattr(one, field.name), getattr(other, field.name)
            assert x.dtype == y.dtype and torch.equal(x, y), field.name


def test_a_file_gives_back_the_support_to_the_bit(support: SnowSupport, tmp_path: Path) -> None:
    path = tmp_path / "new" / "snow.safetensors"
    save_support(path, support, "a key")
    assert_equal(load_support(path, "a key"), support)
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    save_support(path, dataclasses.replace(support, actors={}), "another")
    assert load_support(path, "another").actors == {}


def test_the_same_support_is_the_same_bytes(support: SnowSupport, tmp_path: Path) -> None:
    for name in "ab":
        save_support(tmp_path / name, support, "k")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    ground = dataclasses.replace(support.ground, light=support.ground.tracks)
    shared = SnowSupport(ground, {"a": support.actors["car"], "b": support.actors["car"]})
    save_support(tmp_path / "support", shared, "k")
    assert_equal(load_support(tmp_path / "support", "k"), shared)
    empty = place_snow_support(drive(sheet((-2, 14), (-6, 6))), [], SETTINGS)
    save_support(tmp_path / "b", empty, "k")
    assert_equal(load_support(tmp_path / "b", "k"), empty)


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
    keys = {"as it is": support_key(scene, cameras, SETTINGS)}
    again = drive(sheet((-2, 14), (-6, 6), semantic=1), actors=scene.actors)
    assert support_key(again, cameras_of(again), SETTINGS) == keys["as it is"]
    keys |= {what: support_key(other, cameras, SETTINGS) for what, other in changed(scene).items()}
    keys["fewer cameras"] = support_key(scene, cameras[:1], SETTINGS)
    keys["a wider camera"] = support_key(
        scene, [dataclasses.replace(cameras[0], fx=70.0), *cameras[1:]], SETTINGS
    )
    for change in ({"cell_m": 0.3}, {"max_slope_deg": 40.0}, {"estimator": "median"}):
        settings = dataclasses.replace(SETTINGS, **change)
        keys[str(change)] = support_key(scene, cameras, settings)
    assert len(set(keys.values())) == len(keys)
    assert all(len(key) == 40 and int(key, 16) >= 0 for key in keys.values())


def test_files_of_something_else_are_refused(support: SnowSupport, tmp_path: Path) -> None:
    path = tmp_path / "snow.safetensors"
    with pytest.raises(SceneError, match="no such file"):
        load_support(path, "k")
    save_support(path, support, "k")
    with pytest.raises(SceneError, match="of something else: its key is 'k', expected 'other'"):
        load_support(path, "other")
    save_file({"x": torch.zeros(3)}, path)
    with pytest.raises(SceneError, match="no snow support of this version"):
        load_support(path, "k")
    path.write_text("no tensors")
    with pytest.raises(SceneError, match="damaged"):
        load_support(path, "k")
    with pytest.raises(SceneError, match="damaged"):
        load_support(tmp_path, "k")


def test_cut_files_are_refused(support: SnowSupport, tmp_path: Path) -> None:
    path = tmp_path / "snow.safetensors"
    save_support(path, support, "k")
    data = path.read_bytes()
    for length in (0, 1, 7, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(SceneError, match="damaged"):
            load_support(path, "k")


def test_contents_that_do_not_fit_are_refused(support: SnowSupport, tmp_path: Path) -> None:
    path = tmp_path / "snow.safetensors"
    save_support(path, support, "k")
    whole = load_file(path)
    ids: dict = {"format": FORMAT, "key": "k", "track_ids": list(support.actors)}
    short = whole["ground.light"][1:].clone()
    neighbours, buried_by, buried = (
        whole[f"ground.{name}"].clone() for name in ("neighbours", "buried_by", "buried")
    )
    neighbours[0, 0], buried_by[0, 0], buried[0] = -3, len(support.ground), -1
    missing = {name: tensor for name, tensor in whole.items() if name != "actors.1.banks"}
    for tensors, about in (
        (whole | {"ground.light": short}, ids),
        (missing, ids),
        (whole | {"ground.tracks": whole["ground.tracks"].double()}, ids),
        (whole | {"ground.neighbours": neighbours}, ids),
        (whole | {"ground.buried_by": buried_by}, ids),
        (whole | {"ground.buried": buried}, ids),
        (whole, ids | {"track_ids": 3}),
    ):
        save_file(tensors, path, metadata={"snow_bed": json.dumps(about)})
        with pytest.raises(SceneError, match="damaged"):
            load_support(path, "k")


def test_a_support_is_found_once(scene: Scene, monkeypatch, tmp_path: Path, caplog) -> None:
    calls = []

    def counted(*arguments, **options) -> SnowSupport:
        calls.append(arguments)
        return place_snow_support(*arguments, **options)

    monkeypatch.setattr(supports, "place_snow_support", counted)
    own = dataclasses.replace(scene)
    first = support_of(own, SETTINGS, folder=tmp_path)
    assert support_of(own, SETTINGS, folder=tmp_path) is first
    assert support_of(own, SETTINGS) is first
    (path,) = tmp_path.iterdir()
    assert path.name == f"snow-{support_key(own, cameras_of(own), SETTINGS)}.safetensors"
    assert len(calls) == 1
    again = dataclasses.replace(scene)
    assert_equal(support_of(again, SETTINGS, folder=tmp_path), first)
    assert len(calls) == 1
    path.write_bytes(path.read_bytes()[:-5])
    with caplog.at_level(logging.WARNING):
        support_of(dataclasses.replace(scene), SETTINGS, folder=tmp_path)
    assert len(calls) == 2 and "placed anew" in caplog.text and str(path) in caplog.text
    caplog.clear()
    support_of(dataclasses.replace(scene), SETTINGS, folder=tmp_path)
    assert len(calls) == 2 and not caplog.text
    support_of(own, dataclasses.replace(SETTINGS, max_slope_deg=10.0))
    assert len(calls) == 3


def test_a_folder_that_cannot_be_written_is_an_error(scene: Scene, tmp_path: Path) -> None:
    in_the_way = tmp_path / "file"
    in_the_way.write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        support_of(dataclasses.replace(scene), SETTINGS, folder=in_the_way)
