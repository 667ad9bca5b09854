"""The recording car in a picture: its paint at night has the light that falls on its roof.

Depth of the car's pixels is that of the ground behind it, or noise. So they get one illuminance,
that of a level surface under the camera, and no fog and no water.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32

from augment.effects.lamps.picture_light import find_reflectance
from augment.lamps.lamp import EGO_OWNER, Lamps
from augment.lamps.surface_light import illuminance
from augment.photo.own_car import own_car_in_view
from augment.scene.cameras import Camera
from augment.scene.scene import Scene

# Distance from the camera to the car's paint, about, metres.
PAINT_M = 1.0


def recording_car_pixels(scene: Scene, camera: Camera) -> Bool[np.ndarray, "H W"] | None:
    """Return the pixels that show the recording car; None where recorded images show none."""
    if not any(camera.name in frame.image_paths for frame in scene.frames):
        return None
    car = own_car_in_view(scene, camera)
    return None if car is None else car.mask


def light_recording_car(
    added: Float32[np.ndarray, "H W 3"],
    pixels: Bool[np.ndarray, "H W"],
    rgb: Float32[np.ndarray, "H W 3"],
    white: float,
    lamps: Lamps,
    camera: Camera,
    *,
    uses_kernels: bool,
) -> None:
    """Add the luminance of the recording car's paint to a picture, in place.

    Args:
        added: luminance in linear sRGB, cd/m2.
        pixels: pixels that show the car.
        rgb: the picture, display-encoded.
        white: linear light of a white surface in it.
        lamps: the lamps; those of the car itself light no paint.
        camera: the view.
        uses_kernels: False for the plain definition.
    """
    foreign_lamps = lamps.select(lamps.owners != EGO_OWNER)
    if len(foreign_lamps) == 0:
        return
    place = camera.centre.numpy()[None] - np.array([[0.0, 0.0, PAINT_M]])
    lux = illuminance(foreign_lamps, place, np.array([[0.0, 0.0, 1.0]]))[0]
    paint = np.ascontiguousarray(rgb[pixels])[None]
    reflectance = find_reflectance(paint, white, None, (0.0, 0.0, 0.0), uses_kernels=uses_kernels)
    added[pixels] += reflectance[0] * ((lux @ foreign_lamps.colors) / np.pi).astype(np.float32)
