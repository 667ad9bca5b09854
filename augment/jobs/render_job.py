"""A batch job: one scene, any number of recipes, images and labels into one output folder.

A job can be killed at any moment and run again: it goes on with what is missing. The files it
leaves do not depend on how often that happened, nor on the number of workers.
"""

from __future__ import annotations

import contextlib
import copy
import json
import logging
import os
import re
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

import pyarrow as pa
from tqdm import tqdm

import augment
from augment.cameras import Frame
from augment.effects import Sharing, share_effects
from augment.errors import ClimateGSError, OutputError
from augment.jobs.atomic import (
    flush_folder,
    make_folder,
    output_error,
    refusals_of,
    remove_temporaries,
    write_atomic,
)
from augment.jobs.box_tables import BoxNumbers, Item
from augment.jobs.claims import hold
from augment.jobs.files import (
    SceneIndex,
    box_tables,
    calibration_bytes,
    frame_entry,
    read_entries,
    select_frames,
    trajectory_id,
    uses_boxes,
)
from augment.jobs.layout import (
    MANIFEST,
    STATE_FOLDER,
    SWEEPS,
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
    FAILED,
    OK,
    Identity,
    Pictured,
    image_row,
    later_columns,
    merge_rows,
    read_manifest,
    rows_of,
    shown_words,
    write_manifest,
)
from augment.jobs.pools import ProcessPool, SerialPool, Work, WorkerPool, run_tasks
from augment.jobs.processes import (
    OutputLock,
    SharedScene,
    check_sendable,
    choose_backend,
    share_scene,
)
from augment.jobs.quality import resolve_quality_for
from augment.jobs.store import open_store
from augment.jobs.tables import FrameBoxes, boxes_bytes, read_boxes
from augment.jobs.worker import (
    WORKERS,
    Chunk,
    Outcome,
    Renderer,
    SceneSetup,
    Setup,
    TaskFailed,
    WorkTimes,
    describe,
)
from augment.memo import memo_of
from augment.scene import Scene
from recipes.fields import found, replaced
from recipes.files import read_files, with_digest
from recipes.load import dump_recipe
from recipes.schema import SECTIONS, Recipe

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
        with reading_back(str(self.path), "Delete it; what it lists is rendered again"):
            identity, *rows = [json.loads(line) for line in lines]
            return Identity(**identity), rows

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
_log = logging.getLogger(__name__)


@dataclass
class VariantState:
    """One variant of the job. rows: what is known of its images, from this run and earlier ones.
    box_weather: what is measured of the boxes of those images, by kind (see box_tables).
    """

    recipe: Recipe
    name: str
    folder: str
    identity: Identity
    progress_log: ProgressLog
    rows: dict[Item, dict[str, Any]] = field(default_factory=dict)
    box_weather: dict[str, dict[Item, BoxNumbers]] = field(
        default_factory=lambda: {kind: {} for kind in box_tables()}
    )
    is_logged: bool = False


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
                left = tuple(n for n in names if not self._is_finished(variant, (frame.index, n)))
                if left:
                    yield Chunk(number, frame.index, left)

    def record(self, outcome: Outcome, frame: Frame) -> None:
        """Enter what became of an image, durably. May be called from several threads."""
        variant = self.variants[outcome.variant]
        row = self._row(variant, outcome, frame)
        tables = box_tables()
        measured = {k: tables[k].to_json(numbers) for k, numbers in outcome.box_weather.items()}
        variant.progress_log.append({**row, **measured})
        with self._lock:
            variant.rows[frame.index, outcome.camera] = row
            for kind, numbers in outcome.box_weather.items():
                variant.box_weather[kind][frame.index, outcome.camera] = numbers

    def _is_finished(self, variant: VariantState, item: Item) -> bool:
        """Whether the image's row says ok, and all its files and its boxes' numbers are there; and
        its objects are numbered as today, when a frame may be read that could not be read then.
        """
        row = variant.rows.get(item)
        if row is None or row["status"] != OK:
            return False
        measured = [kind for kind in box_tables() if row[f"{kind}_path"] is not None]
        if any(item not in variant.box_weather[kind] for kind in measured):
            return False
        if "box_2d" in measured:
            numbers = variant.box_weather["box_2d"][item]
            if not self.index.instances.agree(numbers.track_ids, numbers["instance"]):
                return False
        of_variant = {"labels", "calibration", *box_tables()}
        paths = [row[f"{kind}_path"] for kind in path_kinds() if kind not in of_variant]
        return all((self.out_dir / path).is_file() for path in paths if path is not None)

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
            for kind, table in box_tables().items():
                if (numbers := row.pop(kind, None)) is not None:
                    item = row["frame"], row["camera"]
                    variant.box_weather[kind][item] = table.from_json(numbers)
        # The recipe's hash agrees, so the rows show what it says, whatever their version called it.
        shown = shown_words(variant.recipe)
        known = [{**later_columns(), **row, **shown} for row in [*rows, *logged]]
        variant.rows = {(row["frame"], row["camera"]): row for row in known}
        return False

    def _give_up(self, variants: Sequence[VariantState]) -> None:
        """Drop the variants' files and rows, in an order that a kill cannot confuse: the folder
        goes first, in one step. Until the rows have gone too, the next run finds the old images
        missing; the old job can render them again, and another is refused.
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
        remove_temporaries(self.out_dir / folder_name(self.index.name) / SWEEPS)

    def _row(self, variant: VariantState, outcome: Outcome, frame: Frame) -> dict[str, Any]:
        recipe, index = variant.recipe, self.index
        camera = frame.cameras[outcome.camera].scaled(recipe.render.scale)
        paths = path_columns(item_paths(index.name, recipe, outcome.camera, frame.index))
        if not outcome.lidar:
            paths["lidar_path"] = None
        if frame.index not in index.labelled:
            paths["labels_path"] = None
        for kind in box_tables().keys() - outcome.box_weather.keys():
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
        return box_tables()[kind].read(path)
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
    write_atomic(path, box_tables()[kind].to_bytes({i: known[i] for i in known if i in listed}))


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


# ---- The files that a recipe names, beside the images: those of a style in `<variant>/style/` ----
# With them a variant's `recipe.yaml` renders it again wherever the folder is taken.

_SUFFIX = re.compile(r"\.[A-Za-z0-9]{1,16}")


def file_folders() -> tuple[str, ...]:
    """Folders inside a variant's that hold files which recipes name."""
    return tuple(path.split(".")[-1] for path, model in SECTIONS.items() if model.file_fields)


