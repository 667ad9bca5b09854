"""Robustness suites: effects in levels of a physical number, and the recipe of each for a scene.

A suite is a YAML file of this package, `recipes/suites/<name>.yaml`. Its numbers never change: a
change is a new version with a name of its own. A variant is an effect and a level (`fog-3`); level
0 is the clean render (`clean-0`), which all effects share.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from pydantic import Field, ValidationError, model_validator
from ruamel.yaml import YAML

from recipes.errors import RecipeError, did_you_mean, readable
from recipes.fields import ClosedModel, packaged_names, packaged_text
from recipes.files import with_digest
from recipes.job import Job, JobScene, scaled_recipe
from recipes.schema import Recipe

# Name of the effect of level 0, which has none.
CLEAN = "clean"
# Number of levels of every effect, without level 0.
NUM_LEVELS = 5
# Ending of the name of a suite's quarter.
QUARTER_ENDING = "-q"
# Frame numbers of a suite's quarter.
QUARTER_FRAMES = "::4"
# Sections of a recipe that a user of a suite may change; the weather's numbers stay.
CHANGEABLE_SECTIONS = ("render", "output")

_NAME = r"^[a-z][a-z0-9]{0,30}$"
_VARIANT = re.compile(r"([a-z][a-z0-9]{0,30})-([0-9])")

Condition = Literal["rain", "snow", "fog", "night"]


class SuiteVariant(NamedTuple):
    """An effect at a level."""

    effect: str
    """Name of the effect; CLEAN at level 0."""
    level: int
    """Level, 0 to NUM_LEVELS."""

    @property
    def name(self) -> str:
        """Return the name of the variant's recipe: `fog-3`."""
        return f"{self.effect}-{self.level}"

    @staticmethod
    def parse(text: str) -> SuiteVariant:
        """Return the variant of a name such as `fog-3`.

        Raises:
            RecipeError: It is no such name.
        """
        match = _VARIANT.fullmatch(text)
        if match is None:
            raise RecipeError(f"{text!r} is no variant of a suite; write EFFECT-LEVEL, as in fog-3")
        return SuiteVariant(match[1], int(match[2]))


class SuiteLevel(ClosedModel):
    """One level of an effect."""

    value: float
    """The effect's physical number, as the level is called; in the effect's unit."""
    set: dict[str, Any] = Field(default_factory=dict)
    """Fields of the recipe by dotted path."""
    of: tuple[str, ...] = ()
    """Variants whose fields this level has, before its own."""


class SuiteEffect(ClosedModel):
    """One effect of a suite."""

    number: str
    """Name of the physical number that grows or falls from level to level."""
    unit: str
    """Unit of that number."""
    recorded_as: tuple[Condition, ...]
    """Conditions of a recording that has this effect already."""
    set: dict[str, Any] = Field(default_factory=dict)
    """Fields of the recipes of all levels, by dotted path."""
    levels: tuple[SuiteLevel, ...] = Field(min_length=NUM_LEVELS, max_length=NUM_LEVELS)
    """The levels from 1 on, mildest first."""


class Suite(ClosedModel):
    """Definition of a suite."""

    version: Literal[1]
    """Version of the file's format."""
    name: str
    """Name of the suite, with its version."""
    every_recipe: dict[str, Any]
    """Fields of all recipes, level 0 among them, as in a recipe file."""
    effects: dict[str, SuiteEffect]
    """Effects by name, in the order of reports."""

    @model_validator(mode="after")
    def _has_usable_names(self) -> Suite:
        for name in self.effects:
            if name == CLEAN or not re.match(_NAME, name):
                raise ValueError(f"{name!r} cannot be the name of an effect")
        return self

    @property
    def variants(self) -> tuple[SuiteVariant, ...]:
        """Return all variants, the clean one first."""
        levels = range(1, NUM_LEVELS + 1)
        weather = (SuiteVariant(effect, level) for effect in self.effects for level in levels)
        return (SuiteVariant(CLEAN, 0), *weather)

    def select(
        self, effects: Sequence[str] | None = None, levels: Iterable[int] | None = None
    ) -> tuple[SuiteVariant, ...]:
        """Return the variants of some effects and levels, with the clean one.

        Args:
            effects: Names of effects; None for all.
            levels: Levels from 1 on; 0 alone asks for the clean variant and nothing else. None for
                all.

        Raises:
            RecipeError: The suite has no such effect or level.
        """
        names = tuple(self.effects)
        for name in effects or ():
            if name not in names:
                guess = did_you_mean(name, names)
                raise RecipeError(
                    f"{self.name} has no effect {name!r}; {guess}effects are {', '.join(names)}"
                )
        wanted_levels = set(range(NUM_LEVELS + 1) if levels is None else levels)
        for level in sorted(wanted_levels):
            if not 0 <= level <= NUM_LEVELS:
                raise RecipeError(f"{self.name} has the levels 0 to {NUM_LEVELS}; got {level}")
        wanted_effects = names if effects is None else effects
        return tuple(
            variant
            for variant in self.variants
            if variant.effect == CLEAN
            or (variant.effect in wanted_effects and variant.level in wanted_levels)
        )

    def level_of(self, variant: SuiteVariant) -> SuiteLevel | None:
        """Return the definition of a variant's level; None for the clean variant.

        Raises:
            RecipeError: The suite has no such variant.
        """
        if variant not in self.variants:
            raise RecipeError(
                f"{self.name} has no variant {variant.name!r}; effects are "
                f"{', '.join(self.effects)}, levels 1 to {NUM_LEVELS}, and {CLEAN}-0"
            )
        return None if variant.effect == CLEAN else self._level(variant)

    def recipe(
        self, variant: SuiteVariant, scene_name: str, changes: Mapping[str, object] | None = None
    ) -> Recipe:
        """Return the recipe in numbers of a variant for a scene.

        Args:
            variant: Effect and level.
            scene_name: Name of the scene, from which the seed follows.
            changes: Values of fields of CHANGEABLE_SECTIONS, by dotted path.

        Raises:
            RecipeError: The suite has no such variant, or a change is not allowed.
        """
        self.level_of(variant)
        check_changes(self.name, changes or {})
        data: dict[str, Any] = {}
        _merge(data, self.every_recipe)
        self._add_fields(data, variant)
        for path, value in (changes or {}).items():
            _set_field(data, path, value)
        data["name"] = variant.name
        data["seed"] = seed_of(self.name, scene_name, variant)
        try:
            return with_digest(Recipe.model_validate(data))
        except ValidationError as error:
            texts = (f"{self.name}, {variant.name}: {text}" for text in readable(error))
            raise RecipeError(*texts) from None

    def effects_in(self, conditions: Iterable[str]) -> tuple[str, ...]:
        """Return the effects that a recording under these conditions has already."""
        recorded = set(conditions)
        return tuple(
            name for name, effect in self.effects.items() if recorded & {*effect.recorded_as}
        )

    def _level(self, variant: SuiteVariant) -> SuiteLevel:
        """Return the level of a variant that has an effect."""
        return self.effects[variant.effect].levels[variant.level - 1]

    def _add_fields(self, data: dict[str, Any], variant: SuiteVariant) -> None:
        """Put the fields of a variant into a recipe's data."""
        if variant.effect == CLEAN:
            return
        level = self._level(variant)
        for name in level.of:
            self._add_fields(data, SuiteVariant.parse(name))
        for fields in (self.effects[variant.effect].set, level.set):
            for path, value in fields.items():
                _set_field(data, path, value)


