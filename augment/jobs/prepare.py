"""What all images and processes of a job share: where snow can lie, and the styles' colour maps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from augment.cameras import Camera
from augment.effects.snow.cells import SnowSupport
from augment.effects.snow.snow import placement_settings
from augment.effects.snow.support import (
    load_support,
    remember_support,
    save_support,
    support_key,
    support_of,
    support_path,
)
from augment.effects.style.color_maps import StyleMaps
from augment.effects.style.style import remember_maps, style_maps
from augment.scene import Scene
from recipes.schema import Recipe
from recipes.snow import Snow
from recipes.style import Style


@dataclass(frozen=True)
class StoredSnowSupport:
    """A snow support in its file, named by its content, for this snow and any that can lie in the
    same places; picklable.
    """

    snow: Snow
    path: str
    key: str

    def take_over(self, scene: Scene) -> None:
        """Read it into this process, for whoever renders the scene here."""
        remember(scene, self.snow, load_support(Path(self.path), self.key))


def snow_of_recipe(recipe: Recipe) -> Snow | None:
    """The recipe's snow; None where there is none to be laid."""
    snow = recipe.weather.snow
    return snow if snow is not None and snow.changes else None


def remember(scene: Scene, snow: Snow, bed: SnowSupport) -> None:
    """Make it the support that pictures of the scene in such snow use in this process."""
    remember_support(scene, placement_settings(snow), bed)


def find_snow_support(scene: Scene, snow: Snow, *, backend: str = "auto") -> SnowSupport:
    """The support of a snow for all of the scene's cameras, remembered for this scene object."""
    return support_of(scene, placement_settings(snow), backend=backend)


def store_snow_supports(
    scene: Scene,
    recipes: Iterable[Recipe],
    folder: Path,
    *,
    cameras: Sequence[Camera] | None = None,
    backend: str = "auto",
    progress: bool = False,
) -> tuple[StoredSnowSupport, ...]:
    """The supports of all snow in the recipes, in `folder` and remembered for this scene object.
    cameras: all that a camera path has, or None for the scene's: never a selection, so that no
    image depends on what else is rendered. backend: that renders the images. progress: a bar on
    stderr for each support that is placed.
    """
    if cameras is None:
        cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    requested = {placement_settings(s): s for r in recipes if (s := snow_of_recipe(r)) is not None}
    stored = []
    for settings, snow in requested.items():
        bed = support_of(
            scene, settings, cameras=cameras, folder=folder, backend=backend, progress=progress
        )
        key = support_key(scene, cameras, settings, backend=backend)
        path = support_path(folder, key)
        if not path.is_file():  # this process knew it from a job in another folder
            save_support(path, bed, key)
        stored.append(StoredSnowSupport(snow, str(path), key))
    return tuple(stored)


@dataclass(frozen=True, eq=False)
class StoredMaps:
    """The maps of a style in one scene, float32 as in StyleMaps; picklable, so that workers neither
    render what a map is fitted to nor read the files of a style.
    """

    style: Style
    splats: np.ndarray  # [C, 3, 4]
    sky: np.ndarray  # [3, 4]
    picture: np.ndarray  # [3, 4]
    seen_sky: np.ndarray | None  # [3, 4]

    def take_over(self, scene: Scene) -> None:
        """Make them the maps that pictures of the scene in this style use in this process. A scene
        remembers the last few styles only, so this comes right before their pictures.
        """
        remember_maps(scene, self.style, self._maps)

    @cached_property
    def _maps(self) -> StyleMaps:
        """Always the same object: what pictures make of it is kept as long as it is."""
        arrays = (self.splats, self.sky, self.picture)
        splats, sky, picture = (torch.from_numpy(array.copy()) for array in arrays)
        seen = None if self.seen_sky is None else torch.from_numpy(self.seen_sky.copy())
        return StyleMaps(splats, sky, picture, seen)


def style_to_apply(recipe: Recipe) -> Style | None:
    """The recipe's style; None where there is none that changes anything."""
    style = recipe.style
    return style if style is not None and style.changes else None


def store_maps(
    scene: Scene, recipes: Iterable[Recipe], *, cameras: Sequence[Camera] | None = None
) -> tuple[StoredMaps, ...]:
    """The maps of all styles in the recipes. cameras: as of `store_snow_supports`.

    Raises:
        StyleError: a style's files cannot be used, or it cannot be had in this scene.
    """
    stored = []
    for style in {s: None for r in recipes if (s := style_to_apply(r)) is not None}:
        maps = style_maps(scene, style, cameras=cameras)
        splats, sky, picture = (m.numpy() for m in (maps.splats, maps.sky, maps.picture))
        seen = None if maps.seen_sky is None else maps.seen_sky.numpy()
        stored.append(StoredMaps(style, splats, sky, picture, seen))
    return tuple(stored)
