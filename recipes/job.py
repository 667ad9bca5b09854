"""Job files: scenes, recipes, and the number of variants of each recipe (docs/generate.md).

Every scene is rendered under every recipe, or under those that it names itself.
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

from pydantic import BeforeValidator, Field, ValidationError, field_validator, model_validator

from recipes.errors import Place, Problems, RecipeError, did_you_mean, dotted, nearest_word, short
from recipes.fields import ClosedModel, Number, Whole, changed
from recipes.load import load_recipe, preset_names, read_text
from recipes.schema import Recipe, parse_frames
from recipes.template import RecipeTemplate
from recipes.yaml_tree import ListNode, MapNode, Node, ScalarNode, plain, read_tree

MAX_BYTES = 4 << 20  # largest size of a job file, bytes
_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
Text = Annotated[str, Field(min_length=1, max_length=4096, strict=True)]
Name = Annotated[str, Field(pattern=_NAME, strict=True)]


def _expand_text(key: str) -> BeforeValidator:
    return BeforeValidator(lambda value: {key: value} if isinstance(value, str) else value)


ALL_CAMERAS = ("all",)


def _parse_all(value: Any) -> Any:
    return ALL_CAMERAS if value == "all" else value


class JobScene(ClosedModel):
    """A scene of the job, or with `*` in its path all that match."""

    uri: Text
    """What opens the scene; a relative path starts at the job file."""
    name: Name | None = None
    """Its folder in the output, where the scene's own will not do."""
    frames: Text = "all"
    """Frame numbers: all, 4, 0,5,9, 0:20:2 or ::5; ranges end with the scene."""
    cameras: Annotated[tuple[Text, ...] | None, BeforeValidator(_parse_all)] = Field(
        default=None, min_length=1
    )
    """Names of cameras; null for all, but of a fitted scene those that it was fitted to; `all` for
    all of them."""
    recipes: tuple[Text, ...] | None = Field(default=None, min_length=1)
    """Names of the job's recipes; null for all."""

    @field_validator("frames")
    @classmethod
    def _is_pattern(cls, text: str) -> str:
        parse_frames(text)
        return text


class JobRecipe(ClosedModel):
    """A recipe of the job."""

    recipe: Text
    """A preset's name, or a file relative to the job file."""
    name: Name | None = None
    """Its name in this job and the output; its own if absent."""
    variants: Whole | None = Field(default=None, ge=1, le=100_000)
    """How many to draw; as many as it says if null."""
    set: dict[str, Any] = Field(default_factory=dict)
    """Fields that replace the recipe's, by dotted path: `weather.smog.visibility_m: 60`."""


class Job(ClosedModel):
    """A job file: its scenes, its recipes and how they are drawn."""

    version: Literal[1] = 1
    """Version of the format."""
    name: Name = "job"
    """The file's name if absent."""
    scenes: tuple[Annotated[JobScene, _expand_text("uri")], ...] = Field(min_length=1)
    """URIs, or mappings with a uri."""
    recipes: tuple[Annotated[JobRecipe, _expand_text("recipe")], ...] = Field(min_length=1)
    """Presets and files, or mappings with a recipe."""
    draws: Literal["per_scene", "shared"] = "per_scene"
    """per_scene draws a recipe's ranges anew for every scene; shared gives variant k of a recipe
    the same numbers in every scene."""
    scale: Number = Field(default=1.0, gt=0, le=4)
    """Resolution, times the recipes' own render.scale."""
    block_images: Whole = Field(default=64, ge=1, le=10_000)
    """About how many images are published at once: what is lost with a machine."""

    @model_validator(mode="after")
    def _names_known_recipes(self) -> Job:
        names = [entry.name or Path(entry.recipe).stem for entry in self.recipes]
        if repeated := _repeated_names(names):
            raise ValueError(f"recipes are called the same: {repeated}; give one of them a name")
        for scene in self.scenes:
            for name in scene.recipes or ():
                if name not in names:
                    guess = did_you_mean(name, tuple(names))
                    raise ValueError(
                        f"scene {scene.uri!r} names the recipe {name!r}, which the job has not; "
                        f"{guess}it has {', '.join(names)}"
                    )
        return self


def _repeated_names(names: list[str]) -> str:
    return ", ".join(sorted({name for name in names if names.count(name) > 1}))


@runtime_checkable
class SceneRecipes(Protocol):
    """Recipes of a dataset job, in numbers for one scene after the other."""

    @property
    def job(self) -> Job:
        """Job that the recipes belong to."""
        ...

    def resolve_for_scene(self, entry: JobScene, scene_name: str) -> list[Recipe]:
        """Return the recipes in numbers under which a scene is rendered."""
        ...


@dataclasses.dataclass(frozen=True)
class JobRecipes:
    """Loaded recipes of a job. templates: by their names in the job, in its order."""

    job: Job
    templates: dict[str, RecipeTemplate]

    def resolve_for_scene(self, entry: JobScene, scene_name: str) -> list[Recipe]:
        """Return the recipes in numbers under which a scene is rendered."""
        recipes = []
        for name in self.templates if entry.recipes is None else dict.fromkeys(entry.recipes):
            template = self.templates[name]
            if self.job.draws == "per_scene":
                seed = seed_for_scene(template.seed, scene_name)
                template = dataclasses.replace(template, seed=seed)
            variants = [template.resolve(number) for number in range(template.variants)]
            recipes += [scaled_recipe(recipe, self.job.scale) for recipe in variants]
        return recipes


