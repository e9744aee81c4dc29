"""Tests of the contract runner: expected failures, required checks, provider names."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import pytest
from threadpoolctl import threadpool_limits

from mpsfm_core import ProviderContext, ProviderSpec, View
from mpsfm_core.data.errors import InputError, ProviderError
from mpsfm_core.providers import KINDS
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import ContractSetup, run_checks
from mpsfm_core.testing.contract import (
    check_id,
    checks_of_kind,
    find_check,
    find_providers,
    list_checks,
)
from tests.support.reference_providers import PaintedDepth, depth_prior

PAINTED = ContractSetup(truth_source="painted")


class Millimetres(PaintedDepth):
    def predict(self, view: View) -> Any:
        prior = super().predict(view)
        return depth_prior(1000 * prior.depth)


def registry_of(*specs: ProviderSpec) -> Registry:
    registry = Registry()
    registry.add(*specs, distribution="mpsfm-here")
    return registry


def outcomes(factory: Any, setup: Any, *only: str) -> dict[str, tuple[str, str]]:
    registry = registry_of(ProviderSpec("depth", "here", factory))
    results = run_checks(registry, "depth", "here", setup, only=only or None)
    return {r.id: (r.status, r.message) for r in results}


def test_expected_failure_is_reported_with_its_reason() -> None:
    setup = ContractSetup(
        truth_source="painted", expected_failures={"depth-scale": "the network is in mm"}
    )
    found = outcomes(Millimetres, setup, "depth-scale", "depth-is-z")
    assert found["depth-is-z"][0] == "pass"
    status, message = found["depth-scale"]
    assert status == "xfail"
    assert message.startswith("the network is in mm (depth is declared metric")


def test_passing_expected_failure_fails() -> None:
    setup = ContractSetup(
        truth_source="painted", expected_failures={"depth-scale": "the network is in mm"}
    )
    status, message = outcomes(PaintedDepth, setup, "depth-scale")["depth-scale"]
    assert status == "fail"
    assert message == "passes, and was expected to fail: the network is in mm"


def test_expected_failures_need_a_reason_and_a_check() -> None:
    with pytest.raises(ValueError, match="'depth-scale' needs a reason"):
        ContractSetup(expected_failures={"depth-scale": " "})
    setup = ContractSetup(expected_failures={"depth-scal": "because"})
    status, message = outcomes(PaintedDepth, setup, "depth-scale")["depth-scale"]
    assert status == "fail"
    assert "did you mean 'depth-scale'" in message


def test_prepared_truth_requires_the_function_prepare() -> None:
    with pytest.raises(ValueError, match="requires the function prepare"):
        ContractSetup(truth_source="prepared")


def test_without_a_known_answer_accuracy_is_skipped_not_passed() -> None:
    found = outcomes(PaintedDepth, None)
    needing = {"depth-is-z", "depth-scale", "depth-channel-order", "depth-pixel-convention"}
    needing |= {"depth-orientation", "depth-validity", "depth-variance"}
    assert {found[name][0] for name in needing} == {"unmeasured"}
    assert all("ground truth is unknown" in found[name][1] for name in needing)
    assert found["odd-size"] == (
        "pass",
        "valid output; accuracy not measured without ground truth",
    )


def test_plugin_declares_its_contract_setup(tmp_path: Path) -> None:
    folders = []

    def contract(folder: Path) -> ContractSetup:
        folders.append(folder)
        assert folder.is_dir()
        return PAINTED

    registry = registry_of(ProviderSpec("depth", "here", PaintedDepth, contract=contract))
    results = run_checks(registry, "depth", "here", only={"depth-is-z", "depth-scale"})
    assert [r.status for r in results] == ["pass", "pass"]
    assert len(folders) == 1 and not folders[0].exists()


@pytest.mark.parametrize(
    ("contract", "message"),
    [
        ("no_such_module:contract", "No module named 'no_such_module'"),
        (lambda folder: {"weights": 1}, "returns a dict, not a ContractSetup"),
    ],
)
def test_a_contract_that_fails(contract: Any, message: str) -> None:
    registry = registry_of(ProviderSpec("depth", "here", PaintedDepth, contract=contract))
    (result,) = run_checks(registry, "depth", "here", only={"construction"})
    assert result.status == "fail"
    assert message in result.message


def test_matcher_gets_features_of_its_family() -> None:
    class Matcher:
        def __init__(self, options: None, context: ProviderContext) -> None: ...

        def match(self, *arguments: Any) -> Any: ...

    sparse = frozenset({"sparse"})
    registry = registry_of(ProviderSpec("matcher", "m", Matcher, capabilities=sparse, tags=("x",)))
    (result,) = run_checks(registry, "matcher", "m", only={"output-rules"})
    assert (result.status, result.message) == (
        "fail",
        "no features provider of the family x is installed",
    )


def test_providers_by_name_kind_and_distribution() -> None:
    depth, normals = (ProviderSpec(kind, "here", PaintedDepth) for kind in ("depth", "normals"))
    registry = registry_of(depth, normals)
    both = [("depth", "here"), ("normals", "here")]
    assert find_providers(registry, "here") == both
    assert find_providers(registry, "mpsfm-here") == both
    assert find_providers(registry, "normals/here") == both[1:]
    with pytest.raises(InputError, match="no provider or plugin 'hear'; did you mean 'here'"):
        find_providers(registry, "hear")


def test_plugin_without_providers_has_no_checks(install_plugin: Any) -> None:
    source = """
        from mpsfm_core import hookimpl
        @hookimpl
        def mpsfm_filter_pairs(pairs):
            return pairs
    """
    install_plugin("mpsfm-hooks", source)
    with pytest.raises(ProviderError, match="mpsfm-hooks only has hooks and no providers to check"):
        find_providers(Registry.discover(), "mpsfm-hooks")


def test_unavailable_provider_states_the_reason() -> None:
    registry = registry_of(ProviderSpec("depth", "needy", PaintedDepth, requires=("no_such_pkg",)))
    ((kind, name),) = find_providers(registry, "needy")
    with pytest.raises(ProviderError, match="needs no_such_pkg, not installed"):
        run_checks(registry, kind, name)


def test_ids_are_unique_and_every_check_says_what_it_is_about() -> None:
    checks = list_checks()
    ids = [check_id(check) for check in checks]
    assert len(set(ids)) == len(ids)
    assert all(find_check(name) is check for name, check in zip(ids, checks, strict=True))
    assert all((check.__doc__ or "").strip().endswith(".") for check in checks)
    assert all(checks_of_kind(kind) for kind in KINDS)


def test_find_providers_of_a_distribution_never_returns_another_ones_provider() -> None:
    registry = Registry.discover(environments=False)
    registry.add(ProviderSpec("depth", "flat", PaintedDepth), distribution="mpsfm-other")
    assert find_providers(registry, "mpsfm-other") == [("depth", "mpsfm-other:flat")]
    (result,) = run_checks(registry, "depth", "mpsfm-other:flat", PAINTED, only={"depth-variance"})
    assert result.status == "pass"  # The built-in provider ``flat`` has no variance.
    registry.add(ProviderSpec("depth", "needy", PaintedDepth, requires=("no_such_pkg",)))
    with pytest.raises(ProviderError, match="needs no_such_pkg"):
        find_providers(registry, "this process")
    assert ("depth", "flat") in find_providers(registry, "mpsfm-core")


class FailsInSecondProcess(PaintedDepth):
    """Depth provider that raises in a second process, or ends the second process."""

    def predict(self, view: View) -> Any:
        if os.environ["PYTHONHASHSEED"] == "4321":
            self.fail()
        return super().predict(view)

    def fail(self) -> None:
        raise RuntimeError("no display")


class EndsSecondProcess(FailsInSecondProcess):
    def fail(self) -> None:
        tempfile.mkdtemp()
        os.write(2, b"Segmentation fault\n")
        os._exit(1)


@pytest.mark.parametrize(
    ("factory", "message"),
    [(FailsInSecondProcess, "no display"), (EndsSecondProcess, "Segmentation fault")],
)
def test_second_process_failure_is_reported_and_later_providers_are_checked(
    factory: type, message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PYTHONHASHSEED", "0")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    status, text = outcomes(factory, PAINTED, "second-process")["second-process"]
    assert status == "fail"
    assert text.startswith("the provider fails in a second process") and text.endswith(message)
    assert outcomes(PaintedDepth, PAINTED, "second-process")["second-process"][0] == "pass"
    # The ended process leaves no files; those of the running process are in its folder.
    assert {path.name for path in tmp_path.glob("*/*")} == {"input", "input.answer"}


@pytest.mark.parametrize("threads", [1, 2])
def test_outputs_of_processes_are_compared_with_equal_numbers_of_blas_threads(threads: int) -> None:
    with threadpool_limits(threads, user_api="blas"):
        results = run_checks(
            Registry.discover(), "matcher", "mutual-nearest", only=("second-process",)
        )
    assert [(r.status, r.message) for r in results if r.status != "pass"] == []
