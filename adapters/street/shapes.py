"""The surfaces a street is made of, as arrays: every shape is a unit shape in its own affine frame.

A point has local coordinates q with `point = origin + q @ axes`, and the kinds are

    PARALLELOGRAM  0 <= u, v <= 1, w = 0        DISC       u^2 + v^2 <= 1, w = 0
    TRIANGLE       0 <= u, v, u + v <= 1, w = 0 ELLIPSOID  |q| = 1
    CYLINDER       u^2 + v^2 = 1, |w| <= 1 (open ends)

For the flat kinds the third axis is the unit normal, pointing outwards.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from adapters.street.materials import Material
from augment.semantics import SemanticClass


class Kind(IntEnum):
    PARALLELOGRAM = 0
    TRIANGLE = 1
    DISC = 2
    ELLIPSOID = 3
    CYLINDER = 4


# Bits of Shapes.edges: where a parallelogram's splats should end crisply.
U0, U1, V0, V1 = 1, 2, 4, 8
ALL_EDGES = U0 | U1 | V0 | V1
# A triangle that leaves the splats on its diagonal to the other half of its quad.
OPEN_DIAGONAL = 16


@dataclass(frozen=True)
class Look:
    """What a surface looks like. rgb: linear albedo. ambient: share of sky light that reaches it.
    spacing: its splats' distance relative to other surfaces as far away. backed: whether half a
    metre of nothing lies behind it, where a second layer of splats may stand.
    """

    rgb: tuple[float, float, float]
    semantic: SemanticClass
    material: Material = Material.PLAIN
    ambient: float = 1.0
    spacing: float = 1.0
    backed: bool = False

    def tinted(self, rgb: Sequence[float]) -> Look:
        return dataclasses.replace(self, rgb=tuple(float(c) for c in rgb))


@dataclass(frozen=True, eq=False)
class Shapes:
    """P shapes. origin [P, 3], axes [P, 3, 3] (rows u, v, w), metres.

    shading: [P, 3, 3], of flat kinds and leaves: what light takes for the normal is
    shading[0] + u shading[1] + v shading[2].
    rgb [P, 3] linear albedo; material, semantic, kind, edges [P]; ambient, spacing,
    backed [P] as in Look.
    variation [P]: a number in [0, 1) that tells equal shapes apart.
    """

    kind: np.ndarray
    origin: np.ndarray
    axes: np.ndarray
    shading: np.ndarray
    rgb: np.ndarray
    material: np.ndarray
    semantic: np.ndarray
    edges: np.ndarray
    ambient: np.ndarray
    spacing: np.ndarray
    backed: np.ndarray
    variation: np.ndarray

    def __len__(self) -> int:
        return len(self.kind)

    def select(self, index: np.ndarray) -> Shapes:
        return Shapes(*(getattr(self, f.name)[index] for f in dataclasses.fields(self)))

    def moved(self, translation: Sequence[float], yaw_rad: float = 0.0) -> Shapes:
        """The shapes turned about z, then shifted."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # rows: images of x, y, z
        return dataclasses.replace(
            self,
            origin=self.origin @ turn + np.asarray(translation, np.float64),
            axes=self.axes @ turn,
            shading=self.shading @ turn,
        )

    def repeated(self, translations: np.ndarray) -> Shapes:
        """A copy at each translation [M, 3]."""
        count, copies = len(self), len(translations)
        index = np.tile(np.arange(count), copies)
        shifts = np.repeat(np.asarray(translations, np.float64), count, axis=0)
        copied = self.select(index)
        variation = (copied.variation + np.repeat(np.arange(copies) * 0.618034, count)) % 1.0
        return dataclasses.replace(copied, origin=copied.origin + shifts, variation=variation)

    def points(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Positions [N, 3] of local coordinates [N, 3] on shapes [N]."""
        return self.origin[shape] + np.einsum("nk,nkj->nj", local, self.axes[shape])

    def normals(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Outward unit normals [N, 3] of the true surface."""
        normals = self.axes[shape, 2].copy()
        curved = self.kind[shape] >= Kind.ELLIPSOID
        if curved.any():
            chosen, q = shape[curved], local[curved].copy()
            q[self.kind[chosen] == Kind.CYLINDER, 2] = 0
            axes = self.axes[chosen]
            gradient = np.einsum("nk,nkj->nj", q / (axes**2).sum(2), axes)  # axes are orthogonal
            normals[curved] = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        return normals

    def shading_normals(self, shape: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Unit normals [N, 3] that light sees: smooth across the panels of a mesh."""
        normals = self.normals(shape, local)
        flat = (self.kind[shape] < Kind.ELLIPSOID) | (self.material[shape] == Material.LEAF)
        bent = self.shading[shape[flat]]
        q = local[flat]
        smooth = bent[:, 0] + q[:, :1] * bent[:, 1] + q[:, 1:2] * bent[:, 2]
        normals[flat] = smooth / np.linalg.norm(smooth, axis=1, keepdims=True)
        return normals


def join(parts: Sequence[Shapes]) -> Shapes:
    """All parts in one."""
    return Shapes(
        *(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Shapes))
    )


def make_shapes(
    kind: Kind,
    origin: np.ndarray,
    axes: np.ndarray,
    look: Look,
    *,
    edges: np.ndarray | int = 0,
    shading: np.ndarray | None = None,
) -> Shapes:
    """Shapes of one kind and look, from origin [P, 3] and axes [P, 3, 3]."""
    count = len(origin)
    if shading is None:
        shading = np.zeros((count, 3, 3))
        shading[:, 0] = axes[:, 2]
    return Shapes(
        kind=np.full(count, kind, np.int8),
        origin=np.asarray(origin, np.float64),
        axes=np.asarray(axes, np.float64),
        shading=shading,
        rgb=np.tile(np.asarray(look.rgb, np.float64), (count, 1)),
        material=np.full(count, look.material, np.int16),
        semantic=np.full(count, look.semantic, np.int16),
        edges=np.broadcast_to(np.asarray(edges, np.uint8), (count,)).copy(),
        ambient=np.full(count, look.ambient),
        spacing=np.full(count, look.spacing),
        backed=np.full(count, look.backed),
        variation=(np.arange(count) * 0.618034 + 0.37) % 1.0,
    )
