"""Reads Gaussians in SOG files of versions 1 and 2 (PlayCanvas), and writes version 2.

A SOG is meta.json and lossless images, in a folder or zipped as .sog. A pixel of each image is a
Gaussian: 16 bits of each coordinate's signed logarithm, rotations by their three smaller
components, logarithms of scales and colours by codebooks of 256 numbers, opacities, and bands of
spherical harmonics as entries of one palette.

Version 1 has no number. It has ranges instead of codebooks, and stores logits of opacities.

Sources: developer.playcanvas.com, "The SOG Format", and github.com/playcanvas/splat-transform,
src/lib/readers/read-sog.ts and read-sog-v1.ts (MIT). Where the two differ, the code counts: scales
are logarithms, the first component of a rotation is w, and the axes are those of the .ply that the
SOG was made from. So meta.json of the files written here says which axis is up and what a unit is,
in a field "climategs" that other readers ignore.
"""

from __future__ import annotations

import contextlib
import json
import lzma
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from augment.errors import SceneError
from augment.files.image_size import image_header
from augment.files.limits import check_memory, parse_json_object, row_slices, validate_model
from augment.files.sog_meta import (
    CODEBOOK_SIZE,
    MAX_PALETTE,
    NUM_SH_REST,
    Palette,
    RangedPalette,
    SogMeta,
    SogMetaVersion1,
    code_numbers,
)
from augment.files.splat_format import (
    ANTIALIASED_WARNING,
    OTHER_COMPONENTS,
    FileFacts,
    Loss,
    SplatFile,
    SplatFormat,
    SplatWriter,
    has_directional_colors,
)
from augment.output.atomic import write_file_atomically
from augment.rng import rng_for
from augment.scene.scene import Gaussians, check_gaussians
from augment.scene.transform import transform_gaussians_rigidly
from recipes.files import open_file

SUFFIX = ".sog"  # the end of the zipped files' names
META = "meta.json"  # the name of the file that describes the others
_ZIP = b"PK\x03\x04"  # first bytes of a zip
_MAX_CODE = 65535  # the largest code of a coordinate
_ENTRIES_PER_ROW = 64  # entries of the palette in a row of its image
_MAX_META_BYTES = 1 << 20  # bytes of meta.json
# Pixels that an image may have beyond twice the number of Gaussians.
_MAX_UNUSED_PIXELS = 1 << 16

_READ_ERRORS = (OSError, EOFError, RuntimeError, ValueError, struct.error, zipfile.BadZipFile)
_READ_ERRORS += (zlib.error, lzma.LZMAError)

# ---- Reading -------------------------------------------------------------------------------------


