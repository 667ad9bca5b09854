"""Checkpoints from strangers: tensors arrive, nothing runs, memory is needed once."""

from __future__ import annotations

import os
import pickle
import struct
import warnings
import zipfile
from collections import Counter, OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from augment.errors import AdapterError
from augment.files.checkpoints import (
    checked_tensor,
    copy_mapped_tensor,
    dictionary_in,
    load_checkpoint,
    release,
)


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
    found = checked_tensor(dictionary_in(content, "part", "model"), "xyz", (None, 3), "model, part")
    assert torch.equal(found, xyz) and not found.requires_grad and content["iter"] == 5


def test_code_in_a_pickle_is_not_run(tmp_path):
    made = tmp_path / "made"
    path = saved(tmp_path, {"part": Hostile(made)})
    with pytest.raises(AdapterError, match=r"model\.pth was not read, and nothing in it was run"):
        load_checkpoint(path)
    (tmp_path / "plain.pth").write_bytes(pickle.dumps(Hostile(made)))
    with pytest.raises(AdapterError, match=r"plain\.pth was not read, and nothing in it was run"):
        load_checkpoint(tmp_path / "plain.pth")
    assert not made.exists()


def test_damaged_files_are_named(tmp_path):
    path = saved(tmp_path, {"xyz": torch.zeros(1000)})
    whole = path.read_bytes()
    for name, data in (("cut", whole[:-700]), ("empty", b""), ("text", b"hello")):
        (tmp_path / f"{name}.pth").write_bytes(data)
        with pytest.raises(
            AdapterError, match=rf"{name}\.pth was not read.*(no whole checkpoint|cut short)"
        ):
            load_checkpoint(tmp_path / f"{name}.pth")
    with pytest.raises(AdapterError, match="does not exist"):
        load_checkpoint(tmp_path / "none.pth")
    with pytest.raises(AdapterError, match="must hold a dictionary; it holds a list"):
        load_checkpoint(saved(tmp_path, [1]))


def test_what_is_missing_or_of_another_shape_is_named():
    content = {"xyz": torch.zeros(4, 2), "part": {}, "ids": torch.zeros(4, dtype=torch.int64)}
    with pytest.raises(AdapterError, match=r"model lacks the tensor 'scale'; it holds xyz, part"):
        checked_tensor(content, "scale", (None, 3), "model")
    with pytest.raises(AdapterError, match=r"xyz must be float32 \[any, 3\]; got float32 \[4, 2\]"):
        checked_tensor(content, "xyz", (None, 3), "model")
    with pytest.raises(AdapterError, match=r"ids must be float32 \[4\]; got int64 \[4\]"):
        checked_tensor(content, "ids", (4,), "model")
    assert checked_tensor(content, "ids", (4,), "model", dtype=None).dtype == torch.int64
    with pytest.raises(AdapterError, match="model holds no dictionary 'xyz'"):
        dictionary_in(content, "xyz", "model")


def test_copies_are_whole_and_released_pages_come_back(tmp_path):
    source = torch.randn(300_000, 3)
    found = load_checkpoint(saved(tmp_path, {"xyz": source}))["xyz"]
    assert torch.equal(copy_mapped_tensor(found), source)
    into = torch.zeros(300_000, 4)
    assert copy_mapped_tensor(found, into[:, :3]).data_ptr() == into.data_ptr()
    assert torch.equal(into[:, :3], source) and float(into[:, 3].abs().max()) == 0
    release(found)
    assert torch.equal(found, source)
    few = load_checkpoint(saved(tmp_path, {"a": torch.tensor(3.0), "b": torch.zeros(0, 3)}))
    assert float(copy_mapped_tensor(few["a"])) == 3 and copy_mapped_tensor(few["b"]).shape == (0, 3)


