"""Kernels of light on surfaces against plain definitions: wide means, shadows, pixels of nodes."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from augment.lamps import surface_light_kernels as light_kernels
from augment.lamps import surface_normal_kernels as normal_kernels
from augment.lamps.beam_shadows import BeamShadows
from augment.lamps.lamp import EGO_OWNER, LampKind
from augment.lamps.surface_light import illuminance, surface_light
from augment.lamps.surface_light_kernels import ShadowArrays
from augment.lamps.surface_normal_kernels import SAME_SURFACE
from augment.lamps.surface_normals import find_nodes, node_view
from augment.lamps.surface_spread_kernels import OTHER_SURFACE_WEIGHT
from augment.scene.cameras import Camera
from tests.lamp_scenes import camera_at, lamps_at, road_depth


def broken_road(camera: Camera) -> np.ndarray:
    """Return the depth of a rough road with a wall, a post before it, and sky."""
    rng = np.random.default_rng(4)
    depth = road_depth(camera, 60.0)
    depth *= 1 + 0.01 * rng.standard_normal(depth.shape).astype(np.float32)
    columns = np.arange(camera.width)
    is_wall = (columns > camera.width // 2)[None] & ((depth > 15) | (depth == 0))
    depth = np.where(is_wall, np.float32(15), depth)
    depth[:, 20:23] = 6
    depth[: camera.height // 4] = 0
    return np.ascontiguousarray(depth, np.float32)


def inverse_of(depth: np.ndarray) -> np.ndarray:
    return np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)


def blurred(values: np.ndarray, window: tuple[int, int], border: int) -> np.ndarray:
    return cv2.blur(values, window, borderType=border)


def smoothed(normals: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return normals, those of ground and walls as means over windows: the plain definition."""
    zeros = cv2.BORDER_CONSTANT
    mirrored = cv2.BORDER_REFLECT_101
    share = np.clip((normals[..., 2] - 0.766) / (0.906 - 0.766), 0, 1)
    mean = normals * share[..., None]
    near = blurred(share, (33, 17), mirrored)
    near_inverse = blurred(share * inverse, (33, 17), mirrored)
    is_near = np.abs(inverse * near - near_inverse) < 0.03 * near_inverse
    share = np.maximum(share, np.where(is_near, np.clip((near - 0.45) / 0.2, 0, 1), 0))
    for _ in range(2):
        mean = blurred(mean, (65, 17), zeros)
    mean /= np.maximum(np.linalg.norm(mean, axis=2, keepdims=True), 1e-6)
    normals = normals + share[..., None] * (mean - normals)
    lengths = np.linalg.norm(normals, axis=2)
    weights = np.clip((lengths - 0.8) / 0.15, 0, 1)
    weights *= np.clip((0.906 - normals[..., 2]) / (0.906 - 0.766), 0, 1)
    total = blurred(weights, (49, 49), zeros)
    near_inverse = blurred(weights * inverse, (49, 49), zeros)
    mean = blurred(normals * weights[..., None], (49, 49), zeros)
    mean *= (lengths / np.maximum(np.linalg.norm(mean, axis=2), 1e-6))[..., None]
    gap = np.abs(inverse * total - near_inverse) / np.maximum(near_inverse, 1e-12)
    share = weights * np.clip(2 - gap / 0.02, 0, 1)
    return normals + share[..., None] * (mean - normals)


@pytest.mark.parametrize("size", [(331, 207), (40, 9)])
def test_wide_means_of_normals_equal_their_definition(size: tuple[int, int]) -> None:
    camera = camera_at(1.5, width=size[0], height=size[1], focal_px=250)
    depth = broken_road(camera)
    nodes = find_nodes(camera, depth, step_px=1)
    inverse = inverse_of(depth)
    slopes = np.empty((*depth.shape, 3), np.float32)
    normals = np.empty_like(slopes)
    normal_kernels.find_slopes(inverse, node_view(camera, 1), slopes)
    normal_kernels.average_normals(inverse, slopes, normals)
    error = np.abs(nodes.normals - smoothed(normals, inverse)).max(2)
    # Where a node is hardly near enough to the ground about it, rounding decides.
    assert np.quantile(error, 0.995) < 2e-4
    assert not np.array_equal(nodes.normals, normals)