class _Files:
    """The files beside meta.json, in its folder or in the same zip; plain names only."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.zip = None if path.name == META else zipfile.ZipFile(path)

    def close(self) -> None:
        """Close the zip."""
        if self.zip is not None:
            self.zip.close()

    def read(self, name: str, max_bytes: int) -> bytes:
        """Read a file of at most `max_bytes` bytes."""
        if name in ("", ".", "..") or any(mark in name for mark in "/\\\0"):
            raise SceneError(
                f"{self.path} names the file {name!r}; names must be of files beside {META}"
            )
        if self.zip is None:
            path = self.path.parent / name
            if path.resolve().parent != self.path.parent.resolve():
                raise SceneError(f"{path} is a link out of its folder; put the file itself there")
            with open_file(path) as file:
                data = file.read(max_bytes + 1)
        else:
            with self.zip.open(name) as file:
                data = file.read(max_bytes + 1)
        if len(data) > max_bytes:
            raise SceneError(
                f"{self.path}: {name} is larger than the {max_bytes} bytes it may have"
            )
        return data

    def pixels(self, name: str, max_bytes: int, count: int | None = None) -> np.ndarray:
        """Read a lossless image as RGBA, uint8 [H, W, 4].

        Args:
            name: the file.
            max_bytes: the largest size of the file, bytes.
            count: the number of Gaussians; the image has as many pixels or slightly more.
        """
        data = self.read(name, max_bytes)
        header = image_header(data)
        where = f"{self.path}: {name}"
        if header is None or header.format not in ("WebP", "PNG") or data[12:16] == b"VP8 ":
            format_text = (
                "another format" if header is None else f"a lossy or other {header.format}"
            )
            raise SceneError(f"{where} must be a lossless WebP or a PNG; it is {format_text}")
        num_pixels = header.width * header.height
        if count is not None and not count <= num_pixels <= 2 * count + _MAX_UNUSED_PIXELS:
            raise SceneError(
                f"{where} has {header.width} x {header.height} pixels for {count} Gaussians: "
                f"{count} to {2 * count + _MAX_UNUSED_PIXELS} are expected"
            )
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:  # sizes that it refuses
            image = None
        if image is None or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] < 3:
            raise SceneError(f"{where} is damaged, or no image of 8 bits in three or four channels")
        if image.shape[:2] != (header.height, header.width):
            raise SceneError(
                f"{where} is damaged: it says {header.width} x {header.height} pixels and holds "
                f"{image.shape[1]} x {image.shape[0]}"
            )
        if image.shape[2] == 3:  # decoders leave out an alpha that is 255 everywhere
            return cv2.cvtColor(image, cv2.COLOR_BGR2RGBA)
        return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA)


def is_sog_folder(folder: Path) -> bool:
    """Return True if a folder holds the files of a SOG, by their usual names."""
    return (folder / META).is_file() and (folder / "means_l.webp").is_file()


def read_sog(path: str | Path) -> SplatFile:
    """Read a .sog, or the meta.json of a folder. The notes are the file's `up` and `unit`.

    Raises:
        SceneError: files are missing, truncated or damaged, or of another version.
    """
    path = Path(path)
    all_gaussians, notes = read_all_sog_gaussians(path)
    gaussians, problems = check_gaussians(all_gaussians, where=str(path))
    return SplatFile(gaussians, notes=notes, problems=problems)


def read_all_sog_gaussians(path: Path) -> tuple[Gaussians, dict[str, str]]:
    """Read all Gaussians of a .sog, including those that cannot be rendered, and its notes.

    The Gaussians have the file's order.

    Raises:
        SceneError: as `read_sog`.
    """
    try:
        with contextlib.closing(_Files(path)) as files:
            return _read(files)
    except KeyError as error:
        raise SceneError(f"{path}: not a whole .sog file: {error.args[0]}") from error
    except FileNotFoundError as error:
        raise SceneError(f"{path} names {error.filename}, which is missing") from error
    except _READ_ERRORS as error:
        raise SceneError(
            f"{path}: not a whole .sog file ({error}); copy or export it again"
        ) from error


def _read(files: _Files) -> tuple[Gaussians, dict[str, str]]:
    """Read and decode all images."""
    meta = _read_meta(files)
    count = meta.count
    max_bytes = max(2 * count, _MAX_META_BYTES) * 4
    low_bytes, high_bytes = (
        _pixels_of_gaussians(files.pixels(name, max_bytes, count), count)
        for name in meta.means.files
    )
    colour_codes = _pixels_of_gaussians(files.pixels(meta.sh0.files[0], max_bytes, count), count)
    scale_codes = _pixels_of_gaussians(files.pixels(meta.scales.files[0], max_bytes, count), count)
    quat_codes = _pixels_of_gaussians(files.pixels(meta.quats.files[0], max_bytes, count), count)
    palette = None
    if meta.shN is not None:
        shape = _palette_shape(files, meta.shN)
        palette = _palette_entries(files, meta.shN.files, shape, count, max_bytes)
    num_rest = 0 if palette is None else palette.entries.shape[1]
    gaussians = Gaussians(
        means=torch.empty(count, 3),
        quats=torch.empty(count, 4),
        scales=torch.empty(count, 3),
        opacities=torch.empty(count),
        sh=torch.empty(count, 1 + num_rest, 3),
    )
    arrays = {name: getattr(gaussians, name).numpy() for name in ("means", "quats", "scales", "sh")}
    mins = np.array(meta.means.mins)
    maxs = np.array(meta.means.maxs)
    numbers = code_numbers(meta)
    channels = np.arange(3)
    for rows in row_slices(count):
        codes = low_bytes[rows, :3] | high_bytes[rows, :3].astype(np.uint16) << 8
        with np.errstate(
            over="ignore", invalid="ignore"
        ):  # infinite values are left out later, and reported
            logs = mins + (maxs - mins) * (codes / _MAX_CODE)
            arrays["means"][rows] = np.copysign(np.expm1(np.abs(logs)), logs)
            arrays["scales"][rows] = np.exp(numbers.scales[scale_codes[rows, :3], channels])
        arrays["quats"][rows] = _decode_quats(quat_codes[rows])
        arrays["sh"][rows, 0] = numbers.colours[colour_codes[rows, :3], channels]
        if palette is not None and numbers.sh is not None:
            sh_codes = palette.entries[palette.labels[rows]]
            arrays["sh"][rows, 1:] = numbers.sh[sh_codes]
        gaussians.opacities.numpy()[rows] = numbers.opacities[colour_codes[rows, 3]]
    stated_notes = {} if isinstance(meta, SogMetaVersion1) else meta.climategs
    return gaussians, {key: stated_notes[key] for key in ("up", "unit") if key in stated_notes}


def _read_meta(files: _Files) -> SogMeta | SogMetaVersion1:
    """Read and check meta.json."""
    where = str(files.path) if files.zip is None else f"{files.path}: {META}"
    content = parse_json_object(files.read(META, _MAX_META_BYTES), where)
    if "means" not in content:
        raise SceneError(f"{where} does not describe splats: it has no 'means'")
    if content.get("version", 1) not in (1, 2):
        raise SceneError(
            f"{where}: only versions 1 and 2 of SOG are read; got {content['version']!r:.20}. Save "
            f"it anew with SplatTransform or SuperSplat, or as .ply"
        )
    is_version_2 = content.get("version", 1) == 2
    meta = validate_model(SogMeta if is_version_2 else SogMetaVersion1, content, where)
    names = [*meta.means.files, *meta.scales.files, *meta.quats.files, *meta.sh0.files]
    names += [] if meta.shN is None else meta.shN.files
    size = files.path.stat().st_size
    if files.zip is None:
        size = sum((files.path.parent / Path(name).name).stat().st_size for name in {*names})
    bands = 0 if meta.shN is None else len(NUM_SH_REST) - 1
    if isinstance(meta.shN, Palette):
        bands = meta.shN.bands
    check_memory(where, meta.count, num_sh=1 + NUM_SH_REST[bands], file_bytes=size)
    return meta


def _pixels_of_gaussians(pixels: np.ndarray, count: int) -> np.ndarray:
    """Return the pixels of the Gaussians, [N, 4]."""
    return pixels.reshape(-1, 4)[:count]


def _decode_quats(pixels: np.ndarray) -> np.ndarray:
    """Decode rotations, float32 [N, 4], wxyz.

    Zeros, which are no rotation, replace pixels whose fourth byte is invalid.
    """
    quats = np.zeros((len(pixels), 4))
    largest = pixels[:, 3].astype(np.int64) - 252
    is_valid = largest >= 0
    largest = largest.clip(0)
    np.put_along_axis(
        quats, OTHER_COMPONENTS[largest], (pixels[:, :3] / 255 - 0.5) * np.sqrt(2), axis=1
    )
    largest_value = np.sqrt(np.maximum(0, 1 - (quats**2).sum(axis=1)))
    quats[np.arange(len(quats)), largest] = largest_value
    return np.where(is_valid[:, None], quats, 0).astype(np.float32)


class _PaletteEntries(NamedTuple):
    """The palette of spherical harmonics and its use."""

    entries: np.ndarray  # uint8 [P, K, 3], codes of the spherical harmonics beyond the first
    labels: np.ndarray  # int64 [N], the entry of each Gaussian


class _PaletteShape(NamedTuple):
    """The size of a palette of spherical harmonics."""

    num_entries: int
    bands: int  # bands of spherical harmonics beyond the first


def _palette_shape(files: _Files, palette: Palette | RangedPalette) -> _PaletteShape:
    """Return the size of a palette, which version 1 tells by the size of its image."""
    if isinstance(palette, Palette):
        return _PaletteShape(palette.count, palette.bands)
    name = palette.files[0]
    widths = [_ENTRIES_PER_ROW * num_rest for num_rest in NUM_SH_REST]
    max_height = MAX_PALETTE // _ENTRIES_PER_ROW
    header = image_header(files.read(name, 4 * widths[-1] * max_height + _MAX_META_BYTES))
    if header is None or header.width not in widths[1:] or not 1 <= header.height <= max_height:
        size_text = "no image" if header is None else f"{header.width} x {header.height}"
        raise SceneError(
            f"{files.path}: {name} must be 192, 512 or 960 pixels wide for 1 to 3 bands, and at "
            f"most {max_height} high; got {size_text}"
        )
    return _PaletteShape(_ENTRIES_PER_ROW * header.height, widths.index(header.width))


def _palette_entries(
    files: _Files, names: list[str], shape: _PaletteShape, count: int, max_bytes: int
) -> _PaletteEntries:
    """Read the palette and each Gaussian's entry.

    Args:
        files: the files of the SOG.
        names: the images of the entries and of each Gaussian's entry.
        shape: the size of the palette.
        count: the number of Gaussians.
        max_bytes: the largest size of an image of the Gaussians, bytes.
    """
    row_width = _ENTRIES_PER_ROW * NUM_SH_REST[shape.bands]
    num_rows = -(-shape.num_entries // _ENTRIES_PER_ROW)
    entries = files.pixels(
        names[0],
        4 * row_width * (num_rows + _ENTRIES_PER_ROW) + _MAX_META_BYTES,
        row_width * num_rows,
    )
    if entries.shape[1] != row_width:
        raise SceneError(
            f"{files.path}: {names[0]} must be {row_width} pixels wide for {shape.bands} bands; "
            f"got {entries.shape[1]}"
        )
    low_bytes, high_bytes = _pixels_of_gaussians(files.pixels(names[1], max_bytes, count), count)[
        :, :2
    ].T
    labels = low_bytes | high_bytes.astype(np.int64) << 8
    if labels.max() >= shape.num_entries:
        raise SceneError(
            f"{files.path}: {names[1]} names entry {labels.max()} of a palette of "
            f"{shape.num_entries}"
        )
    return _PaletteEntries(entries[..., :3].reshape(-1, row_width // _ENTRIES_PER_ROW, 3), labels)


# ---- Writing -------------------------------------------------------------------------------------


def write_sog(
    path: str | Path, gaussians: Gaussians, *, notes: Mapping[str, str] | None = None
) -> None:
    """Write a .sog, atomically.

    The Gaussians follow a Morton curve: WebP compresses similar neighbours well.

    Args:
        path: the file.
        gaussians: the Gaussians.
        notes: `up` and `unit`, which `read_sog` returns.
    """
    means = gaussians.means.detach().cpu().numpy().astype(np.float64)
    logs = np.copysign(np.log1p(np.abs(means)), means)
    mins = logs.min(axis=0)
    maxs = logs.max(axis=0)
    span = np.where(maxs > mins, maxs - mins, 1)
    mean_codes = np.rint((logs - mins) / span * _MAX_CODE).astype(np.uint16)
    order = np.argsort(_morton_codes(mean_codes), kind="stable")
    mean_codes = mean_codes[order]
    sh = gaussians.sh.detach().cpu().numpy()[order]
    scales = gaussians.scales.detach().cpu().double().log().numpy()[order]
    opacities = gaussians.opacities.detach().cpu().numpy()[order, None]
    scale_book, scale_codes = _encode_scalars(scales)
    colour_book, colour_codes = _encode_scalars(sh[:, 0])
    alpha = np.rint(255 * opacities).clip(0, 255).astype(np.uint8)
    quats = _encode_quats(gaussians.quats.detach().cpu().double().numpy()[order])
    images = {
        "means_l.webp": _image_of_codes((mean_codes & 255).astype(np.uint8)),
        "means_u.webp": _image_of_codes((mean_codes >> 8).astype(np.uint8)),
        "scales.webp": _image_of_codes(scale_codes),
        "quats.webp": _image_of_codes(quats),
        "sh0.webp": _image_of_codes(np.concatenate([colour_codes, alpha], axis=1)),
    }
    meta = {
        "version": 2,
        "count": len(gaussians),
        "antialias": False,
        "means": {
            "mins": mins.tolist(),
            "maxs": maxs.tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scale_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colour_book, "files": ["sh0.webp"]},
        "climategs": dict(notes or {}),
    }
    if gaussians.sh_degree > 0:
        names = ["shN_centroids.webp", "shN_labels.webp"]
        palette, labels = _build_palette(sh[:, 1:].reshape(len(sh), -1))
        sh_book, codes = _encode_scalars(palette)
        row_width = _ENTRIES_PER_ROW * (sh.shape[1] - 1)
        codes = np.pad(codes, ((0, -len(codes) % _ENTRIES_PER_ROW), (0, 0))).reshape(
            -1, row_width, 3
        )
        label_bytes = np.stack([labels & 255, labels >> 8, 0 * labels], axis=1)
        images |= {names[0]: codes, names[1]: _image_of_codes(label_bytes.astype(np.uint8))}
        palette_facts = {"count": len(palette), "bands": gaussians.sh_degree}
        meta["shN"] = {**palette_facts, "codebook": sh_book, "files": names}
    with write_file_atomically(Path(path)) as file, zipfile.ZipFile(file, "w") as archive:
        archive.writestr(zipfile.ZipInfo(META), json.dumps(meta))
        for name, pixels in images.items():
            archive.writestr(zipfile.ZipInfo(name), _encode_webp(pixels))


def _morton_codes(mean_codes: np.ndarray) -> np.ndarray:
    """Return Morton codes, uint64 [N]: the bits of three 16-bit codes by turns."""
    curve_codes = np.zeros(len(mean_codes), np.uint64)
    for bit in range(16):
        for axis in range(3):
            axis_bit = (mean_codes[:, axis] >> bit & 1).astype(np.uint64)
            curve_codes |= axis_bit << np.uint64(3 * bit + axis)
    return curve_codes


def _image_of_codes(codes: np.ndarray) -> np.ndarray:
    """Return codes [N, 3 or 4] as an image, about as wide as high, its sides multiples of 4."""
    row_width = 4 * int(np.ceil(np.sqrt(len(codes)) / 4))
    num_unused = -len(codes) % (4 * row_width)
    return np.pad(codes, ((0, num_unused), (0, 0))).reshape(-1, row_width, codes.shape[1])


def _encode_webp(pixels: np.ndarray) -> bytes:
    """Encode a lossless WebP that has colours where alpha is 0, too."""
    conversion = cv2.COLOR_RGB2BGR if pixels.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    image = cv2.cvtColor(np.ascontiguousarray(pixels), conversion)
    options = [cv2.IMWRITE_WEBP_LOSSLESS_MODE, cv2.IMWRITE_WEBP_LOSSLESS_PRESERVE_COLOR]
    is_done, data = cv2.imencode(".webp", image, options)
    if not is_done:
        raise SceneError(f"an image of {image.shape[1]} x {image.shape[0]} cannot be a WebP")
    return data.tobytes()


def _encode_quats(wxyz: np.ndarray) -> np.ndarray:
    """Encode rotations as pixels, uint8 [N, 4]."""
    quats = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)[:, None]
    quats *= np.copysign(1, np.take_along_axis(quats, largest, axis=1))
    small_values = np.take_along_axis(quats, OTHER_COMPONENTS[largest[:, 0]], axis=1)
    steps = np.rint((small_values / np.sqrt(2) + 0.5) * 255).clip(0, 255)
    return np.concatenate([steps, 252 + largest], axis=1).astype(np.uint8)


_CODEBOOK_ROUNDS = 20  # rounds of Lloyd's algorithm


def _encode_scalars(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """Return an ascending codebook, and the index of the nearest number for each value, uint8.

    Up to 256 different values are the codebook themselves. For more, Lloyd's rounds (Lloyd 1982,
    method I) start from levels as dense as the cube root of the values' density, which is best for
    many levels (Panter and Dite 1951).
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    levels = np.unique(ordered)
    if len(levels) > CODEBOOK_SIZE:
        counts, edges = np.histogram(ordered, CODEBOOK_SIZE)
        cumulative_density = np.concatenate([[0], np.cumsum(np.cbrt(counts))])
        levels = np.interp(
            (np.arange(CODEBOOK_SIZE) + 0.5) / CODEBOOK_SIZE * cumulative_density[-1],
            cumulative_density,
            edges,
        )
        sums = np.concatenate([[0], np.cumsum(ordered)])
        for _ in range(_CODEBOOK_ROUNDS):
            ends = np.searchsorted(ordered, (levels[1:] + levels[:-1]) / 2)
            ends = np.concatenate([[0], ends, [len(ordered)]])
            level_counts = np.diff(ends)
            levels = np.where(
                level_counts > 0, np.diff(sums[ends]) / np.maximum(level_counts, 1), levels
            )
    levels = np.array([float(f"{level:.9g}") for level in levels.astype(np.float32)])
    codes = np.searchsorted((levels[1:] + levels[:-1]) / 2, values).astype(np.uint8)
    return np.pad(levels, (0, CODEBOOK_SIZE - len(levels)), "edge").tolist(), codes


