"""A trained model: its options, configuration and files, and what they hold."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from adapters.camera_files.camera_files import validate
from adapters.plain_files import read_yaml
from adapters.raw_drive import DriveOptions
from adapters.street_gaussians.data import ModelConfig
from adapters.uri import check_query, choice_of, whole_number_of
from augment.errors import AdapterError, SceneError
from augment.files.checkpoints import load_checkpoint, release, section, taken, tensor
from augment.files.ply import (
    PlyElement,
    PlyHeader,
    count_surplus_bytes,
    iterate_rows,
    read_ply_header,
)
from augment.geometry import rotmat_from_quat
from augment.scene import SH_COUNTS, Gaussians, check_gaussians, drawable_rows, is_drawable

# ---- What the URI of a trained model may ask for -----------------------------------------------

SCHEME = "street_gaussians"
DEFAULT_WIDTH = 1600
_KEYS = {
    "data": "the dataset's folder, where it is not where the configuration says",
    "iteration": "which of the saved iterations, a number; the newest without it",
    "weights": "pth or ply; the .pth where there is one",
    "width": f"images are at most so many pixels wide, {DEFAULT_WIDTH} without it; 0 as recorded",
    "frames": "first:stop, frame numbers with stop excluded, either side may be empty",
    "rotation_bug": "0 or 1; actors turned as an older release of the project turned them",
}


@dataclass(frozen=True)
class ModelOptions:
    """Options of one opening; see _KEYS. width: 0 for as recorded."""

    data: Path | None = None
    iteration: int | None = None
    weights: str | None = None
    width: int = DEFAULT_WIDTH
    frames: DriveOptions = field(default_factory=DriveOptions)
    rotation_bug: bool = False

    @staticmethod
    def from_query(query: dict[str, str]) -> ModelOptions:
        check_query(SCHEME, query, _KEYS)
        frames = {"frames": query["frames"]} if "frames" in query else {}
        return ModelOptions(
            data=Path(query["data"]).expanduser() if "data" in query else None,
            iteration=whole_number_of(SCHEME, query, "iteration"),
            weights=choice_of(SCHEME, query, "weights", ("pth", "ply")),
            width=whole_number_of(SCHEME, query, "width", DEFAULT_WIDTH),
            frames=DriveOptions.from_query(SCHEME, frames),
            rotation_bug=choice_of(SCHEME, query, "rotation_bug", ("0", "1")) == "1",
        )


# ---- The configuration that a model was trained with: configs/config_{iteration:06d}.yaml --------

_NAME = re.compile(r"config_(\d+)\.yaml")


def newest_config(model: Path) -> Path:
    """The configuration of a model's folder; of several the one of the latest iteration."""
    files = (model / "configs").glob("config_*.yaml")
    found = {int(match[1]): path for path in files if (match := _NAME.fullmatch(path.name))}
    if not found:
        raise AdapterError(
            f"{model / 'configs'} holds no config_*.yaml; which column of the actors' poses "
            f"belongs to which object depends on it. Copy the folder configs/ of the training's "
            f"output to {model}"
        )
    return found[max(found)]


def read_config(path: Path) -> ModelConfig:
    """What of a configuration decides how its model is read; keys that it lacks or has as null
    have the project's defaults."""
    tree, given = read_yaml(path), {}
    for field_name, entry in ModelConfig.model_fields.items():
        key = entry.alias or field_name
        found: Any = tree
        for name in key.split("."):
            if found is not None and not isinstance(found, Mapping):
                raise AdapterError(
                    f"{path}: {key} must be a key inside a section; got {str(found)[:80]!r}"
                )
            found = None if found is None else found.get(name)
        if found is not None:
            given[key] = found
    return validate(ModelConfig, given, path, "configuration of a Street Gaussians training")


# ---- Where the files of a trained model are ------------------------------------------------------

