"""The arrays of a saved scene: their names, their shapes, and that every number can be drawn.

    background.means [n, 3], quats [n, 4], scales [n, 3], opacities [n], sh [n, K, 3]: float32
    background.semantic [n]: int16, where classes are known
    actors.0.means ...: the same of each actor; actors.0.waves [n, F - 1, 3] of its colour waves
    rgb [3], image [H, W, 3] or faces [6, R, R, 3]: the sky, float32

At precision float16, quats, opacities, sh, waves and the sky are float16.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from augment.errors import SceneError
from augment.gaussian_checks import drawable_rows, is_drawable
from augment.scene import SH_COUNTS, Gaussians, Scene, SemanticClass, check_gaussians
from augment.sky import ConstantSky, CubemapSky, LatLongSky, Sky

if TYPE_CHECKING:
    from augment.files.scene_schema import Precision, SceneDocument

SKY_KINDS: dict[type, str] = {ConstantSky: "constant", LatLongSky: "latlong", CubemapSky: "cubemap"}
MOST_WAVES = 1000  # terms; what is summed for every image must not take for ever
_SKY_ARRAYS = {"constant": "rgb", "latlong": "image", "cubemap": "faces"}
_ARRAYS = ("means", "quats", "scales", "opacities", "sh")
_HALVED = ("quats", "opacities", "sh", "waves")
_ROWS = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": ()}
_FLOAT16_END = 65520  # rounds to infinity


@dataclass(frozen=True, eq=False)
class SavedPart:
    """Gaussians, and the coefficients [n, F - 1, 3] of their colour waves where they have some."""

    gaussians: Gaussians
    waves: Tensor | None = None


def part_arrays(scene: Scene, precision: Precision) -> dict[str, np.ndarray]:
    """The arrays of the scene's Gaussians.

    Raises:
        SceneError: they are not float32, or hold numbers beyond float16 where that is asked for.
    """
    arrays = {}
    waves = [None, *(actor.color_waves for actor in scene.actors)]
    for number, gaussians in enumerate(scene.all_gaussians):
        part = _part_name(number)
        tensors = {name: getattr(gaussians, name) for name in _ARRAYS}
        if (colours := waves[number]) is not None:
            tensors["waves"] = colours.coefficients
            if colours.coefficients.shape[1] > MOST_WAVES:
                raise SceneError(
                    f"scene {scene.name!r}: {part} has colour waves of "
                    f"{colours.coefficients.shape[1]} terms; saved scenes hold {MOST_WAVES}"
                )
        for name, tensor in tensors.items():
            where = f"scene {scene.name!r}: {part}.{name}"
            if tensor.dtype != torch.float32:
                raise SceneError(f"{where}: saved scenes hold float32; got {tensor.dtype}")
            is_halved = precision == "float16" and name in _HALVED
            arrays[f"{part}.{name}"] = _array(_half(tensor, where) if is_halved else tensor)
        if gaussians.semantic is not None:
            arrays[f"{part}.semantic"] = _array(gaussians.semantic)
    return arrays


def sky_arrays(scene: Scene, precision: Precision) -> dict[str, np.ndarray]:
    """The one array of the scene's sky, whose class is among SKY_KINDS.

    Raises:
        SceneError: it holds numbers beyond float16 where that is asked for.
    """
    name = _SKY_ARRAYS[SKY_KINDS[type(scene.sky)]]
    values = getattr(scene.sky, name)
    is_halved = precision == "float16"
    return {name: _array(_half(values, f"scene {scene.name!r}: sky") if is_halved else values)}


def take_parts(
    tensors: dict[str, Tensor], document: SceneDocument, where: str
) -> tuple[list[SavedPart], list[str]]:
    """Background and actors, whose arrays are taken out of `tensors`, and what was left out.

    Raises:
        SceneError: arrays are missing, too many, or of other types or shapes than documented.
    """
    counts = [document.background_gaussians, *(actor.gaussians for actor in document.actors)]
    has_waves = [False, *(actor.color_waves is not None for actor in document.actors)]
    parts, problems = [], []
    for number, count in enumerate(counts):
        name = _part_name(number)
        part = _take_part(tensors, name, count, document.precision, has_waves[number], where)
        if not _is_drawable(part):
            part, found = _drawable(part, f"{where}, {name}")
            problems += found
        parts.append(part)
    if tensors:
        raise SceneError(
            f"{where} holds arrays that its document does not know: {sorted(tensors)[:5]}"
        )
    return parts, problems


def take_sky(tensors: dict[str, Tensor], kind: str, precision: Precision, where: str) -> Sky:
    """The sky of its one array.

    Raises:
        SceneError: another array, or another type or shape.
    """
    sky_class = next(cls for cls, name in SKY_KINDS.items() if name == kind)
    name = _SKY_ARRAYS[kind]
    if list(tensors) != [name]:
        raise SceneError(f"{where}: a {kind} sky is one array {name!r}; got {sorted(tensors)[:5]}")
    values = tensors[name]
    shape = tuple(values.shape)
    fits = {
        "rgb": shape == (3,),
        "image": len(shape) == 3 and shape[2] == 3,
        "faces": len(shape) == 4 and shape[0] == 6 and shape[1] == shape[2] and shape[3] == 3,
    }[name]
    is_type = values.dtype == (torch.float16 if precision == "float16" else torch.float32)
    if not fits or not is_type or values.numel() == 0:
        expected = {"rgb": "[3]", "image": "[H, W, 3]", "faces": "[6, R, R, 3]"}[name]
        raise SceneError(
            f"{where}: {name} must be {precision} {expected}; got {values.dtype} {list(shape)}"
        )
    values = values.float()
    if not np.isfinite(_range(values)).all():
        raise SceneError(f"{where}: {name} holds NaN or infinite values")
    return sky_class(values)


def _part_name(number: int) -> str:
    return "background" if number == 0 else f"actors.{number - 1}"


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy())


def _half(tensor: Tensor, where: str) -> Tensor:
    low, high = _range(tensor)
    if not max(-low, high) < _FLOAT16_END:
        raise SceneError(
            f"{where}: float16 holds numbers up to 65504; got {low} to {high}. Write it at full "
            f"precision"
        )
    return tensor.half()


def _take_part(
    tensors: dict[str, Tensor],
    part: str,
    count: int,
    precision: Precision,
    has_waves: bool,
    where: str,
) -> SavedPart:
    names = (*_ARRAYS, "waves") if has_waves else _ARRAYS
    missing = [f"{part}.{name}" for name in names if f"{part}.{name}" not in tensors]
    if missing:
        raise SceneError(f"{where} lacks {', '.join(missing)}")
    own = {name: tensors.pop(f"{part}.{name}") for name in names}
    semantic = tensors.pop(f"{part}.semantic", None)
    for name, tensor in own.items():
        is_halved = precision == "float16" and name in _HALVED
        _check_array(tensor, name, count, is_halved=is_halved, where=f"{where}: {part}.{name}")
        if is_halved:
            own[name] = tensor.float()
    if precision == "float16":
        own["quats"] = torch.nn.functional.normalize(own["quats"], dim=1)
    if semantic is not None:
        _check_semantic(semantic, count, f"{where}: {part}.semantic")
    waves = own.pop("waves", None)
    return SavedPart(Gaussians(**own, semantic=semantic), waves)


def _check_array(tensor: Tensor, name: str, count: int, *, is_halved: bool, where: str) -> None:
    shape = tuple(tensor.shape)
    expected = torch.float16 if is_halved else torch.float32
    if tensor.dtype != expected:
        raise SceneError(f"{where} must be {str(expected)[6:]}; got {tensor.dtype}")
    if not shape or shape[0] != count:
        raise SceneError(
            f"{where} must have {count} rows, as the document says; got {list(shape)}: they "
            f"do not belong together"
        )
    if name in _ROWS and shape[1:] != _ROWS[name]:
        raise SceneError(f"{where} must be {[count, *_ROWS[name]]}; got {list(shape)}")
    is_colour = len(shape) == 3 and shape[2] == 3
    if name == "sh" and not (is_colour and shape[1] in SH_COUNTS):
        raise SceneError(f"{where} must be [N, K, 3] with K in {SH_COUNTS}; got {list(shape)}")
    if name == "waves" and not (is_colour and shape[1] <= MOST_WAVES):
        raise SceneError(
            f"{where} must be [N, terms, 3], at most {MOST_WAVES} terms; got {list(shape)}"
        )


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


def _is_drawable(part: SavedPart) -> bool:
    """Whether `_drawable` would leave every bit as it is, told in one look at each number."""
    waves = part.waves
    has_finite_waves = waves is None or bool(np.isfinite(_range(waves)).all())
    return is_drawable(part.gaussians) and has_finite_waves


def _drawable(part: SavedPart, where: str) -> tuple[SavedPart, tuple[str, ...]]:
    """As check_gaussians; colour waves follow their Gaussians."""
    gaussians, waves = part.gaussians, part.waves
    if waves is None:
        gaussians, problems = check_gaussians(gaussians, where=where)
        return SavedPart(gaussians), problems
    finite = torch.isfinite(waves.sum((1, 2)))
    unknown = torch.where(finite, 0.0, torch.nan)  # makes means that check_gaussians leaves out
    gaussians = replace(gaussians, means=gaussians.means + unknown[:, None])
    kept = drawable_rows(gaussians)
    gaussians, problems = check_gaussians(gaussians, where=where)
    return SavedPart(gaussians, waves[kept]), problems


def _range(values: Tensor) -> tuple[float, float]:
    """Lowest and highest value; NaN where there is one. By NumPy, which wakes no threads."""
    array = values.detach().cpu().numpy()
    if array.size == 0:
        return 0.0, 0.0
    with np.errstate(invalid="ignore"):
        return float(array.min()), float(array.max())
