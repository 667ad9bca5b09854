"""Contract of all splat formats: round trips, exports, damage, and what is said of it.

Values against the formats' definitions and other writers' files are in each format's own tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, get_args

import pytest
import torch

from adapters.base import open_scene
from augment.errors import OutputError, SceneError
from augment.files import limits
from augment.files.export import export_losses, export_splats
from augment.files.formats import SplatKind, read_splats, splat_formats, splat_writer
from augment.files.gltf import write_glb
from augment.files.ply import write_ply
from augment.files.sog import write_sog
from augment.files.splat import write_splat
from augment.files.spz import write_spz
from augment.files.usd import write_usd
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Gaussians
from tests.fitted_scenes import START_NS, fitted_scene, with_classes

NOTES = {"up": "-y", "unit": "metre"}


def some_gaussians(count: int = 400, bands: int = 16) -> Gaussians:
    """Gaussians within 50 m, in even steps along x, with uniform logarithms of scales."""
    rng = torch.Generator().manual_seed(1)
    means = 100 * (torch.rand(count, 3, generator=rng) - 0.5)
    means[:, 0] = torch.linspace(-50, 50, count)
    return Gaussians(
        means=means,
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=rng), dim=1),
        scales=torch.exp(8 * torch.rand(count, 3, generator=rng) - 7),
        opacities=torch.rand(count, generator=rng),
        sh=torch.rand(count, bands, 3, generator=rng) - 0.5,
    )


# ---- Rounding of each format: errors that a round trip may have ----------------------------------


def turn_deg(before: Gaussians, after: Gaussians) -> float:
    """The greatest angle between rotations, degrees."""
    turn = rotmat_from_quat(after.quats) @ rotmat_from_quat(before.quats).transpose(1, 2)
    cosine = (turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    return float(torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).max())


def check_floats(before: Gaussians, after: Gaussians) -> None:
    for name in ("means", "scales", "opacities", "sh"):
        assert torch.equal(getattr(after, name), getattr(before, name)), name
    # Lengths are made 1 again: two roundings of float32.
    assert (after.quats - before.quats).abs().max() <= 2.5e-7


def check_ply(before: Gaussians, after: Gaussians) -> None:
    assert torch.equal(after.means, before.means) and torch.equal(after.sh, before.sh)
    # log and exp, logit and sigmoid each round once: a few units in the last place of the logit
    # (|log scale| < 7, |logit| < 12, so 12 * 2^-24 relative) and of the result.
    torch.testing.assert_close(after.scales, before.scales, rtol=1e-6, atol=0)
    torch.testing.assert_close(after.opacities, before.opacities, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(after.quats, before.quats, rtol=0, atol=2e-7)


def check_splat(before: Gaussians, after: Gaussians) -> None:
    assert torch.equal(after.means, before.means) and torch.equal(after.scales, before.scales)
    # Half a step of 1/255; half a step of 1/128 in each part, a whole one where 1.0 meets 255.
    assert (after.opacities - before.opacities).abs().max() <= 0.5 / 255 + 1e-6
    assert ((after.quats * before.quats).sum(1).abs() > 1 - 2 / 128).all()


def check_spz(before: Gaussians, after: Gaussians) -> None:
    # Half a step each: 2^-12 m, 1/16 of a logarithm, 1/255 of an opacity, 1/(0.15 * 255) of f_dc.
    assert (after.means - before.means).abs().max() <= 2**-13 + 1e-5
    assert (after.scales.log() - before.scales.log()).abs().max() <= 1 / 32 + 1e-5
    assert (after.opacities - before.opacities).abs().max() <= 0.5 / 255 + 1e-6
    assert (after.sh[:, 0] - before.sh[:, 0]).abs().max() <= 0.5 / (0.15 * 255) + 1e-6
    steps = torch.where(torch.arange(1, before.sh.shape[1]) < 4, 4 / 128, 8 / 128)[:, None]
    assert ((after.sh[:, 1:] - before.sh[:, 1:]).abs() <= steps + 1e-6).all()
    # Three components off by half a step of sqrt(1/2)/511 each, the fourth by what follows.
    assert turn_deg(before, after) < 0.25


def check_sog(before: Gaussians, after: Gaussians) -> None:
    after = after.select(after.means[:, 0].argsort())  # the file's order is that of a Morton curve
    # Half a step of 2 ln(51) / 65535, times the slope of the exponential.
    step = math.log(51) / 65535 * (1 + before.means.abs())
    assert ((after.means - before.means).abs() <= step + 1e-5).all()
    assert (after.opacities - before.opacities).abs().max() <= 0.5 / 255 + 1e-6
    # 256 even levels leave a uniform distribution 1/256 of its deviation.
    for old, new in ((before.scales.log(), after.scales.log()), (before.sh, after.sh)):
        assert (new - old).std() < old.std() / 256
    # Three components off by up to half a step of sqrt(2)/255 each, the fourth by what follows.
    assert turn_deg(before, after) < 1.0


class Case(NamedTuple):
    """A format that is written.

    query: what its users have to add to the file's name, so that it opens upright and in metres.
    mean_m, sh: errors that a scene may have after export and opening.
    """

    write: Callable[[Path, Gaussians], None]
    check: Callable[[Gaussians, Gaussians], None]
    notes: dict[str, str]
    query: str = ""
    mean_m: float = 0.0
    sh: float = 1e-6  # SH are turned and turned back in float32


CASES = {
    "ply": Case(lambda path, g: write_ply(path, g, notes=NOTES), check_ply, NOTES),
    "splat": Case(write_splat, check_splat, {}, "?up=+z&scale=1", sh=math.inf),
    # Half a step of 8/128 in each of seven terms, which a rotation mixes.
    "spz": Case(write_spz, check_spz, {"up": "+y"}, "?scale=1", 2**-12, 0.17),
    # Half a step at 50 m, as above; 256 levels of -1 to 1.
    "sog": Case(lambda path, g: write_sog(path, g, notes=NOTES), check_sog, NOTES, "", 0.01, 0.008),
    "glb": Case(write_glb, check_floats, {"up": "+y", "unit": "metre"}),
    "usd": Case(
        lambda path, g: write_usd(path, g, is_upright=True, is_metric=True),
        check_floats,
        {"up": "+z", "unit": "metre"},
    ),
}
KINDS: tuple[SplatKind, ...] = get_args(SplatKind)


def written(folder: Path, kind: SplatKind, gaussians: Gaussians) -> Path:
    path = folder / f"{len(list(folder.iterdir()))}{splat_writer(kind).suffix}"
    CASES[kind].write(path, gaussians)
    return path


def test_every_written_format_of_the_list_is_tested_here():
    """The command line names the kinds without loading the formats."""
    writers = [splat_format.writer for splat_format in splat_formats()]
    assert [writer.kind for writer in writers if writer is not None] == [*KINDS] == [*CASES]


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
@pytest.mark.parametrize("kind", KINDS)
def test_a_round_trip_loses_what_the_steps_are(tmp_path, kind, bands):
    before = some_gaussians(800, 1 if kind == "splat" else bands)
    path = written(tmp_path, kind, before)
    read = read_splats(path)
    assert dict(read.notes) == CASES[kind].notes and read.problems == ()
    assert read.gaussians.sh_degree == before.sh_degree
    CASES[kind].check(before, read.gaussians)
    assert written(tmp_path, kind, before).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_an_exported_scene_comes_back_upright_in_metres(tmp_path, kind):
    """Each format has axes of its own; the file says which, or its user does."""
    scene = fitted_scene(
        background=with_classes(some_gaussians()),
        actors=(),
        has_known_gravity=True,
        has_metric_scale=True,
    )
    case, writer, before = CASES[kind], splat_writer(kind), scene.background
    path = tmp_path / "below" / f"a{writer.suffix}"
    export_splats(scene, path, START_NS, kind=kind)
    opened = open_scene(f"gaussians:{path}{case.query}")
    assert opened.has_known_gravity and opened.has_metric_scale
    after = opened.background.select(opened.background.means[:, 0].argsort())
    assert (after.means - before.means).abs().max() <= case.mean_m
    assert (after.sh - before.sh[:, : after.sh.shape[1]]).abs().max() < case.sh
    assert turn_deg(before, after) < 1.5
    if writer.keeps_classes:
        assert torch.equal(after.semantic, before.semantic)
    origin = read_splats(path).notes.get("world_origin_m")
    assert origin == ("448262.0 4421337.0 -0.1" if writer.keeps_world_origin else None)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"cannot write .* in the way"):
        export_splats(scene, tmp_path / "file" / "below" / path.name, START_NS, kind=kind)


@pytest.mark.parametrize("kind", KINDS)
def test_a_moment_with_nothing_in_it_is_refused(tmp_path, kind):
    scene = fitted_scene(background=Gaussians.empty())
    later_ns = START_NS + 10**12  # when the actors are gone
    with pytest.raises(SceneError, match=f"shows no Gaussians at {later_ns} ns"):
        export_splats(scene, tmp_path / "a", later_ns, kind=kind)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", KINDS)
def test_each_truncation_is_refused_with_the_files_name(tmp_path, kind):
    """But for cuts between the records of a .splat, which has no header, and within the checksum at
    the end of a .spz.
    """
    path = written(tmp_path, kind, some_gaussians(100, 4))
    whole = path.read_bytes()
    is_slow = kind == "usd"  # each file is read by another process
    cuts = [0, 200, len(whole) // 2 + 1, len(whole) - 100] if is_slow else [
        *range(0, 70, 9), *(len(whole) * part // 12 + 1 for part in range(1, 12)), len(whole) - 40
    ]  # fmt: skip
    for length in cuts:
        cut = tmp_path / f"cut-at-{length}{path.suffix}"
        cut.write_bytes(whole[:length])
        with pytest.raises(SceneError, match=cut.name):
            read_splats(cut)
            pytest.fail(f"{length} of {len(whole)} bytes")


@pytest.mark.parametrize("kind", ["spz", "sog", "glb", "usd"])
def test_gaussians_beyond_the_memory_for_a_file_are_refused(tmp_path, kind, monkeypatch):
    """Formats that can announce more than they have bytes; .ply and .splat cannot."""
    path = written(tmp_path, kind, some_gaussians())
    assert len(read_splats(path).gaussians) == 400
    monkeypatch.setattr(limits, "FREE_BYTES", 0)
    monkeypatch.setattr(limits, "BYTES_PER_BYTE", 0)
    with pytest.raises(SceneError, match=r"announces 400 Gaussians of 236 bytes in memory each"):
        read_splats(path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.ply", None, r"no such file; expected a \.ply, \.splat, .* or \.usd"),
        ("a.ply", b"", r"neither a \.ply, .*; convert other splat formats \(\.lcc\)"),
        ("a.lcc", b"\0\1\0\0", r"nor named \.splat, \.ksplat, \.gltf or \.usd"),
    ],
)
def test_other_files_are_refused(tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SceneError, match=message):
        read_splats(path)


def test_an_option_of_another_format_is_refused(tmp_path):
    path = written(tmp_path, "splat", some_gaussians(3, 1))
    for options, message in (({"activated": True}, r"only a .ply"), ({"level": 1}, "no levels of")):
        with pytest.raises(SceneError, match=message):
            read_splats(path, **options)


@pytest.mark.parametrize("kind", KINDS)
def test_losses_of_a_format_are_sentences(kind):
    scene = fitted_scene(background=with_classes(some_gaussians()))
    sentences = export_losses(scene, kind, START_NS)
    assert all(s == s.strip() and not s.endswith(".") for s in sentences)
    writer = splat_writer(kind)
    for loss in (*writer.world_losses, *writer.value_losses):
        assert (loss.sentence in sentences) == loss.applies_to(scene)
    for words, is_kept in (
        ("dataset's world", writer.keeps_world_origin),
        ("semantic classes", writer.keeps_classes),
        ("cameras are left out", writer.has_camera_file),
    ):
        assert any(words in s for s in sentences) != is_kept, words
