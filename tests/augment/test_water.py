"""The water's plane, waves, picture and reflections: kernels against definitions, known cases."""

from __future__ import annotations

import dataclasses
import itertools
import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
import torch

from augment.effects.flood import water as water_module
from augment.effects.flood.flood_medium import FloodMedium, Layer, reflectance
from augment.effects.flood.screen_space import ScreenReflection, trace_screen
from augment.effects.flood.water_plane import Window, mirrored_camera, plane_depth, plane_window
from augment.effects.flood.waves import (
    GRAVITY_MPS2,
    WaveField,
    WaveSet,
    make_waves,
    normals_from_tangents,
    phases_of,
    tangents_of,
    turns_at,
    wave_field,
)
from augment.render.fog import Fog
from augment.scene.cameras import Camera
from augment.scene.geometry import invert_rigid, rigid, rotmat_from_quat
from augment.scene.sky import ConstantSky, CubemapSky
from recipes.flood import Wave, Waves

NONE = np.zeros(0)
STILL = WaveSet(np.zeros((0, 2)), NONE, NONE, NONE, NONE, 1.0)
LEVEL = 10.0
MUD = (0.42, 0.38, 0.30)
GREY = (0.5, 0.6, 0.7)


def medium(**changes) -> FloodMedium:
    return dataclasses.replace(FloodMedium(LEVEL, (2.0, 1.5, 1.0), MUD, STILL), **changes)


def camera(
    width: int = 61, height: int = 43, *, above: float = 1.5, pitch_deg: float = -20.0, roll=0.03
) -> Camera:
    """An eye above the water, looking north-east and down, a few kilometres from the origin."""
    yaw, pitch = 0.7, math.radians(pitch_deg)
    forward = np.array(
        [math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)]
    )
    right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    down = np.cross(forward, right)
    c, s = math.cos(roll), math.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = [c * right + s * down, c * down - s * right, forward]
    pose[:3, 3] = -pose[:3, :3] @ [3000.0, -2000.0, LEVEL + above]
    f = 0.8 * max(width, 40)
    return Camera("c", width, height, f, f * 1.03, width / 2 + 0.3, height / 2, torch.tensor(pose))


def mirrored(eye: Camera) -> Camera:
    """The camera below the water, its image upside down, which keeps its axes right-handed."""
    world = eye.world_from_camera.clone()
    world[2] = -world[2]
    world[:3, 1] = -world[:3, 1]
    world[2, 3] += 2 * LEVEL
    world[3] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    pose = invert_rigid(world)
    return dataclasses.replace(eye, cy=eye.height - eye.cy, camera_from_world=pose)


def flat_field(eye: Camera) -> WaveField:
    zero = torch.zeros(eye.height, eye.width)
    return WaveField(zero, zero, zero)


