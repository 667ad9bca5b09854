"""Intensity of lamps by direction, against the regulations and against plain definitions."""

from __future__ import annotations

import numpy as np
import pytest

from augment.lamps import patterns
from augment.lamps.lamp_types import DAYTIME, HIGH, REAR_FOG, STOP, TAIL
from augment.lamps.pattern_kernels import patterns_of_eight
from augment.lamps.patterns import Pattern, standard_tables
from augment.render.cpu import simd as v8
from augment.render.cpu.jit import serial_kernel
from augment.render.layout import NUM_LANES, Index

# Test points of UN R112 class B, right-hand traffic: name, degrees up, degrees right, least and
# largest candela.
R112_POINTS = (
    ("B50L", 0.57, -3.43, 0, 350),
    ("BR", 1.0, 2.5, 0, 1750),
    ("75R", -0.57, 1.15, 10_100, np.inf),
    ("75L", -0.57, -3.43, 0, 10_600),
    ("50L", -0.86, -3.43, 0, 13_200),
    ("50R", -0.86, 1.72, 10_100, np.inf),
    ("50V", -0.86, 0.0, 5_100, np.inf),
    ("25L", -1.72, -9.0, 1_700, np.inf),
    ("25R", -1.72, 9.0, 1_700, np.inf),
    ("zone III, left", 1.0, -8.0, 0, 625),
    ("zone III, HV", 0.0, 0.0, 0, 625),
)


def candela(pattern: Pattern, up_deg: float, right_deg: float, peak_cd: float) -> float:
    direction = patterns.directions_at(np.array([float(up_deg)]), np.array([float(right_deg)]))
    return peak_cd * float(patterns.pattern_value(standard_tables()[pattern], direction)[0])


@pytest.mark.parametrize(("name", "up", "right", "least", "largest"), R112_POINTS)
def test_dipped_beam_keeps_the_limits_of_r112_in_both_traffics(name, up, right, least, largest):
    peak = patterns.DIPPED_PEAK_CD
    value = candela(Pattern.DIPPED_RIGHT, up, right, peak)
    assert least <= value <= largest, name
    # Mirrored within the float32 of the tables.
    assert candela(Pattern.DIPPED_LEFT, up, -right, peak) == pytest.approx(value, rel=1e-5)


def test_dipped_beam_lights_the_road_as_the_table_of_own_beams_says():
    """E = I h / d³ on level ground: 3.25 lx at 10 m and 0.42 lx at 25 m from 0.65 m."""
    for distance_m, lux in ((10.0, 3.25), (25.0, 0.42)):
        down_deg = np.degrees(np.arctan(0.65 / distance_m))
        intensity_cd = candela(Pattern.DIPPED_RIGHT, -down_deg, 0.0, patterns.DIPPED_PEAK_CD)
        length_m = np.hypot(distance_m, 0.65)
        # 4 %: the packed table rounds the bend at 10 m by 2 %, and the text's own numbers.
        assert intensity_cd * 0.65 / length_m**3 == pytest.approx(lux, rel=0.04)


def test_dipped_edge_is_level_on_the_left_and_rises_by_15_degrees_on_the_right():
    def edge_deg(right_deg: float) -> float:
        up = np.linspace(-2, 2, 4001)
        values = patterns.dipped_beam_cd(up, np.full_like(up, right_deg))
        below = patterns.dipped_beam_cd(np.array([-2.0]), np.array([right_deg]))[0]
        return float(up[values > min(2000.0, 0.5 * below)].max())

    left, far_left, right, farther_right = map(edge_deg, (-2.0, -3.0, 1.5, 3.5))
    assert left == pytest.approx(far_left, abs=0.15)
    # The slope between two places on the right; intensity changes along the edge, hence 2 degrees.
    assert np.degrees(np.arctan2(farther_right - right, 2.0)) == pytest.approx(15.0, abs=2.0)


def test_high_beam_is_as_wide_as_r112_asks():
    peak = HIGH.intensity_cd
    assert candela(Pattern.HIGH_BEAM, 0, 0, peak) >= 40_500
    for side in (-1, 1):
        assert candela(Pattern.HIGH_BEAM, 0, side * 2.58, peak) >= 20_300
        assert candela(Pattern.HIGH_BEAM, 0, side * 5.15, peak) >= 5_100