_PTH, _PLY = re.compile(r"iteration_(\d+)\.pth"), re.compile(r"iteration_(\d+)")
_DATA_FOLDERS = ("ego_pose", "extrinsics", "track")


@dataclass(frozen=True)
class ModelFiles:
    """weights: a .pth or .ply. data: the folder of the dataset."""

    folder: Path
    weights: Path
    iteration: int | None
    config_file: Path
    config: ModelConfig
    data: Path


def is_dataset(path: Path) -> bool:
    """Whether a path is a dataset's folder and no model's."""
    return all((path / name).is_dir() for name in _DATA_FOLDERS) and not _saved(path)


def find_model(path: Path, options: ModelOptions) -> ModelFiles:
    """The files of a model, given its folder or its weights."""
    folder, weights, iteration = _find_weights(path, options)
    config_file = newest_config(folder)
    config = read_config(config_file)
    data = options.data or Path(config.source_path)
    if options.data is not None and not data.is_dir():
        raise AdapterError(f"data={data}: no such folder; expected the model's dataset")
    if options.data is None and not (config.source_path and data.is_dir()):
        raise AdapterError(
            f"{config_file}: source_path {config.source_path!r} is not here; the model needs "
            f"poses, tracks and cameras of its dataset. Give its folder as data=DIR"
        )
    return ModelFiles(folder, weights, iteration, config_file, config, data)


def _find_weights(path: Path, options: ModelOptions) -> tuple[Path, Path, int | None]:
    """The model's folder, its weights and their iteration, where their name says it."""
    if path.is_file():
        if options.iteration is not None or options.weights is not None:
            raise AdapterError(
                f"{path} is one file, so iteration= and weights= say nothing; give the model's "
                f"folder or leave them out"
            )
        match path.suffix.lower():
            case ".pth":
                named = _PTH.fullmatch(path.name)
            case ".ply":
                named = _PLY.fullmatch(path.parent.name)
            case _:
                raise AdapterError(f"{path}: expected a model's folder, .pth or .ply")
        folders = path.absolute().parents[:3]
        folder = next((folder for folder in folders if (folder / "configs").is_dir()), folders[-1])
        return folder, path, int(named[1]) if named else None
    saved = _saved(path)
    if not saved:
        raise AdapterError(
            f"{path} is no Street Gaussians model and no dataset of one: expected "
            f"trained_model/iteration_N.pth or point_cloud/iteration_N/point_cloud.ply in it, or "
            f"{', '.join(f'{name}/' for name in _DATA_FOLDERS)}"
        )
    kind = options.weights or ("pth" if any(kind == "pth" for kind, _ in saved) else "ply")
    of_kind = {number: file for (k, number), file in saved.items() if k == kind}
    if not of_kind:
        raise AdapterError(f"{path} holds no .{kind} of a saved iteration; give the other weights=")
    iteration = max(of_kind) if options.iteration is None else options.iteration
    if iteration not in of_kind:
        known = ", ".join(map(str, sorted(of_kind)))
        raise AdapterError(f"{path} has no .{kind} of iteration {iteration}; it has {known}")
    return path, of_kind[iteration], iteration


def _saved(folder: Path) -> dict[tuple[str, int], Path]:
    """Weights by kind and iteration."""
    files = [("pth", file, file.name) for file in folder.glob("trained_model/iteration_*.pth")]
    for file in folder.glob("point_cloud/iteration_*/point_cloud.ply"):
        files.append(("ply", file, file.parent.name))
    pattern = {"pth": _PTH, "ply": _PLY}
    return {(k, int(m[1])): file for k, file, name in files if (m := pattern[k].fullmatch(name))}


# ---- Tables of a trained model beside its Gaussians: poses, sky, colour and pose correction ------

_ACTOR = re.compile(r"obj_(\d{3,9})")


def actor_id(name: str) -> int | None:
    """The track id in a part's name, such as obj_003; None for other names."""
    match = _ACTOR.fullmatch(name)
    number = int(match[1]) if match else None
    return number if number is not None and name == f"obj_{number:03d}" else None


