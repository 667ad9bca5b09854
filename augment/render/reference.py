"""The definition of the image: EWA splatting in plain torch, differentiable, in any float dtype.

    project   camera coordinates, 2D mean and covariance, colour           per Gaussian
    order     by float32 z, ties by index through the parts
    blend     alpha = min(alpha_max, opacity exp(-sigma)), front to back   per pixel

Kerbl et al. 2023, "3D Gaussian splatting for real-time radiance field rendering"; thresholds of
gsplat 1.5.3. In exact arithmetic an image depends on no box: a splat of opacity <= 1 has alpha
below 1/255 outside min(3.33, sqrt(2 ln(255 opacity))) sigmas, so boxes and tiles only save work.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int16, Int64
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from augment.cameras import Camera
from augment.geometry import rotmat_from_quat, transform_points
from augment.render.buffers import (
    ALPHA,
    EXPECTED_DEPTH,
    MEDIAN_DEPTH,
    MODE_DEPTH,
    OVERLAY,
    RGB,
    SPLAT_IDS,
    RenderOutput,
)
from augment.render.constants import (
    ALPHA_MIN,
    DEPTH_EPS,
    MAX_EXTENT_SIGMAS,
    TAN_FOV_MARGIN,
    TRANSMITTANCE_STOP,
    RasterSettings,
)
from augment.render.fog import Fog, blend_airlight, optical_depth
from augment.render.layout import FAR_PX, LONGEST, SHARP_PX2, HeightClip
from augment.render.mode_depth import Clusters
from augment.render.sh import evaluate_sh
from augment.render.shading import LINES, TINY, light_share, shading_lines
from augment.scene import Gaussians, PosedGaussians

# ---- Projection of the reference rasteriser: Gaussians of a scene to splats of one image ---------
# Positions are taken relative to the eye before anything else, so that float32 keeps its digits in
# scenes that are kilometres wide. Zwicker et al. 2001, "EWA volume splatting", with the clamps and
# thresholds of gsplat 1.5.3.


@dataclass(frozen=True, eq=False)
class Splats:
    """M Gaussians seen by one camera.

    ids: index counted through all parts. depths: z, metres. means2d: pixels. covs2d: xx, xy, yy,
    px^2, blurred. dets: their determinants. opacities: after antialiasing. colors: display-encoded
    and >= 0, in the fog where there is any; None where no colour was asked for. overlay: 1 of those
    of an overlay, else 0. cuts: of splats
    clipped at a height, value at means2d and slope in x and y, per px: clamp(value, 0, 1) is the
    share of alpha that is kept at a pixel; then the growth of the surface's depth in x and y, its
    share per px (seen by an orthographic camera: metres per px), and the most that it may grow or
    shrink. None without a clip.
    """

    ids: Int64[Tensor, "M"]
    depths: Float[Tensor, "M"]
    means2d: Float[Tensor, "M 2"]
    covs2d: Float[Tensor, "M 3"]
    dets: Float[Tensor, "M"]
    opacities: Float[Tensor, "M"]
    colors: Float[Tensor, "M 3"] | None
    overlay: Float[Tensor, "M"]
    cuts: Float[Tensor, "M 6"] | None = None
    lights: Float[Tensor, "M 9"] | None = None

    def __len__(self) -> int:
        return self.ids.shape[0]

    def columns(self) -> dict[str, Tensor]:
        """The fields that are there, by name; one row a splat."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def select(self, index: Tensor) -> Splats:
        """The splats at the given indices or mask, in that order."""
        return dataclasses.replace(self, **{k: v[index] for k, v in self.columns().items()})

    def split(self, sizes: list[int] | int) -> list[Splats]:
        """Consecutive runs of the splats, of the given sizes, as views."""
        names = list(self.columns())
        runs = zip(*(value.split(sizes) for value in self.columns().values()), strict=True)
        return [dataclasses.replace(self, **dict(zip(names, run, strict=True))) for run in runs]


def project_parts(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None = None,
    clip: HeightClip | None = None,
    *,
    with_color: bool = True,
) -> Splats:
    """Splats of all parts that are in front of the camera and opaque enough, in index order."""
    projected: list[Splats] = []
    any_light = with_color and any(part.shading is not None for part in parts)
    first_id = 0
    for part in parts:
        projected.append(
            _project_part(part, first_id, camera, settings, fog, clip, with_color, any_light)
        )
        first_id += len(part.gaussians)
    if len(projected) == 1:
        return projected[0]
    columns = [splats.columns() for splats in projected]
    joined = {name: torch.cat([column[name] for column in columns]) for name in columns[0]}
    return dataclasses.replace(projected[0], **joined)


