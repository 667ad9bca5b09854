"""State of a render job: the images of every variant that its output folder holds.

In: recipes, a scene's index, and the output folder. Out: the images that are missing, and at the
end the variants' files and the manifest's rows. Called by `render_job`.

An image counts as finished once its line is in the variant's progress log. When a job ends, the
files of whole variants are written (boxes, their measured numbers, calibration), the lines become
rows of the manifest, and the log is deleted. A kill at any point leaves the log, and the next run
goes on from there.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from augment.errors import OutputError
from augment.jobs.worker import Chunk, Outcome, describe_error
from augment.output.atomic import (
    flush_folder,
    make_folder,
    make_output_error,
    path_below,
    raise_output_error,
    read_file,
    remove_temporaries,
    remove_tree,
    write_atomic,
)
from augment.output.box_tables import BoxNumbers, Item
from augment.output.box_weather import box_tables
from augment.output.calibration import calibration_bytes, frame_entry, read_entries
from augment.output.claims import hold_claim
from augment.output.layout import (
    OLD_PROGRESS_LOGS,
    PROGRESS_LOGS,
    SWEEP_FOLDER,
    FileListing,
    box_weather_files,
    item_paths,
    parse_errors_as_output_errors,
    path_columns,
    path_kinds,
    variant_folder,
    variant_name,
)
from augment.output.manifest import (
    OK,
    PARTS,
    Identity,
    ImageFacts,
    check_rows,
    image_row,
    later_columns,
    merge_rows,
    moment_columns,
    read_manifest,
    recipe_columns,
    select_variant_rows,
    write_manifest,
)
from augment.output.names import MANIFEST_FILE, STATE_FOLDER, folder_name
from augment.output.store import open_store
from augment.output.tables import FrameBoxes, boxes_bytes, read_boxes
from augment.scene.cameras import Frame
from augment.scene.scene_index import SceneIndex
from recipes.schema import Recipe

_log = logging.getLogger(__name__)


class ProgressLog:
    """Progress log of a variant, `.climategs/progress/<scene>/<variant>.jsonl`.

    It holds the variant's identity, then a line for every image whose files are in place. A line
    counts only with its line break, so a job that is killed while writing a line loses only that
    line. `append` may be called from several threads.
    """

    def __init__(self, out_dir: Path, scene: str, variant: str) -> None:
        folder = out_dir / STATE_FOLDER / PROGRESS_LOGS / folder_name(scene)
        self.path = folder / f"{folder_name(variant)}.jsonl"
        self._file: int | None = None
        self._lock = threading.Lock()

    def load(self) -> tuple[Identity | None, list[dict[str, Any]]]:
        """Return the identity and rows in the log; (None, []) where there is no log."""
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
        """Return a context manager that turns errors of reading the lines into an OutputError."""
        return parse_errors_as_output_errors(
            str(self.path), "Delete it; what it lists is rendered again"
        )

    def begin(self, identity: Identity) -> None:
        """Open the log for appending; writes the identity, and keeps all complete lines."""
        with raise_output_error(self.path):
            data = read_file(self.path) if self.path.exists() else b""
            rows = data[data.find(b"\n") + 1 : data.rfind(b"\n") + 1]
            write_atomic(self.path, _line(asdict(identity)) + rows)
            self._file = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW)

    def append(self, row: dict[str, Any]) -> None:
        """Add a finished image; return when the line is on the disk."""
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
                raise make_output_error(self.path, error) from error

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def remove(self) -> None:
        """Delete the progress log and the folders it leaves empty."""
        self.close()
        with raise_output_error(self.path):
            self.path.unlink(missing_ok=True)
            for folder in (self.path.parent, self.path.parent.parent):
                if folder.is_dir() and not any(folder.iterdir()):
                    folder.rmdir()
                    flush_folder(folder.parent)


def logged_variants(out_dir: Path) -> list[str]:
    """Return folders (`<scene>/<variant>`) of the variants that a job has begun and not ended."""
    root = out_dir / STATE_FOLDER / PROGRESS_LOGS
    return sorted(str(p.relative_to(root).with_suffix("")) for p in root.glob("*/*.jsonl"))


def _take_over_old_logs(out_dir: Path) -> None:
    """Move the progress logs of an older version to where this one keeps them.

    The caller holds the output's lock. A variant that has a log in both folders was begun by this
    version and then by an older one. Its newer log stays, and the images that only the other one
    lists are rendered again.
    """
    old_dir = path_below(out_dir, (STATE_FOLDER, OLD_PROGRESS_LOGS))
    if not old_dir.is_dir():
        return
    logs_dir = path_below(out_dir, (STATE_FOLDER, PROGRESS_LOGS))
    with raise_output_error(old_dir):
        if not logs_dir.exists():
            old_dir.rename(logs_dir)
            flush_folder(logs_dir.parent)
            return
        for old_path in old_dir.glob("*/*.jsonl"):
            path = path_below(logs_dir, old_path.relative_to(old_dir).parts)
            if not path.exists():
                make_folder(path.parent)
                old_path.rename(path)
                flush_folder(path.parent)
    remove_tree(old_dir)


def _line(value: dict[str, Any]) -> bytes:
    """Return a value as one line of JSON."""
    return json.dumps(value, separators=(",", ":")).encode() + b"\n"


class VariantState:
    """One variant of the job.

    Attributes:
        index: The scene's index.
        recipe: Resolved recipe.
        identity: Identity of the images.
        rows: Rows of its images, from this run and earlier ones.
        box_weather: Measured numbers of the boxes of those images, by kind (see box_tables).
    """

    def __init__(
        self, out_dir: Path, index: SceneIndex, recipe: Recipe, identity: Identity
    ) -> None:
        self.index = index
        self.recipe = recipe
        self.identity = identity
        self.name = variant_name(recipe)
        self.folder = variant_folder(index.name, self.name)
        self.path = out_dir / self.folder
        self.progress_log = ProgressLog(out_dir, index.name, self.name)
        self.rows: dict[Item, dict[str, Any]] = {}
        self.box_weather: dict[str, dict[Item, BoxNumbers]] = {kind: {} for kind in box_tables()}
        self._out_dir = out_dir
        self._is_logged = False
        self._listing = FileListing(out_dir)
        self._adopts_rows = False  # True if rows lack the digest of the scene's content

    @property
    def key(self) -> tuple[str, str]:
        """Scene and variant, as in the manifest."""
        return self.index.name, self.name

    def load(self, table: pa.Table | None, listing: FileListing, overwrite: bool) -> bool:
        """Read the rows of earlier runs; return True where there is anything to be replaced.

        Args:
            table: The manifest; None where there is none.
            listing: Files of the output folder.
            overwrite: If True, earlier images are replaced.
        """
        self._listing = listing
        logged_identity, logged_rows = self.progress_log.load()
        rows = [] if table is None else select_variant_rows(table, {self.key})
        identities = {Identity.of_row(row) for row in rows} | (
            {logged_identity} if logged_identity else set()
        )
        if overwrite and identities:
            return True
        for stored_identity in sorted(identities, key=repr):
            self.identity.check(stored_identity, str(self.path))
        if self.identity.source_digest is not None:
            self._adopts_rows = any(
                stored_identity.source_digest is None for stored_identity in identities
            )
            if self._adopts_rows:
                _log.warning(
                    "note: %s is of an older version, which did not note the content of its "
                    "scene; it is taken to be the scene as it is now",
                    self.path,
                )
        self._is_logged = logged_identity is not None
        for kind, file in box_weather_files(self.recipe).items():
            if any(row.get(f"{kind}_path") for row in rows):
                self.box_weather[kind] = _read_table(kind, self.path / file)
        with self.progress_log.reading():
            # Logged rows also hold the boxes' numbers, which are no columns of the manifest.
            for row in logged_rows:
                for kind, box_table in box_tables().items():
                    if (numbers := row.pop(kind, None)) is not None:
                        self.box_weather[kind][row["frame"], row["camera"]] = box_table.from_json(
                            numbers
                        )
            check_rows(logged_rows, self.key, str(self.progress_log.path))
        # The recipe's hash agrees, so its values hold for the rows, whatever older versions called
        # them.
        recipe_values = recipe_columns(self.recipe)
        if self._adopts_rows:
            recipe_values["source_digest"] = self.identity.source_digest
        all_rows = [
            {
                **later_columns(),
                **row,
                **recipe_values,
                **moment_columns(self.recipe, self.index.times, row["timestamp_ns"]),
            }
            for row in [*rows, *logged_rows]
        ]
        self.rows = {(row["frame"], row["camera"]): row for row in all_rows}
        return False

    def is_finished(self, item: Item) -> bool:
        """Return True if the image is complete.

        Its row says ok, all its files and its boxes' numbers exist, and its objects are numbered as
        today. The last may fail where a frame can be read now that could not be read before.
        """
        row = self.rows.get(item)
        if row is None or row["status"] != OK:
            return False
        measured_kinds = [kind for kind in box_tables() if row[f"{kind}_path"] is not None]
        if any(item not in self.box_weather[kind] for kind in measured_kinds):
            return False
        if "box_2d" in measured_kinds:
            numbers = self.box_weather["box_2d"][item]
            if not self.index.instances.has_same_numbers(numbers.track_ids, numbers["instance"]):
                return False
        variant_kinds = {"labels", "calibration", *box_tables()}
        paths = [row[f"{kind}_path"] for kind in path_kinds() if kind not in variant_kinds]
        return all(self._listing.has(path) for path in paths if path is not None)

    def check_folders(self, cameras: Iterable[str]) -> None:
        """Raise OutputError where a folder that will be written to is a link out of the output."""
        recipe = self.recipe
        index = self.index
        paths = {
            path
            for name in {"", *cameras}
            for path in item_paths(index.name, recipe, name, 0).values()
            if path is not None
        }
        for folder in sorted({path.rpartition("/")[0] for path in paths}):
            path_below(self._out_dir, tuple(folder.split("/")))

    def record(self, outcome: Outcome, frame: Frame) -> None:
        """Record the outcome of an image durably; may be called from several threads."""
        row = self._row(outcome, frame)
        tables = box_tables()
        json_of_table = {
            k: tables[k].to_json(numbers) for k, numbers in outcome.box_weather.items()
        }
        self.progress_log.append({**row, **json_of_table})
        item = frame.index, outcome.camera
        for kind, numbers in outcome.box_weather.items():
            self.box_weather[kind][item] = numbers
        self.rows[item] = row

    def files(self) -> dict[str, Path]:
        """Return the files that belong to the whole variant, by kind of path.

        Tables of boxes that came with a later version than the one that rendered the images are
        left out: only rendering again would tell their content.
        """
        files = {"calibration": self.path / "calibration.json"}
        if self.recipe.output.labels and self.index.labels is not None:
            files["labels"] = self.path / "labels" / "boxes.parquet"
            labelled_rows = [row for row in self.rows.values() if row["labels_path"] is not None]
            for kind, file in box_weather_files(self.recipe).items():
                if not labelled_rows or any(
                    row[f"{kind}_path"] is not None for row in labelled_rows
                ):
                    files[kind] = self.path / file
        return files

    def write_files(self, boxes: BoxCache, trajectory: str) -> None:
        """Write the files that belong to the whole variant."""
        for kind, path in self.files().items():
            if kind == "calibration":
                write_atomic(path, self._calibration(path, trajectory))
            elif kind == "labels":
                write_atomic(path, self._boxes(path, boxes))
            else:  # leaves out images that were measured once and have failed since
                numbers_of_item = self.box_weather[kind]
                listed_items = {
                    i for i, row in self.rows.items() if row[f"{kind}_path"] is not None
                }
                data = box_tables()[kind].to_bytes(
                    {i: numbers_of_item[i] for i in numbers_of_item if i in listed_items}
                )
                write_atomic(path, data)

    def is_complete(self) -> bool:
        """Return True if `finish` has nothing to do for the variant.

        No progress log is open then.
        """
        return (
            not self._is_logged
            and not self._adopts_rows
            and all(path.is_file() for path in self.files().values())
        )

    def _boxes(self, path: Path, cache: BoxCache) -> bytes:
        """Return the file of the variant's boxes."""
        frames = {frame for frame, _ in self.rows}
        stored_boxes: dict[int, FrameBoxes] = {}
        if path.is_file():
            with contextlib.suppress(OutputError):  # a damaged file: the scene still has the boxes
                stored_boxes = {n: boxes for n, boxes in read_boxes(path).items() if n in frames}
        boxes_of_frame = stored_boxes | cache.get(sorted(frames - stored_boxes.keys()))
        number_of = self.index.instances.numbers_of
        return boxes_bytes(
            {
                n: replace(b, instances=number_of(b.boxes.track_ids))
                for n, b in boxes_of_frame.items()
            }
        )

    def _calibration(self, path: Path, trajectory: str) -> bytes:
        """Return the file of the variant's calibration."""
        index = self.index
        scene_frames = self.index.frames_by_number
        camera_names = dict[int, list[str]]()
        for frame, camera in self.rows:
            camera_names.setdefault(frame, []).append(camera)
        frame_numbers = [n for n in camera_names if n in scene_frames]
        scale = self.recipe.render.scale
        entries = {
            n: frame_entry(scene_frames[n], camera_names[n], scale, index.world_origin_m)
            for n in frame_numbers
        }
        # The scene has lost frames since.
        if lost_frames := camera_names.keys() - scene_frames.keys():
            entries |= {n: e for n, e in read_entries(path).items() if n in lost_frames}
        return calibration_bytes(index, self.name, trajectory, entries)

    def _row(self, outcome: Outcome, frame: Frame) -> dict[str, Any]:
        """Return the manifest's row of an image."""
        recipe = self.recipe
        index = self.index
        camera = frame.cameras[outcome.camera].scaled(recipe.render.scale)
        paths = path_columns(item_paths(index.name, recipe, outcome.camera, frame.index))
        absent_kinds = box_tables().keys() - outcome.box_weather.keys()
        absent_kinds |= set() if outcome.lidar else {"lidar"}
        absent_kinds |= set() if frame.index in index.labelled_frames else {"labels"}
        return image_row(
            index.name,
            recipe,
            self.identity,
            ImageFacts(frame.index, camera.name, camera.timestamp_ns, camera.width, camera.height),
            index.times,
            paths=paths | {f"{kind}_path": None for kind in absent_kinds},
            status=outcome.status,
            message=outcome.message,
            checksum=outcome.checksum,
            lidar=outcome.lidar,
            lidar_note=outcome.lidar_note,
            measures=outcome.measures,
        )


