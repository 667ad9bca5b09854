"""Gaussians in plain files: INRIA's .ply (SH degree 0 to 3) and .splat (32-byte records).

A header is not trusted: counts are compared with the size of the file before anything is allocated,
so a damaged or hostile file costs a message and no memory.
"""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.errors import SceneError
from augment.jobs.atomic import replaced_file
from augment.render.sh import SH_C0
from augment.scene import SH_COUNTS, Gaussians, check_gaussians

# ---- The container: a header, and tables of rows that are read in pieces -------------------------

ROWS_PER_CHUNK = 16384  # about 4 MB of degree-3 rows: columns are picked out while in the cache
_MAX_HEADER_BYTES = 1 << 20
_MAX_LINE_BYTES = 1 << 16  # of a row of text
_COUNT = re.compile(r"[0-9]{1,18}")  # more than any file holds, few enough for int64
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "ascii"}
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class PlyElement:
    """One table of the file. columns: numpy type codes without byte order, by name in the file's
    order. lists: names of properties whose length varies by row; such rows have no fixed size.
    """

    name: str
    count: int
    columns: dict[str, str] = field(default_factory=dict)
    lists: list[str] = field(default_factory=list)


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

    def row_dtype(self, element: PlyElement) -> np.dtype:
        """Of the rows that `iterate_rows` gives."""
        if self.byte_order == "ascii":
            return np.dtype([(name, "f8") for name in element.columns])
        return np.dtype([(name, self.byte_order + code) for name, code in element.columns.items()])

    def size_of(self, elements: tuple[PlyElement, ...]) -> int:
        """Bytes of binary tables without lists."""
        return sum(element.count * self.row_dtype(element).itemsize for element in elements)

    def surplus_problems(self) -> tuple[str, ...]:
        """A sentence where bytes follow the last row announced; in ascii, or after lists, that
        cannot be known.
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
    byte_order, elements, comments = None, [], []
    for number, line in enumerate(lines, start=2):
        match line.split():
            case []:
                pass
            case ["comment" | "obj_info", *_]:
                comments.append(line.partition(" ")[2].strip())
            case ["format", kind, _] if kind in _BYTE_ORDERS:
                byte_order = _BYTE_ORDERS[kind]
            case ["element", name, count] if _COUNT.fullmatch(count):
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
    types = words[1:] if len(words) == 3 and words[0] == "list" else words
    return len(types) in (1, 2) and len(words) != 2 and all(word in _TYPES for word in types)


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


def iterate_rows(header: PlyHeader, name: str) -> Iterator[np.ndarray]:
    """Structured arrays of at most ROWS_PER_CHUNK rows of one element, in order. Ascii values
    arrive as float64, binary ones in the file's own types.
    """
    element = header.element(name)
    before = header.elements[: header.elements.index(element)]
    is_ascii = header.byte_order == "ascii"
    for other in (*before, element):
        if other.lists and (other is element or not is_ascii):
            raise SceneError(
                f"{header.path}: cannot read element {name!r}: element {other.name!r} has list "
                f"properties ({', '.join(other.lists)}), so its rows have no fixed size; "
                f"re-save the file with {name!r} first and without lists"
            )
    if not element.columns:
        return
    dtype, width = header.row_dtype(element), len(element.columns)
    skipped = 0 if is_ascii else header.size_of(before)
    available = header.path.stat().st_size - header.body_offset - skipped
    # Of text, a digit and a separator a value are the least.
    row_bytes, there = (2 * width, available + 1) if is_ascii else (dtype.itemsize, available)
    if element.count * row_bytes > there:
        raise SceneError(
            f"{header.path}: the header announces {element.count} rows of {name!r}, at least "
            f"{row_bytes} bytes each, but the file ends after {max(0, there) // row_bytes} of "
            "them; it is truncated or its header is wrong: copy or export it again"
        )
    with header.path.open("rb") as file:
        file.seek(header.body_offset + skipped)
        if is_ascii:
            for _ in itertools.islice(file, sum(other.count for other in before)):
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
    """The rows of `count` lines of text, fewer at the file's end. start: number of the first."""
    lines = [line for _ in range(count) if (line := file.readline(_MAX_LINE_BYTES))]
    width = len(dtype.names or ())
    for number, line in enumerate(lines, start):
        found = len(line.split(None, width))
        if found != width or len(line) == _MAX_LINE_BYTES:
            got = "more" if found > width else found
            raise SceneError(
                f"{where}, row {number} must have {width} values (one per property); got {got}"
            )
    try:
        values = np.loadtxt(lines, np.float64, comments=None, ndmin=2) if lines else np.empty(0)
    except ValueError as error:
        rows = f"rows {start} to {start + len(lines) - 1}"
        raise SceneError(f"{where}, {rows}: a value is not a number ({error})") from error
    return values.reshape(-1).view(dtype)


