"""The hash of `augment.rng`, for kernels: random numbers that depend on a key and nothing else."""

from __future__ import annotations

import numpy as np

from augment.render.cpu.jit import kernel_function
from augment.rng import MIX_A, MIX_B

_A = np.uint64(MIX_A)
_B = np.uint64(MIX_B)
_S27, _S30, _S31 = (np.uint64(s) for s in (27, 30, 31))


@kernel_function()
def mix(bits):
    """Return the mixed bits of `augment.rng.mix`, for one uint64."""
    bits = (bits ^ (bits >> _S30)) * _A
    bits = (bits ^ (bits >> _S27)) * _B
    return bits ^ (bits >> _S31)
