"""A small dataset's folder, images of it in other weather, and what a copy of it must keep."""

from __future__ import annotations

import dataclasses
import functools
import os
from pathlib import Path

import cv2
import numpy as np

from augment.jobs.mirror import (
    DatasetFolder,
    MirrorResult,
    mirror_dataset,
    mirror_folder,
    survey,
    weathered_images,
)
from augment.jobs.render_job import RenderJob, run_job
from augment.output.manifest import read_manifest
from augment.scene.scene import Scene
from tests.augment.batch_scenes import SIZE, FakeLabels, fake_render, make_recipe, open_fake

IMAGES = r"camera/[^/]+/\d+\.(png|jpg)"
CAMERAS = {"front": "front", "rear/left": "rear"}  # and their folders


def write_dataset(
    root: Path, *, suffix: str = "png", size: tuple[int, int] = SIZE, frames: int = 4
) -> Path:
    """Images of two cameras, tables, an empty folder, a file without content."""
    rng = np.random.default_rng(1)
    for folder in CAMERAS.values():
        (root / "camera" / folder).mkdir(parents=True)
        for frame in range(frames):
            path = root / "camera" / folder / f"{frame:02d}.{suffix}"
            cv2.imwrite(str(path), rng.integers(0, 256, (*size[::-1], 3), dtype=np.uint8))
        (root / "camera" / folder / "poses.json").write_text('[{"x": 1}]')
    (root / "lidar" / "raw").mkdir(parents=True)
    (root / "lidar" / "raw" / "00.bin").write_bytes(rng.bytes(5000))
    (root / "lidar" / "nothing.txt").touch()
    (root / "maps").mkdir()
    (root / "README.md").write_text("A dataset.\n")
    for number, path in enumerate(sorted(root.rglob("*"))):
        if path.is_file():
            os.utime(path, ns=(10**18, 10**18 + 1001 * number))
    return root


def tree_of(root: Path, **options) -> DatasetFolder:
    return DatasetFolder(f"test:{root}", root.absolute(), IMAGES, **options)


_open = functools.cache(open_fake)


def scene_of(root: Path, name: str = "street") -> Scene:
    """The scene of a dataset: recorded images where there are any."""
    scene = _open(f"fake:{name}")
    frames = []
    for frame in scene.frames:
        image_paths = {
            camera: str(path)
            for camera, folder in CAMERAS.items()
            for path in (root / "camera" / folder).glob(f"{frame.index:02d}.*")
        }
        frames.append(dataclasses.replace(frame, image_paths=image_paths))
    return dataclasses.replace(scene, frames=tuple(frames), labels=FakeLabels())


def render(root: Path, out: Path, *, scale: float = 1.0, name: str = "fog", **options) -> None:
    """Images of the dataset's scene under a recipe, as small as can be. options: of the job, and
    `image`, their format."""
    image = options.pop("image", "png")
    renderer = options.pop("renderer", fake_render)
    recipe = make_recipe(
        name, semantic=False, instance=False, depth="none", lidar=False, image=image
    )
    render_settings = recipe.render.model_copy(update={"scale": scale})
    recipe = recipe.model_copy(update={"render": render_settings})
    job = RenderJob("fake:street", [recipe], out, **options)
    run_job(job, scene_loader=lambda _: scene_of(root), renderer=renderer, progress=False)


def mirror(root: Path, out: Path, variant: str = "fog-000", **options) -> MirrorResult:
    """Build the copy of the dataset with the images that `render` made."""
    tree = options.pop("tree", None) or tree_of(root)
    rows = [row for row in read_manifest(out).to_pylist() if row["variant"] == variant]
    images, notes = weathered_images(out, rows, scene_of(root).frames, tree)
    assert notes == []
    return mirror_dataset(
        tree,
        mirror_folder(out, variant),
        images,
        {"street": {"seed": 7}},
        extent=survey(tree),
        progress=False,
        **options,
    )


def listing(root: Path) -> list[str]:
    """Every file, folder and link below a folder."""
    return sorted(str(path.relative_to(root)) for path in root.rglob("*"))


def snapshot(root: Path) -> dict[str, tuple]:
    """All that must not change of a source: kinds, modes, times of change, inodes, contents."""
    file_states = {}
    for path in [root, *root.rglob("*")]:
        facts = path.lstat()
        content = path.read_bytes() if path.is_file() else None
        text = os.readlink(path) if path.is_symlink() else None
        key = (facts.st_mode, facts.st_mtime_ns, facts.st_ino, facts.st_size, content, text)
        file_states[str(path)] = key
    return file_states


def contents(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}
