"""What a style costs, how exact its maps are, and whether styled views agree: the entry."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from adapters.base import open_scene
from recipes.weather import style_preset_names
from tools.bench_scene import RasterCase
from tools.bench_style_cost import bench_apply, bench_frames, front_camera
from tools.bench_style_exact import bench_exact, bench_folding
from tools.bench_style_maps import bench_maps
from tools.bench_style_memory import bench_memory
from tools.bench_style_network import bench_network
from tools.bench_style_scores import ScoreCase, bench_scores
from tools.bench_style_views import bench_views
from tools.machine import load_average, machine_facts


@dataclass(frozen=True)
class StyleCase:
    """What is measured on. scene: of exactness, frames and memory; width: of its pictures, pixels.
    gaussians: SH 3, that maps are applied to. street, frames, views_width: of the views that are
    compared; each frame with the next and with the one FAR later. presets: styles. scores: of
    the network and the closed forms. b0: whether EfficientNet-B0 is timed, where there is one.
    """

    scene: str = "procedural:street?seed=0&frames=1&gaussians=1000000"
    width: int = 1600
    gaussians: int = 1_000_000
    street: str = "procedural:street?seed=0&frames=10"
    frames: tuple[int, ...] = (0, 1, 2)
    views_width: int = 480
    presets: tuple[str, ...] = style_preset_names()
    scores: ScoreCase = field(default_factory=ScoreCase)
    b0: bool = True


WHOLE = StyleCase()
QUICK = StyleCase(
    scene="procedural:street?seed=0&frames=1",
    width=800,
    gaussians=200_000,
    street="procedural:street?seed=0&frames=8&gaussians=120000",
    frames=(0,),
    views_width=240,
    presets=("overcast", "golden-hour"),
    scores=ScoreCase(size_px=128, repeats=1, pairs=60),
    b0=False,
)


def bench_style(
    case: StyleCase = WHOLE,
    *,
    scene_uri: str | None = None,
    photos: Sequence[Path] | Path | None = None,
    checkpoint: Path | None = None,
    repeats: int = 7,
    memory: bool = True,
    progress: bool = True,
) -> dict[str, Any]:
    """All figures as plain numbers for JSON.

    scene_uri: a scene that exactness, frames, memory and views are measured on, too. photos: files
    and folders, of which those are scored on that the network was not trained on: as its file
    says, else every eighth. checkpoint: the network; None for the one that comes with the
    package, or where there is none a random one.
    repeats: timed turns a case, after one that is not counted. memory: also start processes that
    measure the peak memory of a frame.
    """
    if repeats < 1:
        raise ValueError(f"need repeats >= 1; got {repeats}")
    machine = machine_facts()
    folders = [photos] if isinstance(photos, Path) else list(photos or ())
    network = bench_network(checkpoint)
    uris = [case.scene] if scene_uri is None else [case.scene, scene_uri]
    scenes = [
        _scene_figures(uri, case, repeats=repeats, memory=memory, progress=progress) for uri in uris
    ]
    street = open_scene(case.street)
    views = {case.street: bench_views(street, case.frames, case.presets, case.views_width)}
    if scene_uri is not None:
        other = open_scene(scene_uri)
        frames = tuple(frame.index for frame in other.frames)[: len(case.frames)]
        views[scene_uri] = bench_views(other, frames, case.presets, case.views_width)
    return {
        "machine": dataclasses.asdict(machine),
        "network": network.facts,
        "folding": bench_folding(network.net),
        "apply": bench_apply(RasterCase(case.gaussians, 640, 480), repeats),
        "scenes": scenes,
        "maps": bench_maps(street, network.net, folders, b0=case.b0, repeats=repeats),
        "scores": bench_scores(network, folders, case.scores, progress=progress),
        "views": views,
        "load_after": load_average(),
    }


def _scene_figures(
    uri: str, case: StyleCase, *, repeats: int, memory: bool, progress: bool
) -> dict[str, Any]:
    scene = open_scene(uri)
    camera = front_camera(scene, case.width)
    return {
        "scene": uri,
        "exact": bench_exact(scene, camera, case.presets),
        "frames": bench_frames(scene, camera, case.presets[0], repeats, progress=progress),
        "memory": bench_memory(scene, uri, case.width, case.presets[0]) if memory else None,
    }
