"""The pictures of a report: which images it shows, and small JPEGs of them within a budget.

The choice is evenly spread and the same every time. A file that cannot be read is noted, and does
not stop the report.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar
from urllib.parse import quote

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from markupsafe import Markup

from augment.errors import OutputError
from augment.files.image_size import image_header
from augment.jobs.files import decode_image, decode_png, depth_in_metres
from augment.jobs.layout import mask_names
from augment.jobs.store import Store, StoredFile, StoredFileMissing
from augment.jobs.tables import read_table
from augment.semantics import SemanticClass
from tools.drawing import color_mapped, resized
from tools.report_numbers import Draws, weather_text

Value = TypeVar("Value")
MAX_FILE = 1 << 28  # bytes; a report needs no larger one
MAX_PROBLEMS = 50  # that the page lists
MAX_PIXELS = 1 << 26  # of one image: what an untrusted file may make the decoder allocate
BUDGET = 3_100_000  # bytes of all pictures; a third more as text of the page
MAX_IMAGES = 400  # more of them could not be told apart within the budget
_MAX_VARIANTS = 6  # of one comparison
_SAMPLE = 4  # pictures: an image, its depth, its classes, and a mask
# Pixels across, and bytes at most of one picture.
_LARGE, _LARGE_BYTES = 1120, 130_000
_SMALL, _SMALL_BYTES = 400, 40_000
_BUFFER, _BUFFER_BYTES = 480, 45_000
_QUALITIES = (82, 74, 64, 52, 40)
_NO_DEPTH = (128, 128, 128)
_NEAREST_M = 0.5
# Multiples of either, less their whole parts, fill an interval evenly however many there are.
_GOLDEN, _SILVER = (math.sqrt(5) - 1) / 2, math.sqrt(2) - 1

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


@dataclass
class ReportFiles:
    """The files of one output. listing: of the whole store.

    problems: why files could not be read, by path. unlisted: how many more there are.
    """

    store: Store
    listing: Mapping[str, StoredFile]
    problems: dict[str, str] = field(default_factory=dict)
    unlisted: int = 0

    def read(self, path: str) -> bytes | None:
        """The file's content; None, and noted, where there is none that can be used."""
        stored = self.listing.get(path)
        if stored is not None and stored.size > MAX_FILE:
            return self.note(path, f"larger than {MAX_FILE >> 20} MiB: not looked at")
        try:
            return self.store.read(path)
        except StoredFileMissing:
            return self.note(path, "missing")
        except OutputError as error:
            # A page that is handed on says nothing of the machine that it was made on.
            return self.note(path, str(error).replace(self.store.uri, "OUT"))

    def read_columns(self, path: str, names: tuple[str, ...]) -> pa.Table | None:
        """Those of `names` that a Parquet file has; None, and noted, where it is none."""
        data = self.read(path)
        if data is None:
            return None
        try:
            return read_table(data, path, names)
        except OutputError as error:
            return self.note(path, str(error))

    def read_image(self, path: str | None, checksum: str | None = None) -> bytes | None:
        """The bytes of an image of no more than MAX_PIXELS; None, and noted, of anything else."""
        data = None if path is None else self.read(path)
        if path is None or data is None:
            return None
        header = image_header(data)
        if header is None:
            return self.note(path, f"no readable image ({len(data)} bytes)")
        if header.width * header.height > MAX_PIXELS:
            return self.note(path, f"{header.width}x{header.height} pixels: not looked at")
        if checksum and hashlib.sha256(data).hexdigest() != checksum:
            return self.note(path, "its SHA-256 is not the manifest's: the file was changed")
        return data

    def decoded(self, path: str, decode: Callable[[], np.ndarray]) -> np.ndarray | None:
        """What `decode` returns; None, and noted, where it finds the file damaged."""
        try:
            return decode()
        except ValueError as error:
            return self.note(path, str(error))

    def note(self, path: str, why: str) -> None:
        """Remember that a file is damaged."""
        if path in self.problems:
            return
        if len(self.problems) < MAX_PROBLEMS:
            self.problems[path] = why
        else:
            self.unlisted += 1


