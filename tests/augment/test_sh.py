import math

import numpy as np
import pytest
import torch

from augment.geometry import rotmat_from_quat
from augment.render.sh import SH_C0, evaluate_sh, rotate_sh, sh_basis


def _directions(count, seed=0):
    rng = np.random.default_rng(seed)
    vectors = torch.from_numpy(rng.normal(size=(count, 3)))
    return torch.nn.functional.normalize(vectors, dim=-1)


def _rotation(seed):
    return rotmat_from_quat(torch.from_numpy(np.random.default_rng(seed).normal(size=4)))


def _coefficients(count, degree, seed=1):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.normal(size=(count, (degree + 1) ** 2, 3)))


def test_basis_is_orthonormal_over_the_sphere():
    # Gauss-Legendre in z and equal steps in azimuth integrate polynomials of degree 6 exactly.
    nodes, weights = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * (2 * math.pi / 16)
    z, phi = np.meshgrid(nodes, azimuth, indexing="ij")
    radius = np.sqrt(1 - z * z)
    points = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], -1)
    basis = sh_basis(torch.from_numpy(points), 3).numpy()
    area = weights[:, None] * (2 * math.pi / 16)
    gram = np.einsum("ij,ijk,ijl->kl", np.broadcast_to(area, z.shape), basis, basis)
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-13)


def test_signs_and_order_of_the_trained_convention():
    x, y, z = torch.eye(3, dtype=torch.float64)
    c1 = 0.4886025119029199
    torch.testing.assert_close(sh_basis(x, 1)[1:], torch.tensor([0.0, 0.0, -c1]).double())
    torch.testing.assert_close(sh_basis(y, 1)[1:], torch.tensor([-c1, 0.0, 0.0]).double())
    torch.testing.assert_close(sh_basis(z, 1)[1:], torch.tensor([0.0, c1, 0.0]).double())
    diagonal = torch.full((3,), 1 / math.sqrt(3), dtype=torch.float64)
    signs = torch.sign(sh_basis(diagonal, 3)[[4, 5, 7, 9, 10, 11, 12, 13, 15]])
    assert signs.tolist() == [1, -1, -1, -1, 1, -1, -1, -1, 1]


def test_constant_band():
    sh = torch.tensor([[[0.5, -1.0, 2.0]]])
    torch.testing.assert_close(evaluate_sh(sh, torch.tensor([[0.0, 0.0, 1.0]])), sh[:, 0] * SH_C0)


@pytest.mark.parametrize("cut", [0, 1, 2, 3])
def test_max_degree_leaves_higher_bands_out(cut):
    sh, directions = _coefficients(5, 3), _directions(5)
    kept = sh[:, : (cut + 1) ** 2]
    assert torch.equal(evaluate_sh(sh, directions, cut), evaluate_sh(kept, directions))


def test_max_degree_above_what_is_held_changes_nothing():
    sh, directions = _coefficients(5, 1), _directions(5)
    assert torch.equal(evaluate_sh(sh, directions, 3), evaluate_sh(sh, directions))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotating_equals_looking_from_the_inversely_rotated_direction(degree):
    sh, directions, rotation = _coefficients(7, degree), _directions(7), _rotation(2)
    turned = evaluate_sh(rotate_sh(sh, rotation), directions)
    expected = evaluate_sh(sh, directions @ rotation)  # rows R^T d
    torch.testing.assert_close(turned, expected, rtol=0, atol=1e-12)  # float64 rounding


def test_rotations_compose():
    sh, first, second = _coefficients(4, 3), _rotation(3), _rotation(4)
    stepwise = rotate_sh(rotate_sh(sh, first), second)
    torch.testing.assert_close(stepwise, rotate_sh(sh, second @ first), rtol=0, atol=1e-12)


def test_rotation_keeps_the_energy_of_each_band_and_the_dtype():
    sh = _coefficients(4, 3).float()
    turned = rotate_sh(sh, _rotation(5))
    assert turned.dtype == torch.float32
    for band in range(4):
        of_band = slice(band * band, (band + 1) ** 2)
        before, after = sh[:, of_band].norm(), turned[:, of_band].norm()
        torch.testing.assert_close(after, before, rtol=1e-6, atol=0)  # float32 rounding


def test_no_gaussians():
    empty = torch.zeros(0, 16, 3)
    assert evaluate_sh(empty, torch.zeros(0, 3)).shape == (0, 3)
    assert rotate_sh(empty, torch.eye(3)).shape == (0, 16, 3)


def test_gradients():
    sh = _coefficients(3, 3).requires_grad_()
    directions = _directions(3).requires_grad_()
    assert torch.autograd.gradcheck(evaluate_sh, (sh, directions))


def test_unknown_degree_is_refused():
    with pytest.raises(ValueError, match="degree must be 0 to 3; got 4"):
        sh_basis(torch.zeros(1, 3), 4)
