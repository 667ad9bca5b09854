"""The random numbers of a recipe: each a pure function of (seed, variant, name of the field).

There is no generator whose state one draw could hand to the next, so a new field or a new variant
leaves every other number as it was, in any process and in any order.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass

_DOMAIN = "climategs recipe draw 1"  # a change of the scheme changes this, never silently a number


@dataclass(frozen=True)
class Draws:
    """The numbers of one variant."""

    seed: int
    variant: int

    def unit(self, path: str) -> float:
        """The number in [0, 1) that belongs to `path`: 53 bits of a SHA-256."""
        key = json.dumps([_DOMAIN, self.seed, self.variant, path])
        digest = hashlib.sha256(key.encode()).digest()
        return (int.from_bytes(digest[:8], "big") >> 11) * 2.0**-53
