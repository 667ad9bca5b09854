"""Tiny synthetic Gaussians and cameras, and the stored reference renders. World: x ahead, z up."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from augment.render.constants import RasterSettings
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid, rotmat_from_quat
from augment.scene.scene import Gaussians, PosedGaussians


def camera_ahead(
    width: int = 33,
    height: int = 21,
    focal: float = 30.0,
    *,
    position=(0.0, 0.0, 0.0),
    yaw: float = 0.0,
    timestamp_ns: int = 0,
) -> Camera:
    """A level camera that looks along +x, turned left by yaw (radians) about +z."""
    forward = torch.tensor([np.cos(yaw), np.sin(yaw), 0.0], dtype=torch.float64)
    right = torch.tensor([np.sin(yaw), -np.cos(yaw), 0.0], dtype=torch.float64)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    rotation = torch.stack([right, down, forward])
    centre = torch.tensor(position, dtype=torch.float64)
    return Camera(
        name="ahead",
        width=width,
        height=height,
        fx=focal,
        fy=focal * 1.05,  # not square, so that swapped axes show
        cx=0.48 * width,
        cy=0.53 * height,
        camera_from_world=rigid(rotation, -rotation @ centre),
        timestamp_ns=timestamp_ns,
    )


def sh_of(rgb, dtype=torch.float32) -> torch.Tensor:
    """Degree-0 coefficients [N, 1, 3] that evaluate to rgb [N, 3]."""
    rgb = torch.from_numpy(np.asarray(rgb, np.float64))
    return ((rgb - 0.5) / SH_C0).to(dtype)[:, None, :]


def one_gaussian(
    mean=(4.0, 0.0, 0.0), scale=0.3, opacity: float = 0.8, rgb=(0.9, 0.5, 0.1), dtype=torch.float32
) -> Gaussians:
    """A ball (or, with three scales, an ellipsoid along the axes) of one colour."""
    return Gaussians(
        means=torch.tensor([mean], dtype=dtype),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=dtype),
        scales=torch.tensor(np.broadcast_to(scale, 3).copy(), dtype=dtype)[None],
        opacities=torch.tensor([opacity], dtype=dtype),
        sh=sh_of(np.asarray(rgb)[None], dtype),
    )


def stack(*gaussians: Gaussians) -> Gaussians:
    """The Gaussians one after the other."""
    names = ("means", "quats", "scales", "opacities", "sh")
    return Gaussians(**{n: torch.cat([getattr(g, n) for g in gaussians]) for n in names})


def random_gaussians(
    count: int = 300, *, seed: int = 0, sh_degree: int = 3, dtype=torch.float32, size=0.25
) -> Gaussians:
    """Gaussians ahead of `camera_ahead`, some outside its image, some behind it, of all opacities.

    size: the largest semi-axis, metres; the smallest is a twentieth of it.
    """
    rng = np.random.default_rng(seed)
    bands = (sh_degree + 1) ** 2
    x = rng.uniform(-1.0, 9.0, count)
    sh = rng.normal(0, 0.15, (count, bands, 3))
    sh[:, 0] = (rng.uniform(0, 1, (count, 3)) - 0.5) / SH_C0
    fields = {
        "means": np.stack([x, *(rng.uniform(-0.7, 0.7, (2, count)) * np.abs(x))], -1),
        "quats": _unit(rng.normal(size=(count, 4))),
        "scales": size * np.exp(rng.uniform(np.log(0.05), 0, (count, 3))),
        "opacities": np.clip(rng.beta(0.9, 1.2, count), 0, 1),
        "sh": sh,
    }
    return Gaussians(**{k: torch.from_numpy(v).to(dtype) for k, v in fields.items()})


def smooth_gaussians(count: int = 4, *, seed: int = 0, sh_degree: int = 1) -> Gaussians:
    """float64 Gaussians far from every cut-off, so that images are smooth in all their numbers.

    They cover the whole of `camera_ahead(7, 5, 9.0)`, let light through, keep their order, and
    their colours stay positive.
    """
    rng = np.random.default_rng(seed)
    sh = rng.normal(0, 0.05, (count, (sh_degree + 1) ** 2, 3))
    fields = {
        "means": np.stack([np.arange(count) + 4.0, *rng.uniform(-0.3, 0.3, (2, count))], -1),
        "quats": _unit(rng.normal(size=(count, 4))),
        "scales": rng.uniform(2.0, 3.0, (count, 3)),
        "opacities": rng.uniform(0.3, 0.7, count),
        "sh": sh,
    }
    return Gaussians(**{k: torch.from_numpy(v) for k, v in fields.items()})


def _unit(quats: np.ndarray) -> np.ndarray:
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def in_float64(gaussians: Gaussians) -> Gaussians:
    """The same numbers in the precision in which the definition is taken for exact."""
    names = ("means", "quats", "scales", "opacities", "sh")
    return dataclasses.replace(gaussians, **{n: getattr(gaussians, n).double() for n in names})


def parts_in_float64(parts: list[PosedGaussians]) -> list[PosedGaussians]:
    return [dataclasses.replace(part, gaussians=in_float64(part.gaussians)) for part in parts]


def random_pose(seed: int = 0, translation=(0.5, -0.3, 0.2)) -> torch.Tensor:
    """A rigid world_from_part, float64 [4, 4]."""
    quat = torch.from_numpy(np.random.default_rng(seed).normal(size=4))
    return rigid(rotmat_from_quat(quat), torch.tensor(translation, dtype=torch.float64))


def slight_pose(translation=(0.1, 0.2, -0.1)) -> torch.Tensor:
    """A world_from_part, float64 [4, 4], that leaves what is ahead of the camera ahead."""
    quat = torch.tensor([1.0, 0.03, -0.05, 0.04], dtype=torch.float64)
    return rigid(rotmat_from_quat(quat), torch.tensor(translation, dtype=torch.float64))


# Stored scenes and how they were rendered; all but those of the first take long.
GOLDEN = [
    pytest.param(name, mode, marks=[pytest.mark.long] if name != "edge" else [])
    for name in ("edge", "garden_small", "opaque")
    for mode in (
        *("a999_classic", "a999_aa", "a99_classic", "a99_aa"),
        *(f"a99_classic_sh{degree}" for degree in range(4)),
    )
]


def golden_view(
    folder: Path, name: str, mode: str, dtype=torch.float32
) -> tuple[list[PosedGaussians], Camera, RasterSettings, dict[str, np.ndarray]]:
    """A stored scene as parts, a camera and the mode's settings; arrays: the mode's images "rgb",
    and where it takes plain colours "alpha" and "ED", beside what the file holds for all modes.
    """
    with np.load(folder / "golden" / f"{name}.npz") as file:
        arrays = {name.removeprefix(f"{mode}_"): file[name] for name in file.files}
    with_sh = "_sh" in mode
    K = arrays["K"].astype(np.float64)
    camera = Camera(
        name=name,
        width=int(arrays["width"]),
        height=int(arrays["height"]),
        fx=K[0, 0],
        fy=K[1, 1],
        cx=K[0, 2],
        cy=K[1, 2],
        camera_from_world=torch.from_numpy(arrays["viewmat"]).to(torch.float64),
    )
    settings = RasterSettings(
        alpha_max=0.999 if mode.startswith("a999") else 0.99,
        antialiased="_aa" in mode,
        sh_degree=int(mode[-1]) if with_sh else None,
    )
    arrays["quats"] = _unit(arrays["quats"].astype(np.float64))  # Gaussians hold unit quaternions
    sh = torch.from_numpy(arrays["sh"]).to(dtype) if with_sh else sh_of(arrays["colors"], dtype)
    names = ("means", "quats", "scales", "opacities")
    gaussians = Gaussians(**{n: torch.from_numpy(arrays[n]).to(dtype) for n in names}, sh=sh)
    return [PosedGaussians(gaussians)], camera, settings, arrays
