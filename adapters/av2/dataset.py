"""The record of Argoverse 2's sensor dataset."""

from adapters.dataset import Dataset, FolderLayout, Signature, fixed_tree

_POSES = "city_SE3_egovehicle.feather"

AV2 = Dataset(
    scheme="av2",
    description="a log of Argoverse 2's sensor dataset",
    page="av2.md",
    example="av2:data/av2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede",
    opener="adapters.av2.adapter:open_av2",
    labels="adapters.av2.adapter:av2_labels",
    is_raw=True,
    folder=Signature(
        lambda folder: (folder / _POSES).is_file(), f"a log of Argoverse 2 ({_POSES})"
    ),
    layouts=(
        FolderLayout(
            "an Argoverse 2 log",
            {
                _POSES: (_POSES,),
                "calibration/intrinsics.feather": ("calibration/intrinsics.feather",),
                "sensors/lidar/": ("sensors/lidar",),
                "sensors/cameras/": ("sensors/cameras",),
            },
        ),
    ),
    source_tree=fixed_tree(r"sensors/cameras/[^/]+/\d+\.jpg", r"sensors/lidar/\d+\.feather"),
)
