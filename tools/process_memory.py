"""Resident memory of this process over time."""

from __future__ import annotations

import threading
from types import TracebackType

from tools.bench_memory import status_mib

_PERIOD_S = 0.1


class MemorySampler:
    """Samples while entered, on a thread of its own; Linux only."""

    def __init__(self) -> None:
        self.mib: list[float] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> MemorySampler:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._thread.join()

    def at_share(self, share: float) -> float:
        """MiB when that share of the time had passed, smoothed over a twentieth of it."""
        middle, reach = share * len(self.mib), max(1, len(self.mib) // 20)
        near = self.mib[max(0, int(middle) - reach) : int(middle) + reach] or self.mib[-1:]
        return sum(near) / len(near)

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            self.mib.append(status_mib("VmRSS"))
