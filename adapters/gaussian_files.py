"""Scenes of plain splat files, such as a .ply, alone or in a trained 3DGS model's folder.

    gaussians:PATH?up=-y&scale=1&cameras=FILE
    gaussians:FOLDER?files=a.ply,b.ply

Several files of a folder are parts of one scene: those that `files` lists, else all of them, which
must then be of one kind. A folder with a lod-meta.json is one streamed scene; `lod` selects its
level of detail.

Cameras are looked for beside the file (cameras.json, transforms.json, a COLMAP model in sparse/0)
and above it in a model's folder. `adapters.camera_files.paths` groups images into frames, and makes
a path if there are none. Coordinates and cameras of the file are turned so that `up` points to +z,
scaled to metres, and recentred if they lie beyond a kilometre from zero. If neither the URI nor the
file gives up or scale, they are estimated. A file whose ground is not clear gets no path.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import BeforeValidator, Field, field_validator
from scipy.spatial import KDTree
from torch import Tensor

from adapters.camera_files.camera_files import PosedView, ViewSet, find_camera_file, read_views
from adapters.camera_files.paths import (
    BULK_REACH,
    NO_CAMERAS,
    PathKind,
    frames_from_views,
    ground_under,
    is_in_bulk,
    lowest_ground,
    make_default_path,
    road_heights,
    solid_points,
)
from adapters.recorded_lenses import (
    LENS_MEANING,
    RECORDED_LENS,
    UNDISTORTED_LENS,
    LensChoice,
    split_lenses,
)
from adapters.uri import UriOptions, format_uri
from adapters.world import WorldChange, nearest_axis, parse_up, rotation_to_z_up
from augment.errors import AdapterError
from augment.files.formats import read_splats, splat_names, splat_suffixes
from augment.files.sog import META, is_sog_folder
from augment.files.splat_format import SplatFile, recentring_origin
from augment.files.streamed_sog import LOD_META
from augment.rng import rng_for
from augment.scene.cameras import Frame
from augment.scene.scene import Gaussians, Scene
from augment.scene.sky import ConstantSky
from augment.scene.transform import concatenate_gaussians

Part = Annotated[float, Field(ge=0, le=1)]
COLOURS = {"overcast": (0.85, 0.85, 0.85), "black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def _colour(text: str) -> Sequence[object]:
    return COLOURS.get(text) or text.split(",")


def _names(text: str) -> Sequence[str]:
    names = tuple(text.split(","))
    if "" in names or len(set(names)) < len(names):
        raise ValueError("an empty name, or one twice")
    return names


class GaussianOptions(UriOptions):
    """Options of a splat file in its URI."""

    up: str | None = Field(
        None,
        description="the file's axis that points up (+x … -z), a vector 0,-1,0.1, or 'cameras': "
        "their mean; estimated without it",
    )
    scale: float | None = Field(
        None,
        ge=1e-6,  # beyond, float32 runs out for real scenes
        le=1e6,
        description="metres per unit of the file, a number from 1e-6 to 1e6; 1 says that it is in "
        "metres; estimated without it",
    )
    cameras: str | None = Field(
        None, description="a camera file or COLMAP folder in the file's world, or 'none'"
    )
    path: PathKind = Field("auto", description="auto, drive or orbit, where there are no cameras")
    iteration: int | None = Field(
        None,
        ge=0,
        lt=10**9,
        description="the number N of a trained model's iteration_N; the newest by default",
    )
    files: Annotated[tuple[str, ...], BeforeValidator(_names)] | None = Field(
        None,
        description="the names of the folder's splat files that make up the scene, with commas, "
        "such as a.ply,b.ply; all of the folder by default, where they are of one kind",
    )
    lod: int | None = Field(
        None,
        ge=0,
        lt=10**9,
        description="the level of detail of a lod-meta.json: 0, the default, is the finest",
    )
    activated: bool | None = Field(
        None,
        description="of a .ply: true if it stores opacities from 0 to 1 and scales as lengths, "
        "false if it stores logits and logarithms, as trainers do; told by the values, or asked",
    )
    lens: LensChoice = Field(UNDISTORTED_LENS, description=LENS_MEANING)
    sky: Annotated[tuple[Part, Part, Part], BeforeValidator(_colour)] | None = Field(
        None,
        description="the colour behind the Gaussians: overcast (a light grey), black, white, or "
        "three numbers 0 to 1 such as 0.7,0.8,0.9",
    )

    @field_validator("up")
    @classmethod
    def _is_axis(cls, up: str) -> str:
        if up != "cameras":
            parse_up(up)  # a mistake here must not wait for a large file to load
        return up


# ---- Which way is up in a splat file and how long its unit is, where nothing in it says so -------
# The ground is the widest flat surface that has everything else on one side, and no parallel one of
# its size there: a floor under a ceiling and the facades of a canyon look like each other, and are
# refused. Surface is counted in voxels, so that it matters neither how densely splats lie nor how
# large they are; distances are parts of the scene's own size, so that the unit does not matter. The
# unit is the height of cameras above the ground, where they were driven or carried; without cameras
# there is only the question whether the scene can be a street in metres.

CAMERAS_ABOVE_GROUND_M = 1.6
_METRIC_HEIGHTS_M = (1.0, 2.6)  # cameras this high are on a car or a head, and the unit is a metre
_HEIGHTS_SPREAD = 0.5  # interquartile range over median, of cameras that were driven or carried
_STEEPEST_LOOK_DEG = 30.0  # drones look down
_WIDE_M = (10.0, 2000.0)  # least and largest diagonal of a street in plan
_TALL_M = (2.0, 150.0)  # least and largest height of a street
_SPLAT_M = (0.003, 0.6)  # least and largest median of a street's splats' longest scales

_VOXELS = 5000  # occupied voxels that are wanted
_FINER_STEPS = 16  # times that voxels may shrink to become so many
_NEIGHBOURS = 12  # of a voxel, that its surface is fitted to
_FLAT = 0.5  # thickness of that surface over its width, at most
_TRIES = 400
_SAME_WAY = math.cos(math.radians(25.0))  # of surface and plane
_OTHER_WAY = math.cos(math.radians(30.0))  # of planes that would make another up
_MUCH_BELOW = 0.05  # of the surface under a plane: it is not the ground
_COUNTERPART = 1.25  # above 1: of two facades that face each other one has more gaps
_MIN_SHARE = 0.05  # least lead of a clear ground's share over that of any plane above it
_MIN_LEAD = 4.0  # least ratio of its score to that of the best plane of another direction
_SNAP_DEG = 3.0  # a road's slope; a world that is turned at random rarely comes this close
_MIN_POINTS = 100


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """Ground plane of a splat file.

    Attributes:
        up: float64 [3], unit vector in the file's world.
        share: fraction of the scene's surface in the plane.
        below: fraction under it.
        above: fraction in the fullest parallel plane over it.
        lead: ratio of its score to that of the best plane in another direction.
    """

    up: np.ndarray
    share: float
    below: float
    above: float
    lead: float

    @property
    def is_clear(self) -> bool:
        return self.share - self.above >= _MIN_SHARE and self.lead >= _MIN_LEAD

    @property
    def sentence(self) -> str:
        is_axis = np.abs(self.up).max() == 1
        name = nearest_axis(self.up) if is_axis else ",".join(f"{value:.4g}" for value in self.up)
        return (
            f"{name}: {self.share:.0%} of the surface lies in one plane, {self.below:.1%} under it "
            f"and {self.above:.0%} in a parallel one above it; that is {min(self.lead, 99):.1f} "
            "times as clear as in any other direction"
        )


def find_ground(gaussians: Gaussians, *, near: np.ndarray | None = None) -> GroundPlane | None:
    """Return the plane that is most like a ground. None if nothing is flat.

    Args:
        gaussians: the scene.
        near: unit vector within 45 degrees of which up must be, such as the mean of the cameras'.
    """
    points = solid_points(gaussians)
    points = points[is_in_bulk(points, 3.0)]
    if len(points) < _MIN_POINTS:
        return None
    surface = _Surface.of(points - points.mean(axis=0))
    if surface is None:
        return None
    flat = np.flatnonzero(surface.is_flat)
    rng = rng_for(seed=0, scene="", effect="adapters.gaussian_files")
    samples = rng.permutation(flat)[:_TRIES]
    ups = np.concatenate([surface.normals[samples], -surface.normals[samples]])
    places = np.tile(surface.places[samples], (2, 1))
    if near is not None:
        is_near = ups @ near > math.cos(math.radians(45.0))
        ups = ups[is_near]
        places = places[is_near]
    if len(ups) == 0:
        return None
    scores = np.array([surface.score(up, at) for up, at in zip(ups, places, strict=True)])
    best = int(scores.argmax())
    other_scores = scores[ups @ ups[best] < _OTHER_WAY]
    rival = max(float(other_scores.max(initial=0.0)), 1e-6)
    up, at = surface.refine_plane(ups[best], places[best])
    return GroundPlane(_snap_to_axis(up), *surface.judge(up, at), float(scores[best]) / rival)


def scale_from_cameras(points: np.ndarray, poses: np.ndarray) -> tuple[float, str] | None:
    """Estimate metres per unit from the height of level cameras above the ground, and describe
    it.

    The result is None if the cameras do not stand as on a car or in a hand.

    Args:
        points: float64 [N, 3], in a world whose +z is up.
        poses: world_from_camera, float64 [C, 4, 4].
    """
    eyes = poses[:, :3, 3]
    looks = poses[:, 2, 2]
    if np.median(np.abs(looks)) > math.sin(math.radians(_STEEPEST_LOOK_DEG)):
        return None
    radius = 0.25 * float(np.linalg.norm(np.ptp(eyes[:, :2], axis=0)))
    low, over = ground_under(points, eyes, radius=radius)
    if len(low):  # once more from nearby: a wide circle reaches into ditches and up slopes
        low, over = ground_under(points, eyes, radius=3 * float(np.median(over[:, 2] - low)))
    if len(low) == 0:
        return None
    height = float(np.median(over[:, 2] - low))
    unit = height / CAMERAS_ABOVE_GROUND_M
    heights = over[:, 2] - road_heights(points, np.ones(len(points)), over, low, unit=unit)
    least, height, most = np.nanquantile(heights, [0.25, 0.5, 0.75])
    if not most - least <= _HEIGHTS_SPREAD * height:
        return None
    if _METRIC_HEIGHTS_M[0] <= height <= _METRIC_HEIGHTS_M[1]:
        return 1.0, f"the cameras stand {height:.2f} units above the ground"
    scale = CAMERAS_ABOVE_GROUND_M / height
    return scale, (
        f"the cameras stand {height:.3g} units above the ground, which is taken as "
        f"{CAMERAS_ABOVE_GROUND_M} m, give or take a quarter"
    )


def doubt_about_metres(points: np.ndarray, scales: Tensor) -> str | None:
    """Return why points and scales cannot be those of a street in metres. None if they may be.

    Args:
        points: float64 [N, 3], solid points, +z up.
        scales: scales of all Gaussians.
    """
    points = points[is_in_bulk(points, BULK_REACH)]
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    measures = {
        "wide": (float(np.hypot(*(high - low)[:2])), _WIDE_M),
        "tall": (float(np.quantile(points[:, 2], 0.98) - low[2]), _TALL_M),
        "a splat": (float(scales.amax(1).median()), _SPLAT_M),
    }
    if all(least <= value <= most for value, (least, most) in measures.values()):
        return None
    return "in metres it would be no street: " + ", ".join(
        f"{value:.3g} {measure_name} ({least:g} to {most:g} expected)"
        for measure_name, (value, (least, most)) in measures.items()
    )


@dataclass(frozen=True, eq=False)
class _Surface:
    """A scene's surface as voxels.

    Attributes:
        places: float64 [V, 3].
        normals: float64 [V, 3], of either sign.
        size: edge of a voxel.
    """

    places: np.ndarray
    normals: np.ndarray
    is_flat: np.ndarray
    size: float

    @staticmethod
    def of(points: np.ndarray) -> _Surface | None:
        """Return the surface of points, or None if they are in too few places to have one."""
        size = float(np.linalg.norm(points, axis=1).max()) / 8 + 1e-9
        places = _voxel_means(points, size)
        for _ in range(_FINER_STEPS):
            if len(places) >= min(_VOXELS, len(points) / 4):
                break
            size /= 1.2
            places = _voxel_means(points, size)
        # A surface on the border of two layers of voxels would count twice: it lies amid one of
        # those that are half a voxel further.
        places = _voxel_means(places + size / 2, size) - size / 2
        if len(places) < _NEIGHBOURS:
            return None
        _, near = KDTree(places).query(places, _NEIGHBOURS)
        offsets = places[near] - places[near].mean(axis=1, keepdims=True)
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
        thickness = np.sqrt(np.maximum(spread[:, 0], 0) / np.maximum(spread[:, 1], 1e-30))
        return _Surface(places, axes[:, :, 0], thickness < _FLAT, size)

    def judge(self, up: np.ndarray, at: np.ndarray) -> tuple[float, float, float]:
        """Return the fractions of the surface in the plane, under it, and in the fullest
        parallel one above.
        """
        height = (self.places - at) @ up
        parallel = self.is_flat & (np.abs(self.normals @ up) > _SAME_WAY)
        share = float((parallel & (np.abs(height) < 0.75 * self.size)).mean())
        below = float((height < -1.5 * self.size).mean())
        higher = height[parallel & (height > 2.25 * self.size)]
        floors = np.bincount((higher / (0.75 * self.size)).astype(int), minlength=2)
        return share, below, float((floors[:-1] + floors[1:]).max()) / len(height)

    def score(self, up: np.ndarray, at: np.ndarray) -> float:
        share, below, above = self.judge(up, at)
        return (share - _COUNTERPART * above) * math.exp(-below / _MUCH_BELOW)

    def refine_plane(self, up: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the plane through the nearby surface, by least squares in ever closer
        surroundings.
        """
        for reach in (1.0, 0.7, 0.5, 0.4):
            near = self.is_flat & (np.abs(self.normals @ up) > _SAME_WAY)
            near &= np.abs((self.places - at) @ up) < reach * self.size
            if near.sum() < _NEIGHBOURS:
                break
            at = self.places[near].mean(axis=0)
            offsets = self.places[near] - at
            normal = np.linalg.eigh(offsets.T @ offsets)[1][:, 0]
            up = normal if normal @ up > 0 else -normal
        return up, at


