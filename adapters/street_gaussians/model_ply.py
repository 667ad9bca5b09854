"""The Gaussians of a trained model, read from point_cloud/iteration_N/point_cloud.ply.

One element for each part, vertex_background and vertex_obj_003. It has no sky, no colour correction
and not what training added to poses.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from torch import Tensor

from adapters.street_gaussians.model import TrainedModel
from adapters.street_gaussians.parameters import actor_id
from adapters.street_gaussians.parts import Part, allocate, check_counts, finish_part
from adapters.street_gaussians.records import ModelConfig
from augment.errors import AdapterError, SceneError
from augment.files.ply_io import (
    PlyElement,
    PlyHeader,
    count_surplus_bytes,
    iterate_rows,
    read_ply_header,
)

_PREFIX = "vertex_"
_FIXED = (
    *"xyz", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)),
)  # fmt: skip
_NUMBERED = re.compile(r"(f_dc|f_rest|semantic)_(0|[1-9]\d{0,6})")


def read_point_cloud(path: Path, config: ModelConfig) -> TrainedModel:
    """Read a .ply in pieces.

    Raises:
        AdapterError: not such a file, truncated, or columns missing or wrong in number.
    """
    with _as_adapter_errors():
        header = read_ply_header(path)
        elements = {e.name.removeprefix(_PREFIX): e for e in header.elements if _is_part(e)}
        if "background" not in elements:
            raise AdapterError(_not_a_model(header))
        problems = [_lacks(path, config)]
        others = [e.name for e in header.elements if not _is_part(e)]
        if others:
            problems.append(f"{path} also holds {', '.join(others[:8])}, which is not used")
        parts: dict[str, Part] = {}
        for name, element in elements.items():
            part, found = _read_part(header, element, name)
            problems += found
            if part is not None:
                parts[name] = part
    surplus = count_surplus_bytes(header)
    if surplus:
        problems.append(f"{path}: {surplus} bytes follow its rows and were ignored")
    background = parts.pop("background")
    actors = {int(name.removeprefix("obj_")): part for name, part in parts.items()}
    return TrainedModel(path, background, actors, problems=problems)


@contextlib.contextmanager
def _as_adapter_errors() -> Iterator[None]:
    try:
        yield
    except AdapterError:
        raise
    except SceneError as error:
        raise AdapterError(str(error)) from None


def _is_part(element: PlyElement) -> bool:
    name = element.name.removeprefix(_PREFIX)
    return element.name.startswith(_PREFIX) and (name == "background" or actor_id(name) is not None)


def _not_a_model(header: PlyHeader) -> str:
    found = [element.name for element in header.elements]
    hint = ""
    if "vertex" in found:
        hint = f". A .ply with one element 'vertex' opens as gaussians:{header.path}"
    return (
        f"{header.path} is no Street Gaussians model: expected an element vertex_background and "
        f"one such as vertex_obj_003 for each actor; found {', '.join(found[:12]) or 'none'}{hint}"
    )


def _lacks(path: Path, config: ModelConfig) -> str:
    lost = {
        "the actors' learnt poses": config.opt_track,
        "the sky": config.include_sky,
        "the colour correction": config.use_color_correction,
        "the pose correction": config.use_pose_correction,
    }
    names = [name for name, was_trained in lost.items() if was_trained]
    text = f"{path}: a .ply holds Gaussians only"
    if not names:
        return text
    return f"{text}; left out: {', '.join(names)}. They are in trained_model/iteration_N.pth"


def _read_part(header: PlyHeader, element: PlyElement, name: str) -> tuple[Part | None, list[str]]:
    """A part, None for an actor without usable Gaussians, and sentences."""
    where, is_background = f"{header.path}, {element.name}", name == "background"
    colours, rest, semantic = _count_columns(element, where)
    check_counts(where, rest, colours, is_background=is_background)
    problems = [f"{where}: its semantic features are not used"] if semantic else []
    if element.count == 0 and not is_background:
        return None, [*problems, f"{where}: it has no Gaussians and is left out"]
    arrays: dict[str, Tensor] = {}
    terms: Tensor | None = None
    done = 0
    for rows in iterate_rows(header, element.name):
        if not arrays:  # only now is the file known to be as long as its header says
            arrays, terms = allocate(element.count, 1 + rest, colours)
        _scatter(rows, arrays, terms, slice(done, done + len(rows)))
        done += len(rows)
    if not arrays:
        arrays, terms = allocate(0, 1 + rest, colours)
    try:
        part, found = finish_part(arrays, terms, where)
    except AdapterError as error:
        if is_background:
            raise
        return None, [*problems, f"{error} It is left out"]
    return part, [*problems, *found]


def _count_columns(element: PlyElement, where: str) -> tuple[int, int, int]:
    """Colour terms F, coefficients above the constant one, and semantic columns."""
    missing = [name for name in _FIXED if name not in element.names]
    numbers: dict[str, list[int]] = {"f_dc": [], "f_rest": [], "semantic": []}
    for name in element.names:
        if match := _NUMBERED.fullmatch(name):
            numbers[match[1]].append(int(match[2]))
    if missing or not numbers["f_dc"]:
        raise AdapterError(
            f"{where}: not the Gaussians of a model: {', '.join([*missing[:8], *_no_dc(numbers)])} "
            f"missing; it has {', '.join(element.names[:12]) or 'no properties'}"
        )
    for name in ("f_dc", "f_rest"):
        found = numbers[name]
        if len(found) % 3 or sorted(found) != list(range(len(found))):
            raise AdapterError(
                f"{where}: {name}_0, {name}_1, … must be a multiple of 3 in number (a channel's "
                f"values after the other's) and without gaps; got {len(found)}"
            )
    return len(numbers["f_dc"]) // 3, len(numbers["f_rest"]) // 3, len(numbers["semantic"])


def _no_dc(numbers: dict[str, list[int]]) -> list[str]:
    return [] if numbers["f_dc"] else ["f_dc_0"]


def _scatter(
    rows: np.ndarray, arrays: dict[str, Tensor], terms: Tensor | None, where: slice
) -> None:
    """Copy the columns of some rows to their places; no activation yet."""
    values = {name: array.numpy()[where] for name, array in arrays.items()}
    rest = values["sh"].shape[1] - 1
    count = 1 if terms is None else 1 + terms.shape[1]
    with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 become infinite
        for axis, name in enumerate("xyz"):
            values["means"][:, axis] = rows[name]
            values["scales"][:, axis] = rows[f"scale_{axis}"]
        for axis in range(4):
            values["quats"][:, axis] = rows[f"rot_{axis}"]
        values["opacities"][:] = rows["opacity"]
        for channel in range(3):
            values["sh"][:, 0, channel] = rows[f"f_dc_{channel * count}"]
            for term in range(1, count):
                assert terms is not None
                terms.numpy()[where][:, term - 1, channel] = rows[f"f_dc_{channel * count + term}"]
            for band in range(rest):
                values["sh"][:, 1 + band, channel] = rows[f"f_rest_{channel * rest + band}"]
