"""`climategs style apply`: a scene in the colours of a photograph or a preset, as a scene folder.

OUT is the scene, OUT.style.jpg beside it shows views before and after. The scene's bytes depend on
the scene and the style alone; times are only printed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import ValidationError

from adapters.base import open_scene
from adapters.scene_folder import storable
from augment.cameras import Camera
from augment.effects.style.color_maps import StyleMaps, sky_levels, style_gaussians, styled_scene
from augment.effects.style.content import content_pictures, content_statistics, select_views
from augment.effects.style.style import SceneStyle, style_maps
from augment.errors import OutputError, StyleError
from augment.files.scene_file import is_scene_folder, save_scene
from augment.render.composite import composite_sky, quantise
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass
from recipes.weather import Style, no_such_style, style_preset_names
from tools.drawing import captioned, strip
from tools.output import print_note
from tools.sheet import write_rgb

Method = Literal["mkl", "reinhard", "gscm"]
VIEWS = 2  # that are drawn and measured
VIEW_WIDTH = 640  # px
VISIBLE = 1 / 255  # a difference of colour


def apply_style(
    scene_uri: str,
    style: str,
    out: Path,
    *,
    method: Method = "mkl",
    strength: float = 1.0,
    per_region: bool = False,
    mask: Path | None = None,
    checkpoint: Path | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Writes the styled scene and its picture, prints what was done, and returns it as facts.

    style: an image file, or the name of a style preset (a file of the same name is ./NAME).

    Raises:
        StyleError: the style cannot be used. SceneError: the scene cannot. OutputError: OUT holds
            something, or cannot be written.
    """
    out = Path(out)
    _check_out(out, overwrite)
    requested = _style(style, method, strength, per_region, mask, checkpoint)
    # Compile the kernel where it is not yet, so that times are of the work.
    eye = torch.eye(3, 4) / 2
    style_gaussians(Gaussians.empty(), StyleMaps(eye[None], eye, eye))
    begun = time.perf_counter()
    scene = open_scene(scene_uri)
    for problem in scene.problems:
        print_note(f"note: {problem}")
    scene = storable(scene)
    opened = time.perf_counter()
    if requested.changes and method == "gscm":
        content_pictures(scene)
    elif requested.changes:
        content_statistics(scene, per_region=per_region)
    measured = time.perf_counter()
    maps = style_maps(scene, requested)
    mapped = time.perf_counter()

    styled = styled_scene(scene, maps)
    facts: dict[str, Any] = {
        "scene": scene.source,
        "out": str(out),
        "style": _style_facts(requested),
        "maps": _map_facts(maps),
        "clamped": _clamp_facts(scene, styled, maps),
        "seconds": {
            "open": opened - begun,
            "content": measured - opened,
            "image to map": mapped - measured,
        },
        "apply": _apply_facts(scene, maps),
    }
    done = {**facts["style"], "scene": scene.source, "maps": facts["maps"]}
    made_by = {**scene.made_by, "styles": [*scene.made_by.get("styles", ()), done]}
    begun = time.perf_counter()
    save_scene(dataclasses.replace(styled, made_by=made_by), out.absolute())
    facts["seconds"]["write"] = time.perf_counter() - begun
    if (picture := _picture(scene, styled)) is not None:
        facts["picture"] = str(picture_path(out))
        write_rgb(picture_path(out), picture, jpeg_quality=88)
    print(style_text(facts))
    return facts


def picture_path(out: Path) -> Path:
    """Where the picture of a styled scene lies: beside its folder."""
    folder = Path(out).resolve()
    return folder.with_name(f"{folder.name}.style.jpg")


def style_text(facts: Mapping[str, Any]) -> str:
    """The facts for people."""
    lines = []
    for name, one in facts["maps"].items():
        rows = "   ".join(" ".join(f"{value:7.3f}" for value in row) for row in one["map"])
        gains = ", ".join(f"{value:.2f}" for value in one["gains"])
        lines.append(f"{name:8}  {rows}")
        lines.append(f"          gains {gains}; condition {one['condition']:.1f}")
    clamped = facts["clamped"]
    for what in ("Gaussians", "pixels"):
        if what in clamped:
            below, above = clamped[what]["below 0"], clamped[what]["above 1"]
            lines.append(
                f"{what:9} with a colour below 0: {_percent(below)}; above 1: {_percent(above)}"
            )
    if (off := clamped.get("pixels off a render under the style")) is not None:
        lines.append(
            f"pixels where that makes more than 1/255 of difference to rendering the scene under "
            f"the style: {100 * off:.2f} %"
        )
    seconds, applied = facts["seconds"], facts["apply"]
    lines.append(
        f"scene colours {1e3 * seconds['content']:.0f} ms, image to map "
        f"{1e3 * seconds['image to map']:.0f} ms; {applied['gaussians']} Gaussians mapped in "
        f"{1e3 * applied['in_place_s']:.1f} ms ({applied['in_place_gbps']:.1f} GB/s) in place, "
        f"{1e3 * applied['new_memory_s']:.1f} ms into new memory; written in "
        f"{seconds['write']:.1f} s"
    )
    if "picture" in facts:
        lines.append(f"picture: {facts['picture']}")
    lines.append(f"scene: {facts['out']}")
    lines.append(
        f"render it: climategs render clear --scene 'scene:{facts['out']}' --out out/styled"
    )
    return "\n".join(lines)


