"""Records of light sources."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from augment.lamps.lamp import AMBER, GREEN, MAX_LAMPS, RED, LampKind, Lamps, color_of_temperature
from augment.lamps.lamp_types import DIPPED, STOP, TAIL, make_lamps
from augment.lamps.patterns import standard_tables
from augment.light.srgb import LUMINANCE_WEIGHTS


def some_lamps(count: int = 3) -> Lamps:
    positions = np.arange(3.0 * count).reshape(count, 3)
    return make_lamps(positions, np.tile([1.0, 0.0, 0.0], (count, 1)), TAIL)


REFUSALS = (
    ("intensities_cd", np.array([1.0, -2.0, 1.0]), r"intensities_cd must be >= 0; got -2.0 in row"),
    ("intensities_cd", np.array([1.0, np.nan, 1.0]), r"intensities_cd must be finite; row 1"),
    ("intensities_cd", np.zeros(2), r"\[3\] with M=3"),
    ("positions_m", np.full((3, 3), np.inf), "positions_m must be finite"),
    ("radii_m", np.zeros(3), r"radii_m must be > 0; got 0.0 in row 0"),
    ("spreads_deg", np.zeros(3), "spreads_deg must be > 0"),
    ("patterns", np.array([0, 1, 99]), r"rows of tables, 0 to 9; got 99 in row 2"),
    ("axes", np.ones((3, 3)), "unit vectors at right angles"),
    ("kinds", np.zeros(3), "kinds must be int64"),
)


@pytest.mark.parametrize(("name", "value", "message"), REFUSALS)
def test_lamps_refuse_columns_that_are_not_of_lamps(name, value, message):
    # With shape annotations checked, some of these are refused by their type.
    with pytest.raises((ValueError, TypeError)) as error:
        dataclasses.replace(some_lamps(), **{name: value})
    if isinstance(error.value, ValueError):
        error.match(message)


def test_more_lamps_than_the_limit_are_refused_with_the_limit():
    with pytest.raises(ValueError, match=f"at most {MAX_LAMPS} lamps"):
        some_lamps(MAX_LAMPS + 1)


def test_joined_lamps_share_standard_tables_and_keep_other_tables_apart():
    lamps = some_lamps()
    own_table = dataclasses.replace(
        lamps, tables=np.ones((1, 5, 5), np.float32), patterns=np.zeros(3, np.int64)
    )
    assert Lamps.concatenate([lamps, some_lamps(1)]).tables is standard_tables()
    assert len(Lamps.concatenate([])) == len(Lamps.concatenate([Lamps.none()])) == 0
    with pytest.raises(ValueError, match="one size"):
        Lamps.concatenate([lamps, own_table])
    wide = dataclasses.replace(own_table, tables=standard_tables()[:1] * np.float32(0.5))
    joined = Lamps.concatenate([lamps, wide])
    assert len(joined) == 6 and len(joined.tables) == len(standard_tables()) + 1
    assert joined.patterns[3:].tolist() == [len(standard_tables())] * 3


def test_selected_lamps_keep_their_order():
    lamps = some_lamps(4)
    chosen = lamps.select(np.array([2, 0]))
    np.testing.assert_array_equal(chosen.positions_m, lamps.positions_m[[2, 0]])
    assert len(lamps.select(lamps.positions_m[:, 0] > 100)) == 0


def test_colours_have_luminance_1_and_warm_lamps_are_redder():
    colors = [color_of_temperature(k) for k in (1700.0, 2000.0, 2900.0, 4300.0, 6500.0, 25_000.0)]
    for color in (*colors, RED, AMBER, GREEN):
        assert color.min() >= 0
        assert color @ LUMINANCE_WEIGHTS == pytest.approx(1.0)
    warmth = [color[0] / max(color[2], 1e-6) for color in colors]
    assert warmth == sorted(warmth, reverse=True)
    # sRGB's white is 6,504 K of daylight, a little greener than a black body of 6,500 K.
    np.testing.assert_allclose(color_of_temperature(6500.0), 1.0, atol=0.06)
    with pytest.raises(ValueError, match="1667 to 25000; got 900"):
        color_of_temperature(900.0)


def test_made_lamps_have_axes_at_right_angles_and_the_flux_of_their_pattern():
    axes = np.array([[1.0, 1.0, 0.3], [0.0, -2.0, 0.0]])
    lamps = make_lamps(np.zeros((2, 3)), axes, DIPPED, factors=np.array([1.0, 0.5]), owner=7)
    np.testing.assert_allclose(np.linalg.norm(lamps.axes, axis=1), 1)
    assert lamps.ups[0, 2] > 0.9 and lamps.owners.tolist() == [7, 7]
    assert lamps.kinds.tolist() == [LampKind.DIPPED] * 2
    # Of 14,000 cd a dipped beam spreads 59 cd on average: 750 lm, as real ones do (600 to 1,000).
    flux_lm = 4 * np.pi * lamps.mean_intensities_cd
    assert 600 < flux_lm[0] < 1000 and flux_lm[1] == pytest.approx(flux_lm[0] / 2)
    assert 8 < lamps.spreads_deg[0] < 20
    assert make_lamps(np.zeros((1, 3)), axes[:1], STOP).spreads_deg[0] == 90
