import dataclasses
import math

import pytest
import torch

from augment.cameras import Camera
from augment.effects.flood.flood import Layer
from augment.effects.flood.screen_space import trace_screen
from augment.geometry import rigid, rotmat_from_quat

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


VIEWS = [(0, 0), (8, 0), (0, 25), (12, -40), (-10, 5), (35, 90)]


@pytest.mark.parametrize(
    ("backend", "view"), [("reference", VIEWS[3]), ("cpu", VIEWS[1]), ("cpu", VIEWS[5])]
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
def test_what_is_lost_behind_a_thin_thing_is_not_known(backend):
    """A sign hangs before the sky: rays of water far behind it pass behind it."""
    camera = looking(0, height=151)
    front = see(camera, SIGN)
    found = trace_screen(front, camera, LEVEL_M, stride=1, backend=backend)
    rays = camera.ray_directions(torch.float64)
    s = EYE_M / -rays[..., 2]
    # Where the mirrored ray, seen from the eye, crosses the middle of the sign (0.7 m over it).
    slope = (SIGN[3] + SIGN[4]) / 2 - EYE_M
    behind = 2 * EYE_M / (-rays[..., 2] / rays[..., 1] + slope / SIGN[0] * -1)
    z = 2 * EYE_M / (-rays[..., 2] - slope / SIGN[0])
    x = rays[..., 0] * SIGN[0]
    hidden = water(camera, front) & (z > 5) & (x.abs() < 0.6) & (s < z) & (behind > 0)
    assert int(hidden.sum()) > 20
    assert (found.weight[hidden] == 0).all() and found.distance[hidden].isinf().all()
    beside = water(camera, front) & (x.abs() > 0.8) & (x.abs() < 1.5)
    assert found.distance[beside].isinf().all() and int((found.weight[beside] == 1).sum()) > 20


@BACKENDS
def test_rays_that_come_back_to_the_camera_are_not_known(backend):
    """Looking straight down, past the point under the camera."""
    for roll in (0, 30):
        camera = looking(90, roll, 41, 41)
        front = see(camera)
        found = trace_screen(front, camera, LEVEL_M, stride=1, backend=backend)
        assert (found.weight == 0).all() and found.distance.isinf().all()


@pytest.mark.parametrize(("backend", "stride"), [("reference", 1), ("cpu", 1), ("cpu", 4)])
def test_nothing_stands_anywhere(backend, stride):
    camera = looking(0, height=65)
    front = see(camera)
    found = trace_screen(front, camera, LEVEL_M, stride=stride, backend=backend)
    assert found.distance.isinf().all()
    middle = found.weight[40:60, 8:-8]  # these rays end between rows 5 and 25 of 65
    assert (middle == 1).all()
    assert (found.weight[:32] == 0).all()  # above the horizon there is no water


@BACKENDS
def test_pixels_without_water_have_no_reflection(backend):
    camera = looking(10)
    everything = dataclasses.replace(
        see(camera), alpha=torch.ones(75, 97), depth=torch.full((75, 97), 0.5)
    )
    for front, level in ((everything, LEVEL_M), (see(camera), 5.0)):  # covered; under water
        found = trace_screen(front, camera, level, backend=backend)
        assert (found.weight == 0).all() and found.distance.isinf().all()


@pytest.mark.parametrize(("size", "stride"), [((1, 1), 4), ((17, 5), 4), ((129, 64), 1)])
def test_every_size_of_image_and_window(size, stride):
    camera = looking(15, 4, *size, fx=0.6 * max(size))
    front = see(camera, CAR, WALL)
    whole = trace_screen(front, camera, LEVEL_M, stride=1)
    left, top = size[0] // 3, size[1] // 3
    window = camera.cropped(left, top, size[0] - left, size[1] - top)
    part = trace_screen(front, window, LEVEL_M, stride=stride)
    assert part.distance.shape == part.weight.shape == (window.height, window.width)
    if stride == 1:
        assert torch.equal(part.distance, whole.distance[top:, left:])
        assert torch.equal(part.weight, whole.weight[top:, left:])
    wider = camera.cropped(-3, -2, size[0] + 5, size[1] + 7)
    beyond = trace_screen(front, wider, LEVEL_M, stride=1)
    inside = (slice(2, 2 + size[1]), slice(3, 3 + size[0]))
    assert torch.equal(beyond.distance[inside], whole.distance)
    assert torch.equal(beyond.weight[inside], whole.weight)
    assert float(beyond.weight.sum()) == pytest.approx(float(whole.weight.sum()), rel=1e-5)


@pytest.mark.parametrize(("pitch", "roll"), [VIEWS[2], VIEWS[4], (80, 20)])
def test_the_kernel_matches_the_definition(pitch, roll):
    camera = looking(pitch, roll, 131, 90, fx=80.0)
    front = see(camera, SIGN, CAR, WALL, (30.0, 2.0, 9.0, 1.0, 8.0))
    fast = trace_screen(front, camera, LEVEL_M, stride=1)
    slow = trace_screen(front, camera, LEVEL_M, backend="reference")
    close = torch.isclose(fast.distance, slow.distance, rtol=1e-3, atol=1e-3)
    close &= (fast.weight - slow.weight).abs() < 1e-3
    # The definition steps over corners of pixels (a pixel of the longer axis a step): there a ray
    # may pass a silhouette that it grazes, about one ray in 300.
    assert int((~close).sum()) <= 0.005 * close.numel()


@pytest.mark.parametrize(("backend", "stride"), [("reference", 1), ("cpu", 1), ("cpu", 4)])
def test_only_needed_pixels_are_traced(backend, stride):
    camera = looking(6, 10)
    front = see(camera, CAR, WALL)
    whole = trace_screen(front, camera, LEVEL_M, stride=1, backend=backend)
    needed = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    needed[40:60, 5:70] = True
    needed[65::3, 1::3] = True  # alone between pixels that are not
    part = trace_screen(front, camera, LEVEL_M, needed=needed, stride=stride, backend=backend)
    assert (part.weight[~needed] == 0).all() and part.distance[~needed].isinf().all()
    assert (part.weight >= 0).all() and int((part.weight[needed] > 0).sum()) > 500
    if stride == 1:
        assert torch.equal(part.distance[needed], whole.distance[needed])
        assert torch.equal(part.weight[needed], whole.weight[needed])
