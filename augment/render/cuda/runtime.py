"""The GPU that Triton's kernels run on: which one it is, what has been copied to it, launches.

Nothing here is imported or compiled before a backend that needs it is asked for. With
TRITON_INTERPRET=1 set before the kernels are imported, Triton runs them in Python on CPU tensors
instead: thousands of times slower, and so for small tests, but everywhere.
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
    if is_interpreted():
        return None
    if not torch.cuda.is_available():
        return f"torch {torch.__version__} sees no GPU; use backend 'cpu'"
    return _driver_obstacle()


def _driver_obstacle() -> str | None:
    """Why Triton cannot launch: it compiles its own launchers, by what the machine has for that."""
    from triton.runtime import driver

    try:
        # Made when it is first asked for.
        driver.active.utils  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
    except Exception as error:  # of a compiler, a linker, a folder: whatever stands in its way
        return (
            f"Triton cannot build what launches its kernels ({type(error).__name__}: {error}). It "
            f"needs a C compiler (gcc or clang), the headers of this Python, and a home folder or "
            f"TRITON_CACHE_DIR that can be written to; or use backend 'cpu'"
        )
    return None


@functools.cache
def is_interpreted() -> bool:
    """Whether Triton interprets kernels (TRITON_INTERPRET=1) instead of compiling them.

    Decided once: a kernel is of one kind or the other from the time it is imported.
    """
    import triton

    return bool(triton.knobs.runtime.interpret)  # pyright: ignore[reportAttributeAccessIssue]


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

    A tensor that is there already is not copied, unless it is not contiguous, or begins at no
    multiple of 16 bytes, as within another tensor: kernels read as many at a time.
    """
    device = gpu_device()
    if tensor.device == device:
        own = tensor.detach().contiguous()
        return own if address_of(own) % 16 == 0 else own.clone()
    key, version = (id(tensor), str(device)), version_of(tensor)
    known = _copies.get(key)
    if known is not None and known[0]() is tensor and known[1] == version:
        return known[2]
    copy = tensor.detach().contiguous().to(device)
    if version is not None:
        _copies[key] = (weakref.ref(tensor, lambda _: _copies.pop(key, None)), version, copy)
    return copy


def version_of(tensor: Tensor) -> int | None:
    """Another number after every change in place; None where torch does not count these, as of
    tensors made in its inference mode: what such a tensor held may be kept by nobody.
    """
    return None if tensor.is_inference() else tensor._version


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
    """Run a Triton kernel over a grid of programs; nothing where the grid is empty.

    arguments: in the kernel's order; tensors must lie on the GPU and be contiguous; numbers may be
    numpy's. constants: its tl.constexpr parameters by name, and num_warps where the usual 4 are not
    wanted.
    """
    if 0 in grid:
        return
    # Triton refuses integers of numpy where it compiles, but not where it interprets.
    given = [_argument(argument) for argument in arguments]
    # Interpreted kernels run in numpy, which warns of infinities that a GPU goes on with.
    with np.errstate(all="ignore"):
        # Fused multiply-add is Triton's own choice too, until a version that asks to be told.
        kernel[grid](*given, enable_fp_fusion=True, **constants)


def address_of(tensor: Tensor) -> int:
    """Where a tensor's numbers lie on the GPU, for kernels that take many parts in one launch.

    Whoever launches them keeps the tensor alive.
    """
    return _kernel_argument(tensor).data_ptr()


def _argument(given: Any) -> Any:
    if isinstance(given, tuple):
        return tuple(map(_argument, given))
    return _kernel_argument(given.item() if isinstance(given, np.generic) else given)


def _kernel_argument(argument: Any) -> Any:
    return argument


# ---- Copies from the GPU that nobody waits for until the numbers are needed ----------------------


class Download:
    """A tensor on its way into the CPU's memory.

    The copy goes into page-locked memory, past the kernels that are launched after it. Memory of
    this kind is scarce: it is used again as soon as nobody holds the result any more.
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
            # Whoever waits sleeps, and leaves the core to the threads that write files.
            self._arrived = torch.cuda.Event(blocking=True)
            self._arrived.record(stream)
        tensor.record_stream(stream)  # its memory is not given away before it has been read

    def result(self) -> Tensor:
        """The copy; waits until it is there."""
        if self._arrived is not None:
            self._arrived.synchronize()
            self._arrived = None
        return self._host


def download(images: Mapping[str, Tensor]) -> Callable[[], dict[str, np.ndarray]]:
    """Starts the images' way into the CPU's memory; what is returned waits for them. A tensor of
    two names is copied once, one that lies on the CPU not at all.
    """
    unique = {id(image): image.detach() for image in images.values()}
    copies = {k: i if i.device.type == "cpu" else Download(i) for k, i in unique.items()}

    def finish() -> dict[str, np.ndarray]:
        found = {k: (c.result() if isinstance(c, Download) else c) for k, c in copies.items()}
        return {name: found[id(image)].numpy() for name, image in images.items()}

    return finish


@functools.cache
def _copying(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)
