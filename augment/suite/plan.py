"""Plan of a suite before it is rendered: its images, and about how long they take and how large
they get.

One level of each effect is tried: an effect's levels cost about the same.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace

from augment.jobs.blocks import JobPlan
from augment.jobs.estimate import Sample, estimate_job
from augment.jobs.generate import plan_job
from augment.jobs.render_job import SceneLoader
from augment.suite.run import SuiteRun
from recipes.suite import SuiteVariant

# Level of an effect that is tried, where the run has it.
_TRIED_LEVEL = 3


@dataclass(frozen=True)
class EffectCost:
    """Estimated cost of the levels of one effect."""

    variants: int
    """Number of levels."""
    images: int
    """Number of images."""
    seconds: float
    """Seconds of a single worker."""
    bytes: float
    """Bytes of all files."""


@dataclass(frozen=True)
class SuitePlan:
    """Images of a run, with their estimated cost."""

    plan: JobPlan
    """Plan of the job."""
    opening_s: float
    """Seconds that opening the scenes takes."""
    effects: dict[str, EffectCost]
    """Cost by effect, the clean render first."""

    @property
    def seconds(self) -> float:
        """Return the estimated seconds of a single worker."""
        return self.opening_s + sum(cost.seconds for cost in self.effects.values())

    @property
    def bytes(self) -> float:
        """Return the estimated bytes of all files."""
        return sum(cost.bytes for cost in self.effects.values())


def plan_suite(
    run: SuiteRun,
    open_scene: SceneLoader,
    *,
    progress: bool = True,
    on_recipe: Callable[[str], None] = lambda name: None,
) -> SuitePlan:
    """Return the plan of a run, with the cost of two pictures of each effect scaled to all images.

    Nothing is written. The estimate is right to within a factor of about two.

    Args:
        open_scene: Opens a scene by its URI.
        progress: If True, show bars on stderr.
        on_recipe: Called with a variant's name before its pictures.
    """
    plan = plan_job(run.job, progress=progress)
    tried = _tried_variants(plan)
    blocks = tuple(block for block in plan.blocks if block.recipe.name in tried.values())
    estimate = estimate_job(
        replace(plan, blocks=blocks), open_scene, on_recipe=on_recipe, max_sampled=len(tried)
    )
    costs = {
        effect: _effect_cost(plan, effect, estimate.samples[name]) for effect, name in tried.items()
    }
    opening_s = sum(record.open_s for record in plan.records.values())
    return SuitePlan(plan, opening_s, costs)


def _tried_variants(plan: JobPlan) -> dict[str, str]:
    """Return the name of the variant that is tried, by effect."""
    levels: defaultdict[str, set[int]] = defaultdict(set)
    for block in plan.blocks:
        variant = SuiteVariant.parse(block.recipe.name)
        levels[variant.effect].add(variant.level)
    return {
        effect: SuiteVariant(effect, min(numbers, key=lambda level: abs(level - _TRIED_LEVEL))).name
        for effect, numbers in levels.items()
    }


def _effect_cost(plan: JobPlan, effect: str, sample: Sample) -> EffectCost:
    """Return the cost of all images of an effect, by the cost of one of its levels."""
    blocks = [b for b in plan.blocks if SuiteVariant.parse(b.recipe.name).effect == effect]
    images = [image for b in blocks for image in b.list_images(plan.records[b.scene])]
    megapixels = sum(image.width * image.height for image in images) / 1e6
    preparations = len({(block.scene, block.recipe.name) for block in blocks})
    return EffectCost(
        variants=len({block.recipe.name for block in blocks}),
        images=len(images),
        seconds=megapixels * sample.seconds_per_mpx + preparations * sample.prepare_s,
        bytes=megapixels * sample.bytes_per_mpx,
    )
