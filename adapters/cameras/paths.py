"""Other cameras for a scene, from a path file.

The path file is a camera path (`adapters.cameras.path_json`), an INRIA cameras.json, a nerfstudio
transforms.json or a COLMAP model. Its poses are in the scene's world before recentring: metres, +z
up, `Scene.world_origin_m` not yet subtracted. Its times count from the scene's first frame, so that
moving actors are where they were then. (Cameras in a splat file's own axes and unit belong
into that scene's URI: `gaussians:FILE?cameras=…`.)
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from adapters.cameras.default_paths import NO_CAMERAS
from adapters.cameras.files import read_views
from adapters.cameras.frames import frames_from_views
from adapters.uri import CAMERA_PATH_KEY, add_to_uri
from adapters.world import WorldChange
from augment.cameras import Frame
from augment.scene import Scene


def frames_from_path_file(path: str | Path, scene: Scene) -> tuple[Frame, ...]:
    """The frames of a path file, in the scene's recentred world.

    Raises:
        AdapterError: no such file, or one that cannot be used; names the field.
    """
    return _frames_and_problems(Path(path), scene)[0]


def with_camera_path(scene: Scene, path: str | Path) -> Scene:
    """The scene with the frames of a path file in place of its own, and without the labels, which
    belong to the frames it had. Its `source` opens it again, path included.

    Raises:
        AdapterError: as for frames_from_path_file.
    """
    frames, problems = _frames_and_problems(Path(path), scene)
    return dataclasses.replace(
        scene,
        frames=frames,
        labels=None,
        source=add_to_uri(scene.source, CAMERA_PATH_KEY, str(path)),
        problems=(*(p for p in scene.problems if not p.startswith(NO_CAMERAS)), *problems),
    )


def _frames_and_problems(path: Path, scene: Scene) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    found = read_views(path)
    frames, problems = frames_from_views(
        found.views,
        WorldChange(origin_m=scene.world_origin_m),
        start_ns=scene.frames[0].timestamp_ns if scene.frames else 0,
    )
    if scene.labels is not None:
        problems += (f"{path}: its frames are not the dataset's, so boxes and LiDAR are left out",)
    return frames, (*found.problems, *problems)
