"""Small beds of snow made by hand, with the scenes that they lie in. World z up, metres."""

from __future__ import annotations

import numpy as np
import torch

from augment.exposure.cells import (
    FLUSH,
    MAX_EDGE_DISTANCE_M,
    OPEN_EDGE,
    ExposedCells,
    ExposedSurface,
)
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid
from augment.scene.scene import Actor, Gaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky
from tests.snow_scenes import splats

LEFT, RIGHT, BACK, FRONT = range(4)


def cells_on_grid(
    z_m: np.ndarray,
    cell_m: float = 0.05,
    *,
    corner_m: tuple[float, float] = (0.0, 0.0),
    border: int = FLUSH,
    holes: int = OPEN_EDGE,
    tracks: np.ndarray | None = None,
    light: np.ndarray | None = None,
    banks: tuple[float, float] = (0.0, 0.0),
) -> ExposedCells:
    """Cells over a grid of heights z_m [nx, ny]; NaN where there is none.

    corner_m: of the first cell. border: what follows at the grid's own border. holes: what follows
    where a height is NaN. tracks, light: [nx, ny]. No Gaussian is buried.
    """
    nx, ny = z_m.shape
    there = np.isfinite(z_m)
    number = np.where(there, np.cumsum(there.ravel()).reshape(nx, ny) - 1, holes)
    around = np.full((nx + 2, ny + 2), border)
    around[1:-1, 1:-1] = number
    sides = (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:])
    x = corner_m[0] + (np.arange(nx) + 0.5) * cell_m
    y = corner_m[1] + (np.arange(ny) + 0.5) * cell_m
    centers = np.stack([*np.broadcast_arrays(x[:, None], y[None, :]), z_m], -1)[there]
    count = len(centers)
    filled = np.where(there, z_m, np.nanmean(z_m) if count else 0.0)
    slope = [
        np.gradient(filled, cell_m, axis=a) if n > 1 else 0 * filled for a, n in ((0, nx), (1, ny))
    ]
    normals = np.stack([-slope[0], -slope[1], np.ones_like(filled)], -1)[there]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)

    def flat(values, usual):
        return torch.full((count,), usual) if values is None else _tensor(values[there])

    return ExposedCells(
        centers_m=_tensor(centers),
        normals=_tensor(normals),
        sizes_m=torch.full((count,), float(cell_m)),
        edge_distance_m=_tensor(_edge_distance(around, cell_m)[there]),
        neighbours=torch.from_numpy(np.stack(sides, -1)[there].astype(np.int32)),
        relative_light=flat(light, 1.0),
        track_share=flat(tracks, 0.0),
        obstacle_vectors=torch.tensor(banks).repeat(count, 1),
        semantic=torch.full((count,), int(SemanticClass.ROAD), dtype=torch.int16),
        depth_share=flat(None, 1.0),
        hideable_ids=torch.zeros(0, dtype=torch.int32),
        covering_cells=torch.zeros(0, 5, dtype=torch.int32),
    )


def _edge_distance(around: np.ndarray, cell_m: float) -> np.ndarray:
    """Distance of every cell of a grid from the nearest open edge."""
    import cv2  # a test's brute force would take minutes on the large beds

    solid = (around != OPEN_EDGE).astype(np.uint8)
    steps = cv2.distanceTransform(solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.clip((steps - 0.5) * cell_m, 0.5 * cell_m, MAX_EDGE_DISTANCE_M)[1:-1, 1:-1]


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def bed_of_cells(ground: ExposedCells, **actors: ExposedCells) -> ExposedSurface:
    return ExposedSurface(ground, actors)


def level_bed(size_m: float = 10.0, cell_m: float = 0.05, **options) -> ExposedSurface:
    """Level ground at z = 0, from (0, 0) to (size_m, size_m)."""
    count = max(1, round(size_m / cell_m))
    return bed_of_cells(cells_on_grid(np.zeros((count, count)), cell_m, **options))


def grid_surface(
    z_m: np.ndarray, cell_m: float, rgb=(0.25, 0.25, 0.27), corner_m=(0.0, 0.0)
) -> Gaussians:
    """Opaque flat discs over a grid of heights: what the snow lies on."""
    nx, ny = z_m.shape
    x = corner_m[0] + (np.arange(nx) + 0.5) * cell_m
    y = corner_m[1] + (np.arange(ny) + 0.5) * cell_m
    centers = np.stack([*np.broadcast_arrays(x[:, None], y[None, :]), z_m], -1)
    scales = (0.75 * cell_m, 0.75 * cell_m, 0.002)
    return splats(
        centers[np.isfinite(z_m)], scales, rgb=rgb, semantic=SemanticClass.ROAD, opacity=1.0
    )


def scene_of(background: Gaussians, actors: tuple[Actor, ...] = ()) -> Scene:
    sky = ConstantSky(torch.tensor([0.62, 0.7, 0.8]))
    return Scene("snow bed", "made by hand", background, actors, sky, ())


def looking(
    eye_m, at_m, width: int = 320, height: int = 200, focal: float = 300.0, timestamp_ns: int = 0
) -> Camera:
    """A camera at eye_m that looks at at_m, upright; world y is up where it looks down."""
    eye, at = (torch.tensor(p, dtype=torch.float64) for p in (eye_m, at_m))
    forward = (at - eye) / (at - eye).norm()
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    if abs(float(forward[2])) > 0.999:
        up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    right = torch.linalg.cross(forward, up)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    lens = (focal, focal, width / 2, height / 2)
    pose = rigid(rotation, -rotation @ eye)
    return Camera("looking", width, height, *lens, pose, timestamp_ns)
