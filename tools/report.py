"""One page about an output: what it holds, how its weather is spread, how it looks, what failed.

`climategs report` writes it: a single HTML file without links to anything outside, the same bytes
for the same output. Names and messages of a manifest are untrusted: the template escapes them all.
"""

from __future__ import annotations

import base64
import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from augment.effects.lidar import codes
from augment.errors import OutputError
from augment.jobs.atomic import write_atomic
from augment.jobs.files import box_tables
from augment.jobs.layout import STATE_FOLDER, folder_name, path_kinds
from augment.jobs.manifest import OK, read_finished
from augment.jobs.store import Store, StoredFile, open_store
from tools.report_numbers import (
    byte_size,
    chart,
    count,
    find_draws,
    percent,
    plural_of,
    spreads,
    weather_of_recipes,
)
from tools.report_pictures import (
    MAX_IMAGES,
    Gallery,
    ReportFiles,
    Shares,
    depth_gradient,
    evenly,
    first_of_each,
)

REPORT = "report.html"
IMAGES = 48
MAX_PAGE = 5_000_000  # bytes
MAX_RECIPES = 12  # whose labels and sweeps are looked at
MAX_ROWS = 40  # of a table
OPEN_ROWS = 12  # tables of more are folded
MAX_CHARTS = 24
MAX_FAILURES = 20
MAX_EXAMPLES = 3
MAX_TEXT = 300  # characters of one name or message
# Control characters and lone surrogates have no place in HTML; others could turn the line's
# direction and so show a name as what it is not.
_INVISIBLE = re.compile(
    "[\0-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\u200e\u200f\u202a-\u202e\u2066-\u2069]"
)
_DIGITS = re.compile(r"\d+")
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
# Of a variant's folder; what else lies there, such as its recipe, is small.
OTHER, STATE = "other", "state of jobs"
MAX_BOX_FILES = 40
MAX_TABLES = 6  # of each recipe
MAX_SWEEPS = 3  # of each recipe
VISIBILITY_STEPS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95)  # lower bounds of the bins; the last is open
_BOX = ("frame", "camera", "box")
_BOX_TYPES = [pa.int64(), pa.string(), pa.int64()]
_CODES = {
    codes.UNCHANGED: "unchanged",
    codes.ATTENUATED: "weaker",
    codes.SCATTERED: "scattered in the air or at the water",
    codes.LOST: "lost",
    codes.MOVED: "on another surface",
}


class Written(NamedTuple):
    """problems: how many files could not be read."""

    path: Path
    size: int
    problems: int

    @property
    def sentence(self) -> str:
        text = f"{self.path} ({self.size / 1e6:.2f} MB)"
        if self.problems:
            text += f"; {count(self.problems, 'file')} could not be read, see the page"
        return text


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
    table = add_variant_key(read_finished(store).drop_columns(_UNUSED))
    beside, own = _beside(store, html)
    listing = store.list("")
    files = ReportFiles(store, listing)
    finished = table.filter(pc.equal(table["status"], OK))
    recipes = group_by(table, "recipe")
    draws = find_draws(finished)
    with_images = [group.name for group in recipes if group.finished]
    gallery = Gallery(finished, draws, files, Shares.of(images), beside)
    some = evenly(with_images, MAX_RECIPES)
    found = spreads(finished, draws)
    shown = [group.name for group in listed(recipes)["rows"]]
    script = _asset("report.js")
    # Dictionaries keep their order: in this one files are read, and noted where they are damaged.
    facts = {
        "name": _name_of(store),
        "whole": overall(table),
        "compare": gallery.compare(),
        "sheets": gallery.contact_sheets(with_images),
        "charts": [chart(spread) for spread in found if not spread.is_constant],
        "constant": [spread for spread in found if spread.is_constant],
        "classes": count_classes(finished, files),
        "visible": share_visible(finished, some, files),
        "codes": share_codes(finished, some, files),
        "buffers": gallery.buffers(with_images),
        "recipes": recipes,
        "weather": weather_of_recipes(finished, draws, shown),
        "scenes": group_by(table, "scene"),
        "kinds": files_by_kind(listing, own),
        "failures": group_failures(table),
        "problems": sorted(files.problems.items()),
        "unlisted": files.unlisted,
        "facts": _facts(table),
        "script": script,
        # Only this very script runs, whatever may have slipped into the text.
        "digest": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        "style": _asset("report.css"),
    }
    text = _environment().get_template("report.html").render(facts)
    return text, len(files.problems) + files.unlisted


