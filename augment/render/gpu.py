"""The GPU that Triton's kernels run on: which one it is, what has been copied to it, launches.

Nothing here is imported or compiled before a backend that needs it is asked for. With
TRITON_INTERPRET=1 set before the kernels are imported, Triton runs them in Python on CPU tensors
instead: thousands of times slower, and so for small tests, but everywhere.
"""

from __future__ import annotations

import functools
import weakref
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.errors import BackendUnavailable


def check_can_run() -> None:
    """Raises BackendUnavailable, which says why Triton's kernels cannot run here."""
    obstacle = _obstacle()
    if obstacle is not None:
        raise BackendUnavailable(f"backend 'cuda' is unavailable: {obstacle}")


@functools.cache
def _obstacle() -> str | None:
    try:
        import triton  # noqa: F401
    except ImportError as error:
        return (
            f"{error}. Install triton (it comes with torch's CUDA builds), or use backend 'cpu', "
            f"which needs no GPU"
        )
    if is_interpreted() or torch.cuda.is_available():
        return None
    return f"torch {torch.__version__} sees no GPU; use backend 'cpu'"


@functools.cache
def is_interpreted() -> bool:
    """Whether Triton interprets kernels (TRITON_INTERPRET=1) instead of compiling them.

    Decided once: a kernel is of one kind or the other from the time it is imported.
    """
    import triton

    return bool(triton.knobs.runtime.interpret)


def has_gpu() -> bool:
    """Whether kernels can run on a real GPU: what `auto` asks before it takes one."""
    return torch.cuda.is_available() and _obstacle() is None and not is_interpreted()


def gpu_device() -> torch.device:
    """Where the cuda backend's tensors live: the current GPU, or the CPU where interpreted."""
    return _device()


def _device() -> torch.device:
    if is_interpreted():
        return torch.device("cpu")
    return torch.device("cuda", torch.cuda.current_device())


def upload(array: np.ndarray | Tensor) -> Tensor:
    """A copy on the GPU, for this frame only; it is on its way when this returns."""
    tensor = (
        torch.from_numpy(np.ascontiguousarray(array)) if isinstance(array, np.ndarray) else array
    )
    device = gpu_device()
    if device.type == "cuda" and tensor.device.type == "cpu":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)


_copies: dict[tuple[int, str], tuple[weakref.ref[Tensor], int, Tensor]] = {}


def resident(tensor: Tensor) -> Tensor:
    """The tensor on the GPU, detached and contiguous; copied once for as long as it lives.

    A tensor that is there already is not copied, unless it is not contiguous.
    """
    device = gpu_device()
    if tensor.device == device:
        return tensor.detach().contiguous()
    key = (id(tensor), str(device))
    known = _copies.get(key)
    if known is not None and known[0]() is tensor and known[1] == tensor._version:
        return known[2]
    copy = tensor.detach().contiguous().to(device)
    _copies[key] = (weakref.ref(tensor, lambda _: _copies.pop(key, None)), tensor._version, copy)
    return copy


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
    """Run a Triton kernel over a grid of programs; nothing where the grid is empty.

    arguments: in the kernel's order; tensors must lie on the GPU and be contiguous. constants: its
    tl.constexpr parameters by name, and num_warps where the usual 4 are not wanted.
    """
    if 0 in grid:
        return
    given = [_kernel_argument(argument) for argument in arguments]
    # Interpreted kernels run in numpy, which warns of infinities that a GPU goes on with.
    with np.errstate(all="ignore"):
        # Fused multiply-add is Triton's own choice too, until a version that asks to be told.
        kernel[grid](*given, enable_fp_fusion=True, **constants)


def address_of(tensor: Tensor) -> int:
    """Where a tensor's numbers lie on the GPU, for kernels that take many parts in one launch.

    Whoever launches them keeps the tensor alive.
    """
    return _kernel_argument(tensor).data_ptr()


def _kernel_argument(argument: Any) -> Any:
    return argument
