"""A scene in a style, as pictures need it: mapped parts and sky, and what lights the snow."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

from jaxtyping import Float, Int16
from torch import Tensor

from augment.render.backends import AUTO, CUDA
from augment.scene import PosedGaussians, Scene
from augment.sky import Sky
from augment.style.apply import style_gaussians, style_sky
from augment.style.maps import StyleMaps
from augment.style.scene_maps import style_maps
from augment.style.sky_splats import level_maps, map_rows, sky_levels
from recipes.style import Style

_MOST_LOOKS = 4  # of a scene, that are kept: a job goes through its variants frame by frame


@dataclass(frozen=True, eq=False)
class Look:
    """The maps of a style in a scene, and the scene's sky under them. levels [N]: how much of each
    background splat is sky; None where none is any.

    folds: the background's SH are mapped once and kept, as much memory as they take themselves (of
    the GPU where that draws), in place of the colours that they evaluate to, which a map does not
    commute with where the clamp to >= 0 acts (augment.style.apply). Actors' colours are mapped
    either way: their SH are turned and changed from frame to frame, and they are few.
    """

    maps: StyleMaps
    sky: Sky
    bare: Scene
    levels: Int16[Tensor, "N"] | None = None
    folds: bool = False

    def on(
        self, parts: Sequence[PosedGaussians], *, backend: str = AUTO
    ) -> tuple[PosedGaussians, ...]:
        """The parts under the maps; snow among them keeps its colours. backend: that draws them."""
        return tuple(part if part.is_snow else self._mapped(part, backend) for part in parts)

    @cached_property
    def witness(self) -> Scene:
        """A scene of the styled background's mean colours and sky, to read the light from."""
        flat = dataclasses.replace(self.bare.background, sh=self.bare.background.sh[:, :1])
        flat = style_gaussians(flat, self.maps, levels=self.levels)
        return dataclasses.replace(self.bare, background=flat, sky=self.sky)

    def _mapped(self, part: PosedGaussians, backend: str) -> PosedGaussians:
        if self.folds and part.gaussians.sh is self.bare.background.sh:
            sh = self._folded_on_gpu if backend == CUDA else self._folded
            return dataclasses.replace(part, gaussians=dataclasses.replace(part.gaussians, sh=sh))
        if self.levels is None or part.instance_id > 0:
            return dataclasses.replace(part, color_maps=self.maps.splats)
        return dataclasses.replace(part, color_maps=self._level_maps, color_rows=self._rows)

    @cached_property
    def _folded(self) -> Float[Tensor, "N K 3"]:
        return style_gaussians(self.bare.background, self.maps, levels=self.levels).sh

    @cached_property
    def _folded_on_gpu(self) -> Float[Tensor, "N K 3"]:
        background = self.bare.background
        return style_gaussians(background, self.maps, levels=self.levels, backend=CUDA).sh

    @cached_property
    def _level_maps(self) -> Float[Tensor, "R 3 4"]:
        return level_maps(self.maps)

    @cached_property
    def _rows(self) -> Int16[Tensor, "N"]:
        assert self.levels is not None
        return map_rows(self.levels, self.bare.background.semantic, len(self.maps.splats))


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
        sky, levels = style_sky(scene.sky, maps.sky), sky_levels(scene, maps)
        look = looks[style] = Look(maps, sky, bare, levels, folds=style.evaluated == "sh")
    looks.move_to_end(style)
    while len(looks) > _MOST_LOOKS:
        looks.popitem(last=False)
    return look


_looks: WeakKeyDictionary[Scene, OrderedDict[Style, Look]] = WeakKeyDictionary()