def wavy_field(eye: Camera, *, slope: float = 0.04, variance: float = 0.0) -> WaveField:
    """Slopes that vary over a few pixels; the variance jumps to 0 in the middle of the image."""
    rows = torch.arange(eye.height)[:, None] / 7
    columns = torch.arange(eye.width)[None, :] / 9
    rough = torch.full((eye.height, eye.width), variance)
    rough[:, eye.width // 2 :] = 0
    return WaveField(
        slope * torch.sin(rows + 2 * columns), slope * torch.cos(2 * rows - columns), rough
    )


def pattern(points: torch.Tensor) -> torch.Tensor:
    """A smooth colour of every point of the world."""
    x, y, z = points.double().unbind(-1)
    waves = [torch.sin(0.9 * x + 0.3 * z), torch.sin(1.1 * y + x / 2), torch.cos(0.8 * (x - y) + z)]
    return 0.5 + 0.4 * torch.stack(waves, -1)


def plane_layer(
    eye: Camera, z_m: float, dtype: torch.dtype = torch.float32, *, reach: float = 200.0
) -> Layer:
    """The pattern on a level plane, as far as `reach` metres of depth."""
    rays = eye.ray_directions(torch.float64)
    depth = (z_m - float(eye.centre[2])) / rays[..., 2]
    hit = (depth > 0) & (depth < reach)
    depth = torch.where(hit, depth, 0)
    rgb = pattern(eye.centre + depth[..., None] * rays) * hit[..., None]
    return Layer(eye, rgb.to(dtype), hit.to(dtype), depth.to(dtype))


def doubled(layer: Layer) -> Layer:
    parts = {name: getattr(layer, name).double() for name in ("rgb", "alpha", "depth")}
    return dataclasses.replace(layer, **parts)


def noise_sky(size: int = 16) -> CubemapSky:
    return CubemapSky(torch.rand(6, size, size, 3, generator=torch.Generator().manual_seed(5)))


def uncovered(eye: Camera) -> torch.Tensor:
    return torch.zeros(eye.height, eye.width)


def margin(eye: Camera, pixels: int = 12) -> Camera:
    return eye.cropped(-pixels, -pixels, eye.width + 2 * pixels, eye.height + 2 * pixels)


def shade_water(
    eye: Camera,
    water: FloodMedium,
    field: WaveField,
    bed: Layer,
    *,
    cover=None,
    sky=None,
    **options,
) -> torch.Tensor:
    """The water's colours, where nothing covers it unless said."""
    cover, sky = uncovered(eye) if cover is None else cover, noise_sky() if sky is None else sky
    return water_module.shade_water(eye, cover, water, field, bed, sky=sky, **options)


REFERENCE = pytest.param("reference", marks=pytest.mark.long)
ALL = pytest.mark.parametrize("backend", ["cpu", REFERENCE])
SMOGS = {"clear": None, "uniform": Fog(0.02, GREY), "layered": Fog(0.02, GREY, 8.0, LEVEL - 3)}


VIEWS = [
    ((61, 43), 0.0, "exact"),
    ((61, 43), 2e-3, "schlick"),
    ((1, 1), 2e-3, "exact"),
    ((17, 90), 2e-3, "exact"),
]


@pytest.mark.parametrize(
    ("smog", "tier", "view"),
    [
        ("layered", "sky", VIEWS[0]),
        ("layered", "screen_space", VIEWS[0]),
        ("clear", "screen_space", VIEWS[1]),
        ("uniform", "mirrored", VIEWS[3]),
        ("layered", "mirrored", VIEWS[2]),
    ],
)
def test_the_kernel_matches_the_definition(smog, tier, view):
    (size, variance, fresnel), smog = view, SMOGS[smog]
    eye = camera(*size)
    field = wavy_field(eye, variance=variance)
    bed = plane_layer(margin(eye), LEVEL - 0.4)
    sky = CubemapSky(noise_sky(2).faces)  # smooth: coordinates' rounding is not magnified
    layers, exact = {}, {}
    if tier != "sky":
        layers["mirror"] = plane_layer(margin(mirrored(eye), 3), LEVEL + 2, reach=12.0)
        exact["mirror"] = doubled(layers["mirror"])
    if tier == "screen_space":
        front = plane_layer(margin(eye, 40), LEVEL + 2, reach=12.0)
        distance = torch.full((eye.height, eye.width), 4.0)
        distance[::3] = torch.inf
        weight = torch.linspace(0, 1, eye.width).expand(eye.height, eye.width).contiguous()
        layers["screen"] = ScreenReflection(front, distance, weight)
        exact["screen"] = ScreenReflection(doubled(front), distance, weight)
    water = medium(fresnel=fresnel)
    fast = shade_water(eye, water, field, bed, sky=sky, fog=smog, **layers)
    slow = shade_water(eye, water, field, doubled(bed), sky=sky, fog=smog, **exact)
    assert slow.dtype == torch.float64 and bool((slow != 0).any())
    difference = (fast - slow).abs().amax(-1)
    # Float32 knows image coordinates to about 1e-5 pixels here, and colours change by up to 0.1 a
    # pixel; distances and depths that follow from them have the same relative error.
    assert float(difference.median()) < 1e-6
    # Where a coordinate lies that close to a pixel's border, the nearest pixel and the depth read
    # from it are another: visible where the layer ends there, or a ray just meets it or misses.
    assert int((difference > 5e-5).sum()) <= 0.002 * difference.numel()


def refract_exactly(eye: Camera, depth: float, index: float) -> tuple[torch.Tensor, torch.Tensor]:
    """World points [H, W, 3] of a flat bed seen through flat water, and the way to them there."""
    d = torch.nn.functional.normalize(eye.ray_directions(torch.float64), dim=-1)
    height = float(eye.centre[2]) - LEVEL
    surface = eye.centre + d * (height / -d[..., 2:])
    level_part = d[..., :2] / index  # Snell: n sin(inside) = sin(outside), in the same plane
    fall = torch.sqrt(1 - level_part.square().sum(-1))
    way = depth / fall
    ends = torch.cat((surface[..., :2] + level_part * way[..., None], surface[..., 2:] - depth), -1)
    return ends, way


@ALL
def test_refracted_rays_meet_the_bed_where_snell_says(backend):
    eye, depth, index = camera(pitch_deg=-40), 0.6, 1.333
    bed = plane_layer(margin(eye, 40), LEVEL - depth)
    water = medium(extinction_per_m=(0.0, 0.4, 1.5), refraction_index=index)
    black = ConstantSky(torch.zeros(3))
    out = shade_water(eye, water, flat_field(eye), bed, sky=black, backend=backend)
    ends, way = refract_exactly(eye, depth, index)
    a = torch.exp(-torch.tensor([0.0, 0.4, 1.5], dtype=torch.float64) * way[..., None])
    seen = a * pattern(ends) + (1 - a) * torch.tensor(MUD, dtype=torch.float64)
    d = torch.nn.functional.normalize(eye.ray_directions(torch.float64), dim=-1)
    share = reflectance(-d[..., 2], index, "exact")[..., None]
    # The bed's image is interpolated between pixels up to 0.3 m apart, of a pattern whose second
    # derivative is about 0.6 / m2: 0.6 / 8 * 0.3^2; misplacing the end by that much would show
    # as 0.1.
    assert float((out - (1 - share) * seen).abs().max()) < 7e-3
    straight = pattern(
        eye.centre
        + plane_layer(eye, LEVEL - depth).depth[..., None].double()
        * eye.ray_directions(torch.float64)
    )
    assert float((seen - straight)[..., 0].abs().mean()) > 0.05  # it does bend


@ALL
def test_the_mirrored_wall_is_where_the_mirrored_ray_meets_it(backend):
    eye, slope = camera(pitch_deg=-8), (0.03, -0.02)
    below = mirrored(eye).cropped(-20, -20, 101, 83)
    normal = torch.tensor([40.0, 30.0, 0.0], dtype=torch.float64) / 50  # a wall 25 m ahead

    def on_wall(origin: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        return 25.0 - ((origin - eye.centre) @ normal), rays @ normal

    offset, speed = on_wall(below.centre, below.ray_directions(torch.float64))
    depth = offset / speed
    points = below.centre + depth[..., None] * below.ray_directions(torch.float64)
    small = 0.25 * points  # a coarser pattern than on the bed: the wall is far
    mirror = Layer(below, pattern(small).float(), torch.ones(83, 101), depth.float())
    bed = plane_layer(margin(eye), LEVEL - 0.3)
    water = medium(rgb=(0.0, 0.0, 0.0), extinction_per_m=(math.inf,) * 3)
    up = torch.tensor([*slope, 1.0], dtype=torch.float64)
    up = up / up.norm()
    field = WaveField(*(torch.full((43, 61), float(part)) for part in (up[0], up[1], 0.0)))
    out = shade_water(eye, water, field, bed, mirror=mirror, backend=backend)
    d = torch.nn.functional.normalize(eye.ray_directions(torch.float64), dim=-1)
    surface = eye.centre + d * ((float(eye.centre[2]) - LEVEL) / -d[..., 2:])
    ray = d - 2 * (d @ up)[..., None] * up
    far, speed = on_wall(surface, ray)
    met = (ray[..., 2] > 0.01) & (far > 1)  # the surface lies before the wall
    seen = pattern(0.25 * (surface + (far / speed)[..., None] * ray))
    share = reflectance((-(d @ up)).clamp(1e-3, 1), 1.333, "exact")[..., None]
    error = (out - share * seen).abs().amax(-1)[met]
    assert int(met.sum()) > 1000
    # Bilinear between pixels 0.5 m apart on the wall, 0.13 on the pattern; a tilted ray's end
    # is corrected once, which leaves some centimetres where the surface is seen edge-on.
    assert float(error.quantile(0.99)) < 4e-3


@ALL
def test_the_sky_tier_shows_the_sky_of_the_mirrored_direction(backend):
    eye = camera(pitch_deg=0)
    bed = plane_layer(eye, LEVEL - 0.3)
    opaque = medium(rgb=(0.0, 0.0, 0.0), extinction_per_m=(math.inf,) * 3)
    sky = noise_sky(8)
    out = shade_water(eye, opaque, flat_field(eye), bed, sky=sky, backend=backend)
    rays = eye.ray_directions(torch.float64)
    up = rays * torch.tensor([1.0, 1.0, -1.0])
    cosine = up[..., 2] / up.norm(dim=-1)
    expected = reflectance(cosine.clamp(1e-3, 1), 1.333, "exact")[..., None] * sky.sample(up)
    met = cosine > 2e-3  # closer to the horizon rays are raised
    assert 500 < int(met.sum()) < 61 * 43
    # Texture coordinates of float32 (1e-6) times differences between texels of up to 1.
    assert float((out - expected).abs()[met].max()) < 1e-5
    assert torch.equal(out[rays[..., 2] >= 0], torch.zeros_like(out[rays[..., 2] >= 0]))


def test_a_bed_seen_by_another_camera_is_refused():
    eye = camera()
    turned = plane_layer(camera(pitch_deg=-21), LEVEL - 0.3)
    with pytest.raises(ValueError, match="windows of one image"):
        shade_water(eye, medium(), flat_field(eye), turned)


# ---- the plane -----------------------------------------------------------------------------------


def turned_camera(seed: int, width=31, height=19, position=(0.0, 0.0, 0.0)) -> Camera:
    quat = torch.from_numpy(np.random.default_rng(seed).normal(size=4))
    rotation = rotmat_from_quat(quat / quat.norm())
    centre = torch.tensor(position, dtype=torch.float64)
    return Camera(
        "turned", width, height, 25.0, 27.0, 14.2, 9.7, rigid(rotation, -rotation @ centre)
    )


def test_the_window_is_the_least_that_holds_all_rays_that_meet_the_plane():
    for seed, level_z_m in itertools.product(range(12), [-1.5, 1.5, 0.0]):
        camera = turned_camera(seed)
        meets = plane_depth(camera, level_z_m).isfinite()
        if level_z_m == 0.0:  # an eye in the plane: rays that rise
            meets = camera.ray_directions(torch.float64)[..., 2] > 0
        rows, columns = meets.any(1).nonzero(), meets.any(0).nonzero()
        expected = None
        if len(rows):
            first, last = (int(columns.min()), int(rows.min())), (columns.max(), rows.max())
            expected = Window(*first, int(last[0]) + 1, int(last[1]) + 1)
        assert plane_window(camera, level_z_m) == expected


def test_depths_reach_the_plane():
    camera = turned_camera(1, position=(3.0, -2.0, 5.0))
    depth = plane_depth(camera, 2.0)
    points = camera.centre + depth[..., None] * camera.ray_directions(torch.float64)
    met = depth.isfinite()
    assert bool(met.any()) and float((points[met][:, 2] - 2.0).abs().max()) < 1e-12
    assert bool((depth[met] > 0).all())


@pytest.mark.parametrize("seed", range(2))
def test_a_pixel_of_the_mirrored_camera_looks_along_the_reflected_ray(seed):
    camera, level = turned_camera(seed, position=(0.4, 0.3, 1.7)), -0.2
    mirrored = mirrored_camera(camera, level)
    rays = camera.ray_directions(torch.float64)
    expected = rays * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    assert torch.allclose(mirrored.ray_directions(torch.float64).flip(0), expected, atol=1e-12)
    assert mirrored.centre.tolist() == pytest.approx([0.4, 0.3, 2 * level - 1.7])
    # Twice mirrored is where it was.
    back = mirrored_camera(mirrored, level)
    assert torch.allclose(back.camera_from_world, camera.camera_from_world, atol=1e-12)


# ---- the march over the screen -------------------------------------------------------------------

EYE_M = 1.5  # over the water, whose level is LEVEL_M
LEVEL_M = 0.3
WALL_M = 12.0
BACKENDS = pytest.mark.parametrize(
    "backend", ["cpu", pytest.param("reference", marks=pytest.mark.long)]
)


@pytest.fixture(autouse=True, scope="module")
def one_torch_thread():
    """The definition is hundreds of steps on few rays, where threads only wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def looking(
    pitch_deg: float = 0, roll_deg: float = 0, width: int = 97, height: int = 75, fx: float = 60.0
) -> Camera:
    """At EYE_M over the water, along +y of the world, turned down by the pitch, then rolled."""
    level = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    a, b = math.radians(pitch_deg) / 2, math.radians(roll_deg) / 2
    pitch = rotmat_from_quat(torch.tensor([math.cos(a), math.sin(a), 0, 0], dtype=torch.float64))
    roll = rotmat_from_quat(torch.tensor([math.cos(b), 0, 0, math.sin(b)], dtype=torch.float64))
    rotation = roll @ pitch @ level
    centre = torch.tensor([3.0, -7.0, LEVEL_M + EYE_M], dtype=torch.float64)
    pose = rigid(rotation, -rotation @ centre)
    return Camera("c", width, height, fx, fx, width / 2 - 0.3, height / 2 + 0.2, pose)


def see(camera: Camera, *boxes: tuple[float, float, float, float, float]) -> Layer:
    """Upright screens standing in the water: (distance along +y, left, right, bottom, top).

    Left and right are relative to the eye, bottom and top to the water; metres.
    """
    rays = camera.ray_directions(torch.float64)
    depth = torch.full(rays.shape[:2], math.inf, dtype=torch.float64)
    for far, left, right, bottom, top in boxes:
        z = far / rays[..., 1]
        x, height = rays[..., 0] * z, EYE_M + rays[..., 2] * z
        inside = (z > 0) & (x > left) & (x < right) & (height > max(bottom, 0)) & (height < top)
        depth = torch.where(inside & (z < depth), z, depth)
    alpha = depth.isfinite().float()
    depth = depth.nan_to_num(posinf=0).float()
    return Layer(camera, torch.zeros(*depth.shape, 3), alpha, depth)


WALL = (WALL_M, -1e3, 1e3, 0.0, 3.0)
CAR = (5.0, -1.0, 0.8, 0.0, 1.4)
SIGN = (3.0, -0.7, 0.7, 2.0, 2.4)


def water(camera: Camera, front: Layer) -> torch.Tensor:
    return (camera.ray_directions(torch.float64)[..., 2] < 0) & (front.alpha == 0)


def mirrored_way(camera: Camera, far: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Metres along each mirrored ray to the plane `far` along +y, and its height there."""
    rays = camera.ray_directions(torch.float64)
    s = EYE_M / -rays[..., 2]
    way = (far / rays[..., 1] - s) * rays.norm(dim=-1)
    return way, (far / rays[..., 1] - s) * -rays[..., 2]


def projected(camera: Camera, way: torch.Tensor) -> torch.Tensor:
    """Pixel coordinates of the points so many metres along the mirrored rays."""
    rays = camera.ray_directions(torch.float64)
    s = EYE_M / -rays[..., 2]
    up = rays * torch.tensor([1, 1, -1], dtype=torch.float64)
    point = rays * s[..., None] + up * (way / rays.norm(dim=-1))[..., None]
    seen = point @ camera.camera_from_world[:3, :3].T
    x = seen[..., 0] / seen[..., 2] * camera.fx + camera.cx
    y = seen[..., 1] / seen[..., 2] * camera.fy + camera.cy
    return torch.stack([x, y], -1)


SCREEN_VIEWS = [(0, 0), (8, 0), (0, 25), (12, -40), (-10, 5), (35, 90)]


@pytest.mark.parametrize(
    ("backend", "view"),
    [("reference", SCREEN_VIEWS[3]), ("cpu", SCREEN_VIEWS[1]), ("cpu", SCREEN_VIEWS[5])],
)
def test_rays_meet_a_wall_where_geometry_says(backend, view):
    pitch, roll = view
    camera = looking(pitch, roll)
    front = see(camera, WALL)
    found = trace_screen(front, camera, LEVEL_M, stride=1, backend=backend)
    way, height = mirrored_way(camera, WALL_M)
    at = projected(camera, way)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    shown = ((at > 2) & (at < size - 2)).all(-1)
    # Half a metre off its edges: those are pixels wide (5 pixels per metre).
    sure = water(camera, front) & shown & (height > 0.5) & (height < 2.5)
    assert int(sure.sum()) > 100
    # Inverse depth is linear over a plane, so what is left is the float32 of the depth buffer.
    assert torch.allclose(found.distance[sure].double(), way[sure], rtol=1e-4, atol=1e-4)
    middle = sure & ((at > 0.05 * size) & (at < 0.95 * size)).all(-1)
    assert (found.weight[middle] == 1).all()


@BACKENDS
def test_a_car_before_a_wall_is_met_first_and_sky_is_above_both(backend):
    camera = looking(height=101)
    car_top, wall_top = 0.6, 5.0  # low and high enough for rays between them to be in the image
    front = see(camera, (*CAR[:4], car_top), (*WALL[:4], wall_top))
    found = trace_screen(front, camera, LEVEL_M, stride=1, backend=backend)
    to_car, car_height = mirrored_way(camera, CAR[0])
    to_wall, wall_height = mirrored_way(camera, WALL_M)
    rays = camera.ray_directions(torch.float64)
    x = rays[..., 0] / rays[..., 1] * CAR[0]
    free = water(camera, front) & (to_car > 0)  # the surface before the car
    inside = (x > CAR[1] + 0.2) & (x < CAR[2] - 0.2)
    car = free & inside & (car_height > 0.15) & (car_height < car_top - 0.15)
    assert int(car.sum()) > 20
    assert torch.allclose(found.distance[car].double(), to_car[car], rtol=1e-4, atol=1e-4)
    # Rays that pass over the car meet the wall behind it, not the car's stretched roof.
    over = free & inside & (car_height > car_top + 0.2) & (wall_height < wall_top - 0.4)
    assert int(over.sum()) > 20
    assert torch.allclose(found.distance[over].double(), to_wall[over], rtol=1e-4, atol=1e-4)
    at = projected(camera, torch.full_like(to_wall, 1e9))
    shown = at[..., 1] > 0.05 * camera.height
    sky = free & inside & (wall_height > wall_top + 0.4) & shown
    assert int(sky.sum()) > 20
    assert found.distance[sky].isinf().all() and (found.weight[sky] == 1).all()


@BACKENDS
def test_rays_that_come_back_to_the_camera_are_not_known(backend):
    """Looking straight down, past the point under the camera."""
    for roll in (0, 30):
        camera = looking(90, roll, 41, 41)
        front = see(camera)
        found = trace_screen(front, camera, LEVEL_M, stride=1, backend=backend)
        assert (found.weight == 0).all() and found.distance.isinf().all()


@pytest.mark.parametrize(("pitch", "roll"), [SCREEN_VIEWS[2], SCREEN_VIEWS[4], (80, 20)])
def test_the_march_over_the_screen_matches_the_definition(pitch, roll):
    camera = looking(pitch, roll, 131, 90, fx=80.0)
    front = see(camera, SIGN, CAR, WALL, (30.0, 2.0, 9.0, 1.0, 8.0))
    fast = trace_screen(front, camera, LEVEL_M, stride=1)
    slow = trace_screen(front, camera, LEVEL_M, backend="reference")
    close = torch.isclose(fast.distance, slow.distance, rtol=1e-3, atol=1e-3)
    close &= (fast.weight - slow.weight).abs() < 1e-3
    # The definition steps over corners of pixels (a pixel of the longer axis a step): there a ray
    # may pass a silhouette that it grazes, about one ray in 300.
    assert int((~close).sum()) <= 0.005 * close.numel()


# ---- waves ---------------------------------------------------------------------------------------

NOW = 1_700_000_000_123_456_789  # a timestamp of today's recordings
RMS_SLOPES = {"calm": 0.012, "breeze": 0.04, "wind": 0.09}


def waves_of(count: int = 5, *, steepness: float = 0.5, low=0.4, high=6.0, slope=0.3) -> WaveSet:
    """Waves of all directions, a total steepness and a total slope (sum of k A)."""
    rng = np.random.default_rng(count)
    angles = rng.uniform(0, 2 * math.pi, count)
    share = rng.uniform(0.5, 1.5, count)
    share /= share.sum()
    wavelengths = np.geomspace(low, high, count)
    return WaveSet(
        directions=np.stack([np.cos(angles), np.sin(angles)], axis=1),
        amplitudes_m=slope * share * wavelengths / (2 * math.pi),
        wavelengths_m=wavelengths,
        steepness=steepness * share,
        phases_rad=rng.uniform(0, 2 * math.pi, count),
        depth_m=0.4,
    )


def displaced_surface(waves: WaveSet, points: torch.Tensor, timestamp_ns: int) -> torch.Tensor:
    """Where points [N, 2] of the still plane are at that time; z counts from its level."""
    surface = torch.nn.functional.pad(points, (0, 1))
    phases = phases_of(waves, turns_at(waves, timestamp_ns), points)
    for i, (dx, dy) in enumerate(waves.directions.tolist()):
        theta = phases[..., i]
        across = float(waves.steepness[i] / waves.wavenumbers[i]) * theta.cos()
        lift = float(waves.amplitudes_m[i]) * theta.sin()
        surface = surface + torch.stack([dx * across, dy * across, lift], dim=-1)
    return surface


def wave_normals(waves: WaveSet, points: torch.Tensor, timestamp_ns: int) -> torch.Tensor:
    """Unit normals over parameter points, with every wave at full height."""
    theta = phases_of(waves, turns_at(waves, timestamp_ns), points)
    return normals_from_tangents(tangents_of(waves, theta))


def camera_at(
    eye, *, down_deg=6.0, yaw_deg=40.0, roll_deg=0.0, size=(97, 61), focal=90.0, time=NOW
) -> Camera:
    """A camera that looks down_deg below the horizon; yaw 0 is world +x."""
    yaw, down, roll = (math.radians(a) for a in (yaw_deg, down_deg, roll_deg))
    forward = [math.cos(yaw) * math.cos(down), math.sin(yaw) * math.cos(down), -math.sin(down)]
    forward = torch.tensor(forward, dtype=torch.float64)
    right = torch.tensor([math.sin(yaw), -math.cos(yaw), 0.0], dtype=torch.float64)
    below = torch.linalg.cross(forward, right)
    right, below = (
        math.cos(roll) * right + math.sin(roll) * below,
        math.cos(roll) * below - math.sin(roll) * right,
    )
    rotation = torch.stack([right, below, forward])
    pose = rigid(rotation, -rotation @ torch.tensor(eye, dtype=torch.float64))
    width, height = size
    return Camera("c", width, height, focal, 1.1 * focal, width / 2, height / 2, pose, time)


def random_points(count: int, extent_m: float = 50.0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(0).uniform(-extent_m, extent_m, (count, 2)))


# What a recipe draws


def test_the_same_seed_draws_the_same_bits():
    first, again = (make_waves(Waves(preset="wind"), seed=5, depth_m=0.5) for _ in range(2))
    for field in dataclasses.fields(WaveSet):
        assert np.array_equal(getattr(first, field.name), getattr(again, field.name))
    other = make_waves(Waves(preset="wind"), seed=6, depth_m=0.5)
    assert not np.array_equal(first.wavelengths_m, other.wavelengths_m)
    own = make_waves(Waves(preset="wind", seed=6), seed=5, depth_m=0.5)
    assert np.array_equal(own.phases_rad, other.phases_rad)


def test_the_first_numbers_of_a_seed_are_pinned():
    waves = make_waves(Waves(preset="breeze", count=3), seed=1, depth_m=0.5)
    # Twelve digits: cosines and powers may differ in the last bits between machines.
    wavelengths = [0.0804594348773729, 0.3843134351955985, 2.0991211404386902]
    phases = [2.751173005872406, 1.4414570607582793, 5.628359912392606]
    assert waves.wavelengths_m.tolist() == pytest.approx(wavelengths, rel=1e-12)
    assert waves.phases_rad.tolist() == pytest.approx(phases, rel=1e-12)


@pytest.mark.parametrize(("preset", "count"), [("calm", 1), ("breeze", 24), ("wind", 64)])
def test_a_preset_has_its_rms_slope_whatever_the_count(preset, count):
    waves = make_waves(Waves(preset=preset, count=count), seed=3, depth_m=0.5)
    assert len(waves.wavelengths_m) == count
    waves = dataclasses.replace(waves, steepness=np.zeros(count))  # sines, whose slopes add
    # Over kilometres: two waves of nearly one length still beat within fifty metres.
    normals = wave_normals(waves, random_points(8000, 5000.0), NOW)
    slopes = (normals[:, :2] / normals[:, 2:]).square().sum(-1)
    # 8000 samples of a square that varies as much as its mean: 1.1 %, halved by the root.
    assert float(slopes.mean().sqrt()) == pytest.approx(RMS_SLOPES[preset], rel=0.02)


# Time


def test_waves_travel_as_fast_as_their_depth_allows():
    waves = waves_of(2, low=0.01, high=1000.0)
    deep = dataclasses.replace(waves, depth_m=math.inf)
    speed = deep.frequencies_hz * deep.wavelengths_m
    assert np.allclose(speed, np.sqrt(GRAVITY_MPS2 / deep.wavenumbers), rtol=1e-14)
    shallow = dataclasses.replace(waves, depth_m=1e-4)
    # k h is at most 0.06 here: tanh(x) / x is 1 - x^2 / 3.
    speed = shallow.frequencies_hz * shallow.wavelengths_m
    assert np.allclose(speed, math.sqrt(GRAVITY_MPS2 * 1e-4), rtol=1e-3)


@pytest.mark.parametrize("time", [0, 1, -5, 10**18, NOW, -NOW])
def test_phases_keep_their_precision_at_any_time(time):
    waves = waves_of(64, low=1e-3, high=1e3)
    turns = turns_at(waves, time)
    with localcontext() as context:
        context.prec = 80
        for frequency, phase, turn in zip(
            waves.frequencies_hz, waves.phases_rad, turns, strict=True
        ):
            passed = Decimal(float(frequency)) * time / 10**9
            exact = Decimal(float(phase) / (2 * math.pi)) - passed - Decimal(float(turn))
            # Whole turns, and two roundings of numbers below 1.
            assert abs(exact - exact.to_integral_value()) < 4e-16


# The surface


def test_a_wave_lifts_and_gathers_the_surface_at_its_crest():
    wave = Wave(direction_deg=0, amplitude_m=0.2, wavelength_m=4, steepness=0.5)
    waves = make_waves(Waves(components=(wave,)), seed=0, depth_m=1.0)
    points = torch.tensor([[0.0, 0], [1, 0], [2, 0], [3, 7]], dtype=torch.float64)
    reach = 0.5 * 4 / (2 * math.pi)
    expected = [[reach, 0, 0], [1, 0, 0.2], [2 - reach, 0, 0], [3, 7, -0.2]]
    found = displaced_surface(waves, points, 0)
    assert torch.allclose(found, torch.tensor(expected, dtype=torch.float64), atol=1e-15)


@pytest.mark.parametrize("steepness", [0.0, 0.5, 0.98])
def test_normals_are_those_of_the_displaced_surface(steepness):
    waves = waves_of(64, steepness=steepness, slope=0.9)
    points = random_points(500)
    step = 1e-5
    tangents = []
    for axis in range(2):
        shift = torch.zeros(2, dtype=torch.float64)
        shift[axis] = step
        ahead = displaced_surface(waves, points + shift, NOW)
        tangents.append((ahead - displaced_surface(waves, points - shift, NOW)) / (2 * step))
    expected = torch.linalg.cross(*tangents)
    expected = expected / expected.norm(dim=-1, keepdim=True)
    normals = wave_normals(waves, points, NOW)
    assert float(normals[:, 2].min()) > 0
    # Central differences: (k step)^2 / 6 = 4e-9 of the slope for the shortest wave, and 1e-14 m /
    # 1e-5 m from rounding 50 m; ten times that where the crests are steep.
    assert torch.allclose(normals, expected, atol=5e-8)
    assert torch.allclose(normals.norm(dim=-1), torch.ones(500, dtype=torch.float64), atol=1e-14)


# What a camera sees

CAMERAS = {
    "driving": camera_at([0.0, 0, 1.5]),
    "rolled": camera_at([3.0, 1, 1.5], roll_deg=25),
    "on its side": camera_at([3.0, 1, 1.5], roll_deg=90),
    "along the surface": camera_at([0.0, 0, 0.02], down_deg=0),
    "down": camera_at([1.0, 2, 3.0], down_deg=90),
    "up": camera_at([1.0, 2, 3.0], down_deg=-90),
    "under water": camera_at([1.0, 2, -0.3], down_deg=-20, roll_deg=5),
    "far from the origin": camera_at([5000.0, -5000, 1.5]),
    "at 1e9 s": camera_at([0.0, 0, 1.5], time=10**18),
    "one pixel": camera_at([0.0, 0, 1.5], size=(1, 1)),
    "a row": camera_at([0.0, 0, 1.5], size=(301, 1), roll_deg=10),
    "a column": camera_at([0.0, 0, 1.5], size=(1, 77)),
    "tele": camera_at([0.0, 0, 1.5], down_deg=3, focal=4000.0),
}

SETS = {
    "one": waves_of(1),
    "24": waves_of(24, steepness=0.8, slope=0.8),
    "64": waves_of(64, steepness=0.5, slope=2.0, low=0.05),
    "1 mm and 1 km": waves_of(2, low=1e-3, high=1e3),
}


def fields_of(waves: WaveSet, camera: Camera, *, backend: str, level_z_m: float = 0.0):
    field = wave_field(waves, camera, level_z_m, backend=backend)
    return torch.stack([field.normal_x, field.normal_y, field.slope_variance])


@pytest.mark.parametrize(
    ("waves", "cameras"),
    [
        ("24", CAMERAS),
        ("one", ["tele"]),
        ("64", ["rolled"]),
        ("1 mm and 1 km", ["driving", "down"]),
    ],
)
def test_the_kernel_of_waves_matches_the_definition(waves, cameras):
    for name in cameras:
        assert_matches_the_definition(SETS[waves], CAMERAS[name])
        seen = fields_of(SETS[waves], CAMERAS[name], backend="reference")
        assert bool((seen != 0).any()) == (name != "up")


def assert_matches_the_definition(waves: WaveSet, camera: Camera) -> None:
    fast = fields_of(waves, camera, backend="cpu")
    slow = fields_of(waves, camera, backend="reference")
    assert fast.shape == slow.shape and fast.dtype == slow.dtype == torch.float32
    # Turns from an anchor at most 64 pixels away, at 4 pixels a turn: 16 * 6e-8 * 2 pi = 6e-6
    # radians at worst, times a slope of at most 1, over the 0.2 that the steepest crest leaves
    # of a unit area.
    assert float((fast - slow).abs().max()) < 1e-5


def footprint_by_differences(camera: Camera, row: int, column: int) -> tuple[np.ndarray, ...]:
    """The plane point of a pixel, its change per pixel [2, 2], and the ray, by moving the image."""

    def point(dx: float, dy: float) -> np.ndarray:
        moved = dataclasses.replace(camera, cx=camera.cx - dx, cy=camera.cy - dy)
        ray = moved.ray_directions(torch.float64)[row, column].numpy()
        eye = camera.centre.numpy()
        return eye[:2] - eye[2] / ray[2] * ray[:2]

    step = 1e-5
    columns = (point(step, 0) - point(-step, 0)) / (2 * step)
    rows = (point(0, step) - point(0, -step)) / (2 * step)
    ray = camera.ray_directions(torch.float64)[row, column].numpy()
    return point(0, 0), np.stack([columns, rows], axis=1), ray


@pytest.mark.parametrize("camera", ["rolled", "tele"])
def test_the_field_is_what_its_definition_says_pixel_by_pixel(camera):
    camera, waves = CAMERAS[camera], waves_of(12, steepness=0.6, slope=1.0, low=0.05, high=3.0)
    field = fields_of(waves, camera, backend="reference")
    rays = camera.ray_directions(torch.float64)
    seen = torch.nonzero(rays[..., 2] < -0.02)[::37].tolist()
    assert len(seen) > 20
    partly = 0
    for row, column in seen:
        place, footprint, ray = footprint_by_differences(camera, row, column)
        view = ray[:2] / np.hypot(*ray[:2])
        heights, variance, xx, xy, yy = np.zeros(2), 0.0, 0.0, 0.0, 0.0
        for i, turn in enumerate(turns_at(waves, camera.timestamp_ns)):
            d, k = waves.directions[i], waves.wavenumbers[i]
            pixels = 2 * math.pi / (k * np.hypot(*(footprint.T @ d)))
            x = min(max((pixels - 2) / 2, 0), 1)
            weight = 3 * x**2 - 2 * x**3
            partly += 0 < weight < 1
            theta = k * (d @ place) + 2 * math.pi * turn
            heights += weight * k * waves.amplitudes_m[i] * math.cos(theta) * d
            squeeze = weight * waves.steepness[i] * math.sin(theta)
            xx, xy, yy = (
                xx + squeeze * d[0] ** 2,
                xy + squeeze * d[0] * d[1],
                yy + squeeze * d[1] ** 2,
            )
            slope = k * waves.amplitudes_m[i] * (d @ view)
            variance += 0.5 * slope**2 * (1 - weight**2)
        normal = np.cross([1 - xx, -xy, heights[0]], [-xy, 1 - yy, heights[1]])
        normal /= np.linalg.norm(normal)
        expected = [normal[0], normal[1], variance]
        # Differences of 1e-5 px leave 1e-9 of the footprint; the field is stored in float32.
        assert field[:, row, column].tolist() == pytest.approx(expected, abs=3e-7)
    assert partly > 10
