"""Small files of datasets: what is refused, and that names stay inside their folder."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest

from adapters.base import open_scene
from adapters.camera_files.camera_files import read_views
from adapters.drivestudio.drive import read_config as drivestudio_config
from adapters.lidar_scene.image_views import read_image
from adapters.nuscenes.tables import read_rows
from adapters.plain_files import inside, read_image_size, read_json, read_numbers, read_pose
from adapters.recording.adapter import read_sweep
from adapters.safe_pickle import read_array, read_frame
from adapters.street_gaussians.model import read_config as street_gaussians_config
from adapters.training_views.depth_priors import read_metric
from augment.effects.style.images import read_style_image
from augment.effects.style.network import load_network
from augment.effects.style.style import parse_statistics
from augment.errors import AdapterError, SceneError, StyleError
from augment.files.checkpoints import load_checkpoint
from augment.files.scene_file import load_scene_parts
from recipes.errors import RecipeError
from recipes.job import load_job
from recipes.load import load_recipe


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_numbers_are_finite_and_as_many_as_expected(tmp_path):
    path = write(tmp_path / "a.txt", "1, 2\n3e1 -4\n")
    assert read_numbers(path).tolist() == [1, 2, 30, -4]
    assert read_numbers(path, (2, 2)).tolist() == [[1, 2], [30, -4]]
    with pytest.raises(AdapterError, match=r"a\.txt must hold 3 x 3 numbers; it holds 4"):
        read_numbers(path, (3, 3))
    for text, message in (("1 two", "numbers only"), ("1 nan", "NaN or infinite")):
        with pytest.raises(AdapterError, match=message):
            read_numbers(write(tmp_path / "b.txt", text))
    with pytest.raises(AdapterError, match=r"none\.txt does not exist"):
        read_numbers(tmp_path / "none.txt")


def test_poses_are_rotations_and_translations(tmp_path):
    turn = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7]])
    text = "\n".join(" ".join(map(str, row)) for row in turn + 1e-6)
    pose = read_pose(write(tmp_path / "pose.txt", text))
    assert np.allclose(pose[:3], turn, atol=1e-5) and pose[3].tolist() == [0, 0, 0, 1]
    assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-12
    wrong = {
        "mirrored": np.diag([1.0, 1, -1, 1]),
        "scaled": np.diag([2.0, 2, 2, 1]),
        "projective": np.eye(4) + np.array([[0.0] * 4] * 3 + [[1, 0, 0, 0]]),
    }
    for name, matrix in wrong.items():
        path = write(tmp_path / f"{name}.txt", " ".join(map(str, matrix.reshape(-1))))
        with pytest.raises(AdapterError, match=rf"{name}\.txt must be a rotation"):
            read_pose(path)
    with pytest.raises(AdapterError, match="must hold 4 x 4 numbers"):
        read_pose(write(tmp_path / "short.txt", "1 2 3"))


def test_json_is_of_the_kind_expected(tmp_path):
    path = write(tmp_path / "a.json", "[1]")
    assert read_json(path, list) == [1]
    with pytest.raises(AdapterError, match=r"a\.json must hold an object; got list"):
        read_json(path)
    nested = "[" * 900 + "]" * 900
    for text in ("{", "[" * 50_000, nested, '{"a": 1, "a": 2}', r'["\ud800"]', "1" * 5000):
        with pytest.raises(AdapterError, match="is not readable JSON"):
            read_json(write(tmp_path / "bad.json", text))
    (tmp_path / "latin.json").write_bytes(b'{"a": "\xff"}')
    with pytest.raises(AdapterError, match="cannot be read as text"):
        read_json(tmp_path / "latin.json")


def test_names_in_tables_stay_inside_the_folder(tmp_path):
    root, elsewhere = tmp_path / "set", tmp_path / "elsewhere"
    (root / "samples").mkdir(parents=True)
    elsewhere.mkdir()
    for folder in (root / "samples", elsewhere):
        write(folder / "a.jpg", "image")
    assert inside(root, "samples/a.jpg", "row 1") == root / "samples" / "a.jpg"
    (root / "samples" / "link.jpg").symlink_to(elsewhere / "a.jpg")
    (root / "samples" / "own.jpg").symlink_to(root / "samples" / "a.jpg")
    assert inside(root, "samples/own.jpg", "row 1").read_text() == "image"
    with pytest.raises(AdapterError, match=r"row 7 names 'samples/link.jpg'.*outside"):
        inside(root, "samples/link.jpg", "row 7")
    for name in ("../elsewhere/a.jpg", "/etc/passwd", "", "samples/../../a", "a\\b", "a\0b"):
        with pytest.raises(AdapterError, match=r"without '\.\.'"):
            inside(root, name, "row 7")


def test_a_folder_that_its_owner_linked_elsewhere_is_followed(tmp_path):
    root, disk = tmp_path / "set", tmp_path / "disk"
    (disk / "samples").mkdir(parents=True)
    write(disk / "samples" / "a.jpg", "image")
    root.mkdir()
    (root / "samples").symlink_to(disk / "samples")
    assert inside(root, "samples/a.jpg", "row 1").read_text() == "image"
    (root / "one.jpg").symlink_to(disk / "samples" / "a.jpg")
    with pytest.raises(AdapterError, match="outside"):
        inside(root, "one.jpg", "row 1")


def merged(levels: int) -> str:
    """A merge key that copies 9^levels entries."""
    lines = ["a0: &a0 {x: 1}"]
    for n in range(levels):
        lines.append(f"a{n + 1}: &a{n + 1} {{<<: [{', '.join(9 * [f'*a{n}'])}]}}")
    return "\n".join(lines)


def aliased(levels: int) -> str:
    """A list of 9^levels items."""
    lines = ["a0: &a0 [1]"]
    lines += [f"a{n + 1}: &a{n + 1} [{', '.join(9 * [f'*a{n}'])}]" for n in range(levels)]
    return "\n".join(lines)


HOSTILE_YAML = {
    merged(9): r"merge keys \(<<\) are not read",
    aliased(9): "more than 20000 values, aliases expanded",
    "a: &a [*a]": "stands inside its own anchor",
    "[" * 50_000: "nested more than 32 levels deep",
    "a: !!python/object/apply:os.system ['true']": "tags are not allowed",
    "x" * 300_000: "larger than|at most 262144 characters|is a mapping",
    "a: 1\na: 2": "a is given twice",
    "": "the file is empty",
}
READERS = {
    "street gaussians": street_gaussians_config,
    "drivestudio": drivestudio_config,
    "recipe": load_recipe,
    "job": load_job,
    "style": lambda path: parse_statistics(path.read_text(), source=str(path)),
}


@pytest.mark.parametrize("reader", READERS)
def test_yaml_that_multiplies_or_runs_code_is_refused_at_once(tmp_path, reader, ends_soon):
    path = tmp_path / "file.yaml"
    for text, message in HOSTILE_YAML.items():
        if reader == "style" and len(text) > 200_000:
            continue  # those come with the package
        path.write_text(text)
        with pytest.raises((AdapterError, RecipeError, StyleError), match=message) as caught:
            READERS[reader](path)
        assert str(path) in str(caught.value)


def test_pipes_devices_and_folders_are_no_files(tmp_path, ends_soon):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    hurt = tmp_path / "scene"
    hurt.mkdir()
    os.mkfifo(hurt / "scene.json")
    readers = {
        **READERS,
        "text": read_json,
        "style image": read_style_image,
        "network": load_network,
        "scene": open_scene,
        "scene by scheme": lambda path: open_scene(f"gaussians:{path}"),
        "scene file": load_scene_parts,
        "camera path": read_views,
    }
    del readers["style"]
    for name, read in readers.items():
        for path in (pipe, Path("/dev/zero"), tmp_path, hurt):
            with pytest.raises((AdapterError, RecipeError, StyleError, SceneError)) as caught:
                read(path)
            assert str(path) in str(caught.value), name


def test_pipes_inside_datasets_are_faults_of_theirs(tmp_path, ends_soon):
    for suffix in ("png", "npy", "pkl.gz", "pth", "safetensors", "parquet", "json"):
        os.mkfifo(tmp_path / f"pipe.{suffix}")
    refused = {
        "png": read_metric,
        "npy": read_array,
        "pkl.gz": read_frame,
        "pth": load_checkpoint,
        "parquet": read_sweep,
        "json": lambda path: list(read_rows(path)),
    }
    for suffix, read in refused.items():
        path = tmp_path / f"pipe.{suffix}"
        with pytest.raises(AdapterError, match=re.escape(str(path))):
            read(path)
    picture = tmp_path / "pipe.png"
    assert read_image(picture, 1.0) is None
    assert read_image_size(picture) == "cannot be read (a pipe or device, not a regular file)"