# ---- Columns of the splat .ply: which there must be, and how they map to Gaussians ---------------
# Scales are logs, opacities logits, quaternions of any length. f_dc may hold more than one term a
# channel, as Street Gaussians' actors have; f_dc and f_rest are channel-major (all of red's, then
# green's, then blue's).

SEMANTIC = "semantic_class"
_GEOMETRY = ("x", "y", "z", "opacity", *(f"scale_{i}" for i in range(3)),
             *(f"rot_{i}" for i in range(4)))  # fmt: skip
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_RGB = {"f_dc_0": "red", "f_dc_1": "green", "f_dc_2": "blue"}
# Beyond these the float32 sigmoid is 0 or 1; a finite logit keeps other readers' sums finite.
_LOGIT_MIN, _LOGIT_MAX = -110.0, 40.0


def read_columns(
    header: PlyHeader, table: PlyElement, *, has_terms: bool = False
) -> dict[str, np.ndarray]:
    """The columns of Gaussians as they stand in the file, gathered into contiguous arrays. means
    [N, 3] (float64 where the file is wider than float32), quats [N, 4], scales [N, 3] (log),
    opacities [N] (logit), sh [N, K, 3], semantic_class [N] where the file has it, and where
    has_terms says that f_dc may hold them, terms [N, F - 1, 3] beyond the first.
    """
    terms, bands = _check_columns(header, table, has_terms=has_terms)
    pieces = iterate_rows(header, table.name)
    first = next(pieces, None)  # only now is the file known to be as long as its header says
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (1 + bands, 3)}
    types: dict[str, type] = {"means": np.float64 if _has_wide_means(header, table) else np.float32}
    if has_terms:
        shapes["terms"] = (terms - 1, 3)
    if SEMANTIC in table.columns:
        shapes[SEMANTIC], types[SEMANTIC] = (), np.int16
    arrays = {n: np.empty((table.count, *s), types.get(n, np.float32)) for n, s in shapes.items()}
    places, done = _columns_of(arrays), 0
    for rows in () if first is None else itertools.chain([first], pieces):
        with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 are infinite
            for name, place in places.items():
                if name in table.columns:
                    values = rows[name]
                else:
                    values = (rows[_RGB[name]] / 255.0 - 0.5) / SH_C0
                place[done : done + len(rows)] = values
        done += len(rows)
    return arrays