def visible_text(value: object) -> object:
    """What stands in the page for a value: cut to MAX_TEXT, its invisible characters shown."""
    if isinstance(value, Markup):
        return value
    text = str(value)
    if len(text) > MAX_TEXT:
        text = text[: MAX_TEXT - 1] + "…"
    return _INVISIBLE.sub("\ufffd", text)


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("tools"),
        autoescape=True,
        finalize=visible_text,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": count, "plural": plural_of, "bytes": byte_size, "percent": percent,
        "listed": listed,
    }  # fmt: skip
    environment.globals |= {
        "depth_gradient": depth_gradient, "max_rows": MAX_ROWS, "open_rows": OPEN_ROWS,
        "max_charts": MAX_CHARTS, "max_failures": MAX_FAILURES,
    }  # fmt: skip
    return environment


def _asset(name: str) -> Markup:
    return Markup((resources.files("tools") / "templates" / name).read_text(encoding="utf-8"))


class Group(NamedTuple):
    """The images of a scene, of a recipe, or of all. source: of a scene, else empty."""

    name: str
    source: str
    finished: int
    failed: int
    scenes: int
    variants: int
    frames: int
    cameras: int


class Failure(NamedTuple):
    """Failed images whose messages differ in numbers alone. message: of the first of them."""

    message: str
    images: int
    examples: list[str]


class Files(NamedTuple):
    """files, bytes: of one kind."""

    kind: str
    files: int
    bytes: int


def add_variant_key(table: pa.Table) -> pa.Table:
    """With a column `draw`: one whole number for each scene and variant, in the table's order."""
    return table.append_column("draw", _codes(table, ("scene", "variant"), ""))


def overall(table: pa.Table) -> Group:
    """Of the whole output. table: as `add_variant_key` returns it."""
    everything = table.append_column("all", pa.array([""] * table.num_rows, pa.string()))
    groups = group_by(everything, "all")
    return groups[0] if groups else Group("", "", 0, 0, 0, 0, 0, 0)


def group_by(table: pa.Table, column: str) -> list[Group]:
    """Sorted by name. Frames are counted once per scene, whatever their variants and cameras."""
    finished = pc.equal(table["status"], OK).cast(pa.int64())
    table = table.append_column("finished", finished)
    table = table.append_column("place", _codes(table, ("scene", "frame"), "?"))
    functions = [("finished", "sum"), ("finished", "count"), ("source", "min")] + [
        (name, "count_distinct") for name in ("scene", "draw", "place", "camera")
    ]
    rows = table.group_by(column).aggregate(functions).to_pylist()
    groups = [
        Group(
            name=row[column] or "",
            source=row["source_min"] or "",
            finished=row["finished_sum"] or 0,
            failed=row["finished_count"] - (row["finished_sum"] or 0),
            scenes=row["scene_count_distinct"],
            variants=row["draw_count_distinct"],
            frames=row["place_count_distinct"],
            cameras=row["camera_count_distinct"],
        )
        for row in rows
    ]
    return sorted(groups, key=lambda group: group.name)


def listed(groups: Sequence[Group]) -> dict[str, Any]:
    """The groups that a table has room for, with failures first where not all fit, and how many
    others there are with how many images.
    """
    if len(groups) > MAX_ROWS:
        groups = sorted(groups, key=lambda group: (-group.failed, group.name))
    rest = groups[MAX_ROWS:]
    return {
        "rows": groups[:MAX_ROWS],
        "others": len(rest),
        "finished": sum(group.finished for group in rest),
        "failed": sum(group.failed for group in rest),
    }


def group_failures(table: pa.Table) -> list[Failure]:
    """Most frequent first. Numbers in messages are often frames and paths: they are looked past."""
    failed = table.filter(pc.not_equal(table["status"], OK))
    names = ("message", "scene", "variant", "frame", "camera")
    found: dict[str, Failure] = {}
    for message, *place in zip(*(failed[name].to_pylist() for name in names), strict=True):
        key = _DIGITS.sub("#", message or "")
        known = found.setdefault(key, Failure(message or "no message", 0, []))
        if known.images < MAX_EXAMPLES:
            known.examples.append("{} · {} · frame {} · {}".format(*place))
        found[key] = known._replace(images=known.images + 1)
    return sorted(found.values(), key=lambda failure: (-failure.images, failure.message))


