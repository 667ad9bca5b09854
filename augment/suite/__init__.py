"""Robustness suites: rendered by dataset jobs, checked by their hashes, or rendered on the fly."""