def _project_part(
    part: PosedGaussians,
    first_id: int,
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None,
    with_color: bool,
    any_light: bool,
) -> Splats:
    camera_from_part = camera.camera_from_world
    if part.world_from_part is not None:
        camera_from_part = camera_from_part @ part.world_from_part
    rotation = camera_from_part[:3, :3].to(part.gaussians.means.dtype)
    offsets = _offsets_from_eye(part.gaussians.means, camera_from_part)
    # Term by term: a matrix product may round the same mean differently at another index, and ties
    # would no longer be ties.
    x, y, z = offsets.unbind(1)
    depths = x * rotation[2, 0] + y * rotation[2, 1] + z * rotation[2, 2]
    kept = (depths >= settings.near_m) & (part.gaussians.opacities >= ALPHA_MIN)
    index = torch.nonzero(kept).squeeze(-1)

    gaussians, offsets, depths = part.gaussians.select(index), offsets[index], depths[index]
    points = torch.cat([offsets @ rotation[:2].T, depths[:, None]], 1)  # in the camera
    axes = rotation @ rotmat_from_quat(gaussians.quats) * gaussians.scales[:, None, :]  # [M, 3, 3]
    covs2d, det_sharp = _project_covariances(points, axes, camera)
    # The same product written as a sum of positive terms, so that no digits cancel.
    blur = settings.blur_px2
    dets = det_sharp + blur * (covs2d[:, 0] + covs2d[:, 2]) + blur**2
    opacities = gaussians.opacities
    if settings.antialiased:
        tiny = torch.finfo(dets.dtype).tiny  # the slope of sqrt is infinite at 0
        opacities = opacities * torch.sqrt((det_sharp / dets).clamp_min(tiny))
    colors = None
    if with_color:
        towards = rotation[2].expand_as(offsets) if camera.is_orthographic else offsets
        rows = None if part.map_rows is None else part.map_rows[index]
        colors = _colors(gaussians, rows, towards, part, camera, settings, fog)
    splats = Splats(
        ids=index + first_id,
        depths=depths,
        means2d=_project_points(points, camera),
        covs2d=covs2d + torch.tensor([blur, 0, blur], dtype=covs2d.dtype),
        dets=dets,
        opacities=opacities,
        colors=colors,
        overlay=torch.full_like(depths, float(part.is_overlay)),
    )
    if any_light:
        lights = splats.depths.new_zeros(len(splats), LINES)
        if part.shading is not None:
            lights = _lights(part, index, rotation, points, camera)
            if fog is not None:
                tau = _optical_depths(gaussians, offsets, part, camera, fog)
                lights[:, 6:] *= torch.exp(-tau)[:, None]
        splats = dataclasses.replace(splats, lights=lights)
    if clip is not None:
        heights = clip.sign * _heights(gaussians, offsets, part, camera, clip)
        cuts, partly = _cut(heights, axes, points, camera, clip)
        splats = dataclasses.replace(splats, cuts=cuts).select(partly)
    if settings.radius_clip_px > 0:
        splats = splats.select(half_extents(splats).amax(1) > settings.radius_clip_px)
    return splats


def half_extents(splats: Splats) -> Float[Tensor, "M 2"]:
    """Half the width and height, px, of the boxes in which the splats' alpha can reach 1/255."""
    opacities, covs2d = splats.opacities.detach(), splats.covs2d.detach()
    sigmas = torch.sqrt(2 * torch.log(opacities / ALPHA_MIN).clamp_min(0))
    return sigmas.clamp_max(MAX_EXTENT_SIGMAS)[:, None] * torch.sqrt(covs2d[:, ::2])


def _heights(
    gaussians: Gaussians, offsets: Tensor, part: PosedGaussians, camera: Camera, clip: HeightClip
) -> Float[Tensor, "M"]:
    """Heights of the means above the plane, by way of the eye, so that float32 keeps its digits."""
    rise = torch.tensor(clip.up, dtype=torch.float64)
    if part.world_from_part is not None:
        rise = rise @ part.world_from_part[:3, :3]
    return offsets @ rise.to(offsets.dtype) + clip.height_of(camera.centre.tolist())


