"""KITTI as scenes."""
