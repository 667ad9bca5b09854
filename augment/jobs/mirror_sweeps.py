"""Weather for the LiDAR sweeps of a copied drive that no image was rendered with.

A LiDAR turns more often than cameras look: nuScenes has 20 sweeps a second and 12 images. A job
weathers the sweeps of its images' frames; the others of the same span get theirs here, into the
same folder, so that clouds of several sweeps show one weather.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from augment.cameras import Frame
from augment.effects import Sharing, share_effects
from augment.effects.lidar.sweep import weathered_sweep
from augment.errors import OutputError
from augment.jobs.atomic import write_atomic
from augment.jobs.layout import STATE_FOLDER, SWEEPS, item_paths, variant_folder
from augment.jobs.manifest import OK
from augment.jobs.tables import lidar_bytes, read_lidar_note
from augment.jobs.worker import describe
from augment.labels import StoresLidar
from augment.scene import Scene
from recipes.schema import Recipe


class SweepsBetween(NamedTuple):
    """Sweeps that were weathered without an image.

    rows: for each, what the manifest's rows say of sweeps. faults: why a sweep stays clear, by
    frame number.
    """

    rows: list[dict[str, Any]]
    faults: dict[int, str]


def frames_of_span(
    frames: Sequence[Frame], rendered: Collection[int], cameras: Collection[str]
) -> list[int]:
    """Numbers of the frames that were rendered, and of those between them.

    A frame without an image of these cameras belongs to the span where the frames with one before
    and after it were rendered; so do such frames at the ends of the drive.

    Args:
        frames: of the scene, in order of time.
        rendered: numbers of the frames of which there are images.
        cameras: that were rendered.
    """
    span: list[int] = []
    waiting: list[int] = []
    is_after_rendered = True
    for frame in frames:
        if frame.cameras.keys().isdisjoint(cameras):
            waiting.append(frame.index)
            continue
        is_rendered = frame.index in rendered
        span += waiting if is_after_rendered and is_rendered else []
        span += [frame.index] if is_rendered else []
        waiting, is_after_rendered = [], is_rendered
    return span + (waiting if is_after_rendered else [])


def weather_sweeps_between(
    scene: Scene,
    recipe: Recipe,
    rows: Sequence[Mapping[str, Any]],
    out_dir: Path,
    *,
    progress: bool = True,
) -> SweepsBetween:
    """Write the weathered sweeps of the span that no finished image has, where they are not there.

    Args:
        scene: that the images were rendered from.
        recipe: of the variant, resolved.
        rows: the variant's rows of the manifest.
        out_dir: the output folder, whose lock the caller holds.
    """
    between = SweepsBetween([], {})
    if recipe.lidar != "weather" or not isinstance(scene.labels, StoresLidar):
        return between
    cameras = {row["camera"] for row in rows}
    span = frames_of_span(scene.frames, {row["frame"] for row in rows}, cameras)
    finished = {row["frame"] for row in rows if row["status"] == OK}
    places = {
        number: str(item_paths(scene.name, recipe, "", number)["lidar"])
        for number in span
        if number not in finished and scene.labels.lidar_files(number)
    }
    missing = [number for number, place in places.items() if not _is_weathered(out_dir / place)]
    if missing:
        folder, backend = out_dir / STATE_FOLDER, rows[0]["backend"]
        share_effects(Sharing(scene, [recipe], folder=folder, backend=backend, progress=progress))
    for number in tqdm(
        missing, desc="LiDAR between images", unit="sweep", disable=not (progress and missing)
    ):
        try:
            sweep = scene.lidar(number)
            if sweep is None:
                raise ValueError("its file cannot be read")
            data = lidar_bytes(weathered_sweep(scene, recipe, number, sweep))
        except Exception as error:  # of one sweep: the others have their weather
            between.faults[number] = describe(error, "no weather on this sweep")
            continue
        write_atomic(out_dir / places[number], data, clear=False)
    for number, place in places.items():
        if number not in between.faults:
            facts = {"scene": scene.name, "frame": number, "status": OK}
            between.rows.append({**facts, "lidar": "weather", "lidar_path": place})
    return between


def is_sweep_between(out_dir: Path, variant: str, scene: str, path: str) -> bool:
    """Return True for the path of a weathered sweep in the folder of a scene's variant, which the
    manifest need not name: it may have no image.
    """
    folder, _, name = path.rpartition("/")
    is_place = folder == f"{variant_folder(scene, variant)}/{SWEEPS}" and name.endswith(".parquet")
    return is_place and _is_weathered(out_dir / path)


def _is_weathered(path: Path) -> bool:
    try:
        return path.is_file() and read_lidar_note(path) is None
    except OutputError:  # a damaged one is written anew
        return False
