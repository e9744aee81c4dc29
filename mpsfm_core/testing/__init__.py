"""Contract tests for plugin authors: checks of providers on views with known ground truth.

The test file of a plugin contains::

    from mpsfm_core.testing import contract_tests

    test_contract = contract_tests("depth", "my-depth")

The page docs/contract.md lists the contract checks. :class:`ContractSetup` declares how to test a
provider.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mpsfm_core.testing.contract import CheckResult, run_checks
    from mpsfm_core.testing.contract_case import ContractCase, ContractSetup
    from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
    from mpsfm_core.testing.pytest_tests import contract_tests, hook_tests

_LAZY_NAMES = {
    "CheckFailed": "outcome",
    "CheckResult": "contract",
    "CheckSkipped": "outcome",
    "ContractCase": "contract_case",
    "ContractSetup": "contract_case",
    "contract_tests": "pytest_tests",
    "hook_tests": "pytest_tests",
    "run_checks": "contract",
}
"""Module of each exported name. The second process of a contract imports few of the modules."""

__all__ = [
    "CheckFailed",
    "CheckResult",
    "CheckSkipped",
    "ContractCase",
    "ContractSetup",
    "contract_tests",
    "hook_tests",
    "run_checks",
]


def __getattr__(name: str) -> Any:
    """Import an exported name at first use."""
    if name not in _LAZY_NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_LAZY_NAMES[name]}"), name)
    globals()[name] = value
    return value
