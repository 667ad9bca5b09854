"""PandaSet as scenes: `open_pandaset`."""

from adapters.pandaset.adapter import open_pandaset

__all__ = ["open_pandaset"]
