"""A program that opens an OpenUSD file and writes its Gaussians to the standard output.

    python usd_stage.py FILE MEMORY_BYTES SECONDS

`augment.files.usd` starts it, because OpenUSD's parser is C++ and a damaged file can crash it or
make it fill the memory. The output is one line of JSON, {"error": ...} or

    {"notes": {}, "problems": [], "prims": [{"path": "/a", "matrix": [16 numbers, row by row],
     "degree": 0, "problems": [], "columns": {"positions": [count, 3], ...}}]}

and then the float32 columns one after another. The matrices lead to the file's world in metres
where it states its unit. It imports neither this package nor torch, so that it starts fast.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

LEAST_ROW = 6  # bytes of a place, in halves
MAX_COPIES = 16  # of all Gaussians that the file has room for
MAX_DEGREE = 16  # of spherical harmonics; those beyond the third are cut off
MAX_PRIMS = 10_000  # with Gaussians, copies among them
COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"
# The attributes of a prim beside its positions: numbers a value, and the schema's default.
ATTRIBUTES: dict[str, list[float]] = {
    "orientations": [0.0, 0.0, 0.0, 1.0],
    "scales": [1.0, 1.0, 1.0],
    "opacities": [1.0],
    COEFFICIENTS: [0.0, 0.0, 0.0],
}


class Refusal(Exception):
    """The file cannot be used; the text is for its user."""


def main() -> None:
    path, memory, seconds = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what OpenUSD prints is not mixed with the columns
    arrays: list[np.ndarray] = []
    try:
        found = read_stage(path, arrays)
    except Refusal as error:
        found, arrays = {"error": str(error)}, []
    except MemoryError:
        found, arrays = {"error": f"needs more than {memory >> 20} MiB of memory to be read"}, []
    except Exception as error:  # whatever a damaged file leads to
        found, arrays = {"error": f"not a whole OpenUSD file: {reason_of(error)}"}, []
    output.write(json.dumps(found).encode() + b"\n")
    for array in arrays:
        output.write(array.data)
    output.close()


def reason_of(error: Exception) -> str:
    """What an error says; of OpenUSD's, the sentence of its first one."""
    try:
        first = error.args[0] if error.args else error
        return str(getattr(first, "commentary", error)).strip()[:300]
    except UnicodeDecodeError:  # the message repeats what the file has
        return "it holds text that is not UTF-8"


def openusd() -> Any:
    """The modules of usd-core as attributes, which no type checker knows."""
    import pxr
    from pxr import Sdf, Usd, UsdGeom, UsdVol  # noqa: F401 - attributes of pxr

    return pxr


def read_stage(path: Path, arrays: list[np.ndarray]) -> dict[str, Any]:
    """The facts of all visible prims with Gaussians; their columns are appended to `arrays`."""
    pxr = openusd()
    usd, geometry = pxr.Usd, pxr.UsdGeom
    root = pxr.Sdf.Layer.FindOrOpen(str(path))
    if root is None:
        raise Refusal("OpenUSD cannot open it")
    check_layers(path, root)
    stage = usd.Stage.Open(root)
    time = usd.TimeCode.EarliestTime()
    transforms = geometry.XformCache(time)
    room = path.stat().st_size // LEAST_ROW
    notes, problems, prims, unit = {}, [], [], 1.0
    if stage.HasAuthoredMetadata(geometry.Tokens.metersPerUnit):
        unit = float(geometry.GetStageMetersPerUnit(stage))
        notes["unit"] = "metre"
        if not (np.isfinite(unit) and unit > 0):
            raise Refusal(f"metersPerUnit must be positive; got {unit}")
    if stage.HasAuthoredMetadata(geometry.Tokens.upAxis):
        notes["up"] = f"+{geometry.GetStageUpAxis(stage).lower()}"
    for prim in usd.PrimRange(
        stage.GetPseudoRoot(), usd.TraverseInstanceProxies(usd.PrimDefaultPredicate)
    ):
        where = prim.GetPath()
        if prim.HasMetadata("clips"):
            raise Refusal(f"{where} takes values from other files (clips)")
        if not prim.IsA(pxr.UsdVol.ParticleField3DGaussianSplat):
            continue
        if geometry.Imageable(prim).ComputeVisibility(time) == geometry.Tokens.invisible:
            problems.append(f"{where} is invisible and left out")
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = np.array(transforms.GetLocalToWorldTransform(prim)).T * unit
            determinant = np.linalg.det(matrix[:3, :3])
        if not np.isfinite(matrix).all() or not determinant > 0:
            raise Refusal(f"{where} mirrors or flattens its Gaussians")
        positions = column(prim, "positions", 3, time)
        if positions is None:
            continue
        room -= len(positions) / MAX_COPIES
        if room < 0:
            raise Refusal(
                f"it places more than {MAX_COPIES} times the Gaussians that it has room for; place "
                "fewer copies"
            )
        if len(prims) == MAX_PRIMS:
            raise Refusal(f"it places more than {MAX_PRIMS} prims of Gaussians; join them")
        prims.append(facts_of(prim, matrix, positions, arrays, time))
    return {"notes": notes, "problems": problems, "prims": prims}


