"""Moves faint splats onto strong ones and adds more there: the image hardly changes by it.

Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo": splats as samples of
what explains the images, so that none is cloned or removed by a rule of thumb.
"""

from __future__ import annotations

import math

import numpy as np

from augment.reconstruct.config import DensifyConfig
from augment.reconstruct.densify_report import DensifyReport
from augment.reconstruct.splat_rows import check_some_usable, rebuild, rest, rotate, usable
from augment.reconstruct.splats import Splats

MOST_COPIES = 51  # of one splat after a round, as in the authors' code
OPAQUE = 1 - 1e-6  # no root of a transmittance of 0 spreads it over several splats
NOISE_STEEPNESS = 100.0
NOISE_KNEE = 0.005  # the opacity at which half of the noise is left, theirs
NOISE_REACH = 0.1  # of opacity above the knee: beyond, less than 1/20000 of the noise is left

_ORDERS = np.arange(1, MOST_COPIES + 1)
_TERMS = np.array(
    [
        [math.comb(n, k) * (-1) ** (k + 1) / math.sqrt(k) for k in _ORDERS.tolist()]
        for n in range(MOST_COPIES + 1)
    ]
)  # [MOST_COPIES + 1, MOST_COPIES]; comb is 0 where k > n


def relocated(opacities: np.ndarray, copies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Opacity and factor on all scales of each of `copies` equal splats in place of one, float64.

    opacities: [T] in (0, 1]. copies: integer [T], 1 to MOST_COPIES. Equation 9: together the
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
        return np.full(len(opacities), MOST_COPIES, np.int64)
    opacity = np.minimum(opacities.astype(np.float64), OPAQUE)
    most = np.log1p(-opacity) / math.log1p(-min(prune_opacity, OPAQUE))
    # A hair below the whole number, so that float32 does not round a copy to the dead side.
    return np.clip(most - 1e-4, 1, MOST_COPIES).astype(np.int64)


def add_noise(
    splats: Splats,
    rows: np.ndarray | None,
    lr: float,
    rng: np.random.Generator,
) -> None:
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
