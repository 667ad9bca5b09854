"""The CPU rasteriser against stored renders, against the definition, and against itself."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from augment.geometry import rigid
from augment.render.buffers import (
    ALPHA,
    BUFFERS,
    EXPECTED_DEPTH,
    MEDIAN_DEPTH,
    OVERLAY,
    RGB,
    SPLAT_IDS,
)
from augment.render.constants import RasterSettings
from augment.render.cpu import driver as cpu
from augment.render.cpu.driver import rasterize_cpu
from augment.render.fog import Fog
from augment.render.reference import rasterize_reference
from augment.scene import Gaussians, PosedGaussians
from tests.assertions import assert_images_close, assert_labels_equal, assert_stored_render
from tests.scenes import (
    GOLDEN,
    GOLDEN_MODES,
    camera_ahead,
    golden_view,
    one_gaussian,
    parts_in_float64,
    random_gaussians,
    random_pose,
    slight_pose,
    stack,
)

ALL = frozenset(BUFFERS)
DEFAULT = RasterSettings()


def render(parts, camera, buffers=ALL, settings=DEFAULT, smog=None):
    parts = [PosedGaussians(parts)] if isinstance(parts, Gaussians) else parts
    return rasterize_cpu(parts, camera, frozenset(buffers), settings, smog)


def assert_same_bits(actual, expected, buffers=ALL):
    for name in buffers:
        assert torch.equal(getattr(actual, name), getattr(expected, name)), name


def assert_matches_definition(parts, camera, settings=DEFAULT, smog=None, *, max_flips=2):
    actual = render(parts, camera, ALL, settings, smog)
    expected = rasterize_reference(parts_in_float64(parts), camera, ALL, settings, smog)
    # 1e-5: forty float32 blends and an exp2 that is good to 3e-6. Depths are up to 9 m.
    for name in (RGB, ALPHA):
        assert_images_close(
            getattr(actual, name), getattr(expected, name), p999=1e-5, max_flips=max_flips
        )
    assert_images_close(
        actual.expected_depth, expected.expected_depth, p999=2e-4, flip=5e-3, max_flips=max_flips
    )
    # A pixel whose transmittance nears one half, or whose two heaviest splats weigh the same, may
    # name the next splat.
    assert_images_close(
        actual.median_depth, expected.median_depth, p999=1e-5, max_flips=max_flips + 2
    )
    assert_labels_equal(actual.splat_ids, expected.splat_ids, max_flips=max_flips + 2)
    # Nor may a sample join the cluster that another rounding leaves it out of.
    assert_images_close(
        actual.mode_depth, expected.mode_depth, p999=2e-4, flip=5e-3, max_flips=max_flips + 4
    )


# ---- stored renders ----------------------------------------------------------------------------


@pytest.mark.parametrize("mode", GOLDEN_MODES)
@pytest.mark.parametrize("name", GOLDEN)
def test_stored_renders(shared_dir, name, mode):
    parts, camera, settings, arrays = golden_view(shared_dir, name, mode)
    assert_stored_render(render(parts, camera, {RGB, ALPHA, EXPECTED_DEPTH}, settings), arrays)


# ---- the definition ----------------------------------------------------------------------------


@pytest.mark.parametrize(("size", "seed"), [((61, 43), 0), ((17, 33), 1), ((1, 1), 0)], ids=str)
def test_random_scenes(size, seed):
    width, height = size
    camera = camera_ahead(width, height, 0.9 * max(size))
    assert_matches_definition([PosedGaussians(random_gaussians(400, seed=seed))], camera)


@pytest.mark.parametrize(
    "settings",
    [
        RasterSettings(antialiased=True),
        RasterSettings(alpha_max=0.99, near_m=1.5),
        RasterSettings(sh_degree=1),
        RasterSettings(transmittance_stop=0.05, radius_clip_px=6.0),
        RasterSettings(transmittance_stop=1e-6, radius_clip_px=2.5, antialiased=True),
    ],
    ids=["antialiased", "near and alpha_max", "sh_degree", "coarse", "fine"],
)
def test_settings(settings):
    parts = [PosedGaussians(random_gaussians(400, size=0.1))]
    assert_matches_definition(parts, camera_ahead(97, 61, 80.0), settings)


@pytest.mark.parametrize(("scale_height_m", "base_z_m"), [(0.05, -3000.0), (0.05, 3000.0)])
def test_smog_far_below_and_above_its_layer(scale_height_m, base_z_m):
    smog = Fog(0.2, (0.8, 0.7, 0.5), scale_height_m, base_z_m)
    assert_matches_definition(
        [PosedGaussians(random_gaussians(200))], camera_ahead(position=(0.0, 0.0, 0.4)), smog=smog
    )


def test_poses():
    """Actors turned and moved, SH directions in their own frames, ids through all parts."""
    parts = [
        PosedGaussians(random_gaussians(300)),
        PosedGaussians(random_gaussians(150, seed=1), slight_pose(), 1),
        PosedGaussians(random_gaussians(150, seed=2, sh_degree=1), random_pose(), 2),
    ]
    assert_matches_definition(parts, camera_ahead(97, 61, 80.0, yaw=0.2))


# ---- corners -----------------------------------------------------------------------------------


def test_nothing_to_see():
    camera = camera_ahead(19, 7)
    behind = one_gaussian(mean=(-4.0, 0.0, 0.0))
    aside = one_gaussian(mean=(4.0, 90.0, 0.0))
    thin = one_gaussian(opacity=0.0039)
    for parts in (
        Gaussians.empty(3),
        stack(behind, aside, thin),
        [PosedGaussians(Gaussians.empty()), PosedGaussians(behind, random_pose())],
    ):
        output = render(parts, camera)
        for name in (RGB, ALPHA, EXPECTED_DEPTH, MEDIAN_DEPTH):
            assert torch.count_nonzero(getattr(output, name)) == 0
        assert (output.splat_ids == -1).all()


def test_equal_depths_keep_the_order_of_indices():
    """Layers at one depth in three blocks: what is seen depends on their order alone."""
    layers = [one_gaussian(opacity=0.3, rgb=(i % 7 / 7, 0.5, i / 40)) for i in range(40)]
    scene = stack(*layers).select(torch.arange(4200) % 40)
    camera = camera_ahead(17, 11, 15.0)  # two tiles
    assert_matches_definition([PosedGaussians(scene)], camera, max_flips=0)


# ---- the same bits -----------------------------------------------------------------------------


@pytest.fixture
def crowd():
    """Several blocks of Gaussians in two parts; some tiles close soon, some late, a few never."""
    near, far = (random_gaussians(n, seed=n, size=0.2, sh_degree=1) for n in (6000, 3000))
    near = near.select(near.means[:, 0] > 0.5)
    far = far.select(far.means[:, 0] > 1)
    parts = [PosedGaussians(near), PosedGaussians(far, slight_pose(), is_overlay=True)]
    return parts, camera_ahead(150, 111, 130.0)


@pytest.mark.parametrize(
    "buffers",
    # Sets that the library asks for: any other takes a kernel of its own, compiled for seconds.
    [{RGB, ALPHA}, {RGB, ALPHA, MEDIAN_DEPTH}, {RGB, ALPHA, OVERLAY}, {MEDIAN_DEPTH, SPLAT_IDS}],
    ids=lambda names: "+".join(sorted(names)),
)
def test_bits_do_not_depend_on_the_buffers_asked_for(crowd, buffers):
    output = render(*crowd, buffers)
    assert_same_bits(output, render(*crowd), buffers)
    assert all(getattr(output, name) is None for name in ALL - buffers)


def test_bits_do_not_depend_on_slices_and_lists(crowd, monkeypatch):
    monkeypatch.setattr(cpu, "_MIN_SLICE", 1_000_000)
    times: dict[str, float] = {}
    whole = rasterize_cpu(*crowd, ALL, DEFAULT, None, stage_times=times)
    monkeypatch.setattr(cpu, "_MIN_SLICE", 100)
    monkeypatch.setattr(cpu, "_SLICE_COVER", 1.0)
    monkeypatch.setattr(cpu, "_SLICE_GROWTH", 1.5)
    sliced_times: dict[str, float] = {}
    sliced = rasterize_cpu(*crowd, ALL, DEFAULT, None, stage_times=sliced_times)
    assert_same_bits(sliced, whole)
    assert sliced_times["visible"] < times["visible"]  # slices did leave something out
    monkeypatch.setattr(cpu, "_MAX_PAIRS", 300)
    assert_same_bits(render(*crowd), whole)


def test_a_quarter_turn_of_the_world_turns_nothing():
    """Camera and scene moved together: the same picture, its view-dependent colours included."""
    scene, camera = random_gaussians(300), camera_ahead(97, 61, 80.0)
    world = rigid(
        torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64),
        torch.tensor([3.0, 1.0, -2.0], dtype=torch.float64),
    )
    moved = dataclasses.replace(
        camera, camera_from_world=camera.camera_from_world @ torch.linalg.inv(world)
    )
    turned = render([PosedGaussians(scene, world)], moved)
    assert_images_close(turned.rgb, render(scene, camera).rgb, p999=1e-4, max_flips=2)


def test_threads_that_render_at_once(crowd):
    expected = render(*crowd)
    with ThreadPoolExecutor(4) as pool:
        for output in pool.map(lambda _: render(*crowd), range(8)):
            assert_same_bits(output, expected)
