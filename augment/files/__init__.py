"""Scenes as files: our own format, and what other programs read."""
