"""Progress bars whose remaining time leaves out the compiling of kernels.

The first image or step of a job may wait a minute for kernels, which no later one does. Counted as
work it would make the bar announce days.
"""

from __future__ import annotations

from typing import Any

from tqdm import tqdm

from augment.render.cpu.jit import compile_seconds


class ProgressBar(tqdm):
    """tqdm's bar, on a clock that stands still while kernels are compiled."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self._compiling_s = compile_seconds()
        super().__init__(*args, **options)

    def update(self, n: float | None = 1) -> bool | None:
        """Advance by n, as tqdm does."""
        if not self.disable:  # a disabled bar has no times
            total_s = compile_seconds()
            spent_s = total_s - self._compiling_s
            self._compiling_s = total_s
            self.start_t += spent_s
            self.last_print_t += spent_s
        return super().update(n)
