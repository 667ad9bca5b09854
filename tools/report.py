"""One page about an output: what it holds, how its weather is spread, how it looks, what failed.

`climategs report` writes it: a single HTML file without links to anything outside, the same bytes
for the same output.
"""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from importlib import resources
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

import pyarrow as pa
import pyarrow.compute as pc

from augment.errors import OutputError
from augment.jobs.atomic import write_atomic
from augment.jobs.layout import folder_name
from augment.jobs.manifest import OK, read_finished
from augment.jobs.store import Store, open_store
from tools import report_label_page, report_labels, report_page, report_summary, report_tables
from tools.report_files import ReportFiles
from tools.report_gallery import MAX_IMAGES, Gallery, Shares
from tools.report_html import Html, joined, tag
from tools.report_numbers import count
from tools.report_weather import find_draws, spreads, weather_of_recipes

REPORT = "report.html"
IMAGES = 48
MAX_PAGE = 5_000_000  # bytes
MAX_RECIPES = 12  # whose labels and sweeps are looked at
# Of a million rows they take some hundred megabytes, over and over.
_UNUSED = [
    "timestamp_ns",
    "instance_path",
    "calibration_path",
    "recipe_hash",
    "style_method",
    "render_scale",
    "settings",
]
_SECTIONS = {
    "compare": "Before and after",
    "images": "Images",
    "weather": "Weather",
    "labels": "Labels",
    "buffers": "Depth and classes",
    "contents": "Contents",
    "failures": "Failures",
    "damaged": "Damaged files",
}


@dataclass(frozen=True)
class Written:
    """problems: how many files could not be read."""

    path: Path
    size: int
    problems: int


