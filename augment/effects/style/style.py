"""A scene in a style: mapped parts and sky, and the scene that lights the snow."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int16
from pydantic import ValidationError, field_validator
from torch import Tensor

from augment.base_photo import PhotoStyle
from augment.cameras import Camera
from augment.effects.style.color_maps import (
    LEVELS,
    StyleMaps,
    level_maps,
    map_rows,
    sky_levels,
    style_gaussians,
    style_sky,
)
from augment.effects.style.content import (
    PICTURE_SIZE,
    content_key,
    content_pictures,
    content_statistics,
)
from augment.effects.style.images import StyleImage, image_statistics, read_style_image
from augment.effects.style.statistics import (
    LAND,
    LAND_LIMITS,
    SKY,
    WHOLE,
    ColorStatistics,
    Statistics,
    closed_maps,
)
from augment.errors import StyleError
from augment.memo import memo_of, size_of
from augment.render.buffers import AUTO, CUDA
from augment.scene import PosedGaussians, Scene
from augment.sky import Sky
from recipes.errors import RecipeError
from recipes.fields import ClosedModel, Number, Unit
from recipes.style import Style, style_preset_text
from recipes.template import readable
from recipes.yaml_tree import read_plain

if TYPE_CHECKING:
    from augment.effects.style.network import Gscm


def style_maps(scene: Scene, style: Style, *, cameras: Sequence[Camera] | None = None) -> StyleMaps:
    """The maps that give the scene the style's colours, float32; identities at strength 0.

    style: image, mask and checkpoint are paths that can be opened as they are. cameras: those that
    the scene will be seen by; None for all of its own. They are kept in the scene's memo,
    with what their files held when first read; maps shared there come first.

    Raises:
        StyleError: an image, a preset or a checkpoint cannot be used.
    """
    if not style.has_effect:
        return StyleMaps(torch.eye(3, 4)[None], torch.eye(3, 4), torch.eye(3, 4))
    memo = memo_of(scene)

    def compute() -> StyleMaps:
        key = ("style maps of cameras", style, content_key(scene, cameras))
        return memo.get(key, lambda: _find_maps(scene, style, cameras))

    shared = ("style maps", style)
    return memo.get(shared, compute) if memo.has(shared) else compute()


def _find_maps(scene: Scene, style: Style, cameras: Sequence[Camera] | None) -> StyleMaps:
    if style.method == "gscm":
        color_map = _network_map(scene, style, cameras)
        return StyleMaps(color_map[None], color_map, color_map)
    preset = style.preset
    return closed_maps(
        content_statistics(scene, cameras, per_region=style.per_region),
        image_statistics(_style_image(style)) if preset is None else preset_statistics(preset),
        method=style.method,
        strength=style.strength,
        per_region=style.per_region,
    )


def _style_image(style: Style) -> StyleImage:
    assert style.image is not None
    mask = None if style.mask is None else Path(style.mask)
    return read_style_image(Path(style.image), mask)


def _network_map(
    scene: Scene, style: Style, cameras: Sequence[Camera] | None
) -> Float[Tensor, "3 4"]:
    from augment.effects.style.network import compose, style_side

    picture = _style_picture(_style_image(style))
    net = _network(style.checkpoint, _stamp(style.checkpoint))
    content = content_pictures(scene, cameras)
    color_map = compose(style_side(net, picture), _content_side(scene, net, content)).double()
    if not bool(torch.isfinite(color_map).all()):
        raise StyleError(
            f"the network gives no finite map for style image {style.image}: {color_map.tolist()}; "
            f"use another checkpoint, or method mkl"
        )
    mean = content.double().mean((0, 2, 3))
    full = _limited(color_map, mean)
    # The identity at strength 0, the map at 1, straight between and beyond.
    return _limited(torch.lerp(torch.eye(3, 4).double(), full, style.strength), mean).float()


def _content_side(
    scene: Scene, net: Gscm, content: Float[Tensor, "B 3 256 256"]
) -> Float[Tensor, "3 4"]:
    """The scene's half of its maps, remembered with the pictures and the network it is of."""
    from augment.effects.style.network import content_side

    key = ("content side", net, content)
    return memo_of(scene).get(key, lambda: content_side(net, content))


@functools.lru_cache(maxsize=2)
def _network(path: str | None, _stamp: tuple[int, int]) -> Gscm:
    """The network of a file, read once for all styles for as long as the file stays as it is."""
    from augment.effects.style.network import load_network

    return load_network(None if path is None else Path(path))


