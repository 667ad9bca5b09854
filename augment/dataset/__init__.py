"""PyTorch datasets: over the files that jobs have written, and rendered on the fly.

Both yield the samples that `augment.dataset.samples` describes, with the same pixels.
"""

from augment.dataset.boxes import Boxes2d, box_masks, boxes_2d, torchvision_sample
from augment.dataset.clips_pairs import (
    ClipDataset,
    MixedDataset,
    PairedDataset,
    ShardedSampler,
    clean_frames,
    split_by_scene,
)
from augment.dataset.label_files import LabelOptions, write_labels
from augment.dataset.live import SceneDataset
from augment.dataset.samples import collate_frames
from augment.dataset.weather_dataset import WeatherDataset

__all__ = [
    "Boxes2d",
    "ClipDataset",
    "LabelOptions",
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
    "write_labels",
]
