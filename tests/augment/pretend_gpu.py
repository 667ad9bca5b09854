"""A GPU that is none: tensors that say they lie elsewhere and hold their data on the CPU.

Where there is no GPU, a tensor that was left on the wrong device shows nowhere. Here it does: these
tensors say they are on torch's device "meta", mixing them with tensors of the CPU is the error that
CUDA would raise, and numpy cannot read them. Triton's interpreter gets what they hold.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from augment.render.cuda import runtime as gpu

AWAY = torch.device("meta")


class AwayTensor(torch.Tensor):
    """A tensor of the pretended GPU. inner: what it holds, on the CPU."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> AwayTensor:
        self = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=AWAY,
            requires_grad=inner.requires_grad,
        )
        self.inner = inner
        return self

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"AwayTensor({self.inner!r})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


@contextmanager
def pretended_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Within it, `gpu_device()` is the pretended GPU. Skips the test where kernels are compiled:
    they run on a real GPU, where a tensor on the wrong side shows by itself.
    """
    if not gpu.is_interpreted():
        pytest.skip("kernels are compiled for a real GPU; TRITON_INTERPRET=1 interprets them")
    with monkeypatch.context() as patch:
        patch.setattr(gpu, "_device", lambda: AWAY)
        patch.setattr(gpu, "_kernel_argument", _kernel_argument)
        with _Moves(), _Work():
            yield


def held_by(value: Any) -> Any:
    """What a tensor of the pretended GPU holds; anything else as it is, but no tensor of the CPU
    may reach a kernel.
    """
    if isinstance(value, AwayTensor):
        return value.inner
    assert not isinstance(value, torch.Tensor), f"a kernel was given a tensor of {value.device}"
    return value


def _kernel_argument(value: Any) -> Any:
    """As held_by, and nothing that compiled kernels would refuse or misread: no tensor with gaps,
    no number that is not Python's.
    """
    held = held_by(value)
    if isinstance(held, torch.Tensor):
        assert held.is_contiguous(), f"a kernel was given a tensor that is not contiguous: {value}"
    else:
        assert type(held) in (int, float, bool, type(None)), f"a kernel was given {held!r}"
    return held


class _Moves(TorchFunctionMode):
    """Calls that name a device."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func is torch.Tensor.to:
            return _moved(args[0], args[1:], kwargs)
        if func is torch.tensor and _is_away(kwargs.get("device")):
            return AwayTensor(torch.tensor(*args, **{**kwargs, "device": None}))
        if func is torch.Tensor.pin_memory:
            return args[0]
        return func(*args, **kwargs)


class _Work(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


def _is_away(device: Any) -> bool:
    return device is not None and torch.device(device).type == AWAY.type


def _moved(tensor: torch.Tensor, args: tuple[Any, ...], kwargs: dict[str, Any]) -> torch.Tensor:
    rest, device = [], kwargs.get("device")
    for arg in args:
        if isinstance(arg, str | torch.device):
            device = arg
        elif isinstance(arg, torch.Tensor):
            device = arg.device
            rest.append(arg.dtype)
        elif isinstance(arg, torch.dtype):  # not the bool that says whether to wait
            rest.append(arg)
    others = {k: v for k, v in kwargs.items() if k not in ("device", "non_blocking")}
    was_away = isinstance(tensor, AwayTensor)
    goes_away = was_away if device is None else _is_away(device)
    inner = tensor.inner if was_away else tensor
    out = inner.to(*rest, **others) if rest or others else inner
    if was_away == goes_away:
        return tensor if out is inner else (AwayTensor(out) if goes_away else out)
    out = out.clone() if out is inner else out
    return AwayTensor(out) if goes_away else out


def _run(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    tensors = [a for a in tree_flatten((args, kwargs))[0] if isinstance(a, torch.Tensor)]
    away = [a for a in tensors if isinstance(a, AwayTensor)]
    here = [a for a in tensors if not isinstance(a, AwayTensor)]
    copies = func in (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)
    stray = [a for a in here if a.dim() > 0]
    if away and stray and not copies:
        raise RuntimeError(f"{func}: expected all tensors on one device; one lies on the CPU")
    goes_away = _is_away(kwargs["device"]) if kwargs.get("device") is not None else bool(away)
    if func is torch.ops.aten.copy_.default:
        goes_away = isinstance(args[0], AwayTensor)
    inner_args, inner_kwargs = tree_map(_inner, (args, kwargs))
    out = func(*inner_args, **inner_kwargs)

    def outer(value: Any) -> Any:
        if not isinstance(value, torch.Tensor) or not goes_away or isinstance(value, AwayTensor):
            return value
        for tensor in away:
            if tensor.inner is value:
                return tensor
        return AwayTensor(value)

    return tree_map(outer, out)


def _inner(value: Any) -> Any:
    if isinstance(value, AwayTensor):
        return value.inner
    return torch.device("cpu") if isinstance(value, torch.device) else value
