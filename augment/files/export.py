"""Writes scenes as plain splat files: baked at one moment, or part by part; with viewers' cameras.

The command `export` calls it. `export_losses` lists what such files cannot keep. Scales and
opacities are stored as logarithms and logits, so they read back to rounding, not to the bit.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from augment.errors import OutputError, SceneError
from augment.files.gltf import write_glb
from augment.files.ply import write_ply, write_splat
from augment.files.scene_file import document_text, track_entry
from augment.files.sog import MAX_PALETTE, write_sog
from augment.files.spz import write_spz
from augment.files.usd import write_usd
from augment.output.atomic import raise_output_error, write_atomic, write_folder_atomically
from augment.output.layout import folder_name
from augment.render.sh import rotate_sh
from augment.scene.cameras import Camera
from augment.scene.geometry import multiply_quats, quat_from_rotmat, rotmat_from_quat
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians, Scene
from augment.scene.semantics import SemanticClass

# ---- What an exported file cannot keep of a scene: one sentence each, for people -----------------

_VISIBLE_OFFSET_PX = 0.1  # a smaller offset of the principal point goes unmentioned
ExportKind = Literal["scene", "file", "ply", "ply-parts", "splat", "spz", "sog", "glb", "usd"]


def export_losses(
    scene: Scene, kind: ExportKind, timestamp_ns: int | None = None, *, half: bool = False
) -> tuple[str, ...]:
    """List what a file of one kind loses of a scene, and what its users have to know.

    Args:
        scene: the scene.
        kind: the kind of file.
        timestamp_ns: the moment at which ply and splat files are baked.
        half: whether a scene file stores float16.

    Returns:
        One sentence a loss.
    """
    if kind in ("scene", "file"):
        return tuple(_saved_losses(scene, kind, half=half))
    losses = [*_place_losses(scene, kind, timestamp_ns), *_colour_losses(scene, kind)]
    return (*losses, *_fact_losses(scene, kind))


def _saved_losses(scene: Scene, kind: ExportKind, *, half: bool) -> Iterator[str]:
    """Losses of a saved scene: a scene folder or a scene file."""
    has_images = any(frame.image_paths for frame in scene.frames)
    if scene.labels is not None or scene.recorded_source is not None or has_images:
        yield (
            f"boxes, LiDAR and recorded images are not in it: they are read from "
            f"{scene.recorded_source or scene.source}; where that has moved, open it with ?data=URI"
        )
    if kind == "file":
        yield "it names folders of this machine: the working folder, the recording's, the images'"
    if half:
        yield (
            "rotations, opacities and colours are rounded to float16: colours by up to 0.1/255, "
            "rotations by up to 0.05 degrees, opacities by up to 0.00025"
        )


def _place_losses(scene: Scene, kind: ExportKind, timestamp_ns: int | None) -> Iterator[str]:
    """Losses in positions, poses, units and axes."""
    if kind == "ply-parts":
        if any(len(part) == 0 for part in scene.all_gaussians):
            yield "parts without Gaussians have no file"
    elif scene.actors:
        assert timestamp_ns is not None
        num_actors = sum(actor.track.pose_at(timestamp_ns) is not None for actor in scene.actors)
        number = next((f.index for f in scene.frames if f.timestamp_ns == timestamp_ns), None)
        moment = f"at {timestamp_ns} ns" if number is None else f"in frame {number}"
        yield f"actors ({num_actors}) stand still where they are {moment}"
        if num_actors < len(scene.actors):
            yield f"actors ({len(scene.actors) - num_actors}) that are not there then are left out"
        if delay_ns := _greatest_delay_ns(scene, timestamp_ns):
            yield (
                f"the frame's cameras took their images up to {delay_ns / 1e6:.0f} ms from that "
                f"moment, so that moving actors are a little off in them"
            )
    if kind in ("splat", "spz", "sog", "glb", "usd") and scene.world_origin_m.any():
        place = ", ".join(f"{v:.3f}" for v in scene.world_origin_m)
        yield f"where the scene lies in the dataset's world ({place}) is left out"
    if kind == "splat":
        yield "which way is up and how long a unit is are left out: open it with ?up=+z&scale=1"
    if kind == "spz":
        yield "how long a unit is is left out: open it with ?scale=1; y points up in it"
    if kind in ("spz", "sog", "usd"):
        yield "cameras are left out"
    if kind == "glb":
        unit = "its unit is the metre, y points up in it; cameras are left out"
        yield (
            unit if scene.has_metric_scale else f"how long the scene's unit is is not known; {unit}"
        )


def _colour_losses(scene: Scene, kind: ExportKind) -> Iterator[str]:
    """Losses in colours, sky and classes."""
    yield "the sky is left out"
    if scene.color_mapped_cameras:
        yield (
            f"how the recorded colours of {', '.join(scene.color_mapped_cameras)} differ from the "
            f"scene's (colour maps) is left out"
        )
    waves = sum(actor.color_waves is not None for actor in scene.actors)
    if waves:
        which = "their constant part" if kind == "ply-parts" else "those of that moment"
        yield f"colours of actors ({waves}) that change over time are {which}"
    if kind == "ply-parts" and any(actor.colors_in_world for actor in scene.actors):
        yield (
            "colours of actors by direction are for directions of the world, and viewers turn them "
            "with the actor"
        )
    if kind == "sog":
        yield (
            "places are rounded to 0.1 mm at the origin, 1 cm at 100 m and 10 cm at 1 km from it, "
            "rotations to 1 degree, opacities to 8 bits, scales and colours to the nearest of "
            "256 each"
        )
        if any(part.sh_degree > 0 for part in scene.all_gaussians):
            yield f"SH is rounded to the nearest of {MAX_PALETTE} sets, where there are more"
    if kind == "spz":
        yield (
            "places are rounded to 0.12 mm within 2 km, scales by up to 3 %, rotations to 0.25 "
            "degrees, opacities, colours and SH to 8 bits and less; SH beyond -1 and 1 is cut off"
        )
    if kind == "splat":
        yield "colours, opacities and rotations have 8 bits; colours below 0 or above 1 are cut off"
        if any(part.sh_degree > 0 for part in scene.all_gaussians):
            yield "colours do not depend on the direction of view: SH bands above 0 are left out"
    has_classes = any(part.semantic is not None for part in scene.all_gaussians)
    if kind in ("splat", "spz", "sog", "glb", "usd") and has_classes:
        yield "semantic classes are left out"


def _fact_losses(scene: Scene, kind: ExportKind) -> Iterator[str]:
    """Losses in labels, cameras and other facts."""
    if scene.labels is not None:
        yield f"boxes and LiDAR stay with {scene.recorded_source or scene.source}"
    if scene.ground_z_m is not None:
        yield f"the road's height is left out: open it with ?ground_z={scene.ground_z_m:.3f}"
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    if cameras and kind not in ("spz", "sog", "glb", "usd"):
        offset_px = max(
            max(abs(camera.cx - camera.width / 2), abs(camera.cy - camera.height / 2))
            for camera in cameras
        )
        yield "times of images are left out of cameras.json"
        if offset_px >= _VISIBLE_OFFSET_PX:
            yield (
                f"viewers take the principal points of cameras.json to be in the middle of the "
                f"image; they lie up to {offset_px:.1f} px off"
            )
    if any(camera.is_orthographic for camera in cameras):
        yield "orthographic cameras are left out"
    if scene.made_by:
        yield "how the scene was made (made_by) is left out"


def _greatest_delay_ns(scene: Scene, timestamp_ns: int) -> int:
    """Return the largest time between a frame and its images; 0 at a time without a frame."""
    delays = [
        abs(camera.timestamp_ns - timestamp_ns)
        for frame in scene.frames
        if frame.timestamp_ns == timestamp_ns
        for camera in frame.cameras.values()
    ]
    return max(delays, default=0)


# ---- Gaussians in another frame, and all Gaussians of a scene at one moment ----------------------

_ROWS_AT_ONCE = 65536  # Gaussians whose colours are rotated together


def transform_gaussians_rigidly(
    gaussians: Gaussians,
    rotation: Float[Tensor, "3 3"],
    shift: Float[Tensor, "3"],
    scale: float = 1.0,
) -> Gaussians:
    """Return the Gaussians at scale * rotation @ mean + shift.

    Quaternions and SH are rotated too. Positions are computed in float64 and rounded once.

    Args:
        gaussians: the Gaussians.
        rotation: float64 [3, 3].
        shift: float64 [3].
        scale: a factor of positions and sizes.
    """
    means = scale * (gaussians.means.double() @ rotation.T) + shift
    moved = dataclasses.replace(
        gaussians,
        means=means.to(gaussians.means.dtype),
        scales=gaussians.scales if scale == 1.0 else gaussians.scales * scale,
    )
    if torch.equal(rotation, torch.eye(3, dtype=rotation.dtype)):
        return moved
    quat = quat_from_rotmat(rotation).to(gaussians.quats.dtype).expand_as(gaussians.quats)
    sh = gaussians.sh if gaussians.sh_degree == 0 else _rotate_sh_in_pieces(gaussians.sh, rotation)
    return dataclasses.replace(moved, quats=multiply_quats(quat, gaussians.quats), sh=sh)


def transform_gaussians(gaussians: Gaussians, matrix: Float[Tensor, "3 3"]) -> Gaussians:
    """Return the Gaussians under a linear map without mirrors; their shapes are exact.

    SH rotate by the rotation that is nearest to the map.

    Args:
        gaussians: the Gaussians.
        matrix: float64 [3, 3], with a positive determinant.
    """
    u, stretch, vh = torch.linalg.svd(matrix)
    rotation = u @ vh
    scale = float(stretch.mean())
    no_shift = torch.zeros(3, dtype=torch.float64)
    if float(stretch[0] - stretch[2]) <= 1e-6 * scale:
        if torch.allclose(rotation, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12):
            rotation = torch.eye(3, dtype=torch.float64)  # changes no bit
        return transform_gaussians_rigidly(gaussians, rotation, no_shift, scale)
    quats = torch.nn.functional.normalize(gaussians.quats.double(), dim=1)
    axes = matrix @ rotmat_from_quat(quats) * gaussians.scales.double()[:, None]
    is_usable = axes.isfinite().all(2).all(1)
    axes = torch.where(is_usable[:, None, None], axes, torch.eye(3, dtype=torch.float64))
    axes, scales, _ = torch.linalg.svd(axes)  # covariance = axes scales^2 axes^T
    scales = torch.where(is_usable[:, None], scales, torch.nan)
    axes = axes * torch.linalg.det(axes)[:, None, None]
    moved = transform_gaussians_rigidly(gaussians, rotation, no_shift)
    return dataclasses.replace(
        moved,
        means=(gaussians.means.double() @ matrix.T).to(gaussians.means.dtype),
        quats=quat_from_rotmat(axes).to(gaussians.quats.dtype),
        scales=scales.to(gaussians.scales.dtype),
    )


def bake_scene(scene: Scene, timestamp_ns: int) -> Gaussians:
    """Return the background and the actors of one moment as Gaussians of the scene's world.

    They have the colours of that moment, and the order of `Scene.parts_at`. Colours of a lower
    degree are filled up with zero bands, unknown classes with UNKNOWN.
    """
    parts = []
    for part in scene.parts_at(timestamp_ns):
        gaussians = part.gaussians
        pose = part.world_from_part
        if pose is not None:
            gaussians = transform_gaussians_rigidly(gaussians, pose[:3, :3], pose[:3, 3])
        parts.append(gaussians)
    return concatenate_gaussians(parts)


def concatenate_gaussians(parts: Sequence[Gaussians]) -> Gaussians:
    """Return the Gaussians of all parts, one part after another.

    Colours of a lower degree are filled up with zero bands, unknown classes with UNKNOWN.
    """
    if len(parts) == 1:
        return parts[0]
    names = ("means", "quats", "scales", "opacities")
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    count = sum(map(len, parts))
    bands = NUM_SH_BY_DEGREE[max(part.sh_degree for part in parts if len(part) or count == 0)]
    sh = torch.zeros(count, bands, 3, dtype=parts[0].sh.dtype)
    has_classes = any(part.semantic is not None for part in parts)
    semantic = torch.full((count,), int(SemanticClass.UNKNOWN), dtype=torch.int16)
    start = 0
    for part in parts:
        rows = slice(start, start + len(part))
        sh[rows, : part.sh.shape[1]] = part.sh[:, :bands]
        if part.semantic is not None:
            semantic[rows] = part.semantic
        start = rows.stop
    return Gaussians(**columns, sh=sh, semantic=semantic if has_classes else None)


def _rotate_sh_in_pieces(sh: Float[Tensor, "N K 3"], rotation: Float[Tensor, "3 3"]) -> Tensor:
    """Rotate SH without temporaries as large as the coefficients of a large scene."""
    rotated = torch.empty_like(sh)
    for start in range(0, len(sh), _ROWS_AT_ONCE):
        rotated[start : start + _ROWS_AT_ONCE] = rotate_sh(
            sh[start : start + _ROWS_AT_ONCE], rotation
        )
    return rotated


# ---- Files ---------------------------------------------------------------------------------------

BACKGROUND = "background.ply"  # the Gaussians that do not move
CAMERAS = "cameras.json"  # all images' cameras, for viewers
PARTS = "parts.json"  # tracks, labels and sizes of actors
ACTORS = "actors"  # the folder of the actors' .ply files
_FORMAT = "climategs-parts"  # the format that parts.json names
_FORMAT_PATTERN = re.compile(rb'\s*\{\s*"format"\s*:\s*"' + _FORMAT.encode() + rb'"')


def export_ply(scene: Scene, path: str | Path, timestamp_ns: int) -> None:
    """Write the scene at one moment into an INRIA .ply.

    Its comments say `up: +z` where gravity is known, and `unit: metre` where the scale is.
    """
    write_ply(path, _baked_or_error(scene, timestamp_ns), notes=_notes(scene))


def export_splat(scene: Scene, path: str | Path, timestamp_ns: int) -> None:
    """Write the scene at one moment into a .splat."""
    gaussians = _baked_or_error(scene, timestamp_ns)
    write_splat(path, replace(gaussians, sh=gaussians.sh[:, :1]))  # export_losses says so


def export_spz(scene: Scene, path: str | Path, timestamp_ns: int) -> None:
    """Write the scene at one moment into a .spz, y up."""
    write_spz(path, _y_up(_baked_or_error(scene, timestamp_ns)))


def export_glb(scene: Scene, path: str | Path, timestamp_ns: int) -> None:
    """Write the scene at one moment into a .glb with KHR_gaussian_splatting, y up."""
    write_glb(path, _y_up(_baked_or_error(scene, timestamp_ns)))


def export_usd(scene: Scene, path: str | Path, timestamp_ns: int) -> None:
    """Write the scene at one moment into a .usdc, in the scene's axes."""
    has_gravity = scene.has_known_gravity
    has_scale = scene.has_metric_scale
    write_usd(
        path, _baked_or_error(scene, timestamp_ns), is_upright=has_gravity, is_metric=has_scale
    )