class Parameters:
    """Networks and tables of a checkpoint beside its Gaussians, with sentences about them."""

    def __init__(
        self, content: Mapping[str, Any], path: Path, config: ModelConfig, problems: list[str]
    ) -> None:
        self.path, self.config, self.problems = path, config, problems
        self._content = content
        self.seen = {"background", "iter"}

    def of(self, name: str, switch: str) -> Mapping[str, Any] | None:
        """The table `params` of an entry. switch: what of the configuration says if it is used."""
        self.seen.add(name)
        key = ModelConfig.model_fields[switch].alias
        if not getattr(self.config, switch):
            if self._content.get(name):
                self.problems.append(
                    f"{self.path}: {name} is left out, as the configuration has not {key}"
                )
            return None
        if name not in self._content:
            raise AdapterError(
                f"{self.path} lacks {name!r}, although the configuration has {key}; it holds "
                f"{', '.join(map(str, list(self._content)[:12]))}. Copy the model and its "
                f"configs/ from the same training"
            )
        entry = section(self._content, name, str(self.path))
        return section(entry, "params", f"{self.path}, {name}")

    def numbers(
        self, params: Mapping[str, Any], name: str, key: str, shape: Sequence[int | None]
    ) -> np.ndarray:
        """A small table, float64."""
        where = f"{self.path}, {name}.params"
        found = tensor(params, key, shape, where).double().numpy()
        if not np.isfinite(found).all():
            raise AdapterError(f"{where}: {key} holds NaN or infinite numbers")
        return found

    def report_unknown(self) -> None:
        names = [name for name in self._content if name not in self.seen]
        names = [str(name) for name in names if actor_id(str(name)) is None]
        if names:
            self.problems.append(
                f"{self.path} also holds {', '.join(names[:8])}, which is not used: expected "
                f"background, obj_000 ..., actor_pose, sky_cubemap, color_correction, "
                f"pose_correction and iter"
            )


class PoseChanges(NamedTuple):
    """What training added to the poses of each frame and column of the tracklets.

    positions: float64 [F, M, 3], metres, vehicle frame. half_turns: float64 [F, M], radians about
    the object's z; it turns by twice as much.
    """

    positions: np.ndarray
    half_turns: np.ndarray


def read_pose_changes(parameters: Parameters, *, has_actors: bool) -> PoseChanges | None:
    """What training added to the actors' poses; None where it left them."""
    if not has_actors:
        parameters.seen.add("actor_pose")
        return None
    params = parameters.of("actor_pose", "opt_track")
    if params is None:
        return None
    positions = parameters.numbers(params, "actor_pose", "opt_trans", (None, None, 3))
    shape = (*positions.shape[:2], 1)
    half_turns = parameters.numbers(params, "actor_pose", "opt_rots", shape)
    return PoseChanges(positions, half_turns[..., 0])


def read_sky(parameters: Parameters) -> Tensor | None:
    """Faces of the sky, float32 [6, R, R, 3] in [0, 1]; None where there is none that can be used.

    The project clamps what it looks up; clamped texels are the same but between texels of which
    only some are out of range.
    """
    params = parameters.of("sky_cubemap", "include_sky")
    if params is None:
        return None
    where = f"{parameters.path}, sky_cubemap.params"
    if any(str(key) == "sky_codebook" or str(key).startswith("mlp_shader") for key in params):
        parameters.problems.append(
            f"{where}: a sky made of a codebook and a network is not supported; the sky has the "
            f"background's colour instead"
        )
        return None
    faces = tensor(params, "sky_cube_map", (6, None, None, 3), where)
    if faces.shape[1] != faces.shape[2] or faces.shape[1] == 0:
        raise AdapterError(
            f"{where}: sky_cube_map must be float32 [6, R, R, 3]; got {list(faces.shape)}"
        )
    own = torch.empty(faces.shape)
    for face in range(6):
        taken(faces[face], own[face])
    if not np.isfinite([own.numpy().min(), own.numpy().max()]).all():
        raise AdapterError(f"{where}: sky_cube_map holds NaN or infinite numbers")
    return own.clamp_(0, 1)


