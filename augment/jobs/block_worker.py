"""Worker of a dataset job: opens scenes, renders blocks of images, and publishes them.

In: tasks of `generate` (`IndexTask`, `ResolveTask`, `BlockTask`). Out: their results, and files in
the output. The pools run it, in this process or in others. A worker keeps only one scene, the last
that it opened.
"""

from __future__ import annotations

import gc
import json
import logging
import shutil
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import pyarrow as pa

from augment import effects
from augment.errors import ClimateGSError, GpuLost, OutputError, SceneError, StyleError
from augment.jobs.blocks import Block, SceneRecord
from augment.jobs.pools import OutcomeCallback
from augment.jobs.processes import file_lock
from augment.jobs.render_job import RenderJob, SceneLoader, file_folders, run_job
from augment.jobs.worker import Outcome, TaskFailed, WorkTimes, describe_error
from augment.output.atomic import (
    copy_file,
    link_file,
    make_folder,
    raise_output_error,
    remove_temporaries,
)
from augment.output.box_weather import box_tables
from augment.output.claims import CLAIMS_FOLDER, hold_claim, try_claim
from augment.output.layout import (
    MANIFEST_FILE,
    STATE_FOLDER,
    SWEEP_FOLDER,
    FileListing,
    folder_name,
    item_paths,
    parse_errors_as_output_errors,
    path_kinds,
    variant_folder,
)
from augment.output.manifest import (
    OK,
    PARTS,
    Identity,
    Part,
    list_parts,
    parse_manifest,
    publish_part,
    read_manifest,
    write_manifest,
)
from augment.output.store import LocalStore, Store, StoredFileMissing, open_store
from augment.scene.scene import Scene
from augment.view.quality import CHOICES_FOLDER as QUALITY
from augment.view.quality import choose_settings
from augment.view.results import Renderer
from recipes.schema import Recipe

# ---- Publishing: moves a block from the folder it was rendered in to the output ------------------
# The files go there first; to an object store, an image's files go as soon as it is finished.
# Readers see no image of the block before its rows follow in one step. Files that belong to several
# images are named by blocks, so that no two workers write one file:
# `labels/boxes/000016-3fc0a1b2d4e5.parquet`.


def _shared_kinds() -> set[str]:
    """Return the kinds of files that belong to several images."""
    return {"labels", "calibration", *box_tables()}


# Uploads at a time: an upload spends most of its time waiting.
NUM_UPLOADS = 8


class Publisher:
    """Publishes one block. Use as a context manager.

    Attributes:
        store: The output.
        block: The block.
        folder: Folder where `run_job` renders the block.
    """

    def __init__(self, store: Store, folder: Path, block: Block) -> None:
        self._store = store
        self._folder = folder
        self._block = block
        self._pool = ThreadPoolExecutor(NUM_UPLOADS, thread_name_prefix="publish")
        self._uploads: dict[str, Future[None]] = {}

    def __enter__(self) -> Publisher:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def image_done(self, outcome: Outcome) -> None:
        """Begin to upload the files of a finished image.

        Does nothing for an output on this disk.
        """
        if outcome.status != OK or isinstance(self._store, LocalStore):
            return
        recipe = self._block.recipe
        paths = item_paths(self._block.scene, recipe, outcome.camera, outcome.frame)
        for kind in paths.keys() - _shared_kinds():
            path = paths[kind]
            if path is None or path in self._uploads:  # the cameras of a frame share its sweep
                continue
            if kind != "lidar" or outcome.lidar:
                self._start_upload(path, path)

    def finish(self) -> Part:
        """Publish the remaining files, then make the block visible."""
        rows = read_manifest(self._folder)
        stem = self._block.file_stem  # `labels/boxes.parquet` becomes `labels/boxes/<stem>.parquet`
        published_rows = _rename_shared_files(
            rows, lambda path: path.with_suffix("") / f"{stem}{path.suffix}"
        )
        # The recipe and the files that it names are the same in every block of a variant.
        globs = ("*/*/recipe.yaml", *(f"*/*/{folder}/*" for folder in file_folders()))
        recipe_files = [p for glob in globs for p in sorted(self._folder.glob(glob))]
        source_of_target = {
            p: p for p in (p.relative_to(self._folder).as_posix() for p in recipe_files)
        }
        for kind in path_kinds():
            targets = published_rows[f"{kind}_path"].to_pylist()
            sources = rows[f"{kind}_path"].to_pylist()
            source_of_target |= {
                t: s for t, s in zip(targets, sources, strict=True) if s is not None
            }
        if isinstance(self._store, LocalStore):
            self._store.put_files(
                {target: self._folder / source_of_target[target] for target in source_of_target}
            )
        else:
            for target in source_of_target.keys() - self._uploads.keys():
                self._start_upload(source_of_target[target], target)
            for future in self._uploads.values():
                future.result()
        return publish_part(self._store, self._block.key, published_rows)

    def _start_upload(self, source: str, target: str) -> None:
        self._uploads[target] = self._pool.submit(self._upload, self._folder / source, target)

    def _upload(self, source: Path, target: str) -> None:
        is_shared = target.startswith(f"{folder_name(self._block.scene)}/{SWEEP_FOLDER}/")
        if not (is_shared and self._store.exists(target)):
            self._store.put_file(target, source)