def _cut(
    heights: Float[Tensor, "M"],
    axes: Float[Tensor, "M 3 3"],
    points: Float[Tensor, "M 3"],
    camera: Camera,
    clip: HeightClip,
) -> tuple[Float[Tensor, "M 6"], Tensor]:
    """Cuts, and which splats have a part on the kept side. heights: positive there."""
    rise = torch.tensor(clip.up, dtype=torch.float64)
    up = (clip.sign * (camera.camera_from_world[:3, :3] @ rise)).to(axes.dtype)
    reach = MAX_EXTENT_SIGMAS * (up @ axes).norm(dim=-1)
    gx, gy = _depth_slope(*_image_axes(points, axes, camera), axes[:, 2])
    by = _divisors(points, camera)
    fall = clip.sign * clip.height_of(camera.centre.tolist()) / by**2
    most = LONGEST
    if camera.is_orthographic:
        fall, most = -up[2], math.inf
    slope = torch.stack([up[0] / camera.fx - fall * gx, up[1] / camera.fy - fall * gy], -1)
    length = slope.norm(dim=-1).clamp_min(1e-20)
    offset = (heights / by / length).clamp(-FAR_PX, FAR_PX)
    deep = (MAX_EXTENT_SIGMAS * axes[:, 2].norm(dim=-1) / by).clamp_max(most)
    whole = heights >= reach
    offset = torch.where(whole, torch.full_like(offset, FAR_PX), offset) + clip.edge_px
    slope = torch.where(whole[:, None], torch.zeros_like(slope), slope / length[:, None])
    cuts = torch.cat([offset[:, None], slope, torch.stack([gx / by, gy / by, deep], -1)], 1)
    return cuts, (heights >= -reach) & (heights - reach <= clip.reach_m)


def _depth_slope(
    right: Float[Tensor, "M 3"], down: Float[Tensor, "M 3"], away: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, "M"], Float[Tensor, "M"]]:
    """g = S2^-1 c (augment.render.layout), per px right and down, of semi-axes.

    Determinants are written as products of cross products (Lagrange, Binet-Cauchy): of needles, and
    of sheets seen edge-on, all digits would cancel, even in float64.
    """
    scale = (down.square().sum(1) + SHARP_PX2).rsqrt()[:, None]
    minors = torch.linalg.cross(right, down) * scale
    blur = SHARP_PX2 * scale[:, 0] ** 2
    det = minors.square().sum(1) + blur * right.square().sum(1) + SHARP_PX2
    gx = (minors * (torch.linalg.cross(away, down) * scale)).sum(1)
    gy = (minors * (torch.linalg.cross(right, away) * scale)).sum(1)
    gx = gx + blur * (right * away).sum(1)
    gy = gy + blur * (down * away).sum(1)
    return gx / det, gy / det


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
    x, y, by = points[:, 0], points[:, 1], _divisors(points, camera)
    return torch.stack([camera.fx * x / by + camera.cx, camera.fy * y / by + camera.cy], -1)


def _divisors(points: Float[Tensor, "M 3"], camera: Camera) -> Float[Tensor, "M"]:
    """What x and y are divided by in the projection: z, or 1 where rays are parallel."""
    z = points[:, 2]
    return torch.ones_like(z) if camera.is_orthographic else z


def _project_covariances(
    points: Float[Tensor, "M 3"], axes: Float[Tensor, "M 3 3"], camera: Camera
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]:
    """Covariances (xx, xy, yy) in px^2, not blurred, and their determinants.

    axes: columns are the semi-axes in the camera, metres. The projection is linearised at the
    splat's centre, or at the nearest point within a margin around the image where it lies outside.
    """
    right, down = _image_axes(points, axes, camera)
    covs2d = torch.stack([(right * right).sum(1), (right * down).sum(1), (down * down).sum(1)], -1)
    # Lagrange's identity: xx yy - xy^2 without its cancellation, which needles would suffer from.
    return covs2d, torch.linalg.cross(right, down).square().sum(1)


