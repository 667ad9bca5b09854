"""What the images of a variant are made from, kept in the output before the first of them.

Two jobs that call different recipes the same can start at one moment, when neither sees images of
the other. Whoever comes second is refused here.
"""

from __future__ import annotations

import json

from augment.batch.claims import hold
from augment.batch.journal import Identity
from augment.batch.layout import STATE_FOLDER, folder_name, variant_folder
from augment.batch.store import Store, StoredFileMissing
from augment.errors import OutputError

VARIANTS = f"{STATE_FOLDER}/variants"


def enter_variant(store: Store, scene: str, variant: str, identity: Identity) -> None:
    """Make sure that the variant's images are all made from the same.

    Raises:
        OutputError: the output has the variant made from something else.
    """
    folder = variant_folder(scene, variant)
    path = f"{VARIANTS}/{folder}.json"
    try:
        found = store.read(path)
    except StoredFileMissing:
        with hold(store, folder_name(f"variant.{folder.replace('/', '.')}")):
            if not store.exists(path):
                store.write(path, json.dumps(vars(identity), sort_keys=True).encode())
            found = store.read(path)
    try:
        other = Identity(**json.loads(found))
    except (ValueError, TypeError, RecursionError) as error:
        raise OutputError(
            f"{store.uri}/{path} is damaged: {error}. Delete it and start the job again"
        ) from error
    identity.check(other, f"{store.uri}/{folder}")
