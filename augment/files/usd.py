"""Reads and writes Gaussians in OpenUSD files: prims ParticleField3DGaussianSplat of usd-core 26.3.

    pip install 'climategs[usd]'

Scales and opacities are linear, spherical harmonics those of 3D Gaussian splatting, stored particle
after particle. Each attribute has a form in half floats, whose name ends in h. An attribute that is
missing or too short has the schema's default, which a problem reports. Source: OpenUSD's
usdVol/schema.usda.

A file has to hold all its layers: references to others are refused. OpenUSD's own parser, which is
C++, reads it in a separate process (`usd_stage.py`) with limits of memory and time.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from augment.errors import SceneError
from augment.files.limits import check_memory, parse_json_object
from augment.files.splat_format import (
    Loss,
    SplatFile,
    SplatFormat,
    SplatWriter,
    join_positioned_parts,
)
from augment.files.usd_stage import ATTRIBUTES, COEFFICIENTS
from augment.output.atomic import make_folder, raise_output_error, write_file_atomically
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians
from augment.scene.transform import transform_gaussians

_BASE_MEMORY_BYTES = 2 << 30  # bytes of address space to read a file of any size
_MEMORY_PER_BYTE = 16  # bytes beyond that for each byte of the file
_BASE_TIME_S = 45  # seconds to read a file of any size
_BYTES_PER_SECOND = 4 << 20  # bytes of the file for each second beyond that


def _pxr() -> Any:
    """Return the modules of usd-core as attributes."""
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
    """Read all visible Gaussians of the stage at the time of its first sample.

    They are in its axes, and in metres where it states the length of its unit.

    Raises:
        SceneError: usd-core is missing; the file is damaged, without Gaussians, or has layers in
            other files; or OpenUSD crashes on it, or needs more memory or time than the limits.
    """
    path = Path(path)
    _pxr()  # raises an error that says how to install it
    with tempfile.TemporaryFile() as output:
        _run_reader(path, output)
        output.seek(0)
        facts = parse_json_object(output.readline(), f"{path}: OpenUSD's reader")
        if "error" in facts:
            raise SceneError(f"{path}: {facts['error']}")
        return _splats(path, facts, output)


def _run_reader(path: Path, output: IO[bytes]) -> None:
    """Run `usd_stage.py` in a separate process, whose crash becomes an error here."""
    size = path.stat().st_size
    memory = _BASE_MEMORY_BYTES + _MEMORY_PER_BYTE * size
    seconds = _BASE_TIME_S + size // _BYTES_PER_SECOND
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
    last_line = text.splitlines()[-1][:300] if text else "it said nothing"
    ending = signal.Signals(-code).name if code < 0 else f"exit code {code} ({last_line})"
    raise SceneError(
        f"{path}: OpenUSD's reader ended with {ending}: the file is damaged, or nested too deeply; "
        "export it again"
    )


def _splats(path: Path, facts: dict[str, Any], output: IO[bytes]) -> SplatFile:
    """Return the Gaussians of all prims.

    Args:
        path: the file.
        facts: the line of JSON that `usd_stage.py` wrote.
        output: its output after that line.
    """
    problems = [f"{path}: {sentence}" for sentence in facts["problems"]]
    prims = facts["prims"]
    num_gaussians = sum(prim["columns"]["positions"][0] for prim in prims)
    if num_gaussians == 0:
        raise SceneError(
            f"{path}: no visible ParticleField3DGaussianSplat with positions; splats are needed"
        )
    max_degree = min(max(prim["degree"] for prim in prims), len(NUM_SH_BY_DEGREE) - 1)
    check_memory(
        str(path),
        num_gaussians,
        num_sh=NUM_SH_BY_DEGREE[max_degree],
        file_bytes=path.stat().st_size,
    )
    parts = []
    for prim in prims:
        columns = {
            name: np.fromfile(output, np.float32, count * width).reshape(count, width)
            for name, (count, width) in prim["columns"].items()
        }
        matrix = np.array(prim["matrix"], np.float64).reshape(4, 4)
        gaussians = _gaussians(columns, prim["degree"])
        problems += [f"{path}: {prim['path']}: {sentence}" for sentence in prim["problems"]]
        if prim["degree"] >= len(NUM_SH_BY_DEGREE):
            problems.append(
                f"{path}: {prim['path']}: spherical harmonics of degree {prim['degree']} are cut "
                f"off at {len(NUM_SH_BY_DEGREE) - 1}"
            )
        with np.errstate(
            over="ignore", invalid="ignore"
        ):  # infinite values are left out later, and reported
            positions = columns["positions"].astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        placed_gaussians = transform_gaussians(gaussians, torch.from_numpy(matrix[:3, :3].copy()))
        parts.append((positions, placed_gaussians))
    return join_positioned_parts(parts, path, facts["notes"], problems)


def _gaussians(columns: dict[str, np.ndarray], degree: int) -> Gaussians:
    """Return a prim's Gaussians in its axes with zero means; missing columns have the default."""
    count = len(columns["positions"])
    num_sh = (degree + 1) ** 2
    num_kept_sh = min(num_sh, NUM_SH_BY_DEGREE[-1])

    def values(name: str, rows: int) -> np.ndarray:
        if name in columns:
            return columns[name]
        return np.tile(np.array(ATTRIBUTES[name], np.float32), (rows, 1))

    if COEFFICIENTS in columns:
        sh = columns[COEFFICIENTS].reshape(count, num_sh, 3)[:, :num_kept_sh]
    else:
        sh = values(COEFFICIENTS, count * num_kept_sh).reshape(count, num_kept_sh, 3)
    arrays = {
        "quats": values("orientations", count)[:, [3, 0, 1, 2]],
        "scales": values("scales", count),
        "opacities": values("opacities", count).reshape(count),
        "sh": sh,
    }
    tensors = {name: torch.from_numpy(np.ascontiguousarray(v)) for name, v in arrays.items()}
    return Gaussians(means=torch.zeros(count, 3), **tensors)


