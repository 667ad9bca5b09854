"""Keyed generators: same key, same numbers; any other key, others."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from augment.rng import rng_for

KEY = {"seed": 7, "scene": "street", "effect": "snow.flakes", "frame": 3, "camera": "front"}


def first(**changes: object) -> float:
    return float(rng_for(**{**KEY, **changes}).random())


def test_the_first_numbers_are_pinned() -> None:
    """Written data depends on them: they are the same in every version, on every platform."""
    assert rng_for(seed=0, scene="s", effect="e").random(3).tolist() == [
        0.45683649455347763,
        0.4501256850477985,
        0.4131717658034758,
    ]
    assert rng_for(**KEY).random(3).tolist() == [
        0.7187658359476665,
        0.8643062832301446,
        0.119411030876862,
    ]
    assert rng_for(**KEY).integers(0, 1000, 5).tolist() == [877, 718, 200, 864, 397]


def test_the_same_key_starts_anew() -> None:
    one, two = rng_for(**KEY), rng_for(**KEY)
    one.random(100)
    assert first() == float(two.random())


def test_every_part_of_the_key_counts() -> None:
    others = [
        {},
        {"seed": 8},
        {"scene": "streets"},
        {"effect": "snow.size"},
        {"frame": 4},
        {"frame": None},
        {"camera": "rear"},
        {"camera": None},
        {"frame": None, "camera": None},
        {"camera": "None"},
        {"scene": 'street", 3, "front'},  # what a key joined with commas would confuse
        {"scene": ""},
    ]
    assert len({first(**other) for other in others}) == len(others)


def test_numpy_integers_are_the_same_key() -> None:
    assert first(seed=np.int64(7), frame=np.int32(3)) == first()


def test_neighbouring_keys_are_independent() -> None:
    frames = np.array([[first(seed=s, frame=f) for f in range(40)] for s in range(25)])
    flat = np.sort(frames.ravel())
    steps = np.arange(1, flat.size + 1) / flat.size
    distance = max((steps - flat).max(), (flat - steps + 1 / flat.size).max())
    assert distance < 1.95 / math.sqrt(flat.size)  # Kolmogorov: one fair sample in a thousand
    pairs = np.corrcoef(frames[:, :-1].ravel(), frames[:, 1:].ravel())[0, 1]
    assert abs(pairs) < 4 / math.sqrt(25 * 39)  # a correlation's four standard deviations


def test_the_global_state_is_not_touched() -> None:
    before = np.random.get_state(legacy=False)["state"]["key"].tobytes()  # noqa: NPY002
    rng_for(**KEY).random(10)
    assert np.random.get_state(legacy=False)["state"]["key"].tobytes() == before  # noqa: NPY002


def test_positional_arguments_are_refused() -> None:
    with pytest.raises(TypeError):
        rng_for(1, "street", "snow")  # type: ignore


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -1}, "seed and frame must be >= 0; got seed=-1, frame=3"),
        ({"frame": -2}, "seed and frame must be >= 0; got seed=7, frame=-2"),
        ({"effect": ""}, "effect must name what is drawn"),
    ],
)
def test_wrong_keys(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rng_for(**{**KEY, **changes})


def test_order_of_use_does_not_matter() -> None:
    keys = list(itertools.product(range(3), ("front", "rear")))
    forwards = {key: first(frame=key[0], camera=key[1]) for key in keys}
    backwards = {key: first(frame=key[0], camera=key[1]) for key in reversed(keys)}
    assert forwards == backwards
