"""Where the copy of a dataset lies, and the file beside it that says what stands in it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from augment.batch.layout import folder_name
from augment.batch.mirror_tree import SourceTree
from augment.errors import OutputError

MIRROR_FOLDER = "source"
_IMAGE, _SWEEP = ("scene", "image", "sha256"), ("scene", "sweep")


@dataclass(frozen=True)
class MirrorRecord:
    """scenes: facts by name. replaced: by place in the dataset, the image that stands there: its
    scene, its path relative to the output folder and its SHA-256. sweeps: likewise, scene and path
    of the weathered sweep in a file of returns; none in older records.
    """

    scenes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    replaced: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    sweeps: Mapping[str, Mapping[str, str]] = field(default_factory=dict)


def mirror_folder(out_dir: Path, variant: str) -> Path:
    """Where the copies of datasets in a variant's weather lie."""
    return out_dir / MIRROR_FOLDER / folder_name(variant)


def record_names(tree: SourceTree, folder: Path) -> tuple[Path, Path]:
    """The record of a complete copy, and its name while the copy is being changed."""
    record = folder / f"climategs-mirror-{tree.root.name}.json"
    return record, record.with_name(record.name + ".begun")


def read_record(tree: SourceTree, folder: Path) -> MirrorRecord:
    """What is known of the dataset's copy in a folder, also of one that was stopped while it was
    being changed; empty where there is none.

    Raises:
        OutputError: the record is damaged, or the copy is that of another dataset.
    """
    path = next((path for path in record_names(tree, folder) if path.is_file()), None)
    if path is None:
        return MirrorRecord()
    try:
        content = json.loads(path.read_bytes())
        root = os.path.realpath(content["folder"])
        record = MirrorRecord(
            {name: dict(facts) for name, facts in content["scenes"].items()},
            _entries(content["replaced"], _IMAGE),
            _entries(content.get("replaced_sweeps", {}), _SWEEP),
        )
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise OutputError(
            f"{path} is damaged ({error!r}). Delete it and build the copy again, once for each "
            f"scene whose images are in it"
        ) from error
    if root != os.path.realpath(tree.root):
        raise OutputError(
            f"{folder / tree.root.name} is the copy of {root}, not of {tree.root}: choose another "
            f"output folder, or delete that copy"
        )
    return record


def _entries(content: Any, keys: tuple[str, ...]) -> dict[str, dict[str, str]]:
    return {place: {key: str(entry[key]) for key in keys} for place, entry in content.items()}
