"""How far flooded pictures are from what they should be, on the procedural street.

Still, opaque water under the mirrored tier against a picture made by mirroring the Gaussians; the
other tiers against the mirrored one; Schlick's formula against Fresnel's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from augment.cameras import Camera
from augment.effects.flood.flood import FresnelModel, ReflectionTier, exact, schlick
from augment.metrics.image import psnr
from augment.plan import make_plan
from augment.scene import Scene
from augment.views import render_buffers
from recipes.schema import Output, Recipe, Weather
from recipes.weather import Flood, Waves
from tools.bench_flood_mirror import mirrored_picture

WAVES = ("still", "calm")
PICTURE_ONLY = Output(depth="none", labels=False)
OPAQUE = (1e6, 1e6, 1e6)
EDGE_PX = 3  # pixels this close to the water's border are left out: they show two surfaces
DARK, LIT = 2 / 255, 8 / 255  # a black pixel, and what it is compared with when it should not be
BLOCK = 32
ANGLES_DEG = (0, 30, 50, 60, 70, 75, 80, 85, 88)
WATER_INDEX = 1.333


@dataclass(frozen=True, eq=False)
class Picture:
    """rgb [H, W, 3] in [0, 1]. water [H, W]: where the view shows it first."""

    rgb: np.ndarray
    water: np.ndarray


def flood_recipe(
    reflection: ReflectionTier = "mirrored",
    waves: str = "still",
    *,
    level_m: float = 0.25,
    opaque: bool = False,
    fresnel: FresnelModel = "exact",
    output: Output | None = None,
) -> Recipe:
    """Water level_m above the median road, the middle one of a drive that may have a slope."""
    flood = Flood(
        level_m=level_m,
        reference="median",
        absorption_per_m=OPAQUE if opaque else None,
        waves=Waves.model_validate({"preset": waves}),
        fresnel=fresnel,
        reflection=reflection,
    )
    return Recipe(weather=Weather(flood=flood), output=output or PICTURE_ONLY)


def draw(scene: Scene, camera: Camera, recipe: Recipe, backend: str = "auto") -> Picture:
    buffers = render_buffers(scene, camera, make_plan(recipe, scene), backend=backend)
    water = buffers.water
    if water is None:
        water = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    return Picture(buffers.rgb.clamp(0, 1).cpu().numpy(), water.cpu().numpy())


def inside(water: np.ndarray, margin_px: int = EDGE_PX) -> np.ndarray:
    """The water's pixels that are at least margin_px from its border; the image's is none."""
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    return cv2.erode(water.astype(np.uint8), kernel, borderValue=1).astype(bool)


def analytic_error(
    scene: Scene, camera: Camera, fresnel: FresnelModel = "exact"
) -> dict[str, float]:
    """The mirrored tier against mirrored Gaussians: still, opaque water."""
    recipe = flood_recipe(opaque=True, fresnel=fresnel)
    picture = draw(scene, camera, recipe)
    truth = mirrored_picture(scene, camera, make_plan(recipe, scene)).clamp(0, 1).numpy()
    mask = inside(picture.water)
    error = np.abs(picture.rgb - truth).max(-1) * 255
    return {
        "water_share": float(picture.water.mean()),
        "psnr_db": psnr(picture.rgb, truth, mask),
        "psnr_with_edges_db": psnr(picture.rgb, truth, picture.water),
        "outside_psnr_db": psnr(picture.rgb, truth, inside(~picture.water)),
        "p999": float(np.quantile(error[mask], 0.999)),
        "largest": float(error[mask].max()),
    }


def tier_error(
    scene: Scene, camera: Camera, reflection: ReflectionTier, waves: str
) -> dict[str, Any]:
    """A tier against the mirrored one under the same waves, inside the water."""
    picture = draw(scene, camera, flood_recipe(reflection, waves))
    truth = draw(scene, camera, flood_recipe("mirrored", waves))
    return compare(picture, truth)


def compare(picture: Picture, truth: Picture) -> dict[str, Any]:
    """psnr_db in the water; black_share of its pixels that are dark and should not be; worst_block:
    mean channel error in 1/255 of the worst square of BLOCK px that is at least half water, and its
    column and row.
    """
    mask = inside(truth.water)
    black = (picture.rgb.max(-1) < DARK) & (truth.rgb.max(-1) >= LIT) & mask
    error = np.abs(picture.rgb - truth.rgb).mean(-1) * 255
    block = worst_block(error, mask)
    return {
        "psnr_db": psnr(picture.rgb, truth.rgb, mask),
        "black_share": float(black.sum() / mask.sum()),
        "p99": float(np.quantile(error[mask], 0.99)),
        "worst_block": block[0],
        "worst_block_at": [block[1], block[2]],
    }


def worst_block(error: np.ndarray, mask: np.ndarray) -> tuple[float, int, int]:
    """Largest mean error of a square that is at least half inside the mask; its column and row."""
    worst = (0.0, 0, 0)
    for row in range(0, error.shape[0], BLOCK):
        for column in range(0, error.shape[1], BLOCK):
            here = np.s_[row : row + BLOCK, column : column + BLOCK]
            if 2 * mask[here].sum() >= BLOCK * BLOCK:
                worst = max(worst, (float(error[here][mask[here]].mean()), column, row))
    return worst


def fresnel_table() -> dict[str, Any]:
    """Reflected shares of water by both models, and where they differ most."""
    degrees = torch.linspace(0, 90, 9001, dtype=torch.float64)
    cosine = torch.cos(torch.deg2rad(degrees))
    difference = (schlick(cosine, WATER_INDEX) - exact(cosine, WATER_INDEX)).abs()
    at = torch.cos(torch.deg2rad(torch.tensor(ANGLES_DEG, dtype=torch.float64)))
    rows = zip(ANGLES_DEG, exact(at, WATER_INDEX), schlick(at, WATER_INDEX), strict=True)

    def largest(low: float, high: float) -> dict[str, float]:
        part = (degrees >= low) & (degrees <= high)
        index = int(difference[part].argmax())
        return {
            "difference": float(difference[part][index]),
            "degrees": float(degrees[part][index]),
        }

    return {
        "index": WATER_INDEX,
        "rows": [{"degrees": d, "exact": float(e), "schlick": float(s)} for d, e, s in rows],
        "below_70": largest(0, 70),
        "at_75": largest(75, 75),
        "80_to_90": largest(80, 90),
    }


def bench_error(scene: Scene, cameras: Sequence[Camera]) -> list[dict[str, Any]]:
    """All errors of every view."""
    views = []
    for camera in cameras:
        tiers = {
            f"{tier}, {waves}": tier_error(scene, camera, tier, waves)
            for tier in ("screen_space", "sky")
            for waves in WAVES
        }
        views.append(
            {
                "view": f"{camera.name} {camera.width}x{camera.height} at {camera.timestamp_ns} ns",
                "analytic": analytic_error(scene, camera),
                "tiers": tiers,
            }
        )
    return views
