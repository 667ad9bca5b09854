"""What the class numbers in a recording's LiDAR files mean."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from adapters.lidar.sweep_times import whole_numbers
from augment.errors import AdapterError
from augment.semantics import SemanticClass


def class_numbers(path: Path, column: np.ndarray) -> np.ndarray:
    """The column `semantic` as int64 [N]. path: its file or folder, for messages.

    Raises:
        AdapterError: it holds something else than whole numbers.
    """
    try:
        return whole_numbers(column, "semantic")
    except ValueError as error:
        raise AdapterError(f"{path}: {error}") from None


def class_table(
    root: Path, numbers: np.ndarray, lidar_classes: Mapping[int, int] | None
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """SemanticClass (or NO_SURFACE) by the files' class number, int16, None where their meaning is
    not known; and a sentence where that is so. numbers: those that occur.

    Raises:
        AdapterError: numbers out of range.
    """
    if len(numbers) == 0:
        return None, ()
    if lidar_classes is None:
        known = (numbers >= 0) & (numbers < SemanticClass.SKY)
        if not known.all():
            return None, (
                f"lidar/: the column semantic holds {int(numbers[~known][0])}, which is no "
                f"SemanticClass (0 to {SemanticClass.SKY - 1}): classes are ignored. Say what the "
                f'numbers mean in calibration.json: "lidar_classes": {{"7": "road", ...}}',
            )
        return np.arange(SemanticClass.SKY, dtype=np.int16), ()
    size = max(0, int(numbers.max()), *lidar_classes) + 1
    if numbers.min() < 0 or min(lidar_classes, default=0) < 0 or size > 2**16:
        raise AdapterError(
            f"{root / 'lidar'}: class numbers must lie in 0 to 65535; the files hold "
            f"{int(numbers.min())} to {int(numbers.max())}, lidar_classes names "
            f"{sorted(lidar_classes)}"
        )
    table = np.full(size, SemanticClass.UNKNOWN, np.int16)
    for number, meaning in lidar_classes.items():
        table[number] = meaning
    return table, ()
