"""The pictures of a report: small JPEGs inside the page, within a budget of bytes."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from augment.files.image_size import image_header
from augment.jobs.files import decode_image, decode_png, depth_in_metres
from augment.semantics import SemanticClass
from tools.report_files import ReportFiles
from tools.report_html import Html

MAX_PIXELS = 1 << 26  # of one image: what an untrusted file may make the decoder allocate
_QUALITIES = (82, 74, 64, 52, 40)
_NO_DEPTH = (128, 128, 128)
_NEAREST_M = 0.5

# Told apart by eye, and close to what people know from Cityscapes.
CLASS_COLORS: dict[SemanticClass, tuple[int, int, int]] = {
    SemanticClass.UNKNOWN: (40, 40, 40),
    SemanticClass.ROAD: (128, 64, 128),
    SemanticClass.LANE_MARKING: (235, 235, 235),
    SemanticClass.SIDEWALK: (244, 35, 232),
    SemanticClass.TERRAIN: (152, 200, 130),
    SemanticClass.VEGETATION: (90, 130, 40),
    SemanticClass.BUILDING: (95, 95, 110),
    SemanticClass.BARRIER: (190, 153, 153),
    SemanticClass.POLE: (170, 150, 90),
    SemanticClass.SIGN: (240, 210, 0),
    SemanticClass.VEHICLE: (20, 40, 190),
    SemanticClass.TWO_WHEELER: (130, 20, 40),
    SemanticClass.PEDESTRIAN: (230, 30, 60),
    SemanticClass.OTHER: (250, 150, 50),
    SemanticClass.SKY: (130, 190, 235),
    SemanticClass.WATER: (0, 120, 140),
    SemanticClass.SNOW: (205, 225, 255),
}


@dataclass(frozen=True)
class Picture:
    """uri: a JPEG inside the page. width, height: of it, pixels."""

    uri: Html
    width: int
    height: int


@dataclass(frozen=True)
class Buffer:
    """A picture of a depth map, a class map or a mask. note: its range; classes: what it shows."""

    title: str
    picture: Picture
    note: str = ""
    classes: tuple[SemanticClass, ...] = ()
    is_depth: bool = False


def read_picture(row: dict[str, Any], files: ReportFiles) -> np.ndarray | None:
    """uint8 [H, W, 3] RGB of a manifest's row; None, and noted, where the file is damaged."""
    path = row["image_path"]
    if path is None:
        return None
    data = _small_enough(path, files)
    if data is None:
        return None
    if row["checksum"] and hashlib.sha256(data).hexdigest() != row["checksum"]:
        return files.note(path, "its SHA-256 is not the manifest's: the file was changed")
    return _decoded(path, files, lambda: decode_image(data))


def read_buffers(row: dict[str, Any], files: ReportFiles, width: int, most: int) -> list[Buffer]:
    """Pictures of what else was written beside an image: depth, classes, masks.

    width: pixels at most. most: bytes of each.
    """
    found = []
    if (depth := _read_png(row, "depth", np.uint16, files)) is not None:
        metres = depth_in_metres(_shrunk(depth, width))
        rgb, note = color_depth(metres)
        found.append(Buffer("Depth", embed(rgb, width, most), note, is_depth=True))
    if (classes := _read_png(row, "semantic", np.uint8, files)) is not None:
        small = _shrunk(classes, width)
        present = tuple(c for c in SemanticClass if (small == c).mean() > 0.001)
        picture = embed(color_classes(small), width, most)
        found.append(Buffer("Semantic classes", picture, classes=present))
    for kind, title in (("water", "Water mask"), ("snow", "Snow mask")):
        if (mask := _read_png(row, kind, np.uint8, files)) is not None:
            covered = float((mask > 0).mean())
            rgb = cv2.cvtColor(_shrunk(mask, width), cv2.COLOR_GRAY2RGB)
            found.append(Buffer(title, embed(rgb, width, most), f"{100 * covered:.0f} % of pixels"))
    return found


