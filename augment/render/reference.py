"""The definition of the image: EWA splatting in plain torch, differentiable, in any float dtype.

    project   camera coordinates, 2D mean and covariance, colour           per Gaussian
    order     by float32 z, ties by index through the parts
    blend     alpha = min(alpha_max, opacity exp(-sigma)), front to back   per pixel

Zwicker et al. 2001, "EWA volume splatting"; Kerbl et al. 2023; thresholds of gsplat 1.5.3.
In exact arithmetic an image depends on no box: a splat of opacity <= 1 has alpha below 1/255
outside min(3.33, sqrt(2 ln(255 opacity))) sigmas, so boxes and tiles only save work.
Positions are taken relative to the eye before anything else, so that float32 keeps its digits in
scenes that are kilometres wide.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from augment.cameras import Camera
from augment.geometry import rotmat_from_quat, transform_points
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, MEDIAN_DEPTH, RGB, SPLAT_IDS, RenderOutput
from augment.render.constants import (
    ALPHA_MIN,
    COV2D_BLUR,
    DEPTH_EPS,
    MAX_EXTENT_SIGMAS,
    TAN_FOV_MARGIN,
    TRANSMITTANCE_STOP,
    RasterSettings,
)
from augment.render.sh import evaluate_sh
from augment.scene import Gaussians, PosedGaussians
from augment.weather.smog import SmogMedium, blend_airlight, optical_depth

TILE = 16  # pixels a side
BLOCK = 1024  # splats of a tile that are blended at once: bounds memory at a few MB a tile
MEDIAN = 0.5  # median depth is where transmittance falls below this


@dataclass(frozen=True, eq=False)
class Splats:
    """M Gaussians seen by one camera.

    ids: index counted through all parts. depths: z, metres. means2d: pixels. covs2d: xx, xy, yy,
    px^2, blurred. dets: their determinants. opacities: after antialiasing. colors: display-encoded
    and >= 0, in the smog where there is any; None where no colour was asked for.
    """

    ids: Int64[Tensor, "M"]
    depths: Float[Tensor, "M"]
    means2d: Float[Tensor, "M 2"]
    covs2d: Float[Tensor, "M 3"]
    dets: Float[Tensor, "M"]
    opacities: Float[Tensor, "M"]
    colors: Float[Tensor, "M 3"] | None

    def __len__(self) -> int:
        return self.ids.shape[0]

    def select(self, index: Tensor) -> Splats:
        """The splats at the given indices or mask, in that order."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return Splats(**{k: None if v is None else v[index] for k, v in fields.items()})


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
) -> RenderOutput:
    """The image of the parts: project, order, blend. Arguments are checked by `rasterize`.

    Differentiable with respect to all float tensors of the Gaussians; the cut-offs (order, alpha
    threshold, transmittance stop) are taken as constant.
    """
    splats = order_by_depth(project_parts(parts, camera, settings, smog, with_color=RGB in buffers))
    return blend(splats, bin_to_tiles(splats, camera), camera, buffers, settings)


def project_parts(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    smog: SmogMedium | None = None,
    *,
    with_color: bool = True,
) -> Splats:
    """Splats of all parts that are in front of the camera and opaque enough, in index order."""
    projected: list[Splats] = []
    first_id = 0
    for part in parts:
        projected.append(_project_part(part, first_id, camera, settings, smog, with_color))
        first_id += len(part.gaussians)
    if len(projected) == 1:
        return projected[0]
    joined = {}
    for field in dataclasses.fields(Splats):
        values = [getattr(splats, field.name) for splats in projected]
        joined[field.name] = None if values[0] is None else torch.cat(values)
    return Splats(**joined)


