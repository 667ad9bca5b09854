"""The Gaussians that a recipe's snow becomes when a picture needs them."""

from __future__ import annotations

from collections import OrderedDict
from weakref import WeakKeyDictionary

from augment.render.backends import AUTO
from augment.scene import Scene
from augment.snow.beds import bed_of
from augment.snow.cells import SnowBed
from augment.snow.cover import SnowCover
from augment.snow.layer import lay_snow
from augment.snow.light import illumination_of
from augment.snow.placed import PlacedSnow
from augment.snow.placement import PlacementSettings
from augment.style.looks import Look
from recipes.snow import Snow

_MOST_COVERS = 2  # of a scene, that are kept: a job goes through its variants frame by frame


def placement_settings(snow: Snow) -> PlacementSettings:
    """What of a recipe's snow decides where it can lie."""
    return PlacementSettings(cell_m=snow.cell_m, max_slope_deg=snow.max_slope_deg)


def cover_of(
    scene: Scene, placed: PlacedSnow, look: Look | None = None, *, backend: str = AUTO
) -> SnowCover:
    """The snow in the scene; remembered for as long as the scene lives and no third is asked for.

    look: the style that the scene wears; the snow lies in the light that it shows.

    The first call finds where snow can lie, unless a bed is remembered (augment.snow.beds), by
    `backend` (augment.snow.placement).

    Raises:
        SceneError: snow cannot be placed in this scene, or not with cells this small.
    """
    covers = _covers.setdefault(scene, OrderedDict())
    bed = bed_of(scene, placement_settings(placed.snow), backend=backend)
    laid_on, cover = covers.get((placed, look), (None, None))
    if cover is None or laid_on is not bed:
        cover = lay_snow(
            bed,
            scene,
            placed.snow,
            illumination_of(scene if look is None else look.witness, placed.snow),
            seed=placed.seed,
            water_level_z_m=placed.water_level_z_m,
        )
        covers[placed, look] = (bed, cover)
    covers.move_to_end((placed, look))
    while len(covers) > _MOST_COVERS:
        covers.popitem(last=False)
    return cover


_Covers = OrderedDict[tuple[PlacedSnow, Look | None], tuple[SnowBed, SnowCover]]
_covers: WeakKeyDictionary[Scene, _Covers] = WeakKeyDictionary()
