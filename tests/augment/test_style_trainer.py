"""Training of the style network: what it learns from, and that nothing else decides it."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scenes import camera_ahead, one_gaussian, random_gaussians

from augment.effects.style.losses import FilterBank, weighted_sum
from augment.effects.style.network import Gscm, apply_map
from augment.effects.style.pairs import (
    LUMA,
    PAIR_WEIGHTS,
    PairBatch,
    RecolorSettings,
    closed_form_method,
    pair_losses,
    recolor,
    sample_pairs,
    sample_recolorings,
    score_pairs,
)
from augment.effects.style.statistics import reinhard_map
from augment.effects.style.train import (
    StyleTrainer,
    TrainingPool,
    folded_pictures,
    generator_for,
    new_network,
    read_photos,
    scene_contents,
    transfer_maps,
    view_picture,
)
from augment.errors import StyleError
from augment.render.buffers import ALPHA, RGB
from augment.render.cuda import runtime as gpu
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene.cameras import Frame
from augment.scene.scene import Actor, Scene, Track
from augment.scene.sky import ConstantSky
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu

SIZE = 16
MILD = torch.tensor([[0.8, 0.1, 0.0, 0.05], [0.05, 0.7, 0.1, 0.1], [0.0, 0.15, 0.75, 0.02]])


def photos(count=5, *, seed=0) -> torch.Tensor:
    """Smooth colourful pictures."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand((count, 3, 4, 4), generator=generator)
    fine = torch.nn.functional.interpolate(coarse, (SIZE, SIZE), mode="bilinear")
    return (255 * fine).round().to(torch.uint8)


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
    views = scene_contents(tiny_scene(), 1, SIZE, seed=0, device=device) if scene else ()
    return TrainingPool(views, photos(count).to(device))


WEIGHTS = {"style": 1.0, "consistency": 10.0, "cycle": 10.0, "pairs": 0.0, "range": 4.0}


def trainer_of(pool=None, *, weights=(), **settings) -> StyleTrainer:
    settings = {
        "steps": 20, "seed": 0, "learning_rate": 1e-3, "batch": 1, "pair_batch": 1, **settings
    }  # fmt: skip
    net, pool = new_network("small", seed=settings["seed"]), pool or pool_of()
    return StyleTrainer(net, pool, FilterBank(), weights=WEIGHTS | dict(weights), **settings)


def draw(pool, step=0):
    return pool.draw(generator_for(0, step, "pictures"), 4)


# ---- views and photos -------------------------------------------------------------------------


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
        TrainingPool((), photos(0))


# ---- what a step sees -------------------------------------------------------------------------


def test_a_draw_is_of_its_seed_and_step():
    pool = pool_of(scene=True)
    first, again, other = draw(pool), draw(pool), draw(pool, 1)
    assert torch.equal(first.pictures, again.pictures) and torch.equal(first.styles, again.styles)
    assert torch.equal(first.colors.base, again.colors.base)
    assert not torch.equal(first.pictures, other.pictures)
    assert first.colors.base.shape == (4, 1024, 3) and first.colors.bands.shape == (4, 1024, 3, 3)


# ---- losses and schedule ----------------------------------------------------------------------


def moved_network():
    net = new_network("small", seed=0)
    torch.nn.init.normal_(net.head.weight, std=0.01, generator=torch.Generator().manual_seed(1))
    return net


def test_maps_are_those_of_the_paper_s_stages():
    net, found = moved_network(), draw(pool_of())
    with torch.no_grad():
        maps, rendered = transfer_maps(net, found)
        f_c, f_s = net.encode(found.pictures)
        _, style = net.encode(found.styles)
        pixels = found.pictures.flatten(2).mT
        content = apply_map(net.content_map(f_c), pixels)
        styled = apply_map(net.style_map(style), content)
        back, _ = net.encode(styled.mT.reshape(found.pictures.shape).clamp(0, 1))
        returned = apply_map(net.content_map(back), styled)
        cycled = apply_map(net.style_map(f_s), content)
    for name, wanted in {
        "content": content, "styled": styled, "returned": returned, "cycled": cycled
    }.items():  # fmt: skip
        assert torch.allclose(apply_map(getattr(maps, name), pixels), wanted, atol=1e-4), name
    assert torch.allclose(rendered, styled.mT.reshape(found.pictures.shape), atol=1e-4)


def test_the_schedule_is_the_paper_s():
    trainer = trainer_of(steps=300_000, learning_rate=1e-4)
    at = {0: 1e-4, 99_999: 1e-4, 100_000: 1e-5, 199_999: 1e-5, 200_000: 1e-6, 299_999: 1e-6}
    for step, rate in at.items():
        assert trainer.learning_rate_at(step) == pytest.approx(rate)
    assert trainer.is_warming_up(29_999) and not trainer.is_warming_up(30_000)
    assert not trainer_of(weights={"cycle": 0.0}).is_warming_up(0)


def test_the_loss_falls():
    """Of two pictures, which thirty steps can learn by heart."""
    trainer = trainer_of(pool=pool_of(2), steps=30)
    trainer.step = 3  # beyond the warm-up
    losses = [trainer.run_step().loss for _ in range(27)]
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    assert trainer.step == 30


