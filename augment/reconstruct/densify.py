"""When and how the number of splats changes during a fit."""

from __future__ import annotations

import math

import numpy as np

from augment.reconstruct.config import DensifyConfig
from augment.reconstruct.densify_absgrad import SPLITS, densify_absgrad
from augment.reconstruct.densify_mcmc import add_noise, densify_mcmc
from augment.reconstruct.densify_report import DensifyReport
from augment.reconstruct.splat_rows import rebuild
from augment.reconstruct.splats import Splats

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
