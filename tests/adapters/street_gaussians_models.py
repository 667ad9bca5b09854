"""Tiny trained Street Gaussians models as the project saves them, from known numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import yaml


@dataclass(frozen=True)
class RawPart:
    """Float32, as trained. xyz [N, 3], dc [N, F, 3], rest [N, K - 1, 3], scaling [N, 3] logs,
    rotation [N, 4] wxyz of any length, opacity [N, 1] logits."""

    xyz: np.ndarray
    dc: np.ndarray
    rest: np.ndarray
    scaling: np.ndarray
    rotation: np.ndarray
    opacity: np.ndarray

    def tensors(self) -> dict[str, np.ndarray]:
        return {
            "xyz": self.xyz, "feature_dc": self.dc, "feature_rest": self.rest,
            "scaling": self.scaling, "rotation": self.rotation, "opacity": self.opacity,
            "semantic": np.zeros((len(self.xyz), 0), np.float32),
        }  # fmt: skip


@dataclass(frozen=True)
class RawModel:
    """affine: [n, 3, 4]. moves, turns: [n, 3] and [n, 4] of the pose correction."""

    background: RawPart
    actors: Mapping[int, RawPart]
    opt_trans: np.ndarray | None = None
    opt_rots: np.ndarray | None = None
    sky: np.ndarray | None = None
    affine: np.ndarray | None = None
    moves: np.ndarray | None = None
    turns: np.ndarray | None = None
    extra: Mapping[str, object] = field(default_factory=dict)

    @property
    def parts(self) -> dict[str, RawPart]:
        return {
            "background": self.background,
            **{f"obj_{n:03d}": p for n, p in self.actors.items()},
        }


def random_part(
    seed: int, count: int, *, terms: int = 1, degree: int = 1, low=(-1, -1, -1), high=(1, 1, 1),
    size_m: float = 0.3,
) -> RawPart:  # fmt: skip
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    dc = 0.8 * normal(count, terms, 3)
    dc[:, 1:] *= 0.4
    return RawPart(
        xyz=rng.uniform(low, high, (count, 3)).astype(np.float32),
        dc=dc,
        rest=0.3 * normal(count, (degree + 1) ** 2 - 1, 3),
        scaling=(math.log(size_m) + 0.3 * normal(count, 3)).astype(np.float32),
        rotation=(normal(count, 4) * rng.uniform(0.2, 4, (count, 1))).astype(np.float32),
        opacity=(1 + normal(count, 1)).astype(np.float32),
    )


def config_tree(**changes: object) -> dict:
    """A configuration's keys with changes by dotted names, such as **{"data.cameras": [0]}."""
    tree: dict = {
        "task": "waymo", "exp_name": "tiny", "gpus": [0], "mode": "train", "source_path": "",
        "data": {
            "type": "Waymo", "cameras": [0, 1, 2], "selected_frames": None, "use_tracker": False,
            "split_test": -1, "split_train": 1, "box_scale": 1.5, "white_background": False,
        },
        "model": {
            "gaussian": {"sh_degree": 1, "fourier_dim": 5, "fourier_scale": 1.0, "flip_prob": 0.0},
            "nsg": {"include_bkgd": True, "include_obj": True, "include_sky": True,
                    "opt_track": True},
            "sky": {"resolution": 16, "white_background": False},
            "use_color_correction": False, "use_pose_correction": False,
            "color_correction": {"mode": "image", "use_mlp": False, "use_sky": False},
            "pose_correction": {"mode": "image"},
        },
        "optim": {"lambda_sky": 0.05, "track_position_lr_init": 0.005},
    }  # fmt: skip
    for name, value in changes.items():
        *sections, key = name.split(".")
        place = tree
        for section in sections:
            place = place[section]
        place[key] = value
    return tree