def _columns_of(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Views of the arrays of `read_columns`, by the file's columns in INRIA's order."""
    sh, terms = arrays["sh"], arrays.get("terms", np.empty((len(arrays["sh"]), 0, 3)))
    columns = {axis: arrays["means"][:, i] for i, axis in enumerate("xyz")}
    dc, bands = 1 + terms.shape[1], sh.shape[1] - 1
    for number in range(3 * dc):
        channel, term = divmod(number, dc)
        columns[f"f_dc_{number}"] = terms[:, term - 1, channel] if term else sh[:, 0, channel]
    for number in range(3 * bands):
        columns[f"f_rest_{number}"] = sh[:, 1 + number % bands, number // bands]
    columns["opacity"] = arrays["opacities"]
    columns |= {f"scale_{i}": arrays["scales"][:, i] for i in range(3)}
    columns |= {f"rot_{i}": arrays["quats"][:, i] for i in range(4)}
    return columns | ({SEMANTIC: arrays[SEMANTIC]} if SEMANTIC in arrays else {})


def _check_columns(header: PlyHeader, table: PlyElement, *, has_terms: bool) -> tuple[int, int]:
    """Colour terms and SH bands a channel, once the columns are known to be those of Gaussians."""
    where, names = f"{header.path}, {table.name}", set(table.columns)
    missing = [name for name in _GEOMETRY if name not in names]
    if has_terms or not names.issuperset(_RGB.values()):
        missing += [name for name in _DC[: 1 if has_terms else 3] if name not in names]
    if missing:
        raise SceneError(
            f"{header.path}: not a Gaussian splat .ply: its element {table.name!r} misses "
            f"{', '.join(missing)}; it has {', '.join(table.columns) or 'no properties'}. "
            + _guess_content(header, names)
        )
    counts = {}
    for prefix in ("f_dc_", "f_rest_"):
        found = [name for name in table.columns if name.startswith(prefix)]
        counts[prefix] = len(found) // 3
        is_read = has_terms or prefix == "f_rest_"
        are_all = set(found) == {f"{prefix}{i}" for i in range(len(found))}
        if is_read and (len(found) % 3 or not are_all):
            raise SceneError(
                f"{where}: {prefix}0, {prefix}1, … must be a multiple of 3 in number (a channel's "
                f"values after the other's) and numbered without gaps; got {len(found)}"
            )
    if 1 + counts["f_rest_"] not in SH_COUNTS:
        raise SceneError(
            f"{where}: f_rest_0, f_rest_1, … must be {tuple(3 * (k - 1) for k in SH_COUNTS)} in "
            f"number (SH degrees 0 to 3); got {3 * counts['f_rest_']}"
        )
    return counts["f_dc_"], counts["f_rest_"]


def _has_wide_means(header: PlyHeader, table: PlyElement) -> bool:
    """Whether coordinates come with more digits than float32 holds."""
    wide = ("f8", "i4", "u4")
    return header.byte_order == "ascii" or any(table.columns[axis] in wide for axis in "xyz")


def _guess_content(header: PlyHeader, names: set[str]) -> str:
    if "packed_position" in names:
        return "This is SuperSplat's compressed layout: export it as uncompressed .ply."
    if any(e.name in ("face", "tristrips") for e in header.elements):
        return "This is a mesh; a trained 3D Gaussian splat is needed."
    if "scale_0" in names and "scale_2" not in names:
        return "These are 2D Gaussians (two scales), which are not supported."
    return "This is a point cloud; a trained 3D Gaussian splat is needed."


# ---- Files ---------------------------------------------------------------------------------------

_USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
SPLAT_SUFFIXES = (".ply", ".splat", ".spz", ".sog", ".glb", ".gltf", *_USD_SUFFIXES)
RECENTRE_BEYOND_M = 1000.0  # float32 keeps 0.06 mm at 1 km; 0.25 m at UTM's 4000 km
_FAR_M = 1e15  # beyond, float64 has no decimetres
_SPLAT_RECORD = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)]
)

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


def read_splats(
    path: str | Path, *, activated: bool | None = None, level: int | None = None
) -> SplatFile:
    """Read a .ply, .splat, .spz, .sog, glTF or USD file, told apart by its first bytes, the
    meta.json of a SOG folder, or the lod-meta.json of a streamed one.

    Args:
        path: the file.
        activated: of a .ply alone, as of `read_ply`.
        level: of a lod-meta.json alone, the level of detail; 0, the finest, by default.

    Raises:
        SceneError: no such file, an unknown format, damaged content, or Gaussians that need more
            memory than there is; says what was expected.
    """
    path = Path(path)
    try:
        return _reader_of(path, activated, level)(path)
    except MemoryError as error:
        raise SceneError(f"{path}: its Gaussians need more memory than there is: {error}") from None


def _reader_of(
    path: Path, activated: bool | None, level: int | None
) -> Callable[[Path], SplatFile]:
    from augment.files.gltf import GLB, read_gltf  # which take this module's records
    from augment.files.sog import META, ZIP, read_sog
    from augment.files.spz import GZIP, read_spz, refuse_bare_spz
    from augment.files.streamed_sog import LOD_META, read_streamed_sog
    from augment.files.usd import read_usd

    if not path.is_file():
        raise SceneError(f"{path}: no such file; expected a .ply, .splat, .spz, .sog, .glb or .usd")
    with path.open("rb") as file:
        start = file.read(8)
    if level is not None and path.name != LOD_META:
        raise SceneError(f"{path} has no levels of detail, as a {LOD_META} has; leave lod out")
    if start[:3] == b"ply" and start[3:4] in (b"\n", b"\r"):
        return partial(read_ply, activated=activated)
    if activated is not None:
        raise SceneError(
            f"{path}: only a .ply may store values before or after their activation; leave "
            f"activated out"
        )
    if path.name == LOD_META:
        return partial(read_streamed_sog, level=level or 0)
    if start[:2] == GZIP:
        return read_spz
    if path.suffix.lower() in _USD_SUFFIXES:  # before ZIP, which a .usdz is too
        return read_usd
    if start[:4] == ZIP or path.name == META:
        return read_sog
    if start[:4] == GLB or path.suffix.lower() == ".gltf":
        return read_gltf
    refuse_bare_spz(path, start)
    if path.suffix.lower() == ".splat":
        return read_splat
    raise SceneError(
        f"{path}: neither a .ply (its first line would be 'ply') nor a .spz, .sog or .glb, nor "
        "named .splat, .gltf or .usd; convert other splat formats (.ksplat) to .ply first, for "
        "example with SuperSplat"
    )


def read_ply(
    path: str | Path, element: str = "vertex", *, activated: bool | None = None
) -> SplatFile:
    """Read Gaussians from one element of a .ply, binary of either byte order or ascii. Properties
    may stand in any order; unknown ones are ignored. `red green blue` (uint8) serve as colour where
    f_dc is missing. Reads in pieces: peak memory is the Gaussians plus a few MB.

    Args:
        path: the file.
        element: the name of the table of Gaussians.
        activated: True where the file stores opacities from 0 to 1 and scales as lengths, False
            where it stores logits and logarithms, as trainers do. None: the latter, unless the
            numbers look like the former.

    Raises:
        SceneError: not a splat .ply (lists what is missing), truncated, empty, wrong f_rest count,
            or values that look activated while nobody says whether they are.
    """
    header = read_ply_header(path)
    table = header.element(element)
    columns = read_columns(header, table)
    if table.count == 0:
        raise SceneError(f"{header.path}: its {element!r} element has 0 rows; nothing to render")
    means, origin = columns["means"], np.zeros(3)
    if means.dtype == np.float64:
        origin = recentring_origin(means)
        with np.errstate(over="ignore"):  # what overflows is left out as infinite, and reported
            means = (means - origin).astype(np.float32)
    scales, opacities = torch.from_numpy(columns["scales"]), torch.from_numpy(columns["opacities"])
    if activated is None and _looks_activated(scales, opacities):
        raise SceneError(
            f"{header.path}: all its opacities lie from {float(opacities.min()):.3g} to "
            f"{float(opacities.max()):.3g} and all its scales are positive, from "
            f"{float(scales.min()):.3g} to {float(scales.max()):.3g}, as in files that store them "
            f"activated; trainers store logits and logarithms. Say which: ?activated=true takes "
            f"them as they stand, ?activated=false as logits and logarithms"
        )
    if not activated:
        scales, opacities = scales.exp_(), opacities.sigmoid_()
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
    pairs = (comment.partition(":") for comment in header.comments)
    notes = {key.strip(): value.strip() for key, colon, value in pairs if colon}
    return SplatFile(gaussians, origin, notes, (*problems, *header.surplus_problems()))


def _looks_activated(scales: Tensor, opacities: Tensor) -> bool:
    """Whether every opacity is a fraction and every scale a length. Logits of trained scenes reach
    from below 0 to above 1, and logarithms of scales are negative below one unit.
    """
    is_fraction = bool(((opacities >= 0) & (opacities <= 1)).all())
    return is_fraction and bool((scales > 0).all())


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
    """Write an INRIA .ply (binary little endian), atomically; normals are 0. notes: written as
    `comment key: value` lines and given back by `read_ply`. A `semantic_class` column is added
    where the Gaussians have classes; other readers ignore it.
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
    with replaced_file(Path(path)) as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode())
        for start in range(0, len(gaussians), ROWS_PER_CHUNK):
            stop = min(start + ROWS_PER_CHUNK, len(gaussians))
            rows = np.zeros(stop - start, dtype)
            for name, values in _file_columns(gaussians.select(torch.arange(start, stop))).items():
                rows[name] = values
            file.write(rows.tobytes())


