"""The definition of the image: EWA splatting in plain torch, differentiable, in any float dtype.

    project   camera coordinates, 2D mean and covariance, colour           per Gaussian
    order     by float32 z, ties by index through the parts
    blend     alpha = min(alpha_max, opacity exp(-sigma)), front to back   per pixel

`rasterize` calls it for backend "reference"; the kernels on the CPU and the GPU are tested against
it. It takes the parts of a scene and a camera, and returns the image buffers.

Kerbl et al. 2023, "3D Gaussian splatting for real-time radiance field rendering"; thresholds of
gsplat 1.5.3. In exact arithmetic an image depends on no box: a splat of opacity <= 1 has alpha
below 1/255 outside min(3.33, sqrt(2 ln(255 opacity))) sigmas, so boxes and tiles only save work.

Symbols: S splats of a tile, P pixels, M splats in front of the camera, N Gaussians of a part.
sigma is half the squared Mahalanobis distance of a pixel from a splat's mean; tau is the optical
depth of the fog before a splat.
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
from augment.render.fog_table import point_means
from augment.render.layout import FAR_PX, MAX_DEPTH_GROWTH, SHARP_PX2, HeightClip
from augment.render.mode_depth import Clusters
from augment.render.sh import evaluate_sh
from augment.render.shading import LINES, TINY, light_share, shading_lines
from augment.scene.cameras import Camera
from augment.scene.geometry import rotmat_from_quat, transform_points
from augment.scene.scene import Gaussians, PosedGaussians

# ---- Projection: Gaussians of a scene to splats of one image -------------------------------------
# First of all, positions are taken relative to the eye, so that float32 keeps its digits in scenes
# that are kilometres wide. Zwicker et al. 2001, "EWA volume splatting", with the clamps and
# thresholds of gsplat 1.5.3.


@dataclass(frozen=True, eq=False)
class Splats:
    """M Gaussians seen by one camera.

    ids: index of the Gaussian, counted through all parts.
    depths: z of the centre, metres.
    means2d: centre in the image, pixels.
    covs2d: xx, xy, yy of the blurred covariance, px^2.
    dets: determinant of that covariance, px^4.
    opacities: opacity after antialiasing.
    colors: display-encoded and >= 0, with the fog if there is any; None if no colour was asked for.
    overlay: 1 for a splat of an overlay, else 0.
    cuts: cut of a splat that is clipped at a height; None without a clip. First the value at
        means2d and its slopes in x and y, per px: clamp(value, 0, 1) is the share of alpha that is
        kept at a pixel. Then the growth of the surface's depth in x and y, its share per px (for an
        orthographic
        camera: metres per px), and the most that the depth may grow or shrink.
    lights: light of a splat that is lit pixel by pixel (augment.render.shading); None if no part
    is.
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
        """Return the fields that are not None, by name; one row per splat."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def select(self, index: Tensor) -> Splats:
        """Return the splats at the given indices or mask, in that order."""
        return dataclasses.replace(self, **{k: v[index] for k, v in self.columns().items()})

    def split(self, sizes: list[int] | int) -> list[Splats]:
        """Return consecutive runs of the splats, of the given sizes, as views."""
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
    """Return the splats of all parts that are in front of the camera and opaque enough.

    Args:
        parts: Gaussians with their poses.
        camera: the camera.
        settings: thresholds of the image.
        fog: fog that fades the colours; None for clear air.
        clip: height at which splats are cut; None for no cut.
        with_color: if False, colours and lights are not computed.

    Returns:
        Splats in the order of the Gaussians' indices.
    """
    part_splats: list[Splats] = []
    any_light = with_color and any(part.shading is not None for part in parts)
    first_id = 0
    for part in parts:
        part_splats.append(
            _project_part(part, first_id, camera, settings, fog, clip, with_color, any_light)
        )
        first_id += len(part.gaussians)
    if len(part_splats) == 1:
        return part_splats[0]
    columns = [splats.columns() for splats in part_splats]
    joined_columns = {name: torch.cat([column[name] for column in columns]) for name in columns[0]}
    return dataclasses.replace(part_splats[0], **joined_columns)


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
    """Return the splats of one part.

    Args:
        part: Gaussians with their pose.
        first_id: index of the part's first Gaussian, counted through all parts.
        camera: the camera.
        settings: thresholds of the image.
        fog: fog before the splats; None for clear air.
        clip: height at which splats are cut; None for no cut.
        with_color: if False, colours and lights are not computed.
        any_light: if True, some part is lit pixel by pixel, so every splat gets lights.
    """
    camera_from_part = camera.camera_from_world
    if part.world_from_part is not None:
        camera_from_part = camera_from_part @ part.world_from_part
    rotation = camera_from_part[:3, :3].to(part.gaussians.means.dtype)
    offsets = _offsets_from_eye(part.gaussians.means, camera_from_part)
    # The product is summed term by term: a matrix product may round the same mean differently at
    # another index, and ties would no longer be ties.
    x, y, z = offsets.unbind(1)
    depths = x * rotation[2, 0] + y * rotation[2, 1] + z * rotation[2, 2]
    is_drawn = (depths >= settings.near_m) & (part.gaussians.opacities >= ALPHA_MIN)
    index = torch.nonzero(is_drawn).squeeze(-1)

    # Centres in the camera, and their ellipses in the image.
    gaussians = part.gaussians.select(index)
    offsets = offsets[index]
    depths = depths[index]
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
    # Colour, then the light and the cut of parts that have them.
    colors = None
    if with_color:
        view_directions = rotation[2].expand_as(offsets) if camera.is_orthographic else offsets
        rows = None if part.color_map_rows is None else part.color_map_rows[index]
        colors = _colors(gaussians, rows, view_directions, part, camera, settings, fog)
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
        cuts, has_kept_part = _cut(heights, axes, points, camera, clip)
        splats = dataclasses.replace(splats, cuts=cuts).select(has_kept_part)
    if settings.radius_clip_px > 0:
        splats = splats.select(half_extents(splats).amax(1) > settings.radius_clip_px)
    return splats


def half_extents(splats: Splats) -> Float[Tensor, "M 2"]:
    """Return half the width and height, px, of the boxes in which alpha can reach 1/255."""
    opacities = splats.opacities.detach()
    covs2d = splats.covs2d.detach()
    sigmas = torch.sqrt(2 * torch.log(opacities / ALPHA_MIN).clamp_min(0))
    return sigmas.clamp_max(MAX_EXTENT_SIGMAS)[:, None] * torch.sqrt(covs2d[:, ::2])


def _heights(
    gaussians: Gaussians, offsets: Tensor, part: PosedGaussians, camera: Camera, clip: HeightClip
) -> Float[Tensor, "M"]:
    """Return the heights of the means above the clip's plane, metres.

    They are sums of the eye's height and the height over the eye, so that float32 keeps its digits.
    """
    rise = torch.tensor(clip.up, dtype=torch.float64)
    if part.world_from_part is not None:
        rise = rise @ part.world_from_part[:3, :3]
    return offsets @ rise.to(offsets.dtype) + clip.height_above(camera.centre.tolist())


def _cut(
    heights: Float[Tensor, "M"],
    axes: Float[Tensor, "M 3 3"],
    points: Float[Tensor, "M 3"],
    camera: Camera,
    clip: HeightClip,
) -> tuple[Float[Tensor, "M 6"], Tensor]:
    """Return the cut of every splat and a mask of the splats that have a part on the kept side.

    heights: heights of the means, positive on the kept side, metres.
    """
    rise = torch.tensor(clip.up, dtype=torch.float64)
    up = (clip.sign * (camera.camera_from_world[:3, :3] @ rise)).to(axes.dtype)
    reach = MAX_EXTENT_SIGMAS * (up @ axes).norm(dim=-1)
    gx, gy = _depth_slope(*_image_axes(points, axes, camera), axes[:, 2])
    divisors = _divisors(points, camera)
    fall = clip.sign * clip.height_above(camera.centre.tolist()) / divisors**2
    max_growth = MAX_DEPTH_GROWTH
    if camera.is_orthographic:
        fall = -up[2]
        max_growth = math.inf
    slope = torch.stack([up[0] / camera.fx - fall * gx, up[1] / camera.fy - fall * gy], -1)
    length = slope.norm(dim=-1).clamp_min(1e-20)
    offset = (heights / divisors / length).clamp(-FAR_PX, FAR_PX)
    growth_limit = (MAX_EXTENT_SIGMAS * axes[:, 2].norm(dim=-1) / divisors).clamp_max(max_growth)
    is_uncut = heights >= reach
    offset = torch.where(is_uncut, torch.full_like(offset, FAR_PX), offset) + clip.edge_px
    slope = torch.where(is_uncut[:, None], torch.zeros_like(slope), slope / length[:, None])
    cuts = torch.cat(
        [offset[:, None], slope, torch.stack([gx / divisors, gy / divisors, growth_limit], -1)], 1
    )
    return cuts, (heights >= -reach) & (heights - reach <= clip.max_distance_m)


def _depth_slope(
    right: Float[Tensor, "M 3"], down: Float[Tensor, "M 3"], away: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, "M"], Float[Tensor, "M"]]:
    """Return g = S2^-1 c (augment.render.layout) per px right and down, from semi-axes.

    Determinants are written as products of cross products (Lagrange, Binet-Cauchy). For needles,
    and for sheets seen edge-on, all digits would cancel otherwise, even in float64.
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
    """Return the means minus the camera's centre, in the part's axes.

    The centre is the point that the transform takes to the origin. This also holds where a rotation
    read from a file is orthonormal to seven digits only. The centre is subtracted in two steps,
    since it rarely is a float32 number.
    """
    eye = torch.linalg.solve(camera_from_part[:3, :3], -camera_from_part[:3, 3])
    coarse = eye.to(means.dtype)
    return (means - coarse) - (eye - coarse).to(means.dtype)


