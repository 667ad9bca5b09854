"""Reads Gaussians in checkpoints of trainers (.pt): gsplat's, and those of 3DGRT and 3DGUT.

gsplat keeps `splats`: means, quats (wxyz), scales (logarithms), opacities (logits), sh0 [N, 1, 3]
and shN [N, K, 3]. 3DGRUT keeps positions, rotation (wxyz), scale (logarithms), density (logits),
features_albedo [N, 3] and features_specular [N, 3 K], coefficient after coefficient, with the
number of degrees that were trained so far. Only tensors and plain values are read, and nothing in
the file is run. Sources: github.com/nerfstudio-project/gsplat, examples/simple_trainer.py;
github.com/nv-tlabs/3dgrut, threedgrut/model/model.py (both Apache-2.0).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.errors import AdapterError, SceneError
from augment.files.checkpoints import SettingsRecord, checked_tensor, load_checkpoint
from augment.files.limits import check_memory
from augment.files.splat_format import FileFacts, SplatFile, SplatFormat
from augment.scene.scene import NUM_SH_BY_DEGREE, Gaussians, check_gaussians

_ZIP = b"PK\x03\x04"  # first bytes of a zip
_NAME_LENGTH = struct.Struct("<26xH2x")  # bytes of the first entry's name, in the zip's first bytes
_NUM_SH_OF_DEGREE_4 = 25  # gsplat trains up to this degree
_GAUSSIAN_KERNEL_DEGREE = 2  # degree of the kernel exp(-r^2 / 2)


def is_checkpoint(path: Path) -> bool:
    """Return True if the first file in a zip is the pickle of a checkpoint."""
    with path.open("rb") as file:
        start = file.read(_NAME_LENGTH.size)
        if len(start) < _NAME_LENGTH.size or not start.startswith(_ZIP):
            return False
        (length,) = _NAME_LENGTH.unpack(start)
        return file.read(length).endswith(b"/data.pkl")


def read_splat_checkpoint(path: str | Path) -> SplatFile:
    """Read the Gaussians of a checkpoint. Its note `trainer` is "gsplat" or "3DGRUT".

    Raises:
        SceneError: the file is damaged, holds code, or lacks tensors of either trainer.
    """
    path = Path(path)
    try:
        content = load_checkpoint(path, has_settings=True)
    except AdapterError as error:
        raise SceneError(str(error)) from None
    problems: tuple[str, ...] = ()
    if isinstance(content.get("splats"), Mapping):
        trainer = "gsplat"
        columns, sh = _gsplat_columns(content["splats"], f"{path}, splats")
    elif "features_albedo" in content or "features_specular" in content:
        trainer = "3DGRUT"
        columns, sh = _grut_columns(content, str(path))
        problems = _settings_problems(content.get("config"), str(path))
    else:
        names = ", ".join(map(repr, list(content)[:12])) or "nothing"
        raise SceneError(
            f"{path}: not a checkpoint of Gaussians: expected 'splats' (gsplat) or 'positions' and "
            f"'features_albedo' (3DGRUT); it holds {names[:300]}"
        )
    num_sh = sh.shape[1]
    if num_sh == _NUM_SH_OF_DEGREE_4:
        problems = (*problems, f"{path}: spherical harmonics of degree 4 are cut off at 3")
        num_sh = NUM_SH_BY_DEGREE[-1]
    elif num_sh not in NUM_SH_BY_DEGREE:
        raise SceneError(
            f"{path}: {num_sh} spherical harmonics a channel; expected one of {NUM_SH_BY_DEGREE}"
        )
    check_memory(str(path), len(sh), num_sh=num_sh, file_bytes=path.stat().st_size)
    all_gaussians = Gaussians(
        means=columns["means"].float().contiguous(),
        quats=columns["quats"].float().contiguous(),
        scales=columns["scales"].float().exp(),
        opacities=columns["opacities"].float().reshape(-1).sigmoid(),
        sh=sh[:, :num_sh].float().contiguous(),
    )
    gaussians, new_problems = check_gaussians(all_gaussians, where=str(path))
    return SplatFile(gaussians, notes={"trainer": trainer}, problems=(*new_problems, *problems))


def _columns(
    content: Mapping[str, Any], names: Mapping[str, tuple[str, tuple[int, ...]]], where: str
) -> dict[str, Tensor]:
    """Return checked tensors of floats with the same number of rows.

    Args:
        content: the file's tensors by name.
        names: for each name in the result, the file's name and the shape without its first number.
        where: the file, for messages.
    """
    columns = {}
    num_rows = None
    for name, (file_name, shape) in names.items():
        tensor = checked_tensor(
            content, file_name, (num_rows, *shape), where, dtype=None, error=SceneError
        )
        if not tensor.is_floating_point():
            raise SceneError(f"{where}: {file_name} must be floats; got {str(tensor.dtype)[6:]}")
        num_rows = len(tensor)
        columns[name] = tensor
    if num_rows == 0:
        raise SceneError(f"{where}: its tensors have 0 rows; nothing to render")
    return columns


def _gsplat_columns(splats: Mapping[str, Any], where: str) -> tuple[dict[str, Tensor], Tensor]:
    """Return the tensors of gsplat's checkpoint, and its spherical harmonics [N, K, 3]."""
    if "sh0" not in splats and "colors" in splats:
        raise SceneError(
            f"{where}: its colours come from a network (trained with app_opt); Gaussians with "
            "spherical harmonics, sh0 and shN, are needed"
        )
    names = {"means": ("means", (3,)), "quats": ("quats", (4,)), "scales": ("scales", (3,))}
    columns = _columns(
        splats, {**names, "opacities": ("opacities", ()), "sh0": ("sh0", (1, 3))}, where
    )
    num_rows = len(columns["means"])
    if "shN" not in splats:
        return columns, columns["sh0"]
    higher_terms = checked_tensor(
        splats, "shN", (num_rows, None, 3), where, dtype=None, error=SceneError
    )
    return columns, torch.cat([columns["sh0"].float(), higher_terms.float()], dim=1)


