"""Reads and writes Gaussians in INRIA's .ply files (SH degree 0 to 3).

A header is not trusted: counts are compared with the size of the file before anything is allocated,
so a damaged or hostile file costs a message and no memory.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from augment.errors import SceneError
from augment.files.splat_format import (
    FileFacts,
    SplatFile,
    SplatFormat,
    SplatWriter,
    recentring_origin,
    writer_in,
)
from augment.output.atomic import write_file_atomically
from augment.render.sh import SH_C0
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians, check_gaussians

# ---- The container: a header, and tables of rows that are read in pieces -------------------------

ROWS_PER_CHUNK = 16384  # rows read together: about 4 MB at degree 3, so columns stay in the cache
_MAX_HEADER_BYTES = 1 << 20  # bytes of a header
_MAX_LINE_BYTES = 1 << 16  # bytes of a row of text
# The text of a count: more digits than any file needs, few enough for int64.
_COUNT_PATTERN = re.compile(r"[0-9]{1,18}")
# numpy's characters of the byte orders, and "ascii".
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "ascii"}
# numpy's type codes of the property types.
_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}


@dataclass(frozen=True)
class PlyElement:
    """One table of the file."""

    name: str
    count: int  # rows
    # numpy's type codes, without byte order, by name in the file's order.
    columns: dict[str, str] = field(default_factory=dict)
    # Names of properties whose length varies by row; such rows have no fixed size.
    lists: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class PlyHeader:
    """The header of a .ply file."""

    path: Path
    byte_order: str  # '<', '>' or 'ascii'
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]  # texts of the lines `comment` and `obj_info`
    body_offset: int  # bytes before the first row

    def element(self, name: str) -> PlyElement:
        """Return the element of that name.

        Raises:
            SceneError: there is none; the message lists the others.
        """
        for element in self.elements:
            if element.name == name:
                return element
        names = ", ".join(repr(e.name) for e in self.elements) or "none"
        raise SceneError(f"{self.path}: expected an element {name!r} in the .ply; found {names}")

    @property
    def notes(self) -> dict[str, str]:
        """Return the comments of the form `key: value`."""
        pairs = (comment.partition(":") for comment in self.comments)
        return {key.strip(): value.strip() for key, colon, value in pairs if colon}

    def row_dtype(self, element: PlyElement) -> np.dtype:
        """Return the type of the rows that `iterate_rows` yields."""
        if self.byte_order == "ascii":
            return np.dtype([(name, "f8") for name in element.columns])
        return np.dtype([(name, self.byte_order + code) for name, code in element.columns.items()])

    def size_of(self, elements: tuple[PlyElement, ...]) -> int:
        """Return the bytes of binary tables without lists."""
        return sum(element.count * self.row_dtype(element).itemsize for element in elements)

    def surplus_problems(self) -> tuple[str, ...]:
        """Return a sentence if bytes follow the last announced row.

        In ascii, and after lists, this cannot be known.
        """
        if self.byte_order == "ascii" or any(element.lists for element in self.elements):
            return ()
        end = self.body_offset + self.size_of(self.elements)
        surplus = self.path.stat().st_size - end
        if surplus <= 0:
            return ()
        return (
            f"{self.path}: {surplus} bytes follow the rows its header announces and were ignored",
        )


def read_ply_header(path: str | Path) -> PlyHeader:
    """Read the header of a .ply file."""
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"{path}: no such file; expected a .ply file")
    with path.open("rb") as file:
        lines = _header_lines(file, path)
        offset = file.tell()
    byte_order = None
    elements = []
    comments = []
    for number, line in enumerate(lines, start=2):
        match line.split():
            case []:
                pass
            case ["comment" | "obj_info", *_]:
                comments.append(line.partition(" ")[2].strip())
            case ["format", kind, _] if kind in _BYTE_ORDERS:
                byte_order = _BYTE_ORDERS[kind]
            case ["element", name, count] if _COUNT_PATTERN.fullmatch(count):
                elements.append(PlyElement(name, int(count)))
            case ["property", *kind, name] if elements and _is_type(kind):
                last = elements[-1]
                if name in last.columns or name in last.lists:
                    raise SceneError(
                        f"{path}: line {number} of the .ply header repeats the property {name!r} "
                        f"of element {last.name!r}"
                    )
                if len(kind) == 1:
                    last.columns[name] = _TYPES[kind[0]]
                else:
                    last.lists.append(name)
            case _:
                raise SceneError(
                    f"{path}: line {number} of the .ply header cannot be used: {line[:80]!r}; "
                    "expected 'element NAME COUNT' and 'property TYPE NAME' lines"
                )
    if byte_order is None:
        raise SceneError(
            f"{path}: the .ply header names no format; expected a line 'format X 1.0' with X "
            "one of " + ", ".join(_BYTE_ORDERS)
        )
    return PlyHeader(path, byte_order, tuple(elements), tuple(comments), offset)


def _is_type(words: list[str]) -> bool:
    """Return True for the words of a scalar or list type."""
    types = words[1:] if len(words) == 3 and words[0] == "list" else words
    return len(types) in (1, 2) and len(words) != 2 and all(word in _TYPES for word in types)


def _header_lines(file: BinaryIO, path: Path) -> list[str]:
    """Read the lines between `ply` and `end_header`."""
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


def iterate_rows(header: PlyHeader, name: str) -> Iterator[np.ndarray]:
    """Yield the rows of one element in order, as structured arrays of at most ROWS_PER_CHUNK rows.

    Values of ascii files are float64, values of binary files have the file's own types.
    """
    element = header.element(name)
    earlier_elements = header.elements[: header.elements.index(element)]
    is_ascii = header.byte_order == "ascii"
    for other in (*earlier_elements, element):
        if other.lists and (other is element or not is_ascii):
            raise SceneError(
                f"{header.path}: cannot read element {name!r}: element {other.name!r} has list "
                f"properties ({', '.join(other.lists)}), so its rows have no fixed size; "
                f"re-save the file with {name!r} first and without lists"
            )
    if not element.columns:
        return
    dtype = header.row_dtype(element)
    width = len(element.columns)
    num_skipped_bytes = 0 if is_ascii else header.size_of(earlier_elements)
    body_bytes = header.path.stat().st_size - header.body_offset - num_skipped_bytes
    # A value in text takes at least two bytes: a digit and a separator.
    row_bytes, available_bytes = (
        (2 * width, body_bytes + 1) if is_ascii else (dtype.itemsize, body_bytes)
    )
    if element.count * row_bytes > available_bytes:
        raise SceneError(
            f"{header.path}: the header announces {element.count} rows of {name!r}, at least "
            f"{row_bytes} bytes each, but the file ends after "
            f"{max(0, available_bytes) // row_bytes} of "
            "them; it is truncated or its header is wrong: copy or export it again"
        )
    with header.path.open("rb") as file:
        file.seek(header.body_offset + num_skipped_bytes)
        if is_ascii:
            for _ in itertools.islice(file, sum(other.count for other in earlier_elements)):
                pass
        for start in range(0, element.count, ROWS_PER_CHUNK):
            count = min(ROWS_PER_CHUNK, element.count - start)
            if is_ascii:
                rows = _parse_rows(file, count, dtype, f"{header.path}: {name!r}", start)
            else:
                rows = np.fromfile(file, dtype=dtype, count=count)
            if len(rows) < count:
                raise SceneError(
                    f"{header.path}: the header announces {element.count} rows of {name!r}, but "
                    f"the file ends after {start + len(rows)} of them"
                )
            yield rows


def _parse_rows(file: BinaryIO, count: int, dtype: np.dtype, where: str, start: int) -> np.ndarray:
    """Parse `count` lines of text, or fewer at the file's end.

    Args:
        file: the file, at the first line.
        count: how many lines to read.
        dtype: the type of a row.
        where: file and element, for messages.
        start: number of the first row, for messages.
    """
    lines = [line for _ in range(count) if (line := file.readline(_MAX_LINE_BYTES))]
    width = len(dtype.names or ())
    for number, line in enumerate(lines, start):
        num_values = len(line.split(None, width))
        if num_values != width or len(line) == _MAX_LINE_BYTES:
            num_text = "more" if num_values > width else num_values
            raise SceneError(
                f"{where}, row {number} must have {width} values (one per property); got {num_text}"
            )
    try:
        values = np.loadtxt(lines, np.float64, comments=None, ndmin=2) if lines else np.empty(0)
    except ValueError as error:
        rows = f"rows {start} to {start + len(lines) - 1}"
        raise SceneError(f"{where}, {rows}: a value is not a number ({error})") from error
    return values.reshape(-1).view(dtype)


# ---- Columns of the splat .ply: which are required, and how they map to Gaussians ----------------
# Scales are logarithms, opacities are logits, and quaternions have any length. f_dc may hold more
# than one term a channel, as in Street Gaussians' actors. f_dc and f_rest are channel-major: all
# values of red, then of green, then of blue.

SEMANTIC = "semantic_class"  # the column of semantic classes
_GEOMETRY_COLUMNS = (
    "x",
    "y",
    "z",
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
_DC_COLUMNS = ("f_dc_0", "f_dc_1", "f_dc_2")
# Columns of 8-bit colour that replace f_dc.
_RGB_COLUMNS = {"f_dc_0": "red", "f_dc_1": "green", "f_dc_2": "blue"}
# Beyond these the float32 sigmoid is 0 or 1; a finite logit keeps other readers' sums finite.
_MIN_LOGIT = -110.0
_MAX_LOGIT = 40.0


def read_columns(
    header: PlyHeader, table: PlyElement, *, has_terms: bool = False
) -> dict[str, np.ndarray]:
    """Read the columns of Gaussians as stored, gathered into contiguous arrays.

    Args:
        header: the file's header.
        table: its element of Gaussians.
        has_terms: whether f_dc may hold more than one term a channel.

    Returns:
        means [N, 3] (float64 where the file is wider than float32), quats [N, 4], scales [N, 3]
        (logarithms), opacities [N] (logits), sh [N, K, 3], semantic_class [N] if the file has it,
        and with has_terms the terms [N, F - 1, 3] beyond the first.
    """
    terms, bands = _check_columns(header, table, has_terms=has_terms)
    pieces = iterate_rows(header, table.name)
    first_piece = next(pieces, None)  # checks the file's length before arrays are allocated
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (1 + bands, 3)}
    types: dict[str, type] = {"means": np.float64 if _has_wide_means(header, table) else np.float32}
    if has_terms:
        shapes["terms"] = (terms - 1, 3)
    if SEMANTIC in table.columns:
        shapes[SEMANTIC] = ()
        types[SEMANTIC] = np.int16
    arrays = {n: np.empty((table.count, *s), types.get(n, np.float32)) for n, s in shapes.items()}
    destinations = _columns_of(arrays)
    num_read = 0
    for rows in () if first_piece is None else itertools.chain([first_piece], pieces):
        with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 are infinite
            for name, destination in destinations.items():
                if name in table.columns:
                    values = rows[name]
                else:
                    values = (rows[_RGB_COLUMNS[name]] / 255.0 - 0.5) / SH_C0
                destination[num_read : num_read + len(rows)] = values
        num_read += len(rows)
    return arrays


def _columns_of(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return views of the arrays of `read_columns`, by the file's columns in INRIA's order."""
    sh = arrays["sh"]
    terms = arrays.get("terms", np.empty((len(arrays["sh"]), 0, 3)))
    columns = {axis: arrays["means"][:, i] for i, axis in enumerate("xyz")}
    num_terms = 1 + terms.shape[1]
    bands = sh.shape[1] - 1
    for number in range(3 * num_terms):
        channel, term = divmod(number, num_terms)
        columns[f"f_dc_{number}"] = terms[:, term - 1, channel] if term else sh[:, 0, channel]
    for number in range(3 * bands):
        columns[f"f_rest_{number}"] = sh[:, 1 + number % bands, number // bands]
    columns["opacity"] = arrays["opacities"]
    columns |= {f"scale_{i}": arrays["scales"][:, i] for i in range(3)}
    columns |= {f"rot_{i}": arrays["quats"][:, i] for i in range(4)}
    return columns | ({SEMANTIC: arrays[SEMANTIC]} if SEMANTIC in arrays else {})


def _check_columns(header: PlyHeader, table: PlyElement, *, has_terms: bool) -> tuple[int, int]:
    """Check that the columns are those of Gaussians; return colour terms and SH bands a channel."""
    where = f"{header.path}, {table.name}"
    names = set(table.columns)
    missing_names = [name for name in _GEOMETRY_COLUMNS if name not in names]
    if has_terms or not names.issuperset(_RGB_COLUMNS.values()):
        missing_names += [
            name for name in _DC_COLUMNS[: 1 if has_terms else 3] if name not in names
        ]
    if missing_names:
        raise SceneError(
            f"{header.path}: not a Gaussian splat .ply: its element {table.name!r} misses "
            f"{', '.join(missing_names)}; it has {', '.join(table.columns) or 'no properties'}. "
            + _guess_content(header, names)
        )
    counts = {}
    for prefix in ("f_dc_", "f_rest_"):
        prefix_columns = [name for name in table.columns if name.startswith(prefix)]
        counts[prefix] = len(prefix_columns) // 3
        is_read = has_terms or prefix == "f_rest_"
        is_numbered = set(prefix_columns) == {f"{prefix}{i}" for i in range(len(prefix_columns))}
        if is_read and (len(prefix_columns) % 3 or not is_numbered):
            raise SceneError(
                f"{where}: {prefix}0, {prefix}1, … must be a multiple of 3 in number (a channel's "
                f"values after the other's) and numbered without gaps; got {len(prefix_columns)}"
            )
    if 1 + counts["f_rest_"] not in NUM_SH_BY_DEGREE:
        raise SceneError(
            f"{where}: f_rest_0, f_rest_1, … must "
            f"be {tuple(3 * (k - 1) for k in NUM_SH_BY_DEGREE)} "
            f"in number (SH degrees 0 to 3); got {3 * counts['f_rest_']}"
        )
    return counts["f_dc_"], counts["f_rest_"]


def _has_wide_means(header: PlyHeader, table: PlyElement) -> bool:
    """Return True if coordinates have more digits than float32 holds."""
    wide_types = ("f8", "i4", "u4")
    return header.byte_order == "ascii" or any(table.columns[axis] in wide_types for axis in "xyz")


def _guess_content(header: PlyHeader, names: set[str]) -> str:
    """Return a sentence about a .ply without the columns of Gaussians."""
    if any(e.name in ("face", "tristrips") for e in header.elements):
        return "This is a mesh; a trained 3D Gaussian splat is needed."
    if "scale_0" in names and "scale_2" not in names:
        return "These are 2D Gaussians (two scales), which are not supported."
    return "This is a point cloud; a trained 3D Gaussian splat is needed."


# ---- Files ---------------------------------------------------------------------------------------


def read_ply(
    path: str | Path, element: str = "vertex", *, activated: bool | None = None
) -> SplatFile:
    """Read Gaussians from one element of a .ply, binary of either byte order or ascii.

    Properties may have any order; unknown ones are ignored. `red green blue` (uint8) serve as
    colour where f_dc is missing. The file is read in pieces: peak memory is the Gaussians plus a
    few MB.

    Args:
        path: the file.
        element: the name of the table of Gaussians.
        activated: True where the file stores opacities from 0 to 1 and scales as lengths, False
            where it stores logits and logarithms, as trainers do. None: logits and logarithms,
            unless the numbers look like opacities and lengths; then an error asks which they are.

    Raises:
        SceneError: the file is no splat .ply (the message lists missing columns), is truncated or
            empty, has a wrong count of f_rest, or holds values that look activated while
            `activated` is None.
    """
    header = read_ply_header(path)
    table = header.element(element)
    columns = read_columns(header, table)
    if table.count == 0:
        raise SceneError(f"{header.path}: its {element!r} element has 0 rows; nothing to render")
    means = columns["means"]
    origin = np.zeros(3)
    if means.dtype == np.float64:
        origin = recentring_origin(means)
        with np.errstate(over="ignore"):  # infinite values are left out later, and reported
            means = (means - origin).astype(np.float32)
    scales = torch.from_numpy(columns["scales"])
    opacities = torch.from_numpy(columns["opacities"])
    if activated is None and _looks_activated(scales, opacities):
        raise SceneError(
            f"{header.path}: all its opacities lie from {float(opacities.min()):.3g} to "
            f"{float(opacities.max()):.3g} and all its scales are positive, from "
            f"{float(scales.min()):.3g} to {float(scales.max()):.3g}, as in files that store them "
            f"activated; trainers store logits and logarithms. Say which: ?activated=true takes "
            f"them as they stand, ?activated=false as logits and logarithms"
        )
    if not activated:
        scales = scales.exp_()
        opacities = opacities.sigmoid_()
    semantic = columns.get(SEMANTIC)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(columns["quats"]),
        scales=scales,
        opacities=opacities,
        sh=torch.from_numpy(columns["sh"]),
        semantic=None if semantic is None else torch.from_numpy(semantic),
    )
    gaussians, problems = check_gaussians(gaussians, where=str(header.path))
    return SplatFile(gaussians, origin, header.notes, (*problems, *header.surplus_problems()))


