"""A style in a scene: its colour maps, the mapped parts and sky, and the scene that lights snow.

A scene and the recipe section `style` come in. `style_maps` gives the maps and `scene_style_of` a
`SceneStyle`, which `augment.effects.style.effect` applies to every image.
"""

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

from augment.effects.style.color_maps import (
    MAX_SKY_LEVEL,
    StyleMaps,
    level_maps,
    map_rows,
    sky_levels,
    style_gaussians,
    style_sky,
)
from augment.effects.style.content import (
    PICTURE_SIZE_PX,
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
from augment.photo.recorded_base import PhotoStyle
from augment.render.buffers import AUTO, CUDA
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians, Scene
from augment.scene.sky import Sky
from recipes.errors import RecipeError
from recipes.fields import ClosedModel, Number, Unit
from recipes.style import Style, style_preset_text
from recipes.template import readable
from recipes.yaml_tree import read_plain

if TYPE_CHECKING:
    from augment.effects.style.network import Gscm


def style_maps(scene: Scene, style: Style, *, cameras: Sequence[Camera] | None = None) -> StyleMaps:
    """Return the maps that give the scene the style's colours, float32; identities at strength 0.

    The maps are kept in the scene's memo, from the files as they were when first read. Maps that
    another process shared there have priority.

    Args:
        scene: the unstyled scene.
        style: the style. Its image, mask and checkpoint are paths that can be opened as they are.
        cameras: the cameras that the scene will be seen by; None for all of its own.

    Raises:
        StyleError: an image, a preset or a checkpoint cannot be used.
    """
    if not style.has_effect:
        return StyleMaps(torch.eye(3, 4)[None], torch.eye(3, 4), torch.eye(3, 4))
    memo = memo_of(scene)

    def compute_maps() -> StyleMaps:
        key = ("style maps of cameras", style, content_key(scene, cameras))
        return memo.get(key, lambda: _find_maps(scene, style, cameras))

    shared_key = ("style maps", style)
    return memo.get(shared_key, compute_maps) if memo.has(shared_key) else compute_maps()


def _find_maps(scene: Scene, style: Style, cameras: Sequence[Camera] | None) -> StyleMaps:
    """Compute the maps of a style at a strength above 0."""
    if style.method == "gscm":
        color_map = _network_map(scene, style, cameras)
        return StyleMaps(color_map[None], color_map, color_map)
    preset_name = style.preset
    return closed_maps(
        content_statistics(scene, cameras, per_region=style.per_region),
        image_statistics(_style_image(style))
        if preset_name is None
        else preset_statistics(preset_name),
        method=style.method,
        strength=style.strength,
        per_region=style.per_region,
    )


def _style_image(style: Style) -> StyleImage:
    """Read the style image and its sky mask, if there is one."""
    assert style.image is not None
    mask = None if style.mask is None else Path(style.mask)
    return read_style_image(Path(style.image), mask)


def _network_map(
    scene: Scene, style: Style, cameras: Sequence[Camera] | None
) -> Float[Tensor, "3 4"]:
    """Return the network's map, with limited gain, at the style's strength."""
    from augment.effects.style.network import compose, style_side

    style_picture = _style_picture(_style_image(style))
    network = _network(style.checkpoint, _file_stamp(style.checkpoint))
    content_images = content_pictures(scene, cameras)
    color_map = compose(
        style_side(network, style_picture), _content_side(scene, network, content_images)
    ).double()
    if not bool(torch.isfinite(color_map).all()):
        raise StyleError(
            f"the network gives no finite map for style image {style.image}: {color_map.tolist()}; "
            f"use another checkpoint, or method mkl"
        )
    mean = content_images.double().mean((0, 2, 3))
    limited_map = _limit_gain(color_map, mean)
    # The identity at strength 0, the map at 1, straight between and beyond.
    return _limit_gain(
        torch.lerp(torch.eye(3, 4).double(), limited_map, style.strength), mean
    ).float()


def _content_side(
    scene: Scene, net: Gscm, content: Float[Tensor, "B 3 256 256"]
) -> Float[Tensor, "3 4"]:
    """Return the content stage's map of the scene, kept in its memo per network and pictures."""
    from augment.effects.style.network import content_side

    key = ("content side", net, content)
    return memo_of(scene).get(key, lambda: content_side(net, content))


@functools.lru_cache(maxsize=2)
def _network(path: str | None, _version: tuple[int, int]) -> Gscm:
    """Return the network of a file, which is read once as long as the file does not change."""
    from augment.effects.style.network import load_network

    return load_network(None if path is None else Path(path))


def _file_stamp(path: str | None) -> tuple[int, int]:
    """Return time (ns) and size of a file; (0, 0) without a file, which `load_network` reports."""
    if path is None or not Path(path).is_file():
        return (0, 0)
    status = Path(path).stat()
    return (status.st_mtime_ns, status.st_size)


def _style_picture(image: StyleImage) -> Float[Tensor, "1 3 256 256"]:
    """Return the style image, squeezed to a square; transparent pixels get the mean colour."""
    # NumPy and OpenCV are used here: on small pictures torch's threads cost more than they give.
    weights = image.weights[..., None]
    mean = np.average(image.rgb.reshape(-1, 3), axis=0, weights=image.weights.reshape(-1))
    opaque_rgb = image.rgb * weights + mean.astype(np.float32) * (1 - weights)
    square = cv2.resize(
        opaque_rgb, (PICTURE_SIZE_PX, PICTURE_SIZE_PX), interpolation=cv2.INTER_AREA
    )
    square = np.clip(square, 0, 1).transpose(2, 0, 1)[None]
    return torch.from_numpy(np.ascontiguousarray(square))


def _limit_gain(color_map: Float[Tensor, "3 4"], mean: Float[Tensor, "3"]) -> Float[Tensor, "3 4"]:
    """Return the map with its gains limited as in the closed forms; the mean colour is mapped
    to the same colour as before.
    """
    matrix = color_map[:, :3]
    offset = color_map[:, 3]
    u, gains, v = torch.linalg.svd(matrix)
    if float(gains.max()) <= LAND_LIMITS.max_gain:
        return color_map
    limited_matrix = u @ torch.diag(gains.clamp(max=LAND_LIMITS.max_gain)) @ v
    return torch.cat([limited_matrix, (offset + (matrix - limited_matrix) @ mean)[:, None]], 1)


# ---- Styles that come with the package: colour statistics of a mood, in place of an image --------

# Shares of the regions of a street's picture. They only matter where a map of the whole picture
# replaces those of land and sky.
REGION_SHARES: Mapping[str, float] = {LAND: 0.75, SKY: 0.25}
# Row of a covariance in a preset.
_Triple = tuple[Number, Number, Number]


class _PresetMoments(ClosedModel):
    """Colour moments of one region in a preset, display-encoded."""

    mean: tuple[Unit, Unit, Unit]
    """Mean colour."""

    covariance: tuple[_Triple, _Triple, _Triple]
    """Covariance of the colours."""

    @field_validator("covariance")
    @classmethod
    def _check_covariance(cls, rows: tuple[_Triple, ...]) -> tuple[_Triple, ...]:
        """Check that a covariance is symmetric and positive semidefinite."""
        matrix = np.array(rows)
        if not np.array_equal(matrix, matrix.T):
            raise ValueError(f"must be symmetric; got {matrix.tolist()}")
        min_variance = float(np.linalg.eigvalsh(matrix)[0])
        if min_variance < -1e-9:
            raise ValueError(
                f"must have no variance below zero; got {min_variance:g} in a direction"
            )
        return rows


class _Preset(ClosedModel):
    """Content of a preset's file."""

    land: _PresetMoments
    """Moments of everything except the sky."""

    sky: _PresetMoments
    """Moments of the sky."""


def preset_statistics(name: str) -> Statistics:
    """Return the statistics of LAND and SKY, and of WHOLE, which combines both by REGION_SHARES.

    Raises:
        StyleError: there is no preset of that name, or its file is not valid.
    """
    try:
        return parse_statistics(style_preset_text(name), source=f"style {name}")
    except RecipeError as error:
        raise StyleError(str(error)) from None


def parse_statistics(text: str, *, source: str) -> Statistics:
    """Return the statistics in a preset's YAML: mean and covariance of land and of sky.

    Args:
        text: the YAML text; its colours are display-encoded.
        source: name of the text in error messages.

    Raises:
        StyleError: the text is not valid; the message says where.
    """
    try:
        preset = _Preset.model_validate(read_plain(text, source=source))
    except RecipeError as error:
        raise StyleError(str(error)) from None
    except ValidationError as error:
        raise StyleError(f"{source}: {'; '.join(readable(error))}") from None
    regions: dict[str, ColorStatistics] = {}
    for region, share in REGION_SHARES.items():
        moments: _PresetMoments = getattr(preset, region)
        mean = np.array(moments.mean)
        covariance = np.array(moments.covariance)
        regions[region] = ColorStatistics(mean, covariance, share)
    return {WHOLE: combine_regions(tuple(regions.values())), **regions}


def combine_regions(regions: tuple[ColorStatistics, ...]) -> ColorStatistics:
    """Return the statistics of disjoint regions together, weighted by their shares."""
    share = sum(region.share for region in regions)
    mean = np.zeros(3)
    covariance = np.zeros((3, 3))
    for region in regions:
        mean += region.share / share * region.mean
    for region in regions:
        mean_offset = region.mean - mean
        covariance += (
            region.share / share * (region.covariance + np.outer(mean_offset, mean_offset))
        )
    return ColorStatistics(mean, covariance, share)


@dataclass(frozen=True, eq=False)
class SceneStyle:
    """A style in a scene: its maps and the mapped sky."""

    maps: StyleMaps
    """Maps of the style."""

    sky: Sky
    """The scene's sky under its map."""

    unstyled_scene: Scene
    """The scene without the style."""

    levels: Int16[Tensor, "N"] | None = None
    """Sky levels of the background splats (see `sky_levels`); None if no splat is sky."""

    folds_sh: bool = False
    """If True, the background's SH are mapped once and kept, on the GPU if it draws. If False, the
    colours that the SH evaluate to are mapped. The two differ where the clamp to >= 0 acts, because
    a map does not commute with it (see augment.effects.style.color_maps). Colours of actors are
    always mapped after evaluation, because their SH change from frame to frame.
    """

    def map_parts(
        self, parts: Sequence[PosedGaussians], *, backend: str = AUTO
    ) -> tuple[PosedGaussians, ...]:
        """Return the parts under the maps; overlays such as snow keep their colours.

        Args:
            parts: parts of the scene that a camera draws.
            backend: backend that draws them.
        """
        return tuple(part if part.is_overlay else self._map_part(part, backend) for part in parts)

    @cached_property
    def photo_style(self) -> PhotoStyle:
        """Style of recorded photos of the scene."""
        splats = self.maps.splats
        level_shares = None
        map_row_of_splat = None
        indicator_maps = None
        other_maps = [
            color_map
            for color_map in torch.unique(splats, dim=0)
            if not torch.equal(color_map, splats[0])
        ]
        if self.levels is not None:
            level_shares = torch.nn.functional.pad(self.levels.float() / MAX_SKY_LEVEL, (1, 1))
            map_row_of_splat = map_rows(
                self.levels, self.unstyled_scene.background.semantic, len(splats)
            )
        if len(other_maps) < 3 and (other_maps or level_shares is not None):
            num_levels = 1 if level_shares is None else MAX_SKY_LEVEL + 1
            indicator_maps = torch.zeros(num_levels, len(splats), 3, 4)
            indicator_maps[:, :, 0, 3] = torch.arange(num_levels)[:, None] / MAX_SKY_LEVEL
            for map_index, other_map in enumerate(other_maps):
                indicator_maps[:, :, 1 + map_index, 3] = (
                    (splats == other_map).flatten(1).all(1).float()
                )
            indicator_maps = indicator_maps.flatten(0, 1)
        return PhotoStyle(
            splats,
            self.maps.sky,
            level_shares,
            torch.stack(other_maps) if other_maps else None,
            indicator_maps,
            map_row_of_splat,
        )

    @property
    def own_bytes(self) -> int:
        """Size in bytes of the levels, the sky and the folded SH, which the scene does not hold."""
        folded_sh = self.unstyled_scene.background.sh if self.folds_sh else None
        return size_of((self.levels, self.sky, folded_sh))

    @cached_property
    def lighting_scene(self) -> Scene:
        """Scene of the styled background's mean colours and sky, from which light is taken."""
        flat_background = dataclasses.replace(
            self.unstyled_scene.background, sh=self.unstyled_scene.background.sh[:, :1]
        )
        flat_background = style_gaussians(flat_background, self.maps, levels=self.levels)
        return dataclasses.replace(self.unstyled_scene, background=flat_background, sky=self.sky)

    def _map_part(self, part: PosedGaussians, backend: str) -> PosedGaussians:
        """Return a part of the scene with mapped colours."""
        if self.folds_sh and part.gaussians.sh is self.unstyled_scene.background.sh:
            unfolded = part.gaussians
            sh = self._gpu_sh if backend == CUDA else self._cpu_sh
            # One object, whose levels of detail are made once.
            folded_gaussians = memo_of(unfolded).get(
                ("folded", id(sh)), lambda: dataclasses.replace(unfolded, sh=sh)
            )
            return dataclasses.replace(part, gaussians=folded_gaussians)
        if self.levels is None or part.instance_id > 0:
            return dataclasses.replace(part, color_maps=self.maps.splats)
        maps, rows = self._level_maps
        return dataclasses.replace(part, color_maps=maps, color_rows=rows)

    def _fold_sh(self, backend: str) -> Float[Tensor, "N K 3"]:
        """Return the mapped SH of the background."""
        background = self.unstyled_scene.background
        return style_gaussians(background, self.maps, levels=self.levels, backend=backend).sh

    @cached_property
    def _cpu_sh(self) -> Float[Tensor, "N K 3"]:
        return self._fold_sh(AUTO)

    @cached_property
    def _gpu_sh(self) -> Float[Tensor, "N K 3"]:
        return self._fold_sh(CUDA)

    @cached_property
    def _level_maps(self) -> tuple[Tensor, Tensor]:
        """Maps at every sky level, and the row among them of each background splat."""
        assert self.levels is not None
        rows = map_rows(self.levels, self.unstyled_scene.background.semantic, len(self.maps.splats))
        return level_maps(self.maps), rows


def scene_style_of(scene: Scene, style: Style) -> SceneStyle:
    """Return the style in the scene, kept in the scene's memo.

    Raises:
        StyleError: the style cannot be read.
    """
    scene = scene.as_recorded
    maps = style_maps(scene, style)

    def make_style() -> SceneStyle:
        # A copy, because a memo entry that holds the scene itself would keep it alive.
        unstyled_scene = dataclasses.replace(scene)
        sky = style_sky(scene.sky, maps.sky)
        levels = sky_levels(scene, maps)
        return SceneStyle(maps, sky, unstyled_scene, levels, folds_sh=style.evaluated == "sh")

    return memo_of(scene).get(("scene style", style, maps), make_style)
