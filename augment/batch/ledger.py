"""What of a job is done already, what is left, and what the manifest will say of it."""

from __future__ import annotations

import contextlib
import logging
import shutil
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa

from augment.batch.atomic import flush_folder, make_folder, output_error, remove_temporaries
from augment.batch.box_tables import BoxNumbers, Item
from augment.batch.box_weather import TABLES
from augment.batch.claims import hold
from augment.batch.journal import Identity, Journal, journalled_variants
from augment.batch.layout import (
    MANIFEST,
    PATH_KINDS,
    STATE_FOLDER,
    box_weather_files,
    item_paths,
    variant_folder,
    variant_name,
)
from augment.batch.manifest import (
    LATER,
    OK,
    merge_rows,
    read_manifest,
    rows_of,
    write_manifest,
)
from augment.batch.rows import Pictured, image_row, shown_words
from augment.batch.runner import Chunk, Outcome
from augment.batch.selection import SceneIndex
from augment.batch.store import open_store
from augment.cameras import Frame
from augment.errors import OutputError
from augment.instances import Instances
from recipes.schema import Recipe

# What belongs to a whole variant is written when the job ends.
_OF_VARIANT = ("labels", *TABLES, "calibration")
_log = logging.getLogger(__name__)


@dataclass
class VariantState:
    """One variant of the job. rows: what is known of its images, from this run and earlier ones.

    box_weather: what is measured of the boxes of those images, by kind (see TABLES).
    """

    recipe: Recipe
    name: str
    folder: str
    identity: Identity
    journal: Journal
    rows: dict[Item, dict[str, Any]] = field(default_factory=dict)
    box_weather: dict[str, dict[Item, BoxNumbers]] = field(
        default_factory=lambda: {kind: {} for kind in TABLES}
    )
    is_journalled: bool = False

    def is_finished(self, out_dir: Path, item: Item, instances: Instances) -> bool:
        """Whether the image's row says ok, and all its files and its boxes' numbers are there; and
        its objects are numbered as today, when a frame may be read that could not be read then.
        """
        row = self.rows.get(item)
        if row is None or row["status"] != OK:
            return False
        measured = [kind for kind in TABLES if row[f"{kind}_path"] is not None]
        if any(item not in self.box_weather[kind] for kind in measured):
            return False
        if "box_2d" in measured:
            numbers: Any = self.box_weather["box_2d"][item]
            if not instances.agree(numbers.track_ids, numbers.instance):
                return False
        paths = [row[f"{kind}_path"] for kind in PATH_KINDS if kind not in _OF_VARIANT]
        return all((out_dir / path).is_file() for path in paths if path is not None)


