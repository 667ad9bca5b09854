"""`climategs export`: a scene for other programs, or in one file to share; `--layout source` and
`climategs mirror`: a variant as a copy of the dataset it was made from; `climategs labels`: what
trainers read.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.base import open_scene
from adapters.detect_format import source_tree
from adapters.scene_folder import storable
from adapters.uri import parse_uri
from augment.errors import AdapterError, ClimateGSError, OutputError
from augment.files.export import (
    CAMERAS,
    PARTS,
    ExportKind,
    export_cameras,
    export_glb,
    export_losses,
    export_ply,
    export_ply_parts,
    export_sog,
    export_splat,
    export_spz,
    export_usd,
)
from augment.files.scene_file import (
    FILES,
    SCENE_SUFFIX,
    is_scene_folder,
    save_scene,
    save_scene_file,
)
from augment.jobs.files import RECORDED
from augment.jobs.layout import MANIFEST, folder_name, variant_folder, variant_name
from augment.jobs.manifest import OK, read_manifest, rows_of
from augment.jobs.mirror import (
    MIRROR_FOLDER,
    Links,
    Shown,
    SourceTree,
    Survey,
    Weathered,
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
from augment.jobs.mirror_sweeps import frames_of_span, is_sweep_between, weather_sweeps_between
from augment.jobs.processes import OutputLock
from augment.labels import StoresLidar
from augment.scene import Scene
from recipes.load import load_recipe
from recipes.schema import Recipe
from tools.output import fill, print_note

if TYPE_CHECKING:
    from tools.cli import ExportOptions

_SUFFIXES: dict[ExportKind, str] = {
    "file": SCENE_SUFFIX,
    "ply": ".ply",
    "splat": ".splat",
    "spz": ".spz",
    "sog": ".sog",
    "glb": ".glb",
    "usd": ".usdc",
}


def recipes_for_source(
    scene: Scene, out: Path, recipes: Sequence[Recipe], *, overwrite: bool = False
) -> list[Recipe]:
    """The recipes with images in the dataset's format, or PNG where they are of another size, after
    a look at whether the dataset can be copied and images that are there go on or are overwritten.

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
    """Sentences, before anything starts: how many images and sweeps of the dataset will stay clear
    in its copies, and why.

    Args:
        frames: numbers that will be rendered; None for all.
        cameras: names that will be rendered; None for all.
        of_sweeps: whether there are sweeps to be weathered.
    """
    tree, extent = _dataset(scene)
    wanted = {
        frame.index: [name for name in frame.cameras if cameras is None or name in cameras]
        for frame in scene.frames
        if frames is None or frame.index in frames
    }
    images = {
        tree.relative(path): name in wanted.get(frame.index, ())
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
    rendered = {number for number, names in wanted.items() if names}
    span = frames_of_span(scene.frames, rendered, {n for names in wanted.values() for n in names})
    sweeps = {
        tree.relative(file): frame.index in span
        for frame in scene.frames
        for file in scene.labels.lidar_files(frame.index)[:1]
    }
    return notes + _clear_note("LiDAR sweeps", extent.sweeps, sweeps, scene.name)


def _clear_note(what: str, total: int, places: Mapping[str | None, bool], scene: str) -> list[str]:
    """places: files of the scene's, and whether they will be weathered."""
    left_out, others = list(places.values()).count(False), total - len(places)
    reasons = [f"{left_out} of frames or cameras that are not rendered"] if left_out else []
    if others > 0:
        reasons.append(
            f"{others} that no frame of scene {scene!r} has (taken outside its frames, or of other "
            f"scenes)"
        )
    if not reasons:
        return []
    clear = left_out + max(others, 0)
    return [
        f"{clear} of {total} {what} will stay clear in the dataset's copy: {', '.join(reasons)}"
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
        found = _rows(scene, out, variants)
        deleted = [name for name in found if not _recipe_file(scene, out, name).is_file()]
        if variants is not None or len(deleted) == len(found):
            _check_there(scene, out, deleted)
        for name in deleted:
            found.pop(name)
            lines.append(
                f"{_recipe_file(scene, out, name).parent} was deleted, so its copy of the dataset "
                f"is not brought up to date; render it again, or delete {mirror_folder(out, name)}"
            )
        try:
            for name, rows in found.items():
                lines += _mirror_rows(scene, out, tree, extent, name, rows, links, progress)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                "stopped while the dataset was being copied; run the same command again to go on "
                "from there"
            ) from None
    return lines


def mirror_again(out: Path, scene_uri: str | None = None, *, links: Links = "hard") -> int:
    """`climategs mirror`: opens the scene, or all that the manifest has in turn, builds the copies,
    prints. Returns the exit code."""
    columns = ["source", "scene", "frame", "camera", "lidar"]
    rows = read_manifest(out).select(columns).to_pylist()
    named: dict[str, list[str]] = {}  # a job can give scenes other names
    for source, name in sorted({(row["source"], row["scene"]) for row in rows}):
        named.setdefault(source, []).append(name)
    of_scene: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        of_scene.setdefault(row["scene"], []).append(row)
    sources = [scene_uri] if scene_uri else sorted(named)
    if not sources:
        raise OutputError(f"{out / MANIFEST} lists no images; render some first")
    for source in sources:
        scene = open_scene(source)
        for name in named.get(scene.source, [scene.name]):
            named_scene, own = dataclasses.replace(scene, name=name), of_scene.get(name, [])
            if own:
                frames, cameras = ({row[key] for row in own} for key in ("frame", "camera"))
                of_sweeps = any(row["lidar"] == "weather" for row in own)
                for note in clear_notes(named_scene, frames, cameras, of_sweeps=of_sweeps):
                    print_note(f"note: {note}")
            for sentence in mirror_outputs(named_scene, out, links=links):
                print(sentence)
    return 0


def _dataset(scene: Scene) -> tuple[SourceTree, Survey]:
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
    tree: SourceTree,
    extent: Survey,
    name: str,
    rows: list[dict[str, Any]],
    links: Links,
    progress: bool,
) -> list[str]:
    folder = mirror_folder(out, name)
    record = read_record(tree, folder)
    recipe = load_recipe(_recipe_file(scene, out, name)).resolve(0)
    between = weather_sweeps_between(scene, recipe, rows, out, progress=progress)
    images, notes = weathered_images(out, rows, scene.frames, tree)
    sweeps, unplaced = weathered_sweeps(out, [*rows, *between.rows], scene.labels, tree)
    if between.faults:
        first = min(between.faults)
        unplaced.append(
            f"{len(between.faults)} LiDAR sweeps without an image stay clear, the first of frame "
            f"{first}: {between.faults[first]}"
        )
    shown = {**record.replaced, **record.replaced_sweeps}
    of_others = {place: each for place, each in shown.items() if each.scene != scene.name}
    others = _of_other_scenes(out, name, of_others)
    if gone := sorted(p for p in of_others.keys() - others.keys() if of_others[p].image):
        unplaced.append(
            f"{len(gone)} images of other scenes, such as {gone[0]}, are no longer in {out} or its "
            f"manifest: the source's own stand there again"
        )
    scenes = {ours.shown.scene for ours in others.values()} & record.scenes.keys()
    facts = {key: rows[0][key] for key in ("source", "recipe_hash", "version", "backend")}
    done = mirror_dataset(
        tree,
        folder,
        {**others, **images, **sweeps},
        {**{key: record.scenes[key] for key in sorted(scenes)}, scene.name: facts},
        extent=extent,
        links=links,
        progress=progress,
    )
    num_sweeps = sum(tree.is_sweep(place) for place in done.record.replaced_sweeps)
    page = fill("mirror.txt", done=done, record=done.record, sweeps=num_sweeps, root=tree.root)
    return [*page.split("\n"), *(f"  {note}" for note in [*notes, *unplaced])]


