"""Scenes from plain splat files: a .ply or .splat, alone or in a trained 3DGS model's folder.

    gaussians:PATH?up=-y&scale=1&cameras=FILE

Cameras are looked for beside the file (cameras.json, transforms.json, a COLMAP model in sparse/0)
and above it in a model's folder; `adapters.cameras.frames` says how images become frames. Without
any, `adapters.cameras.default_paths` makes a path. Coordinates and cameras of the file are turned
so that `up` points to +z, scaled to metres, and recentred where they lie beyond a kilometre from
zero. What neither the URI nor the file says of up and scale, `adapters.up_and_scale` estimates; a
file whose ground is not clear gets no path.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from adapters.cameras.default_paths import NO_CAMERAS, make_default_path
from adapters.cameras.files import find_camera_file, read_views
from adapters.cameras.frames import frames_from_views
from adapters.cameras.ground_estimate import lowest_ground, solid_points
from adapters.cameras.posed_views import PosedView, ViewSet
from adapters.gaussian_options import COLOURS, GaussianOptions
from adapters.up_and_scale import doubt_about_metres, find_ground, scale_from_cameras
from adapters.uri import format_uri
from adapters.world import WorldChange, nearest_axis, parse_up, rotation_to_z_up
from augment.cameras import Frame
from augment.errors import AdapterError
from augment.scene import Gaussians, Scene
from augment.sky import ConstantSky
from augment.splat_io import SplatFile, read_splats, recentring_origin

_UP_TOLERANCE_DEG = 30.0
_LEVEL_TOLERANCE_DEG = 15.0  # cameras on a car lean less; this vouches for an axis, not for degrees
_ITERATION = re.compile(r"iteration_(\d+)")
_SAMPLED_VIEWS, _SAMPLED_POINTS = 16, 20_000
_LEAST_SEEN = 0.001


def open_gaussians(path: str | Path, query: dict[str, str]) -> Scene:
    """A scene of a splat file or of a trained model's folder. The query's keys:
    adapters.gaussian_options.QUERY_KEYS.

    has_metric_scale and has_known_gravity are True where URI or file say scale and up, where the
    cameras are upright, and where they could be estimated, which the scene's problems say.

    Raises:
        AdapterError: a query key or value, or a camera file, that cannot be used.
        SceneError: the splat file is missing, damaged, or something else.
    """
    options = GaussianOptions.from_query(query)
    file = find_splat_file(Path(path), options.iteration)
    splats = read_splats(file)
    problems = list(splats.problems)
    found = _find_views(file, Path(path), options)
    views = found.views if found else ()
    problems += found.problems if found else ()
    world = _find_world(file, splats, views, options)
    change = world.change
    gaussians = change.gaussians(splats.gaussians, splats.origin)
    frames, ground_z_m, about_frames = _frames_and_ground(gaussians, views, world, options)
    return Scene(
        name=_scene_name(file, Path(path)),
        source=format_uri("gaussians", path, query),
        background=gaussians,
        actors=(),
        sky=ConstantSky(torch.tensor(options.sky or _stand_in_sky(Path(path)))),
        frames=frames,
        world_origin_m=change.origin_m,
        ground_z_m=ground_z_m,
        has_metric_scale=world.is_metric,
        has_known_gravity=world.knows_up,
        problems=(*problems, *world.problems, *about_frames),
    )


def find_splat_file(path: Path, iteration: int | None = None) -> Path:
    """The splat file itself, the newest (or given) iteration of a model, or a folder's only one.

    Raises:
        AdapterError: none, or several; lists what is there.
    """
    if not path.is_dir():
        return path
    found = {}
    for file in path.glob("point_cloud/iteration_*/point_cloud.ply"):
        if match := _ITERATION.fullmatch(file.parent.name):
            found[int(match[1])] = file
    if found:
        if iteration is not None and iteration not in found:
            raise AdapterError(f"{path}: no iteration {iteration}; it has {sorted(found)}")
        return found[max(found) if iteration is None else iteration]
    files = sorted(p for p in path.iterdir() if p.suffix.lower() in (".ply", ".splat"))
    if len(files) != 1:
        names = [p.name for p in files[:8]]
        raise AdapterError(
            f"{path}: expected point_cloud/iteration_N/point_cloud.ply or exactly one .ply or "
            f".splat file in this folder; found {names or 'none'}. Give the file itself"
        )
    return files[0]


def _stand_in_sky(path: Path) -> tuple[float, float, float]:
    """An overcast sky, whose light tints nothing; white where the model's cfg_args say that it was
    trained in front of white. (What was trained in front of black would stand in a black night.)
    """
    arguments = path / "cfg_args"
    if arguments.is_file() and "white_background=True" in arguments.read_text(errors="replace"):
        return COLOURS["white"]
    return COLOURS["overcast"]


def _find_views(file: Path, given: Path, options: GaussianOptions) -> ViewSet | None:
    if options.cameras == "none":
        return None
    if options.cameras is not None:
        return read_views(Path(options.cameras))
    folders = [file.parent]
    if _ITERATION.fullmatch(file.parent.name) and file.parent.parent.name == "point_cloud":
        folders.append(file.parent.parent.parent)
    if given.is_dir():
        folders.append(given)
    for folder in folders:
        if found := find_camera_file(folder):
            try:
                return read_views(found)
            except AdapterError as error:
                raise AdapterError(
                    f"{error}. (Found beside {file}; give cameras=FILE for others or cameras=none "
                    "to do without)"
                ) from error
    return None


@dataclass(frozen=True, eq=False)
class _World:
    """change: from the file's world to the scene's. problems: what is estimated or in doubt.
    lacking: what of up and scale is not known; empty where both are.
    """

    change: WorldChange
    knows_up: bool
    is_metric: bool
    problems: tuple[str, ...]
    lacking: str


def _find_world(
    file: Path, splats: SplatFile, views: tuple[PosedView, ...], options: GaussianOptions
) -> _World:
    up, knows_up, about_up = _find_up(splats, views, options)
    turned = WorldChange(rotation_to_z_up(up))
    scale, is_metric, about_scale = 1.0, False, "to estimate it, up has to be known"
    if knows_up or options.scale is not None:
        scale, is_metric, about_scale = _find_scale(splats, views, options, turned)
    if not is_metric:
        about_scale = (
            "the file does not say how long a unit is; one unit is taken as one metre. "
            f"Give scale=METRES_PER_UNIT (scale=1 if it is in metres); {about_scale}"
        )
    facts = ((knows_up, "which way is up"), (is_metric, "how long a unit is"))
    lacking = " and ".join(what for known, what in facts if not known)
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
    return _World(change, knows_up, is_metric, tuple(problems), lacking)


def _find_up(
    splats: SplatFile, views: tuple[PosedView, ...], options: GaussianOptions
) -> tuple[np.ndarray, bool, str]:
    """Up in the file's world, whether it is known, and what there is to say about it."""
    cameras_up = _mean_up(views)
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
        found = find_ground(splats.gaussians, near=cameras_up)
        if found is not None and found.is_clear:
            return found.up, True, f"up is estimated to be {found.sentence}. Give up=AXIS if not"
        why = "which way is up is not clear; " + (
            f"the best guess is {found.sentence}" if found else "nothing in the file is flat"
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
    """Metres per unit, whether that is known, and what there is to say about it. turned: to a world
    whose +z is up.
    """
    if options.scale is not None:
        return options.scale, True, ""
    if splats.notes.get("unit") in ("metre", "metres", "m"):
        return 1.0, True, ""
    points = turned.points(solid_points(splats.gaussians) + splats.origin)
    scale, reason = 1.0, "nothing says otherwise, and it can be a street in metres"
    if views:
        poses = np.stack([turned.pose(view.world_from_camera) for view in views])
        by_cameras = scale_from_cameras(points, poses)
        if by_cameras is None:
            return 1.0, False, "the cameras do not stand at one height, level, as on a car"
        scale, reason = by_cameras
    doubt = doubt_about_metres(scale * points, scale * splats.gaussians.scales)
    if doubt is not None:
        return 1.0, False, doubt
    said = f"a unit is estimated to be {scale:.4g} m: {reason}"
    return scale, True, f"{said}. Give scale=METRES_PER_UNIT if not"


def _mean_up(views: tuple[PosedView, ...]) -> np.ndarray | None:
    """Mean direction of the images' top edge in the file's world; None if there is none."""
    if not views:
        return None
    mean = np.mean([-view.world_from_camera[:3, 1] for view in views], axis=0)
    length = np.linalg.norm(mean)
    return mean / length if length > 0.1 else None  # cameras that point everywhere say nothing


def _frames_and_ground(
    gaussians: Gaussians,
    views: tuple[PosedView, ...],
    world: _World,
    options: GaussianOptions,
) -> tuple[tuple[Frame, ...], float | None, list[str]]:
    change, is_metric = world.change, world.is_metric
    if not views:
        if options.path == "auto" and world.lacking:
            note = (
                f"{NO_CAMERAS}, and no path is made where it is not known {world.lacking}; add "
                "?up=+z&scale=1 to the file's name (its axis that points up, metres per unit), "
                "path=orbit to circle it as it lies, or camera_path=FILE"
            )
            return (), None, [note]
        made = make_default_path(gaussians, is_metric=is_metric, kind=options.path)
        frames, problems = frames_from_views(made.views, WorldChange())
        return frames, made.ground_z_m, [made.note, *problems]
    frames, problems = frames_from_views(views, change)
    points = solid_points(gaussians)
    positions = np.stack([change.pose(view.world_from_camera)[:3, 3] for view in views])
    extent = float(np.linalg.norm(np.ptp(positions[:, :2], axis=0)))
    radius = 5.0 if is_metric else max(0.25 * extent, 1e-6)
    ground = lowest_ground(points, positions, radius=radius)
    return frames, ground, [*problems, *_check_views_see(points, frames)]


def _check_views_see(points: np.ndarray, frames: tuple[Frame, ...]) -> list[str]:
    """A sentence if the cameras see next to nothing: they are then in another world."""
    cameras = [camera for frame in frames for camera in frame.cameras.values()]
    points = points[:: 1 + len(points) // _SAMPLED_POINTS]
    shares = []
    for camera in cameras[:: 1 + len(cameras) // _SAMPLED_VIEWS]:
        pose = camera.camera_from_world.numpy()
        x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
        ahead = z > 0
        u = camera.fx * x[ahead] / z[ahead] + camera.cx
        v = camera.fy * y[ahead] / z[ahead] + camera.cy
        seen = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        shares.append(seen.sum() / len(points))
    if np.median(shares) >= _LEAST_SEEN:
        return []
    return [
        f"the cameras see {np.median(shares):.2%} of the Gaussians (median): camera file and splat "
        "file are probably in different worlds, for example because the training tool centred "
        "and scaled the scene"
    ]


def _scene_name(file: Path, given: Path) -> str:
    """The folder's name for a trained model, whose file is always called point_cloud.ply."""
    if file == given and file.name != "point_cloud.ply":
        return file.stem
    folder = given if given.is_dir() else given.parent
    while _ITERATION.fullmatch(folder.name) or folder.name == "point_cloud":
        folder = folder.parent
    return folder.resolve().name or file.stem
