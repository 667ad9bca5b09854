"""Gaussians in OpenUSD files: round trips, transforms, the schema's defaults, refusals."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from pxr import UsdUtils

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
