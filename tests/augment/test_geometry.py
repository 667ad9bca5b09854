import math

import pytest
import torch

from augment.geometry import (
    invert_rigid,
    multiply_quats,
    quat_from_rotmat,
    rigid,
    rotmat_from_quat,
    slerp,
    transform_points,
)

# float64 arithmetic of a few dozen operations: 1e-12 leaves four digits of slack.
EXACT = 1e-12


def random_quats(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(quats, dim=-1)


def test_rotation_matrices_are_proper_and_round_trip():
    quats = random_quats(100)
    rotations = rotmat_from_quat(3.0 * quats)  # length does not matter
    identity = torch.eye(3, dtype=torch.float64).expand(100, 3, 3)
    assert torch.allclose(rotations @ rotations.transpose(1, 2), identity, atol=EXACT)
    assert torch.allclose(torch.det(rotations), torch.ones(100, dtype=torch.float64), atol=EXACT)
    back = quat_from_rotmat(rotations)
    sign = torch.sign((back * quats).sum(-1, keepdim=True))
    assert torch.allclose(back, sign * quats, atol=EXACT)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_round_trip(axis):
    """The trace formula divides by zero at these rotations."""
    quat = torch.zeros(4, dtype=torch.float64)
    quat[axis + 1] = 1
    rotation = rotmat_from_quat(quat)
    assert torch.allclose(rotmat_from_quat(quat_from_rotmat(rotation)), rotation, atol=EXACT)


def test_quarter_turns_compose():
    quarter = torch.tensor([math.sqrt(0.5), 0, 0, math.sqrt(0.5)], dtype=torch.float64)
    half = multiply_quats(quarter, quarter)
    x = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    assert torch.allclose(rotmat_from_quat(quarter) @ x, x.roll(1), atol=EXACT)  # x -> y
    assert torch.allclose(rotmat_from_quat(half) @ x, -x, atol=EXACT)


def test_product_of_quaternions_is_product_of_matrices():
    a, b = random_quats(50), random_quats(50).flip(0)
    expected = rotmat_from_quat(a) @ rotmat_from_quat(b)
    assert torch.allclose(rotmat_from_quat(multiply_quats(a, b)), expected, atol=EXACT)


def test_slerp_moves_at_constant_speed_the_shorter_way():
    a = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    angle = 1.2
    b = torch.tensor([math.cos(angle / 2), 0, 0, math.sin(angle / 2)], dtype=torch.float64)
    for fraction in (0.0, 0.25, 0.5, 1.0):
        at = slerp(a, -b, torch.tensor(fraction, dtype=torch.float64))  # -b is the same rotation
        expected = [math.cos(angle * fraction / 2), 0, 0, math.sin(angle * fraction / 2)]
        assert torch.allclose(at, torch.tensor(expected, dtype=torch.float64), atol=EXACT)


def test_slerp_of_equal_rotations_has_no_nan():
    q = random_quats(1)[0]
    assert torch.allclose(slerp(q, q, torch.tensor(0.3, dtype=torch.float64)), q, atol=EXACT)


def test_inverse_of_rigid_transform():
    transform = rigid(rotmat_from_quat(random_quats(1)[0]), torch.tensor([1.0, -2, 3]).double())
    points = torch.randn(10, 3, dtype=torch.float64)
    back = transform_points(invert_rigid(transform), transform_points(transform, points))
    assert torch.allclose(back, points, atol=EXACT)
