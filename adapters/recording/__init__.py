"""Raw data in a plain folder as scenes: `open_recording`."""

from adapters.recording.adapter import open_recording

__all__ = ["open_recording"]
