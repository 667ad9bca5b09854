"""The record of Street Gaussians: trained models, and the dataset that they are trained on."""

from __future__ import annotations

import re
from pathlib import Path

from adapters.dataset import Dataset, Signature, fixed_tree, read_start

DATA_FOLDERS = ("ego_pose", "extrinsics", "track")
_MULTI_PART = b"element vertex_"  # how a .ply names its parts


def _is_here(folder: Path) -> bool:
    is_data = all((folder / name).is_dir() for name in DATA_FOLDERS)
    if is_data or any(folder.glob("trained_model/iteration_*.pth")):
        return True
    return any(map(_is_multi_part, folder.glob("point_cloud/iteration_*/point_cloud.ply")))


def _is_multi_part(path: Path) -> bool:
    start = read_start(path)
    return start.startswith(b"ply") and _MULTI_PART in start


STREET_GAUSSIANS = Dataset(
    scheme="street_gaussians",
    description="a trained Street Gaussians model, or its dataset",
    page="street-gaussians.md",
    example="street_gaussians:output/waymo/002?data=data/waymo/002",
    opener="adapters.street_gaussians.adapter:open_street_gaussians",
    labels="adapters.street_gaussians.adapter:street_gaussians_labels",
    folder=Signature(
        _is_here,
        "a Street Gaussians model (trained_model/iteration_N.pth) or its dataset (ego_pose/, "
        "extrinsics/, track/)",
    ),
    file=Signature(
        lambda path: _is_multi_part(path) or bool(re.fullmatch(r"iteration_\d+\.pth", path.name)),
        "iteration_N.pth of Street Gaussians",
    ),
    source_tree=fixed_tree(r"images/[^/]+\.(png|jpg)"),
)