def color_depth(depth_m: np.ndarray) -> tuple[np.ndarray, str]:
    """uint8 [H, W, 3] and its range: the logarithm between the 1st and the 99th percentile.

    depth_m: float32 [H, W], 0 = none, which is grey.
    """
    there = depth_m > 0
    rgb = np.empty((*depth_m.shape, 3), np.uint8)
    rgb[...] = _NO_DEPTH
    if not there.any():
        return rgb, "nowhere"
    near, far = np.percentile(depth_m[there], [1, 99])
    near = max(float(near), _NEAREST_M)
    far = max(float(far), 1.01 * near)
    place = np.log(np.maximum(depth_m, _NEAREST_M) / near) / np.log(far / near)
    levels = np.rint(255 * (1 - np.clip(place, 0, 1))).astype(np.uint8)
    turbo = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    rgb[there] = turbo[there]
    return rgb, f"{near:.1f} m to {far:.0f} m"


def depth_gradient() -> str:
    """CSS stops of `color_depth`'s colours, near to far."""
    levels = np.linspace(255, 0, 9).astype(np.uint8)[:, None]
    stops = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[:, 0, ::-1]
    return ",".join("rgb({} {} {})".format(*stop) for stop in stops.tolist())


def color_classes(classes: np.ndarray) -> np.ndarray:
    """uint8 [H, W] -> [H, W, 3]; numbers that are no class are black."""
    palette = np.zeros((256, 3), np.uint8)
    for known, color in CLASS_COLORS.items():
        palette[known] = color
    return palette[classes]


def embed(rgb: np.ndarray, width: int, most: int) -> Picture:
    """A JPEG of at most `width` pixels across and about `most` bytes: quality gives way, then size.

    rgb: uint8 [H, W, 3]. A picture much taller than wide is at most 1.5 times as tall as `width`.
    """
    data, small = b"", rgb
    for _ in range(8):
        height = round(rgb.shape[0] * width / rgb.shape[1])
        if height > 1.5 * width:
            height, width = round(1.5 * width), max(1, round(1.5 * width * width / height))
        if width < rgb.shape[1]:
            small = cv2.resize(rgb, (width, max(1, height)), interpolation=cv2.INTER_AREA)
        for quality in _QUALITIES:
            data = _jpeg(small, quality)
            if len(data) <= most:
                return _picture(data, small)
        width = max(8, min(width, rgb.shape[1]) * 3 // 4)
    return _picture(data, small)


def _picture(data: bytes, rgb: np.ndarray) -> Picture:
    uri = "data:image/jpeg;base64," + base64.b64encode(data).decode()
    return Picture(Html(uri), rgb.shape[1], rgb.shape[0])


def _jpeg(rgb: np.ndarray, quality: int) -> bytes:
    bgr = np.ascontiguousarray(rgb[..., ::-1])
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"OpenCV could not encode {list(rgb.shape)} as JPEG")
    return data.tobytes()


def _read_png(row: dict[str, Any], kind: str, dtype: type, files: ReportFiles) -> np.ndarray | None:
    path = row[f"{kind}_path"]
    if path is None:
        return None
    data = _small_enough(path, files)
    return None if data is None else _decoded(path, files, lambda: decode_png(data, dtype))


def _small_enough(path: str, files: ReportFiles) -> bytes | None:
    data = files.read(path)
    if data is None:
        return None
    header = image_header(data)
    if header is None:
        return files.note(path, f"no readable image ({len(data)} bytes)")
    if header.width * header.height > MAX_PIXELS:
        return files.note(path, f"{header.width}x{header.height} pixels: not looked at")
    return data


def _decoded(path: str, files: ReportFiles, decode: Callable[[], np.ndarray]) -> np.ndarray | None:
    try:
        return decode()
    except ValueError as error:
        return files.note(path, str(error))


def _shrunk(image: np.ndarray, width: int) -> np.ndarray:
    """Without new values: a mean of two classes is a third one."""
    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
