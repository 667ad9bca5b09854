"""Adaptive control: clones and splits where the image pulls at a splat, removes faint ones.

Kerbl et al. 2023 (3D Gaussian Splatting, section 5.2), chosen by absolute image gradients as in
Ye et al. 2024 (AbsGS): a large splat whose pixels pull it in opposite directions has a small
gradient but a large absolute one. Departures: growth has a budget (the best of each round, as in
Rota Bulò et al. 2024) instead of a threshold alone, opacity is corrected, and opacities are never
reset: that is a cure for clutter from a random start, while these splats start on measured surfaces
and lose more by being made transparent than clutter costs.
"""

from __future__ import annotations

import numpy as np

from augment.reconstruct.config import DensifyConfig
from augment.reconstruct.densify_report import DensifyReport
from augment.reconstruct.splat_rows import check_some_usable, rebuild, rest, rotate, usable
from augment.reconstruct.splats import Splats

GRADIENT_FLOOR = 1e-4  # an eighth of gsplat's threshold for the same measure: the budget decides
SPLIT_RADIUS = 0.004  # one sigma, of the image's larger side: two pixels of 480
SPLIT_SCALE = 0.01  # of the scene's extent, where no image has shown the splat
SHRINK = 1.6
SIDE_SHRINK = 1.2  # the other axes', for a split along the longest
OFFSET = float(np.sqrt(1 - 1 / SHRINK**2))  # sigmas: the pair keeps the parent's covariance
SPLITS = ("sampled", "long_axis")


def densify_absgrad(
    splats: Splats,
    config: DensifyConfig,
    *,
    rng: np.random.Generator,
    extent_m: float,
    grow: bool = True,
    scores: np.ndarray | None = None,
) -> tuple[Splats, DensifyReport]:
    """One round: removes what is faint or unusable, then grows the best-scored of the rest by one.

    grow: whether to grow, or only to remove. scores: float [N], what is to be grown first, instead
    of the mean absolute gradient of the views that saw the splat; only those above 0 grow.
    If all splats are faint, only unusable ones go: a scene is never emptied.

    Raises:
        SceneError: no splat is usable.
    """
    good = usable(splats, extent_m)
    check_some_usable(splats, good)
    keep = good & (splats.opacities >= config.prune_opacity)
    if not keep.any():
        keep = good
    kept = int(keep.sum())
    counts = keep.astype(np.int64)
    large = _is_large(splats, extent_m)
    opacities = _child_opacities(splats, large, config.split)
    chosen = np.zeros(0, np.int64)
    if grow:
        # Children fainter than prune_opacity would both be gone after the next round.
        candidates = keep & (opacities >= config.prune_opacity)
        budget = min(int(config.grow_fraction * kept), max(config.max_splats - kept, 0))
        chosen = _best(splats, candidates, scores, budget)
    counts[chosen] += 1
    first = (np.cumsum(counts) - counts)[chosen]
    grown = rebuild(splats, np.repeat(np.arange(len(splats)), counts))
    grown.opacities[first] = opacities[chosen]
    grown.opacities[first + 1] = opacities[chosen]
    # A clone's original keeps its momentum and the copy starts with a whole step of Adam: two
    # equal splats at one place would otherwise stay together for long.
    rest(grown, first + 1)
    split = large[chosen]
    _split(grown, first[split], config.split, rng)
    report = DensifyReport(
        cloned=int((~split).sum()),
        split=int(split.sum()),
        pruned=len(splats) - kept,
        moved=0,
        added=len(chosen),
        before=len(splats),
        after=len(grown),
    )
    return grown, report


def _is_large(splats: Splats, extent_m: float) -> np.ndarray:
    """bool [N]: split rather than clone. By size in the images, since what one image can show of a
    splat does not depend on how large the world is; by size in the world where none saw it.
    """
    radius = splats.grads[:, 2]
    unseen = (radius <= 0) & (splats.scales.max(1, initial=0) > SPLIT_SCALE * extent_m)
    return (radius > SPLIT_RADIUS) | unseen


def _child_opacities(splats: Splats, large: np.ndarray, split: str) -> np.ndarray:
    """float32 [N]: the opacity of each of the two that a splat would become.

    1 - sqrt(1 - o) (Rota Bulò et al. 2024, section 4.3): two such splats at one place let through
    what the one let through, where 3DGS's two copies of o hide more of what is behind them, in
    every round again. Splits along the longest axis hardly overlap, so they keep their parent's.
    """
    halved = 1 - np.sqrt(np.clip(1 - splats.opacities, 0, 1))
    return np.where(large, splats.opacities, halved) if split == "long_axis" else halved


def _best(
    splats: Splats, candidates: np.ndarray, scores: np.ndarray | None, budget: int
) -> np.ndarray:
    """int64: increasing rows of the `budget` best candidates; the earlier of equals."""
    if scores is None:
        seen = splats.grads[:, 1]
        scores = splats.grads[:, 0] / np.maximum(seen, 1)
        candidates = candidates & (seen > 0) & np.isfinite(scores) & (scores > GRADIENT_FLOOR)
    else:
        candidates = candidates & (scores > 0)
    rows = np.flatnonzero(candidates)
    return np.sort(rows[np.argsort(-scores[rows], kind="stable")[:budget]])


def _split(splats: Splats, first: np.ndarray, split: str, rng: np.random.Generator) -> None:
    """Turns the equal pairs of rows (first, first + 1) into two smaller splats, in place.

    sampled: both axes and place as in 3DGS, 1.6 times smaller at a random place within the parent;
    but mirrored at its centre and drawn from a Gaussian so much narrower that the pair keeps the
    parent's mean and covariance (two free draws spread 1.4 times as wide as the parent).
    long_axis: side by side along the longest axis only (as Deng et al. 2024 suggest), which
    disturbs the image least; no random numbers.
    """
    scales = splats.scales[first]
    if split == "long_axis":
        along = np.arange(3) == scales.argmax(1)[:, None]
        local = np.where(along, np.float32(OFFSET) * scales, np.float32(0))
        shrink = np.where(along, np.float32(SHRINK), np.float32(SIDE_SHRINK))
    else:
        drawn = rng.standard_normal((len(first), 3), dtype=np.float32)
        local = np.float32(OFFSET) * scales * drawn
        shrink = np.float32(SHRINK)
    offset = rotate(splats.quats[first], local)
    splats.means[first] += offset
    splats.means[first + 1] -= offset
    splats.scales[first] = splats.scales[first + 1] = scales / shrink
    rest(splats, first)