def test_a_file_of_before_torch_1_6_gives_the_same(tmp_path):
    content = {
        "net": OrderedDict(w=nn.Parameter(torch.randn(4, 5)), b=torch.arange(3)),
        "turned": torch.randn(3, 4).T,
        "part": torch.randn(100)[7:9],
        "half": torch.randn(5).half(),
        "one": torch.tensor(2.5),
        "none": torch.zeros(0, 3),
        "step": 7,
    }
    torch.save(content, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    old, new = load_checkpoint(tmp_path / "old.pth"), load_checkpoint(saved(tmp_path, content))
    for found in (old, new):
        assert list(found) == list(content) and found["step"] == 7
        assert torch.equal(found["net"]["w"], content["net"]["w"])
        for name in ("turned", "part", "half", "one", "none"):
            assert torch.equal(found[name], content[name])
            assert found[name].dtype == content[name].dtype
    assert torch.load(tmp_path / "old.pth", weights_only=True)["step"] == 7  # it is that format
    torch.save({"x": torch.zeros(5)}, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    whole = (tmp_path / "old.pth").read_bytes()
    for wrong in (
        whole.replace(struct.pack("<q", 5) + bytes(20), struct.pack("<q", 4) + bytes(20)),
        whole[:-1],
    ):
        assert wrong != whole
        (tmp_path / "old.pth").write_bytes(wrong)
        with pytest.raises(AdapterError, match=r"does not hold the 5 numbers|states 20 bytes"):
            load_checkpoint(tmp_path / "old.pth")


def test_what_an_optimiser_and_a_training_run_keep_is_read(tmp_path):
    weight = nn.Parameter(torch.ones(3))
    optimiser = torch.optim.Adam([weight], lr=0.1)
    weight.sum().backward()
    optimiser.step()
    content = {
        "optimiser": optimiser.state_dict(),
        "best": np.float64(0.5),
        "milestones": Counter([3, 5]),
        "size": torch.Size([2, 3]),
        "type": torch.float32,
    }
    found = load_checkpoint(saved(tmp_path, content))
    state = found["optimiser"]["state"][0]
    assert torch.equal(state["exp_avg"], optimiser.state_dict()["state"][0]["exp_avg"])
    assert found["best"] == 0.5 and found["size"] == (2, 3) and found["milestones"] == {3: 1, 5: 1}


def hostile(path: Path, *, offset=0, size=(4,), stride=(1,), count=4, key="0", tail=b"") -> Path:
    """A checkpoint of four numbers whose tensor says of itself what is given."""

    def number(value: int) -> bytes:
        return b"\x8a\x08" + struct.pack("<q", value)

    def text(value: str) -> bytes:
        return b"X" + struct.pack("<I", len(value)) + value.encode()

    def tuple_of(*items: bytes) -> bytes:
        return b"(" + b"".join(items) + b"t"

    kind, end = b"ctorch\nFloatStorage\n", b"ccollections\nOrderedDict\n)R"
    flat = tuple_of(text("storage"), kind, text(key), text("cpu"), number(count))
    shape = [tuple_of(*map(number, sides)) for sides in (size, stride)]
    tensor = tuple_of(flat + b"Q", number(offset), *shape, b"\x89", end)
    pickled = b"}" + text("x") + b"ctorch._utils\n_rebuild_tensor_v2\n" + tensor + b"R" + tail
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", b"\x80\x02" + pickled + b"s.")
        archive.writestr("a/data/0", bytes(16))
    return path


def test_tensors_stay_inside_the_numbers_of_the_file(tmp_path):
    path = tmp_path / "a.pth"
    assert load_checkpoint(hostile(path))["x"].tolist() == [0, 0, 0, 0]
    for case in (
        {"offset": 1}, {"offset": -1}, {"offset": 1 << 40, "size": (1,)}, {"size": (5,)},
        {"size": (-1,)}, {"size": (2,), "stride": (-1,)}, {"size": (2,), "stride": (4,)},
        {"size": (1 << 47, 1 << 47), "stride": (0, 0)}, {"size": (2, 2), "stride": (1,)},
        {"count": 5}, {"count": 1 << 39}, {"count": -4}, {"key": "1"}, {"key": "../0"},
        {"tail": b"(tb"},  # a state, which torch's own reader would set the tensor to
    ):  # fmt: skip
        with pytest.raises(AdapterError, match=r"a\.pth was not read, and nothing in it was run"):
            load_checkpoint(hostile(path, **case))


def test_archives_that_hold_something_twice_or_compressed_are_refused(tmp_path):
    whole = saved(tmp_path, {"x": torch.zeros(100)})
    with zipfile.ZipFile(whole) as archive:
        members = [(entry.filename, archive.read(entry)) for entry in archive.infolist()]
    numbers = "model/data/0"
    for packed_name, files, message in (
        (numbers, members, "compressed"),
        ("model/data.pkl", members, "compressed"),  # a bomb could hide in it
        ("", [*members, members[0]], "several"),
    ):
        with warnings.catch_warnings(), zipfile.ZipFile(tmp_path / "b.pth", "w") as archive:
            warnings.simplefilter("ignore")  # zipfile warns of a second file of one name
            for name, data in files:
                is_packed = name == packed_name
                archive.writestr(
                    name, data, zipfile.ZIP_DEFLATED if is_packed else zipfile.ZIP_STORED
                )
        with pytest.raises(AdapterError, match=message):
            load_checkpoint(tmp_path / "b.pth")
