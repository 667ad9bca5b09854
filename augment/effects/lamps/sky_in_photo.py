"""The sky of the hour in recorded pictures: it replaces the recorded one by the sky matte."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from augment.effects.effect import RenderedView
from augment.render.composite import apply_color_map
from augment.render.fog_image import sky_image_depth
from augment.scene.cameras import Camera
from augment.scene.sky import sample_at


def replace_photo_sky(
    rgb: Float32[np.ndarray, "H W 3"], view: RenderedView, camera: Camera, color_map: Tensor | None
) -> Float32[np.ndarray, "H W 3"]:
    """Return the picture with the sky of `view.layers` in place of the recorded one.

    A pixel with the share w of sky, as the fog lets it through, loses w times the recorded sky and
    gets w times the new one.

    Args:
        rgb: the picture, display-encoded, after the colour map.
        view: the picture before it, with its layers and buffers.
        camera: the view.
        color_map: the camera's colour map, [3, 4]; None without one.
    """
    photo = view.layers.photo
    fog = view.layers.fog
    alpha = view.raster.alpha
    assert photo is not None and alpha is not None
    weight = (1 - alpha.detach().cpu()).clamp(0, 1)
    if fog is not None:
        if fog.scale_height_m is None:
            return rgb
        directions = camera.ray_directions()
        slope = directions[..., 2] / directions.norm(dim=-1)
        weight = weight * torch.exp(-sky_image_depth(fog, camera, slope))
    rows, columns = torch.nonzero(weight > 0, as_tuple=True)
    if len(rows) == 0:
        return rgb
    recorded = photo.sky_colors(camera, parts_sky=photo.matte is not None).cpu()[rows, columns]
    if color_map is not None:
        recorded = apply_color_map(recorded[None].contiguous(), color_map.cpu())[0]
    new = sample_at(view.layers.sky, camera.ray_directions()[rows, columns])
    share = weight[rows, columns, None]
    picture = torch.from_numpy(rgb.copy())
    old = picture[rows, columns]
    mixed = (old - share * recorded).clamp_min(0) + share * new
    picture[rows, columns] = torch.where(share >= 1, new, mixed)
    return picture.numpy()
