"""Gaussians in .spz files: what is kept, against the format's rules one by one, and refusals."""

from __future__ import annotations

import gzip
import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from adapters.base import open_scene
from augment.errors import SceneError
from augment.files.export import export_splats
from augment.files.formats import read_splats
from augment.files.spz import read_spz, write_spz
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Gaussians
from tests.streets import open_street

MAGIC = 0x5053474E


def some_gaussians(count: int = 400, bands: int = 16) -> Gaussians:
    rng = torch.Generator().manual_seed(1)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=rng), dim=1)
    return Gaussians(
        means=100 * (torch.rand(count, 3, generator=rng) - 0.5),
        quats=quats,
        scales=torch.exp(2 * torch.randn(count, 3, generator=rng) - 3),
        opacities=torch.rand(count, generator=rng),
        sh=torch.rand(count, bands, 3, generator=rng) - 0.5,
    )


def packed(
    version: int, columns: bytes, *, count: int = 1, degree: int = 0, bits: int = 12, flags: int = 0
) -> bytes:
    header = struct.pack("<IIIBBBB", MAGIC, version, count, degree, bits, flags, 0)
    return gzip.compress(header + columns)


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
def test_a_round_trip_loses_what_the_steps_are(tmp_path: Path, bands: int) -> None:
    before = some_gaussians(bands=bands)
    write_spz(tmp_path / "a.spz", before)
    read = read_splats(tmp_path / "a.spz")
    after = read.gaussians
    assert read.notes == {"up": "+y"} and not read.problems and after.sh_degree == before.sh_degree
    # Half a step each: 2^-12 m, 1/16 of a logarithm, 1/255 of an opacity, 1/(0.15 * 255) of f_dc.
    assert (after.means - before.means).abs().max() <= 2**-13 + 1e-5
    assert (after.scales.log() - before.scales.log()).abs().max() <= 1 / 32 + 1e-5
    assert (after.opacities - before.opacities).abs().max() <= 0.5 / 255 + 1e-6
    assert (after.sh[:, 0] - before.sh[:, 0]).abs().max() <= 0.5 / (0.15 * 255) + 1e-6
    steps = torch.where(torch.arange(1, bands) < 4, 4 / 128, 8 / 128)[:, None]
    assert ((after.sh[:, 1:] - before.sh[:, 1:]).abs() <= steps + 1e-6).all()
    # Three components off by half a step of sqrt(1/2)/511 each, the fourth by what follows.
    turn = rotmat_from_quat(after.quats) @ rotmat_from_quat(before.quats).transpose(1, 2)
    cosine = (turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    assert torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).max() < 0.25


def test_bytes_mean_what_the_format_says(tmp_path: Path) -> None:
    """A Gaussian of every version, by hand."""
    place = (-3 * 4096 & 0xFFFFFF).to_bytes(3, "little") + (4096).to_bytes(3, "little") + bytes(3)
    rest = bytes([51, 255, 128, 0, 160, 176, 144])  # opacity, colours, scales
    half = math.sqrt(0.5)
    smallest = 3 << 30 | (1 << 9 | 511) << 20  # w is missing, x = -sqrt(1/2), y = z = 0
    cases = {
        1: (np.array([-3, 1, 0], "<f2").tobytes(), bytes([128, 128, 255]), [0, 0, 0, 1]),
        2: (place, bytes([128, 128, 255]), [0, 0, 0, 1]),
        3: (place, smallest.to_bytes(4, "little"), [half, -half, 0, 0]),
    }
    for version, (where, turn, quat) in cases.items():
        path = tmp_path / f"v{version}.spz"
        path.write_bytes(packed(version, where + rest + turn))
        found = read_spz(path).gaussians
        assert found.means[0].tolist() == [-3, 1, 0]
        assert found.opacities.item() == pytest.approx(0.2)
        colour = [(255 / 255 - 0.5) / 0.15, (128 / 255 - 0.5) / 0.15, -0.5 / 0.15]
        assert found.sh[0, 0].tolist() == pytest.approx(colour)
        assert found.scales[0].log().tolist() == pytest.approx([0, 1, -1], abs=1e-6)
        # A byte of 128 is 1/255 from 0.
        assert found.quats[0].tolist() == pytest.approx(quat, abs=0.005)
    # Colour is the inner axis of coefficients.
    sh = bytes(range(119, 128))
    path.write_bytes(packed(3, place + rest + cases[3][1] + sh, degree=1))
    stored = read_spz(path).gaussians.sh[0, 1:] * 128 + 128
    assert stored.tolist() == [[119, 120, 121], [122, 123, 124], [125, 126, 127]]


def test_places_far_away_keep_fewer_bits(tmp_path: Path) -> None:
    gaussians = some_gaussians(count=8, bands=1)
    far = Gaussians(**{**vars(gaussians), "means": gaussians.means * 1000})
    write_spz(tmp_path / "far.spz", far)
    error = (read_spz(tmp_path / "far.spz").gaussians.means - far.means).abs().max()
    assert 2**-12 < error < 0.01
    beyond = Gaussians(**{**vars(gaussians), "means": gaussians.means * 1e7})
    with pytest.raises(SceneError, match="ends at 8388607"):
        write_spz(tmp_path / "beyond.spz", beyond)


def test_a_scene_comes_back_upright(tmp_path: Path) -> None:
    """The file's y is up, the scene's z again; its Gaussians are those of the .ply."""
    scene = open_street()
    moment = scene.frames[0].timestamp_ns
    export_splats(scene, tmp_path / "street.spz", moment, kind="spz")
    export_splats(scene, tmp_path / "street.ply", moment)
    spz = open_scene(f"gaussians:{tmp_path}/street.spz?scale=1").background
    ply = open_scene(f"gaussians:{tmp_path}/street.ply?scale=1").background
    assert len(spz) == len(ply) and spz.sh_degree == ply.sh_degree
    assert (spz.means - ply.means).abs().max() < 2**-12
    assert (tmp_path / "street.spz").stat().st_size < (tmp_path / "street.ply").stat().st_size / 3


def test_refusals(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    write_spz(path, some_gaussians(bands=1))
    whole = path.read_bytes()
    noise = np.random.default_rng(0).bytes(200_000)
    cases = {
        "cut": (whole[:-200], "not a whole .spz"),
        "no stream": (b"\x1f\x8bnothing", "not a whole .spz"),
        "no magic": (gzip.compress(b"x" * 100), "NGSP"),
        "version": (packed(4, bytes(99)), "version 4 .* only 1 to 3"),
        "degree": (packed(3, bytes(99), degree=5), "degree 5"),
        "bits": (packed(3, bytes(99), bits=30), "30 fractional bits"),
        "extended": (packed(3, bytes(99), flags=2), "vendors' extensions"),
        "none": (packed(3, b"", count=0), "announces 0 Gaussians"),
        "a bomb": (packed(3, bytes(99), count=1 << 31), "announces 2147483648 Gaussians"),
        "deflated": (packed(3, noise, count=10**7), "10000000 Gaussians of 56 bytes"),
        "short": (packed(3, bytes(99), count=40), "columns end early"),
    }
    for name, (data, message) in cases.items():
        path.write_bytes(data)
        with pytest.raises(SceneError, match=message):
            read_splats(path)
            pytest.fail(name)
