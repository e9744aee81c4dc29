"""Contract of a provider, which selects the checks of its kind and runs them one by one."""

from __future__ import annotations

import importlib
import tempfile
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mpsfm_core.data.errors import InputError, MpsfmError, ProviderError, did_you_mean
from mpsfm_core.providers import KINDS, PROVIDER_KINDS, Kind, ProviderSpec
from mpsfm_core.providers.registry import ProviderStatus, Registry
from mpsfm_core.support.yaml_text import parse_yaml
from mpsfm_core.testing.checks.common import (
    COMMON,
    STANDALONE,
    check_construction,
    check_output_rules,
    check_specification,
)
from mpsfm_core.testing.contract_case import ContractCase, ContractSetup, load_setup
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped, CheckUnmeasured

Check = Callable[[ContractCase], str | None]
"""Type of a contract check, a function that returns nothing or a remark if the provider passes.
A check that fails or does not apply raises ``CheckFailed`` or ``CheckSkipped``."""

Status = Literal["pass", "fail", "skip", "unmeasured", "xfail"]
SetupSource = ContractSetup | Callable[[Path], ContractSetup] | None


def checks_of_kind(kind: Kind) -> tuple[Check, ...]:
    """Return the contract checks of a provider kind, in addition to those for every kind."""
    module, _, name = PROVIDER_KINDS[kind].checks.partition(":")
    checks: tuple[Check, ...] = getattr(importlib.import_module(module), name)
    return checks


REQUIRED: tuple[Check, ...] = (check_specification, check_construction, check_output_rules)
"""Contract checks whose failure makes all later checks meaningless; later checks are then
skipped."""


@dataclass(frozen=True)
class CheckResult:
    """Result of one contract check of one provider."""

    provider: str
    """Kind and name of the provider, such as ``depth/files``."""
    around: str
    """Provider kind that a wrapper under test wraps, else empty."""
    id: str
    """Id of the check, such as ``depth-is-z``."""
    status: Status
    """Outcome of the contract check, such as ``pass`` or ``fail``. A check is skipped (``skip``) if
    it does not apply, and ``unmeasured`` if the check applies but the ground truth is unknown. A
    failure that the plugin declares as expected is ``xfail``."""
    message: str
    """Reason why the check failed or was skipped, or the remark of a check that passed."""
    seconds: float
    """Run time of the check in seconds."""


@dataclass(frozen=True)
class CheckTask:
    """One contract check to run on one provider."""

    id: str
    """Id of the contract check."""
    around: str
    """Provider kind that a wrapper under test wraps, else empty."""

    def __str__(self) -> str:
        return f"{self.around}-{self.id}" if self.around else self.id


