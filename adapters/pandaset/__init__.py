"""PandaSet as scenes: `open_pandaset`."""

from adapters.pandaset.adapter import open_pandaset
from adapters.pandaset.labels import pandaset_labels

__all__ = ["open_pandaset", "pandaset_labels"]
