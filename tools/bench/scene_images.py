"""Images of scenes in several kinds of weather, to learn from: rendered where missing, and read.

In: `SceneImages` of each scene, and an output folder. Out: images in the folder, and samples of
them by view. A view is what one camera sees at one frame.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.compute as pc

from adapters.base import open_scene
from adapters.street.layout import StreetParameters
from augment.dataset import WeatherDataset
from augment.errors import OutputError
from augment.jobs.render_job import RenderJob, SceneLoader, run_job
from augment.output.layout import variant_name
from augment.output.manifest import OK, read_manifest
from augment.output.names import MANIFEST_FILE
from recipes.files import with_digest
from recipes.schema import Recipe


@dataclass(frozen=True)
class SceneImages:
    """Images of the views of one scene in several kinds of weather."""

    uri: str
    """URI of the scene."""
    recipes: Sequence[Recipe]
    """Resolved recipes, the clean one first."""
    frames: Sequence[int]
    """Frame numbers."""
    cameras: tuple[str, ...]
    """Cameras of every frame."""

    def __len__(self) -> int:
        return len(self.recipes) * len(self.frames) * len(self.cameras)

    @property
    def rows(self) -> pc.Expression:
        """Return the condition on a manifest's rows that they are finished images of these."""
        return (
            (pc.field("source") == self.uri)
            & (pc.field("status") == OK)
            & pc.field("recipe_hash").isin([with_digest(recipe).hash for recipe in self.recipes])
            & pc.field("camera").isin([*self.cameras])
            & pc.field("frame").isin([*self.frames])
        )


def street_uris(seeds: Sequence[int], street: StreetParameters) -> tuple[str, ...]:
    """Return URIs of streets through which the car drives fast, so that frames differ.

    Args:
        seeds: The seeds of the streets.
        street: The parameters of all of them, but for speed and LiDAR.
    """
    # No sweep is used.
    changes = {"speed_mps": 20.0, "lidar_columns": 16, "lidar_rings": 2}
    return tuple(street.model_copy(update={**changes, "seed": seed}).uri for seed in seeds)


def render_images(
    scenes: Iterable[SceneImages], folder: Path, scene_loader: SceneLoader = open_scene
) -> int:
    """Render the images that are missing; return their number.

    A scene that lacks no image is not opened.

    Args:
        scenes: The images.
        folder: The output folder.
        scene_loader: Opens a scene from its URI.

    Raises:
        OutputError: An image failed.
    """
    num_rendered = 0
    for images in scenes:
        has_manifest = (folder / MANIFEST_FILE).is_file()
        if has_manifest and read_manifest(folder).filter(images.rows).num_rows == len(images):
            continue
        job = RenderJob(images.uri, images.recipes, folder, images.frames, images.cameras)
        result = run_job(job, scene_loader=scene_loader)
        if result.failed:
            raise OutputError(f"{images.uri}: {result.failed} images failed: {result.failures[0]}")
        num_rendered += result.written
    return num_rendered


def read_samples(images: SceneImages, folder: Path, truth: str) -> list[list[dict[str, Any]]]:
    """Return the samples of each view, by recipe.

    Args:
        images: The images.
        folder: The output folder.
        truth: The part of samples that is read beside the image, such as `boxes`.

    Raises:
        OutputError: An image is missing.
    """
    dataset = WeatherDataset(folder, where=images.rows, load=("image", truth), image_type="uint8")
    samples = {
        (sample["frame"], sample["camera"]["name"], sample["variant"]): sample
        for sample in (dataset[number] for number in range(len(dataset)))
    }
    views = []
    for frame in images.frames:
        for camera in images.cameras:
            keys = [(frame, camera, variant_name(recipe)) for recipe in images.recipes]
            missing_keys = [key for key in keys if key not in samples]
            if missing_keys:
                raise OutputError(f"{folder} lacks an image of {images.uri}: {missing_keys[0]}")
            views.append([samples[key] for key in keys])
    return views


def processor_s() -> float:
    """Return the processor time of this process so far, seconds, with that of finished children."""
    return sum(os.times()[:4])