def files_by_kind(listing: Mapping[str, StoredFile], own: Sequence[str] = ()) -> list[Files]:
    """What lies in the output, the largest kind first. own: the page itself, which is left out."""
    found: dict[str, Files] = {}
    for path, stored in listing.items():
        if path not in own:
            kind = _kind_of(path)
            _, files, size = found.get(kind, (kind, 0, 0))
            found[kind] = Files(kind, files + 1, size + stored.size)
    return sorted(found.values(), key=lambda files: (-files.bytes, files.kind))


def _kind_of(path: str) -> str:
    parts = PurePosixPath(path).parts
    if parts[:1] == (STATE_FOLDER,):
        return STATE
    folder = parts[2] if len(parts) > 3 else parts[-1].partition(".")[0]
    if folder == "manifest":
        return "manifest"
    known = {"images", *path_kinds()}
    return folder if folder in known and len(parts) > 2 else OTHER


def sample_text(files: int, of: int) -> str:
    """How much of what there is was looked at."""
    return "" if files >= of else f"; from {files:,} of {count(of, 'file')}, evenly chosen"


class Classes(NamedTuple):
    """Boxes by class, the most frequent first: (class, boxes, tracks)."""

    rows: list[tuple[str, int, int]]
    sample: str


class Bars(NamedTuple):
    """Counts in categories for every recipe that has any: (recipe, [c] counts). noun: what is
    counted. keys: (name, CSS class) of each category.
    """

    rows: list[tuple[str, list[int]]]
    sample: str
    noun: str
    keys: list[tuple[str, str]]

    def parts(self, counts: Sequence[int]) -> list[tuple[str, float, str, str]]:
        """CSS class, share, name and title of each part of a recipe's bar."""
        total = sum(counts)
        return [
            (css, n / total, f"{name} {percent(n, total)}", f"{name}: {n:,} ({percent(n, total)})")
            for n, (name, css) in zip(counts, self.keys, strict=True)
            if n
        ]


def count_classes(table: pa.Table, files: ReportFiles) -> Classes | None:
    """Of every scene's first variant that has labels: they are the same in the others."""
    labelled = table.filter(pc.is_valid(table["labels_path"]))
    if not labelled.num_rows:
        return None
    first = labelled["draw"].take(pa.array(first_of_each(labelled, "scene"))).combine_chunks()
    of_first = labelled.filter(pc.is_in(labelled["draw"], value_set=first))
    rows = first_of_each(of_first, "labels_path")
    chosen = evenly(rows, MAX_BOX_FILES)
    boxes: Counter[str] = Counter()
    tracks: set[tuple[str, str, str]] = set()
    read = 0
    for row in of_first.select(["scene", "labels_path"]).take(pa.array(chosen)).to_pylist():
        found = files.read_columns(row["labels_path"], ("label", "track_id"))
        if found is None or found.num_columns < 2:
            continue
        read += 1
        labels, ids = (found[name].to_pylist() for name in ("label", "track_id"))
        boxes.update(map(str, labels))
        tracks |= {(str(a), row["scene"], str(b)) for a, b in zip(labels, ids, strict=True)}
    tracked = Counter(label for label, *_ in tracks)
    order = sorted(boxes, key=lambda label: (-boxes[label], label))
    counted = [(label, boxes[label], tracked[label]) for label in order]
    return Classes(counted, sample_text(read, len(rows))) if counted else None


def share_visible(table: pa.Table, recipes: list[str], files: ReportFiles) -> Bars | None:
    """How much the weather leaves of each box that an image shows, in VISIBILITY_STEPS.

    The product of what every effect leaves, as `augment.jobs.files.visibility` has it.
    """
    says = (kind for kind, of_boxes in box_tables().items() if of_boxes.visible or of_boxes.hidden)
    columns = [f"{kind}_path" for kind in says if f"{kind}_path" in table.column_names]
    rows, read, there = [], 0, 0
    for recipe in recipes:
        own = table.filter(pc.equal(table["recipe"], recipe))
        found = own.group_by(columns, use_threads=False).aggregate([]).to_pylist()
        sets = sorted((tuple(row[c] for c in columns) for row in found), key=str)
        sets = [paths for paths in sets if any(paths)]
        there += len(sets)
        counts = np.zeros(len(VISIBILITY_STEPS), np.int64)
        for paths in evenly(sets, MAX_TABLES):
            visible = _visible(dict(zip(columns, paths, strict=True)), files)
            if visible is None:
                continue
            read += 1
            edges = [*VISIBILITY_STEPS, np.inf]
            counts += np.histogram(np.clip(visible, 0, 1), edges)[0]
        if counts.any():
            rows.append((recipe, counts.tolist()))
    bounds = [f"{100 * step:.0f}" for step in VISIBILITY_STEPS] + ["100"]
    keys = [(f"{a}–{b} %", f"s{i}") for i, (a, b) in enumerate(itertools.pairwise(bounds))]
    return Bars(rows, sample_text(read, there), "box", keys) if rows else None


