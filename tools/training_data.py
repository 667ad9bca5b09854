"""The images of the worked example: rendered where they are missing, and read back."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import torch
from torch.utils.data import DataLoader

from adapters.base import open_scene
from augment.dataset import WeatherDataset, collate_frames
from augment.errors import OutputError
from augment.jobs.layout import MANIFEST
from augment.jobs.manifest import OK, read_manifest
from augment.jobs.render_job import RenderJob, SceneLoader, run_job
from augment.semantics import SemanticClass as S
from recipes.files import with_digest
from tools.training_case import CLEAN, TrainingCase

# What is told apart: few enough that a small network sees each of them often.
CLASSES: dict[str, tuple[S, ...]] = {
    "road": (S.ROAD, S.LANE_MARKING),
    "sidewalk": (S.SIDEWALK,),
    "nature": (S.VEGETATION, S.TERRAIN),
    "building": (S.BUILDING, S.BARRIER),
    "pole, sign": (S.POLE, S.SIGN),
    "vehicle": (S.VEHICLE, S.TWO_WHEELER),
    "person": (S.PEDESTRIAN,),
    "sky": (S.SKY,),
}
IGNORED = 255  # pixels of any other class neither teach nor count


@dataclass(frozen=True)
class Generated:
    """Images written now and found, and the seconds it took."""

    written: int
    found: int
    seconds: float


def generate(
    case: TrainingCase,
    folder: Path,
    *,
    scene_loader: SceneLoader = open_scene,
    progress: bool = True,
) -> Generated:
    """Render what is missing of every scene of the case. A scene that lacks nothing is not opened.

    Raises:
        OutputError: an image failed, or the folder holds other variants of these names.
    """
    started = time.perf_counter()
    written = found = 0
    for uri in (*case.train_scenes, *case.test_scenes):
        there = _finished(case, folder, uri)
        if there is not None:
            found += there
            continue
        job = RenderJob(uri, case.recipes_of(uri), folder, range(case.frames), case.cameras)
        result = run_job(job, scene_loader=scene_loader, progress=progress)
        if result.failed:
            raise OutputError(f"{uri}: {result.failed} images failed: {result.failures[0]}")
        written, found = written + result.written, found + result.skipped
    return Generated(written, found, time.perf_counter() - started)


def _finished(case: TrainingCase, folder: Path, uri: str) -> int | None:
    """How many images of a scene there are, if every one is there; else None."""
    if not (folder / MANIFEST).is_file():
        return None
    recipes = case.recipes_of(uri)
    hashes = [with_digest(recipe).hash for recipe in recipes]
    wanted = (
        (pc.field("source") == uri)
        & (pc.field("status") == OK)
        & pc.field("recipe_hash").isin(hashes)
        & pc.field("camera").isin(list(case.cameras))
        & (pc.field("frame") < case.frames)
    )
    there = read_manifest(folder).filter(wanted).num_rows
    return there if there == len(recipes) * case.frames * len(case.cameras) else None


@dataclass(frozen=True, eq=False)
class Views:
    """Every view (a camera of a frame of a scene) in all its weather.

    images: uint8 [N, 1 + K, 3, H, W], first the clean one, then K variants. labels: uint8
    [N, 1 + K, H, W], indices into CLASSES or IGNORED. Labels do not change with the weather but
    under water, where refraction moves what is seen. names: scene, frame and camera of each view.
    variants: of each, the names of its 1 + K.
    """

    images: torch.Tensor
    labels: torch.Tensor
    names: tuple[tuple[str, int, str], ...]
    variants: tuple[tuple[str, ...], ...]

    def __len__(self) -> int:
        return len(self.names)


def read_views(folder: Path, uris: tuple[str, ...]) -> Views:
    """All views of some scenes, in memory: a few hundred small images.

    Raises:
        OutputError: there is none, a view lacks its clean image, or views have different numbers
            of variants.
    """
    of_scenes = pc.field("source").isin(list(uris))
    dataset = WeatherDataset(
        folder, where=of_scenes, load=("image", "semantic"), image_type="uint8"
    )
    by_view: dict[tuple[str, int, str], dict[str, tuple]] = defaultdict(dict)
    for batch in DataLoader(dataset, batch_size=32, collate_fn=collate_frames):
        for view, variant, image, semantic in _unbatched(batch):
            by_view[view][variant] = (image, semantic)
    names = tuple(sorted(by_view))
    if not names:
        raise OutputError(f"{folder} has no finished image of {', '.join(uris)}")
    clean = f"{CLEAN}-000"
    if lacking := [view for view in names if clean not in by_view[view]]:
        raise OutputError(f"{folder}: {lacking[0]} has no image of {clean}")
    variants = tuple((clean, *sorted(set(by_view[view]) - {clean})) for view in names)
    if len({len(each) for each in variants}) != 1:
        raise OutputError(f"{folder}: views differ in their number of variants")

    def stacked(part: int) -> torch.Tensor:
        return torch.stack(
            [
                torch.stack([by_view[view][variant][part] for variant in own])
                for view, own in zip(names, variants, strict=True)
            ]
        )

    return Views(stacked(0), grouped(stacked(1)), names, variants)


def _unbatched(batch: dict) -> list[tuple]:
    views = zip(batch["scene"], batch["frame"].tolist(), batch["camera"]["name"], strict=True)
    return list(zip(views, batch["variant"], batch["image"], batch["semantic"], strict=True))


def grouped(semantic: torch.Tensor) -> torch.Tensor:
    """Indices into CLASSES of numbers of SemanticClass, uint8, IGNORED for all others."""
    lookup = np.full(256, IGNORED, np.uint8)
    for index, members in enumerate(CLASSES.values()):
        lookup[[int(member) for member in members]] = index
    return torch.from_numpy(lookup)[semantic.long()]
