"""drivestudio runs (OmniRe and its kin: `config.yaml` and `checkpoint_*.pth`) as scenes.

    drivestudio:RUN?data=DIR&checkpoint=NAME&frames=first:stop

Background, rigid objects, the sky, and what was learnt for each image (colours, camera pose) are
read; people and what else deforms is left out, with its count in Scene.problems. World: the
model's, turned until z is up (see adapters.drivestudio.drive). Cameras are those of training:
pinholes of the size that images were scaled to, with their corrected poses.

Differences from the project's own renderer: it clamps each splat's colour, and what the splats
blend to, to at most 1, where here what is brighter stays so until the image is written; and it
draws nothing nearer than its near plane of 0.1 m.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from adapters.drivestudio.drive import (
    FRAME_NS,
    DriveStudioLabels,
    Instance,
    Run,
    RunOptions,
    find_run,
    model_from_dataset,
    read_corrections,
    read_drive,
    read_instances,
    scene_from_model,
)
from adapters.uri import format_uri
from adapters.world import WorldChange, with_class_of
from augment.cameras import Camera
from augment.errors import AdapterError, SceneError
from augment.files.checkpoints import load_checkpoint, section, taken, tensor
from augment.geometry import multiply_quats, quat_from_rotmat, rigid, rotmat_from_quat, slerp
from augment.render.composite import composite_sky
from augment.render.sh import SH_C0, rotate_sh
from augment.scene import SH_COUNTS, Actor, Gaussians, Scene, Track, check_gaussians
from augment.sky import ConstantSky, CubemapSky, Sky, cubemap_coordinates, directions_of_cubemap

# ---- The Gaussians of a run's models: tensors of a checkpoint, activated -------------------------

BACKGROUND, RIGID = "Background", "RigidNodes"
OTHERS = ("Sky", "Affine", "CamPose", "CamPosePerturb")  # models without Gaussians
RIGID_KEYS = ("points_ids", "instances_size", "instances_fv", "instances_quats", "instances_trans")
_KEYS = ("_means", "_scales", "_quats", "_opacities", "_features_dc", "_features_rest")
_REASONS = {
    "SMPLNodes": "people need the body model SMPL, which is licensed by itself",
    "DeformableNodes": "they deform over time",
}


def read_gaussians(
    content: Mapping[str, Any], *, step: int, sh_interval: int, where: str
) -> tuple[Gaussians, tuple[str, ...]]:
    """The Gaussians of one model as training rendered them, in its own axes, quaternions as they
    are, and what is left out of them.

    Of spherical harmonics those degrees are kept that training had switched on: one for each
    sh_interval steps. Models without any have colours sigmoid(c), here the degree 0 that gives
    them.
    """
    more = sorted(set(map(str, content)) - {*_KEYS, *RIGID_KEYS})
    if more:
        raise AdapterError(
            f"{where} holds {', '.join(more[:6])} besides plain Gaussians: they change over time "
            f"in ways that are not known here. Known models are VanillaGaussians and RigidNodes"
        )
    means = tensor(content, "_means", (None, 3), where)
    count = len(means)
    rest = tensor(content, "_features_rest", (count, None, 3), where)
    if rest.shape[1] + 1 not in SH_COUNTS:
        raise AdapterError(
            f"{where}: _features_rest must have 0, 3, 8 or 15 rows (degrees 0 to 3 of spherical "
            f"harmonics); got {rest.shape[1]}"
        )
    degree = SH_COUNTS.index(rest.shape[1] + 1)
    active = min(step // sh_interval, degree)
    sh = torch.empty(count, SH_COUNTS[active], 3)
    taken(tensor(content, "_features_dc", (count, 3), where), sh[:, 0])
    taken(rest[:, : SH_COUNTS[active] - 1], sh[:, 1:])
    if degree == 0:
        sh.sigmoid_().sub_(0.5).div_(SH_C0)
    gaussians = Gaussians(
        means=taken(means),
        quats=taken(tensor(content, "_quats", (count, 4), where)),
        scales=taken(tensor(content, "_scales", (count, 3), where)).exp_(),
        opacities=taken(tensor(content, "_opacities", (count, 1), where)).sigmoid_()[:, 0],
        sh=sh,
    )
    if active == degree:
        return gaussians, ()
    return gaussians, (
        f"{where}: training stopped at step {step}, before spherical harmonics of degree "
        f"{active + 1} to {degree} were switched on; they are left out",
    )


def left_out(models: Mapping[str, Any], where: str) -> list[str]:
    """A sentence for each model that is not drawn, with the number of its Gaussians."""
    sentences = []
    for name in models:
        if name in (BACKGROUND, RIGID, *OTHERS):
            continue
        means = section(models, name, where).get("_means")
        is_count = isinstance(means, Tensor)
        what = f"{len(means)} Gaussians of {name} are" if is_count else f"the model {name} is"
        reason = _REASONS.get(name, "models of this kind are not known here")
        sentences.append(f"{where}: {what} left out: {reason}")
    return sentences


def turned_to_actor(
    gaussians: Gaussians, object_from_actor: np.ndarray, scene_from_model: np.ndarray
) -> Gaussians:
    """An object's Gaussians in its actor's axes, colours for directions of the scene's world.

    The project looks up spherical harmonics in directions of the world, whichever way the object
    is turned. scene_from_model: [3, 3].
    """
    sh = gaussians.sh
    if gaussians.sh_degree > 0 and not np.array_equal(scene_from_model, np.eye(3)):
        sh = rotate_sh(sh, torch.from_numpy(scene_from_model))
    if np.array_equal(object_from_actor, np.eye(3)):
        return dataclasses.replace(gaussians, sh=sh)
    actor_from_object = torch.from_numpy(object_from_actor.T.copy())
    turn = quat_from_rotmat(actor_from_object).to(gaussians.quats.dtype)
    return dataclasses.replace(
        gaussians,
        means=gaussians.means @ actor_from_object.T.to(gaussians.means.dtype),
        quats=multiply_quats(turn.expand_as(gaussians.quats), gaussians.quats),
        sh=sh,
    )


# ---- Rigid objects of a run as actors: their tracks, and which of the data's objects they are ----

_LABEL = "vehicle"  # of an object that none of the data's is known to be
_SAME_SIZE_M = 0.01
_NEAR_M = 2.0  # training moves an object less far from where it was labelled
_CLEARER = 2.0  # how many times farther the next candidate must be


@dataclass(frozen=True, eq=False)
class RigidPoses:
    """Where I objects are in the F frames of a run, in the model's world and their boxes' axes.

    positions: float64 [F, I, 3]. rotations: float64 [F, I, 3, 3]. visible: bool [F, I].
    sizes_m: float64 [I, 3].
    """

    positions: np.ndarray
    rotations: np.ndarray
    visible: np.ndarray
    sizes_m: np.ndarray


def read_poses(content: Mapping[str, Any], run: Run, where: str) -> RigidPoses:
    """The poses that frames are rendered with.

    In frames that were not trained on, those are halfway between the frames before and after,
    where both are and the first and last frames are not among them. (The project turns the
    Gaussians themselves, but not their places, by such a frame's own untrained pose. Here one pose
    does both.)
    """
    visible = tensor(content, "instances_fv", (None, None), where, dtype=torch.bool)
    frames, count = visible.shape
    if frames != len(run.frames):
        raise AdapterError(
            f"{where}: instances_fv has {frames} frames; {run.config_file} and {run.data} have "
            f"{len(run.frames)} ({run.frames.start} to {run.frames[-1]}). Is it the scene that the "
            f"run was trained on?"
        )
    quats = taken(tensor(content, "instances_quats", (frames, count, 4), where)).double()
    places = taken(tensor(content, "instances_trans", (frames, count, 3), where)).double()
    sizes = taken(tensor(content, "instances_size", (count, 3), where)).double()
    visible = taken(visible)
    norms = quats.norm(dim=2)
    usable = torch.isfinite(places).all(2) & torch.isfinite(norms) & (norms > 0)
    if not bool((usable | ~visible).all()) or not bool((sizes > 0).all()):
        raise AdapterError(f"{where}: poses or sizes of instances are NaN, infinite or zero")
    quats = torch.where(usable[..., None], quats, torch.tensor([1.0, 0, 0, 0]).double())
    places = torch.where(usable[..., None], places, torch.zeros(3).double())
    quats = quats / quats.norm(dim=2, keepdim=True)
    trained_quats, trained_places = quats.clone(), places.clone()
    for at, number in enumerate(run.frames):
        if not run.is_held_out(number) or at < 2 or at + 1 >= frames:
            continue
        both = (visible[at - 1] & visible[at + 1])[:, None]
        half = torch.full((count,), 0.5, dtype=torch.float64)
        between = slerp(trained_quats[at - 1], trained_quats[at + 1], half)
        quats[at] = torch.where(both, between, quats[at])
        middle = (trained_places[at - 1] + trained_places[at + 1]) / 2
        places[at] = torch.where(both, middle, places[at])
    return RigidPoses(
        places.numpy(), rotmat_from_quat(quats).numpy(), visible.numpy(), sizes.numpy()
    )


def make_actors(
    gaussians: Gaussians,
    owners: np.ndarray,
    poses: RigidPoses,
    identities: Sequence[Instance | None],
    run: Run,
    where: str,
) -> tuple[list[Actor], list[str]]:
    """One actor for each object that has Gaussians and is in some frame.

    owners: int64 [N], the object of each of the Gaussians. A track has a knot at each frame's time,
    which is that of its images, and the actor is absent from frames in which it is not visible.
    """
    actors, problems, absent = [], [], []
    axes, turn = run.convention.object_from_actor, scene_from_model(run)
    for index, identity in enumerate(identities):
        track_id, label = f"rigid-{index}", _LABEL
        if identity is not None:
            track_id, label = identity.track_id, identity.label
        own = np.flatnonzero(owners == index)
        seen = np.flatnonzero(poses.visible[:, index])
        if len(own) == 0 or len(seen) == 0:
            absent.append(track_id)
            continue
        try:
            usable, about = check_gaussians(
                gaussians.select(torch.from_numpy(own)), where=f"{where} object {index}"
            )
        except SceneError as error:
            problems.append(str(error))
            continue
        problems += about
        rotations, places = poses.rotations[seen, index] @ axes, poses.positions[seen, index]
        actors.append(
            Actor(
                track_id=track_id,
                label=label,
                gaussians=with_class_of(label, turned_to_actor(usable, axes, turn)),
                track=Track(
                    torch.from_numpy((run.frames.start + seen).astype(np.int64) * FRAME_NS),
                    rigid(torch.from_numpy(turn @ rotations), torch.from_numpy(places @ turn.T)),
                    hold_ns=FRAME_NS // 2 - 1,  # the frame before and after are without it
                    max_gap_ns=FRAME_NS,
                ),
                size_m=tuple((poses.sizes_m[index] @ np.abs(axes)).tolist()),
                colors_in_world=True,
            )
        )
    if absent:
        problems.append(
            f"{where}: objects without Gaussians, or visible in no frame, are no actors: "
            f"{', '.join(absent)}"
        )
    return actors, problems


def identify(
    poses: RigidPoses, instances: Sequence[Instance], model_from_dataset: np.ndarray, frames: range
) -> list[Instance | None]:
    """Which of the data's objects each of the model's is; None where that is not clear.

    The model counts objects as it meets them in the LiDAR. One is the same as another that is
    labelled in the frames in which it is visible, of its mean size, and near it throughout.
    """
    numbers = np.array(frames)
    clear: list[Instance | None] = []
    for index in range(poses.visible.shape[1]):
        shown = poses.visible[:, index]
        candidates = []
        for instance in instances:
            inside = np.isin(instance.frames, numbers)
            if not np.array_equal(instance.frames[inside], numbers[shown]) or not inside.any():
                continue
            size = instance.sizes_m[inside].mean(0)
            if np.abs(size - poses.sizes_m[index]).max() > _SAME_SIZE_M:
                continue
            places = instance.poses[inside, :3, 3] @ model_from_dataset[:3, :3].T
            offsets = places + model_from_dataset[:3, 3] - poses.positions[shown, index]
            candidates.append((float(np.linalg.norm(offsets, axis=1).mean()), instance))
        candidates.sort(key=lambda candidate: candidate[0])
        is_clear = bool(candidates) and candidates[0][0] < _NEAR_M
        if is_clear and len(candidates) > 1:
            is_clear = candidates[1][0] > _CLEARER * candidates[0][0] + _SAME_SIZE_M
        clear.append(candidates[0][1] if is_clear else None)
    times_taken = Counter(instance.track_id for instance in clear if instance is not None)
    return [None if i is None or times_taken[i.track_id] > 1 else i for i in clear]


# ---- The sky of a run as a cube map of the scene's world -----------------------------------------
# drivestudio looks a direction (x, y, z) of its world up at (x, z, -y), in nvdiffrast's faces.
# Where the scene's world differs from it by a permutation of axes, both turns together take texels
# to texels, and no colour is interpolated.

_LOOKUP_FROM_MODEL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
_BAKED_SIZE = 256
_LARGEST = 8192  # texels along an edge
_OCTAVES = 7  # frequencies 1 to 64 of the sky network's directions


def read_sky(
    models: Mapping[str, Any], scene_from_model: np.ndarray, where: str
) -> tuple[Sky, tuple[str, ...]]:
    """The sky of a checkpoint's models, black where there is none that is known here, and what is
    not as it was trained.

    scene_from_model: [3, 3], a rotation.
    """
    black = ConstantSky(torch.zeros(3))
    if "Sky" not in models:
        return black, (f"{where} holds no Sky; the sky is black",)
    content, where = section(models, "Sky", where), f"{where} Sky"
    if "base" in content:
        base = tensor(content, "base", (6, None, None, 3), where)
        if base.shape[1] != base.shape[2] or not 1 <= base.shape[1] <= _LARGEST:
            raise AdapterError(
                f"{where}: base must be [6, R, R, 3] with R from 1 to {_LARGEST}; "
                f"got {list(base.shape)}"
            )
        faces = taken(base)
        if not bool(torch.isfinite(faces).all()):
            raise AdapterError(f"{where}: base holds NaN or infinite numbers")
        return CubemapSky(turned_faces(faces, _LOOKUP_FROM_MODEL @ scene_from_model.T)), ()
    if "sky_head.layers.0.weight" in content:
        return _baked(content, scene_from_model, where)
    keys = ", ".join(map(str, list(content)[:6])) or "nothing"
    return black, (f"{where} is of a kind that is not known here ({keys}); the sky is black",)


def turned_faces(faces: Tensor, source_from_target: np.ndarray) -> Tensor:
    """A cube map that shows in direction d what `faces` show in source_from_target @ d: exactly
    where that is a permutation of axes with signs, else at the middle of each texel.

    faces: [6, R, R, 3]. source_from_target: [3, 3], a rotation.
    """
    turned = torch.empty_like(faces)
    if np.isin(source_from_target, (-1.0, 0.0, 1.0)).all():
        # Found on a cube map of two texels an edge: where four texels go, all do.
        turn = torch.from_numpy(source_from_target).float()
        face, s, t = cubemap_coordinates(directions_of_cubemap(2) @ turn.T)
        texels = torch.arange(24).reshape(6, 2, 2)
        for target, shown in enumerate(face * 4 + (t > 0) * 2 + (s > 0)):
            for source, quarters in itertools.product(range(6), range(4)):
                if torch.equal(torch.rot90(texels[source], quarters), shown):
                    turned[target] = torch.rot90(faces[source], quarters)
        return turned
    # Each face as a camera of 90 degrees sees it; a face is the mirror image of such a picture.
    size = faces.shape[1]
    for face, corners in enumerate(directions_of_cubemap(2).double()):
        left, down = corners[0, 0] - corners[0, 1], corners[1, 0] - corners[0, 0]
        axes = torch.nn.functional.normalize(torch.stack([left, down, corners.sum((0, 1))]))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = axes @ torch.from_numpy(source_from_target.T.copy())
        camera = Camera("face", size, size, *[size / 2] * 4, camera_from_world=pose)
        empty = torch.zeros(size, size, 3)
        turned[face] = composite_sky(empty, empty[..., 0], camera, CubemapSky(faces)).flip(1)
    return turned


def _baked(
    content: Mapping[str, Any], scene_from_model: np.ndarray, where: str
) -> tuple[Sky, tuple[str, ...]]:
    """The sky network's colours of 256 texels a face, with the mean of its images' appearances."""
    appearance, note = torch.zeros(0), ()
    if "appearance_embedding.weight" in content:
        rows = taken(tensor(content, "appearance_embedding.weight", (None, None), where))
        appearance = rows.mean(0)
        if bool((rows != appearance).any()):
            note = (
                f"{where}: the sky differed from image to image; it has their mean appearance, as "
                f"the project gives it to images that were not trained on",
            )
    inputs = 3 + 6 * _OCTAVES + len(appearance)
    width = tensor(content, "sky_head.layers.0.weight", (None, inputs), where).shape[0]
    shapes = ((width, inputs), (width, width + inputs), (3, width))
    layers = [
        (
            taken(tensor(content, f"sky_head.layers.{i}.weight", shape, where)),
            taken(tensor(content, f"sky_head.layers.{i}.bias", shape[:1], where)),
        )
        for i, shape in enumerate(shapes)
    ]
    turn = torch.from_numpy(scene_from_model).float()
    faces = torch.stack(
        [
            _network(directions.reshape(-1, 3) @ turn, appearance, layers)
            for directions in directions_of_cubemap(_BAKED_SIZE)
        ]
    )
    if not bool(torch.isfinite(faces).all()):
        raise AdapterError(f"{where}: the sky's network gives NaN or infinite colours")
    return CubemapSky(faces.reshape(6, _BAKED_SIZE, _BAKED_SIZE, 3)), note


def _network(directions: Tensor, appearance: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Colours [N, 3] of unit directions [N, 3] of the model's world."""
    scales = 2.0 ** torch.arange(_OCTAVES)
    waves = (directions[:, None, :] * scales[:, None]).reshape(len(directions), -1)
    encoded = torch.cat([directions, waves.sin(), (waves + 0.5 * torch.pi).sin()], 1)
    given = torch.cat([encoded, appearance.expand(len(directions), -1)], 1)
    (first, first_bias), (middle, middle_bias), (last, last_bias) = layers
    hidden = (given @ first.T + first_bias).relu()
    hidden = (torch.cat([hidden, given], 1) @ middle.T + middle_bias).relu()
    return (hidden @ last.T + last_bias).sigmoid()