def evenly(values: Sequence[Value], most: int) -> list[Value]:
    """At most `most` of them in their order, from the middles of as many equal parts."""
    number = min(most, len(values))
    return [values[(2 * i + 1) * len(values) // (2 * number)] for i in range(number)]


def first_of_each(table: pa.Table, column: str) -> list[int]:
    """Row numbers where a value of the column stands first, in the table's order."""
    codes = table[column].combine_chunks().dictionary_encode().indices.to_numpy()
    _, first = np.unique(codes, return_index=True)
    return sorted(int(row) for row in first)


def pick_images(table: pa.Table, number: int, shift: int = 0) -> list[dict[str, Any]]:
    """At most `number` rows: one each of evenly chosen variants, wandering over frames and cameras.

    Evenly spaced rows would mostly show one camera: the numbers of frames and cameras divide them.
    shift: of the place, so that calls for one row each do not all take the same.
    """
    starts = first_of_each(table, "draw")
    bounds = [*starts, table.num_rows]
    rows: list[int] = []
    for i in range(min(number, table.num_rows)):
        within = (0.5 + (i + shift) * _GOLDEN) % 1
        group = int((i + within) * len(starts) / min(number, table.num_rows))
        low, size = bounds[group], bounds[group + 1] - bounds[group]
        inside = int(size * ((0.5 + (i + shift) * _SILVER) % 1))
        free = [low + (inside + k) % size for k in range(size)]
        rows += [next(row for row in free if row not in rows)] if set(free) - set(rows) else []
    return table.take(pa.array(sorted(rows), pa.int64())).to_pylist()


class Place(NamedTuple):
    """What several variants show of one scene, frame and camera. rows: of the manifest, those
    without weather first; clear: which of them are.
    """

    scene: str
    frame: int
    camera: str
    rows: tuple[dict[str, Any], ...]
    clear: tuple[bool, ...]


def pick_places(table: pa.Table, draws: Draws, places: int, variants: int) -> list[Place]:
    """Scenes evenly chosen, and in each the frame and camera that most variants show.

    Those without weather come first, then at most one of each recipe until there are none left.
    Only scenes in which two variants show the same are taken, those with weather and without first.
    """
    clear = set(draws.draw[draws.clear].tolist())
    names, candidates = sorted(pc.unique(table["scene"]).to_pylist()), []
    for name in evenly(names, 8 * places):  # reading rows of thousands of scenes takes seconds
        place = _place_of(table.filter(pc.equal(table["scene"], name)), name, clear, variants)
        if place is not None:
            candidates.append(place)
    paired = [place for place in candidates if any(place.clear) and not all(place.clear)]
    return evenly(paired or candidates, places)


def _place_of(rows: pa.Table, scene: str, clear: set[int], variants: int) -> Place | None:
    counted = rows.group_by(["frame", "camera"], use_threads=False)
    seen = counted.aggregate([("draw", "count_distinct")]).to_pylist()
    most = max(entry["draw_count_distinct"] for entry in seen)
    if most < 2:
        return None
    full = [e for e in seen if e["draw_count_distinct"] == most]
    # The camera that looks ahead first, as far as names tell.
    cameras = {e["camera"] for e in full}
    camera = min(cameras, key=lambda name: ("front" not in name.lower(), len(name), name))
    frames = sorted(e["frame"] for e in full if e["camera"] == camera)
    frame = frames[len(frames) // 2]
    here = pc.and_(pc.equal(rows["frame"], frame), pc.equal(rows["camera"], camera))
    shown = rows.filter(here).to_pylist()
    bare = [row for row in shown if row["draw"] in clear]
    weathered = [row for row in shown if row["draw"] not in clear]
    others = weathered or bare[1:]
    # Of each recipe its first variant; all of them where there is one recipe only.
    first = {row["recipe"]: row for row in reversed(others)}
    if len(first) >= 2:
        others = [row for row in others if first[row["recipe"]] is row]
    chosen = bare[:1] + evenly(others, variants - len(bare[:1]))
    return Place(scene, frame, camera, tuple(chosen), tuple(r["draw"] in clear for r in chosen))


class Picture(NamedTuple):
    """uri: a JPEG inside the page. width, height: of it, pixels."""

    uri: Markup
    width: int
    height: int


class Figure(NamedTuple):
    """A picture with its caption. link: to the file beside the page. depth: its caption shows the
    colours of depths. keys: (name, CSS colour) of classes.
    """

    picture: Picture
    alt: str
    title: str
    note: str
    weather: str | None = None
    link: str | None = None
    is_depth: bool = False
    keys: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Shares:
    """How many pictures of each kind a page has, and how many bytes each may take."""

    places: int
    variants: int
    samples: int
    thumbnails: int
    large_bytes: int
    buffer_bytes: int
    small_bytes: int

    @staticmethod
    def of(images: int) -> Shares:
        """A third for comparisons, a quarter for depth and classes, the rest for contact sheets."""
        compared, buffers = images // 3, images // 4
        # Two stand beside each other, one has the page's width.
        places = 0 if compared < 2 else 1 if compared < 8 else 2 if compared < 20 else 4
        variants = min(_MAX_VARIANTS, compared // places) if places else 0
        samples = buffers // _SAMPLE
        thumbnails = images - places * variants - _SAMPLE * samples
        weight = 3 * places * variants + 1.2 * _SAMPLE * samples + thumbnails
        unit = BUDGET / max(weight, 1)
        return Shares(
            places,
            variants,
            samples,
            thumbnails,
            int(min(_LARGE_BYTES, 3 * unit)),
            int(min(_BUFFER_BYTES, 1.2 * unit)),
            int(min(_SMALL_BYTES, unit)),
        )


@dataclass(frozen=True)
class Gallery:
    """The page's pictures. linked: whether they lead to the files, which lie beside the page."""

    table: pa.Table
    draws: Draws
    files: ReportFiles
    shares: Shares
    linked: bool

    def compare(self) -> dict[str, Any]:
        """Sliders between variants of one place. lacks: what there is nothing of: a `clear` variant
        at all, or `pairs` of one with a weathered one.
        """
        places: list[Place] = []
        if self.shares.places:
            places = pick_places(self.table, self.draws, self.shares.places, self.shares.variants)
        shown = [part for i, place in enumerate(places) if (part := self._compare(place, i))]
        lacks = None
        if not self.draws.clear.any():
            lacks = "clear"
        elif not any(any(place.clear) for place in places):
            lacks = "pairs"
        return {"places": shown, "lacks": lacks}

    def _compare(self, place: Place, number: int) -> dict[str, Any] | None:
        sides = []
        for row in place.rows:
            rgb = read_picture(row, self.files)
            if rgb is not None:
                weather = weather_text(row)
                sides.append({
                    "picture": embed(rgb, _LARGE, self.shares.large_bytes),
                    "name": row["variant"],
                    "alt": f"{row['variant']}: {weather}",
                    "text": f"{row['variant']} · {weather}",
                })  # fmt: skip
        if len(sides) < 2:
            return None
        right = 1 + number % (len(sides) - 1)  # not the same weather at every place
        where = f"{place.scene}, frame {place.frame}, {place.camera}"
        return {"number": number, "where": where, "sides": sides, "right": right}

    def contact_sheets(self, recipes: Sequence[str]) -> dict[str, Any]:
        """A strip of thumbnails for each recipe, as many recipes as there are pictures for."""
        chosen = evenly(list(recipes), self.shares.thumbnails)
        strips = []
        for recipe in chosen:
            each = max(1, min(8, self.shares.thumbnails // len(chosen)))
            own = self.table.filter(pc.equal(self.table["recipe"], recipe))
            figures = []
            for row in pick_images(own, each):
                rgb = read_picture(row, self.files)
                if rgb is not None:
                    picture = embed(rgb, _SMALL, self.shares.small_bytes)
                    figures.append(self._figure(row, picture, weather_text(row)))
            strips.append({"recipe": recipe, "images": own.num_rows, "figures": figures})
        return {"strips": strips, "of": len(recipes)}

    def buffers(self, recipes: Sequence[str]) -> list[list[Figure]]:
        """Images of some recipes with their depth, classes and masks."""
        having = pc.or_(
            pc.is_valid(self.table["depth_path"]), pc.is_valid(self.table["semantic_path"])
        )
        table = self.table.filter(having)
        present = set(pc.unique(table["recipe"]).to_pylist())
        chosen = evenly([r for r in recipes if r in present], self.shares.samples)
        rows = []
        for i, recipe in enumerate(chosen):
            own = table.filter(pc.equal(table["recipe"], recipe))
            rows.append([f for row in pick_images(own, 1, shift=i) for f in self._buffers(row)])
        return [figures for figures in rows if figures]

    def _buffers(self, row: dict[str, Any]) -> list[Figure]:
        rgb = read_picture(row, self.files)
        figures = read_buffers(row, self.files, _BUFFER, self.shares.buffer_bytes)[: _SAMPLE - 1]
        if rgb is not None:
            picture = embed(rgb, _BUFFER, self.shares.buffer_bytes)
            figures.insert(0, self._figure(row, picture))
        return figures

    def _figure(self, row: dict[str, Any], picture: Picture, weather: str | None = None) -> Figure:
        where = f"{row['scene']} · {row['frame']} · {row['camera']}"
        link = "./" + quote(row["image_path"]) if self.linked else None
        return Figure(picture, f"{row['variant']}, {where}", row["variant"], where, weather, link)


def read_picture(row: dict[str, Any], files: ReportFiles) -> np.ndarray | None:
    """uint8 [H, W, 3] RGB of a manifest's row; None, and noted, where the file is damaged."""
    data = files.read_image(row["image_path"], row["checksum"])
    return None if data is None else files.decoded(row["image_path"], lambda: decode_image(data))


def read_buffers(row: dict[str, Any], files: ReportFiles, width: int, most: int) -> list[Figure]:
    """Pictures of what else was written beside an image: depth, classes, masks.

    width: pixels at most. most: bytes of each.
    """

    def read(kind: str, dtype: type) -> np.ndarray | None:
        path = row[f"{kind}_path"]
        data = files.read_image(path)
        return None if data is None else files.decoded(path, lambda: decode_png(data, dtype))

    def figure(rgb: np.ndarray, title: str, note: str = "", **more: Any) -> Figure:
        return Figure(embed(rgb, width, most), title, title, note, **more)

    found = []
    if (depth := read("depth", np.uint16)) is not None:
        rgb, note = color_depth(depth_in_metres(_shrunk(depth, width)))
        found.append(figure(rgb, "Depth", note, is_depth=True))
    if (classes := read("semantic", np.uint8)) is not None:
        small = _shrunk(classes, width)
        keys = tuple(
            (c.name.lower().replace("_", " "), "rgb({} {} {})".format(*CLASS_COLORS[c]))
            for c in SemanticClass
            if (small == c).mean() > 0.001
        )
        palette = np.zeros((256, 3), np.uint8)  # numbers that are no class are black
        for known, color in CLASS_COLORS.items():
            palette[known] = color
        found.append(figure(palette[small], "Semantic classes", keys=keys))
    for kind in mask_names():
        if (mask := read(kind, np.uint8)) is not None:
            note = f"{100 * float((mask > 0).mean()):.0f} % of pixels"
            rgb = cv2.cvtColor(_shrunk(mask, width), cv2.COLOR_GRAY2RGB)
            found.append(figure(rgb, f"{kind.capitalize()} mask", note))
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
    rgb[there] = color_mapped(1 - place, cv2.COLORMAP_TURBO)[there]
    return rgb, f"{near:.1f} m to {far:.0f} m"


def depth_gradient() -> str:
    """CSS stops of `color_depth`'s colours, near to far."""
    levels = np.linspace(255, 0, 9).astype(np.uint8)[:, None]
    stops = color_mapped(levels / 255, cv2.COLORMAP_TURBO)[:, 0]
    return ",".join("rgb({} {} {})".format(*stop) for stop in stops.tolist())


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
            bgr = np.ascontiguousarray(small[..., ::-1])
            data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
            if len(data) <= most:
                break
        if len(data) <= most:
            break
        width = max(8, min(width, rgb.shape[1]) * 3 // 4)
    uri = "data:image/jpeg;base64," + base64.b64encode(data).decode()
    return Picture(Markup(uri), small.shape[1], small.shape[0])


def _shrunk(image: np.ndarray, width: int) -> np.ndarray:
    """Without new values: a mean of two classes is a third one."""
    return image if image.shape[1] <= width else resized(image, width, cv2.INTER_NEAREST_EXACT)
