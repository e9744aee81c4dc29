"""Contract checks as pytest functions in a plugin's own test file."""

from __future__ import annotations

from collections.abc import Callable

from mpsfm_core.providers import Kind
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.contract import (
    CheckResult,
    CheckTask,
    Contract,
    SetupSource,
    check_id,
    schedule_checks,
)


def contract_tests(
    kind: Kind, name: str, setup: SetupSource = None, *, registry: Registry | None = None
) -> Callable[..., None]:
    """Create a parametrized pytest function with one test per contract check of a provider.

    Example::

        test_contract = contract_tests("depth", "my-depth")

    Args:
        kind: Kind of the provider, such as ``depth``.
        name: Name of the provider.
        setup: ContractSetup, or a function that returns one; by default that of the
            specification.
        registry: Registry of providers, by default all installed plugins.

    Returns:
        Parametrized pytest function to assign in a test module.

    Raises:
        ProviderError: the provider does not exist or is unavailable.
    """
    import pytest

    registry = registry or Registry.discover()
    tasks = schedule_checks(registry.spec(kind, name))
    contracts: list[Contract] = []

    def test_contract(task: CheckTask, tmp_path_factory: pytest.TempPathFactory) -> None:
        if not contracts:
            folder = tmp_path_factory.mktemp("contract")
            contracts.append(Contract(registry, kind, name, folder, setup))
        report(contracts[0].run(task))

    mark = pytest.mark.parametrize("task", tasks, ids=[str(task) for task in tasks])
    tests: Callable[..., None] = mark(test_contract)
    return tests


def hook_tests(name: str, *, registry: Registry | None = None) -> Callable[..., None]:
    """Create a parametrized pytest function with one test per contract check of hooks.

    Args:
        name: Name of the plugin's entry point or distribution.
        registry: Registry of plugins, by default all installed plugins.

    Returns:
        Parametrized pytest function to assign in a test module.
    """
    import pytest

    from mpsfm_core.testing.hook_checks import HOOK_CHECKS, run_hook_checks

    @pytest.mark.parametrize("id", [check_id(check) for check in HOOK_CHECKS])
    def test_hooks(id: str) -> None:
        results = run_hook_checks(registry or Registry.discover(), name, only={id})
        if not results:
            pytest.skip("the plugin does not implement the hook")
        report(results[0])

    return test_hooks


def report(result: CheckResult) -> None:
    """End the current pytest test with the status of a contract check."""
    import pytest

    __tracebackhide__ = True
    if result.status in ("skip", "unmeasured"):
        pytest.skip(result.message)
    if result.status == "xfail":
        pytest.xfail(result.message)
    if result.status == "fail":
        pytest.fail(result.message, pytrace=False)