def _looks_activated(scales: Tensor, opacities: Tensor) -> bool:
    """Return True if every opacity is a fraction and every scale a length.

    Logits of trained scenes reach from below 0 to above 1, and logarithms of scales are negative
    below one unit.
    """
    is_fraction = bool(((opacities >= 0) & (opacities <= 1)).all())
    return is_fraction and bool((scales > 0).all())


def write_ply(
    path: str | Path, gaussians: Gaussians, *, notes: Mapping[str, str] | None = None
) -> None:
    """Write an INRIA .ply (binary little endian), atomically; normals are 0.

    A `semantic_class` column is added if the Gaussians have classes; other readers ignore it.

    Args:
        path: the file.
        gaussians: the Gaussians.
        notes: facts that are written as `comment key: value` lines; `read_ply` returns them.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    for key, value in (notes or {}).items():
        if not f"{key}{value}".isprintable() or ":" in key:
            raise ValueError(f"a note must be one printable line, no ':' in its key; got {key!r}")
        lines.append(f"comment {key}: {value}")
    names = list(_file_columns(gaussians.select(torch.arange(0))))
    names[3:3] = ["nx", "ny", "nz"]
    dtype = np.dtype([(name, "<i2" if name == SEMANTIC else "<f4") for name in names])
    lines.append(f"element vertex {len(gaussians)}")
    lines += [f"property {'short' if name == SEMANTIC else 'float'} {name}" for name in names]
    with write_file_atomically(Path(path)) as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode())
        for start in range(0, len(gaussians), ROWS_PER_CHUNK):
            stop = min(start + ROWS_PER_CHUNK, len(gaussians))
            rows = np.zeros(stop - start, dtype)
            for name, values in _file_columns(gaussians.select(torch.arange(start, stop))).items():
                rows[name] = values
            file.write(rows.tobytes())


def _file_columns(part: Gaussians) -> dict[str, np.ndarray]:
    """Return columns of Gaussians by the names of a .ply, activations inverted."""
    opacities = part.opacities.double()
    logits = (opacities.log() - torch.log1p(-opacities)).clamp(_MIN_LOGIT, _MAX_LOGIT)
    tensors = {"means": part.means, "quats": part.quats, "sh": part.sh, "opacities": logits}
    tensors["scales"] = part.scales.double().log()
    if part.semantic is not None:
        tensors[SEMANTIC] = part.semantic
    return _columns_of({name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()})


def describe_ply_header(path: Path) -> FileFacts:
    """Return the facts of a .ply's header."""
    header = read_ply_header(path)
    orders = {"<": "binary, little endian", ">": "binary, big endian", "ascii": "text"}
    warnings = []
    table = next((e for e in header.elements if e.name == "vertex"), PlyElement("", 0))
    wide_axes = [axis for axis in "xyz" if table.columns.get(axis) == "f8"]
    if wide_axes:
        warnings.append(
            f"{', '.join(wide_axes)} are doubles: most viewers read floats only, and take the "
            "columns behind them for others"
        )
    if "red" in table.columns and "f_dc_0" not in table.columns:
        warnings.append("colours are red, green, blue: viewers that look for f_dc show it grey")
    if header.byte_order != "<":
        warnings.append("most viewers read little-endian binary files only")
    notes = header.notes
    return FileFacts(
        version=orders[header.byte_order],
        writer=writer_in(header.comments),
        up=notes.get("up", ""),
        unit=notes.get("unit", ""),
        warnings=tuple(warnings),
    )


PLY = SplatFormat(
    name=".ply",
    describe=describe_ply_header,
    viewer_up="-y",
    reader=read_ply,
    suffixes=(".ply",),
    first_bytes=(b"ply\n", b"ply\r"),
    option="activated",
    writer=SplatWriter(
        kind="ply",
        suffix=".ply",
        write=lambda path, gaussians, facts: write_ply(path, gaussians, notes=facts),
        keeps_world_origin=True,
        keeps_classes=True,
        has_camera_file=True,
    ),
)
