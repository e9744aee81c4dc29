"""Contract checks as pytest items, for ``pytest --mpsfm-plugin NAME``."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from mpsfm_core.data.errors import MpsfmError
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.contract import CheckTask, Contract, find_providers, parse_setup
from mpsfm_core.testing.pytest_tests import report


class ContractCollection:
    """Pytest plugin that collects one item per contract check of each named provider."""

    def __init__(self, names: Sequence[str], options: Sequence[str]) -> None:
        self._names = names
        self._options = options
        self._folder = Path(tempfile.mkdtemp(prefix="mpsfm-contract-"))

    # Run before pytest's own filters, so that -k and -m also select among these items.
    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(
        self, session: pytest.Session, items: list[pytest.Item]
    ) -> None:
        """Add the contract checks to the collected pytest items. Creates no provider."""
        try:
            setup = parse_setup(self._options)
            registry = Registry.discover()
            providers = [p for name in self._names for p in find_providers(registry, name)]
            contracts = [
                Contract(registry, *p, self._folder, setup) for p in dict.fromkeys(providers)
            ]
        except MpsfmError as error:
            raise pytest.UsageError(str(error)) from error
        for contract in contracts:
            parent = _Provider.from_parent(
                session, name=contract.provider, nodeid=contract.provider
            )
            for task in contract.tasks():
                item = ContractItem.from_parent(
                    parent, name=str(task), contract=contract, task=task
                )
                items.append(item)

    def pytest_unconfigure(self) -> None:
        """Remove the folder with the weights files of test networks."""
        shutil.rmtree(self._folder, ignore_errors=True)


class _Provider(pytest.Collector):
    """Pytest collector that is the parent of the contract checks of one provider."""

    def collect(self) -> list[pytest.Item | pytest.Collector]:
        """Return no pytest items, because these are created together with this collector."""
        return []


class ContractItem(pytest.Item):
    """Pytest item of one contract check."""

    def __init__(self, *, contract: Contract, task: CheckTask, **rest: Any) -> None:
        super().__init__(**rest)
        self._contract = contract
        self._task = task

    def runtest(self) -> None:
        """Run the contract check and report its result to pytest."""
        report(self._contract.run(self._task))

    def reportinfo(self) -> tuple[Path, None, str]:
        """Return the name of the contract check for pytest's reports."""
        return self.path, None, f"{self._contract.provider} {self._task}"
