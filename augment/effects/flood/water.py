"""A water surface's picture: what it reflects, and what is seen through it. The torch definition,
and the launch of the CPU's kernel.

    water = sum_i w_i F_i R_i + (1 - sum_i w_i F_i) T

i runs over the slopes inside a pixel; F: reflected share of the light, R: what comes from the
mirrored direction, T: what comes up through the surface.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood import water_kernels as kernels
from augment.effects.flood.flood import FloodMedium, Layer, reflectance
from augment.effects.flood.screen_space import ScreenReflection
from augment.effects.flood.water_kernels import (
    BED_STEPS,
    EDGE,
    FAINT,
    FARTHEST,
    HIDDEN_COVER,
    MATCH_M,
    MATCH_SHARE,
    MIN_COSINE,
    MIN_DEPTH,
    SETTLED_M,
    SOLID_ALPHA,
    STEEPEST,
)
from augment.effects.flood.water_plane import image_coordinates, places_in
from augment.effects.flood.waves import WaveField
from augment.memo import memo_of
from augment.render.buffers import CPU, kernels_for
from augment.render.composite import sky_behind
from augment.render.fog import Fog, blend_airlight, optical_depth, vertical_optical_depth
from augment.render.threads import kernel_threads
from augment.sky import (
    ConstantSky,
    CubemapSky,
    LatLongSky,
    Sky,
    bordered_faces,
    directions_of_cubemap,
    sample_at,
    with_border,
)


class Water(NamedTuple):
    """What `shade_water` is given; fog is None where it has no density."""

    camera: Camera
    cover: Float[Tensor, "h w"]
    medium: FloodMedium
    field: WaveField
    bed: Layer
    mirror: Layer | None
    screen: ScreenReflection | None
    sky: Sky
    fog: Fog | None


def shade_water(
    camera: Camera,
    cover: Float[Tensor, "h w"],
    medium: FloodMedium,
    field: WaveField,
    bed: Layer,
    *,
    mirror: Layer | None = None,
    screen: ScreenReflection | None = None,
    sky: Sky,
    fog: Fog | None = None,
    backend: str = CPU,
) -> Float[Tensor, "h w 3"]:
    """Colour of the water where the camera's rays meet it, not clamped; 0 where they do not.

    cover: alpha of what stands before the water; above HIDDEN_COVER the result is the water's own
    colour, or the fog's. bed: from a window of the same image. mirror: from the mirrored eye.
    screen: serves the smooth pixels. Layers are fogged already; fog here dims the sky and the
    water's own colour. backend: the CPU's kernel equals the definition within float rounding.

    Raises:
        ValueError: the bed's camera and this one are not windows of one image.
    """
    if fog is not None and fog.sigma_per_m == 0:
        fog = None
    water = Water(camera, cover, medium, field, bed, mirror, screen, sky, fog)
    layers = (bed, mirror, None if screen is None else screen.layer)
    images = [(i.rgb, i.alpha, i.depth) for i in layers if i is not None]
    if kernels_for(backend, cover, *(part for parts in images for part in parts)) == CPU:
        return _run_kernel(water)
    surface = meet_plane(camera, medium.level_z_m, bed.rgb)
    smooth = is_smooth(field, camera)
    weights, normals = tilted_normals(surface, field, smooth)
    below = through_the_surface(surface, normals[0], water)
    out = below
    if medium.refraction_index != 1:
        rays = mirrored(surface.to_eye, normals)
        seen = below.new_zeros(*weights.shape, 4)
        if mirror is not None:
            seen = reflect_mirror(surface, rays, mirror, smooth)
        if screen is not None:
            image = reflect_screen(surface, rays[0], screen, smooth, seen[0])
            seen = torch.cat((image[None], seen[1:]))
        # Facets that look away from the eye count as seen edge-on.
        cosine = (normals * surface.to_eye).sum(-1).clamp(MIN_COSINE, 1)
        share = weights * reflectance(cosine, medium.refraction_index, medium.fresnel)
        color = before_sky(seen, reflect_sky(surface, rays, water))
        out = below + (share[..., None] * (color - below)).sum(0)
    plain = _tensor(medium.rgb if fog is None else fog.rgb, out)
    out = torch.where((cover <= HIDDEN_COVER)[..., None], out, plain)
    return torch.where(surface.meets[..., None], out, 0)


def _tensor(numbers: tuple[float, ...], like: Tensor) -> Tensor:
    return torch.tensor(numbers, dtype=like.dtype, device=like.device)


# ---- What a layer's image shows in a direction ---------------------------------------------------
# Image coordinates are (column, row) in pixels. Vectors are in world axes and start at the layer's
# optical centre.

MIP_LEVELS = 7  # blurs up to 64 pixels: three taps are seldom farther apart


def project(camera: Camera, vectors: Float[Tensor, "*B 3"]) -> tuple[Tensor, Tensor]:
    """Column and row of vectors that start at the optical centre; huge for those behind it."""
    local = vectors @ _axes(camera, vectors).T
    x, y, z = local.unbind(-1)
    z = z.clamp_min(MIN_DEPTH)
    return camera.fx * (x / z) + camera.cx, camera.fy * (y / z) + camera.cy


def is_inside(camera: Camera, column: Tensor, row: Tensor) -> Bool[Tensor, "*B"]:
    return (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)


def clamp_to(camera: Camera, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest coordinates between the centres of the image's outermost pixels."""
    return column.clamp(0.5, camera.width - 0.5), row.clamp(0.5, camera.height - 0.5)


