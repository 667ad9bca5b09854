"""drivestudio runs as scenes: `open_drivestudio`."""

from adapters.drivestudio.adapter import open_drivestudio
from adapters.drivestudio.drive import drivestudio_labels

__all__ = ["drivestudio_labels", "open_drivestudio"]
