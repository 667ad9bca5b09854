"""Styles: their cost in a frame, errors of maps folded into SH, and scores on photographs."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from adapters.base import open_scene
from augment.effects.style.color_maps import NUM_CLASSES, StyleMaps, style_gaussians
from augment.effects.style.content import content_pictures, content_statistics
from augment.effects.style.images import image_statistics, read_style_image
from augment.effects.style.network import gscm_map, load_network, network_facts
from augment.effects.style.pairs import (
    Method,
    closed_form_method,
    mapped_picture,
    network_method,
    score_pairs,
)
from augment.effects.style.statistics import closed_maps, reinhard_map
from augment.effects.style.train import read_photos
from augment.metrics.image import psnr
from augment.render.composite import to_byte_array
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from recipes.schema import Recipe
from recipes.style import style_preset_names
from tools.bench.harness import Action, Table, median_ms, rounds
from tools.bench.scenes import (
    CLEAN,
    EffectCase,
    RasterCase,
    cost_tables,
    frame_of,
    front_camera,
    random_scene,
    recipe_of,
)

PHOTO_PX = 256  # The side of the squares of photographs, pixels.
HOLDOUT = 8  # Every so many photographs one is scored, if the network's record names none.
PAIRS = 60  # The number of pairs of photographs that are checked for oversaturation.
# The share of further saturated pixels above which a picture is oversaturated.
OVERSATURATED = 0.2
SATURATED = 254.5 / 255  # The least channel of a saturated pixel: it is displayed as full.


def style_recipe(preset: str = "overcast", **other_fields: Any) -> Recipe:
    """Return a recipe of a style. other_fields: further fields of the style."""
    return recipe_of({"style": {"preset": preset, **other_fields}})


def tables(case: EffectCase, repeats: int) -> list[Table]:
    """Measure costs of styles, errors of folded maps, the time to a map, and scores."""
    costs = {
        "one map": (style_recipe(), CLEAN),
        "a map a region": (style_recipe(per_region=True), CLEAN),  # a preset's are the same
        "on the picture": (style_recipe(applied_to="picture"), CLEAN),
        "one map, folded into SH": (style_recipe(evaluated="sh"), CLEAN),
    }
    return [
        _fold_table(RasterCase(case.splats, 640, 480), repeats),
        *cost_tables(case, costs, ("one map",), repeats),
        *(_folded_error_table(uri, case) for uri in case.scenes),
        _map_table(open_scene(case.street), repeats),
        *([] if case.photos is None else [_score_table(case.photos)]),
    ]


def fold(
    gaussians: Gaussians, count: int, out: torch.Tensor | None, backend: str = "auto"
) -> Action:
    """Return an action that folds colour maps into SH. Colours stay finite however often it runs.

    Args:
        gaussians: The Gaussians.
        count: The number of maps: 1, or one for each class.
        out: The tensor that receives the mapped SH; None for a new one.
        backend: The backend.
    """
    map_34 = 0.9 * torch.eye(3, 4)
    maps = StyleMaps(map_34.repeat(count, 1, 1), map_34, map_34)
    return functools.partial(style_gaussians, gaussians, maps, out=out, backend=backend)


def _fold_table(case: RasterCase, repeats: int) -> Table:
    """Measure folds of one map, and of one map for each class, into the SH of random Gaussians."""
    gaussians, _ = random_scene(case)
    classes = torch.arange(len(gaussians), dtype=torch.int16) % (max(SemanticClass) + 1)
    gaussians = dataclasses.replace(gaussians, semantic=classes)
    num_bytes = 2 * gaussians.sh.nbytes
    actions = {
        f"{name}, {where}": fold(gaussians, count, out)
        for name, count in (("one map", 1), ("a map a class", NUM_CLASSES))
        for where, out in (("in place", gaussians.sh), ("new memory", None))
    }
    rows = [
        [name, median_ms(times), min(times) * 1e3, num_bytes / min(times) / 1e9]
        for name, times in rounds(actions, repeats).items()
    ]
    title = (
        f"Maps folded into {len(gaussians):,} Gaussians, {num_bytes / 1e6:.0f} MB read and written"
    )
    return Table(title, ("map", "ms", "least", "GB/s at best"), rows)


def _folded_error_table(uri: str, case: EffectCase) -> Table:
    """Compare pictures of maps folded into SH with pictures of mapped colours.

    They differ where a splat with a colour below 0 is blended. Without folding, its colour is
    clamped before the map.
    """
    scene = open_scene(uri)
    camera = front_camera(scene, case.width)
    rows = []
    for preset in case.presets or style_preset_names():
        recipes = (style_recipe(preset, evaluated=where) for where in ("sh", "color"))
        folded, mapped = (frame_of(scene, camera, r)().rgb.numpy() for r in recipes)
        off = 255 * np.abs(folded - mapped).max(-1)
        psnr_db = psnr(folded.clip(0, 1), mapped.clip(0, 1)) if off.any() else None
        rows.append([preset, psnr_db, float(off.max()), 100 * float((off > 1).mean())])
    columns = ("preset", "PSNR dB", "largest", "off by > 1/255, %")
    return Table(f"Maps folded into SH against mapped colours, 1/255: {uri}", columns, rows)


def _map_table(scene: Scene, repeats: int) -> Table:
    """Measure the time from a style image's file to its map, and the statistics of a scene."""
    net = load_network(None)
    rgb = frame_of(scene, front_camera(scene, 1920), CLEAN)().rgb
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "style.jpg"
        cv2.imwrite(str(path), to_byte_array(rgb * torch.tensor([1.0, 0.8, 0.6]))[..., ::-1])
        image = read_style_image(path)
        reading = rounds({"reading the image": lambda: read_style_image(path)}, repeats)
    content = content_statistics(scene, per_region=True)
    pictures = content_pictures(scene)

    def closed(method: Any, per_region: bool = False) -> object:
        style = image_statistics(image)
        return closed_maps(content, style, method=method, strength=1.0, per_region=per_region)

    def once(find: Callable[..., object], **options: bool) -> object:
        return find(
            dataclasses.replace(scene), **options
        )  # A copy of the scene has no cached statistics.

    actions: dict[str, Action] = {
        "mkl": lambda: closed("mkl"),
        "mkl, per region": lambda: closed("mkl", per_region=True),
        "reinhard": lambda: closed("reinhard"),
        f"gscm, with {len(pictures)} pictures of the scene": lambda: gscm_map(
            net, pictures, pictures[:1].flip(3)
        ),
        "once a scene: statistics": lambda: once(content_statistics, per_region=False),
        "once a scene: of regions": lambda: once(content_statistics, per_region=True),
        "once a scene: pictures": lambda: once(content_pictures),
    }
    seconds = reading | rounds(actions, repeats)
    rows = [[name, median_ms(times), 1e3 * min(times)] for name, times in seconds.items()]
    return Table("From a style image to its map", ("what", "ms", "least"), rows)


