"""Errors that cross a boundary of the library; arguments raise ValueError or TypeError."""


class ClimateGSError(Exception):
    """Base of every error a user of the library can act on."""


class SceneError(ClimateGSError):
    """A scene, or a file that holds one, cannot be used as it is."""


class AdapterError(SceneError):
    """A dataset or scene file could not be turned into a Scene."""


class BackendUnavailable(ClimateGSError):
    """A rasteriser backend was named that this machine cannot run."""


class GpuLost(ClimateGSError):
    """The GPU no longer answers this process; another process may still use it."""


class OutputError(ClimateGSError):
    """The output folder cannot be written, or holds something else."""


class StyleError(ClimateGSError):
    """A style image, mask, preset or network cannot be used as it is."""


class MetricError(ClimateGSError):
    """A metric's weights cannot be used as they are."""


class LampError(ClimateGSError):
    """A lamp, or a file that describes one, cannot be used as it is."""


class ScoreError(ClimateGSError):
    """Predictions, a baseline or a suite cannot be scored as they are."""
