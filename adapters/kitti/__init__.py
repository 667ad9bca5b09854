"""KITTI as scenes: `open_kitti` for raw drives and for frames of the object benchmark."""

from adapters.kitti.adapter import kitti_labels, open_kitti
from adapters.kitti.files import kitti_root

__all__ = ["kitti_labels", "kitti_root", "open_kitti"]
