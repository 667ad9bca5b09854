"""Weather for the LiDAR sweeps of a copied drive between the sweeps of its rendered images.

In: a scene, a recipe, and the manifest's rows of its images. Out: sweeps in the variant's folder.
Called by `climategs export`.

A LiDAR turns more often than cameras take images: nuScenes has 20 sweeps a second and 12 images. A
job weathers the sweeps of its images' frames. This module weathers the other sweeps of the same
time span, into the same folder, so that point clouds of several sweeps show one weather.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from augment.effects import JobContext, precompute_effects
from augment.errors import OutputError
from augment.jobs.worker import describe_error
from augment.output.atomic import write_atomic
from augment.output.layout import SWEEP_FOLDER, item_paths, variant_folder
from augment.output.manifest import OK
from augment.output.names import STATE_FOLDER
from augment.output.tables import lidar_bytes, read_lidar_note
from augment.scene.cameras import Frame
from augment.scene.labels import StoresLidar
from augment.scene.scene import Scene
from augment.view.weathered_sweep import weathered_sweep
from recipes.schema import Recipe


class SweepResult(NamedTuple):
    """Sweeps that were weathered without an image."""

    rows: list[dict[str, Any]]
    """Entries of the sweeps, as in the manifest's rows."""
    errors: dict[int, str]
    """Reasons why sweeps stay clear, by frame number."""


def find_span_frames(
    frames: Sequence[Frame], rendered_frames: Collection[int], cameras: Collection[str]
) -> list[int]:
    """Return the numbers of the rendered frames and of the frames between them.

    A frame without an image of these cameras belongs to the span where the frames with one before
    and after it were rendered; so do such frames at the ends of the drive.

    Args:
        frames: Frames of the scene, in order of time.
        rendered_frames: Numbers of the frames that have images.
        cameras: Names of the cameras that were rendered.
    """
    span: list[int] = []
    frames_between: list[int] = []
    follows_rendered = True
    for frame in frames:
        if frame.cameras.keys().isdisjoint(cameras):
            frames_between.append(frame.index)
            continue
        is_rendered = frame.index in rendered_frames
        span += frames_between if follows_rendered and is_rendered else []
        span += [frame.index] if is_rendered else []
        frames_between = []
        follows_rendered = is_rendered
    return span + (frames_between if follows_rendered else [])


def weather_sweeps_between(
    scene: Scene,
    recipe: Recipe,
    rows: Sequence[Mapping[str, Any]],
    out_dir: Path,
    *,
    progress: bool = True,
) -> SweepResult:
    """Write the missing weathered sweeps of the span that belong to no finished image.

    Args:
        scene: Scene that the images were rendered from.
        recipe: Resolved recipe of the variant.
        rows: The variant's rows of the manifest.
        out_dir: Output folder, whose lock the caller holds.
    """
    sweeps_between = SweepResult([], {})
    if recipe.lidar != "weather" or not isinstance(scene.labels, StoresLidar):
        return sweeps_between
    cameras = {row["camera"] for row in rows}
    span_frames = find_span_frames(scene.frames, {row["frame"] for row in rows}, cameras)
    finished_frames = {row["frame"] for row in rows if row["status"] == OK}
    path_of_frame = {
        number: str(item_paths(scene.name, recipe, "", number)["lidar"])
        for number in span_frames
        if number not in finished_frames and scene.labels.lidar_files(number)
    }
    missing_frames = [
        number for number, path in path_of_frame.items() if not _is_weathered(out_dir / path)
    ]
    if missing_frames:
        folder = out_dir / STATE_FOLDER
        backend = rows[0]["backend"]
        precompute_effects(
            JobContext(scene, [recipe], folder=folder, backend=backend, progress=progress)
        )
    for number in tqdm(
        missing_frames,
        desc="LiDAR between images",
        unit="sweep",
        disable=not (progress and missing_frames),
    ):
        try:
            sweep = scene.lidar(number)
            if sweep is None:
                raise ValueError("its file cannot be read")
            data = lidar_bytes(weathered_sweep(scene, recipe, number, sweep))
        except Exception as error:  # concerns one sweep: the other ones get their weather
            sweeps_between.errors[number] = describe_error(error, "no weather on this sweep")
            continue
        write_atomic(out_dir / path_of_frame[number], data, clear=False)
    for number, path in path_of_frame.items():
        if number not in sweeps_between.errors:
            facts = {"scene": scene.name, "frame": number, "status": OK}
            sweeps_between.rows.append({**facts, "lidar": "weather", "lidar_path": path})
    return sweeps_between


def is_sweep_between(out_dir: Path, variant: str, scene: str, path: str) -> bool:
    """Return True for the path of a weathered sweep in the folder of a scene's variant.

    The manifest need not name the sweep, because it may have no image.
    """
    folder, _, name = path.rpartition("/")
    is_sweep_path = folder == f"{variant_folder(scene, variant)}/{SWEEP_FOLDER}" and name.endswith(
        ".parquet"
    )
    return is_sweep_path and _is_weathered(out_dir / path)


def _is_weathered(path: Path) -> bool:
    try:
        return path.is_file() and read_lidar_note(path) is None
    except OutputError:  # a damaged file is written again
        return False
