"""What a recipe may say of speed against accuracy: a tier, or what an error or a frame may cost."""

from __future__ import annotations

from types import MappingProxyType
from typing import ClassVar, Literal

from pydantic import Field, model_validator

from recipes.types import Closed, Flag, Number

Tier = Literal["draft", "balanced", "reference"]
TARGETS = ("max_flip", "budget_ms")


class Quality(Closed):
    """Speed against accuracy. It chooses every setting of the table of knobs that the recipe does
    not give itself; `quality: balanced` is short for `quality: {tier: balanced}`.
    """

    SHORTHAND: ClassVar[str] = "tier"

    tier: Literal["draft", "balanced", "reference"] | None = Field(
        default=None,
        description="draft is for a first look, balanced differs from reference by less than a "
        "person sees, reference takes no shortcut; null leaves every setting at its default.",
    )
    max_flip: Number | None = Field(
        default=None,
        gt=0,
        le=1,
        description="The fastest settings whose pictures of this scene differ from reference by "
        "no more than this: mean FLIP, the worst of a few views.",
    )
    budget_ms: Number | None = Field(
        default=None,
        gt=0,
        le=1e7,
        description="The most accurate settings whose frames of this scene take no longer than "
        "this on the machine that starts the job: the median of a few views, writing left out.",
    )
    settled: Flag = Field(
        default=False,
        description="Whether max_flip or budget_ms has made its choice, which the recipe then "
        "holds: so it is in the recipes that a job leaves, and nothing is chosen again.",
    )

    @model_validator(mode="after")
    def _one_wish(self) -> Quality:
        given = [name for name in ("tier", *TARGETS) if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} each choose the settings: keep one of them")
        if self.settled and not self.has_target:
            raise ValueError("settled belongs to max_flip or budget_ms, and neither is given")
        return self

    @property
    def has_target(self) -> bool:
        return self.max_flip is not None or self.budget_ms is not None

    @property
    def is_open(self) -> bool:
        """Whether settings have still to be chosen, in view of a scene."""
        return self.has_target and not self.settled

    @property
    def words(self) -> str | None:
        """For the manifest: `balanced`, `max_flip 0.03`, `budget_ms 150`; None without a wish."""
        for name in TARGETS:
            if getattr(self, name) is not None:
                return f"{name} {getattr(self, name):g}"
        return self.tier


# What each tier sets, by the fields' dotted paths, but for those that a recipe gives and those of
# effects that it has not; the rest are at reference, the last value of every knob (recipes.knobs).
# By the rule of docs/trade.md from the tables there.
TIERS = MappingProxyType(
    {
        "draft": MappingProxyType(
            {
                "render.scale": 0.75,
                "render.transmittance_stop": 0.01,
                "weather.snow.shading": "per_splat",
            }
        ),
        "balanced": MappingProxyType({"render.transmittance_stop": 0.01}),
    }
)