def stored_names(recipe: Recipe) -> dict[str, str]:
    """The name of each of the recipe's files inside the variant's folder, by dotted path of its
    field. It is the file's own where that is safe; another file of the same name gets its field's
    name before its own.
    """
    found: dict[str, str] = {}
    for section_path, section in recipe.sections().items():
        names: dict[str, str] = {}
        for key, path in section.files.items():
            name = _safe_name(path)
            while name.casefold() in {taken.casefold() for taken in names.values()}:
                name = f"{key}-{name}"
            names[key] = name
        folder = section_path.split(".")[-1]
        found |= {f"{section_path}.{key}": f"{folder}/{name}" for key, name in names.items()}
    return found


def portable_recipe(recipe: Recipe) -> Recipe:
    """The recipe with its files named from the variant's folder; its hash is the same."""
    for path, name in stored_names(recipe).items():
        recipe = replaced(recipe, path, name)
    return recipe


def check_kept(recipe: Recipe, folders: Collection[Path]) -> None:
    """Refuse to overwrite (`folders`) files that the recipe is about to need."""
    for path in stored_names(recipe):
        real = Path(found(recipe, path)).resolve()
        for folder in folders:
            if real.is_relative_to(folder.resolve()):
                raise OutputError(
                    f"{path} of recipe {recipe.name} is {real}, in the folder {folder}, "
                    f"which is to be overwritten: copy the recipe and its files out of it first"
                )


def copy_files(recipe: Recipe, folder: Path) -> None:
    """Put the recipe's files where `portable_recipe` names them. folder: the variant's. Raises
    RecipeError: they are unreadable or not those of the recipe's digest.
    """
    names = stored_names(recipe)
    for section_path, section in recipe.sections().items():
        for key, data in read_files(section).items() if section.files else ():
            path = folder / names[f"{section_path}.{key}"]
            if not (path.is_file() and path.read_bytes() == data):
                write_atomic(path, data)


def _safe_name(path: str) -> str:
    """The file's name as `folder_name` has it, with its suffix still at the end."""
    name = PurePath(path)
    if _SUFFIX.fullmatch(name.suffix):
        return folder_name(name.stem) + name.suffix
    return folder_name(name.name)


# ---- The job -------------------------------------------------------------------------------------

SceneLoader = Callable[[str], Scene]
TASK_IMAGES = 32  # at most that a worker process gets at a time: between, its threads have no work


