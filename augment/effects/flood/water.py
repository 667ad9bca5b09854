"""Colour of a water surface: the torch definition, and the launch of the CPU's kernel.

    water = sum_i w_i F_i R_i + (1 - sum_i w_i F_i) T

i runs over the slopes inside a pixel, w is their weight, F the reflected share of the light, R the
light from the mirrored direction, and T the light that comes up through the surface.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.effects.flood import water_kernels
from augment.effects.flood.flood_medium import FloodMedium, Layer, reflectance
from augment.effects.flood.screen_space import ScreenReflection
from augment.effects.flood.water_kernels import (
    BED_STEPS,
    CONVERGED_M,
    EDGE,
    FAINT,
    FARTHEST,
    HIDDEN_COVER,
    MATCH_M,
    MATCH_SHARE,
    MIN_COSINE,
    MIN_DEPTH,
    MIN_NORMAL_Z2,
    SOLID_ALPHA,
)
from augment.effects.flood.water_plane import image_coordinates, scale_and_offset
from augment.effects.flood.waves import WaveField
from augment.memo import memo_of
from augment.render.buffers import CPU, choose_kernels
from augment.render.composite import simplify_sky
from augment.render.fog import Fog, blend_airlight, optical_depth, vertical_optical_depth
from augment.render.fog_table import local_fog
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.sky import (
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
    """Arguments of `shade_water`; fog is None if it has no density."""

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
    """Return the colour of the water where the camera's rays meet it, not clamped; 0 elsewhere.

    The layers contain their fog already. The fog here dims the sky and the colour of deep water.

    Args:
        camera: camera of the pixels, a window of the image.
        cover: alpha of the scene in front of the water. Above HIDDEN_COVER the result is the colour
            of deep water, or of the fog.
        medium: the water.
        field: normals of the waves.
        bed: the bed, from a window of the same image.
        mirror: the scene above the water, from the mirrored eye.
        screen: screen-space reflections, for the smooth pixels.
        sky: the sky.
        fog: the fog; of fog with banks, its density around the camera counts here.
        backend: the CPU's kernel equals the definition within float rounding.

    Raises:
        ValueError: the bed's camera and this one are not windows of one image.
    """
    if fog is not None and fog.extinction_per_m == 0:
        fog = None
    fog = local_fog(fog, camera)
    water = Water(camera, cover, medium, field, bed, mirror, screen, sky, fog)
    layers = (bed, mirror, None if screen is None else screen.layer)
    images = [(i.rgb, i.alpha, i.depth) for i in layers if i is not None]
    if choose_kernels(backend, cover, *(part for parts in images for part in parts)) == CPU:
        return _run_kernel(water)
    surface = meet_plane(camera, medium.level_z_m, bed.rgb)
    smooth = is_smooth(field, camera)
    weights, normals = tilted_normals(surface, field, smooth)
    below = through_the_surface(surface, normals[0], water)
    out = below
    if medium.refraction_index != 1:
        rays = mirrored(surface.to_eye, normals)
        reflected = below.new_zeros(*weights.shape, 4)
        if mirror is not None:
            reflected = reflect_mirror(surface, rays, mirror, smooth)
        if screen is not None:
            image = reflect_screen(surface, rays[0], screen, smooth, reflected[0])
            reflected = torch.cat((image[None], reflected[1:]))
        # Facets that face away from the eye count as edge-on.
        cosine = (normals * surface.to_eye).sum(-1).clamp(MIN_COSINE, 1)
        share = weights * reflectance(cosine, medium.refraction_index, medium.fresnel)
        color = before_sky(reflected, reflect_sky(surface, rays, water))
        out = below + (share[..., None] * (color - below)).sum(0)
    plain_color = _tensor(medium.rgb if fog is None else fog.airlight_rgb, out)
    out = torch.where((cover <= HIDDEN_COVER)[..., None], out, plain_color)
    return torch.where(surface.meets[..., None], out, 0)


def _tensor(numbers: tuple[float, ...], like: Tensor) -> Tensor:
    return torch.tensor(numbers, dtype=like.dtype, device=like.device)


# ---- Look-ups in a layer's image by direction ----------------------------------------------------
# Image coordinates are (column, row) in pixels. Vectors are in world axes and start at the layer's
# optical centre.

MIP_LEVELS = 7  # they blur up to 64 pixels; three taps are seldom farther apart


def project(camera: Camera, vectors: Float[Tensor, "*B 3"]) -> tuple[Tensor, Tensor]:
    """Return column and row of vectors from the optical centre; huge values behind the camera."""
    local = vectors @ _axes(camera, vectors).T
    x, y, z = local.unbind(-1)
    z = z.clamp_min(MIN_DEPTH)
    return camera.fx * (x / z) + camera.cx, camera.fy * (y / z) + camera.cy


def is_inside(camera: Camera, column: Tensor, row: Tensor) -> Bool[Tensor, "*B"]:
    return (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)


def clamp_to(camera: Camera, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """Clamp coordinates to the area between the centres of the image's outermost pixels."""
    return column.clamp(0.5, camera.width - 0.5), row.clamp(0.5, camera.height - 0.5)


