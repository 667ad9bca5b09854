"""Fixtures shared by all tests. Nothing of the library is imported here at the top."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder with real data and reference renders beside the project; skips where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip(f"real data and reference renders are not at {folder}")
    return folder