@dataclass(frozen=True, eq=False)
class RenderJob:
    """What to render, and where to. recipes: resolved, one a variant; their `name` and `variant`
    number make the folder. Missing digests of style files are filled in; settings that a quality
    leaves open are chosen once and kept in the output. frames: the dataset's frame numbers, or None
    for all. cameras: names, or None for all. camera_path: frames to render in place of the scene's
    own, poses in the scene's world; labels and LiDAR pass through where a frame of the scene has
    the same number and timestamp. workers: 1 renders in this process. overwrite: replace the
    variants' folders, finished or not, and choose their settings anew. shared_dir: keeps
    what lies in files of what images share (where snow can lie) for later jobs; the output folder's
    state if None.
    """

    scene_uri: str
    recipes: Sequence[Recipe]
    out_dir: Path | str
    frames: Sequence[int] | None = None
    cameras: Sequence[str] | None = None
    camera_path: Sequence[Frame] | None = None
    workers: int = 1
    backend: str = "auto"
    overwrite: bool = False
    shared_dir: Path | None = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ValueError(f"workers must be >= 1; got {self.workers}")
        names = Counter(variant_name(recipe) for recipe in self.recipes)
        if not names:
            raise ValueError("a job needs at least one recipe; got none")
        repeated = sorted(name for name, count in names.items() if count > 1)
        if repeated:
            raise ValueError(
                f"recipes of one job need different names or variant numbers; repeated: {repeated}"
            )


@dataclass(frozen=True)
class JobResult:
    """Counts of images of this job. skipped: finished by earlier runs. failures: a line each.
    seconds: wall clock. timings: seconds by kind of work, summed over threads and workers, or of
    the job itself (open, settle, prepare, labels, share, finish); `worker.shares_of` says what
    bound it.
    """

    written: int
    skipped: int
    failed: int
    manifest: Path
    seconds: float
    failures: tuple[str, ...] = ()
    timings: dict[str, float] = field(default_factory=dict)


def run_job(
    job: RenderJob,
    *,
    scene_loader: SceneLoader,
    renderer: Renderer | None = None,
    progress: bool = True,
    on_outcome: Callable[[Outcome], None] | None = None,
) -> JobResult:
    """Render what is missing, then write labels, calibration and manifest. scene_loader: called
    once with `job.scene_uri`. renderer: `augment.views.render_view` if None; with several workers
    an importable function, and the scene's labels and sky of importable classes. progress: a bar on
    stderr. on_outcome: called after each image, from several threads, one at a time. An image that
    fails is recorded in the manifest and the rest goes on. A KeyboardInterrupt finishes the images
    at hand, writes the manifest of what there is, and is raised again. Raises SceneError: the scene
    cannot be opened, lacks a requested frame or camera, or cannot have the snow of a recipe;
    StyleError, RecipeError: a style or one of its files cannot be used; no file of a variant has
    been written or replaced then. OutputError: the folder cannot be written, is in use, or holds
    something else.
    """
    started = time.perf_counter()
    run = _Run(job, scene_loader(job.scene_uri), renderer, on_outcome, progress)
    opening = time.perf_counter() - started
    run.times.add("open", opening - run.times.so_far().get("settle", 0.0))
    run.go()
    seconds = time.perf_counter() - started
    run.times.add(WORKERS, job.workers * seconds)
    return JobResult(
        written=run.counts[OK],
        skipped=run.skipped,
        failed=run.counts[FAILED],
        manifest=run.out_dir / MANIFEST,
        seconds=seconds,
        failures=tuple(sorted(run.failures)),
        timings=run.times.so_far(),
    )


