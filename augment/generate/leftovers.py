"""Clears away what killed processes have left in an output: nobody reads it, but it takes room.

Temporary files of processes that have ended, the folders that published blocks were rendered in,
and the claims' files of the dead. What live processes hold stays; should one on another machine
lose a temporary file all the same, because locks do not reach there, its store writes it again.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

from augment.batch.atomic import remove_temporaries
from augment.batch.claims import CLAIMS_FOLDER, try_claim
from augment.batch.layout import STATE_FOLDER, variant_folder
from augment.batch.parts import PARTS
from augment.batch.store import Store
from augment.errors import OutputError
from augment.generate.publish import staging_folder
from augment.generate.records import Block
from augment.generate.variants import VARIANTS
from augment.quality.record import FOLDER as QUALITY


def clear_leftovers(store: Store, scratch: Path | None, published: Iterable[Block]) -> None:
    """published: blocks that need no further work.

    Raises:
        OutputError: the system refused.
    """
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
        claim = try_claim(store, path.removeprefix(f"{CLAIMS_FOLDER}/").removesuffix(".lock"))
        if claim is not None:
            claim.release()


def clear_block(store: Store, scratch: Path | None, block: Block) -> None:
    """Delete the folder that a block was rendered in; who calls holds its claim."""
    folder = staging_folder(store, scratch, block)
    clear_files_of(store, block)
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
