"""Gaussians in OpenUSD files: round trips, transforms, the schema's defaults, refusals."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from pxr import Usd, UsdGeom, UsdUtils

from augment.errors import SceneError
from augment.files.formats import read_splats
from augment.files.usd import read_usd, write_usd
from tests.augment.test_splat_formats import some_gaussians

SPLATS = "def ParticleField3DGaussianSplat"
# A Gaussian at (1, 2, 3), a turn of 90 degrees about z, opacity 0.25.
ONE = """
    half3[] scalesh = [(0.5, 1, 2)]
    point3f[] positions = [(1, 2, 3)]
    quath[] orientationsh = [(0.70711, 0, 0, 0.70711)]
    float[] opacities = [0.25, 1]
    uniform int radiance:sphericalHarmonicsDegree = 0
    float3[] radiance:sphericalHarmonicsCoefficients = [(0.1, 0.2, 0.3)]
"""


def saved(folder: Path, body: str, head: str = "") -> Path:
    path = folder / f"{len(list(folder.iterdir()))}.usda"  # OpenUSD keeps open layers by name
    path.write_text(f"#usda 1.0\n({head})\n{body}\n")
    return path


def test_a_usdz_is_read_as_what_it_packs(tmp_path: Path) -> None:
    before = some_gaussians()
    write_usd(tmp_path / "a.usdc", before, is_upright=True, is_metric=True)
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "a.usdc"), str(tmp_path / "a.usdz"))
    assert torch.equal(read_splats(tmp_path / "a.usdz").gaussians.sh, before.sh)


def test_a_written_file_meets_the_rules_that_nvidia_publishes_for_splats(tmp_path: Path) -> None:
    """SimReady's SPL.001 to SPL.006 and its stage rules, and VG.035 of Omniverse's requirements."""
    for bands in (1, 4, 9, 16):
        gaussians = some_gaussians(300, bands)
        gaussians.quats.mul_(3)  # of any length
        path = tmp_path / f"{bands}.usdc"
        write_usd(path, gaussians, is_upright=True, is_metric=True)
        stage = Usd.Stage.Open(str(path))
        assert stage.HasAuthoredMetadata("upAxis") and stage.HasAuthoredMetadata("metersPerUnit")
        assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
        root = stage.GetDefaultPrim()
        assert [prim.GetName() for prim in stage.GetPseudoRoot().GetChildren()] == [root.GetName()]
        assert UsdGeom.Xform(root)
        (splat,) = root.GetChildren()
        assert splat.GetTypeName() == "ParticleField3DGaussianSplat"
        attributes = {
            attribute.GetName(): attribute.Get()
            for attribute in splat.GetAttributes()
            if attribute.HasAuthoredValue()
        }
        count = len(attributes["positions"])
        assert count == 300
        for name in ("scales", "orientations", "opacities"):
            assert len(attributes[name]) == count, name
        scales = torch.tensor([list(scale) for scale in attributes["scales"]])
        assert torch.equal(scales, gaussians.scales) and (scales > 0).all()
        opacities = torch.tensor(list(attributes["opacities"]))
        assert torch.equal(opacities, gaussians.opacities)
        lengths = [quat.GetLength() for quat in attributes["orientations"]]
        assert lengths == pytest.approx([1.0] * count, abs=1e-6)
        degree = attributes["radiance:sphericalHarmonicsDegree"]
        coefficients = attributes["radiance:sphericalHarmonicsCoefficients"]
        assert degree == gaussians.sh_degree and len(coefficients) == count * (degree + 1) ** 2
        low, high = attributes["extent"]
        assert all(low[i] <= gaussians.means[:, i].min() for i in range(3))
        assert all(high[i] >= gaussians.means[:, i].max() for i in range(3))


def test_transforms_units_halves_and_defaults(tmp_path: Path) -> None:
    """Centimetres, y up; a prim turned by 90 degrees about x, another with places only."""
    body = f"""
