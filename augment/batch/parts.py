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
from collections.abc import Collection, Iterable
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
    folder = PARTS if scene_folder is None else f"{PARTS}/{scene_folder}"
    for path, file in store.list(folder).items():
        part = Part.parse(path, file.modified_s)
        if part is not None:
            older = found.get(part.key)
            found[part.key] = part if older is None else _better(older, part)
    return found


def publish_part(store: Store, key: str, rows: pa.Table) -> Part:
    """Make a block's rows visible: in one step, and in place of what the block had before."""
    data = manifest_bytes(rows)
    failed = FAILED in rows["status"].to_pylist()
    part = Part(key, hashlib.sha256(data).hexdigest()[:12], failed)
    store.write(part.path, data)
    scene_folder = key.rsplit("/", 1)[0]
    for path in store.list(f"{PARTS}/{scene_folder}"):
        other = Part.parse(path)
        if other is not None and other.key == key and other.name != part.name:
            store.delete([path])
    return part


def read_finished(store: Store) -> pa.Table:
    """The rows of all finished images and of those that failed, sorted by `manifest.KEY`.

    Raises:
        OutputError: nothing is finished yet, or a file is damaged.
    """
    table = _merged(store, list_parts(store).values())[0]
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
    parts = sorted(list_parts(store).values(), key=lambda part: part.name)
    table, before = _merged(store, parts)
    if table is None:
        return None
    listed = json.dumps([part.name for part in parts], separators=(",", ":")).encode()
    data = manifest_bytes(table.replace_schema_metadata({_LISTED: listed} if parts else None))
    if data != before:
        store.write(MANIFEST, data)
    return table


def parts_to_merge(store: Store) -> int:
    """How many parts the manifest does not have yet."""
    listed = _listed(_manifest(store)[0])
    return sum(part.name not in listed for part in list_parts(store).values())


def _merged(store: Store, parts: Iterable[Part]) -> tuple[pa.Table | None, bytes | None]:
    """The rows of the manifest and of the parts, and the manifest's bytes as they are."""
    table, data = _manifest(store)
    listed = _listed(table)
    new = [part for part in parts if part.name not in listed]
    read = [_read_part(store, part) for part in sorted(new, key=lambda part: part.name)]
    table = None if table is None else table.replace_schema_metadata(None)
    if not read:
        return table, data
    return latest_rows([concat_rows(read), *([] if table is None else [table])]), data


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
    names = json.loads(note)
    return frozenset(name for name in names if isinstance(name, str))


def _better(one: Part, other: Part) -> Part:
    """Of two parts of a block: the one without failures, else the later one."""
    return max(one, other, key=lambda p: (not p.has_failures, p.modified_s, p.name))
