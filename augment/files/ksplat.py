"""Reads Gaussians in .ksplat files (mkkellogg's GaussianSplats3D, version 0.1).

A file is a header of 4096 bytes, headers of 1024 bytes for each section, and the sections' data. At
compression level 0 all numbers are floats. At levels 1 and 2, scales and rotations are half floats,
and positions are 16-bit steps from the centre of the Gaussian's bucket. Spherical harmonics beyond
the first are floats, half floats, or bytes of a range. Colours and opacities are always bytes. A
section's first buckets are full; the lengths of the others precede the buckets' centres.
Source: github.com/mkkellogg/GaussianSplats3D, src/loaders/SplatBuffer.js (MIT).

A half float cannot hold a scale below 6e-8. Such scales are stored as 0 and read as 3e-8.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import torch

from augment.errors import SceneError
from augment.files.limits import check_memory, row_slices
from augment.files.splat_format import FileFacts, SplatFile, SplatFormat
from augment.render.sh import SH_C0
from augment.scene.scene import Gaussians, check_gaussians

_HEADER_BYTES = 4096  # bytes of the file's header
_SECTION_HEADER_BYTES = 1024  # bytes of each section's header
# Fields of the file's header: version (major, minor), sections that have room, sections, Gaussians
# that have room, Gaussians, compression level, centre, least and greatest coefficient.
_HEADER = struct.Struct("<BBxxIIIIHxx12xff")
# Fields of a section's header: Gaussians, Gaussians that have room, Gaussians and number of full
# buckets, their edge, bytes of a bucket, steps of half an edge, bytes of the section (unused), full
# and partly filled buckets, degree of the spherical harmonics.
_SECTION = struct.Struct("<IIIIfHxxI4xIIH")
_MAX_SECTIONS = 10_000  # sections of a file
_NUM_TERMS = (0, 3, 8)  # coefficients a channel beyond the first, by degree
_BANDS = ((0, 3), (3, 8))  # first and last of these coefficients in each band
_DEFAULT_STEPS = (1, 32767, 32767)  # steps of half a bucket's edge by level, where none are stated
_SH_TYPES = ("<f4", "<f2", "u1")  # types of coefficients by level
_DEFAULT_SH_LIMIT = 1.5  # greatest coefficient, where none is stated
_LEAST_HALF_SCALE = np.float32(2.0**-25)  # half the smallest half float
_BUCKET_BYTES = 12  # bytes of a bucket's centre


class _Section(NamedTuple):
    """The header of a section."""

    num: int  # Gaussians
    num_places: int  # Gaussians that have room
    bucket_size: int  # Gaussians of a full bucket
    num_buckets: int
    bucket_edge: float  # in the file's unit
    bucket_bytes: int  # bytes of a bucket's centre
    num_steps: int  # steps of half a bucket's edge; 0 for the default
    num_full_buckets: int
    num_partial_buckets: int
    degree: int  # of the spherical harmonics


class _Layout(NamedTuple):
    """Facts that hold for all sections."""

    level: int  # of compression
    least_sh: float  # coefficient of the byte 0
    greatest_sh: float  # coefficient of the byte 255


def read_ksplat(path: str | Path) -> SplatFile:
    """Read a .ksplat file.

    Raises:
        SceneError: the file is truncated or damaged, or has another version.
    """
    path = Path(path)
    size = path.stat().st_size
    with path.open("rb") as file:
        layout, sections = _read_headers(path, file, size)
        num = sum(section.num for section in sections)
        num_sh = 1 + max(_NUM_TERMS[section.degree] for section in sections)
        check_memory(str(path), num, num_sh=num_sh, file_bytes=size)
        all_gaussians = Gaussians(
            means=torch.empty(num, 3),
            quats=torch.empty(num, 4),
            scales=torch.empty(num, 3),
            opacities=torch.empty(num),
            sh=torch.zeros(num, num_sh, 3),
        )
        start = 0
        with np.errstate(over="ignore", invalid="ignore"):  # infinite values are left out later
            for section in sections:
                _read_section(path, file, layout, section, all_gaussians, start)
                start += section.num
    gaussians, problems = check_gaussians(all_gaussians, where=str(path))
    return SplatFile(gaussians, problems=problems)


def _read_headers(path: Path, file: BinaryIO, size: int) -> tuple[_Layout, list[_Section]]:
    """Read and check the headers; the file then stands at the first section's data."""
    data = file.read(_HEADER_BYTES)
    if len(data) < _HEADER_BYTES:
        raise SceneError(
            f"{path}: a .ksplat begins with a header of {_HEADER_BYTES} bytes; got {len(data)}: "
            "truncated, or another format"
        )
    major, minor, num_headers, _, _, num, level, least_sh, greatest_sh = _HEADER.unpack_from(data)
    if (major, minor) != (0, 1):
        raise SceneError(
            f"{path}: version {major}.{minor} of .ksplat is not read, only 0.1: another version or "
            "format; save it as .ply"
        )
    if level > 2 or not 1 <= num_headers <= _MAX_SECTIONS:
        raise SceneError(
            f"{path}: its header is damaged: compression level {level} (0 to 2), {num_headers} "
            f"sections (1 to {_MAX_SECTIONS})"
        )
    layout = _Layout(level, least_sh or -_DEFAULT_SH_LIMIT, greatest_sh or _DEFAULT_SH_LIMIT)
    num_remaining_bytes = size - _HEADER_BYTES - num_headers * _SECTION_HEADER_BYTES
    sections = []
    for number in range(num_headers):
        data = file.read(_SECTION_HEADER_BYTES)
        if len(data) < _SECTION_HEADER_BYTES:
            raise SceneError(f"{path}: the headers of its {num_headers} sections end early")
        section = _Section(*_SECTION.unpack_from(data))
        _check_section(path, layout, section, number)
        num_remaining_bytes -= _section_bytes(layout, section)
        if num_remaining_bytes < 0:
            raise SceneError(
                f"{path}: section {number} announces {section.num_places} Gaussians and "
                f"{section.num_buckets} buckets, {-num_remaining_bytes} bytes more than the file "
                "holds: truncated, or its header is wrong"
            )
        sections.append(section)
    num_announced = sum(section.num for section in sections)
    if num_announced != num or num == 0:
        raise SceneError(
            f"{path}: its header announces {num} Gaussians, its sections {num_announced}: damaged, "
            "empty, or not loaded to its end when it was saved"
        )
    return layout, sections


