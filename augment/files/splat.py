"""Reads and writes Gaussians in .splat files: a row of 32-byte records."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from augment.errors import SceneError
from augment.files.splat_format import (
    Loss,
    SplatFile,
    SplatFormat,
    SplatWriter,
    has_directional_colors,
)
from augment.output.atomic import write_file_atomically
from augment.render.sh import SH_C0
from augment.scene.scene import Gaussians, check_gaussians

_SPLAT_RECORD = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)]
)

_log = logging.getLogger(__name__)


def read_splat(path: str | Path) -> SplatFile:
    """Read a .splat file: colour without view dependence (SH degree 0), linear scales."""
    path = Path(path)
    size = path.stat().st_size
    if size == 0 or size % _SPLAT_RECORD.itemsize:
        raise SceneError(
            f"{path}: a .splat file is a row of 32-byte records; got {size} bytes = "
            f"{size // 32} records and {size % 32} bytes: truncated, or another format"
        )
    records = np.fromfile(path, dtype=_SPLAT_RECORD)
    rgba = torch.from_numpy(np.ascontiguousarray(records["rgba"])).float() / 255
    quat_bytes = torch.from_numpy(np.ascontiguousarray(records["quat"])).float()
    all_gaussians = Gaussians(
        means=torch.from_numpy(np.ascontiguousarray(records["mean"])),
        quats=(quat_bytes - 128) / 128,
        scales=torch.from_numpy(np.ascontiguousarray(records["scale"])),
        opacities=rgba[:, 3].contiguous(),
        sh=((rgba[:, :3] - 0.5) / SH_C0)[:, None],
    )
    gaussians, problems = check_gaussians(all_gaussians, where=str(path))
    if len(gaussians) * 2 < len(all_gaussians):
        raise SceneError(
            f"{path}: only {len(gaussians)} of {len(all_gaussians)} records hold usable numbers, "
            "so this is "
            "probably no .splat file. " + " ".join(problems)
        )
    return SplatFile(gaussians, problems=problems)


def write_splat(path: str | Path, gaussians: Gaussians) -> None:
    """Write a .splat file, atomically.

    The format stores 8 bits of colour, opacity and rotation. It has no SH bands above degree 0;
    a warning is logged when they are dropped.
    """
    if gaussians.sh_degree > 0:
        _log.warning("%s: .splat holds no view dependence; SH bands above 0 are dropped", path)
    records = np.zeros(len(gaussians), dtype=_SPLAT_RECORD)
    records["mean"] = gaussians.means.detach().cpu().numpy()
    records["scale"] = gaussians.scales.detach().cpu().numpy()
    rgb = 0.5 + SH_C0 * gaussians.sh[:, 0]
    rgba = torch.cat([rgb, gaussians.opacities[:, None]], 1).clamp(0, 1)
    records["rgba"] = (rgba * 255).round().detach().cpu().numpy()
    quats = (gaussians.quats * 128 + 128).round().clamp(0, 255)
    records["quat"] = quats.detach().cpu().numpy()
    with write_file_atomically(Path(path)) as file:
        file.write(records.tobytes())


def _export(path: Path, gaussians: Gaussians, _facts: Mapping[str, str]) -> None:
    """Write a scene's Gaussians without SH bands above 0; SPLAT's losses say so."""
    write_splat(path, replace(gaussians, sh=gaussians.sh[:, :1]))


SPLAT = SplatFormat(
    name=".splat",
    viewer_up="-y",
    reader=read_splat,
    suffixes=(".splat",),
    writer=SplatWriter(
        kind="splat",
        suffix=".splat",
        write=_export,
        world_losses=(
            Loss(
                "which way is up and how long a unit is are left out: open it with ?up=+z&scale=1"
            ),
        ),
        value_losses=(
            Loss(
                "colours, opacities and rotations have 8 bits; colours below 0 or above 1 are cut "
                "off"
            ),
            Loss(
                "colours do not depend on the direction of view: SH bands above 0 are left out",
                has_directional_colors,
            ),
        ),
        has_camera_file=True,
    ),
)
