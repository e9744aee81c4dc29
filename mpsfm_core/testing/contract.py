"""The contract: all checks of a provider, run one by one."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from mpsfm_core.data.errors import InputError, MpsfmError, ProviderError, did_you_mean
from mpsfm_core.providers import Kind, ProviderSpec
from mpsfm_core.providers.registry import ProviderStatus, Registry
from mpsfm_core.support.yaml_text import parse_yaml
from mpsfm_core.testing.checks import depth as checks_depth
from mpsfm_core.testing.checks import features as checks_features
from mpsfm_core.testing.checks import mask as checks_mask
from mpsfm_core.testing.checks import matcher as checks_matcher
from mpsfm_core.testing.checks import multiview as checks_multiview
from mpsfm_core.testing.checks import normals as checks_normals
from mpsfm_core.testing.checks import retrieval as checks_retrieval
from mpsfm_core.testing.checks import wrapper as checks_wrapper
from mpsfm_core.testing.checks.common import (
    COMMON,
    STANDALONE,
    check_construction,
    check_output_rules,
    check_specification,
)
from mpsfm_core.testing.contract_case import ContractCase, ContractSetup, load_setup
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

Check = Callable[[ContractCase], str | None]
Status = Literal["pass", "fail", "skip", "xfail"]
SetupSource = ContractSetup | Callable[[Path], ContractSetup] | None

CHECKS_BY_KIND: Mapping[Kind, tuple[Check, ...]] = MappingProxyType(
    {
        "depth": checks_depth.CHECKS,
        "normals": checks_normals.CHECKS,
        "multiview": checks_multiview.CHECKS,
        "features": checks_features.CHECKS,
        "matcher": checks_matcher.CHECKS,
        "retrieval": checks_retrieval.CHECKS,
        "mask": checks_mask.CHECKS,
        "wrapper": checks_wrapper.CHECKS,
    }
)
"""The checks of each kind, besides the common ones."""

REQUIRED: tuple[Check, ...] = (check_specification, check_construction, check_output_rules)
"""Where one of these fails, the others are skipped."""


@dataclass(frozen=True)
class CheckResult:
    """How one check ended.

    ``provider``: kind and name, ``depth/files``. ``around``: what a wrapper was put around, else
    empty. ``message``: why it failed or was skipped, or a remark.
    """

    provider: str
    around: str
    id: str
    status: Status
    message: str
    seconds: float


@dataclass(frozen=True)
class CheckTask:
    """One check of one provider; ``around`` as in :class:`CheckResult`."""

    id: str
    around: str

    def __str__(self) -> str:
        return f"{self.around}-{self.id}" if self.around else self.id


class Contract:
    """All checks of one provider.

    ``setup``: how it is put under test, by default what its plugin says (``spec.contract``).
    ``folder``: for the files of stand-ins. Raises :class:`~mpsfm_core.data.errors.ProviderError`
    when there is no such provider or it is unavailable."""

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
        self.spec = registry.spec(kind, name)
        self._registry = registry
        self._folder = folder
        self._setup = setup
        self._device = device
        self._cases: dict[str, ContractCase] = {}
        self._faults: dict[str, str] = {}

    @property
    def provider(self) -> str:
        """Kind and name."""
        return f"{self.spec.kind}/{self.spec.name}"

    def tasks(self) -> list[CheckTask]:
        """The checks in the order to run them; knows them without making anything."""
        return schedule_checks(self.spec)

    def run(self, task: CheckTask) -> CheckResult:
        """Run one check."""
        started = time.perf_counter()
        reason = ""
        try:
            case = self._case(task.around)
            reason = case.setup.expected_failures.get(task.id, "")
            status, message = self._outcome(case, task)
        except ProviderError as error:  # there is no setup
            status, message = "fail", str(error)
        if reason and status == "fail":
            status, message = "xfail", f"{reason} ({message})"
        elif reason and status == "pass":
            status, message = "fail", f"passes, and was expected to fail: {reason}"
        seconds = time.perf_counter() - started
        return CheckResult(self.provider, task.around, task.id, status, message, seconds)

    def _outcome(self, case: ContractCase, task: CheckTask) -> tuple[Status, str]:
        check = find_check(task.id)
        if check not in REQUIRED and check not in STANDALONE:
            fault = self._fault(case, task.around)
            if fault:
                return "skip", f"{fault} fails"
        try:
            return "pass", check(case) or ""
        except CheckSkipped as skipped:
            return "skip", str(skipped)
        except (CheckFailed, MpsfmError) as failed:
            return "fail", str(failed)
        except Exception as error:  # of the provider, where it is called directly
            return "fail", f"{type(error).__name__}: {error}"

    def _fault(self, case: ContractCase, around: str) -> str:
        """The first of the checks without which the others mean nothing that fails."""
        if around not in self._faults:
            failed = (check_id(check) for check in REQUIRED if not _passes(check, case))
            self._faults[around] = next(failed, "")
        return self._faults[around]

    def _case(self, around: str) -> ContractCase:
        if around not in self._cases:
            setup = self._setup
            if setup is None:
                setup = load_setup(self.spec, self._folder)
            elif not isinstance(setup, ContractSetup):
                setup = setup(self._folder)
            known = {task.id for task in self.tasks()}
            for name in setup.expected_failures:
                if name not in known:
                    raise ProviderError(f"expected failure {name!r}{did_you_mean(name, known)}")
            behaves_as = next((kind for kind in CHECKS_BY_KIND if kind == around), None)
            self._cases[around] = ContractCase(
                self._registry,
                self.spec,
                setup,
                self._folder,
                behaves_as=behaves_as,
                device=self._device,
            )
        return self._cases[around]


def run_checks(
    registry: Registry,
    kind: Kind,
    name: str,
    setup: SetupSource = None,
    *,
    only: Collection[str] | None = None,
    device: str = "cpu",
    on_result: Callable[[CheckResult], None] | None = None,
) -> list[CheckResult]:
    """Run the checks of a provider, or ``only`` those with the given ids.

    ``on_result`` is called after each check. See :class:`Contract`.
    """
    results = []
    with tempfile.TemporaryDirectory(prefix="mpsfm-contract-") as folder:
        contract = Contract(registry, kind, name, Path(folder), setup, device=device)
        for task in contract.tasks():
            if only is None or task.id in only:
                results.append(contract.run(task))
                if on_result:
                    on_result(results[-1])
    return results


def find_providers(registry: Registry, name: str) -> list[tuple[Kind, str]]:
    """Kind and name of the providers that ``name`` means: a provider (``onnx``), one of a kind
    (``depth/onnx``) or all of a distribution (``mpsfm-onnx``).

    Raises :class:`~mpsfm_core.data.errors.InputError` when there is none, and
    :class:`~mpsfm_core.data.errors.ProviderError` with the reason if the plugin is there and has
    none."""
    known = [line for line in registry.status() if line.kind != "plugin"]
    found = [
        (line.kind, line.name)
        for line in known
        if name in (line.name, f"{line.kind}/{line.name}", line.distribution)
    ]
    if not found:
        plugin = find_plugin(registry, name)
        if plugin is not None and plugin.available:
            raise ProviderError(f"{name} brings hooks and no providers to check")
        if plugin is not None:
            raise ProviderError(f"{name} {plugin.reason}; {plugin.install_hint}")
        candidates = {n for line in registry.status() for n in (line.name, line.distribution)}
        raise InputError(f"no provider or plugin {name!r}{did_you_mean(name, candidates)}")
    return [(kind, name) for kind, name in found if kind != "plugin"]


def find_plugin(registry: Registry, name: str) -> ProviderStatus | None:
    """The plugin without providers (it brings hooks only, or fails) of this entry point or
    distribution, if there is one."""
    plugins = (line for line in registry.status() if line.kind == "plugin")
    return next((line for line in plugins if name in (line.name, line.distribution)), None)


def parse_setup(assignments: Sequence[str]) -> ContractSetup | None:
    """The setup of a provider with options given as ``key=value`` (or ``a.b=value``) with YAML
    values; None if there are none, which means what the plugin says.

    Raises :class:`~mpsfm_core.data.errors.InputError` for what is no assignment.
    """
    options: dict[str, Any] = {}
    for text in assignments:
        path, equals, value = text.partition("=")
        *parents, key = path.strip().split(".")
        if not (equals and key):
            raise InputError(f"{text!r} must look like key=value")
        place = options
        for parent in parents:
            place = place.setdefault(parent, {})
        place[key] = parse_yaml(value, text)
    return ContractSetup(options=options) if options else None


def schedule_checks(spec: ProviderSpec) -> list[CheckTask]:
    """The checks of a provider of this specification, in the order to run them."""
    wrapped = [kind for kind in ("depth", "normals") if f"wraps-{kind}" in spec.capabilities]
    tasks = []
    for around in (wrapped or ["depth"]) if spec.kind == "wrapper" else [""]:
        special = [*CHECKS_BY_KIND[spec.kind]]
        special += next((checks for kind, checks in CHECKS_BY_KIND.items() if kind == around), ())
        checks = [*STANDALONE, check_output_rules, *special, *COMMON]
        tasks += [CheckTask(check_id(check), around) for check in checks]
    return tasks


def list_checks() -> list[Check]:
    """Every check of the kit, the common ones first."""
    special = dict.fromkeys(check for checks in CHECKS_BY_KIND.values() for check in checks)
    return [*STANDALONE, check_output_rules, *COMMON, *special]


def find_check(id: str) -> Check:
    """The check with an id."""
    return next(check for check in list_checks() if check_id(check) == id)


def parse_check_ids(ids: Collection[str]) -> set[str]:
    """The ids as a set; raises :class:`~mpsfm_core.data.errors.InputError` for one that is no
    check."""
    known = [check_id(check) for check in list_checks()]
    for name in ids:
        if name not in known:
            raise InputError(f"no check {name!r}{did_you_mean(name, known)}")
    return set(ids)


def check_id(check: Check) -> str:
    """The check's name in reports: ``check_depth_is_z`` is ``depth-is-z``."""
    return check.__name__.removeprefix("check_").replace("_", "-")


def _passes(check: Check, case: ContractCase) -> bool:
    try:
        check(case)
    except CheckSkipped:
        return True
    except Exception:
        return False
    return True
