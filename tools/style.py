"""`climategs style apply`: a scene in the colours of a photograph or a preset, as a scene folder;
`style train`: photographs and scenes become a network that maps colours.

Bytes depend on the data, the settings and the number of steps alone; times are only printed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from pydantic import ValidationError

from adapters.base import open_scene
from adapters.scene_folder import prepare_for_storage
from augment.effects.style.color_maps import StyleMaps, sky_levels, style_gaussians, style_scene
from augment.effects.style.content import content_pictures, content_statistics, select_views
from augment.effects.style.losses import FeatureExtractor, open_features
from augment.effects.style.network import B0Encoder, load_imagenet_weights, save_network
from augment.effects.style.style import SceneStyle, style_maps
from augment.effects.style.train import (
    SCORE_DEFINITIONS,
    Content,
    Draw,
    StepRecord,
    StyleTrainer,
    TrainingPool,
    generator_for,
    new_network,
    read_photos,
    scene_contents,
    score_photos,
    score_training,
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
from tools.options import StyleTrainOptions, uri_text
from tools.output import check_scene_out, fill, path_beside, print_note
from tools.pictures import captioned, strip, write_rgb
from tools.training import (
    CHECKPOINT_S,
    PLAN_FILE,
    REPORT_FILE,
    RESERVE,
    STYLE_PANELS,
    Checkpoint,
    Outcome,
    Training,
    open_training,
    rounded_steps,
    run_training,
    train,
    write_curves,
)

if TYPE_CHECKING:
    from tools.cli import ApplyOptions

# OUT of a training holds the network, the report and its curves; OUT/checkpoint what an unfinished
# one goes on from.
NETWORK_FILE = "network.safetensors"
CURVES_FILE = "curves.png"
ROWS = 40  # the number of rows of the history, roughly
ROW_STEPS = 50  # the number of steps that are averaged into one row, at most
SCORED = 16  # contents with a style each, by which a network is scored
TIMED = 8  # the number of steps that are timed, to estimate how many fit the time
UNTIMED = 2  # the number of steps before them that are not timed


def train_style(
    options: StyleTrainOptions, *, progress: bool = True, checkpoint_s: float = CHECKPOINT_S
) -> Outcome:
    """Train a network into `options.out`, or go on with a training there.

    Raises:
        ClimateGSError: options, data or the output folder cannot be used as they are.
    """
    out = options.out
    folder = checkpoint_folder(options.out)
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out} is a file: choose another --out")
    network = out / NETWORK_FILE
    if not (options.overwrite or (folder / PLAN_FILE).is_file()) and network.exists():
        raise OutputError(
            f"{out} holds a network, and no checkpoint to go on from: choose another --out, or "
            f"replace it with --overwrite"
        )
    return train(
        options,
        folder,
        out,
        report=out / REPORT_FILE,
        stands=network.is_file,
        show=lambda report: _show_end(out, report),
        prepare=lambda before: _prepare(options, folder, before),
        run=lambda run: _train(run, progress, checkpoint_s),
    )


def checkpoint_folder(out: Path) -> Path:
    """Return the folder of the checkpoint from which a training in `out` goes on."""
    return out / "checkpoint"


class _Data(NamedTuple):
    """Pictures of a training. scored: by which networks are scored. held_out: photos."""

    pool: TrainingPool
    scored: Draw
    held_out: torch.Tensor
    facts: dict[str, Any]
    problems: tuple[str, ...]


class _Run(NamedTuple):
    """All that a training needs, opened and at the step to go on from."""

    training: Training
    features: FeatureExtractor
    data: _Data


def _prepare(options: StyleTrainOptions, folder: Path, before: Checkpoint | None) -> _Run:
    _check_device(options.device)
    data = _open_data(options)
    for problem in data.problems:
        print_note(f"note: {problem}")
    views = len(data.pool.views)
    photos = len(data.pool.photos)
    print_note(f"{photos} photos and {views} views of {len(options.scenes)} scenes to learn from")
    features = open_features(options.vgg)
    training = open_training(
        options,
        folder,
        before,
        data.facts,
        trainer=lambda steps: _trainer(options, steps, data.pool, features),
        estimate=lambda budget_s: _estimate(options, budget_s, data.pool, features),
        result="network",
        changed=f"the photos or scenes are not those {options.out} was trained on so far",
    )
    return _Run(training, features, data)


def _check_device(device: str) -> None:
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:  # of torch without CUDA
        reason = str(error).splitlines()[0]
        raise ClimateGSError(f"--device {device}: {reason}; train on cpu, or cuda") from error


def _open_data(options: StyleTrainOptions) -> _Data:
    size_px = options.settings()["size_px"]
    device = options.device
    views: list[Content] = []
    problems: list[str] = []
    for uri in options.scenes:
        scene = open_scene(uri)
        views += scene_contents(scene, options.views, size_px, seed=options.seed, device=device)
        problems += scene.problems
    photos = read_photos(options.photos, size_px, holdout=options.holdout)
    facts = {
        "views": len(views),
        "views_sha256": _digest(view.picture for view in views),
        "photos": len(photos.train),
        "photos_sha256": _digest([photos.train]),
        "held_out_photos": len(photos.held_out),
        "held_out_sha256": _digest([photos.held_out]),
    }
    pool = TrainingPool(views, photos.train.to(device))
    # Networks are scored by held-out photos where there are any, and the scenes' views.
    held_out = photos.held_out.to(device)
    scored_pool = TrainingPool(views, held_out) if len(held_out) else pool
    # Whatever the seed: trainings are compared by them.
    scored = scored_pool.draw(generator_for(0, 0, "scores"), SCORED)
    return _Data(pool, scored, photos.held_out, facts, (*problems, *photos.problems))


def _digest(pictures: Iterable[torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for picture in pictures:
        digest.update(picture.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _trainer(
    options: StyleTrainOptions, steps: int, pool: TrainingPool, features: FeatureExtractor
) -> StyleTrainer:
    net = new_network(options.encoder, seed=options.seed)
    if options.encoder_weights is not None:
        assert isinstance(net.encoder, B0Encoder)
        load_imagenet_weights(net.encoder, options.encoder_weights)
    weights = {name: getattr(options, name) for name in ("style", "consistency", "cycle", "pairs")}
    return StyleTrainer(
        net,
        pool,
        features,
        steps=steps,
        seed=options.seed,
        learning_rate=options.settings()["learning_rate"],
        weights={**weights, "range": options.pair_range},
        batch=options.batch,
        pair_batch=options.pair_batch,
        frozen_norm=options.encoder_weights is not None,
    )


def _estimate(
    options: StyleTrainOptions, budget_s: float, pool: TrainingPool, features: FeatureExtractor
) -> tuple[int, float]:
    """Estimate the steps that fill the time, and the seconds of one with all losses, by a trainer
    that is thrown away.
    """
    trainer = _trainer(options, 1000, pool, features)
    trainer.step = 500  # beyond the warm-up
    seconds: list[float] = []
    for _ in range(UNTIMED + TIMED):
        start_s = time.perf_counter()
        trainer.run_step()
        seconds.append(time.perf_counter() - start_s)
    step_s = sorted(seconds[UNTIMED:])[TIMED // 2]
    return rounded_steps(int(budget_s * (1 - RESERVE) / step_s)), step_s


def _train(run: _Run, progress: bool, checkpoint_s: float) -> Outcome:
    training = run.training
    steps = training.plan.steps
    row_steps = min(max(steps // ROWS, 1), ROW_STEPS)

    def add(record: StepRecord) -> None:
        training.add({"steps": 1.0, "loss": record.loss})
        for name, value in record.terms.items():  # of a part of the steps, where the warm-up ends
            training.add({f"sum.{name}": value, f"count.{name}": 1})
        if record.step % row_steps == 0 or record.step == steps:
            sums = training.sums
            training.sums = {}
            names = [name.removeprefix("sum.") for name in sums if name.startswith("sum.")]
            terms = {name: sums[f"sum.{name}"] / sums[f"count.{name}"] for name in names}
            training.add_row(loss=sums["loss"] / sums["steps"], **terms)

    def postfix(_: StepRecord) -> dict[str, str]:
        sums = training.sums
        return {"loss": f"{sums['loss'] / sums['steps']:.4f}"} if sums else {}

    return run_training(
        training,
        "train",
        add=add,
        score=lambda: training.add_row(**_scores(run)),
        postfix=postfix,
        write=lambda complete: _write(run, complete),
        checkpoint_s=checkpoint_s,
        progress=progress,
    )


def _scores(run: _Run) -> dict[str, Any]:
    """Return the scores of the network as it is now."""
    return score_training(run.training.trainer.net, run.data.scored, run.features)


def _write(run: _Run, complete: bool) -> dict[str, Any]:
    training = run.training
    options = training.options
    plan = training.plan
    net = training.trainer.net
    about = {
        "command": "style train",
        "step": training.trainer.step,
        "steps": plan.steps,
        "features": run.features.name,
        "settings": plan.settings,
        "data": plan.data,
    }
    save_network(options.out / NETWORK_FILE, net, about)
    report = {
        **about,
        "complete": complete,
        "network": NETWORK_FILE,
        "parameters": sum(parameter.numel() for parameter in net.parameters()),
        "seconds": training.seconds(),
        "scenes": [uri_text(uri) for uri in options.scenes],
        "problems": list(run.data.problems),
        "definitions": SCORE_DEFINITIONS,
        "scores": _scores(run) | score_photos(net, run.data.held_out),
        "history": training.rows,
    }
    write_atomic(options.out / REPORT_FILE, (json.dumps(report, indent=1) + "\n").encode())
    write_curves(options.out / CURVES_FILE, training.rows, STYLE_PANELS)
    if complete:
        _show_end(options.out, report)
    return report


def _show_end(out: Path, report: dict[str, Any]) -> None:
    numbers = {n: v for n, v in report["scores"].items() if isinstance(v, int | float)}
    print(", ".join(f"{name} {v:.4g}" for name, v in numbers.items() if math.isfinite(v)))
    if (out / CURVES_FILE).is_file():
        print(f"curves: {out / CURVES_FILE}")
    print(f"network: {out / NETWORK_FILE}")


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
