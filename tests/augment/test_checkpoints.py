"""Checkpoints from strangers: tensors arrive, nothing runs, memory is needed once."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import pytest
import torch
from torch import nn

from augment.errors import AdapterError
from augment.files.checkpoints import load_checkpoint, release, section, taken, tensor


class Hostile:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def saved(tmp_path: Path, content: object) -> Path:
    torch.save(content, tmp_path / "model.pth")
    return tmp_path / "model.pth"


def test_tensors_and_parameters_arrive(tmp_path):
    xyz = torch.randn(1000, 3)
    path = saved(tmp_path, {"part": {"xyz": nn.Parameter(xyz), "degree": 1}, "iter": 5})
    content = load_checkpoint(path)
    found = tensor(section(content, "part", "model"), "xyz", (None, 3), "model, part")
    assert torch.equal(found, xyz) and not found.requires_grad and content["iter"] == 5


def test_code_in_a_pickle_is_not_run(tmp_path):
    made = tmp_path / "made"
    path = saved(tmp_path, {"part": Hostile(made)})
    with pytest.raises(AdapterError, match=r"model\.pth was not read, and nothing in it was run"):
        load_checkpoint(path)
    (tmp_path / "plain.pth").write_bytes(pickle.dumps(Hostile(made)))
    with pytest.raises(AdapterError, match=r"plain\.pth was not read, and nothing in it was run: it asks for"):
        load_checkpoint(tmp_path / "plain.pth")
    assert not made.exists()


def test_damaged_files_are_named(tmp_path):
    path = saved(tmp_path, {"xyz": torch.zeros(1000)})
    whole = path.read_bytes()
    for name, data in (("cut", whole[:-700]), ("empty", b""), ("text", b"hello")):
        (tmp_path / f"{name}.pth").write_bytes(data)
        with pytest.raises(AdapterError, match=rf"{name}\.pth was not read.*(no whole checkpoint|cut short)"):
            load_checkpoint(tmp_path / f"{name}.pth")
    with pytest.raises(AdapterError, match="does not exist"):
        load_checkpoint(tmp_path / "none.pth")
    with pytest.raises(AdapterError, match="must hold a dictionary; it holds a list"):
        load_checkpoint(saved(tmp_path, [1]))


def test_what_is_missing_or_of_another_shape_is_named():
    content = {"xyz": torch.zeros(4, 2), "part": {}, "ids": torch.zeros(4, dtype=torch.int64)}
    with pytest.raises(AdapterError, match=r"model lacks the tensor 'scale'; it holds xyz, part"):
        tensor(content, "scale", (None, 3), "model")
    with pytest.raises(AdapterError, match=r"xyz must be float32 \[any, 3\]; got float32 \[4, 2\]"):
        tensor(content, "xyz", (None, 3), "model")
    with pytest.raises(AdapterError, match=r"ids must be float32 \[4\]; got int64 \[4\]"):
        tensor(content, "ids", (4,), "model")
    assert tensor(content, "ids", (4,), "model", dtype=None).dtype == torch.int64
    with pytest.raises(AdapterError, match="model holds no dictionary 'xyz'"):
        section(content, "xyz", "model")


def test_copies_are_whole_and_released_pages_come_back(tmp_path):
    source = torch.randn(300_000, 3)
    found = load_checkpoint(saved(tmp_path, {"xyz": source}))["xyz"]
    assert torch.equal(taken(found), source)
    into = torch.zeros(300_000, 4)
    assert taken(found, into[:, :3]).data_ptr() == into.data_ptr()
    assert torch.equal(into[:, :3], source) and float(into[:, 3].abs().max()) == 0
    release(found)
    assert torch.equal(found, source)
    few = load_checkpoint(saved(tmp_path, {"a": torch.tensor(3.0), "b": torch.zeros(0, 3)}))
    assert float(taken(few["a"])) == 3 and taken(few["b"]).shape == (0, 3)
