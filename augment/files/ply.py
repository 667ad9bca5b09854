"""The .ply container: its header, and rows of fixed size read in pieces.

Knows nothing of Gaussians. A header is not trusted: counts are compared with the size of the file
before anything is allocated, so a damaged or hostile file costs a message and no memory.
"""

from __future__ import annotations

import itertools
import logging
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float

from augment.errors import SceneError
from augment.jobs.atomic import replaced_file
from augment.render.sh import SH_C0
from augment.scene import SH_COUNTS, Gaussians, check_gaussians

# ---- The container -------------------------------------------------------------------------------

ROWS_PER_CHUNK = 16384  # about 4 MB of degree-3 rows: columns are picked out while in the cache
_MAX_HEADER_BYTES = 1 << 20
_MAX_COUNT_DIGITS = 18  # more than any file holds, few enough for int64
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "ascii"}
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class PlyElement:
    """One table of the file. columns: names and numpy type codes without byte order, in order.
    list_columns: names of properties whose length varies by row; such an element has no row size.
    """

    name: str
    count: int
    columns: tuple[tuple[str, str], ...]
    list_columns: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.columns)

    def row_dtype(self, byte_order: str) -> np.dtype:
        return np.dtype([(name, byte_order + code) for name, code in self.columns])


@dataclass(frozen=True)
class PlyHeader:
    """What a .ply says of itself. byte_order: '<', '>' or 'ascii'. body_offset: bytes."""

    path: Path
    byte_order: str
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]
    body_offset: int

    def element(self, name: str) -> PlyElement:
        """The element of that name."""
        for element in self.elements:
            if element.name == name:
                return element
        found = ", ".join(repr(e.name) for e in self.elements) or "none"
        raise SceneError(f"{self.path}: expected an element {name!r} in the .ply; found {found}")


def read_ply_header(path: str | Path) -> PlyHeader:
    """Read the header of a .ply file."""
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"{path}: no such file; expected a .ply file")
    with path.open("rb") as file:
        lines = _header_lines(file, path)
        offset = file.tell()
    byte_order = None
    elements: list[PlyElement] = []
    comments: list[str] = []
    for number, line in enumerate(lines, start=2):
        words = line.split()
        if not words:
            continue
        if words[0] in ("comment", "obj_info"):
            comments.append(line.partition(" ")[2].strip())
        elif words[0] == "format" and len(words) == 3 and words[1] in _BYTE_ORDERS:
            byte_order = _BYTE_ORDERS[words[1]]
        elif words[0] == "element":
            digits = words[2] if len(words) == 3 else ""
            if not (digits.isascii() and digits.isdigit() and len(digits) <= _MAX_COUNT_DIGITS):
                raise _bad_line(path, number, " ".join(words))
            elements.append(PlyElement(words[1], int(digits), ()))
        elif words[0] == "property" and elements:
            elements[-1] = _add_property(elements[-1], words, path, number)
        else:
            raise _bad_line(path, number, line)
    if byte_order is None:
        raise SceneError(
            f"{path}: the .ply header names no format; expected a line 'format X 1.0' with X "
            "one of " + ", ".join(_BYTE_ORDERS)
        )
    return PlyHeader(path, byte_order, tuple(elements), tuple(comments), offset)


def count_surplus_bytes(header: PlyHeader) -> int:
    """Bytes after the last row announced; 0 where that cannot be known (ascii, lists)."""
    if header.byte_order == "ascii" or any(e.list_columns for e in header.elements):
        return 0
    body = sum(e.count * e.row_dtype(header.byte_order).itemsize for e in header.elements)
    return max(0, header.path.stat().st_size - header.body_offset - body)


