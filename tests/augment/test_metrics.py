"""Scores of pictures and depths; whether views agree; LPIPS against torch's own layers."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy import ndimage
from torch import nn

from augment.errors import MetricError
from augment.metrics.consistency import (
    ActorPaths,
    DepthView,
    consistency_of,
    find_warp,
    move_surfaces,
    warp_view,
    warped_consistency,
)
from augment.metrics.image import DepthErrors, depth_errors, flip, psnr, ssim
from augment.metrics.lpips import ALEX, VGG16, Conv, Lpips, expected_shapes, load_lpips
from augment.metrics.lpips import picture_lpips as lpips_of
from tests.scenes import camera_ahead
from tests.walls import FRAME_NS, board_boxes, driving_camera, wall_view


def pictures(height=23, width=31, *, noise=0.1, seed=0):
    """A smooth picture and a noisy copy, floats in [0, 1]."""
    rng = np.random.default_rng(seed)
    smooth = ndimage.gaussian_filter(rng.uniform(0, 1, (height, width, 3)), (3, 3, 0))
    smooth = (smooth - smooth.min()) / np.ptp(smooth)
    return np.clip(smooth + rng.normal(0, noise, smooth.shape), 0, 1), smooth


def ssim_by_definition(a, b):
    """Wang et al. 2004, eq. 13, pixel by pixel, with zeros around the picture."""
    offsets = np.arange(11) - 5
    line = np.exp(-(offsets**2) / (2 * 1.5**2))
    window = np.outer(line, line) / line.sum() ** 2
    total = []
    for c in range(3):
        x, y = np.pad(a[..., c], 5), np.pad(b[..., c], 5)
        for i in range(a.shape[0]):
            for j in range(a.shape[1]):
                p, q = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
                cov = (window * (p - mp) * (q - mq)).sum()
                total.append(
                    (2 * mp * mq + 1e-4)
                    * (2 * cov + 9e-4)
                    / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4))
                )
    return np.mean(total)


def test_psnr_of_a_known_error():
    black = np.zeros((4, 5, 3))
    assert psnr(black + 0.1, black) == pytest.approx(20, abs=1e-9)  # rounding of 0.1**2
    assert psnr(black + 1, black) == pytest.approx(0, abs=1e-12)
    assert psnr(np.full((4, 5, 3), 51, np.uint8), black) == pytest.approx(-20 * math.log10(0.2))


def test_equal_pictures_are_perfect():
    _, picture = pictures()
    assert psnr(picture, picture) == math.inf
    assert ssim(picture, picture) == pytest.approx(1, abs=1e-12)
    assert flip(picture, picture) == 0


@pytest.mark.parametrize("size", [(23, 31), (3, 40), (1, 1), (12, 11)])
def test_ssim_is_its_definition(size):
    a, b = pictures(*size) if min(size) > 1 else (np.full((1, 1, 3), 0.3), np.full((1, 1, 3), 0.7))
    # Variances by differences of means: float64 leaves about 1e-16 / C2.
    assert ssim(a, b) == pytest.approx(ssim_by_definition(a, b), abs=1e-11)


def test_whatever_is_left_out_changes_nothing():
    a, b = pictures()
    weight = np.ones(a.shape[:2])
    weight[5:12, 7:20] = 0
    spoilt = a.copy()
    spoilt[weight == 0] = np.random.default_rng(3).uniform(0, 1, (int((weight == 0).sum()), 3))
    for score in (psnr, ssim, flip):
        assert score(a, b, weight) == score(spoilt, b, weight)
        assert score(a, b, weight) == score(a, b, weight > 0)
        assert score(a, b, np.ones_like(weight)) == pytest.approx(score(a, b), abs=1e-12)
    wrong_inside = np.where((weight == 0)[..., None], 1 - b, b)
    assert psnr(wrong_inside, b, weight) == math.inf
    assert ssim(wrong_inside, b, weight) == pytest.approx(1, abs=1e-12)
    assert flip(wrong_inside, b, weight) == 0


def test_8_bit_and_float_pictures_agree():
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 256, (2, 9, 13, 3), dtype=np.uint8)
    for score in (psnr, ssim, flip):
        assert score(a, b) == score(a / 255.0, b)


def test_flip_of_black_and_white():
    black = np.zeros((8, 8, 3))
    # The package's own figure for it; the colour term of two greys does not reach 1.
    assert flip(black + 1, black) == pytest.approx(0.9674, abs=1e-3)


def test_flip_grows_with_noise_and_leaves_its_inputs_alone():
    scores = []
    for noise in (0.02, 0.05, 0.2):
        a, b = (image.astype(np.float32) for image in pictures(noise=noise))
        copies = a.copy(), b.copy()
        scores.append(flip(a, b))
        assert (a == copies[0]).all() and (b == copies[1]).all()
    assert scores == sorted(scores) and scores[0] < scores[-1]


@pytest.mark.parametrize("score", [psnr, ssim, flip])
def test_bad_pictures_are_refused(score):
    black = np.zeros((4, 4, 3))
    for a, b, weight, words in (
        (black, np.zeros((4, 5, 3)), None, r"one size; got \(4, 4, 3\)"),
        (black[..., 0], black, None, r"\[H, W, 3\]"),
        (black[:0], black[:0], None, "H, W >= 1"),
        (black.astype(np.int32), black, None, "uint8, or floats"),
        (black + 1.01, black, None, "clamp it first"),
        (black + np.nan, black, None, r"\[0, 1\]"),
        (black, black, np.ones((4, 5)), r"weight must be \[4, 4\]"),
        (black, black, -np.ones((4, 4)), ">= 0"),
        (black, black, np.full((4, 4), np.nan), "finite"),
        (black, black, np.zeros((4, 4)), "no pixel counts"),
    ):
        with pytest.raises(ValueError, match=words):
            score(a, b, weight)


def test_depth_errors_of_known_values():
    true = np.arange(1, 11).astype(np.float64)
    errors = depth_errors(true + 0.01 * np.arange(1, 11), true)
    assert errors.pixels == 10
    assert errors.median_m == pytest.approx(0.05)
    assert errors.p90_m == pytest.approx(0.09)
    assert errors.abs_rel == pytest.approx(0.01)
    # 0.05 itself is rounded in both terms: 4 or 5 of the 10 are within it.
    assert 0.4 <= errors.within_5cm <= 0.5
    assert depth_errors(true, true) == DepthErrors(10, 0.0, 0.0, 0.0, 1.0)


def test_depth_quantiles_are_those_of_repeated_values():
    rng = np.random.default_rng(0)
    true = rng.uniform(2, 50, (7, 9))
    depth = true + rng.normal(0, 0.3, true.shape)
    times = rng.integers(0, 4, true.shape)
    weighted = depth_errors(depth, true, times)
    plain = depth_errors(np.repeat(depth, times.ravel()), np.repeat(true, times.ravel()))
    assert (weighted.median_m, weighted.p90_m) == (plain.median_m, plain.p90_m)
    assert weighted.abs_rel == pytest.approx(plain.abs_rel)
    assert weighted.within_5cm == pytest.approx(plain.within_5cm)
    error = np.sort(np.repeat(np.abs(depth - true), times.ravel()))
    assert plain.p90_m == np.quantile(error, 0.9, method="inverted_cdf")


def test_bad_depths_are_refused():
    for depth, true, words in (
        (np.ones(3), np.ones(4), "one shape"),
        (np.array([1, np.nan]), np.ones(2), "1 of 2 depths"),
        (np.ones(3), np.array([0, 1, np.inf]), "2 true depths"),
    ):
        with pytest.raises(ValueError, match=words):
            depth_errors(depth, true)


# ---- consistency of views ------------------------------------------------------------------------

WALL_M = 8.0


def wall_color(y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Linear in the plane: bilinear interpolation of it has no error."""
    return np.stack([0.5 + 0.05 * y, 0.5 - 0.04 * z, 0.4 + 0.03 * (y + z)], -1)


