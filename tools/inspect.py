"""`climategs inspect`: the content of a scene, or of a drive that no scene can be made of."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from adapters.base import open_scene
from adapters.camera_files.paths import with_camera_path
from adapters.raw_drive import IncompleteDrive
from augment.errors import SceneError
from augment.files.lens_records import lens_words
from augment.light.scene_light import find_scene_light
from augment.photo.trust import judge_scene
from augment.scene.cameras import Camera, Frame
from augment.scene.ground import describe_ground, ground_of
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from tools.inspect_splats import describe_splat_files
from tools.output import fill, write_json

if TYPE_CHECKING:
    from tools.cli import InspectOptions

# Share of the light that is the sun's above which sunlit walls and shadows show at night.
MAX_SUN_SHARE_AT_NIGHT = 0.5


def inspect_scene(options: InspectOptions) -> int:
    """Print and write the facts of a scene. Return 1 for a drive that no scene can be made of."""
    try:
        scene = open_scene(options.uri)
        if options.camera_path is not None:
            scene = with_camera_path(scene, options.camera_path)
        facts = describe_scene(scene)
        facts |= describe_splat_files(options.uri, scene)
    except IncompleteDrive as error:
        facts = describe_drive(error)
        print(drive_text(facts))
        write_json(options.json_file, facts)
        return 1
    print(scene_text(facts))
    write_json(options.json_file, facts)
    return 0


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Describe a scene: counts, bounds, memory, what it has and lacks, and its problems.

    A few small views of it are drawn to find what is not fit for weather.

    """
    actors = [
        {
            "track_id": a.track_id,
            "label": a.label,
            "gaussians": len(a.gaussians),
            "color_terms": 1 if a.color_waves is None else 1 + a.color_waves.coefficients.shape[1],
            "size_m": list(a.size_m),
            "from_ns": int(a.track.timestamps_ns[0]),
            "to_ns": int(a.track.timestamps_ns[-1]),
        }
        for a in scene.actors
    ]
    all_gaussians = scene.all_gaussians
    return {
        "name": scene.name,
        "source": scene.source,
        "gaussians": sum(len(g) for g in all_gaussians),
        "gaussian_bytes": scene.gaussian_bytes,
        "background": _describe_gaussians(scene.background),
        "actors": actors,
        "sky": type(scene.sky).__name__,
        "cameras": _describe_cameras(scene.frames),
        "frames": _describe_frames(scene.frames),
        "labels": _describe_labels(scene),
        "ground_z_m": scene.ground_z_m,
        "ground": _describe_ground(scene),
        "has_metric_scale": scene.has_metric_scale,
        "has_known_gravity": scene.has_known_gravity,
        "world_origin_m": [float(v) for v in scene.world_origin_m],
        "recorded_source": scene.recorded_source,
        "color_maps": {name: matrix.tolist() for name, matrix in scene.color_maps.items()},
        "image_color_maps": dict(Counter(name for name, _ in scene.image_color_maps)),
        "made_by": dict(scene.made_by),
        "light": _describe_light(scene),
        "problems": list(scene.problems),
        "trust": judge_scene(scene).as_dict(),
    }


def _describe_light(scene: Scene) -> dict[str, Any]:
    """Describe the light of the recording, and if its colours are fit for dusk and night."""
    light = find_scene_light(scene)
    share = f"the sun gives {100 * light.sun_share:.0f} % of it"
    if light.sun_share > MAX_SUN_SHARE_AT_NIGHT:
        sentence = f"{share}: not fit for dusk and night, where its lit walls and shadows stay"
    else:
        sentence = f"{share}: fit for dusk and night"
    return {"sun_share": light.sun_share, "sentence": sentence}


