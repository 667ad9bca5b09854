"""nuScenes as scenes: `open_nuscenes`."""

from adapters.nuscenes.adapter import open_nuscenes
from adapters.nuscenes.frames import FrameToken, frame_tokens
from adapters.nuscenes.labels import nuscenes_labels

__all__ = ["FrameToken", "frame_tokens", "nuscenes_labels", "open_nuscenes"]
