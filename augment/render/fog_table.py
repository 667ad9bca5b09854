"""Fog banks before a camera: a table of their mean density along rays, from which all passes read.

The optical depth of a ray through fog with banks is that of plain fog times the mean of the banks'
density along the ray. Banks vary along the ground alone, so the mean depends on the ray's heading,
on its level distance, and, where plain fog thins with height, on its climb. It is tabulated once
for an eye, over the heading, the logarithm of the distance and the climb, and interpolated
linearly. The table goes once around, so windows of an image, images of another resolution and
mirrored cameras read the same numbers. Beams of a LiDAR are integrated one by one.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.render import fog_bank_kernels as kernels
from augment.render.buffers import AUTO, CPU, choose_kernels
from augment.render.fog import Fog
from augment.render.fog_bank_kernels import HEAD, STEP, STEP_GROWTH
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Optical depth of plain fog up to which rays are integrated; banks behind it are the mean of the
# ray before it.
MAX_DEPTH = 16.0
# Largest distance up to which rays are integrated, in widths of the largest banks, at least.
MIN_BANKS = 4.0
# The same, at most.
MAX_BANKS = 40.0
# Optical depth of plain fog at whose distance the headings resolve the banks.
RESOLVED_DEPTH = 5.0
# Distance there between headings that are integrated, in lattice steps of the last octave.
HEADING_STEP = 0.3
# Smallest number of headings that are integrated.
MIN_HEADINGS = 48
# Largest number of headings that are integrated.
MAX_HEADINGS = 480
# The same in fog that thins with height, whose table has many climbs.
MAX_LAYERED_HEADINGS = 240
# Headings of the table for each that is integrated.
REFINEMENT = 3
# Nodes of the table per doubling of the distance.
NODES_PER_DOUBLING = 20.0
# Distance at which the nodes begin to grow apart, in lattice steps of the last octave.
NEAR_STEPS = 3.0
# Nodes per doubling of the climb.
CLIMBS_PER_DOUBLING = 1.5
# Steepest slope that has a node of its own.
MAX_SLOPE = 10.0
# Rows that a thread takes at a time.
_ROWS_PER_CHUNK = 32
# Level distance below which a ray has the density at its eye, metres.
_MIN_LEVEL_M = 1e-9


@dataclass(frozen=True, eq=False)
class BankTable:
    """Mean density of fog banks along the rays of a camera.

    numbers: float32, flat: the head that `fog_bank_kernels` reads, and log2 of the means, which
        keeps the same share of a thin and of a dense bank.
    shape: number of climbs, headings and distances.
    """

    numbers: np.ndarray
    shape: tuple[int, int, int]

    @property
    def means(self) -> np.ndarray:
        """Return the means [climbs, headings, distances]."""
        return np.exp2(self.numbers[HEAD:].reshape(self.shape))

    @functools.cached_property
    def least(self) -> float:
        """Return the least mean of any ray."""
        return 2.0 ** float(self.numbers[HEAD:].min())


def bank_table(fog: Fog, camera: Camera) -> BankTable:
    """Return the table of a fog with banks before a pinhole camera."""
    pose = camera.world_from_camera.numpy()
    plain = replace(
        fog, airlight_rgb=(0.0, 0.0, 0.0), varying_airlight_rgb=None, elevation_gain=0.0
    )
    return _table(plain, pose[:3].tobytes())


@functools.lru_cache(maxsize=8)
def _table(fog: Fog, pose_bytes: bytes) -> BankTable:
    """Return the table for a camera's pose [3, 4]; a pure function, so that it may be kept."""
    pose = np.frombuffer(pose_bytes).reshape(3, 4)
    scales, logs = _log_means(fog, float(pose[0, 3]), float(pose[1, 3]))
    numbers = np.empty(HEAD + logs.size, np.float32)
    numbers[: kernels.H_PER_M] = pose[:, :3].reshape(-1)
    numbers[kernels.H_PER_M : kernels.H_SHAPE] = scales
    numbers[kernels.H_SHAPE : HEAD] = logs.shape
    numbers[HEAD:] = logs.reshape(-1)
    return BankTable(numbers, logs.shape)


