"""The torch definition of what a pixel of water shows: the bed through the surface, and what the
surface reflects.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood.flood import FloodMedium, Layer
from augment.effects.flood.screen_space import ScreenReflection
from augment.effects.flood.water_kernels import (
    BED_STEPS,
    EDGE,
    FAINT,
    FARTHEST,
    MATCH_M,
    MATCH_SHARE,
    MAX_OPTICAL_DEPTH,
    MIN_COSINE,
    MIN_DEPTH,
    SETTLED_M,
    SOLID_ALPHA,
    STEEPEST,
)
from augment.effects.flood.water_plane import window_offset
from augment.effects.flood.waves import WaveField
from augment.render.composite import sky_behind
from augment.render.fog import Fog, optical_depth, vertical_optical_depth
from augment.sky import Sky

# ---- What a layer's image shows in a direction ---------------------------------------------------
# Image coordinates are (column, row) in pixels. Vectors are in world axes and start at the layer's
# optical centre.

MIP_LEVELS = 7  # blurs up to 64 pixels: three taps are seldom farther apart


def project(camera: Camera, vectors: Float[Tensor, "*B 3"]) -> tuple[Tensor, Tensor]:
    """Column and row of vectors that start at the optical centre; huge for those behind it."""
    local = vectors @ camera.camera_from_world[:3, :3].T.to(vectors.dtype)
    x, y, z = local.unbind(-1)
    z = z.clamp_min(MIN_DEPTH)
    return camera.fx * (x / z) + camera.cx, camera.fy * (y / z) + camera.cy


def is_inside(camera: Camera, column: Tensor, row: Tensor) -> Bool[Tensor, "*B"]:
    return (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)


def clamp_to(camera: Camera, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest coordinates between the centres of the image's outermost pixels."""
    return column.clamp(0.5, camera.width - 0.5), row.clamp(0.5, camera.height - 0.5)


