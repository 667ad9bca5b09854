"""PyTorch datasets: over the files that jobs have written, and rendered on the fly.

Both yield the samples that `augment.dataset.samples` describes, with the same pixels.
"""

from augment.dataset.boxes import Boxes2d, boxes_2d
from augment.dataset.clips import ClipDataset
from augment.dataset.collate import collate_frames
from augment.dataset.files import WeatherDataset
from augment.dataset.live import SceneDataset
from augment.dataset.pairs import MixedDataset, PairedDataset, clean_frames
from augment.dataset.shards import ShardedSampler
from augment.dataset.splits import split_by_scene
from augment.dataset.vision import box_masks, torchvision_sample

__all__ = [
    "Boxes2d",
    "ClipDataset",
    "MixedDataset",
    "PairedDataset",
    "SceneDataset",
    "ShardedSampler",
    "WeatherDataset",
    "box_masks",
    "boxes_2d",
    "clean_frames",
    "collate_frames",
    "split_by_scene",
    "torchvision_sample",
]
