"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with real scenes and models (``data/``, ``models/``): $MPSFM_SHARED or ../shared."""
    folder = Path(os.environ.get("MPSFM_SHARED", _DEFAULT))
    if not folder.is_dir():
        pytest.skip("no shared scenes and models here (set MPSFM_SHARED)")
    return folder
