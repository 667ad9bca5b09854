"""Small kernels for the tests of what records and compiles kernels: good ones and bad ones."""

import triton
import triton.language as tl


@triton.jit
def _halved(value):
    return value * 0.5


@triton.jit(do_not_specialize=["count"])
def scale(source, target, count, factor, BLOCK: tl.constexpr):
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    value = _halved(tl.load(source + at, mask=at < count))
    tl.store(target + at, value * factor, mask=at < count)


@triton.jit
def add_wide(source, total, BLOCK: tl.constexpr):
    at = tl.arange(0, BLOCK)
    value = tl.exp(tl.load(source + at).to(tl.float64))
    tl.atomic_add(total + at % 2, value.to(tl.float32))


@triton.jit
def crowd(source, target, BLOCK: tl.constexpr):
    at = tl.arange(0, BLOCK)
    value = tl.load(source + at)
    tl.store(target + at, value / tl.sum(value))


@triton.jit
def broken(source, BLOCK: tl.constexpr):
    tl.store(source + tl.arange(0, BLOCK - 1), 0.0)