def link_published_sweeps(store: Store, folder: Path, block: Block) -> None:
    """Link the sweeps that the scene's other variants have published into the folder."""
    if store.local_dir is None or block.recipe.lidar != "clean":
        return
    for frame in block.frames:
        path = item_paths(block.scene, block.recipe, "", frame)["lidar"] or ""
        if (store.local_dir / path).is_file():
            with raise_output_error(folder / path):
                make_folder((folder / path).parent)
                link_file(str(store.local_dir / path), str(folder / path))


def link_published_files(store: Store, folder: Path, block: Block, part: Part) -> None:
    """Link the remaining files of a published block with lost files into the folder.

    `run_job` then makes the missing files there, and nothing else.
    """
    if store.local_dir is None or (folder / MANIFEST_FILE).is_file():
        return
    rows = parse_manifest(store.read(part.path), f"{store.uri}/{part.path}")
    staged_rows = _rename_shared_files(rows, lambda path: path.parent.with_suffix(path.suffix))
    staged_path_of: dict[str, str] = {}
    for column in (f"{kind}_path" for kind in path_kinds()):
        pairs = zip(rows[column].to_pylist(), staged_rows[column].to_pylist(), strict=True)
        staged_path_of |= {
            stored_path: staged_path
            for stored_path, staged_path in pairs
            if stored_path is not None
        }
    listing = FileListing(store.local_dir)
    for stored_path, staged_path in staged_path_of.items():
        if listing.has(stored_path):
            with raise_output_error(folder / staged_path):
                make_folder((folder / staged_path).parent)
                if not link_file(str(store.local_dir / stored_path), str(folder / staged_path)):
                    copy_file(str(store.local_dir / stored_path), str(folder / staged_path))
    write_manifest(folder, staged_rows)


def staging_folder(store: Store, scratch: Path | None, block: Block) -> Path:
    """Return the folder where a block is rendered: on the output's own disk, else in `scratch`.

    A restarted job finds there the images of the block that it had finished.
    """
    if store.local_dir is not None:
        return store.local_dir / STATE_FOLDER / "blocks" / block.claim
    assert scratch is not None, "a store elsewhere needs a folder to render in"
    return scratch / "blocks" / block.claim


def _rename_shared_files(
    rows: pa.Table, rename: Callable[[PurePosixPath], PurePosixPath]
) -> pa.Table:
    """Return the rows with renamed paths of the files that belong to several images."""
    for name in (f"{kind}_path" for kind in _shared_kinds()):
        files = [None if p is None else PurePosixPath(p) for p in rows[name].to_pylist()]
        paths = [None if file is None else str(rename(file)) for file in files]
        position = rows.column_names.index(name)
        rows = rows.set_column(position, rows.schema.field(position), pa.array(paths, pa.string()))
    return rows.combine_chunks()


# ---- Identity of a variant's images, kept in the output before the first image -------------------
# Two jobs whose different recipes have the same name can start at one moment, when neither sees
# images of the other. The second one is refused here.

# Folder of the variants' identities.
VARIANTS = f"{STATE_FOLDER}/variants"