def _voxel_means(points: np.ndarray, size: float) -> np.ndarray:
    """Return the mean of the points in every voxel.

    Voxels with far fewer points than a point's voxel usually has are left out: stray points fill
    many voxels.
    """
    index = np.floor(points / size).astype(np.int64)
    index -= index.min(axis=0)
    _, y, z = index.max(axis=0) + 1
    _, voxel, count = np.unique(
        (index[:, 0] * y + index[:, 1]) * z + index[:, 2], return_inverse=True, return_counts=True
    )
    sums = np.stack([np.bincount(voxel, points[:, axis]) for axis in range(3)], axis=1)
    return (sums / count[:, None])[count >= 0.05 * np.median(count[voxel])]


def _snap_to_axis(up: np.ndarray) -> np.ndarray:
    axis = np.zeros(3)
    index = int(np.abs(up).argmax())
    axis[index] = math.copysign(1.0, up[index])
    return axis if up @ axis > math.cos(math.radians(_SNAP_DEG)) else up


# ---- The scene -----------------------------------------------------------------------------------

_UP_TOLERANCE_DEG = 30.0
_LEVEL_TOLERANCE_DEG = 15.0  # cameras on a car lean less; this vouches for an axis, not for degrees
_NAMED_FILES = 8  # of one scene, that a sentence names
_ITERATION = re.compile(r"iteration_(\d+)")
_SAMPLED_VIEWS = 16  # most cameras that are checked
_SAMPLED_POINTS = 20_000  # most points that each of them is checked with
_MIN_SEEN = 0.001  # least part of the points that the median camera must see


