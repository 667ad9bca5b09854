"""Airlight mixed in linear light: fog's light is added to that of things, as air adds it.

The rasterisers blend fog and things display-encoded, like splats. There a finished pixel is

    p = t c + (1 - t) a

with the colour c of the thing, the airlight a and the transmittance t = exp(-tau), all
display-encoded but t. Light adds up linearly, and a display-encoded colour is about the square root
of its light (as in `augment.effects.falling`). So the pixel that a camera records is

    p' = sqrt(t c^2 + (1 - t) a^2)

Koschmieder's contrast is one of luminance, too. Dark things pale much sooner: at t = 0.7 a black
car has a third of the airlight's encoded colour by p, and more than half by p'. Colours beyond what
t allows occur at silhouettes, where a pixel shows two distances. Where p < (1 - t) a, p' falls to
zero in proportion to p; where c > 1, the excess is added as it is. So p' is continuous in p and t.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.render import picture_kernels
from augment.render.buffers import AUTO, CPU, choose_kernels
from augment.render.composite import ROWS_PER_CHUNK, airlight_gains, unit_depth_coordinates
from augment.render.fog import Fog, airlight_gain
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Smallest transmittance that is divided by; things behind so much fog have no colour left.
MIN_TRANSMITTANCE = 1e-4


def mix_linear_light(
    rgb: Float[Tensor, "H W 3"],
    fog_share: Float[Tensor, "H W"],
    camera: Camera,
    fog: Fog,
    *,
    backend: str = AUTO,
) -> Float[Tensor, "H W 3"]:
    """Return a picture in fog whose airlight is mixed in linear light.

    Args:
        rgb: the picture p in fog that was mixed display-encoded; on the CPU it is overwritten.
        fog_share: 1 - t of each pixel (`augment.render.scatter.scattered_share`).
        camera: camera of the picture.
        fog: the fog.
        backend: on the CPU, pixels go through a kernel, equal to this definition within 1e-4.
    """
    varying_rgb = fog.airlight_rgb if fog.varying_airlight_rgb is None else fog.varying_airlight_rgb
    if choose_kernels(backend, rgb, fog_share) == CPU:
        picture = rgb.detach().contiguous().numpy()
        with kernel_threads(ROWS_PER_CHUNK):
            picture_kernels.mix_linear_light(
                picture.reshape(len(picture), -1),
                fog_share.contiguous().numpy(),
                *unit_depth_coordinates(camera),
                camera.world_from_camera[2, :3].numpy().astype(np.float32),
                airlight_gains(fog.elevation_gain),
                np.array(fog.airlight_rgb, np.float32),
                np.array(varying_rgb, np.float32),
                np.float32(MIN_TRANSMITTANCE),
            )
        return torch.from_numpy(picture)
    airlight = torch.tensor(fog.airlight_rgb, dtype=rgb.dtype, device=rgb.device)
    if fog.elevation_gain > 0:
        rays = camera.ray_directions(rgb.dtype, rgb.device)
        airlight = airlight + airlight_gain(fog, rays[..., 2] / rays.norm(dim=-1))
    airlight = airlight.clamp_min(0)
    share = fog_share[..., None].to(rgb.dtype)
    transmittance = 1 - share
    of_things = rgb - share * airlight  # t c
    within = torch.minimum(of_things.clamp_min(0), transmittance)
    light = within**2 / transmittance.clamp_min(MIN_TRANSMITTANCE) + share * airlight**2
    mixed = light.sqrt() + (of_things - within)
    darker = rgb.clamp_max(0) + rgb.clamp_min(0) / share.clamp_min(MIN_TRANSMITTANCE).sqrt()
    return torch.where(of_things < 0, darker, mixed)
