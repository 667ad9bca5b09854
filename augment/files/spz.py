"""Reads Gaussians in .spz files (Niantic, versions 1 to 4), and writes version 3.

A file is a 16-byte header, then column after column: positions as half floats (version 1) or 24-bit
fixed point, opacities, colours, logarithms of scales, rotations (three bytes; from version 3 the
three smallest components in 32 bits), spherical harmonics. Versions 1 to 3 are one gzip stream of
it, or the same bytes unpacked. Version 4 has 32 bytes of header, records of vendors, a table of
sizes, and one zstd stream a column. Axes are RUB: x right, y up, z back. There is no unit.
Source: github.com/nianticlabs/spz, README.md, extensions/README.md and src/cc/load-spz.cc (MIT).

The header says how long the columns are. Deflate shrinks nothing more than 1032 times; zstd has no
such limit, and its table must state the very sizes of the header. A file that announces more than
it can hold, or far more than its bytes (augment.files.limits), is refused before anything is
allocated.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import pyarrow
import torch

from augment.errors import SceneError
from augment.files.limits import check_memory, row_slices
from augment.files.splat_format import (
    ANTIALIASED_WARNING,
    OTHER_COMPONENTS,
    FileFacts,
    Loss,
    SplatFile,
    SplatFormat,
    SplatWriter,
    insert_omitted_component,
    rotate_z_to_y,
)
from augment.output.atomic import write_file_atomically
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians, check_gaussians

UP = "+y"  # the axis that points up, unless the file says otherwise
_GZIP = b"\x1f\x8b"  # first bytes of a gzip stream
_MAGIC = 0x5053474E  # first number of a header
_MARK = _MAGIC.to_bytes(4, "little")  # its bytes
_HEADER = struct.Struct("<IIIBBBB")  # the fields of _Header
_TABLE_OFFSET = struct.Struct("<I12x")  # the rest of a header of version 4: where the table begins
_RECORD = struct.Struct("<II")  # type and bytes of a record of vendors
_SIZES = struct.Struct("<QQ")  # packed and unpacked bytes of a stream, an entry of the table
_AXES_RECORD = 0xADBE0003  # type of Adobe's record of the axes that the file has
_AXES_BYTES = 4  # bytes of the number in that record
# Names of axes by their number in that record; the letters are the directions of x, y and z.
_AXES = (
    *("RUB", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LBD", "RBD", "LBU", "RBU", "LFD", "RFD", "LFU", "RFU"),
)
_MAX_RECORDS_BYTES = 1 << 20  # bytes of all records of vendors
WRITTEN_VERSION = 3  # the version that is written
_ANTIALIASED_FLAG = 0x1  # set if the splats were trained for an antialiasing renderer
_EXTENSIONS_FLAG = 0x2  # set if there are records of vendors
_READ_ERRORS = (OSError, EOFError, zlib.error, struct.error)  # errors of damaged files
_MAX_DEFLATE_RATIO = 1032  # unpacked bytes for one packed byte (zlib's technical details)
_PIECE_BYTES = 1 << 22  # bytes that are unpacked together
_NUM_SH_REST = {
    0: 0,
    1: 3,
    2: 8,
    3: 15,
    4: 24,
}  # coefficients a channel beyond the first, by degree
_COLOUR_SCALE = 0.15  # factor of f_dc, so that colours beyond 0 and 1 can be stored
_MAX_FRACTION_BITS = 12  # a quarter of a millimetre, up to 2 km from the origin
_MAX_FIXED_POINT = (1 << 23) - 1  # the largest fixed-point number
# Steps a unit of a quaternion's smaller components, which lie from 0 to sqrt(1/2).
_STEPS_PER_UNIT = 511 * np.sqrt(2)
# Steps of 8-bit coefficients that the library writes: 5 bits for the first band, 4 for others.
_STEP_OF_BAND_1 = 8
_STEP_OF_OTHER_BANDS = 16


class _Header(NamedTuple):
    """The header of a .spz file."""

    magic: int
    version: int
    num: int  # Gaussians
    degree: int  # of the spherical harmonics
    fraction_bits: int  # of the fixed-point positions
    flags: int  # bits, among them _EXTENSIONS_FLAG
    num_streams: int  # of version 4; reserved before

    @property
    def columns(self) -> dict[str, tuple[str, int]]:
        """Return the type and the width of each column, in the file's order."""
        means_column = ("<f2", 3) if self.version == 1 else ("u1", 9)
        quats_column = ("<u4", 1) if self.version >= 3 else ("u1", 3)
        return {
            "means": means_column,
            "opacities": ("u1", 1),
            "colours": ("u1", 3),
            "scales": ("u1", 3),
            "quats": quats_column,
            "sh": ("u1", 3 * _NUM_SH_REST[self.degree]),
        }


