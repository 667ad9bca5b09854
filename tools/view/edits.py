"""Changes of a recipe by a page, as texts of `--set`: a command line can say the same."""

from __future__ import annotations

import itertools
import json
import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from augment.errors import OutputError
from augment.output.atomic import write_new_file
from augment.output.recipe_files import copy_files, portable_recipe
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.scene.scene_times import scene_times
from recipes.errors import RecipeError, short
from recipes.fields import section_at, with_unchecked_field
from recipes.job import scaled_recipe
from recipes.load import dump_recipe, load_recipe, preset_names, read_overrides
from recipes.schema import Recipe, Sensor
from tools.view.controls import start_values_of_model


def as_yaml(value: Any) -> str:
    """Return a plain value as one line of YAML."""
    return json.dumps(value)


@dataclass(frozen=True)
class Edits:
    """A recipe and the changes to it."""

    source: str
    """The name of a preset, or the path of a recipe file."""
    scale: float = 1.0
    """The resolution relative to the recipe's."""
    values: Mapping[str, str] = field(default_factory=dict)
    """The changed values as YAML, by dotted path."""
    added: Mapping[str, str] = field(default_factory=dict)
    """The sections that the source lacks, as YAML, by dotted path."""
    absent: frozenset[str] = frozenset()
    """The sections that are switched off. Their values are kept for switching them on again."""
    folder: Path = field(default_factory=Path)
    """The folder of uploaded files, to which paths in values are relative."""

    def with_values(self, values: Mapping[str, str]) -> Edits:
        """Return edits with further changed values."""
        return replace(self, values={**self.values, **values})

    def with_tier(self, tier: str | None) -> Edits:
        """Return edits with a tier in place of the quality that the source asks for."""
        quality = {"tier": as_yaml(tier), "max_flip": "null", "budget_ms": "null"}
        return self.with_values({f"quality.{name}": text for name, text in quality.items()})

    def with_section(self, section: str) -> Edits:
        """Return edits with a section switched on.

        It has its values from before it was switched off, or else the source's, or start values.
        """
        edits = replace(self, absent=self.absent - {section})
        if section_at(replace(edits, values={}).recipe(), section) is not None:
            return edits
        start = as_yaml(start_values(section))
        return replace(edits, added={**self.added, section: start})

    def without_section(self, section: str) -> Edits:
        """Return edits with a section switched off."""
        return replace(self, absent=self.absent | {section})

    def sets(self) -> list[str]:
        """Return FIELD=VALUE texts in the order in which `--set` takes them."""
        prefixes = tuple(f"{section}." for section in self.absent)
        added = {path: text for path, text in self.added.items() if path not in self.absent}
        values = {path: text for path, text in self.values.items() if not path.startswith(prefixes)}
        absent = dict.fromkeys(sorted(self.absent), "null")
        return [f"{path}={text}" for path, text in {**added, **values, **absent}.items()]

    def recipe(self) -> Recipe:
        """Return the edited recipe, with numbers in place of ranges.

        Raises:
            RecipeError: the edits make no valid recipe.
        """
        overrides = read_overrides(self.sets(), "changed", folder=self.folder)
        return scaled_recipe(load_recipe(self.source, overrides).resolve(0), self.scale)

    def without_conflict(self, changed_path: str, nullable_paths: tuple[str, ...]) -> Edits:
        """Return the edits without a field that contradicts the changed one.

        An example is the other of two densities. Valid edits are returned as they are, and so are
        edits that no single field makes valid.

        Args:
            changed_path: Dotted path of the changed field.
            nullable_paths: Dotted paths of fields that may be set to null, in order.
        """
        try:
            self.recipe()
        except RecipeError:
            for path in nullable_paths:
                edits = self.with_values({path: "null"})
                try:
                    edits.recipe()
                except RecipeError:
                    continue
                return edits if path != changed_path else self
        return self

    def command(self, where: str) -> str:
        """Return the command line that renders the edited recipe.

        Args:
            where: Its words that choose scene, frames, cameras and output folder.
        """
        sets = " ".join(f"--set {shlex.quote(text)}" for text in self.sets())
        scale = "" if self.scale == 1 else f"--scale {self.scale:g}"
        words = ("climategs render", shlex.quote(self.source), sets, scale, "--variants 1", where)
        return " ".join(word for word in words if word)


