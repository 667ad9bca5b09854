"""Skies: colour by world direction, infinitely far away.

A scene holds one `Sky`. Compositing samples it behind the splats, on the CPU or a GPU; training
learns cube maps (`sample_within_faces`).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from augment.memo import memo_of
from augment.render.cuda.runtime import gpu_copy


@runtime_checkable
class Sky(Protocol):
    """Anything that gives a display-encoded colour for a world direction."""

    def sample(self, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """Return colours in [0, 1] for directions of any positive length (+z up)."""
        ...


@dataclass(frozen=True, eq=False)
class ConstantSky:
    """One colour in every direction."""

    rgb: Float[Tensor, "3"]
    """The colour, float32 [3], 0 to 1."""

    def sample(self, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """Return the colour for every direction."""
        return self.rgb.to(directions.dtype).expand(directions.shape).contiguous()


@dataclass(frozen=True, eq=False)
class LatLongSky:
    """An equirectangular image of the sky."""

    image: Float[Tensor, "H W 3"]
    """Colours, float32 [H, W, 3]. Row 0 is the zenith (+z), the last row the nadir; column 0 starts
    at azimuth -pi, and azimuth = atan2(y, x) grows with the column."""

    def sample(self, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """Return colours for directions, bilinear."""
        height, width, _ = self.image.shape
        x, y, z = directions.unbind(-1)
        azimuth = torch.atan2(y, x)
        elevation = torch.atan2(z, torch.sqrt(x * x + y * y))
        column = (azimuth / (2 * torch.pi) + 0.5) * width - 0.5
        row = (0.5 - elevation / torch.pi) * height - 0.5
        return _bilinear(self.image, row.clamp(0, height - 1), column, wrap_columns=True)


@dataclass(frozen=True, eq=False)
class CubemapSky:
    """A cube map with the texture axes of OpenGL and nvdiffrast."""

    faces: Float[Tensor, "6 R R 3"]
    """Square faces in the order +x, -x, +y, -y, +z, -z, float32 [6, R, R, 3]."""

    def sample(self, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """Return colours for directions, bilinear inside a face and across its edges."""
        return _sample_bordered(bordered_faces(self), directions)


def is_unknown_sky(sky: Sky) -> bool:
    """Return True if the sky is one grey in every direction (black and white included).

    Then nothing is known of the sky, and its colour says nothing about the scene's.
    """
    return isinstance(sky, ConstantSky) and bool((sky.rgb == sky.rgb[0]).all())


def sample_at(sky: Sky, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """Return the sky's colours on the directions' device, though its own tensors lie on the CPU."""
    if directions.device.type == "cpu":
        return sky.sample(directions)
    if isinstance(sky, ConstantSky):
        return ConstantSky(sky.rgb.to(directions.device)).sample(directions)
    if isinstance(sky, LatLongSky):
        return LatLongSky(gpu_copy(sky.image)).sample(directions)
    if isinstance(sky, CubemapSky):
        return _sample_bordered(gpu_copy(bordered_faces(sky)), directions)
    return sky.sample(directions.cpu()).to(directions.device)


def _sample_bordered(
    faces: Float[Tensor, "6 S S 3"], directions: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B 3"]:
    """Return colours from faces with one texel of their neighbours around each."""
    face, s, t = cubemap_coordinates(directions)
    size = faces.shape[1] - 2
    column = (s * 0.5 + 0.5) * size + 0.5
    row = (t * 0.5 + 0.5) * size + 0.5
    return _bilinear(faces, row, column, face=face)


def sample_within_faces(
    faces: Float[Tensor, "6 R R 3"], directions: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B 3"]:
    """Return what `CubemapSky.sample` gives, clamped at a face's edge.

    This is for a sky that is being learnt, each of whose texels stands for itself.
    """
    face, s, t = cubemap_coordinates(directions)
    size = faces.shape[1]
    column = (s * 0.5 + 0.5) * size - 0.5
    row = (t * 0.5 + 0.5) * size - 0.5
    return _bilinear(faces, row.clamp(0, size - 1), column.clamp(0, size - 1), face=face)


def bordered_faces(sky: CubemapSky) -> Float[Tensor, "6 S S 3"]:
    """Return the faces with one texel of their neighbours around each, S = R + 2; kept with the
    sky.

    A corner, where three faces meet, has the mean of their texels, as nvdiffrast has it.
    """
    key = ("bordered faces", sky.faces._version)
    return memo_of(sky).get(key, lambda: with_border(sky.faces))


def with_border(faces: Float[Tensor, "6 R R C"]) -> Float[Tensor, "6 S S C"]:
    """Return a cube map's faces with one texel of their neighbours around each, S = R + 2."""
    size = faces.shape[1]
    channels = faces.shape[3]
    out = torch.empty(6, size + 2, size + 2, channels, dtype=faces.dtype)
    out[:, 1:-1, 1:-1] = faces
    flat = faces.reshape(-1, channels)
    edges = _neighbours(size)  # [6, 4, R]
    out[:, 0, 1:-1] = flat[edges[:, 0]]
    out[:, -1, 1:-1] = flat[edges[:, 1]]
    out[:, 1:-1, 0] = flat[edges[:, 2]]
    out[:, 1:-1, -1] = flat[edges[:, 3]]
    for row, column, r, c in ((0, 0, 1, 1), (0, -1, 1, -2), (-1, 0, -2, 1), (-1, -1, -2, -2)):
        out[:, row, column] = (out[:, r, c] + out[:, row, c] + out[:, r, column]) / 3
    return out