class BoxCache:
    """Boxes of the scene's frames, each frame read once.

    Attributes:
        errors: Messages of the frames whose boxes cannot be read, by frame number.
    """

    def __init__(self, index: SceneIndex) -> None:
        self._index = index
        self._boxes_of_frame = dict[int, FrameBoxes]()
        self.errors: dict[int, str] = {}

    def get(self, frames: Iterable[int]) -> dict[int, FrameBoxes]:
        """Return the boxes of those frames that have labels and can be read."""
        labelled_frames = [f for f in frames if f in self._index.labelled_frames]
        labels = self._index.labels
        for number in labelled_frames:
            if labels is None or number in self._boxes_of_frame or number in self.errors:
                continue
            try:
                time_ns = self._index.frames_by_number[number].timestamp_ns
                boxes = FrameBoxes(time_ns, labels.boxes(number))
                # Boxes that cannot be stored exactly fail here, frame by frame.
                boxes_bytes({number: boxes})
            except Exception as error:
                self.errors[number] = describe_error(error, f"reading the boxes of frame {number}")
            else:
                self._boxes_of_frame[number] = boxes
        return {
            number: self._boxes_of_frame[number]
            for number in labelled_frames
            if number in self._boxes_of_frame
        }


class JobState:
    """The variants of a job in its output folder; needs the folder's lock."""

    def __init__(
        self,
        out_dir: Path,
        index: SceneIndex,
        recipes: Sequence[Recipe],
        identities: Sequence[Identity],
    ) -> None:
        self.out_dir = out_dir
        self.index = index
        self._table: pa.Table | None = None
        pairs = zip(recipes, identities, strict=True)
        self.variants = [VariantState(out_dir, index, *pair) for pair in pairs]

    def open(self, *, overwrite: bool) -> None:
        """Delete leftovers of a killed run, and read the rows that it finished."""
        if (self.out_dir / MANIFEST_FILE).is_file():
            self._table = read_manifest(self.out_dir)
        _take_over_old_logs(self.out_dir)
        path_below(self.out_dir, (STATE_FOLDER, PROGRESS_LOGS, folder_name(self.index.name)))
        listing = FileListing(self.out_dir)
        replaced_variants = [v for v in self.variants if v.load(self._table, listing, overwrite)]
        self._clear_leftovers()
        if replaced_variants:
            self._delete_variants(replaced_variants)

    def pending(self, selection: Sequence[tuple[Frame, tuple[str, ...]]]) -> Iterator[Chunk]:
        """Yield the images to render, in order: variant by variant, frame by frame."""
        for number, variant in enumerate(self.variants):
            for frame, names in selection:
                missing_names = tuple(n for n in names if not variant.is_finished((frame.index, n)))
                if missing_names:
                    yield Chunk(number, frame.index, missing_names)

    def finish(self, boxes: BoxCache) -> None:
        """Write the files of the variants that have rows, and the manifest; safe to repeat."""
        variants = [variant for variant in self.variants if variant.rows]
        for variant in variants:
            variant.write_files(boxes, variant.identity.trajectory)
        if variants:
            self._replace_rows([r for v in variants for r in v.rows.values()], variants)
            self._drop_sweeps()
        for variant in variants:
            variant.progress_log.remove()

    def is_complete(self) -> bool:
        """Return True if `finish` has nothing to write."""
        has_manifest = (self.out_dir / MANIFEST_FILE).is_file()
        return has_manifest and all(variant.is_complete() for variant in self.variants)

    def close(self) -> None:
        for variant in self.variants:
            variant.progress_log.close()

    def _delete_variants(self, variants: Sequence[VariantState]) -> None:
        """Delete the variants' files and rows, in an order that a kill cannot confuse.

        The folder goes first, in one step. Until the rows have gone too, the next run finds the old
        images missing: the old job can render them again, and any other job is refused.
        """
        trash_dir = self.out_dir / STATE_FOLDER / "trash"
        for number, variant in enumerate(variants):
            if variant.path.is_dir():
                with raise_output_error(variant.path):
                    make_folder(trash_dir)
                    variant.path.rename(trash_dir / str(number))
                    flush_folder(variant.path.parent)
        if self._table is not None:
            self._replace_rows([], variants)
        for variant in variants:
            variant.progress_log.remove()
        remove_tree(trash_dir)

    def _drop_sweeps(self) -> None:
        """Delete the scene's sweeps that no image has any more.

        Does nothing while other jobs run, because the manifest lacks their images.
        """
        job_folders = {variant.folder for variant in self.variants}
        if (self.out_dir / PARTS).is_dir() or not job_folders.issuperset(
            logged_variants(self.out_dir)
        ):
            return
        assert self._table is not None, "the manifest has just been written"
        listed_paths = set(self._table["lidar_path"].to_pylist())
        folder = self.out_dir / folder_name(self.index.name) / SWEEP_FOLDER
        with raise_output_error(folder):
            for path in folder.glob("*.parquet"):
                if path.relative_to(self.out_dir).as_posix() not in listed_paths:
                    path.unlink()
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()

    def _replace_rows(self, rows: list[dict[str, Any]], variants: Sequence[VariantState]) -> None:
        """Exchange rows of the manifest as it is now: other jobs may have merged rows meanwhile."""
        with hold_claim(open_store(self.out_dir), "manifest"):
            has_manifest = (self.out_dir / MANIFEST_FILE).is_file()
            keys = {variant.key for variant in variants}
            self._table = merge_rows(
                read_manifest(self.out_dir) if has_manifest else None, rows, keys
            )
            write_manifest(self.out_dir, self._table)

    def _clear_leftovers(self) -> None:
        """Delete temporary files of killed runs."""
        state_dir = self.out_dir / STATE_FOLDER
        remove_temporaries(self.out_dir, recursive=False)
        # Blocks of other jobs may be at work below it.
        remove_temporaries(state_dir, recursive=False)
        remove_temporaries(state_dir / PROGRESS_LOGS)
        remove_tree(state_dir / "trash")
        job_folders = {variant.folder for variant in self.variants}
        sweeps = f"{folder_name(self.index.name)}/{SWEEP_FOLDER}"
        for folder in sorted({sweeps, *job_folders, *logged_variants(self.out_dir)}):
            remove_temporaries(self.out_dir / folder)


def _read_table(kind: str, path: Path) -> dict[Item, BoxNumbers]:
    """Return the numbers in a table of boxes.

    A lost or damaged file counts as empty: only rendering again tells its content.
    """
    try:
        return box_tables()[kind].read(path)
    except OutputError as error:
        _log.warning("%s; the images it belongs to are rendered again", error)
        return {}
