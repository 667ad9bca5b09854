"""Scenes whose files have changed since images of them were published.

In: the manifest's rows and the blocks of a job. Out: a `SceneChange` for each changed scene, which
`generate` refuses or accepts. The manifest's column `source_digest` says which content an image was
made from. The record of a scene in `.climategs/scenes` says so too, also for images of older
versions, which lack the column.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute

from augment.errors import OutputError
from augment.jobs.blocks import Block
from augment.jobs.publishing import VARIANTS, clear_staged
from augment.output.claims import hold_claim
from augment.output.manifest import list_parts, read_manifest, write_manifest
from augment.output.names import MANIFEST_FILE, folder_name
from augment.output.store import Store

pc: Any = pyarrow.compute  # type checkers do not see the functions that it makes on import


@dataclass(frozen=True)
class SceneChange:
    """Scene whose files have other content now than when the output's images were made."""

    scene: str
    """Name of the scene in the output."""
    uri: str
    """URI that opens the scene."""
    old_digest: str
    """Digest of the content that the output's images were made from."""
    new_digest: str
    """Digest of the content of the scene's files."""
    record_path: str | None = None
    """Path of the output's record of the scene."""

    def check(self, store: Store) -> None:
        """Raise OutputError where images of the old content are in the output."""
        folder = folder_name(self.scene)
        output_dir = store.local_dir
        if output_dir is None and not list_parts(store, folder):
            return
        if output_dir is not None and not (output_dir / folder).exists():
            return
        advice = (
            ""
            if output_dir is None
            else f", or delete {output_dir / folder} to have its images made anew"
        )
        raise OutputError(
            f"{store.uri} holds images of the scene {self.scene} as it was before: the files of "
            f"{self.uri} have changed since (digest of their content there {self.old_digest}, here "
            f"{self.new_digest}). Choose another output (--out){advice}"
        )

    def accept(self, store: Store, scratch: Path | None) -> None:
        """Delete the output's records of the old images, whose files have been deleted.

        Args:
            scratch: Folder of `block_worker.JobWorkerSetup`.
        """
        folder = folder_name(self.scene)
        store.delete([part.path for part in list_parts(store, folder).values()])
        store.delete(store.list(f"{VARIANTS}/{folder}"))
        store.delete([] if self.record_path is None else [self.record_path])
        clear_staged(store, scratch, folder)
        if store.local_dir is None or not store.exists(MANIFEST_FILE):
            return
        with hold_claim(store, "manifest"):
            table = read_manifest(store.local_dir)
            write_manifest(store.local_dir, table.filter(pc.not_equal(table["scene"], self.scene)))


def changes_in(table: pa.Table, blocks: Iterable[Block]) -> list[SceneChange]:
    """Return the blocks' scenes whose content differs from the one that the manifest names.

    Args:
        table: Columns scene, status and source_digest of the manifest.
        blocks: Blocks of the job; scenes of unknown content are left out.
    """
    scenes = {block.scene: block for block in blocks if block.digest is not None}
    pairs = table.select(["scene", "source_digest"]).group_by(
        ["scene", "source_digest"], use_threads=False
    )
    changes: dict[str, SceneChange] = {}
    for row in pairs.aggregate([]).to_pylist():
        name = row["scene"]
        digest = row["source_digest"]
        block = scenes.get(name)
        if block is not None and digest not in (None, block.digest):
            changes[name] = SceneChange(name, block.uri, digest, str(block.digest))
    return list(changes.values())