def _project_points(points: Float[Tensor, "M 3"], camera: Camera) -> Float[Tensor, "M 2"]:
    """Return the image positions of points in the camera, pixels."""
    x = points[:, 0]
    y = points[:, 1]
    divisors = _divisors(points, camera)
    return torch.stack(
        [camera.fx * x / divisors + camera.cx, camera.fy * y / divisors + camera.cy], -1
    )


def _divisors(points: Float[Tensor, "M 3"], camera: Camera) -> Float[Tensor, "M"]:
    """Return the divisor of x and y in the projection: z, or 1 for parallel rays."""
    z = points[:, 2]
    return torch.ones_like(z) if camera.is_orthographic else z


def _project_covariances(
    points: Float[Tensor, "M 3"], axes: Float[Tensor, "M 3 3"], camera: Camera
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]:
    """Return the unblurred covariances (xx, xy, yy), px^2, and their determinants.

    The projection is linearised at the splat's centre. If the centre lies outside a margin around
    the image, the nearest point within the margin is used instead.

    Args:
        points: centres in the camera, metres.
        axes: matrices whose columns are the semi-axes in the camera, metres.
        camera: the camera.
    """
    right, down = _image_axes(points, axes, camera)
    covs2d = torch.stack([(right * right).sum(1), (right * down).sum(1), (down * down).sum(1)], -1)
    # Lagrange's identity: xx yy - xy^2 without its cancellation, which needles would suffer from.
    return covs2d, torch.linalg.cross(right, down).square().sum(1)