def enter_variant(store: Store, scene: str, variant: str, identity: Identity) -> None:
    """Make sure that all images of the variant are made from the same scene and recipe."""
    folder = variant_folder(scene, variant)
    path = f"{VARIANTS}/{folder}.json"
    try:
        data = store.read(path)
    except StoredFileMissing:
        with hold_claim(store, folder_name(f"variant.{folder.replace('/', '.')}")):
            if not store.exists(path):
                store.write(path, json.dumps(vars(identity), sort_keys=True).encode())
            data = store.read(path)
    with parse_errors_as_output_errors(f"{store.uri}/{path}", "Delete it and start the job again"):
        stored_identity = Identity(**json.loads(data))
    identity.check(stored_identity, f"{store.uri}/{folder}")


# ---- Leftovers of killed processes in an output --------------------------------------------------
# These are temporary files of processes that have ended, the folders in which published blocks were
# rendered, and claim files of dead processes. Files that live processes hold stay. Locks may not
# reach another machine; if a process there loses a temporary file, its store writes the file again.


def clear_leftovers(store: Store, scratch: Path | None, published_blocks: Iterable[Block]) -> None:
    """Delete what killed processes have left in the output.

    Args:
        published_blocks: Blocks that need no further work.
    """
    for block in published_blocks:
        if staging_folder(store, scratch, block).is_dir():
            claim = try_claim(store, block.claim)
            if claim is not None:
                with claim:
                    clear_block(store, scratch, block)
    if store.local_dir is None:
        return
    state_dir = store.local_dir / STATE_FOLDER
    remove_temporaries(store.local_dir, recursive=False)
    for folder in (state_dir / "jobs", state_dir / "scenes"):
        remove_temporaries(folder)
    for state_folder in (PARTS, VARIANTS, QUALITY):
        remove_temporaries(store.local_dir / state_folder)
    with raise_output_error(state_dir):
        for lock in state_dir.glob("beds-*.lock"):  # the names in older versions
            lock.unlink(missing_ok=True)
    for path in store.list(CLAIMS_FOLDER):
        name = path.removeprefix(f"{CLAIMS_FOLDER}/").removesuffix(".lock")
        if folder_name(name) != name:  # not a claim's file: another program has put it there
            continue
        claim = try_claim(store, name)
        if claim is not None:
            claim.release()


def clear_staged(store: Store, scratch: Path | None, scene_folder: str) -> None:
    """Delete the folders in which a scene's blocks are rendered, except those of live processes."""
    root = store.local_dir / STATE_FOLDER if store.local_dir is not None else scratch
    for folder in sorted(root.glob(f"blocks/{scene_folder}.*")) if root is not None else ():
        claim = try_claim(store, folder_name(folder.name))
        if claim is not None:
            with claim:
                _remove_tree(folder)


def clear_block(store: Store, scratch: Path | None, block: Block) -> None:
    """Delete the folder in which a block was rendered; the caller holds the block's claim."""
    clear_files_of(store, block)
    _remove_tree(staging_folder(store, scratch, block))


def _remove_tree(folder: Path) -> None:
    """Delete a folder with everything in it, if it exists."""
    try:
        shutil.rmtree(folder)
    except FileNotFoundError:
        return
    except OSError as error:
        raise OutputError(f"cannot delete {folder}: {error.strerror}") from error


def clear_files_of(store: Store, block: Block) -> None:
    """Delete files that were half-written to the output when a worker at this block was killed."""
    if store.local_dir is not None:
        remove_temporaries(store.local_dir / variant_folder(block.scene, block.variant))
        remove_temporaries(store.local_dir / folder_name(block.scene) / SWEEP_FOLDER)


# ---- The worker ----------------------------------------------------------------------------------

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JobWorkerSetup:
    """Everything that all workers of a job share; picklable."""

    store_uri: str
    """URI of the output."""
    scratch_dir: Path | None
    """Folder where blocks are rendered on their way to an output that is not on this machine."""
    backend: str
    """Name of the rasteriser's backend."""
    open_scene: SceneLoader
    """Opens a scene by its URI; an importable function."""
    renderer: Renderer | None = None
    """Importable function that renders an image; None for the library's own."""
    scene_digest: Callable[[str], str | None] | None = None
    """Importable function that returns the digest of a scene's content; None notes no digest."""

    @property
    def output(self) -> str:
        """URI of the output, for messages."""
        return self.store_uri

    def worker(self, on_outcome: OutcomeCallback) -> BlockWorker:
        """Return a worker for this process."""
        return BlockWorker(self, on_outcome)


@dataclass(frozen=True)
class IndexTask:
    """Task to open a scene and return its record."""

    uri: str
    """URI of the scene."""
    name: str | None
    """Name of the scene in the output; None for its own name."""


