"""What the street's surfaces really are: distance, normal, class and colour along any ray."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from adapters.street.parameters import parse_parameters
from adapters.street.shadows import SHADOW_RGB, ContactShadow, contact_shadow
from adapters.street.sky import build_sky
from adapters.street.world import Body, Street, build_street
from augment.cameras import Camera
from augment.semantics import SemanticClass
from augment.sky import Sky


@dataclass(frozen=True, eq=False)
class RayHits:
    """What N rays see. distance [N]: metres, infinite for sky. normal [N, 3]: world, unit, towards
    the ray's origin; zero for sky. semantic [N] int16, instance [N] int32: 0 or 1 + the actor's
    index. rgb [N, 3]: display-encoded surface colour with baked light, zero for sky; None unless
    asked for. shape [N]: of the body that was hit, -1 for sky.
    """

    distance: np.ndarray
    normal: np.ndarray
    semantic: np.ndarray
    instance: np.ndarray
    shape: np.ndarray
    rgb: np.ndarray | None


@dataclass(frozen=True, eq=False)
class TrueView:
    """A camera's image as it should be. rgb float32 [H, W, 3] with sky; depth float64 [H, W]: z,
    infinite for sky; normal [H, W, 3]; semantic int16 [H, W]; instance int32 [H, W].
    """

    rgb: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    semantic: np.ndarray
    instance: np.ndarray


@dataclass(frozen=True, eq=False)
class StreetTruth:
    """Exact answers about a street, by ray casting."""

    street: Street

    @cached_property
    def sky(self) -> Sky:
        """As the scene's."""
        return build_sky(self.street.parameters.seed, self.street.to_sun)

    @cached_property
    def _shadows(self) -> tuple[ContactShadow, ...]:
        return tuple(contact_shadow(mover) for mover in self.street.movers)

    def cast(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        timestamp_ns: int | np.ndarray,
        *,
        with_rgb: bool = True,
    ) -> RayHits:
        """Follow rays [N, 3] (origins may be [3]) at a time, or at each ray's own time [N]."""
        rays = len(directions)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        origins = np.ascontiguousarray(np.broadcast_to(origins, unit.shape), np.float64)
        times = np.broadcast_to(np.asarray(timestamp_ns, np.int64), (rays,))
        hits = self.street.static.tree.cast(origins, unit)
        distance, shape, local = hits.distance, hits.shape, hits.local
        instance = np.zeros(rays, np.int32)
        for number, mover in enumerate(self.street.movers, start=1):
            centres, present = mover.motion.at(times)
            relative = origins - centres
            reach = np.linalg.norm(mover.size_m) / 2
            along = -(relative * unit).sum(1)
            passing = (relative**2).sum(1) - along**2 < reach**2
            index = np.flatnonzero(present & passing)
            turn = _turn(mover.motion.yaw)
            met = mover.body.tree.cast(relative[index] @ turn, unit[index] @ turn)
            nearer = met.distance < distance[index]
            index = index[nearer]
            distance[index], shape[index] = met.distance[nearer], met.shape[nearer]
            local[index], instance[index] = met.local[nearer], number
        return self._describe(origins, unit, times, distance, shape, local, instance, with_rgb)

    def render(self, camera: Camera) -> TrueView:
        """Cast a ray through every pixel centre."""
        size = (camera.height, camera.width)
        rays = camera.ray_directions(torch.float64)
        flat = rays.reshape(-1, 3).numpy()
        hits = self.cast(camera.centre.numpy(), flat, camera.timestamp_ns)
        assert hits.rgb is not None
        sky = self.sky.sample(rays.float()).numpy()
        is_sky = np.isinf(hits.distance).reshape(size)
        rgb = np.where(is_sky[..., None], sky, hits.rgb.reshape(*size, 3)).astype(np.float32)
        return TrueView(
            rgb=rgb,
            depth=(hits.distance / np.linalg.norm(flat, axis=1)).reshape(size),
            normal=hits.normal.reshape(*size, 3),
            semantic=hits.semantic.reshape(size),
            instance=hits.instance.reshape(size),
        )

    def _describe(
        self,
        origins: np.ndarray,
        unit: np.ndarray,
        times: np.ndarray,
        distance: np.ndarray,
        shape: np.ndarray,
        local: np.ndarray,
        instance: np.ndarray,
        with_rgb: bool,
    ) -> RayHits:
        rays = len(unit)
        normal = np.zeros((rays, 3))
        semantic = np.full(rays, SemanticClass.SKY, np.int16)
        rgb = np.zeros((rays, 3)) if with_rgb else None
        for number in np.unique(instance):
            index = np.flatnonzero((instance == number) & (shape >= 0))
            body, turn = self._body(int(number))
            chosen = shape[index]
            normal[index] = body.shapes.normals(chosen, local[index]) @ turn.T
            semantic[index] = body.shapes.semantic[chosen]
            if rgb is not None:
                rgb[index] = body.colors(chosen, local[index][None])
        normal[(normal * unit).sum(1) > 0] *= -1
        if rgb is not None:
            seen = np.flatnonzero((instance == 0) & (shape >= 0))
            points = origins[seen] + distance[seen, None] * unit[seen]
            for mover, shadow in zip(self.street.movers, self._shadows, strict=True):
                centres, present = mover.motion.at(times[seen])
                relative = (points - centres) @ _turn(mover.motion.yaw)
                cover = shadow.cover(relative) * present
                rgb[seen] += cover[:, None] * (SHADOW_RGB - rgb[seen])
        return RayHits(distance, normal, semantic, instance, shape, rgb)

    def _body(self, instance: int) -> tuple[Body, np.ndarray]:
        if instance == 0:
            return self.street.static, np.eye(3)
        mover = self.street.movers[instance - 1]
        return mover.body, _turn(mover.motion.yaw)


def _turn(yaw: float) -> np.ndarray:
    """world_from_actor rotation; `world @ turn` takes row vectors into the actor's frame."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def open_truth(query: Mapping[str, str]) -> StreetTruth:
    """Truth of the street that `open_procedural` opens for the same query.

    Raises:
        AdapterError: as open_procedural.
    """
    return StreetTruth(build_street(parse_parameters(query)))
