"""What one round of densification did."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DensifyReport:
    """Counts of splats: after = before - pruned + added.

    cloned, split: parents that became two, in place or side by side. pruned: removed for good.
    moved: faint ones put onto others. added: new ones, of clones and splits one each.
    """

    cloned: int
    split: int
    pruned: int
    moved: int
    added: int
    before: int
    after: int