def _check_section(path: Path, layout: _Layout, section: _Section, number: int) -> None:
    """Check that a section's numbers fit one another."""
    reason = ""
    num_full = section.num_full_buckets * section.bucket_size
    if section.num > section.num_places:
        reason = f"{section.num} Gaussians in {section.num_places} places"
    elif section.degree >= len(_NUM_TERMS):
        reason = f"spherical harmonics of degree {section.degree} (0 to 2)"
    elif layout.level and section.bucket_bytes != _BUCKET_BYTES and section.num_buckets:
        reason = f"{section.bucket_bytes} bytes a bucket ({_BUCKET_BYTES} are expected)"
    elif layout.level and (
        section.num_full_buckets + section.num_partial_buckets > section.num_buckets
        or num_full > section.num_places
    ):
        reason = (
            f"{section.num_full_buckets} full buckets of {section.bucket_size} and "
            f"{section.num_partial_buckets} others of {section.num_buckets}, for {section.num}"
        )
    elif layout.level and not np.isfinite(section.bucket_edge):
        reason = f"buckets with edges of {section.bucket_edge}"
    if reason:
        raise SceneError(f"{path}: the header of section {number} is damaged: {reason}")


def _row_type(layout: _Layout, degree: int) -> np.dtype:
    """Return the type of a section's rows."""
    mean_type, number_type = ("<f4", "<f4") if layout.level == 0 else ("<u2", "<f2")
    return np.dtype(
        [
            ("mean", mean_type, 3),
            ("scale", number_type, 3),
            ("quat", number_type, 4),
            ("rgba", "u1", 4),
            ("sh", _SH_TYPES[layout.level], 3 * _NUM_TERMS[degree]),
        ]
    )


def _section_bytes(layout: _Layout, section: _Section) -> int:
    """Return the bytes of a section's data."""
    rows_bytes = _row_type(layout, section.degree).itemsize * section.num_places
    return 4 * section.num_partial_buckets + section.bucket_bytes * section.num_buckets + rows_bytes


