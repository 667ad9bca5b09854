"""Style training where pictures and network lie on a GPU, here a pretended one."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("triton")

from augment.render.cuda import runtime as gpu
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu
from tests.augment.test_style_trainer import draw, pool_of, trainer_of


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
