"""What a view's snow becomes on a GPU that is pretended: what it becomes on the CPU."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.effects.snow import cuda
from augment.effects.snow.cuda import MAX_GLINTS, blocks_of, plan_split, pose_layers
from augment.effects.snow.kernels import MAX_SPLITS
from augment.effects.snow.near_camera import Crystals, Grain, Layer, SnowLayers, split_near
from augment.geometry import rigid
from augment.render.cuda import runtime as gpu
from augment.render.cuda.runtime import upload_together
from augment.render.sh import SH_C0
from augment.scene import Actor, Gaussians, PosedGaussians, Track
from augment.semantics import SemanticClass
from augment.views import render_view
from tests.augment.kernel_frames import RECIPES, small_scene
from tests.augment.pretend_gpu import AwayTensor, held_by, pretended_gpu
from tests.snow_beds import scene_of

SUN = np.array([math.cos(0.6), 0.0, math.sin(0.6)])
GRAIN = Grain(amount=0.5, contrast=0.4, seed=5)
WRAP = 0.3


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


def camera(shift=(0.0, 0.0, 0.0), f=900.0) -> Camera:
    """Looking along +x, 20 degrees down, from 1.4 m over what it is shifted to."""
    tilt = math.radians(20)
    forward = torch.tensor([math.cos(tilt), 0.0, -math.sin(tilt)], dtype=torch.float64)
    right = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    centre = torch.tensor([0.0, 0.0, 1.4], dtype=torch.float64) + torch.tensor(shift).double()
    return Camera("close", 640, 480, f, f, 320.0, 240.0, rigid(rotation, -rotation @ centre))


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


def posed_on_gpu(cover, covered, view, monkeypatch) -> list[PosedGaussians]:
    with pretended_gpu(monkeypatch):
        return pose_layers(cover, covered, view)


@pytest.mark.parametrize("lit", [False, True], ids=["per splat", "per pixel"])
def test_near_discs_are_split_as_on_the_cpu(lit, monkeypatch):
    snow, view = discs(150, 1), camera()
    slopes = 0.4 * torch.rand(150, 3, generator=torch.Generator().manual_seed(9)) if lit else None
    kept = snow.opacities.clone()
    near = split_near(snow, slopes, view, torch.from_numpy(SUN), GRAIN)
    cover = snow_layers_of(layer(snow, slopes=slopes))
    whole, fine = posed_on_gpu(cover, [(cover.ground, PosedGaussians(snow))], view, monkeypatch)
    assert torch.equal(snow.opacities, kept)
    left = held_by(whole.gaussians.opacities)
    assert torch.equal(left, near.whole.opacities) and 20 < int((left == 0).sum()) < 130
    assert_alike(fine.gaussians, near.fine, flips=2)
    assert int((near.fine.sh[:, 0].std(0) > 0.01).sum()) == 3
    assert len(near.fine) <= len(fine.gaussians) <= 4 * len(near.fine)
    assert whole.is_overlay and fine.is_overlay
    assert held_by(fine.gaussians.semantic).eq(int(SemanticClass.SNOW)).all()
    assert (fine.shading is None) == (not lit)
    if lit:
        assert whole.shading.slopes is slopes
        shown = held_by(fine.gaussians.opacities) > 0
        totals = held_by(fine.shading.slopes)[shown].sum(0), near.fine_slopes.sum(0)
        torch.testing.assert_close(*totals, rtol=1e-4, atol=0)
        assert fine.shading.sun == pytest.approx(tuple(SUN))


def test_grain_keeps_its_place_far_from_the_origin(monkeypatch):
    shift = (4096.0, -2048.0, 64.0)  # where float32 tells half a millimetre
    snow, view = moved(discs(60, 2, far_m=4.0), shift), camera(shift)
    near = split_near(snow, None, view, torch.from_numpy(SUN), GRAIN)
    cover = snow_layers_of(layer(snow))
    _, fine = posed_on_gpu(cover, [(cover.ground, PosedGaussians(snow))], view, monkeypatch)
    found = np.sort(drawn_of(fine.gaussians)["sh"].reshape(-1))
    expected = np.sort(drawn_of(near.fine)["sh"].reshape(-1))
    assert found.shape == expected.shape
    assert (np.abs(found - expected) > 1e-4).mean() < 0.02


def test_no_block_near_the_eye_is_left_out_and_few_others_are_looked_at():
    snow = discs(20_000, 3, far_m=40.0)
    for f, place in ((900.0, (0.0, 0, 0)), (2500.0, (3.0, 1, -1)), (300.0, (8.0, 0, 0.5))):
        view = camera(place, f)
        near = split_near(snow, None, view, torch.from_numpy(SUN), GRAIN)
        split = plan_split(snow, None, view, SUN, GRAIN)
        assert near is not None and split is not None
        rows, order = split.arrays[0], split.order.numpy()
        reserved = np.zeros(len(snow), int)
        for first, count, most, _ in rows.tolist():
            reserved[order[first : first + count]] = most**2
        gone = (near.whole.opacities == 0).numpy()
        parts = near.fine.opacities.shape[0]
        assert (reserved[gone] > 0).all() and reserved[gone].sum() >= parts
        assert split.total == reserved.sum() <= len(snow) * MAX_SPLITS**2
        ends = rows[:, 3] + rows[:, 1] * rows[:, 2] ** 2
        assert (rows[1:, 3] == ends[:-1]).all() and ends[-1] == split.total


def yawed(angle: float, x: float, y: float) -> torch.Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=torch.float64)
    return rigid(turn, torch.tensor([x, y, 0.5], dtype=torch.float64))


@pytest.fixture
def street(monkeypatch):
    """A cover with snow on the ground and on two vehicles, all of which glints."""
    del monkeypatch
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
    expected = cover.parts_for(scene, camera())
    with pretended_gpu(monkeypatch):
        found = cover.parts_for(scene, camera(), backend="cuda")
        again = cover.parts_for(scene, camera(), backend="cuda")
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
    assert len(glints) <= 2 * MAX_GLINTS


@pytest.mark.long
def test_a_picture_of_close_and_glinting_snow_is_the_cpus(monkeypatch):
    scene, recipe = small_scene(), RECIPES["snow, close and glinting"]
    view = scene.frames[0].cameras["ahead"].cropped(8, 3, 7, 5)
    expected = render_view(scene, view, recipe, backend="cpu")
    launched = []
    launch = gpu.launch
    monkeypatch.setattr(
        gpu,
        "launch",
        lambda kernel, *a, **k: launched.append(kernel.__name__) or launch(kernel, *a, **k),
    )
    with pretended_gpu(monkeypatch):
        found = render_view(scene, view, recipe, backend="cuda")
    assert {"split_discs", "find_glints", "light_splats"} <= set(launched)
    assert np.abs(found.rgb.astype(int) - expected.rgb).max() <= 1
    assert (found.snow == expected.snow).all() and expected.snow.any()


def test_crystals_that_all_face_alike_leave_no_block_its_bounds(monkeypatch):
    """More than a block has room for: the first of them show, and nothing else is written."""
    many = crystals(1500, 3, spread_m=0.5)
    eye = camera().centre
    towards = torch.nn.functional.normalize(eye.float() - many.places_m, dim=1)
    facing = torch.nn.functional.normalize(towards + torch.from_numpy(SUN).float(), dim=1)
    bright = Crystals(many.places_m, facing, 1.0)
    snow = moved(discs(5, 1), (30.0, 0.0, 0.0))
    cover = snow_layers_of(layer(snow, crystals=bright))
    found = posed_on_gpu(cover, [(cover.ground, PosedGaussians(snow))], camera(), monkeypatch)[-1]
    assert len(found.gaussians) == 2 * MAX_GLINTS
    opacities = held_by(found.gaussians.opacities)
    assert int((opacities > 0.02).sum()) > MAX_GLINTS
    assert torch.isfinite(held_by(found.gaussians.means)).all() and float(opacities.max()) <= 1


@pytest.mark.gpu
def test_much_snow_on_a_gpu_is_the_cpus_and_the_same_every_time():
    snow, bright = discs(200_000, 11, far_m=60.0), crystals(300_000, 12, spread_m=20.0)
    cover = snow_layers_of(layer(snow, slopes=snow.sh[:, 0].abs(), crystals=bright))
    scene = scene_of(discs(3, 4))
    expected = cover.parts_for(scene, camera())
    found, again = (cover.parts_for(scene, camera(), backend="cuda") for _ in range(2))
    _, whole, fine, glints = (part.gaussians for part in expected)
    for a, b in zip(found[1:], again[1:], strict=True):
        for name in ("means", "opacities", "sh"):
            assert torch.equal(getattr(a.gaussians, name).cpu(), getattr(b.gaussians, name).cpu())
    there = [part.gaussians for part in found[1:]]
    # Discs at a threshold are split by one and not by the other.
    assert int((there[0].opacities.cpu() != whole.opacities).sum()) <= 10
    for own, other in zip(there[1:], (fine, glints), strict=True):
        shown = int((own.opacities > 0.0).sum())
        assert shown == pytest.approx(len(other), rel=5e-3)
        drawn = own.means[own.opacities > 0.0].cpu().double().mean(0)
        torch.testing.assert_close(drawn, other.means.double().mean(0), rtol=0, atol=0.05)


@pytest.mark.parametrize("many", [0, 1024], ids=["groups first", "all blocks"])
def test_blocks_hold_every_point_once_and_are_compact(many, monkeypatch):
    monkeypatch.setattr(cuda, "_MANY", many)
    rng = np.random.default_rng(0)
    points = rng.uniform((-30, 5, -1), (30, 40, 2), (5000, 3)).astype(np.float32)
    blocks = blocks_of(points, 128)
    assert sorted(blocks.order.tolist()) == list(range(5000))
    assert blocks.counts(np.arange(40)).sum() == 5000 and len(blocks) == 40
    extents = blocks.highs - blocks.lows
    assert np.median(extents[:, :2]) < 15  # of 60 m by 35 m
    for eye in (np.array([3.0, 10.0, 1.0]), np.array([90.0, 0.0, 1.0])):
        gaps = np.linalg.norm(points.astype(np.float64) - eye, axis=1)[blocks.order]
        nearest = np.minimum.reduceat(gaps, np.arange(0, 5000, 128))
        for reach in (1.0, 12.0, 200.0):
            near, distances = blocks.near(eye, reach)
            assert set(np.flatnonzero(nearest < reach)) <= set(near.tolist())
            assert (distances <= nearest[near] + 1e-9).all() and (distances < reach).all()
        assert len(near) == 40
    assert (blocks.largest(points[:, 0])[0] == points[blocks.order[:128], 0].max()).all()
    assert (
        len(blocks_of(points[:0], 128)) == 0
        and len(blocks_of(points[:0], 8).near(eye, 9.0)[0]) == 0
    )


def test_arrays_of_several_kinds_travel_together(monkeypatch):
    arrays = [
        np.arange(3, dtype=np.int64),
        np.zeros((0, 4), np.int32),
        np.linspace(0, 1, 7, dtype=np.float32),
        np.arange(10, dtype=np.int32).reshape(5, 2),
    ]
    with pretended_gpu(monkeypatch):
        there = [held_by(tensor) for tensor in upload_together(arrays)]
    for tensor, array in zip(there, arrays, strict=True):
        assert tensor.numpy().dtype == array.dtype and np.array_equal(tensor.numpy(), array)
        assert tensor.storage_offset() * tensor.element_size() % 16 == 0
