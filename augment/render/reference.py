"""The definition of the image: EWA splatting in plain torch, differentiable, in any float dtype.

    project   camera coordinates, 2D mean and covariance, colour           per Gaussian
    order     by float32 z, ties by index through the parts
    blend     alpha = min(alpha_max, opacity exp(-sigma)), front to back   per pixel

Kerbl et al. 2023, "3D Gaussian splatting for real-time radiance field rendering"; thresholds of
gsplat 1.5.3. In exact arithmetic an image depends on no box: a splat of opacity <= 1 has alpha
below 1/255 outside min(3.33, sqrt(2 ln(255 opacity))) sigmas, so boxes and tiles only save work.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from augment.cameras import Camera
from augment.render.buffers import (
    ALPHA,
    EXPECTED_DEPTH,
    MEDIAN_DEPTH,
    MODE_DEPTH,
    RGB,
    SNOW,
    SPLAT_IDS,
    RenderOutput,
)
from augment.render.clip import HeightClip
from augment.render.constants import (
    ALPHA_MIN,
    DEPTH_EPS,
    TRANSMITTANCE_STOP,
    RasterSettings,
)
from augment.render.mode_depth import Clusters
from augment.render.reference_project import (
    Splats,
    half_extents,
    order_by_depth,
    project_parts,
)
from augment.render.shading import TINY, light_share
from augment.scene import PosedGaussians
from augment.weather.smog import SmogMedium

TILE = 16  # pixels a side
# Splats of a tile that are blended at once. 256 pixels x 96 splats stay in a core's cache, and
# torch keeps so few values on one thread; handing them to others would cost more than the work,
# far more where the cores are busy. Hence also exp2 and sums below instead of exp and matrix
# products, which go to a library that wakes its threads for any size.
BLOCK = 96
LOG2_E = math.log2(math.e)
MEDIAN = 0.5  # median depth is where transmittance falls below this


@dataclass(frozen=True, eq=False)
class TileLists:
    """Which splats each tile blends. members [E]: splat indices, tile after tile, each in the order
    of the splats. starts [tiles + 1]: tile i (row by row) owns members[starts[i]:starts[i + 1]].
    """

    members: Int64[Tensor, "E"]
    starts: Int64[Tensor, "L"]
    columns: int
    rows: int


def rasterize_reference(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
    smog: SmogMedium | None,
    clip: HeightClip | None = None,
) -> RenderOutput:
    """The image of the parts: project, order, blend. Arguments are checked by `rasterize`.

    Differentiable with respect to all float tensors of the Gaussians; the cut-offs (order, alpha
    threshold, transmittance stop) are taken as constant.
    """
    with_color = RGB in buffers
    splats = project_parts(parts, camera, settings, smog, clip, with_color=with_color)
    splats = order_by_depth(splats)
    return blend(splats, bin_to_tiles(splats, camera), camera, buffers, settings)


def bin_to_tiles(splats: Splats, camera: Camera) -> TileLists:
    """Every tile's splats: those whose box, in which alpha can reach 1/255, touches the tile."""
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    x0, x1 = _tile_span(splats, 0, columns)
    y0, y1 = _tile_span(splats, 1, rows)
    widths = (x1 - x0).clamp_min(0)
    counts = widths * (y1 - y0).clamp_min(0)
    counts[splats.opacities < ALPHA_MIN] = 0  # antialiasing may have thinned them since projection
    owners = torch.repeat_interleave(counts)  # [E]
    within = torch.arange(len(owners)) - (counts.cumsum(0) - counts)[owners]
    tiles = (y0[owners] + within // widths[owners]) * columns + x0[owners] + within % widths[owners]
    order = torch.argsort(tiles, stable=True)
    starts = torch.searchsorted(tiles[order], torch.arange(columns * rows + 1))
    return TileLists(owners[order], starts, columns, rows)


def _tile_span(splats: Splats, axis: int, tiles: int) -> tuple[Tensor, Tensor]:
    """First tile and one past the last along x (axis 0) or y (axis 1) of each splat's box."""
    centres = splats.means2d.detach()[:, axis]
    # Rounding must not lose a pixel whose alpha is just 1/255.
    half = half_extents(splats)[:, axis] * (1 + 1e-5) + 1e-3
    first = torch.floor((centres - half) / TILE).clamp(0, tiles).long()
    last = torch.floor((centres + half) / TILE).clamp(-1, tiles - 1).long()
    return first, last + 1


def blend(
    splats: Splats,
    lists: TileLists,
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
) -> RenderOutput:
    """Buffers [H, W] of ordered splats; tile by tile, and so in little memory."""
    recompute = torch.is_grad_enabled() and any(
        value.requires_grad for value in splats.columns().values()
    )
    sizes = lists.starts.diff().tolist()
    tiles = []
    # Gathered once: taking each tile's splats from all of them would make every backward step of a
    # tile as long as the scene.
    for tile, members in enumerate(splats.select(lists.members).split(sizes)):
        args = (members, divmod(tile, lists.columns), buffers, settings, camera)
        if recompute and len(members):  # a backward pass would else keep every splat x pixel
            tiles.append(
                checkpoint(blend_tile, *args, use_reentrant=False, preserve_rng_state=False)
            )
        else:
            tiles.append(blend_tile(*args))
    images = {name: _assemble([getattr(t, name) for t in tiles], lists, camera) for name in buffers}
    if recompute and len(lists.members) == 0:
        # A view of nothing is a function of the splats too: its gradients are 0, not an error.
        floats = [value for value in splats.columns().values() if value.is_floating_point()]
        nothing = torch.stack([value[:0].sum() for value in floats]).sum()
        images = {n: i + nothing if i.is_floating_point() else i for n, i in images.items()}
    return RenderOutput(**images)


def _assemble(tiles: list[Tensor], lists: TileLists, camera: Camera) -> Tensor:
    channels = tiles[0].shape[2:]
    grid = torch.stack(tiles).reshape(lists.rows, lists.columns, TILE, TILE, *channels)
    image = grid.transpose(1, 2).reshape(lists.rows * TILE, lists.columns * TILE, *channels)
    return image[: camera.height, : camera.width].contiguous()


def blend_tile(
    splats: Splats,
    tile: tuple[int, int],
    buffers: frozenset[str],
    settings: RasterSettings,
    camera: Camera,
) -> RenderOutput:
    """Buffers [TILE, TILE] of the tile at (row, column). splats: its own, nearest first."""
    dtype = splats.depths.dtype
    step = torch.arange(TILE, dtype=dtype) + 0.5
    y, x = torch.meshgrid(tile[0] * TILE + step, tile[1] * TILE + step, indexing="ij")
    pixels = torch.stack([x.reshape(-1), y.reshape(-1)])  # [2, P]
    transmittance = torch.ones(TILE * TILE, dtype=dtype)
    rgb = torch.zeros(TILE * TILE, 3, dtype=dtype)
    alpha, depth, median, snow = (torch.zeros(TILE * TILE, dtype=dtype) for _ in range(4))
    clusters = Clusters.empty(TILE * TILE, dtype)
    heaviest = torch.zeros(TILE * TILE, dtype=dtype)
    ids = torch.full((TILE * TILE,), -1, dtype=torch.int64)
    for near in splats.split(BLOCK) if len(splats) else ():
        weights, after = blend_weights(near, pixels, transmittance, settings)  # [S, P] both
        alpha = alpha + weights.sum(0)
        if near.colors is not None:
            rgb = rgb + _weighted_sums(weights, near.colors)
            if near.lights is not None:
                rgb = rgb + _shaded(near, pixels, weights, camera)
        if SNOW in buffers:
            snow = snow + (weights * near.snow[:, None]).sum(0)
        if buffers & {EXPECTED_DEPTH, MODE_DEPTH}:
            surfaces = _surface_depths(near, pixels, camera.is_orthographic)
            depth = depth + (weights * surfaces).sum(0)
            if MODE_DEPTH in buffers:
                for row in torch.nonzero(weights.detach().any(1))[:, 0].tolist():
                    clusters = clusters.add(
                        surfaces[row], weights[row], settings.mode_depth_floor_m
                    )
        if MEDIAN_DEPTH in buffers:
            median = median + _median_here(near.depths, weights, after, transmittance)
        if SPLAT_IDS in buffers:
            weight = weights.detach().amax(0)
            rows = torch.arange(len(near))[:, None]
            row = torch.where(weights == weight, rows, len(near)).amin(0)  # the first of equals
            ids = torch.where(weight > heaviest, near.ids[row], ids)
            heaviest = torch.maximum(heaviest, weight)
        transmittance = after[-1]
        if bool((transmittance <= settings.transmittance_stop).all()):
            break
    values = {
        RGB: rgb,
        ALPHA: alpha,
        EXPECTED_DEPTH: depth / alpha.clamp_min(DEPTH_EPS),
        MEDIAN_DEPTH: median,
        SPLAT_IDS: ids.int(),
        MODE_DEPTH: clusters.heaviest_mode(),
        SNOW: snow,
    }
    shaped = {name: values[name].reshape(TILE, TILE, *values[name].shape[1:]) for name in buffers}
    return RenderOutput(**shaped)


def blend_weights(
    splats: Splats,
    pixels: Float[Tensor, "2 P"],
    transmittance: Float[Tensor, "P"],
    settings: RasterSettings,
) -> tuple[Float[Tensor, "S P"], Float[Tensor, "S P"]]:
    """Weight of every splat at every pixel, and the transmittance behind it.

    pixels: x, y of their centres. transmittance: in front of the first splat. Transmittance never
    grows, so the splats that are not blended are those that stand behind the stop, and the one that
    would leave no more than TRANSMITTANCE_STOP, or the stop where that is less (RasterSettings).
    """
    dx = pixels[0] - splats.means2d[:, :1]  # [S, P]
    dy = pixels[1] - splats.means2d[:, 1:]
    sigma = _sigmas(splats, dx, dy)
    alphas = (splats.opacities[:, None] * torch.exp2(-LOG2_E * sigma)).clamp_max(settings.alpha_max)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, torch.zeros_like(alphas))
    if splats.cuts is not None:
        at, slope_x, slope_y = splats.cuts.T[:3, :, None]
        alphas = alphas * (at + slope_x * dx + slope_y * dy).clamp(0, 1)
    after = transmittance * torch.cumprod(1 - alphas, 0)
    before = torch.cat([transmittance[None], after[:-1]])
    stop = settings.transmittance_stop
    kept = (after > min(stop, TRANSMITTANCE_STOP)) & (before > stop)
    weights = torch.where(kept, alphas * before, torch.zeros_like(alphas))
    return weights, after


