"""What a reader sees of an output, here or in an object store, also while jobs are running.

`generate` jobs publish a block of images at a time: first its files, then its rows as one part,
`.climategs/parts/<scene>/<block>-<digest>.parquet`. From time to time somebody merges all parts
into `manifest.parquet`, whose metadata lists them. Parts stay: they are what is true, and the
manifest can be made from them again. So no two writers can lose each other's rows, whatever the
order.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection
from dataclasses import dataclass

import pyarrow as pa

from augment.batch.layout import MANIFEST, STATE_FOLDER
from augment.batch.manifest import FAILED, concat_rows, latest_rows, manifest_bytes, parse_manifest
from augment.batch.store import Store, StoredFileMissing
from augment.errors import OutputError

PARTS = f"{STATE_FOLDER}/parts"
_SUFFIX = ".parquet"
_FAILED = ".failed"
_LISTED = b"climategs.parts"
_MOST_RACES = 100  # times that a part is replaced just before it is read


@dataclass(frozen=True)
class Part:
    """The rows of a finished block. key: `<scene>/<block>`. has_failures: some images failed."""

    key: str
    digest: str
    has_failures: bool
    modified_s: float = 0.0

    @property
    def name(self) -> str:
        return f"{self.key}-{self.digest}{_FAILED if self.has_failures else ''}{_SUFFIX}"

    @property
    def path(self) -> str:
        return f"{PARTS}/{self.name}"

    @staticmethod
    def parse(path: str, modified_s: float = 0.0) -> Part | None:
        """The part of a path in the output; None where it is none."""
        if not (path.startswith(f"{PARTS}/") and path.endswith(_SUFFIX)):
            return None
        stem = path[len(PARTS) + 1 : -len(_SUFFIX)]
        has_failures = stem.endswith(_FAILED)
        key, dash, digest = stem.removesuffix(_FAILED).rpartition("-")
        return Part(key, digest, has_failures, modified_s) if dash else None


def list_parts(store: Store, scene_folder: str | None = None) -> dict[str, Part]:
    """The part of every block that has one, by the block's key; no file is read.

    scene_folder: of one scene only.
    """
    found: dict[str, Part] = {}
    for part in _all_parts(store, scene_folder):
        other = found.get(part.key)
        found[part.key] = part if other is None else max(other, part, key=_worth)
    return found


def publish_part(store: Store, key: str, rows: pa.Table) -> Part:
    """Make a block's rows visible: in one step, and in place of what the block had before.

    A part without failures is never replaced by one with some. Returns the part that stands.
    """
    data = manifest_bytes(rows)
    failed = FAILED in rows["status"].to_pylist()
    part = Part(key, hashlib.sha256(data).hexdigest()[:12], failed)
    # Listed before it is written: of two who publish a block at once, none can delete the other's.
    before = [p for p in _all_parts(store, key.rsplit("/", 1)[0]) if p.key == key]
    whole = [p for p in before if not p.has_failures]
    if failed and whole:
        return max(whole, key=_worth)
    store.write(part.path, data)
    store.delete([other.path for other in before if other.name != part.name])
    return part


def read_finished(store: Store) -> pa.Table:
    """The rows of all finished images and of those that failed, sorted by `manifest.KEY`.

    Raises:
        OutputError: nothing is finished yet, or a file is damaged.
    """
    table = _merged(store)[0]
    if table is None:
        raise OutputError(
            f"{store.uri} holds neither {MANIFEST} nor finished blocks: it is no output folder, or "
            f"nothing in it is finished yet. A job writes its manifest when it ends"
        )
    return table


def compact(store: Store) -> pa.Table | None:
    """Merge all parts into the manifest; returns its table, None where nothing is finished.

    Whoever calls holds the claim on the manifest, so that the last to write has seen all parts.
    """
    table, before, parts = _merged(store)
    if table is None:
        return None
    listed = json.dumps([part.name for part in parts], separators=(",", ":")).encode()
    data = manifest_bytes(table.replace_schema_metadata({_LISTED: listed} if parts else None))
    if data != before:
        store.write(MANIFEST, data)
    stands = {part.key: _worth(part) for part in parts}
    store.delete([p.path for p in _all_parts(store) if _worth(p) < stands.get(p.key, _worth(p))])
    return table


def parts_to_merge(store: Store) -> int:
    """How many parts the manifest does not have yet."""
    listed = _listed(_manifest(store)[0])
    return sum(part.name not in listed for part in list_parts(store).values())


def _merged(store: Store) -> tuple[pa.Table | None, bytes | None, list[Part]]:
    """The rows of the manifest and of the parts, the manifest's bytes as they are, and the parts.

    A part may be replaced between being listed and being read: then all is looked at again.
    """
    for attempt in range(_MOST_RACES):
        parts = sorted(list_parts(store).values(), key=lambda part: part.name)
        table, data = _manifest(store)
        listed = _listed(table)
        try:
            read = [_read_part(store, part) for part in parts if part.name not in listed]
        except StoredFileMissing:
            if attempt == _MOST_RACES - 1:
                raise
            continue
        table = None if table is None else table.replace_schema_metadata(None)
        if read:
            table = latest_rows([concat_rows(read), *([] if table is None else [table])])
        return table, data, parts
    raise AssertionError


def _manifest(store: Store) -> tuple[pa.Table | None, bytes | None]:
    try:
        data = store.read(MANIFEST)
    except StoredFileMissing:
        return None, None
    return parse_manifest(data, f"{store.uri}/{MANIFEST}"), data


def _read_part(store: Store, part: Part) -> pa.Table:
    return parse_manifest(store.read(part.path), f"{store.uri}/{part.path}")


def _listed(table: pa.Table | None) -> Collection[str]:
    note = None if table is None else (table.schema.metadata or {}).get(_LISTED)
    if note is None:
        return frozenset()
    try:
        names = json.loads(note)
    except (ValueError, RecursionError):  # damaged: the parts tell it all again
        names = []
    if not isinstance(names, list):
        return frozenset()
    return frozenset(name for name in names if isinstance(name, str))


def _all_parts(store: Store, scene_folder: str | None = None) -> list[Part]:
    """Also those that a killed process left beside the ones that took their place."""
    folder = PARTS if scene_folder is None else f"{PARTS}/{scene_folder}"
    files = store.list(folder).items()
    parts = [Part.parse(path, file.modified_s) for path, file in files]
    return [part for part in parts if part is not None]


def _worth(part: Part) -> tuple[bool, float, str]:
    """Of two parts of a block the greater one stands: without failures, else the later one."""
    return not part.has_failures, part.modified_s, part.name
