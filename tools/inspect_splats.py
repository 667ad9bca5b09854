"""Facts of splat files for `climategs inspect`, and what other viewers would show wrongly."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch

from adapters.detect_format import detect_scheme
from adapters.gaussian_files import GaussianOptions, find_splat_files
from adapters.uri import parse_uri
from augment.files.formats import find_format
from augment.render.sh import SH_C0
from augment.scene.scene import Gaussians, Scene

_KNOWN_AXIS = re.compile(r"[+-][xyz]")
_LARGE_SHARE = 0.1  # length of a splat, in parts of the scene's, from which it is large
_VISIBLE_OPACITY = 0.05  # opacity from which a large splat is seen
_CUT_SHARE = 0.01  # share of colours beyond 0 to 1 from which it is told
_MAX_FILES = 8  # files that are described


def describe_splat_files(uri: str, scene: Scene) -> dict[str, Any]:
    """Return facts of a scene's splat files, and what other viewers would show wrongly.

    Args:
        uri: the scene's URI or path.
        scene: the opened scene.

    Returns:
        `files`, a dictionary for each file, and `elsewhere`, a sentence for each thing that others
        show wrongly; both are empty for scenes of other kinds.
    """
    scheme, path, query = parse_uri(uri)
    if (scheme or detect_scheme(Path(path))) != "gaussians":
        return {"files": [], "elsewhere": []}
    names = {name for name in GaussianOptions.model_fields if name in query}
    options = GaussianOptions.from_query("gaussians", {name: query[name] for name in names})
    paths = find_splat_files(Path(path), options)[:_MAX_FILES]
    files = [_describe_file(file, options) for file in paths]
    warnings = [warning for file in files for warning in file["warnings"]]
    return {"files": files, "elsewhere": [*dict.fromkeys(warnings), *_scene_warnings(scene)]}


def _describe_file(file: Path, options: GaussianOptions) -> dict[str, Any]:
    """Return the facts of one file."""
    splat_format = find_format(file)
    assert splat_format is not None  # the scene was read from it
    facts = splat_format.describe(file)
    warnings = list(facts.warnings)
    up = options.up or facts.up
    viewer_up = splat_format.viewer_up
    if viewer_up and _KNOWN_AXIS.fullmatch(up) and up != viewer_up:
        turn = "upside down" if up[1] == viewer_up[1] else "on its side"
        warnings.append(
            f"up is {up}: viewers that take {viewer_up} for up, as most do, show it {turn}"
        )
    return {
        "name": file.name,
        "format": splat_format.name,
        "version": facts.version,
        "writer": facts.writer,
        "bytes": file.stat().st_size,
        "up": facts.up,
        "viewer_up": viewer_up,
        "unit": facts.unit,
        "warnings": warnings,
    }


def _scene_warnings(scene: Scene) -> list[str]:
    """Return what other viewers show wrongly of a scene's Gaussians."""
    warnings = []
    distance_m = float(torch.as_tensor(scene.world_origin_m).double().norm())
    if distance_m > 0:
        warnings.append(
            f"coordinates lie {distance_m / 1000:.0f} km from zero: viewers that compute in floats "
            "show it tremble"
        )
    background = scene.background
    num_large = _count_large(background)
    if num_large:
        warnings.append(
            f"{num_large} splats are longer than a tenth of the scene: viewers that sort by "
            "centres show them jump in front of others"
        )
    rgb = 0.5 + SH_C0 * background.sh[:, 0]
    cut_share = float(((rgb < 0) | (rgb > 1)).any(1).double().mean())
    if cut_share > _CUT_SHARE:
        warnings.append(
            f"{cut_share:.0%} of the base colours lie beyond 0 to 1: viewers that pack colours "
            "into bytes cut them off"
        )
    return warnings


def _count_large(gaussians: Gaussians) -> int:
    """Return the number of visible splats that are longer than a tenth of the scene."""
    means = gaussians.means[:: len(gaussians) // 100_000 + 1].double()
    bounds = torch.quantile(means, torch.tensor([0.01, 0.99]).double(), dim=0)
    size = float((bounds[1] - bounds[0]).norm())
    is_large = 2 * gaussians.scales.amax(1) > _LARGE_SHARE * size
    return int((is_large & (gaussians.opacities > _VISIBLE_OPACITY)).sum())
