"""Scene folders: a scene as files of our own, opened in an instant.

    scene.json              what it is, cameras over time, tracks, colour maps (scene_document)
    gaussians.safetensors   background.means, ..., actors.0.means, ...: float32; semantic: int16
    sky.safetensors         rgb [3], image [H, W, 3] or faces [6, R, R, 3]: float32

Arrays hold activated values, as `Gaussians` does, and are mapped into memory, so that opening costs
no copy; every number is looked at once, since the files may come from anywhere.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from torch import Tensor

from augment.atomic_folder import replaced_folder
from augment.errors import OutputError, SceneError
from augment.scene import SH_COUNTS, Gaussians, Scene, SemanticClass, check_gaussians
from augment.scene_document import SKY_KINDS, document_text, scene_document, scene_of
from augment.scene_schema import FORMAT, SceneDocument, read_document
from augment.sky import ConstantSky, CubemapSky, LatLongSky, Sky

DOCUMENT, GAUSSIANS, SKY = "scene.json", "gaussians.safetensors", "sky.safetensors"
FILES = (DOCUMENT, GAUSSIANS, SKY)
SCENE_SUFFIX = ".climategs"
_ARRAYS = ("means", "quats", "scales", "opacities", "sh")
_QUAT_TOLERANCE = 1e-4  # of unit length; what is further off is normalised
_MARK = re.compile(rb'\s*\{\s*"format"\s*:\s*"' + FORMAT.encode() + rb'"')


def is_scene_folder(folder: Path) -> bool:
    """Whether a folder says that it is a scene folder; it may be damaged all the same."""
    try:
        with (folder / DOCUMENT).open("rb") as file:
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
    arrays = _arrays_of(scene)
    sky = {_sky_array(type(scene.sky)): _array(getattr(scene.sky, _sky_array(type(scene.sky))))}
    if folder.is_dir() and any(folder.iterdir()) and not is_scene_folder(folder):
        raise OutputError(
            f"{folder} holds other files and no scene, so it is not replaced; choose another folder"
        )
    with replaced_folder(folder, FILES) as new:
        (new / DOCUMENT).write_text(document_text(document), encoding="utf-8")
        mode = (new / DOCUMENT).stat().st_mode & 0o777
        for name, tensors in ((GAUSSIANS, arrays), (SKY, sky)):
            _write_tensors(new / name, tensors)
            (new / name).chmod(mode)  # safetensors keeps its files to their owner


@dataclass(frozen=True, eq=False)
class SceneFolder:
    """What a scene folder held. scene: without labels. working_folder: where relative paths in
    scene.recorded_source start from.
    """

    scene: Scene
    working_folder: Path


def load_scene_parts(folder: str | Path) -> Scene:
    """The scene of `read_scene_folder` alone."""
    return read_scene_folder(folder).scene


def read_scene_folder(folder: str | Path) -> SceneFolder:
    """Open a scene folder. Its arrays are mapped: writes to them stay in memory.

    Gaussians that no rasteriser can draw are left out with a sentence in `problems`.

    Raises:
        SceneError: a file is missing, damaged, of another version or format, or they do not belong
            together.
    """
    folder = Path(folder)
    for name in FILES:
        if not (folder / name).is_file():
            raise SceneError(f"{folder} is no scene folder: it has no {name}")
    document = read_document(folder / DOCUMENT)
    parts, problems = _read_parts(folder / GAUSSIANS, document)
    sky = _read_sky(folder / SKY, document.sky)
    if problems:
        found = [*document.problems, *problems]
        document = document.model_copy(update={"problems": found})
    scene = scene_of(document, parts, sky, source=f"scene:{folder}", where=str(folder / DOCUMENT))
    return SceneFolder(scene, Path(document.working_folder))


def _arrays_of(scene: Scene) -> dict[str, np.ndarray]:
    arrays = {}
    for number, gaussians in enumerate(scene.all_gaussians):
        if gaussians.means.dtype != torch.float32:
            raise SceneError(
                f"scene {scene.name!r}: scene folders hold float32 Gaussians; got "
                f"{gaussians.means.dtype}"
            )
        part = _part_name(number)
        arrays |= {f"{part}.{name}": _array(getattr(gaussians, name)) for name in _ARRAYS}
        if gaussians.semantic is not None:
            arrays[f"{part}.semantic"] = _array(gaussians.semantic)
    return arrays


def _part_name(number: int) -> str:
    return "background" if number == 0 else f"actors.{number - 1}"


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy())


def _sky_array(kind: type) -> str:
    return {ConstantSky: "rgb", LatLongSky: "image", CubemapSky: "faces"}[kind]


def _write_tensors(path: Path, tensors: dict[str, np.ndarray]) -> None:
    try:
        save_file(tensors, path)
    except SafetensorError as error:
        number = re.search(r"os error (\d+)", str(error))
        if number is None:
            raise
        code = int(number[1])
        raise OSError(code, os.strerror(code), str(path)) from error


def _read_tensors(path: Path) -> dict[str, Tensor]:
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error}") from error
    except Exception as error:  # whatever a damaged header leads to, in safetensors or in torch
        raise SceneError(f"{path} is damaged or no safetensors file: {error}") from error


def _read_parts(path: Path, document: SceneDocument) -> tuple[list[Gaussians], list[str]]:
    tensors = _read_tensors(path)
    counts = [document.background_gaussians, *(actor.gaussians for actor in document.actors)]
    parts, problems = [], []
    for number, count in enumerate(counts):
        part = _part_name(number)
        gaussians = _take_part(path, tensors, part, count)
        if not _is_drawable(gaussians):
            gaussians, found = check_gaussians(gaussians, where=f"{path}, {part}")
            problems += found
        parts.append(gaussians)
    if tensors:
        raise SceneError(
            f"{path} holds arrays that {DOCUMENT} does not know: {sorted(tensors)[:5]}"
        )
    return parts, problems


def _take_part(path: Path, tensors: dict[str, Tensor], part: str, count: int) -> Gaussians:
    """Gaussians of a part, which are taken out of `tensors`."""
    missing = [f"{part}.{name}" for name in _ARRAYS if f"{part}.{name}" not in tensors]
    if missing:
        raise SceneError(f"{path} lacks {', '.join(missing)}")
    own = {name: tensors.pop(f"{part}.{name}") for name in _ARRAYS}
    semantic = tensors.pop(f"{part}.semantic", None)
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": None}
    for name, tensor in own.items():
        where, shape = f"{path}: {part}.{name}", tuple(tensor.shape)
        if tensor.dtype != torch.float32:
            raise SceneError(f"{where} must be float32; got {tensor.dtype}")
        if not shape or shape[0] != count:
            raise SceneError(
                f"{where} must have {count} rows, as {DOCUMENT} says; got {list(shape)}: the files "
                f"do not belong together"
            )
        row = shapes[name]
        if row is None and not (len(shape) == 3 and shape[1] in SH_COUNTS and shape[2] == 3):
            raise SceneError(f"{where} must be [N, K, 3] with K in {SH_COUNTS}; got {list(shape)}")
        if row is not None and shape[1:] != row:
            raise SceneError(f"{where} must be {[count, *row]}; got {list(shape)}")
    if semantic is not None:
        _check_semantic(semantic, count, f"{path}: {part}.semantic")
    return Gaussians(**own, semantic=semantic)


def _check_semantic(semantic: Tensor, count: int, where: str) -> None:
    if semantic.dtype != torch.int16 or tuple(semantic.shape) != (count,):
        raise SceneError(
            f"{where} must be int16 [{count}]; got {semantic.dtype} {list(semantic.shape)}"
        )
    classes = [int(value) for value in SemanticClass]
    low, high = _range(semantic) if semantic.numel() else (0, 0)
    if low < min(classes) or high > max(classes):
        raise SceneError(
            f"{where} must hold classes from {min(classes)} to {max(classes)}; got "
            f"{low:.0f} to {high:.0f}"
        )


def _is_drawable(gaussians: Gaussians) -> bool:
    """Whether `check_gaussians` would leave every bit as it is, told in one look at each number."""
    if len(gaussians) == 0:
        return True
    ranges = {name: _range(getattr(gaussians, name)) for name in _ARRAYS}
    quats = gaussians.quats.numpy()
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = _range(np.sqrt(np.einsum("ni,ni->n", quats, quats)))
    return (
        all(np.isfinite(ends).all() for ends in ranges.values())
        and lengths[0] > 1 - _QUAT_TOLERANCE
        and lengths[1] < 1 + _QUAT_TOLERANCE
        and ranges["scales"][0] > 0
        and ranges["opacities"][0] >= 0
        and ranges["opacities"][1] <= 1
    )


def _range(values: Tensor | np.ndarray) -> tuple[float, float]:
    """Lowest and highest value; NaN where there is one. By NumPy, which wakes no threads."""
    array = values.numpy() if isinstance(values, Tensor) else values
    with np.errstate(invalid="ignore"):
        return float(array.min()), float(array.max())


def _read_sky(path: Path, kind: str) -> Sky:
    tensors = _read_tensors(path)
    sky_class = next(cls for cls, name in SKY_KINDS.items() if name == kind)
    name = _sky_array(sky_class)
    if list(tensors) != [name]:
        raise SceneError(f"{path}: a {kind} sky is one array {name!r}; got {sorted(tensors)[:5]}")
    values = tensors[name]
    shape = tuple(values.shape)
    fits = {
        "rgb": shape == (3,),
        "image": len(shape) == 3 and shape[2] == 3,
        "faces": len(shape) == 4 and shape[0] == 6 and shape[1] == shape[2] and shape[3] == 3,
    }[name]
    if not fits or values.dtype != torch.float32 or values.numel() == 0:
        expected = {"rgb": "[3]", "image": "[H, W, 3]", "faces": "[6, R, R, 3]"}[name]
        raise SceneError(
            f"{path}: {name} must be float32 {expected}; got {values.dtype} {list(shape)}"
        )
    if not np.isfinite(_range(values)).all():
        raise SceneError(f"{path}: {name} holds NaN or infinite values")
    return sky_class(values)