def _image_axes(
    points: Float[Tensor, "M 3"], axes: Float[Tensor, "M 3 3"], camera: Camera
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Return the semi-axes in the image, px right and px down."""
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
    """Return max(SH + 0.5, 0), mapped and faded by the fog.

    Args:
        gaussians: Gaussians of one part that are projected.
        rows: row of the part's colour maps for every Gaussian; None if all use the first.
        offsets: vectors from the eye, in the part's axes; without fog their lengths do not matter.
        part: the part.
        camera: the camera.
        settings: thresholds of the image.
        fog: fog before the splats; None for clear air.
    """
    directions = torch.nn.functional.normalize(offsets, dim=-1)
    colors = (evaluate_sh(gaussians.sh, directions, settings.sh_degree) + 0.5).clamp_min(0)
    if part.color_maps is not None:
        colors = _map_colors(colors, part.color_maps.to(colors.dtype), rows)
    if fog is None:
        return colors
    return blend_airlight(colors, _optical_depths(gaussians, offsets, part, camera, fog), fog)


def _map_colors(
    colors: Float[Tensor, "M 3"], maps: Float[Tensor, "C 3 4"], rows: Int16[Tensor, "M"] | None
) -> Float[Tensor, "M 3"]:
    """Return every colour under its colour map, not below 0.

    A row that is not among the maps means the first map.
    """
    if rows is None:
        return (colors @ maps[0, :, :3].T + maps[0, :, 3]).clamp_min(0)
    index = torch.where((rows >= 0) & (rows < len(maps)), rows, 0).long()
    splat_maps = maps[index]
    return (torch.einsum("mij,mj->mi", splat_maps[..., :3], colors) + splat_maps[..., 3]).clamp_min(
        0
    )


def _optical_depths(
    gaussians: Gaussians,
    offsets: Float[Tensor, "M 3"],
    part: PosedGaussians,
    camera: Camera,
    fog: Fog,
) -> Float[Tensor, "M"]:
    """Return the optical depth of the fog before every splat."""
    heights = None
    if fog.scale_height_m is not None:
        heights = gaussians.means[:, 2]
        if part.world_from_part is not None:
            heights = transform_points(part.world_from_part, gaussians.means)[:, 2]
    tau = optical_depth(fog, offsets.norm(dim=-1), float(camera.centre[2]), heights)
    if fog.banks is None:
        return tau
    if part.world_from_part is not None:
        offsets = offsets @ part.world_from_part[:3, :3].T.to(offsets)
    return tau * point_means(fog, camera, offsets)


def _lights(
    part: PosedGaussians,
    index: Int64[Tensor, "M"],
    rotation: Float[Tensor, "3 3"],
    points: Float[Tensor, "M 3"],
    camera: Camera,
) -> Float[Tensor, "M 9"]:
    """Return the shading lines of a lit part's splats (augment.render.shading).

    points: centres of the splats in the camera, metres.
    """
    assert part.shading is not None
    normals = rotmat_from_quat(part.gaussians.quats[index])[:, :, 2] @ rotation.T
    sun = rotation @ torch.tensor(part.shading.sun, dtype=rotation.dtype)
    view_directions = torch.tensor([0.0, 0, 1]).to(points).expand_as(points)
    view_directions = view_directions if camera.is_orthographic else points
    slopes = part.shading.slopes[index].to(rotation.dtype)
    return shading_lines(normals, view_directions, slopes, sun, part.shading.wrap, camera)


def order_by_depth(splats: Splats) -> Splats:
    """Return the splats nearest first by float32 z, whatever the dtype.

    Splats of equal depth stay in index order.
    """
    return splats.select(torch.argsort(splats.depths.detach().float(), stable=True))


# Side of a tile, pixels.
TILE = 16
# Splats of a tile that are blended at once. 256 pixels x 96 splats stay in a core's cache, and
# torch keeps so few values on one thread. Several threads would cost more than the work, far more
# if the cores are busy. This is also why exp2 and sums are used below instead of exp and matrix
# products, which go to a library that wakes its threads for any size.
BLOCK = 96
# log2 of e, which turns exp into exp2.
LOG2_E = math.log2(math.e)
# Transmittance that defines median depth: the depth where transmittance falls below it.
MEDIAN = 0.5


@dataclass(frozen=True, eq=False)
class TileLists:
    """The splats that each tile blends.

    tile_splat_ids [E]: splat indices, tile after tile, each tile's in the order of the splats.
    tile_offsets [tiles + 1]: position in tile_splat_ids at which the list of tile i (row by row)
    begins.
    columns: number of tile columns.
    rows: number of tile rows.
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
    """Return the image of the parts: project, order, blend. `rasterize` checks the arguments.

    The result is differentiable with respect to all float tensors of the Gaussians. The cut-offs
    (order, alpha threshold, transmittance stop) are taken as constant.
    """
    with_color = RGB in buffers
    splats = project_parts(parts, camera, settings, fog, clip, with_color=with_color)
    splats = order_by_depth(splats)
    return blend(splats, bin_to_tiles(splats, camera), camera, buffers, settings)


def bin_to_tiles(splats: Splats, camera: Camera) -> TileLists:
    """Return every tile's splats: those whose box, in which alpha can reach 1/255, touches the
    tile.
    """
    columns = -(-camera.width // TILE)
    rows = -(-camera.height // TILE)
    x0, x1 = _tile_span(splats, 0, columns)
    y0, y1 = _tile_span(splats, 1, rows)
    widths = (x1 - x0).clamp_min(0)
    counts = widths * (y1 - y0).clamp_min(0)
    counts[splats.opacities < ALPHA_MIN] = 0  # antialiasing may have lowered them
    splat_ids = torch.repeat_interleave(counts)  # [E]
    tile_in_box = torch.arange(len(splat_ids)) - (counts.cumsum(0) - counts)[splat_ids]
    tiles = (
        (y0[splat_ids] + tile_in_box // widths[splat_ids]) * columns
        + x0[splat_ids]
        + tile_in_box % widths[splat_ids]
    )
    order = torch.argsort(tiles, stable=True)
    tile_offsets = torch.searchsorted(tiles[order], torch.arange(columns * rows + 1))
    return TileLists(splat_ids[order], tile_offsets, columns, rows)


def _tile_span(splats: Splats, axis: int, tiles: int) -> tuple[Tensor, Tensor]:
    """Return the first tile and one past the last of each splat's box, along x (axis 0) or y (axis
    1).
    """
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
    """Return buffers [H, W] of ordered splats. Tiles are blended one by one, which takes little
    memory.
    """
    needs_checkpoint = torch.is_grad_enabled() and any(
        value.requires_grad for value in splats.columns().values()
    )
    sizes = lists.tile_offsets.diff().tolist()
    tiles = []
    # Gathered once: taking each tile's splats from all of them would make every backward step of a
    # tile as long as the scene.
    for tile, tile_splat_ids in enumerate(splats.select(lists.tile_splat_ids).split(sizes)):
        args = (tile_splat_ids, divmod(tile, lists.columns), buffers, settings, camera)
        if needs_checkpoint and len(
            tile_splat_ids
        ):  # a backward pass would else keep every splat x pixel
            tiles.append(
                checkpoint(blend_tile, *args, use_reentrant=False, preserve_rng_state=False)
            )
        else:
            tiles.append(blend_tile(*args))
    images = {name: _assemble([getattr(t, name) for t in tiles], lists, camera) for name in buffers}
    if needs_checkpoint and len(lists.tile_splat_ids) == 0:
        # A view of nothing is a function of the splats too: its gradients are 0, not an error.
        floats = [value for value in splats.columns().values() if value.is_floating_point()]
        zero_sum = torch.stack([value[:0].sum() for value in floats]).sum()
        images = {n: i + zero_sum if i.is_floating_point() else i for n, i in images.items()}
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
    """Return buffers [TILE, TILE] of one tile.

    Args:
        splats: splats of the tile, nearest first.
        tile: row and column of the tile.
        buffers: names of the buffers.
        settings: thresholds of the image.
        camera: the camera.
    """
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
    for block in splats.split(BLOCK) if len(splats) else ():
        weights, transmittance_behind = blend_weights(
            block, pixels, transmittance, settings
        )  # [S, P] both
        alpha = alpha + weights.sum(0)
        if block.colors is not None:
            rgb = rgb + _weighted_sums(weights, block.colors)
            if block.lights is not None:
                rgb = rgb + _lit_colors(block, pixels, weights, camera)
        if OVERLAY in buffers:
            overlay = overlay + (weights * block.overlay[:, None]).sum(0)
        if buffers & {EXPECTED_DEPTH, MODE_DEPTH}:
            surfaces = _surface_depths(block, pixels, camera.is_orthographic)
            depth = depth + (weights * surfaces).sum(0)
            if MODE_DEPTH in buffers:
                for row in torch.nonzero(weights.detach().any(1))[:, 0].tolist():
                    clusters = clusters.add(
                        surfaces[row], weights[row], settings.mode_depth_floor_m
                    )
        if MEDIAN_DEPTH in buffers:
            median = median + _median_depths(
                block.depths, weights, transmittance_behind, transmittance
            )
        if SPLAT_IDS in buffers:
            weight = weights.detach().amax(0)
            rows = torch.arange(len(block))[:, None]
            row = torch.where(weights == weight, rows, len(block)).amin(0)  # the first of equals
            ids = torch.where(weight > heaviest, block.ids[row], ids)
            heaviest = torch.maximum(heaviest, weight)
        transmittance = transmittance_behind[-1]
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
    tile_images = {
        name: values[name].reshape(TILE, TILE, *values[name].shape[1:]) for name in buffers
    }
    return RenderOutput(**tile_images)


def blend_weights(
    splats: Splats,
    pixels: Float[Tensor, "2 P"],
    transmittance: Float[Tensor, "P"],
    settings: RasterSettings,
) -> tuple[Float[Tensor, "S P"], Float[Tensor, "S P"]]:
    """Return the weight of every splat at every pixel, and the transmittance behind it.

    Transmittance never grows. So the splats that are not blended are those that stand behind the
    stop, and the one that would leave at most TRANSMITTANCE_STOP, or the stop if that is less
    (RasterSettings).

    Args:
        splats: splats of a tile, nearest first.
        pixels: x and y of the pixels' centres.
        transmittance: transmittance in front of the first splat.
        settings: thresholds of the image.
    """
    dx = pixels[0] - splats.means2d[:, :1]  # [S, P]
    dy = pixels[1] - splats.means2d[:, 1:]
    sigma = _sigmas(splats, dx, dy)
    alphas = (splats.opacities[:, None] * torch.exp2(-LOG2_E * sigma)).clamp_max(settings.alpha_max)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, torch.zeros_like(alphas))
    if splats.cuts is not None:
        value_at_mean, slope_x, slope_y = splats.cuts.T[:3, :, None]
        alphas = alphas * (value_at_mean + slope_x * dx + slope_y * dy).clamp(0, 1)
    transmittance_behind = transmittance * torch.cumprod(1 - alphas, 0)
    transmittance_before = torch.cat([transmittance[None], transmittance_behind[:-1]])
    stop = settings.transmittance_stop
    is_blended = (transmittance_behind > min(stop, TRANSMITTANCE_STOP)) & (
        transmittance_before > stop
    )
    weights = torch.where(is_blended, alphas * transmittance_before, torch.zeros_like(alphas))
    return weights, transmittance_behind


def _lit_colors(
    splats: Splats, pixels: Float[Tensor, "2 P"], weights: Float[Tensor, "S P"], camera: Camera
) -> Float[Tensor, "P 3"]:
    """Return the light that splats lit pixel by pixel add to the colours."""
    assert splats.lights is not None
    dx = pixels[0] - splats.means2d[:, :1]
    dy = pixels[1] - splats.means2d[:, 1:]
    log_contrast = torch.log(splats.opacities / ALPHA_MIN).clamp_min(TINY)[:, None]
    rim_share = (_sigmas(splats, dx, dy) / log_contrast).clamp(0, 1)
    share = light_share(splats.lights, dx, dy, rim_share, camera)
    return _weighted_sums(weights * share, splats.lights[:, 6:])


def _sigmas(
    splats: Splats, dx: Float[Tensor, "S P"], dy: Float[Tensor, "S P"]
) -> Float[Tensor, "S P"]:
    """Return half the squared Mahalanobis distance of pixels at (dx, dy) from the means."""
    # [S, 1]
    xy = splats.covs2d[:, 1:2]
    yy = splats.covs2d[:, 2:3]
    # d^T cov^-1 d with the square completed: never negative, in whatever precision.
    offset_along_row = dx - (xy / yy) * dy
    return 0.5 * (offset_along_row * offset_along_row * (yy / splats.dets[:, None]) + dy * dy / yy)


def _surface_depths(
    splats: Splats, pixels: Float[Tensor, "2 P"], is_orthographic: bool
) -> Float[Tensor, "S P"]:
    """Return z of every splat at every pixel: of its centre, or with a clip of its surface."""
    depths = splats.depths[:, None].expand(-1, pixels.shape[1])
    if splats.cuts is None:
        return depths
    slope_x, slope_y, max_growth = splats.cuts.T[3:, :, None]
    dx = pixels[0] - splats.means2d[:, :1]
    dy = pixels[1] - splats.means2d[:, 1:]
    growth = (slope_x * dx + slope_y * dy).clamp(-max_growth, max_growth)
    return depths + growth if is_orthographic else depths / (1 - growth)


def _weighted_sums(
    weights: Float[Tensor, "S P"], colors: Float[Tensor, "S 3"]
) -> Float[Tensor, "P 3"]:
    """Return weights^T colors without a matrix product (see BLOCK)."""
    return torch.stack([(weights * channel[:, None]).sum(0) for channel in colors.unbind(1)], -1)


def _median_depths(
    depths: Float[Tensor, "S"],
    weights: Float[Tensor, "S P"],
    transmittance_behind: Float[Tensor, "S P"],
    transmittance: Float[Tensor, "P"],
) -> Float[Tensor, "P"]:
    """Return z of the splat of this block that brings transmittance below one half.

    It is 0 where no splat of the block does.
    """
    row = (transmittance_behind >= MEDIAN).sum(0)
    is_inside = row < len(depths)
    row = row.clamp_max(len(depths) - 1)
    is_blended = weights.gather(0, row[None])[0] > 0
    is_crossing = is_inside & is_blended & (transmittance >= MEDIAN)
    return torch.where(is_crossing, depths[row], torch.zeros_like(depths[row]))
