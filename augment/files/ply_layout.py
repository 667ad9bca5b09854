"""Columns of the INRIA splat .ply: which there must be, and how they map to Gaussians.

Scales are logs, opacities logits, quaternions of any length; f_rest is channel-major (all of red's
coefficients, then green's, then blue's). Values here are as in the file: no activation is applied
on reading, and `rows_of_gaussians` inverts them for writing.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from augment.errors import SceneError
from augment.files.ply_io import PlyElement, PlyHeader, iterate_rows
from augment.render.sh import SH_C0
from augment.scene import SH_COUNTS, Gaussians

SEMANTIC = "semantic_class"
_F_REST_COUNTS = tuple(3 * (k - 1) for k in SH_COUNTS)
_GEOMETRY = ("x", "y", "z", "opacity", *(f"scale_{i}" for i in range(3)),
             *(f"rot_{i}" for i in range(4)))  # fmt: skip
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_RGB = ("red", "green", "blue")
# Beyond these the float32 sigmoid is 0 or 1; a finite logit keeps other readers' sums finite.
_LOGIT_MIN, _LOGIT_MAX = -110.0, 40.0


def has_wide_means(header: PlyHeader, table: PlyElement) -> bool:
    """Whether coordinates come with more digits than float32 holds."""
    types = dict(table.columns)
    return header.byte_order == "ascii" or any(types[axis] in ("f8", "i4", "u4") for axis in "xyz")


def read_columns(header: PlyHeader, table: PlyElement) -> dict[str, np.ndarray]:
    """The columns of Gaussians as they stand in the file, gathered into contiguous arrays.

    means [N, 3] (float64 where the file is wider than float32), quats [N, 4], scales [N, 3] (log),
    opacities [N] (logit), sh [N, K, 3], and semantic_class [N] where the file has it.

    Raises:
        SceneError: columns are missing (lists them), wrong in number, or fewer rows than announced.
    """
    sh_count = _check_columns(header, table)
    mean_type = np.float64 if has_wide_means(header, table) else np.float32
    target: dict[str, np.ndarray] = {}
    done = 0
    for rows in iterate_rows(header, table.name):
        if not target:  # only now is the file known to be as long as its header says
            target = _allocate(table, sh_count, mean_type)
        _scatter_columns(rows, target, slice(done, done + len(rows)))
        done += len(rows)
    return target or _allocate(table, sh_count, mean_type)


def column_types(gaussians: Gaussians) -> list[tuple[str, str]]:
    """Names and types of the columns written for these Gaussians, in INRIA's order."""
    rest = 3 * (gaussians.sh.shape[1] - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", *_DC, *(f"f_rest_{i}" for i in range(rest))]
    columns = [(name, "<f4") for name in (*names, *_GEOMETRY[3:])]
    return columns if gaussians.semantic is None else [*columns, (SEMANTIC, "<i2")]


def rows_of_gaussians(part: Gaussians, dtype: np.dtype) -> np.ndarray:
    """Structured rows [N] of the Gaussians, activations inverted. Normals are written as 0."""
    rows = np.zeros(len(part), dtype=dtype)
    opacities = part.opacities.double()
    logits = (opacities.log() - torch.log1p(-opacities)).clamp(_LOGIT_MIN, _LOGIT_MAX)
    log_scales = part.scales.double().log()
    rest = part.sh[:, 1:].transpose(1, 2).reshape(len(part), -1)  # channel-major
    columns: dict[str, Tensor] = {
        "x": part.means[:, 0],
        "y": part.means[:, 1],
        "z": part.means[:, 2],
    }
    columns["opacity"] = logits
    columns |= {f"scale_{i}": log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": part.quats[:, i] for i in range(4)}
    columns |= {name: part.sh[:, 0, channel] for channel, name in enumerate(_DC)}
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    if part.semantic is not None:
        columns[SEMANTIC] = part.semantic
    for name, values in columns.items():
        rows[name] = values.detach().cpu().numpy()
    return rows


def _check_columns(header: PlyHeader, table: PlyElement) -> int:
    """Number of SH coefficients K, once the columns are known to be those of Gaussians."""
    names = set(table.names)
    missing = [name for name in _GEOMETRY if name not in names]
    if not names.issuperset(_RGB):
        missing += [name for name in _DC if name not in names]
    if missing:
        raise SceneError(
            f"{header.path}: not a Gaussian splat .ply: its element {table.name!r} misses "
            f"{', '.join(missing)}; it has {', '.join(table.names) or 'no properties'}. "
            + _guess_content(header, names)
        )
    rest = [name for name in table.names if name.startswith("f_rest_")]
    if len(rest) not in _F_REST_COUNTS or set(rest) != {f"f_rest_{i}" for i in range(len(rest))}:
        raise SceneError(
            f"{header.path}: f_rest_0, f_rest_1, … must be {_F_REST_COUNTS} in number (SH degrees "
            f"0 to 3) and numbered without gaps; got {len(rest)}"
        )
    return 1 + len(rest) // 3


def _guess_content(header: PlyHeader, names: set[str]) -> str:
    if "packed_position" in names:
        return "This is SuperSplat's compressed layout: export it as uncompressed .ply."
    if any(e.name in ("face", "tristrips") for e in header.elements):
        return "This is a mesh; a trained 3D Gaussian splat is needed."
    if "scale_0" in names and "scale_2" not in names:
        return "These are 2D Gaussians (two scales), which are not supported."
    return "This is a point cloud; a trained 3D Gaussian splat is needed."


def _allocate(table: PlyElement, sh_count: int, mean_type: type) -> dict[str, np.ndarray]:
    count = table.count
    target = {
        "means": np.empty((count, 3), mean_type),
        "quats": np.empty((count, 4), np.float32),
        "scales": np.empty((count, 3), np.float32),
        "opacities": np.empty(count, np.float32),
        "sh": np.empty((count, sh_count, 3), np.float32),
    }
    if SEMANTIC in table.names:
        target[SEMANTIC] = np.empty(count, np.int16)
    return target


def _scatter_columns(rows: np.ndarray, target: dict[str, np.ndarray], where: slice) -> None:
    """Copy the columns of some rows to their places; no activation yet."""
    names = rows.dtype.names or ()
    sh = target["sh"][where]
    with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 become infinite
        for axis, name in enumerate("xyz"):
            target["means"][where, axis] = rows[name]
        for axis in range(3):
            target["scales"][where, axis] = rows[f"scale_{axis}"]
        for part in range(4):
            target["quats"][where, part] = rows[f"rot_{part}"]
        target["opacities"][where] = rows["opacity"]
        for channel in range(3):
            if _DC[channel] in names:
                sh[:, 0, channel] = rows[_DC[channel]]
            else:
                sh[:, 0, channel] = (rows[_RGB[channel]] / 255.0 - 0.5) / SH_C0
            bands = sh.shape[1] - 1
            for band in range(bands):
                sh[:, 1 + band, channel] = rows[f"f_rest_{channel * bands + band}"]
        if SEMANTIC in target:
            target[SEMANTIC][where] = rows[SEMANTIC]
