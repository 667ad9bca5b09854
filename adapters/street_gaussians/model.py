"""A trained model: its options, configuration and files, and what they hold."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from pydantic import BeforeValidator, Field
from torch import Tensor

from adapters.camera_files.camera_files import validate
from adapters.plain_files import read_yaml
from adapters.raw_drive import DriveOptions
from adapters.street_gaussians.data import ModelConfig, Number
from adapters.uri import UriOptions
from augment.errors import AdapterError, SceneError
from augment.files.checkpoints import (
    finite_numbers,
    load_checkpoint,
    release,
    section,
    taken,
    tensor,
)
from augment.files.ply import SEMANTIC, PlyElement, PlyHeader, read_columns, read_ply_header
from augment.geometry import rotmat_from_quat
from augment.scene import SH_COUNTS, Gaussians, check_gaussians, drawable_rows, is_drawable

# ---- What the URI of a trained model may ask for -----------------------------------------------

SCHEME = "street_gaussians"
DEFAULT_WIDTH = 1600


def _frames(text: object) -> DriveOptions:
    return DriveOptions.from_query(SCHEME, {"frames": str(text)})


class ModelOptions(UriOptions):
    """Options of one opening."""

    data: Annotated[Path, BeforeValidator(lambda text: Path(text).expanduser())] | None = Field(
        None, description="the dataset's folder, where it is not where the configuration says"
    )
    iteration: Number | None = Field(
        None, description="a whole number, which of the saved iterations; the newest without it"
    )
    weights: Literal["pth", "ply"] | None = Field(
        None, description="pth or ply; the .pth where there is one"
    )
    width: Number = Field(
        DEFAULT_WIDTH,
        description=f"a whole number of pixels, which images are at most wide, {DEFAULT_WIDTH} "
        f"without it; 0 as recorded",
    )
    frames: Annotated[DriveOptions, BeforeValidator(_frames)] = Field(
        DriveOptions(),
        description="first:stop, frame numbers with stop excluded, either side may be empty",
    )
    rotation_bug: Literal["0", "1"] = Field(
        "0", description="0 or 1; actors turned as an older release of the project turned them"
    )


# ---- The configuration that a model was trained with: configs/config_{iteration:06d}.yaml --------


def newest_config(model: Path) -> Path:
    """The configuration of a model's folder; of several the one of the latest iteration."""
    files = (model / "configs").glob("config_*.yaml")
    found = {int(m[1]): p for p in files if (m := re.fullmatch(r"config_(\d+)\.yaml", p.name))}
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
    find_weights = _weights_of_file if path.is_file() else _weights_of_folder
    folder, weights, iteration = find_weights(path, options)
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


def _weights_of_file(path: Path, options: ModelOptions) -> tuple[Path, Path, int | None]:
    """The model's folder, its weights and their iteration, where their name says it."""
    if options.iteration is not None or options.weights is not None:
        raise AdapterError(
            f"{path} is one file, so iteration= and weights= say nothing; give the model's "
            f"folder or leave them out"
        )
    if path.suffix.lower() not in (".pth", ".ply"):
        raise AdapterError(f"{path}: expected a model's folder, .pth or .ply")
    folders = path.absolute().parents[:3]
    folder = next((folder for folder in folders if (folder / "configs").is_dir()), folders[-1])
    return folder, path, _iteration_of(path)


def _weights_of_folder(path: Path, options: ModelOptions) -> tuple[Path, Path, int]:
    saved = _saved(path)
    if not saved:
        raise AdapterError(
            f"{path} is no Street Gaussians model and no dataset of one: expected "
            f"trained_model/iteration_N.pth or point_cloud/iteration_N/point_cloud.ply in it, or "
            f"{', '.join(f'{name}/' for name in _DATA_FOLDERS)}"
        )
    kind = options.weights or ("pth" if "pth" in saved else "ply")
    if kind not in saved:
        raise AdapterError(f"{path} holds no .{kind} of a saved iteration; give the other weights=")
    iteration = max(saved[kind]) if options.iteration is None else options.iteration
    if iteration not in saved[kind]:
        known = ", ".join(map(str, sorted(saved[kind])))
        raise AdapterError(f"{path} has no .{kind} of iteration {iteration}; it has {known}")
    return path, saved[kind][iteration], iteration


def _saved(folder: Path) -> dict[str, dict[int, Path]]:
    """Weights by kind, then iteration."""
    saved: dict[str, dict[int, Path]] = {}
    for pattern in ("trained_model/iteration_*.pth", "point_cloud/iteration_*/point_cloud.ply"):
        for file in folder.glob(pattern):
            if (iteration := _iteration_of(file)) is not None:
                saved.setdefault(file.suffix[1:], {})[iteration] = file
    return saved


