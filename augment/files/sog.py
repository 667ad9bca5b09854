"""Gaussians in SOG files of version 2 (PlayCanvas): meta.json and lossless images, in a folder or
zipped as .sog.

A pixel of each image is a Gaussian: 16 bits of each coordinate's signed logarithm, rotations by
their three smaller components, logarithms of scales and colours by codebooks of 256 numbers,
opacities, and bands of spherical harmonics as entries of one palette. Facts by
developer.playcanvas.com, "The SOG Format", and github.com/playcanvas/splat-transform,
src/lib/readers/read-sog.ts (MIT), where the two differ: scales are logarithms, the first
component of a rotation is w, and the axes are those of the .ply that it was made from. So
meta.json of the files written here says which axis is up and what a unit is, in a field
"climategs" that others ignore.
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
from typing import Annotated, Literal, NamedTuple

import cv2
import numpy as np
import torch
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from augment.errors import SceneError
from augment.files.image_size import image_header
from augment.files.limits import check_memory, parsed_json, row_slices
from augment.files.ply import SplatFile
from augment.files.scene_file import checked
from augment.jobs.atomic import replaced_file
from augment.rng import rng_for
from augment.scene import Gaussians, check_gaussians
from recipes.files import open_file

SUFFIX, META = ".sog", "meta.json"
ZIP = b"PK\x03\x04"
_LEVELS = 256  # of a codebook
_STEPS = 65535  # of a coordinate
_COEFFICIENTS = (0, 3, 8, 15)  # a channel beyond the first, by bands
_ROW = 64  # entries of the palette in a row of its image
MAX_PALETTE = 1 << 16
_MAX_META_BYTES = 1 << 20
_MAX_SPARE = 1 << 16  # pixels beyond as many again as there are Gaussians

_DAMAGED = (OSError, EOFError, RuntimeError, ValueError, struct.error, zipfile.BadZipFile)
_DAMAGED += (zlib.error, lzma.LZMAError)

# ---- meta.json -----------------------------------------------------------------------------------


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False, strict=True)


def _patched(codebook: object) -> object:
    """Early files have null as the first number; PlayCanvas takes this for it."""
    if isinstance(codebook, list) and codebook[:1] == [None] and len(codebook) == _LEVELS:
        second, last = codebook[1], codebook[-1]
        if isinstance(second, int | float) and isinstance(last, int | float):
            return [second + (second - last) / (_LEVELS - 1), *codebook[1:]]
    return codebook


Codebook = Annotated[
    list[float], BeforeValidator(_patched), Field(min_length=_LEVELS, max_length=_LEVELS)
]
Three = Annotated[list[float], Field(min_length=3, max_length=3)]
OneFile = Annotated[list[str], Field(min_length=1, max_length=1)]
TwoFiles = Annotated[list[str], Field(min_length=2, max_length=2)]


class _Means(_Part):
    mins: Three
    maxs: Three
    files: TwoFiles


class _Coded(_Part):
    codebook: Codebook
    files: OneFile


class _Quats(_Part):
    files: OneFile


class _Palette(_Part):
    count: int = Field(ge=1, le=MAX_PALETTE)
    bands: int = Field(ge=1, le=3)
    codebook: Codebook
    files: TwoFiles


class _Meta(_Part):
    version: Literal[2]
    count: int = Field(ge=1)
    means: _Means
    scales: _Coded
    quats: _Quats
    sh0: _Coded
    shN: _Palette | None = None
    climategs: dict[str, str] = {}


# ---- Reading -------------------------------------------------------------------------------------


class _Files:
    """The files beside meta.json, in its folder or in the same zip; each only by a plain name."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.zip = None if path.name == META else zipfile.ZipFile(path)

    def close(self) -> None:
        if self.zip is not None:
            self.zip.close()

    def read(self, name: str, most: int) -> bytes:
        """At most so many bytes."""
        if name in ("", ".", "..") or any(mark in name for mark in "/\\\0"):
            raise SceneError(
                f"{self.path} names the file {name!r}; names must be of files beside {META}"
            )
        if self.zip is None:
            path = self.path.parent / name
            if path.resolve().parent != self.path.parent.resolve():
                raise SceneError(f"{path} is a link out of its folder; put the file itself there")
            with open_file(path) as file:
                data = file.read(most + 1)
        else:
            with self.zip.open(name) as file:
                data = file.read(most + 1)
        if len(data) > most:
            raise SceneError(f"{self.path}: {name} is larger than the {most} bytes it may have")
        return data

    def pixels(self, name: str, most: int, count: int | None = None) -> np.ndarray:
        """uint8 [H, W, 4], RGBA, of a lossless image; of at least `count` pixels and not far more.
        most: its bytes."""
        data = self.read(name, most)
        header, where = image_header(data), f"{self.path}: {name}"
        if header is None or header.format not in ("WebP", "PNG") or data[12:16] == b"VP8 ":
            found = "another format" if header is None else f"a lossy or other {header.format}"
            raise SceneError(f"{where} must be a lossless WebP or a PNG; it is {found}")
        size = header.width * header.height
        if count is not None and not count <= size <= 2 * count + _MAX_SPARE:
            raise SceneError(
                f"{where} has {header.width} x {header.height} pixels for {count} Gaussians: "
                f"{count} to {2 * count + _MAX_SPARE} are expected"
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
    """Whether it holds the files of a SOG, by the names that they usually have."""
    return (folder / META).is_file() and (folder / "means_l.webp").is_file()


def read_sog(path: str | Path) -> SplatFile:
    """Read a .sog, or the meta.json of a folder. Notes are what the file says of `up` and `unit`.
    Raises SceneError: missing, truncated or damaged files, or another version.
    """
    path = Path(path)
    raw, notes = read_stored_sog(path)
    gaussians, problems = check_gaussians(raw, where=str(path))
    return SplatFile(gaussians, notes=notes, problems=problems)


def read_stored_sog(path: Path) -> tuple[Gaussians, dict[str, str]]:
    """All Gaussians of a .sog in the file's order, those that cannot be drawn among them, and its
    notes. Raises SceneError: as `read_sog`.
    """
    try:
        with contextlib.closing(_Files(path)) as files:
            return _read(files)
    except KeyError as error:
        raise SceneError(f"{path}: not a whole .sog file: {error.args[0]}") from error
    except FileNotFoundError as error:
        raise SceneError(f"{path} names {error.filename}, which is missing") from error
    except _DAMAGED as error:
        raise SceneError(
            f"{path}: not a whole .sog file ({error}); copy or export it again"
        ) from error


def _read(files: _Files) -> tuple[Gaussians, dict[str, str]]:
    meta = _meta(files)
    count, most = meta.count, max(2 * meta.count, _MAX_META_BYTES) * 4
    low, high = (_rows(files.pixels(name, most, count), count) for name in meta.means.files)
    colours = _rows(files.pixels(meta.sh0.files[0], most, count), count)
    scales = _rows(files.pixels(meta.scales.files[0], most, count), count)
    quats = _rows(files.pixels(meta.quats.files[0], most, count), count)
    palette = None if meta.shN is None else _palette_entries(files, meta.shN, count, most)
    bands = 0 if meta.shN is None else meta.shN.bands
    raw = Gaussians(
        means=torch.empty(count, 3),
        quats=torch.empty(count, 4),
        scales=torch.empty(count, 3),
        opacities=torch.empty(count),
        sh=torch.empty(count, 1 + _COEFFICIENTS[bands], 3),
    )
    arrays = {name: getattr(raw, name).numpy() for name in ("means", "quats", "scales", "sh")}
    mins, maxs = np.array(meta.means.mins), np.array(meta.means.maxs)
    for rows in row_slices(count):
        fixed = low[rows, :3] | high[rows, :3].astype(np.uint16) << 8
        with np.errstate(over="ignore", invalid="ignore"):  # overflow is left out, and reported
            logs = mins + (maxs - mins) * (fixed / _STEPS)
            arrays["means"][rows] = np.copysign(np.expm1(np.abs(logs)), logs)
            arrays["scales"][rows] = np.exp(_decoded(meta.scales.codebook, scales[rows, :3]))
        arrays["quats"][rows] = _turns(quats[rows])
        arrays["sh"][rows, 0] = _decoded(meta.sh0.codebook, colours[rows, :3])
        if palette is not None and meta.shN is not None:
            coded = palette.entries[palette.labels[rows]]
            arrays["sh"][rows, 1:] = _decoded(meta.shN.codebook, coded)
        raw.opacities.numpy()[rows] = colours[rows, 3] / 255.0
    return raw, {key: meta.climategs[key] for key in ("up", "unit") if key in meta.climategs}


def _meta(files: _Files) -> _Meta:
    where = str(files.path) if files.zip is None else f"{files.path}: {META}"
    content = parsed_json(files.read(META, _MAX_META_BYTES), where)
    if "means" not in content:
        raise SceneError(f"{where} does not describe splats: it has no 'means'")
    if content.get("version") != 2:
        raise SceneError(
            f"{where}: only version 2 of SOG is read; got {content.get('version')!r:.20}. Save it "
            f"anew with SplatTransform or SuperSplat, or as .ply"
        )
    meta = checked(_Meta, content, where)
    names = [*meta.means.files, *meta.scales.files, *meta.quats.files, *meta.sh0.files]
    names += [] if meta.shN is None else meta.shN.files
    size = files.path.stat().st_size
    if files.zip is None:
        size = sum((files.path.parent / Path(name).name).stat().st_size for name in {*names})
    bands = 0 if meta.shN is None else meta.shN.bands
    check_memory(where, meta.count, functions=1 + _COEFFICIENTS[bands], size=size)
    return meta


def _rows(pixels: np.ndarray, count: int) -> np.ndarray:
    return pixels.reshape(-1, 4)[:count]


def _decoded(codebook: list[float], indices: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return np.array(codebook).astype(np.float32)[indices]


def _turns(pixels: np.ndarray) -> np.ndarray:
    """float32 [N, 4], wxyz; zeros, which no rotation is, where the fourth byte is not one."""
    quats = np.zeros((len(pixels), 4))
    largest = pixels[:, 3].astype(np.int64) - 252
    known, largest = largest >= 0, largest.clip(0)
    np.put_along_axis(quats, _OTHERS[largest], (pixels[:, :3] / 255 - 0.5) * np.sqrt(2), axis=1)
    rest = np.sqrt(np.maximum(0, 1 - (quats**2).sum(axis=1)))
    quats[np.arange(len(quats)), largest] = rest
    return np.where(known[:, None], quats, 0).astype(np.float32)


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


class _PaletteEntries(NamedTuple):
    """entries: uint8 [P, K, 3], codes of the spherical harmonics beyond the first. labels: int64
    [N], the entry of each Gaussian.
    """

    entries: np.ndarray
    labels: np.ndarray


def _palette_entries(files: _Files, palette: _Palette, count: int, most: int) -> _PaletteEntries:
    wide, rows = _ROW * _COEFFICIENTS[palette.bands], -(-palette.count // _ROW)
    entries = files.pixels(
        palette.files[0], 4 * wide * (rows + _ROW) + _MAX_META_BYTES, wide * rows
    )
    if entries.shape[1] != wide:
        raise SceneError(
            f"{files.path}: {palette.files[0]} must be {wide} pixels wide for {palette.bands} "
            f"bands; got {entries.shape[1]}"
        )
    low, high = _rows(files.pixels(palette.files[1], most, count), count)[:, :2].T
    labels = low | high.astype(np.int64) << 8
    if labels.max() >= palette.count:
        raise SceneError(
            f"{files.path}: {palette.files[1]} names entry {labels.max()} of a palette of "
            f"{palette.count}"
        )
    return _PaletteEntries(entries[..., :3].reshape(-1, wide // _ROW, 3), labels)


# ---- Writing -------------------------------------------------------------------------------------


def write_sog(
    path: str | Path, gaussians: Gaussians, *, notes: Mapping[str, str] | None = None
) -> None:
    """Write a .sog, atomically, its Gaussians along a Morton curve: WebP packs neighbours that are
    alike. notes: `up` and `unit`, given back by `read_sog`.
    """
    means = gaussians.means.detach().cpu().numpy().astype(np.float64)
    logs = np.copysign(np.log1p(np.abs(means)), means)
    mins, maxs = logs.min(axis=0), logs.max(axis=0)
    span = np.where(maxs > mins, maxs - mins, 1)
    fixed = np.rint((logs - mins) / span * _STEPS).astype(np.uint16)
    order = np.argsort(_along_curve(fixed), kind="stable")
    fixed = fixed[order]
    sh = gaussians.sh.detach().cpu().numpy()[order]
    scales = gaussians.scales.detach().cpu().double().log().numpy()[order]
    opacities = gaussians.opacities.detach().cpu().numpy()[order, None]
    scale_book, scale_codes = _coded(scales)
    colour_book, colour_codes = _coded(sh[:, 0])
    alpha = np.rint(255 * opacities).clip(0, 255).astype(np.uint8)
    quats = _packed_turns(gaussians.quats.detach().cpu().double().numpy()[order])
    images = {
        "means_l.webp": _square((fixed & 255).astype(np.uint8)),
        "means_u.webp": _square((fixed >> 8).astype(np.uint8)),
        "scales.webp": _square(scale_codes),
        "quats.webp": _square(quats),
        "sh0.webp": _square(np.concatenate([colour_codes, alpha], axis=1)),
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
        palette, labels = _palette(sh[:, 1:].reshape(len(sh), -1))
        book, codes = _coded(palette)
        wide = _ROW * (sh.shape[1] - 1)
        codes = np.pad(codes, ((0, -len(codes) % _ROW), (0, 0))).reshape(-1, wide, 3)
        bytes_of_label = np.stack([labels & 255, labels >> 8, 0 * labels], axis=1)
        images |= {names[0]: codes, names[1]: _square(bytes_of_label.astype(np.uint8))}
        facts = {"count": len(palette), "bands": gaussians.sh_degree}
        meta["shN"] = {**facts, "codebook": book, "files": names}
    with replaced_file(Path(path)) as file, zipfile.ZipFile(file, "w") as archive:
        archive.writestr(zipfile.ZipInfo(META), json.dumps(meta))
        for name, pixels in images.items():
            archive.writestr(zipfile.ZipInfo(name), _webp(pixels))


def _along_curve(fixed: np.ndarray) -> np.ndarray:
    """uint64 [N]: the bits of three 16-bit coordinates by turns."""
    bits = np.zeros(len(fixed), np.uint64)
    for bit in range(16):
        for axis in range(3):
            one = (fixed[:, axis] >> bit & 1).astype(np.uint64)
            bits |= one << np.uint64(3 * bit + axis)
    return bits


def _square(codes: np.ndarray) -> np.ndarray:
    """[N, 3 or 4] as an image of sides that are multiples of 4, about as wide as high."""
    wide = 4 * int(np.ceil(np.sqrt(len(codes)) / 4))
    spare = -len(codes) % (4 * wide)
    return np.pad(codes, ((0, spare), (0, 0))).reshape(-1, wide, codes.shape[1])


def _webp(pixels: np.ndarray) -> bytes:
    """Lossless, with colours where alpha is 0 too."""
    order = cv2.COLOR_RGB2BGR if pixels.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    image = cv2.cvtColor(np.ascontiguousarray(pixels), order)
    mode = [cv2.IMWRITE_WEBP_LOSSLESS_MODE, cv2.IMWRITE_WEBP_LOSSLESS_PRESERVE_COLOR]
    is_done, data = cv2.imencode(".webp", image, mode)
    if not is_done:
        raise SceneError(f"an image of {image.shape[1]} x {image.shape[0]} cannot be a WebP")
    return data.tobytes()


def _packed_turns(wxyz: np.ndarray) -> np.ndarray:
    quats = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)[:, None]
    quats *= np.copysign(1, np.take_along_axis(quats, largest, axis=1))
    others = np.take_along_axis(quats, _OTHERS[largest[:, 0]], axis=1)
    steps = np.rint((others / np.sqrt(2) + 0.5) * 255).clip(0, 255)
    return np.concatenate([steps, 252 + largest], axis=1).astype(np.uint8)


_ROUNDS = 20


def _coded(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """A codebook, ascending, and the nearest of its numbers to each value, uint8.

    The numbers themselves where there are no more than 256; else Lloyd's rounds (Lloyd 1982, method
    I) from levels as dense as the cube root of values' density, which is best for many levels
    (Panter and Dite 1951).
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    levels = np.unique(ordered)
    if len(levels) > _LEVELS:
        counts, edges = np.histogram(ordered, _LEVELS)
        dense = np.concatenate([[0], np.cumsum(np.cbrt(counts))])
        levels = np.interp((np.arange(_LEVELS) + 0.5) / _LEVELS * dense[-1], dense, edges)
        sums = np.concatenate([[0], np.cumsum(ordered)])
        for _ in range(_ROUNDS):
            ends = np.searchsorted(ordered, (levels[1:] + levels[:-1]) / 2)
            ends = np.concatenate([[0], ends, [len(ordered)]])
            held = np.diff(ends)
            levels = np.where(held > 0, np.diff(sums[ends]) / np.maximum(held, 1), levels)
    levels = np.array([float(f"{level:.9g}") for level in levels.astype(np.float32)])
    codes = np.searchsorted((levels[1:] + levels[:-1]) / 2, values).astype(np.uint8)
    return np.pad(levels, (0, _LEVELS - len(levels)), "edge").tolist(), codes


_COARSE, _SAMPLE = 256, 1 << 16
_PALETTE_ROUNDS = 6


def _palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most MAX_PALETTE rows, and for each of `rows` the number of one that is near it.

    All of them where they are no more; else k-means in two steps: groups, then within each of them
    as many entries as its share of all squared distances allows.
    """
    if len(rows) <= MAX_PALETTE:
        unique, labels = np.unique(rows, axis=0, return_inverse=True)
        return unique, labels.reshape(-1)
    rng = rng_for(seed=0, scene="", effect="augment.files.sog")
    groups = _clustered(rows[rng.permutation(len(rows))[:_SAMPLE]], _COARSE, rng)
    group = _nearest(rows, groups)
    spread = np.bincount(group, ((rows - groups[group]) ** 2).sum(axis=1), len(groups))
    able = np.floor((MAX_PALETTE - len(groups)) * spread / (spread.sum() or 1)).astype(np.int64) + 1
    palette, labels, start = [], np.empty(len(rows), np.int64), 0
    for number, most in enumerate(able):
        members = np.flatnonzero(group == number)
        if len(members):
            entries = _clustered(rows[members], min(int(most), len(members)), rng)
            palette.append(entries)
            labels[members] = start + _nearest(rows[members], entries)
            start += len(entries)
    return np.concatenate(palette), labels


def _clustered(rows: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """k-means from rows drawn at random; centres that lose their rows stay where they are."""
    centres = rows[rng.permutation(len(rows))[:count]]
    for _ in range(_PALETTE_ROUNDS if count < len(rows) else 0):
        labels = _nearest(rows, centres)
        order = np.argsort(labels, kind="stable")
        held, starts = np.unique(labels[order], return_index=True)
        sums = np.add.reduceat(rows[order], starts, axis=0, dtype=np.float64)
        centres[held] = sums / np.diff(starts, append=len(rows))[:, None]
    return centres


def _nearest(rows: np.ndarray, centres: np.ndarray) -> np.ndarray:
    half = 0.5 * (centres**2).sum(axis=1)
    piece = max(1, (1 << 24) // len(centres))
    parts = [
        (half - rows[start : start + piece] @ centres.T).argmin(axis=1)
        for start in range(0, len(rows), piece)
    ]
    return np.concatenate(parts)
