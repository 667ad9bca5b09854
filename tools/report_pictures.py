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
from augment.output.codecs import decode_image, decode_png, depth_in_metres
from augment.output.layout import mask_names
from augment.output.manifest import Row
from augment.output.store import Store, StoredFile, StoredFileMissing
from augment.output.tables import read_table
from augment.scene.semantics import SemanticClass
from tools.chosen_images import evenly
from tools.pictures import color_mapped, resized
from tools.report_numbers import weather_text

Value = TypeVar("Value")
MAX_FILE = 1 << 28  # bytes; a report needs no larger one
MAX_PROBLEMS = 50  # that the page lists
MAX_PIXELS = 1 << 26  # of one image: what an untrusted file may make the decoder allocate
BUDGET = 3_100_000  # bytes of all pictures; a third more as text of the page
MAX_IMAGES = 400  # more of them could not be told apart within the budget
_MAX_VARIANTS = 6  # of one comparison
_SAMPLE = 4  # pictures: an image, its depth, its classes, and a mask
_LARGE = 1120  # the width of a picture of a comparison, in pixels
_LARGE_BYTES = 130_000  # its size at most, in bytes
_SMALL = 400  # the width of a thumbnail of a contact sheet, in pixels
_SMALL_BYTES = 40_000  # its size at most, in bytes
_BUFFER = 480  # the width of a picture of depth, classes or a mask, in pixels
_BUFFER_BYTES = 45_000  # its size at most, in bytes
_QUALITIES = (82, 74, 64, 52, 40)
_NO_DEPTH = (128, 128, 128)
_NEAREST_M = 0.5
# Multiples of either, less their whole parts, fill an interval evenly however many there are.
_GOLDEN = (math.sqrt(5) - 1) / 2  # the golden ratio, less 1
_SILVER = math.sqrt(2) - 1  # the silver ratio, less 2

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

    def read(self, path: str, parse: Callable[[bytes], Value]) -> Value | None:
        """Return what `parse` makes of a file; None, and a note, where it cannot be used."""
        stored = self.listing.get(path)
        try:
            if stored is not None and stored.size > MAX_FILE:
                raise ValueError(f"larger than {MAX_FILE >> 20} MiB: not looked at")
            return parse(self.store.read(path))
        except StoredFileMissing:
            return self.note(path, "missing")
        except (OutputError, ValueError) as error:
            # A page that is handed on says nothing of the machine that it was made on.
            return self.note(path, str(error).replace(self.store.uri, "OUT"))

    def note(self, path: str, why: str) -> None:
        """Remember that a file is damaged."""
        if path not in self.problems and len(self.problems) < MAX_PROBLEMS:
            self.problems[path] = why
        elif path not in self.problems:
            self.unlisted += 1

    def read_columns(self, path: str, names: tuple[str, ...]) -> pa.Table | None:
        """Read those columns of `names` that a Parquet file has."""
        return self.read(path, lambda data: read_table(data, path, names))

    def read_image(
        self, path: str, decode: Callable[[bytes], np.ndarray], checksum: str = ""
    ) -> np.ndarray | None:
        """Read an image of no more than MAX_PIXELS."""

        def checked(data: bytes) -> np.ndarray:
            header = image_header(data)
            if header is None:
                raise ValueError(f"no readable image ({len(data)} bytes)")
            if header.width * header.height > MAX_PIXELS:
                raise ValueError(f"{header.width}x{header.height} pixels: not looked at")
            if checksum and hashlib.sha256(data).hexdigest() != checksum:
                raise ValueError("its SHA-256 is not the manifest's: the file was changed")
            return decode(data)

        return self.read(path, checked)

    def read_picture(self, row: Row) -> np.ndarray | None:
        """Return the picture of a manifest's row, RGB uint8 [H, W, 3]."""
        return self.read_image(row["image_path"], decode_image, row["checksum"])


def rows_with(table: pa.Table, column: str, value: str) -> np.ndarray:
    """Return the numbers of the rows with a value, int64; a copy of the rows would be large."""
    return np.flatnonzero(pc.equal(table[column], value).to_numpy())


