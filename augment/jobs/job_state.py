"""What of a job is done already, what is left, and what the manifest will say of it."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from augment.boxes import Instances
from augment.cameras import Frame
from augment.errors import OutputError
from augment.jobs.atomic import (
    flush_folder,
    make_folder,
    output_error,
    refusals_of,
    remove_temporaries,
    write_atomic,
)
from augment.jobs.box_tables import TABLES, BoxNumbers, Item
from augment.jobs.claims import hold
from augment.jobs.files import SceneIndex, calibration_bytes, frame_entry, read_entries
from augment.jobs.layout import (
    MANIFEST,
    PATH_KINDS,
    STATE_FOLDER,
    box_weather_files,
    folder_name,
    item_paths,
    variant_folder,
    variant_name,
)
from augment.jobs.manifest import (
    LATER,
    OK,
    Identity,
    Pictured,
    image_row,
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

# ---- What a variant has finished so far, on the disk, until the manifest has it ------------------
# `.climategs/journal/<scene>/<variant>.jsonl` starts with the variant's identity and gains a line
# for every image once all its files are in place. A line counts only with its line break, so a job
# killed while writing one loses that line and nothing else. When a job ends, its lines have become
# rows of the manifest and the progress log goes.


class ProgressLog:
    """The progress log of one variant. `append` may be called from several threads."""

    def __init__(self, out_dir: Path, scene: str, variant: str) -> None:
        folder = out_dir / STATE_FOLDER / "journal" / folder_name(scene)
        self.path = folder / f"{folder_name(variant)}.jsonl"
        self._file: int | None = None
        self._lock = threading.Lock()

    def load(self) -> tuple[Identity | None, list[dict[str, Any]]]:
        """The identity and rows in it; (None, []) where there is none."""
        try:
            lines = self.path.read_bytes().split(b"\n")[:-1]  # the last part has no line break
        except FileNotFoundError:
            return None, []
        try:
            identity, *rows = [json.loads(line) for line in lines]
            return Identity(**identity), rows
        except (ValueError, TypeError, RecursionError) as error:
            raise OutputError(
                f"{self.path} is damaged: {error}. Delete it; what it lists is rendered again"
            ) from error

    def begin(self, identity: Identity) -> None:
        """Open for appending; starts with the identity, or goes on after the last whole line."""
        with refusals_of(self.path):
            whole = self.path.read_bytes() if self.path.exists() else b""
            whole = whole[: whole.rfind(b"\n") + 1]
            write_atomic(self.path, whole or _line(asdict(identity)))
            self._file = os.open(self.path, os.O_WRONLY | os.O_APPEND)

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
    root = out_dir / STATE_FOLDER / "journal"
    return sorted(str(p.relative_to(root).with_suffix("")) for p in root.glob("*/*.jsonl"))


def _line(value: dict[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode() + b"\n"


# ---- What of a job is done already, what is left, and what the manifest will say of it -----------

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
    progress_log: ProgressLog
    rows: dict[Item, dict[str, Any]] = field(default_factory=dict)
    box_weather: dict[str, dict[Item, BoxNumbers]] = field(
        default_factory=lambda: {kind: {} for kind in TABLES}
    )
    is_logged: bool = False

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
            numbers = self.box_weather["box_2d"][item]
            if not instances.agree(numbers.track_ids, numbers["instance"]):
                return False
        paths = [row[f"{kind}_path"] for kind in PATH_KINDS if kind not in _OF_VARIANT]
        return all((out_dir / path).is_file() for path in paths if path is not None)


class JobState:
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
            progress_log = ProgressLog(out_dir, index.name, name)
            folder = variant_folder(index.name, name)
            self.variants.append(VariantState(recipe, name, folder, identity, progress_log))

    @property
    def keys(self) -> set[tuple[str, str]]:
        return {(self.index.name, variant.name) for variant in self.variants}

    def open(self, *, overwrite: bool) -> None:
        """Clear away what a killed run left, and read what it finished."""
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
        variant.progress_log.append({**row, **measured})
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
            variant.progress_log.close()

    def _load(self, variant: VariantState, overwrite: bool) -> bool:
        """Read the variant's rows; true where there are any that have to be given up."""
        begun, logged = variant.progress_log.load()
        rows: list[dict[str, Any]] = []
        if self._table is not None:
            rows = rows_of(self._table, {(self.index.name, variant.name)})
        found = begun or (Identity.of_row(rows[0]) if rows else None)
        if overwrite and found is not None:
            return True
        if found is not None:
            variant.identity.check(found, str(self.out_dir / variant.folder))
        variant.is_logged = begun is not None
        for kind, file in box_weather_files(variant.recipe).items():
            if any(row.get(f"{kind}_path") for row in rows):
                variant.box_weather[kind] = _read_table(kind, self.out_dir / variant.folder / file)
        for row in logged:  # which have the boxes' numbers beyond the manifest's columns
            for kind, table in TABLES.items():
                if (numbers := row.pop(kind, None)) is not None:
                    item = row["frame"], row["camera"]
                    variant.box_weather[kind][item] = table.from_json(numbers)
        # The recipe's hash agrees, so the rows show what it says, whatever their version called it.
        shown = shown_words(variant.recipe)
        known = [{**LATER, **row, **shown} for row in [*rows, *logged]]
        variant.rows = {(row["frame"], row["camera"]): row for row in known}
        return False

    def _give_up(self, variants: Sequence[VariantState]) -> None:
        """Drop the variants' files and rows, in an order that a kill cannot confuse. The folder
        goes first, in one step: until the rows have gone too, the next run finds the old images
        missing, which the old job can render again and another is refused.
        """
        trash = self.out_dir / STATE_FOLDER / "trash"
        for number, variant in enumerate(variants):
            folder = self.out_dir / variant.folder
            if folder.is_dir():
                with refusals_of(folder):
                    make_folder(trash)
                    folder.rename(trash / str(number))
                    flush_folder(folder.parent)
        if self._table is not None:
            keys = {(self.index.name, variant.name) for variant in variants}
            self._replace_rows([], keys)
        for variant in variants:
            variant.progress_log.remove()
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
        for folder in sorted(mine | set(logged_variants(self.out_dir))):
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
    with refusals_of(folder), contextlib.suppress(FileNotFoundError):
        shutil.rmtree(folder)