class _Start(NamedTuple):
    """The part of a .spz file before its columns."""

    header: _Header
    up: str  # the axis that points up
    problems: tuple[str, ...]  # one sentence about each thing that is left out
    stream: BinaryIO | gzip.GzipFile  # the file, unpacked up to version 3, behind that part


class SpzContent(NamedTuple):
    """The content of a .spz file."""

    gaussians: Gaussians  # in the file's axes, also those that cannot be rendered
    up: str  # the axis that points up
    problems: tuple[str, ...]  # one sentence about each thing that was left out


def read_spz(path: str | Path) -> SplatFile:
    """Read a .spz file; its note `up` is +y, unless the file states other axes.

    Raises:
        SceneError: the file does not exist, is truncated or damaged, or has an unknown version.
    """
    path = Path(path)
    with path.open("rb") as file:
        content = read_spz_stream(file, path.stat().st_size, str(path))
    gaussians, problems = check_gaussians(content.gaussians, where=str(path))
    problems = (*problems, *content.problems)
    return SplatFile(gaussians, notes={"up": content.up}, problems=problems)


def read_spz_stream(file: BinaryIO, num_bytes: int, where: str) -> SpzContent:
    """Read the content of a .spz file, which may be a part of another file.

    Args:
        file: the bytes, at their start.
        num_bytes: the number of bytes.
        where: the file, for messages.

    Raises:
        SceneError: as `read_spz`.
    """
    try:
        start = _read_start(file, num_bytes, where)
        header = start.header
        if header.version > 3:
            columns = _read_streams(where, file, header, num_bytes)
        else:
            columns = {
                name: _read_column(where, start.stream, header.num, *kind)
                for name, kind in header.columns.items()
            }
    except _READ_ERRORS as error:
        raise SceneError(
            f"{where}: not a whole .spz file ({error}); copy or export it again"
        ) from error
    return SpzContent(_decode_gaussians(header, columns), start.up, start.problems)


def _read_start(file: BinaryIO, num_bytes: int, where: str) -> _Start:
    """Read and check what stands before the columns; arguments as of `read_spz_stream`."""
    mark = file.read(8)
    file.seek(0)
    up = UP
    problems: tuple[str, ...] = ()
    if mark.startswith(_MARK) and int.from_bytes(mark[4:8], "little") > 3:
        stream = file
        header = _check_header(where, stream.read(_HEADER.size), num_bytes)
        up, problems = _read_records(where, file, header)
    else:
        stream = file if mark.startswith(_MARK) else gzip.GzipFile(fileobj=file)
        header = _check_header(where, stream.read(_HEADER.size), num_bytes)
        if header.version > 3:
            raise SceneError(
                f"{where}: a .spz of version {header.version} inside a gzip stream, which only "
                "versions 1 to 3 are; unpack it with gunzip, or export it again"
            )
    if header.degree == 4:
        problems = (*problems, f"{where}: spherical harmonics of degree 4 are cut off at 3")
    return _Start(header, up, problems, stream)


def _read_records(where: str, file: BinaryIO, header: _Header) -> tuple[str, tuple[str, ...]]:
    """Read what stands before the table of version 4; return the up axis, and problems."""
    (table_offset,) = _TABLE_OFFSET.unpack(file.read(_TABLE_OFFSET.size))
    num_bytes = table_offset - _HEADER.size - _TABLE_OFFSET.size
    if not 0 <= num_bytes <= _MAX_RECORDS_BYTES:
        raise SceneError(
            f"{where}: its header is damaged: its table begins at byte {table_offset}; 32 to "
            f"{32 + _MAX_RECORDS_BYTES} are expected"
        )
    records = file.read(num_bytes)
    if not header.flags & _EXTENSIONS_FLAG:
        return UP, ()
    up = UP
    unknown_types = []
    offset = 0
    while offset < len(records):
        kind, size = _RECORD.unpack_from(records, offset)
        payload = records[offset + _RECORD.size : offset + _RECORD.size + size]
        offset += _RECORD.size + size
        if offset > len(records):
            raise SceneError(f"{where}: a record of vendors, {kind:#x}, ends behind all of them")
        if kind == _AXES_RECORD:
            up = _up_of_axes(where, int.from_bytes(payload[:_AXES_BYTES], "little"))
        else:
            unknown_types.append(f"{kind:#x}")
    if not unknown_types:
        return up, ()
    names = ", ".join(unknown_types[:8])
    return up, (f"{where}: left out {len(unknown_types)} records of vendors: {names}",)