def open_gaussians(path: str | Path, query: dict[str, str]) -> Scene:
    """Open a scene of a splat file or of a trained model's folder.

    has_metric_scale and has_known_gravity are True if URI or file give scale and up, if the cameras
    are upright, and if they could be estimated, which the scene's problems say.

    Raises:
        AdapterError: a query key or value, or a camera file, cannot be used.
        SceneError: the splat file is missing, damaged, or something else.
    """
    options = GaussianOptions.from_query("gaussians", query)
    files = find_splat_files(Path(path), options)
    file = files[0]
    splats = _read_parts(files, options)
    problems = list(splats.problems)
    view_set = _find_views(file, Path(path), options)
    views = view_set.views if view_set else ()
    problems += view_set.problems if view_set else ()
    world = _find_world(file, splats, views, options)
    change = world.change
    gaussians = change.gaussians(splats.gaussians, splats.origin)
    frames, ground_z_m, about_frames = _frames_and_ground(gaussians, views, world, options)
    name = _scene_name(files, Path(path))
    seen_frames = None if views else ()
    if options.lens == RECORDED_LENS:
        cameras = "cameras of the scene's file" if views else "cameras of a made-up path"
        lens_frames = split_lenses(name, frames, options.lens, published=cameras)
        problems += lens_frames.notes
        if lens_frames.recorded_frames is not None:
            seen_frames = lens_frames.frames
    return Scene(
        name=name,
        source=format_uri("gaussians", path, query),
        background=gaussians,
        actors=(),
        sky=ConstantSky(torch.tensor(options.sky or _stand_in_sky(Path(path)))),
        frames=frames,
        world_origin_m=change.origin_m,
        ground_z_m=ground_z_m,
        has_metric_scale=world.is_metric,
        has_known_gravity=world.knows_up,
        seen_frames=seen_frames,
        problems=(*problems, *world.problems, *about_frames),
    )


