"""Snow on the recording car in a recorded image, for recipes that ask for it.

The scene has no surfaces of the recording car, so that its snow is painted: in the colour that snow
has near the camera in the same picture, uneven as snow is, and thin at the car's edge.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.photo.own_car import OwnCar
from augment.render.buffers import RenderOutput

# Overlay share from which a pixel shows nothing but snow.
_MIN_OVERLAY = 0.95
# Rows from the bottom in which snow near the camera is looked for, a part of the height.
_NEAR_PART = 0.5
# Pixels of snow without which there is no colour, a part of the image.
_MIN_SNOW_PART = 0.002
# Relative unevenness of the snow's brightness, standard deviation.
_UNEVENNESS = 0.03
# Sizes of the unevenness, parts of the image's width.
_GRAIN_PARTS = (0.002, 0.008, 0.02)
# Width of the car's edge on which the snow gets thin, a part of the image's width.
_EDGE_PART = 0.006


def cover_own_car(
    car_rgb: Float[Tensor, "h W 3"],
    own_car: OwnCar,
    raster: RenderOutput,
    *,
    rng: np.random.Generator,
) -> Float[Tensor, "h W 3"]:
    """Return the recording car's colours under the snow that lies on the scene.

    They are unchanged where the view shows hardly any snow.

    Args:
        car_rgb: colours of the car's rows.
        own_car: the recording car in the view.
        raster: buffers of the view; `rgb` holds the colours of what lies on the scene, and
            `overlay` their share.
        rng: random numbers, the same for all images of a camera.
    """
    if raster.overlay is None or raster.rgb is None:
        return car_rgb
    height, width = own_car.mask.shape
    overlay = raster.overlay.detach().cpu().numpy()
    near = slice(round((1 - _NEAR_PART) * height), None)
    is_snow = overlay[near] >= _MIN_OVERLAY
    if is_snow.sum() < _MIN_SNOW_PART * height * width:
        return car_rgb
    colors = raster.rgb.detach().cpu().numpy()[near][is_snow] / overlay[near][is_snow][:, None]
    snow_rgb = np.median(colors, axis=0)
    noise = np.zeros(car_rgb.shape[:2], np.float32)
    for part in _GRAIN_PARTS:
        octave = rng.standard_normal(noise.shape, np.float32)
        octave = cv2.GaussianBlur(octave, (0, 0), max(part * width, 0.5))
        noise += octave / max(float(octave.std()), 1e-6) / np.float32(np.sqrt(len(_GRAIN_PARTS)))
    inside_px = cv2.distanceTransform(own_car.mask[own_car.rows].astype(np.uint8), cv2.DIST_L2, 3)
    cover = np.clip(inside_px / (_EDGE_PART * width) + 0.5 * noise, 0, 1) * (inside_px > 0)
    snow = snow_rgb * (1 + np.float32(_UNEVENNESS) * noise[..., None])
    weight = torch.from_numpy(cover.astype(np.float32)).to(car_rgb.device)[..., None]
    return (1 - weight) * car_rgb + weight * torch.from_numpy(snow.astype(np.float32)).to(car_rgb)
