"""Whether Gaussians in a box can touch a camera's image, and what of a scene a camera may see.

A rasteriser draws a Gaussian if its mean lies at `near_m` or beyond and its splat's box touches
the image. With g = MAX_EXTENT_SIGMAS sqrt(1 + w^2), w the largest tangent that the projection's
Jacobian is clamped to, the splat of a Gaussian at depth z whose longest axis is s reaches at most
fx g s / z + 2 px from its mean's place (the 2 px: its blur). So it lies left of the image where

    fx x / z + cx + fx g s / z + 2 < 0,    that is    fx x + (cx + 2) z + fx g s < 0 :

a half-space of the mean, and so are the other sides. A box of means that lies wholly in one of
these, or before the near plane, shows nothing. For an orthographic camera, z drops out of the
sides, and w is 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int64

from augment.cameras import Camera
from augment.geometry import rotmat_from_quat
from augment.memo import memo_of
from augment.render.constants import ALPHA_MIN, MAX_EXTENT_SIGMAS, TAN_FOV_MARGIN
from augment.scene import Actor, Gaussians, Scene

_BLUR_PX = 3.0  # 1.9 of it is the blur, the rest float32's rounding of pixels
_ROUNDING = 1e-5  # of all terms of a sum: a hundred times float32's


@dataclass(frozen=True, eq=False)
class Bounds:
    """B boxes along the axes of a part's frame that hold means. centres, halves: metres.

    longest: the largest standard deviation of a Gaussian in the box, metres. owners: instance ids
    of the parts, 0 for the background.
    """

    centres: Float[np.ndarray, "B 3"]
    halves: Float[np.ndarray, "B 3"]
    longest: Float[np.ndarray, "B"]
    owners: Int64[np.ndarray, "B"]

    def __len__(self) -> int:
        return len(self.longest)

    def select(self, rows: np.ndarray) -> Bounds:
        return Bounds(*(getattr(self, f.name)[rows] for f in fields(self)))

    @staticmethod
    def join(bounds: Iterable[Bounds]) -> Bounds:
        """All boxes, in their order."""
        nothing = Bounds(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
        each, names = [nothing, *bounds], [f.name for f in fields(Bounds)]
        return Bounds(*(np.concatenate([getattr(b, name) for b in each]) for name in names))


def bound(gaussians: Gaussians, owner: int = 0) -> Bounds:
    """One box around all that are opaque enough to be drawn; none where there are none."""
    return bound_chunks(gaussians, gaussians.opacities.detach().numpy() >= ALPHA_MIN, owner=owner)


def bound_chunks(
    gaussians: Gaussians, chosen: np.ndarray, side_m: float = math.inf, owner: int = 0
) -> Bounds:
    """Boxes around the chosen (bool [N]), one for each square of x and y that has any."""
    means = gaussians.means.detach().numpy()[chosen].astype(np.float64)
    longest = gaussians.scales.detach().numpy()[chosen].max(1, initial=0).astype(np.float64)
    return bound_points(means, longest, side_m, owner)


def bound_points(
    means: Float[np.ndarray, "N 3"], longest: Float[np.ndarray, "N"], side_m: float, owner: int
) -> Bounds:
    if len(means) == 0:
        return Bounds.join([])
    numbers = np.zeros(len(means), np.int64)
    if side_m < math.inf:
        squares = np.floor(means[:, :2] / side_m).astype(np.int64)
        numbers = np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(numbers, kind="stable")
    starts = np.flatnonzero(np.diff(numbers[order], prepend=-1))
    lows = np.minimum.reduceat(means[order], starts, axis=0)
    highs = np.maximum.reduceat(means[order], starts, axis=0)
    widest = np.maximum.reduceat(longest[order], starts)
    owners = np.full(len(starts), owner, np.int64)
    return Bounds((lows + highs) / 2, (highs - lows) / 2, widest, owners)


def may_show(
    bounds: Bounds, world_from_part: np.ndarray | None, camera: Camera, near_m: float
) -> Bool[np.ndarray, "B"]:
    """Whether a Gaussian of each box can touch the image; True where it is not known.

    world_from_part: float64, [4, 4] of all boxes or [B, 4, 4]; None for the identity.
    """
    camera_from_part = camera.camera_from_world.numpy()
    if world_from_part is not None:
        camera_from_part = camera_from_part @ world_from_part
    sides, offsets, reach = _half_spaces(camera, near_m)
    rotation, shift = camera_from_part[..., :3, :3], camera_from_part[..., :3, 3]
    axes = (sides @ rotation).reshape(-1, 5, 3)  # along the part's own axes, [1 or B, 5, 3]
    if len(axes) == 1:
        centres, extents = bounds.centres @ axes[0].T, bounds.halves @ np.abs(axes[0]).T
    else:
        centres = (axes * bounds.centres[:, None]).sum(-1)
        extents = (np.abs(axes) * bounds.halves[:, None]).sum(-1)
    placed = shift @ sides.T + offsets
    most = centres + placed + extents + bounds.longest[:, None] * reach
    slack = _ROUNDING * (np.abs(centres) + np.abs(placed) + extents)
    return ~(most + slack < 0).any(-1)  # not `>=`: of NaN nothing is known


def _half_spaces(camera: Camera, near_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the camera's axes: sides [5, 3], offsets [5] and reach [5]. A Gaussian at p whose longest
    axis is s is not drawn where sides . p + offsets + reach s < 0 in any row.
    """
    focal = np.array([camera.fx, camera.fy])
    centre = np.array([camera.cx, camera.cy])
    size = np.array([camera.width, camera.height], np.float64)
    before, beyond = centre + _BLUR_PX, size - centre + _BLUR_PX  # px from the centre to the sides
    sides, offsets = np.zeros((5, 3)), np.zeros(5)
    sides[0, 2], offsets[0] = 1.0, -near_m
    sides[[1, 2], [0, 1]], sides[[3, 4], [0, 1]] = focal, -focal
    widest = np.zeros(2)
    if camera.is_orthographic:
        offsets[1:] = *before, *beyond
    else:
        sides[1:, 2] = *before, *beyond
        margin = TAN_FOV_MARGIN * 0.5 * size
        widest = (np.maximum(np.abs(centre), np.abs(size - centre)) + margin) / focal
    reach = MAX_EXTENT_SIGMAS * focal * np.sqrt(1 + widest**2)
    return sides, offsets, np.array([0.0, *reach, *reach])


