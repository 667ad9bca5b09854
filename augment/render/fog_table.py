"""Fog banks before a camera: a table of their mean along rays, from which all passes read.

The optical depth of a ray through fog with banks is that of plain fog times the mean of the banks'
density along the ray (`augment.render.fog_bank_kernels`). That mean is smooth: it hardly changes
from a ray to its neighbour, nor from a distance to a little more. So it is tabulated once for a
camera, over x/z, y/z and the logarithm of the distance, and interpolated linearly.

The columns and rows lie at multiples of a step that follows from the fog alone. So windows of an
image and images of another resolution read the same numbers. Beams of a LiDAR, which have no image,
are integrated one by one.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import make_interp_spline
from torch import Tensor

from augment.render import fog_bank_kernels
from augment.render.buffers import AUTO, CPU, choose_kernels
from augment.render.fog import Fog
from augment.render.fog_bank_kernels import HEAD
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Optical depth of plain fog up to which rays are integrated; banks behind it are the mean of the
# ray before it.
MAX_DEPTH = 20.0
# Largest distance up to which rays are integrated, in widths of the largest banks, at least.
MIN_BANKS = 4.0
# The same, at most.
MAX_BANKS = 40.0
# Optical depth of plain fog at whose distance the table's columns resolve the banks.
RESOLVED_DEPTH = 5.0
# Step between columns of the table, for banks whose last octave is as far away as it is wide.
STEP_SCALE = 0.3
# Growth of that step with the angle of the last octave: rays average what is far away.
STEP_POWER = 0.75
# Largest step between columns; the largest number of steps along a side of the image.
MAX_STEP = 0.25
MAX_STEPS = 72
# Width of the border around the image, for splats whose centres lie outside, in image widths.
BORDER = 0.1
# Nodes of the table per doubling of the distance.
NODES_PER_DOUBLING = 12.0
# Distance at which the nodes begin to grow apart, in lattice steps of the last octave.
NEAR_STEPS = 3.0
# Columns of the table per column of rays that are integrated; splines fill it.
REFINEMENT = 3
# Rows that a thread takes at a time.
_ROWS_PER_CHUNK = 32


@dataclass(frozen=True, eq=False)
class BankTable:
    """Mean density of fog banks along the rays of a camera.

    numbers: float32, flat: the head that `fog_bank_kernels.interpolate_mean` reads, and log2 of the
        means, which keeps the same share of a thin and of a dense bank.
    shape: number of distances, rows and columns.
    """

    numbers: np.ndarray
    shape: tuple[int, int, int]

    @property
    def means(self) -> np.ndarray:
        """Return the means [distances, rows, columns]."""
        return np.exp2(self.numbers[HEAD:].reshape(self.shape))

    @functools.cached_property
    def least(self) -> float:
        """Return the least mean of any ray."""
        return 2.0 ** float(self.numbers[HEAD:].min())


def bank_table(fog: Fog, camera: Camera) -> BankTable:
    """Return the table of a fog with banks before a pinhole camera."""
    pose = camera.world_from_camera.numpy()
    lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    plain = replace(fog, airlight_rgb=(0.0, 0.0, 0.0), varying_airlight_rgb=None, elevation_gain=0)
    return _table(plain, lens, pose[:3].tobytes())


@functools.lru_cache(maxsize=16)
def _table(fog: Fog, lens: tuple[float, ...], pose_bytes: bytes) -> BankTable:
    """Return the table for the numbers of a camera; a pure function, so that it may be kept."""
    banks = fog.banks
    assert banks is not None
    pose = np.frombuffer(pose_bytes).reshape(3, 4)
    width, height, fx, fy, cx, cy = lens
    far_m = _far_distance(fog)
    low_u, high_u = _padded(-cx / fx, (width - cx) / fx)
    low_v, high_v = _padded(-cy / fy, (height - cy) / fy)
    step = max(_grid_step(fog), max(high_u - low_u, high_v - low_v) / MAX_STEPS)
    columns = np.arange(math.floor(low_u / step), math.ceil(high_u / step) + 1)
    rows = np.arange(math.floor(low_v / step), math.ceil(high_v / step) + 1)
    scale_m = NEAR_STEPS * banks.finest_m
    num_nodes = math.ceil(math.log2(1 + far_m / scale_m) * NODES_PER_DOUBLING) + 1
    distances = scale_m * (2 ** (np.arange(num_nodes) / NODES_PER_DOUBLING) - 1)
    means = np.empty((num_nodes, len(rows), len(columns)))
    axes = np.ascontiguousarray(pose[:, :3])
    with kernel_threads():
        fog_bank_kernels.tabulate_means(
            pose[:, 3].copy(),
            axes,
            float(columns[0] * step),
            float(rows[0] * step),
            step,
            distances,
            axes[2].copy(),
            _scale_rate(fog),
            *bank_numbers(fog),
            means,
        )
    fine = _refining(len(rows)) @ np.log2(means) @ _refining(len(columns)).T
    head = (
        REFINEMENT / step,
        -columns[0] * REFINEMENT,
        -rows[0] * REFINEMENT,
        fine.shape[2],
        fine.shape[1],
        num_nodes,
        1 / scale_m,
        NODES_PER_DOUBLING,
    )
    numbers = np.concatenate([head, fine.reshape(-1)]).astype(np.float32)
    return BankTable(numbers, fine.shape)


@functools.lru_cache(maxsize=64)
def _refining(count: int) -> np.ndarray:
    """Return the matrix [(count - 1) REFINEMENT + 1, count] of cubic splines between nodes."""
    nodes = np.arange(count)
    spline = make_interp_spline(nodes, np.eye(count), k=min(3, count - 1))
    return spline(np.arange((count - 1) * REFINEMENT + 1) / REFINEMENT)


def _padded(low: float, high: float) -> tuple[float, float]:
    margin = BORDER * (high - low)
    return low - margin, high + margin


def _scale_rate(fog: Fog) -> float:
    return 0.0 if fog.scale_height_m is None else 1 / fog.scale_height_m


def bank_numbers(fog: Fog) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Return what kernels read of banks: finest lattice step, lattices, seeds, log mean."""
    banks = fog.banks
    assert banks is not None
    return banks.finest_m, banks.lattices, banks.seeds, banks.log_mean


