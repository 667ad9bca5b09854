"""Street Gaussians models and their data as scenes."""
