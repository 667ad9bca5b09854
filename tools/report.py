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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from augment.dataset.label_files import LABELS, RECORD, LabelsRecord
from augment.effects.lidar import codes
from augment.errors import OutputError
from augment.output.atomic import write_atomic
from augment.output.box_weather import box_tables
from augment.output.layout import path_kinds
from augment.output.manifest import OK, read_manifest_rows
from augment.output.names import STATE_FOLDER, folder_name
from augment.output.store import Store, StoredFile, open_store
from tools.chosen_images import cameras_on_car, evenly, first_of_each, value_codes
from tools.report_numbers import (
    byte_size,
    chart,
    count,
    find_draws,
    percent,
    plural_of,
    short,
    spreads,
    weather_of_recipes,
    with_unit,
)
from tools.report_pictures import MAX_IMAGES, Gallery, ReportFiles, Shares, depth_gradient

REPORT = "report.html"
IMAGES = 48
MAX_PAGE = 5_000_000  # bytes
MAX_RECIPES = 12  # whose labels and sweeps are looked at
# Rows of a table, those of one that is not folded, ...
LIMITS = {"max_rows": 40, "open_rows": 12, "max_charts": 24, "max_failures": 20}
MAX_EXAMPLES = 3
MAX_TEXT = 300  # characters of one name or message
# Control characters and lone surrogates have no place in HTML; others could turn the line's
# direction and so show a name as what it is not.
_INVISIBLE = re.compile(
    "[\0-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\u200e\u200f\u202a-\u202e\u2066-\u2069]"
)
_DIGITS = re.compile(r"\d+")
# Of a million rows they take some hundred megabytes, over and over.
_UNUSED = ["timestamp_ns", "instance_path", "recipe_hash", "style_method"]
_UNUSED += ["render_scale", "settings"]
OTHER = "other"  # the kind of a variant's other files, such as its recipe: they are small
STATE = "state of jobs"  # the kind of the files in the folder of jobs
MAX_BOX_FILES = 40  # the number of label files in which boxes are counted
MAX_TABLES = 6  # the number of variants of each recipe whose box tables are read
MAX_SWEEPS = 3  # the number of sweeps of each recipe that are read
VISIBILITY_STEPS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95)  # lower bounds of the bins; the last is open
# Bounds of the bins of luminance contrast; the first bin begins at -1, the last is open.
CONTRAST_STEPS = (-0.2, 0.2, 1.0, 5.0, 20.0)
_BOX = {"frame": pa.int64(), "camera": pa.string(), "box": pa.int64()}
_CODES = {
    codes.UNCHANGED: "unchanged",
    codes.ATTENUATED: "weaker",
    codes.SCATTERED: "scattered in the air or at the water",
    codes.LOST: "lost",
    codes.MOVED: "on another surface",
    codes.PRECIPITATION: "on a drop or a flake",
}
_FACTS = {
    "size": "Image size",
    "camera": "Cameras",
    "trajectory": "Trajectory",
    "surface": "Surface of labels",
    "seed": "Seeds",
    "version": "Version",
    "backend": "Backend",
}
# Columns of a group of images, each with the column it is computed from and Arrow's function.
# Frames are counted once per scene, whatever their variants and cameras.
_COUNTS = {
    "source": ("source", "min"),
    "finished": ("finished", "sum"),
    "failed": ("failed", "sum"),
    "scenes": ("scene", "count_distinct"),
    "variants": ("draw", "count_distinct"),
    "frames": ("place", "count_distinct"),
    "cameras": ("camera", "count_distinct"),
}


