"""Tile lists on the GPU: which splats every tile blends, nearest first, ties by index.

    order    of the Gaussians by the bits of z                                stable sort
    expand   every splat to its pairs with tiles, in that order               list_pairs
    group    the pairs by tile, which leaves each tile's in order of depth    stable sort

Both sorts are torch's, radix sorts on a GPU. Pairs are spread evenly over programs, however many
tiles a splat touches.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int32
from torch import Tensor

from augment.cameras import Camera
from augment.render import gpu
from augment.render.cuda_splats import TILE, CudaSplats, CudaTiles
from augment.render.cuda_tiles_kernels import count_tiles, list_pairs

_SPLATS, _PAIRS = 256, 512  # of a program; a thread looks for the owners of four pairs at once
_MOST_PAIRS = 2**31 - 1024  # tiles' lists begin at an int32, and are read some way beyond


def list_tiles(splats: CudaSplats, camera: Camera, wanted: Tensor | None) -> CudaTiles:
    """The lists of all tiles. wanted: bool [H, W]; tiles without a wanted pixel get none.

    Waits for the GPU once, to learn how many pairs there are.

    Raises:
        ValueError: there are more pairs than an int32 can count.
    """
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    count, tiles, device = len(splats.keys), columns * rows, splats.keys.device
    none = torch.empty(0, dtype=torch.int32, device=device)
    is_wanted = None if wanted is None else _wanted_tiles(wanted.to(device), columns, rows)

    order = torch.sort(splats.keys, stable=True).indices
    counts = torch.empty(count, dtype=torch.int32, device=device)
    gpu.launch(
        count_tiles,
        (-(-count // _SPLATS),),
        order,
        splats.counts,
        splats.rects,
        none if is_wanted is None else _sums_from_corner(is_wanted),
        counts,
        count,
        columns,
        IS_PARTIAL=is_wanted is not None,
        BLOCK=_SPLATS,
    )
    ends = torch.cumsum(counts, 0, dtype=torch.int64)
    pairs = int(ends[-1]) if count else 0
    if pairs > _MOST_PAIRS:
        raise ValueError(
            f"the {count} Gaussians touch {pairs} tiles of a {camera.width} x {camera.height} "
            f"image together, which is more than {_MOST_PAIRS}; render a smaller image, or fewer "
            f"or smaller Gaussians"
        )

    # One number more than there are tiles stands for those that are not wanted, behind all others.
    numbers = torch.int16 if tiles <= torch.iinfo(torch.int16).max else torch.int32
    tile_of = torch.empty(pairs, dtype=numbers, device=device)
    owners = torch.empty(pairs, dtype=torch.int32, device=device)
    gpu.launch(
        list_pairs,
        (-(-pairs // _PAIRS),),
        order,
        ends,
        splats.rects,
        none if is_wanted is None else is_wanted,
        tile_of,
        owners,
        pairs,
        count,
        count.bit_length(),
        columns,
        tiles,
        IS_PARTIAL=is_wanted is not None,
        BLOCK=_PAIRS,
    )
    grouped, index = torch.sort(tile_of, stable=True)
    edges = torch.arange(tiles + 1, dtype=numbers, device=device)
    starts = torch.searchsorted(grouped, edges, out_int32=True)
    return CudaTiles(owners[index], starts, columns, rows)


def _wanted_tiles(wanted: Bool[Tensor, "H W"], columns: int, rows: int) -> Bool[Tensor, "R C"]:
    """Tiles with a wanted pixel."""
    height, width = wanted.shape
    padded = wanted.new_zeros(rows * TILE, columns * TILE)
    padded[:height, :width] = wanted
    return padded.reshape(rows, TILE, columns, TILE).any(3).any(1).contiguous()


def _sums_from_corner(is_wanted: Bool[Tensor, "R C"]) -> Int32[Tensor, "R1 C1"]:
    """Wanted tiles above and to the left of each corner."""
    sums = is_wanted.cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32)
    return torch.nn.functional.pad(sums, (1, 0, 1, 0))
