"""Files of a suite in copies of its datasets (`--layout source`).

In: the records that `augment.jobs.mirror` writes beside the copies. Out: paths of the images and
sweeps that stand in place of recorded ones. All other files of a copy are the dataset's own.
"""

from __future__ import annotations

from collections.abc import Collection

from augment.jobs.mirror import MIRROR_FOLDER, RECORD_START, MirrorRecord
from augment.output.layout import parse_errors_as_output_errors
from augment.output.names import folder_name
from augment.output.store import Store

_RECORD_END = ".json"


def find_mirrored_files(store: Store, variants: Collection[str]) -> list[str]:
    """Return the paths of the files in place of recorded ones in complete copies of datasets.

    Args:
        store: The output.
        variants: Names of the variants, such as `fog-3-000`.

    Raises:
        OutputError: A record is damaged.
    """
    starts = tuple(f"{MIRROR_FOLDER}/{folder_name(name)}/{RECORD_START}" for name in variants)
    mirrored_paths = []
    for path in store.list(MIRROR_FOLDER):
        start = next((start for start in starts if path.startswith(start)), None)
        if start is None or "/" in path[len(start) :] or not path.endswith(_RECORD_END):
            continue
        dataset = path[len(start) : -len(_RECORD_END)]
        copy = f"{start.removesuffix(RECORD_START)}{dataset}"
        advice = "Delete it and start the suite again, which builds the copy anew"
        with parse_errors_as_output_errors(f"{store.uri}/{path}", advice):
            record = MirrorRecord.model_validate_json(store.read(path))
        places = (*record.replaced, *record.replaced_sweeps)
        mirrored_paths += [f"{copy}/{place}" for place in places]
    return sorted(mirrored_paths)
