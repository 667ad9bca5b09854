"""The pictures of a report's page: comparisons, contact sheets, depth and classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import pyarrow as pa
import pyarrow.compute as pc

from tools.report_files import ReportFiles
from tools.report_html import Html, joined, tag
from tools.report_numbers import count
from tools.report_pick import Place, evenly, pick_images, pick_places
from tools.report_pictures import (
    CLASS_COLORS,
    Buffer,
    Picture,
    depth_gradient,
    embed,
    read_buffers,
    read_picture,
)
from tools.report_weather import Draws, weather_text

BUDGET = 3_100_000  # bytes of all pictures; a third more as text of the page
MAX_IMAGES = 400  # more of them could not be told apart within the budget
_VARIANTS = 6  # of one comparison
_SAMPLE = 4  # pictures: an image, its depth, its classes, and a mask
# Pixels across, and bytes at most of one picture.
_LARGE, _LARGE_BYTES = 1120, 130_000
_SMALL, _SMALL_BYTES = 400, 40_000
_BUFFER, _BUFFER_BYTES = 480, 45_000


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
        variants = min(_VARIANTS, compared // places) if places else 0
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
    """Pieces of the page. linked: whether pictures lead to the files, which lie beside the page."""

    table: pa.Table
    draws: Draws
    files: ReportFiles
    shares: Shares
    linked: bool

    def compare(self) -> Html:
        """Sliders between variants of one place."""
        if not self.shares.places:
            return Html("")
        places = pick_places(self.table, self.draws, self.shares.places, self.shares.variants)
        shown = [part for i, place in enumerate(places) if (part := self._compare(place, i))]
        if not shown:
            return Html("")
        note = None
        if not self.draws.clear.any():
            note = tag(
                "p",
                "This output has no variant without weather to compare with, so these are pairs "
                "of weathered ones. The preset ", tag("code", "clear"), " renders one.",
                class_="note",
            )  # fmt: skip
        elif not any(any(place.clear) for place in places):
            note = tag("p", "No variant without weather shows the same images as a weathered one: "
                       "these are pairs of variants.", class_="note")  # fmt: skip
        return joined([note, tag("div", shown, class_="comparisons")])

    def contact_sheets(self, recipes: Sequence[str]) -> Html:
        """A strip of thumbnails for each recipe, as many recipes as there are pictures for."""
        if not self.shares.thumbnails or not recipes:
            return Html("")
        chosen = evenly(list(recipes), self.shares.thumbnails)
        each = max(1, min(8, self.shares.thumbnails // len(chosen)))
        strips = []
        for recipe in chosen:
            own = self.table.filter(pc.equal(self.table["recipe"], recipe))
            figures = [f for row in pick_images(own, each) if (f := self._thumbnail(row))]
            head = tag("h3", recipe, " ", tag("small", count(own.num_rows, "image")))
            strips.append(tag("div", head, tag("div", figures, class_="strip"), class_="recipe"))
        if len(chosen) < len(recipes):
            said = f"{len(chosen)} of {len(recipes)} recipes, evenly chosen; --images shows more."
            strips.append(tag("p", said, class_="note"))
        return joined(strips)

    def buffers(self, recipes: Sequence[str]) -> Html:
        """Images of some recipes with their depth, classes and masks."""
        having = pc.or_(
            pc.is_valid(self.table["depth_path"]), pc.is_valid(self.table["semantic_path"])
        )
        table = self.table.filter(having)
        present = set(pc.unique(table["recipe"]).to_pylist())
        rows = []
        for i, recipe in enumerate(
            evenly([r for r in recipes if r in present], self.shares.samples)
        ):
            own = table.filter(pc.equal(table["recipe"], recipe))
            figures = [f for row in pick_images(own, 1, shift=i) for f in self._buffers(row)]
            if figures:
                rows.append(tag("div", figures, class_="strip buffers"))
        return joined(rows)

    def _compare(self, place: Place, number: int) -> Html | None:
        sides = []
        for row, clear in zip(place.rows, place.clear, strict=True):
            rgb = read_picture(row, self.files)
            if rgb is not None:
                sides.append((row, clear, embed(rgb, _LARGE, self.shares.large_bytes)))
        if len(sides) < 2:
            return None
        right = 1 + number % (len(sides) - 1)  # not the same weather at every place
        images = [
            tag(
                "img",
                src=picture.uri,
                width=picture.width,
                height=picture.height,
                alt=f"{row['variant']}: {weather_text(row)}",
                class_="left" if i == 0 else "right" if i == right else None,
                decoding="async",
            )
            for i, (row, _, picture) in enumerate(sides)
        ]
        first = sides[0][2]
        where = f"{place.scene}, frame {place.frame}, {place.camera}"
        names = [row["variant"] for row, _, _ in sides]
        stage = tag(
            "div",
            images,
            tag("span", names[0], class_="side first", aria_hidden="true"),
            tag("span", names[right], class_="side second", aria_hidden="true"),
            tag("input", type="range", min=0, max=100, step=0.5, value=50,
                aria_label=f"How much of the left picture shows: {where}"),
            class_="stage",
            style=f"aspect-ratio:{first.width}/{first.height}",
        )  # fmt: skip
        texts = [f"{row['variant']} · {weather_text(row)}" for row, _, _ in sides]
        choices = tag(
            "div",
            _choice("Left", texts, names, 0, f"left-{number}"),
            _choice("Right", texts, names, right, f"right-{number}"),
            class_="choices",
        )
        return tag("figure", tag("figcaption", where), stage, choices, class_="compare")

    def _thumbnail(self, row: Mapping[str, Any]) -> Html | None:
        rgb = read_picture(dict(row), self.files)
        if rgb is None:
            return None
        picture = embed(rgb, _SMALL, self.shares.small_bytes)
        return self._figure(row, picture, tag("br"), weather_text(row))

    def _buffers(self, row: Mapping[str, Any]) -> list[Html]:
        rgb = read_picture(dict(row), self.files)
        found = read_buffers(dict(row), self.files, _BUFFER, self.shares.buffer_bytes)
        figures = [_buffer_figure(buffer) for buffer in found[: _SAMPLE - 1]]
        if rgb is not None:
            picture = embed(rgb, _BUFFER, self.shares.buffer_bytes)
            figures.insert(0, self._figure(row, picture))
        return figures

    def _figure(self, row: Mapping[str, Any], picture: Picture, *further: Html | str) -> Html:
        where = f"{row['scene']} · {row['frame']} · {row['camera']}"
        image = _image(picture, f"{row['variant']}, {where}")
        caption = tag("figcaption", tag("b", row["variant"]), " ", where, further)
        return tag("figure", self._link(row["image_path"], image), caption)

    def _link(self, path: str | None, inside: Html) -> Html:
        if not self.linked or path is None:
            return inside
        return tag("a", inside, href="./" + quote(path), title="the image in full size")


def _image(picture: Picture, description: str) -> Html:
    return tag(
        "img",
        src=picture.uri,
        width=picture.width,
        height=picture.height,
        alt=description,
        decoding="async",
    )


def _choice(
    label: str, texts: Sequence[str], names: Sequence[str], chosen: int, identity: str
) -> Html:
    options = [
        tag("option", said, selected=i == chosen, data_name=name)
        for i, (said, name) in enumerate(zip(texts, names, strict=True))
    ]
    select = tag("select", options, id=identity, autocomplete="off")
    return tag("span", tag("label", label, for_=identity), select)


def _buffer_figure(buffer: Buffer) -> Html:
    said: list[Any] = [tag("b", buffer.title), " ", buffer.note]
    if buffer.is_depth:
        said += [
            tag("i", class_="ramp", style=f"background:linear-gradient(90deg,{depth_gradient()})")
        ]
    if buffer.classes:
        keys = [
            tag("li", tag("i", style="background:rgb({} {} {})".format(*CLASS_COLORS[c])),
                c.name.lower().replace("_", " "))
            for c in buffer.classes
        ]  # fmt: skip
        said.append(tag("ul", keys, class_="keys"))
    return tag("figure", _image(buffer.picture, buffer.title), tag("figcaption", said))
