"""A procedural street of any length, made of stretches that are built one after the other.

The caller is `tools/bench/lod.py`.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path

import torch

from adapters.procedural import open_procedural
from adapters.street.layout import FRAME_NS, build_frames, parse_parameters
from adapters.uri import CAMERA_PATH_KEY, add_to_uri
from augment.files.large_scene import save_large_scene
from augment.scene.scene import Gaussians, Scene

# Length of a stretch.
STRETCH_M = 100.0
# Speed of the ego car.
SPEED_MPS = 20.0
# Frames of one stretch.
STRETCH_FRAMES = round(STRETCH_M / SPEED_MPS / (FRAME_NS * 1e-9))
# Ratio of a street's splats to those of the stretch that its cameras drive along.
SPLATS_PER_STRETCH_SPLAT = 1.35


def write_long_street(
    folder: str | Path,
    *,
    stretches: int = 10,
    gaussians: int = 2_000_000,
    seeds: tuple[int, ...] = (3, 4),
) -> None:
    """Write `stretches` of STRETCH_M as a large scene: a drive along all of them, without
    actors.

    Args:
        folder: where the scene is written.
        stretches: number of stretches.
        gaussians: number of Gaussians of a stretch, nearly.
        seeds: seeds of the streets that the stretches are taken from, in turns. As many streets are
            in memory at once.
    """

    @functools.cache
    def street(seed: int) -> Scene:
        return open_procedural(_query(seed, round(SPLATS_PER_STRETCH_SPLAT * gaussians)))

    def pieces() -> Iterator[Gaussians]:
        for number in range(stretches):
            background = street(seeds[number % len(seeds)]).background
            x = background.means[:, 0]
            is_first = number == 0
            is_last = number == stretches - 1  # which have the street's ends
            piece = background.select(((x >= 0) | is_first) & ((x < STRETCH_M) | is_last))
            translation = torch.tensor([number * STRETCH_M, 0.0, 0.0])
            yield dataclasses.replace(piece, means=piece.means + translation)

    scene = street(seeds[0])
    parameters = parse_parameters(_query(seeds[0], gaussians))
    parameters = parameters.model_copy(
        update={"frames": stretches * STRETCH_FRAMES + 1}
    )  # more than a URI may ask
    save_large_scene(
        dataclasses.replace(
            scene,
            name=f"long-street-{round(stretches * STRETCH_M)}m",
            actors=(),
            labels=None,
            # A drive of its own: the street's boxes and LiDAR are not along it.
            source=add_to_uri(scene.source, CAMERA_PATH_KEY, "along"),
            frames=build_frames(parameters),
            made_by={"stretches": stretches, "seeds": list(seeds), "gaussians": gaussians},
        ),
        pieces(),
        folder,
    )


def _query(seed: int, gaussians: int) -> dict[str, str]:
    numbers = {
        "seed": seed,
        "frames": STRETCH_FRAMES + 1,
        "speed_mps": SPEED_MPS,
        "gaussians": gaussians,
    }
    return {name: str(value) for name, value in numbers.items()}