def _axes(camera: Camera, like: Tensor) -> Float[Tensor, "3 3"]:
    return camera.camera_from_world[:3, :3].to(like.device, like.dtype)


def point_at(layer: Layer, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """Return (has a surface, vector to it [*B, 3]) at the nearest pixel inside the image."""
    camera = layer.camera
    column = column.clamp(0, camera.width - 1).long()
    row = row.clamp(0, camera.height - 1).long()
    solid = layer.alpha[row, column] >= SOLID_ALPHA
    depth = torch.where(solid, layer.depth[row, column], 0)  # meaningless without a surface
    x = (column + (0.5 - camera.cx)) * depth / camera.fx
    y = (row + (0.5 - camera.cy)) * depth / camera.fy
    return solid, torch.stack((x, y, depth), -1) @ _axes(camera, depth)


def stacked(layer: Layer) -> Float[Tensor, "H W 4"]:
    """Return premultiplied colour and alpha in one image."""
    return torch.cat((layer.rgb, layer.alpha[..., None]), -1)


def bilinear(image: Float[Tensor, "H W C"], column: Tensor, row: Tensor) -> Float[Tensor, "*B C"]:
    """Interpolate an image between pixel centres; coordinates outside take the border's value."""
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
    """Interpolate bilinearly in images that lie one after the other in `flat`.

    first, width, height: first row of the image in `flat` and its size; one value, or one a pixel.
    """
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
    """Return the image and its averages over 2 x 2 pixels, level by level.

    The last row or column of an odd size counts twice.
    """
    levels = [image]
    while len(levels) < MIP_LEVELS and max(levels[-1].shape[:2]) > 1:
        fine = levels[-1]
        height, width = fine.shape[:2]
        if height % 2:
            fine = torch.cat((fine, fine[-1:]))
        if width % 2:
            fine = torch.cat((fine, fine[:, -1:]), 1)
        row_sums = fine[0::2] + fine[1::2]
        levels.append((row_sums[:, 0::2] + row_sums[:, 1::2]) * 0.25)
    return levels


def blurred(
    levels: list[Tensor], column: Tensor, row: Tensor, spacing: Float[Tensor, "H W"]
) -> Float[Tensor, "T H W C"]:
    """Look up the mip level whose pixels are `spacing` wide (pixels), blending two levels."""
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

    def look_up(number: Tensor) -> Tensor:
        scale = torch.exp2(-number)
        return _between(flat, column * scale, row * scale, *table[number.long()].unbind(-1))

    return (1 - share) * look_up(low) + share * look_up((low + 1).clamp_max(top))


# ---- Points where a camera's rays meet the water, and the tilt of the surface there --------------
# Points are relative to the eye: float32 stays exact far from the world's origin.

SMOOTH_PX = 2.0  # reflections spread by a pixel's slopes over less than this count as sharp


class Surface(NamedTuple):
    """A plane below the eye, at every pixel of a camera."""

    height_m: float  # of the eye over the plane
    meets: Bool[Tensor, "H W"]  # the ray goes down; elsewhere the other values are dummies
    directions: Float[Tensor, "H W 3"]  # rays with unit z in the camera
    points: Float[Tensor, "H W 3"]  # where the rays meet the plane, relative to the eye
    distance: Float[Tensor, "H W"]  # from these points to the eye, metres
    to_eye: Float[Tensor, "H W 3"]  # unit vectors from these points to the eye


def meet_plane(camera: Camera, level_z_m: float, like: Tensor) -> Surface:
    """Return the points where a camera's rays meet the plane at level_z_m, below the eye.

    like: a tensor whose type and device the result takes.
    """
    rays_f64 = camera.ray_directions(torch.float64, like.device)
    meets = rays_f64[..., 2] < 0
    straight_down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64, device=like.device)
    directions = torch.where(meets[..., None], rays_f64, straight_down)
    height = float(camera.centre[2]) - level_z_m
    depth = (height / -directions[..., 2]).clamp(max=FARTHEST)
    points = depth[..., None] * directions
    points[..., 2] = -height
    length = directions.norm(dim=-1)
    return Surface(
        height,
        meets,
        directions.to(like.dtype),
        points.to(like.dtype),
        (depth * length).to(like.dtype),
        (-directions / length[..., None]).to(like.dtype),
    )


