"""Where snow can lie, found once for all images and processes of a job.

The beds lie beside the lock and the journals, named by their content: a later job of the same
scene, with snow of another depth, finds them there. What finds them is imported only where it is
needed, for it brings the rasteriser.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from augment.cameras import Camera
from augment.scene import Scene
from augment.snow.cells import SnowBed
from recipes.schema import Recipe
from recipes.snow import Snow


@dataclass(frozen=True)
class StoredBed:
    """A bed in its file, for this snow and any that can lie in the same places; picklable."""

    snow: Snow
    path: str
    key: str

    def take_over(self, scene: Scene) -> None:
        """Read the bed into this process, for whoever renders the scene here.

        Raises:
            SceneError: the file is lost or damaged.
        """
        from augment.snow.bed_files import load_bed

        remember(scene, self.snow, load_bed(Path(self.path), self.key))


def snow_to_lay(recipe: Recipe) -> Snow | None:
    """The recipe's snow; None where there is none to be laid."""
    snow = recipe.weather.snow
    return snow if snow is not None and snow.lies else None


def remember(scene: Scene, snow: Snow, bed: SnowBed) -> None:
    """Make it the bed that pictures of the scene in such snow use in this process."""
    from augment.snow.beds import remember_bed
    from augment.snow.covers import placement_settings

    remember_bed(scene, placement_settings(snow), bed)


def find_bed(scene: Scene, snow: Snow, *, backend: str = "auto") -> SnowBed:
    """The bed of a snow for all of the scene's cameras, remembered for this scene object. backend:
    that renders the pictures.

    Raises:
        SceneError: it cannot be placed.
    """
    from augment.snow.beds import bed_of
    from augment.snow.covers import placement_settings

    return bed_of(scene, placement_settings(snow), backend=backend)


def store_beds(
    scene: Scene,
    recipes: Iterable[Recipe],
    folder: Path,
    *,
    cameras: Sequence[Camera] | None = None,
    backend: str = "auto",
    progress: bool = False,
) -> tuple[StoredBed, ...]:
    """The beds of all snow in the recipes, in `folder` and remembered for this scene object.

    cameras: all that a camera path has, or None for the scene's: never a selection, so that no
    image depends on what else is rendered. backend: that renders the images, which places their
    snow, too. progress: a bar on stderr for each bed that is placed.

    Raises:
        SceneError: a bed cannot be placed. OutputError: it cannot be written.
    """
    from augment.snow.bed_files import bed_key, save_bed
    from augment.snow.beds import bed_of, bed_path
    from augment.snow.covers import placement_settings

    if cameras is None:
        cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    wanted = {placement_settings(s): s for r in recipes if (s := snow_to_lay(r)) is not None}
    stored = []
    for settings, snow in wanted.items():
        bed = bed_of(
            scene, settings, cameras=cameras, folder=folder, backend=backend, progress=progress
        )
        key = bed_key(scene, cameras, settings, backend=backend)
        path = bed_path(folder, key)
        if not path.is_file():  # this process knew the bed from a job in another folder
            save_bed(path, bed, key)
        stored.append(StoredBed(snow, str(path), key))
    return tuple(stored)