def owners_seen(
    bounds: Bounds, poses: Mapping[int, np.ndarray], cameras: Iterable[Camera], near_m: float
) -> set[int]:
    """Instance ids of which a box may be seen. poses: world_from_part of those that exist."""
    bounds = bounds.select(np.isin(bounds.owners, list(poses)))
    if not len(bounds):
        return set()
    placed = np.stack([poses[owner] for owner in bounds.owners.tolist()])
    seen = np.any([may_show(bounds, placed, camera, near_m) for camera in cameras], axis=0)
    return set(bounds.owners[seen].tolist())


def actor_boxes(scene: Scene) -> Bounds:
    """One box around each actor; found once per scene."""

    def find() -> Bounds:
        numbered = enumerate(scene.actors, start=1)
        return Bounds.join(bound(a.gaussians, n) for n, a in numbered)

    return memo_of(scene).get(("boxes of actors",), find)


def lowest_z_m(scene: Scene) -> float:
    """Height below which no splat of the scene reaches at any time; found once per scene."""

    def find() -> float:
        return min(
            _lowest(scene.background), *(_lowest_of_actor(a) for a in scene.actors), math.inf
        )

    return memo_of(scene).get(("lowest height",), find)


def _lowest(gaussians: Gaussians) -> float:
    if len(gaussians) == 0:
        return math.inf
    up = rotmat_from_quat(gaussians.quats)[:, 2]  # the world's z along each splat's axes
    reach = MAX_EXTENT_SIGMAS * (up * gaussians.scales).norm(dim=1)
    return float((gaussians.means[:, 2] - reach).min())


def _lowest_of_actor(actor: Actor) -> float:
    """By the sphere about the actor's origin that holds all its splats."""
    g = actor.gaussians
    if len(g) == 0:
        return math.inf
    radius = float((g.means.norm(dim=1) + MAX_EXTENT_SIGMAS * g.scales.amax(1)).max())
    return float(actor.track.world_from_actor[:, 2, 3].min()) - radius
