"""The GPU's projection: splats of all Gaussians of all parts, in one launch."""

from __future__ import annotations

import torch

from augment.render import layout, shading
from augment.render.cuda_inputs import BLOCK, CudaInputs
from augment.render.cuda_project_kernels import project_gaussians
from augment.render.cuda_splats import CudaSplats
from augment.render.gpu import launch


def project(inputs: CudaInputs) -> CudaSplats:
    """Records, keys, tiles, and, where the modes ask for them, cuts and lights."""
    count, device, modes = inputs.count, inputs.device, [int(mode) for mode in inputs.modes]

    def floats(columns: int) -> torch.Tensor:
        return torch.empty((count, columns), dtype=torch.float32, device=device)

    def ints(*shape: int) -> torch.Tensor:
        return torch.empty(shape, dtype=torch.int32, device=device)

    splats = CudaSplats(
        records=floats(layout.RECORD),
        keys=ints(count),
        rects=ints(count, 2),
        counts=ints(count),
        cuts=floats(layout.CUT) if modes[layout.M_CLIP] else None,
        lights=floats(shading.LINES) if modes[layout.M_LIGHT] else None,
    )
    launch(
        project_gaussians,
        (len(inputs.block_parts),),
        inputs.table,
        inputs.views,
        inputs.block_parts,
        splats.records,
        splats.keys,
        splats.rects,
        splats.counts,
        splats.cuts,
        splats.lights,
        COLOR=modes[layout.M_COLOR],
        FUNCTIONS=modes[layout.M_FUNCTIONS],
        ANTIALIASED=modes[layout.M_ANTIALIASED],
        SMOG=modes[layout.M_SMOG],
        CLIP=modes[layout.M_CLIP],
        LIGHT=modes[layout.M_LIGHT],
        BLOCK=BLOCK,
        num_warps=BLOCK // 32,
    )
    return splats
