"""The record of the Waymo Open Dataset v2."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from adapters.dataset import Dataset, FolderLayout, OpenLabels, Signature

SPLITS = ("training", "validation", "testing")
POSES = "vehicle_pose"
# Components that a scene needs.
REQUIRED = (POSES, "camera_calibration", "camera_image", "lidar_calibration", "lidar", "lidar_pose")


def _is_waymo(folder: Path) -> bool:
    splits = (folder, *(folder / name for name in SPLITS))
    return (folder / f"{POSES}.parquet").is_file() or any(
        (split / POSES).is_dir() and any((split / POSES).glob("*.parquet")) for split in splits
    )


def _scene_files(path: str, query: dict[str, str], _open_labels: OpenLabels) -> Iterable[Path]:
    """Return the files of one segment: a split holds hundreds."""
    from adapters.waymo.adapter import waymo_files

    return waymo_files(path, query)


WAYMO = Dataset(
    scheme="waymo",
    description="the Waymo Open Dataset v2 (Parquet)",
    page="waymo.md",
    example="waymo:data/waymo/training?segment=10023947602400723454_1120_000_1140_000",
    opener="adapters.waymo.adapter:open_waymo",
    labels="adapters.waymo.adapter:waymo_labels",
    is_raw=True,
    folder=Signature(_is_waymo, f"Waymo Open Dataset v2 tables ({POSES}/, of Parquet files)"),
    layouts=(
        FolderLayout(
            "a segment of the Waymo Open Dataset v2",
            {
                f"{name}/": (name, f"{name}.parquet", *(f"{split}/{name}" for split in SPLITS))
                for name in REQUIRED
            },
        ),
    ),
    scene_files=_scene_files,
    list_scenes="adapters.waymo.recordings:list_segments",
    conditions="adapters.waymo.recordings:recorded_conditions",
)
