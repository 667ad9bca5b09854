"""The subcommands of `climategs` that hand a scene or a dataset to other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tyro.conf import Positional


def export(
    scene: Positional[str],
    out: Path,
    kind: Literal["file", "scene", "ply", "ply-parts", "splat"] = "file",
    frame: int | None = None,
    half: bool = False,
    overwrite: bool = False,
) -> int:
    """Write a scene as one file to share, or for other programs: .ply, .splat.

    What the kind of file cannot keep is said.

    Args:
        scene: The scene, as for render.
        out: The file or folder; a file's suffix is added where it lacks.
        kind: file: everything in one .climategs file. scene: the same as a folder. ply, splat:
            Gaussians as they are at one frame. ply-parts: background and every actor apart.
        frame: At which ply and splat are baked. The first by default.
        half: A file of about half the size, at a small loss.
        overwrite: Replace what is there.
    """
    from tools.export import export_scene

    return export_scene(scene, out, kind=kind, frame=frame, half=half, overwrite=overwrite)


def mirror(
    out: Positional[Path], scene: str | None = None, links: Literal["hard", "copy"] = "hard"
) -> int:
    """Lay rendered images into copies of their dataset, as `render --layout source` does.

    Args:
        out: A folder that `climategs render` or `generate` wrote.
        scene: Only of this scene. By default of all that the manifest names.
        links: hard: unchanged files share the dataset's disk space. copy: nothing is shared.
    """
    from tools.local_output import check_local
    from tools.mirror import mirror_again

    check_local(out, "copy the output here")
    return mirror_again(out, scene, links=links)