def _axes(camera: Camera, like: Tensor) -> Float[Tensor, "3 3"]:
    return camera.camera_from_world[:3, :3].to(like.device, like.dtype)


def point_at(layer: Layer, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """(is there a surface, vector to it [*B, 3]) at the nearest pixel of coordinates inside."""
    camera = layer.camera
    column = column.clamp(0, camera.width - 1).long()
    row = row.clamp(0, camera.height - 1).long()
    solid = layer.alpha[row, column] >= SOLID_ALPHA
    depth = torch.where(solid, layer.depth[row, column], 0)  # meaningless where nothing is
    x = (column + (0.5 - camera.cx)) * depth / camera.fx
    y = (row + (0.5 - camera.cy)) * depth / camera.fy
    return solid, torch.stack((x, y, depth), -1) @ _axes(camera, depth)


def stacked(layer: Layer) -> Float[Tensor, "H W 4"]:
    """Premultiplied colour and alpha in one image."""
    return torch.cat((layer.rgb, layer.alpha[..., None]), -1)


def bilinear(image: Float[Tensor, "H W C"], column: Tensor, row: Tensor) -> Float[Tensor, "*B C"]:
    """The image between its pixel centres; coordinates outside take the border's value."""
    height, width, channels = image.shape
    return _between(image.reshape(-1, channels), column, row, 0, width, height)


def _between(
    flat: Tensor,
    column: Tensor,
    row: Tensor,
    first: int | Tensor,
    width: int | Tensor,
    height: int | Tensor,
) -> Tensor:
    """first, width, height: of the image in the flat one, of each pixel its own or one for all."""
    x = (column - 0.5).clamp_min(0).clamp_max(width - 1)
    y = (row - 0.5).clamp_min(0)
    y = y.clamp_max(height - 1)
    c0 = x.long()
    r0 = y.long()
    c1 = (c0 + 1).clamp_max(width - 1)
    r1 = (r0 + 1).clamp_max(height - 1)
    fc = (x - c0)[..., None]
    fr = (y - r0)[..., None]
    above = first + r0 * width
    below = first + r1 * width
    top = flat[above + c0] * (1 - fc) + flat[above + c1] * fc
    bottom = flat[below + c0] * (1 - fc) + flat[below + c1] * fc
    return top * (1 - fr) + bottom * fr


def mip_chain(image: Float[Tensor, "H W C"]) -> list[Tensor]:
    """The image and its averages over 2 x 2 pixels, each from the last; odd borders count twice."""
    levels = [image]
    while len(levels) < MIP_LEVELS and max(levels[-1].shape[:2]) > 1:
        last = levels[-1]
        height, width = last.shape[:2]
        if height % 2:
            last = torch.cat((last, last[-1:]))
        if width % 2:
            last = torch.cat((last, last[:, -1:]), 1)
        wide = last[0::2] + last[1::2]
        levels.append((wide[:, 0::2] + wide[:, 1::2]) * 0.25)
    return levels


def blurred(
    levels: list[Tensor], column: Tensor, row: Tensor, spacing: Float[Tensor, "H W"]
) -> Float[Tensor, "T H W C"]:
    """Bilinear from the mip level whose pixels are `spacing` wide (pixels), blended between two."""
    sizes = []
    first = 0
    for image in levels:
        sizes.append((first, image.shape[1], image.shape[0]))
        first += image.shape[0] * image.shape[1]
    table = torch.tensor(sizes, device=column.device)
    flat = torch.cat([image.reshape(-1, image.shape[-1]) for image in levels])
    top = len(levels) - 1
    level = torch.log2(spacing.clamp(1, 2.0**top)).expand(column.shape)
    low = level.floor()
    share = (level - low)[..., None]

    def seen(number: Tensor) -> Tensor:
        scale = torch.exp2(-number)
        return _between(flat, column * scale, row * scale, *table[number.long()].unbind(-1))

    return (1 - share) * seen(low) + share * seen((low + 1).clamp_max(top))


# ---- Where a camera's rays meet the water, and how the surface is tilted there -------------------
# Points are relative to the eye: float32 stays exact far from the world's origin.

SMOOTH_PX = 2.0  # reflections that a pixel's slopes spread over less are as good as sharp


class Surface(NamedTuple):
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


def meet_plane(camera: Camera, level_z_m: float, like: Tensor) -> Surface:
    """The horizontal plane at level_z_m, below the eye, as the camera's rays meet it. like: whose
    type and device the result has.
    """
    exact = camera.ray_directions(torch.float64, like.device)
    meets = exact[..., 2] < 0
    straight_down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64, device=like.device)
    directions = torch.where(meets[..., None], exact, straight_down)
    height = float(camera.centre[2]) - level_z_m
    along = (height / -directions[..., 2]).clamp(max=FARTHEST)
    points = along[..., None] * directions
    points[..., 2] = -height
    length = directions.norm(dim=-1)
    return Surface(
        height,
        meets,
        directions.to(like.dtype),
        points.to(like.dtype),
        (along * length).to(like.dtype),
        (-directions / length[..., None]).to(like.dtype),
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
) -> tuple[Float[Tensor, "3 H W"], Float[Tensor, "3 H W 3"]]:
    """Weights and unit normals of slopes that stand for all slopes in a pixel.

    Gauss-Hermite quadrature over the slope along the view's horizontal direction, whose variance is
    V: the pixel's own normal, the first, has weight 2/3, slopes sqrt(3 V) to either side 1/6 each.
    In smooth pixels the first alone counts.
    """
    dtype = surface.points.dtype
    nx = field.normal_x.to(dtype)
    ny = field.normal_y.to(dtype)
    nz = torch.sqrt((1 - nx * nx - ny * ny).clamp_min(STEEPEST))
    horizontal = surface.to_eye[..., :2]
    # Seen straight from above the view has no horizontal direction: nothing is tilted then.
    horizontal = horizontal / horizontal.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    spread = torch.where(smooth, 0, torch.sqrt(3 * field.slope_variance.to(dtype)))
    offset = torch.stack((torch.zeros_like(spread), spread, -spread))[..., None]
    slope = torch.stack((nx / nz, ny / nz), -1) + offset * horizontal
    normals = torch.cat((slope, torch.ones_like(offset)), -1)
    side = torch.where(smooth, 0, torch.full_like(spread, 1 / 6))
    weights = torch.stack((1 - 2 * side, side, side))
    return weights, torch.nn.functional.normalize(normals, dim=-1)