def view_of_wall(camera, *, wall_m: float = WALL_M, shift: float = 0.0) -> DepthView:
    """The plane x = wall_m seen from anywhere before it, its colours raised by `shift`."""
    rays = camera.ray_directions(torch.float64).numpy()
    centre = camera.centre.numpy()
    depth = (wall_m - centre[0]) / rays[..., 0]  # rays have unit depth
    hit = centre + depth[..., None] * rays
    return DepthView(
        camera, wall_color(hit[..., 1], hit[..., 2]) + shift, depth, np.ones_like(depth)
    )


def moved(**kwargs):
    return camera_ahead(61, 41, 50.0, **kwargs)


@pytest.mark.parametrize("yaw", [0.0, 0.1, -0.2])
@pytest.mark.parametrize("position", [(0, 0, 0), (0.3, 0.5, -0.2), (-1, -0.7, 0.3)])
def test_a_wall_agrees_with_itself(yaw, position):
    a, b = view_of_wall(moved()), view_of_wall(moved(position=position, yaw=yaw))
    consistency = warped_consistency(a, b)
    # Perspective bends the linear colours within a pixel where the wall is seen at an angle.
    assert consistency.rmse < (1e-12 if yaw == 0 else 2e-5)
    assert consistency.share > 0.5


def test_an_offset_is_the_error():
    a, b = view_of_wall(moved()), view_of_wall(moved(position=(0, 0.4, 0)), shift=0.07)
    consistency = warped_consistency(a, b)
    assert consistency.rmse == pytest.approx(0.07, rel=1e-9)
    assert consistency.relative == pytest.approx(0.07 / consistency.spread, rel=1e-9)


