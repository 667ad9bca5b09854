"""Settings chosen from tables of errors and times."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from augment.cameras import Frame
from augment.jobs.quality import Cost, calibration_views, useful, within_budget, within_flip

OPTIONS = {"a": (1, 2, 3), "b": ("fast", "slow"), "c": (0.5, 1.0)}


class Table:
    """Errors and times of single values; together they add up, times `synergy`. Notes questions."""

    def __init__(self, flips, ms=None, synergy: float = 1.0) -> None:
        self.flips, self.saved, self.synergy = flips, ms or {}, synergy
        self.asked: list[dict] = []

    def own(self, path, value) -> float:
        return self.flips.get((path, value), 0.0)

    def flip(self, settings) -> float:
        return self.synergy * sum(self.own(*item) for item in settings.items())

    def ms(self, settings) -> float:
        self.asked.append(settings)
        return 100.0 - sum(self.saved.get(item, 0) for item in settings.items())

    def costs(self):
        return {
            path: [
                Cost(v, 100.0 - self.saved.get((path, v), 0), self.own(path, v)) for v in values
            ]
            for path, values in OPTIONS.items()
        }  # fmt: skip


def flip_choice(table: Table, bound: float) -> dict:
    def exceeds(settings) -> bool:
        table.asked.append(settings)
        return table.flip(settings) > bound

    return within_flip(OPTIONS, bound, table.own, exceeds)


def test_each_knob_takes_its_fastest_value_within_the_bound() -> None:
    table = Table({("a", 1): 0.05, ("a", 2): 0.01, ("b", "fast"): 0.3, ("c", 0.5): 0.02})
    assert flip_choice(table, 0.04) == {"a": 2, "b": "slow", "c": 0.5}


def test_the_first_knobs_have_first_call_on_the_error() -> None:
    table = Table({("a", 1): 0.03, ("a", 2): 0.02, ("b", "fast"): 0.025, ("c", 0.5): 0.01})
    assert flip_choice(table, 0.04) == {"a": 1, "b": "slow", "c": 0.5}
    assert table.asked == [
        {"a": 1, "b": "slow", "c": 1.0},
        {"a": 1, "b": "fast", "c": 1.0},
        {"a": 1, "b": "slow", "c": 0.5},
    ]


def test_errors_that_only_appear_together_lead_to_reference() -> None:
    table = Table({("a", 1): 0.01, ("a", 2): 0.01, ("b", "fast"): 0.01}, synergy=100)
    assert flip_choice(table, 0.04) == {"a": 3, "b": "slow", "c": 0.5}  # c has none of its own
    table = Table(dict.fromkeys([("a", 1), ("a", 2), ("b", "fast"), ("c", 0.5)], 0.01), synergy=9)
    assert flip_choice(table, 0.04) == {"a": 3, "b": "slow", "c": 1.0}
    assert {"a": 3, "b": "slow", "c": 1.0} not in table.asked  # its error is 0 by definition


FLIPS = st.fixed_dictionaries(
    {(p, v): st.floats(0, 0.2) for p, values in OPTIONS.items() for v in values[:-1]}
)


@given(FLIPS, st.floats(0.1, 4), st.floats(0.001, 0.3))
def test_what_is_chosen_is_always_within_the_bound(flips, synergy: float, bound: float) -> None:
    table = Table(flips, synergy=synergy)
    chosen = flip_choice(table, bound)
    assert table.flip(chosen) <= bound
    assert flip_choice(table, bound) == chosen


def test_the_step_that_saves_most_for_its_error_comes_first() -> None:
    table = Table(
        {("a", 1): 0.2, ("a", 2): 0.05, ("b", "fast"): 0.01, ("c", 0.5): 0.1},
        {("a", 1): 40, ("a", 2): 15, ("b", "fast"): 10, ("c", 0.5): 50},
    )  # per ms and error: b 1000, c 500, a to 2 300, a to 1 200
    chosen = [
        within_budget(OPTIONS, ms, table.costs(), table.ms) for ms in (100.0, 95.0, 45.0, 30.0, 0.1)
    ]
    assert [(c.settings["a"], c.settings["b"], c.settings["c"]) for c in chosen] == [
        (3, "slow", 1.0), (3, "fast", 1.0), (3, "fast", 0.5), (2, "fast", 0.5), (1, "fast", 0.5),
    ]  # fmt: skip
    assert [c.is_met for c in chosen] == [True, True, True, True, True]
    assert chosen[-1].ms == 0


def test_what_the_budget_leaves_room_for_is_given_back() -> None:
    """Two steps whose sum is more than was needed: the first is undone where the second does."""
    table = Table(
        {("a", 2): 0.01, ("b", "fast"): 0.05, ("c", 0.5): 0.2},
        {("a", 2): 10, ("b", "fast"): 12, ("c", 0.5): 45},
    )
    chosen = within_budget(OPTIONS, 60.0, table.costs(), table.ms)
    assert (chosen.settings, chosen.ms) == ({"a": 3, "b": "slow", "c": 0.5}, 55)


def test_a_budget_beyond_reach_gets_the_fastest_and_is_not_met() -> None:
    table = Table({("c", 0.5): 0.1}, {("c", 0.5): 50})
    chosen = within_budget(OPTIONS, 20.0, table.costs(), table.ms)
    assert (chosen.settings, chosen.ms, chosen.is_met) == (
        {"a": 3, "b": "slow", "c": 0.5},
        50,
        False,
    )


def test_a_step_without_error_comes_before_all_others_and_the_larger_first() -> None:
    table = Table({("c", 0.5): 1e-9}, {("a", 2): 5, ("b", "fast"): 8, ("c", 0.5): 50})
    assert within_budget(OPTIONS, 95.0, table.costs(), table.ms).settings["b"] == "fast"


def test_values_that_save_nothing_are_left_out() -> None:
    reference = Cost("exact", 100.0, 0.0)
    noise, slower = Cost("noise", 99.0, 0.01), Cost("slower", 120.0, 0.02)
    good, worse, equal = (
        Cost("good", 80.0, 0.03),
        Cost("worse", 85.0, 0.05),
        Cost("equal", 90.0, 0.03),
    )
    fastest = Cost("fastest", 50.0, 0.2)
    assert useful([fastest, worse, equal, good, slower, noise, reference]) == [
        reference,
        good,
        fastest,
    ]
    free = Cost("free", 80.0, 0.0)  # as accurate as reference, and faster
    assert useful([free, reference]) == [reference, free]


def frames(count: int, cameras: int) -> list[Frame]:
    from scenes import camera_ahead

    camera = camera_ahead()
    held = {f"c{number}": camera for number in range(cameras)}
    eye = torch.eye(4, dtype=torch.float64)
    return [Frame(index, index, eye, dict(held)) for index in range(count)]


def picked(views) -> list[tuple[int, str]]:
    return [(view.frame, view.name) for view in views]


def test_views_are_spread_over_frames_and_cameras() -> None:
    assert picked(calibration_views(frames(6, 6))) == [(1, "c0"), (3, "c2"), (5, "c4")]
    assert picked(calibration_views(frames(1, 2))) == [(0, "c0"), (0, "c1")]
    assert picked(calibration_views(frames(1, 1))) == [(0, "c0")]
    assert picked(calibration_views(frames(100, 1), 2)) == [(25, "c0"), (75, "c0")]
    assert picked(calibration_views(frames(6, 6)[::-1])) == picked(calibration_views(frames(6, 6)))


def test_views_need_a_camera() -> None:
    with pytest.raises(ValueError, match="none of the 2 frames"):
        calibration_views(frames(2, 0))
    assert len(calibration_views(frames(2, 1), 5)) == 2  # no image twice
