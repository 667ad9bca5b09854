"""The colour maps of the recipes' styles, worked out once for all images and processes of a job.

Worker processes get the numbers: they neither render what a map is fitted to nor read the files of
a style. What works the maps out is imported only where it is needed, for it brings the rasteriser.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from augment.cameras import Camera
from augment.scene import Scene
from recipes.schema import Recipe
from recipes.style import Style

if TYPE_CHECKING:
    from augment.style.maps import StyleMaps


@dataclass(frozen=True, eq=False)
class StoredMaps:
    """The maps of a style in one scene, float32 as in StyleMaps; picklable."""

    style: Style
    splats: np.ndarray  # [C, 3, 4]
    sky: np.ndarray  # [3, 4]
    picture: np.ndarray  # [3, 4]
    seen_sky: np.ndarray | None  # [3, 4]

    def take_over(self, scene: Scene) -> None:
        """Make them the maps that pictures of the scene in this style use in this process.

        A scene remembers the last few styles only, so this comes right before their pictures.
        """
        from augment.style.scene_maps import remember_maps

        remember_maps(scene, self.style, self._maps)

    @cached_property
    def _maps(self) -> StyleMaps:
        """Always the same object: what pictures make of it is kept as long as it is."""
        import torch

        from augment.style.maps import StyleMaps

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
    """The maps of all styles in the recipes.

    cameras: all that a camera path has, or None for the scene's: never a selection, so that no
    image depends on what else is rendered.

    Raises:
        StyleError: a style's files cannot be used, or it cannot be had in this scene.
    """
    from augment.style.scene_maps import style_maps

    wanted = {s: None for r in recipes if (s := style_to_apply(r)) is not None}
    stored = []
    for style in wanted:
        maps = style_maps(scene, style, cameras=cameras)
        splats, sky, picture = (m.numpy() for m in (maps.splats, maps.sky, maps.picture))
        seen = None if maps.seen_sky is None else maps.seen_sky.numpy()
        stored.append(StoredMaps(style, splats, sky, picture, seen))
    return tuple(stored)
