"""Fixtures for the tests of all plugins in this repository."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mpsfm_core import ProviderContext
from mpsfm_core.providers.weights import WeightStore

SLOW_CHECKS = frozenset({"second-process", "memory-released"})
"""Contract checks of providers that need seconds, because a process imports all libraries again or
a provider is called many times."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the contract checks in ``SLOW_CHECKS`` as slow."""
    for item in items:
        callspec = getattr(item, "callspec", None)
        if callspec is not None and callspec.id in SLOW_CHECKS:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def context(tmp_path_factory: pytest.TempPathFactory) -> ProviderContext:
    """Return a provider context with one thread and without Internet access."""
    store = WeightStore(tmp_path_factory.mktemp("cache"), offline=True)
    return ProviderContext(resolve_weights=store.resolve, threads=1)


@pytest.fixture
def write_onnx(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes an ONNX model to the temporary folder of the test."""
    stand_in = pytest.importorskip("mpsfm_onnx.stand_in")

    def write(text: str, name: str = "tiny.onnx", **arrays: Any) -> Path:
        path: Path = stand_in.save_model(text, tmp_path / name, **arrays)
        return path

    return write
