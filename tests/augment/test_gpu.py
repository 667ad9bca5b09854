"""Copies on the GPU, launches, and the pretended GPU that other tests rely on."""

from __future__ import annotations

import gc
import types

import numpy as np
import pytest
import torch

from augment.errors import BackendUnavailable
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


def test_copies_of_what_may_change_unseen_are_not_kept(monkeypatch):
    with torch.inference_mode():
        tensor = torch.arange(6.0)
    with pretended_gpu(monkeypatch):
        copy = gpu.resident(tensor)
        with torch.inference_mode():
            tensor[0] = 9
        assert float(copy[0]) == 0 and float(gpu.resident(tensor)[0]) == 9


def test_numbers_of_numpy_reach_kernels_as_those_of_python():
    given: list[object] = []
    kernel = {(2,): lambda *arguments, **_: given.extend(arguments)}
    numbers = np.int64(3), np.float32(0.5), np.bool_(True), 4, None
    gpu.launch(kernel, (2,), *numbers)
    assert given == [3, 0.5, True, 4, None]
    assert [type(each) for each in given] == [int, float, bool, int, type(None)]


def test_a_machine_that_cannot_build_launchers_says_so_before_anything_is_launched(monkeypatch):
    class Broken:
        @property
        def utils(self):
            raise RuntimeError("Failed to find C compiler")

    import triton.runtime

    monkeypatch.setattr(triton.runtime, "driver", types.SimpleNamespace(active=Broken()))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gpu, "is_interpreted", lambda: False)
    monkeypatch.setattr(gpu, "_obstacle", gpu._obstacle.__wrapped__)
    with pytest.raises(BackendUnavailable, match=r"Failed to find C compiler.*needs a C compiler"):
        gpu.check_can_run()
    assert not gpu.has_gpu()


def test_tensors_that_are_there_already_are_not_copied(monkeypatch):
    with pretended_gpu(monkeypatch):
        there = gpu.upload(np.arange(4, dtype=np.float32))
        assert gpu.resident(there).inner.data_ptr() == there.inner.data_ptr()


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
