"""Where snow can lie, found once for all images and processes of a job.

The beds lie beside the lock and the journals, named by their content: a later job of the same
scene, with snow of another depth, finds them there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from augment.cameras import Camera
from augment.scene import Scene
from augment.snow.bed_files import bed_key, load_bed, save_bed
from augment.snow.beds import bed_of, bed_path, remember_bed
from augment.snow.covers import placement_settings
from augment.snow.placement import PlacementSettings
from recipes.schema import Recipe


@dataclass(frozen=True)
class StoredBed:
    """A bed in its file; small, and picklable."""

    settings: PlacementSettings
    path: str
    key: str

    def take_over(self, scene: Scene) -> None:
        """Read the bed into this process, for whoever renders the scene here.

        Raises:
            SceneError: the file is lost or damaged.
        """
        remember_bed(scene, self.settings, load_bed(Path(self.path), self.key))


def bed_settings(recipe: Recipe) -> PlacementSettings | None:
    """How the bed of the recipe's snow is found; None where no snow is to be laid."""
    snow = recipe.weather.snow
    if snow is None or snow.depth_m == 0 or snow.coverage == 0:
        return None
    return placement_settings(snow)


def find_beds(
    scene: Scene,
    recipes: Iterable[Recipe],
    folder: Path,
    *,
    cameras: Sequence[Camera] | None = None,
    progress: bool = False,
) -> tuple[StoredBed, ...]:
    """The beds of all snow in the recipes, in `folder` and remembered for this scene object.

    cameras: all that a camera path has, or None for the scene's: never a selection, so that no
    image depends on what else is rendered. progress: a bar on stderr for each bed that is placed.

    Raises:
        SceneError, ValueError: a bed cannot be placed. OutputError: it cannot be written.
    """
    seeing = cameras
    if seeing is None:
        seeing = [camera for frame in scene.frames for camera in frame.cameras.values()]
    wanted = dict.fromkeys(s for recipe in recipes if (s := bed_settings(recipe)) is not None)
    return tuple(_find_bed(scene, settings, folder, seeing, progress) for settings in wanted)


def _find_bed(
    scene: Scene,
    settings: PlacementSettings,
    folder: Path,
    cameras: Sequence[Camera],
    progress: bool,
) -> StoredBed:
    bed = bed_of(scene, settings, cameras=cameras, folder=folder, progress=progress)
    key = bed_key(scene, cameras, settings)
    path = bed_path(folder, key)
    if not path.is_file():  # this process knew the bed from a job in another folder
        save_bed(path, bed, key)
    return StoredBed(settings, str(path), key)
