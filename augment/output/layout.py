"""Paths of all files under an output folder.

In: names of scenes, variants and cameras, and recipes. Out: relative paths. Jobs write there;
readers of an output find files by it. Paths in the manifest are relative to the output folder, with
forward slashes.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from pydantic import ValidationError

from augment import effects
from augment.errors import OutputError
from augment.output.atomic import path_below
from augment.output.box_tables import BOXES_2D, MASKS
from augment.output.names import folder_name
from recipes.schema import Recipe

# Folder of the progress logs inside the state folder, see augment.jobs.job_state.
PROGRESS_LOGS = "progress"
# The same folder as older versions called it.
OLD_PROGRESS_LOGS = "journal"
# Folder of LiDAR sweeps, inside a variant's folder; inside the scene's for sweeps without weather.
SWEEP_FOLDER = "lidar"


def variant_name(recipe: Recipe) -> str:
    """Return the folder's name of one draw of a recipe, such as `fog-003`."""
    return f"{recipe.name}-{recipe.variant:03d}"


# Kinds of image files in the manifest, without masks.
_IMAGE_KINDS = ("image", "depth", "semantic", "instance")
# Kinds of label files in the manifest, without tables of boxes in images.
_LABEL_KINDS = ("lidar", "labels")
# Kind of the calibration file, the last in the manifest.
_CALIBRATION = "calibration"
# Mask that says how far a picture can be believed, 0 to 255, see augment.photo.trust.
TRUST = "trust"


def path_kinds() -> tuple[str, ...]:
    """Return the kinds of files in the order of the manifest's columns.

    The column of the kind `image` is `image_path`.
    """
    tables = [e.box_table.name for e in reversed(effects.EFFECTS) if e.box_table]
    return (
        *_IMAGE_KINDS,
        *mask_names(),
        *_LABEL_KINDS,
        BOXES_2D.name,
        MASKS.name,
        *tables,
        _CALIBRATION,
    )


def mask_names() -> tuple[str, ...]:
    """Return the names of the mask images: masks of effects, and TRUST."""
    return (*(e.mask_name for e in reversed(effects.EFFECTS) if e.mask_name), TRUST)


def mask_share_columns() -> dict[str, str]:
    """Return the manifest's column for the marked share of pixels, by mask name."""
    shares = ((e.mask_name, e.share_column) for e in reversed(effects.EFFECTS))
    return {**{m: column for m, column in shares if m and column}, TRUST: "trusted_fraction"}


def measured_columns() -> tuple[str, ...]:
    """Return the manifest's columns of numbers that effects measure of an image."""
    return tuple(name for effect in effects.EFFECTS for name in effect.measured_columns)


def path_columns(paths: Mapping[str, str | None]) -> dict[str, str | None]:
    """Return paths by the manifest's columns instead of by kind."""
    return {f"{kind}_path": path for kind, path in paths.items()}


def variant_folder(scene: str, variant: str) -> str:
    """Return the folder of one variant of a scene."""
    return f"{folder_name(scene)}/{folder_name(variant)}"


def box_weather_files(recipe: Recipe) -> dict[str, str]:
    """Return the files that hold measured numbers of boxes, by kind.

    The numbers say what is seen of the boxes, and what the weather does to them. Paths are relative
    to the variant's folder.
    """
    if not recipe.output.labels:
        return {}
    effect_tables = [
        e.box_table
        for e in reversed(effects.EFFECTS)
        if e.box_table and e.section_of(recipe) is not None
    ]
    masks = [MASKS] if recipe.output.label_formats else []
    return {table.name: table.file for table in (BOXES_2D, *masks, *effect_tables)}


def item_paths(scene: str, recipe: Recipe, camera: str, frame: int) -> dict[str, str | None]:
    """Return the paths of an image and of the other files that the recipe asks for, by kind.

    Paths are relative to the output folder; None for kinds that are not used.

    Args:
        scene: Name of the scene.
        camera: Camera name.
        frame: Frame number.
    """
    if frame < 0:
        raise ValueError(f"frame numbers in an output folder are >= 0; got {frame}")
    output = recipe.output
    variant_dir = variant_folder(scene, variant_name(recipe))
    stem = f"{folder_name(camera)}/{frame:06d}"
    masks = {
        e.mask_name for e in effects.EFFECTS if e.mask_name and e.section_of(recipe) is not None
    }
    masks |= {TRUST} if output.trust else set()
    path_of_kind = {
        "image": f"{variant_dir}/images/{stem}.{output.image}",
        **{mask: f"{variant_dir}/{mask}/{stem}.png" for mask in masks},
        **{name: f"{variant_dir}/{file}" for name, file in box_weather_files(recipe).items()},
        _CALIBRATION: f"{variant_dir}/calibration.json",
    }
    if output.depth != "none":
        path_of_kind["depth"] = f"{variant_dir}/depth/{stem}.png"
    for name in ("semantic", "instance"):
        if getattr(output, name):
            path_of_kind[name] = f"{variant_dir}/{name}/{stem}.png"
    if recipe.lidar:
        # The variants of a scene share the sweeps that no weather changes.
        folder = variant_dir if recipe.lidar == "weather" else folder_name(scene)
        path_of_kind["lidar"] = f"{folder}/{SWEEP_FOLDER}/{frame:06d}.parquet"
    if output.labels:
        path_of_kind["labels"] = f"{variant_dir}/labels/boxes.parquet"
    return {kind: path_of_kind.get(kind) for kind in path_kinds()}


class FileListing:
    """Listing of the files of an output folder on this machine.

    A folder is listed once, at the first question about it: tens of thousands of single questions
    to the system would take longer than everything else of a resumed job.
    """

    def __init__(self, out_dir: Path) -> None:
        self._out_dir = out_dir
        self._names: dict[str, frozenset[str]] = {}

    def has(self, path: str) -> bool:
        """Return True if a file has this path, relative to the output folder.

        Raises:
            OutputError: A link leads out of the output folder.
        """
        folder, _, name = path.rpartition("/")
        if folder not in self._names:
            self._names[folder] = self._names_in(folder)
        return name in self._names[folder]

    def _names_in(self, folder: str) -> frozenset[str]:
        """Return the names of the files in a folder."""
        folder_path = path_below(self._out_dir, tuple(folder.split("/")) if folder else ())
        try:
            with os.scandir(folder_path) as entries:
                return frozenset(entry.name for entry in entries if entry.is_file())
        except OSError:  # missing, or not a folder
            return frozenset()


@contextlib.contextmanager
def parse_errors_as_output_errors(source_name: str, advice: str) -> Iterator[None]:
    """Context manager that turns errors of reading the output's own JSON into an OutputError.

    Args:
        source_name: Name of the file.
        advice: What to do, a sentence without its full stop.
    """
    try:
        yield
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as e:
        problem = f"{e} is missing" if isinstance(e, KeyError) else " ".join(str(e).split())
        if isinstance(e, ValidationError):  # names the first of all differences
            first = e.errors(include_url=False)[0]
            problem = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise OutputError(f"{source_name} is damaged: {problem}. {advice}") from e
