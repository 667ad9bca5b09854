"""Real spherical harmonics of degrees 0 to 3 in the order and signs that splats are trained with.

Band l holds 2 l + 1 functions, m = -l .. l, orthonormal over the sphere, with the Condon-Shortley
phase: band 1 is (-y, z, -x) times sqrt(3 / 4 pi). K = (degree + 1)^2 counts all bands.
Green 2003, "Spherical harmonic lighting: the gritty details", lists the polynomials.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

# Highest degree.
MAX_DEGREE = 3
# The constant function of band 0.
SH_C0 = 0.5 * math.sqrt(1 / math.pi)
# Factors of the polynomials of bands 1 to 3, named by the polynomial.
C1 = math.sqrt(3 / (4 * math.pi))
C2_XY = math.sqrt(15 / (4 * math.pi))
C2_ZZ = math.sqrt(5 / (16 * math.pi))
C2_XX = 0.5 * C2_XY
C3_CUBIC = math.sqrt(35 / (32 * math.pi))
C3_XYZ = math.sqrt(105 / (4 * math.pi))
C3_ZZ = math.sqrt(21 / (32 * math.pi))
C3_ZZZ = math.sqrt(7 / (16 * math.pi))
C3_ZXX = 0.5 * C3_XYZ


def sh_basis(directions: Float[Tensor, "*B 3"], degree: int) -> Float[Tensor, "*B K"]:
    """Return every basis function up to `degree` at unit directions."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree must be 0 to {MAX_DEGREE}; got {degree}")
    x, y, z = directions.unbind(-1)
    xx = x * x
    yy = y * y
    zz = z * z
    values = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        values += [
            C2_XY * x * y,
            -C2_XY * y * z,
            C2_ZZ * (2 * zz - xx - yy),
            -C2_XY * x * z,
            C2_XX * (xx - yy),
        ]
    if degree >= 3:
        values += [
            -C3_CUBIC * y * (3 * xx - yy),
            C3_XYZ * x * y * z,
            -C3_ZZ * y * (4 * zz - xx - yy),
            C3_ZZZ * z * (2 * zz - 3 * xx - 3 * yy),
            -C3_ZZ * x * (4 * zz - xx - yy),
            C3_ZXX * z * (xx - yy),
            -C3_CUBIC * x * (xx - 3 * yy),
        ]
    return torch.stack(values, -1)


def evaluate_sh(
    sh: Float[Tensor, "N K 3"], directions: Float[Tensor, "N 3"], max_degree: int | None = None
) -> Float[Tensor, "N 3"]:
    """Return the sum of sh times basis for every splat; 0.5 is not added and nothing is clamped.

    Args:
        sh: coefficients.
        directions: unit vectors from the eye to the splats.
        max_degree: highest band that is evaluated; None for all bands that sh holds.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    if max_degree is not None:
        degree = min(degree, max_degree)
    basis = sh_basis(directions, degree)  # [N, K']
    return (basis[:, :, None] * sh[:, : basis.shape[1]]).sum(1)


def rotate_sh(sh: Float[Tensor, "N K 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "N K 3"]:
    """Return the coefficients of the function turned by `rotation`: f'(R d) = f(d), exact in every
    band.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    matrix = sh_rotation(rotation, degree).to(sh.dtype)
    bands = [slice(band * band, (band + 1) ** 2) for band in range(degree + 1)]
    return torch.cat([torch.einsum("ij,njc->nic", matrix[b, b], sh[:, b]) for b in bands], 1)


def sh_rotation(rotation: Float[Tensor, "3 3"], degree: int) -> Float[Tensor, "K K"]:
    """Return the matrix that turns coefficients by a rotation, float64; it has a block for each
    band.

    A rotation mixes the functions of one band only. So each block follows from the values at more
    directions than the band has functions: Y(d) c' = Y(R^T d) c.
    """
    directions, inverses = _turn_solver(degree)
    turned_basis = sh_basis(
        directions @ rotation.to(torch.float64), degree
    ).numpy()  # at rows R^T d
    matrix = np.zeros((turned_basis.shape[1], turned_basis.shape[1]))
    for band, inverse in enumerate(inverses):
        block = slice(band * band, (band + 1) ** 2)
        matrix[block, block] = inverse @ turned_basis[:, block]
    return torch.from_numpy(matrix)


@functools.lru_cache(maxsize=MAX_DEGREE + 1)
def _turn_solver(degree: int) -> tuple[Tensor, tuple[np.ndarray, ...]]:
    """Return sample directions, and for each band the pseudo-inverse of its functions there."""
    directions = _sphere_samples(4 * (degree + 1) ** 2)
    basis = sh_basis(directions, degree).numpy()
    bands = range(degree + 1)
    return directions, tuple(np.linalg.pinv(basis[:, b * b : (b + 1) ** 2]) for b in bands)


def _sphere_samples(count: int) -> Float[Tensor, "S 3"]:
    """Return evenly spread unit vectors on a Fibonacci spiral, float64. They suit any band
    numerically.
    """
    step = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * step + 1) / count
    angle = step * (math.pi * (3 - math.sqrt(5)))
    radius = torch.sqrt(1 - z * z)
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), z], -1)


# ---- Constants of the kernels that fold colour maps into spherical harmonics, on CPU and GPU -----

# Numbers of a folded map: 9 of its matrix row by row, 3 that are added to the first function, and
# one that is not 0 if the map changes anything.
NUM_FOLDED = 13
# First coefficient of a colour of 0.
BLACK_SH_00 = np.float32(-0.5 / SH_C0)