def _of_other_scenes(out: Path, variant: str, shown: Mapping[str, Shown]) -> dict[str, Weathered]:
    """What of other scenes stands in the copy, as far as the manifest still has it."""
    if not shown:
        return {}
    table = rows_of(read_manifest(out), {(each.scene, variant) for each in shown.values()})
    rows = [row for row in table if row["status"] == OK]
    by_path = {row["lidar_path"]: Weathered.sweep(out, row) for row in rows if is_weathered(row)}
    by_path |= {row["image_path"]: Weathered.image(out, row) for row in rows}
    for each in shown.values():
        path = each.sweep
        if path and path not in by_path and is_sweep_between(out, variant, each.scene, path):
            by_path[path] = Weathered.sweep(out, {"scene": each.scene, "lidar_path": path})
    found = {place: by_path.get(each.image or each.sweep) for place, each in shown.items()}
    return {
        place: ours for place, ours in found.items() if ours is not None and ours.path.is_file()
    }


def _rows(
    scene: Scene, out: Path, variants: Sequence[str] | None
) -> dict[str, list[dict[str, Any]]]:
    """The manifest's rows of the scene's variants, by name."""
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
    found = {name: rows_of(table, {(scene.name, name)}) for name in variants}
    absent = sorted(name for name, rows in found.items() if not rows)
    if absent or not found:
        raise OutputError(
            f"{out / MANIFEST} has no images of scene {scene.name!r}"
            + (f" and {', '.join(absent)}" if absent else "")
            + "; render them first, or name another scene"
        )
    for name, rows in found.items():
        _check_rows(scene, out, name, rows)
    return found