def _score_table(photos: Path) -> Table:
    """Score methods on photographs that the network was not trained on."""
    about = network_facts().get("about") or {}
    names = tuple(f"/{name}" for name in about.get("data", {}).get("held_out", ()))
    held_out = [file for file in sorted(photos.rglob("*")) if file.as_posix().endswith(names)]
    squares = (
        read_photos(held_out, PHOTO_PX, holdout=0).train
        if held_out
        else read_photos([photos], PHOTO_PX, holdout=HOLDOUT).held_out
    )
    pictures = squares.float() / 255
    methods = {
        "none": closed_form_method(strength=0.0),
        "reinhard": closed_form_method(reinhard_map),
        "mkl": closed_form_method(),
        "mkl, half": closed_form_method(strength=0.5),
        "gscm": network_method(load_network(None)),
    }
    rows = []
    for name, method in methods.items():
        scores = score_pairs(method, pictures, repeats=1)
        rows.append([name, *scores.values(), _oversaturated_share(method, pictures)])
    columns = ("method", "same", "half", "below", "look", "oversaturated")
    return Table(f"Methods on {len(pictures)} photos that are held out, PSNR in dB", columns, rows)


def _oversaturated_share(method: Method, photos: torch.Tensor) -> float:
    """Return the share of oversaturated pictures among PAIRS pairs of different photos.

    A picture is oversaturated if more of its pixels have a full channel than in content and style,
    by OVERSATURATED of all pixels.
    """

    def saturated(color_map: torch.Tensor, photo: torch.Tensor) -> float:
        return float((mapped_picture(color_map, photo) > SATURATED).any(0).float().mean())

    photo_pairs = list(itertools.permutations(photos, 2))
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(len(photo_pairs), generator=generator)[:PAIRS].tolist()
    eye = torch.eye(3, 4)
    beyond = []
    for content, style in (photo_pairs[index] for index in chosen):
        before = max(saturated(eye, photo) for photo in (content, style))
        beyond.append(saturated(method(content, style), content) - before)
    return float(np.mean(np.array(beyond) > OVERSATURATED))
