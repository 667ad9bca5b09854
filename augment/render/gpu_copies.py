"""Copies from the GPU that nobody waits for until the numbers are needed."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from augment.render.gpu import is_interpreted


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


@functools.cache
def _copying(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)