def find_splat_files(path: Path, options: GaussianOptions) -> tuple[Path, ...]:
    """Return the splat files of a path.

    For a file it is the file itself. For a folder it is one of: the files that `files` lists, the
    newest (or given) iteration of a model, the lod-meta.json, or all its splat files, which must be
    of one kind.
    """
    if options.files is not None:
        return _listed_files(path, options.files)
    if not path.is_dir():
        return (path,)
    iterations = {}
    for file in path.glob("point_cloud/iteration_*/point_cloud.ply"):
        if match := _ITERATION.fullmatch(file.parent.name):
            iterations[int(match[1])] = file
    if iterations:
        number = max(iterations) if options.iteration is None else options.iteration
        if number not in iterations:
            raise AdapterError(f"{path}: no iteration {number}; it has {sorted(iterations)}")
        return (iterations[number],)
    if (path / LOD_META).is_file():
        return (path / LOD_META,)
    files = splat_files_of(path)
    if not files and is_sog_folder(path):
        return (path / META,)
    kinds = {file.suffix.lower() for file in files}
    if not files:
        raise AdapterError(
            f"{path}: expected point_cloud/iteration_N/point_cloud.ply, a {LOD_META}, "
            f"{splat_names()} files, or meta.json and images of SOG, in this folder; found none. "
            f"Give the file itself"
        )
    if len(kinds) > 1:
        names = [file.name for file in files[:8]]
        raise AdapterError(
            f"{path}: it holds splat files of several kinds, which may be one scene twice: found "
            f"{names}{' and more' if len(files) > 8 else ''}. Give one of them, or list those that "
            f"are parts of one scene: ?files={','.join(names[:2])}"
        )
    return files


