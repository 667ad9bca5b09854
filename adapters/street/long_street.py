"""A procedural street as long as one likes, out of stretches that are made one after the other."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path

import torch

from adapters.procedural import open_procedural
from adapters.street.layout import FRAME_NS, build_frames, parse_parameters
from adapters.uri import CAMERA_PATH_KEY, add_to_uri
from augment.files.level_file import save_large_scene
from augment.scene import Gaussians, Scene

STRETCH_M, SPEED_MPS = 100.0, 20.0
FRAMES = round(STRETCH_M / SPEED_MPS / (FRAME_NS * 1e-9))  # of one stretch
BESIDE = 1.35  # splats of a street over those of the stretch that its cameras drive along


def write_long_street(
    folder: str | Path,
    *,
    stretches: int = 10,
    gaussians: int = 2_000_000,
    seeds: tuple[int, ...] = (3, 4),
) -> None:
    """Write `stretches` of STRETCH_M as a large scene: a drive along all of them, without actors.

    gaussians: how many a stretch has, nearly. seeds: of the streets that the stretches are taken
    from, in turns; as many are in memory at once.
    """

    @functools.cache
    def street(seed: int) -> Scene:
        return open_procedural(_query(seed, round(BESIDE * gaussians)))

    def pieces() -> Iterator[Gaussians]:
        for number in range(stretches):
            own = street(seeds[number % len(seeds)]).background
            x = own.means[:, 0]
            first, last = number == 0, number == stretches - 1  # which have the street's ends
            piece = own.select(((x >= 0) | first) & ((x < STRETCH_M) | last))
            along = torch.tensor([number * STRETCH_M, 0.0, 0.0])
            yield dataclasses.replace(piece, means=piece.means + along)

    scene = street(seeds[0])
    whole = parse_parameters(_query(seeds[0], gaussians))
    whole = whole.model_copy(update={"frames": stretches * FRAMES + 1})  # more than a URI may ask
    save_large_scene(
        dataclasses.replace(
            scene,
            name=f"long-street-{round(stretches * STRETCH_M)}m",
            actors=(),
            labels=None,
            # A drive of its own: the street's boxes and LiDAR are not along it.
            source=add_to_uri(scene.source, CAMERA_PATH_KEY, "along"),
            frames=build_frames(whole),
            made_by={"stretches": stretches, "seeds": list(seeds), "gaussians": gaussians},
        ),
        pieces(),
        folder,
    )


def _query(seed: int, gaussians: int) -> dict[str, str]:
    numbers = {"seed": seed, "frames": FRAMES + 1, "speed_mps": SPEED_MPS, "gaussians": gaussians}
    return {name: str(value) for name, value in numbers.items()}
