"""Import path of the training code, which is not part of the installed package."""

from __future__ import annotations

from pathlib import Path

import pytest

PLUGIN = Path(__file__).parents[1]


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the package ``training`` importable, or skip the test if torch is missing."""
    pytest.importorskip("torch")
    monkeypatch.syspath_prepend(str(PLUGIN))
