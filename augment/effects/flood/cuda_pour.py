"""Launches of the Triton kernels that put the layers of a flooded view together."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood import cuda_screen_kernels as kernels
from augment.effects.flood.water_plane import BEGIN, END, Window, falling_rows
from augment.render.constants import DEPTH_EPS
from augment.render.cuda.runtime import gpu_device, launch, upload

# ---- The rows of a camera's image (`plane_rows`) on the GPU, copied once a camera ----------------

_known: WeakKeyDictionary[Camera, tuple[Tensor, int]] = WeakKeyDictionary()


def rows_on_gpu(camera: Camera) -> Int32[Tensor, "H 4"]:
    return _known_of(camera)[0]


def dry_rows(camera: Camera) -> int:
    """One past the last row in which a ray does not fall."""
    return _known_of(camera)[1]


def _known_of(camera: Camera) -> tuple[Tensor, int]:
    known = _known.get(camera)
    if known is None or known[0].device != gpu_device():
        rows = falling_rows(camera)
        is_dry = (rows[:, BEGIN] > 0) | (rows[:, END] < camera.width)
        known = _known[camera] = upload(rows), int(is_dry.nonzero()[0].max(initial=-1)) + 1
    return known


# ---- cuda pour -----------------------------------------------------------------------------------

LANES = 512  # pixels of a program
MAX_OTHERS = 4  # buffers that the kernel joins beside alpha and expected depth


def find_water(
    alpha: Float[Tensor, "H W"], camera: Camera
) -> tuple[Bool[Tensor, "H W"], Float[Tensor, ""]]:
    """As `pour.find_water`; the largest share stays on the GPU."""
    count = alpha.numel()
    programs = -(-count // LANES)
    water = torch.empty(alpha.shape, dtype=torch.uint8, device=alpha.device)
    shown = torch.empty(programs, dtype=torch.float32, device=alpha.device)
    launch(
        kernels.find_water,
        (programs,),
        rows_on_gpu(camera),
        alpha.detach().contiguous(),
        camera.width,
        count,
        shown,
        water,
        LANES=LANES,
    )
    return water.view(torch.bool), shown.max()


def composite_water(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    camera: Camera,
    window: Window,
    color: Float[Tensor, "h w 3"],
    sky: Float[Tensor, "S W 3"],
    dry: int,
) -> None:
    """Water into rgb, and the first `dry` rows of `sky`, finished, where rays do not fall."""
    launch(
        kernels.composite_water,
        (-(-alpha.numel() // LANES),),
        rows_on_gpu(camera),
        alpha,
        color.contiguous(),
        sky.contiguous(),
        dry,
        window.left,
        window.top,
        window.right,
        window.bottom,
        camera.width,
        alpha.numel(),
        rgb,
        LANES=LANES,
    )


def join(
    alpha: Float[Tensor, "H W"],
    behind_alpha: Float[Tensor, "h w"],
    depths: tuple[Tensor, Tensor] | None,
    others: list[tuple[Tensor, Tensor]],
    window: Window,
) -> None:
    """Buffers of two layers as one scene's, in place: alpha, the pair of expected depths, and pairs
    of which those of the layer that covers more of a pixel are kept.
    """
    assert len(others) <= MAX_OTHERS
    (rows, columns), (own_rows, own_columns) = window.overlap(alpha)
    wide, count = columns.stop - columns.start, 0
    if wide > 0:
        count = wide * max(rows.stop - rows.start, 0)
    pairs = [tuple(part.view(torch.int32) for part in pair) for pair in others]
    nothing = (alpha, behind_alpha)  # stands where no pointer is looked at
    pairs += [nothing] * (MAX_OTHERS - len(others))
    launch(
        kernels.join,
        (-(-count // LANES),),
        *nothing,
        *(nothing if depths is None else depths),
        *(part for pair in pairs for part in pair),
        DEPTH_EPS,
        columns.start,
        rows.start,
        own_columns.start,
        own_rows.start,
        wide,
        count,
        alpha.shape[1],
        behind_alpha.shape[1],
        HAS_DEPTH=depths is not None,
        OTHERS=len(others),
        LANES=LANES,
    )