def _project_part(
    part: PosedGaussians,
    first_id: int,
    camera: Camera,
    settings: RasterSettings,
    smog: SmogMedium | None,
    with_color: bool,
) -> Splats:
    camera_from_part = camera.camera_from_world
    if part.world_from_part is not None:
        camera_from_part = camera_from_part @ part.world_from_part
    rotation = camera_from_part[:3, :3].to(part.gaussians.means.dtype)
    offsets = _offsets_from_eye(part.gaussians.means, camera_from_part)
    depths = offsets @ rotation[2]
    kept = (depths >= settings.near_m) & (part.gaussians.opacities >= ALPHA_MIN)
    index = torch.nonzero(kept).squeeze(-1)

    gaussians, offsets, depths = part.gaussians.select(index), offsets[index], depths[index]
    points = torch.cat([offsets @ rotation[:2].T, depths[:, None]], 1)  # in the camera
    axes = rotation @ rotmat_from_quat(gaussians.quats) * gaussians.scales[:, None, :]  # [M, 3, 3]
    covs2d, det_sharp = _project_covariances(points, axes, camera)
    # The same product written as a sum of positive terms, so that no digits cancel.
    dets = det_sharp + COV2D_BLUR * (covs2d[:, 0] + covs2d[:, 2]) + COV2D_BLUR**2
    opacities = gaussians.opacities
    if settings.antialiased:
        tiny = torch.finfo(dets.dtype).tiny  # the slope of sqrt is infinite at 0
        opacities = opacities * torch.sqrt((det_sharp / dets).clamp_min(tiny))
    return Splats(
        ids=index + first_id,
        depths=depths,
        means2d=_project_points(points, camera),
        covs2d=covs2d + torch.tensor([COV2D_BLUR, 0, COV2D_BLUR], dtype=covs2d.dtype),
        dets=dets,
        opacities=opacities,
        colors=_colors(gaussians, offsets, part, camera, settings, smog) if with_color else None,
    )


def _offsets_from_eye(
    means: Float[Tensor, "N 3"], camera_from_part: Float[Tensor, "4 4"]
) -> Float[Tensor, "N 3"]:
    """Means minus the camera's centre, in the part's axes.

    The centre is the point that the transform takes to the origin, also where a rotation read from
    a file is orthonormal to seven digits only. It is subtracted in two steps, since it rarely is a
    float32 number.
    """
    eye = torch.linalg.solve(camera_from_part[:3, :3], -camera_from_part[:3, 3])
    coarse = eye.to(means.dtype)
    return (means - coarse) - (eye - coarse).to(means.dtype)


def _project_points(points: Float[Tensor, "M 3"], camera: Camera) -> Float[Tensor, "M 2"]:
    x, y, z = points.unbind(-1)
    return torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)


def _project_covariances(
    points: Float[Tensor, "M 3"], axes: Float[Tensor, "M 3 3"], camera: Camera
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]:
    """Covariances (xx, xy, yy) in px^2, not blurred, and their determinants.

    axes: columns are the semi-axes in the camera, metres. The projection is linearised at the
    splat's centre, or at the nearest point within a margin around the image where it lies outside.
    """
    z = points[:, 2]
    u = _clamp_to_image(points[:, 0] / z, camera.cx, camera.fx, camera.width)
    v = _clamp_to_image(points[:, 1] / z, camera.cy, camera.fy, camera.height)
    right = (camera.fx / z)[:, None] * (axes[:, 0] - u[:, None] * axes[:, 2])  # [M, 3]
    down = (camera.fy / z)[:, None] * (axes[:, 1] - v[:, None] * axes[:, 2])
    covs2d = torch.stack([(right * right).sum(1), (right * down).sum(1), (down * down).sum(1)], -1)
    # Lagrange's identity: xx yy - xy^2 without its cancellation, which needles would suffer from.
    return covs2d, torch.linalg.cross(right, down).square().sum(1)


def _clamp_to_image(tangents: Tensor, centre: float, focal: float, size: int) -> Tensor:
    margin = TAN_FOV_MARGIN * 0.5 * size / focal
    return tangents.clamp(-(centre / focal + margin), (size - centre) / focal + margin)


def _colors(
    gaussians: Gaussians,
    offsets: Float[Tensor, "M 3"],
    part: PosedGaussians,
    camera: Camera,
    settings: RasterSettings,
    smog: SmogMedium | None,
) -> Float[Tensor, "M 3"]:
    """max(SH + 0.5, 0), seen through the smog. offsets: from the eye, in the part's axes."""
    directions = torch.nn.functional.normalize(offsets, dim=-1)
    colors = (evaluate_sh(gaussians.sh, directions, settings.sh_degree) + 0.5).clamp_min(0)
    if smog is None:
        return colors
    heights = None
    if smog.scale_height_m is not None:
        heights = gaussians.means[:, 2]
        if part.world_from_part is not None:
            heights = transform_points(part.world_from_part, gaussians.means)[:, 2]
    tau = optical_depth(smog, offsets.norm(dim=-1), float(camera.centre[2]), heights)
    return blend_airlight(colors, tau, smog)