@functools.lru_cache(maxsize=8)
def _log_means(fog: Fog, x_m: float, y_m: float) -> tuple[tuple[float, ...], np.ndarray]:
    """Return the head's numbers from H_PER_M on, and log2 of the means, of an eye's place."""
    banks = fog.banks
    assert banks is not None
    edges, nodes = _steps_of_rays(fog)
    num_headings = _num_headings(fog)
    climb_gain, climb_nodes = _climbs(fog)
    # Parabolas through a step's start, middle and end, under its weight.
    lengths = np.diff(edges)
    weights = _weights(np.outer(climb_nodes, lengths))
    shares = _shares(climb_nodes, edges)
    quarters = np.arange(num_headings) * 4 / num_headings
    turn = np.where(quarters < 2, quarters - 1, 3 - quarters)
    east = np.where(quarters < 2, 1 - np.abs(turn), np.abs(turn) - 1)
    headings = np.stack([east, turn], 1) / np.hypot(east, turn)[:, None]
    shape = (len(climb_nodes), REFINEMENT * num_headings + 1, int(nodes.max()) + 1)
    logs = np.empty(shape, np.float32)
    with kernel_threads():
        kernels.tabulate_means(
            np.array([x_m, y_m]),
            headings,
            edges,
            nodes,
            weights,
            shares,
            *bank_numbers(fog)[1:],
            REFINEMENT,
            logs,
        )
    max_climb = float(climb_nodes.max() * climb_gain) if len(climb_nodes) > 1 else 0.0
    scale_rate = 0.0 if fog.scale_height_m is None else 1 / fog.scale_height_m
    scales = (
        1 / (NEAR_STEPS * banks.finest_m),
        NODES_PER_DOUBLING,
        REFINEMENT * num_headings / 4,
        scale_rate * climb_gain,
        CLIMBS_PER_DOUBLING,
        max_climb,
    )
    return scales, logs


def _steps_of_rays(fog: Fog) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of the steps along rays, level metres, and the table's node at each."""
    banks = fog.banks
    assert banks is not None
    near_m = NEAR_STEPS * banks.finest_m
    num_nodes = math.ceil(math.log2(1 + far_distance(fog) / near_m) * NODES_PER_DOUBLING) + 1
    distances = near_m * (2 ** (np.arange(num_nodes) / NODES_PER_DOUBLING) - 1)
    edges = [np.zeros(1)]
    nodes = [np.zeros(1, np.int64)]
    for node in range(1, num_nodes):
        start_m, end_m = distances[node - 1 : node + 1]
        step_m = 2 * STEP * banks.finest_m + STEP_GROWTH * start_m
        count = math.ceil((end_m - start_m) / step_m)
        edges.append(start_m + (end_m - start_m) * np.arange(1, count + 1) / count)
        nodes.append(np.append(np.full(count - 1, -1), node))
    return np.concatenate(edges), np.concatenate(nodes)


def _num_headings(fog: Fog) -> int:
    """Return how many headings are integrated, a multiple of 4."""
    assert fog.banks is not None
    resolved_m = min(RESOLVED_DEPTH / max(fog.extinction_per_m, 1e-9), far_distance(fog))
    count = 2 * math.pi * resolved_m / (HEADING_STEP * fog.banks.finest_m)
    limit = MAX_HEADINGS if fog.scale_height_m is None else MAX_LAYERED_HEADINGS
    return 4 * math.ceil(min(max(count, MIN_HEADINGS), limit) / 4)


def _climbs(fog: Fog) -> tuple[float, np.ndarray]:
    """Return the distance that climbs are measured by, metres, and the nodes of climbs, 1/m.

    Nodes are level rays and, either way, climbs that grow by sinh.
    """
    if fog.scale_height_m is None:
        return 0.0, np.zeros(1)
    gain_m = 0.5 * RESOLVED_DEPTH / max(fog.extinction_per_m, 1e-9)
    gain_m = min(gain_m, far_distance(fog))
    largest = MAX_SLOPE / fog.scale_height_m * gain_m
    count = max(1, math.ceil(math.log2(largest + math.hypot(largest, 1)) * CLIMBS_PER_DOUBLING))
    nodes = np.arange(-count, count + 1) / CLIMBS_PER_DOUBLING
    return gain_m, np.sinh(nodes * math.log(2)) / gain_m