def _up_of_axes(where: str, number: int) -> str:
    """Return the axis that points up, by the number of the axes in Adobe's record."""
    if number >= len(_AXES):
        raise SceneError(f"{where}: its axes are number {number}; 0 to {len(_AXES) - 1} are known")
    name = _AXES[number]
    num_opposites = sum(letter in "LDF" for letter in name)
    num_swaps = int(name[1] not in "UD")  # y and z, where z is the one that points up or down
    if (num_opposites + num_swaps) % 2:
        raise SceneError(
            f"{where}: its axes {name} are left-handed, so everything in it is mirrored; save it "
            "with the axes RUB"
        )
    axis = next(i for i, letter in enumerate(name) if letter in "UD")
    return f"{'+' if name[axis] == 'U' else '-'}{'xyz'[axis]}"


def _read_streams(
    where: str, file: BinaryIO, header: _Header, num_bytes: int
) -> dict[str, np.ndarray]:
    """Unpack the columns of version 4, each of which is a zstd stream."""
    columns = header.columns
    sizes = {
        name: header.num * np.dtype(kind).itemsize * width
        for name, (kind, width) in columns.items()
    }
    if header.num_streams != len(sizes) and sizes["sh"] == 0:
        sizes.pop("sh")  # a column without bytes may have no stream
    if header.num_streams != len(sizes):
        raise SceneError(
            f"{where}: its header is damaged: {header.num_streams} streams; {len(sizes)} are "
            f"expected for spherical harmonics of degree {header.degree}"
        )
    table = [_SIZES.unpack(file.read(_SIZES.size)) for _ in sizes]
    num_remaining_bytes = num_bytes - file.tell()
    for (name, size), (packed_size, stated_size) in zip(sizes.items(), table, strict=True):
        num_remaining_bytes -= packed_size
        if stated_size != size or num_remaining_bytes < 0:
            raise SceneError(
                f"{where}: its table states {packed_size} bytes for {name}, {stated_size} "
                f"unpacked; {size} are expected for {header.num} Gaussians, from at most "
                f"{max(0, num_remaining_bytes + packed_size)} bytes: truncated or damaged"
            )
    arrays = {}
    for (name, size), (packed_size, _) in zip(sizes.items(), table, strict=True):
        packed = file.read(packed_size)
        data = pyarrow.decompress(packed, size, codec="zstd") if size else b""
        kind, width = columns[name]
        arrays[name] = np.frombuffer(data, kind).reshape(header.num, width)
    return {name: arrays.get(name, np.empty((header.num, 0), "u1")) for name in columns}


def _decode_gaussians(header: _Header, columns: Mapping[str, np.ndarray]) -> Gaussians:
    """Decode the file's columns piece by piece."""
    count = header.num
    num_rest = min(_NUM_SH_REST[header.degree], NUM_SH_BY_DEGREE[-1] - 1)
    codes = np.arange(256)
    scale_of_code = np.exp(codes / 16.0 - 10).astype(np.float32)
    opacity_of_code = (codes / 255.0).astype(np.float32)
    colour_of_code = ((codes / 255.0 - 0.5) / _COLOUR_SCALE).astype(np.float32)
    means = np.empty((count, 3), np.float32)
    quats = np.empty((count, 4), np.float32)
    scales = np.empty((count, 3), np.float32)
    opacities = np.empty(count, np.float32)
    sh = np.empty((count, 1 + num_rest, 3), np.float32)
    for rows in row_slices(count):
        means[rows] = _decode_means(header, columns["means"][rows])
        quats[rows] = _decode_quats(header, columns["quats"][rows])
        scales[rows] = scale_of_code[columns["scales"][rows]]
        opacities[rows] = opacity_of_code[columns["opacities"][rows, 0]]
        sh[rows, 0] = colour_of_code[columns["colours"][rows]]
        sh_codes = columns["sh"][rows].reshape(rows.stop - rows.start, -1, 3)[:, :num_rest]
        np.subtract(sh_codes, np.float32(128), out=sh[rows, 1:])
        sh[rows, 1:] *= np.float32(1 / 128)
    return Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(scales),
        opacities=torch.from_numpy(opacities),
        sh=torch.from_numpy(sh),
    )


