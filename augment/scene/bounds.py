"""Boxes around Gaussians, and a test whether a camera's image can show them.

In: Gaussians or a scene. Out: `Bounds`, and masks of the boxes that a camera may see (`may_show`).
The culling on the CPU, the plan of a view and snow's layer call these.

A rasteriser draws a Gaussian if its mean lies at `near_m` or beyond and its splat's box touches the
image. Let g = MAX_EXTENT_SIGMAS sqrt(1 + w^2), with w the largest tangent that the projection's
Jacobian is clamped to. The splat of a Gaussian at depth z whose longest axis is s reaches at most
fx g s / z + 2 px from its mean's place (the 2 px are its blur). So it lies left of the image where

    fx x / z + cx + fx g s / z + 2 < 0,    that is    fx x + (cx + 2) z + fx g s < 0 :

This is a half-space of the mean, and the other sides give half-spaces, too. A box of means that
lies wholly in one of these, or before the near plane, shows nothing. For an orthographic camera, z
drops out of the sides, and w is 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int64

from augment.memo import memo_of
from augment.render.constants import ALPHA_MIN, MAX_EXTENT_SIGMAS, TAN_FOV_MARGIN
from augment.scene.cameras import Camera
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Actor, Gaussians, Scene

# Margin around the image, pixels: 3.7 of it is the largest blur, the rest float32's rounding of
# pixels.
_BLUR_PX = 4.0
# Rounding of a sum, as a part of all its terms: a hundred times float32's.
_ROUNDING = 1e-5


@dataclass(frozen=True, eq=False)
class Bounds:
    """B boxes of means, along the axes of a part's frame."""

    centres: Float[np.ndarray, "B 3"]
    """Centres, metres."""
    halves: Float[np.ndarray, "B 3"]
    """Half sides, metres."""
    max_scales: Float[np.ndarray, "B"]
    """Largest standard deviation of a Gaussian in each box, metres."""
    owners: Int64[np.ndarray, "B"]
    """Instance id of each box's part, 0 for the background."""

    def __len__(self) -> int:
        return len(self.max_scales)

    def select(self, rows: np.ndarray) -> Bounds:
        """Return some of the boxes."""
        return Bounds(*(getattr(self, f.name)[rows] for f in fields(self)))

    @staticmethod
    def join(bounds: Iterable[Bounds]) -> Bounds:
        """Return all boxes, in their order."""
        no_boxes = Bounds(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
        all_bounds = [no_boxes, *bounds]
        names = [f.name for f in fields(Bounds)]
        return Bounds(*(np.concatenate([getattr(b, name) for b in all_bounds]) for name in names))


def bound_gaussians(gaussians: Gaussians, owner: int = 0) -> Bounds:
    """Return one box around all Gaussians opaque enough to be drawn; none where there are none."""
    return bound_squares(gaussians, gaussians.opacities.detach().numpy() >= ALPHA_MIN, owner=owner)


def bound_squares(
    gaussians: Gaussians, is_chosen: np.ndarray, side_m: float = math.inf, owner: int = 0
) -> Bounds:
    """Return boxes around chosen Gaussians, one for each square of x and y that has any.

    Args:
        gaussians: the Gaussians.
        is_chosen: mask of the Gaussians, [N].
        side_m: side of the squares; infinite for one box.
        owner: instance id of the part.
    """
    means = gaussians.means.detach().numpy()[is_chosen].astype(np.float64)
    longest = gaussians.scales.detach().numpy()[is_chosen].max(1, initial=0).astype(np.float64)
    return bound_points(means, longest, side_m, owner)


def bound_points(
    means: Float[np.ndarray, "N 3"], longest: Float[np.ndarray, "N"], side_m: float, owner: int
) -> Bounds:
    """Return boxes around means, one for each square of x and y that has any.

    Args:
        means: the means, metres.
        longest: largest standard deviation of each Gaussian, metres.
        side_m: side of the squares; infinite for one box.
        owner: instance id of the part.
    """
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
    box_longest = np.maximum.reduceat(longest[order], starts)
    owners = np.full(len(starts), owner, np.int64)
    return Bounds((lows + highs) / 2, (highs - lows) / 2, box_longest, owners)


def may_show(
    bounds: Bounds, world_from_part: np.ndarray | None, camera: Camera, near_m: float
) -> Bool[np.ndarray, "B"]:
    """Return the mask of boxes with a Gaussian that can touch the image; True where unknown.

    Args:
        bounds: the boxes.
        world_from_part: pose of the boxes, float64, [4, 4] for all or [B, 4, 4]; None for the
            identity.
        camera: the view.
        near_m: depth from which Gaussians are drawn.
    """
    camera_from_part = camera.camera_from_world.numpy()
    if world_from_part is not None:
        camera_from_part = camera_from_part @ world_from_part
    sides, offsets, reach = _half_spaces(camera, near_m)
    rotation = camera_from_part[..., :3, :3]
    shift = camera_from_part[..., :3, 3]
    axes = (sides @ rotation).reshape(-1, 5, 3)  # along the part's own axes, [1 or B, 5, 3]
    if len(axes) == 1:
        centres = bounds.centres @ axes[0].T
        extents = bounds.halves @ np.abs(axes[0]).T
    else:
        centres = (axes * bounds.centres[:, None]).sum(-1)
        extents = (np.abs(axes) * bounds.halves[:, None]).sum(-1)
    shifts = shift @ sides.T + offsets
    upper_bounds = centres + shifts + extents + bounds.max_scales[:, None] * reach
    tolerance = _ROUNDING * (np.abs(centres) + np.abs(shifts) + extents)
    return ~(upper_bounds + tolerance < 0).any(-1)  # not `>=`, which would be False for NaN


def _half_spaces(camera: Camera, near_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the half-spaces in the camera's axes in which nothing is drawn.

    A Gaussian at p whose longest axis is s is not drawn where sides . p + offsets + reach s < 0 in
    any row.

    Returns:
        sides [5, 3], offsets [5] and reach [5].
    """
    camera.check_no_lens("planes around its view")
    focal = np.array([camera.fx, camera.fy])
    centre = np.array([camera.cx, camera.cy])
    size = np.array([camera.width, camera.height], np.float64)
    low_margin = centre + _BLUR_PX  # px from the centre to the sides
    high_margin = size - centre + _BLUR_PX
    sides = np.zeros((5, 3))
    offsets = np.zeros(5)
    sides[0, 2] = 1.0
    offsets[0] = -near_m
    sides[[1, 2], [0, 1]] = focal
    sides[[3, 4], [0, 1]] = -focal
    max_tangent = np.zeros(2)
    if camera.is_orthographic:
        offsets[1:] = *low_margin, *high_margin
    else:
        sides[1:, 2] = *low_margin, *high_margin
        margin = TAN_FOV_MARGIN * 0.5 * size
        max_tangent = (np.maximum(np.abs(centre), np.abs(size - centre)) + margin) / focal
    reach = MAX_EXTENT_SIGMAS * focal * np.sqrt(1 + max_tangent**2)
    return sides, offsets, np.array([0.0, *reach, *reach])


def find_visible_owners(
    bounds: Bounds, poses: Mapping[int, np.ndarray], cameras: Iterable[Camera], near_m: float
) -> set[int]:
    """Return the instance ids of boxes that may be seen.

    Args:
        bounds: the boxes.
        poses: world_from_part of the parts that exist, by instance id.
        cameras: the cameras that look into the scene.
        near_m: depth from which Gaussians are drawn.
    """
    bounds = bounds.select(np.isin(bounds.owners, list(poses)))
    if not len(bounds):
        return set()
    box_poses = np.stack([poses[owner] for owner in bounds.owners.tolist()])
    may_be_seen = np.any(
        [may_show(bounds, box_poses, camera, near_m) for camera in cameras], axis=0
    )
    return set(bounds.owners[may_be_seen].tolist())


def actor_boxes(scene: Scene) -> Bounds:
    """Return one box around each actor, computed once a scene."""

    def find() -> Bounds:
        numbered = enumerate(scene.actors, start=1)
        return Bounds.join(bound_gaussians(a.gaussians, n) for n, a in numbered)

    scene = scene.as_recorded
    return memo_of(scene).get(("boxes of actors",), find)


def lowest_z_m(scene: Scene) -> float:
    """Return the height that no splat of the scene reaches below at any time, computed once."""

    base = scene.as_recorded
    lowest_of_background = memo_of(base).get(
        ("lowest height of the background",), lambda: _lowest(base.background)
    )

    def find() -> float:
        actors = [actor for actor in scene.actors if not actor.track.is_absent]
        return min(lowest_of_background, *map(_lowest_of_actor, actors), math.inf)

    return memo_of(scene).get(("lowest height",), find)


def _lowest(gaussians: Gaussians) -> float:
    """Return the lowest height that Gaussians in the world reach."""
    if len(gaussians) == 0:
        return math.inf
    up = rotmat_from_quat(gaussians.quats)[:, 2]  # the world's z along each splat's axes
    reach = MAX_EXTENT_SIGMAS * (up * gaussians.scales).norm(dim=1)
    return float((gaussians.means[:, 2] - reach).min())


def _lowest_of_actor(actor: Actor) -> float:
    """Return the lowest height that an actor reaches.

    It is that of the sphere about the actor's origin that holds all its splats.
    """
    g = actor.gaussians
    if len(g) == 0:
        return math.inf
    radius = float((g.means.norm(dim=1) + MAX_EXTENT_SIGMAS * g.scales.amax(1)).max())
    return float(actor.track.world_from_actor[:, 2, 3].min()) - radius
