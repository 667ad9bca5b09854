"""What a worker does, wherever it runs: open scenes, render blocks, publish them.

A worker keeps one scene and no more: the last that it opened.
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
from augment.jobs.atomic import copy_file, link_file, make_folder, refusals_of, remove_temporaries
from augment.jobs.blocks import Block, SceneRecord
from augment.jobs.claims import CLAIMS_FOLDER, hold, try_claim
from augment.jobs.files import box_tables
from augment.jobs.layout import (
    MANIFEST,
    STATE_FOLDER,
    SWEEPS,
    FileListing,
    folder_name,
    item_paths,
    path_kinds,
    reading_back,
    variant_folder,
)
from augment.jobs.manifest import (
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
from augment.jobs.pools import OnOutcome
from augment.jobs.processes import file_lock
from augment.jobs.quality import FOLDER as QUALITY
from augment.jobs.quality import resolve_quality_for
from augment.jobs.render_job import RenderJob, SceneLoader, file_folders, run_job
from augment.jobs.store import LocalStore, Store, StoredFileMissing, open_store
from augment.jobs.worker import Outcome, Renderer, TaskFailed, WorkTimes, describe
from augment.scene import Scene
from recipes.schema import Recipe

# ---- Takes a block from the folder it was rendered in to the output, where it appears at once ----
# Its files go there first, to an object store those of an image as soon as it is finished; nobody
# sees them before the block's rows follow in one step. What belongs to several images lies by
# blocks, so that no two write one file: `labels/boxes/000016-3fc0a1b2d4e5.parquet`.


def _of_block() -> set[str]:
    """Kinds of files that belong to several images."""
    return {"labels", "calibration", *box_tables()}


REMOTE_UPLOADS = 8  # at a time: most of the time of one is waiting


class Publisher:
    """Publishes one block. folder: where `run_job` renders it. Use as a context manager."""

    def __init__(self, store: Store, folder: Path, block: Block) -> None:
        self._store, self._folder, self._block = store, folder, block
        self._pool = ThreadPoolExecutor(REMOTE_UPLOADS, thread_name_prefix="publish")
        self._sent: dict[str, Future[None]] = {}

    def __enter__(self) -> Publisher:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def image_done(self, outcome: Outcome) -> None:
        """Send the files of a finished image on their way; on this disk they only get a name."""
        if outcome.status != OK or isinstance(self._store, LocalStore):
            return
        recipe = self._block.recipe
        paths = item_paths(self._block.scene, recipe, outcome.camera, outcome.frame)
        for kind in paths.keys() - _of_block():
            path = paths[kind]
            if path is None or path in self._sent:  # cameras of a frame share its sweep
                continue
            if kind != "lidar" or outcome.lidar:
                self._send(path, path)

    def finish(self) -> Part:
        """Send what is left, then make the block visible."""
        rows = read_manifest(self._folder)
        stem = self._block.file_stem  # `labels/boxes.parquet` becomes `labels/boxes/<stem>.parquet`
        new = _renamed(rows, lambda path: path.with_suffix("") / f"{stem}{path.suffix}")
        # The recipe, and the files that it names: every block of a variant has the same.
        globs = ("*/*/recipe.yaml", *(f"*/*/{folder}/*" for folder in file_folders()))
        of_variant = [p for glob in globs for p in sorted(self._folder.glob(glob))]
        left = {p: p for p in (p.relative_to(self._folder).as_posix() for p in of_variant)}
        for kind in path_kinds():
            there, here = new[f"{kind}_path"].to_pylist(), rows[f"{kind}_path"].to_pylist()
            left |= {t: h for t, h in zip(there, here, strict=True) if h is not None}
        if isinstance(self._store, LocalStore):
            self._store.put_files({target: self._folder / left[target] for target in left})
        else:
            for target in left.keys() - self._sent.keys():
                self._send(left[target], target)
            for future in self._sent.values():
                future.result()
        return publish_part(self._store, self._block.key, new)

    def _send(self, source: str, target: str) -> None:
        self._sent[target] = self._pool.submit(self._put, self._folder / source, target)

    def _put(self, source: Path, target: str) -> None:
        is_shared = target.startswith(f"{folder_name(self._block.scene)}/{SWEEPS}/")
        if not (is_shared and self._store.exists(target)):
            self._store.put_file(target, source)


def take_sweeps(store: Store, folder: Path, block: Block) -> None:
    """Give the folder, by links, the sweeps that the scene's other variants have published."""
    if store.local_dir is None or block.recipe.lidar != "clean":
        return
    for frame in block.frames:
        path = item_paths(block.scene, block.recipe, "", frame)["lidar"] or ""
        if (store.local_dir / path).is_file():
            with refusals_of(folder / path):
                make_folder((folder / path).parent)
                link_file(str(store.local_dir / path), str(folder / path))


