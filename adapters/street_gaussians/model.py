"""Trained Street Gaussians models: options of the URI, configuration, files and their contents.

`find_model` finds the files, `read_checkpoint` and `read_ply_model` read the weights. The caller is
`adapters.street_gaussians.adapter`.
"""

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
from adapters.recorded_lenses import LENS_MEANING, UNDISTORTED_LENS, LensChoice
from adapters.street_gaussians.data import ModelConfig, Number
from adapters.street_gaussians.dataset import DATA_FOLDERS
from adapters.uri import UriOptions
from augment.errors import AdapterError, SceneError
from augment.files.checkpoints import (
    checked_tensor,
    copy_mapped_tensor,
    dictionary_in,
    finite_array,
    load_checkpoint,
    release,
)
from augment.files.ply import SEMANTIC, PlyElement, PlyHeader, read_columns, read_ply_header
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import (
    NUM_SH_BY_DEGREE,
    Gaussians,
    check_gaussians,
    drawable_rows,
    is_drawable,
)

# ---- What the URI of a trained model may ask for -----------------------------------------------

SCHEME = "street_gaussians"
DEFAULT_WIDTH = 1600


def _parse_frames(text: object) -> DriveOptions:
    """Return the drive options of a range of frames."""
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
    frames: Annotated[DriveOptions, BeforeValidator(_parse_frames)] = Field(
        DriveOptions(),
        description="first:stop, frame numbers with stop excluded, either side may be empty",
    )
    lens: LensChoice = Field(UNDISTORTED_LENS, description=LENS_MEANING)
    rotation_bug: Literal["0", "1"] = Field(
        "0", description="0 or 1; actors turned as an older release of the project turned them"
    )


# ---- The configuration that a model was trained with: configs/config_{iteration:06d}.yaml --------


def newest_config(model: Path) -> Path:
    """Return the configuration in a model's folder; of several the one of the latest iteration."""
    files = (model / "configs").glob("config_*.yaml")
    configs = {int(m[1]): p for p in files if (m := re.fullmatch(r"config_(\d+)\.yaml", p.name))}
    if not configs:
        raise AdapterError(
            f"{model / 'configs'} holds no config_*.yaml; which column of the actors' poses "
            f"belongs to which object depends on it. Copy the folder configs/ of the training's "
            f"output to {model}"
        )
    return configs[max(configs)]


def read_config(path: Path) -> ModelConfig:
    """Read the part of a configuration that decides how its model is read.

    Keys that are missing or null have the project's defaults.
    """
    tree = read_yaml(path)
    values = {}
    for field_name, entry in ModelConfig.model_fields.items():
        key = entry.alias or field_name
        value: Any = tree
        for name in key.split("."):
            if value is not None and not isinstance(value, Mapping):
                raise AdapterError(
                    f"{path}: {key} must be a key inside a section; got {str(value)[:80]!r}"
                )
            value = None if value is None else value.get(name)
        if value is not None:
            values[key] = value
    return validate(ModelConfig, values, path, "configuration of a Street Gaussians training")


# ---- Where the files of a trained model are ------------------------------------------------------


@dataclass(frozen=True)
class ModelFiles:
    """Files of a model.

    Attributes:
        folder: the model's folder.
        weights: a .pth or .ply.
        iteration: iteration of the weights. None if their name does not say it.
        config_file: the configuration's file.
        config: the configuration.
        data: folder of the dataset.
    """

    folder: Path
    weights: Path
    iteration: int | None
    config_file: Path
    config: ModelConfig
    data: Path


def is_dataset(path: Path) -> bool:
    """Return True if a path is a dataset's folder and not a model's."""
    return all((path / name).is_dir() for name in DATA_FOLDERS) and not _find_saved_weights(path)