def _y_up(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians with z up as Gaussians with y up."""
    z_to_y = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
    return transform_gaussians_rigidly(gaussians, z_to_y, torch.zeros(3, dtype=torch.float64))


def export_sog(scene: Scene, path: str | Path, timestamp_ns: int) -> None:
    """Write the scene at one moment into a .sog, y down: viewers turn it as they turn a .ply.

    Its meta.json says `up` and `unit` as the .ply's comments do.
    """
    z_to_minus_y = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    gaussians = _baked_or_error(scene, timestamp_ns)
    notes = {key: note for key, note in _notes(scene).items() if key in ("up", "unit")}
    if "up" in notes:
        notes["up"] = "-y"
    zero = torch.zeros(3, dtype=torch.float64)
    write_sog(path, transform_gaussians_rigidly(gaussians, z_to_minus_y, zero), notes=notes)


def export_cameras(scene: Scene, folder: str | Path) -> bool:
    """Write `cameras.json` beside splat files; a file that exists stays as it is.

    Returns:
        Whether the folder's cameras.json is now this scene's; a scene without frames has none.
    """
    path = Path(folder) / CAMERAS
    text = inria_cameras(scene)
    if text is None:
        return not path.exists()
    if path.exists():
        try:
            return path.read_bytes() == text
        except OSError:  # a folder, or what may not be read
            return False
    write_atomic(path, text)
    return True


def inria_cameras(scene: Scene) -> bytes | None:
    """Return all images' cameras in the form of INRIA's cameras.json, or None without cameras.

    They are named CAMERA/FRAME. The form has no principal points; they are added as cx and cy.
    """
    views = [
        _camera_entry(camera, frame.index)
        for frame in scene.frames
        for camera in frame.cameras.values()
        if not camera.is_orthographic
    ]
    if not views:
        return None
    rows = ",\n".join(json.dumps({"id": number} | view) for number, view in enumerate(views))
    return f"[\n{rows}\n]\n".encode()


def export_ply_parts(scene: Scene, folder: str | Path) -> None:
    """Write a folder with a .ply of the background and one of every actor, or change nothing.

    It holds background.ply, actors/NAME.ply in each actor's own frame, cameras.json, and parts.json
    with tracks, labels and sizes. Colours that change over time are written as their constant part.
    Parts without Gaussians have no file. An earlier export in the folder is replaced.
    """
    folder = Path(folder).resolve()
    with raise_output_error(folder):
        is_free = not folder.exists() or is_parts_folder(folder)
    if not is_free:
        raise OutputError(
            f"{folder} holds something else than exported parts, so it is not replaced; choose "
            f"another folder"
        )
    with write_folder_atomically(folder, (BACKGROUND, CAMERAS, PARTS, ACTORS)) as new:
        _write_parts(scene, new)


def is_parts_folder(folder: Path) -> bool:
    """Return True for a folder that is empty or holds only files of `export_ply_parts`."""
    if not folder.is_dir():
        return False
    names = {entry.name for entry in folder.iterdir()}
    if not names:
        return True
    if PARTS not in names or not names <= {BACKGROUND, CAMERAS, PARTS, ACTORS}:
        return False
    with (folder / PARTS).open("rb") as file:
        is_parts_file = _FORMAT_PATTERN.match(file.read(200)) is not None
    actors = folder / ACTORS
    return is_parts_file and (
        not actors.is_dir() or all(file.suffix == ".ply" for file in actors.iterdir())
    )


def _write_parts(scene: Scene, folder: Path) -> None:
    """Write the files of `export_ply_parts` into a new folder."""
    notes = _notes(scene)

    def write(gaussians: Gaussians, name: str) -> str | None:
        if len(gaussians) == 0:
            return None
        write_ply(folder / name, gaussians, notes=notes)
        return name

    facts: dict[str, Any] = {
        "format": _FORMAT,
        "version": 1,
        "name": scene.name,
        "world_origin_m": [float(v) for v in scene.world_origin_m],
        "has_metric_scale": bool(scene.has_metric_scale),
        "has_known_gravity": bool(scene.has_known_gravity),
        "background": {"file": write(scene.background, BACKGROUND), "count": len(scene.background)},
        "actors": [
            {
                "file": write(actor.gaussians, f"{ACTORS}/{folder_name(actor.track_id)}.ply"),
                "track_id": actor.track_id,
                "label": actor.label,
                "size_m": [float(v) for v in actor.size_m],
                "count": len(actor.gaussians),
                "track": track_entry(actor.track, f"actor {actor.track_id!r}"),
            }
            for actor in scene.actors
        ],
    }
    if (cameras := inria_cameras(scene)) is not None:
        write_atomic(folder / CAMERAS, cameras)
    write_atomic(folder / PARTS, document_text(facts).encode())


def _baked_or_error(scene: Scene, timestamp_ns: int) -> Gaussians:
    """Bake the scene at one moment.

    Raises:
        SceneError: it shows no Gaussians then.
    """
    gaussians = bake_scene(scene, timestamp_ns)
    if len(gaussians) == 0:
        raise SceneError(f"scene {scene.name!r} shows no Gaussians at {timestamp_ns} ns")
    return gaussians


def _notes(scene: Scene) -> dict[str, str]:
    """Return the facts of a scene that a file's comments keep."""
    notes = {}
    if scene.has_known_gravity:
        notes["up"] = "+z"
    if scene.has_metric_scale:
        notes["unit"] = "metre"
    if scene.world_origin_m.any():
        notes["world_origin_m"] = " ".join(str(float(v)) for v in scene.world_origin_m)
    return notes


def _camera_entry(camera: Camera, frame: int) -> dict[str, Any]:
    """Return one entry of cameras.json."""
    pose = camera.world_from_camera
    return {
        "img_name": f"{folder_name(camera.name)}/{frame:06d}",
        **{"width": camera.width, "height": camera.height},
        **{"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()},
        **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
    }