def facts_of(
    prim: Any, matrix: np.ndarray, positions: np.ndarray, arrays: list[np.ndarray], time: Any
) -> dict[str, Any]:
    """The entry of one prim, whose columns are appended to `arrays`."""
    where, count, problems = prim.GetPath(), len(positions), list[str]()
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    if type(degree) is not int or not 0 <= degree <= MAX_DEGREE:
        raise Refusal(
            f"{where}: spherical harmonics of degree {degree!r:.60}, not a number from 0 to "
            f"{MAX_DEGREE}"
        )
    columns = {"positions": positions}
    for name, default in ATTRIBUTES.items():
        rows = count * (degree + 1) ** 2 if name == COEFFICIENTS else count
        values = column(prim, name, len(default), time)
        if values is None or len(values) < rows:
            held = 0 if values is None else len(values)
            problems.append(f"{name} has {held} of {rows} values: the default is taken")
            continue  # the reader fills it in
        columns[name] = np.ascontiguousarray(values[:rows])
    arrays += columns.values()
    return {
        "path": str(where),
        "matrix": matrix.ravel().tolist(),
        "degree": degree,
        "problems": problems,
        "columns": {name: list(values.shape) for name, values in columns.items()},
    }


def column(prim: Any, name: str, width: int, time: Any) -> np.ndarray | None:
    """float32 [N, width], of floats or else of halves; None where there is neither."""
    for form in (name, f"{name}h"):
        values = prim.GetAttribute(form).Get(time)
        if values is None or (hasattr(values, "__len__") and len(values) == 0):
            continue
        numbers = np.array(values)
        shape = numbers.shape if width > 1 else (*numbers.shape, 1)
        if numbers.dtype.kind not in "fiu" or len(shape) != 2 or shape[1] != width:
            raise Refusal(
                f"{prim.GetPath()}: {form} must be an array of {width} numbers a value; it holds "
                f"{type(values).__name__} {str(values)[:60]}"
            )
        with np.errstate(over="ignore"):  # doubles beyond float32 are left out as infinite
            return np.ascontiguousarray(numbers, np.float32).reshape(shape)
    return None


def check_layers(path: Path, root: Any) -> None:
    """Refuse a file with layers in other files; a .usdz can have several in itself."""
    layers = openusd().Sdf.Layer
    waiting, visited = [root], set()
    while waiting:
        layer = waiting.pop()
        if layer.identifier in visited:
            continue
        visited.add(layer.identifier)
        for name in filter(None, layer.GetCompositionAssetDependencies()):  # '': the layer itself
            where = layer.ComputeAbsolutePath(name)
            inner = layers.FindOrOpen(where) if where.startswith(f"{path}[") else None
            if inner is None:
                raise Refusal(
                    f"it refers to {name!r}, which is not in it; make one file of all: usdcat "
                    f"--flatten {path.name} --out flat.usdc"
                )
            waiting.append(inner)


if __name__ == "__main__":
    main()