def share_codes(table: pa.Table, recipes: list[str], files: ReportFiles) -> Bars | None:
    """How many points of each recipe's sweeps have which weather code.

    None where no sweep has the column `weather_code`.
    """
    counted: list[tuple[str, Counter[int]]] = []
    read, there = 0, 0
    for recipe in recipes:
        own = table.filter(pc.equal(table["recipe"], recipe))
        paths = sorted(path for path in pc.unique(own["lidar_path"]).to_pylist() if path)
        found: Counter[int] = Counter()
        for path in evenly(paths, MAX_SWEEPS):
            sweep = files.read_columns(path, ("weather_code",))
            if sweep is None or not sweep.num_columns:
                break  # a recipe's sweeps all have the column, or none has it
            read += 1
            column = sweep["weather_code"]
            if pa.types.is_integer(column.type):
                entries = pc.value_counts(column.combine_chunks()).to_pylist()
                found.update({e["values"]: e["counts"] for e in entries if e["values"] is not None})
        if found:
            there += len(paths)
            counted.append((recipe, found))
    known = sorted({code for _, found in counted for code in found})
    rows = [(recipe, [found[code] for code in known]) for recipe, found in counted]
    keys = [(_CODES.get(code, f"code {code}"), f"c{i % 8}") for i, code in enumerate(known)]
    return Bars(rows, sample_text(read, there), "point", keys) if rows else None


def _visible(paths: dict[str, str | None], files: ReportFiles) -> np.ndarray | None:
    """float64 [boxes that a pixel shows] of the images that a variant's tables hold."""
    parts = []
    for column, path in paths.items():
        if path is None:
            continue
        kind = box_tables()[column.removesuffix("_path")]
        name, counted = kind.visible or kind.hidden, [n for n in ("pixels",) if n in kind.columns]
        found = files.read_columns(path, (*_BOX, *counted, name))
        if found is None:
            return None
        if found.num_columns < len(_BOX) + len(counted) + 1:  # of an output older than `pixels`
            continue
        if found.schema.types != [*_BOX_TYPES, *(pa.int64() for _ in counted), pa.float64()]:
            return files.note(path, "its columns are not of the types that a job writes")
        value = kind.left({name: np.asarray(pc.fill_null(found[name], np.nan), np.float64)})
        shown = pa.array(np.ones(found.num_rows, np.int8))
        if counted:
            shown = pc.fill_null(pc.greater(found["pixels"], 0), False).cast(pa.int8())
        part = found.select(list(_BOX))
        part = part.append_column("left", pa.array(np.where(np.isfinite(value), value, 1.0)))
        parts.append(part.append_column("shown", shown))
    if not parts:
        return None
    together = pa.concat_tables(parts).group_by(list(_BOX), use_threads=False)
    boxes = together.aggregate([("left", "product"), ("shown", "max")])
    return boxes.filter(pc.equal(boxes["shown_max"], 1))["left_product"].to_numpy()


def _facts(table: pa.Table) -> list[tuple[str, list[Any]]]:
    """What all images share, or the few values that they have, the most frequent first."""
    titles = {
        "size": "Image size",
        "camera": "Cameras",
        "trajectory": "Trajectory",
        "surface": "Surface of labels",
        "seed": "Seeds",
        "version": "Version",
        "backend": "Backend",
    }
    table = table.append_column("size", _joined(table, ("width", "height"), "?", "×"))
    found = []
    for column, title in titles.items():
        counted = pc.value_counts(table[column].combine_chunks()).to_pylist()
        known = [entry for entry in counted if entry["values"] is not None]
        known.sort(key=lambda entry: (-entry["counts"], str(entry["values"])))
        found.append((title, [entry["values"] for entry in known[:6]]))
    return [(title, values) for title, values in found if values]


def _codes(table: pa.Table, names: Sequence[str], null: str) -> pa.Array:
    """int64 [rows]: one number for each combination of the columns' values."""
    joined = _joined(table, names, null, "\0")
    return pc.dictionary_encode(joined).combine_chunks().indices.cast(pa.int64())


def _joined(table: pa.Table, names: Sequence[str], null: str, between: str) -> pa.ChunkedArray:
    columns = [pc.fill_null(table[name].cast(pa.string()), null) for name in names]
    return pc.binary_join_element_wise(*columns, between)


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
