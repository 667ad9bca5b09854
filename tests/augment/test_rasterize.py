"""One call over all backends, the CPU's kernels, and the passes over finished images."""

from __future__ import annotations

import dataclasses
import logging
import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from augment.errors import BackendUnavailable
from augment.render import backends
from augment.render import rasterize as module
from augment.render.buffers import (
    ALPHA,
    BUFFERS,
    EXPECTED_DEPTH,
    MEDIAN_DEPTH,
    OVERLAY,
    RGB,
    SPLAT_IDS,
    RenderOutput,
)
from augment.render.composite import apply_color_map, composite_sky, to_byte_array
from augment.render.constants import RasterSettings
from augment.render.cpu import driver as cpu
from augment.render.cpu.driver import rasterize_cpu
from augment.render.fog import Fog
from augment.render.rasterize import rasterize, renormalise_alpha
from augment.render.reference import rasterize_reference
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid, rotmat_from_quat
from augment.scene.scene import Gaussians, PosedGaussians
from augment.scene.sky import CubemapSky
from tests.assertions import assert_images_close, assert_labels_equal, assert_stored_render
from tests.scenes import (
    GOLDEN,
    camera_ahead,
    golden_view,
    one_gaussian,
    parts_in_float64,
    random_gaussians,
    random_pose,
    slight_pose,
    stack,
)


@pytest.fixture
def parts():
    return [
        PosedGaussians(random_gaussians(150)),
        PosedGaussians(random_gaussians(50, seed=1), slight_pose(), 1),
    ]


@pytest.fixture
def fresh_log(caplog):
    module._log_choice.cache_clear()
    caplog.set_level(logging.INFO, logger=module.__name__)
    return caplog


def tracked(part):
    sh = part.gaussians.sh.clone().requires_grad_()
    return dataclasses.replace(part, gaussians=dataclasses.replace(part.gaussians, sh=sh))


def doubled(part):
    names = ("means", "quats", "scales", "opacities", "sh")
    tensors = {name: getattr(part.gaussians, name).double() for name in names}
    return dataclasses.replace(part, gaussians=Gaussians(**tensors))


# ---- what comes back --------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_only_the_buffers_asked_for(parts, backend):
    for asked in (["rgb", "alpha"], list(BUFFERS)):
        output = rasterize(parts, camera_ahead(), buffers=asked, backend=backend)
        assert [name for name in BUFFERS if getattr(output, name) is not None] == asked
    default = rasterize(parts, camera_ahead(), backend=backend)
    assert [name for name in BUFFERS if getattr(default, name) is not None] == ["rgb", "alpha"]


def test_backends_draw_the_same_picture(parts):
    camera, smog = camera_ahead(61, 43, 55.0), Fog(0.05, (0.7, 0.7, 0.7), 20.0)
    reference, cpu = (
        rasterize(parts, camera, fog=smog, backend=name) for name in ("reference", "cpu")
    )
    # float32 in two orders of operations; flips at the 1/255 cut-off are allowed for
    assert_images_close(cpu.rgb, reference.rgb, p999=1e-4, max_flips=3)
    assert_images_close(cpu.alpha, reference.alpha, p999=1e-4, max_flips=3)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_what_a_raised_stop_leaves_is_shared(parts, backend):
    """Finished pixels are opaque and keep their hue; the others are as ever."""
    camera, stop = camera_ahead(61, 43, 55.0), 0.2
    settings = RasterSettings(transmittance_stop=stop)
    exact = rasterize(parts, camera, backend=backend)
    output = rasterize(parts, camera, settings=settings, backend=backend)
    finished = output.alpha == 1
    assert torch.equal(output.rgb[~finished], exact.rgb[~finished])
    assert (
        float(output.alpha[~finished].max()) < 1 - stop < float(exact.alpha[finished].min()) + 1e-6
    )
    every = rasterize(parts, camera, buffers=BUFFERS, settings=settings, backend=backend)
    assert torch.equal(every.rgb, output.rgb) and torch.equal(every.overlay, 0 * every.overlay)
    alone = rasterize(parts, camera, buffers={"rgb"}, settings=settings, backend=backend)
    assert alone.alpha is None and torch.equal(alone.rgb, output.rgb)