def _describe_gaussians(gaussians: Gaussians) -> dict[str, Any]:
    means = gaussians.means
    if len(means) > 100_000:  # every k-th is enough for quantiles, and torch.quantile has a limit
        means = means[:: len(means) // 100_000 + 1]
    quantiles = torch.quantile(means.double(), torch.tensor([0.0, 0.01, 0.99, 1.0]).double(), dim=0)
    classes: dict[str, int] = {}
    if gaussians.semantic is not None:
        values, counts = np.unique(gaussians.semantic.numpy(), return_counts=True)
        classes = {
            SemanticClass(int(v)).name.lower(): int(c) for v, c in zip(values, counts, strict=True)
        }
    return {
        "count": len(gaussians),
        "sh_degree": gaussians.sh_degree,
        "bounds_98_percent_m": [quantiles[1].tolist(), quantiles[2].tolist()],
        "bounds_m": [gaussians.means.amin(0).tolist(), gaussians.means.amax(0).tolist()],
        "median_scale_m": float(gaussians.scales.median()),
        "median_opacity": float(gaussians.opacities.median()),
        "classes": classes,
    }


def describe_drive(incomplete: IncompleteDrive) -> dict[str, Any]:
    """Describe a drive that no scene can be made of: its data, what it lacks, and its problems."""
    drive = incomplete.drive
    ground = incomplete.ground
    boxes = {frame.index: drive.labels.boxes(frame.index) for frame in drive.frames}
    sentence = "not known: it is measured as a scene is made, or told by a map"
    if ground is not None:
        sentence = describe_ground(ground)
    cameras = _describe_cameras(drive.frames)
    for camera in cameras:
        camera["images"] = sum(camera["name"] in frame.image_paths for frame in drive.frames)
    return {
        "name": drive.name,
        "source": drive.source,
        "missing": str(incomplete).split(";")[0].removeprefix(f"{drive.source}: "),
        "frames": _describe_frames(drive.frames),
        "cameras": cameras,
        "lidar": {
            "sweeps": sum(len(sweep) > 0 for sweep in drive.sweeps),
            "returns": sum(map(len, drive.sweeps)),
        },
        "boxes": {
            "count": sum(map(len, boxes.values())),
            "frames": sum(len(frame_boxes) > 0 for frame_boxes in boxes.values()),
            "labels": dict(
                Counter(label for frame_boxes in boxes.values() for label in frame_boxes.labels)
            ),
            "moving": len({box.object_id for box in drive.boxes}),
        },
        "ground": {"sentence": sentence}
        if ground is None
        else {**dataclasses.asdict(ground), "sentence": sentence},
        "problems": list(drive.problems),
    }


def drive_text(facts: dict[str, Any]) -> str:
    """Return the facts of `describe_drive` as a page of text."""
    return fill("inspect_drive.txt", **facts)


def _describe_cameras(frames: Sequence[Frame]) -> list[dict[str, Any]]:
    cameras = []
    for name in dict.fromkeys(name for frame in frames for name in frame.cameras):
        views = [f.cameras[name] for f in frames if name in f.cameras]
        first = views[0]
        cameras.append(
            {
                "name": name,
                "width": first.width,
                "height": first.height,
                "horizontal_fov_deg": _horizontal_view_deg(first),
                "images": len(views),
                **({} if first.lens is None else {"lens": lens_words(first.lens)}),
                **({} if first.shutter is None else {"shutter": first.shutter.read_out}),
            }
        )
    return cameras


def _horizontal_view_deg(camera: Camera) -> float:
    """Return the angle between the rays of the left and the right border, at the middle row."""
    if camera.lens is None:
        return float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx)))
    borders = np.array([[0.0, camera.height / 2], [camera.width, camera.height / 2]])
    rays, is_inside = camera.lens.rays(borders, camera.intrinsics)
    angles = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    return float(np.degrees(np.where(is_inside, angles, camera.lens.max_angle_rad).sum()))


def _describe_frames(frames: Sequence[Frame]) -> dict[str, Any]:
    if not frames:
        return {"count": 0}
    path = torch.stack([f.world_from_ego[:3, 3] for f in frames])
    return {
        "count": len(frames),
        "first": frames[0].index,
        "last": frames[-1].index,
        "duration_s": (frames[-1].timestamp_ns - frames[0].timestamp_ns) / 1e9,
        "ego_path_m": float(path.diff(dim=0).norm(dim=1).sum()),
    }


def _describe_ground(scene: Scene) -> dict[str, Any]:
    """Return the record of the ground, or without one a sentence about what is missing."""
    try:
        ground = ground_of(scene)
    except SceneError as error:
        return {"sentence": f"not known: {error}"}
    return {**dataclasses.asdict(ground), "sentence": describe_ground(ground)}


def _describe_labels(scene: Scene) -> dict[str, Any]:
    """Describe the labels of the first frame: reading all sweeps of a long drive takes minutes."""
    if scene.labels is None or not scene.frames:
        return {"boxes": None, "lidar": None}
    index = scene.frames[0].index
    sweep = scene.lidar(index)
    return {
        "boxes": {"in_first_frame": len(scene.boxes(index))},
        "lidar": None
        if sweep is None
        else {"points_in_first_frame": len(sweep), "columns": list(sweep.columns)},
    }


def scene_text(facts: dict[str, Any]) -> str:
    """Return the facts of `describe_scene` as a page of text."""
    made_by = {name: _short(value) for name, value in facts["made_by"].items()}
    return fill("inspect.txt", **{**facts, "made_by": made_by})


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 100 else text[:97] + "..."
