"""Training of the style network: schedule, what a step sees, and that nothing else decides it."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from scenes import camera_ahead, random_gaussians

from augment.cameras import Frame
from augment.effects.style.losses import FilterBank, GaussianColors
from augment.effects.style.network import apply_map
from augment.effects.style.pairs import PairWeights
from augment.effects.style.scores import score_photos, score_training
from augment.effects.style.train import (
    StyleTrainConfig,
    StyleTrainer,
    TrainingPool,
    generator_for,
    new_network,
    paper_terms,
    read_photos,
    scene_contents,
    stacked,
    transfer_maps,
)
from augment.errors import StyleError
from augment.scene import Scene
from augment.sky import ConstantSky

SIZE = 16


def photos(count=5, *, seed=0) -> torch.Tensor:
    """Smooth colourful pictures."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand((count, 3, 4, 4), generator=generator)
    fine = torch.nn.functional.interpolate(coarse, (SIZE, SIZE), mode="bilinear")
    return (255 * fine).round().to(torch.uint8)


def tiny_scene(count=50) -> Scene:
    made = random_gaussians(count, sh_degree=1)
    cameras = {"ahead": camera_ahead(24, 16, 20.0)}
    frames = (Frame(0, 0, torch.eye(4, dtype=torch.float64), cameras),)
    light = dataclasses.replace(made, sh=0.4 * made.sh)
    return Scene("tiny", "tiny:", light, (), ConstantSky(torch.tensor([0.5, 0.7, 0.9])), frames)


def pool_of(count=5, *, scene=False, with_parts=False) -> TrainingPool:
    views = scene_contents(tiny_scene(), 1, SIZE, with_parts=with_parts, seed=0) if scene else ()
    return TrainingPool(views, photos(count))


def trainer_of(pool=None, **settings) -> StyleTrainer:
    settings = {"steps": 20, "batch": 1, "pair_batch": 1, "pairs": 0.0, **settings}
    config = StyleTrainConfig(**settings)
    net = new_network("small", offset=True, seed=config.seed)
    return StyleTrainer(net, pool_of() if pool is None else pool, config, FilterBank())


# ---- configuration and schedule ---------------------------------------------------------------


def test_defaults_are_the_paper_s():
    config = StyleTrainConfig(steps=300_000, learning_rate=1e-4)
    assert (config.consistency, config.cycle, config.style) == (10, 10, 1)
    at = {0: 1e-4, 99_999: 1e-4, 100_000: 1e-5, 199_999: 1e-5, 200_000: 1e-6, 299_999: 1e-6}
    for step, rate in at.items():
        assert config.learning_rate_at(step) == pytest.approx(rate)
    assert config.is_warming_up(29_999) and not config.is_warming_up(30_000)
    assert not StyleTrainConfig(steps=100, cycle=0.0).is_warming_up(0)
    assert not StyleTrainConfig(steps=100, warm_up=0.0).is_warming_up(0)


def test_settings_out_of_range_are_named():
    for setting, message in (
        ({"steps": 0}, "steps must be at least 1; got 0"),
        ({"warm_up": 1.5}, "warm_up must be between 0 and 1"),
        ({"cycle": float("nan")}, "cycle must be finite and at least 0; got nan"),
        ({"learning_rate": 0.0}, "learning_rate must be finite and above 0"),
        ({"decay": 0.0}, "decay must be above 0"),
        ({"pair_weights": PairWeights(look=-1.0)}, r"pair_weights\.look must be .* got -1"),
        (dict.fromkeys(["style", "consistency", "cycle", "pairs"], 0.0), "all losses weigh 0"),
    ):
        with pytest.raises(ValueError, match=message):
            StyleTrainConfig(**{"steps": 10, **setting})
    with pytest.raises(ValueError, match="views of scenes, or photos; got neither"):
        TrainingPool((), photos(0))


# ---- what a step sees -------------------------------------------------------------------------


def draw(pool, step=0, **settings):
    settings = {"scene_share": 0.5, "perturbed": 0.0, "colors": 7, **settings}
    return pool.draw(generator_for(0, step, "pictures"), 4, **settings)


def test_a_draw_is_of_its_seed_and_step():
    pool = pool_of(scene=True)
    first, again, other = draw(pool), draw(pool), draw(pool, 1)
    assert torch.equal(first.pictures, again.pictures) and torch.equal(first.styles, again.styles)
    assert torch.equal(first.colors.base, again.colors.base)
    assert not torch.equal(first.pictures, other.pictures)
    assert first.colors.base.shape == (4, 7, 3) and first.colors.bands.shape == (4, 7, 3, 3)


def test_a_style_is_another_picture_and_shares_decide_of_the_contents():
    pool = pool_of(2, scene=True)
    for step in range(8):
        found = draw(pool, step)
        assert all((a != b).any() for a, b in zip(found.pictures, found.styles, strict=True))
        assert all(c.view is None for c in draw(pool, step, scene_share=0.0).contents)
        assert all(c.view is not None for c in draw(pool, step, scene_share=1.0).contents)
    alone = draw(pool_of(1))
    assert (alone.styles != alone.pictures).any()  # recoloured, since there is no other
    known = pool.pictures()
    recolored = draw(pool, perturbed=1.0).styles
    assert not any(torch.equal(r, k) for r in recolored for k in known)