def read_color_maps(parameters: Parameters) -> Tensor | None:
    """Colour maps float32 [n, 3, 4]; None where there are none that can be used."""
    name = "color_correction"
    params = parameters.of(name, "use_color_correction")
    if params is None:
        return None
    is_network = any(str(key).startswith("affine_trans.") for key in params)
    if parameters.config.color_correction_mlp or is_network:
        parameters.problems.append(
            f"{parameters.path}, {name}: colour correction by a network is not supported and left "
            f"out; images have the scene's own colours"
        )
        return None
    maps = parameters.numbers(params, name, "affine_trans", (None, 3, 4))
    return torch.from_numpy(maps.astype(np.float32))


def read_camera_changes(parameters: Parameters) -> np.ndarray | None:
    """What the background is moved by before an image is taken, float64 [n, 4, 4]."""
    name = "pose_correction"
    params = parameters.of(name, "use_pose_correction")
    if params is None:
        return None
    centres = parameters.numbers(params, name, "pose_correction_trans", (None, 3))
    quats = parameters.numbers(params, name, "pose_correction_rots", (len(centres), 4))
    if (np.linalg.norm(quats, axis=1) == 0).any():
        raise AdapterError(
            f"{parameters.path}, {name}.params: pose_correction_rots holds a quaternion of zeros"
        )
    changes = np.tile(np.eye(4), (len(centres), 1, 1))
    changes[:, :3, :3] = rotmat_from_quat(torch.from_numpy(quats)).numpy()
    changes[:, :3, 3] = centres
    return changes


# ---- One trained part, the background or an actor: from the numbers in a file to Gaussians -------

_ROWS = 1 << 15  # Gaussians changed at a time: temporaries of a few megabytes


@dataclass(frozen=True, eq=False)
class Part:
    """terms [N, F - 1, 3]: further Fourier terms of the colours; None where F is 1."""

    gaussians: Gaussians
    terms: Tensor | None


def allocate(count: int, sh_count: int, term_count: int) -> tuple[dict[str, Tensor], Tensor | None]:
    """Memory of a part's numbers, to be filled as they stand in a file: log scales, opacity logits,
    quaternions of any length. Named as in Gaussians; the second are the terms."""
    arrays = {
        "means": torch.empty(count, 3),
        "quats": torch.empty(count, 4),
        "scales": torch.empty(count, 3),
        "opacities": torch.empty(count),
        "sh": torch.empty(count, sh_count, 3),
    }
    return arrays, torch.empty(count, term_count - 1, 3) if term_count > 1 else None


def check_counts(where: str, rest: int, terms: int, *, is_background: bool) -> None:
    """rest: SH coefficients above the constant one. terms: F."""
    if rest + 1 not in SH_COUNTS:
        known = ", ".join(str(count - 1) for count in SH_COUNTS)
        raise AdapterError(
            f"{where}: feature_rest must have {known} coefficients a channel (SH degrees 0 to 3); "
            f"got {rest}"
        )
    if terms < 1 or (is_background and terms > 1):
        expected = "1 colour term" if is_background else "1 colour term or more"
        raise AdapterError(f"{where}: feature_dc must have {expected}; got {terms}")