def is_smooth(field: WaveField, camera: Camera) -> Bool[Tensor, "H W"]:
    """Return the mask of pixels whose inner slopes hardly blur their reflections."""
    return field.slope_variance < smooth_variance(camera)


def smooth_variance(camera: Camera) -> float:
    """Return the slope variance V that spreads a reflection by 2 sqrt(3 V) fy = SMOOTH_PX pixels.

    A slope turns the mirrored ray by twice its angle; `tilted_normals` uses the slope sqrt(3 V).
    """
    return (SMOOTH_PX / (2 * camera.fy)) ** 2 / 3


def tilted_normals(
    surface: Surface, field: WaveField, smooth: Bool[Tensor, "H W"]
) -> tuple[Float[Tensor, "3 H W"], Float[Tensor, "3 H W 3"]]:
    """Return weights and unit normals of three slopes that represent all slopes in a pixel.

    They are a Gauss-Hermite quadrature over the slope along the view's horizontal direction, whose
    variance is V. The pixel's mean normal comes first, with weight 2/3. The slopes sqrt(3 V) to
    either side have weight 1/6 each. In smooth pixels the first normal alone counts.
    """
    dtype = surface.points.dtype
    nx = field.normal_x.to(dtype)
    ny = field.normal_y.to(dtype)
    nz = torch.sqrt((1 - nx * nx - ny * ny).clamp_min(MIN_NORMAL_Z2))
    horizontal = surface.to_eye[..., :2]
    # A view straight down has no horizontal direction: nothing is tilted then.
    horizontal = horizontal / horizontal.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    spread = torch.where(smooth, 0, torch.sqrt(3 * field.slope_variance.to(dtype)))
    offset = torch.stack((torch.zeros_like(spread), spread, -spread))[..., None]
    slope = torch.stack((nx / nz, ny / nz), -1) + offset * horizontal
    normals = torch.cat((slope, torch.ones_like(offset)), -1)
    side = torch.where(smooth, 0, torch.full_like(spread, 1 / 6))
    weights = torch.stack((1 - 2 * side, side, side))
    return weights, torch.nn.functional.normalize(normals, dim=-1)


def mirrored(to_eye: Float[Tensor, "H W 3"], normal: Tensor) -> Float[Tensor, "*B H W 3"]:
    """Return unit directions in which the surface mirrors the view, none below the horizon."""
    cosine = (normal * to_eye).sum(-1, keepdim=True)
    ray = 2 * cosine * normal - to_eye
    return _at_least_upward(ray)


def refracted(
    to_eye: Float[Tensor, "H W 3"], normal: Tensor, index: float
) -> Float[Tensor, "H W 3"]:
    """Return unit directions of the view under the surface by Snell's law, all of them downward.

    t = -v / n + (c / n - sqrt(1 - (1 - c^2) / n^2)) normal
    """
    c = (normal * to_eye).sum(-1, keepdim=True).clamp_min(MIN_COSINE)
    inside = torch.sqrt((1 - (1 - c * c) / index**2).clamp_min(0))
    return -_at_least_upward(to_eye / index - (c / index - inside) * normal)


def _at_least_upward(ray: Tensor) -> Tensor:
    upward = ray[..., 2:].clamp_min(MIN_COSINE)
    return torch.nn.functional.normalize(torch.cat((ray[..., :2], upward), -1), dim=-1)


# ---- The bed, through the surface ----------------------------------------------------------------