def test_kernel_and_definition_share_the_rest_alike():
    rng = torch.Generator().manual_seed(0)
    images = {"rgb": (9, 7, 3), "alpha": (9, 7), "overlay": (9, 7)}
    images = {name: torch.rand(shape, generator=rng) for name, shape in images.items()}
    images["alpha"][0, :3] = torch.tensor([0.75, 1.0, 0.0])
    slow = renormalise_alpha(RenderOutput(**images), 0.25, backend="reference")
    fast = renormalise_alpha(RenderOutput(**{n: i.clone() for n, i in images.items()}), 0.25)
    for name in images:
        torch.testing.assert_close(getattr(fast, name), getattr(slow, name), rtol=3e-7, atol=0)
    assert slow.alpha[0, 0] == 1 and slow.alpha[0, 2] == 0


# ---- choice of backend ------------------------------------------------------------------------


def test_auto_takes_what_it_can_and_says_so_once(parts, fresh_log):
    for given, buffers, told in (
        (parts, ["rgb"], "renders with 'cpu' (float32)"),
        ([parts[0], tracked(parts[1])], ["rgb"], "renders with 'cpu'"),
        ([parts[0], tracked(parts[1])], ["rgb", "median_depth"], "gradients of median_depth"),
        ([doubled(part) for part in parts], ["rgb"], "torch.float64"),
    ):
        module._log_choice.cache_clear()
        fresh_log.clear()
        for _ in range(2):
            output = rasterize(given, camera_ahead(), buffers=buffers)
        (record,) = fresh_log.records
        assert told in record.getMessage()
        assert output.rgb.dtype == given[0].gaussians.means.dtype
        assert output.rgb.requires_grad == any(p.gaussians.sh.requires_grad for p in given)


def test_a_failing_import_names_the_reason_and_the_way_out(monkeypatch):
    import sys

    import augment.render.cpu

    monkeypatch.delattr(augment.render.cpu, "driver", raising=False)
    monkeypatch.setitem(sys.modules, "augment.render.cpu.driver", None)
    with pytest.raises(BackendUnavailable, match=r"unavailable: .*numba, tbb.*'reference'"):
        backends.import_cpu()


# ---- refused ----------------------------------------------------------------------------------


def test_what_no_backend_takes_is_refused(parts):
    first, second = parts
    lost = dataclasses.replace(second, world_from_part=second.world_from_part * 1e999)
    single = dataclasses.replace(first, world_from_part=torch.eye(4))
    for arguments, message in (
        ({"buffers": ["rgb", "depth"]}, "unknown buffers 'depth' asked for; known: "),
        ({"buffers": []}, "no buffers asked for; known: rgb, alpha"),
        ({"buffers": "rgb"}, "collection of names; got the string 'rgb'"),
        ({"backend": "gpu"}, "one of auto, reference, cpu, cuda; got 'gpu'"),
        ({"near_m": 0.0}, "near_m must be finite and > 0"),
        ({"alpha_max": 1.0}, "alpha_max must be between"),
        ({"sh_degree": 4}, "None or 0 to 3; got 4"),
        ({"mode_depth_floor_m": 0.0}, "mode_depth_floor_m must be finite and > 0"),
        ({"transmittance_stop": 0.3}, "> 0 and at most 0.25, since median depth"),
        ({"radius_clip_px": -1.0}, "finite and >= 0 (pixels); got -1.0"),
        ({"parts": []}, "non-empty sequence of PosedGaussians; got an empty one"),
        ({"parts": [first, doubled(second)]}, "part 0 is torch.float32, part 1 is torch.float64"),
        ({"parts": [single]}, "float64 [4, 4]"),
        ({"parts": [first, lost]}, "part 1 (instance 1): world_from_part holds NaN or infinite"),
    ):
        if arguments.keys() <= {field.name for field in dataclasses.fields(RasterSettings)}:
            arguments = {"settings": RasterSettings(**arguments)}
        with pytest.raises((ValueError, TypeError), match=re.escape(message)):
            rasterize(**{"parts": parts, "camera": camera_ahead(), **arguments})


def test_cpu_refuses_what_it_cannot_do(parts):
    with pytest.raises(ValueError, match=r"torch\.float64, it takes torch\.float32; convert"):
        rasterize([doubled(parts[0])], camera_ahead(), backend="cpu")
    asked = {"buffers": ["rgb", "splat_ids", "median_depth"], "backend": "cpu"}
    message = "gradients of median_depth, splat_ids are asked for, it has none; convert"
    with pytest.raises(ValueError, match=message):
        rasterize([tracked(parts[0])], camera_ahead(), **asked)


