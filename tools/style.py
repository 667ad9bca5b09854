"""`climategs style apply`: a scene in the colours of a photograph or a preset, as a scene folder;
`style train`: photographs and scenes become a network that maps colours.

The network's bytes depend on the data, the settings and the number of steps alone.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from pydantic import ValidationError

from adapters.base import open_scene
from adapters.scene_folder import prepare_for_storage
from augment.effects.style.color_maps import StyleMaps, sky_levels, style_gaussians, style_scene
from augment.effects.style.content import content_pictures, content_statistics, select_views
from augment.effects.style.losses import open_features
from augment.effects.style.network import B0Encoder, Gscm, load_imagenet_weights, save_network
from augment.effects.style.style import SceneStyle, style_maps
from augment.effects.style.train import (
    Content,
    Photos,
    StepRecord,
    TrainingPool,
    new_network,
    photo_contents,
    read_photos,
    scene_contents,
    score_photos,
    train_network,
)
from augment.errors import ClimateGSError, OutputError, StyleError
from augment.files.scene_file import save_scene
from augment.output.atomic import write_atomic
from augment.render.composite import composite_sky, to_byte_array
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from recipes.style import STYLES, Style, style_preset_names
from recipes.template import readable
from tools.options import DEFAULT_MINUTES, StyleTrainOptions, value_or
from tools.output import check_scene_out, fill, path_beside, print_note
from tools.pictures import captioned, strip, write_rgb
from tools.training import REPORT_FILE, StopRequest

if TYPE_CHECKING:
    from tools.cli import ApplyOptions

# The network in the folder of a training; the report lies beside it.
NETWORK_FILE = "network.safetensors"
# Largest number of views of a scene that are learnt from.
SCENE_VIEWS = 24
# Every so many photos one is held out for scores.
HOLDOUT = 8
# Number of steps after which the losses are printed and the network is written.
ROW_STEPS = 50


def train_style(options: StyleTrainOptions) -> dict[str, Any]:
    """Train a network into `options.out`. Return the report, which is written beside it.

    Raises:
        ClimateGSError: options, data or the output folder cannot be used as they are.
    """
    network_file = _check_network_out(options)
    _check_device(options.device)
    pool, photos, problems = _open_data(options)
    features = open_features(options.vgg)
    net = _new_network(options)
    progress = _progress(options)
    about = {
        "command": "style train",
        "features": features.name,
        "settings": options.settings(),
        "data": {
            "views": len(pool.views),
            "photos": len(photos.train),
            "held_out_photos": len(photos.held_out),
        },
    }
    history: list[dict[str, float]] = []
    records: list[StepRecord] = []
    with StopRequest() as stop:
        for record in train_network(
            net,
            pool,
            features,
            progress=progress,
            seed=options.seed,
            learning_rate=options.settings()["learning_rate"],
            frozen_norm=options.encoder_weights is not None,
        ):
            records.append(record)
            about["steps"] = record.step
            is_last = stop.requested or progress(record.step) >= 1
            if is_last or record.step % ROW_STEPS == 0:
                history.append(_mean_losses(records))
                print_note(", ".join(f"{name} {value:.4g}" for name, value in history[-1].items()))
                records = []
                save_network(network_file, net, about)
            if is_last:
                break
    report = {
        **about,
        "complete": progress(about["steps"]) >= 1,
        "network": NETWORK_FILE,
        "problems": problems,
        "scores": score_photos(net, photos.held_out),
        "history": history,
    }
    write_atomic(options.out / REPORT_FILE, (json.dumps(report, indent=1) + "\n").encode())
    if not report["complete"]:
        print_note(f"stopped after step {about['steps']}; the network is as it was then")
    for name, psnr_db in report["scores"].items():
        print(f"{name}: {psnr_db:.2f} dB")
    print(f"network: {network_file}")
    return report


def _check_network_out(options: StyleTrainOptions) -> Path:
    """Return the path of the network to write; refuse a file, and a network that is there."""
    if options.out.exists() and not options.out.is_dir():
        raise OutputError(f"{options.out} is a file: choose another --out")
    network_file = options.out / NETWORK_FILE
    if network_file.exists() and not options.overwrite:
        raise OutputError(
            f"{options.out} holds a network: choose another --out, or replace it with --overwrite"
        )
    return network_file


def _check_device(device: str) -> None:
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:  # of torch without CUDA
        reason = str(error).splitlines()[0]
        raise ClimateGSError(f"--device {device}: {reason}; train on cpu, or cuda") from error


def _open_data(options: StyleTrainOptions) -> tuple[TrainingPool, Photos, list[str]]:
    """Return the pictures to learn from, all photos, and a sentence for each problem with them."""
    size_px = options.settings()["size_px"]
    views: list[Content] = []
    problems: list[str] = []
    for uri in options.scenes:
        scene = open_scene(uri)
        views += scene_contents(
            scene, SCENE_VIEWS, size_px, seed=options.seed, device=options.device
        )
        problems += scene.problems
    photos = read_photos(options.photos, size_px, holdout=HOLDOUT)
    problems += photos.problems
    pool = TrainingPool(views, photo_contents(photos.train, device=options.device))
    for problem in problems:
        print_note(f"note: {problem}")
    num_photos = len(photos.train)
    num_scenes = len(options.scenes)
    print_note(f"{num_photos} photos and {len(views)} views of {num_scenes} scenes to learn from")
    return pool, photos, problems


def _new_network(options: StyleTrainOptions) -> Gscm:
    """Return the network to train, with the encoder's pretrained weights if there are any."""
    net = new_network(options.encoder, seed=options.seed)
    if options.encoder_weights is not None:
        assert isinstance(net.encoder, B0Encoder)
        load_imagenet_weights(net.encoder, options.encoder_weights)
    return net