def _check_header(where: str, data: bytes, num_bytes: int) -> _Header:
    """Check the first bytes of a header; return the header.

    Args:
        where: the file, for messages.
        data: the bytes.
        num_bytes: bytes of the file.
    """
    if len(data) < _HEADER.size or not data.startswith(_MARK):
        raise SceneError(f"{where}: not a .spz file: its stream does not begin with 'NGSP'")
    header = _Header(*_HEADER.unpack(data))
    if header.version not in (1, 2, 3, 4):
        raise SceneError(
            f"{where}: version {header.version} of .spz is not read, only 1 to 4; save it as "
            f"version 4, or as .ply"
        )
    if header.degree not in _NUM_SH_REST or header.fraction_bits > 23:
        raise SceneError(
            f"{where}: its header is damaged: spherical harmonics of degree {header.degree} (0 to "
            f"4), {header.fraction_bits} fractional bits (0 to 23)"
        )
    if header.flags & _EXTENSIONS_FLAG and header.version < 4:
        raise SceneError(
            f"{where}: it has vendors' extensions, whose place differs by version; save it without"
        )
    row_bytes = sum(np.dtype(kind).itemsize * width for kind, width in header.columns.values())
    max_bytes = num_bytes * _MAX_DEFLATE_RATIO
    is_too_long = header.num * row_bytes > max_bytes and header.version < 4
    if header.num == 0 or is_too_long:
        raise SceneError(
            f"{where}: its header announces {header.num} Gaussians of {row_bytes} bytes each; the "
            f"file holds 1 to {max_bytes // row_bytes} of them: truncated, or its header is wrong"
        )
    num_sh = 1 + min(_NUM_SH_REST[header.degree], NUM_SH_BY_DEGREE[-1] - 1)
    check_memory(where, header.num, num_sh=num_sh, file_bytes=num_bytes)
    return header


def _read_column(
    where: str, stream: BinaryIO | gzip.GzipFile, count: int, kind: str, width: int
) -> np.ndarray:
    """Read one column, [N, width]."""
    column = np.empty((count, width), kind)
    data = column.reshape(-1).view("u1")
    for start in range(0, len(data), _PIECE_BYTES):
        piece = stream.read(min(_PIECE_BYTES, len(data) - start))
        data[start : start + len(piece)] = np.frombuffer(piece, "u1")
        if len(piece) < min(_PIECE_BYTES, len(data) - start):
            raise SceneError(f"{where}: its columns end early; it is truncated: copy it again")
    return column


def _decode_means(header: _Header, column: np.ndarray) -> np.ndarray:
    """Decode positions, float32 [N, 3]."""
    if header.version == 1:
        return column.astype(np.float32)
    padded = np.zeros((3 * len(column), 4), "u1")
    padded[:, 1:] = column.reshape(-1, 3)
    fixed = padded.view("<i4") >> 8  # the shift repeats the sign
    return fixed.reshape(-1, 3).astype(np.float32) * np.float32(0.5**header.fraction_bits)


def _decode_quats(header: _Header, column: np.ndarray) -> np.ndarray:
    """Decode rotations, float32 [N, 4], wxyz; the file's order is xyzw."""
    if header.version < 3:
        wxyz = np.empty((len(column), 4), np.float32)
        xyz = column / 127.5 - 1
        wxyz[:, 1:] = xyz
        wxyz[:, 0] = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1)))
        return wxyz
    packed = column[:, 0]
    magnitudes = np.arange(512) / _STEPS_PER_UNIT
    value_of_code = np.concatenate([magnitudes, -magnitudes])  # the tenth bit is the sign
    codes = [
        (packed >> np.uint32(shift) & np.uint32(1023)).astype(np.intp) for shift in (20, 10, 0)
    ]
    square_of_code = value_of_code**2
    first_square, second_square, third_square = (square_of_code[code] for code in codes)
    first_square += second_square
    first_square += third_square
    omitted_value = np.sqrt(np.maximum(0, 1 - first_square)).astype(np.float32)
    values = [value_of_code.astype(np.float32)[code] for code in codes]
    omitted_index = (packed >> np.uint32(30)).astype(np.uint8)
    x, y, z, w = insert_omitted_component(values, omitted_index, omitted_value)
    return np.stack([w, x, y, z], axis=1)