def _shaded(
    splats: Splats,
    pixels: Float[Tensor, "2 P"],
    weights: Float[Tensor, "S P"],
    camera: Camera,
) -> Float[Tensor, "P 3"]:
    """What the light adds to the colours of splats that are lit pixel by pixel."""
    assert splats.lights is not None
    dx, dy = pixels[0] - splats.means2d[:, :1], pixels[1] - splats.means2d[:, 1:]
    reach = torch.log(splats.opacities / ALPHA_MIN).clamp_min(TINY)[:, None]
    rim = (_sigmas(splats, dx, dy) / reach).clamp(0, 1)
    share = light_share(splats.lights, dx, dy, rim, camera)
    return _weighted_sums(weights * share, splats.lights[:, 6:])


def _sigmas(
    splats: Splats, dx: Float[Tensor, "S P"], dy: Float[Tensor, "S P"]
) -> Float[Tensor, "S P"]:
    """Half the squared Mahalanobis distance of pixels dx, dy away from the means."""
    xy, yy = splats.covs2d[:, 1:2], splats.covs2d[:, 2:3]  # [S, 1]
    # d^T cov^-1 d with the square completed: never negative, in whatever precision.
    along = dx - (xy / yy) * dy
    return 0.5 * (along * along * (yy / splats.dets[:, None]) + dy * dy / yy)


