"""The sky: colour by world direction, infinitely far away."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from augment.memo import memo_of
from augment.render.cuda.runtime import resident


@runtime_checkable
class Sky(Protocol):
    """Anything that gives a display-encoded colour for a world direction."""

    def sample(self, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """Colour in [0, 1] for directions of any positive length (+z up)."""
        ...


@dataclass(frozen=True, eq=False)
class ConstantSky:
    """One colour in every direction. rgb: float32 [3] in [0, 1]."""

    rgb: Float[Tensor, "3"]

    def sample(self, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        return self.rgb.to(directions.dtype).expand(directions.shape).contiguous()


@dataclass(frozen=True, eq=False)
class LatLongSky:
    """An equirectangular image. image: float32 [H, W, 3]; row 0 is the zenith (+z), the last row
    the nadir; column 0 starts at azimuth -pi, azimuth = atan2(y, x) grows with the column.
    """

    image: Float[Tensor, "H W 3"]

    def sample(self, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        height, width, _ = self.image.shape
        x, y, z = directions.unbind(-1)
        azimuth = torch.atan2(y, x)
        elevation = torch.atan2(z, torch.sqrt(x * x + y * y))
        column = (azimuth / (2 * torch.pi) + 0.5) * width - 0.5
        row = (0.5 - elevation / torch.pi) * height - 0.5
        return _bilinear(self.image, row.clamp(0, height - 1), column, wrap_columns=True)


@dataclass(frozen=True, eq=False)
class CubemapSky:
    """Six square faces in the order +x, -x, +y, -y, +z, -z, float32 [6, R, R, 3], with the texture
    axes of OpenGL and nvdiffrast; bilinear inside a face and across its edges.
    """

    faces: Float[Tensor, "6 R R 3"]

    def sample(self, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        return _sample_bordered(bordered_faces(self), directions)


def is_stand_in(sky: Sky) -> bool:
    """Whether the sky is one grey in every direction, black and white among them: nothing is known
    of it, and its colour says nothing of the scene's.
    """
    return isinstance(sky, ConstantSky) and bool((sky.rgb == sky.rgb[0]).all())


def sample_at(sky: Sky, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """The sky's colours on the directions' device, though its own tensors lie on the CPU."""
    if directions.device.type == "cpu":
        return sky.sample(directions)
    if isinstance(sky, ConstantSky):
        return ConstantSky(sky.rgb.to(directions.device)).sample(directions)
    if isinstance(sky, LatLongSky):
        return LatLongSky(resident(sky.image)).sample(directions)
    if isinstance(sky, CubemapSky):
        return _sample_bordered(resident(bordered_faces(sky)), directions)
    return sky.sample(directions.cpu()).to(directions.device)


def _sample_bordered(
    faces: Float[Tensor, "6 S S 3"], directions: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B 3"]:
    face, s, t = cubemap_coordinates(directions)
    size = faces.shape[1] - 2
    column = (s * 0.5 + 0.5) * size + 0.5
    row = (t * 0.5 + 0.5) * size + 0.5
    return _bilinear(faces, row, column, face=face)


def sample_within_faces(
    faces: Float[Tensor, "6 R R 3"], directions: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B 3"]:
    """As `CubemapSky.sample`, but clamped at a face's edge: a sky that is being learnt, each of
    whose texels stands for itself.
    """
    face, s, t = cubemap_coordinates(directions)
    size = faces.shape[1]
    column = (s * 0.5 + 0.5) * size - 0.5
    row = (t * 0.5 + 0.5) * size - 0.5
    return _bilinear(faces, row.clamp(0, size - 1), column.clamp(0, size - 1), face=face)


def bordered_faces(sky: CubemapSky) -> Float[Tensor, "6 S S 3"]:
    """The faces with one texel of their neighbours around each, S = R + 2; kept with the sky.

    A corner, where three faces meet, has the mean of their texels, as nvdiffrast has it.
    """
    key = ("bordered faces", sky.faces._version)
    return memo_of(sky).get(key, lambda: with_border(sky.faces))


def with_border(faces: Float[Tensor, "6 R R C"]) -> Float[Tensor, "6 S S C"]:
    """Faces of a cube map with one texel of their neighbours around each, S = R + 2."""
    size, channels = faces.shape[1], faces.shape[3]
    out = torch.empty(6, size + 2, size + 2, channels, dtype=faces.dtype)
    out[:, 1:-1, 1:-1] = faces
    flat = faces.reshape(-1, channels)
    edges = _neighbours(size)  # [6, 4, R]
    out[:, 0, 1:-1], out[:, -1, 1:-1] = flat[edges[:, 0]], flat[edges[:, 1]]
    out[:, 1:-1, 0], out[:, 1:-1, -1] = flat[edges[:, 2]], flat[edges[:, 3]]
    for row, column, r, c in ((0, 0, 1, 1), (0, -1, 1, -2), (-1, 0, -2, 1), (-1, -1, -2, -2)):
        out[:, row, column] = (out[:, r, c] + out[:, row, c] + out[:, r, column]) / 3
    return out


@functools.lru_cache(maxsize=4)
def _neighbours(size: int) -> Tensor:
    """Flat index of the texel beyond each edge texel: int64 [6, 4, R]; edges above, below, left and
    right of a face.
    """
    along = (torch.arange(size, dtype=torch.float64) + 0.5) / size * 2 - 1
    beyond = torch.full_like(along, 1 + 1 / size)
    edges = ((along, -beyond), (along, beyond), (-beyond, along), (beyond, along))
    directions = torch.stack([_directions_of_faces(s, t) for s, t in edges], 1)
    face, s, t = cubemap_coordinates(directions)
    column, row = (((v * 0.5 + 0.5) * size - 0.5).round().long() for v in (s, t))
    return (face * size + row) * size + column


def cubemap_coordinates(directions: Float[Tensor, "*B 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Face index and texture coordinates (s right, t down) in [-1, 1] (OpenGL's cube map table)."""
    x, y, z = directions.unbind(-1)
    ax, ay, az = x.abs(), y.abs(), z.abs()
    is_x = (ax >= ay) & (ax >= az)
    is_y = ~is_x & (ay >= az)
    major = torch.where(is_x, ax, torch.where(is_y, ay, az)).clamp_min(1e-30)
    signed = torch.where(is_x, x, torch.where(is_y, y, z))
    positive = signed >= 0
    face = torch.where(is_x, 0, torch.where(is_y, 2, 4)) + (~positive).long()
    s = torch.where(
        is_x, torch.where(positive, -z, z), torch.where(is_y, x, torch.where(positive, x, -x))
    )
    t = torch.where(is_x, -y, torch.where(is_y, torch.where(positive, z, -z), -y))
    return face, s / major, t / major


