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

# First factor of SplitMix64 (Steele, Lea and Flood 2014, "Fast Splittable Pseudorandom Number
# Generators").
MIX_A = 0xBF58476D1CE4E5B9
# Second factor of SplitMix64.
MIX_B = 0x94D049BB133111EB
# Odd factor of the first number that is mixed.
STEP_X = 0x9E3779B97F4A7C15
# Odd factor of the second number that is mixed, far from STEP_X in all its bits.
STEP_Y = 0xC2B2AE3D27D4EB4F
# Name of the scheme in every key: a change of the scheme changes this, never silently a number.
_DOMAIN = "climategs effect 1"


def rng_for(
    *,
    seed: SupportsIndex,
    scene: str,
    effect: str,
    frame: SupportsIndex | None = None,
    camera: str | None = None,
) -> np.random.Generator:
    """Return a generator for one effect, keyed by a SHA-256 of the arguments.

    Leave out `frame` where the result must persist over time, and `camera` where all views must
    agree: None is a key of its own.

    Args:
        seed: the recipe's seed, >= 0.
        scene: name of the scene.
        effect: name of the use, "snow.flakes" for example; two uses of one key draw the same
            numbers.
        frame: index of the frame.
        camera: name of the camera.

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
    """Return uint64 of which every bit depends on every bit of the argument.

    `augment.render.cpu.hash_kernels.mix` is the same in kernels.
    """
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(MIX_A)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(MIX_B)
    return bits ^ (bits >> np.uint64(31))
