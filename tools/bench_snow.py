"""What snow costs, how right it is, and whether views agree on it: the entry."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from adapters.base import open_scene, parse_uri
from adapters.procedural import open_truth
from augment.scene import Scene
from tools.bench_flood_cost import bench_camera
from tools.bench_snow_accuracy import AccuracyCase, bench_accuracy
from tools.bench_snow_cost import bench_cost
from tools.bench_snow_depths import lidar_depths, street_depths
from tools.bench_snow_masks import bench_masks
from tools.bench_snow_placement import bench_placement, placement_peak_mib
from tools.machine import load_average, machine_facts


@dataclass(frozen=True)
class SnowCase:
    """What is measured on. scene: of the cost. width, height: of its image, pixels. street: of the
    accuracy, depths and masks, procedural, because the truth must be known. accuracy: its points.
    frames, cameras, scale: of its views; the views of masks have half the scale. cell_m: of cells
    near the path. placements: scenes that placement is timed on.
    """

    scene: str = "procedural:street?seed=3&frames=1&gaussians=1000000"
    width: int = 1600
    height: int = 1066
    street: str = "procedural:street?seed=3&frames=6"
    accuracy: AccuracyCase = field(default_factory=AccuracyCase)
    frames: tuple[int, ...] = (0, 3)
    cameras: tuple[str, ...] = ("front", "left", "back")
    scale: float = 1.0
    cell_m: float = 0.05


WHOLE = SnowCase()
QUICK = SnowCase(
    scene="procedural:street?seed=3&frames=1",
    width=800,
    height=533,
    street="procedural:street?seed=3&frames=2&gaussians=120000",
    accuracy=AccuracyCase(reach_m=16.0, pixel_m=0.1, every=2),
    frames=(0,),
    cameras=("front",),
    scale=0.5,
    cell_m=0.1,
)
LIDAR_FRAMES = 3  # of a scene with sweeps, spread evenly
LIDAR_WIDTH_PX = 960


def bench_snow(
    case: SnowCase = WHOLE,
    *,
    scene_uri: str | None = None,
    repeats: int = 7,
    memory: bool = True,
    progress: bool = True,
) -> dict[str, Any]:
    """All figures as plain numbers for JSON. scene_uri: a scene whose placement, depths and frame
    cost are measured, too.

    repeats: timed pairs of frames a case, after one that is not counted. memory: also start a
    process for each scene that measures the peak memory of placement.
    """
    if repeats < 1:
        raise ValueError(f"need repeats >= 1; got {repeats}")
    machine = machine_facts()
    uris = [case.scene] if scene_uri is None else [case.scene, scene_uri]
    scenes = [
        _scene_figures(uri, case, repeats=repeats, memory=memory, progress=progress) for uri in uris
    ]
    street, truth = open_scene(case.street), open_truth(parse_uri(case.street)[2])
    views = [
        street.frame(f).cameras[c].scaled(case.scale) for f in case.frames for c in case.cameras
    ]
    return {
        "machine": dataclasses.asdict(machine),
        "scenes": scenes,
        "street": case.street,
        "accuracy": bench_accuracy(street, truth, cell_m=case.cell_m, case=case.accuracy),
        "depths": street_depths(street, truth, views),
        "masks": bench_masks(street, case.frames, scale=case.scale / 2, cell_m=case.cell_m),
        "load_after": load_average(),
    }


def _scene_figures(
    uri: str, case: SnowCase, *, repeats: int, memory: bool, progress: bool
) -> dict[str, Any]:
    """Placement, cost and, where the scene has sweeps, the depth buffers against them."""
    scene = open_scene(uri)
    placement = bench_placement(scene, cell_m=case.cell_m, repeats=repeats)
    camera = bench_camera(scene, case.width, case.height)
    return {
        "scene": uri,
        "placement": {
            **placement,
            "peak_mib": placement_peak_mib(uri, case.cell_m) if memory else None,
        },
        "cost": bench_cost(scene, camera, cell_m=case.cell_m, repeats=repeats, progress=progress),
        "lidar_depths": None if uri == case.scene else _against_lidar(scene),
    }


def _against_lidar(scene: Scene) -> dict[str, Any] | None:
    frames = [frame.index for frame in scene.frames]
    chosen = [frames[round(k * (len(frames) - 1) / LIDAR_FRAMES)] for k in range(LIDAR_FRAMES)]
    cameras = scene.frame(chosen[0]).cameras
    widest = max(camera.width for camera in cameras.values())
    return lidar_depths(scene, sorted(set(chosen)), list(cameras), min(1, LIDAR_WIDTH_PX / widest))