def take_published(store: Store, folder: Path, block: Block, part: Part) -> None:
    """Give the folder, by links, what is left of a published block that has lost files: `run_job`
    then makes there what is missing, and nothing else.
    """
    if store.local_dir is None or (folder / MANIFEST).is_file():
        return
    rows = parse_manifest(store.read(part.path), f"{store.uri}/{part.path}")
    staged = _renamed(rows, lambda path: path.parent.with_suffix(path.suffix))
    names: dict[str, str] = {}
    for column in (f"{kind}_path" for kind in path_kinds()):
        pairs = zip(rows[column].to_pylist(), staged[column].to_pylist(), strict=True)
        names |= {there: here for there, here in pairs if there is not None}
    listing = FileListing(store.local_dir)
    for there, here in names.items():
        if listing.has(there):
            with refusals_of(folder / here):
                make_folder((folder / here).parent)
                if not link_file(str(store.local_dir / there), str(folder / here)):
                    copy_file(str(store.local_dir / there), str(folder / here))
    write_manifest(folder, staged)


def staging_folder(store: Store, scratch: Path | None, block: Block) -> Path:
    """Where a block is rendered: on the output's own disk, else in `scratch`. There a killed job
    finds again what it had finished of the block.
    """
    if store.local_dir is not None:
        return store.local_dir / STATE_FOLDER / "blocks" / block.claim
    assert scratch is not None, "a store elsewhere needs a folder to render in"
    return scratch / "blocks" / block.claim


def _renamed(rows: pa.Table, rename: Callable[[PurePosixPath], PurePosixPath]) -> pa.Table:
    """The rows with other names of the files that belong to several images."""
    for name in (f"{kind}_path" for kind in _of_block()):
        files = [None if p is None else PurePosixPath(p) for p in rows[name].to_pylist()]
        paths = [None if file is None else str(rename(file)) for file in files]
        place = rows.column_names.index(name)
        rows = rows.set_column(place, rows.schema.field(place), pa.array(paths, pa.string()))
    return rows.combine_chunks()


# ---- What the images of a variant are made from, kept in the output before the first of them -----
# Two jobs that call different recipes the same can start at one moment, when neither sees images of
# the other. Whoever comes second is refused here.

VARIANTS = f"{STATE_FOLDER}/variants"


def enter_variant(store: Store, scene: str, variant: str, identity: Identity) -> None:
    """Make sure that the variant's images are all made from the same."""
    folder = variant_folder(scene, variant)
    path = f"{VARIANTS}/{folder}.json"
    try:
        found = store.read(path)
    except StoredFileMissing:
        with hold(store, folder_name(f"variant.{folder.replace('/', '.')}")):
            if not store.exists(path):
                store.write(path, json.dumps(vars(identity), sort_keys=True).encode())
            found = store.read(path)
    with reading_back(f"{store.uri}/{path}", "Delete it and start the job again"):
        other = Identity(**json.loads(found))
    identity.check(other, f"{store.uri}/{folder}")


# ---- What killed processes have left in an output ------------------------------------------------
# Temporary files of processes that have ended, the folders that published blocks were rendered in,
# and the claims' files of the dead. What live processes hold stays; should one on another machine
# lose a temporary file all the same, because locks do not reach there, its store writes it again.


def clear_leftovers(store: Store, scratch: Path | None, published: Iterable[Block]) -> None:
    """published: blocks that need no further work."""
    for block in published:
        if staging_folder(store, scratch, block).is_dir():
            claim = try_claim(store, block.claim)
            if claim is not None:
                with claim:
                    clear_block(store, scratch, block)
    if store.local_dir is None:
        return
    state = store.local_dir / STATE_FOLDER
    remove_temporaries(store.local_dir, recursive=False)
    for folder in (state / "jobs", state / "scenes"):
        remove_temporaries(folder)
    for kept in (PARTS, VARIANTS, QUALITY):
        remove_temporaries(store.local_dir / kept)
    for path in store.list(CLAIMS_FOLDER):
        name = path.removeprefix(f"{CLAIMS_FOLDER}/").removesuffix(".lock")
        if folder_name(name) != name:  # not a claim's file: somebody else has put it there
            continue
        claim = try_claim(store, name)
        if claim is not None:
            claim.release()