def start_values(section: str) -> dict[str, Any]:
    """Return the values with which an effect is switched on.

    They are those of the preset with the fewest sections that has the effect. An effect without a
    preset gets values in the middle of what its fields allow.
    """
    candidates = []
    for name in preset_names():
        recipe = load_recipe(name).resolve(0)
        effect = section_at(recipe, section)
        if effect is not None and effect.has_effect:
            start = effect.model_dump(mode="json", exclude_defaults=True)
            candidates.append((len(recipe.sections()), len(start), name, start))
    if candidates:
        return _short(min(candidates, key=lambda entry: entry[:3])[3])
    return start_values_of_model(section)


def _short(value: Any) -> Any:
    """Return a value with its floats to three digits: a preset's draws have ten."""
    if isinstance(value, dict):
        return {name: _short(below) for name, below in value.items()}
    if isinstance(value, list):
        return [_short(item) for item in value]
    return float(f"{value:.3g}") if isinstance(value, float) else value


def without_weather(recipe: Recipe) -> Recipe:
    """Return the recipe of the same picture without effects, through a clean camera."""
    for section in recipe.sections():
        recipe = with_unchecked_field(recipe, section, None)
    return recipe.model_copy(update={"camera": Sensor(), "timelines": ()})


def hold_weather(recipe: Recipe, scene: Scene, camera: Camera, drive_s: float) -> Recipe:
    """Return the recipe of a picture whose weather is that of another time.

    Args:
        recipe: The recipe.
        scene: The scene.
        camera: The camera of the picture.
        drive_s: Time of the weather's drive, seconds since its first image.

    Raises:
        RecipeError: a timeline goes beyond the drive.
    """
    times = scene_times(scene)
    clock = recipe.weather.clock
    time_s = clock.time_s(drive_s)
    start_s = time_s - clock.speed * times.drive_s(camera.timestamp_ns)
    state = recipe.at_weather_time(times, time_s)
    state = with_unchecked_field(state, "weather.clock.start_s", start_s)
    return with_unchecked_field(state, "weather.air", None)  # or a saved recipe would change again


def rename_recipe(recipe: Recipe, name: str) -> Recipe:
    """Return the recipe under another name.

    Raises:
        RecipeError: a recipe cannot have the name.
    """
    try:
        return Recipe.model_validate({**recipe.model_dump(), "name": name})
    except ValidationError as error:
        raise RecipeError(
            f"name: {short(name)!r} is no name of a recipe: it begins with a letter from A to Z or "
            f"a digit, and has 1 to 64 letters, digits, dots, hyphens and underscores"
        ) from error


def save_recipe(recipe: Recipe, path: Path) -> None:
    """Write a recipe in numbers, and its files in a folder of the recipe's name beside it.

    Raises:
        FileExistsError: the path exists.
        RecipeError: a file of the recipe cannot be read, or is not that of its digest.
        OutputError: the folder cannot be written.
    """
    files_dir = path.with_suffix("")
    portable = portable_recipe(recipe)
    for section, effect in portable.sections().items():
        for name, file in effect.files.items():
            portable = with_unchecked_field(
                portable, f"{section}.{name}", f"{files_dir.name}/{file}"
            )
    write_new_file(path, dump_recipe(portable).encode())
    try:
        copy_files(recipe, files_dir)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def unused_path(folder: Path, name: str, *endings: str) -> Path:
    """Return FOLDER/NAME, or NAME-2, NAME-3, ... where no ending of it is taken."""
    for number in itertools.count(1):
        path = folder / (name if number == 1 else f"{name}-{number}")
        if not any(os.path.lexists(f"{path}{ending}") for ending in ("", *endings)):
            return path
    raise AssertionError


def create_file(folder: Path, name: str, ending: str, data: bytes) -> Path:
    """Write a file at NAME + ENDING, or at NAME-2 + ENDING, ... where there is one already.

    Args:
        folder: The folder; it is made if it is missing.
        name: The file's name without its ending; dots in it are kept.
        ending: The rest of the name.
        data: The file's bytes.

    Returns:
        The file's path.

    Raises:
        OutputError: the folder is a link, or cannot be written.
    """
    if folder.is_symlink():
        raise OutputError(
            f"{folder} is a link to {os.readlink(folder)}: files of pages are written below the "
            f"folder of --out only; remove the link, or choose another --out"
        )
    for number in itertools.count(1):
        path = folder / f"{name if number == 1 else f'{name}-{number}'}{ending}"
        try:
            write_new_file(path, data)
        except FileExistsError:
            continue
        return path
    raise AssertionError
