"""What `climategs inspect` says of splat files, and of how other viewers show them."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from augment.files.ply import write_ply
from augment.files.sog import write_sog
from augment.files.splat import write_splat
from augment.files.spz import write_spz
from augment.scene.scene import Gaussians
from tests.augment.test_gltf import compressed_document, saved
from tests.augment.test_ksplat import ksplat
from tests.augment.test_splat_checkpoint import gsplat_content
from tests.augment.test_splat_formats import some_gaussians
from tests.augment.test_spz import version_4_of
from tools.cli import InspectOptions
from tools.inspect import inspect_scene


def small_gaussians(count: int = 60) -> Gaussians:
    """Gaussians that no viewer shows wrongly."""
    gaussians = some_gaussians(count, 4)
    return dataclasses.replace(
        gaussians, sh=0.5 * gaussians.sh, scales=gaussians.scales.clamp(max=0.5)
    )


def inspected(uri: str | Path, capsys: pytest.CaptureFixture[str], folder: Path) -> dict[str, Any]:
    """The facts of a file as JSON, with the page as `text`."""
    json_file = folder / "facts.json"
    assert inspect_scene(InspectOptions(uri=str(uri), json_file=json_file)) == 0
    return json.loads(json_file.read_text()) | {"text": capsys.readouterr().out}


def test_format_version_writer_and_axes_are_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gaussians = small_gaussians()
    folder = tmp_path / "files"
    folder.mkdir()
    write_ply(folder / "a.ply", gaussians, notes={"up": "-y", "unit": "metre"})
    write_sog(folder / "a.sog", gaussians, notes={"up": "-y", "unit": "metre"})
    write_splat(folder / "a.splat", dataclasses.replace(gaussians, sh=gaussians.sh[:, :1]))
    write_spz(folder / "old.spz", gaussians)
    (folder / "new.spz").write_bytes(version_4_of(folder / "old.spz"))
    (folder / "a.ksplat").write_bytes(ksplat([gaussians], 2)[0])
    torch.save(gsplat_content(gaussians), folder / "a.pt")
    expected = {
        "a.ply": (".ply, binary, little endian", "says that -y is up", "unit metre"),
        "a.sog": (".sog, version 2, written by ClimateGS", "says that -y is up", "unit metre"),
        "a.splat": (".splat, 1,920 bytes", "does not say what is up (viewers take -y)", "no unit"),
        "old.spz": (".spz, version 3", "says that +y is up", "no unit"),
        "new.spz": (".spz, version 4", "says that +y is up", "no unit"),
        "a.ksplat": (".ksplat, version 0.1, compression level 2, 1 sections", "(viewers take -y)"),
        "a.pt": ("checkpoint (.pt), PyTorch, written by gsplat, step 29999", "does not say"),
    }
    for name, parts in expected.items():
        facts = inspected(f"gaussians:{folder / name}", capsys, tmp_path)
        line = next(line for line in facts["text"].splitlines() if line.startswith("  file "))
        assert name in line and all(part in line for part in parts), (name, line)
        assert facts["elsewhere"] == [], name
        assert facts["background"]["count"] == 60


def test_what_others_show_wrongly_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = small_gaussians()
    path = tmp_path / "a.ply"

    def warnings_of(query: str = "") -> str:
        return " ".join(inspected(f"gaussians:{path}{query}", capsys, tmp_path)["elsewhere"])

    write_ply(path, small, notes={"up": "+z"})
    assert "up is +z: viewers that take -y for up, as most do, show it on its side" in warnings_of()
    write_ply(path, small, notes={"up": "+y"})
    assert "show it upside down" in warnings_of()
    write_ply(path, small)
    assert warnings_of() == "" and "on its side" in warnings_of("?up=-z")
    write_ply(path, dataclasses.replace(small, means=small.means + 400_000), notes={"up": "-y"})
    assert "coordinates lie 693 km from zero" in warnings_of()
    scales = small.scales.clone()
    scales[:7] = 40
    opaque = dataclasses.replace(small, scales=scales, opacities=torch.ones(60))
    write_ply(path, opaque)
    assert "7 splats are longer than a tenth of the scene" in warnings_of()
    write_ply(path, dataclasses.replace(small, sh=10 * small.sh))
    assert "of the base colours lie beyond 0 to 1" in warnings_of()

    path = tmp_path / "a.spz"
    write_spz(path, small)
    path.write_bytes(version_4_of(path, flags=1))
    assert "antialiasing renderer" in warnings_of()
    spz = path.read_bytes()
    path = saved(tmp_path, compressed_document(spz, 60))
    assert "KHR_gaussian_splatting_compression_spz_2, a draft" in warnings_of()


def test_scenes_of_other_kinds_have_no_such_lines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    facts = inspected("procedural:street?seed=3&frames=1&gaussians=60000", capsys, tmp_path)
    assert facts["files"] == [] and "  file " not in facts["text"]
