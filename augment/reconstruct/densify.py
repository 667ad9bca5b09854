"""When and how the number of splats changes during a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from augment.reconstruct.config import DensifyConfig
from augment.reconstruct.splats import Splats, check_some_usable, rebuild, rest, rotate, usable

# ---- What one round of densification did ---------------------------------------------------------


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


# ---- Adaptive control: clones and splits where the image pulls at a splat, removes faint ones ----
# Kerbl et al. 2023 (3D Gaussian Splatting, section 5.2), chosen by absolute image gradients as in
# Ye et al. 2024 (AbsGS): a large splat whose pixels pull it in opposite directions has a small
# gradient but a large absolute one. Departures: growth has a budget (the best of each round, as in
# Rota Bulò et al. 2024) instead of a threshold alone, opacity is corrected, and opacities are never
# reset: that is a cure for clutter from a random start, while these splats start on measured
# surfaces and lose more by being made transparent than clutter costs.

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


# ---- Moves faint splats onto strong ones and adds more there: the image hardly changes by it -----
# Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo": splats as samples of
# what explains the images, so that none is cloned or removed by a rule of thumb.

MAX_COPIES = 51  # of one splat after a round, as in the authors' code
OPAQUE = 1 - 1e-6  # no root of a transmittance of 0 spreads it over several splats
NOISE_STEEPNESS = 100.0
NOISE_KNEE = 0.005  # the opacity at which half of the noise is left, theirs
NOISE_REACH = 0.1  # of opacity above the knee: beyond, less than 1/20000 of the noise is left

_ORDERS = np.arange(1, MAX_COPIES + 1)
_TERMS = np.array(
    [
        [math.comb(n, k) * (-1) ** (k + 1) / math.sqrt(k) for k in _ORDERS.tolist()]
        for n in range(MAX_COPIES + 1)
    ]
)  # [MAX_COPIES + 1, MAX_COPIES]; comb is 0 where k > n


def relocated(opacities: np.ndarray, copies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Opacity and factor on all scales of each of `copies` equal splats in place of one, float64.

    opacities: [T] in (0, 1]. copies: integer [T], 1 to MAX_COPIES. Equation 9: together the
    copies hide at their centre what the one hid, 1 - (1 - o')^n = o, and hide as much along a line
    through it. Its double sum over i <= n of binomials (i - 1 over k) is one sum of (n over k + 1).
    """
    opacity = np.minimum(opacities.astype(np.float64), OPAQUE)
    share = -np.expm1(np.log1p(-opacity) / copies)
    extent = (_TERMS[copies] * share[:, None] ** _ORDERS).sum(1)
    return share, opacity / extent


def densify_mcmc(
    splats: Splats,
    config: DensifyConfig,
    *,
    rng: np.random.Generator,
    extent_m: float,
    scores: np.ndarray | None = None,
) -> tuple[Splats, DensifyReport]:
    """One round: every splat fainter than prune_opacity becomes a copy of a living one, drawn in
    proportion to opacity (times scores [N], where given), and grow_fraction more are added so.

    A copy belongs to the part of its original. Where the authors raise copies that come out below
    prune_opacity up to it, which thickens the scene, no splat is here given more copies than it can
    carry; dead ones that find no place stay. Unusable ones are moved first, and removed otherwise.
    Everything dead: nothing moves.

    Raises:
        SceneError: no splat is usable.
    """
    good = usable(splats, extent_m)
    check_some_usable(splats, good)
    living = good & (splats.opacities >= config.prune_opacity)
    dead = np.concatenate([np.flatnonzero(~good), np.flatnonzero(good & ~living)])
    room = max(config.max_splats - len(splats), 0)
    wanted = len(dead) + min(int(config.grow_fraction * len(splats)), room)
    copies = _draw(splats, living, scores, wanted, config.prune_opacity, rng)

    placed = int(copies.sum())
    moved = min(len(dead), placed)
    counts = living + copies
    waiting = dead[moved:]
    counts[waiting[good[waiting]]] = 1
    source = np.repeat(np.arange(len(splats)), counts)
    grown = rebuild(splats, source)
    touched = np.flatnonzero(copies[source])
    origin = source[touched]
    share, factor = relocated(splats.opacities[origin], counts[origin])
    grown.opacities[touched] = share
    grown.scales[touched] *= factor[:, None].astype(np.float32)
    rest(grown, touched)
    report = DensifyReport(
        cloned=0,
        split=0,
        pruned=len(splats) - moved + placed - len(grown),
        moved=moved,
        added=placed - moved,
        before=len(splats),
        after=len(grown),
    )
    return grown, report