@dataclass(frozen=True)
class BlockTask:
    """Task to render a block."""

    block: Block
    """The block."""
    name: str | None
    """As of an IndexTask."""
    is_trial: bool = False
    """True if a worker died at the block before. Each image is then rendered in a process of its
    own, so that only the image is lost that ends its process.
    """
    is_damaged: bool = False
    """True if the block is published and has lost files since."""


@dataclass(frozen=True)
class ResolveTask:
    """Task to choose the open settings of recipes in a scene, or to find earlier choices."""

    uri: str
    """URI of the scene."""
    name: str | None
    """As of an IndexTask."""
    recipes: tuple[Recipe, ...]
    """Recipes whose quality leaves settings open."""
    keep: bool = True
    """If True, the output keeps new choices."""


Task = IndexTask | ResolveTask | BlockTask


@dataclass(frozen=True)
class BlockResult:
    """Counts of a block's images."""

    written: int = 0
    """Images rendered now."""
    skipped: int = 0
    """Images that were finished before, here or by another process."""
    failed: int = 0
    """Images that could not be rendered."""
    failures: tuple[str, ...] = ()
    """One line for each failure."""
    is_claimed_elsewhere: bool = False
    """True if another process has claimed the block; nothing was done."""
    seconds: dict[str, float] | None = None
    """Seconds by kind of work, as of `worker.WorkTimes`."""


@dataclass(frozen=True)
class ResolvedRecipes:
    """Result of a ResolveTask: its recipes, resolved, in its order."""

    recipes: tuple[Recipe, ...]
    """Resolved recipes."""


Result = SceneRecord | ResolvedRecipes | BlockResult | TaskFailed


