"""Gaussians in .spz files (Niantic, versions 1 to 3): one gzip stream of quantised columns.

A 16-byte header, then column after column: places as half floats (version 1) or 24-bit fixed point,
opacities, colours, logarithms of scales, rotations (three bytes; from version 3 the three smallest
components in 32 bits), spherical harmonics. Axes are RUB: x right, y up, z back. There is no unit.
Facts by github.com/nianticlabs/spz, README.md and src/cc/load-spz.cc (MIT).

The header says how long the stream is, and deflate makes nothing more than 1032 times smaller: what
a file cannot hold, or what is far more than its bytes (augment.files.limits), is refused before
anything is allocated.
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
from augment.files.ply import SplatFile
from augment.jobs.atomic import replaced_file
from augment.scene import SH_COUNTS, Gaussians, check_gaussians

SUFFIX = ".spz"
UP = "+y"
GZIP = b"\x1f\x8b"
_MAGIC, _HEADER = 0x5053474E, struct.Struct("<IIIBBBB")
WRITTEN_VERSION = 3
_EXTENDED = 0x2  # a flag: there are records of vendors, before the columns or after them
_MAX_DEFLATED = 1032  # bytes out of one, at most (zlib's technical details)
_PIECE = 1 << 22  # bytes that are unpacked together
_BANDS = {0: 0, 1: 3, 2: 8, 3: 15, 4: 24}  # coefficients a channel beyond the first, by degree
_COLOUR = 0.15  # of f_dc, so that colours beyond 0 and 1 are kept
_MAX_FRACTION_BITS = 12  # a quarter of a millimetre, up to 2 km from the origin
_FIXED_MAX = (1 << 23) - 1
_SMALL = 511 * np.sqrt(2)  # steps of the smaller components of a quaternion, which end at sqrt(1/2)
# Steps of 8-bit coefficients that the library writes: 5 bits for the first band, 4 for others.
_STEP_1, _STEP_REST = 8, 16


class _Header(NamedTuple):
    magic: int
    version: int
    num: int
    degree: int
    fraction_bits: int
    flags: int
    reserved: int

    @property
    def columns(self) -> dict[str, tuple[str, int]]:
        """Type and width of each, in order."""
        place = ("<f2", 3) if self.version == 1 else ("u1", 9)
        turn = ("<u4", 1) if self.version >= 3 else ("u1", 3)
        return {
            "means": place,
            "opacities": ("u1", 1),
            "colours": ("u1", 3),
            "scales": ("u1", 3),
            "quats": turn,
            "sh": ("u1", 3 * _BANDS[self.degree]),
        }


def read_spz(path: str | Path) -> SplatFile:
    """Read a .spz file, its note `up` being +y. Raises SceneError: no such file, truncated, damaged
    or of a version that is not known.
    """
    path = Path(path)
    try:
        with gzip.open(path) as stream:
            header = _check(path, stream.read(_HEADER.size))
            stored = {
                name: _column(path, stream, header.num, *kind)
                for name, kind in header.columns.items()
            }
    except (OSError, EOFError, zlib.error) as error:
        raise SceneError(
            f"{path}: not a whole .spz file ({error}); copy or export it again"
        ) from error
    raw = _gaussians(header, stored)
    stored.clear()
    gaussians, problems = check_gaussians(raw, where=str(path))
    if header.degree == 4:
        problems = (*problems, f"{path}: spherical harmonics of degree 4 are cut off at 3")
    return SplatFile(gaussians, notes={"up": UP}, problems=problems)


def refuse_bare_spz(path: Path, start: bytes) -> None:
    """Say what a file is that begins with the mark of .spz and not with that of gzip. start: its
    first bytes. Raises SceneError: it is such a file.
    """
    if start[:4] != _MAGIC.to_bytes(4, "little"):
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


def _gaussians(header: _Header, stored: Mapping[str, np.ndarray]) -> Gaussians:
    """The Gaussians of the file's columns, decoded piece by piece."""
    count = header.num
    bands = min(_BANDS[header.degree], SH_COUNTS[-1] - 1)
    means, quats = np.empty((count, 3), np.float32), np.empty((count, 4), np.float32)
    scales, opacities = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    sh = np.empty((count, 1 + bands, 3), np.float32)
    for rows in row_slices(count):
        means[rows] = _places(header, stored["means"][rows])
        quats[rows] = _turns(header, stored["quats"][rows])
        scales[rows] = np.exp(stored["scales"][rows] / 16.0 - 10)
        opacities[rows] = stored["opacities"][rows, 0] / 255.0
        sh[rows, 0] = (stored["colours"][rows] / 255.0 - 0.5) / _COLOUR
        rest = stored["sh"][rows].reshape(rows.stop - rows.start, -1, 3)[:, :bands]
        sh[rows, 1:] = (rest.astype(np.float32) - 128) / 128
    return Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(scales),
        opacities=torch.from_numpy(opacities),
        sh=torch.from_numpy(sh),
    )