def _weights(kd: np.ndarray) -> np.ndarray:
    """Return weights of a step's start, middle and end for k times its length, [..., 3]."""
    x = np.where(np.abs(kd) < 1e-3, 1.0, np.clip(kd, -500, 500))
    centre = np.where(np.abs(kd) < 1e-3, 0.5 - kd / 12, 1 / x - 1 / np.expm1(x))
    x = np.clip(np.abs(kd), 0.1, 500)
    variance = 1 / np.square(x) - 0.25 / np.square(np.sinh(0.5 * x))
    variance = np.where(np.abs(kd) < 0.1, 1 / 12 - np.square(kd) / 240, variance)
    square = variance + np.square(centre)
    return np.stack(
        [1 - 3 * centre + 2 * square, 4 * (centre - square), 2 * square - centre], axis=-1
    )


def _shares(climbs: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the share of each step in the weight of a ray up to its end, [climbs, steps]."""
    start_m = edges[:-1]
    end_m = edges[1:]
    k = np.where(np.abs(climbs) * edges[-1] < 1e-6, 1e-6 / edges[-1], climbs)[:, None]
    rising = np.exp(-np.abs(k) * start_m) * np.expm1(-np.abs(k) * (end_m - start_m))
    falling = np.expm1(-np.abs(k) * (end_m - start_m))
    return np.where(k > 0, rising, falling) / np.expm1(-np.abs(k) * end_m)


def bank_numbers(fog: Fog) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Return what kernels read of banks: finest lattice step, lattices, seeds, log mean."""
    banks = fog.banks
    assert banks is not None
    return banks.finest_m, banks.lattices, banks.seeds, banks.log_mean


def far_distance(fog: Fog) -> float:
    """Return the level distance up to which rays are integrated, metres."""
    assert fog.banks is not None
    bank_m = fog.banks.bank_m
    opaque_m = MAX_DEPTH / max(fog.extinction_per_m, 1e-9)
    return min(max(opaque_m, MIN_BANKS * bank_m), MAX_BANKS * bank_m)


def image_means(
    fog: Fog, camera: Camera, depth: Float[Tensor, "H W"], *, backend: str = AUTO
) -> Float[Tensor, "H W"]:
    """Return the mean density of the banks before each pixel: the factor of its optical depth.

    Args:
        fog: fog with banks.
        camera: the camera.
        depth: z of what the pixels show, finite, metres.
        backend: on the CPU, pixels go through a kernel.
    """
    table = bank_table(fog, camera)
    if choose_kernels(backend, depth) == CPU:
        lens = np.array([1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy], np.float32)
        out = np.empty(tuple(depth.shape), np.float32)
        with kernel_threads(_ROWS_PER_CHUNK):
            kernels.look_up_image(table.numbers, lens, depth.detach().contiguous().numpy(), out)
        return torch.from_numpy(out)
    rays = camera.ray_directions(depth.dtype, depth.device)
    return look_up(table, rays * depth.clamp_max(kernels.FARTHEST_M)[..., None])


def point_means(fog: Fog, camera: Camera, offsets: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Return the mean density of the banks before points.

    Args:
        fog: fog with banks.
        camera: the camera.
        offsets: vectors from the eye to the points, in the world's axes, metres.
    """
    return look_up(bank_table(fog, camera), offsets)


def point_means_numpy(fog: Fog, camera: Camera, points_m: np.ndarray) -> np.ndarray:
    """Return `point_means` of points [..., 3] in the scene's world."""
    offsets = torch.from_numpy(np.asarray(points_m, np.float64)) - camera.centre
    return point_means(fog, camera, offsets).numpy()


def look_up(table: BankTable, offsets: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Return the table's means at offsets in the world: the definition of `look_up_image`."""
    head = table.numbers[:HEAD].tolist()
    num_climbs, num_headings, num_nodes = table.shape
    logs = torch.from_numpy(table.numbers[HEAD:]).to(offsets.device)
    east, north, up = offsets.unbind(-1)
    level = (east * east + north * north).sqrt()
    turn = north / (east.abs() + north.abs()).clamp_min(1e-30)
    turn = torch.where(east >= 0, turn, 2 - turn) + 1
    turn = (turn * head[kernels.H_QUARTER]).clamp(0, num_headings - 1)
    along = torch.log2(1 + level * head[kernels.H_PER_M]) * head[kernels.H_DOUBLING]
    along = along.clamp(0, num_nodes - 1)
    heading = turn.long().clamp_max(num_headings - 2)
    node = along.long().clamp_max(num_nodes - 2)
    turn = turn - heading
    along = along - node
    first = heading * num_nodes + node

    def node_value(start: Tensor) -> Tensor:
        """Return the value between two nodes of a heading."""
        value = logs[start].to(offsets.dtype)
        return torch.lerp(value, logs[start + 1].to(offsets.dtype), along)

    def layer_value(start: Tensor) -> Tensor:
        """Return the value between four neighbours at one climb."""
        return torch.lerp(node_value(start), node_value(start + num_nodes), turn)

    if num_climbs == 1:
        return torch.exp2(layer_value(first))
    climb = (up.abs() * head[kernels.H_CLIMB]) / level.clamp_min(1e-30)
    climb = climb.clamp_max(head[kernels.H_MAX_CLIMB])
    climb = torch.log2(climb + (climb * climb + 1).sqrt()) * head[kernels.H_CLIMBS]
    climb = torch.where(up >= 0, climb, -climb) + (num_climbs - 1) // 2
    climb = climb.clamp(0, num_climbs - 1)
    layer = climb.long().clamp_max(num_climbs - 2)
    stride = num_headings * num_nodes
    first = first + layer * stride
    return torch.exp2(torch.lerp(layer_value(first), layer_value(first + stride), climb - layer))


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
    directions = np.asarray(directions, np.float64)
    level = np.linalg.norm(directions[:, :2], axis=1)
    safe_level = np.maximum(level, _MIN_LEVEL_M)
    scale_rate = 0.0 if fog.scale_height_m is None else 1 / fog.scale_height_m
    distances = np.nan_to_num(distances_m, nan=0.0) * level
    places = np.broadcast_to(origins_m, directions.shape)[:, :2]
    out = np.empty(len(directions))
    with kernel_threads():
        kernels.means_of_rays(
            np.ascontiguousarray(places, np.float64),
            np.ascontiguousarray(directions[:, :2] / safe_level[:, None]),
            np.clip(distances, 0.0, far_distance(fog)),
            scale_rate * directions[:, 2] / safe_level,
            *bank_numbers(fog),
            out,
        )
    return out


def densities_at(fog: Fog, points_m: np.ndarray) -> np.ndarray:
    """Return the banks' density at points [N, 3], relative to its mean."""
    points = np.asarray(points_m, np.float64)
    directions = np.broadcast_to([1.0, 0.0, 0.0], points.shape)
    return ray_means(fog, points, directions, np.zeros(len(points)))


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
# Number of those rays, across the image.
NUM_LOCAL_RAYS = 9


def local_fog(fog: Fog | None, camera: Camera) -> Fog | None:
    """Return plain fog as dense as fog with banks is around a camera, on average over its image.

    It is for what happens close to the camera, such as drops in fog.
    """
    if fog is None or fog.banks is None:
        return fog
    rotation = camera.world_from_camera[:3, :3]
    u = torch.linspace(-0.5, 0.5, NUM_LOCAL_RAYS) * camera.width / camera.fx
    rays = torch.stack([u, torch.zeros_like(u), torch.ones_like(u)], 1).double() @ rotation.T
    rays = LOCAL_M * rays / rays.norm(dim=1, keepdim=True)
    mean = float(point_means(fog, camera, rays).mean())
    return replace(fog, extinction_per_m=mean * fog.extinction_per_m, banks=None)