def _progress(options: StyleTrainOptions) -> Callable[[int], float]:
    """Return a function from steps done to the share of the training that is done, by now."""
    if (num_steps := options.steps) is not None:
        return lambda step: step / num_steps
    budget_s = 60 * value_or(options.minutes, DEFAULT_MINUTES)
    start_s = time.monotonic()
    return lambda step: (time.monotonic() - start_s) / budget_s if step else 0.0


def _mean_losses(records: Sequence[StepRecord]) -> dict[str, float]:
    """Return the last step's number and mean losses; a loss of some steps is averaged over them."""
    row = {"step": float(records[-1].step), "loss": np.mean([record.loss for record in records])}
    names = {name for record in records for name in record.terms}
    for name in sorted(names):
        row[name] = np.mean([record.terms[name] for record in records if name in record.terms])
    return {name: float(value) for name, value in row.items()}


VIEWS = 2  # that are drawn and measured
VIEW_WIDTH = 640  # px
VISIBLE = 1 / 255  # a difference of colour


def apply_style(options: ApplyOptions) -> dict[str, Any]:
    """Write the styled scene and its picture. Print and return facts about them.

    Raises:
        StyleError: the style cannot be used. SceneError: the scene cannot. OutputError: OUT holds
            something, or cannot be written.
    """
    out = options.out
    check_scene_out(out, may_replace=options.overwrite)
    picture_file = picture_path(out)
    requested = _style(options)
    # Compile the kernel where it is not yet, so that times are of the work.
    eye = torch.eye(3, 4) / 2
    style_gaussians(Gaussians.empty(), StyleMaps(eye[None], eye, eye))
    start_s = time.perf_counter()
    scene = open_scene(options.scene)
    for problem in scene.problems:
        print_note(f"note: {problem}")
    scene = prepare_for_storage(scene)
    open_s = time.perf_counter()
    if requested.has_effect and requested.method == "gscm":
        content_pictures(scene)
    elif requested.has_effect:
        content_statistics(scene, per_region=requested.per_region)
    measure_s = time.perf_counter()
    maps = style_maps(scene, requested)
    map_s = time.perf_counter()

    styled = style_scene(scene, maps)
    facts: dict[str, Any] = {
        "scene": scene.source,
        "out": str(out),
        "style": _style_facts(requested),
        "maps": _map_facts(maps),
        "clamped": _clamp_facts(scene, styled, maps),
        "seconds": {
            "open": open_s - start_s,
            "content": measure_s - open_s,
            "image to map": map_s - measure_s,
        },
        "apply": _apply_facts(scene, maps),
    }
    style_facts = {**facts["style"], "scene": scene.source, "maps": facts["maps"]}
    made_by = {**scene.made_by, "styles": [*scene.made_by.get("styles", ()), style_facts]}
    start_s = time.perf_counter()
    save_scene(dataclasses.replace(styled, made_by=made_by), out.absolute())
    facts["seconds"]["write"] = time.perf_counter() - start_s
    if (picture := _picture(scene, styled)) is not None:
        facts["picture"] = str(picture_file)
        write_rgb(picture_file, picture, jpeg_quality=88)
    print(style_text(facts))
    return facts


def picture_path(out: Path) -> Path:
    """Return the path of a styled scene's picture, beside the scene's folder."""
    return path_beside(out, ".style.jpg")


def style_text(facts: Mapping[str, Any]) -> str:
    """Return the facts of a styling as text."""
    return fill("style.txt", **facts)


def _style(options: ApplyOptions) -> Style:
    """Return the style of an image file, or of a preset (a file of that name is ./NAME)."""
    source = options.style
    is_preset = source in style_preset_names()
    if not is_preset and not Path(source).exists() and not Path(source).suffix:
        raise StyleError(f"{source} is no image file, and {STYLES.refusal(source)}")
    how = options.model_dump(
        mode="json", include={"method", "strength", "per_region", "mask", "checkpoint"}
    )
    try:
        return Style(**{"preset" if is_preset else "image": source}, **how)
    except ValidationError as error:
        raise StyleError(f"the style cannot be used: {'; '.join(readable(error))}") from None


def _style_facts(style: Style) -> dict[str, Any]:
    """Return facts of a style to store with the scene: files by name and digest, not by path."""
    facts = {
        name: value
        for name, value in style.model_dump(exclude={"applied_to", "evaluated", "digest"}).items()
        if value is not None
    }
    for name in ("image", "mask", "checkpoint"):
        if name in facts:
            path = Path(facts[name])
            content = path.read_bytes() if style.has_effect else b""
            facts[name] = {"name": path.name, "sha256": hashlib.sha256(content).hexdigest()}
    return facts