def write_spz(path: str | Path, gaussians: Gaussians) -> None:
    """Write a .spz file of version 3, atomically.

    Positions have as many fractional bits as their range leaves: a quarter of a millimetre within
    2 km.

    Args:
        path: the file.
        gaussians: Gaussians whose y axis points up.
    """
    means = gaussians.means.detach().cpu().numpy().astype(np.float64)
    max_coordinate = float(np.abs(means).max(initial=1e-3))
    bits = min(_MAX_FRACTION_BITS, int(np.floor(np.log2(_MAX_FIXED_POINT / max_coordinate))))
    if bits < 0:
        raise SceneError(
            f"{path}: places reach {max_coordinate:.3g} from the origin; .spz ends at 8388607"
        )
    fixed = np.rint(means * (1 << bits)).astype("<i4")
    scales = gaussians.scales.detach().cpu().double().log().numpy()
    sh = gaussians.sh.detach().cpu().numpy().astype(np.float64)
    columns = (
        fixed.reshape(-1, 1).view("u1")[:, :3],
        _round_to_bytes(255 * gaussians.opacities.detach().cpu().numpy()),
        _round_to_bytes(255 * (_COLOUR_SCALE * sh[:, 0] + 0.5)),
        _round_to_bytes(16 * (scales + 10)),
        _encode_quats(gaussians.quats.detach().cpu().double().numpy()),
        _encode_sh(sh[:, 1:]),
    )
    count = len(gaussians)
    degree = gaussians.sh_degree
    header = _HEADER.pack(_MAGIC, WRITTEN_VERSION, count, degree, bits, 0, 0)
    with (
        write_file_atomically(Path(path)) as file,
        gzip.GzipFile("", "wb", 6, file, mtime=0) as stream,
    ):
        stream.write(header)
        for column in columns:
            stream.write(np.ascontiguousarray(column).tobytes())


def _round_to_bytes(values: np.ndarray) -> np.ndarray:
    """Round to bytes."""
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _encode_quats(wxyz: np.ndarray) -> np.ndarray:
    """Encode rotations for version 3."""
    xyzw = wxyz[:, [1, 2, 3, 0]] / np.linalg.norm(wxyz, axis=1, keepdims=True)
    rows = np.arange(len(xyzw))
    largest = np.abs(xyzw).argmax(axis=1)
    packed = largest.astype(np.uint32)
    is_flipped = xyzw[rows, largest] < 0
    for component in OTHER_COMPONENTS[largest].T:
        value = xyzw[rows, component]
        magnitude = np.rint(_STEPS_PER_UNIT * np.abs(value)).clip(0, 511).astype(np.uint32)
        is_negative = ((value < 0) ^ is_flipped).astype(np.uint32)
        packed = packed << np.uint32(10) | is_negative << np.uint32(9) | magnitude
    return packed.astype("<u4")


def _encode_sh(sh: np.ndarray) -> np.ndarray:
    """Encode spherical harmonics beyond the first, [N, K, 3]."""
    steps = np.where(
        np.arange(sh.shape[1]) < _NUM_SH_REST[1], _STEP_OF_BAND_1, _STEP_OF_OTHER_BANDS
    )[:, None]
    codes = np.rint((128 * sh + 128) / steps) * steps
    return _round_to_bytes(codes)


def describe_spz(path: Path) -> FileFacts:
    """Return the facts of a .spz's header."""
    with path.open("rb") as file:
        start = _read_start(file, path.stat().st_size, str(path))
    warnings = []
    if start.header.flags & _ANTIALIASED_FLAG:
        warnings.append(ANTIALIASED_WARNING)
    if start.up != UP:
        warnings.append(f"its axes are stated by Adobe's record: viewers that skip it take {UP} up")
    version = f"version {start.header.version}"
    return FileFacts(version=version, up=start.up, warnings=tuple(warnings))


SPZ = SplatFormat(
    name=".spz",
    describe=describe_spz,
    reader=read_spz,
    suffixes=(".spz",),
    first_bytes=(_GZIP, _MARK),
    writer=SplatWriter(
        kind="spz",
        suffix=".spz",
        write=lambda path, gaussians, _facts: write_spz(path, rotate_z_to_y(gaussians)),
        world_losses=(
            Loss("how long a unit is is left out: open it with ?scale=1; y points up in it"),
            Loss("cameras are left out"),
        ),
        value_losses=(
            Loss(
                "places are rounded to 0.12 mm within 2 km, scales by up to 3 %, rotations to 0.25 "
                "degrees, opacities, colours and SH to 8 bits and less; SH beyond -1 and 1 is cut "
                "off"
            ),
        ),
    ),
)