def _iteration_of(weights: Path) -> int | None:
    named = weights.stem if weights.suffix.lower() == ".pth" else weights.parent.name
    match = re.fullmatch(r"iteration_(\d+)", named)
    return int(match[1]) if match else None


# ---- One trained part, the background or an actor: from the numbers in a file to Gaussians -------

_ROWS = 1 << 15  # Gaussians changed at a time: temporaries of a few megabytes
_BACKGROUND = "background"
_ACTOR = re.compile(r"obj_(\d{3,9})")


def actor_id(name: str) -> int | None:
    """The track id in a part's name, such as obj_003; None for other names."""
    match = _ACTOR.fullmatch(name)
    number = int(match[1]) if match else None
    return number if number is not None and name == f"obj_{number:03d}" else None


@dataclass(frozen=True, eq=False)
class Part:
    """terms [N, F - 1, 3]: further Fourier terms of the colours; None where F is 1."""

    gaussians: Gaussians
    terms: Tensor | None


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


def make_part(
    arrays: dict[str, Tensor], where: str, problems: list[str], *, is_background: bool
) -> Part | None:
    """Activate the numbers of a file in place (log scales, opacity logits, quaternions of any
    length, and further `terms` of the colours) and leave out what cannot be drawn.

    None for an actor of which nothing usable remains; of a background that is an error.
    """
    terms = arrays.pop("terms")
    if len(terms) == 0 and not is_background:
        problems.append(f"{where}: it has no Gaussians and is left out")
        return None
    arrays["scales"].exp_()
    arrays["opacities"].sigmoid_()
    means, quats = arrays["means"].numpy(), arrays["quats"].numpy()
    for start in range(0, len(quats), _ROWS):
        rows = slice(start, start + _ROWS)
        # In float64, where lengths of any float32 neither overflow nor vanish.
        lengths = np.sqrt(np.einsum("ni,ni->n", quats[rows], quats[rows], dtype=np.float64))
        lengths[lengths == 0] = 1  # such a quaternion is left out later
        quats[rows] /= lengths[:, None]
        # Colours that are not numbers at some time cannot be drawn.
        means[rows][~np.isfinite(terms[rows].numpy()).all((1, 2))] = np.nan
    gaussians, has_terms = Gaussians(**arrays), terms.shape[1] > 0
    if len(gaussians) and is_drawable(gaussians):
        return Part(gaussians, terms if has_terms else None)
    try:
        kept, found = check_gaussians(gaussians, where=where)
    except SceneError as error:
        if is_background:
            raise AdapterError(str(error)) from None
        problems.append(f"{error} It is left out")
        return None
    problems += found
    return Part(kept, terms[drawable_rows(gaussians)] if has_terms else None)


# ---- trained_model/iteration_N.pth ---------------------------------------------------------------

_TENSORS = ("xyz", "feature_dc", "feature_rest", "scaling", "rotation", "opacity", "semantic")
_TRAINING = (
    "spatial_lr_scale", "denom", "max_radii2D", "xyz_gradient_accum", "active_sh_degree",
    "optimizer",
)  # fmt: skip
_PIECE = 1 << 18  # numbers copied at a time


class PoseChanges(NamedTuple):
    """What training added to the poses of each frame and column of the tracklets.

    positions: float64 [F, M, 3], metres, vehicle frame. half_turns: float64 [F, M], radians about
    the object's z; it turns by twice as much.
    """

    positions: np.ndarray
    half_turns: np.ndarray


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
    if _BACKGROUND not in content:
        keys = ", ".join(map(str, list(content)[:12])) or "nothing"
        raise AdapterError(
            f"{path} lacks 'background', so it is no Street Gaussians model of a known version; it "
            f"holds {keys}. Expected background, obj_000 ..., actor_pose, sky_cubemap"
        )
    problems: list[str] = []
    parts = {}
    for name in (_BACKGROUND, *(name for name in content if actor_id(str(name)) is not None)):
        where, is_background = f"{path}, {name}", name == _BACKGROUND
        entry = section(content, name, str(path))
        arrays = _part_arrays(entry, where, problems, is_background=is_background)
        parts[name] = make_part(arrays, where, problems, is_background=is_background)
    background, actors = _told_apart(parts)
    tables = _Tables(content, path, config, problems)
    model = TrainedModel(
        file=path,
        background=background,
        actors=actors,
        pose_changes=_read_pose_changes(tables, has_actors=bool(actors)),
        sky=_read_sky(tables),
        color_maps=_read_color_maps(tables),
        camera_changes=_read_camera_changes(tables),
        problems=problems,
    )
    tables.report_unknown()
    return model