def find_model(path: Path, options: ModelOptions) -> ModelFiles:
    """Return the files of a model, given its folder or its weights."""
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
    """Return the model's folder, its weights and their iteration, if their name says it."""
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
    """Return the model's folder, and the weights and iteration that the options select."""
    saved = _find_saved_weights(path)
    if not saved:
        raise AdapterError(
            f"{path} is no Street Gaussians model and no dataset of one: expected "
            f"trained_model/iteration_N.pth or point_cloud/iteration_N/point_cloud.ply in it, or "
            f"{', '.join(f'{name}/' for name in DATA_FOLDERS)}"
        )
    kind = options.weights or ("pth" if "pth" in saved else "ply")
    if kind not in saved:
        raise AdapterError(f"{path} holds no .{kind} of a saved iteration; give the other weights=")
    iteration = max(saved[kind]) if options.iteration is None else options.iteration
    if iteration not in saved[kind]:
        iterations = ", ".join(map(str, sorted(saved[kind])))
        raise AdapterError(f"{path} has no .{kind} of iteration {iteration}; it has {iterations}")
    return path, saved[kind][iteration], iteration


def _find_saved_weights(folder: Path) -> dict[str, dict[int, Path]]:
    """Return the weights by kind, then iteration."""
    saved: dict[str, dict[int, Path]] = {}
    for pattern in ("trained_model/iteration_*.pth", "point_cloud/iteration_*/point_cloud.ply"):
        for file in folder.glob(pattern):
            if (iteration := _iteration_of(file)) is not None:
                saved.setdefault(file.suffix[1:], {})[iteration] = file
    return saved


def _iteration_of(weights: Path) -> int | None:
    """Return the iteration in the name of a file or its folder, or None if there is none."""
    name = weights.stem if weights.suffix.lower() == ".pth" else weights.parent.name
    match = re.fullmatch(r"iteration_(\d+)", name)
    return int(match[1]) if match else None


# ---- One trained part, the background or an actor: from the numbers in a file to Gaussians -------

# Gaussians that are converted at a time. Temporaries have a few megabytes.
_CHUNK_GAUSSIANS = 1 << 15
# Name of the background's part.
_BACKGROUND_PART = "background"
_ACTOR_NAME = re.compile(r"obj_(\d{3,9})")


def actor_id(name: str) -> int | None:
    """Return the track id in a part's name, such as obj_003, or None for other names."""
    match = _ACTOR_NAME.fullmatch(name)
    number = int(match[1]) if match else None
    return number if number is not None and name == f"obj_{number:03d}" else None


@dataclass(frozen=True, eq=False)
class Part:
    """A trained part: the background or an actor.

    Attributes:
        gaussians: its Gaussians.
        terms: further Fourier terms of the colours, [N, F - 1, 3]. None if F is 1.
    """

    gaussians: Gaussians
    terms: Tensor | None


def check_counts(where: str, num_rest: int, num_terms: int, *, is_background: bool) -> None:
    """Check the number of colour coefficients.

    Args:
        where: the part, for messages.
        num_rest: number of SH coefficients above the constant one.
        num_terms: number F of Fourier terms.
        is_background: True for the background.
    """
    if num_rest + 1 not in NUM_SH_BY_DEGREE:
        counts = ", ".join(str(count - 1) for count in NUM_SH_BY_DEGREE)
        raise AdapterError(
            f"{where}: feature_rest must have {counts} coefficients a channel (SH degrees 0 to 3); "
            f"got {num_rest}"
        )
    if num_terms < 1 or (is_background and num_terms > 1):
        expected = "1 colour term" if is_background else "1 colour term or more"
        raise AdapterError(f"{where}: feature_dc must have {expected}; got {num_terms}")


