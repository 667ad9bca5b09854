"""Which frames are held out of training, by their position in the drive."""

from __future__ import annotations

import re

from augment.errors import AdapterError

NONE = "none"
_EVERY = re.compile(r"every-(\d{1,6})(?:st|nd|rd|th)")


def holdout_step(holdout: str) -> int | None:
    """N of "every-Nth", None of "none".

    Raises:
        AdapterError: anything else, or N below 2.
    """
    if holdout == NONE:
        return None
    match = _EVERY.fullmatch(holdout)
    step = int(match[1]) if match else 0
    if step < 2:
        raise AdapterError(
            f"holdout must be 'none' or 'every-Nth' with N >= 2, such as every-2nd or every-8th; "
            f"got {holdout!r}"
        )
    return step


def is_held_out(position: int, step: int | None) -> bool:
    """Of the frame at this position of the drive, counted from 0: the last of every `step`."""
    return step is not None and position % step == step - 1
