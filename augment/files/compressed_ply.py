"""Reads Gaussians in PlayCanvas' compressed .ply files, as SuperSplat writes them.

Gaussians lie in chunks of 256. The element `chunk` has the ranges of a chunk's positions,
logarithms of scales, and mostly of its colours. The element `vertex` has four numbers of 32 bits a
Gaussian: positions and scales as 11, 10 and 11 bits of these ranges, a rotation as the number of
its largest component and 10 bits of each other one, and 8 bits of red, green, blue and opacity. The
optional element `sh` has a byte for each coefficient from -4 to 4.
Source: github.com/playcanvas/splat-transform, src/lib/readers/decompress-ply.ts (MIT).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch

from augment.errors import SceneError
from augment.files.ply import PlyHeader, describe_ply_header, iterate_rows, read_ply_header
from augment.files.splat_format import SplatFile, SplatFormat, insert_omitted_component
from augment.render.sh import SH_C0
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians, check_gaussians

_ROWS_PER_CHUNK = 256  # Gaussians that share a range
_PACKED_COLUMNS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_RANGES = {
    "position": ("x", "y", "z"),
    "scale": ("scale_x", "scale_y", "scale_z"),
    "color": ("r", "g", "b"),
}
_RANGE_BITS = ((21, 11), (11, 10), (0, 11))  # shift and bits of each packed coordinate or scale
_COLOUR_SHIFTS = (24, 16, 8)  # of red, green and blue; opacity has the last byte
_SH_RANGE = 8.0  # from the least to the greatest coefficient


def is_compressed_ply(path: Path) -> bool:
    """Return True if the header of a .ply announces packed Gaussians."""
    try:
        header = read_ply_header(path)
    except SceneError:
        return False
    return any("packed_position" in element.columns for element in header.elements)


def read_compressed_ply(path: str | Path) -> SplatFile:
    """Read a compressed .ply file. Its notes are the `key: value` comments.

    Raises:
        SceneError: columns are missing, counts disagree, or the file is truncated.
    """
    header = read_ply_header(path)
    has_color_ranges = _check_header(header)
    table = header.element("vertex")
    has_sh = any(element.name == "sh" for element in header.elements)
    num_sh = 1 + (len(header.element("sh").columns) // 3 if has_sh else 0)
    ranges = _read_ranges(header, has_color_ranges=has_color_ranges)
    pieces = iterate_rows(header, "vertex")
    first_piece = next(pieces)  # checks the file's length before arrays are allocated
    sh_pieces: Iterator[np.ndarray | None] = itertools.repeat(None)
    if has_sh:
        sh_pieces = iterate_rows(header, "sh")
    first_sh = next(sh_pieces)
    means = np.empty((table.count, 3), np.float32)
    quats = np.empty((table.count, 4), np.float32)
    scales = np.empty((table.count, 3), np.float32)
    opacities = np.empty(table.count, np.float32)
    sh = np.empty((table.count, num_sh, 3), np.float32)
    start = 0
    all_pieces = zip(
        itertools.chain([first_piece], pieces), itertools.chain([first_sh], sh_pieces), strict=False
    )
    for packed, sh_rows in all_pieces:  # pieces of both have the same number of rows
        rows = slice(start, start + len(packed))
        start = rows.stop
        chunks = np.arange(rows.start, rows.stop) // _ROWS_PER_CHUNK
        position, rotation, scale, color = (
            packed[name].astype(np.uint32, copy=False) for name in _PACKED_COLUMNS
        )
        for axis, (shift, bits) in enumerate(_RANGE_BITS):
            for codes, name, values in ((position, "position", means), (scale, "scale", scales)):
                values[rows, axis] = _in_range(codes, shift, bits, ranges[name], axis, chunks)
        with np.errstate(over="ignore"):  # infinite scales are left out later
            np.exp(scales[rows], out=scales[rows])
        for channel, shift in enumerate(_COLOUR_SHIFTS):
            rgb = _in_range(color, shift, 8, ranges["color"], channel, chunks)
            sh[rows, 0, channel] = (rgb - np.float32(0.5)) / np.float32(SH_C0)
        opacities[rows] = (color & np.uint32(255)).astype(np.float32) / np.float32(255)
        quats[rows] = _decode_quats(rotation)
        if sh_rows is not None:
            sh[rows, 1:] = _decode_sh(sh_rows, num_sh - 1)
    all_gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(scales),
        opacities=torch.from_numpy(opacities),
        sh=torch.from_numpy(sh),
    )
    gaussians, problems = check_gaussians(all_gaussians, where=str(path))
    return SplatFile(
        gaussians, notes=header.notes, problems=(*problems, *header.surplus_problems())
    )


def _check_header(header: PlyHeader) -> bool:
    """Check the elements; return True if chunks have ranges of colours."""
    chunk = header.element("chunk")
    vertex = header.element("vertex")
    expected_names = [f"{end}_{name}" for end in ("min", "max") for name in _RANGES["position"]]
    expected_names += [f"{end}_{name}" for end in ("min", "max") for name in _RANGES["scale"]]
    missing_names = [name for name in expected_names if name not in chunk.columns]
    missing_names += [name for name in _PACKED_COLUMNS if name not in vertex.columns]
    if missing_names:
        raise SceneError(
            f"{header.path}: not a whole compressed .ply: it lacks {', '.join(missing_names)}"
        )
    wide_names = [name for name in _PACKED_COLUMNS if vertex.columns[name] not in ("u4", "i4")]
    if wide_names:
        raise SceneError(
            f"{header.path}: {', '.join(wide_names)} must be of type uint; export it again"
        )
    if vertex.count == 0 or chunk.count != -(-vertex.count // _ROWS_PER_CHUNK):
        raise SceneError(
            f"{header.path}: its header announces {vertex.count} Gaussians in {chunk.count} chunks "
            f"of {_ROWS_PER_CHUNK}: damaged, or empty"
        )
    for element in header.elements:
        if element.name == "sh":
            names = tuple(element.columns)
            num_terms = len(names) // 3
            is_known = 1 + num_terms in NUM_SH_BY_DEGREE[1:] and names == tuple(
                f"f_rest_{i}" for i in range(3 * num_terms)
            )
            is_byte = all(kind == "u1" for kind in element.columns.values())
            if not is_known or not is_byte or element.count != vertex.count:
                raise SceneError(
                    f"{header.path}: its element 'sh' must have f_rest_0 to f_rest_8, 23 or 44 of "
                    f"type uchar, for {vertex.count} Gaussians; it has {len(names)} columns for "
                    f"{element.count}"
                )
    return "min_r" in chunk.columns and all(
        f"{end}_{name}" in chunk.columns for end in ("min", "max") for name in _RANGES["color"]
    )


def _read_ranges(
    header: PlyHeader, *, has_color_ranges: bool
) -> Mapping[str, tuple[np.ndarray, np.ndarray]]:
    """Return the least values and the spans of all chunks, float32 [C, 3] each, by quantity."""
    rows = np.concatenate(list(iterate_rows(header, "chunk")))
    ranges = {}
    for quantity, names in _RANGES.items():
        if quantity == "color" and not has_color_ranges:
            shape = (len(rows), 3)
            ranges[quantity] = (np.zeros(shape, np.float32), np.ones(shape, np.float32))
            continue
        low = np.stack([rows[f"min_{name}"] for name in names], axis=1).astype(np.float32)
        high = np.stack([rows[f"max_{name}"] for name in names], axis=1).astype(np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # such Gaussians are left out later
            ranges[quantity] = (low, high - low)
    return ranges


def _in_range(
    codes: np.ndarray,
    shift: int,
    bits: int,
    ranges: tuple[np.ndarray, np.ndarray],
    axis: int,
    chunks: np.ndarray,
) -> np.ndarray:
    """Return the values of some bits of the codes in their chunks' ranges, float32 [N]."""
    low, span = ranges
    max_code = (1 << bits) - 1
    fractions = (codes >> np.uint32(shift) & np.uint32(max_code)).astype(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        step = span[:, axis] / np.float32(max_code)
        return low[chunks, axis] + fractions * step[chunks]


def _decode_quats(codes: np.ndarray) -> np.ndarray:
    """Decode rotations, float32 [N, 4], wxyz."""
    value_of_code = ((np.arange(1024) / 1023 - 0.5) * np.sqrt(2)).astype(np.float32)
    values = [value_of_code[codes >> np.uint32(shift) & np.uint32(1023)] for shift in (20, 10, 0)]
    squares = sum(value * value for value in values)
    largest_value = np.sqrt(np.maximum(np.float32(0), np.float32(1) - squares))
    largest = (codes >> np.uint32(30)).astype(np.uint8)
    return np.stack(insert_omitted_component(values, largest, largest_value), axis=1)


def _decode_sh(rows: np.ndarray, num_terms: int) -> np.ndarray:
    """Decode coefficients beyond the first, float32 [N, K, 3]."""
    if rows.dtype.itemsize == 3 * num_terms:
        codes = np.ascontiguousarray(rows).view("u1").reshape(len(rows), 3 * num_terms)
    else:  # text
        codes = np.stack([rows[name] for name in rows.dtype.names or ()], axis=1)
        codes = codes.clip(0, 255).astype(np.uint8)
    values = codes.astype(np.float32)
    values *= np.float32(_SH_RANGE / 256)
    values += np.float32(_SH_RANGE / 512 - _SH_RANGE / 2)  # the middles of 256 steps
    values[codes == 0] = -_SH_RANGE / 2  # but for the first and the last
    values[codes == 255] = _SH_RANGE / 2
    return values.reshape(len(rows), 3, num_terms).transpose(0, 2, 1)


COMPRESSED_PLY = SplatFormat(
    name="compressed .ply",
    reader=read_compressed_ply,
    first_bytes=(b"ply\n", b"ply\r"),
    fits_content=is_compressed_ply,
    describe=describe_ply_header,
    viewer_up="-y",
)