def test_signal_lamps_keep_the_limits_of_their_regulations():
    assert 4 <= TAIL.intensity_cd <= 17
    assert 60 <= STOP.intensity_cd - TAIL.intensity_cd <= 260
    assert 150 <= REAR_FOG.intensity_cd <= 300
    assert 400 <= DAYTIME.intensity_cd <= 1_200
    for side in (-20, 20):  # R7: 20 % of the least value
        assert candela(Pattern.REAR, 5, side, STOP.intensity_cd) >= 0.2 * 60
    assert candela(Pattern.REAR, 0, 60, TAIL.intensity_cd) >= 0.05
    assert candela(Pattern.REAR, 0, 180, TAIL.intensity_cd) == 0


def test_batwing_sends_1000_lumens_for_1000_and_has_its_peak_at_60_degrees():
    table = patterns.pack_pattern(patterns.batwing_cd_per_klm)
    # 1 %: the spacing of the nodes near the nadir.
    assert 4 * np.pi * patterns.mean_over_directions(table) == pytest.approx(1000, rel=0.01)
    angles = np.arange(0.0, 91.0)
    values = patterns.batwing_cd_per_klm(angles - 90, np.zeros_like(angles))
    assert values[0] == 250 and values[60] == 490 and values[85:].max() == 0


def test_means_over_directions_equal_those_of_known_patterns():
    means = patterns.standard_means()
    assert means[Pattern.ISOTROPIC] == pytest.approx(1.0, rel=1e-6)
    # A cosine lobe has a quarter of its peak on average; 1 % for the nodes at its rim.
    assert means[Pattern.LAMBERT] == pytest.approx(0.25, rel=0.01)
    beam = patterns.pack_pattern(lambda up, right: np.exp(-0.5 * (up**2 + right**2) / 10**2))
    # A Gaussian of s radians: 2 pi s² / 4 pi, in the small angles that it fills.
    assert patterns.mean_over_directions(beam) == pytest.approx(np.radians(10) ** 2 / 2, rel=0.03)
    assert patterns.spread_deg(beam) == pytest.approx(10, rel=0.05)


@serial_kernel
def _look_up(tables, pattern, directions, values):
    """Write a pattern's values in directions [3, N], N a multiple of eight, flat."""
    rows, columns = tables.shape[1:]
    texels = np.empty(NUM_LANES, np.int32)
    count = Index(len(values))
    for i in range(Index(0), count, Index(NUM_LANES)):
        eight = patterns_of_eight(
            tables,
            pattern * rows * columns,
            rows,
            columns,
            v8.load(directions, i),
            v8.load(directions, count + i),
            v8.load(directions, count + count + i),
            texels,
        )
        v8.store(values, i, eight)


def test_kernel_equals_the_plain_definition_in_all_directions():
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(504, 3))
    directions[:6] = np.concatenate([np.eye(3), -np.eye(3)])  # the corners of the folds
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions.astype(np.float32)
    tables = np.require(standard_tables(), np.float32, ["C", "W"])
    for pattern in Pattern:
        values = np.empty(len(directions), np.float32)
        _look_up(tables, int(pattern), directions.T.ravel(), values)
        expected = patterns.pattern_value(tables[pattern], directions)
        # Rounding of float32, times the steepest cell of a table.
        np.testing.assert_allclose(values, expected, atol=2e-5)


def test_packed_tables_equal_their_functions_between_nodes():
    up, right = np.meshgrid(np.linspace(-20, 10, 61), np.linspace(-40, 40, 81), indexing="ij")
    directions = patterns.directions_at(up.ravel(), right.ravel())
    values = patterns.pattern_value(standard_tables()[Pattern.DIPPED_RIGHT], directions)
    expected = patterns.dipped_beam_cd(up.ravel(), right.ravel()) / patterns.DIPPED_PEAK_CD
    error = np.abs(values - expected)
    # The edge falls within a node's width, so single points differ; on average it is 0.2 % of peak.
    assert error.mean() < 0.002 and error.max() < 0.1


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_patterns_refuse_intensities_that_are_negative_or_not_finite(value):
    with pytest.raises(ValueError, match="finite and >= 0"):
        patterns.pack_pattern(lambda up, right: np.full(up.shape, value))
