"""How far a render job has come: what its output folder holds of every variant, image by image.

An image counts once its line is in the variant's progress log. When a job ends, what belongs to a
whole variant is written (boxes, what is measured of them, calibration), the lines become rows of
the manifest, and the log goes. A kill at any point leaves the log, and the next run goes on.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from augment.cameras import Frame
from augment.errors import OutputError
from augment.jobs.atomic import (
    flush_folder,
    make_folder,
    output_error,
    path_below,
    read_file,
    refusals_of,
    remove_temporaries,
    write_atomic,
)
from augment.jobs.box_tables import BoxNumbers, Item
from augment.jobs.claims import hold
from augment.jobs.files import SceneIndex, box_tables, calibration_bytes, frame_entry, read_entries
from augment.jobs.layout import (
    MANIFEST,
    STATE_FOLDER,
    SWEEPS,
    FileListing,
    box_weather_files,
    folder_name,
    item_paths,
    path_columns,
    path_kinds,
    reading_back,
    variant_folder,
    variant_name,
)
from augment.jobs.manifest import (
    OK,
    PARTS,
    Identity,
    Pictured,
    check_rows,
    image_row,
    later_columns,
    merge_rows,
    read_manifest,
    rows_of,
    shown_words,
    write_manifest,
)
from augment.jobs.store import open_store
from augment.jobs.tables import FrameBoxes, boxes_bytes, read_boxes
from augment.jobs.worker import Chunk, Outcome, describe
from recipes.schema import Recipe

_log = logging.getLogger(__name__)
JOURNAL = "journal"  # the folder of progress logs in that of the state


class ProgressLog:
    """`.climategs/journal/<scene>/<variant>.jsonl`: the variant's identity, then a line for every
    image whose files are in place. A line counts only with its line break, so a job killed while
    writing one loses that line and nothing else. `append` may be called from several threads.
    """

    def __init__(self, out_dir: Path, scene: str, variant: str) -> None:
        folder = out_dir / STATE_FOLDER / JOURNAL / folder_name(scene)
        self.path = folder / f"{folder_name(variant)}.jsonl"
        self._file: int | None = None
        self._lock = threading.Lock()

    def load(self) -> tuple[Identity | None, list[dict[str, Any]]]:
        """The identity and rows in it; (None, []) where there is none."""
        try:
            lines = read_file(self.path).split(b"\n")[:-1]  # the last part has no line break
        except FileNotFoundError:
            return None, []
        except OSError as error:
            raise OutputError(
                f"{self.path} cannot be read: {error.strerror}. Delete it; what it lists is "
                f"rendered again"
            ) from error
        with self.reading():
            identity, *rows = [json.loads(line) for line in lines]
            if not all(isinstance(value, str | None) for value in identity.values()):
                raise ValueError(f"its first line must hold texts; got {identity!r:.200}")
            return Identity(**identity), rows

    def reading(self) -> contextlib.AbstractContextManager[None]:
        """While its lines are taken apart, what goes wrong is an OutputError."""
        return reading_back(str(self.path), "Delete it; what it lists is rendered again")

    def begin(self, identity: Identity) -> None:
        """Open for appending; starts with the identity, and goes on after the last whole line."""
        with refusals_of(self.path):
            whole = read_file(self.path) if self.path.exists() else b""
            rows = whole[whole.find(b"\n") + 1 : whole.rfind(b"\n") + 1]
            write_atomic(self.path, _line(asdict(identity)) + rows)
            self._file = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW)

    def append(self, row: dict[str, Any]) -> None:
        """Add a finished image. Returns when the line is on the disk."""
        assert self._file is not None, "begin() comes first"
        with self._lock:
            length = os.fstat(self._file).st_size
            try:
                data = _line(row)
                while data:
                    data = data[os.write(self._file, data) :]
                os.fsync(self._file)
            except OSError as error:
                os.ftruncate(self._file, length)  # a later line must not join half of this one
                raise output_error(self.path, error) from error

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def remove(self) -> None:
        """Delete the progress log and the folders it leaves empty."""
        self.close()
        with refusals_of(self.path):
            self.path.unlink(missing_ok=True)
            for folder in (self.path.parent, self.path.parent.parent):
                if folder.is_dir() and not any(folder.iterdir()):
                    folder.rmdir()
                    flush_folder(folder.parent)


def logged_variants(out_dir: Path) -> list[str]:
    """Folders (`<scene>/<variant>`) of the variants that some job has begun and not ended."""
    root = out_dir / STATE_FOLDER / JOURNAL
    return sorted(str(p.relative_to(root).with_suffix("")) for p in root.glob("*/*.jsonl"))


def _line(value: dict[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode() + b"\n"


class VariantState:
    """One variant of the job. rows: what is known of its images, from this run and earlier ones.
    box_weather: what is measured of the boxes of those images, by kind (see box_tables).
    """

    def __init__(
        self, out_dir: Path, index: SceneIndex, recipe: Recipe, identity: Identity
    ) -> None:
        self.index, self.recipe, self.identity = index, recipe, identity
        self.name = variant_name(recipe)
        self.folder = variant_folder(index.name, self.name)
        self.place = out_dir / self.folder
        self.progress_log = ProgressLog(out_dir, index.name, self.name)
        self.rows: dict[Item, dict[str, Any]] = {}
        self.box_weather: dict[str, dict[Item, BoxNumbers]] = {kind: {} for kind in box_tables()}
        self._out_dir, self._is_logged = out_dir, False
        self._listing = FileListing(out_dir)
        self._adopts = False  # images whose rows lack the digest of the scene's content

    @property
    def key(self) -> tuple[str, str]:
        return self.index.name, self.name

    def load(self, table: pa.Table | None, listing: FileListing, overwrite: bool) -> bool:
        """Read what is known; true where there is anything that has to be given up. listing: of the
        output folder.
        """
        self._listing = listing
        begun, logged = self.progress_log.load()
        rows = [] if table is None else rows_of(table, {self.key})
        identities = {Identity.of_row(row) for row in rows} | ({begun} if begun else set())
        if overwrite and identities:
            return True
        for found in sorted(identities, key=repr):
            self.identity.check(found, str(self.place))
        if self.identity.source_digest is not None:
            self._adopts = any(found.source_digest is None for found in identities)
            if self._adopts:
                _log.warning(
                    "note: %s is of an older version, which did not note the content of its "
                    "scene; it is taken to be the scene as it is now",
                    self.place,
                )
        self._is_logged = begun is not None
        for kind, file in box_weather_files(self.recipe).items():
            if any(row.get(f"{kind}_path") for row in rows):
                self.box_weather[kind] = _read_table(kind, self.place / file)
        with self.progress_log.reading():
            for row in logged:  # which have the boxes' numbers beyond the manifest's columns
                for kind, own in box_tables().items():
                    if (numbers := row.pop(kind, None)) is not None:
                        self.box_weather[kind][row["frame"], row["camera"]] = own.from_json(numbers)
            check_rows(logged, self.key, str(self.progress_log.path))
        # The recipe's hash agrees, so the rows show what it says, whatever their version called it.
        shown = shown_words(self.recipe)
        if self._adopts:
            shown["source_digest"] = self.identity.source_digest
        known = [{**later_columns(), **row, **shown} for row in [*rows, *logged]]
        self.rows = {(row["frame"], row["camera"]): row for row in known}
        return False

    def is_finished(self, item: Item) -> bool:
        """Whether the image's row says ok, and all its files and its boxes' numbers are there; and
        its objects are numbered as today, when a frame may be read that could not be read then.
        """
        row = self.rows.get(item)
        if row is None or row["status"] != OK:
            return False
        measured = [kind for kind in box_tables() if row[f"{kind}_path"] is not None]
        if any(item not in self.box_weather[kind] for kind in measured):
            return False
        if "box_2d" in measured:
            numbers = self.box_weather["box_2d"][item]
            if not self.index.instances.agree(numbers.track_ids, numbers["instance"]):
                return False
        of_variant = {"labels", "calibration", *box_tables()}
        paths = [row[f"{kind}_path"] for kind in path_kinds() if kind not in of_variant]
        return all(self._listing.has(path) for path in paths if path is not None)

    def check_folders(self, cameras: Iterable[str]) -> None:
        """Raise OutputError where a folder that will be written to is a link out of the output."""
        recipe, index = self.recipe, self.index
        paths = {
            path
            for name in {"", *cameras}
            for path in item_paths(index.name, recipe, name, 0).values()
            if path is not None
        }
        for folder in sorted({path.rpartition("/")[0] for path in paths}):
            path_below(self._out_dir, tuple(folder.split("/")))

    def record(self, outcome: Outcome, frame: Frame) -> None:
        """Enter what became of an image, durably. May be called from several threads."""
        row, tables = self._row(outcome, frame), box_tables()
        measured = {k: tables[k].to_json(numbers) for k, numbers in outcome.box_weather.items()}
        self.progress_log.append({**row, **measured})
        item = frame.index, outcome.camera
        for kind, numbers in outcome.box_weather.items():
            self.box_weather[kind][item] = numbers
        self.rows[item] = row

    def files(self) -> dict[str, Path]:
        """What belongs to the whole variant, by kind of path; of what is measured of boxes not what
        came with a later version than the one that rendered the images: only rendering again
        would tell what is in it.
        """
        files = {"calibration": self.place / "calibration.json"}
        if self.recipe.output.labels and self.index.labels is not None:
            files["labels"] = self.place / "labels" / "boxes.parquet"
            labelled = [row for row in self.rows.values() if row["labels_path"] is not None]
            for kind, file in box_weather_files(self.recipe).items():
                if not labelled or any(row[f"{kind}_path"] is not None for row in labelled):
                    files[kind] = self.place / file
        return files

    def write_files(self, boxes: BoxCache, trajectory: str) -> None:
        for kind, path in self.files().items():
            if kind == "calibration":
                write_atomic(path, self._calibration(path, trajectory))
            elif kind == "labels":
                write_atomic(path, self._boxes(path, boxes))
            else:  # not of an image that was measured once and has failed since
                known = self.box_weather[kind]
                listed = {i for i, row in self.rows.items() if row[f"{kind}_path"] is not None}
                data = box_tables()[kind].to_bytes({i: known[i] for i in known if i in listed})
                write_atomic(path, data)

    def is_complete(self) -> bool:
        """Whether `finish` has nothing to do for it, and no progress log is open."""
        return (
            not self._is_logged
            and not self._adopts
            and all(path.is_file() for path in self.files().values())
        )

    def _boxes(self, path: Path, cache: BoxCache) -> bytes:
        frames = {frame for frame, _ in self.rows}
        known: dict[int, FrameBoxes] = {}
        if path.is_file():
            with contextlib.suppress(OutputError):  # a damaged one: the scene still has the boxes
                known = {n: boxes for n, boxes in read_boxes(path).items() if n in frames}
        found = known | cache.get(sorted(frames - known.keys()))
        number_of = self.index.instances.of
        return boxes_bytes(
            {n: replace(b, instances=number_of(b.boxes.track_ids)) for n, b in found.items()}
        )

    def _calibration(self, path: Path, trajectory: str) -> bytes:
        index, known, names = self.index, self.index.frames_by_number, dict[int, list[str]]()
        for frame, camera in self.rows:
            names.setdefault(frame, []).append(camera)
        here, scale = [n for n in names if n in known], self.recipe.render.scale
        entries = {n: frame_entry(known[n], names[n], scale, index.world_origin_m) for n in here}
        if gone := names.keys() - known.keys():  # the scene has lost frames since
            entries |= {n: e for n, e in read_entries(path).items() if n in gone}
        return calibration_bytes(index, self.name, trajectory, entries)

    def _row(self, outcome: Outcome, frame: Frame) -> dict[str, Any]:
        recipe, index = self.recipe, self.index
        camera = frame.cameras[outcome.camera].scaled(recipe.render.scale)
        paths = path_columns(item_paths(index.name, recipe, outcome.camera, frame.index))
        absent = box_tables().keys() - outcome.box_weather.keys()
        absent |= set() if outcome.lidar else {"lidar"}
        absent |= set() if frame.index in index.labelled else {"labels"}
        return image_row(
            index.name,
            recipe,
            self.identity,
            Pictured(frame.index, camera.name, camera.timestamp_ns, camera.width, camera.height),
            paths=paths | {f"{kind}_path": None for kind in absent},
            status=outcome.status,
            message=outcome.message,
            checksum=outcome.checksum,
            lidar=outcome.lidar,
            lidar_note=outcome.lidar_note,
            shares=outcome.shares,
        )


class BoxCache:
    """Boxes of the scene's frames, each read once. errors: frames whose boxes cannot be read."""

    def __init__(self, index: SceneIndex) -> None:
        self._index, self._read = index, dict[int, FrameBoxes]()
        self.errors: dict[int, str] = {}

    def get(self, frames: Iterable[int]) -> dict[int, FrameBoxes]:
        """The boxes of those frames that have labels and can be read."""
        requested, labels = [f for f in frames if f in self._index.labelled], self._index.labels
        for number in requested:
            if labels is None or number in self._read or number in self.errors:
                continue
            try:
                time_ns = self._index.frames_by_number[number].timestamp_ns
                boxes = FrameBoxes(time_ns, labels.boxes(number))
                boxes_bytes({number: boxes})  # what cannot be stored exactly fails here, by frame
            except Exception as error:
                self.errors[number] = describe(error, f"reading the boxes of frame {number}")
            else:
                self._read[number] = boxes
        return {number: self._read[number] for number in requested if number in self._read}


