"""Where vectors lie in a layer's image, and what the layer shows there.

Image coordinates are (column, row) in pixels with the first pixel's centre at (0.5, 0.5), so that
the pixel nearest to a coordinate is its integer part. Vectors are in world axes and start at the
layer's optical centre; their length plays no part, which makes directions of points of them.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.cameras import Camera
from augment.weather.flood import Layer

SOLID_ALPHA = 0.5  # a pixel at least this opaque shows a surface at its depth
LEAST_DEPTH = 1e-20  # of what is projected: things behind a camera land far outside its image
MIP_LEVELS = 7  # blurs up to 64 pixels: three taps are seldom farther apart


def project(camera: Camera, vectors: Float[Tensor, "*B 3"]) -> tuple[Tensor, Tensor]:
    """Column and row of vectors that start at the optical centre; huge for those behind it."""
    local = vectors @ camera.camera_from_world[:3, :3].T.to(vectors.dtype)
    x, y, z = local.unbind(-1)
    z = z.clamp_min(LEAST_DEPTH)
    return camera.fx * (x / z) + camera.cx, camera.fy * (y / z) + camera.cy


def is_inside(camera: Camera, column: Tensor, row: Tensor) -> Bool[Tensor, "*B"]:
    return (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)


def clamp_to(camera: Camera, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest coordinates between the centres of the image's outermost pixels."""
    return column.clamp(0.5, camera.width - 0.5), row.clamp(0.5, camera.height - 0.5)


def point_at(layer: Layer, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """(is there a surface, vector to it [*B, 3]) at the nearest pixel of coordinates inside."""
    c = column.clamp(0, layer.camera.width - 1).long()
    r = row.clamp(0, layer.camera.height - 1).long()
    solid = layer.alpha[r, c] >= SOLID_ALPHA
    depth = torch.where(solid, layer.depth[r, c], 0)  # depth is meaningless where nothing is
    rays = layer.camera.ray_directions(layer.depth.dtype)
    return solid, depth[..., None] * rays[r, c]


def stacked(layer: Layer) -> Float[Tensor, "H W 4"]:
    """Premultiplied colour and alpha in one image."""
    return torch.cat((layer.rgb, layer.alpha[..., None]), -1)


def bilinear(image: Float[Tensor, "H W C"], column: Tensor, row: Tensor) -> Float[Tensor, "*B C"]:
    """The image between its pixel centres; coordinates outside take the border's value."""
    height, width, _ = image.shape
    x, y = (column - 0.5).clamp(0, width - 1), (row - 0.5).clamp(0, height - 1)
    c0, r0 = x.long(), y.long()
    c1, r1 = (c0 + 1).clamp(max=width - 1), (r0 + 1).clamp(max=height - 1)
    fc, fr = (x - c0)[..., None], (y - r0)[..., None]
    top = image[r0, c0] * (1 - fc) + image[r0, c1] * fc
    bottom = image[r1, c0] * (1 - fc) + image[r1, c1] * fc
    return top * (1 - fr) + bottom * fr


def mip_chain(image: Float[Tensor, "H W C"]) -> list[Tensor]:
    """The image and its averages over 2 x 2 pixels, each from the last; odd borders count twice."""
    levels = [image]
    while len(levels) < MIP_LEVELS and max(levels[-1].shape[:2]) > 1:
        last = levels[-1]
        rows = _pairs(last.shape[0])
        columns = _pairs(last.shape[1])
        wide = (last[rows[0]] + last[rows[1]]) / 2
        levels.append((wide[:, columns[0]] + wide[:, columns[1]]) / 2)
    return levels


def _pairs(size: int) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    first = torch.arange(0, size, 2)
    return first, (first + 1).clamp(max=size - 1)


def blurred(
    levels: list[Tensor], column: Tensor, row: Tensor, spacing: Float[Tensor, "*B"]
) -> Float[Tensor, "*B C"]:
    """Bilinear from the mip level whose pixels are `spacing` wide (pixels), blended between two."""
    level = torch.log2(spacing.clamp(1, 2.0 ** (len(levels) - 1)))
    out = torch.zeros((*column.shape, levels[0].shape[-1]), dtype=column.dtype)
    for i, image in enumerate(levels):
        share = (1 - (level - i).abs()).clamp_min(0)
        out = out + share[..., None] * bilinear(image, column / 2**i, row / 2**i)
    return out