def splat_files_of(folder: Path) -> tuple[Path, ...]:
    """Return the folder's splat files by their suffixes, in the order of their names."""
    return tuple(
        sorted(file for file in folder.iterdir() if file.suffix.lower() in splat_suffixes())
    )


def _listed_files(folder: Path, names: Sequence[str]) -> tuple[Path, ...]:
    if not folder.is_dir():
        raise AdapterError(f"{folder}: files lists names in a folder; this is a file")
    for name in names:
        if "/" in name or name in (".", "..") or not (folder / name).is_file():
            file_names = ", ".join(file.name for file in splat_files_of(folder)[:8]) or "none"
            raise AdapterError(
                f"{folder}: files names {name!r:.100}, which is no file of this folder; its splat "
                f"files: {file_names}"
            )
    return tuple(folder / name for name in names)


def _read_parts(files: Sequence[Path], options: GaussianOptions) -> SplatFile:
    """Read the Gaussians of all files as one, with a sentence that names the files.

    Raises:
        AdapterError: they give different up or units.
        SceneError: a file is damaged.
    """
    parts = [read_splats(f, activated=options.activated, level=options.lod) for f in files]
    if len(parts) == 1:
        return parts[0]
    notes = parts[0].notes
    for key, option in (("up", options.up), ("unit", options.scale)):
        said = {part.notes.get(key) for part in parts}
        if len(said) > 1 and (option is None or len(said - {None}) > 1):
            statements = ", ".join(
                f"{file.name} says {part.notes.get(key) or 'nothing'}"
                for file, part in zip(files[:8], parts, strict=False)
            )
            raise AdapterError(
                f"{files[0].parent}: its splat files differ in {key!r}: {statements}. "
                f"Parts of one scene must have the same axes and unit: export them alike, or open "
                f"them one by one"
            )
    origin = next((part.origin for part in parts if part.origin.any()), parts[0].origin)
    moved = []
    for part in parts:
        gaussians = part.gaussians
        if (part.origin != origin).any():
            means = gaussians.means.double() + torch.from_numpy(part.origin - origin)
            gaussians = dataclasses.replace(gaussians, means=means.float())
        moved.append(gaussians)
    names = ", ".join(
        f"{file.name} ({len(part.gaussians)})"
        for file, part in zip(files[:_NAMED_FILES], parts, strict=False)
    )
    more = f" and {len(files) - _NAMED_FILES} more" if len(files) > _NAMED_FILES else ""
    sentence = (
        f"{files[0].parent}: {len(files)} files are taken as parts of one scene: {names}{more}; "
        "files=NAME,NAME takes others"
    )
    if len({part.sh_degree for part in moved}) > 1:
        sentence += ". Colours by direction of a lower degree are filled up with zeros"
    problems = (sentence, *(problem for part in parts for problem in part.problems))
    return SplatFile(concatenate_gaussians(moved), origin, notes, problems)


