"""Scenes from plain splat files: a .ply or .splat, alone or in a trained 3DGS model's folder.

    gaussians:PATH?up=-y&scale=1&cameras=FILE

Cameras are looked for beside the file (cameras.json, transforms.json, a COLMAP model in sparse/0)
and above it in a model's folder; `adapters.cameras.frames` says how images become frames. Without
any, `adapters.cameras.default_paths` makes a path. Coordinates and cameras of the file are turned
so that `up` points to +z, scaled to metres, and recentred where they lie beyond a kilometre from
zero.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import torch

from adapters.cameras.default_paths import make_default_path
from adapters.cameras.files import find_camera_file, read_views
from adapters.cameras.frames import frames_from_views
from adapters.cameras.ground_estimate import lowest_ground, solid_points
from adapters.cameras.posed_views import PosedView, ViewSet
from adapters.gaussian_options import COLOURS, GaussianOptions
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

    has_metric_scale is True only where `scale` is given or the file's notes say `unit: metre`;
    has_known_gravity only where `up` is given or in the notes, or the cameras are upright.

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
    change, about_world = _world_change(splats, views, options)
    gaussians = change.gaussians(splats.gaussians, splats.origin)
    is_metric = options.scale is not None or splats.notes.get("unit") in ("metre", "metres", "m")
    if not is_metric:
        problems.append(
            f"{file}: the file does not say how long a unit is; one unit is taken as one metre. "
            "Give scale=METRES_PER_UNIT (scale=1 if it is in metres)"
        )
    frames, ground_z_m, about_frames = _frames_and_ground(
        gaussians, views, change, options, is_metric=is_metric
    )
    return Scene(
        name=_scene_name(file, Path(path)),
        source=format_uri("gaussians", path, query),
        background=gaussians,
        actors=(),
        sky=ConstantSky(torch.tensor(options.sky or _trained_background(Path(path)))),
        frames=frames,
        world_origin_m=change.origin_m,
        ground_z_m=ground_z_m,
        has_metric_scale=is_metric,
        has_known_gravity=_knows_gravity(splats, views, options, change),
        problems=(*problems, *about_world, *about_frames),
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


def _trained_background(path: Path) -> tuple[float, float, float]:
    """What the Gaussians were trained in front of: black, unless the model's cfg_args say white."""
    arguments = path / "cfg_args"
    if arguments.is_file() and "white_background=True" in arguments.read_text(errors="replace"):
        return COLOURS["white"]
    return COLOURS["black"]


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


def _world_change(
    splats: SplatFile, views: tuple[PosedView, ...], options: GaussianOptions
) -> tuple[WorldChange, list[str]]:
    """From the file's world to the scene's, and sentences on doubts about it."""
    problems = []
    cameras_up = _mean_up(views)
    if options.up == "cameras":
        if cameras_up is None:
            raise AdapterError(
                "gaussians: up=cameras needs cameras that are upright on the whole; none were found"
            )
        up = cameras_up
    else:
        up = parse_up(options.up or splats.notes.get("up") or "+z")
    if cameras_up is not None and options.up is None:
        angle = math.degrees(math.acos(float(np.clip(cameras_up @ up, -1, 1))))
        if angle > _UP_TOLERANCE_DEG:
            problems.append(
                f"the cameras' mean up direction is {angle:.0f} degrees from what was taken as up, "
                f"{nearest_axis(up)}; weather needs gravity, so give up=cameras, or "
                f"up={nearest_axis(cameras_up)} if that axis is vertical"
            )
    scale = 1.0 if options.scale is None else options.scale
    turned = WorldChange(rotation_to_z_up(up), scale)
    means = splats.gaussians.means
    sample = means[:: 1 + len(means) // 100_000].double().numpy() + splats.origin
    origin = recentring_origin(turned.points(sample))
    if origin.any() and not splats.origin.any():
        step = np.spacing(np.float32(np.abs(sample).max())) * scale
        problems.append(
            f"coordinates lie {np.linalg.norm(origin) / 1000:.0f} km from zero and the file stores "
            f"them in steps of up to {step:.2g} m; they are recentred, but what rounding took "
            "before is lost"
        )
    return WorldChange(turned.rotation, scale, origin), problems


def _knows_gravity(
    splats: SplatFile, views: tuple[PosedView, ...], options: GaussianOptions, change: WorldChange
) -> bool:
    if options.up is not None or splats.notes.get("up"):
        return True
    cameras_up = _mean_up(views)
    if cameras_up is None:
        return False
    return float((change.rotation @ cameras_up)[2]) > math.cos(math.radians(_LEVEL_TOLERANCE_DEG))


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
    change: WorldChange,
    options: GaussianOptions,
    *,
    is_metric: bool,
) -> tuple[tuple[Frame, ...], float | None, list[str]]:
    if not views:
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
