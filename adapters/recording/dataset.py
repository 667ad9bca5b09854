"""The record of recordings: a user's images, poses and LiDAR, and outputs of our own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from adapters.dataset import Dataset, FolderLayout, OpenLabels, Signature, fixed_tree


def _is_recording(folder: Path) -> bool:
    is_calibrated = (folder / "calibration.json").is_file() or any(
        folder.glob("calibration/*.json")
    )
    return is_calibrated and (folder / "images").is_dir()


def _scene_files(path: str, _query: dict[str, str], _open_labels: OpenLabels) -> Iterator[Path]:
    from augment.output.layout import SWEEP_FOLDER

    yield Path(path)
    yield Path(path) / os.pardir / SWEEP_FOLDER  # a variant of a job has its scene's sweeps


RECORDING = Dataset(
    scheme="recording",
    description="images, poses, LiDAR and boxes of my own; or what `render` wrote",
    page="recording.md",
    example="recording:out/street-seed3/clear-000",
    opener="adapters.recording.adapter:open_recording",
    labels="adapters.recording.adapter:recording_labels",
    is_raw=True,
    folder=Signature(_is_recording, "a recording (calibration.json and images/)"),
    layouts=(
        FolderLayout(
            "a recording",
            {
                "calibration.json": ("calibration.json", "calibration/*.json"),
                "images/<camera>/000000.jpg": ("images/*/*[0-9].jpg", "images/*/*[0-9].png"),
            },
        ),
    ),
    source_tree=fixed_tree(r"images/[^/]+/\d+\.(?i:png|jpe?g)", r"lidar/\d+\.parquet"),
    scene_files=_scene_files,
)
