"""Gaussians in checkpoints of trainers: their tensors arrive, nothing in them runs."""

from __future__ import annotations

import os
import sys
import types
import zipfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from augment.errors import SceneError
from augment.files.formats import read_splats
from augment.files.splat_checkpoint import describe_checkpoint
from augment.scene.scene import Gaussians
from tests.augment.test_splat_formats import check_ply, some_gaussians


def gsplat_content(gaussians: Gaussians) -> dict[str, Any]:
    """What gsplat's simple_trainer saves."""
    splats = {
        "means": gaussians.means,
        "quats": 3 * gaussians.quats,  # of any length
        "scales": gaussians.scales.log(),
        "opacities": gaussians.opacities.logit(),
        "sh0": gaussians.sh[:, :1],
        "shN": gaussians.sh[:, 1:],
    }
    return {"step": 29999, "splats": torch.nn.ParameterDict(splats).state_dict()}


def grut_content(gaussians: Gaussians) -> dict[str, Any]:
    """What 3DGRUT saves, without its settings."""
    tensors = {
        "positions": gaussians.means,
        "rotation": gaussians.quats,
        "scale": gaussians.scales.log(),
        "density": gaussians.opacities.logit()[:, None],
        "features_albedo": gaussians.sh[:, 0],
        "features_specular": gaussians.sh[:, 1:].reshape(len(gaussians), -1),
    }
    parameters = {name: torch.nn.Parameter(tensor) for name, tensor in tensors.items()}
    return {
        **parameters,
        "background": {},
        "n_active_features": gaussians.sh_degree,
        "max_n_features": 3,
        "scene_extent": 4.5,
        "optimizer": {"state": {0: {"step": 3, "exp_avg": tensors["scale"]}}, "param_groups": []},
    }


CONTENTS = {"gsplat": gsplat_content, "3DGRUT": grut_content}


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
@pytest.mark.parametrize("trainer", CONTENTS)
def test_tensors_arrive_activated(tmp_path: Path, trainer: str, bands: int) -> None:
    before = some_gaussians(50, bands)
    path = tmp_path / "ckpt_last.pt"
    torch.save(CONTENTS[trainer](before), path)
    read = read_splats(path)
    assert read.notes == {"trainer": trainer} and read.problems == ()
    check_ply(before, read.gaussians)


def test_degrees_that_were_not_trained_yet_are_left_out(tmp_path: Path) -> None:
    before = some_gaussians(5)
    content = grut_content(before) | {"n_active_features": 1}
    torch.save(content, tmp_path / "a.pt")
    assert torch.equal(read_splats(tmp_path / "a.pt").gaussians.sh, before.sh[:, :4])


def test_degree_4_is_cut_off_with_a_note(tmp_path: Path) -> None:
    before = some_gaussians(5)
    content = gsplat_content(before)
    content["splats"]["shN"] = torch.cat([before.sh[:, 1:], torch.ones(5, 9, 3)], dim=1)
    torch.save(content, tmp_path / "a.pt")
    read = read_splats(tmp_path / "a.pt")
    assert torch.equal(read.gaussians.sh, before.sh)
    assert any("degree 4 are cut off at 3" in problem for problem in read.problems)


# ---- OmegaConf's settings, which 3DGRUT saves as objects of its classes -----------------------


class Node:
    """A stand-in for OmegaConf's objects, which hold their values as attributes."""

    def __init__(self, **attributes: Any) -> None:
        self.__dict__.update(attributes)


def settings(values: dict[str, Any]) -> Node:
    """OmegaConf's objects of nested settings."""
    content = {
        key: settings(value) if isinstance(value, dict) else Node(_val=value)
        for key, value in values.items()
    }
    metadata = Node(ref_type=Any, object_type=dict, key_type=str, flags=defaultdict(dict, a={}))
    return Node(_content=content, _metadata=metadata, path=Path("/a"))


