"""Training of the style network: what it learns from, and that nothing else decides it."""

from __future__ import annotations

import dataclasses
import itertools

import cv2
import numpy as np
import pytest
import torch

from augment.effects.style.losses import FilterBank, style_loss
from augment.effects.style.network import apply_map
from augment.effects.style.pairs import (
    PairBatch,
    RecolorSettings,
    closed_form_method,
    recolor,
    sample_pairs,
    sample_recolorings,
    score_pairs,
)
from augment.effects.style.statistics import reinhard_map
from augment.effects.style.train import (
    TrainingPool,
    folded_pictures,
    generator_for,
    learning_rate_at,
    new_network,
    paper_losses,
    photo_contents,
    read_photos,
    scene_contents,
    score_photos,
    train_network,
    view_picture,
)
from augment.errors import StyleError
from augment.light.srgb import LUMINANCE_WEIGHTS
from augment.render.buffers import ALPHA, RGB
from augment.render.cuda import runtime as gpu
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene.cameras import Frame
from augment.scene.scene import Actor, Scene, Track
from augment.scene.sky import ConstantSky
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu
from tests.scenes import camera_ahead, one_gaussian, random_gaussians

SIZE = 16
MILD = torch.tensor([[0.8, 0.1, 0.0, 0.05], [0.05, 0.7, 0.1, 0.1], [0.0, 0.15, 0.75, 0.02]])


def photos(count=5, *, px=SIZE) -> torch.Tensor:
    """Smooth colourful pictures."""
    coarse = torch.rand((count, 3, 4, 4), generator=seeded(0))
    fine = torch.nn.functional.interpolate(coarse, (px, px), mode="bilinear")
    return (255 * fine).round().to(torch.uint8)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def tiny_scene(count=50, **changes) -> Scene:
    """None of its colours comes near 0, from wherever they are seen."""
    made = random_gaussians(count, sh_degree=1)
    frames = (Frame(0, 0, torch.eye(4).double(), {"ahead": camera_ahead(24, 16, 20.0)}),)
    light = dataclasses.replace(made, sh=0.4 * made.sh)
    sky = ConstantSky(torch.tensor([0.5, 0.7, 0.9]))
    return dataclasses.replace(Scene("tiny", "tiny:", light, (), sky, frames), **changes)


def actor() -> Actor:
    pose = torch.eye(4, dtype=torch.float64)[None]
    pose[0, 0, 3] = 3.0
    track = Track(torch.zeros(1, dtype=torch.int64), pose)
    red = one_gaussian((0.0, 0.2, 0.0), 0.4, rgb=(0.8, 0.3, 0.3))
    return Actor("a", "car", red, track, (1.0, 1.0, 1.0))


def pool_of(count=5, *, scene=False, device="cpu") -> TrainingPool:
    views = scene_contents(tiny_scene(), 1, SIZE, seed=0, device=device) if scene else []
    return TrainingPool(views, photo_contents(photos(count), device=device))


def draw(pool, step=0):
    return pool.draw(generator_for(0, step, "pictures"), 4)


def train(pool, net=None, *, start=0.0, steps=20, seed=0, stop=None):
    """The network, and the records of the first `stop` of its steps; of all by default."""
    net = net or new_network("small", seed=seed)
    settings = {"progress": lambda step: start + step / steps, "seed": seed, "learning_rate": 1e-3}
    records = train_network(net, pool, FilterBank(), **settings)
    return net, list(itertools.islice(records, stop))


# ---- views and photos ----------------------------------------------------------------------------


def rendered(scene: Scene, color_map: torch.Tensor) -> torch.Tensor:
    """The view of a scene whose harmonics are mapped: M (C0 sh + 0.5) + b = C0 sh' + 0.5."""
    camera = scene.frames[0].cameras["ahead"]
    linear, offset = color_map[:, :3], color_map[:, 3]
    shift = (linear.sum(1) / 2 + offset - 0.5) / SH_C0
    parts = []
    for part in scene.parts_for(camera):
        mapped = part.gaussians.sh @ linear.T
        sh = torch.cat([mapped[:, :1] + shift, mapped[:, 1:]], 1)
        gaussians = dataclasses.replace(part.gaussians, sh=sh)
        parts.append(dataclasses.replace(part, gaussians=gaussians))
    seen = rasterize(parts, camera, buffers=(RGB, ALPHA))
    sky = scene.sky.sample(camera.ray_directions()) @ linear.T + offset
    return (seen.rgb + (1 - seen.alpha)[..., None] * sky).permute(2, 0, 1)