def _told_apart(parts: dict[str, Part | None]) -> tuple[Part, dict[int, Part]]:
    """Background, and the actors that are left by number."""
    background = parts.pop(_BACKGROUND)
    assert background is not None
    return background, {
        int(name.removeprefix("obj_")): part for name, part in parts.items() if part is not None
    }


def _part_arrays(
    content: Mapping[str, Any], where: str, problems: list[str], *, is_background: bool
) -> dict[str, Tensor]:
    """Copies of a part's tensors, as `make_part` takes them."""
    means = tensor(content, "xyz", (None, 3), where)
    count = len(means)
    colours = tensor(content, "feature_dc", (count, None, 3), where)
    rest = tensor(content, "feature_rest", (count, None, 3), where)
    scales = tensor(content, "scaling", (count, 3), where)
    quats = tensor(content, "rotation", (count, 4), where)
    logits = tensor(content, "opacity", (count, 1), where)
    check_counts(where, rest.shape[1], colours.shape[1], is_background=is_background)
    semantic = content.get("semantic")
    if isinstance(semantic, Tensor) and semantic.dim() == 2 and semantic.shape[1] > 0:
        problems.append(f"{where}: its semantic features are not used")
    if unknown := [str(key) for key in content if key not in (*_TENSORS, *_TRAINING)]:
        problems.append(f"{where}: it also holds {', '.join(unknown[:8])}, which is not used")
    sh, terms = torch.empty(count, 1 + rest.shape[1], 3), torch.empty_like(colours[:, 1:])
    arrays = {"means": taken(means), "quats": taken(quats), "scales": taken(scales)}
    arrays["opacities"] = taken(logits)[:, 0]
    taken(rest, sh[:, 1:])
    rows = max(1, _PIECE // max(1, colours[:1].numel()))
    for start in range(0, count, rows):  # memory is given back as it goes
        piece = colours[start : start + rows]
        sh[start : start + rows, :1] = piece[:, :1]
        terms[start : start + rows] = piece[:, 1:]
        if piece.is_contiguous():
            release(piece)
    return arrays | {"sh": sh, "terms": terms}


# ---- Tables of a checkpoint beside its Gaussians: poses, sky, colour and pose correction ---------


class _Tables:
    """Networks and tables of a checkpoint, with sentences about them."""

    def __init__(
        self, content: Mapping[str, Any], path: Path, config: ModelConfig, problems: list[str]
    ) -> None:
        self.path, self.config, self.problems = path, config, problems
        self._content = content
        self.seen = {_BACKGROUND, "iter"}

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
        return section(section(self._content, name, str(self.path)), "params", self.where(name))

    def where(self, name: str) -> str:
        return f"{self.path}, {name}.params"

    def report_unknown(self) -> None:
        names = [str(name) for name in self._content if name not in self.seen]
        if names := [name for name in names if actor_id(name) is None]:
            self.problems.append(
                f"{self.path} also holds {', '.join(names[:8])}, which is not used: expected "
                f"background, obj_000 ..., actor_pose, sky_cubemap, color_correction, "
                f"pose_correction and iter"
            )


def _read_pose_changes(tables: _Tables, *, has_actors: bool) -> PoseChanges | None:
    """What training added to the actors' poses; None where it left them."""
    if not has_actors:
        tables.seen.add("actor_pose")
        return None
    params = tables.of("actor_pose", "opt_track")
    if params is None:
        return None
    positions = finite_numbers(params, "opt_trans", (None, None, 3), tables.where("actor_pose"))
    half_turns = finite_numbers(
        params, "opt_rots", (*positions.shape[:2], 1), tables.where("actor_pose")
    )
    return PoseChanges(positions, half_turns[..., 0])


def _read_sky(tables: _Tables) -> Tensor | None:
    """Faces of the sky, float32 [6, R, R, 3] in [0, 1]; None where there is none that can be used.

    The project clamps what it looks up; clamped texels are the same but between texels of which
    only some are out of range.
    """
    params = tables.of("sky_cubemap", "include_sky")
    if params is None:
        return None
    where = tables.where("sky_cubemap")
    if any(str(key) == "sky_codebook" or str(key).startswith("mlp_shader") for key in params):
        tables.problems.append(
            f"{where}: a sky made of a codebook and a network is not supported; the sky has the "
            f"background's colour instead"
        )
        return None
    faces = tensor(params, "sky_cube_map", (6, None, None, 3), where)
    if faces.shape[1] != faces.shape[2] or faces.shape[1] == 0:
        raise AdapterError(
            f"{where}: sky_cube_map must be float32 [6, R, R, 3]; got {list(faces.shape)}"
        )
    faces = taken(faces)
    if not np.isfinite([faces.numpy().min(), faces.numpy().max()]).all():
        raise AdapterError(f"{where}: sky_cube_map holds NaN or infinite numbers")
    return faces.clamp_(0, 1)


def _read_color_maps(tables: _Tables) -> Tensor | None:
    """Colour maps float32 [n, 3, 4]; None where there are none that can be used."""
    name = "color_correction"
    params = tables.of(name, "use_color_correction")
    if params is None:
        return None
    is_network = any(str(key).startswith("affine_trans.") for key in params)
    if tables.config.color_correction_mlp or is_network:
        tables.problems.append(
            f"{tables.path}, {name}: colour correction by a network is not supported and left "
            f"out; images have the scene's own colours"
        )
        return None
    maps = finite_numbers(params, "affine_trans", (None, 3, 4), tables.where(name))
    return torch.from_numpy(maps.astype(np.float32))


def _read_camera_changes(tables: _Tables) -> np.ndarray | None:
    """What the background is moved by before an image is taken, float64 [n, 4, 4]."""
    name = "pose_correction"
    params = tables.of(name, "use_pose_correction")
    if params is None:
        return None
    centres = finite_numbers(params, "pose_correction_trans", (None, 3), tables.where(name))
    quats = finite_numbers(params, "pose_correction_rots", (len(centres), 4), tables.where(name))
    if (np.linalg.norm(quats, axis=1) == 0).any():
        raise AdapterError(
            f"{tables.where(name)}: pose_correction_rots holds a quaternion of zeros"
        )
    changes = np.tile(np.eye(4), (len(centres), 1, 1))
    changes[:, :3, :3] = rotmat_from_quat(torch.from_numpy(quats)).numpy()
    changes[:, :3, 3] = centres
    return changes


# ---- point_cloud/iteration_N/point_cloud.ply: an element for each part, such as vertex_obj_003 ---
# It has no sky, no colour correction and not what training added to poses.


def read_ply_model(path: Path, config: ModelConfig) -> TrainedModel:
    """Read a .ply in pieces."""
    try:
        header = read_ply_header(path)
        names = {e.name: e.name.removeprefix("vertex_") for e in header.elements}
        elements = {
            name: header.element(full)
            for full, name in names.items()
            if full != name and (name == _BACKGROUND or actor_id(name) is not None)
        }
        if _BACKGROUND not in elements:
            hint = ""
            if "vertex" in names:
                hint = f". A .ply with one element 'vertex' opens as gaussians:{path}"
            raise AdapterError(
                f"{path} is no Street Gaussians model: expected an element vertex_background and "
                f"one such as vertex_obj_003 for each actor; found "
                f"{', '.join(list(names)[:12]) or 'none'}{hint}"
            )
        problems = _lost_in_ply(path, config)
        if others := [full for full, name in names.items() if name not in elements]:
            problems.append(f"{path} also holds {', '.join(others[:8])}, which is not used")
        parts = {
            name: _read_ply_part(header, element, problems, is_background=name == _BACKGROUND)
            for name, element in elements.items()
        }
    except SceneError as error:
        raise AdapterError(str(error)) from None
    background, actors = _told_apart(parts)
    return TrainedModel(path, background, actors, problems=[*problems, *header.surplus_problems()])


def _lost_in_ply(path: Path, config: ModelConfig) -> list[str]:
    trained = {
        "the actors' learnt poses": config.opt_track,
        "the sky": config.include_sky,
        "the colour correction": config.use_color_correction,
        "the pose correction": config.use_pose_correction,
    }
    lost = ", ".join(name for name, was_trained in trained.items() if was_trained)
    where_else = f"; left out: {lost}. They are in trained_model/iteration_N.pth" if lost else ""
    return [f"{path}: a .ply holds Gaussians only{where_else}"]


def _read_ply_part(
    header: PlyHeader, element: PlyElement, problems: list[str], *, is_background: bool
) -> Part | None:
    where = f"{header.path}, {element.name}"
    if any(name.startswith("semantic_") for name in element.columns):
        problems.append(f"{where}: its semantic features are not used")
    columns = read_columns(header, element, has_terms=True)
    columns.pop(SEMANTIC, None)
    rest, terms = columns["sh"].shape[1] - 1, 1 + columns["terms"].shape[1]
    check_counts(where, rest, terms, is_background=is_background)
    with np.errstate(over="ignore"):  # doubles beyond float32 become infinite
        arrays = {
            name: torch.from_numpy(values.astype(np.float32, copy=False))
            for name, values in columns.items()
        }
    return make_part(arrays, where, problems, is_background=is_background)
