"""Snow near the camera: split discs cover what the whole ones did and show grain; crystals glint.

On a GPU that is pretended it becomes what it becomes on the CPU.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.effects.snow.kernels import FARTHEST_M, MAX_SPLITS, REACH, SPREAD, CloseView
from augment.effects.snow.near_camera import (
    MOTTLE,
    RELIEF,
    Crystals,
    Grain,
    Layer,
    SnowLayers,
    finest_split,
    shift_m,
    split_discs,
    split_near,
    sun_step,
    view_limits,
)
from augment.geometry import rigid
from augment.render.buffers import ALPHA, RGB
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene import Actor, Gaussians, PosedGaussians, Track
from augment.semantics import SemanticClass
from tests.augment.pretend_gpu import AwayTensor, held_by, pretended_gpu
from tests.snow_beds import scene_of

CELL_M, OPACITY = 0.05, 0.98
SUN = torch.tensor([math.cos(0.6), 0.0, math.sin(0.6)], dtype=torch.float64)
GRAIN = Grain(amount=0.5, contrast=0.4, seed=5)


def sheet(first_m=2.0, last_m=8.0, half_m=1.5, color=0.7) -> Gaussians:
    """Level snow at z = 0, ahead along +x, its discs scattered as those of a layer."""
    x, y = torch.meshgrid(
        torch.arange(first_m, last_m, CELL_M), torch.arange(-half_m, half_m, CELL_M), indexing="ij"
    )
    count = x.numel()
    scatter = (
        0.4 * CELL_M * (torch.rand(2, count, generator=torch.Generator().manual_seed(1)) - 0.5)
    )
    side = SPREAD * CELL_M
    return Gaussians(
        means=torch.stack(
            [x.flatten() + scatter[0], y.flatten() + scatter[1], torch.zeros(count)], 1
        ),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.tensor([[side, side, 0.01]]).repeat(count, 1),
        opacities=torch.full((count,), OPACITY),
        sh=torch.full((count, 1, 3), (color - 0.5) / SH_C0),
    )


def camera(x_m=0.0, y_m=0.0, z_m=1.4, f=500.0, width=320, height=240) -> Camera:
    """Looking along +x, 20 degrees down."""
    tilt = math.radians(20)
    forward = torch.tensor([math.cos(tilt), 0.0, -math.sin(tilt)], dtype=torch.float64)
    right = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    centre = torch.tensor([x_m, y_m, z_m], dtype=torch.float64)
    pose = rigid(rotation, -rotation @ centre)
    return Camera("close", width, height, f, f, width / 2, height / 2, pose)


def picture(*gaussians: Gaussians, view: Camera):
    parts = [PosedGaussians(g) for g in gaussians]
    return rasterize(parts, view, buffers=(RGB, ALPHA))


def colors(gaussians: Gaussians) -> torch.Tensor:
    return gaussians.sh[:, 0] * SH_C0 + 0.5


def test_what_is_split_covers_what_it_covered():
    snow, view = sheet(1.0, 7.0), camera(f=900.0, width=640, height=480)
    near = split_near(snow, None, view, SUN, GRAIN)
    before, after = picture(snow, view=view), picture(near.whole, near.fine, view=view)
    inside = before.alpha > 0.99
    assert int(inside.sum()) > 20_000
    assert float(after.alpha[inside].min()) > 0.97
    assert float((before.alpha - after.alpha).abs().mean()) < 0.01
    tone = (after.rgb[inside].mean() - before.rgb[inside].mean()).abs()
    assert float(tone) < 0.01  # grain is neither lighter nor darker than the snow
    assert float(after.rgb[inside].std()) > 3 * float(before.rgb[inside].std())


def test_near_discs_are_split_most_and_far_ones_not_at_all():
    snow, view = sheet(0.8, 14.0, half_m=0.6), camera(f=1500.0, width=960, height=720)
    near = split_near(snow, None, view, SUN, GRAIN)
    distance = (near.fine.means - view.centre.float()).norm(dim=1)
    parts = REACH * SPREAD * CELL_M / near.fine.scales[:, 0]  # into how many, along a side
    assert float(distance.max()) < FARTHEST_M + CELL_M
    assert set(parts.round().int().tolist()) <= set(range(2, MAX_SPLITS + 1))
    close, far = parts[distance < 2.5], parts[distance > 5]
    assert float(close.mean()) > float(far.mean()) + 0.5
    wide = camera(f=60.0, width=64, height=48)  # whose pixels are coarser than the discs
    assert split_near(sheet(4.0, 9.0), None, wide, SUN, GRAIN) is None
    assert split_near(sheet(11.0, 14.0), None, view, SUN, GRAIN) is None


def test_grain_belongs_to_the_place():
    """Two cameras at one distance from a disc split it into the same discs, of the same colours."""
    snow = sheet(3.0, 3.05, 0.02)
    here, there = camera(y_m=0.2, f=900.0), camera(y_m=-0.2, f=900.0)
    one = split_near(snow, None, here, SUN, GRAIN).fine
    two = split_near(snow, None, there, SUN, GRAIN).fine
    assert torch.equal(one.means, two.means)
    assert torch.allclose(colors(one), colors(two), atol=2e-3)  # 1 cm of difference in the fade
    assert float(colors(one).std()) > 0.005
    other = split_near(snow, None, here, SUN, Grain(0.5, 0.4, seed=6)).fine
    assert not torch.allclose(colors(one), colors(other), atol=2e-3)


# ---- Against definitions, and on a GPU -----------------------------------------------------------

WRAP = 0.3
CLOSE = {"f": 900.0, "width": 640, "height": 480}


def discs(count: int, seed: int, *, far_m: float = 11.0) -> Gaussians:
    """Snow ahead of the camera, as far as it is split and farther, of many sizes and colours."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(count, 7, generator=generator)
    tilt = 0.3 * (drawn[:, 5] - 0.5)
    zero = torch.zeros(count)
    return Gaussians(
        means=torch.stack([1.5 + far_m * drawn[:, 0] ** 2, 4 * drawn[:, 1] - 2, zero], 1),
        quats=torch.stack([torch.cos(tilt), torch.sin(tilt), zero, zero], 1),
        scales=torch.stack([0.02 + 0.03 * drawn[:, 2], 0.02 + 0.03 * drawn[:, 3], zero + 0.01], 1),
        opacities=torch.full((count,), 0.98),
        sh=((drawn[:, 4:] - 0.5) / SH_C0)[:, None],
        semantic=torch.full((count,), int(SemanticClass.SNOW), dtype=torch.int16),
    )


