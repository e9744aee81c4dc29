"""Contract tests for plugin authors: checks of providers on views with known ground truth.

The test file of a plugin contains::

    from mpsfm_core.testing import contract_tests

    test_contract = contract_tests("depth", "my-depth")

The page docs/contract.md lists the contract checks. :class:`ContractSetup` declares how to test a
provider.
"""

from __future__ import annotations

from mpsfm_core.testing.contract import CheckResult, run_checks
from mpsfm_core.testing.contract_case import ContractCase, ContractSetup
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
from mpsfm_core.testing.pytest_tests import contract_tests, hook_tests

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
