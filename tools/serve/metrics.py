"""Figures of the service: requests and latencies by method, for the time that it runs."""

from __future__ import annotations

import resource
import threading
import time
from collections import Counter, deque
from typing import Any

import numpy as np

# Latest latencies of a method that percentiles are taken of.
NUM_LATENCIES = 1 << 16
# Percentiles that are reported.
PERCENTILES = (50, 90, 99)


class _MethodFigures:
    """Figures of one method."""

    def __init__(self) -> None:
        self.count_by_status = Counter[str]()
        self.latencies_ms = deque[float](maxlen=NUM_LATENCIES)

    def add(self, status: str, milliseconds: float) -> None:
        """Count a request. Latencies are those of requests that succeeded."""
        self.count_by_status[status] += 1
        if status == "OK":
            self.latencies_ms.append(milliseconds)


class Metrics:
    """Counts requests, images and latencies; all methods may be called by several threads."""

    def __init__(self) -> None:
        self._changing = threading.Lock()
        self._figures_by_method: dict[str, _MethodFigures] = {}
        self._num_images = 0
        self._num_in_flight = 0
        self._start_s = time.monotonic()

    @property
    def num_in_flight(self) -> int:
        """Number of requests that have begun and not ended."""
        return self._num_in_flight

    def begin(self) -> None:
        """Count a request that begins."""
        with self._changing:
            self._num_in_flight += 1

    def end(self, method: str, status: str, seconds: float) -> None:
        """Count a request that has ended.

        Args:
            method: name of the method.
            status: name of the gRPC status.
            seconds: time from its arrival to its end.
        """
        with self._changing:
            self._num_in_flight -= 1
            figures = self._figures_by_method.setdefault(method, _MethodFigures())
            figures.add(status, 1000 * seconds)

    def add_image(self) -> None:
        """Count an image."""
        with self._changing:
            self._num_images += 1

    def facts(self) -> dict[str, Any]:
        """Return all figures, as JSON keeps them."""
        with self._changing:
            seconds = time.monotonic() - self._start_s
            methods = {
                name: _method_facts(figures) for name, figures in self._figures_by_method.items()
            }
            num_images = self._num_images
        return {
            "seconds": round(seconds, 3),
            "images": num_images,
            "images_per_s": round(num_images / seconds, 3) if seconds > 0 else 0.0,
            "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
            "methods": methods,
        }


def _method_facts(figures: _MethodFigures) -> dict[str, Any]:
    """Return the figures of one method."""
    facts: dict[str, Any] = {
        "count": figures.count_by_status.total(),
        "by_status": dict(sorted(figures.count_by_status.items())),
    }
    if figures.latencies_ms:
        values = np.percentile(figures.latencies_ms, PERCENTILES)
        percentiles = zip(PERCENTILES, values, strict=True)
        facts |= {f"p{number}_ms": round(float(value), 2) for number, value in percentiles}
    return facts


def metrics_text(facts: dict[str, Any]) -> str:
    """Return figures as lines for people."""
    lines = [
        f"served {facts['images']} images in {facts['seconds']:.0f} s; "
        f"peak memory {facts['peak_memory_mb']:.0f} MB"
    ]
    for name, method in sorted(facts["methods"].items()):
        latencies = ", ".join(
            f"p{number} {method[f'p{number}_ms']:.1f} ms"
            for number in PERCENTILES
            if f"p{number}_ms" in method
        )
        statuses = ", ".join(f"{count} {status}" for status, count in method["by_status"].items())
        lines.append(f"  {name}: {statuses}{'; ' + latencies if latencies else ''}")
    return "\n".join(lines)