def _draw(
    splats: Splats,
    living: np.ndarray,
    scores: np.ndarray | None,
    wanted: int,
    prune_opacity: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """int64 [N]: new copies of each splat, about `wanted` in all, fewer where too few can carry.

    Stratified: one draw in each of `wanted` equal slices of the summed weights, which keeps the
    counts nearer to their expectation than free draws do.
    """
    room = np.zeros(len(splats), np.int64)
    room[living] = _most_copies(splats.opacities[living], prune_opacity) - 1
    weights = np.where(room > 0, splats.opacities, 0).astype(np.float64)
    if scores is not None:
        weights *= scores
    summed = np.cumsum(weights)
    if wanted == 0 or len(splats) == 0 or summed[-1] <= 0:
        return np.zeros(len(splats), np.int64)
    at = (np.arange(wanted) + rng.random(wanted)) * (summed[-1] / wanted)
    # side="right" passes over rows without weight; rounding may end on the very sum.
    drawn = np.searchsorted(summed, np.minimum(at, np.nextafter(summed[-1], 0)), side="right")
    return np.minimum(np.bincount(drawn, minlength=len(splats)), room)


def _most_copies(opacities: np.ndarray, prune_opacity: float) -> np.ndarray:
    """int64: how many equal splats one can become before they are as faint as dead ones."""
    if prune_opacity <= 0:
        return np.full(len(opacities), MAX_COPIES, np.int64)
    opacity = np.minimum(opacities.astype(np.float64), OPAQUE)
    most = np.log1p(-opacity) / math.log1p(-min(prune_opacity, OPAQUE))
    # A hair below the whole number, so that float32 does not round a copy to the dead side.
    return np.clip(most - 1e-4, 1, MAX_COPIES).astype(np.int64)


def add_noise(splats: Splats, rows: np.ndarray | None, lr: float, rng: np.random.Generator) -> None:
    """Shakes the means of faint splats within their own shape, in place (section 4.2 there).

    step = lr sigmoid(-100 (opacity - NOISE_KNEE)) covariance normal(0, 1). rows: int64, without
    repetition, or None for all. lr: 1/m; the authors take 5e5 times the means' learning rate.
    Only rows within NOISE_REACH above the knee cost anything. Departure: no axis's step is drawn
    wider than the splat itself, since a covariance in m2 would throw a distant splat of some metres
    out of the scene.
    """
    opacities = splats.opacities if rows is None else splats.opacities[rows]
    faint = np.flatnonzero(opacities < NOISE_KNEE + NOISE_REACH)
    rows = faint if rows is None else rows[faint]
    gate = lr / (1 + np.exp(NOISE_STEEPNESS * (opacities[faint] - NOISE_KNEE)))
    scales = splats.scales[rows]
    sigma = np.minimum(gate[:, None].astype(np.float32) * scales, np.float32(1)) * scales
    # The covariance times isotropic noise, R S S R^T n, is R S S n in distribution.
    local = sigma * rng.standard_normal((len(rows), 3), dtype=np.float32)
    splats.means[rows] += rotate(splats.quats[rows], local)


__all__ = ["DensifyReport", "add_noise", "densify", "densify_due", "grows", "rebuild"]

METHODS = ("absgrad", "mcmc")


def grows(config: DensifyConfig, step: int, total_steps: int) -> bool:
    """Whether splats may be added after this many steps: from config.start to config.stop."""
    return config.start * total_steps <= step <= config.stop * total_steps


def densify_due(config: DensifyConfig, step: int, total_steps: int) -> bool:
    """Whether a round is due after this many steps: every config.every while splats are added."""
    return step > 0 and step % config.every == 0 and grows(config, step, total_steps)


def densify(
    splats: Splats,
    config: DensifyConfig,
    *,
    rng: np.random.Generator,
    step: int,
    total_steps: int,
    extent_m: float,
    error_scores: np.ndarray | None = None,
) -> tuple[Splats, DensifyReport]:
    """One round by config.method on all parts together; `splats` itself does not change.

    step, total_steps: outside of config's start and stop faint splats are removed and nothing else
    happens, by either method. extent_m: how far the scene reaches, against which absurd sizes
    show. error_scores: float [N] >= 0, how much each splat deserves company (image error it stands
    for, say): instead of the gradients (absgrad), or multiplied with opacity (mcmc).
    The result's arrays are its own, part after part, children next to their parents, grads zero.

    Raises:
        ValueError: an argument or a setting is out of range.
        SceneError: no splat is usable any more.
    """
    _check(splats, config, extent_m, error_scores)
    grow = grows(config, step, total_steps)
    if grow and config.method == "mcmc":
        return densify_mcmc(splats, config, rng=rng, extent_m=extent_m, scores=error_scores)
    return densify_absgrad(
        splats, config, rng=rng, extent_m=extent_m, grow=grow, scores=error_scores
    )


def _check(
    splats: Splats, config: DensifyConfig, extent_m: float, scores: np.ndarray | None
) -> None:
    if config.method not in METHODS:
        raise ValueError(f"densify method must be one of {METHODS}; got {config.method!r}")
    if config.split not in SPLITS:
        raise ValueError(f"densify split must be one of {SPLITS}; got {config.split!r}")
    if not (config.grow_fraction >= 0 and 0 <= config.prune_opacity < 1):
        raise ValueError(
            f"grow_fraction must be >= 0 and prune_opacity in [0, 1); "
            f"got {config.grow_fraction} and {config.prune_opacity}"
        )
    if not (math.isfinite(extent_m) and extent_m > 0):
        raise ValueError(f"extent_m must be finite and > 0; got {extent_m}")
    if scores is None:
        return
    if scores.shape != (len(splats),):
        raise ValueError(f"error_scores must be [{len(splats)}]; got {list(scores.shape)}")
    if not (np.isfinite(scores).all() and (scores >= 0).all()):
        raise ValueError("error_scores must be finite and >= 0; got others")
