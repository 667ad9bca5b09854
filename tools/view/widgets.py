"""Checked values of widgets, since a page may send any value; and texts of a dropdown's options."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

from augment.errors import ClimateGSError
from recipes.errors import short
from tools.view.text import printable


def value_of(widget: Any, sent: Any) -> Any:
    """Return the value that a page has sent, in the type of the widget's value.

    Args:
        widget: viser's handle of the widget.
        sent: A bool, number, text, or a tuple of numbers.

    Raises:
        ClimateGSError: the value has another type, is no option of the widget, or is out of range.
    """
    value = _cast(sent, widget.value)
    options = getattr(widget, "options", None)
    if value is None or (options is not None and value not in options):
        expected_value = "a value of its kind" if options is None else "one of its options"
        raise ClimateGSError(f"{widget.label}: expected {expected_value}; got {short(repr(sent))}")
    low = getattr(widget, "min", None)
    high = getattr(widget, "max", None)
    numbers = value if isinstance(value, tuple) else (value,)
    for number, least, most in zip(numbers, _ends(low, numbers), _ends(high, numbers), strict=True):
        # A browser rounds to a slider's steps.
        slack = (getattr(widget, "step", None) or 0) / 2 if isinstance(number, float) else 0
        if (least is not None and number < least - slack) or (
            most is not None and number > most + slack
        ):
            ends = " to ".join("any" if end is None else f"{end:g}" for end in (least, most))
            raise ClimateGSError(f"{widget.label}: {number:g} is not within its ends, {ends}")
    return value


def _cast(sent: Any, now: Any) -> Any:
    """Return the value in the type of the widget's current value; None if it has another type."""
    if isinstance(now, bool | str):
        return sent if type(sent) is type(now) else None
    if isinstance(now, int | float):
        is_number = isinstance(sent, int | float) and not isinstance(sent, bool)
        return type(now)(sent) if is_number else None  # a browser has one kind of numbers
    if isinstance(now, tuple) and isinstance(sent, tuple) and len(sent) == len(now):
        values = tuple(map(_cast, sent, now))
        return None if None in values else values
    return None


def _ends(end: Any, numbers: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return one end of the range for each of the numbers; None where there is no end."""
    if not isinstance(end, tuple):
        return (end,) * len(numbers)
    return (*end, *(None,) * len(numbers))[: len(numbers)]


def options_of(values: Iterable[Any]) -> dict[str, Any]:
    """Return texts for the options of a dropdown, and the value that each stands for.

    Texts that would look the same are numbered: a browser refuses two options that are equal.
    """
    options: dict[str, Any] = {}
    for value in values:
        text = printable(str(value)) or "(empty)"
        same = (text if n == 1 else f"{text} ({n})" for n in itertools.count(1))
        options[next(option for option in same if option not in options)] = value
    return options
