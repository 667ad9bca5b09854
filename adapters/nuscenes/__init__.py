"""nuScenes as scenes: `open_nuscenes`."""

from adapters.nuscenes.adapter import open_nuscenes
from adapters.nuscenes.labels import nuscenes_labels
from adapters.nuscenes.tables import FrameToken, frame_tokens

__all__ = ["FrameToken", "frame_tokens", "nuscenes_labels", "open_nuscenes"]