_NUM_GROUPS = 256  # groups of the first step
_SAMPLE_SIZE = 1 << 16  # rows that the groups are found from
_PALETTE_ROUNDS = 6  # rounds of k-means


def _build_palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return at most MAX_PALETTE rows, and for each of `rows` the index of one that is near it.

    Up to MAX_PALETTE different rows are the palette themselves. More rows are clustered by k-means
    in two steps: into groups, then within each group into as many entries as its share of all
    squared distances allows.
    """
    if len(rows) <= MAX_PALETTE:
        unique, labels = np.unique(rows, axis=0, return_inverse=True)
        return unique, labels.reshape(-1)
    rng = rng_for(seed=0, scene="", effect="augment.files.sog")
    groups = _cluster(rows[rng.permutation(len(rows))[:_SAMPLE_SIZE]], _NUM_GROUPS, rng)
    group_of_row = _nearest_centres(rows, groups)
    squared_distances = np.bincount(
        group_of_row, ((rows - groups[group_of_row]) ** 2).sum(axis=1), len(groups)
    )
    max_entries = (
        np.floor(
            (MAX_PALETTE - len(groups)) * squared_distances / (squared_distances.sum() or 1)
        ).astype(np.int64)
        + 1
    )
    palette = []
    labels = np.empty(len(rows), np.int64)
    start = 0
    for number, max_group_entries in enumerate(max_entries):
        members = np.flatnonzero(group_of_row == number)
        if len(members):
            entries = _cluster(rows[members], min(int(max_group_entries), len(members)), rng)
            palette.append(entries)
            labels[members] = start + _nearest_centres(rows[members], entries)
            start += len(entries)
    return np.concatenate(palette), labels


def _cluster(rows: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the centres of k-means that starts from random rows; empty clusters keep theirs."""
    centres = rows[rng.permutation(len(rows))[:count]]
    for _ in range(_PALETTE_ROUNDS if count < len(rows) else 0):
        labels = _nearest_centres(rows, centres)
        order = np.argsort(labels, kind="stable")
        nonempty_labels, starts = np.unique(labels[order], return_index=True)
        sums = np.add.reduceat(rows[order], starts, axis=0, dtype=np.float64)
        centres[nonempty_labels] = sums / np.diff(starts, append=len(rows))[:, None]
    return centres


