import dataclasses

import numpy as np
import pytest
import torch

from augment.cameras import Camera
from augment.geometry import rigid, rotmat_from_quat
from augment.reconstruct.config import LossWeights
from augment.reconstruct.loss import IDENTITY_MAP, LossScratch, ViewLoss, view_loss
from augment.reconstruct.view import RecordedView
from augment.render.threads import limit_threads
from tests.augment.loss_definition import reference_loss, ssim_map

WEIGHTS = LossWeights(d_ssim=0.3, depth=0.7, sky=0.2)


def camera_of(height: int, width: int, seed: int = 0) -> Camera:
    """A wide view in a random direction: several faces of the cube map are seen."""
    quat = torch.from_numpy(np.random.default_rng(seed).standard_normal(4))
    pose = rigid(rotmat_from_quat(quat), torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64))
    return Camera("front", width, height, width / 3, width / 3.1, width / 2.1, height / 1.9, pose)


def case(height: int, width: int, *, texels: int = 8, seed: int = 0) -> dict:
    """Random arguments of view_loss, with pixels of no weight and alphas of exactly 0 and 1."""
    rng = np.random.default_rng(seed)
    alpha = rng.uniform(-0.3, 1.3, (height, width)).clip(0, 1).astype(np.float32)
    weight = rng.random((height, width), np.float32)
    weight[rng.random((height, width)) < 0.2] = 0
    count = max(1, height * width // 5)
    view = RecordedView(
        camera=camera_of(height, width, seed),
        rgb=rng.integers(0, 256, (height, width, 3), np.uint8),
        weight=weight,
        sky=rng.random((height, width)) < 0.3,
        depth_pixels=np.sort(rng.choice(height * width, count, replace=False)).astype(np.int32),
        depth_m=rng.uniform(1, 50, count).astype(np.float32),
        depth_weight=rng.random(count, np.float32),
    )
    return {
        "rgb": rng.uniform(-0.2, 1.2, (height, width, 3)).astype(np.float32),
        "alpha": alpha,
        "expected_depth": rng.uniform(1, 50, (height, width)).astype(np.float32),
        "view": view,
        "sky_faces": rng.random((6, texels, texels, 3), np.float32),
        "color_map": (IDENTITY_MAP + rng.uniform(-0.2, 0.2, (3, 4))).astype(np.float32),
        "weights": WEIGHTS,
    }


def with_view(arguments: dict, **changes) -> dict:
    return {**arguments, "view": dataclasses.replace(arguments["view"], **changes)}


def dense_sky(loss: ViewLoss, faces: np.ndarray) -> np.ndarray:
    dense = np.zeros((faces.size // 3, 3))
    if loss.d_sky is not None:
        dense[loss.d_sky.texels] = loss.d_sky.grads
    return dense.reshape(faces.shape)


def gradients(loss: ViewLoss, faces: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "rgb": loss.d_rgb,
        "alpha": loss.d_alpha,
        "expected_depth": loss.d_expected_depth,
        "sky_faces": dense_sky(loss, faces),
        "color_map": loss.d_color_map,
    }


DIFFERENTIABLE = ("rgb", "alpha", "expected_depth", "sky_faces", "color_map")


def by_reference(arguments: dict) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Values and gradients of the definition, in float64."""
    leaves = {
        name: torch.from_numpy(arguments[name]).double().requires_grad_() for name in DIFFERENTIABLE
    }
    loss = reference_loss(**{**arguments, **leaves})
    if loss.total.requires_grad:
        loss.total.backward()
    values = {name: getattr(loss, name).item() for name in ("total", "l1", "ssim", "depth", "sky")}
    return values, {
        name: np.zeros(leaf.shape) if leaf.grad is None else leaf.grad.numpy()
        for name, leaf in leaves.items()
    }


def assert_matches_reference(arguments: dict, tolerance: float = 1e-4) -> ViewLoss:
    """Values within 1e-5: float32 rounding of pictures, windows and 1/ED in means over pixels.
    Gradients within 1e-4 of the largest: SSIM divides rounding errors of 1e-7 by C2 = 9e-4.
    """
    loss = view_loss(**arguments)
    values, expected = by_reference(arguments)
    for name, value in values.items():
        assert getattr(loss, name) == pytest.approx(value, rel=1e-5, abs=1e-5), name
    for name, got in gradients(loss, arguments["sky_faces"]).items():
        assert got.shape == expected[name].shape
        limit = tolerance * max(np.abs(expected[name]).max(), 1e-12)
        assert np.abs(got - expected[name]).max() <= limit, name
    return loss


@pytest.mark.parametrize("size", [(37, 61), (7, 4), (4, 30), (11, 11), (1, 1)], ids=str)
def test_values_and_gradients_match_the_reference(size):
    loss = assert_matches_reference(case(*size, seed=1))
    assert loss.d_rgb.dtype == loss.d_alpha.dtype == loss.d_expected_depth.dtype == np.float32
    assert loss.d_color_map.dtype == np.float64
    assert type(loss.total) is type(loss.sky) is float


def test_finite_differences_confirm_the_reference():
    arguments = case(9, 10, texels=3, seed=4)
    arguments = with_view(arguments, weight=arguments["view"].weight + np.float32(0.1))
    # Kinks would break differences: alphas stay off the thresholds.
    arguments["alpha"] = arguments["alpha"].clip(0.1, 0.9)
    leaves = {name: torch.from_numpy(arguments[name]).double() for name in DIFFERENTIABLE}
    _, expected = by_reference(arguments)
    rng = np.random.default_rng(0)
    for name, leaf in leaves.items():
        direction = torch.from_numpy(rng.standard_normal(leaf.shape))

        def total(step: float, name=name, leaf=leaf, direction=direction) -> float:
            moved = {**leaves, name: leaf + step * direction}
            return reference_loss(**{**arguments, **moved}).total.item()

        slope = (total(1e-6) - total(-1e-6)) / 2e-6
        # Central differences in float64: rounding 1e-16 / 1e-6, and the curvature times 1e-12.
        assert slope == pytest.approx((expected[name] * direction.numpy()).sum(), rel=1e-6), name


def test_ssim_of_the_reference_by_loops_over_one_window():
    rng = np.random.default_rng(5)
    x, y = rng.random((9, 14, 3)), rng.random((9, 14, 3))
    ticks = np.arange(-5, 6)
    bell = np.exp(-(ticks**2) / 4.5)
    row, column = 2, 12  # the window passes two edges
    sums = np.zeros((5, 3))
    for dy in ticks:
        for dx in ticks:
            if 0 <= row + dy < 9 and 0 <= column + dx < 14:
                a, b = x[row + dy, column + dx], y[row + dy, column + dx]
                window = bell[dy + 5] * bell[dx + 5] / bell.sum() ** 2
                sums += window * np.stack([a, b, a * a, b * b, a * b])
    mx, my, xx, yy, xy = sums
    above = (2 * mx * my + 1e-4) * (2 * (xy - mx * my) + 9e-4)
    below = (mx**2 + my**2 + 1e-4) * (xx - mx**2 + yy - my**2 + 9e-4)
    got = ssim_map(torch.from_numpy(x), torch.from_numpy(y))[row, column].numpy()
    np.testing.assert_allclose(got, above / below, rtol=1e-12)


def test_a_perfect_picture_has_ssim_1_and_no_gradient():
    arguments = case(20, 30)
    view = arguments["view"]
    arguments["rgb"] = view.rgb / np.float32(255)
    arguments |= {"alpha": np.ones((20, 30), np.float32), "color_map": IDENTITY_MAP}
    arguments["weights"] = LossWeights(depth=0.0, sky=0.0)
    loss = view_loss(**arguments)
    assert loss.ssim == pytest.approx(1, abs=1e-6) and loss.l1 < 1e-7
    # L1 has a kink here, so a rounding error of 1e-8 decides its sign: one pixel's worth at most.
    assert np.abs(loss.d_rgb).max() <= 1.01 * (1 / (3 * view.weight.sum()))


def test_surfaces_are_pulled_to_be_opaque():
    arguments = case(24, 33, seed=6)
    view = arguments["view"]
    with_it, without = (
        view_loss(**{**arguments, "weights": LossWeights(surface=weight)}) for weight in (0.3, 0.0)
    )
    total = view.depth_weight.sum()
    through = (1 - arguments["alpha"].reshape(-1)[view.depth_pixels]) * view.depth_weight
    assert with_it.surface == pytest.approx(through.sum() / total)
    assert with_it.total - without.total == pytest.approx(0.3 * with_it.surface)
    change = (with_it.d_alpha - without.d_alpha).reshape(-1)
    expected = np.zeros_like(change)
    expected[view.depth_pixels] = -0.3 * view.depth_weight / total
    # differences of float32 sums of about 1e-3
    np.testing.assert_allclose(change, expected, atol=1e-8)


def test_pixels_without_weight_neither_count_nor_disturb_nor_learn():
    arguments = case(24, 33, seed=6)
    view = arguments["view"]
    other = view.rgb.copy()
    other[view.weight == 0] = 255 - other[view.weight == 0]
    before, after = view_loss(**arguments), view_loss(**with_view(arguments, rgb=other))
    assert before.total == after.total
    np.testing.assert_array_equal(before.d_rgb, after.d_rgb)
    assert (before.d_rgb[view.weight == 0] == 0).all()
    has_prior = np.zeros(view.weight.size, np.bool_)
    has_prior[view.depth_pixels] = True
    blank = (view.weight == 0) & ~view.sky & ~has_prior.reshape(view.weight.shape)
    assert (before.d_alpha[blank] == 0).all()

    # A picture that is right wherever it counts is perfect, however wrong it is elsewhere.
    rgb = np.where((view.weight > 0)[..., None], view.rgb / np.float32(255), np.float32(0.5))
    opaque = {"rgb": rgb, "alpha": np.ones_like(view.weight), "color_map": IDENTITY_MAP}
    assert view_loss(**{**arguments, **opaque}).ssim == pytest.approx(1, abs=1e-5)


def test_impossible_depths_count_nothing():
    arguments = case(13, 17)
    view = arguments["view"]
    depth_m = view.depth_m.copy()
    depth_m[:4] = [0, -1, np.nan, np.inf]  # the last one is a wish for depth without end
    arguments["alpha"].fill(0.9)
    arguments["expected_depth"].reshape(-1)[view.depth_pixels[4:6]] = [0, np.nan]
    loss = view_loss(**with_view(arguments, depth_m=depth_m))
    assert np.isfinite(loss.depth) and np.isfinite(loss.d_expected_depth).all()
    used = loss.d_expected_depth.reshape(-1)[view.depth_pixels] != 0
    assert not used[[0, 1, 2, 4, 5]].any() and used[3] and used[6:].all()


@pytest.mark.parametrize("texels", [1, 7])
def test_the_sky_learns_on_every_face(texels):
    arguments = case(40, 40, texels=texels, seed=0)
    arguments["alpha"] *= 0.5
    # A pixel whose direction lies within float32 rounding of an edge between faces may take
    # either; here none does.
    loss = assert_matches_reference(arguments)
    assert loss.d_sky is not None
    texel = loss.d_sky.texels
    assert texel.dtype == np.int32 and (np.diff(texel) > 0).all()
    assert len(np.unique(texel // texels**2)) >= 3  # faces


@pytest.mark.parametrize("alpha", [1.0, 0.9995])
def test_an_opaque_picture_looks_no_sky_up(alpha):
    arguments = case(13, 17)
    arguments["alpha"] = np.full((13, 17), alpha, np.float32)
    loss = assert_matches_reference(arguments)
    assert loss.d_sky is None
    arguments["sky_faces"] = np.full_like(arguments["sky_faces"], np.nan)
    assert view_loss(**arguments).total == loss.total


def test_the_same_bits_for_any_threads_and_with_reused_buffers():
    first, second = case(61, 83, texels=16, seed=1), case(40, 83, texels=16, seed=2)
    third = {**first, "sky_faces": case(9, 9, texels=5)["sky_faces"]}
    scratch = LossScratch()
    for arguments in (first, second, third, first):
        limit_threads(1)
        alone = view_loss(**arguments)
        limit_threads(2)
        together = view_loss(**arguments, scratch=scratch)
        assert together.total == alone.total
        faces = arguments["sky_faces"]
        for name, gradient in gradients(alone, faces).items():
            np.testing.assert_array_equal(gradients(together, faces)[name], gradient)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rgb", np.zeros((13, 16, 3), np.float32)),
        ("rgb", np.zeros((13, 17, 3))),
        ("alpha", np.zeros((13, 17, 1), np.float32)),
        ("expected_depth", np.zeros((17, 13), np.float32)),
        ("sky_faces", np.zeros((6, 4, 5, 3), np.float32)),
        ("sky_faces", np.zeros((6, 0, 0, 3), np.float32)),
        ("sky_faces", np.zeros((4, 3), np.float32)),
        ("color_map", np.eye(3, 4)),
    ],
)
def test_arrays_of_another_shape_or_type_are_refused(name, value):
    with pytest.raises(ValueError, match=rf"^{name} of camera 'front' must be float32 .*; got "):
        view_loss(**{**case(13, 17), name: value})


@pytest.mark.parametrize("pixels", [[0, 221], [-1, 3], [5, 5], [7, 4]], ids=str)
def test_depth_pixels_outside_or_out_of_order_are_refused(pixels):
    bad = with_view(
        case(13, 17),
        depth_pixels=np.array(pixels, np.int32),
        depth_m=np.ones(2, np.float32),
        depth_weight=np.ones(2, np.float32),
    )
    with pytest.raises(ValueError, match=r"'front'.* increasing indices from 0 to 220"):
        view_loss(**bad)