class Contract:
    """Runner of all contract checks of one provider."""

    def __init__(
        self,
        registry: Registry,
        kind: Kind,
        name: str,
        folder: Path,
        setup: SetupSource = None,
        *,
        device: str = "cpu",
    ) -> None:
        """Prepare the contract of a provider without constructing the provider.

        Args:
            registry: Registry of the installed providers.
            kind: Kind of the provider, such as ``depth``.
            name: Name of the provider under test, or ``DISTRIBUTION:NAME``.
            folder: Folder for the weights files of test networks.
            setup: ContractSetup, or a function that returns one; by default that of the
                specification.
            device: Device of the provider, ``"cpu"`` or ``"cuda"``.

        Raises:
            ProviderError: the provider does not exist or is unavailable.
        """
        self.spec = registry.spec(kind, name)
        self._name = name
        self._registry = registry
        self._folder = folder
        self._setup = setup
        self._device = device
        self._cases: dict[str, ContractCase] = {}
        self._failed_required: dict[str, str] = {}
        self._has_timed_out = False

    @property
    def provider(self) -> str:
        """Kind and name of the provider, such as ``depth/files``."""
        return f"{self.spec.kind}/{self.spec.name}"

    def tasks(self) -> list[CheckTask]:
        """Return the checks in the order to run them. Creates no provider."""
        return schedule_checks(self.spec)

    def run(self, task: CheckTask) -> CheckResult:
        """Run one contract check; an exception of the provider counts as failure."""
        started = time.perf_counter()
        reason = ""
        try:
            case = self._case(task.around)
            reason = case.setup.expected_failures.get(task.id, "")
            status, message = self._outcome(case, task)
        except ProviderError as error:  # The plugin's function failed to create the ContractSetup.
            status, message = "fail", str(error)
        if reason and status == "fail":
            status, message = "xfail", f"{reason} ({message})"
        elif reason and status == "pass":
            status, message = "fail", f"passes, and was expected to fail: {reason}"
        seconds = time.perf_counter() - started
        return CheckResult(self.provider, task.around, task.id, status, message, seconds)

    def _outcome(self, case: ContractCase, task: CheckTask) -> tuple[Status, str]:
        check = find_check(task.id)
        if self._has_timed_out:
            return "skip", "an earlier call of the provider did not return"
        if check not in REQUIRED and check not in STANDALONE:
            failed_id = self._first_failed_required(case, task.around)
            if failed_id:
                return "skip", f"{failed_id} fails"
        try:
            return "pass", check(case) or ""
        except CheckSkipped as skipped:
            is_unmeasured = isinstance(skipped, CheckUnmeasured)
            return ("unmeasured" if is_unmeasured else "skip"), str(skipped)
        except (CheckFailed, MpsfmError) as failed:
            return "fail", str(failed)
        except TimeoutError as late:
            self._has_timed_out = True  # Each further call may take the whole time limit.
            return "fail", str(late)
        # A provider that the check calls directly raised the exception.
        except (Exception, SystemExit) as error:
            return "fail", f"{type(error).__name__}: {error}"

    def _first_failed_required(self, case: ContractCase, around: str) -> str:
        """Return the id of the first failed check of :data:`REQUIRED`, or an empty text."""
        if around not in self._failed_required:
            failed = (check_id(check) for check in REQUIRED if not _passes(check, case))
            self._failed_required[around] = next(failed, "")
        return self._failed_required[around]

    def _case(self, around: str) -> ContractCase:
        if around not in self._cases:
            setup = self._make_setup(self._folder)
            known = {task.id for task in self.tasks()}
            for name in setup.expected_failures:
                if name not in known:
                    raise ProviderError(f"expected failure {name!r}{did_you_mean(name, known)}")
            self._cases[around] = ContractCase(
                self._registry,
                self.spec,
                setup,
                self._folder,
                name=self._name,
                behaves_as=around or None,
                device=self._device,
                make_setup=self._make_setup,
            )
        return self._cases[around]

    def _make_setup(self, folder: Path) -> ContractSetup:
        """Return the ContractSetup, whose function writes weights of test networks to a folder."""
        if self._setup is None:
            return load_setup(self.spec, folder)
        return self._setup if isinstance(self._setup, ContractSetup) else self._setup(folder)


def run_checks(
    registry: Registry,
    kind: Kind,
    name: str,
    setup: SetupSource = None,
    *,
    only: Collection[str] | None = None,
    device: str = "cpu",
    on_start: Callable[[str, str, str], None] | None = None,
    on_result: Callable[[CheckResult], None] | None = None,
) -> list[CheckResult]:
    """Run the contract checks of a provider.

    Args:
        registry: Registry of the installed providers.
        kind: Kind of the provider, such as ``depth``.
        name: Name of the provider under test.
        setup: ContractSetup, or a function that returns one, by default the function that the
            specification names.
        only: Ids of the contract checks to run, or None to run all.
        device: Device of the provider, ``"cpu"`` or ``"cuda"``.
        on_start: Function that is called with the first three fields of the
            :class:`CheckResult` before each check.
        on_result: Function that is called with the result of each check.

    Returns:
        Check results in the order of the checks.

    Raises:
        ProviderError: the provider does not exist or is unavailable.
    """
    results = []
    with tempfile.TemporaryDirectory(prefix="mpsfm-contract-") as folder:
        contract = Contract(registry, kind, name, Path(folder), setup, device=device)
        for task in contract.tasks():
            if only is None or task.id in only:
                if on_start:
                    on_start(contract.provider, task.around, task.id)
                results.append(contract.run(task))
                if on_result:
                    on_result(results[-1])
    return results


