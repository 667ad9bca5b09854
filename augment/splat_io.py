"""Gaussians in plain files: INRIA .ply (SH degree 0 to 3) and .splat (32-byte records).

Activations are applied on reading and inverted on writing: files hold log scales, opacity logits
and quaternions of any length, `Gaussians` holds metres, [0, 1] and unit quaternions.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from augment.batch.atomic import replaced_file
from augment.errors import SceneError
from augment.files.ply_io import ROWS_PER_CHUNK, count_surplus_bytes, read_ply_header
from augment.files.ply_layout import (
    SEMANTIC,
    column_types,
    has_wide_means,
    read_columns,
    rows_of_gaussians,
)
from augment.render.sh import SH_C0
from augment.scene import Gaussians, check_gaussians

RECENTRE_BEYOND_M = 1000.0  # float32 keeps 0.06 mm at 1 km; 0.25 m at UTM's 4000 km
_SPLAT_RECORD = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)]
)
_PLY_NAMES = {"<f4": "float", "<i2": "short"}

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SplatFile:
    """What a splat file held.

    gaussians: in the file's axes and unit. origin: float64 [3], what was subtracted from its
    coordinates (not zero only for double-precision .ply far from the origin). notes: the `key:
    value` comments of a .ply. problems: what was left out, a sentence each.
    """

    gaussians: Gaussians
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    notes: Mapping[str, str] = field(default_factory=dict)
    problems: tuple[str, ...] = ()


def read_splats(path: str | Path) -> SplatFile:
    """Read a .ply or .splat file, told apart by its first bytes.

    Raises:
        SceneError: no such file, an unknown format, or damaged content; says what was expected.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"{path}: no such file; expected a .ply or .splat file")
    with path.open("rb") as file:
        start = file.read(4)
    if start[:3] == b"ply" and start[3:] in (b"\n", b"\r"):
        return read_ply(path)
    if path.suffix.lower() == ".splat":
        return read_splat(path)
    raise SceneError(
        f"{path}: neither a .ply (its first line would be 'ply') nor named .splat; convert other "
        "splat formats (.spz, .ksplat, .sog) to .ply first, for example with SuperSplat"
    )


def read_ply(path: str | Path, element: str = "vertex") -> SplatFile:
    """Read Gaussians from one element of a .ply, binary of either byte order or ascii.

    Properties may stand in any order; unknown ones are ignored. `red green blue` (uint8) serve as
    colour where f_dc is missing. Reads in pieces: peak memory is the Gaussians plus a few MB.

    Raises:
        SceneError: not a splat .ply (lists what is missing), truncated, empty, wrong f_rest count.
    """
    header = read_ply_header(path)
    table = header.element(element)
    columns = read_columns(header, table)
    if table.count == 0:
        raise SceneError(f"{header.path}: its {element!r} element has 0 rows; nothing to render")
    gaussians, origin = _activate(columns, wide=has_wide_means(header, table))
    surplus = count_surplus_bytes(header)
    gaussians, problems = check_gaussians(gaussians, where=str(header.path))
    if surplus:
        problems += (
            f"{header.path}: {surplus} bytes follow the rows its header announces and were ignored",
        )
    notes = dict(
        (key.strip(), value.strip())
        for key, colon, value in (comment.partition(":") for comment in header.comments)
        if colon
    )
    return SplatFile(gaussians, origin, notes, problems)


def read_splat(path: str | Path) -> SplatFile:
    """Read a .splat file: colour without view dependence (SH degree 0), linear scales.

    Raises:
        SceneError: the size is no multiple of 32 bytes, no records, or not this format at all.
    """
    path = Path(path)
    size = path.stat().st_size
    if size == 0 or size % _SPLAT_RECORD.itemsize:
        raise SceneError(
            f"{path}: a .splat file is a row of 32-byte records; got {size} bytes = "
            f"{size // 32} records and {size % 32} bytes: truncated, or another format"
        )
    records = np.fromfile(path, dtype=_SPLAT_RECORD)
    rgba = torch.from_numpy(np.ascontiguousarray(records["rgba"])).float() / 255
    bytes_of_quat = torch.from_numpy(np.ascontiguousarray(records["quat"])).float()
    raw = Gaussians(
        means=torch.from_numpy(np.ascontiguousarray(records["mean"])),
        quats=(bytes_of_quat - 128) / 128,
        scales=torch.from_numpy(np.ascontiguousarray(records["scale"])),
        opacities=rgba[:, 3].contiguous(),
        sh=((rgba[:, :3] - 0.5) / SH_C0)[:, None],
    )
    gaussians, problems = check_gaussians(raw, where=str(path))
    if len(gaussians) * 2 < len(raw):
        raise SceneError(
            f"{path}: only {len(gaussians)} of {len(raw)} records hold usable numbers, so this is "
            "probably no .splat file. " + " ".join(problems)
        )
    return SplatFile(gaussians, problems=problems)