# ---- passes over finished images -----------------------------------------------------------------


def cameras() -> list[Camera]:
    """Six views of a cube map, so that every face and every edge between faces is crossed."""
    generator = torch.Generator().manual_seed(3)
    quats = torch.randn(6, 4, generator=generator, dtype=torch.float64)
    base = Camera("c", 61, 37, 30.0, 31.0, 29.0, 19.0, torch.eye(4, dtype=torch.float64))
    shift = torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)
    return [
        dataclasses.replace(base, camera_from_world=rigid(rotmat_from_quat(q), shift))
        for q in quats
    ]


@pytest.mark.parametrize("number", [1, 2])
def test_the_kernel_matches_the_definition(number):
    camera, smog = cameras()[number], (None, Fog(0.01, (0.5, 0.6, 0.7), 30.0, -2.0))[number % 2]
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(37, 61, 3, generator=generator)
    alpha = torch.rand(37, 61, generator=generator)
    sky = CubemapSky(torch.rand(6, 16, 16, 3, generator=generator))
    fast = composite_sky(rgb, alpha, camera, sky, fog=smog)
    slow = composite_sky(rgb, alpha, camera, sky, fog=smog, backend="reference")
    # Noise textures of 16 texels: float32 rounding of coordinates (1e-6) times 16 texels; a
    # pixel whose direction lies on an edge between faces may fall to either side.
    difference = (fast - slow).abs().amax(-1)
    assert float(difference.quantile(0.995)) < 1e-4
    assert int((difference > 1e-3).sum()) <= 2


def test_opaque_pixels_keep_their_colour_to_the_bit():
    rgb = torch.rand(37, 61, 3)
    out = composite_sky(rgb, torch.ones(37, 61), cameras()[0], CubemapSky(torch.rand(6, 4, 4, 3)))
    assert torch.equal(out, rgb)


def test_gradients_pass_through_the_sky():
    rgb = torch.rand(37, 61, 3, requires_grad=True)
    alpha = torch.rand(37, 61, requires_grad=True)
    sky = CubemapSky(torch.rand(6, 4, 4, 3))
    composite_sky(rgb, alpha, cameras()[0], sky).sum().backward()
    assert torch.equal(rgb.grad, torch.ones_like(rgb))
    behind = sky.sample(cameras()[0].ray_directions()).sum(-1)
    assert torch.allclose(alpha.grad, -behind, atol=1e-5)  # float32 sums of three numbers


def test_eight_bits_round_to_nearest_and_clamp():
    values = torch.tensor([-0.2, 0.0, 0.4 / 255, 0.6 / 255, 127.5 / 255, 1.0, 7.0])
    image = values[:, None, None].expand(7, 1, 3).contiguous()
    expected = np.array([0, 0, 0, 1, 128, 255, 255], np.uint8)
    assert np.array_equal(to_byte_array(image)[:, 0, 0], expected)
    assert np.array_equal(to_byte_array(image.double())[:, 0, 0], expected)


COLOR_MAP = torch.tensor([[1.1, 0.05, 0.0, 0.02], [-0.1, 0.9, 0.1, 0.0], [0.0, 0.2, 1.2, -0.05]])


@pytest.mark.parametrize("size", [(37, 61), (1, 1)])
def test_colour_maps_match_their_definition(size):
    rgb = torch.rand(*size, 3) * 1.5 - 0.2  # pictures are not clamped before
    expected = rgb.double() @ COLOR_MAP[:, :3].double().T + COLOR_MAP[:, 3].double()
    slow = apply_color_map(rgb, COLOR_MAP, backend="reference")
    fast = apply_color_map(rgb.clone(), COLOR_MAP)
    # Sums of four float32 products below 2.
    torch.testing.assert_close(slow.double(), expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(fast.double(), expected, atol=1e-6, rtol=0)
    assert torch.equal(apply_color_map(rgb.double(), COLOR_MAP), expected)


def test_gradients_pass_through_colour_maps():
    rgb = torch.rand(5, 4, 3, requires_grad=True)
    apply_color_map(rgb, COLOR_MAP).sum().backward()
    torch.testing.assert_close(rgb.grad, COLOR_MAP[:, :3].sum(0).expand(5, 4, 3))


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


@pytest.mark.parametrize(("name", "mode"), GOLDEN)
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