def _stand_in_sky(path: Path) -> tuple[float, float, float]:
    """Return an overcast sky, whose light tints nothing, or a white one.

    The sky is white if the model's cfg_args say that it was trained in front of white. (A model
    that was trained in front of black would stand in a black night.)
    """
    arguments = path / "cfg_args"
    if arguments.is_file() and "white_background=True" in arguments.read_text(errors="replace"):
        return COLOURS["white"]
    return COLOURS["overcast"]


def _find_views(file: Path, path: Path, options: GaussianOptions) -> ViewSet | None:
    if options.cameras == "none":
        return None
    if options.cameras is not None:
        return read_views(Path(options.cameras), has_lenses=options.lens == RECORDED_LENS)
    folders = [file.parent]
    if _ITERATION.fullmatch(file.parent.name) and file.parent.parent.name == "point_cloud":
        folders.append(file.parent.parent.parent)
    if path.is_dir():
        folders.append(path)
    for folder in folders:
        if camera_file := find_camera_file(folder):
            try:
                return read_views(camera_file, has_lenses=options.lens == RECORDED_LENS)
            except AdapterError as error:
                raise AdapterError(
                    f"{error}. (Found beside {file}; give cameras=FILE for others or cameras=none "
                    "to do without)"
                ) from error
    return None