def _image_axes(
    points: Float[Tensor, "M 3"], axes: Float[Tensor, "M 3 3"], camera: Camera
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """The semi-axes in the image, px right and px down."""
    if camera.is_orthographic:
        return camera.fx * axes[:, 0], camera.fy * axes[:, 1]
    z = points[:, 2]
    u = _clamp_to_image(points[:, 0] / z, camera.cx, camera.fx, camera.width)
    v = _clamp_to_image(points[:, 1] / z, camera.cy, camera.fy, camera.height)
    right = (camera.fx / z)[:, None] * (axes[:, 0] - u[:, None] * axes[:, 2])
    down = (camera.fy / z)[:, None] * (axes[:, 1] - v[:, None] * axes[:, 2])
    return right, down


def _clamp_to_image(tangents: Tensor, centre: float, focal: float, size: int) -> Tensor:
    margin = TAN_FOV_MARGIN * 0.5 * size / focal
    return tangents.clamp(-(centre / focal + margin), (size - centre) / focal + margin)


def _colors(
    gaussians: Gaussians,
    rows: Int16[Tensor, "M"] | None,
    offsets: Float[Tensor, "M 3"],
    part: PosedGaussians,
    camera: Camera,
    settings: RasterSettings,
    fog: Fog | None,
) -> Float[Tensor, "M 3"]:
    """max(SH + 0.5, 0), mapped, and seen through the fog. rows: of the colour maps. offsets: from
    the eye, in the part's axes; without fog their lengths do not matter.
    """
    directions = torch.nn.functional.normalize(offsets, dim=-1)
    colors = (evaluate_sh(gaussians.sh, directions, settings.sh_degree) + 0.5).clamp_min(0)
    if part.color_maps is not None:
        colors = _mapped(colors, part.color_maps.to(colors.dtype), rows)
    if fog is None:
        return colors
    return blend_airlight(colors, _optical_depths(gaussians, offsets, part, camera, fog), fog)


def _mapped(
    colors: Float[Tensor, "M 3"], maps: Float[Tensor, "C 3 4"], rows: Int16[Tensor, "M"] | None
) -> Float[Tensor, "M 3"]:
    """Every colour under its map, the first where there is no such row; not below 0."""
    if rows is None:
        return (colors @ maps[0, :, :3].T + maps[0, :, 3]).clamp_min(0)
    index = torch.where((rows >= 0) & (rows < len(maps)), rows, 0).long()
    own = maps[index]
    return (torch.einsum("mij,mj->mi", own[..., :3], colors) + own[..., 3]).clamp_min(0)


def _optical_depths(
    gaussians: Gaussians,
    offsets: Float[Tensor, "M 3"],
    part: PosedGaussians,
    camera: Camera,
    fog: Fog,
) -> Float[Tensor, "M"]:
    """Of the fog before every splat."""
    heights = None
    if fog.scale_height_m is not None:
        heights = gaussians.means[:, 2]
        if part.world_from_part is not None:
            heights = transform_points(part.world_from_part, gaussians.means)[:, 2]
    return optical_depth(fog, offsets.norm(dim=-1), float(camera.centre[2]), heights)


def _lights(
    part: PosedGaussians,
    index: Int64[Tensor, "M"],
    rotation: Float[Tensor, "3 3"],
    points: Float[Tensor, "M 3"],
    camera: Camera,
) -> Float[Tensor, "M 9"]:
    """The lines of a shaded part's splats (augment.render.shading). points: in the camera."""
    assert part.shading is not None
    normals = rotmat_from_quat(part.gaussians.quats[index])[:, :, 2] @ rotation.T
    sun = rotation @ torch.tensor(part.shading.sun, dtype=rotation.dtype)
    towards = torch.tensor([0.0, 0, 1]).to(points).expand_as(points)
    towards = towards if camera.is_orthographic else points
    slopes = part.shading.slopes[index].to(rotation.dtype)
    return shading_lines(normals, towards, slopes, sun, part.shading.wrap, camera)


def order_by_depth(splats: Splats) -> Splats:
    """Nearest first by float32 z, whatever the dtype; equal depths stay in index order."""
    return splats.select(torch.argsort(splats.depths.detach().float(), stable=True))


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
    """Which splats each tile blends. tile_splat_ids [E]: splat indices, tile after tile, each in
    the order of the splats. tile_offsets [tiles + 1]: where in it tile i (row by row) begins.
    """

    tile_splat_ids: Int64[Tensor, "E"]
    tile_offsets: Int64[Tensor, "L"]
    columns: int
    rows: int


def rasterize_reference(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None = None,
) -> RenderOutput:
    """The image of the parts: project, order, blend. Arguments are checked by `rasterize`.

    Differentiable with respect to all float tensors of the Gaussians; the cut-offs (order, alpha
    threshold, transmittance stop) are taken as constant.
    """
    with_color = RGB in buffers
    splats = project_parts(parts, camera, settings, fog, clip, with_color=with_color)
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
    tile_offsets = torch.searchsorted(tiles[order], torch.arange(columns * rows + 1))
    return TileLists(owners[order], tile_offsets, columns, rows)


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
    sizes = lists.tile_offsets.diff().tolist()
    tiles = []
    # Gathered once: taking each tile's splats from all of them would make every backward step of a
    # tile as long as the scene.
    for tile, tile_splat_ids in enumerate(splats.select(lists.tile_splat_ids).split(sizes)):
        args = (tile_splat_ids, divmod(tile, lists.columns), buffers, settings, camera)
        if recompute and len(tile_splat_ids):  # a backward pass would else keep every splat x pixel
            tiles.append(
                checkpoint(blend_tile, *args, use_reentrant=False, preserve_rng_state=False)
            )
        else:
            tiles.append(blend_tile(*args))
    images = {name: _assemble([getattr(t, name) for t in tiles], lists, camera) for name in buffers}
    if recompute and len(lists.tile_splat_ids) == 0:
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
    alpha, depth, median, overlay = (torch.zeros(TILE * TILE, dtype=dtype) for _ in range(4))
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
        if OVERLAY in buffers:
            overlay = overlay + (weights * near.overlay[:, None]).sum(0)
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
        OVERLAY: overlay,
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
    splats: Splats, pixels: Float[Tensor, "2 P"], weights: Float[Tensor, "S P"], camera: Camera
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
