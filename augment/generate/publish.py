"""Takes a block from the folder it was rendered in to the output, where it appears at once.

Its files go there first, to an object store those of an image as soon as it is finished; nobody
sees them before the block's rows follow in one step. What belongs to several images lies by blocks,
for no two blocks ever write the same file: `labels/boxes/000016-3fc0a1b2d4e5.parquet`.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path, PurePosixPath

import pyarrow as pa

from augment.batch.layout import PATH_KINDS, STATE_FOLDER, item_paths
from augment.batch.local_store import LocalStore
from augment.batch.manifest import OK, read_manifest
from augment.batch.parts import Part, publish_part
from augment.batch.runner import Outcome
from augment.batch.store import Store
from augment.generate.records import Block

_OF_BLOCK = ("labels", "box_2d", "box_smog", "box_water", "box_snow", "calibration")
_OF_IMAGE = tuple(kind for kind in PATH_KINDS if kind not in _OF_BLOCK)
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
        paths = item_paths(self._block.scene, recipe, outcome.camera, outcome.frame).columns()
        for kind in _OF_IMAGE:
            path = paths[f"{kind}_path"]
            if path is None or path in self._sent:  # cameras of a frame share its sweep
                continue
            if kind != "lidar" or outcome.lidar:
                self._send(path, path)

    def finish(self) -> Part:
        """Send what is left, then make the block visible.

        Raises:
            OutputError: a file could not be written; the block is invisible then.
        """
        rows = read_manifest(self._folder)
        new = _renamed(rows, self._block.file_stem)
        left = {path: path for path in self._of_variant()}
        for kind in PATH_KINDS:
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
        self._sent[target] = self._pool.submit(self._store.put_file, target, self._folder / source)

    def _of_variant(self) -> Iterator[str]:
        """The recipe, and the files of its style: every block of a variant has the same."""
        for path in sorted(self._folder.glob("*/*/recipe.yaml")):
            yield path.relative_to(self._folder).as_posix()
        for path in sorted(self._folder.glob("*/*/style/*")):
            yield path.relative_to(self._folder).as_posix()


def staging_folder(store: Store, scratch: Path | None, block: Block) -> Path:
    """Where a block is rendered: on the output's own disk, else in `scratch`.

    There a killed job finds again what it had finished of the block.
    """
    if store.local_dir is not None:
        return store.local_dir / STATE_FOLDER / "blocks" / block.claim
    assert scratch is not None, "a store elsewhere needs a folder to render in"
    return scratch / "blocks" / block.claim


def _renamed(rows: pa.Table, stem: str) -> pa.Table:
    for kind in _OF_BLOCK:
        name = f"{kind}_path"
        paths = [None if p is None else _of_block(p, stem) for p in rows[name].to_pylist()]
        place = rows.column_names.index(name)
        rows = rows.set_column(place, rows.schema.field(place), pa.array(paths, pa.string()))
    return rows.combine_chunks()


def _of_block(path: str, stem: str) -> str:
    """`labels/boxes.parquet` -> `labels/boxes/<stem>.parquet`."""
    whole = PurePosixPath(path)
    return str(whole.with_suffix("") / f"{stem}{whole.suffix}")
