"""Gaussians in OpenUSD files: prims ParticleField3DGaussianSplat, by usd-core from 26.3 on.

    pip install 'climategs[usd]'

Scales and opacities are linear, spherical harmonics those of 3D Gaussian splatting, particle after
particle; each attribute has a form in halves, whose name ends in h. What lacks, or is too short,
has the schema's default, which is said. Facts by OpenUSD's usdVol/schema.usda.

A file has to hold all its layers: references to others are refused. OpenUSD's own parser, which is
C++, reads it in a process of its own (`usd_stage.py`) with limits of memory and time.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from augment.errors import SceneError
from augment.files.limits import check_memory, parsed_json
from augment.files.ply import SplatFile, join_placed
from augment.files.usd_stage import ATTRIBUTES, COEFFICIENTS
from augment.jobs.atomic import make_folder, refusals_of, replaced_file
from augment.scene import SH_COUNTS, Gaussians

_FREE_MEMORY = 2 << 30  # bytes of address space to read a file of any size
_MEMORY_PER_BYTE = 16  # bytes beyond that for each byte of the file
_FREE_SECONDS = 45  # to read a file of any size
_BYTES_PER_SECOND = 4 << 20  # of the file, read in each second beyond that


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
    metres where it says how long its unit is.

    Raises:
        SceneError: no usd-core; damaged, without Gaussians, or with layers in other files; or
            OpenUSD crashes on it, or needs more memory or time than such a file may take.
    """
    path = Path(path)
    _pxr()  # without it the message says how to get it
    with tempfile.TemporaryFile() as output:
        _run_reader(path, output)
        output.seek(0)
        facts = parsed_json(output.readline(), f"{path}: OpenUSD's reader")
        if "error" in facts:
            raise SceneError(f"{path}: {facts['error']}")
        return _splats(path, facts, output)


def _run_reader(path: Path, output: IO[bytes]) -> None:
    """Let `usd_stage.py` read the file in a process of its own, whose crash is an error here."""
    size = path.stat().st_size
    memory = _FREE_MEMORY + _MEMORY_PER_BYTE * size
    seconds = _FREE_SECONDS + size // _BYTES_PER_SECOND
    program = Path(__file__).with_name("usd_stage.py")
    command = [sys.executable, "-P", str(program), str(path.absolute()), str(memory), str(seconds)]
    threads = ("PXR_WORK_THREAD_LIMIT", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    environment = os.environ | dict.fromkeys(threads, "1")  # each thread would reserve memory
    with tempfile.TemporaryFile() as messages:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=messages, env=environment
        )
        try:
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            code = -signal.SIGXCPU
        finally:
            process.kill()
            process.wait()
        if code == 0:
            return
        if code == -signal.SIGXCPU:
            raise SceneError(
                f"{path}: OpenUSD did not read its {size} bytes within {seconds} s and was "
                "stopped: the file is damaged, or made to take for ever"
            )
        messages.seek(0)
        text = messages.read(1 << 16).decode(errors="replace").strip()
        if "bad_alloc" in text:
            raise SceneError(f"{path}: needs more than {memory >> 20} MiB of memory to be read")
    last = text.splitlines()[-1][:300] if text else "it said nothing"
    name = signal.Signals(-code).name if code < 0 else f"exit code {code} ({last})"
    raise SceneError(
        f"{path}: OpenUSD's reader ended with {name}: the file is damaged, or nested too deeply; "
        "export it again"
    )


def _splats(path: Path, facts: dict[str, Any], output: IO[bytes]) -> SplatFile:
    """The Gaussians of all prims. facts, output: what `usd_stage.py` wrote."""
    from augment.files.export import transformed_gaussians  # which writes by this module

    problems = [f"{path}: {sentence}" for sentence in facts["problems"]]
    prims = facts["prims"]
    rows = sum(prim["columns"]["positions"][0] for prim in prims)
    if rows == 0:
        raise SceneError(
            f"{path}: no visible ParticleField3DGaussianSplat with positions; splats are needed"
        )
    highest = min(max(prim["degree"] for prim in prims), len(SH_COUNTS) - 1)
    check_memory(str(path), rows, functions=SH_COUNTS[highest], size=path.stat().st_size)
    parts = []
    for prim in prims:
        columns = {
            name: np.fromfile(output, np.float32, count * width).reshape(count, width)
            for name, (count, width) in prim["columns"].items()
        }
        matrix = np.array(prim["matrix"], np.float64).reshape(4, 4)
        gaussians = _gaussians(columns, prim["degree"])
        problems += [f"{path}: {prim['path']}: {sentence}" for sentence in prim["problems"]]
        if prim["degree"] >= len(SH_COUNTS):
            problems.append(
                f"{path}: {prim['path']}: spherical harmonics of degree {prim['degree']} are cut "
                f"off at {len(SH_COUNTS) - 1}"
            )
        with np.errstate(over="ignore", invalid="ignore"):  # left out as infinite, and reported
            places = columns["positions"].astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        turned = transformed_gaussians(gaussians, torch.from_numpy(matrix[:3, :3].copy()))
        parts.append((places, turned))
    return join_placed(parts, path, facts["notes"], problems)


def _gaussians(columns: dict[str, np.ndarray], degree: int) -> Gaussians:
    """The Gaussians of a prim in its axes, at 0; columns that it lacks have the default."""
    count, each = len(columns["positions"]), (degree + 1) ** 2
    kept = min(each, SH_COUNTS[-1])

    def values(name: str, rows: int) -> np.ndarray:
        if name in columns:
            return columns[name]
        return np.tile(np.array(ATTRIBUTES[name], np.float32), (rows, 1))

    if COEFFICIENTS in columns:
        sh = columns[COEFFICIENTS].reshape(count, each, 3)[:, :kept]
    else:
        sh = values(COEFFICIENTS, count * kept).reshape(count, kept, 3)
    ready = {
        "quats": values("orientations", count)[:, [3, 0, 1, 2]],
        "scales": values("scales", count),
        "opacities": values("opacities", count).reshape(count),
        "sh": sh,
    }
    tensors = {name: torch.from_numpy(np.ascontiguousarray(v)) for name, v in ready.items()}
    return Gaussians(means=torch.zeros(count, 3), **tensors)


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
    path = Path(path)
    with refusals_of(path):
        make_folder(path.parent)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            made = Path(folder) / "a.usdc"
            layer.Export(str(made))
            with made.open("rb") as source, replaced_file(path) as file:
                shutil.copyfileobj(source, file)
