"""The training code beside the package is no part of it: tests put it on the path."""

from __future__ import annotations

from pathlib import Path

import pytest

PLUGIN = Path(__file__).parents[1]


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes ``training`` importable; skips where its packages are missing."""
    pytest.importorskip("torch")
    monkeypatch.syspath_prepend(str(PLUGIN))