class JobState:
    """The variants of a job in its output folder. Needs the folder's lock."""

    def __init__(
        self,
        out_dir: Path,
        index: SceneIndex,
        recipes: Sequence[Recipe],
        identities: Sequence[Identity],
    ) -> None:
        self.out_dir, self.index = out_dir, index
        self._table: pa.Table | None = None
        pairs = zip(recipes, identities, strict=True)
        self.variants = [VariantState(out_dir, index, *pair) for pair in pairs]

    def open(self, *, overwrite: bool) -> None:
        """Clear away what a killed run left, and read what it finished."""
        if (self.out_dir / MANIFEST).is_file():
            self._table = read_manifest(self.out_dir)
        path_below(self.out_dir, (STATE_FOLDER, JOURNAL, folder_name(self.index.name)))
        listing = FileListing(self.out_dir)
        replaced = [v for v in self.variants if v.load(self._table, listing, overwrite)]
        self._clear_leftovers()
        if replaced:
            self._give_up(replaced)

    def pending(self, selection: Sequence[tuple[Frame, tuple[str, ...]]]) -> Iterator[Chunk]:
        """What has to be rendered, in order: variant by variant, frame by frame."""
        for number, variant in enumerate(self.variants):
            for frame, names in selection:
                left = tuple(n for n in names if not variant.is_finished((frame.index, n)))
                if left:
                    yield Chunk(number, frame.index, left)

    def finish(self, boxes: BoxCache) -> None:
        """Write what belongs to the variants that have rows, and the manifest. Safe to repeat."""
        variants = [variant for variant in self.variants if variant.rows]
        for variant in variants:
            variant.write_files(boxes, variant.identity.trajectory)
        if variants:
            self._replace_rows([r for v in variants for r in v.rows.values()], variants)
            self._drop_sweeps()
        for variant in variants:
            variant.progress_log.remove()

    def is_complete(self) -> bool:
        """Whether `finish` has nothing to write."""
        there = (self.out_dir / MANIFEST).is_file()
        return there and all(variant.is_complete() for variant in self.variants)

    def close(self) -> None:
        for variant in self.variants:
            variant.progress_log.close()

    def _give_up(self, variants: Sequence[VariantState]) -> None:
        """Drop the variants' files and rows, in an order that a kill cannot confuse: the folder
        goes first, in one step. Until the rows have gone too, the next run finds the old images
        missing; the old job can render them again, and another is refused.
        """
        trash = self.out_dir / STATE_FOLDER / "trash"
        for number, variant in enumerate(variants):
            if variant.place.is_dir():
                with refusals_of(variant.place):
                    make_folder(trash)
                    variant.place.rename(trash / str(number))
                    flush_folder(variant.place.parent)
        if self._table is not None:
            self._replace_rows([], variants)
        for variant in variants:
            variant.progress_log.remove()
        _remove_tree(trash)

    def _drop_sweeps(self) -> None:
        """Delete the scene's sweeps that no image has any more, unless other jobs are under way,
        whose images the manifest does not have yet.
        """
        mine = {variant.folder for variant in self.variants}
        if (self.out_dir / PARTS).is_dir() or not mine.issuperset(logged_variants(self.out_dir)):
            return
        assert self._table is not None, "the manifest has just been written"
        named = set(self._table["lidar_path"].to_pylist())
        folder = self.out_dir / folder_name(self.index.name) / SWEEPS
        with refusals_of(folder):
            for path in folder.glob("*.parquet"):
                if path.relative_to(self.out_dir).as_posix() not in named:
                    path.unlink()
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()

    def _replace_rows(self, rows: list[dict[str, Any]], variants: Sequence[VariantState]) -> None:
        """Exchange rows of the manifest as it is now: other jobs may have merged theirs."""
        with hold(open_store(self.out_dir), "manifest"):
            there = (self.out_dir / MANIFEST).is_file()
            keys = {variant.key for variant in variants}
            self._table = merge_rows(read_manifest(self.out_dir) if there else None, rows, keys)
            write_manifest(self.out_dir, self._table)

    def _clear_leftovers(self) -> None:
        state = self.out_dir / STATE_FOLDER
        remove_temporaries(self.out_dir, recursive=False)
        remove_temporaries(state, recursive=False)  # blocks of other jobs may be at work below it
        remove_temporaries(state / JOURNAL)
        _remove_tree(state / "trash")
        mine = {variant.folder for variant in self.variants}
        sweeps = f"{folder_name(self.index.name)}/{SWEEPS}"
        for folder in sorted({sweeps, *mine, *logged_variants(self.out_dir)}):
            remove_temporaries(self.out_dir / folder)


def _read_table(kind: str, path: Path) -> dict[Item, BoxNumbers]:
    """A lost or damaged file counts as empty: only rendering again tells what was in it."""
    try:
        return box_tables()[kind].read(path)
    except OutputError as error:
        _log.warning("%s; the images it belongs to are rendered again", error)
        return {}


def _remove_tree(folder: Path) -> None:
    with refusals_of(folder), contextlib.suppress(FileNotFoundError):
        shutil.rmtree(folder)