def test_items_with_fewer_bands_are_filled_up():
    a = GaussianColors(torch.ones(1, 2, 3), torch.ones(1, 2, 3, 3))
    b = GaussianColors(torch.ones(1, 2, 3), torch.ones(1, 2, 0, 3))
    both = stacked([a, b])
    assert both.bands.shape == (2, 2, 3, 3) and both.bands.sum((1, 2, 3)).tolist() == [18, 0]


# ---- losses -----------------------------------------------------------------------------------


def test_maps_are_those_of_the_paper_s_stages():
    net = new_network("small", offset=True, seed=0)
    torch.nn.init.normal_(net.head.weight, std=0.01, generator=torch.Generator().manual_seed(1))
    found = draw(pool_of())
    with torch.no_grad():
        maps, rendered = transfer_maps(net, found, through="picture")
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


def test_only_the_cycle_counts_in_the_warm_up():
    trainer = trainer_of(steps=20, warm_up=0.1, pairs=1.0)
    records = [trainer.run_step() for _ in range(3)]
    assert [set(r.terms) for r in records] == [{"cycle"}] * 2 + [
        {"cycle", "consistency", "style", "pairs"}
    ]
    assert records[0].loss == pytest.approx(10 * records[0].terms["cycle"])
    t = records[2].terms
    total = 10 * (t["cycle"] + t["consistency"]) + t["style"] + t["pairs"]
    assert records[2].loss == pytest.approx(total, rel=1e-5)


def test_through_the_renderer_is_through_the_picture():
    pool = pool_of(0, scene=True, with_parts=True)
    net = new_network("small", offset=True, seed=0)
    torch.nn.init.normal_(net.head.weight, std=0.005, generator=torch.Generator().manual_seed(1))
    gradients, values = [], []
    for through in ("picture", "renderer"):
        net.zero_grad()
        terms = paper_terms(net, draw(pool), FilterBank(), through=through)
        terms["cycle"].backward()
        gradients.append(net.head.bias.grad.clone())
        values.append({name: float(term.detach()) for name, term in terms.items()})
    # What is restored is bright. Content space is partly below 0, where the renderer clamps.
    assert values[0]["cycle"] == pytest.approx(values[1]["cycle"], rel=1e-3)
    assert values[0]["style"] == pytest.approx(values[1]["style"], rel=0.1)
    assert values[0]["consistency"] == pytest.approx(values[1]["consistency"], rel=0.2)
    assert (gradients[0] - gradients[1]).abs().max() < 1e-2 * gradients[0].abs().max()


def test_l_con_bends_no_style():
    net = new_network("small", offset=True, seed=0)
    torch.nn.init.normal_(net.head.weight, std=0.01, generator=torch.Generator().manual_seed(1))
    paper_terms(net, draw(pool_of()), FilterBank())["consistency"].backward()
    assert (net.content_q.grad != 0).any() and net.style_q.grad is None


def test_the_loss_falls():
    """Of one content and style, which thirty steps can learn by heart."""
    trainer = trainer_of(pool=pool_of(2), steps=30, warm_up=0.0, perturbed=0.0)
    records = [trainer.run_step() for _ in range(30)]
    first, last = (np.mean([r.loss for r in part]) for part in (records[:5], records[-5:]))
    assert last < 0.8 * first
    assert trainer.step == 30


def test_a_loss_that_is_no_number_stops_the_training():
    trainer = trainer_of(warm_up=0.0)
    with torch.no_grad():
        trainer.net.head.bias.fill_(torch.inf)
    with pytest.raises(StyleError, match=r"step 1 .* smaller learning rate"):
        trainer.run_step()
    assert trainer.step == 0


# ---- nothing else decides ---------------------------------------------------------------------


def bits(trainer) -> dict[str, bytes]:
    return {name: array.tobytes() for name, array in trainer.state()[0].items()}


def test_resumed_is_uninterrupted_to_the_bit():
    settings = {"steps": 5, "pairs": 1.0, "warm_up": 0.2}
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


# ---- scores and photos ------------------------------------------------------------------------


def test_scores_of_a_network_that_restores_all():
    """As it begins: both stages are inverse to each other by construction."""
    net = new_network("small", offset=True, seed=0)
    net.train()
    scores = score_training(net, draw(pool_of()), FilterBank())
    assert scores["restoration_psnr"] > 50 and net.training
    with torch.no_grad():
        net.style_q.mul_(0.5)
    assert score_training(net, draw(pool_of()), FilterBank())["restoration_psnr"] < 20
    found = score_photos(net, photos(2), repeats=1)
    assert {"same", "half", "look", "mkl_same"} <= set(found) and found["mkl_same"] > found["same"]
    assert score_photos(net, photos(1)) == {}


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


def test_photos_that_are_none_are_named(tmp_path):
    with pytest.raises(StyleError, match=r"there is no file or folder .*absent"):
        read_photos([tmp_path / "absent"], 8, holdout=0)
    with pytest.raises(StyleError, match="holds no images"):
        read_photos([tmp_path], 8, holdout=0)
    (tmp_path / "a.jpg").write_bytes(b"no picture")
    with pytest.raises(StyleError, match=r"none of 1 images can be read; the first: .*a.jpg"):
        read_photos([tmp_path], 8, holdout=0)
