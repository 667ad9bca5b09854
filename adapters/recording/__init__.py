"""Raw data in a plain folder as scenes: `open_recording`."""

from adapters.recording.adapter import open_recording
from adapters.recording.labels import recording_labels

__all__ = ["open_recording", "recording_labels"]
