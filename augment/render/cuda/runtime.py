"""The GPU that Triton's kernels run on: its choice, the copies on it, and launches.

Nothing here is imported or compiled before a backend needs it. With TRITON_INTERPRET=1 set before
the kernels are imported, Triton runs them in Python on CPU tensors instead: thousands of times
slower, so for small tests only, but on any machine.
"""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.errors import BackendUnavailable


def check_can_run() -> None:
    """Check that Triton's kernels can run here.

    Raises:
        BackendUnavailable: they cannot; the message says why.
    """
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
    if is_interpreted():
        return None
    if not torch.cuda.is_available():
        return f"torch {torch.__version__} sees no GPU; use backend 'cpu'"
    return _driver_obstacle()


def _driver_obstacle() -> str | None:
    """Return the reason why Triton cannot launch kernels, or None.

    Triton compiles its own launchers with the compiler and headers of the machine.
    """
    from triton.runtime import driver

    try:
        # Triton makes it at the first access.
        driver.active.utils  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
    except Exception as error:  # of a compiler, a linker, a folder or anything else
        return (
            f"Triton cannot build what launches its kernels ({type(error).__name__}: {error}). It "
            f"needs a C compiler (gcc or clang), the headers of this Python, and a home folder or "
            f"TRITON_CACHE_DIR that can be written to; or use backend 'cpu'"
        )
    return None


@functools.cache
def is_interpreted() -> bool:
    """Return True if Triton interprets kernels (TRITON_INTERPRET=1) instead of compiling them.

    This is decided once: a kernel is of one kind or the other from the time it is imported.
    """
    import triton

    return bool(triton.knobs.runtime.interpret)  # pyright: ignore[reportAttributeAccessIssue]


def has_gpu() -> bool:
    """Return True if kernels can run on a real GPU; `auto` checks this before it takes one."""
    return torch.cuda.is_available() and _obstacle() is None and not is_interpreted()


def gpu_device() -> torch.device:
    """Return the device of the backend's tensors: the current GPU, or the CPU if interpreted."""
    return _device()


def _device() -> torch.device:
    if is_interpreted():
        return torch.device("cpu")
    return torch.device("cuda", torch.cuda.current_device())


def upload(array: np.ndarray | Tensor) -> Tensor:
    """Return a copy on the GPU, for this frame only; the transfer may still be running."""
    tensor = (
        torch.from_numpy(np.ascontiguousarray(array)) if isinstance(array, np.ndarray) else array
    )
    device = gpu_device()
    if device.type == "cuda" and tensor.device.type == "cpu":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)


_copies: dict[tuple[int, str], tuple[weakref.ref[Tensor], int, Tensor]] = {}


def resident(tensor: Tensor) -> Tensor:
    """Return the tensor on the GPU, detached and contiguous; it is copied once for as long as it
    lives.

    A tensor that is on the GPU already is copied only if it is not contiguous, or does not begin at
    a multiple of 16 bytes, as a part of another tensor may: kernels read 16 bytes at a time.
    """
    device = gpu_device()
    if tensor.device == device:
        gpu_tensor = tensor.detach().contiguous()
        return gpu_tensor if address_of(gpu_tensor) % 16 == 0 else gpu_tensor.clone()
    key = (id(tensor), str(device))
    version = version_of(tensor)
    entry = _copies.get(key)
    if entry is not None and entry[0]() is tensor and entry[1] == version:
        return entry[2]
    copy = tensor.detach().contiguous().to(device)
    if version is not None:
        _copies[key] = (weakref.ref(tensor, lambda _: _copies.pop(key, None)), version, copy)
    return copy


def version_of(tensor: Tensor) -> int | None:
    """Return a number that changes with every change in place; None if torch does not count
    changes.

    torch does not count them for tensors made in its inference mode: their values must not be
    cached.
    """
    return None if tensor.is_inference() else tensor._version


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
    """Run a Triton kernel over a grid of programs; an empty grid does nothing.

    Args:
        kernel: the kernel.
        grid: numbers of programs.
        arguments: in the kernel's order. Tensors must lie on the GPU and be contiguous; numbers may
            be numpy's.
        constants: the kernel's tl.constexpr parameters by name, and num_warps if it is not the
            usual 4.
    """
    if 0 in grid:
        return
    # Triton refuses integers of numpy where it compiles, but not where it interprets.
    kernel_arguments = [_argument(argument) for argument in arguments]
    # Interpreted kernels run in numpy, which warns of infinities; a GPU does not.
    with np.errstate(all="ignore"):
        # Fused multiply-add is Triton's default today, but a later version may change it.
        kernel[grid](*kernel_arguments, enable_fp_fusion=True, **constants)


def address_of(tensor: Tensor) -> int:
    """Return the address of a tensor's numbers on the GPU, for kernels that take many parts in one
    launch.

    The caller keeps the tensor alive.
    """
    return _kernel_argument(tensor).data_ptr()


def _argument(argument: Any) -> Any:
    if isinstance(argument, tuple):
        return tuple(map(_argument, argument))
    return _kernel_argument(argument.item() if isinstance(argument, np.generic) else argument)


def _kernel_argument(argument: Any) -> Any:
    return argument


# ---- Copies from the GPU, without waiting until the numbers are needed ---------------------------


class Download:
    """A tensor that is being copied into the CPU's memory.

    The copy goes into page-locked memory, beside the kernels that are launched after it. Memory of
    this kind is scarce: it is used again as soon as the result is no longer referenced.
    """

    def __init__(self, tensor: Tensor) -> None:
        self._arrived: torch.cuda.Event | None = None
        if is_interpreted():
            self._host = tensor.cpu()
            return
        stream = _copying(tensor.device)
        stream.wait_stream(torch.cuda.current_stream(tensor.device))
        with torch.cuda.stream(stream):
            self._host = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
            self._host.copy_(tensor, non_blocking=True)
            # A waiting thread sleeps, which leaves the core to the threads that write files.
            self._arrived = torch.cuda.Event(blocking=True)
            self._arrived.record(stream)
        tensor.record_stream(stream)  # its memory is not given away before it has been read

    def result(self) -> Tensor:
        """Wait for the copy and return it."""
        if self._arrived is not None:
            self._arrived.synchronize()
            self._arrived = None
        return self._host


def download(images: Mapping[str, Tensor]) -> Callable[[], dict[str, np.ndarray]]:
    """Start to copy images into the CPU's memory, and return a function that waits for them.

    A tensor with two names is copied once; a tensor on the CPU is not copied.
    """
    unique = {id(image): image.detach() for image in images.values()}
    copies = {k: i if i.device.type == "cpu" else Download(i) for k, i in unique.items()}

    def finish() -> dict[str, np.ndarray]:
        arrays = {k: (c.result() if isinstance(c, Download) else c) for k, c in copies.items()}
        return {name: arrays[id(image)].numpy() for name, image in images.items()}

    return finish


@functools.cache
def _copying(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)