def test_a_mapped_picture_is_the_picture_of_mapped_gaussians():
    """And its gradients are those that the renderer's backward pass adds up over the Gaussians."""
    scene = tiny_scene(actors=(actor(),))
    picture = view_picture(scene, scene.frames[0].cameras["ahead"])
    weights = torch.randn(picture.shape, generator=torch.Generator().manual_seed(0))
    images, gradients = [], []
    for way in (lambda m: rendered(scene, m), lambda m: folded_pictures(picture[None], m[None])[0]):
        color_map = MILD.clone().requires_grad_(True)
        images.append(way(color_map))
        (images[-1] * weights).sum().backward()
        gradients.append(color_map.grad)
    # 1e-5: float32's rounding over some dozen splats.
    assert (images[0] - images[1]).abs().max() < 1e-5
    assert (images[1] - picture).abs().max() > 0.1  # the map does something
    assert (gradients[0] - gradients[1]).abs().max() < 1e-4 * gradients[1].abs().max()
    darker = torch.cat([torch.eye(3), torch.full((3, 1), -0.6)], 1)
    parted = (rendered(scene, darker) - folded_pictures(picture[None], darker[None])[0]).abs()
    assert (parted > 1e-4).float().mean() > 0.2  # the renderer clamps, and there alone they part


def test_photos_are_found_squeezed_and_held_out(tmp_path):
    (tmp_path / "below").mkdir()
    for number in range(6):
        image = np.full((20, 30 + number, 3), 40 * number, np.uint8)
        folder = tmp_path / "below" if number % 2 else tmp_path
        cv2.imwrite(str(folder / f"{number}.png"), image)
    (tmp_path / "5.jpg").write_bytes(b"no picture")
    (tmp_path / "LICENCE.txt").write_text("not looked at")
    found = read_photos([tmp_path], 8, holdout=3)
    assert found.train.shape == (4, 3, 8, 8) and found.held_out.shape == (2, 3, 8, 8)
    # In order of paths: 0, 2, 4, then 1, 3, 5 below; every third is kept apart.
    assert found.train[:, 0, 0, 0].tolist() == [0, 80, 40, 120]
    assert found.held_out[:, 0, 0, 0].tolist() == [160, 200]
    assert "5.jpg" in found.problems[0] and found.problems[1] == "1 of 7 images were left out"
    assert len(read_photos([tmp_path], 8, holdout=0).train) == 6
    assert len(read_photos([tmp_path / "0.png"], 8, holdout=3).train) == 1
    assert len(read_photos([], 8, holdout=3).train) == 0


def test_what_cannot_be_learnt_from_is_named(tmp_path):
    with pytest.raises(StyleError, match=r"there is no file or folder .*absent"):
        read_photos([tmp_path / "absent"], 8, holdout=0)
    with pytest.raises(StyleError, match="holds no images"):
        read_photos([tmp_path], 8, holdout=0)
    (tmp_path / "a.jpg").write_bytes(b"no picture")
    with pytest.raises(StyleError, match=r"none of 1 images can be read; the first: .*a.jpg"):
        read_photos([tmp_path], 8, holdout=0)
    with pytest.raises(StyleError, match="no views of scenes, and no photos"):
        TrainingPool([], [])


# ---- a step --------------------------------------------------------------------------------------


@pytest.mark.parametrize("on_gpu", [False, True])
def test_a_draw_depends_on_seed_and_step_alone(on_gpu, monkeypatch):
    expected = draw(pool_of(2, scene=True))
    assert not torch.equal(expected.styles, draw(pool_of(2, scene=True), 1).styles)
    assert expected.colors.base.shape == (4, 1024, 3)
    assert expected.colors.bands.shape == (4, 1024, 3, 3)
    with pretended_gpu(monkeypatch):
        device = str(gpu.gpu_device()) if on_gpu else "cpu"
        again = draw(pool_of(2, scene=True, device=device))
        assert isinstance(again.pictures, AwayTensor) == on_gpu
        for tensor, wanted in (
            (again.pictures, expected.pictures),
            (again.styles, expected.styles),
            (again.colors.base, expected.colors.base),
            (again.colors.bands, expected.colors.bands),
        ):
            assert torch.equal(tensor.cpu(), wanted)