def _surface_depths(
    splats: Splats, pixels: Float[Tensor, "2 P"], is_orthographic: bool
) -> Float[Tensor, "S P"]:
    """z of every splat at every pixel: its centre's, or with a clip that of its surface."""
    depths = splats.depths[:, None].expand(-1, pixels.shape[1])
    if splats.cuts is None:
        return depths
    right, down, most = splats.cuts.T[3:, :, None]
    dx, dy = pixels[0] - splats.means2d[:, :1], pixels[1] - splats.means2d[:, 1:]
    growth = (right * dx + down * dy).clamp(-most, most)
    return depths + growth if is_orthographic else depths / (1 - growth)


def _weighted_sums(
    weights: Float[Tensor, "S P"], colors: Float[Tensor, "S 3"]
) -> Float[Tensor, "P 3"]:
    """weights^T colors without a matrix product (see BLOCK)."""
    return torch.stack([(weights * channel[:, None]).sum(0) for channel in colors.unbind(1)], -1)


def _median_here(
    depths: Float[Tensor, "S"],
    weights: Float[Tensor, "S P"],
    after: Float[Tensor, "S P"],
    transmittance: Float[Tensor, "P"],
) -> Float[Tensor, "P"]:
    """z of the splat of this block that brings transmittance below one half; 0 where none does."""
    row = (after >= MEDIAN).sum(0)
    inside = row < len(depths)
    row = row.clamp_max(len(depths) - 1)
    blended = weights.gather(0, row[None])[0] > 0
    crossing = inside & blended & (transmittance >= MEDIAN)
    return torch.where(crossing, depths[row], torch.zeros_like(depths[row]))
