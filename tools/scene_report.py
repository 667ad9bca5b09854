"""What is in a scene, for people and for machines."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from typing import Any

import numpy as np
import torch

from augment.errors import SceneError
from augment.ground import ground_of, ground_sentence
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Counts, bounds, memory, what is known and what is not, and the problems found."""
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
        "cameras": _describe_cameras(scene),
        "frames": _describe_frames(scene),
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
        "problems": list(scene.problems),
    }


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


def _describe_cameras(scene: Scene) -> list[dict[str, Any]]:
    cameras = []
    for name in scene.camera_names:
        views = [f.cameras[name] for f in scene.frames if name in f.cameras]
        first = views[0]
        cameras.append(
            {
                "name": name,
                "width": first.width,
                "height": first.height,
                "horizontal_fov_deg": float(np.degrees(2 * np.arctan(first.width / 2 / first.fx))),
                "images": len(views),
            }
        )
    return cameras


def _describe_frames(scene: Scene) -> dict[str, Any]:
    if not scene.frames:
        return {"count": 0}
    path = torch.stack([f.world_from_ego[:3, 3] for f in scene.frames])
    return {
        "count": len(scene.frames),
        "first": scene.frames[0].index,
        "last": scene.frames[-1].index,
        "duration_s": (scene.frames[-1].timestamp_ns - scene.frames[0].timestamp_ns) / 1e9,
        "ego_path_m": float(path.diff(dim=0).norm(dim=1).sum()),
    }


def _describe_ground(scene: Scene) -> dict[str, Any]:
    """The ground's record, or without it the sentence that says what is lacking."""
    try:
        ground = ground_of(scene)
    except SceneError as error:
        return {"sentence": f"not known: {error}"}
    return {**dataclasses.asdict(ground), "sentence": ground_sentence(ground)}


def _describe_labels(scene: Scene) -> dict[str, Any]:
    """From the first frame only: reading every sweep of a long drive would take minutes."""
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
    """The facts of `describe_scene` as a page of text."""
    background, frames, labels = facts["background"], facts["frames"], facts["labels"]
    low, high = background["bounds_98_percent_m"]
    size = " x ".join(f"{b - a:.1f}" for a, b in zip(low, high, strict=True))
    lines = [
        f"{facts['name']}  ({facts['source']})",
        f"  Gaussians   {facts['gaussians']:,} ({facts['gaussian_bytes'] / 2**20:.0f} MiB), "
        f"background {background['count']:,}, SH degree {background['sh_degree']}",
        f"  extent      {size} m (middle 98 % of the background)",
        f"  splats      median scale {background['median_scale_m'] * 100:.1f} cm, "
        f"median opacity {background['median_opacity']:.2f}",
        f"  ground      {facts['ground']['sentence']}",
        f"  scale       {'metres' if facts['has_metric_scale'] else 'unknown unit'}",
        f"  up          {'+z' if facts['has_known_gravity'] else 'taken as +z, not known'}",
        f"  sky         {facts['sky']}",
        f"  frames      {_frames(frames)}",
    ]
    if facts["recorded_source"] is not None:
        lines.insert(1, f"  made from   {facts['recorded_source']}")
    lines += [f"  made by     {name}: {_short(value)}" for name, value in facts["made_by"].items()]
    lines += [
        f"  camera      {c['name']}: {c['width']}x{c['height']} px, "
        f"{c['horizontal_fov_deg']:.0f} deg wide, {c['images']} images"
        + _gains(facts["color_maps"].get(c["name"]))
        + _own_maps(facts["image_color_maps"].get(c["name"], 0))
        for c in facts["cameras"]
    ]
    lines += [
        f"  actor       {a['track_id']} ({a['label']}): {a['gaussians']:,} Gaussians"
        + ("" if a["color_terms"] == 1 else f", colours over time in {a['color_terms']} terms")
        for a in facts["actors"]
    ]
    boxes, lidar = labels["boxes"], labels["lidar"]
    lines.append(
        "  boxes       "
        + ("none" if boxes is None else f"{boxes['in_first_frame']} in the first frame")
    )
    lines.append(
        "  LiDAR       "
        + (
            "none in the first frame"
            if lidar is None
            else f"{lidar['points_in_first_frame']:,} points in the first frame; "
            f"columns {', '.join(lidar['columns'])}"
        )
    )
    if background["classes"]:
        known = sorted(background["classes"].items(), key=lambda item: -item[1])
        lines.append("  classes     " + ", ".join(f"{name} {count:,}" for name, count in known))
    lines += [f"  problem     {p}" for p in facts["problems"]] or ["  problems    none found"]
    return "\n".join(lines)


def _gains(color_map: list[list[float]] | None) -> str:
    """How much a camera's colour map changes mid grey, by channel."""
    if color_map is None:
        return ""
    gains = (sum(row[:3]) + row[3] / 0.5 for row in color_map)
    return f", records mid grey x {' '.join(f'{gain:.2f}' for gain in gains)}"


def _own_maps(count: int) -> str:
    return f", {count} images with a colour map of their own" if count else ""


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 100 else text[:97] + "..."


def _frames(frames: dict[str, Any]) -> str:
    if frames["count"] == 0:
        return "none: give a camera path"
    return (
        f"{frames['count']} ({frames['first']} to {frames['last']}), "
        f"{frames['duration_s']:.1f} s, ego path {frames['ego_path_m']:.1f} m"
    )
