"""Style training where pictures, network and Gaussians lie on a GPU, here a pretended one."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("triton")

from augment.effects.style.losses import FilterBank
from augment.effects.style.scene_views import folded_pictures, rendered_pictures
from augment.effects.style.train import (
    StyleTrainConfig,
    StyleTrainer,
    TrainingPool,
    generator_for,
    new_network,
    scene_contents,
)
from augment.render.cuda import runtime as gpu
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu
from tests.augment.test_style_trainer import SIZE, photos, tiny_scene


def pool() -> TrainingPool:
    views = scene_contents(tiny_scene(12), 1, SIZE, with_parts=True, seed=0)
    return TrainingPool(views, photos(2))


def trained(pool: TrainingPool, device: str, steps: int) -> tuple[StyleTrainer, list]:
    config = StyleTrainConfig(
        steps=20, batch=1, pair_batch=1, warm_up=0.0, scene_share=1.0, through="renderer"
    )
    net = new_network("small", offset=True, seed=0)
    trainer = StyleTrainer(net, pool, config, FilterBank(), device=device)
    return trainer, [trainer.run_step() for _ in range(steps)]


def test_a_draw_is_the_same_on_every_device(monkeypatch):
    def draw(pool):
        generator = generator_for(0, 3, "pictures")
        return pool.draw(generator, 3, scene_share=0.5, perturbed=0.7, colors=5)

    own = pool()
    expected = draw(own)
    with pretended_gpu(monkeypatch):
        found = draw(own.to(gpu.gpu_device()))
        for name in ("pictures", "styles"):
            tensor = getattr(found, name)
            assert isinstance(tensor, AwayTensor)
            assert torch.equal(tensor.cpu(), getattr(expected, name))
        assert torch.equal(found.colors.bands.cpu(), expected.colors.bands)


def test_mapped_gaussians_are_rendered_where_they_lie(monkeypatch):
    """Also the gradients of the maps, which the kernels' colours' gradients add up to."""
    (content,) = scene_contents(tiny_scene(12), 1, SIZE, with_parts=True, seed=0)
    map_ = torch.tensor([[[0.8, 0.1, 0, 0.05], [0, 0.9, 0, 0], [0.1, 0, 0.7, 0.1]]])
    weights = torch.randn(1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    leaf = map_.clone().requires_grad_()
    (folded_pictures(content.picture[None], leaf) * weights).sum().backward()
    with pretended_gpu(monkeypatch):
        device = gpu.gpu_device()
        view = content.view.to(device)
        away = map_.to(device).requires_grad_()
        (rendered_pictures([view], away) * weights.to(device)).sum().backward()
        assert isinstance(away.grad, AwayTensor)
        error = (away.grad.cpu() - leaf.grad).norm() / leaf.grad.norm()
    assert error < 1e-4  # no colour is clamped; alpha is 1 - T, weights are sums


@pytest.mark.long
def test_a_training_goes_on_between_devices(monkeypatch):
    own = pool()
    here, expected = trained(own, "cpu", 2)
    with pretended_gpu(monkeypatch):
        device = str(gpu.gpu_device())
        there, found = trained(own, device, 2)
        assert all(isinstance(p, AwayTensor) for p in there.net.parameters())
        arrays, facts = there.state()
    # Adam's first step follows signs, which rounding decides where a gradient is nearly 0.
    for a, b, tolerance in zip(found, expected, (1e-5, 1e-2), strict=True):
        assert a.loss == pytest.approx(b.loss, rel=tolerance)
    assert facts == {"step": 2}
    here.load_state(arrays, facts)
    assert here.run_step().step == 3