def _far_distance(fog: Fog) -> float:
    """Return the distance up to which rays are integrated, metres."""
    assert fog.banks is not None
    bank_m = fog.banks.bank_m
    opaque_m = MAX_DEPTH / max(fog.extinction_per_m, 1e-9)
    return min(max(opaque_m, MIN_BANKS * bank_m), MAX_BANKS * bank_m)


def _grid_step(fog: Fog) -> float:
    """Return the step of x/z and y/z in the table."""
    assert fog.banks is not None
    resolved_m = min(RESOLVED_DEPTH / max(fog.extinction_per_m, 1e-9), _far_distance(fog))
    return min(STEP_SCALE * (fog.banks.finest_m / resolved_m) ** STEP_POWER, MAX_STEP)


def image_means(
    fog: Fog, camera: Camera, depth: Float[Tensor, "H W"], *, backend: str = AUTO
) -> Float[Tensor, "H W"]:
    """Return the mean density of the banks before each pixel: the factor of its optical depth.

    Args:
        fog: fog with banks.
        camera: the camera.
        depth: z of what the pixels show, metres; infinite for the sky.
        backend: on the CPU, pixels go through a kernel.
    """
    table = bank_table(fog, camera)
    u = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    v = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    u, v = u.float(), v.float()
    if choose_kernels(backend, depth) == CPU:
        out = np.empty(tuple(depth.shape), np.float32)
        with kernel_threads(_ROWS_PER_CHUNK):
            fog_bank_kernels.look_up_image(
                table.numbers, u.numpy(), v.numpy(), depth.detach().contiguous().numpy(), out
            )
        return torch.from_numpy(out)
    u = u.to(depth.device, depth.dtype).expand_as(depth)
    v = v[:, None].to(depth.device, depth.dtype).expand_as(depth)
    return look_up(table, u, v, depth * (1 + u * u + v * v).sqrt())