def _stamp(path: str | None) -> tuple[int, int]:
    """Return a stamp that changes with a file; (0, 0) without a file, which reading reports."""
    if path is None or not Path(path).is_file():
        return (0, 0)
    status = Path(path).stat()
    return (status.st_mtime_ns, status.st_size)


def _style_picture(image: StyleImage) -> Float[Tensor, "1 3 256 256"]:
    """The style image squeezed to a square; what does not count has the others' mean colour."""
    # By NumPy and OpenCV: on pictures this small torch's threads cost more than they give.
    weights = image.weights[..., None]
    mean = np.average(image.rgb.reshape(-1, 3), axis=0, weights=image.weights.reshape(-1))
    filled = image.rgb * weights + mean.astype(np.float32) * (1 - weights)
    square = cv2.resize(filled, (PICTURE_SIZE, PICTURE_SIZE), interpolation=cv2.INTER_AREA)
    square = np.clip(square, 0, 1).transpose(2, 0, 1)[None]
    return torch.from_numpy(np.ascontiguousarray(square))


def _limited(color_map: Float[Tensor, "3 4"], mean: Float[Tensor, "3"]) -> Float[Tensor, "3 4"]:
    """The map with no gain above that of the closed forms; the mean colour goes where it went."""
    matrix = color_map[:, :3]
    offset = color_map[:, 3]
    u, gains, v = torch.linalg.svd(matrix)
    if float(gains.max()) <= LAND_LIMITS.max_gain:
        return color_map
    limited_matrix = u @ torch.diag(gains.clamp(max=LAND_LIMITS.max_gain)) @ v
    return torch.cat([limited_matrix, (offset + (matrix - limited_matrix) @ mean)[:, None]], 1)


# ---- Styles that come with the package: colour statistics of a mood, in place of an image --------

# Of a street's picture; they only matter where a map of the whole stands in for land and sky.
SHARES: Mapping[str, float] = {LAND: 0.75, SKY: 0.25}
_Triple = tuple[Number, Number, Number]


class _Moments(ClosedModel):
    mean: tuple[Unit, Unit, Unit]
    covariance: tuple[_Triple, _Triple, _Triple]

    @field_validator("covariance")
    @classmethod
    def _check(cls, rows: tuple[_Triple, ...]) -> tuple[_Triple, ...]:
        matrix = np.array(rows)
        if not np.array_equal(matrix, matrix.T):
            raise ValueError(f"must be symmetric; got {matrix.tolist()}")
        least = float(np.linalg.eigvalsh(matrix)[0])
        if least < -1e-9:
            raise ValueError(f"must have no variance below zero; got {least:g} in a direction")
        return rows


class _Preset(ClosedModel):
    land: _Moments
    sky: _Moments


def preset_statistics(name: str) -> Statistics:
    """Return the statistics of LAND and SKY, and of WHOLE, which combines SHARES of both.

    Raises:
        StyleError: there is no style of that name, or its file is not as it should be.
    """
    try:
        return parse_statistics(style_preset_text(name), source=f"style {name}")
    except RecipeError as error:
        raise StyleError(str(error)) from None


def parse_statistics(text: str, *, source: str) -> Statistics:
    """The statistics in a preset's YAML: mean and covariance (display-encoded) of land and of sky.

    Raises:
        StyleError: it is not as it should be; says where.
    """
    try:
        preset = _Preset.model_validate(read_plain(text, source=source))
    except RecipeError as error:
        raise StyleError(str(error)) from None
    except ValidationError as error:
        raise StyleError(f"{source}: {'; '.join(readable(error))}") from None
    regions: dict[str, ColorStatistics] = {}
    for region, share in SHARES.items():
        moments: _Moments = getattr(preset, region)
        mean = np.array(moments.mean)
        covariance = np.array(moments.covariance)
        regions[region] = ColorStatistics(mean, covariance, share)
    return {WHOLE: together(tuple(regions.values())), **regions}


def together(parts: tuple[ColorStatistics, ...]) -> ColorStatistics:
    """The statistics of disjoint parts as one, each by its share."""
    share = sum(part.share for part in parts)
    mean = np.zeros(3)
    second = np.zeros((3, 3))
    for part in parts:
        mean += part.share / share * part.mean
    for part in parts:
        off = part.mean - mean
        second += part.share / share * (part.covariance + np.outer(off, off))
    return ColorStatistics(mean, second, share)


