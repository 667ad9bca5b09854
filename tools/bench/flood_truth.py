"""Pictures and masks of water by other means, and the errors of a flood against them.

Still, opaque water under the mirrored tier is compared with a picture that does not use the flood's
mirror: here the Gaussians themselves are mirrored. Other tiers are compared with the mirrored tier.
The true mask of water is known on the procedural street by casting rays.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from adapters.procedural import StreetTruth
from augment.effects.flood.water_plane import plane_depth
from augment.metrics.image import psnr
from augment.render.buffers import ALPHA, RGB
from augment.render.layout import ABOVE, BELOW, HeightClip
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.view.plan import make_plan
from recipes.schema import Recipe
from tools.bench.scenes import WATER, frame_of, recipe_of

OPAQUE = {"absorption_per_m": (1e6, 1e6, 1e6)}  # The fields of water that light does not pass.
# The distance from the water's border, pixels, within which a pixel shows two surfaces. Splats
# extend as far over an edge.
EDGE_PX = 3
DARK = 2 / 255  # The largest channel of a black pixel.
LIT = 8 / 255  # The least channel of the true pixel where a black pixel is an error.
BLOCK = 32  # The side of the squares of which the worst is reported, pixels.
# The mirror in the plane z = 0, [4, 4].
MIRROR = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64))


def flood_fields(reflection: str, waves: str = "still", **other_fields: Any) -> dict[str, Any]:
    """Return the fields of a flood. other_fields: further fields of it."""
    return {**WATER, "reflection": reflection, "waves": {"preset": waves}, **other_fields}


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture, and its mask of water."""

    rgb: np.ndarray
    """[H, W, 3], in [0, 1]."""
    water: np.ndarray
    """[H, W], bool. True where the view shows water first."""


def draw_picture(scene: Scene, camera: Camera, recipe: Recipe) -> Picture:
    """Draw a view and its mask of water."""
    buffers = frame_of(scene, camera, recipe)()
    none = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    water = buffers.masks.get("water", none)
    return Picture(buffers.rgb.clamp(0, 1).numpy(), water.numpy())


def inside(water: np.ndarray) -> np.ndarray:
    """Return the mask without pixels within EDGE_PX of its border; the image's edge is none."""
    kernel = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    return cv2.erode(water.astype(np.uint8), kernel, borderValue=1).astype(bool)


def analytic_error(scene: Scene, camera: Camera) -> dict[str, Any]:
    """Compare the mirrored tier at full resolution with mirrored Gaussians.

    The water is still and opaque.
    """
    fields = flood_fields("mirrored", **OPAQUE)
    recipe = recipe_of({"flood": fields, "render": {"speed": {"layers_px": 1}}})
    picture = draw_picture(scene, camera, recipe)
    truth = mirrored_picture(scene, camera, recipe).clamp(0, 1).numpy()
    return {
        **water_error(picture, Picture(truth, picture.water)),
        "water_share": float(picture.water.mean()),
        "psnr_with_edges_db": psnr(picture.rgb, truth, picture.water),
        "outside_psnr_db": psnr(picture.rgb, truth, inside(~picture.water)),
    }


def tier_error(scene: Scene, camera: Camera, reflection: str, waves: str) -> dict[str, Any]:
    """Compare a tier with the mirrored tier under the same waves, inside the water."""
    tiers = (flood_fields(tier, waves) for tier in (reflection, "mirrored"))
    return water_error(*(draw_picture(scene, camera, recipe_of({"flood": t})) for t in tiers))


def water_error(picture: Picture, truth: Picture) -> dict[str, Any]:
    """Return the errors of a picture inside the water of the true one.

    Returns:
        psnr_db: PSNR in the water.
        black_share: the share of its pixels that are dark and should not be.
        worst_block: mean channel error, 1/255, of the worst square of BLOCK px that is at least
            half water.
    """
    mask = inside(truth.water)
    black = (picture.rgb.max(-1) < DARK) & (truth.rgb.max(-1) >= LIT) & mask
    error = np.abs(picture.rgb - truth.rgb).mean(-1) * 255
    corners = itertools.product(range(0, mask.shape[0], BLOCK), range(0, mask.shape[1], BLOCK))
    blocks = [np.s_[row : row + BLOCK, column : column + BLOCK] for row, column in corners]
    watery_blocks = [block for block in blocks if 2 * mask[block].sum() >= BLOCK * BLOCK]
    block_errors = [float(error[block][mask[block]].mean()) for block in watery_blocks]
    return {
        "psnr_db": psnr(picture.rgb, truth.rgb, mask),
        "black_share": float(black.sum() / mask.sum()),
        "worst_block": max(block_errors, default=0.0),
    }


def mirror_gaussians(gaussians: Gaussians) -> Gaussians:
    """Mirror Gaussians in the plane z = 0 of their frame.

    With M = diag(1, 1, -1) the axes R become M R M, a rotation again, since an ellipsoid does not
    change when one of its axes is turned round; its axis vector is -M v. The colour seen along d
    was that along M d: the function of band l and order m has the parity (-1)^(l + m) in z.
    """
    bands = range(gaussians.sh_degree + 1)
    parity = [(-1.0) ** (band + order) for band in bands for order in range(-band, band + 1)]
    return dataclasses.replace(
        gaussians,
        means=gaussians.means * gaussians.means.new_tensor([1.0, 1.0, -1.0]),
        quats=gaussians.quats * gaussians.quats.new_tensor([1.0, -1.0, -1.0, 1.0]),
        sh=gaussians.sh * gaussians.sh.new_tensor(parity)[:, None],
    )


