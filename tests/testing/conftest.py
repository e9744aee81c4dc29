"""Fixtures that require that faulty providers fail the contract check for their fault."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mpsfm_core.providers import Kind, ProviderSpec
from mpsfm_core.providers.builtin.plugin import mpsfm_providers as builtin_providers
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import run_checks
from mpsfm_core.testing.contract import SetupSource

Caught = Callable[..., None]


@pytest.fixture
def named() -> Callable[..., set[str]]:
    """Return the checks that the cases of parametrized tests name in the column ``check``."""

    def checks(*tests: Any) -> set[str]:
        marks = [mark for test in tests for mark in test.pytestmark if mark.name == "parametrize"]
        columns = [
            (mark.args[0].index("check"), mark.args[1]) for mark in marks if "check" in mark.args[0]
        ]
        return {case[column] for column, cases in columns for case in cases}

    return checks


@pytest.fixture
def caught(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Caught:
    """Assert that a check fails for a provider, with a message that matches.

    ``caught("depth", RayLength, "depth-is-z", "length of the ray", setup, "metric")``; files that
    the provider leaves behind are written to a temporary directory.
    """
    monkeypatch.chdir(tmp_path)

    def catch(
        kind: Kind,
        factory: Any,
        check: str,
        message: str,
        setup: SetupSource = None,
        *capabilities: str,
        options: Any = None,
    ) -> None:
        registry = Registry()
        registry.add(*builtin_providers())
        registry.add(ProviderSpec(kind, "wrong", factory, options, frozenset(capabilities)))
        found = run_checks(registry, kind, "wrong", setup, only={check})
        failed = [r.message for r in found if r.status == "fail"]
        assert failed, [(r.status, r.message) for r in found]
        assert re.search(message, failed[0]), failed[0]

    return catch
