"""Runs of a suite with stand-in scenes and renderers. Processes import it without pytest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from augment.jobs.block_worker import JobWorkerSetup
from augment.scene.scene import Scene
from augment.suite.run import SuiteRun, suite_recipes
from recipes.job import JobScene
from recipes.suite import load_suite
from tests.augment.batch_scenes import fake_render, open_fake

SUITE = load_suite("weather-c-v1")
SCENES = ("fake:a?frames=4", "fake:b?frames=2")
# Condition of the recording, by the scene's statement of its origin.
CONDITIONS = {"fake:b": ("fog", "night")}


def conditions_of(source: str) -> tuple[str, ...]:
    return CONDITIONS.get(source, ())


def make_run(
    out: Path | str,
    *,
    effects: Sequence[str] = ("fog", "flood"),
    levels: Sequence[int] = (1, 3),
    scenes: Sequence[str] = SCENES,
    renderer: Callable | None = fake_render,
    opener: Callable[[str], Scene] = open_fake,
    changes: dict[str, object] | None = None,
    scale: float = 1.0,
    frames: str = "all",
    **options,
) -> SuiteRun:
    """Five variants of two scenes with two cameras and six frames, unless told otherwise."""
    setup = JobWorkerSetup(str(out), None, "auto", opener, renderer)
    recipes = suite_recipes(
        SUITE, SUITE.select(effects, levels), changes or {}, scale=scale, block_images=4
    )
    entries = [JobScene(uri=uri, frames=frames) for uri in scenes]
    return SuiteRun(recipes, entries, setup, conditions_of, **{"executor": "serial", **options})