def make_part(
    arrays: dict[str, Tensor], where: str, problems: list[str], *, is_background: bool
) -> Part | None:
    """Activate the numbers of a file in place, and leave out Gaussians that cannot be drawn.

    The numbers are log scales, opacity logits, quaternions of any length, and further `terms` of
    the colours. The result is None for an actor without usable Gaussians; for a background that is
    an error.
    """
    terms = arrays.pop("terms")
    if len(terms) == 0 and not is_background:
        problems.append(f"{where}: it has no Gaussians and is left out")
        return None
    arrays["scales"].exp_()
    arrays["opacities"].sigmoid_()
    means = arrays["means"].numpy()
    quats = arrays["quats"].numpy()
    for start in range(0, len(quats), _CHUNK_GAUSSIANS):
        rows = slice(start, start + _CHUNK_GAUSSIANS)
        # In float64, where lengths of any float32 neither overflow nor vanish.
        lengths = np.sqrt(np.einsum("ni,ni->n", quats[rows], quats[rows], dtype=np.float64))
        lengths[lengths == 0] = 1  # such a quaternion is left out later
        quats[rows] /= lengths[:, None]
        # Colours that are not numbers at some time cannot be drawn.
        means[rows][~np.isfinite(terms[rows].numpy()).all((1, 2))] = np.nan
    gaussians = Gaussians(**arrays)
    has_terms = terms.shape[1] > 0
    if len(gaussians) and is_drawable(gaussians):
        return Part(gaussians, terms if has_terms else None)
    try:
        drawable, part_problems = check_gaussians(gaussians, where=where)
    except SceneError as error:
        if is_background:
            raise AdapterError(str(error)) from None
        problems.append(f"{error} It is left out")
        return None
    problems += part_problems
    return Part(drawable, terms[drawable_rows(gaussians)] if has_terms else None)


# ---- trained_model/iteration_N.pth ---------------------------------------------------------------

_PART_TENSORS = ("xyz", "feature_dc", "feature_rest", "scaling", "rotation", "opacity", "semantic")
_TRAINING_KEYS = (
    "spatial_lr_scale",
    "denom",
    "max_radii2D",
    "xyz_gradient_accum",
    "active_sh_degree",
    "optimizer",
)
# Numbers that are copied at a time.
_CHUNK_NUMBERS = 1 << 18


class PoseChanges(NamedTuple):
    """Changes of the poses of each frame and column of the tracklets by training.

    Attributes:
        positions: float64 [F, M, 3], metres, vehicle frame.
        half_turns: float64 [F, M], radians about the object's z. The object turns by twice as much.
    """

    positions: np.ndarray
    half_turns: np.ndarray


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """Contents of a model's file. None and empty stand for parts that are missing or not used.

    Attributes:
        file: the file.
        background: the background.
        actors: by track id.
        pose_changes: changes of the actors' poses.
        sky: faces of a cube map, float32 [6, R, R, 3].
        color_maps: float32 [n, 3, 4].
        camera_changes: float64 [n, 4, 4], rigid motions of the background.
        problems: one sentence each.
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
    """Read a .pth. Nothing in it is run; the optimiser's state is not read."""
    content = load_checkpoint(path)
    if _BACKGROUND_PART not in content:
        keys = ", ".join(map(str, list(content)[:12])) or "nothing"
        raise AdapterError(
            f"{path} lacks 'background', so it is no Street Gaussians model of a known version; it "
            f"holds {keys}. Expected background, obj_000 ..., actor_pose, sky_cubemap"
        )
    problems: list[str] = []
    parts = {}
    for name in (_BACKGROUND_PART, *(name for name in content if actor_id(str(name)) is not None)):
        where = f"{path}, {name}"
        is_background = name == _BACKGROUND_PART
        entry = dictionary_in(content, name, str(path))
        arrays = _part_arrays(entry, where, problems, is_background=is_background)
        parts[name] = make_part(arrays, where, problems, is_background=is_background)
    background, actors = _separate_background(parts)
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


def _separate_background(parts: dict[str, Part | None]) -> tuple[Part, dict[int, Part]]:
    """Return the background, and the remaining actors by number."""
    background = parts.pop(_BACKGROUND_PART)
    assert background is not None
    return background, {
        int(name.removeprefix("obj_")): part for name, part in parts.items() if part is not None
    }