def Xform "a" {{
    double3 xformOp:translate = (100, 0, 0)
    float xformOp:rotateX = 90
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    {SPLATS} "one" {{ {ONE} }}
    {SPLATS} "hidden" {{ {ONE} token visibility = "invisible"
}}
}}
{SPLATS} "bare" {{ point3f[] positions = [(0, 0, 500)]
}}"""
    read = read_usd(saved(tmp_path, body, 'upAxis = "Y"; metersPerUnit = 0.01'))
    assert read.notes == {"up": "+y", "unit": "metre"}
    found = read.gaussians
    assert found.means.tolist() == [pytest.approx([1.01, -0.03, 0.02]), [0, 0, 5]]
    assert found.scales.tolist() == [pytest.approx([0.005, 0.01, 0.02]), pytest.approx([0.01] * 3)]
    assert found.opacities.tolist() == [0.25, 1]
    half = 0.5  # the turn about x after the one about z, each of cos 45 degrees
    turned = found.quats[0] * math.copysign(1, found.quats[0, 0])
    assert turned.tolist() == pytest.approx([half, half, -half, half], abs=1e-3)  # of halves
    assert found.sh[:, 0].tolist() == [pytest.approx([0.1, 0.2, 0.3]), [0, 0, 0]]
    told = " ".join(read.problems)
    assert "/a/hidden is invisible" in told and "/bare: scales has 0 of 1 values" in told


def test_refusals(tmp_path: Path) -> None:
    other = saved(tmp_path, f'{SPLATS} "one" {{ {ONE} }}')
    scale = "float3 xformOp:scale = (-1, 1, 1)\nuniform token[] xformOpOrder = ['xformOp:scale']\n"
    copies = "".join(
        f'def "c{n}" (instanceable = true; references = </p>) {{}}\n' for n in range(40)
    )
    rows = ", ".join(["(0, 0, 0)"] * 900)
    prims = "\n".join(
        f'{SPLATS} "g{n}" {{ point3f[] positions = [(0, 0, 0)]\n}}' for n in range(10_001)
    )
    many = f'def "p" {{ {SPLATS} "a" {{ point3f[] positions = [{rows}]\n}}\n}}\n'
    cases = (
        ("no splats", 'def Xform "a" {}', "no visible ParticleField3DGaussianSplat"),
        ("another file", f'def "a" (references = @{other}@) {{}}', "refers to .*usdcat --flatten"),
        ("a payload", f'def "a" (payload = @./{other.name}@) {{}}', "refers to"),
        ("a mirror", f'{SPLATS} "a" {{ {ONE} {scale} }}', "mirrors"),
        ("degree", f'{SPLATS} "a" {{ {ONE.replace("Degree = 0", "Degree = 99")} }}', "degree 99"),
        ("no degree", "uniform int radiance:sphericalHarmonicsDegree = None", "of degree None"),
        ("text", "string radiance:sphericalHarmonicsDegree = 'x'", "of degree 'x'"),
        ("pairs", "float2[] scales = [(1, 1)]", "scales must be .* it holds Vec2fArray"),
        ("words", "string[] opacities = ['a']", "opacities must be .* it holds StringArray"),
        ("one", "float opacities = 0.5", "opacities must be .* it holds float"),
        ("not USD", "def {", "not a whole OpenUSD file"),
        ("copies", many + copies, "more than 16 times"),
        ("prims", prims, "more than 10000 prims of Gaussians"),
    )
    for name, text, message in cases:
        is_whole = "def" in text
        place = "point3f[] positions = [(0, 0, 0)]"
        body = text if is_whole else f'{SPLATS} "a" {{ {place}\n{text}\n}}'
        with pytest.raises(SceneError, match=message):
            read_splats(saved(tmp_path, body))
            pytest.fail(name)
    nested = [f'def "a{n}" {{' for n in range(20_000)]
    point = 'def ParticleField3DGaussianSplat "G" { point3f[] positions = [(0, 0, 0)]\n}'
    with pytest.raises(SceneError, match="OpenUSD's reader ended with SIGSEGV"):
        read_usd(saved(tmp_path, "\n".join([*nested, point, "}\n" * len(nested)])))
    other.write_bytes(other.read_bytes().replace(b"float[]", b"fl\xfft[]"))
    with pytest.raises(SceneError, match="not UTF-8"):
        read_usd(other)