# ---- The end of a job: what belongs to a whole variant, then the manifest; then the logs go ------


@dataclass
class BoxCache:
    """Boxes of the scene's frames, each read once. errors: frames whose boxes cannot be read."""

    index: SceneIndex
    read: dict[int, FrameBoxes] = field(default_factory=dict)
    errors: dict[int, str] = field(default_factory=dict)

    def get(self, frames: Iterable[int]) -> dict[int, FrameBoxes]:
        """The boxes of those frames that have labels and can be read."""
        requested = [f for f in frames if f in self.index.labelled]
        for number in requested:
            if number not in self.read and number not in self.errors:
                self._read(number)
        return {number: self.read[number] for number in requested if number in self.read}

    def _read(self, number: int) -> None:
        assert self.index.labels is not None  # labelled frames exist only with a source
        try:
            boxes = FrameBoxes(
                self.index.frames_by_number[number].timestamp_ns, self.index.labels.boxes(number)
            )
            boxes_bytes({number: boxes})  # what cannot be stored exactly fails here, by frame
        except Exception as error:
            self.errors[number] = describe(error, f"reading the boxes of frame {number}")
        else:
            self.read[number] = boxes


def finish(job_state: JobState, trajectory: str, boxes: BoxCache) -> None:
    """Write labels, calibration and manifest of the job's variants that have rows. Safe to repeat:
    a kill at any point leaves the progress logs, and the next run does it again.
    """
    variants = [variant for variant in job_state.variants if variant.rows]
    for variant in variants:
        if variant.recipe.output.labels and job_state.index.labels is not None:
            _write_boxes(job_state, variant, boxes)
            for kind in _tables(variant):
                _write_box_weather(job_state, variant, kind)
        _write_calibration(job_state, variant, trajectory)
    if variants:
        job_state.write_manifest(variants)
    for variant in variants:
        variant.progress_log.remove()


def needs_finish(job_state: JobState) -> bool:
    """Whether anything that `finish` writes is not there, or a progress log is still open."""
    return not (job_state.out_dir / MANIFEST).is_file() or any(
        variant.is_logged or not all(p.is_file() for p in _companions(job_state, variant).values())
        for variant in job_state.variants
    )


def _companions(job_state: JobState, variant: VariantState) -> dict[str, Path]:
    folder = job_state.out_dir / variant.folder
    paths = {"calibration": folder / "calibration.json"}
    if variant.recipe.output.labels and job_state.index.labels is not None:
        paths["labels"] = folder / "labels" / "boxes.parquet"
        paths |= {kind: folder / file for kind, file in _tables(variant).items()}
    return paths


def _tables(variant: VariantState) -> dict[str, str]:
    """The files of what is measured of boxes, less those that came with a later version than
    the one that rendered the images: only rendering again would tell what is in them.
    """
    labelled = [row for row in variant.rows.values() if row["labels_path"] is not None]
    return {
        kind: file
        for kind, file in box_weather_files(variant.recipe).items()
        if not labelled or any(row[f"{kind}_path"] is not None for row in labelled)
    }


def _write_boxes(job_state: JobState, variant: VariantState, cache: BoxCache) -> None:
    path = _companions(job_state, variant)["labels"]
    frames = sorted({frame for frame, _ in variant.rows})
    known: Mapping[int, FrameBoxes] = {}
    if path.is_file():
        known = {n: b for n, b in _read_or_drop(path).items() if n in set(frames)}
    new = cache.get([number for number in frames if number not in known])
    found = {**known, **new}
    number_of = job_state.index.instances.of
    numbered = {n: replace(b, instances=number_of(b.boxes.track_ids)) for n, b in found.items()}
    write_atomic(path, boxes_bytes(numbered))


def _write_box_weather(job_state: JobState, variant: VariantState, kind: str) -> None:
    path = _companions(job_state, variant)[kind]
    # Not of an image that was measured once and has failed since.
    listed = {item for item, row in variant.rows.items() if row[f"{kind}_path"] is not None}
    known = variant.box_weather[kind]
    write_atomic(path, TABLES[kind].to_bytes({i: known[i] for i in known if i in listed}))


def _read_or_drop(path: Path) -> dict[int, FrameBoxes]:
    """A damaged file counts as absent: the scene still has the boxes."""
    try:
        return read_boxes(path)
    except OutputError:
        return {}


def _write_calibration(job_state: JobState, variant: VariantState, trajectory: str) -> None:
    path = _companions(job_state, variant)["calibration"]
    index = job_state.index
    names: dict[int, list[str]] = {}
    for frame, camera in variant.rows:
        names.setdefault(frame, []).append(camera)
    here = [number for number in names if number in index.frames_by_number]
    scale, origin = variant.recipe.render.scale, index.world_origin_m
    entries = {n: frame_entry(index.frames_by_number[n], names[n], scale, origin) for n in here}
    gone: Sequence[int] = [number for number in names if number not in index.frames_by_number]
    if gone:  # the scene has lost frames since they were rendered
        earlier = read_entries(path)
        entries |= {number: earlier[number] for number in gone if number in earlier}
    write_atomic(path, calibration_bytes(index, variant.name, trajectory, entries))
