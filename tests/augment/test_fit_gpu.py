"""A fit whose views gsplat renders, here a stand-in by the definition: all else stays the same."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("triton")

from augment.errors import BackendUnavailable
from augment.reconstruct.config import FitConfig, Growth, Tuning
from augment.reconstruct.trainer import Trainer
from augment.render.cpu import backward_kernels as columns
from augment.render.cuda import runtime as gpu
from augment.render.layout import BLOCK
from tests.augment import gsplat_stand_in
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu
from tests.augment.test_trainer import QUICK, assert_same_state, quick, record, run, start, truth

if not gpu.is_interpreted():
    pytest.skip("the stand-in computes on the CPU", allow_module_level=True)

CONFIG = FitConfig(max_splats=600)
TUNING = Tuning(sh_every=1, growth=Growth(every=3, start=0.1, stop=0.6))


def trainer_on(device: str, source) -> Trainer:
    """Of a run of 8 steps, in which splats are added and a band joins."""
    return Trainer(start(), source, CONFIG, 8, tuning=TUNING, device=device)


@pytest.fixture(scope="module")
def recorded():
    views = record(truth())
    return views.only(list(views.views)[:3])


@pytest.fixture
def gsplat(monkeypatch):
    gsplat_stand_in.install(monkeypatch)


def dense_rows(trainer: Trainer, grads, inputs) -> np.ndarray:
    """A row for each of the trainer's splats."""
    rows = np.zeros((len(trainer.splats), columns.GRAD))
    for block, (part, _, _) in enumerate(inputs.blocks):
        own = slice(block * BLOCK, block * BLOCK + grads.counts[block])
        ids = grads.ids[own]
        assert (np.diff(ids) > 0).all()
        rows[inputs.first_ids[part] + ids] = grads.rows[own]
    return rows


@pytest.mark.usefixtures("gsplat")
def test_gradients_are_those_of_the_cpu_s_kernels(recorded):
    view = recorded.load(recorded.train[1])
    size = (view.camera.height, view.camera.width)
    rng = np.random.default_rng(0)
    slopes = [rng.normal(size=s).astype(np.float32) for s in ((*size, 3), size, size)]
    found = []
    for device in ("cpu", "cuda"):
        trainer = quick(start(), recorded, device=device)
        trainer.step = QUICK.sh_every  # two bands are learnt
        tape = trainer._render(trainer._posed(view.camera), view.camera)
        rows = dense_rows(trainer, tape.backward(*slopes), tape.inputs)
        found.append((tape.rgb, tape.alpha, tape.expected_depth, rows))
    for cpu, cuda in zip(*(images[:3] for images in found), strict=True):
        assert np.quantile(np.abs(cuda - cpu), 0.99) < 1e-4
    cpu, cuda = (rows for *_, rows in found)
    assert len(cpu) > len(truth().background) and np.abs(cpu[-60:]).any()  # the car's, too
    for first, last in ((0, 3), (3, 7), (8, 11), (11, 12), (12, 15)):
        error = np.linalg.norm(cuda[:, first:last] - cpu[:, first:last])
        assert error < 1e-3 * np.linalg.norm(cpu[:, first:last]), (first, error)
    shown = np.abs(cuda).any(1)
    radii = (rows[shown, columns.G_RADIUS] for rows in (cpu, cuda))
    np.testing.assert_allclose(*radii, rtol=1e-4)
    # The stand-in takes the absolute value of the sum, which is at most the sum of those.
    gap = cuda[shown, columns.G_ABS] - cpu[shown, columns.G_ABS]
    assert gap.max() < 1e-3 * cpu[:, columns.G_ABS].max() and cuda[:, columns.G_ABS].any()


@pytest.mark.usefixtures("gsplat")
def test_a_fit_learns_the_same(recorded):
    """Through a round that adds splats, with poses and exposure; and goes on between devices."""
    here, there = (trainer_on(d, recorded) for d in ("cpu", "cuda"))
    for mine, theirs in zip(run(there, 5), run(here, 5), strict=True):
        assert mine.loss == pytest.approx(theirs.loss, rel=2e-2) and mine.key == theirs.key
    resumed = trainer_on("cuda", recorded)
    resumed.load_state(*there.state())
    run(there, 2)
    run(resumed, 2)
    assert_same_state(resumed, there)  # the stand-in adds up in order; the copies are the same
    here.load_state(*there.state())
    assert run(here, 1)[0].step == 8


@pytest.mark.usefixtures("gsplat")
def test_all_that_gsplat_is_given_lies_on_the_gpu(recorded, monkeypatch):
    """The stand-in takes nothing else; steps are those of splats that never left the CPU."""
    here = trainer_on("cuda", recorded)
    expected = run(here, 2)
    with pretended_gpu(monkeypatch):
        there = trainer_on("cuda", recorded)
        found = run(there, 2)
        copies = there._renderer._copies
        assert all(isinstance(copy, AwayTensor) for copy in copies.values())
    assert [r.loss for r in found] == [r.loss for r in expected]
    assert_same_state(there, here)


def test_without_gsplat_a_fit_does_not_begin(recorded, monkeypatch):
    gsplat_stand_in.install(monkeypatch, __version__="0.1")
    with pytest.raises(BackendUnavailable, match=r"gsplat 0\.1 is installed"):
        trainer_on("cuda", recorded)
    with pytest.raises(ValueError, match="device must be one of cpu, cuda; got 'tpu'"):
        trainer_on("tpu", recorded)