def finish_part(
    arrays: Mapping[str, Tensor], terms: Tensor | None, where: str, *, is_background: bool
) -> tuple[Part | None, tuple[str, ...]]:
    """Activate the numbers in place and leave out what cannot be drawn, with a sentence each.

    None for an actor of which nothing usable remains; of a background that is an error.
    """
    arrays["scales"].exp_()
    arrays["opacities"].sigmoid_()
    means, quats = arrays["means"].numpy(), arrays["quats"].numpy()
    for start in range(0, len(quats), _ROWS):
        rows = slice(start, start + _ROWS)
        # In float64, where lengths of any float32 neither overflow nor vanish.
        lengths = np.sqrt(np.einsum("ni,ni->n", quats[rows], quats[rows], dtype=np.float64))
        lengths[lengths == 0] = 1  # such a quaternion is left out later
        quats[rows] /= lengths[:, None]
        if terms is not None:  # colours that are not numbers at some time cannot be drawn
            means[rows][~np.isfinite(terms[rows].numpy()).all((1, 2))] = np.nan
    gaussians = Gaussians(**arrays)
    if len(gaussians) and is_drawable(gaussians):
        return Part(gaussians, terms), ()
    try:
        kept, problems = check_gaussians(gaussians, where=where)
    except SceneError as error:
        if is_background:
            raise AdapterError(str(error)) from None
        return None, (f"{error} It is left out",)
    return Part(kept, None if terms is None else terms[drawable_rows(gaussians)]), problems


# ---- A whole model -------------------------------------------------------------------------------

_TENSORS = ("xyz", "feature_dc", "feature_rest", "scaling", "rotation", "opacity", "semantic")
_TRAINING = (
    "spatial_lr_scale", "denom", "max_radii2D", "xyz_gradient_accum", "active_sh_degree",
    "optimizer",
)  # fmt: skip
_PIECE = 1 << 18  # numbers copied at a time


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A model as its file has it. None and empty stand for what it lacks or what is not used.

    actors: by track id. sky: faces of a cube map, float32 [6, R, R, 3]. color_maps: float32
    [n, 3, 4]. camera_changes: float64 [n, 4, 4], rigid: what the background is moved by. problems:
    a sentence each.
    """

    file: Path
    background: Part
    actors: Mapping[int, Part]
    pose_changes: PoseChanges | None = None
    sky: Tensor | None = None
    color_maps: Tensor | None = None
    camera_changes: np.ndarray | None = None
    problems: Sequence[str] = ()


def read_checkpoint(path: Path, config: ModelConfig) -> TrainedModel:
    """Read a .pth. Nothing in it is run; the optimiser's state is not looked at."""
    content = load_checkpoint(path)
    if "background" not in content:
        keys = ", ".join(map(str, list(content)[:12])) or "nothing"
        raise AdapterError(
            f"{path} lacks 'background', so it is no Street Gaussians model of a known version; it "
            f"holds {keys}. Expected background, obj_000 ..., actor_pose, sky_cubemap"
        )
    problems: list[str] = []
    background, found = _read_part(section(content, "background", str(path)), path, "background")
    problems += found
    actors = {}
    for name in content:
        number = actor_id(name) if isinstance(name, str) else None
        if number is None:
            continue
        part, found = _read_part(section(content, name, str(path)), path, name)
        problems += found
        if part is not None:
            actors[number] = part
    assert background is not None
    parameters = Parameters(content, path, config, problems)
    model = TrainedModel(
        file=path,
        background=background,
        actors=actors,
        pose_changes=read_pose_changes(parameters, has_actors=bool(actors)),
        sky=read_sky(parameters),
        color_maps=read_color_maps(parameters),
        camera_changes=read_camera_changes(parameters),
        problems=problems,
    )
    parameters.report_unknown()
    return model


