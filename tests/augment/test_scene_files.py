"""Scene folders: to the bit and back, whole or not at all, and what is said of damaged ones."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import struct
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from augment.errors import OutputError, SceneError
from augment.files import tensors as tensor_files
from augment.files.scene_file import (
    FILES,
    is_scene_file,
    is_scene_folder,
    load_scene_parts,
    read_saved_scene,
    save_scene,
    save_scene_file,
)
from augment.render.sh import evaluate_sh
from augment.scene.geometry import multiply_quats
from augment.scene.scene import Actor, ColorSeries, Gaussians, Track
from augment.scene.sky import ConstantSky, LatLongSky
from tests.fitted_scenes import assert_same, fitted_scene
from tests.scenes import camera_ahead, random_gaussians

DIFFERENT = ("source", "labels")  # a loaded scene is opened from its folder


def waving(terms: int) -> Actor:
    """An actor of one Gaussian, whose colours change in so many terms."""
    waves = ColorSeries(torch.zeros(1, terms, 3), torch.tensor([0]), torch.zeros(1).double())
    track = Track(torch.tensor([0]), torch.eye(4, dtype=torch.float64)[None])
    return Actor("1", "Car", random_gaussians(1), track, (1.0, 1.0, 1.0), waves)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("saved") / "fit"
    save_scene(fitted_scene(), folder)
    return folder


@pytest.fixture
def saved(written, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "fit"))


def hidden(folder: Path) -> list[str]:
    return [entry.name for entry in folder.iterdir() if entry.name.startswith(".")]


@pytest.mark.parametrize("sky", [None, ConstantSky(torch.rand(3)), LatLongSky(torch.rand(4, 7, 3))])
@pytest.mark.parametrize("name", ["fit", "fit.climategs"])
def test_a_scene_comes_back_to_the_bit(tmp_path, name, sky):
    scene = fitted_scene() if sky is None else fitted_scene(sky=sky)
    path = tmp_path / "new" / name
    (save_scene_file if is_scene_file(path) else save_scene)(scene, path)
    again = load_scene_parts(path)
    assert_same(scene, again, but=DIFFERENT)
    assert again.source == f"scene:{path}"
    assert str(read_saved_scene(path).working_folder) == os.getcwd()
    assert [entry.name for entry in path.parent.iterdir()] == [name]
    if is_scene_file(path):
        assert path.stat().st_mode & 0o777 == 0o666 & ~os.umask(os.umask(0o22))
    else:
        assert is_scene_folder(path) and {entry.name for entry in path.iterdir()} == {*FILES}


def test_equal_scenes_make_equal_files(tmp_path, saved):
    save_scene(load_scene_parts(saved), tmp_path / "again")
    for name in FILES:
        assert (saved / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_what_else_a_scene_may_be(tmp_path):
    """No frames, no actors, unknown ground, an empty background, no recording but its source."""
    empty = fitted_scene(background=Gaussians.empty(2), frames=(), color_maps={}, made_by={})
    empty = dataclasses.replace(empty, ground_z_m=None, problems=(), recorded_source=None)
    save_scene(empty, tmp_path / "fit")
    again = load_scene_parts(tmp_path / "fit")
    assert_same(empty, again, but=(*DIFFERENT, "recorded_source"))
    assert again.recorded_source == empty.source
    save_scene(fitted_scene(actors=()), tmp_path / "fit")
    assert load_scene_parts(tmp_path / "fit").actors == ()


def test_cameras_from_above_stay_so(tmp_path):
    above = dataclasses.replace(camera_ahead(), is_orthographic=True)
    frame = dataclasses.replace(fitted_scene().frames[0], cameras={"ahead": above}, image_paths={})
    save_scene(fitted_scene(frames=(frame,)), tmp_path / "fit")
    assert load_scene_parts(tmp_path / "fit").frames[0].cameras["ahead"].is_orthographic


def test_arrays_are_mapped_and_writes_to_them_stay_in_memory(saved):
    before = (saved / FILES[1]).read_bytes()
    load_scene_parts(saved).background.means[:] = 0
    assert (saved / FILES[1]).read_bytes() == before


def test_image_paths_become_absolute(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = dataclasses.replace(fitted_scene().frames[0], image_paths={"ahead": "data/4.jpg"})
    save_scene(fitted_scene(frames=(first,)), "fit")
    paths = load_scene_parts("fit").frames[0].image_paths
    assert paths == {"ahead": str(tmp_path / "data" / "4.jpg")}


@pytest.mark.long
def test_a_million_gaussians_open_at_once(tmp_path):
    scene = fitted_scene(background=random_gaussians(1_000_000, sh_degree=1))
    save_scene(scene, tmp_path / "fit")
    seconds = []
    for _ in range(3):
        begun = time.process_time()
        load_scene_parts(tmp_path / "fit")
        seconds.append(time.process_time() - begun)
    assert min(seconds) < 0.5  # 0.05 s on a busy machine with two cores


def test_what_cannot_be_kept_is_refused(tmp_path):
    class OwnSky(ConstantSky):
        pass

    scene = fitted_scene()
    wide = random_gaussians(3, dtype=torch.float64)
    ego = torch.diag(torch.tensor([2.0, 1, 1, 1], dtype=torch.float64))
    stretched = dataclasses.replace(scene.frames[0], world_from_ego=ego)
    for changes, message in (
        ({"sky": OwnSky(torch.zeros(3))}, "a sky of class OwnSky cannot be saved"),
        ({"background": wide}, "saved scenes hold float32; got torch.float64"),
        ({"made_by": {"loss": float("nan")}}, "made_by must hold JSON's own types"),
        ({"made_by": {"config": object()}}, "made_by must hold JSON's own types"),
        ({"frames": (stretched,)}, "frames.0.world_from_ego: .*a pose must be a rotation"),
        ({"made_by": {"name": "\ud800"}}, "made_by must hold JSON's own types"),
        ({"name": "a\0b"}, "name: .*NUL"),
        ({"actors": (waving(1001),)}, "waves of 1001 terms; saved scenes hold 1000"),
    ):
        with pytest.raises(SceneError, match=message):
            save_scene(dataclasses.replace(scene, **changes), tmp_path / "fit")
    assert not list(tmp_path.iterdir())


# Replacing


def test_a_folder_that_is_no_scene_is_not_replaced(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").touch()
    with pytest.raises(OutputError, match="holds other files and no scene"):
        save_scene(fitted_scene(), tmp_path / "photos")
    assert [p.name for p in (tmp_path / "photos").iterdir()] == ["holiday.jpg"]
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file"):
        save_scene(fitted_scene(), tmp_path / "file")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "scene.json").write_text('{"format": "of another program"}')
    with pytest.raises(OutputError, match="holds other files and no scene"):
        save_scene(fitted_scene(), tmp_path / "other")
    (tmp_path / "empty").mkdir()
    save_scene(fitted_scene(), tmp_path / "empty")
    assert not hidden(tmp_path)


def test_replacing_keeps_what_else_is_there(tmp_path, saved):
    (saved / "report").mkdir()
    (saved / "report" / "curves.png").write_bytes(b"png")
    (tmp_path / "link").symlink_to(saved)
    save_scene(fitted_scene(name="new"), tmp_path / "link")
    assert load_scene_parts(saved).name == "new"
    assert (saved / "report" / "curves.png").read_bytes() == b"png"
    assert (tmp_path / "link").is_symlink() and not hidden(tmp_path)


@pytest.mark.parametrize("stop_at", range(4))
@pytest.mark.parametrize("is_killed", [False, True])
def test_a_save_that_ends_at_any_flush_leaves_one_of_the_two(tmp_path, saved, is_killed, stop_at):
    """In a process of its own, whose disk is full at one of the flushes, or which is killed."""
    calls, flush = iter(range(1000)), os.fsync

    def failing(descriptor):
        if next(calls) == stop_at:
            if is_killed:
                os.kill(os.getpid(), signal.SIGKILL)
            raise OSError(28, os.strerror(28))
        flush(descriptor)

    (saved / "notes.txt").write_text("keep")
    child = os.fork()
    if child == 0:
        os.fsync, code = failing, 1
        try:
            save_scene(fitted_scene(name="new"), saved)
            code = 0
        except OutputError as error:
            code = 28 if "the disk is full" in str(error) else 1
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, -signal.SIGKILL if is_killed else 28)
    assert load_scene_parts(saved).name in (("drive 2", "new") if code else ("new",))
    save_scene(fitted_scene(name="newest"), saved)
    assert load_scene_parts(saved).name == "newest"
    assert (saved / "notes.txt").read_text() == "keep"
    assert not hidden(tmp_path)


# Damaged and hostile folders


def test_missing_and_damaged_files_are_named(saved, tmp_path):
    for name in FILES:
        hurt = tmp_path / f"without {name}"
        shutil.copytree(saved, hurt)
        (hurt / name).unlink()
        with pytest.raises(SceneError, match=f"no scene folder: it has no {name}"):
            load_scene_parts(hurt)
    for name in FILES:
        data = (saved / name).read_bytes()
        for damaged in (b"", data[:5], data[: len(data) // 2], data[:-1], data + b"\0"):
            if name == FILES[0] and damaged.strip(b"\n") == data.strip(b"\n"):
                continue
            hurt = tmp_path / "hurt"
            shutil.copytree(saved, hurt, dirs_exist_ok=True)
            (hurt / name).write_bytes(damaged)
            with pytest.raises(SceneError, match=name):
                load_scene_parts(hurt)


POSE = ("actors", 0, "track", "world_from_actor", 1, 0, 0)  # a number of a pose
GONE = {"camera": "gone", "timestamp_ns": 0, "rows": [[1.0] * 4] * 3}


def inner(raw, path):
    """The object or list that holds the last key of a path."""
    for key in path[:-1]:
        raw = raw[key]
    return raw


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("format",), "other", r'"format" must be \'climategs-scene\'; got \'other\''),
        (("version",), 3, "reads scenes of version 2; got 3"),
        (("version",), [], r"reads scenes of version 2; got \[\]"),
        (("precision",), "float16", r"background\.quats must be float16 .*; got float32"),
        (("precision",), "float64", "'float32' or 'float16'; got 'float64'"),
        (("colour_maps",), {}, "colour_maps: Extra inputs are not permitted"),
        (("background_gaussians",), 51, r"means must be float32 \[51, 3\]; got .* \[50, 3\]"),
        (("actors", 0, "gaussians"), "7", r"actors\.0\.gaussians: .*valid integer; got '7'"),
        (("actors", 0, "track_id"), "é", "track_ids repeat"),
        (("actors", 0, "track", "timestamps_ns"), [1, 1, 2], "'car/1': track timestamps"),
        (("actors", 0, "track", "timestamps_ns"), [1, 2], "'car/1': a track needs"),
        (("actors", 0, "track", "timestamps_ns"), [2**63], "less than"),
        (POSE, 9.0, "world_from_actor: .*a pose must"),
        (POSE, 1e300, "world_from_actor: .*a pose must"),
        (("actors", 0, "track", "max_gap_ns"), 0.5, "max_gap_ns: .*valid integer"),
        (("actors", 0, "color_waves"), None, r"does not know: \['actors\.0\.waves'\]"),
        (("actors", 1, "color_waves"), {"timestamps_ns": [0], "phases": [0.0]}, "lacks .*actors.1"),
        (("actors", 0, "color_waves", "timestamps_ns"), [3, 2, 1], "'car/1': timestamps of colour"),
        (("actors", 0, "color_waves", "phases"), [0.0], "color_waves: .*as many phases as times"),
        (("actors", 0, "color_waves", "phases", 0), 1e300, "less than or equal to"),
        (("image_color_maps", 0, "rows"), [[1.0] * 4] * 2, "at least 3 items"),
        (("image_color_maps", 0, "rows", 0, 0), 1e300, "must be finite"),
        (("image_color_maps", 0), GONE, "1 images' colour maps are given twice"),
        (("frames", 0, "world_from_ego", 0, 0), -1e308, "frames.0.world_from_ego: .*a pose must"),
        (("frames", 0, "cameras", "left", "fx"), -1.0, "camera 'left': fx must be finite and > 0"),
        (("frames", 0, "cameras", "left", "fx"), 1e999, "no number of JSON"),
        (("frames", 0, "cameras", "left", "width"), 10**9, "less than or equal to 100000"),
        (("frames", 0, "cameras", "left", "camera_from_world", 3, 3), 2.0, "a pose must be"),
        (("frames", 0, "world_from_ego", 0), [1.0, 2.0], "at least 4 items"),
        (("frames", 0, "index"), 5, "1 frame numbers are given twice"),
        (("frames", 0, "image_paths", "ahead"), "a\0b", "NUL"),
        (("frames", 0, "image_paths", "ahead"), "\ud800", "surrogates"),
        (("color_maps", "ahead"), [[1.0] * 4] * 2, "at least 3 items"),
        # Of long lists and objects the first fault is told: every error costs a kilobyte.
        (("frames",), [{"index": 1}] * 9, r"(frames\.0\.[^;]*; got [^;]*(; |$)){4}$"),
        (("problems",), [1] * 9, r"problems\.0: [^;]*; got 1$"),
        (("color_maps",), dict.fromkeys(map(str, range(10_001))), "it has 10001 keys; at most"),
        (("frames", 0, "cameras"), dict.fromkeys(map(str, range(10_001))), "it has 10001 keys"),
        (("sky",), "latlong", "a latlong sky is one array 'image'; got"),
        (("sky",), "void", "'constant', 'latlong' or 'cubemap'; got 'void'"),
    ],
)
def test_wrong_documents_are_refused(saved, path, value, message):
    raw = json.loads((saved / "scene.json").read_text())
    inner(raw, path)[path[-1]] = value
    (saved / "scene.json").write_text(json.dumps(raw))
    with pytest.raises(SceneError, match=message) as caught:
        load_scene_parts(saved)
    assert str(saved) in str(caught.value)


@pytest.mark.parametrize("text", ["[]", "null", "[" * 100_000, '{"format": NaN}', "1" * 10_000])
def test_what_is_no_document_is_refused(saved, text):
    (saved / "scene.json").write_text(text)
    with pytest.raises(SceneError, match=r"scene\.json"):
        load_scene_parts(saved)


def paths_of(value, path=()):
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in items if isinstance(value, dict | list) else ():
        yield from (
            paths_of(inner, (*path, key)) if isinstance(inner, dict | list) else [(*path, key)]
        )


LEAVES = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
    | st.sampled_from([2**63, -(2**63) - 1, 10**400, 1e308, "\ud800", -0.0])
)  # fmt: skip
VALUES = LEAVES | st.lists(LEAVES, max_size=4) | st.dictionaries(st.text(max_size=3), LEAVES)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_any_document_is_a_scene_or_a_scene_error(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp() / "fuzzed"
    if not folder.exists():
        save_scene(fitted_scene(), folder)
        shutil.copy(folder / "scene.json", folder / "whole.json")
    raw = json.loads((folder / "whole.json").read_text())
    path = data.draw(st.sampled_from([p for p in paths_of(raw) if p]))
    if data.draw(st.booleans()):
        inner(raw, path)[path[-1]] = data.draw(VALUES)
    elif isinstance(inner(raw, path), dict):
        del inner(raw, path)[path[-1]]
    (folder / "scene.json").write_text(json.dumps(raw))
    try:
        scene = load_scene_parts(folder)
    except SceneError:
        return
    assert len(scene.background) == 50


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("actors.0.sh"), r"lacks the tensor 'actors\.0\.sh'"),
        (lambda t: t.update({"extra": t["background.sh"]}), r"does not know: \['extra'\]"),
        (lambda t: t.update({"background.means": np.zeros((9, 3), "f4")}), r"be .*\[50, 3\]"),
        (lambda t: t.update({"background.sh": t["background.sh"][:, :3]}), r"K in \(1, 4, 9, 16\)"),
        (lambda t: t.update({"background.quats": np.zeros((50, 3), "f4")}), r"got .*\[50, 3\]"),
        (lambda t: t.update({"background.sh": t["background.sh"].astype("f8")}), "be float32"),
        (lambda t: t.update({"actors.1.semantic": np.full(3, 17, np.int16)}), "from 0 to 16"),
        (lambda t: t.update({"actors.1.semantic": np.zeros(3, np.int64)}), r"must be int16 \[3\]"),
        (lambda t: t.update({"background.semantic": np.zeros(9, np.int16)}), r"be int16 \[50\]"),
        (lambda t: t.update({"background.opacities": np.array(1, "f4")}), r"be float32 \[50\]"),
        (lambda t: t["actors.0.opacities"].fill(np.nan), "holds no usable Gaussians"),
        (lambda t: t["actors.0.waves"].fill(np.nan), "holds no usable Gaussians"),
        (lambda t: t.update({"actors.0.waves": t["actors.0.waves"][1:]}), r"\[7, any, 3\]"),
        (lambda t: t.update({"actors.0.waves": np.zeros((7, 1001, 3), "f4")}), "most 1000 terms"),
        (lambda t: t.update({"actors.1.waves": t["actors.0.waves"]}), "does not know"),
    ],
)
def test_wrong_arrays_are_refused(saved, change, message):
    tensors = load_file(saved / FILES[1])
    change(tensors)
    save_file({k: np.ascontiguousarray(v) for k, v in tensors.items()}, saved / FILES[1])
    with pytest.raises(SceneError, match=message):
        load_scene_parts(saved)


def test_colour_waves_follow_their_gaussians(saved):
    tensors = load_file(saved / FILES[1])
    whole = load_scene_parts(saved).actors[0]
    tensors["actors.0.means"][1] = np.inf
    tensors["actors.0.waves"][3, 2, 1] = np.nan
    tensors["actors.0.quats"][5] = 0
    save_file(tensors, saved / FILES[1])
    scene = load_scene_parts(saved)
    actor, kept = scene.actors[0], torch.tensor([0, 2, 4, 6])
    assert [p.split(", ")[-1] for p in scene.problems[2:]] == [
        "actors.0: left out 2 of 7 Gaussians with NaN or infinite values",
        "actors.0: left out 1 of 7 Gaussians with a zero quaternion",
    ]
    assert torch.equal(actor.gaussians.means, whole.gaussians.means[kept])
    assert torch.equal(actor.color_waves.coefficients, whole.color_waves.coefficients[kept])


def test_undrawable_gaussians_are_left_out_and_counted(saved):
    tensors = load_file(saved / FILES[1])
    tensors["background.means"][3] = np.nan
    tensors["background.scales"][5] = 0
    tensors["background.quats"][7] *= 3
    tensors["background.quats"][9] = 0
    save_file(tensors, saved / FILES[1])
    scene = load_scene_parts(saved)
    assert len(scene.background) == 47
    assert [p.split(", ")[-1] for p in scene.problems[2:]] == [
        "background: left out 1 of 50 Gaussians with NaN or infinite values",
        "background: left out 1 of 50 Gaussians with a zero quaternion",
        "background: left out 1 of 50 Gaussians with a scale <= 0",
    ]
    lengths = scene.background.quats.norm(dim=1)
    assert torch.allclose(lengths, torch.ones(47))


def test_wrong_skies_are_refused(saved):
    for faces in (
        np.zeros((6, 4, 5, 3), "f4"), np.zeros((5, 4, 4, 3), "f4"), np.zeros((6, 0, 0, 3), "f4"),
        np.zeros((6, 4, 4, 3), "f8"), np.full((6, 4, 4, 3), np.inf, "f4"),
    ):  # fmt: skip
        save_file({"faces": faces}, saved / "sky.safetensors")
        with pytest.raises(SceneError, match=r"sky\.safetensors: faces"):
            load_scene_parts(saved)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    save_scene_file(fitted_scene(), tmp_path / "fit.climategs")
    return tmp_path / "fit.climategs"


def contents(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    with safe_open(path, framework="np") as opened:
        return load_file(path), dict(opened.metadata())


def test_the_file_is_what_the_safetensors_library_reads(file, tmp_path):
    """The same arrays as in a folder, each aligned; the document is a scene.json."""
    save_scene(fitted_scene(), tmp_path / "fit")
    tensors, metadata = contents(file)
    expected = load_file(tmp_path / "fit" / "gaussians.safetensors")
    expected |= {f"sky.{k}": v for k, v in load_file(tmp_path / "fit" / "sky.safetensors").items()}
    assert tensors.keys() == expected.keys()
    for name, array in tensors.items():
        assert array.dtype == expected[name].dtype and np.array_equal(array, expected[name])
    assert metadata["format"] == "climategs-scene" and metadata["version"] == "2"
    assert metadata["document"] == (tmp_path / "fit" / "scene.json").read_text()
    (length,) = struct.unpack("<Q", file.read_bytes()[:8])
    assert (8 + length) % 64 == 0
    header = json.loads(file.read_bytes()[8 : 8 + length])
    widths = {"F32": 4, "I16": 2}
    for name, entry in header.items():
        assert name == "__metadata__" or entry["data_offsets"][0] % widths[entry["dtype"]] == 0


def test_a_folder_and_a_file_turn_into_each_other(file, tmp_path):
    save_scene(load_scene_parts(file), tmp_path / "fit")
    save_scene_file(load_scene_parts(tmp_path / "fit"), tmp_path / "again.climategs")
    assert file.read_bytes() == (tmp_path / "again.climategs").read_bytes()


@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_any_numbers_come_back(tmp_path_factory, data):
    """Of times, names, gaps and facts: what is valid is kept to the bit."""
    whole = st.integers(-(2**63), 2**63 - 1)
    scene = fitted_scene()
    car, person = scene.actors
    track = dataclasses.replace(
        car.track, hold_ns=data.draw(whole), max_gap_ns=data.draw(st.none() | whole)
    )
    times = torch.tensor(
        data.draw(st.lists(whole, min_size=1, max_size=4, unique=True).map(sorted))
    )
    if (times.diff() < 0).any():  # gaps beyond int64 are refused by the class itself
        times = times[:1]
    phases = [data.draw(st.floats(-1e9, 1e9)) for _ in times]
    waves = dataclasses.replace(
        car.color_waves, timestamps_ns=times, phases=torch.tensor(phases, dtype=torch.float64)
    )
    name = data.draw(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0")))
    number = st.floats(width=32, allow_nan=False, allow_infinity=False)
    rows = data.draw(st.lists(number, min_size=12, max_size=12))
    color_map = torch.tensor(rows, dtype=torch.float32).reshape(3, 4)
    scene = dataclasses.replace(
        scene,
        name=name,
        actors=(dataclasses.replace(car, track=track, color_waves=waves), person),
        image_color_maps={(name, data.draw(whole)): color_map},
        ground_z_m=data.draw(st.floats(allow_nan=False, allow_infinity=False)),
    )
    path = tmp_path_factory.getbasetemp() / "any.climategs"
    save_scene_file(scene, path)
    assert_same(scene, load_scene_parts(path), but=DIFFERENT)


def test_half_is_half_and_stays_close(tmp_path):
    background = random_gaussians(20_000, sh_degree=3)
    scene = fitted_scene(background=background)
    for half in (False, True):
        save_scene_file(scene, tmp_path / f"{half}.climategs", half=half)
    sizes = [(tmp_path / f"{half}.climategs").stat().st_size for half in (False, True)]
    assert sizes[1] < 0.57 * sizes[0]
    again = load_scene_parts(tmp_path / "True.climategs")
    assert again.made_by == {**scene.made_by, "precision": "float16"}
    ours, theirs = scene.background, again.background
    assert torch.equal(ours.means, theirs.means) and torch.equal(ours.scales, theirs.scales)
    directions = torch.nn.functional.normalize(torch.randn(len(ours), 3), dim=1)
    colours = [evaluate_sh(g.sh, directions) for g in (ours, theirs)]
    # Half an ulp of float16 is 2^-12 for 0.5 to 1; the errors of 16 terms cancel in part.
    assert 0 < (colours[0] - colours[1]).abs().max() < 0.12 / 255
    assert (ours.opacities - theirs.opacities).abs().max() <= 2**-12
    conjugate = ours.quats.double() * torch.tensor([1, -1, -1, -1])
    turn = multiply_quats(conjugate, theirs.quats.double())[:, 1:].norm(dim=1).asin()
    assert 0 < 2 * torch.rad2deg(turn).max() < 0.06
    torch.testing.assert_close(theirs.quats.norm(dim=1), torch.ones(len(ours)), rtol=0, atol=1e-6)
    assert (scene.sky.faces - again.sky.faces).abs().max() <= 2**-12
    waves = [s.actors[0].color_waves.coefficients for s in (scene, again)]
    assert 0 < (waves[0] - waves[1]).abs().max() < 2**-12
    frames = [s.frames[0].cameras["left"].camera_from_world for s in (scene, again)]
    assert torch.equal(*frames)


def test_half_of_what_it_cannot_hold_is_refused(tmp_path):
    scene = fitted_scene()
    scene.background.sh[3, 0, 1] = 65520
    with pytest.raises(SceneError, match=r"background\.sh: float16 holds .* full precision"):
        save_scene_file(scene, tmp_path / "fit.climategs", half=True)
    assert not list(tmp_path.iterdir())
    scene.background.sh[3, 0, 1] = 65519
    save_scene_file(scene, tmp_path / "fit.climategs", half=True)
    assert load_scene_parts(tmp_path / "fit.climategs").background.sh[3, 0, 1] == 65504


def test_names_and_failures(tmp_path, file, monkeypatch):
    with pytest.raises(OutputError, match=r"must be named \*\.climategs"):
        save_scene_file(fitted_scene(), tmp_path / "fit.safetensors")
    (tmp_path / "folder.climategs").mkdir()
    with pytest.raises(OutputError, match="cannot write"):
        save_scene_file(fitted_scene(), tmp_path / "folder.climategs")
    before = file.read_bytes()
    monkeypatch.setattr(tensor_files, "MAX_HEADER_BYTES", 1000)
    with pytest.raises(SceneError, match="Write a scene folder instead"):
        save_scene_file(fitted_scene(name="new"), file)
    assert file.read_bytes() == before
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


# Damaged and hostile files


def test_damaged_files_are_named(file):
    data = file.read_bytes()
    cut = [b"", data[:5], data[:100], data[: len(data) // 2], data[:-1], data + b"\0"]
    lengths = (0, 1, 100_000_001, 2**40, 2**64 - 1)  # which a header claims to have
    for damaged in (*cut, *(struct.pack("<Q", length) + data[8:] for length in lengths)):
        file.write_bytes(damaged)
        with pytest.raises(SceneError, match=r"fit\.climategs is damaged or no safetensors file"):
            load_scene_parts(file)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.clear(), r'"format" must be \'climategs-scene\'; got None'),
        (lambda m: m.update(format="pt"), r'"format" must be \'climategs-scene\'; got \'pt\''),
        (lambda m: m.pop("version"), "scenes of version 2; got 'none'"),
        (lambda m: m.update(version="3"), "scenes of version 2; got '3'. A newer one"),
        (lambda m: m.update(version="2.0"), r"scenes of version 2; got '2\.0'"),
        (lambda m: m.pop("document"), "its metadata has no 'document'"),
        (lambda m: m.update(document=""), "document is no JSON"),
        (lambda m: m.update(document="[" * 500_000), "document is no JSON"),
        (lambda m: m.update(document="null"), "expected an object; got None"),
        (lambda m: m.update(document='{"format": "climategs-scene", "version": 3}'), "got 3"),
        (lambda m: m.update(document='{"format": "climategs-scene", "version": 2}'), "required"),
        (lambda m: m.update(document=m["document"].replace('"cubemap"', '"latlong"')), "latlong"),
        (lambda m: m.update(document="1" * 60_000_000), "document is no JSON"),
    ],
)
def test_other_metadata_is_refused(file, change, message):
    tensors, metadata = contents(file)
    change(metadata)
    save_file(tensors, file, metadata)
    with pytest.raises(SceneError, match=message) as caught:
        load_scene_parts(file)
    assert str(file) in str(caught.value) and len(str(caught.value)) < 1500


def test_undrawable_numbers_of_a_halved_file_are_left_out(tmp_path):
    path = tmp_path / "fit.climategs"
    save_scene_file(fitted_scene(), path, half=True)
    tensors, metadata = contents(path)
    tensors["background.quats"][[3, 4]] = [[np.nan] * 4, [0] * 4]
    tensors["background.sh"][5] = np.inf
    tensors["actors.0.waves"][2] = -np.inf
    save_file(tensors, path, metadata)
    scene = load_scene_parts(path)
    assert len(scene.background) == 47 and len(scene.actors[0].color_waves.coefficients) == 6
    assert [p.split(": ")[-1] for p in scene.problems[2:]] == [
        "left out 2 of 50 Gaussians with NaN or infinite values",
        "left out 1 of 50 Gaussians with a zero quaternion",
        "left out 1 of 7 Gaussians with NaN or infinite values",
    ]


@settings(max_examples=40, deadline=None)
@given(
    flips=st.lists(st.tuples(st.integers(0, 2**20), st.integers(0, 255)), min_size=1, max_size=8),
    in_header=st.booleans(),
)
def test_any_damage_opens_or_raises_a_scene_error(tmp_path_factory, flips, in_header):
    whole = tmp_path_factory.getbasetemp() / "whole.climategs"
    if not whole.exists():
        save_scene_file(fitted_scene(), whole)
    path = whole.with_name("flipped.climategs")
    data = bytearray(whole.read_bytes())
    end = 8 + struct.unpack("<Q", data[:8])[0] if in_header else len(data)
    for place, value in flips:
        data[place % end] = value
    path.write_bytes(data)
    try:
        load_scene_parts(path)
    except SceneError as error:
        assert path.name in str(error)
