"""Street Gaussians models and their data as scenes."""

from adapters.street_gaussians.adapter import open_street_gaussians, street_gaussians_labels

__all__ = ["open_street_gaussians", "street_gaussians_labels"]
