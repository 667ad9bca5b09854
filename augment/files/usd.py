"""Gaussians in OpenUSD files: prims ParticleField3DGaussianSplat, by usd-core from 26.3 on.

    pip install 'climategs[usd]'

Scales and opacities are linear, spherical harmonics those of 3D Gaussian splatting, particle after
particle; each attribute has a form in halves, whose name ends in h. What lacks, or is too short,
has the schema's default, which is said. Facts by OpenUSD's usdVol/schema.usda.

A file has to hold all its layers: references to others are refused. OpenUSD's own parser, which is
C++, reads it.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment.errors import SceneError
from augment.files.ply import SplatFile, join_placed
from augment.jobs.atomic import replaced_file
from augment.scene import SH_COUNTS, Gaussians

_LEAST_ROW = 6  # bytes of a place, in halves
_MAX_COPIES = 16  # of all Gaussians that the file has room for


def _pxr() -> Any:
    """The modules of usd-core, as attributes."""
    try:
        import pxr
        from pxr import Sdf, Tf, Usd, UsdGeom, UsdVol, Vt  # noqa: F401 - attributes of pxr
    except ImportError as error:
        raise SceneError(
            f"OpenUSD files need usd-core ({error}): pip install 'climategs[usd]'"
        ) from error
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise SceneError(
            "this usd-core does not know ParticleField3DGaussianSplat: pip install 'usd-core>=26.3'"
        )
    return pxr


def read_usd(path: str | Path) -> SplatFile:
    """Read all visible Gaussians of the stage, at the time of its first sample, in its axes, and in
    metres where it says how long its unit is. Raises SceneError: no usd-core; damaged, without
    Gaussians, or with layers in other files.
    """
    path, pxr = Path(path), _pxr()
    try:
        layer = pxr.Sdf.Layer.FindOrOpen(str(path.absolute()))
        if layer is None:
            raise SceneError(f"{path}: OpenUSD cannot open it")
        _check_layers(pxr, path, layer)
        stage = pxr.Usd.Stage.Open(layer)
        return _read(pxr, path, stage)
    except pxr.Tf.ErrorException as error:
        first = getattr(error.args[0], "commentary", error) if error.args else error
        raise SceneError(f"{path}: not a whole OpenUSD file: {str(first).strip()[:300]}") from error


def _check_layers(pxr: Any, path: Path, root: Any) -> None:
    """That all layers lie in the file, which a .usdz can have several of."""
    waiting, seen = [root], set()
    while waiting:
        layer = waiting.pop()
        if layer.identifier in seen:
            continue
        seen.add(layer.identifier)
        for name in filter(None, layer.GetCompositionAssetDependencies()):  # '': the layer itself
            where = layer.ComputeAbsolutePath(name)
            inner = None
            if where.startswith(f"{path.absolute()}["):
                inner = pxr.Sdf.Layer.FindOrOpen(where)
            if inner is None:
                raise SceneError(
                    f"{path}: it refers to {name!r}, which is not in it; make one file of all: "
                    f"usdcat --flatten {path.name} --out flat.usdc"
                )
            waiting.append(inner)


def _read(pxr: Any, path: Path, stage: Any) -> SplatFile:
    from augment.files.export import transformed_gaussians  # which writes by this module

    time, geometry = pxr.Usd.TimeCode.EarliestTime(), pxr.UsdGeom
    transforms = geometry.XformCache(time)
    room = path.stat().st_size // _LEAST_ROW
    parts, problems, unit, notes = [], [], 1.0, {}
    if stage.HasAuthoredMetadata(geometry.Tokens.metersPerUnit):
        unit = float(geometry.GetStageMetersPerUnit(stage))
        notes["unit"] = "metre"
        if not (np.isfinite(unit) and unit > 0):
            raise SceneError(f"{path}: metersPerUnit must be positive; got {unit}")
    if stage.HasAuthoredMetadata(geometry.Tokens.upAxis):
        notes["up"] = f"+{geometry.GetStageUpAxis(stage).lower()}"
    for prim in pxr.Usd.PrimRange(
        stage.GetPseudoRoot(), pxr.Usd.TraverseInstanceProxies(pxr.Usd.PrimDefaultPredicate)
    ):
        if prim.HasMetadata("clips"):
            raise SceneError(f"{path}: {prim.GetPath()} takes values from other files (clips)")
        if not prim.IsA(pxr.UsdVol.ParticleField3DGaussianSplat):
            continue
        if geometry.Imageable(prim).ComputeVisibility(time) == geometry.Tokens.invisible:
            problems.append(f"{path}: {prim.GetPath()} is invisible and left out")
            continue
        matrix = np.array(transforms.GetLocalToWorldTransform(prim)).T * unit
        if not np.isfinite(matrix).all() or np.linalg.det(matrix[:3, :3]) <= 0:
            raise SceneError(f"{path}: {prim.GetPath()} mirrors or flattens its Gaussians")
        places = _column(prim, "positions", time)
        if places is None:
            continue
        room -= len(places) / _MAX_COPIES
        if room < 0:
            raise SceneError(
                f"{path}: it places more than {_MAX_COPIES} times the Gaussians that it has room "
                "for; place fewer copies"
            )
        own, about = _own_gaussians(prim, len(places), time)
        problems += [f"{path}: {prim.GetPath()}: {sentence}" for sentence in about]
        far = places.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        parts.append((far, transformed_gaussians(own, torch.from_numpy(matrix[:3, :3].copy()))))
    if not parts:
        raise SceneError(
            f"{path}: no visible ParticleField3DGaussianSplat with positions; splats are needed"
        )
    return join_placed(parts, path, notes, problems)


def _column(prim: Any, name: str, time: Any) -> np.ndarray | None:
    """float32, of floats or else of halves; None where there is neither. Quaternions are xyzw."""
    for form in (name, f"{name}h"):
        values = prim.GetAttribute(form).Get(time)
        if values is not None and len(values):
            return np.array(values, np.float32)
    return None


def _own_gaussians(prim: Any, count: int, time: Any) -> tuple[Gaussians, list[str]]:
    """In the prim's axes, at 0, and a sentence for what is not as written."""
    problems = []

    def rows(name: str, default: list[float], each: int = 1) -> np.ndarray:
        values = _column(prim, name, time)
        if values is None or len(values) < count * each:
            held = 0 if values is None else len(values)
            problems.append(f"{name} has {held} of {count * each} values: the default is taken")
            return np.tile(np.array(default, np.float32), (count * each, 1))
        return values[: count * each]

    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    if not 0 <= degree <= 16:
        raise SceneError(f"{prim.GetPath()}: spherical harmonics of degree {degree}, not 0 to 16")
    each = (degree + 1) ** 2
    sh = rows("radiance:sphericalHarmonicsCoefficients", [0.0, 0.0, 0.0], each)
    if each > SH_COUNTS[-1]:
        problems.append(f"spherical harmonics of degree {degree} are cut off at 3")
    sh = sh.reshape(count, each, 3)[:, : SH_COUNTS[-1]]
    columns = {
        "quats": rows("orientations", [0.0, 0.0, 0.0, 1.0])[:, [3, 0, 1, 2]],
        "scales": rows("scales", [1.0, 1.0, 1.0]),
        "opacities": rows("opacities", [1.0]).reshape(count),
        "sh": sh,
    }
    tensors = {name: torch.from_numpy(np.ascontiguousarray(c)) for name, c in columns.items()}
    return Gaussians(means=torch.zeros(count, 3), **tensors), problems


