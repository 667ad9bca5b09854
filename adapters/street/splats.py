"""Bodies as Gaussians: flat, opaque, overlapping, coloured as the surface below them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from adapters.join import join_gaussians
from adapters.street.materials import Material
from adapters.street.shadows import SHADOW_RGB, ContactShadow
from adapters.street.shapes import U0, U1, V0, V1, Kind, Shapes
from adapters.street.spacing import LEAST_M, Spacing, plan_spacing, split_long
from adapters.street.surfels import Cells, cell_counts, make_cells, total_cells
from adapters.street.world import Body
from augment.geometry import quat_from_rotmat
from augment.scene import Gaussians
from augment.semantics import SemanticClass

SH_C0 = 0.28209479177387814
OPACITY = 0.99
# Standard deviation per cell side: the least that leaves no gap (alpha > 0.99 in the mean), since
# wider splats blur and lead more (see `spacing`). Over a second layer they may be narrower.
SIGMA_PER_SIDE = 0.74
BACKED_SIGMA_PER_SIDE = 0.64
# The second layer, which fills what is left between the splats of the first: how many times as
# coarse, and from how many cells a side. As deep as it is coarse it stays behind at every slant.
BACKING = 3
BACKED_FROM = 4
BLOB_SIGMA_PER_SIDE = 0.66  # of round forms, whose cells overlap more as they curve
MESH_SIGMA_PER_SIDE = 0.71  # of the closed meshes of cars: what leaks is the car again
NARROW_SIGMA_PER_SIDE = 0.5  # half opaque at the edge: single rows, and panels nobody sees
LEAF_SIGMA = 0.64  # of the semi-axes of a tuft, which is one splat
BURIED_M = 0.08
SHADOW_SPACING_M = 0.10
SHADOW_HEIGHT_M = 0.035


@dataclass(frozen=True, eq=False)
class SplatPlan:
    """Surfaces of one body, ready to be sampled at any coarseness."""

    body: Body
    shapes: Shapes
    spacing: Spacing

    def counts(self, coarseness: float) -> np.ndarray:
        """Cells of the first layer along both axes, [P, 2]."""
        along = np.maximum(self.spacing.along * coarseness, LEAST_M)
        return cell_counts(self.shapes, along, self.spacing.hidden)

    def backing(self, counts: np.ndarray) -> np.ndarray:
        """Cells of the second layer, [P, 2]; none where there is no such layer."""
        wanted = self.shapes.backed & ~self.spacing.hidden & (counts.min(1) >= BACKED_FROM)
        return np.where(wanted[:, None], -(-counts // BACKING), 0)

    def total(self, coarseness: float) -> int:
        counts = self.counts(coarseness)
        first = total_cells(self.shapes, counts, self.spacing.hidden)
        return first + int(self.backing(counts).prod(1).sum())


def plan_splats(body: Body, eyes: np.ndarray) -> SplatPlan:
    """How a body seen from eyes [E, 3] (its frame) is to be sampled."""
    shapes = split_long(body.shapes, eyes)
    return SplatPlan(body, shapes, plan_spacing(shapes, body.tree, eyes))


def coarseness_for(plans: list[SplatPlan], target: int) -> float:
    """Spacing per metre of distance at which all plans together come to the target."""
    low, high = 1e-3, 0.2
    for _ in range(12):
        middle = float(np.sqrt(low * high))
        if sum(plan.total(middle) for plan in plans) > target:
            low = middle
        else:
            high = middle
    return high


def splat(plan: SplatPlan, coarseness: float) -> Gaussians:
    """The Gaussians of a body."""
    counts = plan.counts(coarseness)
    backing = plan.backing(counts)
    cells = make_cells(plan.shapes, counts, plan.spacing.hidden)
    cells = _uncovered(plan, cells)
    share = _sigma_per_side(plan, counts, backing)[cells.shape]
    first = _gaussians(plan, cells, share, plan.spacing.sink[cells.shape])
    # Under the ground the second layer may run on past an edge; behind a wall's it would be seen.
    upright = plan.shapes.semantic == SemanticClass.BUILDING
    below = make_cells(plan.shapes, backing, upright & (backing[:, 0] > 0))
    if not len(below.shape):
        return first
    count = len(below.shape)
    share = np.full((count, 2), SIGMA_PER_SIDE)
    return join_gaussians([first, _gaussians(plan, below, share, np.ones(count))])


def _sigma_per_side(plan: SplatPlan, counts: np.ndarray, backing: np.ndarray) -> np.ndarray:
    """Standard deviation per cell side of each shape's first layer, along both axes, [P, 2]."""
    kind, hidden = plan.shapes.kind, plan.spacing.hidden
    share = np.where(backing[:, 0] > 0, BACKED_SIGMA_PER_SIDE, SIGMA_PER_SIDE)
    share = np.where(kind == Kind.TRIANGLE, MESH_SIGMA_PER_SIDE, share)
    share = np.where(kind == Kind.ELLIPSOID, BLOB_SIGMA_PER_SIDE, share)
    share = np.where(hidden & (kind == Kind.PARALLELOGRAM), NARROW_SIGMA_PER_SIDE, share)
    lone = [
        (counts[:, i] == 1) & ((plan.shapes.edges & bits) == bits) for i, bits in enumerate(_ENDS)
    ]
    return np.where(np.stack(lone, 1), NARROW_SIGMA_PER_SIDE, share[:, None])


