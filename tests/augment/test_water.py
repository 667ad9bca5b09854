"""The water's plane, picture and reflections: kernels against definitions and hand-made cases."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.effects.flood import water as water_module
from augment.effects.flood.flood import FloodMedium, Layer, reflectance
from augment.effects.flood.screen_space import ScreenReflection, trace_screen
from augment.effects.flood.water_plane import Window, mirrored_camera, plane_depth, plane_window
from augment.effects.flood.waves import WaveField, WaveSet
from augment.geometry import invert_rigid, rigid, rotmat_from_quat
from augment.render.fog import Fog
from augment.sky import ConstantSky, CubemapSky

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