def find_providers(registry: Registry, name: str) -> list[tuple[Kind, str]]:
    """Find the providers that the name of a provider, plugin or distribution denotes.

    Args:
        registry: Registry to search.
        name: Name of a provider (``onnx``), kind and name (``depth/onnx``), distribution and name
            (``mpsfm-onnx:onnx``), or distribution (``mpsfm-onnx``, which denotes all of its
            providers).

    Returns:
        Kind and name of each provider that the name denotes. The name has the form
        ``DISTRIBUTION:NAME`` if another distribution has a provider of the same name.

    Raises:
        InputError: the name denotes no provider, plugin or distribution.
        ProviderError: the plugin failed to load or has no providers, or one of its providers is
            unavailable.
    """
    lines = [line for line in registry.status() if line.kind != "plugin"]
    matching = [
        line
        for line in lines
        if name
        in (
            line.name,
            f"{line.kind}/{line.name}",
            line.distribution,
            f"{line.distribution}:{line.name}",
        )
    ]
    if not matching:
        plugin = find_plugin(registry, name)
        if plugin is not None and plugin.available:
            raise ProviderError(f"{name} only has hooks and no providers to check")
        if plugin is not None:
            raise ProviderError(f"{name} {plugin.reason}; {plugin.install_hint}")
        candidates = {n for line in registry.status() for n in (line.name, line.distribution)}
        raise InputError(f"no provider or plugin {name!r}{did_you_mean(name, candidates)}")
    providers: list[tuple[Kind, str]] = []
    for line in matching:
        assert line.kind != "plugin"
        is_named = line.name in (name, name.rpartition("/")[2])
        if line.available or is_named:
            providers.append((line.kind, line.name))
        else:
            # Raise ProviderError with the reason, unless several packages have a provider of this
            # name.
            qualified = f"{line.distribution}:{line.name}"
            registry.spec(line.kind, qualified)
            providers.append((line.kind, qualified))
    return list(dict.fromkeys(providers))


def find_plugin(registry: Registry, name: str) -> ProviderStatus | None:
    """Find a plugin without usable providers, which offers only hooks or failed to load.

    Args:
        registry: Registry to search.
        name: Name of the plugin's entry point or distribution.

    Returns:
        Status of the plugin without usable providers, or None.
    """
    plugins = (line for line in registry.status() if line.kind == "plugin")
    return next((line for line in plugins if name in (line.name, line.distribution)), None)


def parse_setup(assignments: Sequence[str]) -> ContractSetup | None:
    """Parse provider options of the command line into a ContractSetup.

    Args:
        assignments: Option assignments ``key=value`` or ``group.key=value`` with YAML values.

    Returns:
        ContractSetup with the provider options, or None without assignments, so that the plugin's
        own ContractSetup is used.

    Raises:
        InputError: a text is not an assignment ``key=value``.
    """
    options: dict[str, Any] = {}
    for text in assignments:
        path, equals, value = text.partition("=")
        *parents, key = path.strip().split(".")
        if not (equals and key):
            raise InputError(f"option {text!r} must look like key=value")
        group = options
        for parent in parents:
            group = group.setdefault(parent, {})
        group[key] = parse_yaml(value, text)
    return ContractSetup(options=options) if options else None


def schedule_checks(spec: ProviderSpec) -> list[CheckTask]:
    """Return the contract checks that apply to a provider, in the order to run them."""
    wrapped = [kind for kind in ("depth", "normals") if f"wraps-{kind}" in spec.capabilities]
    tasks = []
    for around in (wrapped or ["depth"]) if spec.kind == "wrapper" else [""]:
        special = [*checks_of_kind(spec.kind), *(checks_of_kind(around) if around else ())]
        checks = [*STANDALONE, check_output_rules, *special, *COMMON]
        tasks += [CheckTask(check_id(check), around) for check in checks]
    return tasks


def list_checks() -> list[Check]:
    """Return the contract checks of all provider kinds, first those for every kind."""
    special = dict.fromkeys(check for kind in KINDS for check in checks_of_kind(kind))
    return [*STANDALONE, check_output_rules, *COMMON, *special]


def find_check(id: str) -> Check:
    """Return the contract check with the given id."""
    return next(check for check in list_checks() if check_id(check) == id)


def parse_check_ids(
    ids: Collection[str], hook_checks: Sequence[Callable[..., str | None]] = ()
) -> set[str]:
    """Return check ids as a set after verifying that each one is the id of a contract check.

    Args:
        ids: Ids of contract checks.
        hook_checks: Contract checks of hooks, whose ids are also allowed.

    Raises:
        InputError: an id is not the id of a contract check.
    """
    known = [check_id(check) for check in list_checks()]
    known += [check_id(check) for check in hook_checks]
    for name in ids:
        if name not in known:
            raise InputError(f"no check {name!r}{did_you_mean(name, known)}")
    return set(ids)


def check_id(check: Callable[..., str | None]) -> str:
    """Return the id of a contract check, such as ``depth-is-z`` for ``check_depth_is_z``."""
    return check.__name__.removeprefix("check_").replace("_", "-")


def _passes(check: Check, case: ContractCase) -> bool:
    try:
        check(case)
    except CheckSkipped:
        return True
    except (Exception, SystemExit):
        return False
    return True
