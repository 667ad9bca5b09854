"""Scenes whose files have changed since images of them were published.

The manifest's column `source_digest` says what content an image was made from, and so does the
record of a scene in `.climategs/scenes`, for images of older versions too, which lack the column.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute

from augment.errors import OutputError
from augment.jobs.block_worker import VARIANTS, clear_staged
from augment.jobs.blocks import Block
from augment.jobs.claims import hold
from augment.jobs.layout import MANIFEST, folder_name
from augment.jobs.manifest import list_parts, read_manifest, write_manifest
from augment.jobs.store import Store

pc: Any = pyarrow.compute  # type checkers do not see the functions that it makes on import


@dataclass(frozen=True)
class SceneChange:
    """A scene of which an output has other content than its files have now.

    scene: its name in the output.
    uri: what opens it.
    before: digest of the content that the output was made from.
    now: digest of the content of its files.
    record_path: of the output's record of the scene.
    """

    scene: str
    uri: str
    before: str
    now: str
    record_path: str | None = None

    def check(self, store: Store) -> None:
        """Raise OutputError where images of the content of before are there."""
        folder, out = folder_name(self.scene), store.local_dir
        if out is None and not list_parts(store, folder):
            return
        if out is not None and not (out / folder).exists():
            return
        anew = "" if out is None else f", or delete {out / folder} to have its images made anew"
        raise OutputError(
            f"{store.uri} holds images of the scene {self.scene} as it was before: the files of "
            f"{self.uri} have changed since (digest of their content there {self.before}, here "
            f"{self.now}). Choose another output (--out){anew}"
        )

    def accept(self, store: Store, scratch: Path | None) -> None:
        """Forget what the output knows of the images of before, whose files are gone. scratch: the
        folder of `block_worker.WorkSetup`.
        """
        folder = folder_name(self.scene)
        store.delete([part.path for part in list_parts(store, folder).values()])
        store.delete(store.list(f"{VARIANTS}/{folder}"))
        store.delete([] if self.record_path is None else [self.record_path])
        clear_staged(store, scratch, folder)
        if store.local_dir is None or not store.exists(MANIFEST):
            return
        with hold(store, "manifest"):
            table = read_manifest(store.local_dir)
            write_manifest(store.local_dir, table.filter(pc.not_equal(table["scene"], self.scene)))


def changes_in(table: pa.Table, blocks: Iterable[Block]) -> list[SceneChange]:
    """The blocks' scenes of which the manifest names other content than they have now.

    Args:
        table: the manifest's columns scene, status and source_digest.
        blocks: of which the content may be unknown; then nothing is said of their scene.
    """
    scenes = {block.scene: block for block in blocks if block.digest is not None}
    pairs = table.select(["scene", "source_digest"]).group_by(
        ["scene", "source_digest"], use_threads=False
    )
    changes: dict[str, SceneChange] = {}
    for row in pairs.aggregate([]).to_pylist():
        name, digest = row["scene"], row["source_digest"]
        block = scenes.get(name)
        if block is not None and digest not in (None, block.digest):
            changes[name] = SceneChange(name, block.uri, digest, str(block.digest))
    return list(changes.values())
