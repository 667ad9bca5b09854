"""When each return of a sweep was measured, from whichever column says so."""

from __future__ import annotations

import numpy as np

from augment.labels import LidarSweep

_SAME_DRIVE_NS = 10_000_000_000  # times further from the frame's count from some other start


def sweep_times(sweep: LidarSweep, frame_ns: int) -> np.ndarray | None:
    """int64 [N] nanoseconds from the column timestamp_ns, or t in seconds; None where there is
    neither, where t has gaps, or where the times are not of the drive that the frame is of (such as
    times that count from the sweep's start).

    frame_ns: the frame's timestamp.

    Raises:
        ValueError: timestamp_ns holds anything but whole numbers or dates.
    """
    times = sweep.columns.get("timestamp_ns")
    if times is None:
        seconds = sweep.columns.get("t")
        if seconds is None or seconds.dtype.kind not in "fiu" or not np.isfinite(seconds).all():
            return None
        # Beyond 9e9 s int64 has no nanoseconds; such times are no times of this drive either.
        times = np.round(seconds.astype(np.float64).clip(-9e9, 9e9) * 1e9)
    times = whole_numbers(times, "timestamp_ns")
    near = len(times) == 0 or abs(int(np.median(times)) - frame_ns) <= _SAME_DRIVE_NS
    return times if near else None


def whole_numbers(column: np.ndarray, name: str) -> np.ndarray:
    """A column of whole numbers, or of dates (nanoseconds since 1970), as int64.

    Raises:
        ValueError: it holds anything else, or gaps.
    """
    if len(column) == 0:  # Arrow's type of an empty column may be anything
        return np.zeros(0, np.int64)
    if column.dtype.kind == "M" and not np.isnat(column).any():
        return column.astype("datetime64[ns]").astype(np.int64)
    is_whole = column.dtype.kind in "iu" or (
        column.dtype.kind == "f" and np.isfinite(column).all() and (column % 1 == 0).all()
    )
    if not is_whole:
        raise ValueError(
            f"column {name} must hold whole numbers without gaps; it is {column.dtype}"
        )
    if max(abs(float(column.min())), abs(float(column.max()))) > 2**62:
        raise ValueError(
            f"column {name} must hold numbers from -2^62 to 2^62; it holds {column.min()} to "
            f"{column.max()}"
        )
    return column.astype(np.int64)