def checkpoint(raw: RawModel, iteration: int, *, is_final: bool = True) -> dict:
    """The dictionary that the project gives to torch.save."""
    content: dict = {name: _part_entry(part, is_final) for name, part in raw.parts.items()}
    if raw.opt_trans is not None:
        content["actor_pose"] = _entry(
            {"opt_trans": raw.opt_trans, "opt_rots": raw.opt_rots}, is_final
        )
    if raw.sky is not None:
        content["sky_cubemap"] = _entry({"sky_cube_map": raw.sky}, is_final)
    if raw.affine is not None:
        tables = {"affine_trans": raw.affine, "affine_trans_sky": raw.affine * 0}
        content["color_correction"] = _entry(tables, is_final)
    if raw.moves is not None:
        tables = {"pose_correction_trans": raw.moves, "pose_correction_rots": raw.turns}
        content["pose_correction"] = _entry(tables, is_final)
    return {**content, "iter": iteration, **raw.extra}


def write_model(
    folder: Path,
    raw: RawModel,
    config: dict,
    *,
    iteration: int = 50000,
    is_final: bool = True,
    kinds: tuple[str, ...] = ("pth", "ply"),
) -> Path:
    """The folder of a training's output."""
    (folder / "configs").mkdir(parents=True, exist_ok=True)
    (folder / "configs" / "config_000000.yaml").write_text(yaml.safe_dump(config))
    if "pth" in kinds:
        path = folder / "trained_model" / f"iteration_{iteration}.pth"
        path.parent.mkdir(exist_ok=True)
        torch.save(checkpoint(raw, iteration, is_final=is_final), path)
    if "ply" in kinds:
        path = folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(ply_bytes(raw.parts))
    return folder


def ply_bytes(parts: Mapping[str, RawPart], byte_order: str = "little") -> bytes:
    """One element a part; colours with a channel's values after the other's."""
    lines, body = ["ply", f"format binary_{byte_order}_endian 1.0"], b""
    for name, part in parts.items():
        count, terms, bands = len(part.xyz), part.dc.shape[1], part.rest.shape[1]
        names = ["x", "y", "z", "nx", "ny", "nz"]
        names += [f"f_dc_{i}" for i in range(3 * terms)]
        names += [f"f_rest_{i}" for i in range(3 * bands)]
        names += ["opacity", "scale_0", "scale_1", "scale_2", *(f"rot_{i}" for i in range(4))]
        lines.append(f"element vertex_{name} {count}")
        lines += [f"property float {column}" for column in names]
        rows = np.concatenate(
            [
                part.xyz, np.zeros((count, 3)),
                np.concatenate([part.dc[:, :, c] for c in range(3)], 1),
                np.concatenate([part.rest[:, :, c] for c in range(3)], 1),
                part.opacity, part.scaling, part.rotation,
            ],
            1,
        )  # fmt: skip
        body += rows.astype("<f4" if byte_order == "little" else ">f4").tobytes()
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + body


def _parameter(values: np.ndarray) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.from_numpy(np.ascontiguousarray(values, np.float32)))


def _part_entry(part: RawPart, is_final: bool) -> dict:
    parameters = {name: _parameter(values) for name, values in part.tensors().items()}
    if is_final:
        return parameters
    count = len(part.xyz)
    return {
        **parameters,
        "spatial_lr_scale": np.float64(20.5),
        "denom": torch.zeros(count, 1),
        "max_radii2D": torch.zeros(count),
        "xyz_gradient_accum": torch.zeros(count, 2),
        "active_sh_degree": 1,
        "optimizer": _optimizer(list(parameters.values())),
    }


def _entry(tables: dict[str, np.ndarray], is_final: bool) -> dict:
    module = torch.nn.Module()
    for name, values in tables.items():
        module.register_parameter(name, _parameter(values))
    entry: dict = {"params": module.state_dict()}
    if not is_final:
        entry["optimizer"] = _optimizer(list(module.parameters()))
    return entry


def _optimizer(parameters: list[torch.nn.Parameter]) -> dict:
    """The state of an Adam after a step."""
    optimizer = torch.optim.Adam(
        [{"params": [p], "lr": 0.01, "name": str(i)} for i, p in enumerate(parameters)],
        lr=0.0,
        eps=1e-15,
    )
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    return optimizer.state_dict()
