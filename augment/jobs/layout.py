"""Where everything lies under an output folder, and which names are safe there.

Paths in the manifest are relative to the output folder, with forward slashes.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

from augment.errors import OutputError
from recipes.schema import Recipe

MANIFEST = "manifest.parquet"
STATE_FOLDER = ".climategs"
# What is measured of the boxes, inside a variant's folder.
_BOX_WEATHER = {
    "box_2d": "labels/boxes_2d.parquet",
    "box_water": "labels/water.parquet",
    "box_snow": "labels/snow.parquet",
    "box_smog": "labels/smog.parquet",
}

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


@dataclass(frozen=True)
class ItemPaths:
    """Paths of one image and what belongs to it, relative to the output folder; None if unused."""

    image: str
    depth: str | None
    semantic: str | None
    instance: str | None
    water: str | None
    snow: str | None
    lidar: str | None
    labels: str | None
    box_2d: str | None
    box_water: str | None
    box_snow: str | None
    box_smog: str | None
    calibration: str

    def columns(self) -> dict[str, str | None]:
        """As the manifest's columns: `image_path` and so on."""
        return {f"{kind}_path": path for kind, path in asdict(self).items()}


PATH_KINDS = tuple(ItemPaths.__dataclass_fields__)


def variant_folder(scene: str, variant: str) -> str:
    """The folder of one variant of a scene."""
    return f"{folder_name(scene)}/{folder_name(variant)}"


def box_weather_files(recipe: Recipe) -> dict[str, str]:
    """Files inside the variant's folder that say what is seen of the boxes, and what the weather
    does to them, by kind.
    """
    present = {
        "box_2d": True,
        "box_water": recipe.weather.flood is not None,
        "box_snow": recipe.weather.snow is not None,
        "box_smog": recipe.weather.smog is not None,
    }
    return {k: _BOX_WEATHER[k] for k, there in present.items() if there and recipe.output.labels}


def item_paths(scene: str, recipe: Recipe, camera: str, frame: int) -> ItemPaths:
    """Where the image of one camera in one frame lies, and what else the recipe asks for."""
    if frame < 0:
        raise ValueError(f"frame numbers in an output folder are >= 0; got {frame}")
    output, weather = recipe.output, recipe.weather
    tables = box_weather_files(recipe)
    base = variant_folder(scene, variant_name(recipe))
    stem = f"{folder_name(camera)}/{frame:06d}"
    return ItemPaths(
        image=f"{base}/images/{stem}.{output.image}",
        depth=None if output.depth == "none" else f"{base}/depth/{stem}.png",
        semantic=f"{base}/semantic/{stem}.png" if output.semantic else None,
        instance=f"{base}/instance/{stem}.png" if output.instance else None,
        water=None if weather.flood is None else f"{base}/water/{stem}.png",
        snow=None if weather.snow is None else f"{base}/snow/{stem}.png",
        lidar=f"{base}/lidar/{frame:06d}.parquet" if recipe.lidar else None,
        labels=f"{base}/labels/boxes.parquet" if output.labels else None,
        box_2d=f"{base}/{tables['box_2d']}" if "box_2d" in tables else None,
        box_water=f"{base}/{tables['box_water']}" if "box_water" in tables else None,
        box_snow=f"{base}/{tables['box_snow']}" if "box_snow" in tables else None,
        box_smog=f"{base}/{tables['box_smog']}" if "box_smog" in tables else None,
        calibration=f"{base}/calibration.json",
    )


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


def path_below(root: Path, parts: tuple[str, ...]) -> Path:
    """The path of these components, which no link leads out of the root."""
    path = root.joinpath(*parts)
    real_root = root.resolve()
    if not path.resolve().is_relative_to(real_root):
        raise OutputError(
            f"{path} leads through a link to {path.resolve()}, outside {real_root}; "
            f"put the files themselves under the output folder"
        )
    return path