def mirrored(to_eye: Float[Tensor, "H W 3"], normal: Tensor) -> Float[Tensor, "*B H W 3"]:
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
    surface: Surface, normal: Float[Tensor, "H W 3"], water: Water
) -> Float[Tensor, "H W 3"]:
    """Colour of the light that comes up through the surface: T = a bed + (1 - a) water.

    The search along the refracted ray starts from the bed straight behind the pixel, which is taken
    where it leaves the bed's image or meets a hole; the water's own colour where there is no bed
    behind the pixel, or too deep to be seen.
    """
    camera = water.camera
    medium = water.medium
    bed = water.bed
    fog = water.fog
    deep = _tensor(medium.rgb, normal).expand(normal.shape)
    if fog is not None:
        deep = blend_airlight(deep, fog_before(surface, water, fog), fog)
    right, left, down, top = places_in(bed.camera, camera).tolist()
    own_column, own_row = (
        ((torch.arange(size, device=normal.device) + 0.5) * scale + offset).to(normal.dtype)
        for size, scale, offset in ((camera.width, right, left), (camera.height, down, top))
    )
    own_row, own_column = torch.meshgrid(own_row, own_column, indexing="ij")
    own_solid, own_point = point_at(bed, own_column, own_row)
    own_depth = _depth_below(surface, own_point)
    extinction = _tensor(medium.extinction_per_m, normal)
    bends = medium.refraction_index != 1
    ray = -surface.to_eye  # nothing bends, whatever the waves
    if bends:
        ray = refracted(surface.to_eye, normal, medium.refraction_index)
    opaque = _optical_depth(own_depth / -ray[..., 2], extinction.min())
    own_solid = own_solid & is_inside(bed.camera, own_column, own_row)
    own_solid = own_solid & (opaque < -math.log(medium.bed_cut))
    image = stacked(bed)
    depth = own_depth
    colors = bilinear(image, own_column, own_row)
    if bends:
        found, met_depth, met_colors = _search(surface, ray, bed, image, own_solid, own_depth)
        depth = torch.where(found, met_depth, depth)
        colors = torch.where(found[..., None], met_colors, colors)
    colors = torch.where(own_solid[..., None], colors, 0)
    length = torch.where(own_solid, depth / -ray[..., 2], 0)[..., None]
    a = torch.exp(-_optical_depth(length, extinction))
    return a * (colors[..., :3] + (1 - colors[..., 3:]) * deep) + (1 - a) * deep


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
        last = depth
        depth = torch.where(going, _depth_below(surface, point), depth)
        going = going & ((depth - last).abs() > SETTLED_M)
    column, row = project(bed.camera, surface.points + depth[..., None] * per_depth)
    colors = bilinear(image, column, row)
    found = found & is_inside(bed.camera, column, row) & (colors[..., 3] >= SOLID_ALPHA)
    return found, depth, colors


