"""Up and scale of splat files that say neither: found in any pose, or refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from splat_scenes import gaussians_at, street

from adapters.camera_files.camera_files import look_at_pose
from adapters.camera_files.paths import solid_points
from adapters.gaussian_files import doubt_about_metres, find_ground, scale_from_cameras
from adapters.world import parse_up, rotation_to_z_up
from augment.scene import Gaussians

TILTED = "0.25,-0.9,0.3"


def posed(gaussians: Gaussians, up: str, unit: float = 1.0) -> Gaussians:
    """Balls of a z-up world as a file whose `up` points up stores them, in units of `unit` m."""
    turn = torch.from_numpy(rotation_to_z_up(parse_up(up)).T).float()
    return Gaussians(
        **{
            **vars(gaussians),
            "means": gaussians.means @ turn.T / unit,
            "scales": gaussians.scales / unit,
        }
    )


def box(count: int, low: list[float], high: list[float]) -> torch.Tensor:
    rng = torch.Generator().manual_seed(count)
    first, last = torch.tensor(low), torch.tensor(high)
    return first + (last - first) * torch.rand(count, 3, generator=rng)


def with_strays(gaussians: Gaussians, share: float) -> Gaussians:
    """And that many balls hundreds of metres away, on all sides."""
    rng = torch.Generator().manual_seed(5)
    far = 300 * torch.randn(int(share * len(gaussians)), 3, generator=rng)
    return gaussians_at(torch.cat([gaussians.means, far]))


@pytest.mark.parametrize("up", ["+z", "-z", "+y", "-y", "+x", TILTED])
def test_up_is_found_in_any_pose_and_unit_among_strays(up: str) -> None:
    found = find_ground(posed(with_strays(street(), 0.2), up, 7.3))
    assert found is not None and found.is_clear
    # An axis exactly; else what a plane through voxels of a road with cars on it can tell.
    off_deg = math.degrees(math.acos(min(1.0, float(found.up @ parse_up(up)))))
    assert off_deg < 1e-5 if up != TILTED else off_deg < 1.0


def test_what_has_no_clear_ground_is_not_guessed_at() -> None:
    rng = torch.Generator().manual_seed(2)
    cloud = torch.randn(4000, 3, generator=rng)
    room = [
        box(3000, [0, 0, 0], [6, 5, 0.01]), box(3001, [0, 0, 2.99], [6, 5, 3]),
        box(3002, [0, 0, 0], [6, 0.01, 3]), box(3003, [0, 4.99, 0], [6, 5, 3]),
    ]  # fmt: skip
    corner = [box(3000, [0, 0, 0], [9, 9, 0.01]), box(3001, [0, 0, 0], [9, 0.01, 9])]
    refused = {
        "a blob": cloud,
        "a ball": torch.nn.functional.normalize(cloud, dim=1),
        "a floor under a ceiling": torch.cat(room),
        "a floor and a wall of its size": torch.cat(corner),
        "twenty points": cloud[:20],
        "one place": torch.ones(4000, 3),
    }
    for what, means in refused.items():
        found = find_ground(gaussians_at(means))
        assert found is None or not found.is_clear, what


def test_cameras_decide_between_a_floor_and_a_wall_of_its_size() -> None:
    corner = gaussians_at(
        torch.cat([box(3000, [0, 0, 0], [9, 9, 0.01]), box(3001, [0, 0, 0], [9, 0.01, 9])])
    )
    leaning = np.array([0.2, 0.1, 0.97]) / np.linalg.norm([0.2, 0.1, 0.97])
    found = find_ground(corner, near=leaning)
    assert found is not None and found.is_clear and found.up.tolist() == [0, 0, 1]


def poses(height: float, *, pitch_deg: float = 0.0, jump: float = 0.0) -> np.ndarray:
    """Along the street of heading 0; jump: every second camera's additional height."""
    eyes = [(2.0 * n + 5, 0.0, height + jump * (n % 2)) for n in range(20)]
    drop = math.tan(math.radians(pitch_deg))
    return np.stack([look_at_pose(e, (e[0] + 1, 0.0, e[2] - drop), where="test") for e in eyes])


def test_cameras_above_the_ground_give_the_unit() -> None:
    points = solid_points(street(heading_deg=0))
    for height in (1.2, 1.6, 2.0):  # the unit is a metre, and stays so to the bit
        found = scale_from_cameras(points, poses(height))
        assert found is not None and found[0] == 1.0
    for unit in (0.1, 4.0):
        scaled = poses(1.6)
        scaled[:, :3, 3] /= unit
        found = scale_from_cameras(points / unit, scaled)
        # Splats lie up to 2 cm about the road, and strays below it.
        assert found is not None and found[0] == pytest.approx(unit, rel=0.05)
        assert "give or take a quarter" in found[1]
    assert scale_from_cameras(points, poses(9.0, pitch_deg=60)) is None  # a drone's
    assert scale_from_cameras(points, poses(1.6, jump=9)) is None
    assert scale_from_cameras(points + 50.0, poses(1.6)) is None  # nothing under them


def test_streets_may_be_in_metres_and_other_sizes_may_not() -> None:
    gaussians = street()
    points = solid_points(gaussians)
    assert doubt_about_metres(points, gaussians.scales) is None
    for unit in (0.1, 100.0):
        doubt = doubt_about_metres(points / unit, gaussians.scales / unit)
        assert doubt is not None and "wide (10 to 2000 expected)" in doubt
    assert "splat" in str(doubt_about_metres(points, 20 * gaussians.scales))
