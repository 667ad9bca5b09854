"""Program that opens an OpenUSD file and writes its Gaussians to the standard output.

    python usd_stage.py FILE MEMORY_BYTES SECONDS

`augment.files.usd` starts it as a process, because OpenUSD's parser is C++: a damaged file can
crash it or make it fill the memory. The output is one line of JSON, {"error": ...} or

    {"notes": {}, "problems": [], "prims": [{"path": "/a", "matrix": [16 numbers, row by row],
     "degree": 0, "problems": [], "columns": {"positions": [count, 3], ...}}]}

and then the float32 columns one after another. The matrices lead to the file's world, in metres
where it states its unit. The program imports neither this package nor torch, so that it starts
fast.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

MIN_ROW_BYTES = 6  # bytes of a position in half floats
MAX_COPIES = 16  # copies of all Gaussians that the file has room for
MAX_DEGREE = 16  # degree of spherical harmonics; bands beyond the third are cut off
MAX_PRIMS = 10_000  # prims with Gaussians, copies included
COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"
# The attributes of a prim besides its positions, and the schema's default of one value.
ATTRIBUTES: dict[str, list[float]] = {
    "orientations": [0.0, 0.0, 0.0, 1.0],
    "scales": [1.0, 1.0, 1.0],
    "opacities": [1.0],
    COEFFICIENTS: [0.0, 0.0, 0.0],
}


class Refusal(Exception):
    """The file cannot be used; the text is for its user."""


def main() -> None:
    """Read the file and write its Gaussians, within the limits of memory and time."""
    path = Path(sys.argv[1])
    memory = int(sys.argv[2])
    seconds = int(sys.argv[3])
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # OpenUSD's own output must not mix with the columns
    arrays: list[np.ndarray] = []
    try:
        facts = read_stage(path, arrays)
    except Refusal as error:
        facts = {"error": str(error)}
        arrays = []
    except MemoryError:
        facts = {"error": f"needs more than {memory >> 20} MiB of memory to be read"}
        arrays = []
    except Exception as error:  # whatever a damaged file leads to
        facts = {"error": f"not a whole OpenUSD file: {reason_of(error)}"}
        arrays = []
    output.write(json.dumps(facts).encode() + b"\n")
    for array in arrays:
        output.write(array.data)
    output.close()


def reason_of(error: Exception) -> str:
    """Return the text of an error; for OpenUSD's errors the sentence of the first one."""
    try:
        first = error.args[0] if error.args else error
        return str(getattr(first, "commentary", error)).strip()[:300]
    except UnicodeDecodeError:  # the message repeats what the file has
        return "it holds text that is not UTF-8"


def openusd() -> Any:
    """Return the modules of usd-core as attributes, which no type checker knows."""
    import pxr
    from pxr import Sdf, Usd, UsdGeom, UsdVol  # noqa: F401 - attributes of pxr

    return pxr


def read_stage(path: Path, arrays: list[np.ndarray]) -> dict[str, Any]:
    """Return the facts of all visible prims with Gaussians; append their columns to `arrays`."""
    pxr = openusd()
    usd = pxr.Usd
    geometry = pxr.UsdGeom
    root = pxr.Sdf.Layer.FindOrOpen(str(path))
    if root is None:
        raise Refusal("OpenUSD cannot open it")
    check_layers(path, root)
    stage = usd.Stage.Open(root)
    time = usd.TimeCode.EarliestTime()
    transforms = geometry.XformCache(time)
    max_gaussians = path.stat().st_size // MIN_ROW_BYTES
    notes = {}
    problems = []
    prims = []
    unit = 1.0
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
        prim_path = prim.GetPath()
        if prim.HasMetadata("clips"):
            raise Refusal(f"{prim_path} takes values from other files (clips)")
        if not prim.IsA(pxr.UsdVol.ParticleField3DGaussianSplat):
            continue
        if geometry.Imageable(prim).ComputeVisibility(time) == geometry.Tokens.invisible:
            problems.append(f"{prim_path} is invisible and left out")
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = np.array(transforms.GetLocalToWorldTransform(prim)).T * unit
            determinant = np.linalg.det(matrix[:3, :3])
        if not np.isfinite(matrix).all() or not determinant > 0:
            raise Refusal(f"{prim_path} mirrors or flattens its Gaussians")
        positions = column(prim, "positions", 3, time)
        if positions is None:
            continue
        max_gaussians -= len(positions) / MAX_COPIES
        if max_gaussians < 0:
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
    """Return the entry of one prim; append its columns to `arrays`."""
    prim_path = prim.GetPath()
    count = len(positions)
    problems = list[str]()
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    if type(degree) is not int or not 0 <= degree <= MAX_DEGREE:
        raise Refusal(
            f"{prim_path}: spherical harmonics of degree {degree!r:.60}, not a number from 0 to "
            f"{MAX_DEGREE}"
        )
    columns = {"positions": positions}
    for name, default in ATTRIBUTES.items():
        num_expected = count * (degree + 1) ** 2 if name == COEFFICIENTS else count
        values = column(prim, name, len(default), time)
        if values is None or len(values) < num_expected:
            num_values = 0 if values is None else len(values)
            problems.append(
                f"{name} has {num_values} of {num_expected} values: the default is taken"
            )
            continue  # the reader fills it in
        columns[name] = np.ascontiguousarray(values[:num_expected])
    arrays += columns.values()
    return {
        "path": str(prim_path),
        "matrix": matrix.ravel().tolist(),
        "degree": degree,
        "problems": problems,
        "columns": {name: list(values.shape) for name, values in columns.items()},
    }


def column(prim: Any, name: str, width: int, time: Any) -> np.ndarray | None:
    """Return an attribute as float32 [N, width], from floats or else from half floats.

    Returns:
        None where the prim has neither.
    """
    for attribute_name in (name, f"{name}h"):
        values = prim.GetAttribute(attribute_name).Get(time)
        if values is None or (hasattr(values, "__len__") and len(values) == 0):
            continue
        numbers = np.array(values)
        shape = numbers.shape if width > 1 else (*numbers.shape, 1)
        if numbers.dtype.kind not in "fiu" or len(shape) != 2 or shape[1] != width:
            raise Refusal(
                f"{prim.GetPath()}: {attribute_name} must be an array of {width} numbers a value; "
                "it holds "
                f"{type(values).__name__} {str(values)[:60]}"
            )
        with np.errstate(over="ignore"):  # doubles beyond float32 become infinite and are left out
            return np.ascontiguousarray(numbers, np.float32).reshape(shape)
    return None


def check_layers(path: Path, root: Any) -> None:
    """Refuse a file with layers in other files; a .usdz may contain several."""
    layers = openusd().Sdf.Layer
    pending_layers = [root]
    visited = set()
    while pending_layers:
        layer = pending_layers.pop()
        if layer.identifier in visited:
            continue
        visited.add(layer.identifier)
        for name in filter(None, layer.GetCompositionAssetDependencies()):  # '': the layer itself
            layer_path = layer.ComputeAbsolutePath(name)
            contained_layer = (
                layers.FindOrOpen(layer_path) if layer_path.startswith(f"{path}[") else None
            )
            if contained_layer is None:
                raise Refusal(
                    f"it refers to {name!r}, which is not in it; make one file of all: usdcat "
                    f"--flatten {path.name} --out flat.usdc"
                )
            pending_layers.append(contained_layer)


if __name__ == "__main__":
    main()
