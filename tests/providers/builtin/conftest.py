"""Fixtures for tests of built-in providers: views and the provider context."""

from __future__ import annotations

from pathlib import Path

import pytest

from mpsfm_core.data.errors import WeightsError
from mpsfm_core.providers import ProviderContext


def _no_weights(uri: str, sha256: str | None) -> Path:
    raise WeightsError(f"built-in providers have no weights, asked for {uri}")


@pytest.fixture
def context() -> ProviderContext:
    return ProviderContext(resolve_weights=_no_weights)
