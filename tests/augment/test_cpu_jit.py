"""The CPU backend's building blocks: the kernel cache, eight-wide arithmetic, exp2 and log2."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from numba import prange

from augment.render.cpu import jit as cpu_jit
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel
from augment.render.cpu.simd import exp2, exp2_fine, log2
from augment.render.threads import kernel_threads

U = np.uint64


def double(values):
    for i in prange(values.size):
        values[i] *= 2


@kernel
def elementary(which, x, out):
    for group in prange(x.size // 8):
        at = U(group) * U(8)
        value = v8.load(x, at)
        if which == 0:
            v8.store(out, at, exp2(value))
        elif which == 1:
            v8.store(out, at, exp2_fine(value))
        elif which == 2:
            v8.store(out, at, log2(value))
        elif which == 3:
            v8.store(out, at, v8.floor(v8.negate(value)))
        elif which == 4:
            v8.store(out, at, v8.minus_abs(value))
        else:
            v8.store(out, at, v8.sqrt(v8.maximum(value, v8.splat(np.float32(2)))) / value)


def apply(which, x):
    x = np.asarray(x, np.float32)
    padded = np.resize(x, -(-x.size // 8) * 8)
    out = np.empty_like(padded)
    with kernel_threads():
        elementary(which, padded, out)
    return out[: x.size].astype(np.float64)


def test_a_kernel_is_compiled_again_when_any_source_changes(monkeypatch):
    def hits(kernel_function):
        values = np.ones(4)
        with kernel_threads():
            kernel_function(values)
        assert values.tolist() == [2, 2, 2, 2]
        return sum(kernel_function.stats.cache_hits.values())

    hits(kernel(double))  # whatever an earlier run left, it is in the cache now
    assert hits(kernel(double)) == 1
    monkeypatch.setattr(
        cpu_jit, "SOURCES", "other sources " + np.random.default_rng().bytes(8).hex()
    )
    assert hits(kernel(double)) == 0
    assert hits(kernel(double)) == 1


def test_importing_compiles_nothing():
    code = (
        "import numba.core.event as e\n"
        "log = e.RecordingListener()\n"
        "e.register('numba:compile', log)\n"
        "import augment.render.cpu.driver\n"
        "print(len(log.buffer))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120
    )
    assert result.stdout == "0\n", result.stderr


def test_exp2():
    x = np.linspace(-126, 126, 100_001)
    expected = np.exp2(np.float64(np.float32(x)))
    np.testing.assert_allclose(apply(0, x), expected, rtol=3e-6)
    np.testing.assert_allclose(apply(1, x), expected, rtol=2e-7)
    # Smog without density must change no bit.
    assert apply(1, [0.0, -0.0]).tolist() == [1.0, 1.0]


def test_log2():
    x = np.exp2(np.linspace(-125, 125, 100_001)).astype(np.float32)
    expected = np.log2(x.astype(np.float64))
    assert np.all(np.abs(apply(2, x) - expected) <= 2e-7 * (1 + np.abs(expected)))
    assert apply(2, [1.0, 0.5, 8.0]).tolist() == [0.0, -1.0, 3.0]
    # Nothing in the numbers a culled splat brings may look visible.
    assert (apply(2, [0.0, 1e-44]) < -100).all()


@pytest.mark.parametrize(
    ("which", "function"),
    [
        (3, lambda x: np.floor(-x)),
        (4, lambda x: -np.abs(x)),
        (5, lambda x: np.sqrt(np.maximum(x, np.float32(2))) / x),
    ],
)
def test_lanes(which, function):
    x = np.array([-2.5, -1, -0.25, 0.5, 1, 1.5, 3, 1e6, 7, -7], np.float32)
    assert apply(which, x).tolist() == function(x).astype(np.float32).tolist()
