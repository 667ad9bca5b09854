"""Publishing: moves a block from the folder it was rendered in to the output.

In: a block's folder and the output. Out: files in the output, and a part of the manifest.
`block_worker` calls it. Files go to the output first; to an object store, an image's files go as
soon as it is finished. Readers see no image of the block before its rows follow in one step. Files
that belong to several images are named by blocks, so that no two workers write one file:
`labels/boxes/000016-3fc0a1b2d4e5.parquet`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path, PurePosixPath

import pyarrow as pa

from augment.jobs.blocks import Block
from augment.jobs.worker import Outcome
from augment.output.atomic import (
    copy_file,
    link_file,
    make_folder,
    raise_output_error,
    remove_temporaries,
    remove_tree,
)
from augment.output.box_weather import box_tables
from augment.output.claims import CLAIMS_FOLDER, hold_claim, try_claim
from augment.output.layout import (
    SWEEP_FOLDER,
    FileListing,
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
    parse_manifest,
    publish_part,
    read_manifest,
    write_manifest,
)
from augment.output.names import MANIFEST_FILE, STATE_FOLDER, folder_name
from augment.output.recipe_files import file_folders
from augment.output.store import LocalStore, Store, StoredFileMissing
from augment.view.quality import CHOICES_FOLDER as QUALITY


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
                remove_tree(folder)


def clear_block(store: Store, scratch: Path | None, block: Block) -> None:
    """Delete the folder in which a block was rendered; the caller holds the block's claim."""
    clear_files_of(store, block)
    remove_tree(staging_folder(store, scratch, block))


def clear_files_of(store: Store, block: Block) -> None:
    """Delete files that were half-written to the output when a worker at this block was killed."""
    if store.local_dir is not None:
        remove_temporaries(store.local_dir / variant_folder(block.scene, block.variant))
        remove_temporaries(store.local_dir / folder_name(block.scene) / SWEEP_FOLDER)
