"""Cameras of a COLMAP sparse model (cameras, images; .bin or .txt), read by pycolmap."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from adapters.cameras.json_formats import distortion_problem
from adapters.cameras.posed_views import PosedView, ViewSet, check_pose
from augment.errors import AdapterError

_MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")


def find_colmap_model(folder: Path) -> Path | None:
    """The folder of the sparse model in or below `folder`, or None."""
    for name in _MODEL_FOLDERS:
        model = folder / name
        for suffix in (".bin", ".txt"):
            if all((model / f"{table}{suffix}").is_file() for table in ("cameras", "images")):
                return model
    return None


def read_colmap_views(model: Path) -> ViewSet:
    """Views of the registered images. Lens distortion is left out, and said so.

    Raises:
        AdapterError: the model is damaged or holds no posed image.
    """
    import pycolmap  # 0.2 s and a large native library: only those who have COLMAP models pay

    try:
        reconstruction = pycolmap.Reconstruction(str(model))
    except (ValueError, RuntimeError, IndexError) as error:
        raise AdapterError(
            f"{model}: pycolmap cannot read this COLMAP model: {error}. Expected cameras, images "
            "and points3D, all .bin or all .txt"
        ) from error
    folder = next((f for f in _image_folders(model) if f.is_dir()), None)
    views = []
    distorted: Counter[str] = Counter()
    for image in sorted(reconstruction.images.values(), key=lambda image: image.name):
        if not image.has_pose:
            continue
        camera = reconstruction.cameras[image.camera_id]
        if not camera.is_undistorted():
            distorted[camera.model_name] += 1
        camera_from_world = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        path = folder / image.name if folder else None
        views.append(
            PosedView(
                name=image.name,
                width=camera.width,
                height=camera.height,
                fx=camera.focal_length_x,
                fy=camera.focal_length_y,
                cx=camera.principal_point_x,
                cy=camera.principal_point_y,
                world_from_camera=_inverse(camera_from_world, f"{model}: image {image.name}"),
                image_path=str(path) if path and path.is_file() else None,
            )
        )
    if not views:
        raise AdapterError(f"{model}: this COLMAP model holds no image with a pose")
    problems = [distortion_problem(str(model), n, m) for m, n in distorted.items()]
    return ViewSet(tuple(views), tuple(problems))


def _image_folders(model: Path) -> list[Path]:
    """Where COLMAP projects keep the images of project/sparse/0, project/sparse or project."""
    return [parent / "images" for parent in (model, model.parent, model.parent.parent)]


def _inverse(camera_from_world: np.ndarray, where: str) -> np.ndarray:
    pose = check_pose(camera_from_world, where=where)
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse
