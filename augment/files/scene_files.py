"""Scenes in files of our own, opened in an instant: a folder, or a single file to share.

A folder holds

    scene.json              what it is, cameras over time, tracks, colour maps (scene_document)
    gaussians.safetensors   background.means, ..., actors.0.means, ... (scene_tensors)
    sky.safetensors         rgb, image or faces

and NAME.climategs is one safetensors file with the arrays of both (the sky's as sky.rgb, ...) and
the metadata `format`, `version` and `document`, the text of scene.json.

Arrays hold activated values, as `Gaussians` does, and are mapped into memory, so that opening costs
no copy; every number is looked at once, since the files may come from anywhere.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from augment.batch.atomic import replaced_file
from augment.errors import OutputError, SceneError
from augment.files.atomic_folder import replaced_folder
from augment.files.scene_document import document_text, scene_document, scene_of
from augment.files.scene_schema import (
    FORMAT,
    READABLE,
    VERSION,
    SceneDocument,
    check_format,
    parsed_document,
    read_document,
)
from augment.files.scene_tensors import part_arrays, sky_arrays, take_parts, take_sky
from augment.files.tensor_files import read_tensors, write_tensors
from augment.scene import Scene
from recipes.files import open_file

DOCUMENT, GAUSSIANS, SKY = "scene.json", "gaussians.safetensors", "sky.safetensors"
FILES = (DOCUMENT, GAUSSIANS, SKY)
SCENE_SUFFIX = ".climategs"
_SKY_PREFIX = "sky."
_MARK = re.compile(rb'\s*\{\s*"format"\s*:\s*"' + FORMAT.encode() + rb'"')


def is_scene_folder(folder: Path) -> bool:
    """Whether a folder says that it is a scene folder; it may be damaged all the same."""
    try:
        with open_file(folder / DOCUMENT) as file:
            return _MARK.match(file.read(200)) is not None
    except OSError:
        return False


def is_scene_file(path: Path) -> bool:
    """Whether a file is named as a scene in one file is; it may be damaged all the same."""
    return path.suffix.lower() == SCENE_SUFFIX


def save_scene(scene: Scene, folder: str | Path) -> None:
    """Write a scene folder, as a whole or not at all; what `load_scene_parts` gives back is equal
    to the bit, the labels excepted, which stay with the recording.

    A scene folder that is there already is replaced in one step; other files in it are kept.

    Raises:
        SceneError: the scene has something the files cannot hold (a sky of another class, Gaussians
            that are not float32).
        OutputError: the folder holds something else than a scene, or the system refused (disk full,
            no permission ...); what was there before is then as it was.
    """
    folder = Path(folder)
    document = scene_document(scene)
    arrays = {GAUSSIANS: part_arrays(scene, "float32"), SKY: sky_arrays(scene, "float32")}
    if folder.is_dir() and any(folder.iterdir()) and not is_scene_folder(folder):
        raise OutputError(
            f"{folder} holds other files and no scene, so it is not replaced; choose another folder"
        )
    with replaced_folder(folder, FILES) as new:
        (new / DOCUMENT).write_text(document_text(document), encoding="utf-8")
        for name, tensors in arrays.items():
            with (new / name).open("wb") as file:
                write_tensors(file, tensors)


def save_scene_file(scene: Scene, path: str | Path, *, half: bool = False) -> None:
    """Write a scene into one file named *.climategs, as a whole or not at all; what was there is
    replaced. What `load_scene_parts` gives back is equal to the bit, the labels excepted.

    half: quaternions, opacities, colours, their waves and the sky as float16, for about half the
    size (55 % at SH degree 3). Measured: colours move by up to 0.09/255 at degree 3 and 0.04/255 at
    degree 0 (of colours from 0 to 1), rotations by up to 0.05 degrees, opacities by up to 0.00024;
    99.9 % of a street's pixels by less than 0.1/255. That it was done is in made_by for good.

    Raises:
        SceneError: the scene has something the file cannot hold: as for save_scene, text beyond
            100 MB, or, with half, numbers beyond 65504.
        OutputError: another name, or the system refused; what was there before is as it was.
    """
    path = Path(path)
    if not is_scene_file(path):
        raise OutputError(f"{path}: a scene file must be named *{SCENE_SUFFIX}")
    precision = "float16" if half else "float32"
    document = document_text(scene_document(scene, precision))
    sky = {_SKY_PREFIX + name: array for name, array in sky_arrays(scene, precision).items()}
    metadata = {"format": FORMAT, "version": str(VERSION), "document": document}
    arrays = part_arrays(scene, precision) | sky
    with replaced_file(path) as file:
        write_tensors(file, arrays, metadata)


@dataclass(frozen=True, eq=False)
class SavedScene:
    """What a scene folder or file held. scene: without labels. working_folder: where relative paths
    in scene.recorded_source start from.
    """

    scene: Scene
    working_folder: Path


def load_scene_parts(path: str | Path) -> Scene:
    """The scene of `read_saved_scene` alone."""
    return read_saved_scene(path).scene


def read_saved_scene(path: str | Path) -> SavedScene:
    """Open a scene folder or a scene file. Its arrays are mapped: writes to them stay in memory.

    Gaussians that no rasteriser can draw are left out with a sentence in `problems`.

    Raises:
        SceneError: a file is missing, damaged, of another version or format, or they do not belong
            together.
    """
    path = Path(path)
    opened = _open_file(path) if path.is_file() else _open_folder(path)
    document, (in_document, in_parts, in_sky) = opened.document, opened.places
    parts, problems = take_parts(opened.parts, document, in_parts)
    if problems:
        found = [*document.problems, *problems]
        document = document.model_copy(update={"problems": found})
    sky = take_sky(opened.sky, document.sky, document.precision, in_sky)
    scene = scene_of(document, parts, sky, source=f"scene:{path}", where=in_document)
    return SavedScene(scene, Path(document.working_folder))


class _Opened(NamedTuple):
    """places: where document, parts and sky stand, for messages."""

    document: SceneDocument
    parts: dict[str, Tensor]
    sky: dict[str, Tensor]
    places: tuple[str, str, str]


def _open_folder(folder: Path) -> _Opened:
    for name in FILES:
        if not (folder / name).is_file():
            raise SceneError(f"{folder} is no scene folder: it has no {name}")
    places = [folder / name for name in FILES]
    document = read_document(places[0])
    parts, sky = (read_tensors(place)[0] for place in places[1:])
    return _Opened(document, parts, sky, (str(places[0]), str(places[1]), str(places[2])))


def _open_file(path: Path) -> _Opened:
    tensors, metadata = read_tensors(path)
    known = {str(number): number for number in READABLE}
    version = metadata.get("version", "none")
    check_format(metadata.get("format"), known.get(version, version), str(path))
    if "document" not in metadata:
        raise SceneError(f"{path} is damaged: its metadata has no 'document'")
    document = parsed_document(metadata["document"], f"{path}, document")
    sky = {
        name.removeprefix(_SKY_PREFIX): tensors.pop(name)
        for name in list(tensors)
        if name.startswith(_SKY_PREFIX)
    }
    return _Opened(document, tensors, sky, (str(path), str(path), str(path)))