def through_the_surface(
    surface: Surface, normal: Float[Tensor, "H W 3"], water: Water
) -> Float[Tensor, "H W 3"]:
    """Return the light that comes up through the surface, T = a bed + (1 - a) water.

    The search along the refracted ray starts from the bed straight behind the pixel. That point is
    used where the search leaves the bed's image or meets a hole. The result is the colour of deep
    water where no bed is behind the pixel, or where the bed is too deep to be visible.
    """
    camera = water.camera
    medium = water.medium
    bed = water.bed
    fog = water.fog
    deep = _tensor(medium.rgb, normal).expand(normal.shape)
    if fog is not None:
        deep = blend_airlight(deep, fog_before(surface, water, fog), fog)
    right, left, down, top = scale_and_offset(bed.camera, camera).tolist()
    straight_column, straight_row = (
        ((torch.arange(size, device=normal.device) + 0.5) * scale + offset).to(normal.dtype)
        for size, scale, offset in ((camera.width, right, left), (camera.height, down, top))
    )
    straight_row, straight_column = torch.meshgrid(straight_row, straight_column, indexing="ij")
    has_bed, straight_point = point_at(bed, straight_column, straight_row)
    straight_depth = _depth_below(surface, straight_point)
    extinction = _tensor(medium.extinction_per_m, normal)
    bends = medium.refraction_index != 1
    ray = -surface.to_eye  # nothing bends, whatever the waves
    if bends:
        ray = refracted(surface.to_eye, normal, medium.refraction_index)
    thickness = _optical_depth(straight_depth / -ray[..., 2], extinction.min())
    has_bed = has_bed & is_inside(bed.camera, straight_column, straight_row)
    has_bed = has_bed & (thickness < -math.log(medium.bed_cut))
    image = stacked(bed)
    depth = straight_depth
    colors = bilinear(image, straight_column, straight_row)
    if bends:
        is_found, refracted_depth, refracted_colors = _search(
            surface, ray, bed, image, has_bed, straight_depth
        )
        depth = torch.where(is_found, refracted_depth, depth)
        colors = torch.where(is_found[..., None], refracted_colors, colors)
    colors = torch.where(has_bed[..., None], colors, 0)
    length = torch.where(has_bed, depth / -ray[..., 2], 0)[..., None]
    transmittance = torch.exp(-_optical_depth(length, extinction))
    return (
        transmittance * (colors[..., :3] + (1 - colors[..., 3:]) * deep)
        + (1 - transmittance) * deep
    )


