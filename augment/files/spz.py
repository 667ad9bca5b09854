"""Reads and writes Gaussians in .spz files (Niantic, versions 1 to 3).

A file is one gzip stream: a 16-byte header, then column after column: positions as half floats
(version 1) or 24-bit fixed point, opacities, colours, logarithms of scales, rotations (three bytes;
from version 3 the three smallest components in 32 bits), spherical harmonics. Axes are RUB: x
right,
y up, z back. There is no unit. Source: github.com/nianticlabs/spz, README.md and src/cc/load-spz.cc
(MIT).

The header says how long the stream is, and deflate shrinks nothing more than 1032 times. A file
that announces more than it can hold, or far more than its bytes (augment.files.limits), is refused
before anything is allocated.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from augment.errors import SceneError
from augment.files.limits import check_memory, row_slices
from augment.files.splat_format import Loss, SplatFile, SplatFormat, SplatWriter, rotate_z_to_y
from augment.output.atomic import write_file_atomically
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians, check_gaussians

UP = "+y"  # the axis that points up
_GZIP = b"\x1f\x8b"  # first bytes of a gzip stream
_MAGIC = 0x5053474E  # first number of a header
_MARK = _MAGIC.to_bytes(4, "little")  # its bytes
_HEADER = struct.Struct("<IIIBBBB")  # the fields of _Header
WRITTEN_VERSION = 3  # the version that is written
_EXTENSIONS_FLAG = 0x2  # set if there are records of vendors, before the columns or after them
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
    reserved: int

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


def read_spz(path: str | Path) -> SplatFile:
    """Read a .spz file; its note `up` is +y.

    Raises:
        SceneError: the file does not exist, is truncated or damaged, or has an unknown version.
    """
    path = Path(path)
    try:
        _refuse_bare_spz(path)
        with gzip.open(path) as stream:
            header = _unpack_header(path, stream.read(_HEADER.size))
            columns = {
                name: _read_column(path, stream, header.num, *kind)
                for name, kind in header.columns.items()
            }
    except (OSError, EOFError, zlib.error) as error:
        raise SceneError(
            f"{path}: not a whole .spz file ({error}); copy or export it again"
        ) from error
    all_gaussians = _decode_gaussians(header, columns)
    columns.clear()
    gaussians, problems = check_gaussians(all_gaussians, where=str(path))
    if header.degree == 4:
        problems = (*problems, f"{path}: spherical harmonics of degree 4 are cut off at 3")
    return SplatFile(gaussians, notes={"up": UP}, problems=problems)


def _refuse_bare_spz(path: Path) -> None:
    """Refuse a file that begins with the mark of .spz and not with that of gzip."""
    with path.open("rb") as file:
        start = file.read(8)
    if not start.startswith(_MARK):
        return
    version = int.from_bytes(start[4:8], "little")
    if version < 4:
        raise SceneError(
            f"{path}: a .spz of version {version} that is not packed by gzip, as .spz files of "
            f"versions 1 to 3 are; pack it (gzip -c {path.name} > packed.spz), or export it again"
        )
    raise SceneError(
        f"{path}: a .spz of version {version}; versions 1 to 3 are read. Save it as version 3 "
        f"(splat-transform --spz-version 3), or as .ply"
    )


def _decode_gaussians(header: _Header, columns: Mapping[str, np.ndarray]) -> Gaussians:
    """Decode the file's columns piece by piece."""
    count = header.num
    num_rest = min(_NUM_SH_REST[header.degree], NUM_SH_BY_DEGREE[-1] - 1)
    means = np.empty((count, 3), np.float32)
    quats = np.empty((count, 4), np.float32)
    scales = np.empty((count, 3), np.float32)
    opacities = np.empty(count, np.float32)
    sh = np.empty((count, 1 + num_rest, 3), np.float32)
    for rows in row_slices(count):
        means[rows] = _decode_means(header, columns["means"][rows])
        quats[rows] = _decode_quats(header, columns["quats"][rows])
        scales[rows] = np.exp(columns["scales"][rows] / 16.0 - 10)
        opacities[rows] = columns["opacities"][rows, 0] / 255.0
        sh[rows, 0] = (columns["colours"][rows] / 255.0 - 0.5) / _COLOUR_SCALE
        sh_codes = columns["sh"][rows].reshape(rows.stop - rows.start, -1, 3)[:, :num_rest]
        sh[rows, 1:] = (sh_codes.astype(np.float32) - 128) / 128
    return Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(scales),
        opacities=torch.from_numpy(opacities),
        sh=torch.from_numpy(sh),
    )


