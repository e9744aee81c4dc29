"""Tests that correct providers of every kind pass all checks, and skip only with a reason."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from mpsfm_core.providers import Kind, ProviderSpec
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import ContractSetup, run_checks
from tests.support import reference_providers as ref

PAINTED = ContractSetup(truth_source="painted")
JOINT = frozenset({"metric", "variance", "joint-normals", "estimates-focal"})
EVERYTHING = ("metric", "variance", "proposes-poses", "proposes-intrinsics")
MODULE = ref.__name__


def told(folder: Path) -> ContractSetup:
    return ContractSetup(
        options={"folder": folder},
        truth_source="prepared",
        prepare=lambda example: ref.tell(folder, example),
    )


def told_group(folder: Path) -> ContractSetup:
    tell = ref.tell_group
    return ContractSetup(
        options={"folder": folder},
        truth_source="prepared",
        prepare=lambda example: tell(folder, example),
    )


def spec(kind: Kind, name: str, *capabilities: str, options: str | None = None) -> ProviderSpec:
    options = options and f"{MODULE}:{options}"
    factory = f"{MODULE}:{name}"
    return ProviderSpec(kind, "reference", factory, options, frozenset(capabilities))


@pytest.mark.parametrize(
    ("given", "setup", "skipped"),
    [
        (spec("depth", "PaintedDepth", *JOINT), PAINTED, {"depth-intrinsics"}),
        (
            spec("normals", "PaintedNormals", "variance"),
            PAINTED,
            {"normals-validity", "normals-depth-input"},
        ),
        (
            spec("matcher", "ToldMatcher", "dense", "pair-depth", options="ToldOptions"),
            told,
            {
                "matcher-no-features",
                "matcher-few-features",
                "matcher-many-features",
                "name-does-not-matter",
                "large-view",
                "panorama",
                "few-colors",
                "matcher-sizes",
                "matcher-mixed-sizes",
                "matcher-scores",
                "matcher-feature-order",
                "matcher-large-view",
            },
        ),
        (
            spec("multiview", "ToldGroup", *EVERYTHING, options="ToldOptions"),
            told_group,
            {"name-does-not-matter", "depth-channel-order", "depth-intrinsics", "few-colors"},
        ),
        (spec("retrieval", "Thumbnail"), None, {"large-view", "panorama", "few-colors"}),
        (spec("mask", "PaintedMask"), PAINTED, set()),
        (
            spec("wrapper", "Wrapper", "wraps-depth", "wraps-normals"),
            None,
            {
                "wrapper-keeps-unit",
                "wrapper-uses-the-provider",
                "wrapper-hands-on-depth",
                "depth-channel-order",
                "depth-intrinsics",
                "depth-variance",
                "depth-joint",
                "depth-focal",
                "normals-away-from-axis",
                "few-colors",
                "normals-channel-order",
                "normals-variance",
                "normals-depth-input",
            },
        ),
    ],
    ids=lambda value: value.kind if isinstance(value, ProviderSpec) else "",
)
def test_correct_providers_pass(
    given: ProviderSpec,
    setup: ContractSetup | Callable[[Path], ContractSetup] | None,
    skipped: set[str],
) -> None:
    registry = Registry()
    registry.add(given)
    results = run_checks(registry, given.kind, given.name, setup)
    assert {r.id: r.message for r in results if r.status in ("fail", "xfail")} == {}
    assert {r.id for r in results if r.status in ("skip", "unmeasured")} == {
        *skipped,
        "light-import",
        "missing-file",
    }
    assert all(r.message for r in results if r.status in ("skip", "unmeasured"))