def _read_section(
    path: Path, file: BinaryIO, layout: _Layout, section: _Section, gaussians: Gaussians, start: int
) -> None:
    """Decode a section into the rows of `gaussians` from `start`."""
    end = file.tell() + _section_bytes(layout, section)
    lengths = np.frombuffer(file.read(4 * section.num_partial_buckets), "<u4")
    bucket_bytes = file.read(section.bucket_bytes * section.num_buckets)
    row_type = _row_type(layout, section.degree)
    steps = section.num_steps or _DEFAULT_STEPS[layout.level]
    step = np.float32(section.bucket_edge / 2 / steps)
    centres = np.empty((0, 3), np.float32)
    buckets = np.empty(0, np.int64)
    if layout.level:
        centres = np.frombuffer(bucket_bytes, "<f4").reshape(-1, 3)
        buckets = _buckets_of_rows(path, section, lengths)
    for rows in row_slices(section.num):
        row_bytes = file.read(row_type.itemsize * (rows.stop - rows.start))
        values = np.frombuffer(row_bytes, row_type)
        output_rows = slice(start + rows.start, start + rows.stop)
        scales = values["scale"].astype(np.float32)
        means = values["mean"].astype(np.float32)
        if layout.level:
            scales[scales == 0] = _LEAST_HALF_SCALE
            means = (means - np.float32(steps)) * step + centres[buckets[rows]]
        gaussians.means.numpy()[output_rows] = means
        gaussians.scales.numpy()[output_rows] = scales
        gaussians.quats.numpy()[output_rows] = values["quat"]
        fractions = values["rgba"].astype(np.float32) / np.float32(255)
        sh = gaussians.sh.numpy()
        sh[output_rows, 0] = (fractions[:, :3] - np.float32(0.5)) / np.float32(SH_C0)
        gaussians.opacities.numpy()[output_rows] = fractions[:, 3]
        num_terms = _NUM_TERMS[section.degree]
        if num_terms:
            terms = sh[output_rows, 1 : 1 + num_terms]
            _decode_sh(values["sh"], layout, terms)
    file.seek(end)


def _buckets_of_rows(path: Path, section: _Section, lengths: np.ndarray) -> np.ndarray:
    """Return the bucket of each Gaussian of a section, int64 [N].

    Args:
        path: the file, for messages.
        section: the section.
        lengths: Gaussians of each partly filled bucket, uint32 [P].
    """
    num_full = section.num_full_buckets * section.bucket_size
    num_partial = int(lengths.sum(dtype=np.uint64))
    if not num_full + num_partial >= section.num or num_partial > section.num_places:
        raise SceneError(
            f"{path}: its buckets hold {num_full + num_partial} Gaussians; the section has "
            f"{section.num}: damaged"
        )
    all_lengths = np.concatenate(
        [np.full(section.num_full_buckets, section.bucket_size, np.int64), lengths.astype(np.int64)]
    )
    return np.repeat(np.arange(len(all_lengths)), all_lengths)[: section.num]


def _decode_sh(codes: np.ndarray, layout: _Layout, terms: np.ndarray) -> None:
    """Decode coefficients [N, 3 K], which each band has channel after channel, into [N, K, 3]."""
    for first, last in _BANDS:
        if last > terms.shape[1]:
            return
        band = codes[:, 3 * first : 3 * last].reshape(len(codes), 3, last - first)
        terms[:, first:last] = band.transpose(0, 2, 1)
        if layout.level == 2:
            span = np.float32(layout.greatest_sh - layout.least_sh)
            terms[:, first:last] *= span / np.float32(255)
            terms[:, first:last] += np.float32(layout.least_sh)


def describe_ksplat(path: Path) -> FileFacts:
    """Return the facts of a .ksplat's headers."""
    with path.open("rb") as file:
        layout, sections = _read_headers(path, file, path.stat().st_size)
    return FileFacts(
        version=f"version 0.1, compression level {layout.level}, {len(sections)} sections"
    )


KSPLAT = SplatFormat(
    name=".ksplat",
    reader=read_ksplat,
    suffixes=(".ksplat",),
    describe=describe_ksplat,
    viewer_up="-y",
)
