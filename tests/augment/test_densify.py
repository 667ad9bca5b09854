"""Rounds of densification: what they keep, what they count, what they draw."""

from __future__ import annotations

import numpy as np
import pytest

from augment.errors import SceneError
from augment.geometry import rotmat_from_quat
from augment.reconstruct.config import Growth
from augment.reconstruct.splats import GEOMETRY, Splats, densify, densify_due, rebuild, rotate

EXTENT_M = 100.0
PARTS = (30, 0, 12, 8)
PINNED = [11186.756891759826, 1.1397443875275588]


def splats_of(*counts: int, opacity: float | None = None, seed: int = 0) -> Splats:
    """Splats all of whose numbers differ, none of which has a score."""
    rng = np.random.default_rng(seed)
    total = sum(counts)

    def normal(*shape: int) -> np.ndarray:
        return rng.standard_normal((total, *shape), dtype=np.float32)

    quats = normal(4)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    drawn = rng.uniform(0.1, 0.95, total).astype(np.float32)
    sh = normal(4, 3)
    sh[:, 0, 0] = np.arange(total)
    return Splats(
        starts=np.cumsum([0, *counts], dtype=np.int64),
        means=normal(3) * 10,
        quats=quats,
        scales=np.exp(normal(3) - 3),
        opacities=drawn if opacity is None else np.full(total, opacity, np.float32),
        sh=sh,
        semantic=rng.integers(0, 10, total).astype(np.int16),
        geometry_m=normal(GEOMETRY),
        geometry_v=normal(GEOMETRY) ** 2,
        sh_m=normal(4, 3),
        sh_v=normal(4, 3) ** 2,
        age=rng.integers(1, 1000, total).astype(np.int32),
        grads=np.zeros((total, 3), np.float32),
    )


def pulled(splats: Splats, rows: list[int], radius: float) -> Splats:
    """The rows with gradients that rise along the list, seen twice at this size."""
    for rank, row in enumerate(rows):
        splats.grads[row] = (0.01 * (rank + 1), 2, radius)
    return splats


def round_of(splats: Splats, *, max_splats: int = 600_000, **growth) -> Splats:
    """A round, after which all that a step relies on holds; its input is left alone."""
    before = {name: array.copy() for name, array in splats.arrays().items()}
    grown = densify(splats, Growth(**growth), max_splats=max_splats, extent_m=EXTENT_M)
    for name, array in grown.arrays().items():
        original = getattr(splats, name)
        assert np.array_equal(original, before[name], equal_nan=original.dtype.kind == "f"), name
        rows = splats.starts.shape if name == "starts" else (len(grown), *original.shape[1:])
        assert array.shape == rows and array.dtype == original.dtype, name
        assert array.flags.c_contiguous and array.flags.owndata, name
        assert not np.shares_memory(array, original), name
        assert np.isfinite(array).all(), name
    assert grown.starts[0] == 0 and grown.starts[-1] == len(grown)
    assert (np.diff(grown.starts) >= 0).all()
    assert not grown.grads.any()
    return grown


def same(one: Splats, two: Splats) -> bool:
    return all(
        np.array_equal(array, getattr(two, name))
        for name, array in one.arrays().items()
        if name not in ("starts", "grads")
    )


def origins(splats: Splats, before: Splats) -> np.ndarray:
    """The row of `before` each splat descends from: colours are inherited, and red is the row."""
    rows = splats.sh[:, 0, 0].astype(int)
    assert np.array_equal(splats.sh, before.sh[rows])
    assert np.array_equal(splats.semantic, before.semantic[rows])
    return rows


def test_rotation_is_the_quaternions_matrix() -> None:
    import torch

    splats = splats_of(20)
    matrices = rotmat_from_quat(torch.from_numpy(splats.quats)).numpy()
    expected = np.einsum("nij,nj->ni", matrices, splats.means)
    # Means reach 30 m; a few roundings of float32 at that size.
    np.testing.assert_allclose(rotate(splats.quats, splats.means), expected, atol=3e-5)


# --- clones and splits ---


def test_small_ones_are_cloned_and_let_through_what_one_did() -> None:
    splats = pulled(splats_of(*PARTS), [3, 35], radius=0.002)
    grown = round_of(splats, fraction=1.0)
    assert grown.starts.tolist() == [0, 31, 31, 44, 52]
    for parent, first in ((3, 3), (35, 36)):
        pair = slice(first, first + 2)
        for name in ("means", "scales", "sh", "semantic"):
            assert (getattr(grown, name)[pair] == getattr(splats, name)[parent]).all(), name
        through = np.prod(1 - grown.opacities[pair])
        # Opacities are float32: 6e-8 each, twice.
        assert through == pytest.approx(1 - splats.opacities[parent], abs=3e-7)
        assert grown.age[first] == splats.age[parent] and grown.age[first + 1] == 0
        assert (grown.geometry_m[first] == splats.geometry_m[parent]).all()
        for name in ("geometry_m", "geometry_v", "sh_m", "sh_v"):
            assert not getattr(grown, name)[first + 1].any()


