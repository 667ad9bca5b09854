"""Beds found once: remembered for as long as the scene lives, and kept in a folder."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from weakref import WeakKeyDictionary

from augment.cameras import Camera
from augment.errors import SceneError
from augment.render.backends import AUTO
from augment.scene import Scene
from augment.snow.bed_files import bed_key, load_bed, save_bed
from augment.snow.cells import SnowBed
from augment.snow.placement import PlacementSettings, place_snow_bed

logger = logging.getLogger(__name__)

_remembered: WeakKeyDictionary[Scene, dict[PlacementSettings, SnowBed]] = WeakKeyDictionary()


def bed_of(
    scene: Scene,
    settings: PlacementSettings,
    *,
    cameras: Sequence[Camera] | None = None,
    folder: Path | None = None,
    backend: str = AUTO,
    progress: bool = False,
) -> SnowBed:
    """The bed of a scene: remembered, else read from the folder, else placed and written there.

    cameras: those that must see the snow; None for all of the scene's. Only the bed of all cameras
    is remembered under the settings alone; `remember_bed` gives that place to another.
    folder: beds are kept there as snow-<key>.safetensors. A file that cannot be used is replaced,
    with a warning. backend: that places what is not remembered yet, see place_snow_bed; a scene has
    one bed, so that its pictures, sweeps and labels agree.

    Raises:
        SceneError: as place_snow_bed.
        OutputError: the folder cannot be written.
    """
    found = _remembered.get(scene, {}).get(settings)
    if found is not None:
        return found
    seeing = cameras
    if seeing is None:
        seeing = [camera for frame in scene.frames for camera in frame.cameras.values()]
    bed = _kept(scene, seeing, settings, folder, backend, progress)
    remember_bed(scene, settings, bed)
    return bed


def remember_bed(scene: Scene, settings: PlacementSettings, bed: SnowBed) -> None:
    """Make `bed_of` give this bed for the scene and the settings from now on."""
    _remembered.setdefault(scene, {})[settings] = bed


def bed_path(folder: Path, key: str) -> Path:
    """Where the bed of a key is kept in a folder."""
    return folder / f"snow-{key}.safetensors"


def _kept(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: PlacementSettings,
    folder: Path | None,
    backend: str,
    progress: bool,
) -> SnowBed:
    if folder is None:
        return place_snow_bed(scene, cameras, settings, backend=backend, progress=progress)
    key = bed_key(scene, cameras, settings, backend=backend)
    path = bed_path(folder, key)
    if path.exists():
        try:
            return load_bed(path, key)
        except SceneError as error:
            logger.warning("the snow of %s is placed anew: %s", scene.name, error)
    bed = place_snow_bed(scene, cameras, settings, backend=backend, progress=progress)
    save_bed(path, bed, key)
    return bed