# ---- The scene -----------------------------------------------------------------------------------


def open_drivestudio(path: str, query: dict[str, str]) -> Scene:
    """The scene of a run's folder, or of a checkpoint in it.

    query: data, checkpoint, frames; see RunOptions. The checkpoint is the final one, else the
    newest.

    Raises:
        AdapterError: a wrong option, a config, checkpoint or calibration that is missing or not the
            project's, or data of another scene. What is left out is in Scene.problems.
        SceneError: no usable Gaussians.
    """
    options = RunOptions.from_query("drivestudio", query)
    run = find_run(Path(path), options)
    numbers = options.frames.select(run.frames, where=f"drivestudio:{path}").numbers
    content = load_checkpoint(run.checkpoint)
    where = str(run.checkpoint)
    step = content.get("step")
    if type(step) is not int or step < 0:
        raise AdapterError(f"{where}: step must be a number of training steps; got {step!r}")
    models = section(content, "models", where)
    corrections = read_corrections(models, run, where)
    frames, about_frames = read_drive(run, numbers, corrections)
    color_maps, image_color_maps = corrections.maps_of(run, frames)
    sky, about_sky = read_sky(models, scene_from_model(run), where)
    background, about_background = read_gaussians(
        section(models, BACKGROUND, where),
        step=step,
        sh_interval=run.sh_interval(BACKGROUND),
        where=f"{where} {BACKGROUND}",
    )
    background, unusable = check_gaussians(background, where=f"{where} {BACKGROUND}")
    change = WorldChange(rotation=scene_from_model(run))
    actors, about_actors = _actors(models, run, step, where)
    about_renderer = []
    if run.is_set("trainer.render.antialiased"):
        about_renderer = [
            f"{run.config_file}: the run was trained with trainer.render.antialiased, which draws "
            f"small splats fainter than they are drawn here; a recipe's render: "
            f"{{antialiased: true}} does the same"
        ]
    return Scene(
        name=run.folder.absolute().name,
        source=format_uri("drivestudio", path, query),
        background=change.gaussians(background, np.zeros(3)),
        actors=tuple(actors),
        sky=sky,
        frames=frames,
        labels=DriveStudioLabels(run),
        color_maps=color_maps,
        image_color_maps=image_color_maps,
        problems=(
            *left_out(models, where),
            *about_background,
            *unusable,
            *about_actors,
            *about_sky,
            *corrections.problems,
            *about_frames,
            *about_renderer,
        ),
        made_by={
            "method": "drivestudio",
            "checkpoint": where,
            "step": step,
            "config": str(run.config_file),
        },
    )