def mirror_parts(parts: Sequence[PosedGaussians], level_z_m: float) -> list[PosedGaussians]:
    """Mirror parts in the plane z = level_z_m of the world.

    A mirrored pose alone is no rigid motion. So it is mirrored once more in the part's frame, and
    so are the part's Gaussians.
    """
    plane = MIRROR.clone()
    identity = torch.eye(4, dtype=torch.float64)
    plane[2, 3] = 2 * level_z_m
    poses = [identity if p.world_from_part is None else p.world_from_part for p in parts]
    return [
        PosedGaussians(mirror_gaussians(part.gaussians), plane @ pose @ MIRROR, part.instance_id)
        for part, pose in zip(parts, poses, strict=True)
    ]


def mirrored_picture(scene: Scene, camera: Camera, recipe: Recipe) -> Float[Tensor, "H W 3"]:
    """Draw the flooded view of an eye above still, opaque water, without clamping colours."""
    plan = make_plan(recipe, scene)
    medium = plan.effect_plans["flood"].data
    assert medium.waves.is_flat

    def layer(parts: Sequence[PosedGaussians], clip: HeightClip) -> tuple[Tensor, Tensor]:
        """Draw premultiplied rgb [H, W, 3] and alpha [H, W, 1], float64."""
        buffers = frozenset({RGB, ALPHA})
        out = rasterize(parts, camera, buffers=buffers, settings=plan.settings, clip=clip)
        return out.rgb.double(), out.alpha.double()[..., None]

    parts = scene.parts_for(camera)
    level_z_m = medium.level_z_m
    front, alpha_above = layer(parts, HeightClip(level_z_m, ABOVE))
    rgb, alpha = layer(
        mirror_parts(parts, level_z_m), HeightClip(level_z_m, BELOW, has_overlap=True)
    )
    rays = camera.ray_directions(torch.float64)
    mirrored_sky = scene.sky.sample((rays * MIRROR.diagonal()[:3]).float()).double()
    reflected = rgb + (1 - alpha) * mirrored_sky
    cosine = (-rays[..., 2] / rays.norm(dim=-1)).clamp(0, 1).numpy()
    share = torch.from_numpy(fresnel_by_angles(cosine, medium.refraction_index))[..., None]
    water = share * reflected + (1 - share) * torch.tensor(medium.rgb, dtype=torch.float64)
    behind = torch.where(rays[..., 2:] < 0, water, scene.sky.sample(rays.float()).double())
    return (front + (1 - alpha_above) * behind).float()


def fresnel_by_angles(cosine: np.ndarray, index: float) -> np.ndarray:
    """Return the reflected share of unpolarised light from air, by Fresnel's sines and tangents.

    With i the angle of incidence and t that of refraction:
    Rs = (sin(i - t) / sin(i + t))^2 and Rp = (tan(i - t) / tan(i + t))^2, sin i = index sin t.

    Args:
        cosine: Cosine of the angle of incidence, any shape.
        index: Index of refraction, above 1.
    """
    incident = np.arccos(np.clip(cosine, 0, 1))
    refracted = np.arcsin(np.sin(incident) / index)
    # Both quotients are 0 / 0 at normal incidence. Their limit is right to 1e-8 here.
    is_normal = incident < 1e-4
    incident = np.where(is_normal, math.pi / 4, incident)
    angle_difference = incident - refracted
    angle_sum = incident + refracted
    share = 0.5 * (
        (np.sin(angle_difference) / np.sin(angle_sum)) ** 2
        + (np.tan(angle_difference) / np.tan(angle_sum)) ** 2
    )
    return np.where(is_normal, ((index - 1) / (index + 1)) ** 2, share)


def water_masks(
    scene: Scene, truth: StreetTruth, frames: Sequence[int], *, scale: float
) -> list[list[str | float]]:
    """Compare masks of water with the true ones, view by view.

    Splats extend a little beyond silhouettes, so pixels away from silhouettes also count by
    themselves.

    Returns:
        Rows of the view, the share of its pixels with the true mask, the same share away from
        silhouettes, and the share of pixels that are away from silhouettes.
    """
    rows: list[list[str | float]] = []
    recipe = recipe_of({"flood": flood_fields("sky")})
    level_z_m = make_plan(recipe, scene).water_level_z_m
    for camera in (c.scaled(scale) for n in frames for c in scene.frame(n).cameras.values()):
        depth = plane_depth(camera, level_z_m).numpy()
        true = np.isfinite(depth) & (truth.render(camera).depth > depth)
        same = draw_picture(scene, camera, recipe).water == true
        clear = inside(true) | inside(~true)
        shares = (same.mean(), same[clear].mean(), clear.mean())
        rows.append([f"{camera.name} at {camera.timestamp_ns} ns", *map(float, shares)])
    return rows