def _part_arrays(
    content: Mapping[str, Any], where: str, problems: list[str], *, is_background: bool
) -> dict[str, Tensor]:
    """Return copies of a part's tensors in the form that `make_part` takes."""
    means = checked_tensor(content, "xyz", (None, 3), where)
    count = len(means)
    colours = checked_tensor(content, "feature_dc", (count, None, 3), where)
    sh_rest = checked_tensor(content, "feature_rest", (count, None, 3), where)
    scales = checked_tensor(content, "scaling", (count, 3), where)
    quats = checked_tensor(content, "rotation", (count, 4), where)
    logits = checked_tensor(content, "opacity", (count, 1), where)
    check_counts(where, sh_rest.shape[1], colours.shape[1], is_background=is_background)
    semantic = content.get("semantic")
    if isinstance(semantic, Tensor) and semantic.dim() == 2 and semantic.shape[1] > 0:
        problems.append(f"{where}: its semantic features are not used")
    if unknown_keys := [
        str(key) for key in content if key not in (*_PART_TENSORS, *_TRAINING_KEYS)
    ]:
        problems.append(f"{where}: it also holds {', '.join(unknown_keys[:8])}, which is not used")
    sh = torch.empty(count, 1 + sh_rest.shape[1], 3)
    terms = torch.empty_like(colours[:, 1:])
    arrays = {
        "means": copy_mapped_tensor(means),
        "quats": copy_mapped_tensor(quats),
        "scales": copy_mapped_tensor(scales),
    }
    arrays["opacities"] = copy_mapped_tensor(logits)[:, 0]
    copy_mapped_tensor(sh_rest, sh[:, 1:])
    rows = max(1, _CHUNK_NUMBERS // max(1, colours[:1].numel()))
    for start in range(0, count, rows):  # memory is given back as it goes
        chunk = colours[start : start + rows]
        sh[start : start + rows, :1] = chunk[:, :1]
        terms[start : start + rows] = chunk[:, 1:]
        if chunk.is_contiguous():
            release(chunk)
    return arrays | {"sh": sh, "terms": terms}


# ---- Tables of a checkpoint beside its Gaussians: poses, sky, colour and pose correction ---------


class _Tables:
    """Networks and tables of a checkpoint. Sentences about them go to `problems`."""

    def __init__(
        self, content: Mapping[str, Any], path: Path, config: ModelConfig, problems: list[str]
    ) -> None:
        self.path = path
        self.config = config
        self.problems = problems
        self._content = content
        self.read_names = {_BACKGROUND_PART, "iter"}

    def of(self, name: str, switch: str) -> Mapping[str, Any] | None:
        """Return the table `params` of an entry. switch: field of the configuration that enables
        it.
        """
        self.read_names.add(name)
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
        return dictionary_in(
            dictionary_in(self._content, name, str(self.path)), "params", self.where(name)
        )

    def where(self, name: str) -> str:
        """Return the name of an entry's table, for messages."""
        return f"{self.path}, {name}.params"

    def report_unknown(self) -> None:
        """Add a sentence about entries that were not read."""
        names = [str(name) for name in self._content if name not in self.read_names]
        if names := [name for name in names if actor_id(name) is None]:
            self.problems.append(
                f"{self.path} also holds {', '.join(names[:8])}, which is not used: expected "
                f"background, obj_000 ..., actor_pose, sky_cubemap, color_correction, "
                f"pose_correction and iter"
            )


def _read_pose_changes(tables: _Tables, *, has_actors: bool) -> PoseChanges | None:
    """Return the changes of the actors' poses by training, or None if they were not trained."""
    if not has_actors:
        tables.read_names.add("actor_pose")
        return None
    params = tables.of("actor_pose", "opt_track")
    if params is None:
        return None
    positions = finite_array(params, "opt_trans", (None, None, 3), tables.where("actor_pose"))
    half_turns = finite_array(
        params, "opt_rots", (*positions.shape[:2], 1), tables.where("actor_pose")
    )
    return PoseChanges(positions, half_turns[..., 0])


def _read_sky(tables: _Tables) -> Tensor | None:
    """Return the faces of the sky, float32 [6, R, R, 3] in [0, 1].

    The result is None if there is no usable sky.

    The project clamps looked-up colours. Clamped texels give the same, except between texels of
    which only some are out of range.
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
    faces = checked_tensor(params, "sky_cube_map", (6, None, None, 3), where)
    if faces.shape[1] != faces.shape[2] or faces.shape[1] == 0:
        raise AdapterError(
            f"{where}: sky_cube_map must be float32 [6, R, R, 3]; got {list(faces.shape)}"
        )
    faces = copy_mapped_tensor(faces)
    if not np.isfinite([faces.numpy().min(), faces.numpy().max()]).all():
        raise AdapterError(f"{where}: sky_cube_map holds NaN or infinite numbers")
    return faces.clamp_(0, 1)


def _read_color_maps(tables: _Tables) -> Tensor | None:
    """Return the colour maps, float32 [n, 3, 4], or None if there are no usable ones."""
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
    maps = finite_array(params, "affine_trans", (None, 3, 4), tables.where(name))
    return torch.from_numpy(maps.astype(np.float32))


def _read_camera_changes(tables: _Tables) -> np.ndarray | None:
    """Return the rigid motions of the background before images are taken, float64 [n, 4, 4]."""
    name = "pose_correction"
    params = tables.of(name, "use_pose_correction")
    if params is None:
        return None
    centres = finite_array(params, "pose_correction_trans", (None, 3), tables.where(name))
    quats = finite_array(params, "pose_correction_rots", (len(centres), 4), tables.where(name))
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
            name: header.element(full_name)
            for full_name, name in names.items()
            if full_name != name and (name == _BACKGROUND_PART or actor_id(name) is not None)
        }
        if _BACKGROUND_PART not in elements:
            hint = ""
            if "vertex" in names:
                hint = f". A .ply with one element 'vertex' opens as gaussians:{path}"
            raise AdapterError(
                f"{path} is no Street Gaussians model: expected an element vertex_background and "
                f"one such as vertex_obj_003 for each actor; found "
                f"{', '.join(list(names)[:12]) or 'none'}{hint}"
            )
        problems = _ply_problems(path, config)
        if other_names := [full_name for full_name, name in names.items() if name not in elements]:
            problems.append(f"{path} also holds {', '.join(other_names[:8])}, which is not used")
        parts = {
            name: _read_ply_part(header, element, problems, is_background=name == _BACKGROUND_PART)
            for name, element in elements.items()
        }
    except SceneError as error:
        raise AdapterError(str(error)) from None
    background, actors = _separate_background(parts)
    return TrainedModel(path, background, actors, problems=[*problems, *header.surplus_problems()])


def _ply_problems(path: Path, config: ModelConfig) -> list[str]:
    """Return a sentence on trained parts that a .ply does not hold."""
    is_trained_by_name = {
        "the actors' learnt poses": config.opt_track,
        "the sky": config.include_sky,
        "the colour correction": config.use_color_correction,
        "the pose correction": config.use_pose_correction,
    }
    missing_parts = ", ".join(
        name for name, was_trained in is_trained_by_name.items() if was_trained
    )
    advice = (
        f"; left out: {missing_parts}. They are in trained_model/iteration_N.pth"
        if missing_parts
        else ""
    )
    return [f"{path}: a .ply holds Gaussians only{advice}"]


def _read_ply_part(
    header: PlyHeader, element: PlyElement, problems: list[str], *, is_background: bool
) -> Part | None:
    """Read one element of a .ply."""
    where = f"{header.path}, {element.name}"
    if any(name.startswith("semantic_") for name in element.columns):
        problems.append(f"{where}: its semantic features are not used")
    columns = read_columns(header, element, has_terms=True)
    columns.pop(SEMANTIC, None)
    num_rest = columns["sh"].shape[1] - 1
    num_terms = 1 + columns["terms"].shape[1]
    check_counts(where, num_rest, num_terms, is_background=is_background)
    with np.errstate(over="ignore"):  # doubles beyond float32 become infinite
        arrays = {
            name: torch.from_numpy(values.astype(np.float32, copy=False))
            for name, values in columns.items()
        }
    return make_part(arrays, where, problems, is_background=is_background)