def _recipe_file(scene: Scene, out: Path, name: str) -> Path:
    return out / variant_folder(scene.name, name) / "recipe.yaml"


def _check_there(scene: Scene, out: Path, deleted: Sequence[str]) -> None:
    if deleted:
        raise OutputError(
            f"{_recipe_file(scene, out, deleted[0])} was deleted, though {out / MANIFEST} lists "
            f"images of {deleted[0]}; render it again"
        )


def _check_rows(scene: Scene, out: Path, name: str, rows: list[dict[str, Any]]) -> None:
    where, source = out / variant_folder(scene.name, name), rows[0]["source"]
    if rows[0]["trajectory"] != RECORDED:
        raise OutputError(
            f"{where} shows a camera path; a dataset's copy takes images of its own frames"
        )
    if source != scene.source and not (
        parse_uri(source)[::2] == parse_uri(scene.source)[::2] and _has_all(scene, rows)
    ):
        raise OutputError(
            f"{where} was rendered from {source}, not from {scene.source}; name that scene, or the "
            f"same one where it is now"
        )


def _has_all(scene: Scene, rows: list[dict[str, Any]]) -> bool:
    """Whether every image of the rows is one of the scene's, by its time."""
    times = {
        (frame.index, name): camera.timestamp_ns
        for frame in scene.frames
        for name, camera in frame.cameras.items()
    }
    return all(times.get((row["frame"], row["camera"])) == row["timestamp_ns"] for row in rows)


def _check_format(scene: Scene, out: Path, recipe: Recipe, written_as: str) -> None:
    """Images of the same recipe in another format are not rendered twice beside each other."""
    if not (out / MANIFEST).is_file() or recipe.output.image == written_as:
        return
    rows = rows_of(read_manifest(out), {(scene.name, variant_name(recipe))})
    if rows and rows[0]["recipe_hash"] == recipe.hash:
        folder = out / variant_folder(scene.name, variant_name(recipe))
        raise OutputError(
            f"{folder} holds these images as {recipe.output.image}, and they would be rendered as "
            f"{written_as} for the dataset's copy: `climategs mirror {out} --scene URI` makes it "
            f"from the images there; or choose another output folder, or add --overwrite"
        )


def label_files(
    out: Path, split: Sequence[str] = (), seed: int = 0, changes: Sequence[str] = ()
) -> list[str]:
    """Writes the labels of an output in its recipes' formats; without a split, seed or change as
    the last time. Returns sentences: what was written, and which labels were not.

    Raises:
        ClimateGSError: the split is none. OutputError: nothing asks for formats.
    """
    from augment.dataset.label_files import WHOLE, LabelsAsked, write_labels

    asked = None
    if split or seed or changes:
        shares = _shares(split) if split else WHOLE
        asked = LabelsAsked(split=shares, seed=seed, changes=tuple(changes))
    try:
        done = write_labels(out, asked)
    except ValueError as error:
        raise ClimateGSError(f"--split {' '.join(split)}: {error}") from error
    counts = [f"{name} {done.objects[name]} in {done.images[name]} images" for name in done.images]
    parts = ", ".join(f"{name} {count}" for name, count in done.parts.items())
    lines = [f"labels: {done.folder} ({'; '.join(counts)}; parts: {parts})"]
    if hidden := max(done.hidden.values(), default=0):
        lines.append(f"  {hidden} objects are hidden by the weather (output.min_visibility)")
    if done.unmapped:
        listed = ", ".join(
            f"{label or 'boxes without a label'} ({count})"
            for label, count in done.unmapped.items()
        )
        lines.append(f"  of no category, and left out: {listed}")
    if done.without_numbers:
        lines.append(
            f"  {done.without_numbers} objects are DontCare in kitti: centre, size or rotation of "
            f"their box is not finite, or a side is not longer than 0"
        )
    if done.unused:
        lines.append(f"  rows of output.categories that no label is of: {', '.join(done.unused)}")
    return lines


