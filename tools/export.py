"""`climategs export`: a scene for other programs, or in one file to share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from adapters.base import open_scene
from adapters.scene_folder import prepare_for_storage
from augment.errors import ClimateGSError, OutputError
from augment.files.export import (
    CAMERAS,
    PARTS,
    export_cameras,
    export_losses,
    export_ply_parts,
    export_splats,
)
from augment.files.formats import ExportKind, splat_formats, splat_writer
from augment.files.scene_file import (
    FILES,
    SCENE_SUFFIX,
    is_scene_folder,
    save_scene,
    save_scene_file,
)
from augment.scene.scene import Scene
from tools.output import print_note

if TYPE_CHECKING:
    from tools.cli import ExportOptions

_SUFFIXES = {
    "file": SCENE_SUFFIX,
    **{f.writer.kind: f.writer.suffix for f in splat_formats() if f.writer is not None},
}


def export_scene(options: ExportOptions) -> int:
    """Write the scene, and print the files and the losses. Return 0.

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
    for path in _write(prepare_for_storage(scene), out, kind, moment, options.half):
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
    export_splats(scene, out, moment, kind=kind)
    if not splat_writer(kind).has_camera_file:
        return [out]
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
    out_suffix = out.suffix.lower()
    if out_suffix == suffix:
        return out
    other = next((kind for kind, ending in _SUFFIXES.items() if ending == out_suffix), None)
    if other is not None:
        raise ClimateGSError(
            f"--out {out} is named as --kind {other} writes it, and this is --kind {kind}: say "
            f"--kind {other}, or give a name without {out_suffix}"
        )
    return out.with_name(out.name + suffix) if suffix else out


def _check_out(out: Path, kind: ExportKind, overwrite: bool) -> None:
    """Refuse an OUT that exists and may not be replaced, before anything is opened."""
    if not out.exists() or (out.is_dir() and kind not in _SUFFIXES and not any(out.iterdir())):
        return
    if out.is_dir() and kind in _SUFFIXES:
        raise OutputError(f"{out} is a folder: choose another --out")
    if kind == "scene" and not is_scene_folder(out):
        raise OutputError(f"{out} holds something else than a scene: choose another --out")
    if not overwrite:
        raise OutputError(f"{out} is there already: choose another --out, or add --overwrite")
