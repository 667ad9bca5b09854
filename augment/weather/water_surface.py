"""Where a camera's rays meet the water, and how the surface is tilted there.

All vectors are in world axes and all points relative to the eye, which keeps float32 exact enough
kilometres away from the world's origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.weather.waves import WaveField

FARTHEST = 1e12  # times the eye's distance from the image plane: rays along the water end here
LEAST_COSINE = 1e-3  # of rays against the surface, and of reflected ones against the horizon
SMOOTH_PX = 2.0  # reflections that a pixel's slopes spread over less are as good as sharp
STEEPEST = 1e-6  # least square of a normal's z


@dataclass(frozen=True, eq=False)
class Surface:
    """What the pixels of a camera see of a plane `height_m` below the eye.

    meets: the ray goes down; where it does not, the rest is made up but finite.
    directions: rays with unit z in the camera. points: where they meet the plane. distance: from
    the eye to there, metres. to_eye: unit.
    """

    height_m: float
    meets: Bool[Tensor, "H W"]
    directions: Float[Tensor, "H W 3"]
    points: Float[Tensor, "H W 3"]
    distance: Float[Tensor, "H W"]
    to_eye: Float[Tensor, "H W 3"]


def meet_plane(camera: Camera, level_z_m: float, dtype: torch.dtype) -> Surface:
    """The horizontal plane at level_z_m, below the eye, as the camera's rays meet it."""
    exact = camera.ray_directions(torch.float64)
    meets = exact[..., 2] < 0
    straight_down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    directions = torch.where(meets[..., None], exact, straight_down)
    height = float(camera.centre[2]) - level_z_m
    along = (height / -directions[..., 2]).clamp(max=FARTHEST)
    points = along[..., None] * directions
    points[..., 2] = -height
    length = directions.norm(dim=-1)
    return Surface(
        height,
        meets,
        directions.to(dtype),
        points.to(dtype),
        (along * length).to(dtype),
        (-directions / length[..., None]).to(dtype),
    )


def is_smooth(field: WaveField, camera: Camera) -> Bool[Tensor, "H W"]:
    """Where the slopes inside a pixel of `camera` hardly blur what it mirrors."""
    return field.slope_variance < smooth_variance(camera)


def smooth_variance(camera: Camera) -> float:
    """The slope variance V that spreads a reflection by 2 sqrt(3 V) fy = SMOOTH_PX pixels.

    A slope turns the mirrored ray by twice its angle; sqrt(3 V) is what `tilted_normals` takes.
    """
    return (SMOOTH_PX / (2 * camera.fy)) ** 2 / 3


def tilted_normals(
    surface: Surface, field: WaveField, smooth: Bool[Tensor, "H W"]
) -> list[tuple[Tensor, Tensor]]:
    """(weight [H, W], unit normal [H, W, 3]) of slopes that stand for all slopes in a pixel.

    Gauss-Hermite quadrature over the slope along the view's horizontal direction, whose variance is
    V: the pixel's own normal has weight 2/3, slopes sqrt(3 V) to either side have 1/6 each. The
    first is the pixel's own, and the only one that counts where the pixel is smooth.
    """
    dtype = surface.points.dtype
    nx, ny = field.normal_x.to(dtype), field.normal_y.to(dtype)
    variance = field.slope_variance.to(dtype)
    nz = torch.sqrt((1 - nx * nx - ny * ny).clamp_min(STEEPEST))
    horizontal = surface.to_eye[..., :2]
    # Seen straight from above the view has no horizontal direction: nothing is tilted then.
    horizontal = horizontal / horizontal.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    rough = ~smooth
    spread = torch.where(rough, torch.sqrt(3 * variance), 0)

    def normal(offset: Tensor) -> Tensor:
        slope = torch.stack((nx / nz, ny / nz), -1) + offset[..., None] * horizontal
        upright = torch.cat((slope, torch.ones_like(offset)[..., None]), -1)
        return torch.nn.functional.normalize(upright, dim=-1)

    if not bool(rough.any()):
        return [(torch.ones_like(spread), normal(spread))]
    side = torch.where(rough, torch.full_like(spread, 1 / 6), 0)
    return [
        (torch.where(rough, torch.full_like(spread, 2 / 3), 1), normal(0 * spread)),
        (side, normal(spread)),
        (side, normal(-spread)),
    ]


def mirrored(to_eye: Float[Tensor, "H W 3"], normal: Tensor) -> Float[Tensor, "H W 3"]:
    """Unit directions in which the surface mirrors the view, none below the horizon."""
    cosine = (normal * to_eye).sum(-1, keepdim=True)
    ray = 2 * cosine * normal - to_eye
    return _at_least_upward(ray)


def refracted(
    to_eye: Float[Tensor, "H W 3"], normal: Tensor, index: float
) -> Float[Tensor, "H W 3"]:
    """Unit directions of the view under the surface by Snell's law, all of them downward.

    t = -v / n + (c / n - sqrt(1 - (1 - c^2) / n^2)) normal
    """
    c = (normal * to_eye).sum(-1, keepdim=True).clamp_min(LEAST_COSINE)
    inside = torch.sqrt((1 - (1 - c * c) / index**2).clamp_min(0))
    return -_at_least_upward(to_eye / index - (c / index - inside) * normal)


def _at_least_upward(ray: Tensor) -> Tensor:
    upward = ray[..., 2:].clamp_min(LEAST_COSINE)
    return torch.nn.functional.normalize(torch.cat((ray[..., :2], upward), -1), dim=-1)