def _read_part(content: Mapping[str, Any], path: Path, name: str) -> tuple[Part | None, list[str]]:
    """A part, None for an actor without usable Gaussians, and sentences."""
    where = f"{path}, {name}"
    means = tensor(content, "xyz", (None, 3), where)
    count = len(means)
    colours = tensor(content, "feature_dc", (count, None, 3), where)
    rest = tensor(content, "feature_rest", (count, None, 3), where)
    scales = tensor(content, "scaling", (count, 3), where)
    quats = tensor(content, "rotation", (count, 4), where)
    logits = tensor(content, "opacity", (count, 1), where)
    is_background = name == "background"
    check_counts(where, rest.shape[1], colours.shape[1], is_background=is_background)
    problems = []
    semantic = content.get("semantic")
    if isinstance(semantic, Tensor) and semantic.dim() == 2 and semantic.shape[1] > 0:
        problems.append(f"{where}: its semantic features are not used")
    if unknown := [str(key) for key in content if key not in (*_TENSORS, *_TRAINING)]:
        problems.append(f"{where}: it also holds {', '.join(unknown[:8])}, which is not used")
    if count == 0 and not is_background:
        return None, [*problems, f"{where}: it has no Gaussians and is left out"]
    arrays, terms = allocate(count, 1 + rest.shape[1], colours.shape[1])
    for name, source in (("means", means), ("scales", scales), ("quats", quats)):
        taken(source, arrays[name])
    taken(logits, arrays["opacities"][:, None])
    _split(colours, arrays["sh"][:, :1], terms)
    _split(rest, arrays["sh"][:, 1:], None)
    part, found = finish_part(arrays, terms, where, is_background=is_background)
    return part, [*problems, *found]


def _split(source: Tensor, first: Tensor, further: Tensor | None) -> None:
    """Copy [N, T, 3] into two, memory given back as it goes. first takes as many as fit."""
    count = first.shape[1]
    rows = max(1, _PIECE // max(1, source[:1].numel()))
    for start in range(0, len(source), rows):
        piece = source[start : start + rows]
        first[start : start + rows] = piece[:, :count]
        if further is not None:
            further[start : start + rows] = piece[:, count:]
        if piece.is_contiguous():
            release(piece)


# ---- point_cloud/iteration_N/point_cloud.ply: an element for each part, such as vertex_obj_003 ---
# It has no sky, no colour correction and not what training added to poses.

_PREFIX = "vertex_"
_FIXED = (
    *"xyz", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)),
)  # fmt: skip
_NUMBERED = re.compile(r"(f_dc|f_rest|semantic)_(0|[1-9]\d{0,6})")


def read_ply_model(path: Path, config: ModelConfig) -> TrainedModel:
    """Read a .ply in pieces."""
    try:
        header = read_ply_header(path)
        elements = {e.name.removeprefix(_PREFIX): e for e in header.elements if _is_part(e)}
        if "background" not in elements:
            names = [element.name for element in header.elements]
            hint = ""
            if "vertex" in names:
                hint = f". A .ply with one element 'vertex' opens as gaussians:{path}"
            raise AdapterError(
                f"{path} is no Street Gaussians model: expected an element vertex_background and "
                f"one such as vertex_obj_003 for each actor; found "
                f"{', '.join(names[:12]) or 'none'}{hint}"
            )
        trained = {
            "the actors' learnt poses": config.opt_track,
            "the sky": config.include_sky,
            "the colour correction": config.use_color_correction,
            "the pose correction": config.use_pose_correction,
        }
        problems = [f"{path}: a .ply holds Gaussians only"]
        if lost := ", ".join(name for name, was_trained in trained.items() if was_trained):
            problems[0] += f"; left out: {lost}. They are in trained_model/iteration_N.pth"
        others = [e.name for e in header.elements if not _is_part(e)]
        if others:
            problems.append(f"{path} also holds {', '.join(others[:8])}, which is not used")
        parts: dict[str, Part] = {}
        for name, element in elements.items():
            part, found = _read_ply_part(header, element, name)
            problems += found
            if part is not None:
                parts[name] = part
    except AdapterError:
        raise
    except SceneError as error:
        raise AdapterError(str(error)) from None
    surplus = count_surplus_bytes(header)
    if surplus:
        problems.append(f"{path}: {surplus} bytes follow its rows and were ignored")
    background = parts.pop("background")
    actors = {int(name.removeprefix("obj_")): part for name, part in parts.items()}
    return TrainedModel(path, background, actors, problems=problems)


