"""`climategs mirror` and `render --layout source`: images in copies of their dataset."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from adapters.base import open_scene
from adapters.detect_format import source_tree
from adapters.uri import parse_uri
from augment.errors import AdapterError, OutputError
from augment.jobs.mirror import (
    MIRROR_FOLDER,
    DatasetFolder,
    FileCounts,
    Links,
    Replacement,
    ReplacementRecord,
    check_disjoint,
    dataset_format,
    is_weathered,
    mirror_dataset,
    mirror_folder,
    read_record,
    survey,
    weathered_images,
    weathered_sweeps,
)
from augment.jobs.mirror_sweeps import find_span_frames, is_sweep_between, weather_sweeps_between
from augment.jobs.processes import OutputLock
from augment.output.calibration import RECORDED
from augment.output.layout import variant_folder, variant_name
from augment.output.manifest import OK, read_manifest, select_variant_rows
from augment.output.names import MANIFEST_FILE, folder_name
from augment.scene.labels import StoresLidar
from augment.scene.scene import Scene
from recipes.load import load_recipe
from recipes.schema import Recipe
from tools.output import fill, print_note


def recipes_for_source(
    scene: Scene, out: Path, recipes: Sequence[Recipe], *, overwrite: bool = False
) -> list[Recipe]:
    """Return the recipes with images in the dataset's format, or in PNG where their size differs.

    It first checks that the dataset can be copied, and that images of an earlier run can go on or
    may be overwritten.

    Raises:
        AdapterError: the scene is of no dataset, or one that cannot be copied.
        OutputError: the output folder lies in it, or holds these images in another format.
    """
    tree, _ = _dataset(scene)
    recorded_as = dataset_format(scene.frames)
    rendered = []
    for recipe in recipes:
        # What is resized afterwards is compressed once, then.
        written_as = recorded_as if recipe.render.scale == 1 else "png"
        for folder in (variant_folder(scene.name, variant_name(recipe)), MIRROR_FOLDER):
            check_disjoint(tree, out / folder)
        read_record(tree, mirror_folder(out, variant_name(recipe)))
        if not overwrite:
            _check_format(scene, out, recipe, written_as)
        output = recipe.output.model_copy(update={"image": written_as})
        rendered.append(recipe.model_copy(update={"output": output}))
    return rendered


def clear_notes(
    scene: Scene,
    frames: Collection[int] | None = None,
    cameras: Collection[str] | None = None,
    *,
    of_sweeps: bool,
) -> list[str]:
    """Return sentences, before a job starts, about images and sweeps that stay clear in the copies.

    Args:
        frames: numbers that will be rendered; None for all.
        cameras: names that will be rendered; None for all.
        of_sweeps: True if there are sweeps to be weathered.
    """
    tree, extent = _dataset(scene)
    cameras_by_frame = {
        frame.index: [name for name in frame.cameras if cameras is None or name in cameras]
        for frame in scene.frames
        if frames is None or frame.index in frames
    }
    images = {
        tree.place_of(path): name in cameras_by_frame.get(frame.index, ())
        for frame in scene.frames
        for name, path in frame.image_paths.items()
    }
    notes = _clear_note("camera images", extent.images, images, scene.name)
    scheme, _, query = parse_uri(tree.uri)
    if notes and scheme == "av2" and query.get("images") != "all":
        notes[0] += "; images=all in its URI takes those between its sweeps"
    if not of_sweeps:
        return notes
    if not isinstance(scene.labels, StoresLidar):
        return [*notes, "no LiDAR sweep has a file of its own in the dataset: they stay clear"]
    rendered_frames = {number for number, names in cameras_by_frame.items() if names}
    span = find_span_frames(
        scene.frames, rendered_frames, {n for names in cameras_by_frame.values() for n in names}
    )
    sweeps = {
        tree.place_of(file): frame.index in span
        for frame in scene.frames
        for file in scene.labels.lidar_files(frame.index)[:1]
    }
    return notes + _clear_note("LiDAR sweeps", extent.sweeps, sweeps, scene.name)


def _clear_note(kind: str, total: int, places: Mapping[str | None, bool], scene: str) -> list[str]:
    """Return a note on files that stay clear. places: files of the scene, and True if weathered."""
    num_left_out = list(places.values()).count(False)
    num_others = total - len(places)
    reasons = [f"{num_left_out} of frames or cameras that are not rendered"] if num_left_out else []
    if num_others > 0:
        reasons.append(
            f"{num_others} that no frame of scene {scene!r} has (taken outside its frames, or of "
            f"other scenes)"
        )
    if not reasons:
        return []
    num_clear = num_left_out + max(num_others, 0)
    return [
        f"{num_clear} of {total} {kind} will stay clear in the dataset's copy: {', '.join(reasons)}"
    ]


def mirror_outputs(
    scene: Scene,
    out: Path,
    *,
    variants: Sequence[str] | None = None,
    links: Links = "hard",
    progress: bool = True,
) -> list[str]:
    """Build the copies of the dataset in the weather of each variant, or bring them up to date:
    `out/source/<variant>/<the dataset's folder>`.

    scene: the one the images were rendered from. variants: names, or None for all of the scene's
    that the manifest has. Images that a copy has from other scenes of the dataset stay in it.
    Returns sentences: for each variant where its copy is and what it is made of.

    Raises:
        AdapterError: the scene is of no dataset, or one that cannot be copied.
        OutputError: no such images, a folder that is in use or cannot be written.
    """
    out = out.absolute()
    tree, extent = _dataset(scene)
    lines = []
    with OutputLock(out):
        rows_by_variant = _rows(scene, out, variants)
        deleted_variants = [
            name for name in rows_by_variant if not _recipe_file(scene, out, name).is_file()
        ]
        if variants is not None or len(deleted_variants) == len(rows_by_variant):
            _check_there(scene, out, deleted_variants)
        for name in deleted_variants:
            rows_by_variant.pop(name)
            lines.append(
                f"{_recipe_file(scene, out, name).parent} was deleted, so its copy of the dataset "
                f"is not brought up to date; render it again, or delete {mirror_folder(out, name)}"
            )
        try:
            for name, rows in rows_by_variant.items():
                lines += _mirror_rows(scene, out, tree, extent, name, rows, links, progress)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                "stopped while the dataset was being copied; run the same command again to go on "
                "from there"
            ) from None
    return lines


def mirror_again(out: Path, scene_uri: str | None = None, *, links: Links = "hard") -> int:
    """Run `climategs mirror`. Return the exit code.

    It opens the scene, or one after the other all scenes of the manifest, builds the copies and
    prints what it did.
    """
    columns = ["source", "scene", "frame", "camera", "lidar"]
    rows = read_manifest(out).select(columns).to_pylist()
    names_by_source: dict[str, list[str]] = {}  # a job can give scenes other names
    for source, name in sorted({(row["source"], row["scene"]) for row in rows}):
        names_by_source.setdefault(source, []).append(name)
    rows_by_scene: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        rows_by_scene.setdefault(row["scene"], []).append(row)
    sources = [scene_uri] if scene_uri else sorted(names_by_source)
    if not sources:
        raise OutputError(f"{out / MANIFEST_FILE} lists no images; render some first")
    for source in sources:
        scene = open_scene(source)
        for name in names_by_source.get(scene.source, [scene.name]):
            named_scene = dataclasses.replace(scene, name=name)
            scene_rows = rows_by_scene.get(name, [])
            if scene_rows:
                frames, cameras = ({row[key] for row in scene_rows} for key in ("frame", "camera"))
                of_sweeps = any(row["lidar"] == "weather" for row in scene_rows)
                for note in clear_notes(named_scene, frames, cameras, of_sweeps=of_sweeps):
                    print_note(f"note: {note}")
            for sentence in mirror_outputs(named_scene, out, links=links):
                print(sentence)
    return 0


def _dataset(scene: Scene) -> tuple[DatasetFolder, FileCounts]:
    tree = source_tree(scene)
    extent = survey(tree)
    if not extent.images:
        raise AdapterError(
            f"{tree.root}, which {tree.uri} names, holds no camera images ({tree.images}); there "
            f"is nothing that weathered images could replace"
        )
    return tree, extent


def _mirror_rows(
    scene: Scene,
    out: Path,
    tree: DatasetFolder,
    extent: FileCounts,
    name: str,
    rows: list[dict[str, Any]],
    links: Links,
    progress: bool,
) -> list[str]:
    folder = mirror_folder(out, name)
    record = read_record(tree, folder)
    recipe = load_recipe(_recipe_file(scene, out, name)).resolve(0)
    sweeps_between = weather_sweeps_between(scene, recipe, rows, out, progress=progress)
    images, notes = weathered_images(out, rows, scene.frames, tree)
    sweeps, sweep_notes = weathered_sweeps(out, [*rows, *sweeps_between.rows], scene.labels, tree)
    if sweeps_between.errors:
        first_frame = min(sweeps_between.errors)
        sweep_notes.append(
            f"{len(sweeps_between.errors)} LiDAR sweeps without an image stay clear, the first of "
            f"frame {first_frame}: {sweeps_between.errors[first_frame]}"
        )
    entries = {**record.replaced, **record.replaced_sweeps}
    of_others = {place: entry for place, entry in entries.items() if entry.scene != scene.name}
    other_files = _of_other_scenes(out, name, of_others)
    if lost_places := sorted(
        p for p in of_others.keys() - other_files.keys() if of_others[p].image
    ):
        sweep_notes.append(
            f"{len(lost_places)} images of other scenes, such as {lost_places[0]}, are no longer "
            f"in {out} or its manifest: the source's own stand there again"
        )
    scenes = {file.record.scene for file in other_files.values()} & record.scenes.keys()
    facts = {key: rows[0][key] for key in ("source", "recipe_hash", "version", "backend")}
    done = mirror_dataset(
        tree,
        folder,
        {**other_files, **images, **sweeps},
        {**{key: record.scenes[key] for key in sorted(scenes)}, scene.name: facts},
        extent=extent,
        links=links,
        progress=progress,
    )
    num_sweeps = sum(tree.is_sweep(place) for place in done.record.replaced_sweeps)
    page = fill("mirror.txt", done=done, record=done.record, sweeps=num_sweeps, root=tree.root)
    return [*page.split("\n"), *(f"  {note}" for note in [*notes, *sweep_notes])]


def _of_other_scenes(
    out: Path, variant: str, entries: Mapping[str, ReplacementRecord]
) -> dict[str, Replacement]:
    """Return the files of other scenes in the copy that the manifest still has, by place."""
    if not entries:
        return {}
    table = select_variant_rows(
        read_manifest(out), {(entry.scene, variant) for entry in entries.values()}
    )
    rows = [row for row in table if row["status"] == OK]
    by_path = {row["lidar_path"]: Replacement.sweep(out, row) for row in rows if is_weathered(row)}
    by_path |= {row["image_path"]: Replacement.image(out, row) for row in rows}
    for entry in entries.values():
        path = entry.sweep
        if path and path not in by_path and is_sweep_between(out, variant, entry.scene, path):
            by_path[path] = Replacement.sweep(out, {"scene": entry.scene, "lidar_path": path})
    files = {place: by_path.get(entry.image or entry.sweep) for place, entry in entries.items()}
    return {
        place: file for place, file in files.items() if file is not None and file.path.is_file()
    }


def _rows(
    scene: Scene, out: Path, variants: Sequence[str] | None
) -> dict[str, list[dict[str, Any]]]:
    """Return the manifest's rows of the scene's variants, by name."""
    table = read_manifest(out)
    pairs = {
        (row["scene"], row["variant"]) for row in table.select(["scene", "variant"]).to_pylist()
    }
    if MIRROR_FOLDER in {folder_name(name) for name, _ in pairs}:
        raise OutputError(
            f"{out} has images of a scene called {MIRROR_FOLDER!r}, and copies of datasets lie in "
            f"{out / MIRROR_FOLDER}: choose another output folder"
        )
    if variants is None:
        variants = sorted({variant for name, variant in pairs if name == scene.name})
    rows_by_variant = {name: select_variant_rows(table, {(scene.name, name)}) for name in variants}
    absent_variants = sorted(name for name, rows in rows_by_variant.items() if not rows)
    if absent_variants or not rows_by_variant:
        raise OutputError(
            f"{out / MANIFEST_FILE} has no images of scene {scene.name!r}"
            + (f" and {', '.join(absent_variants)}" if absent_variants else "")
            + "; render them first, or name another scene"
        )
    for name, rows in rows_by_variant.items():
        _check_rows(scene, out, name, rows)
    return rows_by_variant


def _recipe_file(scene: Scene, out: Path, name: str) -> Path:
    return out / variant_folder(scene.name, name) / "recipe.yaml"


def _check_there(scene: Scene, out: Path, deleted: Sequence[str]) -> None:
    if deleted:
        raise OutputError(
            f"{_recipe_file(scene, out, deleted[0])} was deleted, though {out / MANIFEST_FILE} "
            f"lists images of {deleted[0]}; render it again"
        )


def _check_rows(scene: Scene, out: Path, name: str, rows: list[dict[str, Any]]) -> None:
    variant_dir = out / variant_folder(scene.name, name)
    source = rows[0]["source"]
    if rows[0]["trajectory"] != RECORDED:
        raise OutputError(
            f"{variant_dir} shows a camera path; a dataset's copy takes images of its own frames"
        )
    if source != scene.source and not (
        parse_uri(source)[::2] == parse_uri(scene.source)[::2] and _has_all(scene, rows)
    ):
        raise OutputError(
            f"{variant_dir} was rendered from {source}, not from {scene.source}; name that scene, "
            f"or the same one where it is now"
        )


def _has_all(scene: Scene, rows: list[dict[str, Any]]) -> bool:
    """True if the scene has an image of the same time for every row."""
    times = {
        (frame.index, name): camera.timestamp_ns
        for frame in scene.frames
        for name, camera in frame.cameras.items()
    }
    return all(times.get((row["frame"], row["camera"])) == row["timestamp_ns"] for row in rows)


def _check_format(scene: Scene, out: Path, recipe: Recipe, written_as: str) -> None:
    """Check that the output has no images of the same recipe in another format."""
    if not (out / MANIFEST_FILE).is_file() or recipe.output.image == written_as:
        return
    rows = select_variant_rows(read_manifest(out), {(scene.name, variant_name(recipe))})
    if rows and rows[0]["recipe_hash"] == recipe.hash:
        folder = out / variant_folder(scene.name, variant_name(recipe))
        raise OutputError(
            f"{folder} holds these images as {recipe.output.image}, and they would be rendered as "
            f"{written_as} for the dataset's copy: `climategs mirror {out} --scene URI` makes it "
            f"from the images there; or choose another output folder, or add --overwrite"
        )
