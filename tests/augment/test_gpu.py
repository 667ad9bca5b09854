"""Copies on the GPU, launches, and the pretended GPU that other tests rely on."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import torch

from augment.render.buffers import AUTO, CPU, CUDA, REFERENCE, available_backends, kernels_for
from augment.render.cuda import runtime as gpu
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu


def test_a_copy_lives_as_long_as_its_tensor_and_follows_its_changes(monkeypatch):
    gc.collect()  # what other tests have left
    with pretended_gpu(monkeypatch):
        before = len(gpu._copies)
        tensor = torch.arange(6.0)
        copy = gpu.resident(tensor)
        assert isinstance(copy, AwayTensor) and gpu.resident(tensor) is copy
        tensor[0] = 9
        assert float(gpu.resident(tensor)[0]) == 9
        del tensor, copy
        gc.collect()
        assert len(gpu._copies) == before


def test_the_pretended_gpu_refuses_what_a_real_one_would(monkeypatch):
    with pretended_gpu(monkeypatch):
        away, here = torch.ones(3).to(gpu.gpu_device()), torch.ones(3)
        assert (away + 1).device == gpu.gpu_device() and float((away + away).sum()) == 6
        with pytest.raises(RuntimeError, match="one lies on the CPU"):
            away + here
        with pytest.raises(RuntimeError):
            away.numpy()
        assert torch.equal(away.cpu(), here) and torch.equal(away.to("cpu"), here)
        made = torch.tensor([1.0, 2.0], device=away.device)
        assert isinstance(made, AwayTensor) and isinstance(torch.zeros_like(made), AwayTensor)
        away[1] = 5
        assert away.inner.tolist() == [1, 5, 1]
        with pytest.raises(AssertionError, match="a kernel was given a tensor of cpu"):
            gpu._kernel_argument(here)
        with pytest.raises(AssertionError, match="not contiguous"):
            gpu._kernel_argument(torch.ones(3, 2).to(gpu.gpu_device()).T)
        with pytest.raises(AssertionError, match="a kernel was given"):
            gpu._kernel_argument(np.int64(3))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_kernels_are_interpreted_and_auto_does_not_take_them():
    assert gpu.is_interpreted() and gpu.gpu_device() == torch.device("cpu")
    assert available_backends()[CUDA] is None and not gpu.has_gpu()


def test_passes_take_kernels_for_plain_float32_only():
    image = torch.ones(2, 2)
    assert [kernels_for(name, image) for name in (REFERENCE, CPU, CUDA)] == [REFERENCE, CPU, CUDA]
    assert kernels_for(CUDA, image.double()) == kernels_for(CUDA, image.clone().requires_grad_())
    assert kernels_for(CUDA, image, None, image.double()) == REFERENCE
    assert kernels_for(AUTO, image) == CPU and kernels_for(AUTO, image.to("meta")) == CUDA