class Written(NamedTuple):
    """A written page. problems: the number of files that could not be read."""

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
    # Captions of long names may outgrow the pictures: with fewer of both the page fits.
    for fewer in (images, images // 2, images // 4, 0):
        page, problems = make_page(store, Path(html), fewer)
        data = page.encode()
        if len(data) <= MAX_PAGE:
            break
    write_atomic(Path(html).absolute(), data)
    return Written(Path(html), len(data), problems)


def make_page(store: Store, html: Path, images: int) -> tuple[str, int]:
    """Return the page's text and the number of unreadable files. html: the page's future path."""
    table = read_manifest_rows(store, _UNUSED)
    cameras = cameras_on_car(store, table)
    table = add_variant_key(table.drop_columns("calibration_path"))
    is_beside, page_names = _beside(store, html)
    listing = store.list("")
    files = ReportFiles(store, listing)
    is_ok = pc.equal(table["status"], OK)
    columns = {}
    for name in table.column_names:  # a million paths take 50 MB: they are not held twice
        columns[name] = table[name].filter(is_ok)
        if name.endswith("_path") or name == "checksum":
            table = table.drop_columns(name)
    finished = pa.table(columns)
    recipes = group_by(table, "recipe")
    draws = find_draws(finished)
    clear_draws = set(draws.filter(draws["is_clear"])["draw"].to_pylist())
    with_images = [group["name"] for group in recipes if group["finished"]]
    gallery = Gallery(finished, clear_draws, cameras, files, Shares.of(images), is_beside)
    sample_recipes = evenly(with_images, MAX_RECIPES)
    number_spreads = spreads(draws)
    environment = make_environment()
    style, script = (page_asset(environment, name) for name in ("report.css", "report.js"))
    # Dictionaries keep their order: in this one files are read, and noted where they are damaged.
    facts = {
        "name": _name_of(store),
        "whole": group_by(table)[0],
        "compare": gallery.compare(),
        "sheets": gallery.contact_sheets(with_images),
        "charts": [chart(spread) for spread in number_spreads if not spread.is_constant],
        "constant": [spread for spread in number_spreads if spread.is_constant],
        "classes": count_classes(finished, files),
        "trainers": read_trainers(files),
        "visible": share_visible(finished, sample_recipes, files),
        "contrast": share_contrast(finished, sample_recipes, files),
        "codes": share_codes(finished, sample_recipes, files),
        "buffers": gallery.buffers(with_images),
        "recipes": recipes,
        "weather": weather_of_recipes(draws),
        "scenes": group_by(table, "scene"),
        "kinds": files_by_kind(listing, page_names),
        "failures": group_failures(table),
        "problems": sorted(files.problems.items()),
        "unlisted": files.unlisted,
        "facts": _facts(table, cameras),
        "style": style,
        "script": script,
        # Only this very script runs, whatever may have slipped into the text.
        "digest": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    }
    text = environment.get_template("report.html").render(facts)
    return text, len(files.problems) + files.unlisted


def visible_text(value: object) -> object:
    """Return a value as the page shows it: cut to MAX_TEXT, its invisible characters replaced."""
    if isinstance(value, Markup):
        return value
    text = str(value)
    if len(text) > MAX_TEXT:
        text = text[: MAX_TEXT - 1] + "…"
    return _INVISIBLE.sub("\ufffd", text)


def make_environment() -> Environment:
    """Return jinja's environment of HTML pages: every value is escaped and cut."""
    environment = Environment(
        loader=PackageLoader("tools"),
        autoescape=True,
        finalize=visible_text,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": count,
        "plural": plural_of,
        "bytes": byte_size,
        "percent": percent,
        "short": short,
        "with_unit": with_unit,
    }
    environment.globals |= {"depth_gradient": depth_gradient, **LIMITS}
    return environment


def page_asset(environment: Environment, name: str) -> Markup:
    """Return the text of a template file, such as a style sheet, that is not escaped."""
    return Markup(environment.loader.get_source(environment, name)[0])


def add_variant_key(table: pa.Table) -> pa.Table:
    """Add a column `draw`: one integer for each scene and variant, in the table's order."""
    return table.append_column("draw", pa.array(value_codes(table, "scene", "variant"), pa.int64()))


def group_by(table: pa.Table, *column: str) -> list[dict[str, Any]]:
    """Count the images that share a value of the column, by that value; without a column, all.
    table: as `add_variant_key` returns it.
    """
    is_ok = pc.equal(table["status"], OK)
    for name, values in (
        ("finished", is_ok.cast(pa.int64())),
        ("failed", pc.invert(is_ok).cast(pa.int64())),
        ("place", pa.array(value_codes(table, "scene", "frame"))),
    ):
        table = table.append_column(name, values)
    aggregates = table.group_by([*column]).aggregate([*_COUNTS.values()])
    named_counts = aggregates.rename_columns([*("name" for _ in column), *_COUNTS])
    groups = sorted(named_counts.to_pylist(), key=lambda group: group.get("name"))
    return [{k: 0 if value is None else value for k, value in row.items()} for row in groups]


def group_failures(table: pa.Table) -> list[dict[str, Any]]:
    """Failed images whose messages differ in numbers alone, which are often frames and paths: the
    first message, how many images, and examples of them. Most frequent first.
    """
    failed_rows = table.filter(pc.not_equal(table["status"], OK))
    names = ("message", "scene", "variant", "frame", "camera")
    failures: dict[str, dict[str, Any]] = {}
    for message, *place in zip(*(failed_rows[name].to_pylist() for name in names), strict=True):
        failure = failures.setdefault(
            _DIGITS.sub("#", message),
            {"message": message or "no message", "images": 0, "examples": []},
        )
        failure["images"] += 1
        if failure["images"] <= MAX_EXAMPLES:
            failure["examples"].append("{} · {} · frame {} · {}".format(*place))
    return sorted(failures.values(), key=lambda failure: (-failure["images"], failure["message"]))


def files_by_kind(
    listing: Mapping[str, StoredFile], page_names: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Count the output's files and bytes by kind, the largest kind first. page_names: paths of the
    page itself, which is left out.
    """
    files = Counter[str]()
    size = Counter[str]()
    for path, stored in listing.items():
        if path not in page_names:
            kind = _kind_of(path)
            files[kind] += 1
            size[kind] += stored.size
    kinds = sorted(files, key=lambda kind: (-size[kind], kind))
    return [{"kind": kind, "files": files[kind], "bytes": size[kind]} for kind in kinds]


def _kind_of(path: str) -> str:
    parts = PurePosixPath(path).parts
    if parts[:1] == (STATE_FOLDER,):
        return STATE
    folder = parts[2] if len(parts) > 3 else parts[-1].partition(".")[0]
    if folder == "manifest":
        return "manifest"
    kind_names = {"images", *path_kinds()}
    return folder if folder in kind_names and len(parts) > 2 else OTHER


def _sample_text(num_read: int, num_files: int) -> str:
    """Say how many of the files were read."""
    if num_read >= num_files:
        return ""
    return f"; from {num_read:,} of {count(num_files, 'file')}, evenly chosen"


def count_classes(table: pa.Table, files: ReportFiles) -> dict[str, Any] | None:
    """Boxes by class, the most frequent first: (class, boxes, tracks). Of every scene's first
    variant that has labels: they are the same in the others.
    """
    labelled_rows = table.select(["scene", "draw", "labels_path"]).drop_null()
    first_draws = labelled_rows["draw"].take(first_of_each(labelled_rows, "scene")).combine_chunks()
    labelled_rows = labelled_rows.filter(pc.is_in(labelled_rows["draw"], value_set=first_draws))
    rows = first_of_each(labelled_rows, "labels_path").tolist()
    boxes = Counter[str]()
    tracks = set[tuple[str, str, str]]()
    num_read = 0
    row_numbers = pa.array(evenly(rows, MAX_BOX_FILES), pa.int64())
    for row in labelled_rows.take(row_numbers).to_pylist():
        columns = files.read_columns(row["labels_path"], ("label", "track_id"))
        if columns is None or columns.num_columns < 2:
            continue
        num_read += 1
        labels, ids = (map(str, columns[name].to_pylist()) for name in ("label", "track_id"))
        for label, track in zip(labels, ids, strict=True):
            boxes[label] += 1
            tracks.add((label, row["scene"], track))
    tracks_by_label = Counter(label for label, *_ in tracks)
    order = sorted(boxes, key=lambda label: (-boxes[label], label))
    class_rows = [(label, boxes[label], tracks_by_label[label]) for label in order]
    return {"rows": class_rows, "sample": _sample_text(num_read, len(rows))} if class_rows else None


def read_trainers(files: ReportFiles) -> LabelsRecord | None:
    """Read the record of the labels in formats for trainers; None where there are none."""
    path = f"{LABELS}/{RECORD}"
    return files.read(path, LabelsRecord.model_validate_json) if path in files.listing else None


def share_visible(table: pa.Table, recipes: list[str], files: ReportFiles) -> dict[str, Any] | None:
    """Count boxes by the share that the weather leaves visible, in VISIBILITY_STEPS.

    The product of what every effect leaves, as `augment.output.box_weather.combine_visibility` has
    it.
    """
    kinds = (
        kind
        for kind, of_boxes in box_tables().items()
        if of_boxes.visible_column or of_boxes.hidden_column
    )
    columns = [f"{kind}_path" for kind in kinds if f"{kind}_path" in table.column_names]

    def count_boxes(paths: dict[str, str | None]) -> Counter[int] | None:
        if (visible := _visible(paths, files)) is None:
            return None
        bins = np.digitize(np.clip(visible, 0, 1), VISIBILITY_STEPS) - 1
        return Counter(bins.tolist())

    counts_by_recipe, sample = _count_by_recipe(table, recipes, columns, MAX_TABLES, count_boxes)
    bounds = [f"{100 * step:.0f}" for step in VISIBILITY_STEPS] + ["100"]
    keys = {i: (f"{a}–{b} %", f"s{i}") for i, (a, b) in enumerate(itertools.pairwise(bounds))}
    return _bars(counts_by_recipe, sample, "box", keys)


def share_contrast(
    table: pa.Table, recipes: list[str], files: ReportFiles
) -> dict[str, Any] | None:
    """Count boxes by their luminance contrast to what is about them, in CONTRAST_STEPS.

    None where no image has boxes with a contrast.
    """
    of_kind = {f"{kind}_path": t for kind, t in box_tables().items() if t.contrast_column}
    columns = [column for column in of_kind if column in table.column_names]

    def count_boxes(paths: dict[str, str | None]) -> Counter[int] | None:
        total = Counter[int]()
        for column, path in paths.items():
            name = of_kind[column].contrast_column
            part = None if path is None else files.read_columns(path, (name,))
            if part is None or not part.num_columns:
                continue
            if part.schema.types != [pa.float64()]:
                return files.note(str(path), "its columns are not of the types that a job writes")
            contrasts = pc.fill_null(part[name], np.nan).to_numpy()
            bins = np.digitize(contrasts[np.isfinite(contrasts)], CONTRAST_STEPS)
            total += Counter(bins.tolist())
        return total

    if not columns:
        return None
    counts_by_recipe, sample = _count_by_recipe(table, recipes, columns, MAX_TABLES, count_boxes)
    bounds = [f"{step:g}".replace("-", "−") for step in (-1.0, *CONTRAST_STEPS)]
    names = [f"{a} to {b}" for a, b in itertools.pairwise(bounds)] + [f"over {bounds[-1]}"]
    keys = {i: (name, f"s{i}") for i, name in enumerate(names)}
    return _bars(counts_by_recipe, sample, "box", keys)


def share_codes(table: pa.Table, recipes: list[str], files: ReportFiles) -> dict[str, Any] | None:
    """Count the points of each recipe's sweeps by their weather code.

    None where no sweep has the column `weather_code`.
    """

    def count_points(paths: dict[str, str | None]) -> Counter[int] | None:
        sweep = files.read_columns(str(paths["lidar_path"]), ("weather_code",))
        if sweep is None or not sweep.num_columns:
            return None
        column = sweep["weather_code"].drop_null()
        is_whole = pa.types.is_integer(column.type)
        entries = pc.value_counts(column).to_pylist() if is_whole else ()
        return Counter({entry["values"]: entry["counts"] for entry in entries})

    counts_by_recipe, sample = _count_by_recipe(
        table, recipes, ["lidar_path"], MAX_SWEEPS, count_points
    )
    codes = sorted({code for _, counts in counts_by_recipe for code in counts})
    keys = {code: (_CODES.get(code, f"code {code}"), f"c{i % 8}") for i, code in enumerate(codes)}
    return _bars(counts_by_recipe, sample, "point", keys)


def _count_by_recipe(
    table: pa.Table,
    recipes: list[str],
    columns: list[str],
    max_sets: int,
    count_values: Callable[[dict[str, str | None]], Counter[int] | None],
) -> tuple[list[tuple[str, Counter[int]]], str]:
    """The sum of what is counted in the files of each recipe that has any, of at most `most` of
    those that its rows name together, and how much that is of all.
    """
    counts_by_recipe = []
    num_read = 0
    num_sets = 0
    for recipe in recipes:
        recipe_rows = table.select(["recipe", *columns]).filter(pc.equal(table["recipe"], recipe))
        sets = recipe_rows.group_by(columns, use_threads=False).aggregate([]).to_pylist()
        sets = [paths for paths in sets if any(paths.values())]
        sets.sort(key=lambda paths: str([*paths.values()]))
        set_counts = [
            counts for s in evenly(sets, max_sets) if (counts := count_values(s)) is not None
        ]
        if total := sum(set_counts, Counter[int]()):
            counts_by_recipe.append((recipe, total))
        num_sets += len(sets) if set_counts else 0
        num_read += len(set_counts)
    return counts_by_recipe, _sample_text(num_read, num_sets)


def _bars(
    counts_by_recipe: list[tuple[str, Counter[int]]],
    sample: str,
    noun: str,
    keys: Mapping[int, tuple],
) -> dict[str, Any] | None:
    """For every recipe that has any, (CSS class, name, count) of each part of its bar. noun: what
    is counted. keys: (name, CSS class) of each category.
    """
    rows = [
        (r, [(*keys[k][::-1], counts[k]) for k in keys if counts[k]])
        for r, counts in counts_by_recipe
    ]
    bars = {"rows": rows, "sample": sample, "noun": noun, "keys": [*keys.values()]}
    return bars if rows else None


def _visible(paths: Mapping[str, str | None], files: ReportFiles) -> np.ndarray | None:
    """Return the share that the weather leaves visible of each box that covers a pixel.

    Each table counts what one effect hides; the product over the tables is what all leave visible.

    Args:
        paths: path of each label table of a variant, by the manifest's column.
        files: reads the tables, and notes those that cannot be read.

    Returns:
        float64 [boxes]; None if a table cannot be read, or if there is none.
    """
    parts = []
    for column, path in paths.items():
        if path is None:
            continue
        kind = box_tables()[column.removesuffix("_path")]
        share_column = kind.visible_column or kind.hidden_column
        has_pixels = "pixels" in kind.columns
        types = {
            **_BOX,
            **({"pixels": pa.int64()} if has_pixels else {}),
            share_column: pa.float64(),
        }
        table = files.read_columns(path, (*types,))
        if table is None:
            return None
        if table.num_columns < len(types):  # of an output older than `pixels`
            continue
        if table.schema.types != [*types.values()]:
            return files.note(path, "its columns are not of the types that a job writes")
        share = pc.subtract(1.0, table[share_column]) if kind.hidden_column else table[share_column]
        share = pc.fill_null(pc.if_else(pc.is_finite(share), share, 1.0), 1.0)
        is_shown = pc.greater(table["pixels"], 0) if has_pixels else pa.repeat(True, len(table))
        part = table.select(list(_BOX)).append_column("left", share)
        parts.append(part.append_column("shown", pc.fill_null(is_shown, False)))
    if not parts:
        return None
    groups = pa.concat_tables(parts).group_by(list(_BOX), use_threads=False)
    boxes = groups.aggregate([("left", "product"), ("shown", "any")])
    return boxes.filter(boxes["shown_any"])["left_product"].to_numpy()


def _facts(table: pa.Table, cameras: list[str]) -> list[tuple[str, list[Any]]]:
    """Return the few values that images have in each column of _FACTS, the most frequent first;
    cameras as they stand on the car.
    """
    sizes = pc.binary_join_element_wise(
        *(table[name].cast(pa.string()) for name in ("width", "height")), "×"
    )
    table = table.append_column("size", sizes)
    facts = []
    for column, title in _FACTS.items():
        entries = pc.value_counts(table[column].drop_null()).to_pylist()
        entries.sort(key=lambda entry: (-entry["counts"], str(entry["values"])))
        values = [entry["values"] for entry in entries[:6]]
        facts.append((title, sorted(values, key=cameras.index) if column == "camera" else values))
    return [(title, values) for title, values in facts if values]


def _name_of(store: Store) -> str:
    if store.local_dir is not None:
        return store.local_dir.resolve().name or "output"
    address = urlsplit(store.uri)
    return PurePosixPath(unquote(address.path)).name or address.netloc or "output"


def _beside(store: Store, html: Path) -> tuple[bool, list[str]]:
    """Return True if the page lies in the output's folder, and the pages that are no output."""
    if store.local_dir is None:
        return False, [REPORT]
    root = store.local_dir.resolve()
    target = html.absolute().parent.resolve() / html.name
    is_inside = target.is_relative_to(root)
    page_names = [REPORT, target.relative_to(root).as_posix()] if is_inside else [REPORT]
    return target.parent == root, page_names