def _file_columns(part: Gaussians) -> dict[str, np.ndarray]:
    """Columns of Gaussians by the names of a .ply, activations inverted."""
    opacities = part.opacities.double()
    logits = (opacities.log() - torch.log1p(-opacities)).clamp(_LOGIT_MIN, _LOGIT_MAX)
    tensors = {"means": part.means, "quats": part.quats, "sh": part.sh, "opacities": logits}
    tensors["scales"] = part.scales.double().log()
    if part.semantic is not None:
        tensors[SEMANTIC] = part.semantic
    return _columns_of({name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()})


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
    """Whole-metre origin to subtract from coordinates, float64 [3]: the median of the points within
    _FAR_M where it lies more than RECENTRE_BEYOND_M from zero, else zero.
    """
    finite = points[(np.abs(points) < _FAR_M).all(1)]  # which NaN is not either
    if len(finite) == 0:
        return np.zeros(3)
    median = np.median(finite, axis=0).astype(np.float64)
    return np.round(median) if np.linalg.norm(median) > RECENTRE_BEYOND_M else np.zeros(3)


def join_placed(
    parts: Sequence[tuple[np.ndarray, Gaussians]],
    path: Path,
    notes: Mapping[str, str],
    problems: Sequence[str],
) -> SplatFile:
    """What a file of several parts holds. parts: of each the places of its Gaussians in the file's
    axes, float64 [N, 3], and all else of them; their own means do not count. Raises SceneError: no
    Gaussian can be drawn.
    """
    means = np.concatenate([places for places, _ in parts])
    origin = recentring_origin(means)
    bands = max(part.sh.shape[1] for _, part in parts)
    sh = [torch.nn.functional.pad(p.sh, (0, 0, 0, bands - p.sh.shape[1])) for _, p in parts]
    with np.errstate(over="ignore"):  # what overflows is left out as infinite, and reported
        near = (means - origin).astype(np.float32)
    raw = Gaussians(
        means=torch.from_numpy(near),
        quats=torch.cat([part.quats for _, part in parts]),
        scales=torch.cat([part.scales for _, part in parts]),
        opacities=torch.cat([part.opacities for _, part in parts]),
        sh=torch.cat(sh),
    )
    gaussians, left_out = check_gaussians(raw, where=str(path))
    return SplatFile(gaussians, origin, notes, (*problems, *left_out))
