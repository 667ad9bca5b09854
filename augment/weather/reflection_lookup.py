"""What a water surface reflects: the sky, a view from below the water, the image itself.

The sky is known in every direction. What stands above the water is seen in the mirrored layer from
the mirrored eye, or in the front layer from the eye itself; a ray that leaves the surface a little
off the flat mirror's direction is looked up there at the distance at which it meets something.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.render.composite import sky_behind
from augment.sky import Sky
from augment.weather.flood import Layer
from augment.weather.layer_lookup import (
    bilinear,
    blurred,
    clamp_to,
    is_inside,
    mip_chain,
    point_at,
    project,
    stacked,
)
from augment.weather.refraction import smog_before
from augment.weather.screen_space import ScreenReflection
from augment.weather.smog import SmogMedium, vertical_optical_depth
from augment.weather.water_surface import Surface

EDGE = 0.04  # share of the image's sides over which what the image shows fades out
MATCH_M, MATCH_SHARE = 0.3, 0.05  # how far beside a surface a ray may end and still show it

FAINT = 1 / 256  # a share of the sky that does not change what it shows through

Colours = list[Tensor]  # one [H, W, 3], or 4 with alpha, for each of a pixel's normals


def mirrored_eye_is(mirror: Camera, level_z_m: float, eye: Float[Tensor, "3"]) -> bool:
    """Whether a camera stands where the plane mirrors the eye."""
    expected = torch.tensor([eye[0], eye[1], 2 * level_z_m - eye[2]], dtype=torch.float64)
    allowed = 1e-6 * (1 + float(expected.abs().max()))
    return float((mirror.centre - expected).abs().max()) <= allowed


def reflect_sky(
    surface: Surface,
    rays: list[Tensor],
    camera: Camera,
    level_z_m: float,
    sky: Sky,
    smog: SmogMedium | None,
) -> Colours:
    """The sky in unit directions that climb, through the smog before it and before the surface."""
    seen, layered = sky_behind(sky, smog)
    colors = [seen.sample(ray) for ray in rays]
    if layered is None:
        return colors
    near = smog_before(surface, camera, level_z_m, layered)
    above = vertical_optical_depth(layered, level_z_m)
    airlight = torch.tensor(layered.rgb, dtype=near.dtype)
    through = [torch.exp(-(near + above / ray[..., 2]))[..., None] for ray in rays]
    return [t * color + (1 - t) * airlight for t, color in zip(through, colors, strict=True)]


def reflect_mirror(
    surface: Surface, rays: list[Tensor], mirror: Layer, smooth: Bool[Tensor, "H W"]
) -> Colours:
    """The mirrored layer's colours and alphas.

    A ray's length is first that of the flat mirror's ray, then what the layer shows where the
    tilted ray of that length ends. In rough pixels all rays take the length of the first: what they
    show is blurred over more than they would differ.
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
    """What the image itself shows where the ray of smooth pixels ends, as far as it does.

    The rest elsewhere, and in rough pixels: they are blurred too much for the image to add to it.
    """
    camera = screen.layer.camera
    column, row, matches = _end_in_image(surface, ray, screen)
    matches = matches & is_inside(camera, column, row) & smooth
    fade = _smoothstep(_to_border(camera, column, row) / EDGE)
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


def _to_border(camera: Camera, column: Tensor, row: Tensor) -> Tensor:
    """Distance to the image's border over the length of the sides that stand on it."""
    across = torch.minimum(column, camera.width - column) / camera.width
    down = torch.minimum(row, camera.height - row) / camera.height
    return torch.minimum(across, down)


def _smoothstep(x: Tensor) -> Tensor:
    x = x.clamp(0, 1)
    return x * x * (3 - 2 * x)


def _fetch(
    layer: Layer, places: list[tuple[Tensor, Tensor]], smooth: Bool[Tensor, "H W"]
) -> Colours:
    """Colour and alpha at every normal's coordinates.

    Where a pixel has several normals, each sees an average as wide as they lie apart: single
    points would show as so many ghosts.
    """
    image = stacked(layer)
    (column, row), *sides = places
    if not sides:
        return [bilinear(image, column, row)]
    apart = [torch.hypot(c - column, r - row) for c, r in sides]
    spacing = torch.where(smooth, 1, torch.stack(apart).mean(0))
    levels = mip_chain(image)
    return [blurred(levels, c, r, spacing) for c, r in places]