def test_large_ones_are_split_side_by_side_along_their_longest_axis() -> None:
    splats = pulled(splats_of(*PARTS), [7, 40], radius=0.2)
    splats.scales[[7, 40]] = ((0.1, 0.8, 0.2), (0.8, 0.1, 0.1))
    grown = round_of(splats, fraction=1.0)
    for row, first, axis in ((7, 7, 1), (40, 41, 0)):
        along = rotate(splats.quats[[row]], np.eye(3, dtype=np.float32)[[axis]])[0]
        offset = grown.means[first] - splats.means[row]
        # 0.7806 sigma keeps the covariance along the axis: 0.7806^2 + 1 / 1.6^2 = 1.
        np.testing.assert_allclose(offset, 0.7806 * 0.8 * along, atol=2e-5)
        np.testing.assert_allclose(
            grown.means[first : first + 2].mean(0), splats.means[row], atol=1e-5
        )
        shrink = np.full(3, 1.2)
        shrink[axis] = 1.6
        np.testing.assert_allclose(grown.scales[first], splats.scales[row] / shrink, rtol=1e-6)
        assert (grown.opacities[first : first + 2] == splats.opacities[row]).all()
        assert not grown.age[first : first + 2].any()


def test_the_budget_goes_to_the_best() -> None:
    splats = pulled(splats_of(*PARTS), [40, 1, 33, 20, 9, 45], radius=0.002)
    rows, counts = np.unique(origins(round_of(splats, fraction=0.06), splats), return_counts=True)
    assert rows[counts == 2].tolist() == [9, 20, 45]  # 6 % of 50
    for limit, total in ((53, 53), (50, 50), (10, 50)):
        assert len(round_of(splats, fraction=0.5, max_splats=limit)) == total


# --- removal ---


def test_faint_and_unusable_ones_are_removed() -> None:
    """Rows 0 to 8 unusable, each in its own way, 9 faint; 10 and 11 suspicious but sound."""
    splats = splats_of(*PARTS)
    splats.means[0, 1] = np.nan
    splats.quats[1, 2] = np.inf
    splats.scales[2, 0] = np.nan
    splats.sh[3, 2, 1] = -np.inf
    splats.opacities[4] = np.nan
    splats.scales[5, 1] = 0
    splats.quats[6] = 0
    splats.scales[7] = 1.5 * EXTENT_M
    splats.scales[8, 2] = 0.2 * EXTENT_M
    splats.grads[8, 2] = 0.8
    splats.opacities[9] = 0.01
    splats.scales[10] = 0.2 * EXTENT_M
    splats.grads[11, 2] = 0.9
    grown = round_of(splats)
    assert same(grown, rebuild(splats, np.arange(10, 50)))
    assert grown.starts.tolist() == [0, 20, 20, 32, 40]


def test_a_part_may_become_empty_but_not_the_scene() -> None:
    splats = splats_of(5, 5)
    splats.opacities[:5] = 0.001
    assert round_of(splats).starts.tolist() == [0, 0, 5]
    faint = splats_of(5, 5, opacity=0.001)
    faint.means[0] = np.nan
    assert round_of(faint).starts.tolist() == [0, 4, 9]
    assert len(round_of(splats_of(0, 0))) == 0
    faint.means[:] = np.nan
    with pytest.raises(SceneError, match="none of the 10 splats"):
        round_of(faint)


def test_rounds_are_due_every_so_many_steps_while_splats_are_added() -> None:
    growth = Growth(every=200, start=0.1, stop=0.6)
    due = [step for step in range(0, 2001, 50) if densify_due(growth, step, 2000)]
    assert due == list(range(200, 1201, 200))
    assert not densify_due(Growth(start=0.0), 0, 2000)


def test_a_round_gives_the_same_bits_in_every_version() -> None:
    """Checkpoints are resumed to the same bits."""
    splats = pulled(splats_of(*PARTS), [3, 35, 44], radius=0.2)
    splats.opacities[10:20] = 0.01
    grown = round_of(splats, fraction=0.1)
    assert same(grown, round_of(splats, fraction=0.1))
    sums = [float((a.astype(np.float64) ** 2).sum()) for a in (grown.means, grown.scales)]
    # Float32 values; another processor's multiply-adds may round the last bit otherwise.
    assert sums == pytest.approx(PINNED, rel=1e-6)
