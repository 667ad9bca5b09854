"""What scenes show, how near that is to recorded images, and whether two scenes are one."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch

from augment.render.rasterize import rasterize


def render(scene, camera) -> np.ndarray:
    out = rasterize(scene.parts_for(camera), camera)
    sky = scene.sky.sample(camera.ray_directions())
    return (out.rgb + (1 - out.alpha)[..., None] * sky).clamp(0, 1).numpy()


def psnr(image: np.ndarray, recorded: np.ndarray) -> float:
    return -10 * math.log10(np.mean((image - recorded) ** 2))


def psnr_of(scene, frame: int, camera: str) -> float:
    """Of the scene against its own recorded image."""
    recorded = cv2.imread(scene.frame(frame).image_paths[camera])[..., ::-1] / 255
    return psnr(render(scene, scene.frame(frame).cameras[camera]), recorded)


def assert_same_bits(scene, again) -> None:
    pairs = [(scene.background, again.background)]
    pairs += [(a.gaussians, b.gaussians) for a, b in zip(scene.actors, again.actors, strict=True)]
    for a, b in pairs:
        for name in ("means", "quats", "scales", "opacities", "sh", "semantic"):
            assert torch.equal(getattr(a, name), getattr(b, name)), name
    assert torch.equal(scene.sky.faces, again.sky.faces)
    for one, other in zip(scene.frames, again.frames, strict=True):
        assert torch.equal(one.world_from_ego, other.world_from_ego)
