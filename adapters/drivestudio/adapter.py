"""Scenes of drivestudio runs (OmniRe and related models: `config.yaml` and `checkpoint_*.pth`).

    drivestudio:RUN?data=DIR&checkpoint=NAME&frames=first:stop

Background, rigid objects, the sky, and corrections of each image (colours, camera pose) are read.
People and other deforming objects are left out, with their count in Scene.problems. World: the
model's, turned until z is up (see adapters.drivestudio.drive). Cameras are those of training:
pinholes of the size to which images were scaled, with their corrected poses.

Differences from the project's own renderer: it clamps each splat's colour, and the blend of the
splats, to at most 1; here brighter colours stay so until the image is written. It draws nothing
nearer than its near plane of 0.1 m.
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
from adapters.recorded_lenses import split_lenses
from adapters.uri import format_uri
from adapters.world import WorldChange, with_class_of
from augment.errors import AdapterError, SceneError
from augment.files.checkpoints import (
    checked_tensor,
    copy_mapped_tensor,
    dictionary_in,
    load_checkpoint,
)
from augment.render.composite import composite_sky
from augment.render.sh import SH_C0, rotate_sh
from augment.scene.cameras import Camera
from augment.scene.geometry import multiply_quats, quat_from_rotmat, rigid, rotmat_from_quat, slerp
from augment.scene.scene import NUM_SH_BY_DEGREE, Actor, Gaussians, Scene, Track, check_gaussians
from augment.scene.sky import (
    ConstantSky,
    CubemapSky,
    Sky,
    cubemap_coordinates,
    directions_of_cubemap,
)

# ---- The Gaussians of a run's models: tensors of a checkpoint, activated -------------------------

BACKGROUND = "Background"
RIGID = "RigidNodes"
OTHER_MODELS = ("Sky", "Affine", "CamPose", "CamPosePerturb")  # models without Gaussians
RIGID_KEYS = ("points_ids", "instances_size", "instances_fv", "instances_quats", "instances_trans")
_GAUSSIAN_KEYS = ("_means", "_scales", "_quats", "_opacities", "_features_dc", "_features_rest")
_REASONS_BY_MODEL = {
    "SMPLNodes": "people need the body model SMPL, which is licensed by itself",
    "DeformableNodes": "they deform over time",
}


def read_gaussians(
    content: Mapping[str, Any], *, step: int, sh_interval: int, where: str
) -> tuple[Gaussians, tuple[str, ...]]:
    """Return the Gaussians of one model as training rendered them, and sentences on what is left
    out.

    They are in the model's own axes, with unnormalised quaternions. Spherical harmonics are kept up
    to the degree that training had switched on: one degree for each sh_interval steps. Models
    without spherical harmonics have colours sigmoid(c); here they get the degree 0 that gives these
    colours.
    """
    unknown_keys = sorted(set(map(str, content)) - {*_GAUSSIAN_KEYS, *RIGID_KEYS})
    if unknown_keys:
        raise AdapterError(
            f"{where} holds {', '.join(unknown_keys[:6])} besides plain Gaussians: they change "
            f"over time in ways that are not known here. Known models are VanillaGaussians and "
            f"RigidNodes"
        )
    means = checked_tensor(content, "_means", (None, 3), where)
    count = len(means)
    sh_rest = checked_tensor(content, "_features_rest", (count, None, 3), where)
    if sh_rest.shape[1] + 1 not in NUM_SH_BY_DEGREE:
        raise AdapterError(
            f"{where}: _features_rest must have 0, 3, 8 or 15 rows (degrees 0 to 3 of spherical "
            f"harmonics); got {sh_rest.shape[1]}"
        )
    degree = NUM_SH_BY_DEGREE.index(sh_rest.shape[1] + 1)
    active_degree = min(step // sh_interval, degree)
    sh = torch.empty(count, NUM_SH_BY_DEGREE[active_degree], 3)
    copy_mapped_tensor(checked_tensor(content, "_features_dc", (count, 3), where), sh[:, 0])
    copy_mapped_tensor(sh_rest[:, : NUM_SH_BY_DEGREE[active_degree] - 1], sh[:, 1:])
    if degree == 0:
        sh.sigmoid_().sub_(0.5).div_(SH_C0)
    gaussians = Gaussians(
        means=copy_mapped_tensor(means),
        quats=copy_mapped_tensor(checked_tensor(content, "_quats", (count, 4), where)),
        scales=copy_mapped_tensor(checked_tensor(content, "_scales", (count, 3), where)).exp_(),
        opacities=copy_mapped_tensor(
            checked_tensor(content, "_opacities", (count, 1), where)
        ).sigmoid_()[:, 0],
        sh=sh,
    )
    if active_degree == degree:
        return gaussians, ()
    return gaussians, (
        f"{where}: training stopped at step {step}, before spherical harmonics of degree "
        f"{active_degree + 1} to {degree} were switched on; they are left out",
    )


def undrawn_models(models: Mapping[str, Any], where: str) -> list[str]:
    """Return a sentence for each model that is not drawn, with the number of its Gaussians."""
    sentences = []
    for name in models:
        if name in (BACKGROUND, RIGID, *OTHER_MODELS):
            continue
        means = dictionary_in(models, name, where).get("_means")
        is_count = isinstance(means, Tensor)
        subject = f"{len(means)} Gaussians of {name} are" if is_count else f"the model {name} is"
        reason = _REASONS_BY_MODEL.get(name, "models of this kind are not known here")
        sentences.append(f"{where}: {subject} left out: {reason}")
    return sentences


def rotate_to_actor(
    gaussians: Gaussians, object_from_actor: np.ndarray, scene_from_model: np.ndarray
) -> Gaussians:
    """Return an object's Gaussians in its actor's axes, with colours for directions of the
    scene's world.

    The project looks up spherical harmonics in directions of the world, however the object is
    turned. scene_from_model: [3, 3].
    """
    sh = gaussians.sh
    if gaussians.sh_degree > 0 and not np.array_equal(scene_from_model, np.eye(3)):
        sh = rotate_sh(sh, torch.from_numpy(scene_from_model))
    if np.array_equal(object_from_actor, np.eye(3)):
        return dataclasses.replace(gaussians, sh=sh)
    actor_from_object = torch.from_numpy(object_from_actor.T.copy())
    rotation_quat = quat_from_rotmat(actor_from_object).to(gaussians.quats.dtype)
    return dataclasses.replace(
        gaussians,
        means=gaussians.means @ actor_from_object.T.to(gaussians.means.dtype),
        quats=multiply_quats(rotation_quat.expand_as(gaussians.quats), gaussians.quats),
        sh=sh,
    )


# ---- Rigid objects of a run as actors: their tracks, and which of the data's objects they are ----

# Label of an object that is not identified with one of the data's.
_DEFAULT_LABEL = "vehicle"
# Largest difference of the sizes of one object.
_MAX_SIZE_DIFFERENCE_M = 0.01
# Training moves an object less far than this from where it was labelled.
_MAX_DISTANCE_M = 2.0
# The second-best candidate must be this many times as far away.
_MIN_DISTANCE_RATIO = 2.0


@dataclass(frozen=True, eq=False)
class RigidPoses:
    """Poses of I objects in the F frames of a run, in the model's world and their boxes' axes.

    Attributes:
        positions: float64 [F, I, 3].
        rotations: float64 [F, I, 3, 3].
        is_visible: bool [F, I].
        sizes_m: float64 [I, 3].
    """

    positions: np.ndarray
    rotations: np.ndarray
    is_visible: np.ndarray
    sizes_m: np.ndarray


def read_poses(content: Mapping[str, Any], run: Run, where: str) -> RigidPoses:
    """Read the poses with which frames are rendered.

    The pose in a frame that was not trained on is halfway between the frames before and after, if
    the object is visible in both and they are not the first and last frames. (The project turns the
    Gaussians themselves, but not their places, by such a frame's own untrained pose. Here one pose
    does both.)
    """
    is_visible = checked_tensor(content, "instances_fv", (None, None), where, dtype=torch.bool)
    frames, count = is_visible.shape
    if frames != len(run.frames):
        raise AdapterError(
            f"{where}: instances_fv has {frames} frames; {run.config_file} and {run.data} have "
            f"{len(run.frames)} ({run.frames.start} to {run.frames[-1]}). Is it the scene that the "
            f"run was trained on?"
        )
    quats = copy_mapped_tensor(
        checked_tensor(content, "instances_quats", (frames, count, 4), where)
    ).double()
    positions = copy_mapped_tensor(
        checked_tensor(content, "instances_trans", (frames, count, 3), where)
    ).double()
    sizes = copy_mapped_tensor(
        checked_tensor(content, "instances_size", (count, 3), where)
    ).double()
    is_visible = copy_mapped_tensor(is_visible)
    norms = quats.norm(dim=2)
    is_usable = torch.isfinite(positions).all(2) & torch.isfinite(norms) & (norms > 0)
    if not bool((is_usable | ~is_visible).all()) or not bool((sizes > 0).all()):
        raise AdapterError(f"{where}: poses or sizes of instances are NaN, infinite or zero")
    quats = torch.where(is_usable[..., None], quats, torch.tensor([1.0, 0, 0, 0]).double())
    positions = torch.where(is_usable[..., None], positions, torch.zeros(3).double())
    quats = quats / quats.norm(dim=2, keepdim=True)
    trained_quats = quats.clone()
    trained_positions = positions.clone()
    for position, number in enumerate(run.frames):
        if not run.is_held_out(number) or position < 2 or position + 1 >= frames:
            continue
        is_visible_around = (is_visible[position - 1] & is_visible[position + 1])[:, None]
        half_fraction = torch.full((count,), 0.5, dtype=torch.float64)
        middle_quats = slerp(
            trained_quats[position - 1], trained_quats[position + 1], half_fraction
        )
        quats[position] = torch.where(is_visible_around, middle_quats, quats[position])
        middle_positions = (trained_positions[position - 1] + trained_positions[position + 1]) / 2
        positions[position] = torch.where(is_visible_around, middle_positions, positions[position])
    return RigidPoses(
        positions.numpy(), rotmat_from_quat(quats).numpy(), is_visible.numpy(), sizes.numpy()
    )


def make_actors(
    gaussians: Gaussians,
    owners: np.ndarray,
    poses: RigidPoses,
    identities: Sequence[Instance | None],
    run: Run,
    where: str,
) -> tuple[list[Actor], list[str]]:
    """Return one actor for each object that has Gaussians and is visible in some frame, and
    sentences.

    A track has a knot at each frame's time, which is that of its images. The actor is absent from
    frames in which it is not visible.

    Args:
        gaussians: Gaussians of all objects.
        owners: int64 [N], the object of each of the Gaussians.
        poses: poses of the objects.
        identities: the data's object of each object.
        run: the run.
        where: the model, for messages.
    """
    actors = []
    problems = []
    absent_ids = []
    axes = run.convention.object_from_actor
    scene_rotation = scene_from_model(run)
    for index, identity in enumerate(identities):
        track_id = f"rigid-{index}"
        label = _DEFAULT_LABEL
        if identity is not None:
            track_id = identity.track_id
            label = identity.label
        rows = np.flatnonzero(owners == index)
        visible_frames = np.flatnonzero(poses.is_visible[:, index])
        if len(rows) == 0 or len(visible_frames) == 0:
            absent_ids.append(track_id)
            continue
        try:
            usable_gaussians, gaussian_problems = check_gaussians(
                gaussians.select(torch.from_numpy(rows)), where=f"{where} object {index}"
            )
        except SceneError as error:
            problems.append(str(error))
            continue
        problems += gaussian_problems
        rotations = poses.rotations[visible_frames, index] @ axes
        positions = poses.positions[visible_frames, index]
        actors.append(
            Actor(
                track_id=track_id,
                label=label,
                gaussians=with_class_of(
                    label, rotate_to_actor(usable_gaussians, axes, scene_rotation)
                ),
                track=Track(
                    torch.from_numpy(
                        (run.frames.start + visible_frames).astype(np.int64) * FRAME_NS
                    ),
                    rigid(
                        torch.from_numpy(scene_rotation @ rotations),
                        torch.from_numpy(positions @ scene_rotation.T),
                    ),
                    hold_ns=FRAME_NS // 2 - 1,  # the frame before and after are without it
                    max_gap_ns=FRAME_NS,
                ),
                size_m=tuple((poses.sizes_m[index] @ np.abs(axes)).tolist()),
                colors_in_world=True,
            )
        )
    if absent_ids:
        problems.append(
            f"{where}: objects without Gaussians, or visible in no frame, are no actors: "
            f"{', '.join(absent_ids)}"
        )
    return actors, problems


def identify(
    poses: RigidPoses, instances: Sequence[Instance], model_from_dataset: np.ndarray, frames: range
) -> list[Instance | None]:
    """Return the data's object of each of the model's objects. None if it is ambiguous.

    The model counts objects as it meets them in the LiDAR. An object of the data is the same if it
    is labelled in exactly the frames in which the model's is visible, has its mean size, and is
    near it throughout.
    """
    numbers = np.array(frames)
    matched_instances: list[Instance | None] = []
    for index in range(poses.is_visible.shape[1]):
        is_visible = poses.is_visible[:, index]
        candidates = []
        for instance in instances:
            is_in_run = np.isin(instance.frames, numbers)
            if (
                not np.array_equal(instance.frames[is_in_run], numbers[is_visible])
                or not is_in_run.any()
            ):
                continue
            size = instance.sizes_m[is_in_run].mean(0)
            if np.abs(size - poses.sizes_m[index]).max() > _MAX_SIZE_DIFFERENCE_M:
                continue
            positions = instance.poses[is_in_run, :3, 3] @ model_from_dataset[:3, :3].T
            offsets = positions + model_from_dataset[:3, 3] - poses.positions[is_visible, index]
            candidates.append((float(np.linalg.norm(offsets, axis=1).mean()), instance))
        candidates.sort(key=lambda candidate: candidate[0])
        is_clear = bool(candidates) and candidates[0][0] < _MAX_DISTANCE_M
        if is_clear and len(candidates) > 1:
            is_clear = (
                candidates[1][0] > _MIN_DISTANCE_RATIO * candidates[0][0] + _MAX_SIZE_DIFFERENCE_M
            )
        matched_instances.append(candidates[0][1] if is_clear else None)
    times_taken = Counter(
        instance.track_id for instance in matched_instances if instance is not None
    )
    return [None if i is None or times_taken[i.track_id] > 1 else i for i in matched_instances]


# ---- The sky of a run as a cube map of the scene's world -----------------------------------------
# drivestudio looks a direction (x, y, z) of its world up at (x, z, -y), in nvdiffrast's faces.
# Where the scene's world differs from it by a permutation of axes, both turns together take texels
# to texels, and no colour is interpolated.

_LOOKUP_FROM_MODEL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
# Texels along an edge of a baked sky network.
_BAKED_FACE_SIZE = 256
# Largest number of texels along an edge.
_MAX_FACE_SIZE = 8192
# Octaves of the sky network's directions: frequencies 1 to 64.
_NUM_OCTAVES = 7


def read_sky(
    models: Mapping[str, Any], scene_from_model: np.ndarray, where: str
) -> tuple[Sky, tuple[str, ...]]:
    """Return the sky of a checkpoint's models, and sentences on what is not as it was trained.

    The sky is black if there is none of a known kind. scene_from_model: [3, 3], a rotation.
    """
    black = ConstantSky(torch.zeros(3))
    if "Sky" not in models:
        return black, (f"{where} holds no Sky; the sky is black",)
    content = dictionary_in(models, "Sky", where)
    where = f"{where} Sky"
    if "base" in content:
        base = checked_tensor(content, "base", (6, None, None, 3), where)
        if base.shape[1] != base.shape[2] or not 1 <= base.shape[1] <= _MAX_FACE_SIZE:
            raise AdapterError(
                f"{where}: base must be [6, R, R, 3] with R from 1 to {_MAX_FACE_SIZE}; "
                f"got {list(base.shape)}"
            )
        faces = copy_mapped_tensor(base)
        if not bool(torch.isfinite(faces).all()):
            raise AdapterError(f"{where}: base holds NaN or infinite numbers")
        return CubemapSky(rotate_cubemap(faces, _LOOKUP_FROM_MODEL @ scene_from_model.T)), ()
    if "sky_head.layers.0.weight" in content:
        return _bake_network_sky(content, scene_from_model, where)
    keys = ", ".join(map(str, list(content)[:6])) or "nothing"
    return black, (f"{where} is of a kind that is not known here ({keys}); the sky is black",)


def rotate_cubemap(faces: Tensor, source_from_target: np.ndarray) -> Tensor:
    """Return a cube map that shows in direction d what `faces` show in source_from_target @ d.

    The result is exact if the rotation is a permutation of axes with signs; else it is sampled at
    the middle of each texel.

    Args:
        faces: [6, R, R, 3].
        source_from_target: [3, 3], a rotation.
    """
    rotated_faces = torch.empty_like(faces)
    if np.isin(source_from_target, (-1.0, 0.0, 1.0)).all():
        # Found on a cube map of two texels an edge: where four texels go, all do.
        rotation = torch.from_numpy(source_from_target).float()
        face, s, t = cubemap_coordinates(directions_of_cubemap(2) @ rotation.T)
        texels = torch.arange(24).reshape(6, 2, 2)
        for target, texel_order in enumerate(face * 4 + (t > 0) * 2 + (s > 0)):
            for source, quarters in itertools.product(range(6), range(4)):
                if torch.equal(torch.rot90(texels[source], quarters), texel_order):
                    rotated_faces[target] = torch.rot90(faces[source], quarters)
        return rotated_faces
    # Each face as a camera of 90 degrees sees it; a face is the mirror image of such a picture.
    size = faces.shape[1]
    for face, corners in enumerate(directions_of_cubemap(2).double()):
        left_axis = corners[0, 0] - corners[0, 1]
        down_axis = corners[1, 0] - corners[0, 0]
        axes = torch.nn.functional.normalize(
            torch.stack([left_axis, down_axis, corners.sum((0, 1))])
        )
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = axes @ torch.from_numpy(source_from_target.T.copy())
        camera = Camera("face", size, size, *[size / 2] * 4, camera_from_world=pose)
        empty = torch.zeros(size, size, 3)
        rotated_faces[face] = composite_sky(empty, empty[..., 0], camera, CubemapSky(faces)).flip(1)
    return rotated_faces


def _bake_network_sky(
    content: Mapping[str, Any], scene_from_model: np.ndarray, where: str
) -> tuple[Sky, tuple[str, ...]]:
    """Return the sky network's colours with 256 texels a face, and the mean of its images'
    appearances.
    """
    appearance = torch.zeros(0)
    problems = ()
    if "appearance_embedding.weight" in content:
        embeddings = copy_mapped_tensor(
            checked_tensor(content, "appearance_embedding.weight", (None, None), where)
        )
        appearance = embeddings.mean(0)
        if bool((embeddings != appearance).any()):
            problems = (
                f"{where}: the sky differed from image to image; it has their mean appearance, as "
                f"the project gives it to images that were not trained on",
            )
    num_inputs = 3 + 6 * _NUM_OCTAVES + len(appearance)
    num_hidden = checked_tensor(
        content, "sky_head.layers.0.weight", (None, num_inputs), where
    ).shape[0]
    shapes = ((num_hidden, num_inputs), (num_hidden, num_hidden + num_inputs), (3, num_hidden))
    layers = [
        (
            copy_mapped_tensor(
                checked_tensor(content, f"sky_head.layers.{i}.weight", shape, where)
            ),
            copy_mapped_tensor(
                checked_tensor(content, f"sky_head.layers.{i}.bias", shape[:1], where)
            ),
        )
        for i, shape in enumerate(shapes)
    ]
    rotation = torch.from_numpy(scene_from_model).float()
    faces = torch.stack(
        [
            _network(directions.reshape(-1, 3) @ rotation, appearance, layers)
            for directions in directions_of_cubemap(_BAKED_FACE_SIZE)
        ]
    )
    if not bool(torch.isfinite(faces).all()):
        raise AdapterError(f"{where}: the sky's network gives NaN or infinite colours")
    return CubemapSky(faces.reshape(6, _BAKED_FACE_SIZE, _BAKED_FACE_SIZE, 3)), problems


def _network(directions: Tensor, appearance: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Return colours [N, 3] of unit directions [N, 3] of the model's world."""
    scales = 2.0 ** torch.arange(_NUM_OCTAVES)
    waves = (directions[:, None, :] * scales[:, None]).reshape(len(directions), -1)
    encoded = torch.cat([directions, waves.sin(), (waves + 0.5 * torch.pi).sin()], 1)
    inputs = torch.cat([encoded, appearance.expand(len(directions), -1)], 1)
    (first_weights, first_bias), (middle_weights, middle_bias), (last_weights, last_bias) = layers
    activations = (inputs @ first_weights.T + first_bias).relu()
    activations = (torch.cat([activations, inputs], 1) @ middle_weights.T + middle_bias).relu()
    return (activations @ last_weights.T + last_bias).sigmoid()