def pick_images(table: pa.Table, among: np.ndarray, number: int, shift: int = 0) -> list[Row]:
    """Return at most `number` rows, of evenly chosen variants and varying frames and cameras.

    Evenly spaced rows would mostly show one camera: the numbers of frames and cameras divide them.
    among: the rows to choose from. shift: of the place, so that calls for one row each do not all
    take the same.
    """
    draws = table["draw"].to_numpy()[among]
    bounds = [*np.flatnonzero(np.diff(draws, prepend=-1)).tolist(), len(among)]
    number = min(number, len(among))
    rows = set[int]()
    for i in range(number):
        group = int((i + (0.5 + (i + shift) * _GOLDEN) % 1) * (len(bounds) - 1) / number)
        low = bounds[group]
        size = bounds[group + 1] - bounds[group]
        offset = int(size * ((0.5 + (i + shift) * _SILVER) % 1))
        free_rows = (low + (offset + k) % size for k in range(size))
        rows |= {next((row for row in free_rows if row not in rows), low)}
    return table.take(among[sorted(rows)]).to_pylist()


def pick_places(table: pa.Table, clear: set[int], places: int, variants: int) -> list[list[Row]]:
    """Scenes evenly chosen, and of each the frame and camera that most variants show: the rows of
    one variant without weather, then of at most one of each recipe until there are none left.

    Only scenes in which two variants show the same are taken, those with weather and without first.
    clear: the numbers of the variants without weather.
    """
    names = sorted(pc.unique(table["scene"]).to_pylist())
    candidates = []
    for name in evenly(names, 8 * places):  # reading rows of thousands of scenes takes seconds
        candidates.append(_place_of(table, rows_with(table, "scene", name), clear, variants))
    candidates = [rows for rows in candidates if len(rows) >= 2]
    mixed_places = [rows for rows in candidates if len({row["draw"] in clear for row in rows}) == 2]
    return evenly(mixed_places or candidates, places)