def write_usd(path: str | Path, gaussians: Gaussians, *, is_upright: bool, is_metric: bool) -> None:
    """Write a .usdc with one prim of floats under a root, atomically.

    It meets the rules that NVIDIA publishes for splats (SimReady's SPL.001 to SPL.006, and VG.035
    of the Omniverse asset requirements), where up and unit are known: all arrays have the same
    length, scales and opacities are linear, quaternions have length 1, there are (degree + 1)^2
    coefficients a Gaussian, and the stage has a default prim, an up axis and metres a unit.

    Args:
        path: the file.
        gaussians: the Gaussians.
        is_upright: whether z is up; the file then says so.
        is_metric: whether the unit is the metre; the file then says so.
    """
    pxr = _pxr()
    layer = pxr.Sdf.Layer.CreateAnonymous(".usdc")
    stage = pxr.Usd.Stage.Open(layer)
    if is_upright:
        pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    if is_metric:
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = pxr.UsdGeom.Xform.Define(stage, "/Scene")
    stage.SetDefaultPrim(root.GetPrim())
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Scene/Gaussians")

    def numbers(tensor: torch.Tensor) -> np.ndarray:
        return np.ascontiguousarray(tensor.detach().cpu().numpy(), np.float32)

    means = numbers(gaussians.means)
    scales = numbers(gaussians.scales)
    quats_xyzw = torch.nn.functional.normalize(gaussians.quats, dim=1)[:, [1, 2, 3, 0]]
    radii = 3 * scales.max(axis=1, keepdims=True)  # three standard deviations
    extent = np.stack([(means - radii).min(axis=0), (means + radii).max(axis=0)])
    to_vectors = pxr.Vt.Vec3fArray.FromNumpy
    vt = pxr.Vt
    field.CreateExtentAttr(to_vectors(extent))
    field.CreatePositionsAttr(to_vectors(means))
    field.CreateScalesAttr(to_vectors(scales))
    field.CreateOrientationsAttr(vt.QuatfArray.FromNumpy(numbers(quats_xyzw)))
    field.CreateOpacitiesAttr(vt.FloatArray.FromNumpy(numbers(gaussians.opacities)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
    coefficients = numbers(gaussians.sh.reshape(-1, 3))
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(to_vectors(coefficients))
    path = Path(path)
    with raise_output_error(path):
        make_folder(path.parent)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            temporary_file = Path(folder) / "a.usdc"
            layer.Export(str(temporary_file))
            with temporary_file.open("rb") as source, write_file_atomically(path) as file:
                shutil.copyfileobj(source, file)


def _export(path: Path, gaussians: Gaussians, facts: Mapping[str, str]) -> None:
    """Write a scene's Gaussians in the scene's axes."""
    write_usd(path, gaussians, is_upright="up" in facts, is_metric="unit" in facts)


USD = SplatFormat(
    name=".usd",
    reader=read_usd,
    suffixes=(".usd", ".usda", ".usdc", ".usdz"),
    writer=SplatWriter(
        kind="usd",
        suffix=".usdc",
        write=_export,
        world_losses=(
            Loss("cameras are left out"),
            Loss(
                "which way is up is not known, so the stage has no upAxis: OpenUSD then takes y",
                lambda scene: not scene.has_known_gravity,
            ),
            Loss(
                "how long a unit is is not known, so the stage has no metersPerUnit: OpenUSD then "
                "takes a centimetre",
                lambda scene: not scene.has_metric_scale,
            ),
        ),
    ),
)
