"""Gloss of a clear day: the blue of the sky that panes, paint and leaves mirror, and its greying.

In: a scene whose sky is blue. Out: its `SkyGloss`, the share of mirrored sky in a colour
(`mirror_share`), and parts of the scene whose splats mirror a grey sky (`GreyedGloss`).
`augment.photo.greyed_photo` does the same to the pixels of a recorded image.

A glossy surface shows c = b + a S: its body b, and the sky's colour S by the Fresnel reflectance a.
White light keeps its colour when it is mirrored, so c lies between b and S: for a neutral body it
has the hue of the sky, and at most its saturation. Blue paint is more saturated, or of another hue.
With Y the luminance of c, and g the colour of grey things in the same light, the greyed colour is

    c' = (1 - w) c + w Y(c) g          w = fade mirror_share(c)

A colour alone does not tell pale blue paint from a mirror of the sky.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32, Int16
from torch import Tensor

from augment.light.srgb import LUMINANCE_WEIGHTS
from augment.memo import memo_of
from augment.render.sh import SH_C0
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import is_unknown_sky

# Classes that mirror no sky, or whose blue is as likely their own.
MATTE_CLASSES = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
    SemanticClass.SIGN,
    SemanticClass.TWO_WHEELER,
    SemanticClass.PEDESTRIAN,
    SemanticClass.SKY,
    SemanticClass.WATER,
    SemanticClass.SNOW,
)
# Classes that are grey, and show the colour of the light.
GREY_CLASSES = (SemanticClass.ROAD, SemanticClass.SIDEWALK)
# Least number of splats or pixels of those classes.
MIN_GREY_COUNT = 100
# Largest difference of a channel of grey things from their green channel, as a share of it.
MAX_TINT = 0.15
# Saturation of a sky from which on it is blue.
MIN_SKY_SATURATION = 0.1
# Share of the sky's directions, the most saturated ones, that S is the mean of.
BLUE_SHARE = 0.2
# Saturations between which a colour begins to be the sky's. Greys of one image differ by less.
SATURATION_START = (0.03, 0.10)
# Saturations over that of the sky between which a colour ends to be the sky's.
SATURATION_END = (1.0, 1.35)
# Differences of hue, (G - R) / (B - R), between which a colour ends to be the sky's.
HUE_END = (0.4, 0.7)
# Largest channel of dark colours, whose saturation is noise.
MIN_CHANNEL = 0.08
# Rows and columns of directions in which the sky is sampled, over its upper half.
SKY_GRID = (24, 96)
# Steps of the share by which splats are greyed.
NUM_STEPS = 16


@dataclass(frozen=True)
class SkyGloss:
    """Colours of a clear sky and of grey things under it, display-encoded."""

    sky_rgb: tuple[float, float, float]
    """Mean colour of the sky where it is bluest."""
    grey_rgb: tuple[float, float, float]
    """Colour of grey things, of green 1."""

    @property
    def saturation(self) -> float:
        """Return the saturation of the sky beside grey things."""
        return float(_saturation_and_hue(self.relative(np.array(self.sky_rgb)))[0])

    @property
    def hue(self) -> float:
        """Return the hue of the sky beside grey things, (G - R) / (B - R)."""
        return float(_saturation_and_hue(self.relative(np.array(self.sky_rgb)))[1])

    @property
    def is_blue(self) -> bool:
        """Return True if things that mirror this sky are bluer than others."""
        return self.saturation >= MIN_SKY_SATURATION

    def relative(self, rgb: np.ndarray) -> np.ndarray:
        """Return colours [*, 3] over those of grey things."""
        return rgb.astype(np.float32) / np.array(self.grey_rgb, np.float32)


def find_sky_gloss(scene: Scene) -> SkyGloss | None:
    """Return what the scene's glossy surfaces mirror; None where its sky is not blue.

    It is found once for each scene object.
    """
    scene = scene.as_recorded
    return memo_of(scene).get(("sky gloss",), lambda: (_find_sky_gloss(scene),))[0]


def _find_sky_gloss(scene: Scene) -> SkyGloss | None:
    """Find the bluest part of the sky, and the colour of the road."""
    g = scene.background
    if g.semantic is None or is_unknown_sky(scene.sky):
        return None
    is_grey = np.isin(g.semantic.numpy(), GREY_CLASSES)
    gloss = SkyGloss(_mean_sky(scene), grey_of(_base_colors(g)[is_grey]))
    return gloss if gloss.is_blue else None


def _mean_sky(scene: Scene) -> tuple[float, float, float]:
    """Return the mean colour of the bluest part of the upper half of a scene's sky."""
    rows, columns = SKY_GRID
    sines = (torch.arange(rows) + 0.5) / rows  # equal steps of height are equal solid angles
    azimuths = (torch.arange(columns) + 0.5) * (2 * torch.pi / columns)
    cosines = torch.sqrt(1 - sines * sines)[:, None]
    x = cosines * torch.cos(azimuths)
    y = cosines * torch.sin(azimuths)
    directions = torch.stack([x, y, sines[:, None].expand_as(x)], -1).reshape(-1, 3)
    rgb = np.clip(np.nan_to_num(scene.sky.sample(directions).numpy()), 0, 1)
    saturation, _ = _saturation_and_hue(rgb)
    bluest = rgb[saturation >= np.quantile(saturation, 1 - BLUE_SHARE)].mean(0)
    return float(bluest[0]), float(bluest[1]), float(bluest[2])