def test_the_share_is_the_overlap():
    """A camera moved sideways by whole pixels loses as many columns, and one for its bilinear."""
    camera = moved()
    step = WALL_M / camera.fx  # of a pixel, metres
    b = view_of_wall(moved(position=(0, -7.25 * step, 0)))
    _, counts = warp_view(view_of_wall(camera), b)
    assert counts.any(1)[:-1].all()
    columns = counts[:-1].all(0)
    # Pixel c of A lies at c - 7.25 of B: from 8 on; the last row and column have no neighbour.
    assert not columns[:8].any() and columns[8:].all()


def test_what_is_hidden_does_not_count():
    """A board before the wall hides a part of it from B only."""
    a = view_of_wall(moved())
    b = view_of_wall(moved(position=(0, 0.5, 0)))
    board = slice(10, 30), slice(20, 40)
    b.depth_m[board] = 3.0
    b.picture[board] = 0.9
    warped, counts = warp_view(a, b)
    consistency = warped_consistency(a, b)
    free = warped_consistency(a, view_of_wall(b.camera))
    assert consistency.rmse < 1e-12
    assert consistency.share == pytest.approx(
        free.share - 21 * 21 / counts.size, abs=2 * 21 / counts.size
    )
    assert (warped[~counts] == 0).all()


@pytest.mark.parametrize("side", ["a", "b"])
def test_the_sky_does_not_count(side):
    views = {"a": view_of_wall(moved()), "b": view_of_wall(moved(position=(0, 0.1, 0)))}
    views[side].alpha[:20] = 0.5
    views[side].picture[:20] = 1.0
    consistency = warped_consistency(views["a"], views["b"])
    assert consistency.rmse < 1e-12 and 0.2 < consistency.share < 0.55


def test_nothing_in_common_gives_nan():
    a, b = view_of_wall(moved()), view_of_wall(moved())
    b = dataclasses.replace(b, camera=moved(yaw=math.pi))
    consistency = warped_consistency(a, b)
    assert consistency.share == 0
    assert math.isnan(consistency.rmse) and math.isnan(consistency.relative)
    b.depth_m[:] = math.nan
    assert warped_consistency(b, a).share == 0


FRAMES = 9


def compared(paths, a, b, **kwargs):
    """(consistency over the pixels that moved, over all, what moved and counts)."""
    carried = move_surfaces(paths, a, b, **kwargs)
    clear = dataclasses.replace(b, alpha=np.where(carried.is_unclear_in_b, 0.0, b.alpha))
    warp = find_warp(a, clear, carried.points_m)
    warped = warp.sample(b.picture)
    moved = warp.is_counted & carried.is_moved
    return consistency_of(a, warped, moved), consistency_of(a, warped, warp.is_counted), moved