def _place_of(table: pa.Table, among: np.ndarray, clear: set[int], variants: int) -> list[Row]:
    rows = table.select(["frame", "camera", "draw"]).take(among)
    views = rows.group_by(["frame", "camera"], use_threads=False)
    view_counts = views.aggregate([("draw", "count_distinct")]).to_pylist()
    max_variants = max(entry["draw_count_distinct"] for entry in view_counts)
    fullest_views = [
        (e["camera"], e["frame"]) for e in view_counts if e["draw_count_distinct"] == max_variants
    ]
    # The camera that looks ahead first, as far as names tell.
    camera, _ = min(
        fullest_views, key=lambda key: ("front" not in key[0].lower(), len(key[0]), key[0])
    )
    frames = sorted(number for name, number in fullest_views if name == camera)
    is_frame = pc.equal(rows["frame"], frames[len(frames) // 2])
    is_view = pc.and_(is_frame, pc.equal(rows["camera"], camera)).to_numpy()
    candidates = table.take(among[is_view]).to_pylist()
    clear_rows = [row for row in candidates if row["draw"] in clear]
    weathered_rows = [row for row in candidates if row["draw"] not in clear] or clear_rows[1:]
    # Of each recipe its first variant; all of them where there is one recipe only.
    first_rows = {row["recipe"]: row for row in reversed(weathered_rows)}
    if len(first_rows) >= 2:
        weathered_rows = [row for row in weathered_rows if first_rows[row["recipe"]] is row]
    return clear_rows[:1] + evenly(weathered_rows, variants - len(clear_rows[:1]))


class Picture(NamedTuple):
    """A JPEG inside the page."""

    uri: Markup
    """The image's bytes as a data URI."""
    width: int
    """The width, pixels."""
    height: int
    """The height, pixels."""


class Figure(NamedTuple):
    """A picture with its caption."""

    picture: Picture
    """The picture."""
    alt: str
    """The text in place of the picture."""
    title: str
    """The first line of the caption."""
    note: str
    """The second line of the caption."""
    weather: str | None = None
    """The weather in words; None without a line for it."""
    link: str | None = None
    """The link to the image's file next to the page; None without a link."""
    is_depth: bool = False
    """True if the caption shows the colours of depths."""
    keys: Sequence[tuple[str, str]] = ()
    """The name and the CSS colour of every class in the picture."""


class Shares(NamedTuple):
    """Numbers of a page's pictures of each kind, and the bytes that each may take."""

    places: int
    """The number of places that are compared."""
    variants: int
    """The number of variants that are compared at each place."""
    samples: int
    """The number of images that are shown with their buffers."""
    thumbnails: int
    """The number of thumbnails."""
    large_bytes: int
    """The largest size of a picture of a comparison, bytes."""
    buffer_bytes: int
    """The largest size of a picture of a buffer, bytes."""
    small_bytes: int
    """The largest size of a thumbnail, bytes."""

    @staticmethod
    def of(images: int) -> Shares:
        """Divide a page's images among the kinds of pictures.

        A third is for comparisons, a quarter for depth and classes, and all others are for contact
        sheets.
        """
        num_compared = images // 3
        samples = images // 4 // _SAMPLE
        # Two stand beside each other, one has the page's width.
        places = 0 if num_compared < 2 else 1 if num_compared < 8 else 2 if num_compared < 20 else 4
        variants = min(_MAX_VARIANTS, num_compared // places) if places else 0
        thumbnails = images - places * variants - _SAMPLE * samples
        unit = BUDGET / max(3 * places * variants + 1.2 * _SAMPLE * samples + thumbnails, 1)
        limits = (_LARGE_BYTES, 3 * unit), (_BUFFER_BYTES, 1.2 * unit), (_SMALL_BYTES, unit)
        return Shares(places, variants, samples, thumbnails, *(int(min(limit)) for limit in limits))


@dataclass(frozen=True)
class Gallery:
    """The page's pictures."""

    table: pa.Table
    """The rows of finished images, with the column `draw`."""
    clear: set[int]
    """The numbers of the variants without weather."""
    cameras: list[str]
    """The names of the cameras in their order on the car."""
    files: ReportFiles
    """The files of the output."""
    shares: Shares
    """The numbers and sizes of pictures."""
    linked: bool
    """True if pictures link to the output's files, which lie next to the page."""

    def compare(self) -> dict[str, Any]:
        """Sliders between variants of one place. lacks: what there is nothing of: a `clear` variant
        at all, or `pairs` of one with a weathered one.
        """
        places = []
        if self.shares.places:
            places = pick_places(self.table, self.clear, self.shares.places, self.shares.variants)
        comparisons = []
        for number, rows in enumerate(places):
            sides = [
                {
                    "picture": embed(rgb, _LARGE, self.shares.large_bytes),
                    "name": row["variant"],
                    "weather": weather_text(row),
                }
                for row in rows
                if (rgb := self.files.read_picture(row)) is not None
            ]
            if len(sides) >= 2:
                right = 1 + number % (len(sides) - 1)  # not the same weather at every place
                where = "{scene}, frame {frame}, {camera}".format_map(rows[0])
                comparisons.append(
                    {"number": number, "where": where, "sides": sides, "right": right}
                )
        lacks = "clear" if not self.clear else "pairs"
        has_pairs = any(row["draw"] in self.clear for rows in places for row in rows)
        return {"places": comparisons, "lacks": None if has_pairs else lacks}

    def contact_sheets(self, recipes: Sequence[str]) -> dict[str, Any]:
        """Return a strip of thumbnails for each of as many recipes as the budget allows."""
        chosen_recipes = evenly(list(recipes), self.shares.thumbnails)
        num_images = max(1, min(8, self.shares.thumbnails // max(len(chosen_recipes), 1)))
        strips = []
        for recipe in chosen_recipes:
            row_numbers = rows_with(self.table, "recipe", recipe)
            rows = sorted(pick_images(self.table, row_numbers, num_images), key=self._place_on_car)
            candidates = [
                self._figure(row, _SMALL, self.shares.small_bytes, weather_text(row))
                for row in rows
            ]
            figures = [figure for figure in candidates if figure is not None]
            strips.append({"recipe": recipe, "images": len(row_numbers), "figures": figures})
        return {"strips": strips, "of": len(recipes)}

    def buffers(self, recipes: Sequence[str]) -> list[list[Figure]]:
        """Return images of some recipes with their depth, classes and masks."""
        has_buffers = pc.or_(*(pc.is_valid(self.table[f"{k}_path"]) for k in ("depth", "semantic")))
        table = self.table
        recipes_with_buffers = set(pc.unique(self.table["recipe"].filter(has_buffers)).to_pylist())
        limits = (_BUFFER, self.shares.buffer_bytes)
        samples = []
        chosen_recipes = evenly(
            [r for r in recipes if r in recipes_with_buffers], self.shares.samples
        )
        for i, recipe in enumerate(chosen_recipes):
            row_numbers = rows_with(table, "recipe", recipe)
            row_numbers = row_numbers[has_buffers.to_numpy()[row_numbers]]
            for row in pick_images(table, row_numbers, 1, shift=i):
                image = self._figure(row, *limits)
                buffers = read_buffers(row, self.files, *limits)[: _SAMPLE - 1]
                samples.append(buffers if image is None else [image, *buffers])
        return [figures for figures in samples if figures]

    def _place_on_car(self, row: Row) -> tuple[int, ...]:
        return row["draw"], row["frame"], self.cameras.index(row["camera"])

    def _figure(self, row: Row, width: int, most: int, weather: str | None = None) -> Figure | None:
        rgb = self.files.read_picture(row)
        if rgb is None:
            return None
        where = f"{row['scene']} · {row['frame']} · {row['camera']}"
        link = "./" + quote(row["image_path"]) if self.linked else None
        name = row["variant"]
        return Figure(embed(rgb, width, most), f"{name}, {where}", name, where, weather, link)


def read_buffers(row: Row, files: ReportFiles, width: int, most: int) -> list[Figure]:
    """Return pictures of an image's buffers: depth, classes, masks.

    width: pixels at most. most: bytes of each.
    """

    def read(kind: str, dtype: type) -> np.ndarray | None:
        if (path := row[f"{kind}_path"]) is None:
            return None
        return files.read_image(path, lambda data: decode_png(data, dtype))

    def shrunk(image: np.ndarray) -> np.ndarray:  # without new values: two classes have no mean
        fits = image.shape[1] <= width
        return image if fits else resized(image, width, cv2.INTER_NEAREST_EXACT)

    def figure(rgb: np.ndarray, title: str, note: str = "", **more: Any) -> Figure:
        return Figure(embed(rgb, width, most), title, title, note, **more)

    figures = []
    if (depth := read("depth", np.uint16)) is not None:
        rgb, note = color_depth(depth_in_metres(shrunk(depth)))
        figures.append(figure(rgb, "Depth", note, is_depth=True))
    if (classes := read("semantic", np.uint8)) is not None:
        small = shrunk(classes)
        palette = np.zeros((256, 3), np.uint8)  # what is no class is black
        palette[list(CLASS_COLORS)] = list(CLASS_COLORS.values())
        keys = [
            (c.name.lower().replace("_", " "), "rgb({} {} {})".format(*CLASS_COLORS[c]))
            for c in SemanticClass
            if (small == c).mean() > 0.001
        ]
        figures.append(figure(palette[small], "Semantic classes", keys=keys))
    for kind in mask_names():
        if (mask := read(kind, np.uint8)) is not None:
            note = f"{100 * float((mask > 0).mean()):.0f} % of pixels"
            rgb = cv2.cvtColor(shrunk(mask), cv2.COLOR_GRAY2RGB)
            figures.append(figure(rgb, f"{kind.capitalize()} mask", note))
    return figures


def color_depth(depth_m: np.ndarray) -> tuple[np.ndarray, str]:
    """Return colours of depths, uint8 [H, W, 3], and their range.

    The colours are logarithmic in depth, from the 1st to the 99th percentile.


    depth_m: float32 [H, W], 0 = none, which is grey.
    """
    has_depth = depth_m > 0
    rgb = np.full((*depth_m.shape, 3), _NO_DEPTH, np.uint8)
    if not has_depth.any():
        return rgb, "nowhere"
    near, far = np.percentile(depth_m[has_depth], [1, 99])
    near = max(float(near), _NEAREST_M)
    far = max(float(far), 1.01 * near)
    place = np.log(np.maximum(depth_m, _NEAREST_M) / near) / np.log(far / near)
    rgb[has_depth] = color_mapped(1 - place, cv2.COLORMAP_TURBO)[has_depth]
    return rgb, f"{near:.1f} m to {far:.0f} m"


def depth_gradient() -> str:
    """Return CSS stops of `color_depth`'s colours, from near to far."""
    levels = np.linspace(255, 0, 9).astype(np.uint8)[:, None]
    stops = color_mapped(levels / 255, cv2.COLORMAP_TURBO)[:, 0]
    return ",".join("rgb({} {} {})".format(*stop) for stop in stops.tolist())


def embed(rgb: np.ndarray, width: int, most: int) -> Picture:
    """Return a JPEG of at most `width` pixels across and about `most` bytes.

    If it is too large, the quality is lowered first, and then the size.


    rgb: uint8 [H, W, 3]. A picture much taller than wide is at most 1.5 times as tall as `width`.
    """
    for _ in range(8):
        height = round(rgb.shape[0] * width / rgb.shape[1])
        if height > 1.5 * width:
            max_height = round(1.5 * width)
            width = max(1, round(1.5 * width * width / height))
            height = max_height
        small = rgb
        if width < rgb.shape[1]:
            small = cv2.resize(rgb, (width, max(1, height)), interpolation=cv2.INTER_AREA)
        for quality in _QUALITIES:
            bgr = np.ascontiguousarray(small[..., ::-1])
            data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
            if len(data) <= most:
                break
        else:
            width = max(8, min(width, rgb.shape[1]) * 3 // 4)
            continue
        break
    uri = "data:image/jpeg;base64," + base64.b64encode(data).decode()
    return Picture(Markup(uri), small.shape[1], small.shape[0])