def write_usd(path: str | Path, gaussians: Gaussians, *, is_upright: bool, is_metric: bool) -> None:
    """Write a .usdc, atomically: one prim of floats. is_upright: z is up, which it then says.
    is_metric: the unit is the metre, likewise.
    """
    pxr = _pxr()
    layer = pxr.Sdf.Layer.CreateAnonymous(".usdc")
    stage = pxr.Usd.Stage.Open(layer)
    if is_upright:
        pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    if is_metric:
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Gaussians")
    stage.SetDefaultPrim(field.GetPrim())

    def numbers(tensor: torch.Tensor) -> np.ndarray:
        return np.ascontiguousarray(tensor.detach().cpu().numpy(), np.float32)

    means, scales = numbers(gaussians.means), numbers(gaussians.scales)
    turns = torch.nn.functional.normalize(gaussians.quats, dim=1)[:, [1, 2, 3, 0]]
    reach = 3 * scales.max(axis=1, keepdims=True)  # of three standard deviations
    extent = np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)])
    vectors, vt = pxr.Vt.Vec3fArray.FromNumpy, pxr.Vt
    field.CreateExtentAttr(vectors(extent))
    field.CreatePositionsAttr(vectors(means))
    field.CreateScalesAttr(vectors(scales))
    field.CreateOrientationsAttr(vt.QuatfArray.FromNumpy(numbers(turns)))
    field.CreateOpacitiesAttr(vt.FloatArray.FromNumpy(numbers(gaussians.opacities)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
    coefficients = numbers(gaussians.sh.reshape(-1, 3))
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(vectors(coefficients))
    with tempfile.TemporaryDirectory(dir=Path(path).parent) as folder:
        made = Path(folder) / "a.usdc"
        layer.Export(str(made))
        with made.open("rb") as source, replaced_file(Path(path)) as file:
            shutil.copyfileobj(source, file)