# ---- The scene -----------------------------------------------------------------------------------


def open_drivestudio(path: str, query: dict[str, str]) -> Scene:
    """Open the scene of a run's folder, or of a checkpoint in it.

    Args:
        path: the folder or checkpoint. In a folder the checkpoint is the final one, else the
            newest.
        query: data, checkpoint, frames; see RunOptions.

    Raises:
        AdapterError: an option is wrong; a config, checkpoint or calibration is missing or not the
            project's; or the data are of another scene. What is left out is listed in
            Scene.problems.
        SceneError: no Gaussians are usable.
    """
    options = RunOptions.from_query("drivestudio", query)
    run = find_run(Path(path), options)
    numbers = options.frames.select(run.frames, where=f"drivestudio:{path}").numbers
    content = load_checkpoint(run.checkpoint)
    where = str(run.checkpoint)
    step = content.get("step")
    if type(step) is not int or step < 0:
        raise AdapterError(f"{where}: step must be a number of training steps; got {step!r}")
    models = dictionary_in(content, "models", where)
    corrections = read_corrections(models, run, where)
    frames, frame_problems = read_drive(run, numbers, corrections, options.lens)
    lens_frames = split_lenses(
        run.folder.absolute().name,
        frames,
        options.lens,
        published=f"the images that {run.folder} was trained on",
    )
    color_maps, image_color_maps = corrections.maps_of(run, frames)
    sky, sky_problems = read_sky(models, scene_from_model(run), where)
    background, background_problems = read_gaussians(
        dictionary_in(models, BACKGROUND, where),
        step=step,
        sh_interval=run.sh_interval(BACKGROUND),
        where=f"{where} {BACKGROUND}",
    )
    background, unusable_problems = check_gaussians(background, where=f"{where} {BACKGROUND}")
    change = WorldChange(rotation=scene_from_model(run))
    actors, actor_problems = _actors(models, run, step, where)
    renderer_problems = []
    if run.is_set("trainer.render.antialiased"):
        renderer_problems = [
            f"{run.config_file}: the run was trained with trainer.render.antialiased, which draws "
            f"small splats fainter than they are drawn here; a recipe's render: "
            f"{{speed: {{antialiased: true}}}} does the same"
        ]
    return Scene(
        name=run.folder.absolute().name,
        source=format_uri("drivestudio", path, query),
        background=change.gaussians(background, np.zeros(3)),
        actors=tuple(actors),
        sky=sky,
        frames=frames,
        seen_frames=lens_frames.frames if lens_frames.recorded_frames is not None else None,
        labels=DriveStudioLabels(run),
        color_maps=color_maps,
        image_color_maps=image_color_maps,
        problems=(
            *undrawn_models(models, where),
            *background_problems,
            *unusable_problems,
            *actor_problems,
            *sky_problems,
            *corrections.problems,
            *frame_problems,
            *lens_frames.notes,
            *renderer_problems,
        ),
        made_by={
            "method": "drivestudio",
            "checkpoint": where,
            "step": step,
            "config": str(run.config_file),
        },
    )