def _optical_depth(length: Tensor, extinction_per_m: Tensor) -> Tensor:
    return torch.where(length > 0, extinction_per_m * length, 0)  # infinity times no way is none


def _depth_below(surface: Surface, point: Tensor) -> Float[Tensor, "H W"]:
    """Metres of points below the plane, 0 above it. point: relative to the eye."""
    return (-surface.height_m - point[..., 2]).clamp_min(0)


def fog_before(surface: Surface, water: Water, fog: Fog) -> Float[Tensor, "H W"]:
    """Optical depth of the fog between the eye and the surface."""
    level = torch.full_like(surface.distance, water.medium.level_z_m)
    return optical_depth(fog, surface.distance, float(water.camera.centre[2]), level)


# ---- What the surface reflects: the sky, the mirrored layer, the image itself --------------------


def reflect_sky(
    surface: Surface, rays: Float[Tensor, "T H W 3"], water: Water
) -> Float[Tensor, "T H W 3"]:
    """The sky in unit directions that climb, through the fog before it and before the surface."""
    seen, layered = sky_behind(water.sky, water.fog)
    colors = sample_at(seen, rays)
    if layered is None:
        return colors
    above = vertical_optical_depth(layered, water.medium.level_z_m)
    tau = fog_before(surface, water, layered) + above / rays[..., 2]
    return blend_airlight(colors, tau, layered)


