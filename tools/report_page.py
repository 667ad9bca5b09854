"""What a report's page says of images, recipes, scenes and files: tables and charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tools.report_charts import amount_bar, histogram, histogram_svg
from tools.report_html import Html, joined, tag
from tools.report_numbers import byte_size, count, percent, plural_of, short, with_unit
from tools.report_summary import Failure, Files, Group
from tools.report_tables import MAX_ROWS, facts, folded_table, number_cell, table
from tools.report_weather import RecipeWeather, Spread

MAX_CHARTS = 24
MAX_FAILURES = 20


def tiles(whole: Group, recipes: int, files: Sequence[Files]) -> Html:
    """The counts that say how much there is."""
    total = sum(kind.bytes for kind in files)
    rows = [
        (count(whole.finished), plural_of(whole.finished, "image")),
        (count(whole.scenes), plural_of(whole.scenes, "scene")),
        (count(recipes), plural_of(recipes, "recipe")),
        (count(whole.variants), plural_of(whole.variants, "variant")),
        (count(whole.frames), plural_of(whole.frames, "frame")),
        (count(whole.cameras), plural_of(whole.cameras, "camera")),
        (byte_size(total), f"in {count(sum(kind.files for kind in files), 'file')}"),
    ]
    items = [tag("li", tag("b", number), tag("span", word)) for number, word in rows]
    if whole.failed:
        failed = tag("a", tag("b", count(whole.failed)), tag("span", "failed"), href="#failures")
        items.insert(1, tag("li", failed, class_="bad"))
    return tag("ul", items, class_="tiles")


def weather_charts(found: Sequence[Spread]) -> Html:
    """A histogram of each number that differs, and a line of those that do not."""
    drawn = [spread for spread in found if not spread.is_constant]
    constant = [
        (spread.quantity.title, [f"{_range_text(spread)} in {_where_text(spread)}"])
        for spread in found
        if spread.is_constant
    ]
    note = "Bars count images. Each tick beneath is one variant of a scene."
    if len(drawn) > MAX_CHARTS:
        note += f" {len(drawn) - MAX_CHARTS} further numbers are not drawn."
    charts = [
        tag("p", note, class_="note"),
        tag("div", [_chart(spread) for spread in drawn[:MAX_CHARTS]], class_="cards"),
    ]
    return joined([charts if drawn else None, facts(constant[:MAX_CHARTS]) if constant else None])


def _chart(spread: Spread) -> Html:
    shape = histogram(spread.values, spread.images, linear=spread.quantity.linear)
    title, said = spread.quantity.title, _range_text(spread)
    described = f"Histogram of {title} over images: {said}"
    marks = np.sort(spread.values)
    return tag(
        "figure",
        tag("figcaption", tag("b", title), tag("span", said)),
        histogram_svg(shape, spread.quantity.unit, "image", marks, described),
        tag("p", _where_text(spread), tag("br"), tag("code", spread.quantity.formula)),
        class_="card",
    )


def _range_text(spread: Spread) -> str:
    low, high = float(spread.values.min()), float(spread.values.max())
    if spread.is_constant:
        return with_unit(low, spread.quantity.unit)
    return f"{short(low)} to {with_unit(high, spread.quantity.unit)}"


def _where_text(spread: Spread) -> str:
    there = int(spread.images.sum())
    said = f"{count(there, 'image')}, {count(len(spread.values), 'variant')}"
    return f"{said}; absent in {spread.absent_images:,}" if spread.absent_images else said


def listed(groups: Sequence[Group]) -> list[Group]:
    """Those that a table has room for: by name or, where not all fit, with failures first."""
    if len(groups) <= MAX_ROWS:
        return list(groups)
    return sorted(groups, key=lambda group: (-group.failed, group.name))[:MAX_ROWS]


def recipe_table(groups: Sequence[Group], weather: Mapping[str, RecipeWeather]) -> Html:
    """A row per recipe, with what its variants drew."""
    most = max((group.images for group in groups), default=0)
    rows = [
        [
            tag("th", group.name, scope="row"),
            _weather_cell(weather.get(group.name)),
            number_cell(count(group.scenes)),
            number_cell(count(group.variants)),
            _images_cell(group, most),
        ]
        for group in listed(groups)
    ]
    heads = ("Recipe", "Weather drawn", "Scenes", "Variants", "Images")
    return folded_table(f"By recipe ({len(groups):,})", heads, rows, _rest(groups, "recipe"), 2)


def scene_table(groups: Sequence[Group]) -> Html:
    """A row per scene."""
    most = max((group.images for group in groups), default=0)
    rows = [
        [
            tag("th", group.name, tag("small", group.source), scope="row"),
            number_cell(count(group.variants)),
            number_cell(count(group.frames)),
            number_cell(count(group.cameras)),
            _images_cell(group, most),
        ]
        for group in listed(groups)
    ]
    heads = ("Scene", "Variants", "Frames", "Cameras", "Images")
    return folded_table(f"By scene ({len(groups):,})", heads, rows, _rest(groups, "scene"), 1)


def file_table(files: Sequence[Files]) -> Html:
    """What takes the space."""
    total = sum(kind.bytes for kind in files)
    rows = [
        [
            tag("th", kind.kind, scope="row"),
            number_cell(count(kind.files)),
            tag("td", byte_size(kind.bytes), amount_bar(kind.bytes, total), class_="n"),
            number_cell(percent(kind.bytes, total)),
        ]
        for kind in files
    ]
    return folded_table("By kind of file", ("Kind", "Files", "Size", ""), rows, None, 1)


def failure_table(failures: Sequence[Failure]) -> Html:
    """Failed images by what went wrong."""
    if not failures:
        return Html("")
    rows = [
        [
            number_cell(count(failure.images)),
            tag("td", tag("code", failure.message, class_="message"),
                tag("small", "such as ", "; ".join(failure.examples)), class_="text"),
        ]
        for failure in failures[:MAX_FAILURES]
    ]  # fmt: skip
    rest = failures[MAX_FAILURES:]
    images = count(sum(failure.images for failure in rest), "image")
    note = f"and {images} with {count(len(rest), 'other message')}" if rest else None
    said = (
        "Messages that differ in numbers only are counted together. The same command tries again."
    )
    return joined([tag("p", said, class_="note"), table(("Images", "Message"), rows, note, 0)])


def problem_table(problems: Mapping[str, str], unlisted: int) -> Html:
    """Files that this report could not read."""
    if not problems:
        return Html("")
    rows = [
        [tag("th", path, scope="row"), tag("td", why, class_="text")]
        for path, why in sorted(problems.items())
    ]
    note = f"and {count(unlisted, 'more file')}" if unlisted else None
    said = (
        "Of the files that this page looked at, these could not be used. Delete them and run the "
        "job again, which makes them anew."
    )
    return joined([tag("p", said, class_="note"), table(("File", "What is wrong"), rows, note, 2)])


def _rest(groups: Sequence[Group], noun: str) -> str | None:
    shown = {group.name for group in listed(groups)}
    rest = [group for group in groups if group.name not in shown]
    if not rest:
        return None
    finished, failed = sum(g.finished for g in rest), sum(g.failed for g in rest)
    return (
        f"and {count(len(rest), f'more {noun}')} with {count(finished, 'image')}, "
        f"{failed or 'none'} failed"
    )


def _images_cell(group: Group, most: int) -> Html:
    failed = tag("em", f"{count(group.failed)} failed", class_="bad") if group.failed else None
    return tag(
        "td", failed, " " if failed else None, count(group.finished),
        amount_bar(group.finished, most), class_="n",
    )  # fmt: skip


def _weather_cell(weather: RecipeWeather | None) -> Html:
    if weather is None:
        return tag("td")
    if not (weather.ranges or weather.styles):
        return tag("td", "no weather", class_="faint")
    said = [f"Style: {', '.join(weather.styles[:4])}"] if weather.styles else []
    for quantity, low, high in weather.ranges[:10]:
        numbers = short(low) if low == high else f"{short(low)} to {short(high)}"
        said.append(f"{quantity.title} {numbers} {quantity.unit}".rstrip())
    return tag("td", tag("small", "; ".join(said)), class_="text")