def load_job(path: Path) -> Job:
    """Read the job in a YAML file.

    Raises:
        RecipeError: the file does not exist, or is no valid job; one line for each problem.
    """
    missing = "no such file; a job is a YAML file"
    too_large = "name scenes by a pattern (*)"
    text = read_text(path, MAX_BYTES, missing=missing, too_large=too_large)
    return parse_job(text, source=str(path), name=path.stem, folder=path.parent)


def parse_job(text: str, *, source: str, name: str = "job", folder: Path | None = None) -> Job:
    """Read the job in YAML `text`.

    Args:
        text: the YAML.
        source: words before the line number in messages.
        name: default of the job's name.
        folder: folder of the files that its `set` names.

    Raises:
        RecipeError: it is no valid job; one line for each problem.
    """
    problems = Problems()
    place = Place(source, folder=folder)
    empty = "the file is empty; a job names scenes and recipes"
    tree = read_tree(text, place, problems, empty=empty)
    if not isinstance(tree, MapNode):
        raise tree.place.error("a job is a mapping with scenes and recipes")
    problems.raise_if_any()
    tree.setdefault("name", ScalarNode(place, name, name))
    data: Any = plain(tree)
    recipes = tree.get("recipes")
    for index, node in enumerate(recipes if isinstance(recipes, ListNode) else ()):
        if isinstance(node, MapNode) and "set" in node:
            data["recipes"][index]["set"] = node["set"]  # with its lines
    try:
        return Job.model_validate(data)
    except ValidationError as error:
        for problem in error.errors(include_url=False, include_context=False):
            if problem["type"] == "too_short" and problem["input"]:
                continue  # it has items, each of them with a problem of its own
            prefix = f"{dotted(problem['loc'])}: " if problem["loc"] else ""
            problems.add(_place(tree, problem["loc"]), f"{prefix}{_message(problem)}")
    problems.raise_if_any()
    raise AssertionError("pydantic found a problem and named none")


def load_job_recipes(job: Job, folder: Path) -> JobRecipes:
    """Load the job's recipes from their presets and files. folder: where relative paths start.

    Raises:
        RecipeError: a recipe is missing or invalid.
    """
    templates = {}
    for entry in job.recipes:
        is_preset = entry.recipe in preset_names()
        try:
            source = entry.recipe if is_preset else folder / entry.recipe
            template = load_recipe(source, entry.set)
        except RecipeError as error:
            raise RecipeError(f"job {job.name}, recipe {entry.recipe!r}: {error}") from None
        name = entry.name or Path(entry.recipe).stem
        if entry.name is not None:
            template = dataclasses.replace(template, name=entry.name)
        if entry.variants is not None:
            template = dataclasses.replace(template, variants=entry.variants)
        templates[name] = template
    if repeated := _repeated_names([template.name for template in templates.values()]):
        raise RecipeError(
            f"job {job.name}: recipes write to the same folders: {repeated}; give one of them a "
            "name in the job"
        )
    return JobRecipes(job, templates)


def seed_for_scene(seed: int, scene_name: str) -> int:
    """Return a seed for one scene: the first 63 bits of a SHA-256 of `seed` and its name."""
    digest = hashlib.sha256(f"climategs scene seed 1 {seed} {scene_name}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def scaled_recipe(recipe: Recipe, scale: float) -> Recipe:
    """Return the recipe at another resolution, its render.scale.

    Raises:
        RecipeError: the scale is beyond the limits.
    """
    if scale == 1:
        return recipe
    try:
        return changed(recipe, {"render.scale": recipe.render.scale * scale})
    except ValidationError as error:
        product = f"a scale of {scale} times the recipe's render.scale {recipe.render.scale}"
        raise RecipeError(f"{product} is not possible: {error.errors()[0]['msg']}") from None


def _place(tree: Node, location: tuple[int | str, ...]) -> Place:
    """Return the place of the location, or of the nearest node above it that the file has."""
    node: Any = tree
    for part in location:
        try:
            node = node[part]
        except (KeyError, IndexError, TypeError):
            break
    return node.place


_WORDS = {
    "missing": "is missing",
    "tuple_type": "must be a list, with a line '- ...' for each",
    "too_short": "names none; at least one is needed",
    "model_type": "must be a text, or a mapping of fields",
    "dict_type": "must be a mapping such as {weather.smog.visibility_m: 60}",
    "string_pattern_mismatch": "must be letters, digits, '.', '_', '-', at most 64, the first a "
    "letter or digit",
}


def _message(problem: Any) -> str:
    if problem["type"] == "extra_forbidden":
        fields = {**JobScene.model_fields, **JobRecipe.model_fields, **Job.model_fields}
        field = nearest_word(str(problem["loc"][-1]), fields)
        return "unknown field" + (f"; did you mean {field}?" if field else "")
    if problem["type"] == "value_error":
        return problem["msg"].removeprefix("Value error, ")
    if problem["type"] in _WORDS:
        return _WORDS[problem["type"]]
    text = problem["msg"].replace("Input should", "must", 1)
    return f"{text}; got {short(repr(problem['input']))}"
