"""Launches of the Triton kernels that march mirrored rays through the image."""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from augment.cameras import Camera
from augment.render.gpu import gpu_device, launch
from augment.weather import cuda_screen_kernels as kernels
from augment.weather.cuda_rows import rows_on_gpu
from augment.weather.flood import Layer

WIDE, HIGH = 8, 4  # pixels of a program: a warp, whose rays wait for each other


def trace(
    front: Layer,
    camera: Camera,
    left: int,
    top: int,
    needed: Bool[Tensor, "h w"],
    vertical: tuple[list[float], list[float], float],
) -> tuple[Tensor, Tensor]:
    """(distance, weight) as in `screen_space.ScreenReflection`, on the GPU.

    left, top: of the window `camera` in the front's image. vertical: in the front's camera, its
    image in homogeneous pixels, and the eye's height over the water.
    """
    whole, device = front.camera, gpu_device()
    alpha, depth, asked = (
        part.detach().to(device).contiguous() for part in (front.alpha, front.depth, needed)
    )
    block = kernels.BLOCK
    rows, columns = (-(-size // block) * block for size in (whole.height, whole.width))
    pyramid = torch.empty((rows, columns + columns // 4), dtype=torch.float32, device=device)
    launch(
        kernels.build_pyramid,
        ((rows // block) * (columns // block),),
        alpha,
        depth,
        whole.width,
        whole.height,
        rows,
        columns,
        pyramid,
        num_warps=8,
    )
    up, image, eye_height_m = vertical
    size = (camera.height, camera.width)
    distance, weight = (torch.empty(size, dtype=torch.float32, device=device) for _ in range(2))
    across = -(-camera.width // WIDE)
    launch(
        kernels.trace,
        (across * -(-camera.height // HIGH),),
        pyramid,
        rows_on_gpu(camera),
        alpha,
        asked.view(torch.uint8),
        left,
        top,
        camera.width,
        camera.height,
        across,
        whole.width,
        whole.height,
        rows,
        columns,
        up[0] / camera.fx,
        *up,
        image[0],
        image[1],
        whole.fx,
        whole.fy,
        whole.cx,
        whole.cy,
        eye_height_m,
        distance,
        weight,
        WIDE=WIDE,
        HIGH=HIGH,
        num_warps=1,
    )
    return distance, weight