def _map_facts(maps: StyleMaps) -> dict[str, Any]:
    """Return the facts of every map that no earlier one equals, by the map's purpose."""
    map_by_name = {"splats": maps.splats[0]}
    if len(maps.splats) > 1:
        map_by_name = {
            SemanticClass(n).name.lower(): style_map for n, style_map in enumerate(maps.splats)
        }
    map_by_name["sky"] = maps.sky
    facts = {}
    unique_maps = []
    for name, style_map in map_by_name.items():
        if name != "sky" and any(torch.equal(style_map, other_map) for other_map in unique_maps):
            continue
        unique_maps.append(style_map)
        gains = torch.linalg.svdvals(style_map[:, :3].double())
        facts[name] = {
            "map": [[float(value) for value in row] for row in style_map],
            "gains": [float(gain) for gain in gains],
            "condition": float(gains[0] / gains[-1].clamp_min(1e-12)),
        }
    return facts


def _clamp_facts(scene: Scene, styled: Scene, maps: StyleMaps) -> dict[str, Any]:
    """Shares of what leaves [0, 1], before and after: below 0 renderers clamp each Gaussian, which
    a map does not commute with; above 1 the finished picture is clipped.
    """
    facts: dict[str, Any] = {"Gaussians": _outside([_constant_colors(s) for s in (scene, styled)])}
    pictures = [_render(s, camera) for s in (scene, styled) for camera in _views(scene)]
    if not pictures:
        return facts
    half = len(pictures) // 2
    pictures_before = pictures[:half]
    pictures_after = pictures[half:]
    groups = (pictures_before, pictures_after)
    facts["pixels"] = _outside([torch.cat([p.reshape(-1, 3) for p in group]) for group in groups])
    style_parts = SceneStyle(maps, styled.sky, scene, sky_levels(scene, maps))
    errors = [
        (_render(scene, camera, style_parts) - picture).abs().amax(-1).flatten()
        for camera, picture in zip(_views(scene), pictures_after, strict=True)
    ]
    is_visible = torch.cat(errors) > VISIBLE
    facts["pixels off a render under the style"] = float(is_visible.float().mean())
    return facts


def _outside(pair: list[torch.Tensor]) -> dict[str, list[float]]:
    slack = 1e-5  # rounding of a black or a white one
    return {
        "below 0": [float((rgb.amin(-1) < -slack).float().mean()) for rgb in pair],
        "above 1": [float((rgb.amax(-1) > 1 + slack).float().mean()) for rgb in pair],
    }


def _constant_colors(scene: Scene) -> torch.Tensor:
    return torch.cat([0.5 + SH_C0 * part.sh[:, 0] for part in scene.all_gaussians])


def _views(scene: Scene) -> list[Camera]:
    cameras = select_views(scene, None, VIEWS)
    return [camera.scaled(min(1.0, VIEW_WIDTH / camera.width)) for camera in cameras]


def _render(scene: Scene, camera: Camera, style_parts: SceneStyle | None = None) -> torch.Tensor:
    """Return the picture with its sky, not clamped. style_parts: the style; None for none."""
    parts = scene.parts_for(camera)
    sky = scene.sky
    if style_parts is not None:
        parts = style_parts.map_parts(parts)
        sky = style_parts.sky
    raster = rasterize(parts, camera)
    assert raster.rgb is not None and raster.alpha is not None
    return composite_sky(raster.rgb, raster.alpha, camera, sky)


def _apply_facts(scene: Scene, maps: StyleMaps) -> dict[str, Any]:
    """Return the time of the mapping alone, over all Gaussians: the least of three."""
    parts = [dataclasses.replace(part, sh=part.sh.clone()) for part in scene.all_gaussians]
    traffic = 2 * sum(part.sh.numel() * part.sh.element_size() for part in parts)
    seconds = {}
    for is_in_place in (False, True):
        runs = []
        for _ in range(3):
            start_s = time.perf_counter()
            for part in parts:
                style_gaussians(part, maps, out=part.sh if is_in_place else None)
            runs.append(time.perf_counter() - start_s)
        seconds[is_in_place] = min(runs)
    return {
        "gaussians": sum(map(len, parts)),
        "bytes": traffic,
        "in_place_s": seconds[True],
        "in_place_gbps": traffic / max(seconds[True], 1e-9) / 1e9,
        "new_memory_s": seconds[False],
    }


def _picture(scene: Scene, styled: Scene) -> np.ndarray | None:
    """Draw views before and after, a row each, RGB uint8; None for a scene without cameras."""
    rows = []
    for camera in _views(scene):
        panels = [
            captioned(to_byte_array(_render(panel_scene, camera)), title, camera.name)
            for panel_scene, title in ((scene, "before"), (styled, "after"))
        ]
        rows.append(strip(panels))
    if not rows:
        return None
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    return np.concatenate(rows)
