"""Scores of detectors and segmentation networks on a robustness suite. Nothing is rendered here."""