def _shares(split: Sequence[str]) -> dict[str, float]:
    """`train=0.8` and so on."""
    shares = {}
    for text in split:
        name, _, share = text.partition("=")
        try:
            shares[name] = float(share)
        except ValueError:
            raise ClimateGSError(f"--split {text}: write NAME=SHARE, as in train=0.8") from None
    return shares


def export_scene(options: ExportOptions) -> int:
    """Writes the scene, prints what was written and what could not be kept. Returns 0.

    Raises:
        SceneError: the scene cannot be opened, or has no such frame, or cannot be kept in such a
            file. OutputError: OUT holds something, or cannot be written.
    """
    kind = options.kind
    out = _named(options.out, kind)
    _check_out(out, kind, options.overwrite)
    scene = open_scene(options.scene)
    for problem in scene.problems:
        print_note(f"note: {problem}")
    moment = _moment(scene, options.frame)
    for path in _write(storable(scene), out, kind, moment, options.half):
        print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")
    for loss in export_losses(scene, kind, moment, half=options.half):
        print(f"note: {loss}")
    return 0


def _write(scene: Scene, out: Path, kind: ExportKind, moment: int, half: bool) -> list[Path]:
    if kind == "scene":
        save_scene(scene, out.absolute())
        return [out / name for name in FILES]
    if kind == "file":
        save_scene_file(scene, out, half=half)
        return [out]
    if kind == "ply-parts":
        export_ply_parts(scene, out)
        return [out / PARTS, *sorted(out.rglob("*.ply")), *out.glob(CAMERAS)]
    alone = {"spz": export_spz, "sog": export_sog, "glb": export_glb, "usd": export_usd}
    if kind in alone:
        alone[kind](scene, out, moment)
        return [out]
    if kind == "ply":
        export_ply(scene, out, moment)
    else:
        export_splat(scene, out, moment)
    cameras = out.parent / CAMERAS
    if export_cameras(scene, out.parent):
        return [out, cameras] if cameras.exists() else [out]
    print_note(
        f"note: {cameras} is there already and not this scene's; it is left as it is. Viewers that "
        f"look for cameras there find its cameras: export into a folder of its own"
    )
    return [out]


def _moment(scene: Scene, frame: int | None) -> int:
    """The time of the frame, or of the first; without frames, the first at which an actor is there.

    Raises:
        SceneError: there is no such frame.
    """
    if frame is not None:
        return scene.frame(frame).timestamp_ns
    if scene.frames:
        return scene.frames[0].timestamp_ns
    return min((int(actor.track.timestamps_ns[0]) for actor in scene.actors), default=0)


def _named(out: Path, kind: ExportKind) -> Path:
    suffix = _SUFFIXES.get(kind, "")
    if not out.resolve().name:
        raise OutputError(f"--out {out} is the file system's root: name a file or folder below it")
    named = out.suffix.lower()
    if named == suffix:
        return out
    other = next((kind for kind, ending in _SUFFIXES.items() if ending == named), None)
    if other is not None:
        raise ClimateGSError(
            f"--out {out} is named as --kind {other} writes it, and this is --kind {kind}: say "
            f"--kind {other}, or give a name without {named}"
        )
    return out.with_name(out.name + suffix) if suffix else out


def _check_out(out: Path, kind: ExportKind, overwrite: bool) -> None:
    """What is at OUT is nothing, or may be replaced; known before anything is opened."""
    if not out.exists() or (out.is_dir() and kind not in _SUFFIXES and not any(out.iterdir())):
        return
    if out.is_dir() and kind in _SUFFIXES:
        raise OutputError(f"{out} is a folder: choose another --out")
    if kind == "scene" and not is_scene_folder(out):
        raise OutputError(f"{out} holds something else than a scene: choose another --out")
    if not overwrite:
        raise OutputError(f"{out} is there already: choose another --out, or add --overwrite")