def reflect_mirror(
    surface: Surface, rays: Float[Tensor, "T H W 3"], mirror: Layer, smooth: Bool[Tensor, "H W"]
) -> Float[Tensor, "T H W 4"]:
    """The mirrored layer's colours and alphas.

    A ray's length is first that of the flat mirror's ray, then what the layer shows where the
    tilted ray of that length ends. All of a pixel's rays take the length of the first; each sees an
    average as wide as they lie apart: single points would show as so many ghosts.
    """
    to_mirror = _tensor((0.0, 0.0, -2 * surface.height_m), rays)
    flat = surface.directions * _tensor((1.0, 1.0, -1.0), rays)

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
    column, row = end_of(rays, distance_at(*end_of(rays[0], first)))
    apart = torch.hypot(column[1:] - column[0], row[1:] - row[0]).mean(0)
    levels = mip_chain(stacked(mirror))
    return blurred(levels, column, row, torch.where(smooth, 1, apart))


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


def before_sky(seen: Float[Tensor, "*B 4"], sky: Float[Tensor, "*B 3"]) -> Tensor:
    """Premultiplied colours and alphas before a sky, which is left out where it hardly shows."""
    color = seen[..., :3]
    alpha = seen[..., 3:]
    opaque = 1 - alpha <= FAINT
    return torch.where(opaque, color / alpha.clamp_min(0.5), color + (1 - alpha) * sky)


def _end_in_image(
    surface: Surface, ray: Tensor, screen: ScreenReflection
) -> tuple[Tensor, Tensor, Tensor]:
    """(column, row, does the image show there what the ray ends at)."""
    layer = screen.layer
    far = screen.distance.isinf()
    forward = _axes(layer.camera, ray)[2]

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


# ---- The kernel's arrays -------------------------------------------------------------------------

ROWS = 8  # image rows a thread takes at a time: rows without water cost nothing
MIP_ROWS = 32
SKY_SIZE = 256  # texels along a face where a sky that is no cube map is sampled onto one
LARGEST = 1e30  # stands for infinity: its products with 0 are 0


def _run_kernel(water: Water) -> Tensor:
    camera = water.camera
    field = water.field
    screen = water.screen
    texels, size, layered = _flat_faces(water.sky, water.fog)
    limit = smooth_variance(camera)
    axes = np.ascontiguousarray(camera.world_from_camera[:3, :3].numpy())
    front = None
    distance = water.cover
    weight = water.cover
    if screen is not None:
        front = screen.layer
        distance = screen.distance
        weight = screen.weight
    x, y, variance = map(_array, (field.normal_x, field.normal_y, field.slope_variance))
    pixels = kernels.Pixels(
        *image_coordinates(camera), axes, _array(water.cover), places_in(water.bed.camera, camera)
    )
    out = np.empty((camera.height, camera.width, 3), np.float32)
    with kernel_threads(ROWS):
        kernels.shade(
            pixels,
            kernels.Normals(x, y, variance, np.float32(limit)),
            _image(water.bed),
            _image(water.mirror),
            _mips(water.mirror, bool((variance >= limit).any())),
            _image(front),
            kernels.Rays(_array(distance), _array(weight)),
            kernels.Faces(texels.numpy(), np.uint64(size)),
            _medium_numbers(water, layered),
            out,
        )
    return torch.from_numpy(out)


def _array(part: Tensor) -> np.ndarray:
    return part.detach().float().contiguous().numpy()


def _flat_faces(sky: Sky, fog: Fog | None) -> tuple[Tensor, int, Fog | None]:
    """(flat cube map, size of its faces with border, the fog before them)."""
    seen, layered = sky_behind(sky, fog)
    if isinstance(seen, ConstantSky):
        return _padded(seen.rgb.expand(6, 3, 3, 3)), 3, layered
    if isinstance(seen, CubemapSky):
        key = ("flat faces", seen.faces._version)
        faces = memo_of(seen).get(key, lambda: _padded(bordered_faces(seen)))
        return faces, len(seen.faces[0]) + 2, layered
    if isinstance(seen, LatLongSky):
        key = ("flat faces", seen.image._version)
        return memo_of(seen).get(key, lambda: _padded(_sampled(seen))), SKY_SIZE + 2, layered
    return _padded(_sampled(seen)), SKY_SIZE + 2, layered