def iterate_rows(header: PlyHeader, name: str) -> Iterator[np.ndarray]:
    """Structured arrays of at most ROWS_PER_CHUNK rows of one element, in order. Ascii values
    arrive as float64, binary ones in the file's own types.
    """
    position = [e.name for e in header.elements].index(header.element(name).name)
    before, element = header.elements[:position], header.elements[position]
    for other in (*before, element):
        if other.list_columns and (other is element or header.byte_order != "ascii"):
            raise SceneError(
                f"{header.path}: cannot read element {name!r}: element {other.name!r} has list "
                f"properties ({', '.join(other.list_columns)}), so its rows have no fixed size; "
                f"re-save the file with {name!r} first and without lists"
            )
    if header.byte_order == "ascii":
        yield from _ascii_rows(header, element, skip=sum(e.count for e in before))
    else:
        skip = sum(e.count * e.row_dtype(header.byte_order).itemsize for e in before)
        yield from _binary_rows(header, element, header.body_offset + skip)


def _header_lines(file: BinaryIO, path: Path) -> list[str]:
    if file.readline(8).rstrip(b"\r\n") != b"ply":
        raise SceneError(f"{path}: not a .ply file: expected 'ply' as its first line")
    lines: list[str] = []
    while file.tell() < _MAX_HEADER_BYTES:
        raw = file.readline(_MAX_HEADER_BYTES)
        if not raw.endswith(b"\n"):
            break
        line = raw.decode("utf-8", errors="replace").strip()
        if line == "end_header":
            return lines
        lines.append(line)
    raise SceneError(
        f"{path}: the .ply header has no 'end_header' line in its first "
        f"{min(file.tell(), _MAX_HEADER_BYTES)} bytes; the file is truncated or not a .ply"
    )


def _bad_line(path: Path, number: int, line: str) -> SceneError:
    return SceneError(
        f"{path}: line {number} of the .ply header cannot be used: {line[:80]!r}; expected "
        "'element NAME COUNT' and 'property TYPE NAME' lines"
    )


def _add_property(element: PlyElement, words: list[str], path: Path, number: int) -> PlyElement:
    line = " ".join(words)
    name = words[-1]
    if name in element.names or name in element.list_columns:
        raise SceneError(
            f"{path}: line {number} of the .ply header repeats the property {name!r} of element "
            f"{element.name!r}"
        )
    if len(words) == 3 and words[1] in _TYPES:
        return replace(element, columns=(*element.columns, (name, _TYPES[words[1]])))
    if len(words) == 5 and words[1] == "list" and words[2] in _TYPES and words[3] in _TYPES:
        return replace(element, list_columns=(*element.list_columns, name))
    raise _bad_line(path, number, line)


def _binary_rows(header: PlyHeader, element: PlyElement, offset: int) -> Iterator[np.ndarray]:
    dtype = element.row_dtype(header.byte_order)
    available = os.stat(header.path).st_size - offset
    if element.count * dtype.itemsize > available:
        raise SceneError(
            f"{header.path}: the header announces {element.count} rows of {element.name!r} "
            f"({dtype.itemsize} bytes each), but the file ends after "
            f"{max(0, available) // max(1, dtype.itemsize)} of them; it is truncated or its header "
            "is wrong: copy or export it again"
        )
    with header.path.open("rb") as file:
        file.seek(offset)
        for start in range(0, element.count, ROWS_PER_CHUNK):
            count = min(ROWS_PER_CHUNK, element.count - start)
            rows = np.fromfile(file, dtype=dtype, count=count)
            if len(rows) < count:
                raise SceneError(f"{header.path}: the file became shorter while it was read")
            yield rows


def _ascii_rows(header: PlyHeader, element: PlyElement, skip: int) -> Iterator[np.ndarray]:
    dtype = np.dtype([(name, "f8") for name in element.names])
    width = len(element.columns)
    available = header.path.stat().st_size - header.body_offset
    if element.count * 2 * width > available + 1:  # a digit and a separator a value, at the least
        raise SceneError(
            f"{header.path}: the header announces {element.count} rows of {width} values in "
            f"{element.name!r}, more than the file's {available} bytes can hold; it is truncated "
            "or its header is wrong: copy or export it again"
        )
    with header.path.open("rb") as file:
        file.seek(header.body_offset)
        for _ in islice(file, skip):
            pass
        for start in range(0, element.count, ROWS_PER_CHUNK):
            count = min(ROWS_PER_CHUNK, element.count - start)
            words = [line.split() for line in islice(file, count)]
            for number, row in enumerate(words, start=start):
                if len(row) != width:
                    raise SceneError(
                        f"{header.path}: row {number} of {element.name!r} must have {width} values "
                        f"(one per property); got {len(row)}"
                    )
            if len(words) < count:
                raise SceneError(
                    f"{header.path}: the header announces {element.count} rows of "
                    f"{element.name!r}, but the file ends after {start + len(words)} of them"
                )
            yield _parse_numbers(words, dtype, header.path, element.name, start)