class _ImageWork(Work):
    """The images of a job as tasks: all of them for one worker, else a few frames at a time. Where
    a worker dies, what it had in hand is tried once more, each image alone.
    """

    def __init__(
        self,
        chunks: Sequence[Chunk],
        workers: int,
        deliver: Callable[[Outcome], None],
        times: WorkTimes,
    ) -> None:
        images = sum(len(chunk.cameras) for chunk in chunks)
        most = images if workers == 1 else max(1, min(TASK_IMAGES, images // (4 * workers)))
        self._tasks: deque[tuple[Chunk, ...]] = deque(_tasks(chunks, most))
        self._deliver, self._times = deliver, times
        self._done: set[tuple[int, int, str]] = set()

    def tick(self, slot: int, outcome: Outcome) -> None:
        self._done.add((outcome.variant, outcome.frame, outcome.camera))
        self._deliver(outcome)

    def take(self, slot: int) -> tuple[Chunk, ...] | None:
        return self._tasks.popleft() if self._tasks else None

    def retry(self, slot: int, task: tuple[Chunk, ...], why: str) -> list[tuple[Chunk, ...]]:
        left = self._left(task)
        _log.warning("%d images are tried once more, alone: %s", len(left), why)
        return [(image,) for image in left]

    def done(self, slot: int, task: tuple[Chunk, ...], result: Any) -> None:
        if isinstance(result, TaskFailed):
            raise ClimateGSError(result.text)
        self._times.update(result)

    def lost(self, slot: int, task: tuple[Chunk, ...], how: str) -> None:
        message = (
            f"the worker process {how} while rendering this image, and again when it was tried "
            f"alone; if memory ran out, use fewer workers"
        )
        for image in self._left(task):
            name = image.cameras[0]
            self._deliver(Outcome(image.variant, image.frame, name, FAILED, message))

    def _left(self, task: tuple[Chunk, ...]) -> list[Chunk]:
        """A chunk for each image that has not been delivered."""
        images = [replace(chunk, cameras=(name,)) for chunk in task for name in chunk.cameras]
        return [i for i in images if (i.variant, i.frame, i.cameras[0]) not in self._done]


def _tasks(chunks: Sequence[Chunk], most: int) -> Iterator[tuple[Chunk, ...]]:
    """Runs of chunks, each of about so many images."""
    run: list[Chunk] = []
    for chunk in chunks:
        run.append(chunk)
        if sum(len(own.cameras) for own in run) >= most:
            yield tuple(run)
            run = []
    if run:
        yield tuple(run)


class _Run:
    """One call of run_job."""

    def __init__(
        self,
        job: RenderJob,
        scene: Scene,
        renderer: Renderer | None,
        on_outcome: Callable[[Outcome], None] | None,
        progress: bool,
    ) -> None:
        self.job, self.renderer, self.on_outcome = job, renderer, on_outcome
        self.progress, self.times = progress, WorkTimes()
        self.scene: Scene | None = scene  # None once workers have it
        # A stand-in has its own idea of backends.
        self.backend = job.backend if renderer else choose_backend(job.backend, scene)
        self.index = SceneIndex.of(scene, job.camera_path)
        self.selection = select_frames(self.index, job.frames, job.cameras)
        self.out_dir = Path(job.out_dir).absolute()
        self.trajectory = trajectory_id(job.camera_path)
        self.recipes = tuple(self._resolved(with_digest(r)) for r in job.recipes)
        identities = [self._identity(recipe) for recipe in self.recipes]
        self.job_state = JobState(self.out_dir, self.index, self.recipes, identities)
        self.boxes = BoxCache(self.index)
        self.counts: Counter[str] = Counter()
        self.failures: list[str] = []
        self.counting = threading.Lock()  # outcomes arrive from several threads

    def go(self) -> None:
        self.total = len(self.recipes) * sum(len(names) for _, names in self.selection)
        with OutputLock(self.out_dir) as lock:
            if self.job.overwrite:  # this may fail, so it comes before anything is given up
                folders = [self.out_dir / variant.folder for variant in self.job_state.variants]
                for recipe in self.recipes:
                    check_kept(recipe, folders)
                self._prepare(self.recipes)
            self.job_state.open(overwrite=self.job.overwrite)
            chunks = list(self.job_state.pending(self.selection))
            self.skipped = self.total - sum(len(chunk.cameras) for chunk in chunks)
            try:
                if not self.job.overwrite:
                    pending = sorted({chunk.variant for chunk in chunks})
                    self._prepare([self.recipes[number] for number in pending])
                self.bar = tqdm(
                    total=self.total, initial=self.skipped, unit="image", disable=not self.progress
                )
                with self.bar:
                    self._render(chunks, lock)
                    if self.counts or needs_finish(self.job_state):
                        self._finish()
            except KeyboardInterrupt:
                self._finish()
                raise KeyboardInterrupt(
                    f"stopped with {self.skipped + self.counts[OK]} of {self.total} images "
                    f"finished; run the same command again to go on from there"
                ) from None
            finally:
                self.job_state.close()

    def _render(self, chunks: list[Chunk], lock: OutputLock) -> None:
        if chunks:
            self._begin(chunks)
            chunks = self._leave_unlabelled(chunks)
        assert self.scene is not None
        setup = Setup(
            out_dir=str(self.out_dir),
            recipes=self.recipes,
            backend=self.backend,
            labelled=self.index.labelled,
            instances=self.index.instances,
            memo=memo_of(self.scene).shared(),
            overwrite=self.job.overwrite,
        )
        if not chunks:
            return
        shared = None
        if self.job.workers > 1:
            check_sendable(self.renderer)
            with self.times.spent("share"):
                shared = share_scene(self.scene, self.index.frames, self.out_dir / STATE_FOLDER)
            self.scene = None  # this process needs no more of it than the index
        work = _ImageWork(chunks, self.job.workers, self._deliver, self.times)
        try:
            with contextlib.closing(self._pool(setup, shared, lock)) as pool:
                run_tasks(pool, work)
        finally:
            if shared is not None:
                shared.remove()

    def _pool(self, setup: Setup, shared: SharedScene | None, lock: OutputLock) -> WorkerPool:
        """This process, or several that open the shared scene."""
        workers = self.job.workers
        if shared is None:
            assert self.scene is not None
            opened = (self.scene, self.index.frames)
            return SerialPool(SceneSetup(setup, lambda: opened, self.renderer))
        own = SceneSetup(setup, shared.open, self.renderer, lock.inherited(), workers)
        return ProcessPool(own, workers)

    def _resolved(self, recipe: Recipe) -> Recipe:
        """The recipe with the settings that its quality chooses here, or has chosen before."""
        if not recipe.quality.is_open:
            return recipe
        assert self.scene is not None
        with self.times.spent("settle"):
            return resolve_quality_for(
                open_store(self.out_dir),
                recipe,
                self.scene,
                backend=self.backend,
                camera_path=self.job.camera_path,
                renderer=self.renderer,
                anew=self.job.overwrite,
                progress=self.progress,
            )

    def _identity(self, recipe: Recipe) -> Identity:
        version = augment.__version__
        return Identity(self.index.source, recipe.hash, self.trajectory, version, self.backend)

    def _prepare(self, recipes: Sequence[Recipe]) -> None:
        """Find what images of these recipes share, for all cameras of the scene or the path."""
        assert self.scene is not None
        cameras, path = None, self.job.camera_path
        if path is not None and any(recipe.sections() for recipe in recipes):
            # An object of its own, or the caller's would remember what was found for this path.
            self.scene = copy.copy(self.scene)
            cameras = [camera for frame in path for camera in frame.cameras.values()]
        with self.times.spent("prepare"):
            folder = self.job.shared_dir or self.out_dir / STATE_FOLDER
            given = (self.scene, recipes, cameras, folder, self.backend, self.progress)
            share_effects(Sharing(*given))

    def _begin(self, chunks: Sequence[Chunk]) -> None:
        """Announce the variants that will be written, before their first file."""
        for number in sorted({chunk.variant for chunk in chunks}):
            variant = self.job_state.variants[number]
            variant.progress_log.begin(variant.identity)
            folder = self.out_dir / variant.folder
            copy_files(variant.recipe, folder)
            text = dump_recipe(portable_recipe(variant.recipe)).encode()
            write_atomic(folder / "recipe.yaml", text)

    def _leave_unlabelled(self, chunks: Sequence[Chunk]) -> list[Chunk]:
        """Record as failed what belongs to frames whose boxes cannot be read; return the rest."""
        with self.times.spent("labels"):
            labelled = {c.frame for c in chunks if uses_boxes(self.recipes[c.variant])}
            self.boxes.get(sorted(labelled))
            if labelled:
                _ = self.index.instances.by_track  # read once, and not by every worker
        rest = []
        for chunk in chunks:
            message = self.boxes.errors.get(chunk.frame)
            if message is None or not uses_boxes(self.recipes[chunk.variant]):
                rest.append(chunk)
                continue
            for name in chunk.cameras:
                self._deliver(Outcome(chunk.variant, chunk.frame, name, FAILED, message))
        return rest

    def _deliver(self, outcome: Outcome) -> None:
        self.job_state.record(outcome, self.index.frames_by_number[outcome.frame])
        with self.counting:
            self.counts[outcome.status] += 1
            if outcome.status == FAILED:
                where = f"frame {outcome.frame}, camera {outcome.camera}"
                folder = self.job_state.variants[outcome.variant].folder
                self.failures.append(f"{folder}, {where}: {outcome.message}")
                self.bar.set_postfix(failed=self.counts[FAILED], refresh=False)
            self.bar.update()
            if self.on_outcome is not None:
                self.on_outcome(outcome)

    def _finish(self) -> None:
        with self.times.spent("finish"):
            finish(self.job_state, self.trajectory, self.boxes)
