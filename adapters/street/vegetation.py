"""Trees: a trunk with a few boughs, and a crown of many small leafy blobs around a dense core."""

from __future__ import annotations

import numpy as np

from adapters.street.forms import ellipsoids, tube
from adapters.street.layout import Layout, pavement_z
from adapters.street.materials import Material
from adapters.street.shapes import Look, Shapes, join
from augment.semantics import SemanticClass as Class

BARK = Look((0.13, 0.10, 0.075), Class.VEGETATION, Material.BARK)
LEAVES = Look((0.105, 0.18, 0.035), Class.VEGETATION, Material.LEAVES, spacing=1.5)
CORE = Look((0.05, 0.085, 0.02), Class.VEGETATION, Material.LEAVES, ambient=0.45, spacing=2.0)


def build_vegetation(layout: Layout) -> Shapes:
    """Street trees, garden trees behind the houses, and woods far out."""
    rng = np.random.default_rng([layout.parameters.seed, 30])
    middle = layout.path_length_m / 2
    parts = []
    for x, y in layout.trees:
        near = abs(x - middle) < middle + 26
        parts.append(
            _tree(rng, 1.0, 210 if near else 90).moved((x, y, float(pavement_z(y)) - 0.03))
        )
    for _ in range(26):
        place = (
            rng.uniform(layout.x0 - 8, layout.x1 + 8),
            rng.choice([-1, 1]) * rng.uniform(24, 33),
        )
        parts.append(_tree(rng, rng.uniform(1.1, 1.5), 45).moved((*place, 0.0)))
    parts.append(_woods(rng, layout))
    return join(parts)


def _tree(rng: np.random.Generator, size: float, blobs: int) -> Shapes:
    """One tree at the origin; blobs says how finely its crown is broken up."""
    height = size * rng.uniform(3.9, 4.6)  # of the crown's middle
    radii = size * np.array([1.0, 1.0, 1.15]) * rng.uniform(1.55, 1.95)
    lean = rng.uniform(-0.12, 0.12, 2)
    top = np.array([*lean, height])
    fork = top * [1, 1, 0.62]
    parts = [
        tube((0, 0, -0.1), fork * 0.5, 0.135 * size, BARK),
        tube(fork * 0.48, fork, 0.115 * size, BARK),
    ]
    for k in range(4):
        angle = rng.uniform(0, 0.8) + k * np.pi / 2
        reach = np.array([np.cos(angle), np.sin(angle), 0.9]) * radii * 0.62
        parts.append(tube(fork * 0.98, fork + reach, 0.055 * size, BARK))
    core = radii * 0.62
    parts.append(ellipsoids(top[None], np.diag(core)[None], CORE))
    parts.append(_crown(rng, top, radii, blobs))
    return join(parts)


def _crown(rng: np.random.Generator, centre: np.ndarray, radii: np.ndarray, blobs: int) -> Shapes:
    """Flat leafy clusters in the outer shell of an ellipsoid, lighter towards the outside and top."""
    direction = rng.normal(size=(blobs, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction[:, 2] = np.where(direction[:, 2] < -0.75, -direction[:, 2], direction[:, 2])
    depth = rng.uniform(0.62, 1.04, blobs) ** 0.8
    lumps = 1 + 0.13 * np.sin(3.1 * direction[:, 0] + 5.0 * direction[:, 2] + rng.uniform(0, 6))
    centres = centre + direction * radii * (depth * lumps)[:, None]
    size = 1.9 * radii.mean() / np.sqrt(blobs) * rng.uniform(0.8, 1.35, blobs)
    normal = direction + 0.7 * rng.normal(size=(blobs, 3)) + np.array([0, 0, 0.35])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    u = np.cross(normal, rng.normal(size=(blobs, 3)))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normal, u)
    axes = np.stack([u, v * 0.8, normal * 0.55], 1) * size[:, None, None]
    shapes = ellipsoids(centres, axes, LEAVES)
    outside = np.clip((depth - 0.62) / 0.4, 0, 1)
    shapes.ambient[:] = 0.45 + 0.35 * outside + 0.25 * np.clip(direction[:, 2], -0.3, 1)
    shapes.variation[:] = rng.random(blobs)
    return shapes


def _woods(rng: np.random.Generator, layout: Layout) -> Shapes:
    """Big loose crowns at the edge of the land, which hide where it ends."""
    count = 260
    angle = rng.uniform(0, 2 * np.pi, count)
    radius = rng.uniform(150, 215, count)
    middle = (layout.x0 + layout.x1) / 2
    stretch = 1 + (layout.x1 - layout.x0) / 2 / 200
    size = rng.uniform(5.0, 9.0, count)
    centres = np.stack(
        [middle + stretch * radius * np.cos(angle), radius * np.sin(angle), 0.55 * size], 1
    )
    axes = np.stack([np.diag([s * 1.5, s * 1.5, s * 0.85]) for s in size])
    look = Look((0.07, 0.12, 0.035), Class.VEGETATION, Material.LEAVES)
    shapes = ellipsoids(centres, axes, look)
    shapes.variation[:] = rng.random(count)
    return shapes
