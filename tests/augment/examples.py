"""How many examples the property-based tests draw: few as a rule, many when asked to.

CLIMATEGS_EXAMPLES=2000 makes a long soak of the same tests. Examples are drawn from a fixed seed
and kept in no database, so that a run fails or passes whatever ran before it.
"""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

VARIABLE = "CLIMATEGS_EXAMPLES"


def examples(default: int) -> int:
    """The number of examples of one test: `default`, or what the environment asks for."""
    text = os.environ.get(VARIABLE, "")
    if not text:
        return default
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"{VARIABLE} must be a whole number of examples, >= 1; got {text!r}")
    return int(text)


def drawing(default: int) -> settings:
    """Settings of a property: `default` examples, or the environment's number.

    Frames take as long as they take, and the first waits for kernels: no deadline, and no
    complaint that drawing is slow.
    """
    return settings(
        max_examples=examples(default),
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )
