"""The record that describes a splat format, the content of a splat file, and shared helpers.

Each format has its record in its own file. `augment.files.formats` lists them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from augment.scene.scene import Gaussians, Scene, check_gaussians
from augment.scene.transform import transform_gaussians_rigidly

# Distance from zero, metres, from which coordinates are recentred: float32 resolves 0.06 mm at
# 1 km, and 0.25 m at UTM's 4000 km.
RECENTRE_BEYOND_M = 1000.0
# The other three components of a rotation, in order, by the place of the largest one.
OTHER_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
_MAX_COORDINATE_M = 1e15  # beyond, float64 has no decimetres


@dataclass(frozen=True, eq=False)
class SplatFile:
    """The content of a splat file."""

    gaussians: Gaussians  # in the file's axes and unit
    # float64 [3]: subtracted from the file's coordinates; zero except for double-precision .ply
    # files far from the origin.
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    # The `key: value` comments of a .ply, and the same facts of other formats.
    notes: Mapping[str, str] = field(default_factory=dict)
    problems: tuple[str, ...] = ()  # one sentence about each thing that was left out


class FileFacts(NamedTuple):
    """Facts of a splat file's header, as `climategs inspect` prints them; empty where not known."""

    version: str = ""  # of the format, with its kind of packing
    writer: str = ""  # the program that wrote the file
    up: str = ""  # the axis that the file says points up
    unit: str = ""  # the unit that the file states
    warnings: tuple[str, ...] = ()  # things that other viewers show wrongly, one sentence each


ANTIALIASED_WARNING = (
    "trained for an antialiasing renderer (Mip-Splatting): viewers without its filter show far and "
    "thin splats too thick and too opaque"
)
_WRITER = re.compile(r"(?:generated|created|written|made|exported) (?:by|with) (.+)", re.IGNORECASE)


def writer_in(comments: Iterable[str]) -> str:
    """Return the program that a comment names; empty if none does."""
    matches = (_WRITER.search(comment) for comment in comments)
    names = [match[1].strip() for match in matches if match is not None]
    return names[0][:80] if names else ""


class Loss(NamedTuple):
    """A thing of a scene that a format cannot keep."""

    sentence: str  # for people
    applies_to: Callable[[Scene], bool] = lambda scene: True  # True for a scene that has the thing


@dataclass(frozen=True)
class SplatWriter:
    """The export of scenes to one format."""

    kind: str  # the format's name in `climategs export --kind`
    suffix: str  # the end of the written files' names
    # Writes Gaussians of a z-up scene, atomically. The mapping holds the facts that are known:
    # `up`, `unit` and `world_origin_m`, as in SplatFile.notes.
    write: Callable[[Path, Gaussians, Mapping[str, str]], None]
    world_losses: tuple[Loss, ...] = ()  # losses of axes, unit and cameras
    value_losses: tuple[Loss, ...] = ()  # losses of numbers and colours
    keeps_world_origin: bool = False  # True if `world_origin_m` is written
    keeps_classes: bool = False  # True if semantic classes are written
    has_camera_file: bool = False  # True if viewers look for a cameras.json beside the file


@dataclass(frozen=True)
class SplatFormat:
    """A format of splat files.

    A file has the format if it begins with one of `first_bytes`, or is named as one of
    `file_names`. If the format has no `first_bytes`, its suffixes tell. Formats that share their
    first bytes are told apart by `fits_content`.
    """

    name: str  # for messages, such as ".spz"
    reader: Callable[..., SplatFile]  # takes the path, and the option by its name
    suffixes: tuple[str, ...] = ()  # lower case; files with them are splat files of a folder
    first_bytes: tuple[bytes, ...] = ()
    file_names: tuple[str, ...] = ()
    # Returns True if a file with these first bytes has this format.
    fits_content: Callable[[Path], bool] = lambda path: True
    # Returns facts of a file's header.
    describe: Callable[[Path], FileFacts] = lambda path: FileFacts()
    viewer_up: str = (
        ""  # the axis that viewers of the format take for up; empty if the file says it
    )
    option: str = ""  # the one option of `read_splats` that the reader takes
    writer: SplatWriter | None = None

    def fits_name(self, path: Path) -> bool:
        """Return True if the name alone tells that the file has this format."""
        has_suffix = not self.first_bytes and path.suffix.lower() in self.suffixes
        return has_suffix or path.name in self.file_names


def has_directional_colors(scene: Scene) -> bool:
    """Return True if colours depend on the direction of view."""
    return any(part.sh_degree > 0 for part in scene.all_gaussians)


def rotate_z_to_y(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians with z up as Gaussians with y up."""
    z_to_y = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
    return transform_gaussians_rigidly(gaussians, z_to_y, torch.zeros(3, dtype=torch.float64))


def insert_omitted_component(
    values: Sequence[np.ndarray], omitted_index: np.ndarray, omitted_value: np.ndarray
) -> list[np.ndarray]:
    """Return the four components, [N] each, of rotations that are stored without the largest one.

    Args:
        values: the three stored components in order, [N] each.
        omitted_index: the place of the omitted component among the four, 0 to 3, [N].
        omitted_value: the omitted component, [N].
    """
    components = []
    for component in range(4):
        lower = values[max(component - 1, 0)]
        same = values[min(component, 2)]
        other = np.where(omitted_index > component, same, lower)
        components.append(np.where(omitted_index == component, omitted_value, other))
    return components


def recentring_origin(points: Float[np.ndarray, "N 3"]) -> np.ndarray:
    """Return the whole-metre origin to subtract from coordinates, float64 [3].

    It is the median of the points within _MAX_COORDINATE_M if that lies more than RECENTRE_BEYOND_M
    from zero; else zero.
    """
    usable_points = points[(np.abs(points) < _MAX_COORDINATE_M).all(1)]  # False for NaN, too
    if len(usable_points) == 0:
        return np.zeros(3)
    median = np.median(usable_points, axis=0).astype(np.float64)
    return np.round(median) if np.linalg.norm(median) > RECENTRE_BEYOND_M else np.zeros(3)


def join_positioned_parts(
    parts: Sequence[tuple[np.ndarray, Gaussians]],
    path: Path,
    notes: Mapping[str, str],
    problems: Sequence[str],
) -> SplatFile:
    """Join the parts of a file into one set of Gaussians.

    Args:
        parts: for each part the positions of its Gaussians in the file's axes, float64 [N, 3], and
            its Gaussians, whose own means are ignored.
        path: the file, for messages.
        notes: the notes of the result.
        problems: the problems found so far.

    Raises:
        SceneError: no Gaussian can be rendered.
    """
    means = np.concatenate([places for places, _ in parts])
    origin = recentring_origin(means)
    bands = max(part.sh.shape[1] for _, part in parts)
    sh = [torch.nn.functional.pad(p.sh, (0, 0, 0, bands - p.sh.shape[1])) for _, p in parts]
    with np.errstate(over="ignore"):  # infinite values are left out later, and reported
        means_f32 = (means - origin).astype(np.float32)
    all_gaussians = Gaussians(
        means=torch.from_numpy(means_f32),
        quats=torch.cat([part.quats for _, part in parts]),
        scales=torch.cat([part.scales for _, part in parts]),
        opacities=torch.cat([part.opacities for _, part in parts]),
        sh=torch.cat(sh),
    )
    gaussians, new_problems = check_gaussians(all_gaussians, where=str(path))
    return SplatFile(gaussians, origin, notes, (*problems, *new_problems))