def grey_of(rgb: Float32[np.ndarray, "M 3"]) -> tuple[float, float, float]:
    """Return the median colour of grey things, of green 1; white where they are too few.

    Args:
        rgb: their colours, display-encoded.
    """
    if len(rgb) < MIN_GREY_COUNT:
        return (1.0, 1.0, 1.0)
    red, green, blue = np.median(rgb, axis=0)
    ratios = np.array([red, blue]) / max(float(green), 1e-3)
    red, blue = np.clip(ratios, 1 - MAX_TINT, 1 + MAX_TINT)
    return float(red), 1.0, float(blue)


def mirror_share(rgb: Float32[np.ndarray, "*B 3"], gloss: SkyGloss) -> Float32[np.ndarray, "*B"]:
    """Return how surely colours are of the mirrored sky, 0 to 1.

    Args:
        rgb: the colours, display-encoded.
        gloss: colours of the sky and of grey things.
    """
    saturation, hue = _saturation_and_hue(gloss.relative(rgb))
    low, high = (gloss.saturation * factor for factor in SATURATION_END)
    share = _ramp(saturation, *SATURATION_START) * (1 - _ramp(saturation, low, high))
    share = share * (1 - _ramp(np.asarray(np.abs(hue - gloss.hue)), *HUE_END))
    return np.asarray(share, np.float32)


def _saturation_and_hue(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (B - R) / max and (G - R) / (B - R) of colours [*, 3]; the hue is 0 without blue."""
    red, green, blue = (rgb[..., channel] for channel in range(3))
    blue_excess = blue - red
    # Reducing an axis of three channels would take ten times as long.
    largest = np.maximum(np.maximum(red, green), blue)
    saturation = blue_excess / np.maximum(largest, MIN_CHANNEL)
    hue = (green - red) / np.maximum(blue_excess, 1e-3)
    return np.asarray(saturation), np.where(blue_excess > 1e-3, hue, 0)


def _ramp(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return 0 below low, 1 above high, and a straight line between."""
    return np.asarray(np.clip((values - low) / (high - low), 0, 1))


# ---- Splats --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class GreyedGloss:
    """Splats that mirror a grey sky in place of a blue one."""

    gloss: SkyGloss
    """Colours of the scene's sky and of grey things."""
    fade: float
    """How much of the mirrored blue goes, 0 to 1."""

    def apply_to(self, part: PosedGaussians) -> PosedGaussians:
        """Return the background or an actor with its gloss greyed, before any maps that it has.

        A part without gloss is returned as it is.
        """
        rows = self._rows_of(part.gaussians)
        if rows is None:
            return part
        maps = self._maps()
        if part.color_maps is None:
            return replace(part, color_maps=maps, color_rows=rows)
        outer_maps = part.color_maps.to(maps)
        outer_rows = part.color_map_rows
        combined = outer_maps[:, None, :, :3] @ maps[None, :, :, :3]
        offsets = outer_maps[:, None, :, 3:].expand(-1, len(maps), -1, -1)
        combined_maps = torch.cat([combined, offsets], -1).flatten(0, 1)
        if outer_rows is None:
            return replace(part, color_maps=combined_maps, color_rows=rows)
        is_row = (outer_rows >= 0) & (outer_rows < len(outer_maps))
        all_rows = torch.where(is_row, outer_rows, 0).to(torch.int32) * len(maps) + rows
        if len(combined_maps) > torch.iinfo(torch.int16).max:
            used_rows, all_rows = torch.unique(all_rows, return_inverse=True)
            combined_maps = combined_maps[used_rows]
        return replace(part, color_maps=combined_maps, color_rows=all_rows.to(torch.int16))

    def _rows_of(self, g: Gaussians) -> Int16[Tensor, "N"] | None:
        """Return the row of the maps for each splat; None where no splat is glossy."""

        def find() -> tuple[Tensor | None]:
            if g.semantic is None:
                return (None,)
            share = mirror_share(_base_colors(g), self.gloss)
            share[np.isin(g.semantic.numpy(), MATTE_CLASSES)] = 0
            steps = np.rint(share * NUM_STEPS).astype(np.int16)
            return (torch.from_numpy(steps) if steps.any() else None,)

        return memo_of(g).get(("rows of sky gloss", self.gloss), find)[0]

    def _maps(self) -> Float[Tensor, "K 3 4"]:
        """Return the colour maps, [NUM_STEPS + 1, 3, 4]; the first changes nothing."""
        shares = torch.linspace(0, self.fade, NUM_STEPS + 1)[:, None, None]
        grey = torch.tensor(self.gloss.grey_rgb)
        weights = torch.tensor(grey_weights(self.gloss.grey_rgb), dtype=torch.float32)
        maps = torch.zeros(NUM_STEPS + 1, 3, 4)
        maps[:, :, :3] = (1 - shares) * torch.eye(3) + shares * grey[:, None] * weights
        return maps


def grey_weights(grey_rgb: Sequence[float]) -> tuple[float, ...]:
    """Return the weights of red, green and blue in Y, by which grey things keep their colour."""
    total = sum(w * c for w, c in zip(LUMINANCE_WEIGHTS, grey_rgb, strict=True))
    return tuple(w / total for w in LUMINANCE_WEIGHTS)


def _base_colors(g: Gaussians) -> Float32[np.ndarray, "N 3"]:
    """Return the colours of splats from all sides, display-encoded and clamped to 0 to 1."""
    rgb = 0.5 + SH_C0 * np.nan_to_num(g.sh[:, 0].float().numpy())
    return np.clip(rgb, 0, 1)
