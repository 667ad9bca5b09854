"""Scenes in a single file: to the bit and back, halved, shared, damaged and hostile."""

from __future__ import annotations

import dataclasses
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from fitted_scenes import assert_same, fitted_scene
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from scenes import random_gaussians

from augment.errors import OutputError, SceneError
from augment.files import scene_file as tensor_files
from augment.files.scene_file import (
    is_scene_file,
    load_scene_parts,
    read_saved_scene,
    save_scene,
    save_scene_file,
)
from augment.geometry import multiply_quats
from augment.render.sh import evaluate_sh
from augment.sky import ConstantSky, LatLongSky

DIFFERENT = ("source", "labels")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    save_scene_file(fitted_scene(), tmp_path / "fit.climategs")
    return tmp_path / "fit.climategs"


def contents(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    with safe_open(path, framework="np") as opened:
        return load_file(path), dict(opened.metadata())


@pytest.mark.parametrize("sky", [None, ConstantSky(torch.rand(3)), LatLongSky(torch.rand(4, 7, 3))])
def test_a_scene_comes_back_to_the_bit(tmp_path, sky):
    scene = fitted_scene() if sky is None else fitted_scene(sky=sky)
    path = tmp_path / "new" / "fit.climategs"
    save_scene_file(scene, path)
    again = load_scene_parts(path)
    assert_same(scene, again, but=DIFFERENT)
    assert again.source == f"scene:{path}" and is_scene_file(path)
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    assert path.stat().st_mode & 0o777 == 0o666 & ~os.umask(os.umask(0o22))
    assert str(read_saved_scene(path).working_folder) == os.getcwd()


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
    for damaged in (b"", data[:5], data[:100], data[: len(data) // 2], data[:-1], data + b"\0"):
        file.write_bytes(damaged)
        with pytest.raises(SceneError, match=r"fit\.climategs is damaged or no safetensors file"):
            load_scene_parts(file)


def test_a_header_that_claims_too_much_is_refused(file):
    data = file.read_bytes()
    for length in (0, 1, 100_000_001, 2**40, 2**64 - 1):
        file.write_bytes(struct.pack("<Q", length) + data[8:])
        with pytest.raises(SceneError, match=r"fit\.climategs is damaged"):
            load_scene_parts(file)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.clear(), r'"format" must be \'climategs-scene\'; got None'),
        (lambda m: m.update(format="pt"), r'"format" must be \'climategs-scene\'; got \'pt\''),
        (lambda m: m.pop("version"), "scenes of versions 1 and 2; got 'none'"),
        (lambda m: m.update(version="3"), "scenes of versions 1 and 2; got '3'. A newer one"),
        (lambda m: m.update(version="2.0"), r"scenes of versions 1 and 2; got '2\.0'"),
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