@pytest.fixture
def omegaconf(monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("omegaconf.dictconfig")
    module.Node = Node
    monkeypatch.setattr(Node, "__module__", "omegaconf.dictconfig")
    monkeypatch.setitem(sys.modules, "omegaconf", types.ModuleType("omegaconf"))
    monkeypatch.setitem(sys.modules, "omegaconf.dictconfig", module)


@pytest.mark.usefixtures("omegaconf")
def test_settings_are_read_without_their_classes(tmp_path: Path) -> None:
    before = some_gaussians(5)
    path = tmp_path / "a.pt"
    render = {"particle_kernel_degree": 2}
    model = {"density_activation": "sigmoid", "scale_activation": "exp"}
    for kernel_degree in (2, 4):
        render["particle_kernel_degree"] = kernel_degree
        config = settings({"render": render, "model": model})
        torch.save(grut_content(before) | {"config": config}, path)
        read = read_splats(path)
        check_ply(before, read.gaussians)
        assert any("kernel of degree 4" in p for p in read.problems) == (kernel_degree == 4)
    config = settings({"model": {"density_activation": "relu"}})
    torch.save(grut_content(before) | {"config": config}, path)
    with pytest.raises(SceneError, match="its density_activation is 'relu'"):
        read_splats(path)
    config = settings({"render": {"particle_kernel_degree": torch.zeros(2)}})
    torch.save(grut_content(before) | {"config": config, "global_step": torch.zeros(2)}, path)
    check_ply(before, read_splats(path).gaussians)
    assert describe_checkpoint(path).writer == "3DGRUT"


# ---- Refusals ------------------------------------------------------------------------------------


class Hostile:
    """An object whose pickle would make a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_refusals(tmp_path: Path) -> None:
    before = some_gaussians(100, 4)
    path, folder = tmp_path / "a.pt", tmp_path / "made"
    wide = torch.zeros(1).expand(10**9, 3)
    Change = Callable[[dict[str, Any]], object]
    cases: dict[str, tuple[str, Change, str]] = {
        "code": ("gsplat", lambda c: c.update(code=Hostile(folder)), "nothing in it was run"),
        "code in splats": (
            "gsplat",
            lambda c: c["splats"].update(means=Hostile(folder)),
            "nothing in it was run",
        ),
        "code of 3DGRUT": ("3DGRUT", lambda c: c.update(config=Hostile(folder)), "was run"),
        "nothing": ("gsplat", lambda c: c.clear(), "it holds nothing"),
        "other weights": ("gsplat", lambda c: c.pop("splats"), "it holds 'step'"),
        "a list": ("gsplat", lambda c: c.update(splats=[1]), "not a checkpoint of Gaussians"),
        "no means": ("gsplat", lambda c: c["splats"].pop("means"), "lacks the tensor 'means'"),
        "a number": ("gsplat", lambda c: c["splats"].update(quats=3), "lacks the tensor 'quats'"),
        "rows": (
            "gsplat",
            lambda c: c["splats"].update(scales=torch.zeros(99, 3)),
            r"scales must be \[100, 3\]; got float32 \[99, 3\]",
        ),
        "columns": (
            "gsplat",
            lambda c: c["splats"].update(scales=torch.zeros(100, 2)),
            r"got float32 \[100, 2\]",
        ),
        "integers": (
            "gsplat",
            lambda c: c["splats"].update(means=torch.zeros(100, 3, dtype=torch.int64)),
            "means must be floats; got int64",
        ),
        "a bomb": ("gsplat", lambda c: c["splats"].update(means=wide), "not hold as many numbers"),
        "harmonics": (
            "gsplat",
            lambda c: c["splats"].update(shN=torch.zeros(100, 5, 3)),
            "6 spherical harmonics a channel",
        ),
        "a network": (
            "gsplat",
            lambda c: (c["splats"].pop("sh0"), c["splats"].update(colors=torch.zeros(100, 3))),
            "colours come from a network",
        ),
        "none": (
            "gsplat",
            lambda c: c.update(splats={k: v[:0] for k, v in c["splats"].items()}),
            "0 rows",
        ),
        "NaN": (
            "gsplat",
            lambda c: c["splats"].update(means=torch.full((100, 3), torch.nan)),
            "no usable Gaussians.*NaN",
        ),
        "sparse": (
            "gsplat",
            lambda c: c["splats"].update(means=torch.zeros(100, 3).to_sparse()),
            "nothing in it was run",
        ),
        "no positions": ("3DGRUT", lambda c: c.pop("positions"), "lacks the tensor 'positions'"),
        "density": ("3DGRUT", lambda c: c.update(density=torch.zeros(100)), r"density must be"),
        "channels": (
            "3DGRUT",
            lambda c: c.update(features_specular=torch.zeros(100, 10)),
            "got 10 columns",
        ),
    }
    for name, (trainer, change, message) in cases.items():
        content = CONTENTS[trainer](before)
        change(content)
        torch.save(content, path)
        with pytest.raises(SceneError, match=message):
            read_splats(path)
            pytest.fail(name)
    torch.save(gsplat_content(before), path)
    whole = path.read_bytes()
    for length in (40, 1000, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:length])
        with pytest.raises(SceneError, match="no whole checkpoint"):
            read_splats(path)
    assert not folder.exists()


def test_a_zip_of_other_files_is_no_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(SceneError, match=r"not a whole \.sog"):
        read_splats(path)
