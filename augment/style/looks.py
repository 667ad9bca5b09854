"""A scene in a style, as pictures need it: mapped parts and sky, and what lights the snow."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

from augment.scene import PosedGaussians, Scene
from augment.sky import Sky
from augment.style.apply import style_gaussians, style_sky
from augment.style.maps import StyleMaps
from augment.style.scene_maps import style_maps
from recipes.style import Style

_MOST_LOOKS = 4  # of a scene, that are kept: a job goes through its variants frame by frame


@dataclass(frozen=True, eq=False)
class Look:
    """The maps of a style in a scene, and the scene's sky under them."""

    maps: StyleMaps
    sky: Sky
    bare: Scene

    def on(self, parts: Sequence[PosedGaussians]) -> tuple[PosedGaussians, ...]:
        """The parts under the maps; snow among them keeps its colours."""
        return tuple(
            part if part.is_snow else dataclasses.replace(part, color_maps=self.maps.splats)
            for part in parts
        )

    @cached_property
    def witness(self) -> Scene:
        """A scene of the styled background's mean colours and sky, to read the light from."""
        flat = dataclasses.replace(self.bare.background, sh=self.bare.background.sh[:, :1])
        return dataclasses.replace(
            self.bare, background=style_gaussians(flat, self.maps), sky=self.sky
        )


def look_of(scene: Scene, style: Style) -> Look:
    """The style in the scene; remembered for as long as the scene lives and few others are asked
    for.

    Raises:
        StyleError: the style cannot be read.
    """
    looks = _looks.setdefault(scene, OrderedDict())
    maps = style_maps(scene, style)
    look = looks.get(style)
    if look is None or look.maps is not maps:
        # The scene itself would be kept alive by what is remembered for as long as it lives.
        bare = dataclasses.replace(scene)
        look = looks[style] = Look(maps, style_sky(scene.sky, maps.sky), bare)
    looks.move_to_end(style)
    while len(looks) > _MOST_LOOKS:
        looks.popitem(last=False)
    return look


_looks: WeakKeyDictionary[Scene, OrderedDict[Style, Look]] = WeakKeyDictionary()
