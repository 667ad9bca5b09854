"""The definition: against loops, stored renders, known cases and finite differences."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from augment.render.buffers import ALPHA, BUFFERS, EXPECTED_DEPTH, MEDIAN_DEPTH, RGB
from augment.render.constants import RasterSettings
from augment.render.fog import Fog
from augment.render.reference import order_by_depth, project_parts, rasterize_reference
from augment.render.sh import rotate_sh
from augment.scene.geometry import multiply_quats, quat_from_rotmat, transform_points
from augment.scene.scene import Gaussians, PosedGaussians
from tests.assertions import assert_images_close
from tests.scenes import (
    GOLDEN,
    camera_ahead,
    golden_view,
    one_gaussian,
    random_gaussians,
    random_pose,
    slight_pose,
    smooth_gaussians,
    stack,
)

ALL = frozenset(BUFFERS)
DEFAULT = RasterSettings()


def render(gaussians, camera, buffers=ALL, settings=DEFAULT, smog=None):
    parts = [PosedGaussians(gaussians)] if isinstance(gaussians, Gaussians) else gaussians
    return rasterize_reference(parts, camera, frozenset(buffers), settings, smog)


def assert_outputs_close(actual, expected, atol):
    for name in (RGB, ALPHA, EXPECTED_DEPTH, MEDIAN_DEPTH):
        torch.testing.assert_close(
            getattr(actual, name), getattr(expected, name), rtol=0, atol=atol
        )
    assert torch.equal(actual.splat_ids, expected.splat_ids)


# ---- the definition, written once more as loops -----------------------------------------------


def loop_pixel(splats, column, row, settings):
    """rgb, alpha, expected depth, median depth, id, whether blending stopped, at one pixel."""
    transmittance, best_weight, best_id, median = 1.0, 0.0, -1, 0.0
    rgb, weight_sum, depth_sum, stopped = np.zeros(3), 0.0, 0.0, False
    for i in range(len(splats)):
        xx, xy, yy = splats.covs2d[i].tolist()
        inverse = np.linalg.inv([[xx, xy], [xy, yy]])
        offset = np.array([column + 0.5, row + 0.5]) - splats.means2d[i].numpy()
        alpha = float(splats.opacities[i]) * math.exp(-0.5 * offset @ inverse @ offset)
        alpha = min(settings.alpha_max, alpha)
        if alpha < 1 / 255:
            continue
        behind = transmittance * (1 - alpha)
        if behind <= min(settings.transmittance_stop, 1e-4):
            stopped = True
            break
        weight = alpha * transmittance
        rgb += weight * splats.colors[i].numpy()
        weight_sum += weight
        depth_sum += weight * float(splats.depths[i])
        if weight > best_weight:
            best_weight, best_id = weight, int(splats.ids[i])
        if transmittance >= 0.5 and behind < 0.5:
            median = float(splats.depths[i])
        transmittance = behind
        if transmittance <= settings.transmittance_stop:
            stopped = True
            break
    return rgb, 1 - transmittance, depth_sum / max(weight_sum, 1e-10), median, best_id, stopped


def assert_equals_loops(gaussians, camera, settings=DEFAULT):
    """Renders, compares every pixel with the loops, and returns how many pixels stopped."""
    output = render(gaussians, camera, settings=settings)
    splats = order_by_depth(project_parts([PosedGaussians(gaussians)], camera, settings))
    pixels_stopped = 0
    for row in range(camera.height):
        for column in range(camera.width):
            rgb, alpha, depth, median, best, stopped = loop_pixel(splats, column, row, settings)
            np.testing.assert_allclose(output.rgb[row, column], rgb, atol=1e-9)
            np.testing.assert_allclose(output.alpha[row, column], alpha, atol=1e-9)
            np.testing.assert_allclose(output.expected_depth[row, column], depth, atol=1e-8)
            np.testing.assert_allclose(output.median_depth[row, column], median, atol=1e-12)
            assert output.splat_ids[row, column] == best
            pixels_stopped += stopped
    return pixels_stopped


@pytest.mark.parametrize(
    "settings",
    [DEFAULT, RasterSettings(antialiased=True), RasterSettings(transmittance_stop=0.1)],
    ids=["default", "antialiased", "stop"],
)
def test_against_loops_over_pixels_and_splats(settings):
    gaussians = random_gaussians(400, dtype=torch.float64, size=0.7)
    camera = camera_ahead(19, 13, 15.0)
    stopped = assert_equals_loops(gaussians, camera, settings)
    assert stopped > 0
    if settings.transmittance_stop == DEFAULT.transmittance_stop:
        assert stopped < 13 * 19  # both kinds of pixel occur


@pytest.mark.parametrize(("width", "height"), [(1, 1), (17, 1), (3, 50)])
def test_any_size_against_loops(width, height):
    gaussians = random_gaussians(80, dtype=torch.float64, size=0.5, sh_degree=0)
    assert_equals_loops(gaussians, camera_ahead(width, height, 20.0))


# ---- single splats ----------------------------------------------------------------------------


def test_one_ball_on_the_axis():
    camera = camera_ahead(41, 31, 40.0)
    gaussian = one_gaussian((5.0, 0.0, 0.0), 0.4, 0.8, (0.9, 0.5, 0.1), torch.float64)
    output = render(gaussian, camera)
    u = np.arange(41) + 0.5 - camera.cx
    v = (np.arange(31) + 0.5 - camera.cy)[:, None]
    var_x = (camera.fx * 0.4 / 5) ** 2 + 0.3
    var_y = (camera.fy * 0.4 / 5) ** 2 + 0.3
    alpha = 0.8 * np.exp(-0.5 * (u * u / var_x + v * v / var_y))
    alpha = np.where(alpha < 1 / 255, 0, alpha)
    np.testing.assert_allclose(output.alpha, alpha, atol=1e-12)
    np.testing.assert_allclose(output.rgb, alpha[..., None] * [0.9, 0.5, 0.1], atol=1e-12)
    np.testing.assert_allclose(output.expected_depth, np.where(alpha > 0, 5.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(output.median_depth, np.where(alpha > 0.5, 5.0, 0.0), atol=1e-12)
    np.testing.assert_array_equal(output.splat_ids, np.where(alpha > 0, 0, -1))


@pytest.mark.parametrize(
    ("mean", "opacity"),
    [((-3.0, 0, 0), 0.9), ((0.009, 0, 0), 0.9), ((3.0, 0, 0), 0.0039), ((3.0, 60.0, 0), 0.9)],
    ids=["behind", "nearer than near_m", "too transparent", "beside the image"],
)
def test_splats_that_cannot_be_seen(mean, opacity):
    output = render(one_gaussian(mean, 0.001, opacity), camera_ahead())
    assert float(output.alpha.abs().max()) == 0
    assert float(output.rgb.abs().max()) == 0
    assert bool((output.splat_ids == -1).all())


def test_a_splat_at_near_is_drawn_and_one_just_nearer_is_not():
    near = np.float32(0.01)
    for z, drawn in ((near, True), (np.nextafter(near, np.float32(0)), False)):
        output = render(one_gaussian((float(z), 0, 0), 0.001), camera_ahead())
        assert bool(output.alpha.max() > 0) == drawn


# ---- order and stop ---------------------------------------------------------------------------


def test_equal_depths_keep_the_order_of_the_parts():
    camera = camera_ahead(5, 5)
    red = one_gaussian(opacity=0.6, rgb=(1, 0, 0))
    blue = one_gaussian(opacity=0.6, rgb=(0, 0, 1))
    for first, second in ((red, blue), (blue, red)):
        together = render(stack(first, second), camera)
        parts = render([PosedGaussians(first), PosedGaussians(second)], camera)
        assert torch.equal(together.rgb, parts.rgb)
        front = 0 if first is red else 2
        assert bool((together.rgb[..., front] > together.rgb[..., 2 - front]).all())


def test_order_is_by_float32_depth_in_float64_too():
    """Depths that differ by less than float32 resolves are ties, whatever the dtype."""
    far = one_gaussian((4.0 + 1e-9, 0, 0), rgb=(1, 0, 0), dtype=torch.float64)
    near = one_gaussian((4.0, 0, 0), rgb=(0, 0, 1), dtype=torch.float64)
    output = render(stack(far, near), camera_ahead(5, 5))
    assert bool((output.rgb[..., 0] > output.rgb[..., 2]).all())


def wall(z, opacity, rgb=(0.5, 0.5, 0.5)):
    """A splat so wide that its alpha is its opacity (to 1e-4) all over a small image."""
    return one_gaussian((z, 0, 0), 40.0 * z, opacity, rgb, torch.float64)


def test_blending_stops_before_the_splat_that_would_reach_the_stop():
    # transmittance 0.1, 0.01, 0.001; then 0.00005 <= 1e-4 stops; the last would have left 9e-4
    walls = [wall(2, 0.9), wall(3, 0.9), wall(4, 0.9), wall(5, 0.95), wall(6, 0.1, (9, 9, 9))]
    output = render(stack(*walls), camera_ahead(6, 4))
    stopped = render(stack(*walls[:3]), camera_ahead(6, 4))
    assert_outputs_close(output, stopped, 0.0)
    assert float(output.alpha.max()) == pytest.approx(0.999, abs=1e-5)


def test_a_greater_stop_blends_the_splat_that_reaches_it():
    # transmittance 0.1, 0.001; the third is not blended
    walls = [wall(2, 0.9), wall(3, 0.99), wall(4, 0.5, (9, 9, 9))]
    settings = RasterSettings(transmittance_stop=0.05)
    output = render(stack(*walls), camera_ahead(6, 4), settings=settings)
    assert_outputs_close(output, render(stack(*walls[:2]), camera_ahead(6, 4)), 0.0)
    assert float(output.alpha.max()) == pytest.approx(0.999, abs=1e-5)


@pytest.mark.parametrize("orthographic", [False, True])
def test_splats_no_larger_than_the_radius_clip_are_left_out(orthographic):
    """An upright ellipsoid on the axis: 3 px right and 6 px down at one sigma, before the blur."""
    camera = camera_ahead(81, 81, 60.0)
    camera = dataclasses.replace(camera, cx=40.5, cy=40.5, is_orthographic=orthographic)
    divisor = 1 if orthographic else 4
    scale = (0.01, 3 * divisor / camera.fx, 6 * divisor / camera.fy)
    ball = one_gaussian((4.0, 0, 0), scale, 0.5, dtype=torch.float64)
    radius = math.sqrt(2 * math.log(255 * 0.5) * (36 + 0.3))
    for clip, is_drawn in ((0.0, True), (radius - 1e-4, True), (radius + 1e-4, False)):
        output = render(ball, camera, settings=RasterSettings(radius_clip_px=clip))
        assert bool(output.alpha.any()) == is_drawn


def test_median_depth_is_where_less_than_half_the_light_is_left():
    camera = camera_ahead(6, 4)
    thin = [wall(2, 0.2), wall(3, 0.2), wall(4, 0.2), wall(5, 0.2)]  # 0.8, 0.64, 0.512, 0.41
    np.testing.assert_allclose(render(stack(*thin), camera).median_depth, 5.0)
    assert float(render(stack(*thin[:3]), camera).median_depth.max()) == 0  # never below one half


def test_splat_ids_name_the_heaviest_splat_through_the_parts():
    camera = camera_ahead(6, 4)
    front, back = wall(2, 0.3), wall(3, 0.9)  # weights 0.3 and 0.63
    behind_camera = one_gaussian((-5.0, 0, 0), dtype=torch.float64)
    parts = [PosedGaussians(stack(behind_camera, back)), PosedGaussians(stack(front))]
    output = render(parts, camera)
    assert bool((output.splat_ids == 1).all()) and output.splat_ids.dtype == torch.int32
    parts = [PosedGaussians(front), PosedGaussians(stack(behind_camera, wall(3, 0.4)))]
    assert bool((render(parts, camera).splat_ids == 0).all())  # 0.3 beats 0.28


# ---- parts, sizes, buffers --------------------------------------------------------------------


def test_a_posed_part_looks_like_its_gaussians_moved():
    camera, pose = camera_ahead(31, 23, 28.0), random_pose(2, (4.0, 0.2, 0.1))
    actor = random_gaussians(120, seed=5, dtype=torch.float64)
    actor = dataclasses.replace(actor, means=actor.means - torch.tensor([4.0, 0, 0]).double())
    quat = quat_from_rotmat(pose[:3, :3]).expand(len(actor), 4)
    moved = Gaussians(
        means=transform_points(pose, actor.means),
        quats=multiply_quats(quat, torch.nn.functional.normalize(actor.quats, dim=-1)),
        scales=actor.scales,
        opacities=actor.opacities,
        sh=rotate_sh(actor.sh, pose[:3, :3]),
    )
    background = random_gaussians(80, seed=6, dtype=torch.float64)
    smog = Fog(0.1, (0.7, 0.7, 0.6), scale_height_m=2.0, base_z_m=-1.0)
    posed = render([PosedGaussians(background), PosedGaussians(actor, pose, 1)], camera, smog=smog)
    expected = render(stack(background, moved), camera, smog=smog)
    assert_outputs_close(posed, expected, 1e-9)  # float64 through another chain of transforms
    assert bool((posed.splat_ids >= 80).any()) and bool((posed.splat_ids < 80).any())


@pytest.mark.parametrize("parts", [1, 2])
def test_no_gaussians(parts):
    output = render([PosedGaussians(Gaussians.empty(3))] * parts, camera_ahead(10, 7))
    assert output.rgb.shape == (7, 10, 3) and float(output.rgb.abs().max()) == 0
    assert float(output.expected_depth.max()) == 0 and bool((output.splat_ids == -1).all())


def test_each_buffer_alone_equals_itself_among_all():
    gaussians, camera = random_gaussians(), camera_ahead()
    together = render(gaussians, camera)
    for name in BUFFERS:
        alone = render(gaussians, camera, [name])
        assert torch.equal(getattr(alone, name), getattr(together, name))
        assert all(getattr(alone, other) is None for other in BUFFERS if other != name)


# ---- smog -------------------------------------------------------------------------------------


def test_smog_fades_by_euclidean_distance():
    camera = camera_ahead(41, 31, 40.0)
    rgb, airlight = np.array([0.9, 0.5, 0.1]), np.array([0.6, 0.7, 0.8])
    gaussian = one_gaussian((5.0, 1.5, 0.5), 0.4, 0.8, rgb, torch.float64)
    output = render(gaussian, camera, smog=Fog(0.2, tuple(airlight)))
    t = math.exp(-0.2 * math.sqrt(5.0**2 + 1.5**2 + 0.5**2))
    expected = output.alpha.numpy()[..., None] * (t * rgb + (1 - t) * airlight)
    np.testing.assert_allclose(output.rgb, expected, atol=1e-12)


def test_smog_with_a_scale_height_uses_world_heights():
    """A camera 2 m up looks at a splat 1 m up: integrate the density along the ray."""
    camera = camera_ahead(41, 31, 40.0, position=(0, 0, 2.0))
    gaussian = one_gaussian((5.0, 0.0, 1.0), 0.4, 0.8, (0, 0, 0), torch.float64)
    smog = Fog(0.3, (1.0, 1.0, 1.0), scale_height_m=1.5, base_z_m=0.5)
    steps = (np.arange(20000) + 0.5) / 20000
    heights = 2.0 + steps * (1.0 - 2.0)
    tau = 0.3 * np.exp(-(heights - 0.5) / 1.5).mean() * math.hypot(5.0, 1.0)
    output = render(gaussian, camera, smog=smog)
    ratio = output.rgb.max() / output.alpha.max()
    assert float(ratio) == pytest.approx(1 - math.exp(-tau), rel=1e-6)  # midpoint rule


# ---- stored renders ------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "mode"), GOLDEN)
def test_stored_renders(shared_dir, name, mode):
    parts, camera, settings, arrays = golden_view(shared_dir, name, mode, torch.float64)
    images = {"rgb": RGB, "alpha": ALPHA, "ED": EXPECTED_DEPTH}
    output = rasterize_reference(parts, camera, frozenset(images.values()), settings, None)
    for key in arrays.keys() & images.keys():
        # The files hold float32: rounding of depths of up to 4 m, and no pixel flips.
        assert_images_close(getattr(output, images[key]), arrays[key], p999=5e-7, flip=1e-6)


@pytest.mark.parametrize("name", ["edge", "garden_small", "opaque"])
def test_stored_projections(shared_dir, name):
    parts, camera, _, arrays = golden_view(shared_dir, name, "a999_classic", torch.float64)
    splats = project_parts(parts, camera, RasterSettings())
    # The file's arrays are zero where its renderer culled; this one culls by the image later.
    seen = (arrays["radii"] > 0).all(1)
    assert set(np.flatnonzero(seen)) <= set(splats.ids.tolist())
    splats = splats.select(torch.from_numpy(seen)[splats.ids])
    ids = splats.ids.numpy()
    xx, xy, yy = splats.covs2d.unbind(1)
    conics = torch.stack([yy, -xy, xx], 1) / splats.dets[:, None]
    # Same float64 arithmetic in another order.
    np.testing.assert_allclose(splats.means2d, arrays["means2d"][ids], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(conics, arrays["conics"][ids], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(splats.depths, arrays["depths"][ids], rtol=1e-12, atol=1e-12)


# ---- gradients -----------------------------------------------------------------------------------

FIELDS = ("means", "quats", "scales", "opacities", "sh")


def render_posed(gaussians, camera, settings=None, smog=None, pose=None):
    parts, settings = [PosedGaussians(gaussians, pose)], settings or RasterSettings()
    return rasterize_reference(parts, camera, frozenset(BUFFERS), settings, smog)


@pytest.mark.parametrize(
    "variant",
    ["classic", *(pytest.param(v, marks=pytest.mark.long) for v in ("antialiased", "smog"))],
)
def test_gradients_of_every_tensor(variant):
    camera = camera_ahead(4, 3, 7.0)
    count, sh_degree = (2, 1) if variant == "classic" else (3, 0)
    gaussians = smooth_gaussians(count, sh_degree=sh_degree)
    pose = slight_pose((0.1, 0.2, -0.1))
    smog = Fog(0.1, (0.7, 0.6, 0.5), 3.0) if variant == "smog" else None
    settings = RasterSettings(antialiased=variant == "antialiased")

    def image(*tensors):
        values = Gaussians(**dict(zip(FIELDS, tensors, strict=True)))
        output = render_posed(values, camera, settings, smog, pose)
        return output.rgb, output.alpha, output.expected_depth, output.median_depth

    tensors = [getattr(gaussians, name).requires_grad_() for name in FIELDS]
    assert bool((image(*tensors)[3] > 0).any())  # the median depth is exercised too
    # 6 decimal steps in float64: central differences are good to about 1e-8
    assert torch.autograd.gradcheck(image, tensors, eps=1e-6, atol=1e-6, fast_mode=False)