def suite_names() -> tuple[str, ...]:
    """Return the names of the suites that come with the package."""
    return packaged_names("suites")


def load_suite(name: str) -> Suite:
    """Return a suite of the package; `-q` at the end of a name is its quarter, the same suite.

    Raises:
        RecipeError: There is no such suite.
    """
    stem = name.removesuffix(QUARTER_ENDING)
    if stem not in suite_names():
        guess = did_you_mean(stem, suite_names())
        raise RecipeError(f"no such suite: {name!r}; {guess}suites are {', '.join(suite_names())}")
    data = YAML(typ="safe", pure=True).load(io.StringIO(packaged_text("suites", stem)))
    return Suite.model_validate(data)


def seed_of(suite: str, scene_name: str, variant: SuiteVariant) -> int:
    """Return the seed of a variant for a scene, below 2^63, the limit of a recipe's seed.

    It is the first 63 bits of the SHA-256 of suite, scene, effect and level, with a line feed
    between them: a scene can be rendered alone, and in any order.
    """
    text = "\n".join((suite, scene_name, variant.effect, str(variant.level)))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def check_changes(suite: str, changes: Mapping[str, object]) -> None:
    """Refuse changes of the weather's numbers.

    Raises:
        RecipeError: A path begins with none of CHANGEABLE_SECTIONS.
    """
    for path in changes:
        if path.partition(".")[0] not in CHANGEABLE_SECTIONS or "." not in path:
            sections = " and ".join(f"{name}." for name in CHANGEABLE_SECTIONS)
            raise RecipeError(
                f"{path} cannot be changed in {suite}, whose weather has fixed numbers; fields of "
                f"{sections} can"
            )


@dataclass(frozen=True)
class SuiteRecipes:
    """Recipes of a dataset job that renders a suite; stands for `recipes.job.JobRecipes`."""

    suite: Suite
    """The suite."""
    variants: tuple[SuiteVariant, ...]
    """Variants that are rendered."""
    changes: Mapping[str, object]
    """Values of fields of CHANGEABLE_SECTIONS, by dotted path."""
    job: Job
    """Name, scale and size of blocks of the job. Its own recipes are not used."""

    def resolve_for_scene(self, entry: JobScene, scene_name: str) -> list[Recipe]:
        """Return the recipes in numbers under which a scene is rendered."""
        recipes = (
            self.suite.recipe(variant, scene_name, self.changes) for variant in self.variants
        )
        return [scaled_recipe(recipe, self.job.scale) for recipe in recipes]


def _merge(data: dict[str, Any], fields: Mapping[str, Any]) -> None:
    """Put fields into data; mappings merge, other values replace earlier ones."""
    for name, value in fields.items():
        if isinstance(value, Mapping):
            section = data.get(name)
            merged: dict[str, Any] = {**section} if isinstance(section, Mapping) else {}
            _merge(merged, value)
            data[name] = merged
        else:
            data[name] = value


def _set_field(data: dict[str, Any], path: str, value: object) -> None:
    """Put the value of a dotted path into data."""
    nested: Any = value
    for name in reversed(path.split(".")):
        nested = {name: nested}
    _merge(data, nested)
