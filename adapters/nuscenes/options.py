"""What the URI of a nuScenes scene may ask for."""

from __future__ import annotations

from dataclasses import dataclass

from adapters.lidar.options import DriveOptions
from augment.errors import AdapterError

_OWN = {
    "version": "a folder of tables such as v1.0-mini",
    "scene": "a scene's name or token",
    "sweeps": "1 for keyframes and the sweeps between them, 0 for keyframes only",
}


@dataclass(frozen=True)
class NuScenesOptions:
    """version, scene: None for the only one there is. sweeps: whether the LiDAR's sweeps between
    keyframes are frames too. drive: the options that all raw drives have."""

    version: str | None
    scene: str | None
    sweeps: bool
    drive: DriveOptions

    @staticmethod
    def from_query(query: dict[str, str]) -> NuScenesOptions:
        """The options of a URI's query.

        Raises:
            AdapterError: an unknown key, or a value of the wrong kind or out of range.
        """
        sweeps = query.get("sweeps", "1")
        if sweeps not in ("0", "1"):
            raise AdapterError(f"nuscenes: sweeps must be {_OWN['sweeps']}; got {sweeps!r}")
        drive = DriveOptions.from_query("nuscenes", query, _OWN)
        return NuScenesOptions(query.get("version"), query.get("scene"), sweeps == "1", drive)