def _check(path: Path, data: bytes) -> _Header:
    if len(data) < _HEADER.size or data[:4] != _MAGIC.to_bytes(4, "little"):
        raise SceneError(f"{path}: not a .spz file: its stream does not begin with 'NGSP'")
    header = _Header(*_HEADER.unpack(data))
    if header.version not in (1, 2, 3):
        raise SceneError(
            f"{path}: version {header.version} of .spz is not read, only 1 to 3; save it as "
            f"version 3, or as .ply"
        )
    if header.degree not in _BANDS or header.fraction_bits > 23:
        raise SceneError(
            f"{path}: its header is damaged: spherical harmonics of degree {header.degree} (0 to "
            f"4), {header.fraction_bits} fractional bits (0 to 23)"
        )
    if header.flags & _EXTENDED:
        raise SceneError(
            f"{path}: it has vendors' extensions, whose place differs by version; save it without"
        )
    row = sum(np.dtype(kind).itemsize * width for kind, width in header.columns.values())
    size = path.stat().st_size
    most = size * _MAX_DEFLATED
    if header.num == 0 or header.num * row > most:
        raise SceneError(
            f"{path}: its header announces {header.num} Gaussians of {row} bytes each; the file "
            f"holds 1 to {most // row} of them: truncated, or its header is wrong"
        )
    functions = 1 + min(_BANDS[header.degree], SH_COUNTS[-1] - 1)
    check_memory(str(path), header.num, functions=functions, size=size)
    return header


def _column(path: Path, stream: gzip.GzipFile, count: int, kind: str, width: int) -> np.ndarray:
    """[N, width]."""
    column = np.empty((count, width), kind)
    data = column.reshape(-1).view("u1")
    for start in range(0, len(data), _PIECE):
        piece = stream.read(min(_PIECE, len(data) - start))
        data[start : start + len(piece)] = np.frombuffer(piece, "u1")
        if len(piece) < min(_PIECE, len(data) - start):
            raise SceneError(f"{path}: its columns end early; it is truncated: copy it again")
    return column


def _places(header: _Header, column: np.ndarray) -> np.ndarray:
    if header.version == 1:
        return column.astype(np.float32)
    low, middle, high = column.reshape(-1, 3).astype(np.int32).T
    fixed = (low | middle << 8 | high << 16).reshape(-1, 3)
    fixed = np.where(fixed > _FIXED_MAX, fixed - (1 << 24), fixed)
    return (fixed / float(1 << header.fraction_bits)).astype(np.float32)


def _turns(header: _Header, column: np.ndarray) -> np.ndarray:
    """float32 [N, 4], wxyz; the file's order is xyzw."""
    xyzw = np.zeros((len(column), 4))
    if header.version < 3:
        xyzw[:, :3] = column / 127.5 - 1
        missing = np.full(len(column), 3)
    else:
        packed = column[:, 0]
        missing = (packed >> 30).astype(np.int64)
        for place, others in enumerate(_others(missing).T):
            bits = packed >> np.uint32(20 - 10 * place)
            size = (bits & 511) / _SMALL
            xyzw[np.arange(len(column)), others] = np.where(bits & 512, -size, size)
    rest = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(axis=1)))
    xyzw[np.arange(len(column)), missing] = rest
    return np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]], np.float32)


def _others(missing: np.ndarray) -> np.ndarray:
    """The components beside those, [N, 3], in order."""
    table = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    return table[missing]


def write_spz(path: str | Path, gaussians: Gaussians) -> None:
    """Write a .spz file of version 3, atomically, from Gaussians whose y points up. Places keep as
    many bits as their reach leaves, a quarter of a millimetre within 2 km.
    """
    means = gaussians.means.detach().cpu().numpy().astype(np.float64)
    reach = float(np.abs(means).max(initial=1e-3))
    bits = min(_MAX_FRACTION_BITS, int(np.floor(np.log2(_FIXED_MAX / reach))))
    if bits < 0:
        raise SceneError(f"{path}: places reach {reach:.3g} from the origin; .spz ends at 8388607")
    fixed = np.rint(means * (1 << bits)).astype("<i4")
    scales = gaussians.scales.detach().cpu().double().log().numpy()
    sh = gaussians.sh.detach().cpu().numpy().astype(np.float64)
    columns = (
        fixed.reshape(-1, 1).view("u1")[:, :3],
        _bytes(255 * gaussians.opacities.detach().cpu().numpy()),
        _bytes(255 * (_COLOUR * sh[:, 0] + 0.5)),
        _bytes(16 * (scales + 10)),
        _packed_turns(gaussians.quats.detach().cpu().double().numpy()),
        _coefficients(sh[:, 1:]),
    )
    count, degree = len(gaussians), gaussians.sh_degree
    header = _HEADER.pack(_MAGIC, WRITTEN_VERSION, count, degree, bits, 0, 0)
    with replaced_file(Path(path)) as file, gzip.GzipFile("", "wb", 6, file, mtime=0) as stream:
        stream.write(header)
        for column in columns:
            stream.write(np.ascontiguousarray(column).tobytes())


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _packed_turns(wxyz: np.ndarray) -> np.ndarray:
    xyzw = wxyz[:, [1, 2, 3, 0]] / np.linalg.norm(wxyz, axis=1, keepdims=True)
    rows, largest = np.arange(len(xyzw)), np.abs(xyzw).argmax(axis=1)
    packed = largest.astype(np.uint32)
    flipped = xyzw[rows, largest] < 0
    for others in _others(largest).T:
        value = xyzw[rows, others]
        size = np.rint(_SMALL * np.abs(value)).clip(0, 511).astype(np.uint32)
        negative = ((value < 0) ^ flipped).astype(np.uint32)
        packed = packed << np.uint32(10) | negative << np.uint32(9) | size
    return packed.astype("<u4")


def _coefficients(sh: np.ndarray) -> np.ndarray:
    """sh: [N, K, 3], beyond the first."""
    steps = np.where(np.arange(sh.shape[1]) < _BANDS[1], _STEP_1, _STEP_REST)[:, None]
    stored = np.rint((128 * sh + 128) / steps) * steps
    return _bytes(stored)
