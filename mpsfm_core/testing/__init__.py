"""What plugin authors and our own tests use: analytic scenes and the contract of providers.

A plugin's test file is::

    from mpsfm_core.testing import contract_tests

    test_contract = contract_tests("depth", "my-depth")

See docs/contract.md for the checks, and :class:`ContractSetup` for how a provider is put under test.
"""

from __future__ import annotations

from mpsfm_core.testing.contract import CheckResult, run_checks
from mpsfm_core.testing.contract_case import ContractCase, ContractSetup
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
from mpsfm_core.testing.pytest_tests import contract_tests

__all__ = [
    "ContractCase",
    "CheckFailed",
    "CheckResult",
    "CheckSkipped",
    "ContractSetup",
    "contract_tests",
    "run_checks",
]