def point_at(layer: Layer, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """(is there a surface, vector to it [*B, 3]) at the nearest pixel of coordinates inside."""
    c = column.clamp(0, layer.camera.width - 1).long()
    r = row.clamp(0, layer.camera.height - 1).long()
    solid = layer.alpha[r, c] >= SOLID_ALPHA
    depth = torch.where(solid, layer.depth[r, c], 0)  # depth is meaningless where nothing is
    rays = layer.camera.ray_directions(layer.depth.dtype)
    return solid, depth[..., None] * rays[r, c]


def stacked(layer: Layer) -> Float[Tensor, "H W 4"]:
    """Premultiplied colour and alpha in one image."""
    return torch.cat((layer.rgb, layer.alpha[..., None]), -1)


def bilinear(image: Float[Tensor, "H W C"], column: Tensor, row: Tensor) -> Float[Tensor, "*B C"]:
    """The image between its pixel centres; coordinates outside take the border's value."""
    height, width, _ = image.shape
    x, y = (column - 0.5).clamp(0, width - 1), (row - 0.5).clamp(0, height - 1)
    c0, r0 = x.long(), y.long()
    c1, r1 = (c0 + 1).clamp(max=width - 1), (r0 + 1).clamp(max=height - 1)
    fc, fr = (x - c0)[..., None], (y - r0)[..., None]
    top = image[r0, c0] * (1 - fc) + image[r0, c1] * fc
    bottom = image[r1, c0] * (1 - fc) + image[r1, c1] * fc
    return top * (1 - fr) + bottom * fr


def mip_chain(image: Float[Tensor, "H W C"]) -> list[Tensor]:
    """The image and its averages over 2 x 2 pixels, each from the last; odd borders count twice."""
    levels = [image]
    while len(levels) < MIP_LEVELS and max(levels[-1].shape[:2]) > 1:
        last = levels[-1]
        rows, columns = (torch.arange(0, size, 2) for size in last.shape[:2])
        below, right = (
            (rows + 1).clamp(max=len(last) - 1),
            (columns + 1).clamp(max=last.shape[1] - 1),
        )
        wide = (last[rows] + last[below]) / 2
        levels.append((wide[:, columns] + wide[:, right]) / 2)
    return levels


def blurred(
    levels: list[Tensor], column: Tensor, row: Tensor, spacing: Float[Tensor, "*B"]
) -> Float[Tensor, "*B C"]:
    """Bilinear from the mip level whose pixels are `spacing` wide (pixels), blended between two."""
    level = torch.log2(spacing.clamp(1, 2.0 ** (len(levels) - 1)))
    out = torch.zeros((*column.shape, levels[0].shape[-1]), dtype=column.dtype)
    for i, image in enumerate(levels):
        share = (1 - (level - i).abs()).clamp_min(0)
        out = out + share[..., None] * bilinear(image, column / 2**i, row / 2**i)
    return out


# ---- Where a camera's rays meet the water, and how the surface is tilted there -------------------
# Points are relative to the eye: float32 stays exact far from the world's origin.

SMOOTH_PX = 2.0  # reflections that a pixel's slopes spread over less are as good as sharp


@dataclass(frozen=True, eq=False)
class Surface:
    """What the pixels of a camera see of a plane `height_m` below the eye.

    meets: the ray goes down; where it does not, the rest is made up but finite. directions: rays
    with unit z in the camera. points: where they meet the plane. distance: from there to the eye.
    """

    height_m: float
    meets: Bool[Tensor, "H W"]
    directions: Float[Tensor, "H W 3"]
    points: Float[Tensor, "H W 3"]
    distance: Float[Tensor, "H W"]
    to_eye: Float[Tensor, "H W 3"]


def meet_plane(camera: Camera, level_z_m: float, dtype: torch.dtype) -> Surface:
    """The horizontal plane at level_z_m, below the eye, as the camera's rays meet it."""
    exact = camera.ray_directions(torch.float64)
    meets = exact[..., 2] < 0
    straight_down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    directions = torch.where(meets[..., None], exact, straight_down)
    height = float(camera.centre[2]) - level_z_m
    along = (height / -directions[..., 2]).clamp(max=FARTHEST)
    points = along[..., None] * directions
    points[..., 2] = -height
    length = directions.norm(dim=-1)
    return Surface(
        height,
        meets,
        directions.to(dtype),
        points.to(dtype),
        (along * length).to(dtype),
        (-directions / length[..., None]).to(dtype),
    )


def is_smooth(field: WaveField, camera: Camera) -> Bool[Tensor, "H W"]:
    """Where the slopes inside a pixel of `camera` hardly blur what it mirrors."""
    return field.slope_variance < smooth_variance(camera)


def smooth_variance(camera: Camera) -> float:
    """The slope variance V that spreads a reflection by 2 sqrt(3 V) fy = SMOOTH_PX pixels.

    A slope turns the mirrored ray by twice its angle; sqrt(3 V) is what `tilted_normals` takes.
    """
    return (SMOOTH_PX / (2 * camera.fy)) ** 2 / 3


def tilted_normals(
    surface: Surface, field: WaveField, smooth: Bool[Tensor, "H W"]
) -> list[tuple[Tensor, Tensor]]:
    """(weight [H, W], unit normal [H, W, 3]) of slopes that stand for all slopes in a pixel.

    Gauss-Hermite quadrature over the slope along the view's horizontal direction, whose variance is
    V: the pixel's own normal, the first, has weight 2/3, slopes sqrt(3 V) to either side 1/6 each.
    In smooth pixels the first alone counts.
    """
    dtype = surface.points.dtype
    nx, ny = field.normal_x.to(dtype), field.normal_y.to(dtype)
    variance = field.slope_variance.to(dtype)
    nz = torch.sqrt((1 - nx * nx - ny * ny).clamp_min(STEEPEST))
    horizontal = surface.to_eye[..., :2]
    # Seen straight from above the view has no horizontal direction: nothing is tilted then.
    horizontal = horizontal / horizontal.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    rough = ~smooth
    spread = torch.where(rough, torch.sqrt(3 * variance), 0)

    def normal(offset: Tensor) -> Tensor:
        slope = torch.stack((nx / nz, ny / nz), -1) + offset[..., None] * horizontal
        upright = torch.cat((slope, torch.ones_like(offset)[..., None]), -1)
        return torch.nn.functional.normalize(upright, dim=-1)

    if not bool(rough.any()):
        return [(torch.ones_like(spread), normal(spread))]
    side = torch.where(rough, torch.full_like(spread, 1 / 6), 0)
    return [
        (torch.where(rough, torch.full_like(spread, 2 / 3), 1), normal(0 * spread)),
        (side, normal(spread)),
        (side, normal(-spread)),
    ]


def mirrored(to_eye: Float[Tensor, "H W 3"], normal: Tensor) -> Float[Tensor, "H W 3"]:
    """Unit directions in which the surface mirrors the view, none below the horizon."""
    cosine = (normal * to_eye).sum(-1, keepdim=True)
    ray = 2 * cosine * normal - to_eye
    return _at_least_upward(ray)


def refracted(
    to_eye: Float[Tensor, "H W 3"], normal: Tensor, index: float
) -> Float[Tensor, "H W 3"]:
    """Unit directions of the view under the surface by Snell's law, all of them downward.

    t = -v / n + (c / n - sqrt(1 - (1 - c^2) / n^2)) normal
    """
    c = (normal * to_eye).sum(-1, keepdim=True).clamp_min(MIN_COSINE)
    inside = torch.sqrt((1 - (1 - c * c) / index**2).clamp_min(0))
    return -_at_least_upward(to_eye / index - (c / index - inside) * normal)


def _at_least_upward(ray: Tensor) -> Tensor:
    upward = ray[..., 2:].clamp_min(MIN_COSINE)
    return torch.nn.functional.normalize(torch.cat((ray[..., :2], upward), -1), dim=-1)


# ---- The bed as seen through the surface ---------------------------------------------------------


def through_the_surface(
    surface: Surface,
    normal: Float[Tensor, "H W 3"],
    camera: Camera,
    medium: FloodMedium,
    bed: Layer,
    fog: Fog | None,
) -> Float[Tensor, "H W 3"]:
    """Colour of the light that comes up through the surface: T = a bed + (1 - a) water.

    The search along the refracted ray starts from the bed straight behind the pixel, which is taken
    where it leaves the bed's image or meets a hole; the water's own colour where there is no bed
    behind the pixel, or too deep to be seen.
    """
    water = water_color(surface, camera, medium, fog)
    own_column, own_row = _own_pixel(bed.camera, camera, normal.dtype)
    own_inside = is_inside(bed.camera, own_column, own_row)
    own_solid, own_point = point_at(bed, own_column, own_row)
    own_solid = own_solid & own_inside
    own_depth = _depth_below(surface, own_point)
    extinction = torch.tensor(medium.extinction_per_m, dtype=normal.dtype)
    bends = medium.refraction_index != 1
    ray = -surface.to_eye  # nothing bends, whatever the waves
    if bends:
        ray = refracted(surface.to_eye, normal, medium.refraction_index)
    opaque = _optical_depth(own_depth / -ray[..., 2], extinction.min())
    own_solid = own_solid & (opaque < MAX_OPTICAL_DEPTH)
    image = stacked(bed)
    own_colors = bilinear(image, own_column, own_row)
    found, depth, colors = own_solid, own_depth, own_colors
    if bends:
        found, depth, colors = _search(surface, ray, bed, image, own_solid, own_depth)
    depth = torch.where(found, depth, own_depth)
    colors = torch.where(found[..., None], colors, own_colors)
    colors = torch.where(own_solid[..., None], colors, 0)
    length = torch.where(own_solid, depth / -ray[..., 2], 0)[..., None]
    a = torch.exp(-_optical_depth(length, extinction))
    return a * (colors[..., :3] + (1 - colors[..., 3:]) * water) + (1 - a) * water


def _search(
    surface: Surface, ray: Tensor, bed: Layer, image: Tensor, found: Tensor, depth: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(found, depth below the plane, colour and alpha) of the bed along refracted rays."""
    per_depth = ray / -ray[..., 2:]
    going = found
    for _ in range(BED_STEPS):
        column, row = project(bed.camera, surface.points + depth[..., None] * per_depth)
        solid, point = point_at(bed, column, row)
        found = found & (~going | (is_inside(bed.camera, column, row) & solid))
        going = going & found
        last, depth = depth, torch.where(going, _depth_below(surface, point), depth)
        going = going & ((depth - last).abs() > SETTLED_M)
    column, row = project(bed.camera, surface.points + depth[..., None] * per_depth)
    colors = bilinear(image, column, row)
    found = found & is_inside(bed.camera, column, row) & (colors[..., 3] >= SOLID_ALPHA)
    return found, depth, colors


def _optical_depth(length: Tensor, extinction_per_m: Tensor) -> Tensor:
    return torch.where(length > 0, extinction_per_m * length, 0)  # infinity times no way is none


def _own_pixel(outer: Camera, inner: Camera, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    left, top = window_offset(outer, inner)
    row = torch.arange(inner.height, dtype=dtype) + (top + 0.5)
    column = torch.arange(inner.width, dtype=dtype) + (left + 0.5)
    row, column = torch.meshgrid(row, column, indexing="ij")
    return column, row


def _depth_below(surface: Surface, point: Tensor) -> Float[Tensor, "H W"]:
    """Metres of points below the plane, 0 above it. point: relative to the eye."""
    return (-surface.height_m - point[..., 2]).clamp_min(0)


def water_color(
    surface: Surface, camera: Camera, medium: FloodMedium, fog: Fog | None
) -> Float[Tensor, "H W 3"]:
    """Deep water's own colour, seen through the fog before it."""
    dtype = surface.points.dtype
    own = torch.tensor(medium.rgb, dtype=dtype).expand(surface.points.shape)
    if fog is None:
        return own
    t = torch.exp(-fog_before(surface, camera, medium.level_z_m, fog))[..., None]
    return t * own + (1 - t) * torch.tensor(fog.rgb, dtype=dtype)


def fog_before(
    surface: Surface, camera: Camera, level_z_m: float, fog: Fog
) -> Float[Tensor, "H W"]:
    """Optical depth of the fog between the eye and the surface."""
    level = torch.full_like(surface.distance, level_z_m)
    return optical_depth(fog, surface.distance, float(camera.centre[2]), level)


# ---- What the surface reflects: the sky, the mirrored layer, the image itself --------------------

Colours = list[Tensor]  # one [H, W, 3], or 4 with alpha, for each of a pixel's normals


def reflect_sky(
    surface: Surface,
    rays: list[Tensor],
    camera: Camera,
    level_z_m: float,
    sky: Sky,
    fog: Fog | None,
) -> Colours:
    """The sky in unit directions that climb, through the fog before it and before the surface."""
    seen, layered = sky_behind(sky, fog)
    colors = [seen.sample(ray) for ray in rays]
    if layered is None:
        return colors
    near = fog_before(surface, camera, level_z_m, layered)
    above = vertical_optical_depth(layered, level_z_m)
    airlight = torch.tensor(layered.rgb, dtype=near.dtype)
    transmittances = [torch.exp(-(near + above / ray[..., 2]))[..., None] for ray in rays]
    pairs = zip(transmittances, colors, strict=True)
    return [t * color + (1 - t) * airlight for t, color in pairs]


def reflect_mirror(
    surface: Surface, rays: list[Tensor], mirror: Layer, smooth: Bool[Tensor, "H W"]
) -> Colours:
    """The mirrored layer's colours and alphas.

    A ray's length is first that of the flat mirror's ray, then what the layer shows where the
    tilted ray of that length ends. All of a pixel's rays take the length of the first.
    """
    to_mirror = torch.tensor([0.0, 0.0, -2 * surface.height_m], dtype=surface.points.dtype)
    flat = surface.directions * torch.tensor([1.0, 1.0, -1.0], dtype=surface.points.dtype)

    def end_of(ray: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
        far = distance.isinf()
        end = surface.points + torch.where(far, 0, distance)[..., None] * ray - to_mirror
        vector = torch.where(far[..., None], ray, end)
        return clamp_to(mirror.camera, *project(mirror.camera, vector))

    def distance_at(column: Tensor, row: Tensor) -> Tensor:
        solid, point = point_at(mirror, column, row)
        distance = (point + to_mirror - surface.points).norm(dim=-1)
        return torch.where(solid, distance, torch.inf)

    first = distance_at(*clamp_to(mirror.camera, *project(mirror.camera, flat)))
    distance = distance_at(*end_of(rays[0], first))
    return _fetch(mirror, [end_of(ray, distance) for ray in rays], smooth)


def reflect_screen(
    surface: Surface,
    ray: Float[Tensor, "H W 3"],
    screen: ScreenReflection,
    smooth: Bool[Tensor, "H W"],
    rest: Tensor,
) -> Float[Tensor, "H W 4"]:
    """What the image itself shows where the rays of smooth pixels end; `rest` elsewhere."""
    camera = screen.layer.camera
    column, row, matches = _end_in_image(surface, ray, screen)
    matches = matches & is_inside(camera, column, row) & smooth
    across = torch.minimum(column, camera.width - column) / camera.width
    down = torch.minimum(row, camera.height - row) / camera.height
    x = (torch.minimum(across, down) / EDGE).clamp(0, 1)
    fade = x * x * (3 - 2 * x)
    weight = torch.where(matches, screen.weight * fade, 0)[..., None]
    seen = bilinear(stacked(screen.layer), *clamp_to(camera, column, row))
    return weight * seen + (1 - weight) * rest


def before_sky(seen: Float[Tensor, "H W 4"], sky: Float[Tensor, "H W 3"]) -> Tensor:
    """Premultiplied colours and alphas before a sky, which is left out where it hardly shows."""
    color, alpha = seen[..., :3], seen[..., 3:]
    opaque = 1 - alpha <= FAINT
    return torch.where(opaque, color / alpha.clamp_min(0.5), color + (1 - alpha) * sky)


def _end_in_image(
    surface: Surface, ray: Tensor, screen: ScreenReflection
) -> tuple[Tensor, Tensor, Tensor]:
    """(column, row, does the image show there what the ray ends at)."""
    layer, far = screen.layer, screen.distance.isinf()
    forward = layer.camera.camera_from_world[2, :3].to(ray.dtype)

    def look(distance: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        end = surface.points + distance[..., None] * ray
        column, row = project(layer.camera, torch.where(far[..., None], ray, end))
        solid, point = point_at(layer, column, row)
        ahead = end @ forward
        matches = (point @ forward - ahead).abs() < (MATCH_SHARE * ahead).clamp_min(MATCH_M)
        return column, row, solid, point, matches

    distance = torch.where(far, 0, screen.distance)
    _, _, solid, point, _ = look(distance)
    corrected = (point - surface.points).norm(dim=-1)
    column, row, solid, _, matches = look(torch.where(solid, corrected, distance))
    return column, row, torch.where(far, ~solid, solid & matches)


def _fetch(
    layer: Layer, places: list[tuple[Tensor, Tensor]], smooth: Bool[Tensor, "H W"]
) -> Colours:
    """Colour and alpha at every normal's coordinates; of several, each sees an average as wide as
    they lie apart: single points would show as so many ghosts.
    """
    image = stacked(layer)
    (column, row), *sides = places
    if not sides:
        return [bilinear(image, column, row)]
    apart = [torch.hypot(c - column, r - row) for c, r in sides]
    spacing = torch.where(smooth, 1, torch.stack(apart).mean(0))
    levels = mip_chain(image)
    return [blurred(levels, c, r, spacing) for c, r in places]