def test_a_loss_that_is_no_number_stops_the_training():
    trainer = trainer_of()
    with torch.no_grad():
        trainer.net.head.bias.fill_(torch.inf)
    with pytest.raises(StyleError, match=r"step 1 .* smaller learning rate"):
        trainer.run_step()
    assert trainer.step == 0
    with pytest.raises(StyleError, match="none of the losses"):  # one picture makes no pairs
        nothing = dict.fromkeys(["style", "consistency", "cycle"], 0.0)
        trainer_of(pool_of(1), weights={**nothing, "pairs": 1.0}).run_step()


# ---- nothing else decides ---------------------------------------------------------------------


def bits(trainer) -> dict[str, bytes]:
    return {name: array.tobytes() for name, array in trainer.state()[0].items()}


def test_resumed_is_uninterrupted_to_the_bit():
    settings = {"steps": 5, "weights": {"pairs": 1.0}}
    whole, first, second = (trainer_of(**settings) for _ in range(3))
    for _ in range(5):
        whole.run_step()
    for _ in range(2):
        first.run_step()
    arrays, facts = first.state()
    kept = {name: array.copy() for name, array in arrays.items()}
    first.run_step()  # does not reach what was taken from it
    assert all(np.array_equal(arrays[n], a) for n, a in kept.items())
    second.load_state(kept, facts)
    torch.manual_seed(99)  # another process, another state of what torch draws from
    torch.set_num_threads(2)
    state = torch.get_rng_state()
    for _ in range(3):
        second.run_step()
    assert torch.equal(state, torch.get_rng_state()) and torch.get_num_threads() == 2
    assert bits(second) == bits(whole)
    assert bits(trainer_of(steps=5, seed=1)) != bits(trainer_of(steps=5))
    kept.pop("net.head.bias")
    with pytest.raises(StyleError, match="of another network"):
        second.load_state(kept, facts)


# ---- recolourings and pairs ----------------------------------------------------------------------

STILL = RecolorSettings(*[0.0] * 11)


def pair_photos(count: int = 3, px: int = 24) -> torch.Tensor:
    generator = torch.Generator().manual_seed(count)
    rough = torch.rand((count, 3, 4, 4), generator=generator)
    return torch.nn.functional.interpolate(rough, (px, px), mode="bilinear")


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_a_seed_is_a_recolouring():
    images = pair_photos()
    first, again, other = (recolor(images, seeded(seed)) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert first.min() >= 0 and first.max() <= 1
    assert not torch.equal(first, images)


def test_grey_and_night_are_reached():
    images = pair_photos(1).expand(64, -1, -1, -1)
    grey = sample_recolorings(64, seeded(), replace(STILL, grey_share=1.0))(images)
    spread = images.std(1).mean()
    assert (grey.std(1).mean((1, 2)) < 0.31 * spread).all()
    luma = torch.tensor(LUMA)
    torch.testing.assert_close(  # what is taken away is colour alone
        torch.einsum("c,bchw->bhw", luma, grey), torch.einsum("c,bchw->bhw", luma, images)
    )
    night = sample_recolorings(64, seeded(), replace(STILL, night_share=1.0))(images)
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


@pytest.mark.long
def test_losses_fall_by_training():
    torch.manual_seed(0)
    net = Gscm()
    batch = sample_pairs(pair_photos(6), seeded(), 2, size_px=32)
    optimizer = torch.optim.Adam(net.parameters(), 3e-4)
    totals = []
    for _ in range(8):
        losses = pair_losses(net, batch)
        total = weighted_sum(losses, PAIR_WEIGHTS | {"range": 4.0})
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert totals[-1] < totals[0] - 0.1
    assert losses.keys() == {*PAIR_WEIGHTS, "range"}


# ---- scores -----------------------------------------------------------------------------------


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


# ---- on a GPU ------------------------------------------------------------------------------------


def test_a_draw_is_the_same_on_every_device(monkeypatch):
    expected = draw(pool_of(2, scene=True))
    with pretended_gpu(monkeypatch):
        found = draw(pool_of(2, scene=True, device=str(gpu.gpu_device())))
        for name in ("pictures", "styles"):
            tensor = getattr(found, name)
            assert isinstance(tensor, AwayTensor)
            assert torch.equal(tensor.cpu(), getattr(expected, name))
        assert torch.equal(found.colors.bands.cpu(), expected.colors.bands)


@pytest.mark.long
def test_a_training_goes_on_between_devices(monkeypatch):
    here = trainer_of(pool_of(2, scene=True))
    expected = [here.run_step() for _ in range(2)]
    with pretended_gpu(monkeypatch):
        there = trainer_of(pool_of(2, scene=True, device=str(gpu.gpu_device())))
        found = [there.run_step() for _ in range(2)]
        assert all(isinstance(p, AwayTensor) for p in there.net.parameters())
        arrays, facts = there.state()
    # Adam's first step follows signs, which rounding decides where a gradient is nearly 0.
    for a, b, tolerance in zip(found, expected, (1e-5, 1e-2), strict=True):
        assert a.loss == pytest.approx(b.loss, rel=tolerance)
    assert facts == {"step": 2}
    here.load_state(arrays, facts)
    assert here.run_step().step == 3
