"""PyTorch datasets: over the files that jobs have written, and rendered on the fly.

Both yield the samples that `augment.dataset.samples` describes, with the same pixels.
"""

from augment.dataset.clips_pairs import ClipDataset, MixedDataset, PairedDataset, clean_frames
from augment.dataset.live import SceneDataset
from augment.dataset.samples import Boxes2d, boxes_2d, collate_frames
from augment.dataset.splits import ShardedSampler, split_by_scene
from augment.dataset.vision import box_masks, torchvision_sample
from augment.dataset.weather_dataset import WeatherDataset

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