def write_report(out: str | Path, html: Path | None = None, images: int = IMAGES) -> Written:
    """Write the page about an output folder, here or in an object store.

    html: where; by default OUT/report.html, or NAME-report.html in the working folder where OUT is
    not on this machine. images: how many pictures the page has at most, 0 to MAX_IMAGES.

    Raises:
        OutputError: nothing is finished there yet, the manifest is damaged, the page cannot be
            written, or `images` is out of its range.
    """
    if not 0 <= images <= MAX_IMAGES:
        raise OutputError(f"a report has 0 to {MAX_IMAGES} images; got {images}")
    store = open_store(out)
    if html is None:
        name = f"{folder_name(_name_of(store))}-{REPORT}"
        html = Path(name) if store.local_dir is None else store.local_dir / REPORT
    data, problems = b"", 0
    # Captions of long names may outgrow the pictures: with fewer of both the page fits.
    for fewer in (images, images // 2, images // 4, 0):
        page, problems = make_page(store, Path(html), fewer)
        data = page.encode()
        if len(data) <= MAX_PAGE:
            break
    write_atomic(Path(html).absolute(), data)
    return Written(Path(html), len(data), problems)


def make_page(store: Store, html: Path, images: int) -> tuple[str, int]:
    """The page's text, and how many files could not be read. html: where it will lie."""
    table = report_summary.add_variant_key(read_finished(store).drop_columns(_UNUSED))
    beside, own = _beside(store, html)
    listing = store.list("")
    files = ReportFiles(store, listing)
    kinds = report_summary.files_by_kind(listing, own)
    finished = table.filter(pc.equal(table["status"], OK))
    recipes = report_summary.group_by(table, "recipe")
    failures = report_summary.group_failures(table)
    draws = find_draws(finished)
    with_images = [group.name for group in recipes if group.finished]
    gallery = Gallery(finished, draws, files, Shares.of(images), beside)
    shown = [group.name for group in report_page.listed(recipes)]
    some = report_labels.evenly(with_images, MAX_RECIPES)

    whole = report_summary.overall(table)
    parts = {
        "compare": [gallery.compare()],
        "images": [gallery.contact_sheets(with_images)],
        "weather": [report_page.weather_charts(spreads(finished, draws))],
        "labels": _labels(finished, some, files),
        "buffers": [gallery.buffers(with_images)],
        "contents": [
            report_page.recipe_table(recipes, weather_of_recipes(finished, draws, shown)),
            report_page.scene_table(report_summary.group_by(table, "scene")),
            report_page.file_table(kinds),
        ],
        "failures": [report_page.failure_table(failures)],
    }  # in this order files are read, and noted where they are damaged
    parts["damaged"] = [report_page.problem_table(files.problems, files.unlisted)]
    sections = {k: report_tables.section(k, t, *parts[k]) for k, t in _SECTIONS.items()}
    head = joined([report_page.tiles(whole, len(recipes), kinds), _facts(table)])
    return _page(_name_of(store), head, sections), len(files.problems) + files.unlisted


def _labels(table: pa.Table, recipes: list[str], files: ReportFiles) -> list[Html | None]:
    classes = report_labels.count_classes(table, files)
    visible = report_labels.share_visible(table, recipes, files)
    codes = report_labels.share_codes(table, recipes, files)
    return [
        report_label_page.class_table(classes) if classes and classes.rows else None,
        report_label_page.visibility_bars(visible) if visible else None,
        report_label_page.code_bars(*codes) if codes else None,
    ]


def _facts(table: pa.Table) -> Html:
    def words(column: str) -> list[str]:
        return [str(value) for value in report_summary.distinct(table, column)]

    return report_tables.facts(
        [
            ("Image size", report_summary.image_sizes(table)),
            ("Cameras", words("camera")),
            ("Trajectory", words("trajectory")),
            ("Surface of labels", words("surface")),
            ("Seeds", words("seed")),
            ("Version", words("version")),
            ("Backend", words("backend")),
        ]
    )


def _page(name: str, head: Html, sections: dict[str, Html]) -> str:
    style, script = _asset("report.css"), _asset("report.js")
    # Only this very script runs, whatever may have slipped into the text, and nothing is fetched.
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    )
    links = [tag("a", title, href=f"#{key}") for key, title in _SECTIONS.items() if sections[key]]
    return joined(
        [
            Html('<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'),
            tag("meta", http_equiv="Content-Security-Policy", content=Html(policy)),
            tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
            tag("meta", name="color-scheme", content="light dark"),
            tag("title", f"{name} – dataset report"),
            Html(f"\n<style>\n{style}</style>\n<noscript><style>{_asset('report_static.css')}"),
            Html("</style></noscript>\n</head>\n<body>\n"),
            tag("header", tag("p", "Dataset report", class_="kicker"), tag("h1", name), head),
            Html("\n"),
            tag("nav", links, aria_label="Sections"),
            Html("\n"),
            tag("main", [joined([part, Html("\n")]) for part in sections.values() if part]),
            tag("footer", "Written by ", tag("code", "climategs report"), "."),
            Html(f"\n<script>{script}</script>\n</body>\n</html>\n"),
        ]
    )


def _asset(name: str) -> str:
    return resources.files("tools").joinpath(name).read_text(encoding="utf-8")


def _name_of(store: Store) -> str:
    if store.local_dir is not None:
        return store.local_dir.resolve().name or "output"
    address = urlsplit(store.uri)
    return PurePosixPath(unquote(address.path)).name or address.netloc or "output"


def _beside(store: Store, html: Path) -> tuple[bool, list[str]]:
    """Whether the page lies in the output's folder, and pages that are no part of the output."""
    if store.local_dir is None:
        return False, [REPORT]
    root, target = store.local_dir.resolve(), html.absolute().parent.resolve() / html.name
    inside = target.is_relative_to(root)
    own = [REPORT, target.relative_to(root).as_posix()] if inside else [REPORT]
    return target.parent == root, own


def text_of(written: Written) -> str:
    """One line for the terminal."""
    said = f"{written.path} ({written.size / 1e6:.2f} MB)"
    if written.problems:
        said += f"; {count(written.problems, 'file')} could not be read, see the page"
    return said
