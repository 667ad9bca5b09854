"""Where everything lies under an output folder, and which names are safe there.

Paths in the manifest are relative to the output folder, with forward slashes.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from pydantic import ValidationError

from augment import effects
from augment.errors import OutputError
from augment.jobs.atomic import path_below
from augment.jobs.box_tables import BOXES_2D, MASKS
from recipes.schema import Recipe

MANIFEST = "manifest.parquet"
STATE_FOLDER = ".climategs"
SWEEPS = "lidar"  # the folder of sweeps, of a variant or, untouched by weather, of its scene

_SAFE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_UNSAFE_CHARACTERS = re.compile(r"[^A-Za-z0-9._-]+")


def folder_name(name: str) -> str:
    """A name of a scene or camera as one safe path component. Letters, digits, `.`, `_`, `-`, at
    most 100 of them and the first a letter or digit, stay as they are. Any other name has the rest
    replaced by `_` and eight hex digits of its SHA-256 added, so that two names never share a
    folder and nothing leaves the output folder.
    """
    if _SAFE.fullmatch(name) and name != MANIFEST:
        return name
    digest = hashlib.sha256(name.encode()).hexdigest()[:8]
    readable = _UNSAFE_CHARACTERS.sub("_", name).lstrip("._-")[:80]
    return f"{readable or 'unnamed'}-{digest}"


def variant_name(recipe: Recipe) -> str:
    """The folder of a recipe's draw: `fog-003`."""
    return f"{recipe.name}-{recipe.variant:03d}"


# Kinds of files whose paths a row of the manifest has, but for those of effects.
_IMAGES, _LABELS = ("image", "depth", "semantic", "instance"), ("lidar", "labels")
_LAST = "calibration"
TRUST = "trust"  # the mask of how far a picture can be believed, 0 to 255, see augment.trust


def path_kinds() -> tuple[str, ...]:
    """In the order of the manifest's columns: `image` and so on, its column being `image_path`."""
    tables = [e.table.name for e in reversed(effects.EFFECTS) if e.table]
    return (*_IMAGES, *mask_names(), *_LABELS, BOXES_2D.name, MASKS.name, *tables, _LAST)


def mask_names() -> tuple[str, ...]:
    """Of the mask images: of effects, and of what can be believed."""
    return (*(e.mask for e in reversed(effects.EFFECTS) if e.mask), TRUST)


def share_columns() -> dict[str, str]:
    """The manifest's columns that say how many of an image's pixels a mask marks, by the mask."""
    shares = ((e.mask, e.share_column) for e in reversed(effects.EFFECTS))
    return {**{m: column for m, column in shares if m and column}, TRUST: "trusted_fraction"}


def path_columns(paths: Mapping[str, str | None]) -> dict[str, str | None]:
    """Paths by kind as the manifest's columns."""
    return {f"{kind}_path": path for kind, path in paths.items()}


def variant_folder(scene: str, variant: str) -> str:
    """The folder of one variant of a scene."""
    return f"{folder_name(scene)}/{folder_name(variant)}"


def box_weather_files(recipe: Recipe) -> dict[str, str]:
    """Files inside the variant's folder that say what is seen of the boxes, and what the weather
    does to them, by kind.
    """
    if not recipe.output.labels:
        return {}
    own = [e.table for e in reversed(effects.EFFECTS) if e.table and e.of(recipe) is not None]
    masks = [MASKS] if recipe.output.label_formats else []
    return {table.name: table.file for table in (BOXES_2D, *masks, *own)}


def item_paths(scene: str, recipe: Recipe, camera: str, frame: int) -> dict[str, str | None]:
    """Where the image of one camera in one frame lies, and what else the recipe asks for, by kind:
    relative to the output folder; None if unused.
    """
    if frame < 0:
        raise ValueError(f"frame numbers in an output folder are >= 0; got {frame}")
    output, base = recipe.output, variant_folder(scene, variant_name(recipe))
    stem = f"{folder_name(camera)}/{frame:06d}"
    masks = {e.mask for e in effects.EFFECTS if e.mask and e.of(recipe) is not None}
    masks |= {TRUST} if output.trust else set()
    used = {
        "image": f"{base}/images/{stem}.{output.image}",
        **{mask: f"{base}/{mask}/{stem}.png" for mask in masks},
        **{name: f"{base}/{file}" for name, file in box_weather_files(recipe).items()},
        _LAST: f"{base}/calibration.json",
    }
    if output.depth != "none":
        used["depth"] = f"{base}/depth/{stem}.png"
    for name in ("semantic", "instance"):
        if getattr(output, name):
            used[name] = f"{base}/{name}/{stem}.png"
    if recipe.lidar:
        # What no weather changes, the variants of a scene share.
        place = base if recipe.lidar == "weather" else folder_name(scene)
        used["lidar"] = f"{place}/{SWEEPS}/{frame:06d}.parquet"
    if output.labels:
        used["labels"] = f"{base}/labels/boxes.parquet"
    return {kind: used.get(kind) for kind in path_kinds()}


class FileListing:
    """Which files an output folder on this machine has. A folder is looked at once, when it is
    first asked for: tens of thousands of single looks would take longer than all else of a resume.
    """

    def __init__(self, out_dir: Path) -> None:
        self._out_dir = out_dir
        self._names: dict[str, frozenset[str]] = {}

    def has(self, path: str) -> bool:
        """Whether there is a file of this path, which is relative to the output folder. Raises
        OutputError: a link leads out of the output folder.
        """
        folder, _, name = path.rpartition("/")
        if folder not in self._names:
            self._names[folder] = self._names_in(folder)
        return name in self._names[folder]

    def _names_in(self, folder: str) -> frozenset[str]:
        place = path_below(self._out_dir, tuple(folder.split("/")) if folder else ())
        try:
            with os.scandir(place) as entries:
                return frozenset(entry.name for entry in entries if entry.is_file())
        except OSError:  # missing, or what is no folder
            return frozenset()


@contextlib.contextmanager
def reading_back(where: str, advice: str) -> Iterator[None]:
    """While JSON of the output is taken apart as it was put together, what goes wrong is an
    OutputError. advice: what to do, a sentence without its full stop.
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
        if isinstance(e, ValidationError):  # of all that differs, the first
            first = e.errors(include_url=False)[0]
            problem = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise OutputError(f"{where} is damaged: {problem}. {advice}") from e


def relative_parts(path: str) -> tuple[str, ...] | None:
    """The components of a path that stays below its root; None: empty, absolute, or it climbs."""
    parts = PurePosixPath(path).parts
    if not parts or parts[0].startswith("/") or ".." in parts or "\\" in path or "\0" in path:
        return None
    return parts


def resolve_inside(root: Path, relative: str) -> Path:
    """The file that a manifest's path names."""
    parts = relative_parts(relative)
    if parts is None:
        raise OutputError(
            f"{root / MANIFEST} names the file {relative!r}; paths there must be relative to "
            f"{root}, without '..'. The manifest is damaged or not from this project: do not "
            f"trust the folder"
        )
    return path_below(root, parts)
