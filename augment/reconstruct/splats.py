"""All Gaussians of a scene while they are fitted: one set of arrays that the kernels read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.scene import SH_COUNTS, Gaussians

# Columns of the geometry's moments, two registers: means 3, quats 4, one unused, logarithms of
# scales 3, logit of opacity 1, four unused.
GEOMETRY = 16


@dataclass(eq=False)
class Splats:
    """N splats of P parts, part after part, activated values as in `Gaussians`.

    starts: int64 [P + 1], part p owns splats starts[p] to starts[p + 1]. means [N, 3],
    quats [N, 4] unit wxyz, scales [N, 3], opacities [N], sh [N, K, 3]: float32, contiguous, in the
    part's own frame. semantic: int16 [N]. geometry_m, geometry_v [N, GEOMETRY], sh_m, sh_v
    [N, K, 3]: Adam's moments. age: int32 [N], updates so far. grads: float32 [N, 3], since the
    last densification: sum of the image gradients' absolute size (pixels of the image's width and
    height normalised to [-1, 1]), count of the views that saw the splat, and largest radius seen
    as a part of the image's larger side.
    """

    starts: np.ndarray
    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    semantic: np.ndarray
    geometry_m: np.ndarray
    geometry_v: np.ndarray
    sh_m: np.ndarray
    sh_v: np.ndarray
    age: np.ndarray
    grads: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    @property
    def part_of(self) -> np.ndarray:
        """int32 [N]: the part each splat belongs to."""
        return np.repeat(np.arange(len(self.starts) - 1, dtype=np.int32), np.diff(self.starts))

    @staticmethod
    def of(parts: Sequence[Gaussians], sh_degree: int) -> Splats:
        """Copies of the parts' Gaussians with moments at rest; SH cut or filled up with zeros."""
        functions = SH_COUNTS[sh_degree]
        counts = [len(part) for part in parts]
        total = sum(counts)

        def joined(name: str) -> np.ndarray:
            tensors = [getattr(part, name).detach().float().numpy() for part in parts]
            return np.ascontiguousarray(np.concatenate(tensors))

        sh = np.zeros((total, functions, 3), np.float32)
        semantic = np.zeros(total, np.int16)
        at = 0
        for part in parts:
            own = part.sh.detach().float().numpy()[:, :functions]
            sh[at : at + len(part), : own.shape[1]] = own
            if part.semantic is not None:
                semantic[at : at + len(part)] = part.semantic.numpy()
            at += len(part)
        return Splats(
            starts=np.cumsum([0, *counts], dtype=np.int64),
            means=joined("means"),
            quats=joined("quats"),
            scales=joined("scales"),
            opacities=joined("opacities"),
            sh=sh,
            semantic=semantic,
            geometry_m=np.zeros((total, GEOMETRY), np.float32),
            geometry_v=np.zeros((total, GEOMETRY), np.float32),
            sh_m=np.zeros_like(sh),
            sh_v=np.zeros_like(sh),
            age=np.zeros(total, np.int32),
            grads=np.zeros((total, 3), np.float32),
        )

    def gaussians(self, part: int) -> Gaussians:
        """A copy of one part."""
        own = slice(int(self.starts[part]), int(self.starts[part + 1]))
        return Gaussians(
            means=torch.from_numpy(self.means[own].copy()),
            quats=torch.from_numpy(self.quats[own].copy()),
            scales=torch.from_numpy(self.scales[own].copy()),
            opacities=torch.from_numpy(self.opacities[own].copy()),
            sh=torch.from_numpy(self.sh[own].copy()),
            semantic=torch.from_numpy(self.semantic[own].copy()),
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Every array by name: what a checkpoint holds."""
        return {name: getattr(self, name) for name in Splats.__dataclass_fields__}