@pytest.mark.parametrize("num_frames_between", [1, 7])
def test_a_board_goes_along_with_its_box(num_frames_between):
    a, b = wall_view(driving_camera(0)), wall_view(driving_camera(num_frames_between))
    moving, whole, moved = compared(ActorPaths(board_boxes(FRAMES)), a, b)
    on_board = a.depth_m < 7
    assert moved.sum() > 0.5 * on_board.sum() and not (moved & ~on_board).any()
    assert moving.rmse < 1e-6 and whole.rmse < 1e-6
    # As if it stood the board agrees in depth, and its paint does not.
    standing = find_warp(a, b)
    apart_m = num_frames_between * FRAME_NS * 1e-9 * 2.0
    wrong = consistency_of(a, standing.sample(b.picture), standing.is_counted & on_board)
    assert wrong.rmse == pytest.approx(0.2 * apart_m * np.sqrt(2 / 3), rel=0.05)


# ---- LPIPS ---------------------------------------------------------------------------------------

SIZE = 40
# torchvision's `features` as its own lists have them: channels, and M for a pooling.
VGG_LIST = [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M"]
BIAS = "net.slice3.6.bias"
NARROW = 16  # times fewer channels of VGG-16 in tests


def random_weights(architecture):
    generator = torch.Generator().manual_seed(3)
    return {
        name: torch.randn(shape, generator=generator).abs() / 50
        if name.startswith("lin")
        else torch.randn(shape, generator=generator) / max(1, np.prod(shape[1:])) ** 0.5
        for name, shape in expected_shapes(architecture).items()
    }


def picture_pairs(seed):
    return torch.rand(2, 3, SIZE, SIZE + 6, generator=torch.Generator().manual_seed(seed))


def torchvision_alexnet():
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
    )  # fmt: skip