def write_ply(
    path: str | Path, gaussians: Gaussians, *, notes: Mapping[str, str] | None = None
) -> None:
    """Write an INRIA .ply (binary little endian), atomically.

    notes: written as `comment key: value` lines and given back by `read_ply`. A `semantic_class`
    column is added where the Gaussians have classes; other readers ignore it.

    Raises:
        OutputError: the system refused (disk full, no permission ...); `path` is then as it was.
    """
    columns = column_types(gaussians)
    lines = ["ply", "format binary_little_endian 1.0"]
    for key, value in (notes or {}).items():
        if not f"{key}{value}".isprintable() or ":" in key:
            raise ValueError(f"a note must be one printable line, no ':' in its key; got {key!r}")
        lines.append(f"comment {key}: {value}")
    lines.append(f"element vertex {len(gaussians)}")
    lines += [f"property {_PLY_NAMES[code]} {name}" for name, code in columns]
    with replaced_file(Path(path)) as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode())
        for start in range(0, len(gaussians), ROWS_PER_CHUNK):
            stop = min(start + ROWS_PER_CHUNK, len(gaussians))
            part = gaussians.select(torch.arange(start, stop))
            file.write(rows_of_gaussians(part, np.dtype(columns)).tobytes())


def write_splat(path: str | Path, gaussians: Gaussians) -> None:
    """Write a .splat file, atomically. The format keeps 8 bits of colour, opacity and rotation.

    SH bands above degree 0 cannot be kept; that they are dropped is logged as a warning.

    Raises:
        OutputError: as for write_ply.
    """
    if gaussians.sh_degree > 0:
        _log.warning("%s: .splat holds no view dependence; SH bands above 0 are dropped", path)
    records = np.zeros(len(gaussians), dtype=_SPLAT_RECORD)
    records["mean"] = gaussians.means.detach().cpu().numpy()
    records["scale"] = gaussians.scales.detach().cpu().numpy()
    rgb = 0.5 + SH_C0 * gaussians.sh[:, 0]
    rgba = torch.cat([rgb, gaussians.opacities[:, None]], 1).clamp(0, 1)
    records["rgba"] = (rgba * 255).round().detach().cpu().numpy()
    quats = (gaussians.quats * 128 + 128).round().clamp(0, 255)
    records["quat"] = quats.detach().cpu().numpy()
    with replaced_file(Path(path)) as file:
        file.write(records.tobytes())


def recentring_origin(points: Float[np.ndarray, "N 3"]) -> np.ndarray:
    """Whole-metre origin to subtract from coordinates, float64 [3]: the median of the finite points
    where it lies more than RECENTRE_BEYOND_M from zero, else zero.
    """
    finite = points[np.isfinite(points).all(1)]
    if len(finite) == 0:
        return np.zeros(3)
    median = np.median(finite, axis=0).astype(np.float64)
    return np.round(median) if np.linalg.norm(median) > RECENTRE_BEYOND_M else np.zeros(3)


def _activate(columns: dict[str, np.ndarray], *, wide: bool) -> tuple[Gaussians, np.ndarray]:
    """Gaussians of a file's columns, in place, and the origin subtracted from their means."""
    means = columns["means"]
    origin = recentring_origin(means) if wide else np.zeros(3)
    if wide:
        with np.errstate(over="ignore"):  # what overflows is left out as infinite, and reported
            means = (means - origin).astype(np.float32)
    semantic = columns.get(SEMANTIC)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(columns["quats"]),
        scales=torch.from_numpy(columns["scales"]).exp_(),
        opacities=torch.from_numpy(columns["opacities"]).sigmoid_(),
        sh=torch.from_numpy(columns["sh"]),
        semantic=None if semantic is None else torch.from_numpy(semantic),
    )
    return gaussians, origin
