"""Import path of the training code, which is not part of the package."""

from __future__ import annotations

from pathlib import Path

import pytest

PLUGIN = Path(__file__).parents[1]


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make ``training`` importable; skip if its packages are missing."""
    pytest.importorskip("torch")
    monkeypatch.syspath_prepend(str(PLUGIN))