def _nearest_centres(rows: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the index of the nearest centre of each row."""
    half_squares = 0.5 * (centres**2).sum(axis=1)
    rows_at_once = max(1, (1 << 24) // len(centres))
    parts = [
        (half_squares - rows[start : start + rows_at_once] @ centres.T).argmin(axis=1)
        for start in range(0, len(rows), rows_at_once)
    ]
    return np.concatenate(parts)


def _export(path: Path, gaussians: Gaussians, facts: Mapping[str, str]) -> None:
    """Write a scene's Gaussians with y down: viewers turn them as they turn a .ply.

    meta.json says `up` and `unit` as a .ply's comments do.
    """
    z_to_minus_y = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    notes = {key: facts[key] for key in ("up", "unit") if key in facts}
    if "up" in notes:
        notes["up"] = "-y"
    zero = torch.zeros(3, dtype=torch.float64)
    write_sog(path, transform_gaussians_rigidly(gaussians, z_to_minus_y, zero), notes=notes)


def describe_sog(path: Path) -> FileFacts:
    """Return the facts of a SOG's meta.json."""
    with contextlib.closing(_Files(path)) as files:
        meta = _read_meta(files)
    if isinstance(meta, SogMetaVersion1):
        return FileFacts(version="version 1")
    notes = meta.climategs
    return FileFacts(
        version="version 2",
        writer=meta.asset.generator[:80] or ("ClimateGS" if notes else ""),
        up=notes.get("up", ""),
        unit=notes.get("unit", ""),
        warnings=(ANTIALIASED_WARNING,) if meta.antialias else (),
    )


SOG = SplatFormat(
    name=".sog",
    describe=describe_sog,
    viewer_up="-y",
    reader=read_sog,
    suffixes=(SUFFIX,),
    first_bytes=(_ZIP,),
    file_names=(META,),
    writer=SplatWriter(
        kind="sog",
        suffix=SUFFIX,
        write=_export,
        world_losses=(Loss("cameras are left out"),),
        value_losses=(
            Loss(
                "places are rounded to 0.1 mm at the origin, 1 cm at 100 m and 10 cm at 1 km from "
                "it, rotations to 1 degree, opacities to 8 bits, scales and colours to the nearest "
                "of 256 each"
            ),
            Loss(
                f"SH is rounded to the nearest of {MAX_PALETTE} sets, where there are more",
                has_directional_colors,
            ),
        ),
    ),
)
