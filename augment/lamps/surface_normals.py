"""Normals of a picture's surfaces by its depth, at nodes some pixels apart.

A normal follows from the slopes of the inverse depth, and is averaged with those about it. Ground
and walls take means over wide windows besides: a car's own lamps light a road at so small an angle
that each bump of the splats would throw a shadow, and fronts have wide bulges that a lamp would
show as blotches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from augment.lamps import surface_normal_kernels as kernels
from augment.lamps.surface_normal_kernels import BLOCK_COLUMNS, NUM_PLANES, NodeView
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Nodes in a row of a picture, about.
NODES_PER_ROW = 600
# Pixels between nodes, at most.
MAX_STEP_PX = 4
# Rows of nodes that a thread takes at a time.
ROWS_PER_TASK = 8


@dataclass(frozen=True, eq=False)
class Nodes:
    """Points of a picture at which light is summed."""

    depth: Float32[np.ndarray, "h w"]
    """z, metres; 0 for the sky."""
    normals: Float32[np.ndarray, "h w 3"]
    """Normals towards the eye, world, as short as those about them disagree; 0 for the sky."""
    step_px: int
    """Pixels between nodes."""

    @property
    def inverse_depth(self) -> Float32[np.ndarray, "h w"]:
        """Return 1 / z; 0 for the sky."""
        return _inverse(self.depth)


def _inverse(depth: np.ndarray) -> np.ndarray:
    is_surface = (depth > 0) & (depth < 1e6)
    return np.divide(1, depth, out=np.zeros_like(depth), where=is_surface)


def default_step_px(camera: Camera) -> int:
    """Return the pixels between nodes at which a picture has about NODES_PER_ROW in a row."""
    return min(max(round(camera.width / NODES_PER_ROW), 1), MAX_STEP_PX)


def find_nodes(
    camera: Camera, depth_m: Float32[np.ndarray, "H W"], *, step_px: int | None = None
) -> Nodes:
    """Return the nodes of a picture, with normals by its depth.

    A normal follows from the slopes of the inverse depth, on the side of the node that is smoother,
    and is averaged with those about it. On ground, the normals are averaged over a wide window: a
    car's own lamps light a road at so small an angle that each bump of the splats would throw a
    shadow.

    Args:
        camera: camera of the picture.
        depth_m: z of the surfaces, metres; 0 for the sky.
        step_px: pixels between nodes; None for `default_step_px`.
    """
    step_px = default_step_px(camera) if step_px is None else step_px
    first = step_px // 2
    depth = np.ascontiguousarray(depth_m[first::step_px, first::step_px], np.float32)
    if not depth.size:
        depth = np.ascontiguousarray(depth_m[:1, :1], np.float32)
    inverse = _inverse(depth)
    slopes = np.empty((*depth.shape, 3), np.float32)
    normals = np.empty_like(slopes)
    length = -(-depth.shape[1] // BLOCK_COLUMNS) * BLOCK_COLUMNS
    planes = np.empty((NUM_PLANES, depth.shape[0], length), np.float32)
    with kernel_threads(ROWS_PER_TASK):
        kernels.find_slopes(inverse, node_view(camera, step_px), slopes)
        kernels.average_normals(inverse, slopes, normals)
        kernels.weigh_ground(inverse, normals, planes)
        kernels.average_columns(planes, True)
        kernels.smooth_ground(inverse, normals, planes, slopes)
        kernels.average_columns(planes, False)
        kernels.smooth_walls(inverse, slopes, planes, normals)
    return Nodes(depth, normals, step_px)


def node_view(camera: Camera, step_px: int) -> NodeView:
    """Return the view of the nodes as kernels take it."""
    pose = camera.world_from_camera.numpy()
    lens = (1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy, step_px, step_px // 2 + 0.5)
    return NodeView(
        np.array(lens, np.float64),
        np.ascontiguousarray(pose[:3, :3]),
        np.ascontiguousarray(pose[:3, 3]),
    )