class BlockWorker:
    """Does one task after the other.

    Attributes:
        setup: Output, backend and scene loader.
        on_outcome: Called with every image's Outcome, from several threads.
    """

    def __init__(self, setup: JobWorkerSetup, on_outcome: OutcomeCallback) -> None:
        self._setup = setup
        self._on_outcome = on_outcome
        self._store: Store = open_store(setup.store_uri)
        self._scene: Scene | None = None
        self._scene_key: tuple[str, str | None] | None = None
        self._entered_variants: set[tuple[str, str]] = set()

    def do(self, task: Task) -> Result:
        """Do a task; errors that concern only the task are results too.

        Raises:
            GpuLost: This process cannot do any other task either.
        """
        try:
            if isinstance(task, IndexTask):
                return self._index(task)
            if isinstance(task, ResolveTask):
                return ResolvedRecipes(
                    tuple(self._resolve(task, recipe) for recipe in task.recipes)
                )
            return self._render(task)
        except OutputError as error:
            return TaskFailed(str(error), is_output=True)
        except GpuLost:
            raise
        except _SceneFailed as error:
            of_memory = isinstance(error.__cause__, MemoryError)
            return TaskFailed(str(error), is_scene_error=True, of_memory=of_memory)
        except Exception as error:
            _log.debug("task failed", exc_info=True)
            return TaskFailed(_message_of(error), of_memory=isinstance(error, MemoryError))

    def _index(self, task: IndexTask) -> SceneRecord:
        """Open a scene and return its record."""
        start_s = time.perf_counter()
        scene = self._open_scene(task.uri, task.name)
        digest = (
            self._setup.scene_digest(task.uri) if self._setup.scene_digest is not None else None
        )
        return SceneRecord.of(scene, task.uri, time.perf_counter() - start_s, digest)

    def _resolve(self, task: ResolveTask, recipe: Recipe) -> Recipe:
        """Return the recipe with the settings that its quality chooses in the scene."""
        scene = self._open_scene(task.uri, task.name)
        setup = self._setup
        try:
            return choose_settings(
                self._store,
                recipe,
                scene,
                backend=setup.backend,
                renderer=setup.renderer,
                keep_choice=task.keep,
            )
        except (SceneError, StyleError) as error:
            raise ClimateGSError(
                f"recipe {recipe.name}, variant {recipe.variant}: quality {recipe.quality.summary} "
                f"cannot choose its settings: {error}"
            ) from error

    def _open_scene(self, uri: str, name: str | None) -> Scene:
        """Return the opened scene; opens it unless it is the one at hand."""
        if self._scene_key != (uri, name) or self._scene is None:
            self._drop_scene()
            try:
                scene = self._setup.open_scene(uri)
            except OutputError:
                raise
            except Exception as error:
                _log.debug("%s", uri, exc_info=True)
                raise _SceneFailed(_message_of(error)) from error
            self._scene = scene if name is None else replace(scene, name=name)
            self._scene_key = (uri, name)
        return self._scene

    def _drop_scene(self) -> None:
        """Drop the scene before another one is opened, so that two are never in memory."""
        self._scene = self._scene_key = None
        gc.collect()

    def _render(self, task: BlockTask) -> BlockResult:
        """Claim a block and render it, unless it is finished already."""
        block = task.block
        claim = try_claim(self._store, block.claim)
        if claim is None:
            return BlockResult(is_claimed_elsewhere=True)
        with claim:
            part = list_parts(self._store, folder_name(block.scene)).get(block.key)
            if part is not None and not part.has_failures and not task.is_damaged:
                # A killed process may have left the folder.
                clear_block(self._store, self._setup.scratch_dir, block)
                return BlockResult(skipped=block.images)
            return self._render_claimed(task, part if task.is_damaged else None)

    def _render_claimed(self, task: BlockTask, damaged_part: Part | None) -> BlockResult:
        """Render and publish a block whose claim this process holds."""
        block = task.block
        times = WorkTimes()
        if task.is_trial:  # its processes open the scene themselves: never two in memory
            self._drop_scene()
        else:
            with times.measure("open"):
                scene = self._open_scene(block.uri, task.name)
            with times.measure("prepare"):
                self._share_files(block, scene)
        self._enter_variant(block)
        folder = staging_folder(self._store, self._setup.scratch_dir, block)
        if folder.is_dir():
            clear_files_of(self._store, block)
        if damaged_part is not None:
            link_published_files(self._store, folder, block, damaged_part)
        link_published_sweeps(self._store, folder, block)
        job = RenderJob(
            scene_uri=block.uri,
            recipes=[block.recipe],
            out_dir=folder,
            frames=block.frames,
            cameras=block.cameras,
            backend=self._setup.backend,
            workers=2 if task.is_trial else 1,
            shared_files_dir=self._shared_dir(),
            source_digest=block.digest,
        )
        with Publisher(self._store, folder, block) as publisher:

            def on_outcome(outcome: Outcome) -> None:
                publisher.image_done(outcome)
                self._on_outcome(outcome)

            result = run_job(
                job,
                scene_loader=lambda uri: self._open_scene(uri, task.name),
                renderer=self._setup.renderer,
                progress=False,
                on_outcome=on_outcome,
            )
            with times.measure("publish"):
                publisher.finish()
            if not result.failed:
                clear_block(self._store, self._setup.scratch_dir, block)
        times.update(result.timings)
        counts = result.written, result.skipped, result.failed, result.failures
        return BlockResult(*counts, seconds=times.so_far())

    def _enter_variant(self, block: Block) -> None:
        """Make sure that the images of the block's variant have one identity; once per variant."""
        variant = (block.scene, block.variant)
        if variant not in self._entered_variants:
            enter_variant(self._store, *variant, block.identity(self._setup.backend))
            self._entered_variants.add(variant)

    def _shared_dir(self) -> Path:
        """Return the folder for files that images share."""
        if self._store.local_dir is not None:
            return self._store.local_dir / STATE_FOLDER
        assert self._setup.scratch_dir is not None
        return self._setup.scratch_dir

    def _share_files(self, block: Block, scene: Scene) -> None:
        """Let one process compute the files that images share.

        The other processes on this disk wait for it.
        """
        recipe = block.recipe
        backend = self._setup.backend
        if any(e.precomputes_files and e.section_of(recipe) is not None for e in effects.EFFECTS):
            folder = self._shared_dir()
            lock = folder / f"shared-files-{folder_name(block.scene)}.lock"
            with file_lock(lock, "finds the surfaces that are open to the sky"):
                context = effects.JobContext(scene, [recipe], folder=folder, backend=backend)
                effects.precompute_effects(context, only_files=True)


class _SceneFailed(ClimateGSError):
    """Error of a scene that could not be opened."""


def _message_of(error: Exception) -> str:
    """Return an error's message; the type is added unless the error is one of this package."""
    if isinstance(error, MemoryError):
        return f"memory ran out ({error}); use fewer workers, or a machine with more"
    return str(error) if isinstance(error, ClimateGSError) else describe_error(error, "in a worker")