@dataclass(frozen=True, eq=False)
class _World:
    """World of a splat file's scene.

    Attributes:
        change: from the file's world to the scene's.
        problems: sentences on what is estimated or in doubt.
        unknown_facts: words for what of up and scale is not known; empty if both are.
    """

    change: WorldChange
    knows_up: bool
    is_metric: bool
    problems: tuple[str, ...]
    unknown_facts: str


def _find_world(
    file: Path, splats: SplatFile, views: tuple[PosedView, ...], options: GaussianOptions
) -> _World:
    up, knows_up, about_up = _find_up(splats, views, options)
    turned = WorldChange(rotation_to_z_up(up))
    scale = 1.0
    is_metric = False
    about_scale = "to estimate it, up has to be known"
    if knows_up or options.scale is not None:
        scale, is_metric, about_scale = _find_scale(splats, views, options, turned)
    if not is_metric:
        about_scale = (
            "the file does not say how long a unit is; one unit is taken as one metre. "
            f"Give scale=METRES_PER_UNIT (scale=1 if it is in metres); {about_scale}"
        )
    facts = ((knows_up, "which way is up"), (is_metric, "how long a unit is"))
    unknown_facts = " and ".join(fact_name for is_known, fact_name in facts if not is_known)
    problems = [f"{file}: {sentence}" for sentence in (about_scale, about_up) if sentence]
    means = splats.gaussians.means
    sample = means[:: 1 + len(means) // 100_000].double().numpy() + splats.origin
    origin = recentring_origin(scale * turned.points(sample))
    if origin.any() and not splats.origin.any():
        step = np.spacing(np.float32(np.abs(sample).max())) * scale
        problems.append(
            f"coordinates lie {np.linalg.norm(origin) / 1000:.0f} km from zero and the file stores "
            f"them in steps of up to {step:.2g} m; they are recentred, but what rounding took "
            "before is lost"
        )
    change = WorldChange(turned.rotation, scale, origin)
    return _World(change, knows_up, is_metric, tuple(problems), unknown_facts)


def _find_up(
    splats: SplatFile, views: tuple[PosedView, ...], options: GaussianOptions
) -> tuple[np.ndarray, bool, str]:
    """Return up in the file's world, whether it is known, and sentences about it."""
    cameras_up = None
    if views:  # the mean direction of the images' top edges; cameras may point everywhere
        mean = np.mean([-view.world_from_camera[:3, 1] for view in views], axis=0)
        length = np.linalg.norm(mean)
        cameras_up = mean / length if length > 0.1 else None
    if options.up == "cameras":
        if cameras_up is None:
            raise AdapterError(
                "gaussians: up=cameras needs cameras that are upright on the whole; none were found"
            )
        return cameras_up, True, ""
    stated = options.up or splats.notes.get("up")
    up = parse_up(stated or "+z")
    lean_deg = 0.0
    if cameras_up is not None:
        lean_deg = math.degrees(math.acos(float(np.clip(cameras_up @ up, -1, 1))))
    if options.up is not None:
        return up, True, ""
    why = ""
    if stated is None and (cameras_up is None or lean_deg >= _LEVEL_TOLERANCE_DEG):
        ground = find_ground(splats.gaussians, near=cameras_up)
        if ground is not None and ground.is_clear:
            return ground.up, True, f"up is estimated to be {ground.sentence}. Give up=AXIS if not"
        why = "which way is up is not clear; " + (
            f"the best guess is {ground.sentence}" if ground else "nothing in the file is flat"
        )
    if cameras_up is not None and lean_deg > _UP_TOLERANCE_DEG:
        why = (
            f"the cameras' mean up direction is {lean_deg:.0f} degrees from what was taken as up, "
            f"{nearest_axis(up)}; weather needs gravity, so give up=cameras, or "
            f"up={nearest_axis(cameras_up)} if that axis is vertical"
        )
    return up, stated is not None or not why, why


def _find_scale(
    splats: SplatFile, views: tuple[PosedView, ...], options: GaussianOptions, turned: WorldChange
) -> tuple[float, bool, str]:
    """Return metres per unit, whether they are known, and sentences about it.

    turned: change to a world whose +z is up.
    """
    if options.scale is not None:
        return options.scale, True, ""
    if splats.notes.get("unit") in ("metre", "metres", "m"):
        return 1.0, True, ""
    points = turned.points(solid_points(splats.gaussians) + splats.origin)
    scale = 1.0
    reason = "nothing says otherwise, and it can be a street in metres"
    if views:
        poses = np.stack([turned.pose(view.world_from_camera) for view in views])
        by_cameras = scale_from_cameras(points, poses)
        if by_cameras is None:
            return 1.0, False, "the cameras do not stand at one height, level, as on a car"
        scale, reason = by_cameras
    doubt = doubt_about_metres(scale * points, scale * splats.gaussians.scales)
    if doubt is not None:
        return 1.0, False, doubt
    message = f"a unit is estimated to be {scale:.4g} m: {reason}"
    return scale, True, f"{message}. Give scale=METRES_PER_UNIT if not"


def _frames_and_ground(
    gaussians: Gaussians, views: tuple[PosedView, ...], world: _World, options: GaussianOptions
) -> tuple[tuple[Frame, ...], float | None, list[str]]:
    change = world.change
    is_metric = world.is_metric
    if not views:
        if options.path == "auto" and world.unknown_facts:
            note = (
                f"{NO_CAMERAS}, and no path is made where it is not known "
                f"{world.unknown_facts}; add ?up=+z&scale=1 to the file's name (its axis that "
                "points up, metres per unit), path=orbit to circle it as it lies, or "
                "camera_path=FILE"
            )
            return (), None, [note]
        default_path = make_default_path(gaussians, is_metric=is_metric, kind=options.path)
        frames, problems = frames_from_views(default_path.views, WorldChange())
        return frames, default_path.ground_z_m, [default_path.note, *problems]
    frames, problems = frames_from_views(views, change)
    points = solid_points(gaussians)
    positions = np.stack([change.pose(view.world_from_camera)[:3, 3] for view in views])
    extent = float(np.linalg.norm(np.ptp(positions[:, :2], axis=0)))
    radius = 5.0 if is_metric else max(0.25 * extent, 1e-6)
    ground = lowest_ground(points, positions, radius=radius)
    return frames, ground, [*problems, *_check_views_see(points, frames)]


def _check_views_see(points: np.ndarray, frames: tuple[Frame, ...]) -> list[str]:
    """Return a sentence if the cameras see next to nothing: they are then in another world."""
    cameras = [camera for frame in frames for camera in frame.cameras.values()]
    points = points[:: 1 + len(points) // _SAMPLED_POINTS]
    shares = []
    for camera in cameras[:: 1 + len(cameras) // _SAMPLED_VIEWS]:
        pose = camera.camera_from_world.numpy()
        x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
        ahead = z > 0
        u = camera.fx * x[ahead] / z[ahead] + camera.cx
        v = camera.fy * y[ahead] / z[ahead] + camera.cy
        in_image = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        shares.append(in_image.sum() / len(points))
    if np.median(shares) >= _MIN_SEEN:
        return []
    return [
        f"the cameras see {np.median(shares):.2%} of the Gaussians (median): camera file and splat "
        "file are probably in different worlds, for example because the training tool centred "
        "and scaled the scene"
    ]


def _scene_name(files: Sequence[Path], path: Path) -> str:
    """Return the name of the scene.

    It is the folder's name for several files, for a trained model and for a streamed scene, whose
    files always have the same name.
    """
    file = files[0]
    if len(files) > 1 or file.name == LOD_META:
        return file.parent.resolve().name or file.stem
    if file == path and file.name != "point_cloud.ply":
        return file.stem
    folder = path if path.is_dir() else path.parent
    while _ITERATION.fullmatch(folder.name) or folder.name == "point_cloud":
        folder = folder.parent
    return folder.resolve().name or file.stem
