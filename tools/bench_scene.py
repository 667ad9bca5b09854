"""The random scene that CPU rasterisers are compared on, and how a size of it is written."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
import torch

from augment.cameras import Camera
from augment.geometry import rigid
from augment.render.sh import SH_C0
from augment.scene import Gaussians

FOCAL_PER_WIDTH = 0.8125  # 520 px at 640, 1300 px at 1600
_MULTIPLES = {"": 1, "k": 1_000, "M": 1_000_000}


@dataclass(frozen=True)
class RasterCase:
    """One size of the random scene. count: Gaussians. width, height: pixels."""

    count: int
    width: int
    height: int

    def __post_init__(self) -> None:
        if min(self.count, self.width, self.height) < 1:
            raise ValueError(f"count, width and height must be >= 1; got {self}")

    @property
    def name(self) -> str:
        for suffix in ("M", "k"):
            if self.count % _MULTIPLES[suffix] == 0:
                return f"{self.count // _MULTIPLES[suffix]}{suffix}@{self.width}x{self.height}"
        return f"{self.count}@{self.width}x{self.height}"

    @staticmethod
    def parse(text: str) -> RasterCase:
        """From COUNT@WIDTHxHEIGHT, where COUNT may end in k or M."""
        match = re.fullmatch(r"(\d+)([kM]?)@(\d+)x(\d+)", text)
        if match is None:
            raise ValueError(f"a case is COUNT@WIDTHxHEIGHT, such as 100k@640x480; got {text!r}")
        count, suffix, width, height = match.groups()
        return RasterCase(int(count) * _MULTIPLES[suffix], int(width), int(height))


DEFAULT_CASES = (RasterCase(100_000, 640, 480), RasterCase(1_000_000, 1600, 1066))


def random_scene(case: RasterCase, *, seed: int = 0) -> tuple[Gaussians, Camera]:
    """Gaussians with SH of degree 3 spread evenly over a view, and its camera.

    Depth is uniform in 2 to 20 m, x and y within 1.1 of the frustum, each scale exp of a uniform
    logarithm between 4 and 60 mm, rotations uniform, opacity Beta(0.9, 1.2) clipped to [0.005, 1].
    """
    rng = np.random.default_rng(seed)
    count, focal = case.count, FOCAL_PER_WIDTH * case.width
    z = rng.uniform(2, 20, count)
    x = rng.uniform(-1.1, 1.1, count) * z * (case.width / 2 / focal)
    y = rng.uniform(-1.1, 1.1, count) * z * (case.height / 2 / focal)
    scales = np.exp(rng.uniform(math.log(0.004), math.log(0.06), (count, 3)))
    quats = rng.normal(size=(count, 4))
    opacities = np.clip(rng.beta(0.9, 1.2, count), 0.005, 1)
    sh = rng.normal(0, 0.1, (count, 16, 3))
    sh[:, 0] = (rng.uniform(0, 1, (count, 3)) - 0.5) / SH_C0
    fields = {
        "means": np.stack([z, -x, -y], -1),  # the camera looks along +x, z is up
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": scales,
        "opacities": opacities,
        "sh": sh,
    }
    gaussians = Gaussians(**{k: torch.from_numpy(v.astype(np.float32)) for k, v in fields.items()})
    rotation = torch.tensor([[0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    camera = Camera(
        name="bench",
        width=case.width,
        height=case.height,
        fx=focal,
        fy=focal,
        cx=case.width / 2,
        cy=case.height / 2,
        camera_from_world=rigid(rotation, torch.zeros(3, dtype=torch.float64)),
    )
    return gaussians, camera
