"""The tiny street in the form of every raw dataset. A new dataset adds its writer here."""

from __future__ import annotations

from pathlib import Path

from tests.adapters import (
    av2_files,
    kitti_files,
    nuscenes_files,
    pandaset_files,
    recording_files,
    waymo_files,
)
from tests.adapters.street import Drive

# Function that writes the files into a folder, and one that returns the facts that they state.
WRITERS = {
    "pandaset": (pandaset_files.write_as_pandaset, pandaset_files.drive_of_pandaset),
    "nuscenes": (nuscenes_files.write_as_nuscenes, nuscenes_files.drive_of_nuscenes),
    "kitti": (kitti_files.write_as_kitti, kitti_files.drive_of_kitti),
    "waymo": (waymo_files.write_as_waymo, waymo_files.drive_of_waymo),
    "av2": (av2_files.write_as_av2, av2_files.drive_of_av2),
    "recording": (recording_files.write_as_recording, recording_files.drive_of_recording),
}


def write_drive(scheme: str, root: Path) -> Drive:
    write_files, drive_of = WRITERS[scheme]
    return drive_of(write_files(root))
