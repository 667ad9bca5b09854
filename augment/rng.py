"""Random generators that depend on a key and on nothing else.

Weather must come out the same whatever the number of workers, the order of the frames or the point
at which a job was resumed, so no generator is ever shared or advanced between two uses.
"""

from __future__ import annotations

import hashlib
import json
import operator
from typing import SupportsIndex

import numpy as np

# SplitMix64 (Steele, Lea and Flood 2014, "Fast Splittable Pseudorandom Number Generators"), and odd
# factors, far apart in all their bits, for the numbers that are mixed.
MIX_A, MIX_B = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
STEP_X, STEP_Y = 0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F
_DOMAIN = "climategs effect 1"  # a change of the scheme changes this, never silently a number


def rng_for(
    *,
    seed: SupportsIndex,
    scene: str,
    effect: str,
    frame: SupportsIndex | None = None,
    camera: str | None = None,
) -> np.random.Generator:
    """A generator for one effect, keyed by a SHA-256 of the arguments.

    seed: the recipe's, >= 0. scene: the scene's name. effect: which use this is, "snow.flakes" say;
    two uses of the same key draw the same numbers. frame: index; camera: name. Leave out frame
    where the result must persist over time, camera where all views must agree: None is a key of
    its own.

    Raises:
        ValueError: seed or frame is negative, or effect is empty.
    """
    seed_number = operator.index(seed)
    frame_number = None if frame is None else operator.index(frame)
    if seed_number < 0 or (frame_number is not None and frame_number < 0):
        raise ValueError(f"seed and frame must be >= 0; got seed={seed}, frame={frame}")
    if not effect:
        raise ValueError("effect must name what is drawn; got an empty text")
    key = json.dumps([_DOMAIN, seed_number, scene, frame_number, camera, effect])
    digest = hashlib.sha256(key.encode()).digest()
    entropy = np.random.SeedSequence(int.from_bytes(digest, "big"))
    return np.random.Generator(np.random.PCG64(entropy))


def mix(bits: np.ndarray) -> np.ndarray:
    """uint64 of which every bit hangs on every bit given; `augment.kernels.mix` in kernels."""
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(MIX_A)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(MIX_B)
    return bits ^ (bits >> np.uint64(31))
