"""Fixtures shared by the tests of all first-party plugins."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mpsfm_core import ProviderContext
from mpsfm_core.weights import WeightStore

_DEFAULT = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with real scenes and models (``data/``, ``models/``): $MPSFM_SHARED or ../shared."""
    folder = Path(os.environ.get("MPSFM_SHARED", _DEFAULT))
    if not folder.is_dir():
        pytest.skip("no shared scenes and models here (set MPSFM_SHARED)")
    return folder


@pytest.fixture(scope="session")
def context(tmp_path_factory: pytest.TempPathFactory) -> ProviderContext:
    """One thread, no network."""
    store = WeightStore(tmp_path_factory.mktemp("cache"), offline=True)
    return ProviderContext(resolve_weights=store.resolve, threads=1)