def _grut_columns(content: Mapping[str, Any], where: str) -> tuple[dict[str, Tensor], Tensor]:
    """Return the tensors of 3DGRUT's checkpoint, and its trained harmonics [N, K, 3]."""
    names = {
        "means": ("positions", (3,)),
        "quats": ("rotation", (4,)),
        "scales": ("scale", (3,)),
        "opacities": ("density", (1,)),
        "albedo": ("features_albedo", (3,)),
    }
    columns = _columns(content, names, where)
    num_rows = len(columns["means"])
    first = columns["albedo"].float()[:, None]
    if "features_specular" not in content:
        return columns, first
    higher_terms = checked_tensor(
        content, "features_specular", (num_rows, None), where, dtype=None, error=SceneError
    )
    if higher_terms.shape[1] % 3:
        raise SceneError(
            f"{where}: features_specular must have three channels a term; got "
            f"{higher_terms.shape[1]} columns"
        )
    sh = torch.cat([first, higher_terms.float().reshape(num_rows, -1, 3)], dim=1)
    degree = content.get("n_active_features")
    if type(degree) is int and 0 <= degree < len(NUM_SH_BY_DEGREE):
        sh = sh[:, : NUM_SH_BY_DEGREE[degree]]  # later ones were not drawn yet
    return columns, sh


def _settings_problems(config: Any, where: str) -> tuple[str, ...]:
    """Return a sentence for each of 3DGRUT's settings with which its picture differs from ours."""
    if not isinstance(config, SettingsRecord):
        return ()
    problems = []
    kernel_degree = config.setting("render", "particle_kernel_degree")
    if kernel_degree not in (None, _GAUSSIAN_KERNEL_DEGREE):
        problems.append(
            f"{where}: trained with a kernel of degree {kernel_degree!r:.20}; drawn with that of "
            f"Gaussians, of degree {_GAUSSIAN_KERNEL_DEGREE}, so its splats look softer"
        )
    for name, expected in (("density_activation", "sigmoid"), ("scale_activation", "exp")):
        activation = config.setting("model", name)
        if activation not in (None, expected):
            raise SceneError(
                f"{where}: its {name} is {activation!r:.40}; only {expected} is read: export it as "
                ".ply"
            )
    return tuple(problems)


def describe_checkpoint(path: Path) -> FileFacts:
    """Return the trainer of a checkpoint and its step."""
    try:
        content = load_checkpoint(path, has_settings=True)
    except AdapterError as error:
        raise SceneError(str(error)) from None
    step = content.get("step", content.get("global_step"))
    is_stated = type(step) is int and step > 0
    writer = "gsplat" if "splats" in content else "3DGRUT"
    return FileFacts(version="PyTorch", writer=f"{writer}, step {step}" if is_stated else writer)


CHECKPOINT = SplatFormat(
    name="checkpoint (.pt)",
    reader=read_splat_checkpoint,
    first_bytes=(_ZIP,),
    fits_content=is_checkpoint,
    describe=describe_checkpoint,
)