def drivestudio_labels(path: str, query: dict[str, str]) -> DriveStudioLabels:
    """The labels of a run's data; whatever frames the query asks for, they are those of all.

    Raises:
        AdapterError: as for open_drivestudio, as far as config and data are concerned.
    """
    return DriveStudioLabels(find_run(Path(path), RunOptions.from_query("drivestudio", query)))


def _actors(
    models: Mapping[str, Any], run: Run, step: int, where: str
) -> tuple[list[Actor], list[str]]:
    if RIGID not in models:
        return [], []
    content, where = section(models, RIGID, where), f"{where} {RIGID}"
    gaussians, problems = read_gaussians(
        content, step=step, sh_interval=run.sh_interval(RIGID), where=where
    )
    poses = read_poses(content, run, where)
    ids = tensor(content, "points_ids", (len(gaussians), 1), where, dtype=torch.int64)
    owners = taken(ids)[:, 0].numpy()
    count = poses.visible.shape[1]
    if len(owners) and not 0 <= owners.min() <= owners.max() < count:
        raise AdapterError(
            f"{where}: points_ids must be 0 to {count - 1}, one of the {count} objects; got "
            f"{owners.min()} to {owners.max()}"
        )
    instances = read_instances(run.data)
    identities = identify(poses, list(instances.values()), model_from_dataset(run), run.frames)
    unknown = [f"rigid-{i}" for i, identity in enumerate(identities) if identity is None]
    if unknown:
        reason = "" if instances else f" ({run.data} holds no instances/instances_info.json)"
        problems += (
            f"{where}: which of the data's objects these are could not be told{reason}, so that no "
            f"box is known to be theirs: {', '.join(unknown)}",
        )
    actors, about = make_actors(gaussians, owners, poses, identities, run, where)
    return actors, [*problems, *about]
