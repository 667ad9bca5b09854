"""Small files of datasets: what is refused, and that names stay inside their folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from adapters.plain_files import inside, read_json, read_numbers, read_pose
from augment.errors import AdapterError


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
    for text in ("{", "[" * 100_000):
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