def test_losses_are_those_of_the_paper_s_stages():
    net = new_network("small", seed=0)
    torch.nn.init.normal_(net.head.weight, std=0.01, generator=seeded(1))
    step = draw(pool_of())

    def on_colors_and_pixels(color_map, values):
        return tuple(apply_map(color_map, value) for value in values)

    def distance(first, second):
        return sum((a - b).abs().mean() for a, b in zip(first, second, strict=True))

    with torch.no_grad():
        losses = paper_losses(net, step, FilterBank())
        f_c, f_s = net.encode(step.pictures)
        _, f_style = net.encode(step.styles)
        y_o = (step.colors.base, step.pictures.flatten(2).mT)  # colours, and R of them
        z_c = on_colors_and_pixels(net.content_map(f_c), y_o)
        y_s = on_colors_and_pixels(net.style_map(f_style), z_c)
        rendered = y_s[1].mT.reshape(step.pictures.shape)
        f_back, _ = net.encode(rendered.clamp(0, 1))
        z_s = on_colors_and_pixels(net.content_map(f_back), y_s)
        y_c = on_colors_and_pixels(net.style_map(f_s), z_c)
        wanted = {
            "cycle": distance(y_c, y_o),
            "consistency": distance(z_c, z_s),
            "style": style_loss(FilterBank()(rendered), FilterBank()(step.styles)),
        }
        only_cycle = paper_losses(net, step, FilterBank(), only_cycle=True)
    assert losses.keys() == wanted.keys() and only_cycle.keys() == {"cycle"}
    for name, value in wanted.items():  # 1e-4: float32 products in another order
        assert torch.allclose(losses[name], value, atol=1e-4), name
        assert value > 1e-3, name
    assert torch.equal(only_cycle["cycle"], losses["cycle"])


# ---- the loop ------------------------------------------------------------------------------------


def test_the_schedule_is_the_paper_s():
    rates = {0: 1e-4, 99_999: 1e-4, 100_000: 1e-5, 199_999: 1e-5, 200_000: 1e-6, 299_999: 1e-6}
    for step, rate in rates.items():
        assert learning_rate_at(1e-4, step / 300_000) == pytest.approx(rate)
    names = ["cycle", "consistency", "style", "pairs"]
    _, records = train(pool_of(2), stop=3)
    assert [list(record.terms) for record in records] == [names[:1], names[:1], names]
    assert [record.step for record in records] == [1, 2, 3]
    _, (record,) = train(pool_of(1), steps=1, start=0.5)
    assert list(record.terms) == names[:3]  # one picture makes no pairs


def test_the_loss_falls():
    """Of two pictures, which twenty steps can learn by heart."""
    losses = [record.loss for record in train(pool_of(2))[1][2:]]
    assert np.mean(losses[-5:]) < np.mean(losses[:5]) - 1  # mostly of logarithms of errors


def test_a_loss_that_is_no_number_stops_the_training():
    net = new_network("small", seed=0)
    torch.nn.init.constant_(net.head.bias, torch.inf)
    for start in (0.0, 0.5):  # in the warm-up, and beyond it
        with pytest.raises(StyleError, match=r"step 1 .*smaller learning rate"):
            train(pool_of(), net, start=start)


def test_bits_depend_on_data_and_seed_alone():
    def bits(net):
        return {name: value.numpy().tobytes() for name, value in net.state_dict().items()}

    net, _ = train(pool_of(), steps=4)
    torch.manual_seed(99)  # another process, another state of what torch draws from
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        state = torch.get_rng_state()
        again, _ = train(pool_of(), steps=4)
        assert torch.equal(state, torch.get_rng_state()) and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert bits(again) == bits(net)
    assert bits(train(pool_of(), steps=4, seed=1)[0]) != bits(net)


