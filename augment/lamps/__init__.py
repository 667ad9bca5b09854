"""Lamps of a scene at a moment: records of light sources, and the light that they send."""
