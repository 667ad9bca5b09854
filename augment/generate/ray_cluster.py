"""Ray itself, an optional extra, and the cluster: the one there is, or one of this machine.

Imported only here, when a job asks for it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

from augment.batch.processes import available_cores
from augment.errors import ClimateGSError

_OBJECTS_BYTES = 100 << 20  # for objects of Ray's; tasks and results are far smaller


def import_ray() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ClimateGSError(
            f'the executor "ray" needs Ray ({error}): pip install "climategs[ray]"'
        ) from error
    return ray


def connect(ray: Any, slots: int | None) -> bool:
    """Connect to a cluster unless this process is. Returns whether it was started here."""
    if ray.is_initialized():
        return False
    address = os.environ.get("RAY_ADDRESS", "")
    if address.startswith("ray://"):
        raise ClimateGSError(
            f"RAY_ADDRESS is {address}: Ray's client protocol is not supported; start the job on a "
            f"machine of the cluster (`ray job submit`, or RAY_ADDRESS=auto there)"
        )
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    is_ours = address in ("", "local")
    if is_ours:
        options |= {
            "address": "local",
            "num_cpus": slots or available_cores(),
            "include_dashboard": False,
            "object_store_memory": _OBJECTS_BYTES,
            # Workers import from where this process does, as those of other executors.
            "runtime_env": {
                "env_vars": {"PYTHONPATH": os.pathsep.join(p or "." for p in sys.path)}
            },
        }
    with _own_sigterm(), _no_usage_statistics():
        try:
            ray.init(**options)
        except (ConnectionError, RuntimeError, ValueError) as error:
            where = "start Ray here" if is_ours else f"reach the Ray cluster at {address}"
            raise ClimateGSError(f"cannot {where}: {last_line(error)}") from error
    return is_ours


@contextlib.contextmanager
def _own_sigterm() -> Iterator[None]:
    """Ray sets a handler for SIGTERM when it connects: put back the one there was."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _no_usage_statistics() -> Iterator[None]:
    """What Ray starts inside sends nothing home, unless the user has said that it may."""
    name = "RAY_USAGE_STATS_ENABLED"
    was_set = name in os.environ
    os.environ.setdefault(name, "0")
    try:
        yield
    finally:
        if not was_set:
            del os.environ[name]


def last_line(error: Exception) -> str:
    """The end of an error's text, where a remote traceback says what happened."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:300] if lines else type(error).__name__
