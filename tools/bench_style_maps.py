"""How long it takes from a style image's file to the map, and what the scene's side takes once."""

from __future__ import annotations

import dataclasses
import importlib.util
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from augment.effects.style.content import content_pictures, content_statistics
from augment.effects.style.images import image_statistics, read_style_image
from augment.effects.style.network import Gscm, gscm_map
from augment.effects.style.statistics import closed_maps
from augment.effects.style.train import SUFFIXES
from augment.plan import make_plan
from augment.render.composite import quantise
from augment.scene import Scene
from augment.views import render_buffers
from recipes.schema import Recipe
from tools.bench_flood_error import PICTURE_ONLY
from tools.bench_pairs import spread_ms
from tools.bench_style_cost import front_camera
from tools.bench_style_network import random_network
from tools.drawing import write_jpeg

DRAWN_WIDTH = 1920  # of the picture that stands for a photo where none is given


def bench_maps(
    scene: Scene, net: Gscm, photos: Sequence[Path], *, b0: bool, repeats: int
) -> dict[str, Any]:
    """Milliseconds of each method, reading apart, and of the scene's statistics and pictures.

    photos: the first image is the style; of none, a picture of the scene in another light.
    b0: also with EfficientNet-B0, of random weights, where its library is installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = _first_photo(photos) or _drawn(scene, Path(folder) / "style.jpg")
        image = read_style_image(path)
        found: dict[str, Any] = {
            "image": f"JPEG of {path.stat().st_size / 1000:.0f} kB, read as "
            f"{image.rgb.shape[1]}x{image.rgb.shape[0]}",
            "read_ms": _timed(lambda: read_style_image(path), repeats),
        }
    content = content_statistics(scene, per_region=True)
    pictures = content_pictures(scene)
    fresh = lambda: dataclasses.replace(scene)  # noqa: E731 - statistics are remembered by scene
    found["scene_ms"] = {
        "statistics": _timed(lambda: content_statistics(fresh(), per_region=False), repeats),
        "statistics of regions": _timed(
            lambda: content_statistics(fresh(), per_region=True), repeats
        ),
        "pictures for a network": _timed(lambda: content_pictures(fresh()), repeats),
    }

    def closed(method: Any, per_region: bool) -> None:
        style = image_statistics(image)
        closed_maps(content, style, method=method, strength=1.0, per_region=per_region)

    methods: dict[str, Callable[[], object]] = {
        "mkl": lambda: closed("mkl", False),
        "mkl, per region": lambda: closed("mkl", True),
        "reinhard": lambda: closed("reinhard", False),
        **_network_calls("gscm, small" if net.encoder_name == "small" else "gscm", net, pictures),
    }
    if b0 and importlib.util.find_spec("monai") is not None:
        methods |= _network_calls("gscm, b0", random_network("b0"), pictures)
    found["map_ms"] = {name: _timed(call, repeats) for name, call in methods.items()}
    return found


def _network_calls(name: str, net: Gscm, pictures: torch.Tensor) -> dict[str, Callable[[], object]]:
    """The style picture's part alone, whose other part a scene could keep, and all of it."""
    style = pictures[:1].flip(3)

    def alone() -> None:
        threads = torch.get_num_threads()
        try:
            torch.set_num_threads(1)  # as gscm_map does
            with torch.no_grad():
                net.style_map(net.encode(style)[1])
        finally:
            torch.set_num_threads(threads)

    return {
        f"{name}, style picture alone": alone,
        f"{name}, and {len(pictures)} of the scene": lambda: gscm_map(net, pictures, style),
    }


def _timed(call: Callable[[], object], repeats: int) -> dict[str, float]:
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return spread_ms(seconds[1:])


def _first_photo(photos: Sequence[Path]) -> Path | None:
    for path in photos:
        if path.is_file():
            return path
        files = sorted(p for p in path.rglob("*") if p.suffix.lower() in SUFFIXES)
        if files:
            return files[0]
    return None


def _drawn(scene: Scene, path: Path) -> Path:
    camera = front_camera(scene, DRAWN_WIDTH)
    rgb = render_buffers(scene, camera, make_plan(Recipe(output=PICTURE_ONLY), scene)).rgb
    write_jpeg(path, quantise(rgb * torch.tensor([1.0, 0.8, 0.6])))
    return path