@dataclass(frozen=True, eq=False)
class SceneStyle:
    """The maps of a style in a scene, and the scene's sky under them. levels [N]: how much of each
    background splat is sky; None where none is any.

    folds: the background's SH are mapped once and kept (on the GPU where that draws), in place of
    the colours that they evaluate to, which a map does not commute with where the clamp to >= 0
    acts (augment.effects.style.color_maps). Actors' colours are mapped either way: their SH change
    from frame to frame.
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
        return tuple(part if part.is_overlay else self._mapped(part, backend) for part in parts)

    @cached_property
    def on_photo(self) -> PhotoStyle:
        """The maps for a photo of the scene."""
        splats = self.maps.splats
        levels = None
        rows = None
        marks = None
        others = [m for m in torch.unique(splats, dim=0) if not torch.equal(m, splats[0])]
        if self.levels is not None:
            levels = torch.nn.functional.pad(self.levels.float() / LEVELS, (1, 1))
            rows = map_rows(self.levels, self.bare.background.semantic, len(splats))
        if len(others) < 3 and (others or levels is not None):
            steps = 1 if levels is None else LEVELS + 1
            marks = torch.zeros(steps, len(splats), 3, 4)
            marks[:, :, 0, 3] = torch.arange(steps)[:, None] / LEVELS
            for number, other in enumerate(others):
                marks[:, :, 1 + number, 3] = (splats == other).flatten(1).all(1).float()
            marks = marks.flatten(0, 1)
        return PhotoStyle(
            splats, self.maps.sky, levels, torch.stack(others) if others else None, marks, rows
        )

    @property
    def own_bytes(self) -> int:
        """What it keeps beside the scene: levels, the sky, and the SH that it folds."""
        folded = self.bare.background.sh if self.folds else None
        return size_of((self.levels, self.sky, folded))

    @cached_property
    def lighting_scene(self) -> Scene:
        """A scene of the styled background's mean colours and sky, to read the light from."""
        flat = dataclasses.replace(self.bare.background, sh=self.bare.background.sh[:, :1])
        flat = style_gaussians(flat, self.maps, levels=self.levels)
        return dataclasses.replace(self.bare, background=flat, sky=self.sky)

    def _mapped(self, part: PosedGaussians, backend: str) -> PosedGaussians:
        if self.folds and part.gaussians.sh is self.bare.background.sh:
            own = part.gaussians
            sh = self._folded_on_gpu if backend == CUDA else self._folded
            folded = memo_of(own).get(  # one object, of which levels of detail are made once
                ("folded", id(sh)), lambda: dataclasses.replace(own, sh=sh)
            )
            return dataclasses.replace(part, gaussians=folded)
        if self.levels is None or part.instance_id > 0:
            return dataclasses.replace(part, color_maps=self.maps.splats)
        maps, rows = self._level_maps
        return dataclasses.replace(part, color_maps=maps, color_rows=rows)

    def _fold(self, backend: str) -> Float[Tensor, "N K 3"]:
        background = self.bare.background
        return style_gaussians(background, self.maps, levels=self.levels, backend=backend).sh

    @cached_property
    def _folded(self) -> Float[Tensor, "N K 3"]:
        return self._fold(AUTO)

    @cached_property
    def _folded_on_gpu(self) -> Float[Tensor, "N K 3"]:
        return self._fold(CUDA)

    @cached_property
    def _level_maps(self) -> tuple[Tensor, Tensor]:
        """The maps at every level, and each background splat's row of them."""
        assert self.levels is not None
        rows = map_rows(self.levels, self.bare.background.semantic, len(self.maps.splats))
        return level_maps(self.maps), rows


def scene_style_of(scene: Scene, style: Style) -> SceneStyle:
    """The style in the scene.

    Raises:
        StyleError: the style cannot be read.
    """
    maps = style_maps(scene, style)

    def find() -> SceneStyle:
        # The scene itself would be kept alive by what is remembered for as long as it lives.
        bare = dataclasses.replace(scene)
        sky = style_sky(scene.sky, maps.sky)
        levels = sky_levels(scene, maps)
        return SceneStyle(maps, sky, bare, levels, folds=style.evaluated == "sh")

    return memo_of(scene).get(("scene style", style, maps), find)
