"""Light by the normal of every pixel of a splat: each splat is drawn as a small dome.

ClimateGS, "Snow Simulation", with the factor put back that the printed equation lacks. In camera
axes, d leads from a splat's centre to a pixel, within the plane through the centre that is parallel
to the image; n1 = (0, 0, -1) leads back to the camera, and n2 is the normal at the centre. Then

    d' = d - (d . n2) / (n1 . n2) n1        d, moved along the optical axis into the plane across n2
    n  = D d'/|d'| + sqrt(1 - D^2) n2

D is the Mahalanobis distance of the pixel from the centre, divided by the distance at which alpha
falls to 1/255. Without the division it would exceed 1 over most of the footprint. The light is
wrapped around the dome (Green 2004, "Real-time approximations to subsurface scattering"):

    share = clamp((n . L + wrap) / (1 + wrap), 0, 1)        colour = base + slopes share

The paper takes n2 towards the camera, so that a surface's mean brightness depends on the viewpoint.
Here n2 is the splat's own z axis, turned to the camera's side.

A lit splat takes LINES numbers (with a = n2 / -n2.z, and all but the slopes over 1 + wrap)

    n2 . L    gx    gy    wrap    ax / fx    ay / fy    slopes (3)

where d' . L = gx x + gy y and |d'|^2 = (x/fx)^2 + (y/fy)^2 + (ax/fx x + ay/fy y)^2 in pixels x, y
from the mean. The depth scales all of d' and does not change their ratio.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from augment.scene.cameras import Camera

# Numbers of a lit splat.
LINES = 9
# Smallest n1 . n2: splats seen edge-on are treated as if they were tilted this far.
MIN_FACING = 0.05
# Added to |d'|^2, which is 0 at a splat's centre; at pixels it is 1e-9 and more.
TINY = 1e-20


def shading_lines(
    normals: Float[Tensor, "M 3"],
    view_directions: Float[Tensor, "M 3"],
    slopes: Float[Tensor, "M 3"],
    sun: Float[Tensor, "3"],
    wrap: float,
    camera: Camera,
) -> Float[Tensor, "M 9"]:
    """Return the shading numbers of splats, as the module's docstring lists them.

    Args:
        normals: unit normals, camera axes.
        view_directions: vectors from the eye to the splats, camera axes, of any length.
        slopes: change of the colour with the share of the light.
        sun: unit vector towards the light, camera axes.
        wrap: wrap of the light around the dome.
        camera: the camera.
    """
    is_back = (normals * view_directions).sum(1, keepdim=True) > 0
    normals = torch.where(is_back, -normals, normals)
    ax, ay = (normals[:, :2] / (-normals[:, 2:]).clamp_min(MIN_FACING)).unbind(1)
    ones = torch.ones_like(ax)
    light_lines = torch.stack(
        [
            normals @ sun,
            (sun[0] + sun[2] * ax) / camera.fx,
            (sun[1] + sun[2] * ay) / camera.fy,
            wrap * ones,
        ],
        1,
    ) / (1 + wrap)
    return torch.cat([light_lines, torch.stack([ax / camera.fx, ay / camera.fy], 1), slopes], 1)


def light_share(
    lines: Float[Tensor, "S 9"],
    dx: Float[Tensor, "S P"],
    dy: Float[Tensor, "S P"],
    rim_share: Float[Tensor, "S P"],
    camera: Camera,
) -> Float[Tensor, "S P"]:
    """Return the share of the light at every pixel.

    Args:
        lines: shading numbers of the splats.
        dx: columns from the splats' means, pixels.
        dy: rows from the splats' means, pixels.
        rim_share: D^2 of the module's equation, 0 to 1.
        camera: the camera.
    """
    facing, gx, gy, wrap, ax, ay = lines[:, :6].T[..., None]
    distance_squared = (dx / camera.fx) ** 2 + (dy / camera.fy) ** 2 + (ax * dx + ay * dy) ** 2
    tilt = torch.sqrt(rim_share / (distance_squared + TINY)) * (gx * dx + gy * dy)
    return (tilt + torch.sqrt(1 - rim_share) * facing + wrap).clamp(0, 1)