def _percent(change: list[float]) -> str:
    return f"{100 * change[0]:.2f} % before, {100 * change[1]:.2f} % after"


def _style(
    style: str,
    method: Method,
    strength: float,
    per_region: bool,
    mask: Path | None,
    checkpoint: Path | None,
) -> Style:
    is_preset = style in style_preset_names()
    if not is_preset and not Path(style).exists() and not Path(style).suffix:
        raise StyleError(f"{style} is no image file, and {no_such_style(style)}")
    try:
        return Style(
            image=None if is_preset else style,
            preset=style if is_preset else None,
            method=method,
            strength=float(strength),
            per_region=per_region,
            mask=None if mask is None else str(mask),
            checkpoint=None if checkpoint is None else str(checkpoint),
        )
    except ValidationError as error:
        message = "; ".join(
            f"{'.'.join(map(str, e['loc'])) + ': ' if e['loc'] else ''}"
            f"{e['msg'].removeprefix('Value error, ')}"
            for e in error.errors()
        )
        raise StyleError(f"the style cannot be used: {message}") from None


def _check_out(out: Path, overwrite: bool) -> None:
    """What is at OUT is nothing, or a scene that may be replaced; known before anything is done."""
    if not out.resolve().name:
        raise OutputError(f"--out {out} is the file system's root: name a folder below it")
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not is_scene_folder(out):
        raise OutputError(f"{out} holds something else than a scene: choose another --out")
    if not overwrite:
        raise OutputError(
            f"{out} holds a scene: choose another --out, or replace it with --overwrite"
        )


def _style_facts(style: Style) -> dict[str, Any]:
    """What is kept with the scene: names and contents of files, not where they lay."""
    facts = {
        name: value
        for name, value in style.model_dump(exclude={"applied_to", "evaluated", "digest"}).items()
        if value is not None
    }
    for name in ("image", "mask", "checkpoint"):
        if name in facts:
            path = Path(facts[name])
            content = path.read_bytes() if style.changes else b""
            facts[name] = {"name": path.name, "sha256": hashlib.sha256(content).hexdigest()}
    return facts


def _map_facts(maps: StyleMaps) -> dict[str, Any]:
    """Every map that is one of its own, by what it is for."""
    named = {"splats": maps.splats[0]}
    if len(maps.splats) > 1:
        named = {SemanticClass(n).name.lower(): one for n, one in enumerate(maps.splats)}
    named["sky"] = maps.sky
    facts, seen = {}, []
    for name, one in named.items():
        if name != "sky" and any(torch.equal(one, other) for other in seen):
            continue
        seen.append(one)
        gains = torch.linalg.svdvals(one[:, :3].double())
        facts[name] = {
            "map": [[float(value) for value in row] for row in one],
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
    before, after = pictures[:half], pictures[half:]
    facts["pixels"] = _outside(
        [torch.cat([p.reshape(-1, 3) for p in group]) for group in (before, after)]
    )
    style_parts = SceneStyle(maps, styled.sky, scene, sky_levels(scene, maps))
    errors = [
        (_render(scene, camera, style_parts) - new).abs().amax(-1).flatten()
        for camera, new in zip(_views(scene), after, strict=True)
    ]
    off = torch.cat(errors) > VISIBLE
    facts["pixels off a render under the style"] = float(off.float().mean())
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
    """The picture with its sky, not clamped. style_parts: a style to render it under."""
    parts, sky = scene.parts_for(camera), scene.sky
    if style_parts is not None:
        parts, sky = style_parts.on(parts), style_parts.sky
    seen = rasterize(parts, camera)
    assert seen.rgb is not None and seen.alpha is not None
    return composite_sky(seen.rgb, seen.alpha, camera, sky)


def _apply_facts(scene: Scene, maps: StyleMaps) -> dict[str, Any]:
    """Time of the mapping alone, over all Gaussians, least of three."""
    parts = [dataclasses.replace(part, sh=part.sh.clone()) for part in scene.all_gaussians]
    traffic = 2 * sum(part.sh.numel() * part.sh.element_size() for part in parts)
    seconds = {}
    for is_in_place in (False, True):
        runs = []
        for _ in range(3):
            begun = time.perf_counter()
            for part in parts:
                style_gaussians(part, maps, out=part.sh if is_in_place else None)
            runs.append(time.perf_counter() - begun)
        seconds[is_in_place] = min(runs)
    return {
        "gaussians": sum(map(len, parts)),
        "bytes": traffic,
        "in_place_s": seconds[True],
        "in_place_gbps": traffic / max(seconds[True], 1e-9) / 1e9,
        "new_memory_s": seconds[False],
    }


def _picture(scene: Scene, styled: Scene) -> np.ndarray | None:
    """uint8 RGB: a view a row, before and after; None of a scene without cameras."""
    rows = []
    for camera in _views(scene):
        panels = [
            captioned(quantise(_render(shown, camera)), title, camera.name)
            for shown, title in ((scene, "before"), (styled, "after"))
        ]
        rows.append(strip(panels))
    if not rows:
        return None
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    return np.concatenate(rows)