def _unpack_header(path: Path, data: bytes) -> _Header:
    """Check a header."""
    if len(data) < _HEADER.size or not data.startswith(_MARK):
        raise SceneError(f"{path}: not a .spz file: its stream does not begin with 'NGSP'")
    header = _Header(*_HEADER.unpack(data))
    if header.version not in (1, 2, 3):
        raise SceneError(
            f"{path}: version {header.version} of .spz is not read, only 1 to 3; save it as "
            f"version 3, or as .ply"
        )
    if header.degree not in _NUM_SH_REST or header.fraction_bits > 23:
        raise SceneError(
            f"{path}: its header is damaged: spherical harmonics of degree {header.degree} (0 to "
            f"4), {header.fraction_bits} fractional bits (0 to 23)"
        )
    if header.flags & _EXTENSIONS_FLAG:
        raise SceneError(
            f"{path}: it has vendors' extensions, whose place differs by version; save it without"
        )
    row_bytes = sum(np.dtype(kind).itemsize * width for kind, width in header.columns.values())
    size = path.stat().st_size
    max_bytes = size * _MAX_DEFLATE_RATIO
    if header.num == 0 or header.num * row_bytes > max_bytes:
        raise SceneError(
            f"{path}: its header announces {header.num} Gaussians of {row_bytes} bytes each; the "
            "file "
            f"holds 1 to {max_bytes // row_bytes} of them: truncated, or its header is wrong"
        )
    num_sh = 1 + min(_NUM_SH_REST[header.degree], NUM_SH_BY_DEGREE[-1] - 1)
    check_memory(str(path), header.num, num_sh=num_sh, file_bytes=size)
    return header


def _read_column(
    path: Path, stream: gzip.GzipFile, count: int, kind: str, width: int
) -> np.ndarray:
    """Read one column, [N, width]."""
    column = np.empty((count, width), kind)
    data = column.reshape(-1).view("u1")
    for start in range(0, len(data), _PIECE_BYTES):
        piece = stream.read(min(_PIECE_BYTES, len(data) - start))
        data[start : start + len(piece)] = np.frombuffer(piece, "u1")
        if len(piece) < min(_PIECE_BYTES, len(data) - start):
            raise SceneError(f"{path}: its columns end early; it is truncated: copy it again")
    return column


def _decode_means(header: _Header, column: np.ndarray) -> np.ndarray:
    """Decode positions, float32 [N, 3]."""
    if header.version == 1:
        return column.astype(np.float32)
    low, middle, high = column.reshape(-1, 3).astype(np.int32).T
    fixed = (low | middle << 8 | high << 16).reshape(-1, 3)
    fixed = np.where(fixed > _MAX_FIXED_POINT, fixed - (1 << 24), fixed)
    return (fixed / float(1 << header.fraction_bits)).astype(np.float32)


def _decode_quats(header: _Header, column: np.ndarray) -> np.ndarray:
    """Decode rotations, float32 [N, 4], wxyz; the file's order is xyzw."""
    xyzw = np.zeros((len(column), 4))
    if header.version < 3:
        xyzw[:, :3] = column / 127.5 - 1
        omitted_index = np.full(len(column), 3)
    else:
        packed = column[:, 0]
        omitted_index = (packed >> 30).astype(np.int64)
        for slot, component in enumerate(_other_components(omitted_index).T):
            slot_bits = packed >> np.uint32(20 - 10 * slot)
            magnitude = (slot_bits & 511) / _STEPS_PER_UNIT
            xyzw[np.arange(len(column)), component] = np.where(
                slot_bits & 512, -magnitude, magnitude
            )
    omitted_value = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(axis=1)))
    xyzw[np.arange(len(column)), omitted_index] = omitted_value
    return np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]], np.float32)


def _other_components(component: np.ndarray) -> np.ndarray:
    """Return the three other components of each given one, [N, 3], in order."""
    table = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    return table[component]


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
    for component in _other_components(largest).T:
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


SPZ = SplatFormat(
    name=".spz",
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
