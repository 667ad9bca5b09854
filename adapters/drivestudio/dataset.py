"""The record of drivestudio."""

from __future__ import annotations

import os
import re
from pathlib import Path

from adapters.dataset import Dataset, Signature, SourceTree


def _source_tree(path: Path, query: dict[str, str]) -> SourceTree:
    """Return the processed data on which a run was trained."""
    from adapters.drivestudio.drive import RunOptions, find_run

    data = find_run(path, RunOptions.from_query("drivestudio", query)).data
    return SourceTree(Path(os.path.abspath(data)), r"images/\d+_\d+\.jpg", r"lidar/\d+\.bin")


DRIVESTUDIO = Dataset(
    scheme="drivestudio",
    description="a trained drivestudio run",
    page="drivestudio.md",
    example="drivestudio:output/omnire/run?data=data/waymo/processed/training/023",
    opener="adapters.drivestudio.adapter:open_drivestudio",
    labels="adapters.drivestudio.adapter:drivestudio_labels",
    folder=Signature(
        lambda folder: (folder / "config.yaml").is_file() and any(folder.glob("checkpoint_*.pth")),
        "a drivestudio run (config.yaml, checkpoint_*.pth)",
    ),
    file=Signature(
        lambda path: re.fullmatch(r"checkpoint_\w+\.pth", path.name) is not None,
        "checkpoint_*.pth of drivestudio",
    ),
    source_tree=_source_tree,
)