def clear_staged(store: Store, scratch: Path | None, scene_folder: str) -> None:
    """Delete the folders that blocks of a scene are rendered in, but for those that live processes
    are at.
    """
    root = store.local_dir / STATE_FOLDER if store.local_dir is not None else scratch
    for folder in sorted(root.glob(f"blocks/{scene_folder}.*")) if root is not None else ():
        claim = try_claim(store, folder_name(folder.name))
        if claim is not None:
            with claim:
                _remove_tree(folder)


def clear_block(store: Store, scratch: Path | None, block: Block) -> None:
    """Delete the folder that a block was rendered in; who calls holds its claim."""
    clear_files_of(store, block)
    _remove_tree(staging_folder(store, scratch, block))


def _remove_tree(folder: Path) -> None:
    try:
        shutil.rmtree(folder)
    except FileNotFoundError:
        return
    except OSError as error:
        raise OutputError(f"cannot delete {folder}: {error.strerror}") from error


def clear_files_of(store: Store, block: Block) -> None:
    """Delete what was half-way into the output when a worker at this block was killed."""
    if store.local_dir is not None:
        remove_temporaries(store.local_dir / variant_folder(block.scene, block.variant))
        remove_temporaries(store.local_dir / folder_name(block.scene) / SWEEPS)


# ---- The worker ----------------------------------------------------------------------------------

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class WorkSetup:
    """What all workers of a job share; picklable. store_uri: the output. scratch: where blocks are
    rendered on their way to an output that is not on this machine. open_scene, renderer, digest_of:
    importable functions; None renders with the library's, and notes no digest of a scene's content.
    """

    store_uri: str
    scratch: Path | None
    backend: str
    open_scene: SceneLoader
    renderer: Renderer | None = None
    digest_of: Callable[[str], str | None] | None = None

    @property
    def output(self) -> str:
        return self.store_uri

    def worker(self, on_outcome: OnOutcome) -> BlockWorker:
        return BlockWorker(self, on_outcome)


@dataclass(frozen=True)
class IndexTask:
    """Open a scene and say what is in it. name: to be called so, or None for its own name."""

    uri: str
    name: str | None


@dataclass(frozen=True)
class BlockTask:
    """Render a block. is_trial: its worker died before, so each image is rendered in a process of
    its own, and one that ends it is the only one lost. is_damaged: it is published, and has lost
    files since.
    """

    block: Block
    name: str | None
    is_trial: bool = False
    is_damaged: bool = False


@dataclass(frozen=True)
class ResolveTask:
    """Let the qualities of recipes choose their settings in a scene, or find what they have chosen.
    name: as of an IndexTask. keep: whether a new choice is kept in the output.
    """

    uri: str
    name: str | None
    recipes: tuple[Recipe, ...]
    keep: bool = True


Task = IndexTask | ResolveTask | BlockTask


@dataclass(frozen=True)
class BlockDone:
    """What became of a block. skipped: images that were finished before, here or elsewhere.
    is_elsewhere: another process is at it; nothing was done. seconds: by kind of work, as of
    `worker.WorkTimes`.
    """

    written: int = 0
    skipped: int = 0
    failed: int = 0
    failures: tuple[str, ...] = ()
    is_elsewhere: bool = False
    seconds: dict[str, float] | None = None


@dataclass(frozen=True)
class ResolvedRecipes:
    """The recipes of a ResolveTask, in its order."""

    recipes: tuple[Recipe, ...]


Result = SceneRecord | ResolvedRecipes | BlockDone | TaskFailed