def shadows_of(place: np.ndarray) -> BeamShadows:
    """Return a map with things at random depths, seen from a place along x."""
    inverse = np.random.default_rng(2).uniform(0, 0.2, (1, 64, 96)).astype(np.float32)
    inverse[:, :, :30] = 0
    rotation = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], np.float64)
    pose = np.concatenate([rotation, -(rotation @ place)[:, None]], 1)[None]
    lens = np.array([[60.0, 60, 48, 32]])
    arrays = ShadowArrays(inverse, pose, lens, np.array([0.1, 8e-4]))
    return BeamShadows(arrays, place[None], np.array([[1.0, 0, 0]]))


def test_own_light_is_shaded_by_the_map() -> None:
    camera = camera_at(1.5, width=203, height=131, focal_px=120)
    depth = road_depth(camera, 40.0)
    place = np.array([0.5, 0.1, 0.65])
    own = lamps_at([place.tolist()], (1, 0, 0), candela=1e4, kind=LampKind.DIPPED, owner=EGO_OWNER)
    shadows = shadows_of(place)
    nodes = find_nodes(camera, depth, step_px=1)
    white = np.ones((*depth.shape, 3), np.float32)
    lit = surface_light(own, camera, depth, white, nodes=nodes, shadows=shadows)
    points = camera.centre.numpy() + camera.ray_directions().double().numpy() * depth[..., None]
    points = points.reshape(-1, 3)
    normals = nodes.normals.astype(np.float64).reshape(-1, 3)
    lux = illuminance(own, points, normals)[:, 0]
    shares = [light_kernels.lit_share.py_func(shadows.arrays, 0, *point) for point in points]
    expected = (lux * shares).reshape(depth.shape) / math.pi
    expected[depth == 0] = 0
    # Depths of the map change by their whole size from pixel to pixel, within one tolerance.
    np.testing.assert_allclose(lit[..., 1], expected, rtol=1e-3, atol=1e-4 * expected.max())
    is_lit = np.array(shares).reshape(depth.shape)[depth > 0] > 0.5
    assert 0.05 < is_lit.mean() < 0.95


@pytest.mark.parametrize("step", [2, 3, 4])
def test_pixels_take_the_light_of_nodes_on_their_surface(step: int) -> None:
    camera = camera_at(1.5, width=97, height=61, focal_px=80)
    depth = broken_road(camera)
    lamps = lamps_at([(8, 1, 4), (14, -4, 2)], candela=3000, color=(1.3, 0.9, 0.5))
    reflectance = np.random.default_rng(3).uniform(0, 1, (61, 97, 3)).astype(np.float32)
    nodes = find_nodes(camera, depth, step_px=step)
    lit = surface_light(lamps, camera, depth, reflectance, nodes=nodes)
    lux = node_lux(lamps, camera, nodes, step)
    expected = spread(depth, nodes.depth, lux, step) * reflectance / math.pi
    np.testing.assert_allclose(lit, expected, rtol=1e-4, atol=1e-5)


def node_lux(lamps, camera: Camera, nodes, step: int) -> np.ndarray:
    """Return the lux of the nodes by the light of a picture whose pixels they are."""
    first = step // 2
    small = Camera(
        "nodes",
        nodes.depth.shape[1],
        nodes.depth.shape[0],
        camera.fx / step,
        camera.fy / step,
        (camera.cx - first - 0.5) / step + 0.5,
        (camera.cy - first - 0.5) / step + 0.5,
        camera.camera_from_world,
        camera.timestamp_ns,
    )
    white = np.ones((*nodes.depth.shape, 3), np.float32)
    one = type(nodes)(nodes.depth, nodes.normals, 1)
    return surface_light(lamps, small, nodes.depth, white, nodes=one) * math.pi


def spread(depth: np.ndarray, node_depth: np.ndarray, lux: np.ndarray, step: int) -> np.ndarray:
    """Return the lux of pixels: the plain definition of `spread_light`."""
    inverse = inverse_of(node_depth)
    rows, columns = inverse.shape
    out = np.zeros((*depth.shape, 3))
    for row, column in np.argwhere(depth > 0):
        v = min(max((row - step // 2) / step, 0), rows - 1)
        u = min(max((column - step // 2) / step, 0), columns - 1)
        total = 0.0
        for i in {int(v), min(int(v) + 1, rows - 1)}:
            for j in {int(u), min(int(u) + 1, columns - 1)}:
                if inverse[i, j] <= 0:
                    continue
                gap = (inverse[i, j] * depth[row, column] - 1) / SAME_SURFACE
                weight = max(1 - abs(v - i), 0) * max(1 - abs(u - j), 0)
                weight *= max(1 - gap * gap, OTHER_SURFACE_WEIGHT)
                total += weight
                out[row, column] += weight * lux[i, j]
        out[row, column] /= max(total, 1e-12)
    return out