def _is_part(element: PlyElement) -> bool:
    name = element.name.removeprefix(_PREFIX)
    return element.name.startswith(_PREFIX) and (name == "background" or actor_id(name) is not None)


def _read_ply_part(
    header: PlyHeader, element: PlyElement, name: str
) -> tuple[Part | None, list[str]]:
    """A part, None for an actor without usable Gaussians, and sentences."""
    where, is_background = f"{header.path}, {element.name}", name == "background"
    colours, rest, semantic = _count_columns(element, where)
    check_counts(where, rest, colours, is_background=is_background)
    problems = [f"{where}: its semantic features are not used"] if semantic else []
    if element.count == 0 and not is_background:
        return None, [*problems, f"{where}: it has no Gaussians and is left out"]
    arrays: dict[str, Tensor] = {}
    terms: Tensor | None = None
    done = 0
    for rows in iterate_rows(header, element.name):
        if not arrays:  # only now is the file known to be as long as its header says
            arrays, terms = allocate(element.count, 1 + rest, colours)
        _scatter(rows, arrays, terms, slice(done, done + len(rows)))
        done += len(rows)
    if not arrays:
        arrays, terms = allocate(0, 1 + rest, colours)
    part, found = finish_part(arrays, terms, where, is_background=is_background)
    return part, [*problems, *found]


def _count_columns(element: PlyElement, where: str) -> tuple[int, int, int]:
    """Colour terms F, coefficients above the constant one, and semantic columns."""
    missing = [name for name in _FIXED if name not in element.names]
    numbers: dict[str, list[int]] = {"f_dc": [], "f_rest": [], "semantic": []}
    for name in element.names:
        if match := _NUMBERED.fullmatch(name):
            numbers[match[1]].append(int(match[2]))
    if missing or not numbers["f_dc"]:
        lost = [*missing[:8], *([] if numbers["f_dc"] else ["f_dc_0"])]
        raise AdapterError(
            f"{where}: not the Gaussians of a model: {', '.join(lost)} "
            f"missing; it has {', '.join(element.names[:12]) or 'no properties'}"
        )
    for name in ("f_dc", "f_rest"):
        found = numbers[name]
        if len(found) % 3 or sorted(found) != list(range(len(found))):
            raise AdapterError(
                f"{where}: {name}_0, {name}_1, … must be a multiple of 3 in number (a channel's "
                f"values after the other's) and without gaps; got {len(found)}"
            )
    return len(numbers["f_dc"]) // 3, len(numbers["f_rest"]) // 3, len(numbers["semantic"])


def _scatter(
    rows: np.ndarray, arrays: dict[str, Tensor], terms: Tensor | None, where: slice
) -> None:
    """Copy the columns of some rows to their places; no activation yet."""
    values = {name: array.numpy()[where] for name, array in arrays.items()}
    colours = values["sh"][:, :1]
    if terms is not None:
        colours = np.concatenate([colours, terms.numpy()[where]], 1)
    rest = values["sh"][:, 1:]
    with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 become infinite
        for axis, name in enumerate("xyz"):
            values["means"][:, axis] = rows[name]
            values["scales"][:, axis] = rows[f"scale_{axis}"]
        for axis in range(4):
            values["quats"][:, axis] = rows[f"rot_{axis}"]
        values["opacities"][:] = rows["opacity"]
        for prefix, numbers in (("f_dc", colours), ("f_rest", rest)):
            count = numbers.shape[1]  # a channel's values after the other's
            for index in range(3 * count):
                numbers[:, index % count, index // count] = rows[f"{prefix}_{index}"]
    if terms is not None:
        values["sh"][:, :1], terms.numpy()[where] = colours[:, :1], colours[:, 1:]