def order_by_depth(splats: Splats) -> Splats:
    """Nearest first by float32 z, whatever the dtype; equal depths stay in index order."""
    return splats.select(torch.argsort(splats.depths.detach().float(), stable=True))


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
    opacities, centres = splats.opacities.detach(), splats.means2d.detach()[:, axis]
    sigmas = torch.sqrt(2 * torch.log(opacities / ALPHA_MIN).clamp_min(0))
    half = sigmas.clamp_max(MAX_EXTENT_SIGMAS) * torch.sqrt(splats.covs2d.detach()[:, 2 * axis])
    half = half * (1 + 1e-5) + 1e-3  # rounding must not lose a pixel whose alpha is just 1/255
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
    recompute = torch.is_grad_enabled() and splats.opacities.requires_grad
    starts = lists.starts.tolist()
    tiles = []
    for tile, (start, end) in enumerate(itertools.pairwise(starts)):
        members = lists.members[start:end]
        args = (splats, members, divmod(tile, lists.columns), buffers, settings)
        if recompute and start < end:  # a backward pass would otherwise keep every splat x pixel
            tiles.append(
                checkpoint(blend_tile, *args, use_reentrant=False, preserve_rng_state=False)
            )
        else:
            tiles.append(blend_tile(*args))
    return RenderOutput(
        **{name: _assemble([getattr(t, name) for t in tiles], lists, camera) for name in buffers}
    )


def _assemble(tiles: list[Tensor], lists: TileLists, camera: Camera) -> Tensor:
    channels = tiles[0].shape[2:]
    grid = torch.stack(tiles).reshape(lists.rows, lists.columns, TILE, TILE, *channels)
    image = grid.transpose(1, 2).reshape(lists.rows * TILE, lists.columns * TILE, *channels)
    return image[: camera.height, : camera.width].contiguous()


def blend_tile(
    splats: Splats,
    members: Int64[Tensor, "S"],
    tile: tuple[int, int],
    buffers: frozenset[str],
    settings: RasterSettings,
) -> RenderOutput:
    """Buffers [TILE, TILE] of the tile at (row, column). members: its splats, nearest first."""
    dtype = splats.depths.dtype
    step = torch.arange(TILE, dtype=dtype) + 0.5
    rows, columns = torch.meshgrid(tile[0] * TILE + step, tile[1] * TILE + step, indexing="ij")
    pixels = torch.stack([columns.reshape(-1), rows.reshape(-1)])  # [2, P]
    transmittance = torch.ones(TILE * TILE, dtype=dtype)
    rgb = torch.zeros(TILE * TILE, 3, dtype=dtype)
    alpha, depth, median = (torch.zeros(TILE * TILE, dtype=dtype) for _ in range(3))
    heaviest = torch.zeros(TILE * TILE, dtype=dtype)
    ids = torch.full((TILE * TILE,), -1, dtype=torch.int64)
    for block in members.split(BLOCK) if len(members) else ():
        near = splats.select(block)
        weights, after = blend_weights(near, pixels, transmittance, settings)  # [S, P] both
        alpha = alpha + weights.sum(0)
        if near.colors is not None:
            rgb = rgb + weights.T @ near.colors
        if EXPECTED_DEPTH in buffers:
            depth = depth + near.depths @ weights
        if MEDIAN_DEPTH in buffers:
            median = median + _median_here(near.depths, weights, after, transmittance)
        if SPLAT_IDS in buffers:
            weight, row = weights.detach().max(0)  # the first of equals
            ids = torch.where(weight > heaviest, near.ids[row], ids)
            heaviest = torch.maximum(heaviest, weight)
        transmittance = after[-1]
        if bool((transmittance <= TRANSMITTANCE_STOP).all()):
            break
    values = {
        RGB: rgb,
        ALPHA: alpha,
        EXPECTED_DEPTH: depth / alpha.clamp_min(DEPTH_EPS),
        MEDIAN_DEPTH: median,
        SPLAT_IDS: ids.int(),
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
    grows, so the splat that would bring it to the stop and all behind it are those with
    `after <= stop`; they get no weight.
    """
    xy, yy = splats.covs2d[:, 1:2], splats.covs2d[:, 2:3]  # [S, 1]
    dx = pixels[0] - splats.means2d[:, :1]  # [S, P]
    dy = pixels[1] - splats.means2d[:, 1:]
    # d^T cov^-1 d with the square completed: never negative, in whatever precision.
    along = dx - (xy / yy) * dy
    sigma = 0.5 * (along * along * (yy / splats.dets[:, None]) + dy * dy / yy)
    alphas = (splats.opacities[:, None] * torch.exp(-sigma)).clamp_max(settings.alpha_max)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, torch.zeros_like(alphas))
    after = transmittance * torch.cumprod(1 - alphas, 0)
    before = torch.cat([transmittance[None], after[:-1]])
    weights = torch.where(after > TRANSMITTANCE_STOP, alphas * before, torch.zeros_like(alphas))
    return weights, after


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