class BlockWorker:
    """Does one task after the other. tell: hears of every image, from several threads."""

    def __init__(self, setup: WorkSetup, on_outcome: OnOutcome) -> None:
        self._setup, self._on_outcome = setup, on_outcome
        self._store: Store = open_store(setup.store_uri)
        self._scene: Scene | None = None
        self._opened: tuple[str, str | None] | None = None
        self._entered: set[tuple[str, str]] = set()

    def do(self, task: Task) -> Result:
        """The task's result; errors that concern the task alone are results too. Raises GpuLost:
        this process can do no other task either.
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
            return TaskFailed(str(error), of_scene=True, of_memory=of_memory)
        except Exception as error:
            _log.debug("task failed", exc_info=True)
            return TaskFailed(_message_of(error), of_memory=isinstance(error, MemoryError))

    def _index(self, task: IndexTask) -> SceneRecord:
        started = time.perf_counter()
        scene = self._scene_of(task.uri, task.name)
        digest = self._setup.digest_of(task.uri) if self._setup.digest_of is not None else None
        return SceneRecord.of(scene, task.uri, time.perf_counter() - started, digest)

    def _resolve(self, task: ResolveTask, recipe: Recipe) -> Recipe:
        scene, setup = self._scene_of(task.uri, task.name), self._setup
        try:
            return resolve_quality_for(
                self._store,
                recipe,
                scene,
                backend=setup.backend,
                renderer=setup.renderer,
                keep=task.keep,
            )
        except (SceneError, StyleError) as error:
            raise ClimateGSError(
                f"recipe {recipe.name}, variant {recipe.variant}: quality {recipe.quality.words} "
                f"cannot choose its settings: {error}"
            ) from error

    def _scene_of(self, uri: str, name: str | None) -> Scene:
        if self._opened != (uri, name) or self._scene is None:
            self._forget()
            try:
                scene = self._setup.open_scene(uri)
            except OutputError:
                raise
            except Exception as error:
                _log.debug("%s", uri, exc_info=True)
                raise _SceneFailed(_message_of(error)) from error
            self._scene = scene if name is None else replace(scene, name=name)
            self._opened = (uri, name)
        return self._scene

    def _forget(self) -> None:
        """Let go of the scene before another one is opened: never two at a time."""
        self._scene = self._opened = None
        gc.collect()

    def _render(self, task: BlockTask) -> BlockDone:
        block = task.block
        claim = try_claim(self._store, block.claim)
        if claim is None:
            return BlockDone(is_elsewhere=True)
        with claim:
            part = list_parts(self._store, folder_name(block.scene)).get(block.key)
            if part is not None and not part.has_failures and not task.is_damaged:
                clear_block(self._store, self._setup.scratch, block)  # killed just before it did
                return BlockDone(skipped=block.images)
            return self._render_claimed(task, part if task.is_damaged else None)

    def _render_claimed(self, task: BlockTask, damaged: Part | None) -> BlockDone:
        block, times = task.block, WorkTimes()
        if task.is_trial:  # its processes share a scene of their own: not two at a time
            self._forget()
        else:
            with times.spent("open"):
                scene = self._scene_of(block.uri, task.name)
            with times.spent("prepare"):
                self._share(block, scene)
        self._enter(block)
        folder = staging_folder(self._store, self._setup.scratch, block)
        if folder.is_dir():
            clear_files_of(self._store, block)
        if damaged is not None:
            take_published(self._store, folder, block, damaged)
        take_sweeps(self._store, folder, block)
        job = RenderJob(
            scene_uri=block.uri,
            recipes=[block.recipe],
            out_dir=folder,
            frames=block.frames,
            cameras=block.cameras,
            backend=self._setup.backend,
            workers=2 if task.is_trial else 1,
            shared_dir=self._shared_dir(),
            source_digest=block.digest,
        )
        with Publisher(self._store, folder, block) as publisher:

            def on_outcome(outcome: Outcome) -> None:
                publisher.image_done(outcome)
                self._on_outcome(outcome)

            result = run_job(
                job,
                scene_loader=lambda uri: self._scene_of(uri, task.name),
                renderer=self._setup.renderer,
                progress=False,
                on_outcome=on_outcome,
            )
            with times.spent("publish"):
                publisher.finish()
            if not result.failed:
                clear_block(self._store, self._setup.scratch, block)
        times.update(result.timings)
        counts = result.written, result.skipped, result.failed, result.failures
        return BlockDone(*counts, seconds=times.so_far())

    def _enter(self, block: Block) -> None:
        variant = (block.scene, block.variant)
        if variant not in self._entered:
            enter_variant(self._store, *variant, block.identity(self._setup.backend))
            self._entered.add(variant)

    def _shared_dir(self) -> Path:
        if self._store.local_dir is not None:
            return self._store.local_dir / STATE_FOLDER
        assert self._setup.scratch is not None
        return self._setup.scratch

    def _share(self, block: Block, scene: Scene) -> None:
        """Let one process find what lies in files, and the others on this disk wait for it."""
        recipe, backend = block.recipe, self._setup.backend
        if any(e.shares_files and e.of(recipe) is not None for e in effects.EFFECTS):
            folder = self._shared_dir()
            lock = folder / f"beds-{folder_name(block.scene)}.lock"
            with file_lock(lock, "finds where snow can lie"):
                job = effects.Sharing(scene, [recipe], folder=folder, backend=backend)
                effects.share_effects(job, only_files=True)


class _SceneFailed(ClimateGSError):
    """A scene could not be opened."""


def _message_of(error: Exception) -> str:
    """Our own errors say what to do; of others the kind matters too."""
    if isinstance(error, MemoryError):
        return f"memory ran out ({error}); use fewer workers, or a machine with more"
    return str(error) if isinstance(error, ClimateGSError) else describe(error, "in a worker")