@functools.lru_cache(maxsize=4)
def _neighbours(size: int) -> Tensor:
    """Return the flat index of the texel beyond each edge texel, int64 [6, 4, R].

    The edges are those above, below, left and right of a face.
    """
    edge_places = (torch.arange(size, dtype=torch.float64) + 0.5) / size * 2 - 1
    outer_places = torch.full_like(edge_places, 1 + 1 / size)
    edges = (
        (edge_places, -outer_places),
        (edge_places, outer_places),
        (-outer_places, edge_places),
        (outer_places, edge_places),
    )
    directions = torch.stack([_directions_of_faces(s, t) for s, t in edges], 1)
    face, s, t = cubemap_coordinates(directions)
    column, row = (((v * 0.5 + 0.5) * size - 0.5).round().long() for v in (s, t))
    return (face * size + row) * size + column


def cubemap_coordinates(directions: Float[Tensor, "*B 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Return face indices and texture coordinates (s right, t down) in [-1, 1].

    The faces are those of OpenGL's cube map table.
    """
    x, y, z = directions.unbind(-1)
    ax = x.abs()
    ay = y.abs()
    az = z.abs()
    is_x = (ax >= ay) & (ax >= az)
    is_y = ~is_x & (ay >= az)
    major = torch.where(is_x, ax, torch.where(is_y, ay, az)).clamp_min(1e-30)
    signed_major = torch.where(is_x, x, torch.where(is_y, y, z))
    is_positive = signed_major >= 0
    face = torch.where(is_x, 0, torch.where(is_y, 2, 4)) + (~is_positive).long()
    s = torch.where(
        is_x, torch.where(is_positive, -z, z), torch.where(is_y, x, torch.where(is_positive, x, -x))
    )
    t = torch.where(is_x, -y, torch.where(is_y, torch.where(is_positive, z, -z), -y))
    return face, s / major, t / major


def directions_of_cubemap(size: int) -> Float[Tensor, "6 R R 3"]:
    """Return the world direction of every texel centre, the inverse of `cubemap_coordinates`."""
    ticks = (torch.arange(size, dtype=torch.float64) + 0.5) / size * 2 - 1
    t, s = torch.meshgrid(ticks, ticks, indexing="ij")
    return torch.nn.functional.normalize(_directions_of_faces(s, t), dim=-1).float()


def _directions_of_faces(s: Tensor, t: Tensor) -> Tensor:
    """Return directions [6, ..., 3] through texture coordinates of each face, 1 along its axis."""
    ones = torch.ones_like(s)
    faces = [
        (ones, -t, -s),
        (-ones, -t, s),
        (s, ones, t),
        (s, -ones, -t),
        (s, -t, ones),
        (-s, -t, -ones),
    ]
    return torch.stack([torch.stack(face, -1) for face in faces])


def _bilinear(
    image: Tensor,
    row: Tensor,
    column: Tensor,
    *,
    face: Tensor | None = None,
    wrap_columns: bool = False,
) -> Tensor:
    """Return bilinear samples of an image.

    Args:
        image: one image [H, W, 3], or faces [6, H, W, 3].
        row: rows of the samples, texel centres at whole numbers.
        column: columns of the samples.
        face: faces of the samples; None for one image.
        wrap_columns: if True, the last column is beside the first.
    """
    height = image.shape[-3]
    width = image.shape[-2]
    r0 = row.floor()
    c0 = column.floor()
    fr = (row - r0)[..., None]
    fc = (column - c0)[..., None]
    r0 = r0.long()
    c0 = c0.long()
    r1 = (r0 + 1).clamp(max=height - 1)
    c1 = c0 + 1
    if wrap_columns:
        c0 = c0 % width
        c1 = c1 % width
    else:
        c1 = c1.clamp(max=width - 1)
    image = image.to(row.dtype)

    def texel(r: Tensor, c: Tensor) -> Tensor:
        return image[r, c] if face is None else image[face, r, c]

    top = texel(r0, c0) * (1 - fc) + texel(r0, c1) * fc
    bottom = texel(r1, c0) * (1 - fc) + texel(r1, c1) * fc
    return top * (1 - fr) + bottom * fr