def drivestudio_labels(path: str, query: dict[str, str]) -> DriveStudioLabels:
    """Return the labels of a run's data. They cover all frames, whatever the query asks for.

    Raises:
        AdapterError: as for open_drivestudio, as far as config and data are concerned.
    """
    return DriveStudioLabels(find_run(Path(path), RunOptions.from_query("drivestudio", query)))


def _actors(
    models: Mapping[str, Any], run: Run, step: int, where: str
) -> tuple[list[Actor], list[str]]:
    """Return the actors of a run's rigid objects, and sentences."""
    if RIGID not in models:
        return [], []
    content = dictionary_in(models, RIGID, where)
    where = f"{where} {RIGID}"
    gaussians, problems = read_gaussians(
        content, step=step, sh_interval=run.sh_interval(RIGID), where=where
    )
    poses = read_poses(content, run, where)
    ids = checked_tensor(content, "points_ids", (len(gaussians), 1), where, dtype=torch.int64)
    owners = copy_mapped_tensor(ids)[:, 0].numpy()
    count = poses.is_visible.shape[1]
    if len(owners) and not 0 <= owners.min() <= owners.max() < count:
        raise AdapterError(
            f"{where}: points_ids must be 0 to {count - 1}, one of the {count} objects; got "
            f"{owners.min()} to {owners.max()}"
        )
    instances = read_instances(run.data)
    identities = identify(poses, list(instances.values()), model_from_dataset(run), run.frames)
    unknown_ids = [f"rigid-{i}" for i, identity in enumerate(identities) if identity is None]
    if unknown_ids:
        reason = "" if instances else f" ({run.data} holds no instances/instances_info.json)"
        problems += (
            f"{where}: which of the data's objects these are could not be told{reason}, so that no "
            f"box is known to be theirs: {', '.join(unknown_ids)}",
        )
    actors, actor_problems = make_actors(gaussians, owners, poses, identities, run, where)
    return actors, [*problems, *actor_problems]