def moved(gaussians: Gaussians, shift) -> Gaussians:
    return dataclasses.replace(gaussians, means=gaussians.means + torch.tensor(shift))


def crystals(count: int, seed: int, *, spread_m=6.0) -> Crystals:
    rng = np.random.default_rng(seed)
    places = rng.uniform((0, -spread_m, 0), (20, spread_m, 0.1), (count, 3)).astype(np.float32)
    up, around = rng.random(count), 2 * np.pi * rng.random(count)
    flat = np.sqrt(1 - up * up)
    mirrors = np.stack([flat * np.cos(around), flat * np.sin(around), up], 1).astype(np.float32)
    return Crystals(torch.from_numpy(places), torch.from_numpy(mirrors), 0.9)


def snow_layers_of(ground: Layer, **actors: Layer) -> SnowLayers:
    return SnowLayers(ground, actors, tuple(SUN.tolist()), WRAP, 0.1, GRAIN)


def layer(gaussians: Gaussians, own: int = 3, **options) -> Layer:
    return Layer(gaussians, torch.ones(own), **options)


def drawn_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Those with an opacity, by place: the GPU lists them in an order of its own."""
    names = ("means", "quats", "scales", "opacities", "sh")
    held = {name: held_by_or_own(getattr(gaussians, name)).numpy() for name in names}
    shown = np.flatnonzero(held["opacities"] > 0)
    order = shown[np.lexsort(np.round(held["means"][shown], 4).T)]
    return {name: values[order] for name, values in held.items()}


def held_by_or_own(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.inner if isinstance(tensor, AwayTensor) else tensor.cpu()


def assert_alike(found: Gaussians, expected: Gaussians, *, flips=0, opacity=0.0) -> None:
    """flips: of splats whose noise may be of another texel. opacity: how far those of glints may be
    off: a lobe is narrow, and its rim steep.
    """
    a, b = drawn_of(found), drawn_of(expected)
    for name, values in b.items():
        assert a[name].shape == values.shape, name
        # Places lie metres from the origin, of which float32 tells 1e-7.
        atol = opacity if name == "opacities" else 2e-6
        wrong = np.abs(a[name] - values).reshape(len(values), -1).max(1, initial=0) > (
            atol + 2e-7 * np.abs(values).reshape(len(values), -1).max(1, initial=0)
        )
        assert wrong.sum() <= (flips if name == "sh" else 0), f"{name}: {wrong.sum()}"


def count_splits(snow: Gaussians, view: Camera) -> np.ndarray:
    """Into how many discs along each side every disc is split: what the kernel computes."""
    means = snow.means.double().numpy()
    x, y, z = (means @ view.camera_from_world[:3, :3].T.numpy()).T + (
        view.camera_from_world[:3, 3:].numpy()
    )
    far = np.sqrt(x * x + y * y + z * z)
    left, right, top, bottom = view_limits(view)
    seen = (z > 0) & (far < FARTHEST_M) & (left * z <= x) & (x <= right * z)
    seen &= (top * z <= y) & (y <= bottom * z)
    side = REACH * snow.scales[:, :2].double().amax(1).numpy()
    count = np.minimum(np.floor(side / (finest_split(view) * far) + 0.5), MAX_SPLITS)
    return np.where(seen & (count > 1), count, 0).astype(np.int64)


@pytest.mark.parametrize("lit", [False, True], ids=["per splat", "per pixel"])
@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (4096.0, -2048.0, 64.0)])
def test_the_kernel_splits_discs_as_its_definition_does(lit, shift):
    snow, view = moved(discs(300, 1), shift), camera(shift[0], shift[1], 1.4 + shift[2], **CLOSE)
    slopes = 0.4 * torch.rand(300, 3, generator=torch.Generator().manual_seed(9)) if lit else None
    kept = snow.opacities.clone()
    found = split_near(snow, slopes, view, SUN, GRAIN)
    splits = count_splits(snow, view)
    chosen = np.flatnonzero(splits)
    assert 40 < len(chosen) < 260
    numbers = CloseView(
        *(view.centre, torch.from_numpy(sun_step(SUN.numpy()))),
        torch.from_numpy(shift_m(GRAIN.seed)),
        *(GRAIN.amount * GRAIN.contrast * RELIEF, GRAIN.amount * MOTTLE, finest_split(view)),
    )
    total = int((splits**2).sum())
    picked = torch.from_numpy(chosen), torch.from_numpy(splits[chosen])
    expected = split_discs(snow, slopes, *picked, total, numbers)
    assert torch.equal(snow.opacities, kept)
    assert torch.equal(found.whole.opacities, expected.whole.opacities)
    assert int((found.fine.sh[:, 0].std(0) > 0.01).sum()) == 3
    for name in ("means", "quats", "scales", "opacities", "sh", "semantic"):
        # Both count in float64 and round once: a last bit may differ.
        pair = getattr(found.fine, name), getattr(expected.fine, name)
        torch.testing.assert_close(*pair, rtol=2e-7, atol=1e-7)
    if lit:
        torch.testing.assert_close(found.fine_slopes, expected.fine_slopes, rtol=2e-7, atol=1e-7)


def yawed(angle: float, x: float, y: float) -> torch.Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=torch.float64)
    return rigid(turn, torch.tensor([x, y, 0.5], dtype=torch.float64))


@pytest.fixture
def street():
    """Snow on the ground and on two vehicles, all of which glints."""
    normals = torch.nn.functional.normalize(
        torch.tensor([[0.0, 0.3, 1.0]])
        + 0.5 * torch.rand(70, 3, generator=torch.Generator().manual_seed(4)),
        dim=1,
    )
    ground = layer(moved(discs(300, 6), (12.0, 0.0, 0.0)), crystals=crystals(1500, 7))
    cars = {
        name: layer(
            discs(count, seed, far_m=2.0),
            own=2,
            slopes=0.3 * torch.ones(count, 3),
            normals=normals[:count],
            crystals=crystals(count, seed, spread_m=1.0) if seed == 8 else None,
        )
        for name, count, seed in (("a", 70, 8), ("b", 33, 9))
    }
    own = {2: discs(2, 3), 3: discs(3, 4)}
    actors = tuple(
        Actor(name, "car", own[2], Track(torch.tensor([0, 10]), torch.stack([pose, pose])),
              (2.0, 2.0, 1.0))
        for name, pose in (("a", yawed(0.7, 3.0, 1.0)), ("b", yawed(-2.0, 5.0, -2.0)))
    )  # fmt: skip
    return scene_of(own[3], actors), snow_layers_of(ground, **cars)


def test_a_street_full_of_snow_is_the_cpus(street, monkeypatch):
    """Lit by normals, glinting, in parts that are turned: the same parts in the same order."""
    scene, cover = street
    expected = cover.parts_for(scene, camera(**CLOSE))
    with pretended_gpu(monkeypatch):
        found = cover.parts_for(scene, camera(**CLOSE), backend="cuda")
        again = cover.parts_for(scene, camera(**CLOSE), backend="cuda")
    assert len(expected) == 3 + 1 + 1 + 2 + 1  # own; ground and glints, twice that or no glints
    # A part whose crystals all face away is listed all the same, without one that shows.
    assert [(p.instance_id, p.is_overlay) for p in found] == [
        (p.instance_id, p.is_overlay) for p in expected
    ]
    for a, b, c in zip(found, expected, again, strict=True):
        assert_alike(a.gaussians, b.gaussians, opacity=2e-4)
        assert a.world_from_part is b.world_from_part or torch.equal(
            a.world_from_part, b.world_from_part
        )
        for name in ("means", "opacities", "sh"):
            one, two = (held_by_or_own(getattr(p.gaussians, name)) for p in (a, c))
            assert torch.equal(one, two)
    # What is the part's own is one object from frame to frame, on either side.
    assert all(a.gaussians is b.gaussians is c.gaussians
               for a, b, c in zip(found[:3], expected[:3], again[:3], strict=True))  # fmt: skip
    glints = found[4].gaussians
    assert 0 < int((held_by(glints.opacities) > 0).sum()) < 60