def _parse_numbers(
    words: list[list[bytes]], dtype: np.dtype, path: Path, name: str, start: int
) -> np.ndarray:
    try:
        values = np.array(words, dtype="S").astype(np.float64)
    except ValueError as error:
        raise SceneError(
            f"{path}: rows {start} to {start + len(words) - 1} of {name!r} hold a value that is "
            f"not a number ({error})"
        ) from error
    return values.view(dtype).reshape(len(words))


# ---- Columns of the INRIA splat .ply: which there must be, and how they map to Gaussians ---------
# Scales are logs, opacities logits, quaternions of any length; f_rest is channel-major (all of
# red's coefficients, then green's, then blue's). Values here are as in the file: `_activate` and
# `rows_of_gaussians` change them on reading and writing.

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
    """The columns of Gaussians as they stand in the file, gathered into contiguous arrays. means
    [N, 3] (float64 where the file is wider than float32), quats [N, 4], scales [N, 3] (log),
    opacities [N] (logit), sh [N, K, 3], and semantic_class [N] where the file has it.
    """
    sh_count = _check_columns(header, table)
    mean_type = np.float64 if has_wide_means(header, table) else np.float32
    pieces = iterate_rows(header, table.name)
    first = next(pieces, None)  # only now is the file known to be as long as its header says
    target = _allocate(table, sh_count, mean_type)
    done = 0
    for rows in () if first is None else itertools.chain([first], pieces):
        _scatter_columns(rows, target, slice(done, done + len(rows)))
        done += len(rows)
    return target


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
    columns = {axis: part.means[:, i] for i, axis in enumerate("xyz")}
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
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (sh_count, 3)}
    types = {"means": mean_type}
    if SEMANTIC in table.names:
        shapes[SEMANTIC], types[SEMANTIC] = (), np.int16
    return {n: np.empty((table.count, *s), types.get(n, np.float32)) for n, s in shapes.items()}


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


# ---- Gaussians in plain files: INRIA .ply (SH degree 0 to 3) and .splat (32-byte records) --------

RECENTRE_BEYOND_M = 1000.0  # float32 keeps 0.06 mm at 1 km; 0.25 m at UTM's 4000 km
_SPLAT_RECORD = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)]
)
_PLY_NAMES = {"<f4": "float", "<i2": "short"}

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SplatFile:
    """What a splat file held. gaussians: in the file's axes and unit. origin: float64 [3], what was
    subtracted from its coordinates (not zero only for double-precision .ply far from the origin).
    notes: the `key: value` comments of a .ply. problems: what was left out, a sentence each.
    """

    gaussians: Gaussians
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    notes: Mapping[str, str] = field(default_factory=dict)
    problems: tuple[str, ...] = ()


def read_splats(path: str | Path) -> SplatFile:
    """Read a .ply or .splat file, told apart by its first bytes. Raises SceneError: no such file,
    an unknown format, or damaged content; says what was expected.
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
    """Read Gaussians from one element of a .ply, binary of either byte order or ascii. Properties
    may stand in any order; unknown ones are ignored. `red green blue` (uint8) serve as colour where
    f_dc is missing. Reads in pieces: peak memory is the Gaussians plus a few MB. Raises SceneError:
    not a splat .ply (lists what is missing), truncated, empty, wrong f_rest count.
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
    """Read a .splat file: colour without view dependence (SH degree 0), linear scales."""
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
    """Write an INRIA .ply (binary little endian), atomically. notes: written as `comment key:
    value` lines and given back by `read_ply`. A `semantic_class` column is added where the
    Gaussians have classes; other readers ignore it.
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
    """Write a .splat file, atomically. The format keeps 8 bits of colour, opacity and rotation. SH
    bands above degree 0 cannot be kept; that they are dropped is logged as a warning.
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