def _sampled(sky: Sky) -> Tensor:
    return with_border(sky.sample(directions_of_cubemap(SKY_SIZE)))


def _padded(faces: Tensor) -> Tensor:
    """Four numbers a texel, and a row and a texel beyond them."""
    size = faces.shape[1]
    out = torch.zeros(6 * size * size + size + 1, 4)
    out[: 6 * size * size, :3] = faces.detach().reshape(-1, 3)
    return out.reshape(-1)


def _image(layer: Layer | None) -> kernels.Image:
    """A layer as the kernel takes it: of None an empty one."""
    if layer is None:
        nothing = np.zeros(0, np.float32)
        return kernels.Image(np.zeros(22, np.float32), nothing, nothing, nothing)
    camera = layer.camera
    rotation = camera.camera_from_world[:3, :3].numpy()
    fx = camera.fx
    fy = camera.fy
    cx = camera.cx
    cy = camera.cy
    project = rotation * [[fx], [fy], [1.0]]
    rays = rotation.T @ [[1 / fx, 0.0, -cx / fx], [0.0, 1 / fy, -cy / fy], [0.0, 0.0, 1.0]]
    numbers = [*project.reshape(-1), *rays.reshape(-1), cx, cy, camera.width, camera.height]
    parts = [_array(part).reshape(-1) for part in (layer.rgb, layer.alpha, layer.depth)]
    if min(camera.width, camera.height) == 1:  # look-ups read the next column and row as well
        parts = [np.append(part, np.zeros(3 * camera.width + 3, np.float32)) for part in parts]
    return kernels.Image(np.asarray(numbers, np.float32), *parts)


def _mips(layer: Layer | None, rough: bool) -> kernels.Mips:
    if layer is None or not rough:
        return kernels.Mips(np.zeros(1, np.float32), np.zeros((1, 3), np.int64))
    rgb = _array(layer.rgb)
    alpha = _array(layer.alpha)
    height, width = alpha.shape
    spare = width + 1
    sizes = [(0, width, height)]
    first = height * width
    while len(sizes) < MIP_LEVELS and max(height, width) > 1:
        height = (height + 1) // 2
        width = (width + 1) // 2
        sizes.append((first, width, height))
        first += height * width
    mips = np.empty((first + spare, 4), np.float32)
    mips[first:] = 0
    images = [mips[start : start + w * h].reshape(h, w, 4) for start, w, h in sizes]
    with kernel_threads(MIP_ROWS):
        kernels.pack(rgb, alpha, images[0])
        for fine, coarse in pairwise(images):
            kernels.halve_mip(fine, coarse)
    return kernels.Mips(mips.reshape(-1), np.asarray(sizes, np.int64))


def _medium_numbers(water: Water, layered: Fog | None) -> np.ndarray:
    """`kernels.Medium`. layered: the fog before the sky."""
    medium = water.medium
    eye_z = float(water.camera.centre[2])
    level = medium.level_z_m
    per_m = 0.0
    above = -1.0
    airlight = (0.0, 0.0, 0.0)
    if water.fog is not None:
        metre, height = torch.tensor([1.0, level], dtype=torch.float64)
        per_m = float(optical_depth(water.fog, metre, eye_z, height))
        airlight = water.fog.rgb
    if layered is not None:
        above = vertical_optical_depth(layered, level)
    numbers = [eye_z - level, medium.refraction_index, medium.fresnel == "schlick"]
    numbers += [
        *medium.extinction_per_m,
        *medium.rgb,
        per_m,
        above,
        *airlight,
        -math.log(medium.bed_cut),
    ]
    return np.minimum(numbers, LARGEST).astype(np.float32)
