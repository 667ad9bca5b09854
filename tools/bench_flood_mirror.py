"""A flooded picture made without the flood's own mirror: the Gaussians themselves are mirrored.

Below the plane stands a second scene, upside down. Seen from the same camera it is what still water
reflects, so neither a mirrored camera nor any fetch from its picture is involved.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.plan import Plan
from augment.render.buffers import ALPHA, RGB, RenderOutput
from augment.render.layout import ABOVE, BELOW, HeightClip
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians, Scene

MIRROR = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64))


def mirror_gaussians(gaussians: Gaussians) -> Gaussians:
    """The Gaussians mirrored in their frame's plane z = 0.

    With M = diag(1, 1, -1) the axes R become M R M, a rotation again, since an ellipsoid does not
    change when one of its axes is turned round; its axis vector is -M v. The colour seen along d
    was that along M d: the function of band l and order m has the parity (-1)^(l + m) in z.
    """
    turned = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=gaussians.quats.dtype)
    flipped = torch.tensor([1.0, 1.0, -1.0], dtype=gaussians.means.dtype)
    parity = [
        (-1.0) ** (band + order)
        for band in range(gaussians.sh_degree + 1)
        for order in range(-band, band + 1)
    ]
    return dataclasses.replace(
        gaussians,
        means=gaussians.means * flipped,
        quats=gaussians.quats * turned,
        sh=gaussians.sh * torch.tensor(parity, dtype=gaussians.sh.dtype)[:, None],
    )


def mirror_parts(parts: Sequence[PosedGaussians], level_z_m: float) -> list[PosedGaussians]:
    """The parts mirrored in the plane z = level_z_m of the world.

    A mirrored pose would be no rigid motion. Mirrored once more in the part's own frame it is one.
    """
    plane = MIRROR.clone()
    plane[2, 3] = 2 * level_z_m
    identity = torch.eye(4, dtype=torch.float64)
    return [
        PosedGaussians(
            mirror_gaussians(part.gaussians),
            plane @ (identity if part.world_from_part is None else part.world_from_part) @ MIRROR,
            part.instance_id,
        )
        for part in parts
    ]


def mirrored_picture(scene: Scene, camera: Camera, plan: Plan) -> Float[Tensor, "H W 3"]:
    """The flooded view if the water is still and opaque, and there is no smog, not clamped.

    Raises:
        ValueError: the plan has no flood, waves, or smog; or the eye is not above the water.
    """
    medium = plan.flood
    if medium is None or not medium.waves.is_flat or plan.smog is not None:
        raise ValueError("the mirrored picture is of still water without smog")
    if float(camera.centre[2]) <= medium.level_z_m:
        raise ValueError(f"camera {camera.name!r} is not above the water")
    parts = scene.parts_for(camera)
    front_rgb, cover = _layer(parts, camera, plan, HeightClip(medium.level_z_m, ABOVE))
    below = mirror_parts(parts, medium.level_z_m)
    rgb, alpha = _layer(below, camera, plan, HeightClip(medium.level_z_m, BELOW, overlaps=True))
    rays = camera.ray_directions(torch.float64)
    falls = rays[..., 2] < 0
    upward = (rays * MIRROR.diagonal()[:3]).float()
    reflected = rgb + (1 - alpha) * scene.sky.sample(upward).double()
    cosine = (-rays[..., 2] / rays.norm(dim=-1)).clamp(0, 1).numpy()
    share = torch.from_numpy(fresnel_by_angles(cosine, medium.refraction_index))[..., None]
    water = share * reflected + (1 - share) * torch.tensor(medium.rgb, dtype=torch.float64)
    sky = scene.sky.sample(rays.float()).double()
    behind = torch.where(falls[..., None], water, sky)
    return (front_rgb + (1 - cover) * behind).float()


def _layer(
    parts: Sequence[PosedGaussians], camera: Camera, plan: Plan, clip: HeightClip
) -> tuple[Tensor, Tensor]:
    """Premultiplied rgb [H, W, 3] and alpha [H, W, 1], float64."""
    out: RenderOutput = rasterize(
        parts, camera, buffers=frozenset({RGB, ALPHA}), settings=plan.settings, clip=clip
    )
    assert out.rgb is not None and out.alpha is not None
    return out.rgb.double(), out.alpha.double()[..., None]


def fresnel_by_angles(cosine: np.ndarray, index: float) -> np.ndarray:
    """Fresnel's laws of sines and tangents, from air into an index > 1; unpolarised.

    Rs = (sin(i - t) / sin(i + t))^2 and Rp = (tan(i - t) / tan(i + t))^2, sin i = index sin t.
    """
    incident = np.arccos(np.clip(cosine, 0, 1))
    refracted = np.arcsin(np.sin(incident) / index)
    steep = incident < 1e-4  # both quotients are 0 / 0 at 0; the limit is right to 1e-8 here
    incident = np.where(steep, math.pi / 4, incident)
    less, more = incident - refracted, incident + refracted
    share = 0.5 * ((np.sin(less) / np.sin(more)) ** 2 + (np.tan(less) / np.tan(more)) ** 2)
    return np.where(steep, ((index - 1) / (index + 1)) ** 2, share)