def torchvision_vgg16(narrow):
    layers, channels = [], 3
    for width in VGG_LIST:
        if width == "M":
            layers.append(nn.MaxPool2d(2, 2))
            continue
        layers += [nn.Conv2d(channels, width // narrow, 3, padding=1), nn.ReLU()]
        channels = width // narrow
    return nn.Sequential(*layers)


def plainly(layers, layer_numbers, heads, a, b):
    """The metric as its definition says it, pixel by pixel."""
    shift = torch.tensor([-0.030, -0.088, -0.188])[:, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450])[:, None, None]
    total, features_a, features_b = 0.0, (2 * a - 1 - shift) / scale, (2 * b - 1 - shift) / scale
    with torch.no_grad():
        for number, layer in enumerate(layers):
            features_a, features_b = layer(features_a), layer(features_b)
            if number not in layer_numbers:
                continue
            head = heads[layer_numbers.index(number)].flatten()
            f, g = features_a.flatten(1).T, features_b.flatten(1).T  # [pixels, channels]
            f, g = (x / x.norm(dim=1, keepdim=True).clamp(min=1e-10) for x in (f, g))
            total += float(((f - g).square() @ head).mean())
    return total


def heads_of(weights):
    return {name: value for name, value in weights.items() if name.startswith("lin")}


def as_torchvision(weights):
    renamed_weights = {re.sub(r"net\.slice\d\.", "features.", n): v for n, v in weights.items()}
    classifier = {"classifier.1.weight": torch.zeros(2, 2)}
    return {n: v for n, v in renamed_weights.items() if not n.startswith("lin")} | classifier


@pytest.fixture(scope="module")
def alex():
    return random_weights(ALEX)


def test_alex_is_the_definition(alex):
    layers = torchvision_alexnet()
    state = {n.removeprefix("features."): v for n, v in as_torchvision(alex).items()}
    del state["classifier.1.weight"]
    layers.load_state_dict(state)
    a, b = picture_pairs(1), picture_pairs(2)
    distances = Lpips(ALEX, alex)(a, b)
    heads = list(heads_of(alex).values())
    for number in range(2):
        expected = plainly(layers, [1, 4, 7, 9, 11], heads, a[number], b[number])
        assert expected > 0.01
        assert float(distances[number]) == pytest.approx(expected, rel=1e-4)  # float32 sums


def test_vgg_is_the_definition():
    slices = tuple(
        tuple(Conv(c.index, c.channels // NARROW) for c in convs) for convs in VGG16.slices
    )
    narrow = dataclasses.replace(VGG16, slices=slices)
    weights = random_weights(narrow)
    layers = torchvision_vgg16(NARROW)
    names = {n.split(".", 2)[2]: v for n, v in weights.items() if n.startswith("net.")}
    layers.load_state_dict(names)
    a, b = picture_pairs(1), picture_pairs(2)
    heads = list(heads_of(weights).values())
    expected = plainly(layers, [3, 8, 15, 22, 29], heads, a[0], b[0])
    assert float(Lpips(narrow, weights)(a, b)[0]) == pytest.approx(expected, rel=1e-4)


def test_equal_pictures_are_0_apart_and_order_does_not_matter(alex):
    network = Lpips(ALEX, alex)
    a, b = picture_pairs(1), picture_pairs(2)
    assert (network(a, a) == 0).all()
    assert torch.allclose(network(a, b), network(b, a), rtol=1e-6)
    black = torch.zeros_like(a)  # biases alone: features without a length must not be NaN
    assert torch.isfinite(network(black, a)).all()


def test_what_does_not_count_is_the_reference(alex):
    network = Lpips(ALEX, alex)
    a, b = (p[0].permute(1, 2, 0).numpy() for p in (picture_pairs(1), picture_pairs(2)))
    nothing = np.zeros(a.shape[:2], bool)
    assert lpips_of(network, a, b, nothing) == 0
    assert lpips_of(network, a, b, ~nothing) == lpips_of(network, a, b)
    half = nothing.copy()
    half[:, :20] = True
    assert 0 < lpips_of(network, a, b, half) < lpips_of(network, a, b)


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_files_of_both_layouts(alex, tmp_path, suffix):
    def written(name, tensors):
        path = tmp_path / f"{name}{suffix}"
        save = save_file if suffix == ".safetensors" else torch.save
        save(tensors, path)
        return path

    scaling = {"scaling_layer.shift": torch.tensor([-0.030, -0.088, -0.188])[None, :, None, None]}
    copies = {f"lins.{n[3]}.{n[5:]}": v.clone() for n, v in heads_of(alex).items()}
    whole_metric = load_lpips(written("whole", alex | scaling | copies))
    parts = load_lpips(written("net", as_torchvision(alex)), written("heads", heads_of(alex)))
    a, b = picture_pairs(1), picture_pairs(2)
    expected = Lpips(ALEX, alex)(a, b)
    assert whole_metric.name == parts.name == "alex"
    assert torch.equal(whole_metric(a, b), expected) and torch.equal(parts(a, b), expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lin2.model.1.weight": None}, r"lacks lin2.model.1.weight, a tensor \[1, 384, .*own"),
        ({BIAS: torch.zeros(3)}, r"net.slice3.6.bias must be floats \[384\]; .*\[3\]"),
        ({BIAS: torch.zeros(384, dtype=torch.int8)}, r"floats \[384\]; got torch.int8"),
        ({BIAS: torch.full((384,), torch.nan)}, "NaN or infinite"),
        ({"net.slice1.0.weight": torch.zeros(64, 3, 7, 7)}, r"AlexNet .*it is \[64, 3, 7, 7\]"),
        ({"net.slice1.0.weight": None}, "there is none. The file holds lin0.model.1.weight"),
        ({"scaling_layer.shift": torch.zeros(1, 3, 1, 1)}, r"scaling_layer.shift is \[0.0"),
    ],
)  # fmt: skip
def test_other_tensors_are_refused(alex, tmp_path, change, message):
    tensors = {n: v for n, v in (alex | change).items() if v is not None}
    save_file(tensors, tmp_path / "w.safetensors")
    with pytest.raises(MetricError, match=message):
        load_lpips(tmp_path / "w.safetensors")


def test_other_files_are_refused(tmp_path):
    (tmp_path / "text.pth").write_text("weights")
    torch.save(nn.Conv2d(3, 3, 3), tmp_path / "model.pth")  # a pickle: never unpickled
    torch.save([torch.zeros(1)], tmp_path / "list.pth")
    for name, message in (
        ("none.pth", "no such file"),
        ("text.pth", "cannot be read as weights"),
        ("model.pth", "cannot be read as weights"),
        ("list.pth", "holds a list and not a state dict"),
    ):
        with pytest.raises(MetricError, match=message):
            load_lpips(tmp_path / name)
