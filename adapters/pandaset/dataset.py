"""PandaSet's record."""

from adapters.dataset import Dataset, FolderLayout, Signature, fixed_tree

PANDASET = Dataset(
    scheme="pandaset",
    description="a PandaSet sequence",
    page="pandaset.md",
    example="pandaset:data/pandaset/002",
    opener="adapters.pandaset.adapter:open_pandaset",
    labels="adapters.pandaset.adapter:pandaset_labels",
    is_raw=True,
    folder=Signature(
        lambda folder: (folder / "camera").is_dir() and (folder / "lidar").is_dir(),
        "a PandaSet sequence (camera/ and lidar/)",
    ),
    layouts=(FolderLayout("a PandaSet sequence", {"camera/": ("camera",), "lidar/": ("lidar",)}),),
    source_tree=fixed_tree(r"camera/[^/]+/\d+\.jpg", r"lidar/\d+\.pkl\.gz"),
)
