"""Trees: a trunk with a few boughs, and a crown of many small leafy blobs around a dense core."""

from __future__ import annotations

import numpy as np

from adapters.street.forms import ellipsoids, tube
from adapters.street.layout import Layout, pavement_z
from adapters.street.materials import Material
from adapters.street.shapes import Look, Shapes, join
from augment.semantics import SemanticClass as Class

BARK = Look((0.13, 0.10, 0.075), Class.VEGETATION, Material.BARK)
LEAF = Look((0.12, 0.21, 0.04), Class.VEGETATION, Material.LEAF)
CORE = Look((0.045, 0.08, 0.02), Class.VEGETATION, Material.LEAVES, ambient=0.4, spacing=3.0)
WOOD = Look((0.07, 0.12, 0.035), Class.VEGETATION, Material.LEAVES, spacing=2.2)
NEAR_LEAVES, MIDDLE_LEAVES, FAR_LEAVES, GARDEN_LEAVES = 2600, 1200, 300, 80


def build_vegetation(layout: Layout) -> Shapes:
    """Street trees, garden trees behind the houses, and woods far out."""
    rng = np.random.default_rng([layout.parameters.seed, 30])
    middle = layout.path_length_m / 2
    parts = []
    for x, y in layout.trees:
        beyond = max(abs(x - middle) - middle, 0.0)  # along the street from the drive
        leaves = NEAR_LEAVES if beyond < 10 else (MIDDLE_LEAVES if beyond < 28 else FAR_LEAVES)
        parts.append(_tree(rng, 1.0, leaves).moved((x, y, float(pavement_z(y)) - 0.03)))
    for _ in range(24):
        x = rng.uniform(layout.x0 - 8, layout.x1 + 8)
        y = rng.choice([-1, 1]) * rng.uniform(24, 33)
        parts.append(_tree(rng, rng.uniform(1.1, 1.5), GARDEN_LEAVES).moved((x, y, 0.0)))
    parts.append(_woods(rng, layout))
    return join(parts)


def _tree(rng: np.random.Generator, size: float, leaves: int) -> Shapes:
    """One tree at the origin; leaves: how many tufts its crown has."""
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
    parts.append(_crown(rng, top, radii, leaves))
    return join(parts)


def _crown(rng: np.random.Generator, centre: np.ndarray, radii: np.ndarray, leaves: int) -> Shapes:
    """Tufts of leaves on boughs: round lumps around a core, lighter towards the outside and top."""
    lumps = 34
    step = np.arange(lumps)
    height = 1 - (2 * step + 1) / lumps * 0.93  # the underside stays open around the trunk
    angle = step * 2.39996 + rng.uniform(0, 6)
    flat = np.sqrt(1 - height**2)
    lump = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], 1)
    lump += rng.normal(size=(lumps, 3)) * 0.12
    lump /= np.linalg.norm(lump, axis=1, keepdims=True)
    lump_centre = lump * rng.uniform(0.60, 0.80, (lumps, 1))
    lump_radius = rng.uniform(0.32, 0.44, lumps)
    owner = rng.integers(lumps, size=leaves)
    local = _directions(rng, leaves) + 0.75 * lump[owner]  # more of them on a lump's outside
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    spot = (
        lump_centre[owner] + local * (lump_radius[owner] * rng.uniform(0.7, 1.08, leaves))[:, None]
    )
    outward = spot / np.linalg.norm(spot, axis=1, keepdims=True)
    normal = local + 0.5 * outward + 0.45 * rng.normal(size=(leaves, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    size = 2.6 * radii.mean() / np.sqrt(leaves) * rng.uniform(0.75, 1.3, leaves)
    u = np.cross(normal, rng.normal(size=(leaves, 3)))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    axes = np.stack([u, np.cross(normal, u) * 0.72, normal * 0.22], 1) * size[:, None, None]
    shapes = ellipsoids(centre + spot * radii, axes, LEAF)
    shapes.shading[:, 0] = normal
    depth = np.clip((np.linalg.norm(spot, axis=1) - 0.6) / 0.45, 0, 1)
    shapes.ambient[:] = 0.42 + 0.38 * depth + 0.22 * np.clip(outward[:, 2], -0.4, 1)
    shapes.variation[:] = rng.random(leaves)
    return shapes


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Unit vectors [count, 3], evenly over the sphere."""
    out = rng.normal(size=(count, 3))
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def _woods(rng: np.random.Generator, layout: Layout) -> Shapes:
    """Big loose crowns at the edge of the land, which hide where it ends."""
    count = 130
    angle = rng.uniform(0, 2 * np.pi, count)
    radius = rng.uniform(150, 215, count)
    middle = (layout.x0 + layout.x1) / 2
    stretch = 1 + (layout.x1 - layout.x0) / 2 / 200
    size = rng.uniform(5.0, 9.0, count)
    centres = np.stack(
        [middle + stretch * radius * np.cos(angle), radius * np.sin(angle), 0.55 * size], 1
    )
    axes = np.stack([np.diag([s * 1.5, s * 1.5, s * 0.85]) for s in size])
    shapes = ellipsoids(centres, axes, WOOD)
    shapes.variation[:] = rng.random(count)
    return shapes
