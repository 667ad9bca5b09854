"""The colour maps of the recipes' styles, worked out once for all images and processes of a job.

Worker processes get the numbers: they neither render what a map is fitted to nor read the files of
a style. What works the maps out is imported only where it is needed, for it brings the rasteriser.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from augment.cameras import Camera
from augment.effects.snow.cells import SnowSupport
from augment.scene import Scene
from recipes.schema import Recipe
from recipes.weather import Snow, Style

# ---- Where snow can lie, found once for all images and processes of a job ------------------------
# The beds lie beside the lock, named by their content: a later job of the same scene, with snow of
# another depth, finds them there.


@dataclass(frozen=True)
class StoredBed:
    """A bed in its file, for this snow and any that can lie in the same places; picklable."""

    snow: Snow
    path: str
    key: str

    def take_over(self, scene: Scene) -> None:
        """Read the bed into this process, for whoever renders the scene here."""
        from augment.effects.snow.support import load_support

        remember(scene, self.snow, load_support(Path(self.path), self.key))


def snow_to_lay(recipe: Recipe) -> Snow | None:
    """The recipe's snow; None where there is none to be laid."""
    snow = recipe.weather.snow
    return snow if snow is not None and snow.lies else None


def remember(scene: Scene, snow: Snow, bed: SnowSupport) -> None:
    """Make it the bed that pictures of the scene in such snow use in this process."""
    from augment.effects.snow.snow import placement_settings
    from augment.effects.snow.support import remember_support

    remember_support(scene, placement_settings(snow), bed)


def find_bed(scene: Scene, snow: Snow, *, backend: str = "auto") -> SnowSupport:
    """The bed of a snow for all of the scene's cameras, remembered for this scene object. backend:
    that renders the pictures.
    """
    from augment.effects.snow.snow import placement_settings
    from augment.effects.snow.support import support_of

    return support_of(scene, placement_settings(snow), backend=backend)


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
    """
    from augment.effects.snow.snow import placement_settings
    from augment.effects.snow.support import save_support, support_key, support_of, support_path

    if cameras is None:
        cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    requested = {placement_settings(s): s for r in recipes if (s := snow_to_lay(r)) is not None}
    stored = []
    for settings, snow in requested.items():
        bed = support_of(
            scene, settings, cameras=cameras, folder=folder, backend=backend, progress=progress
        )
        key = support_key(scene, cameras, settings, backend=backend)
        path = support_path(folder, key)
        if not path.is_file():  # this process knew the bed from a job in another folder
            save_support(path, bed, key)
        stored.append(StoredBed(snow, str(path), key))
    return tuple(stored)


# ---- style maps ----------------------------------------------------------------------------------

if TYPE_CHECKING:
    from augment.effects.style.color_maps import StyleMaps


@dataclass(frozen=True, eq=False)
class StoredMaps:
    """The maps of a style in one scene, float32 as in StyleMaps; picklable."""

    style: Style
    splats: np.ndarray  # [C, 3, 4]
    sky: np.ndarray  # [3, 4]
    picture: np.ndarray  # [3, 4]
    seen_sky: np.ndarray | None  # [3, 4]

    def take_over(self, scene: Scene) -> None:
        """Make them the maps that pictures of the scene in this style use in this process. A scene
        remembers the last few styles only, so this comes right before their pictures.
        """
        from augment.effects.style.style import remember_maps

        remember_maps(scene, self.style, self._maps)

    @cached_property
    def _maps(self) -> StyleMaps:
        """Always the same object: what pictures make of it is kept as long as it is."""
        import torch

        from augment.effects.style.color_maps import StyleMaps

        splats, sky, picture = (
            torch.from_numpy(array.copy()) for array in (self.splats, self.sky, self.picture)
        )
        seen = None if self.seen_sky is None else torch.from_numpy(self.seen_sky.copy())
        return StyleMaps(splats, sky, picture, seen)


def style_to_apply(recipe: Recipe) -> Style | None:
    """The recipe's style; None where there is none that changes anything."""
    style = recipe.style
    return style if style is not None and style.changes else None


def store_maps(
    scene: Scene, recipes: Iterable[Recipe], *, cameras: Sequence[Camera] | None = None
) -> tuple[StoredMaps, ...]:
    """The maps of all styles in the recipes. cameras: all that a camera path has, or None for the
    scene's: never a selection, so that no image depends on what else is rendered. Raises
    StyleError: a style's files cannot be used, or it cannot be had in this scene.
    """
    from augment.effects.style.style import style_maps

    requested = {s: None for r in recipes if (s := style_to_apply(r)) is not None}
    stored = []
    for style in requested:
        maps = style_maps(scene, style, cameras=cameras)
        splats, sky, picture = (m.numpy() for m in (maps.splats, maps.sky, maps.picture))
        seen = None if maps.seen_sky is None else maps.seen_sky.numpy()
        stored.append(StoredMaps(style, splats, sky, picture, seen))
    return tuple(stored)