class Ledger:
    """The state of a job in its output folder. Needs the folder's lock."""

    def __init__(
        self,
        out_dir: Path,
        index: SceneIndex,
        recipes: Sequence[Recipe],
        identities: Sequence[Identity],
    ) -> None:
        self.out_dir, self.index = out_dir, index
        self._lock = threading.Lock()
        self._table: pa.Table | None = None
        self.variants = []
        for recipe, identity in zip(recipes, identities, strict=True):
            name = variant_name(recipe)
            journal = Journal(out_dir, index.name, name)
            folder = variant_folder(index.name, name)
            self.variants.append(VariantState(recipe, name, folder, identity, journal))

    @property
    def keys(self) -> set[tuple[str, str]]:
        return {(self.index.name, variant.name) for variant in self.variants}

    def open(self, *, overwrite: bool) -> None:
        """Clear away what a killed run left, and read what it finished.

        Raises:
            OutputError: a variant's folder holds images of another recipe, scene or version, and
                `overwrite` is false; nothing was changed then.
        """
        if (self.out_dir / MANIFEST).is_file():
            self._table = read_manifest(self.out_dir)
        replaced = [variant for variant in self.variants if self._load(variant, overwrite)]
        self._clear_leftovers()
        if replaced:
            self._give_up(replaced)

    def pending(self, selection: Sequence[tuple[Frame, tuple[str, ...]]]) -> Iterator[Chunk]:
        """What has to be rendered, in order: variant by variant, frame by frame."""
        for number, variant in enumerate(self.variants):
            for frame, names in selection:
                left = [
                    name
                    for name in names
                    if not variant.is_finished(
                        self.out_dir, (frame.index, name), self.index.instances
                    )
                ]
                if left:
                    yield Chunk(number, frame.index, tuple(left))

    def record(self, outcome: Outcome, frame: Frame) -> None:
        """Enter what became of an image, durably. May be called from several threads."""
        variant = self.variants[outcome.variant]
        row = self._row(variant, outcome, frame)
        measured = {k: TABLES[k].to_json(numbers) for k, numbers in outcome.box_weather.items()}
        variant.journal.append({**row, **measured})
        with self._lock:
            variant.rows[frame.index, outcome.camera] = row
            for kind, numbers in outcome.box_weather.items():
                variant.box_weather[kind][frame.index, outcome.camera] = numbers

    def write_manifest(self, variants: Sequence[VariantState]) -> Path:
        """Put the rows of these variants into the manifest."""
        keys = {(self.index.name, variant.name) for variant in variants}
        rows = [row for variant in variants for row in variant.rows.values()]
        return self._replace_rows(rows, keys)

    def close(self) -> None:
        for variant in self.variants:
            variant.journal.close()

    def _load(self, variant: VariantState, overwrite: bool) -> bool:
        """Read the variant's rows; true where there are any that have to be given up."""
        begun, journalled = variant.journal.load()
        rows: list[dict[str, Any]] = []
        if self._table is not None:
            rows = rows_of(self._table, {(self.index.name, variant.name)})
        found = begun or (Identity.of_row(rows[0]) if rows else None)
        if overwrite and found is not None:
            return True
        if found is not None:
            variant.identity.check(found, str(self.out_dir / variant.folder))
        variant.is_journalled = begun is not None
        for kind, file in box_weather_files(variant.recipe).items():
            if any(row.get(f"{kind}_path") for row in rows):
                variant.box_weather[kind] = _read_table(kind, self.out_dir / variant.folder / file)
        for row in journalled:  # which have the boxes' numbers beyond the manifest's columns
            for kind, table in TABLES.items():
                if (numbers := row.pop(kind, None)) is not None:
                    item = row["frame"], row["camera"]
                    variant.box_weather[kind][item] = table.from_json(numbers)
        # The recipe's hash agrees, so the rows show what it says, whatever their version called it.
        shown = shown_words(variant.recipe)
        known = [{**LATER, **row, **shown} for row in [*rows, *journalled]]
        variant.rows = {(row["frame"], row["camera"]): row for row in known}
        return False

    def _give_up(self, variants: Sequence[VariantState]) -> None:
        """Drop the variants' files and rows, in an order that a kill cannot confuse.

        The folder goes first, in one step: until the rows have gone too, the next run finds the
        old images missing, which the old job can render again and another is refused.
        """
        trash = self.out_dir / STATE_FOLDER / "trash"
        for number, variant in enumerate(variants):
            folder = self.out_dir / variant.folder
            if folder.is_dir():
                try:
                    make_folder(trash)
                    folder.rename(trash / str(number))
                    flush_folder(folder.parent)
                except OSError as error:
                    raise output_error(folder, error) from error
        if self._table is not None:
            keys = {(self.index.name, variant.name) for variant in variants}
            self._replace_rows([], keys)
        for variant in variants:
            variant.journal.remove()
        _remove_tree(trash)

    def _replace_rows(self, rows: Sequence[dict[str, Any]], keys: set[tuple[str, str]]) -> Path:
        """Exchange rows of the manifest as it is now: other jobs may have merged theirs."""
        with hold(open_store(self.out_dir), "manifest"):
            there = (self.out_dir / MANIFEST).is_file()
            self._table = merge_rows(read_manifest(self.out_dir) if there else None, rows, keys)
            return write_manifest(self.out_dir, self._table)

    def _clear_leftovers(self) -> None:
        state = self.out_dir / STATE_FOLDER
        remove_temporaries(self.out_dir, recursive=False)
        remove_temporaries(state, recursive=False)  # blocks of other jobs may be at work below it
        remove_temporaries(state / "journal")
        _remove_tree(state / "trash")
        mine = {variant.folder for variant in self.variants}
        for folder in sorted(mine | set(journalled_variants(self.out_dir))):
            remove_temporaries(self.out_dir / folder)

    def _row(self, variant: VariantState, outcome: Outcome, frame: Frame) -> dict[str, Any]:
        recipe, index = variant.recipe, self.index
        camera = frame.cameras[outcome.camera].scaled(recipe.render.scale)
        paths = item_paths(index.name, recipe, outcome.camera, frame.index).columns()
        if not outcome.lidar:
            paths["lidar_path"] = None
        if frame.index not in index.labelled:
            paths["labels_path"] = None
        for kind in TABLES.keys() - outcome.box_weather.keys():
            paths[f"{kind}_path"] = None
        return image_row(
            index.name,
            recipe,
            variant.identity,
            Pictured(frame.index, camera.name, camera.timestamp_ns, camera.width, camera.height),
            paths=paths,
            status=outcome.status,
            message=outcome.message,
            checksum=outcome.checksum,
            lidar=outcome.lidar,
            lidar_note=outcome.lidar_note,
        )


def _read_table(kind: str, path: Path) -> dict[Item, BoxNumbers]:
    """A lost or damaged file counts as empty: only rendering again tells what was in it."""
    try:
        return TABLES[kind].read(path)
    except OutputError as error:
        _log.warning("%s; the images it belongs to are rendered again", error)
        return {}


def _remove_tree(folder: Path) -> None:
    try:
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(folder)
    except OSError as error:
        raise output_error(folder, error) from error