@pytest.mark.long
def test_a_training_is_the_same_on_a_gpu(monkeypatch):
    _, expected = train(pool_of(2, scene=True), stop=2)
    with pretended_gpu(monkeypatch):
        pool = pool_of(2, scene=True, device=str(gpu.gpu_device()))
        net, records = train(pool, stop=2)
        assert all(isinstance(parameter, AwayTensor) for parameter in net.parameters())
    # Adam's first step follows signs, which rounding decides where a gradient is nearly 0.
    for record, wanted, tolerance in zip(records, expected, (1e-5, 1e-2), strict=True):
        assert record.loss == pytest.approx(wanted.loss, rel=tolerance)


# ---- recolourings and pairs ----------------------------------------------------------------------

STILL = RecolorSettings(*[0.0] * 11)


def pair_photos(count: int = 3, px: int = 24) -> torch.Tensor:
    return photos(count, px=px).float() / 255


def test_a_seed_is_a_recolouring():
    images = pair_photos()
    first, again, other = (recolor(images, seeded(seed)) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert first.min() >= 0 and first.max() <= 1
    assert not torch.equal(first, images)


def test_grey_and_night_are_reached():
    images = pair_photos(1).expand(64, -1, -1, -1)
    grey = sample_recolorings(64, seeded(), dataclasses.replace(STILL, grey_share=1.0))(images)
    spread = images.std(1).mean()
    assert (grey.std(1).mean((1, 2)) < 0.31 * spread).all()
    luma = torch.tensor(LUMINANCE_WEIGHTS)
    torch.testing.assert_close(  # what is taken away is colour alone
        torch.einsum("c,bchw->bhw", luma, grey), torch.einsum("c,bchw->bhw", luma, images)
    )
    night = sample_recolorings(64, seeded(), dataclasses.replace(STILL, night_share=1.0))(images)
    assert (night.mean((1, 2, 3)) < 0.4 * images.mean((1, 2, 3))).all()
    assert (night.mean((2, 3))[:, 2] / night.mean((2, 3))[:, 0]).mean() > 1.3 * (
        images.mean((2, 3))[:, 2] / images.mean((2, 3))[:, 0]
    ).mean()


def test_pairs_share_a_recolouring():
    state = torch.random.get_rng_state()
    batch, again = (sample_pairs(pair_photos(4), seeded(), 5, size_px=16) for _ in range(2))
    assert batch.photos.shape == (5, 3, 16, 16)
    assert all(torch.equal(*both) for both in zip(batch, again, strict=True))
    assert (batch.photos - batch.second_photos).abs().mean((1, 2, 3)).min() > 0.01
    # One recolouring for both: colours that both hold become the same colour.
    one = PairBatch(*(part[:1] for part in batch))
    near = torch.cdist(*(picture[0].flatten(1).T for picture in (one.photos, one.second_photos)))
    first, second = divmod(int(near.argmin()), near.shape[1])
    became = (one.recolored[0].flatten(1)[:, first], one.second_recolored[0].flatten(1)[:, second])
    assert (became[0] - became[1]).abs().max() < 0.05 + 3 * float(near.min())
    assert torch.equal(torch.random.get_rng_state(), state)
    with pytest.raises(ValueError, match="at least 2 photos; got 1"):
        sample_pairs(pair_photos(1), seeded(), 2, size_px=16)


# ---- scores --------------------------------------------------------------------------------------

NAMES = ("same", "half", "below", "look")


@pytest.fixture(scope="module")
def scored() -> torch.Tensor:
    return 0.1 + 0.7 * pair_photos(4, 32)


def test_order_of_methods(scored):
    none, half, full = (
        score_pairs(closed_form_method(strength=strength), scored, repeats=1)
        for strength in (0.0, 0.5, 1.0)
    )
    assert none["same"] < half["same"] < full["same"]
    assert none["same"] == pytest.approx(none["look"])  # the style does not matter to it
    assert full["same"] > max(full["half"], full["below"], full["look"])
    first, again = (
        score_pairs(closed_form_method(reinhard_map), scored, repeats=1) for _ in range(2)
    )
    assert first == again != full


def test_an_untrained_network_scores_as_the_moments_do():
    scores = score_photos(new_network("small", seed=0), photos(3, px=32))
    assert scores["same"] == pytest.approx(scores["mkl_same"], abs=1.5)  # dB
    assert scores.keys() == {f"{m}{n}" for m in ("", "mkl_") for n in NAMES}
    assert score_photos(new_network("small", seed=0), photos(1)) == {}