def directions_of_cubemap(size: int) -> Float[Tensor, "6 R R 3"]:
    """World direction of every texel centre: the inverse of `cubemap_coordinates`."""
    ticks = (torch.arange(size, dtype=torch.float64) + 0.5) / size * 2 - 1
    t, s = torch.meshgrid(ticks, ticks, indexing="ij")
    return torch.nn.functional.normalize(_directions_of_faces(s, t), dim=-1).float()


def _directions_of_faces(s: Tensor, t: Tensor) -> Tensor:
    """Directions [6, ..., 3] through texture coordinates of each face, with 1 along its axis."""
    one = torch.ones_like(s)
    faces = [
        (one, -t, -s), (-one, -t, s),
        (s, one, t), (s, -one, -t),
        (s, -t, one), (-s, -t, -one),
    ]  # fmt: skip
    return torch.stack([torch.stack(face, -1) for face in faces])


def _bilinear(
    image: Tensor,
    row: Tensor,
    column: Tensor,
    *,
    face: Tensor | None = None,
    wrap_columns: bool = False,
) -> Tensor:
    height, width = image.shape[-3], image.shape[-2]
    r0, c0 = row.floor(), column.floor()
    fr, fc = (row - r0)[..., None], (column - c0)[..., None]
    r0, c0 = r0.long(), c0.long()
    r1, c1 = (r0 + 1).clamp(max=height - 1), c0 + 1
    if wrap_columns:
        c0, c1 = c0 % width, c1 % width
    else:
        c1 = c1.clamp(max=width - 1)
    image = image.to(row.dtype)

    def texel(r: Tensor, c: Tensor) -> Tensor:
        return image[r, c] if face is None else image[face, r, c]

    top = texel(r0, c0) * (1 - fc) + texel(r0, c1) * fc
    bottom = texel(r1, c0) * (1 - fc) + texel(r1, c1) * fc
    return top * (1 - fr) + bottom * fr
