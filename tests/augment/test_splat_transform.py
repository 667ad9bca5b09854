"""Our readers and writers against PlayCanvas' splat-transform, where it is installed.

    npm install -g @playcanvas/splat-transform

Both programs read the same files. The .ply that splat-transform makes of a file has the numbers
that it reads.
"""

from __future__ import annotations

import dataclasses
import math
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from augment.files.formats import read_splats
from augment.files.ply import write_ply
from augment.files.sog import write_sog
from augment.files.splat import write_splat
from augment.files.spz import write_spz
from augment.scene.scene import Gaussians
from augment.scene.transform import transform_gaussians_rigidly
from tests.augment.test_ksplat import ksplat
from tests.augment.test_sog import one_gaussian_of_version_1, zipped
from tests.augment.test_splat_formats import CASES, some_gaussians

PROGRAM = shutil.which("splat-transform")
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(PROGRAM is None, reason="splat-transform is not installed"),
]


def convert(source: Path, target: Path, *options: str) -> Path:
    """Let splat-transform convert a file."""
    assert PROGRAM is not None
    command = [PROGRAM, "-q", "-w", "-g", "cpu", *options, str(source), str(target)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    return target


def upright(gaussians: Gaussians) -> Gaussians:
    """Turn y and z about: splat-transform's .spz has y up, its .ply y down.

    It turns the axes of each Gaussian, too, which changes nothing in a picture.
    """
    turn = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
    turned = transform_gaussians_rigidly(gaussians, turn, torch.zeros(3, dtype=torch.float64))
    w, x, y, z = turned.quats.unbind(1)
    return dataclasses.replace(turned, quats=torch.stack([-x, w, z, -y], dim=1))


def check_same(
    ours: Gaussians, theirs: Gaussians, *, opacity: float = 1e-6, quat: float = 1e-4
) -> None:
    """Both read the same numbers: only float32 rounds."""
    assert len(ours) == len(theirs) and ours.sh.shape == theirs.sh.shape
    reach = float(theirs.means.abs().max())
    assert (ours.means - theirs.means).abs().max() <= 1e-6 * reach
    assert (ours.scales / theirs.scales - 1).abs().max() < 1e-5
    assert (ours.opacities - theirs.opacities).abs().max() <= opacity
    assert (ours.sh - theirs.sh).abs().max() < 2e-5
    signs = torch.sign((ours.quats * theirs.quats).sum(1, keepdim=True))
    # A component that follows from three others of its size is a root, which is steep near zero.
    assert (ours.quats * signs - theirs.quats).abs().max() < quat


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.ply"
    write_ply(path, some_gaussians(1000))
    return path


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.compressed.ply", ()),
        ("a.spz", ("--spz-version", "4")),
        ("a.spz", ("--spz-version", "3")),
        ("a.sog", ()),
        ("unbundled/meta.json", ()),
    ],
)
@pytest.mark.parametrize("degree", [0, 3])
def test_files_of_splat_transform_are_read_as_it_reads_them(
    tmp_path: Path, source: Path, name: str, options: tuple[str, ...], degree: int
) -> None:
    (tmp_path / "unbundled").mkdir()
    write_ply(source, some_gaussians(1000, (degree + 1) ** 2))
    path = convert(source, tmp_path / name, *options)
    ours = read_splats(path).gaussians
    theirs = read_splats(convert(path, tmp_path / "back.ply")).gaussians
    check_same(upright(ours) if path.suffix == ".spz" else ours, theirs)


@pytest.mark.parametrize("kind", ["ply", "spz", "sog", "splat"])
def test_files_of_ours_are_read_by_splat_transform(tmp_path: Path, kind: str) -> None:
    before = some_gaussians(1000, 1 if kind == "splat" else 16)
    writers = {"ply": write_ply, "spz": write_spz, "sog": write_sog, "splat": write_splat}
    path = tmp_path / f"a.{kind}"
    writers[kind](path, before)
    theirs = read_splats(convert(path, tmp_path / "back.ply")).gaussians
    # splat-transform keeps opacities of a byte at least 1e-6 from 0 and 1.
    ours = read_splats(path).gaussians
    # It reads a byte b of a .splat as b / 127.5 - 1, viewers and we read it as b / 128 - 1.
    quat = 1 / 128 if kind == "splat" else 1e-4
    check_same(upright(ours) if kind == "spz" else ours, theirs, opacity=2e-6, quat=quat)
    CASES[kind].check(before, upright(theirs) if kind == "spz" else theirs)


@pytest.mark.parametrize("bands", [1, 4, 9])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_ksplat_is_read_as_splat_transform_reads_it(tmp_path: Path, level: int, bands: int) -> None:
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat([some_gaussians(300, bands)], level)[0])
    theirs = read_splats(convert(path, tmp_path / "back.ply")).gaussians
    check_same(read_splats(path).gaussians, theirs, opacity=2e-6)


def test_version_1_of_sog_is_read_as_splat_transform_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    path.write_bytes(zipped(*one_gaussian_of_version_1()))
    theirs = read_splats(convert(path, tmp_path / "back.ply")).gaussians
    check_same(read_splats(path).gaussians, theirs)
    assert math.isclose(float(theirs.opacities), 0.731, abs_tol=1e-3)
