"""A Street Gaussians model of any size with random splats, and the data it needs, for timing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
import yaml

_FRAMES = 100
_CAMERAS = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT")
_TERMS, _SH_COUNT = 5, 4  # as the shipped configurations: Fourier terms of actors, SH degree 1
_SKY_TEXELS = 1024
_ACTOR_SHARE = 0.2  # of all splats


def write_model(folder: Path, gaussians: int, actors: int) -> tuple[Path, Path, int]:
    """A model and its data below a folder: their folders, and the bytes of all its tensors."""
    data, model = folder / "data", folder / "model"
    _write_data(data, actors)
    generator = torch.Generator().manual_seed(0)
    each = round(gaussians * _ACTOR_SHARE / max(1, actors))
    state = {"background": _part(gaussians - each * actors, 1, 60.0, generator)}
    state |= {f"obj_{number:03d}": _part(each, _TERMS, 1.5, generator) for number in range(actors)}
    state["actor_pose"] = {
        "params": {
            "opt_trans": 0.05 * torch.randn(_FRAMES, max(1, actors), 3, generator=generator),
            "opt_rots": 0.01 * torch.randn(_FRAMES, max(1, actors), 1, generator=generator),
        }
    }
    sky = torch.rand(6, _SKY_TEXELS, _SKY_TEXELS, 3, generator=generator)
    state["sky_cubemap"] = {"params": {"sky_cube_map": sky}}
    state["iter"] = 30_000
    (model / "trained_model").mkdir(parents=True)
    (model / "configs").mkdir()
    torch.save(state, model / "trained_model" / "iteration_30000.pth")
    config = {
        "source_path": str(data),
        "data": {"cameras": [0, 1, 2], "selected_frames": [0, _FRAMES - 1]},
        "model": {
            "gaussian": {"sh_degree": 1, "fourier_dim": _TERMS, "fourier_scale": 1.0},
            "nsg": {"include_bkgd": True, "include_obj": True, "include_sky": True},
        },
    }
    (model / "configs" / "config_030000.yaml").write_text(yaml.safe_dump(config))
    return model, data, _bytes_of(state)


def _part(count: int, terms: int, reach_m: float, generator: torch.Generator) -> dict:
    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return {
        "xyz": normal(count, 3) * reach_m,
        "feature_dc": normal(count, terms, 3) * 0.5,
        "feature_rest": normal(count, _SH_COUNT - 1, 3) * 0.1,
        "scaling": normal(count, 3) * 0.5 - 4,
        "rotation": normal(count, 4),
        "opacity": normal(count, 1),
        "semantic": torch.zeros(count, 0),
    }


def _bytes_of(state: object) -> int:
    if isinstance(state, torch.Tensor):
        return state.numel() * state.element_size()
    return sum(map(_bytes_of, state.values())) if isinstance(state, dict) else 0


def _write_data(data: Path, actors: int) -> None:
    for name in ("ego_pose", "extrinsics", "intrinsics", "track"):
        (data / name).mkdir(parents=True)
    for cam in range(5):
        turned = np.radians([0, 45, -45, 90, -90])[cam]
        _write(data / "extrinsics" / f"{cam}.txt", _camera_pose(turned))
        intrinsics = [2000, 2000, 960, 640 if cam < 3 else 443, 0, 0, 0, 0, 0]
        _write(data / "intrinsics" / f"{cam}.txt", np.array(intrinsics, float)[:, None])
    times: dict[str, dict[str, float]] = {"FRAME": {}}
    names = (*_CAMERAS, "SIDE_LEFT", "SIDE_RIGHT")
    for frame in range(_FRAMES):
        key, second = f"{frame:06d}", 0.1 * frame
        times["FRAME"][key] = second
        _write(data / "ego_pose" / f"{key}.txt", _ego(second))
        for cam, name in enumerate(names):
            at = second + 0.01 * (cam + 1)
            times.setdefault(name, {})[key] = at
            _write(data / "ego_pose" / f"{key}_{cam}.txt", _ego(at))
    (data / "timestamps.json").write_text(json.dumps(times))
    header = (
        "frame_id track_id object_class alpha box_height box_width box_length "
        "box_center_x box_center_y box_center_z box_heading speed"
    )
    rows, seen = [header], {str(number): {} for number in range(actors)}
    for frame in range(_FRAMES):
        for number in range(actors):
            x, y = 8.0 + number + 0.4 * frame, 3.5 * (number % 2) - 1.75
            rows.append(f"{frame} {number} vehicle -10 1.6 1.9 4.5 {x} {y} 0.8 0.1 4.0")
            seen[str(number)][str(frame)] = [0, 1]
    (data / "track" / "track_info.txt").write_text("\n".join(rows) + "\n")
    (data / "track" / "track_camera_vis.json").write_text(json.dumps(seen))


def _ego(second: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = [1000 + 10 * second, 500, 20]
    return pose


def _camera_pose(turned: float) -> np.ndarray:
    """Vehicle from an OpenCV camera that looks forward, turned to the left."""
    c, s = np.cos(turned), np.sin(turned)
    axes = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose = np.eye(4)
    pose[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ axes
    pose[:3, 3] = [1.5, 0, 2.1]
    return pose


def _write(path: Path, matrix: np.ndarray) -> None:
    np.savetxt(path, matrix)