_ENDS = (U0 | U1, V0 | V1)


def _uncovered(plan: SplatPlan, cells: Cells) -> Cells:
    """Cells that do not lie wholly under another surface, which they would shine through."""
    covered = plan.shapes.material[cells.shape] != Material.LEAF
    places = cells.places()
    mesh = plan.shapes.kind[cells.shape] == Kind.TRIANGLE
    places[:, mesh] = cells.local[mesh]  # its overlays, wheels and lamps, spill over their rims
    for local in places:
        index = np.flatnonzero(covered)
        shape = cells.shape[index]
        normals = plan.shapes.normals(shape, local[index])
        points = plan.shapes.points(shape, local[index]) + 0.003 * normals
        covered[index] = plan.body.tree.occluded(points, normals, BURIED_M)
    return cells.select(np.flatnonzero(~covered))


def _gaussians(plan: SplatPlan, cells: Cells, share: np.ndarray, sink: np.ndarray) -> Gaussians:
    """Splats of cells; share [N, 2]: sigma per cell side; sink [N]: depth in longer cell sides."""
    shapes, shape = plan.shapes, cells.shape
    body = Body(shapes, plan.body.tree, plan.body.lighting)
    places = cells.places()
    curved = shapes.kind[shape] >= Kind.DISC
    places[:, curved] = cells.local[curved]
    rgb = body.colors(shape, places)
    normals = shapes.normals(shape, cells.local)
    frames, sigmas = _flat_covariance(cells.edges * share[:, :, None], normals)
    sides = np.linalg.norm(cells.edges, axis=2)
    depth = sink * np.where(curved, sides.min(1), sides.max(1))
    means = shapes.points(shape, cells.local) - depth[:, None] * normals
    thin = np.clip(0.1 * sigmas.min(1), 0.002, 0.02)
    sigmas = np.concatenate([sigmas, thin[:, None]], 1)
    leaf = np.flatnonzero(shapes.material[shape] == Material.LEAF)
    size = np.linalg.norm(shapes.axes[shape[leaf]], axis=2, keepdims=True)
    frames[leaf] = (shapes.axes[shape[leaf]] / size).transpose(0, 2, 1)
    sigmas[leaf], means[leaf] = LEAF_SIGMA * size[..., 0], shapes.origin[shape[leaf]]
    opacities = np.full(len(means), OPACITY)
    return make_gaussians(means, frames, sigmas, opacities, rgb, shapes.semantic[shape])


def _flat_covariance(edges: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal axes of a a' + b b', edges a, b [N, 2, 3]: rotations [N, 3, 3], sigmas [N, 2]."""
    a, b = edges[:, 0], edges[:, 1]
    length = np.linalg.norm(a, axis=1)
    first = a / length[:, None]
    first = first - (first * normals).sum(1, keepdims=True) * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    along, across = (b * first).sum(1), (b * second).sum(1)
    xx, xy, yy = length**2 + along**2, along * across, across**2
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    major, minor = c * first + s * second, c * second - s * first
    middle, spread = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    sigmas = np.sqrt(np.stack([middle + spread, np.maximum(middle - spread, 1e-8)], 1))
    return np.stack([major, minor, normals], 2), sigmas


def shadow_gaussians(shadow: ContactShadow) -> Gaussians:
    """A mover's shadow as thin translucent layers, none heavy enough to hide the ground's class."""
    size = np.array(shadow.values.shape) * 0.06
    x, y = (np.arange(SHADOW_SPACING_M / 2, s, SHADOW_SPACING_M) for s in size)
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2) + shadow.origin
    points = np.concatenate([grid, np.full((len(grid), 1), shadow.ground_z)], 1)
    cover = shadow.cover(points)
    kept = cover > 0.02
    points, cover = points[kept], cover[kept]
    # Around any point the lattice's footprints add up to 2 pi (sigma / spacing)^2 of one splat.
    opacity = -np.log1p(-cover) / (2 * np.pi)
    sigma = np.tile([SHADOW_SPACING_M, SHADOW_SPACING_M, 0.004], (len(points), 1))
    frames = np.tile(np.eye(3), (len(points), 1, 1))
    rgb = np.tile(SHADOW_RGB, (len(points), 1))
    semantic = np.full(len(points), SemanticClass.ROAD, np.int16)
    points[:, 2] += SHADOW_HEIGHT_M
    return make_gaussians(points, frames, sigma, opacity, rgb, semantic)


def make_gaussians(
    means: np.ndarray,
    frames: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    rgb: np.ndarray,
    semantic: np.ndarray,
) -> Gaussians:
    """Gaussians of one colour each, from rotations [N, 3, 3] whose columns are the axes."""
    quats = quat_from_rotmat(torch.from_numpy(frames))
    return Gaussians(
        means=torch.from_numpy(means).float(),
        quats=quats.float(),
        scales=torch.from_numpy(scales).float(),
        opacities=torch.from_numpy(opacities).float(),
        sh=torch.from_numpy((rgb - 0.5) / SH_C0).float()[:, None],
        semantic=torch.from_numpy(semantic.astype(np.int16)),
    )
