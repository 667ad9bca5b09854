"""Warped consistency on planes whose pictures are known exactly."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scenes import camera_ahead

from augment.metrics.consistency import DepthView, warp_view, warped_consistency

WALL_M = 8.0


def wall_color(y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Linear in the plane: bilinear interpolation of it has no error."""
    return np.stack([0.5 + 0.05 * y, 0.5 - 0.04 * z, 0.4 + 0.03 * (y + z)], -1)


def view_of_wall(camera, *, wall_m: float = WALL_M, shift: float = 0.0) -> DepthView:
    """The plane x = wall_m seen from anywhere before it, its colours raised by `shift`."""
    rays = camera.ray_directions(torch.float64).numpy()
    centre = camera.centre.numpy()
    depth = (wall_m - centre[0]) / rays[..., 0]  # rays have unit depth
    hit = centre + depth[..., None] * rays
    return DepthView(
        camera, wall_color(hit[..., 1], hit[..., 2]) + shift, depth, np.ones_like(depth)
    )


def moved(**kwargs):
    return camera_ahead(61, 41, 50.0, **kwargs)


@pytest.mark.parametrize("yaw", [0.0, 0.1, -0.2])
@pytest.mark.parametrize("position", [(0, 0, 0), (0.3, 0.5, -0.2), (-1, -0.7, 0.3)])
def test_a_wall_agrees_with_itself(yaw, position):
    a, b = view_of_wall(moved()), view_of_wall(moved(position=position, yaw=yaw))
    found = warped_consistency(a, b)
    # Perspective bends the linear colours within a pixel where the wall is seen at an angle.
    assert found.rmse < (1e-12 if yaw == 0 else 2e-5)
    assert found.share > 0.5


def test_an_offset_is_the_error():
    a, b = view_of_wall(moved()), view_of_wall(moved(position=(0, 0.4, 0)), shift=0.07)
    found = warped_consistency(a, b)
    assert found.rmse == pytest.approx(0.07, rel=1e-9)
    assert found.relative == pytest.approx(0.07 / found.spread, rel=1e-9)


def test_the_share_is_the_overlap():
    """A camera moved sideways by whole pixels loses as many columns, and one for its bilinear."""
    camera = moved()
    step = WALL_M / camera.fx  # of a pixel, metres
    b = view_of_wall(moved(position=(0, -7.25 * step, 0)))
    _, counts = warp_view(view_of_wall(camera), b)
    assert counts.any(1)[:-1].all()
    columns = counts[:-1].all(0)
    # Pixel c of A lies at c - 7.25 of B: from 8 on; the last row and column have no neighbour.
    assert not columns[:8].any() and columns[8:].all()


def test_linear_maps_scale_the_error_and_not_the_relative_one():
    a, b = view_of_wall(moved()), view_of_wall(moved(position=(0, 0.4, 0)), shift=0.02)
    one = warped_consistency(a, b)
    paler = [dataclasses.replace(v, picture=0.3 + 0.5 * v.picture) for v in (a, b)]
    other = warped_consistency(*paler)
    assert other.rmse == pytest.approx(one.rmse / 2, rel=1e-9)
    assert other.relative == pytest.approx(one.relative, rel=1e-9)


def test_what_is_hidden_does_not_count():
    """A board before the wall hides a part of it from B only."""
    a = view_of_wall(moved())
    b = view_of_wall(moved(position=(0, 0.5, 0)))
    board = slice(10, 30), slice(20, 40)
    b.depth_m[board] = 3.0
    b.picture[board] = 0.9
    warped, counts = warp_view(a, b)
    found = warped_consistency(a, b)
    free = warped_consistency(a, view_of_wall(b.camera))
    assert found.rmse < 1e-12
    assert found.share == pytest.approx(
        free.share - 21 * 21 / counts.size, abs=2 * 21 / counts.size
    )
    assert (warped[~counts] == 0).all()


def test_a_board_in_a_does_not_count_where_b_sees_past_it():
    a, b = view_of_wall(moved()), view_of_wall(moved(position=(0, 0.5, 0)))
    a.depth_m[5:15, 5:25] = 3.0
    a.picture[5:15, 5:25] = 0.0
    _, counts = warp_view(a, b)
    assert not counts[5:15, 5:25].any()
    assert warped_consistency(a, b).rmse < 1e-12


@pytest.mark.parametrize("side", ["a", "b"])
def test_the_sky_does_not_count(side):
    views = {"a": view_of_wall(moved()), "b": view_of_wall(moved(position=(0, 0.1, 0)))}
    views[side].alpha[:20] = 0.5
    views[side].picture[:20] = 1.0
    found = warped_consistency(views["a"], views["b"])
    assert found.rmse < 1e-12 and 0.2 < found.share < 0.55


def test_nothing_in_common_gives_nan():
    a, b = view_of_wall(moved()), view_of_wall(moved())
    b = dataclasses.replace(b, camera=moved(yaw=math.pi))
    found = warped_consistency(a, b)
    assert found.share == 0 and math.isnan(found.rmse) and math.isnan(found.relative)
    b.depth_m[:] = math.nan
    assert warped_consistency(b, a).share == 0


def test_sizes_must_fit():
    view = view_of_wall(moved())
    with pytest.raises(ValueError, match=r"alpha must be floats \[41, 61\].*\[61, 41\]"):
        dataclasses.replace(view, alpha=view.alpha.T)