def point_means(fog: Fog, camera: Camera, offsets: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Return the mean density of the banks before points.

    Args:
        fog: fog with banks.
        camera: the camera.
        offsets: vectors from the eye to the points, in the world's axes, metres.
    """
    rotation = camera.camera_from_world[:3, :3].to(offsets.device, offsets.dtype)
    x, y, z = (offsets @ rotation.T).unbind(-1)
    z = z.clamp_min(1e-3 * offsets.norm(dim=-1).clamp_min(1e-6))
    return look_up(bank_table(fog, camera), x / z, y / z, offsets.norm(dim=-1))


def point_means_numpy(fog: Fog, camera: Camera, points_m: np.ndarray) -> np.ndarray:
    """Return `point_means` of points [..., 3] in the scene's world."""
    offsets = torch.from_numpy(np.asarray(points_m, np.float64)) - camera.centre
    return point_means(fog, camera, offsets).numpy()


def pixel_means(
    fog: Fog, camera: Camera, u: np.ndarray, v: np.ndarray, distance_m: np.ndarray
) -> np.ndarray:
    """Return the mean density of the banks along rays through x/z = u, y/z = v, [N]."""
    rays = (torch.from_numpy(np.asarray(a, np.float64)) for a in (u, v, distance_m))
    return look_up(bank_table(fog, camera), *rays).numpy()


def look_up(
    table: BankTable, u: Float[Tensor, "*B"], v: Float[Tensor, "*B"], distance: Float[Tensor, "*B"]
) -> Float[Tensor, "*B"]:
    """Return the table's means: the definition of `look_up_image`."""
    head = table.numbers[:HEAD].tolist()
    num_distances, num_rows, num_columns = table.shape
    means = torch.from_numpy(table.numbers[HEAD:]).to(u.device, u.dtype)
    x = (u * head[0] + head[1]).clamp(0, num_columns - 1)
    y = (v * head[0] + head[2]).clamp(0, num_rows - 1)
    q = (torch.log2(1 + distance * head[6]) * head[7]).clamp(0, num_distances - 1)
    column = x.long().clamp_max(num_columns - 2)
    row = y.long().clamp_max(num_rows - 2)
    node = q.long().clamp_max(num_distances - 2)
    x, y, q = x - column, y - row, q - node
    first = (node * num_rows + row) * num_columns + column

    def plane(start: Tensor) -> Tensor:
        """Return the value between four neighbours at one distance."""
        upper = torch.lerp(means[start], means[start + 1], x)
        start = start + num_columns
        return torch.lerp(upper, torch.lerp(means[start], means[start + 1], x), y)

    return torch.exp2(torch.lerp(plane(first), plane(first + num_rows * num_columns), q))


def ray_means(
    fog: Fog, origins_m: np.ndarray, directions: np.ndarray, distances_m: np.ndarray
) -> np.ndarray:
    """Return the mean density of the banks along rays, integrated one by one, float64 [N].

    Args:
        fog: fog with banks.
        origins_m: starts of the rays [N, 3], scene world, metres.
        directions: unit directions [N, 3].
        distances_m: lengths [N], metres; what is farther than the table reaches is the mean before.
    """
    out = np.empty(len(distances_m))
    lengths = np.clip(np.nan_to_num(distances_m, nan=0.0), 0.0, _far_distance(fog))
    with kernel_threads():
        fog_bank_kernels.means_of_rays(
            np.ascontiguousarray(np.broadcast_to(origins_m, directions.shape), np.float64),
            np.ascontiguousarray(directions, np.float64),
            lengths.astype(np.float64),
            _scale_rate(fog),
            *bank_numbers(fog),
            out,
        )
    return out


def densities_at(fog: Fog, points_m: np.ndarray) -> np.ndarray:
    """Return the banks' density at points [N, 3], relative to its mean."""
    points = np.asarray(points_m, np.float64)
    return ray_means(
        fog, points, np.broadcast_to([1.0, 0.0, 0.0], points.shape), np.zeros(len(points))
    )


def thinnest_fog(fog: Fog, camera: Camera) -> Fog:
    """Return plain fog that is nowhere denser before a camera than a fog with banks."""
    if fog.banks is None:
        return fog
    least = bank_table(fog, camera).least
    return replace(fog, extinction_per_m=0.999 * least * fog.extinction_per_m, banks=None)


def visible_distances(
    fog: Fog, origin_m: np.ndarray, directions: np.ndarray, depth: float
) -> np.ndarray:
    """Return how far rays [N, 3] from a point go up to an optical depth, metres.

    fog: fog with banks that does not thin with height.
    """
    steps = 2.0 ** (np.arange(-24, 25) / 8)
    distances = steps * depth / max(fog.extinction_per_m, 1e-12)
    rays = np.repeat(directions, len(steps), 0)
    origins = np.broadcast_to(origin_m, rays.shape)
    means = ray_means(fog, origins, rays, np.tile(distances, len(directions)))
    tau = fog.extinction_per_m * distances * means.reshape(len(directions), -1)
    return np.array([np.interp(depth, row, distances) for row in np.maximum.accumulate(tau, 1)])


# Distance of the rays that give the fog around a camera, metres.
LOCAL_M = 30.0


def local_fog(fog: Fog | None, camera: Camera) -> Fog | None:
    """Return plain fog as dense as fog with banks is around a camera, on average over its image.

    It is for what happens close to the camera, such as drops in fog.
    """
    if fog is None or fog.banks is None:
        return fog
    table = bank_table(fog, camera)
    node = math.log2(1 + LOCAL_M / (NEAR_STEPS * fog.banks.finest_m)) * NODES_PER_DOUBLING
    mean = float(table.means[min(round(node), table.shape[0] - 1)].mean(dtype=np.float64))
    return replace(fog, extinction_per_m=mean * fog.extinction_per_m, banks=None)