def _search(
    surface: Surface, ray: Tensor, bed: Layer, image: Tensor, is_found: Tensor, depth: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return (is found, depth below the plane, colour and alpha) of the bed along refracted rays.

    is_found, depth: the start of the search: pixels with a bed and its depth below the plane.
    """
    per_depth = ray / -ray[..., 2:]
    is_moving = is_found
    for _ in range(BED_STEPS):
        column, row = project(bed.camera, surface.points + depth[..., None] * per_depth)
        solid, point = point_at(bed, column, row)
        is_found = is_found & (~is_moving | (is_inside(bed.camera, column, row) & solid))
        is_moving = is_moving & is_found
        previous_depth = depth
        depth = torch.where(is_moving, _depth_below(surface, point), depth)
        is_moving = is_moving & ((depth - previous_depth).abs() > CONVERGED_M)
    column, row = project(bed.camera, surface.points + depth[..., None] * per_depth)
    colors = bilinear(image, column, row)
    is_found = is_found & is_inside(bed.camera, column, row) & (colors[..., 3] >= SOLID_ALPHA)
    return is_found, depth, colors


def _optical_depth(length: Tensor, extinction_per_m: Tensor) -> Tensor:
    return torch.where(length > 0, extinction_per_m * length, 0)  # infinity times 0 is 0 here


def _depth_below(surface: Surface, point: Tensor) -> Float[Tensor, "H W"]:
    """Return how far points (relative to the eye) are below the plane, metres; 0 above it."""
    return (-surface.height_m - point[..., 2]).clamp_min(0)


def fog_before(surface: Surface, water: Water, fog: Fog) -> Float[Tensor, "H W"]:
    """Return the optical depth of the fog between the eye and the surface."""
    level = torch.full_like(surface.distance, water.medium.level_z_m)
    return optical_depth(fog, surface.distance, float(water.camera.centre[2]), level)


# ---- Reflections of the sky, of the mirrored layer, and of the image itself ----------------------


def reflect_sky(
    surface: Surface, rays: Float[Tensor, "T H W 3"], water: Water
) -> Float[Tensor, "T H W 3"]:
    """Return the sky in rising unit directions, through the fog before it and the surface."""
    visible_sky, layered = simplify_sky(water.sky, water.fog)
    colors = sample_at(visible_sky, rays)
    if layered is None:
        return colors
    above = vertical_optical_depth(layered, water.medium.level_z_m)
    tau = fog_before(surface, water, layered) + above / rays[..., 2]
    return blend_airlight(colors, tau, layered)


def reflect_mirror(
    surface: Surface, rays: Float[Tensor, "T H W 3"], mirror: Layer, smooth: Bool[Tensor, "H W"]
) -> Float[Tensor, "T H W 4"]:
    """Return colours and alphas of the mirrored layer along mirrored rays.

    The length of a ray is first the length of the flat mirror's ray, then the distance to the
    surface that the layer shows where the tilted ray of that length ends. All rays of a pixel take
    the length of the first ray. Each takes an average as wide as the rays' spacing in the image,
    because single points would show as separate ghost images.
    """
    to_mirror = _tensor((0.0, 0.0, -2 * surface.height_m), rays)
    flat = surface.directions * _tensor((1.0, 1.0, -1.0), rays)

    def end_of(ray: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
        is_infinite = distance.isinf()
        end = surface.points + torch.where(is_infinite, 0, distance)[..., None] * ray - to_mirror
        vector = torch.where(is_infinite[..., None], ray, end)
        return clamp_to(mirror.camera, *project(mirror.camera, vector))

    def distance_at(column: Tensor, row: Tensor) -> Tensor:
        solid, point = point_at(mirror, column, row)
        distance = (point + to_mirror - surface.points).norm(dim=-1)
        return torch.where(solid, distance, torch.inf)

    flat_distance = distance_at(*clamp_to(mirror.camera, *project(mirror.camera, flat)))
    column, row = end_of(rays, distance_at(*end_of(rays[0], flat_distance)))
    spacing = torch.hypot(column[1:] - column[0], row[1:] - row[0]).mean(0)
    levels = mip_chain(stacked(mirror))
    return blurred(levels, column, row, torch.where(smooth, 1, spacing))


def reflect_screen(
    surface: Surface,
    ray: Float[Tensor, "H W 3"],
    screen: ScreenReflection,
    smooth: Bool[Tensor, "H W"],
    mirror_color: Tensor,
) -> Float[Tensor, "H W 4"]:
    """Return the image at the ends of smooth pixels' rays; `mirror_color` elsewhere."""
    camera = screen.layer.camera
    column, row, matches = _end_in_image(surface, ray, screen)
    matches = matches & is_inside(camera, column, row) & smooth
    across = torch.minimum(column, camera.width - column) / camera.width
    down = torch.minimum(row, camera.height - row) / camera.height
    x = (torch.minimum(across, down) / EDGE).clamp(0, 1)
    fade = x * x * (3 - 2 * x)
    weight = torch.where(matches, screen.weight * fade, 0)[..., None]
    image_color = bilinear(stacked(screen.layer), *clamp_to(camera, column, row))
    return weight * image_color + (1 - weight) * mirror_color


def before_sky(rgba: Float[Tensor, "*B 4"], sky: Float[Tensor, "*B 3"]) -> Tensor:
    """Blend premultiplied colours and alphas over a sky; leave it out where it hardly shows."""
    color = rgba[..., :3]
    alpha = rgba[..., 3:]
    opaque = 1 - alpha <= FAINT
    return torch.where(opaque, color / alpha.clamp_min(0.5), color + (1 - alpha) * sky)


def _end_in_image(
    surface: Surface, ray: Tensor, screen: ScreenReflection
) -> tuple[Tensor, Tensor, Tensor]:
    """Return (column, row, is the surface of the image there the one that the ray ends at)."""
    layer = screen.layer
    is_infinite = screen.distance.isinf()
    forward = _axes(layer.camera, ray)[2]

    def look_up(distance: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        end = surface.points + distance[..., None] * ray
        column, row = project(layer.camera, torch.where(is_infinite[..., None], ray, end))
        solid, point = point_at(layer, column, row)
        ahead = end @ forward
        matches = (point @ forward - ahead).abs() < (MATCH_SHARE * ahead).clamp_min(MATCH_M)
        return column, row, solid, point, matches

    distance = torch.where(is_infinite, 0, screen.distance)
    _, _, solid, point, _ = look_up(distance)
    corrected = (point - surface.points).norm(dim=-1)
    column, row, solid, _, matches = look_up(torch.where(solid, corrected, distance))
    return column, row, torch.where(is_infinite, ~solid, solid & matches)


# ---- The kernel's arrays -------------------------------------------------------------------------

ROWS = 8  # image rows that a thread takes at a time; rows without water cost nothing
MIP_ROWS = 32  # rows of a mip level that a thread takes at a time
SKY_SIZE = 256  # texels along a face of the cube map onto which another sky is sampled
LARGEST = 1e30  # replaces infinity: its products with 0 are 0


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
    pixels = water_kernels.Pixels(
        *image_coordinates(camera),
        axes,
        _array(water.cover),
        scale_and_offset(water.bed.camera, camera),
    )
    out = np.empty((camera.height, camera.width, 3), np.float32)
    with kernel_threads(ROWS):
        water_kernels.shade(
            pixels,
            water_kernels.Normals(x, y, variance, np.float32(limit)),
            _image(water.bed),
            _image(water.mirror),
            _mips(water.mirror, bool((variance >= limit).any())),
            _image(front),
            water_kernels.Rays(_array(distance), _array(weight)),
            water_kernels.Faces(texels.numpy(), np.uint64(size)),
            _medium_numbers(water, layered),
            out,
        )
    return torch.from_numpy(out)


def _array(part: Tensor) -> np.ndarray:
    return part.detach().float().contiguous().numpy()


def _flat_faces(sky: Sky, fog: Fog | None) -> tuple[Tensor, int, Fog | None]:
    """Return (flat cube map, size of its faces with border, the fog before them)."""
    visible_sky, layered = simplify_sky(sky, fog)
    if isinstance(visible_sky, ConstantSky):
        return _padded(visible_sky.rgb.expand(6, 3, 3, 3)), 3, layered
    if isinstance(visible_sky, CubemapSky):
        key = ("flat faces", visible_sky.faces._version)
        faces = memo_of(visible_sky).get(key, lambda: _padded(bordered_faces(visible_sky)))
        return faces, len(visible_sky.faces[0]) + 2, layered
    if isinstance(visible_sky, LatLongSky):
        key = ("flat faces", visible_sky.image._version)
        return (
            memo_of(visible_sky).get(key, lambda: _padded(_sampled(visible_sky))),
            SKY_SIZE + 2,
            layered,
        )
    return _padded(_sampled(visible_sky)), SKY_SIZE + 2, layered


def _sampled(sky: Sky) -> Tensor:
    return with_border(sky.sample(directions_of_cubemap(SKY_SIZE)))


def _padded(faces: Tensor) -> Tensor:
    """Pad faces to four numbers a texel, with a row and a texel beyond them."""
    size = faces.shape[1]
    out = torch.zeros(6 * size * size + size + 1, 4)
    out[: 6 * size * size, :3] = faces.detach().reshape(-1, 3)
    return out.reshape(-1)


def _image(layer: Layer | None) -> water_kernels.Image:
    """Return a layer in the kernel's format; an empty image for None."""
    if layer is None:
        no_pixels = np.zeros(0, np.float32)
        return water_kernels.Image(np.zeros(22, np.float32), no_pixels, no_pixels, no_pixels)
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
    return water_kernels.Image(np.asarray(numbers, np.float32), *parts)


def _mips(layer: Layer | None, rough: bool) -> water_kernels.Mips:
    if layer is None or not rough:
        return water_kernels.Mips(np.zeros(1, np.float32), np.zeros((1, 3), np.int64))
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
        water_kernels.pack(rgb, alpha, images[0])
        for fine, coarse in pairwise(images):
            water_kernels.halve_mip(fine, coarse)
    return water_kernels.Mips(mips.reshape(-1), np.asarray(sizes, np.int64))


def _medium_numbers(water: Water, layered: Fog | None) -> np.ndarray:
    """Return the numbers of `water_kernels.Medium`. layered: the fog before the sky."""
    medium = water.medium
    eye_z = float(water.camera.centre[2])
    level = medium.level_z_m
    per_m = 0.0
    above = -1.0
    airlight = (0.0, 0.0, 0.0)
    if water.fog is not None:
        metre, height = torch.tensor([1.0, level], dtype=torch.float64)
        per_m = float(optical_depth(water.fog, metre, eye_z, height))
        airlight = water.fog.airlight_rgb
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
